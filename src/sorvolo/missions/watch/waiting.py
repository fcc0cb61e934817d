"""Frames of a live flight that wait to be searched: new ground comes first, and what is left waits for the landing."""

import heapq
import shutil
import threading
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sorvolo.capture.source import LiveSource
from sorvolo.errors import StoreError
from sorvolo.geometry.arrays import ImageRGB, PointsM
from sorvolo.geometry.polygons import points_inside
from sorvolo.store.images import image_from_jpeg, jpeg_from_image
from sorvolo.store.site.spill import SpillFile
from sorvolo.survey.flight import Frame, LostFrame

_LEVELS = 16  # of a frame's share of new ground: of those alike the newest is searched; below one, nothing is new
_SECOND_LOOKS = 2  # at what was seen once: three views announce it
_LATELY = 600  # frames among which those are looked for, a minute; by choice
_LEAST_FREE = 2_000_000_000  # bytes that stay free on the disk: pictures that would not fit are not kept; by choice


@dataclass(frozen=True, eq=False)
class _Kept:
    """A frame that came; its picture is in the file of all of them. `outline_m`: the ground that it shows."""

    index: int
    name: str
    time_ns: int
    arrived_s: float
    outline_m: PointsM | None = None


class WaitingFrames:
    """The frames of a live source, kept on the disk in `folder` while a slower detector searches them.

    A thread reads the source from the moment it is made. `live` gives frames until the flight ends, `in_order` all of
    it again. A context manager, whose end gives the disk's space back.
    """

    def __init__(
        self, source: LiveSource, wanted: Callable[[int, int], bool], folder: Path
    ) -> None:
        self._source, self._wanted = source, wanted
        self._folder = folder
        self._pictures = SpillFile(folder)
        self._changed = threading.Condition()
        self._came: list[_Kept | LostFrame] = []  # since `live` looked last
        self._newest: Frame | None = None
        self._is_over = False
        self._error: BaseException | None = None
        self._kept: list[_Kept] = []
        self._heap: list[tuple[int, int, _Kept]] = []
        self._given: set[int] = set()  # by `live`
        self._last, self._is_in_order = -1, True
        self._looked_again: Counter[int] = Counter()
        self._was_second = False
        self.unkept = 0
        """How many frames were not kept, as the disk was full."""
        self._thread = threading.Thread(target=self._collect, name="waiting frames", daemon=True)
        self._thread.start()

    def __enter__(self) -> "WaitingFrames":
        return self

    def __exit__(self, *_: object) -> None:
        self._source.close()
        self._thread.join()
        self._pictures.close()

    def live(
        self,
        ground: Callable[[Frame], PointsM | None],
        new_share: Callable[[PointsM], float],
        doubtful: Callable[[], Mapping[int, PointsM]],
    ) -> Generator[tuple[float, Frame | LostFrame]]:
        """Frames to search until the flight ends, each with when it came (monotonic clock).

        The one comes first that shows the largest share of new ground, by `new_share` of what `ground` gives of each
        frame as it comes; the newest where none shows any. Every second one shows what was seen but not often enough to
        be announced: the places (2,), by id, of `doubtful`. Raises what went wrong with the source.
        """
        while True:
            with self._changed:
                came, self._came = self._came, []
                newest, is_over = self._newest, self._is_over
            if self._error is not None:
                raise self._error
            for each in came:
                if isinstance(each, LostFrame):
                    yield 0.0, each
                else:
                    self._take(each, ground)
            if is_over:
                return
            kept = self._second_look(doubtful()) or self._choose(new_share)
            if kept is None:
                with self._changed:
                    self._changed.wait_for(lambda: self._came or self._is_over)
                continue
            self._given.add(kept.index)
            self._is_in_order &= kept.index > self._last
            self._last = kept.index
            is_newest = newest is not None and newest.index == kept.index
            frame = newest if is_newest else self._frame(kept)
            if frame is not None:
                yield kept.arrived_s, frame

    @property
    def is_in_order(self) -> bool:
        """Whether the frames that `live` gave, and then those that are left, are in order of time."""
        return self._is_in_order and all(each > self._last for each in self.left())

    def kept(self) -> list[int]:
        """The numbers of all frames that came, in order."""
        return [each.index for each in self._kept]

    def left(self) -> list[int]:
        """The numbers of the frames that `live` did not give, in order."""
        return [each.index for each in self._kept if each.index not in self._given]

    def in_order(self, wanted: Callable[[int], bool]) -> Iterator[Frame]:
        """The frames that were kept, those of wanted numbers, in order of time."""
        for each in self._kept:
            frame = self._frame(each) if wanted(each.index) else None
            if frame is not None:
                yield frame

    # ---- in the thread ----------------------------------------------------------------------------------------

    def _collect(self) -> None:
        try:
            for arrived_s, frame in self._source.arrivals(self._wanted):
                kept: _Kept | LostFrame = (
                    frame if isinstance(frame, LostFrame) else self._keep(frame, arrived_s)
                )
                with self._changed:
                    self._came.append(kept)
                    self._newest = frame if isinstance(frame, Frame) else self._newest
                    self._changed.notify_all()
        except BaseException as error:  # raised where the frames are taken
            self._error = error
        finally:
            with self._changed:
                self._is_over = True
                self._changed.notify_all()

    def _keep(self, frame: Frame, arrived_s: float) -> _Kept:
        picture = jpeg_from_image(frame.image)
        try:
            with self._changed:
                if shutil.disk_usage(self._folder).free < _LEAST_FREE:
                    raise StoreError("the disk is full")
                self._pictures.put(frame.index, picture)
        except StoreError:
            self.unkept += 1
        return _Kept(frame.index, frame.name, frame.time_ns, arrived_s)

    # ---- where frames are searched ----------------------------------------------------------------------------

    def _take(self, kept: _Kept, ground: Callable[[Frame], PointsM | None]) -> None:
        height, width = self._source.size_px[::-1]
        unseen = Frame.unseen(kept.index, kept.name, kept.time_ns, (height, width))
        outline_m = ground(unseen)
        kept = replace(kept, outline_m=outline_m)
        self._kept.append(kept)
        if outline_m is not None:
            heapq.heappush(self._heap, (-_LEVELS, -kept.index, kept))

    def _second_look(self, doubtful: Mapping[int, PointsM]) -> _Kept | None:
        """A frame that shows one of these places in its middle; not twice in turn, and of each place a few times."""
        if self._was_second:
            self._was_second = False
            return None
        for name, place_m in doubtful.items():
            if self._looked_again[name] >= _SECOND_LOOKS:
                continue
            showing = [
                each
                for each in self._kept[-_LATELY:]
                if each.index not in self._given
                and each.outline_m is not None
                and points_inside([each.outline_m], place_m[None]).all()
            ]
            if showing:
                self._looked_again[name] += 1
                self._was_second = True
                return showing[len(showing) // 2]
        return None

    def _choose(self, new_share: Callable[[PointsM], float]) -> _Kept | None:
        """The frame with the most new ground. Its share only falls while others are searched, so one that still comes
        before the next one's last share comes before them all."""
        while self._heap:
            _, order, kept = heapq.heappop(self._heap)
            assert kept.outline_m is not None
            level = int(_LEVELS * new_share(kept.outline_m))
            if kept.index in self._given or level == 0:
                continue
            if self._heap and (-level, order) > self._heap[0][:2]:
                heapq.heappush(self._heap, (-level, order, kept))
                continue
            return kept
        return next((each for each in reversed(self._kept) if each.index not in self._given), None)

    def _frame(self, kept: _Kept) -> Frame | None:
        """A frame with its picture; None where that was not kept."""
        image = self.picture(kept.index)
        return Frame(kept.index, kept.name, kept.time_ns, image) if image.size else None

    def picture(self, index: int) -> ImageRGB:
        """The picture of a frame that came, without size where it was not kept."""
        with self._changed:
            try:
                picture = self._pictures.get(index)
            except KeyError:
                return np.zeros((0, 0, 3), np.uint8)
        return image_from_jpeg(picture, f"{index}")
