"""`sorvolo watch --through-trees`: frames put together on the forest floor while the flight goes on, and at its end."""

import math
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from sorvolo.canopy.finds import Find
from sorvolo.capture.source import LiveSource
from sorvolo.errors import InputError
from sorvolo.geometry.arrays import Floats, ImageRGB
from sorvolo.geometry.pose import Pose
from sorvolo.heights.cameras import Matches
from sorvolo.heights.views import View, inside
from sorvolo.missions.flight.result_cache import ResultCache
from sorvolo.missions.flight.setup import FlightSetup
from sorvolo.missions.flight.threads import lower_priority
from sorvolo.missions.heights.run import lens_left_over
from sorvolo.missions.mission import Mission
from sorvolo.missions.search.through_trees import LookedUnderTrees, look_through_trees
from sorvolo.registration.lens import Undistorter
from sorvolo.store.exports.detection_files import write_crop
from sorvolo.store.images import image_from_jpeg, jpeg_from_image
from sorvolo.store.site.spill import SpillFile
from sorvolo.survey.flight import Frame, Site
from sorvolo.survey.objects import PERSON, Sighting, Track
from sorvolo.survey.wording import counted

_KEPT = "under trees"  # the stage of frames that a killed watch of a stream kept
_PER_FRAME = (
    40.0  # of a video, frames kept on the way over as much ground as one shows; all photos are
)
_LEAST_UP_M = 10.0  # above the ground: before take-off there is nothing to see
_AGAIN = 24  # frames kept since the last look, for the next one; by choice
_WINDOW = 60  # frames of a look while the flight goes on; by choice
_MOST_NEW = 40  # of them, where frames come faster than looks; by choice
_FLOOR_M = -25.0, 15.0  # where the floor is looked for, above the telemetry's level ground
_SAME_M = 2.0  # on the floor in one picture: finds that are nearer are one
_FIRST_ID = 90_001  # of a find; the detector's objects count from 1


@dataclass(frozen=True, eq=False)
class ForestFrame:
    """A frame that was kept, as it was taken by telemetry; `time_ns` is UTC."""

    index: int
    time_ns: int
    view: View
    jpeg: bytes


