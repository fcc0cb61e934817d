"""A flight's frames as its map needs them: after those of a killed run, and of a video no more than is needed."""

from collections.abc import Callable, Generator, Iterator
from contextlib import closing

from sorvolo.capture.source import LiveSource
from sorvolo.capture.video import VideoSource
from sorvolo.capture.video_spans import SparseReading
from sorvolo.missions.flight.frames_ahead import read_ahead
from sorvolo.missions.flight.setup import FlightSetup
from sorvolo.missions.map.journal import Earlier
from sorvolo.mosaic.selection import SelectionSettings, SmallCopies, every, shows_all_between
from sorvolo.survey.flight import Frame, LostFrame, PosedFrame

_AHEAD = 2  # decoded frames that wait to be placed


class FrameReader:
    """Reads a flight's frames after those of a killed run; of these only the ones that are needed again.

    Of a recorded video it decodes the key frames of the stream, and what lies between them where that is needed by
    `selection`; None: every frame.
    """

    def __init__(
        self, setup: FlightSetup, before: Earlier, selection: SelectionSettings | None
    ) -> None:
        self._setup, self._before, self._selection = setup, before, selection
        self._is_candidate = every(setup.plan.step_s)
        self.small = SmallCopies()
        self.read = 0

    def posed(self, look: Callable[[PosedFrame], None]) -> Iterator[PosedFrame | LostFrame]:
        """The frames to select from; `look` gets those that the killed run took, and that are needed again."""
        for each in self._frames():
            is_new = each.index > self._before.last
            if is_new:
                self.read = each.index + 1
            if isinstance(each, LostFrame):
                if is_new:
                    yield each
                continue
            posed = PosedFrame(each, self._setup.prior(each, first=each.index == 0))
            if is_new:
                yield posed
            else:
                look(posed)

    def _frames(self) -> Generator[Frame | LostFrame]:
        """Those of a recorded flight are decoded while those before them are placed: photos by their source."""
        source = self._setup.source
        if isinstance(source, LiveSource) or source.kind == "photos":
            yield from source.frames(self._is_wanted)
            return
        if isinstance(source, VideoSource) and self._selection is not None:
            frames = source.frames(
                self._is_wanted,
                SparseReading(self._setup.plan.step_s, self._is_needed, self._is_enough),
            )
        else:
            frames = source.frames(self._is_wanted)
        with closing(read_ahead(frames, _AHEAD)) as ahead:
            yield from ahead

    def _is_wanted(self, index: int, time_ns: int) -> bool:
        return self._is_candidate(index, time_ns) and self._is_needed(index, time_ns)

    def _is_needed(self, index: int, _time_ns: int) -> bool:
        return index > self._before.last or index in self._before.needed

    def _is_enough(self, before: Frame, after: Frame) -> bool:
        assert self._selection is not None
        return shows_all_between(self.small.of(before), self.small.of(after), self._selection)
