"""Objects on the map: a detector searches the frames beside the mapping; in the end each object is reported once."""

import math
import time
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sorvolo.capture.live.addresses import is_live_address
from sorvolo.capture.source import demand_inputs
from sorvolo.detection.fusing import is_from_above
from sorvolo.detection.models import installed_models
from sorvolo.errors import SettingsError
from sorvolo.geometry.camera import Camera
from sorvolo.missions.flight.detector_protocol import (
    FindsObjects,
    ObjectDetector,
    as_detector,
    load_detector,
)
from sorvolo.missions.flight.looked_at import LookedAt, ground_for, looked_at
from sorvolo.missions.flight.result_cache import ResultCache
from sorvolo.missions.flight.settings import WAITING_MB
from sorvolo.missions.flight.threads import lower_priority, made_at_low_priority
from sorvolo.registration.lens import at_most
from sorvolo.search.looked_ground import LookedGround, near_ground
from sorvolo.store.exports.detection_files import crop_around
from sorvolo.store.exports.plain import plain_json
from sorvolo.store.images import jpeg_from_image
from sorvolo.store.site.spill import FrameOnDisk
from sorvolo.survey.flight import Frame, Notice, PosedFrame, Site
from sorvolo.survey.map_objects import ObjectSearch, SearchedFrames
from sorvolo.survey.mosaic import PlacedFrame, Status
from sorvolo.survey.objects import Detections, Sighting
from sorvolo.tracking.laying import LaidSighting, MeasuredGround, lay_on_ground, pose_of
from sorvolo.tracking.map_objects import objects_on_map
from sorvolo.tracking.view_evidence import least_seen

NO_MODEL, DEFAULT_MODEL = "none", "default"
"""The model that looks for nothing, and the one that comes with the package."""

_AHEAD = (
    3  # frames of a recorded flight that may wait for the detector before the mapping waits for it
)
_WAITING_ON_DISK = 256  # frames of a live flight at most: 1.6 GB of 1080p
_CROP_PX = 256  # longer side of a picture on a page
_MOST_CROPS = 60  # of one frame, the surest


def open_detector(
    model: str,
    given: FindsObjects | None = None,
    inputs: Sequence[Any] = (),
    *,
    is_live: bool = False,
) -> ObjectDetector | None:
    """The `given` detector, else that of this name or file; None for "none", and for "default" without a default model.

    Beside an `is_live` flight's map, or one among the `inputs`, it runs at low priority. Raises InputError for an input
    that is not there, before a model takes its time, and for any other model that is not there or cannot be used.
    """
    demand_inputs(inputs)
    if given is not None:
        return as_detector(given)
    if model == NO_MODEL:
        return None
    if model == DEFAULT_MODEL and all(each.name != DEFAULT_MODEL for each in installed_models()):
        return None
    if is_live or any(is_live_address(str(each)) for each in inputs):
        return made_at_low_priority(lambda: load_detector(model))
    return load_detector(model)


def check_classes(detector: ObjectDetector | None, classes: Sequence[str]) -> None:
    """Raise SettingsError for a class that the detector does not know, before anything is searched."""
    if detector is not None and (unknown := sorted(set(classes) - set(detector.classes))):
        raise SettingsError(
            f"the model knows no {unknown[0]!r}; it knows {', '.join(detector.classes)}"
        )


@dataclass(frozen=True, eq=False)
class FrameDetections:
    """What the detector saw in the frame `index`, the crops (JPEG) around it, and how long it took.

    `least` is the score from which on each class is reported that was looked for; `found` holds weaker detections too,
    as evidence.
    """

    index: int
    found: Detections
    crops: tuple[bytes, ...]
    seconds: float
    least: Mapping[str, float]