class ThroughTrees:
    """A watch's frames kept one step apart and put together on the floor, in a thread of low priority.

    `take` is given frames in order of time, `finish` puts all of them together and writes the files. A recording waits
    for a look that is not over when the next one is due, so that equal watches announce the same; a live flight leaves
    frames to the end. Raises InputError for a flight whose telemetry lacks what cameras begin with.
    """

    def __init__(self, setup: FlightSetup, site: Site, folder: Path, memo: ResultCache) -> None:
        telemetry = setup.telemetry
        if site.is_local or telemetry is None or telemetry.track.attitude == "none":
            raise InputError(
                f"{setup.source.name}: to look through trees each frame needs a GPS fix, its height above the ground "
                "and a heading: give --telemetry that has them, or leave --through-trees out"
            )
        self._setup, self._site, self._folder, self._memo = setup, site, folder, memo
        self._sigma_m = telemetry.usual_sigma_m
        self._lens = Undistorter(setup.source.camera.camera)
        self._frames: dict[str, ForestFrame] = {}  # without their pictures
        self._pictures, self._lock = SpillFile(folder), threading.Lock()
        self._thread = ThreadPoolExecutor(1, initializer=lower_priority)
        self._look: Future[LookedUnderTrees | InputError] | None = None
        self._matches = Matches()
        self._looked = 0  # frames that looks began with
        self._shown_m: dict[int, dict[str, Floats]] = {}  # of all finds that were ever announced
        self._new: list[Track] = []
        self.tracks: dict[int, Track] = {}
        """The finds so far, by id."""
        self.headline: dict[str, Any] = {
            "text": "not looked through the trees: stopped before",
            "complete": False,
        }
        """What all frames show together, as a report has it."""
        for frame in memo.kept(_KEPT, ForestFrame):
            self._keep(frame)

    def close(self) -> None:
        """End the thread and give the disk's space back."""
        self._thread.shutdown()
        self._pictures.close()

    def new(self) -> list[Track]:
        """The finds since this was asked last."""
        new, self._new = self._new, []
        return new

    def take(
        self, frame: Frame, pose: Pose | None, picture: Callable[[], ImageRGB] | None = None
    ) -> None:
        """Keep a photo, or a video's frame that is a step from the one before; `picture` gives the image of one that
        came without."""
        if pose is None or pose.translation_m[2] < _LEAST_UP_M:
            return
        camera, last = self._lens.camera, next(reversed(self._frames.values()), None)
        shown_m = pose.translation_m[2] / camera.fx_px * min(camera.width_px, camera.height_px)
        if last is not None and self._setup.source.kind != "photos":
            way_m = math.dist(pose.translation_m, last.view.site_from_camera.translation_m)
            if way_m < shown_m / _PER_FRAME:
                return
        image = frame.image if picture is None else picture()
        if not image.size:
            return
        kept = ForestFrame(
            frame.index,
            self._setup.utc_ns(frame.time_ns),
            View(frame.name, camera, pose, np.full(3, np.nan)),
            jpeg_from_image(self._lens.undistort(image)),
        )
        if self._memo.is_of_stream:
            self._memo.keep(frame, _KEPT, kept)
        self._keep(kept)
        frames = list(self._frames.values())
        is_due = len(frames) - self._looked >= _AGAIN
        waits = is_due and not isinstance(self._setup.source, LiveSource)
        if self._look is not None and (self._look.done() or waits):
            self._take_in()
        if self._look is not None or not is_due:
            return
        # the newest frames, with those of earlier strips beside them
        earlier, new = frames[: self._looked], frames[self._looked :][-_MOST_NEW:]
        middle_m = np.mean([each.view.site_from_camera.translation_m for each in new], axis=0)
        earlier.sort(key=lambda each: math.dist(each.view.site_from_camera.translation_m, middle_m))
        chosen = sorted(earlier[: _WINDOW - len(new)] + new, key=lambda each: each.index)
        self._looked = len(frames)
        self._look = self._thread.submit(self._look_at, chosen, is_quick=True)

    def finish(self) -> None:
        """Put all frames together as a search does, and write its files."""
        if self._look is not None:
            self._take_in()
        looked = self._look_at(list(self._frames.values()), is_quick=False)
        if isinstance(looked, InputError):
            self.headline["text"] = f"not looked through the trees: {looked}"
            return
        self.headline = looked.report["headline"]
        if left := self.tracks.keys() - self._see(looked):  # a person may be among them
            found = counted(len(left), "find")
            self.headline["text"] += (
                f"; {found} announced before, not by all frames: look there too"
            )
        looked.write(self._folder)

    def _keep(self, frame: ForestFrame) -> None:
        with self._lock:
            self._pictures.put(frame.view.name, frame.jpeg)
        self._frames[frame.view.name] = replace(frame, jpeg=b"")

    def _look_at(
        self, frames: Sequence[ForestFrame], *, is_quick: bool
    ) -> LookedUnderTrees | InputError:
        """What frames show together, or why that is not known."""
        looking = look_through_trees(
            self._site.name,
            self._site,
            [each.view for each in frames],
            self._opened,
            {each.view.name: each.time_ns for each in frames},
            self._sigma_m,
            floor_m=_FLOOR_M,
            matches=self._matches,
            is_quick=is_quick,
        )
        try:
            return Mission(looking).result()
        except InputError as error:
            return error

    def _opened(
        self, views: Sequence[View], radial: tuple[float, float]
    ) -> Callable[[int], ImageRGB]:
        lens = lens_left_over(self._lens.camera, radial)

        def load(number: int) -> ImageRGB:
            with self._lock:
                jpeg = self._pictures.get(views[number].name)
            image = image_from_jpeg(jpeg, views[number].name)
            return image if lens is None else lens.undistort(image)

        return load

    def _take_in(self) -> None:
        """Announce what the look that was begun last found."""
        assert self._look is not None
        looked, self._look = self._look.result(), None
        if not isinstance(looked, InputError):
            self._see(looked)

    def _see(self, looked: LookedUnderTrees) -> set[int]:
        """The ids of a look's finds; what is not known yet is new."""
        seen = set[int]()
        for find, thing in zip(looked.finds.people, looked.objects, strict=True):
            shown_m, free_id = _shown_m(find, looked.views), _FIRST_ID + len(self._shown_m)
            same = (k for k, other_m in self._shown_m.items() if _is_same(shown_m, other_m))
            number = next(same, free_id)
            frame, half_m = self._frames[thing.best_frame], find.size_m[0] / 2
            corners_m = shown_m[thing.best_frame] + half_m * np.array([[-1.0, -1, 0], [1, 1, 0]])
            box_px = self._lens.camera.pixels_from_points(corners_m).ravel()
            covariance_m2, size_m = np.eye(2) * thing.sigma_m**2, np.array(find.size_m)
            best = Sighting(
                frame.index,
                thing.best_frame,
                frame.time_ns,
                PERSON,
                thing.score,
                box_px.astype(np.float32),
                thing.position_m,
                covariance_m2,
                size_m,
            )
            self.tracks[number] = Track(
                number,
                PERSON,
                thing.score,
                True,
                False,
                thing.first_seen_ns,
                thing.last_seen_ns,
                find.views,
                1,
                thing.position_m,
                covariance_m2,
                np.zeros(2),
                size_m,
                best,
                thing.position_m[None],
                np.array([thing.last_seen_ns]),
                thing.class_scores,
            )
            write_crop(self._folder, number, image_from_jpeg(thing.crop_jpeg, thing.id))
            self._shown_m[number] = self._shown_m.get(number, {}) | shown_m
            seen.add(number)
            if number == free_id:
                self._new.append(self.tracks[number])
        return seen


def _shown_m(find: Find, views: Sequence[View]) -> dict[str, Floats]:
    """Where the pictures' cameras see a find, whatever tilt they were taken to have in common."""
    shown_m = {}
    for view in views:
        pose = view.site_from_camera
        place_m = (find.place_m - pose.translation_m) @ pose.rotation
        if inside(view.camera.pixels_from_points(place_m), view.camera)[0]:
            shown_m[view.name] = place_m
    return shown_m


def _is_same(one_m: Mapping[str, Floats], other_m: Mapping[str, Floats]) -> bool:
    apart_m = [
        math.dist(one_m[name][:2], other_m[name][:2]) for name in one_m.keys() & other_m.keys()
    ]
    return float(np.median(apart_m or [math.inf])) < _SAME_M