class ObjectFinder:
    """Searches the frames of one flight for objects, one frame after another, in a thread beside the mapping.

    A context manager: leaving it ends the thread. No `classes` means those that the detector usually reports; raises
    SettingsError for one that it does not know. `live_folder` is given for a live flight, whose map must not wait for
    the detector: this works at low priority then, and pictures that memory does not hold wait in files there. What
    `memo` has of a killed run is not searched again.
    """

    def __init__(
        self,
        detector: ObjectDetector,
        camera: Camera,
        classes: Sequence[str] = (),
        *,
        live_folder: Path | None = None,
        memo: ResultCache | None = None,
    ) -> None:
        check_classes(detector, classes)
        self._memo = ResultCache() if memo is None else memo
        self._detector, self._camera = detector, camera
        self._live_folder = live_folder
        self._classes = tuple(classes) or detector.info.usual_classes
        self._is_asked = bool(classes)
        self._thread = ThreadPoolExecutor(
            1, "detector", lower_priority if live_folder is not None else None
        )
        self._waiting: deque[Future[FrameDetections]] = deque()
        self._seen: dict[int, FrameDetections] = {}
        self._sightings: tuple[Sighting, ...] = ()

    def close(self) -> None:
        """End the thread; frames that still wait are not searched."""
        self._thread.shutdown(wait=True, cancel_futures=True)

    @property
    def notices(self) -> tuple[Notice, ...]:
        """What the detector would have a user know of the frames."""
        return self._detector.notices

    @property
    def sightings(self) -> tuple[Sighting, ...]:
        """All detections that are reported, by the frames' final places, once that is concluded."""
        return self._sightings

    @property
    def seconds(self) -> float:
        """How long the detector worked, beside everything else."""
        return sum(each.seconds for each in self._seen.values())

    def look(self, posed: PosedFrame) -> None:
        """Have a frame searched; waits when the detector is some frames behind, of a live flight very many.

        Raises StoreError when a picture has to wait on a disk that is full.
        """
        known = self._memo.known(posed.frame.index, "seen", FrameDetections)
        if known is not None:
            self._seen[known.index] = known
            return
        height_m, sigma_m = posed.prior.position_m[2], posed.prior.position_sigma_m[2]
        knows_height = math.isfinite(sigma_m) and height_m > 1.0
        m_per_px = float(height_m) / self._camera.fx_px if knows_height else None
        from_above = is_from_above(posed.prior.rotation)
        given: Frame | FrameOnDisk = posed.frame
        in_memory = max(1, int(1e6 * WAITING_MB // posed.frame.image.nbytes))
        waiting = sum(not each.done() for each in self._waiting)
        if self._live_folder is not None and waiting >= in_memory:
            given = FrameOnDisk.of(posed.frame, self._live_folder)
        self._waiting.append(self._thread.submit(self._look, given, m_per_px, from_above))
        self._take(min(_AHEAD, in_memory) if self._live_folder is None else _WAITING_ON_DISK)

    def rest(self) -> None:
        """Wait until all frames so far are searched, and have the detector give its memory back."""
        self._take(0)
        self._detector.rest()

    def conclude(
        self,
        placed: Sequence[PlacedFrame],
        flight_id: str,
        *,
        has_metres: bool,
        ground: MeasuredGround | None = None,
    ) -> ObjectSearch:
        """Lay all detections on the ground (None: level) by the frames' final places, and report each object once."""
        self._take(0)
        frames = [
            each
            for each in placed
            if each.index in self._seen and each.status is not Status.REJECTED
        ]
        laid: list[LaidSighting] = []
        crops: list[bytes] = []
        for frame in frames:
            seen = self._seen[frame.index]
            for each, crop in zip(
                lay_on_ground(seen.found, frame, has_metres=has_metres, ground=ground), seen.crops
            ):
                if each is not None:
                    laid.append(each)
                    crops.append(crop)
        least = self._least(frames)
        sightings = (each.sighting for each in laid)
        self._sightings = tuple(each for each in sightings if each.score >= least[each.label])
        objects, dropped = objects_on_map(
            laid, crops, frames, flight_id, has_metres=has_metres, least=least
        )
        searched = SearchedFrames.of(
            frames, [self._seen[each.index].least.keys() for each in frames], self._classes
        )
        return ObjectSearch(
            self._detector.info.name,
            self._classes,
            objects,
            searched,
            len(self._seen),
            len(self._sightings),
            dropped,
        )

    def looked_at(
        self, placed: Sequence[PlacedFrame], site: Site, enough: float
    ) -> tuple[LookedAt, LookedGround | None]:
        """How much of what the flight's frames show, by their final places, was looked at, of which a share is
        `enough`; the ground of a site with metres."""
        ground = None if site.is_local else ground_for(site, self._detector.info, self._classes)
        for frame in placed if ground is not None else ():
            pose, seen = pose_of(frame), self._seen.get(frame.index)
            if pose is None or ground is None:
                continue
            camera_m = pose.translation_m
            outline_m = near_ground(frame.outline_m, camera_m)
            ground.show(outline_m)
            if seen is not None:
                ground.look(outline_m, float(camera_m[2]) / frame.camera.fx_px, seen.least)
        excuses = not self._is_asked
        return looked_at(ground, len(self._seen), len(placed), enough, excuses=excuses), ground

    def _least(self, frames: Sequence[PlacedFrame]) -> dict[str, float]:
        """From which score on each class is reported: where frames of two lights differ, the higher; of a class that no
        frame was searched for, from the model's own."""
        of_frames = [self._seen[each.index].least for each in frames]
        highest = {
            name: max(each.get(name, 0.0) for each in of_frames) for name in set().union(*of_frames)
        }
        return {**self._detector.info.thresholds, **highest}

    def _take(self, left: float) -> None:
        """Collect what was seen until this many frames still wait."""
        while self._waiting and (len(self._waiting) > left or self._waiting[0].done()):
            seen = self._waiting.popleft().result()
            self._seen[seen.index] = seen

    def _look(
        self, given: "Frame | FrameOnDisk", m_per_px: float | None, from_above: bool
    ) -> FrameDetections:
        started_s = time.monotonic()
        frame = given.taken() if isinstance(given, FrameOnDisk) else given
        least = self._detector.thresholds_for(frame.image, from_above=from_above, m_per_px=m_per_px)
        found = self._detector.detect(
            frame.image,
            tiles="auto",
            m_per_px=m_per_px,
            classes=self._classes,
            from_above=from_above,
            overlapping=True,
            least_score=least_seen(least),
        )
        surest = found.surest(_MOST_CROPS)
        crops = tuple(
            jpeg_from_image(at_most(crop_around(frame.image, box), _CROP_PX))
            for box in surest.boxes_px
        )
        seconds = time.monotonic() - started_s
        seen = FrameDetections(frame.index, surest, crops, seconds, dict(least))
        self._memo.keep(frame, "seen", seen)
        return seen


def search_summary(
    search: ObjectSearch | None,
    looked: LookedAt | None,
    seconds: float,
    why_not: str = "",
) -> dict[str, Any]:
    """The report's part on objects; specified in docs/formats.md. `why_not`: why nothing was searched."""
    if search is None or looked is None:
        return {"model": None, "why_not": why_not, "count": 0, "classes": {}, "list": []}
    counts = Counter(each.label for each in search.objects)
    return dict(
        plain_json(
            {
                "model": search.model,
                "looked_for": search.classes,
                "headline": looked.headline(
                    {name: counts[name] for name in search.classes}, search.classes
                ),
                "looked_at": looked.facts(),
                "frames": search.looked,
                "sightings": search.sightings,
                "dropped": search.dropped,
                "seconds": round(seconds, 3),
                "count": len(search.objects),
                "moving": sum(each.moving for each in search.objects),
                "classes": {name: counts[name] for name in search.classes},
                "list": [
                    {
                        "id": each.id,
                        "class": each.label,
                        "score": round(each.score, 3),
                        "east_m": each.position_m[0],
                        "north_m": each.position_m[1],
                        "sigma_m": each.sigma_m,
                        "length_m": each.length_m,
                        "width_m": each.width_m,
                        "views": each.views,
                        "possible_views": each.possible_views,
                        "moving": each.moving,
                    }
                    for each in search.objects
                ],
            }
        )
    )


def with_objects(report: Mapping[str, Any], headline: Mapping[str, Any]) -> dict[str, Any]:
    """A headline with what was found, and whether enough was looked at, by the report's part on objects."""
    found = report["objects"].get("headline")
    if not found:
        return dict(headline)
    text = f"{headline['text']}; {found['text']}"
    return {**headline, "text": text, "complete": found["complete"]}


def why_not_searched(model: str) -> str:
    """Why nothing was searched for objects, in words."""
    if model == NO_MODEL:
        return "no model was wanted"
    return "no default model is installed: pip install sorvolo-models"


def crops_of(search: ObjectSearch | None) -> dict[str, bytes]:
    """The JPEG around each object's best view, by the object's id."""
    return {} if search is None else {each.id: each.crop_jpeg for each in search.objects}
