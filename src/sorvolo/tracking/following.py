"""A flight's detections, frame by frame, placed and given to their tracks: on the ground, or in the picture."""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sorvolo.geometry.arrays import Floats, Mask, PointsM
from sorvolo.geometry.ground import footprint
from sorvolo.geometry.pose import Pose
from sorvolo.survey.flight import CameraModel, CameraPrior, Frame
from sorvolo.survey.objects import Detections, Sighting, Track
from sorvolo.survey.wording import counted
from sorvolo.tracking.headings import (
    HeadingCheck,
    contradiction,
    is_uniform,
)
from sorvolo.tracking.image_motion import ImageMotion
from sorvolo.tracking.laying import IMPOSSIBLE_SIZE, GroundHeight, LocateSettings, locate
from sorvolo.tracking.sizes import SceneScale
from sorvolo.tracking.tracker import IN_PICTURES, Tracker, TrackerSettings, TrackUpdate

_MOST_DRONE_PLACES = 200_000  # frames: an hour and fifty minutes at 30 a second; by choice
# a mapping doubts gimbals more, since its pictures measure tilt; here nothing else does
_GIMBAL_TILT_SIGMA_DEG = 1.0
_LEAST_DOWN = 0.1  # of the optical axis: nearer to the horizon a sampling distance means nothing
_OVER_MODEL = LocateSettings(ground_sigma_m=1.0)  # of a height model, where it stands on its own


@dataclass(frozen=True, eq=False)
class Located:
    """A frame's detections as they were placed: all that their tracks need of the frame.

    A detection without a place has no sighting; `unlocated` counts those by reason. `outline_m` (4, 2) is the ground
    that the frame shows, `camera_m` (2,) where its camera was; None where that is not known. `segment`: see `Taken`.
    """

    time_ns: int
    sightings: tuple[Sighting | None, ...]
    unlocated: tuple[tuple[str, int], ...]
    outline_m: PointsM | None
    camera_m: Floats | None
    segment: int


@dataclass(frozen=True, eq=False)
class Taken:
    """What became of a frame's detections, each with its sighting, if it has a place, and its track (0: none).

    `located` is what that was made from, for a follower that goes on in another process. `merged` are ids of tracks
    that turned out to be objects seen before. `segment` counts the stretches of a flight that is followed in the
    picture, from 1, each with places in the pixels of its own first frame; 0 on the ground.
    """

    sightings: Sequence[Sighting | None]
    track_ids: Sequence[int]
    new_ids: frozenset[int]
    merged: frozenset[int]
    located: Located
    segment: int = 0


def watched_prior(prior: CameraPrior, height_sigma_m: float, *, has_gimbal: bool) -> CameraPrior:
    """A mapping's prior as a watch needs it: the ground's own `height_sigma_m` in the height's, a gimbal's angles
    trusted."""
    position_sigma_m = prior.position_sigma_m.copy()
    position_sigma_m[2] = np.hypot(position_sigma_m[2], height_sigma_m)
    attitude_sigma_deg = prior.attitude_sigma_deg.copy()
    if has_gimbal:
        attitude_sigma_deg[:2] = np.minimum(attitude_sigma_deg[:2], _GIMBAL_TILT_SIGMA_DEG)
    return replace(prior, position_sigma_m=position_sigma_m, attitude_sigma_deg=attitude_sigma_deg)


class GroundFollower:
    """Detections of a flight with telemetry, placed on the ground and tracked in site metres. Only `take` and `recall`
    change it.

    `settings` are the tracker's, in metres. `ground` gives the ground's height over the flight's zero; None: it is
    level. Without `knows_heading` the camera's heading comes from the pictures' motion, which corrects one in a video
    that is known and far off, too. `unlocated` counts detections without a place by reason.
    """

    def __init__(
        self,
        camera: CameraModel,
        settings: TrackerSettings,
        ground: GroundHeight | None,
        *,
        knows_heading: bool,
        is_video: bool,
        clock_sigma_s: float = 0.0,
    ) -> None:
        self._camera, self._ground, self._clock_sigma_s = camera, ground, clock_sigma_s
        self._uniform = 0, False  # how many pictures were asked for it, and what they answered
        self._ends: list[tuple[int, Floats]] = []  # the camera's first place and its last
        self._tracker, fx_px = Tracker(settings), camera.camera.fx_px
        self._knows_heading = knows_heading
        self._check = (
            HeadingCheck(fx_px, knows_heading=knows_heading)
            if is_video or not knows_heading
            else None
        )
        self._path: list[Floats] = []
        self._reach_m = 0.0  # between a detection's place and its camera's, at most
        self.unlocated: Counter[str] = Counter()

    def m_per_px(self, prior: CameraPrior) -> float | None:
        """The ground's sampling distance along the optical axis; None at the horizon and without a height."""
        down = -float(prior.rotation[2, 2])
        height_m = float(prior.position_m[2]) - self._below_m(prior)
        if down < _LEAST_DOWN or height_m <= 0:
            return None
        return height_m / down / self._camera.camera.fx_px

    @property
    def impossible_size(self) -> int:
        """Detections so far of a size that their class cannot have."""
        return self.unlocated[IMPOSSIBLE_SIZE]

    @property
    def turns_deg(self) -> Sequence[float]:
        """By how much, clockwise, headings of a video's frames were turned that were far off, a number each."""
        return () if self._check is None else self._check.error.turns_deg

    @property
    def height_scale(self) -> float:
        """The height above the ground in telemetry's, as the pictures' motion shows it; 1 where that is not known."""
        return 1.0 if self._check is None else self._check.shown.sure_scale

    @property
    def tilt_deg(self) -> float:
        """By how much pictures' tilts were corrected at most; 0 where none was."""
        return 0.0 if self._check is None else self._check.tilt_deg

    @property
    def contradiction(self) -> str:
        """What in the telemetry the pictures' motion contradicts; "" where nothing does, and of photos."""
        if self._check is None:
            return ""
        fx_px = self._camera.camera.fx_px
        words = contradiction(self._check.pictures.places, fx_px, knows_tilt=self._knows_heading)
        if not words and self._check.unturned:
            seen = counted(self._check.unturned, "detection")
            return f"its headings are far off, which showed only after {seen}: objects may be counted twice"
        return words

    @property
    def is_uniform(self) -> bool:
        """Whether the pictures' motion has no turn that would hold the telemetry's clock; not so of photos.

        It is asked anew when there are a tenth more pictures."""
        places = [] if self._check is None else self._check.pictures.places
        if len(places) > 1.1 * self._uniform[0]:
            self._uniform = len(places), is_uniform(places, self._camera.camera.fx_px)
        return self._uniform[1]

    def look_ahead(self, coming: Iterable[tuple[Frame, CameraPrior]]) -> None:
        """Learn from a recorded video's first frames, before any is taken, whether headings are far off."""
        if self._check is not None and self._knows_heading:
            self._check.look_ahead(coming, self._below_m)

    def take(self, frame: Frame, time_ns: int, found: Detections, prior: CameraPrior) -> Taken:
        """Place a frame's detections, seen from `prior`, on the ground and give them to their tracks."""
        prior = self._with_heading(frame, time_ns, found, prior)
        sightings, unlocated = locate(
            found,
            frame.index,
            frame.name,
            time_ns,
            self._camera.camera,
            prior,
            focal_sigma=self._camera.focal_sigma,
            ground_height_m=self._ground or 0.0,
            settings=LocateSettings() if self._ground is None else _OVER_MODEL,
        )
        outline_m = footprint(
            self._camera.camera, Pose(prior.rotation, prior.position_m), self._below_m(prior)
        )
        return self.recall(
            Located(
                time_ns,
                tuple(sightings),
                tuple(unlocated.items()),
                outline_m if np.isfinite(outline_m).all() else None,
                prior.position_m[:2] if prior.knows_place else None,
                0,
            )
        )

    def recall(self, located: Located) -> Taken:
        """Give detections that were placed already to their tracks."""
        self.unlocated.update(dict(located.unlocated))
        update = self._tracker.update(
            [each for each in located.sightings if each is not None],
            time_ns=located.time_ns,
            footprint_m=located.outline_m,
        )
        if located.camera_m is not None:
            self._ends = [*self._ends[:1], (located.time_ns, located.camera_m)]
            if len(self._path) < _MOST_DRONE_PLACES:
                self._path.append(located.camera_m)
            for each in filter(None, located.sightings):
                away_m = float(np.linalg.norm(each.position_m - located.camera_m))
                self._reach_m = max(self._reach_m, away_m)
        return _taken(located, update)

    def tracks(self) -> Sequence[Track]:
        """All tracks as they are known now."""
        return self._doubted(self._tracker.tracks())

    def finish(self) -> Sequence[Track]:
        """All tracks when nothing more comes."""
        return self._doubted(self._tracker.finish())

    def _doubted(self, tracks: Sequence[Track]) -> Sequence[Track]:
        """What was placed before a heading showed that is far off may stand by that turn elsewhere around its camera,
        and all that a flight without a turn shows as far along it as it flew while its clock was off."""
        more_m2, turned_m2 = np.zeros((2, 2)), np.zeros((2, 2))
        if self._clock_sigma_s and len(self._ends) == 2 and self.is_uniform:
            (first_ns, start_m), (last_ns, end_m) = self._ends
            gone_m = self._clock_sigma_s * (end_m - start_m) / max((last_ns - first_ns) / 1e9, 1e-3)
            more_m2 = np.outer(gone_m, gone_m)
        if self._check is not None and self._check.unturned:
            beside_m = 2 * self._reach_m * np.sin(self._check.shown_rad / 2)
            turned_m2 = beside_m**2 * np.eye(2)
        elif not more_m2.any():
            return tracks
        shown_ns = 0 if self._check is None else self._check.shown_ns
        return [
            replace(
                each,
                covariance_m2=each.covariance_m2
                + more_m2
                + (turned_m2 if each.first_seen_ns < shown_ns else 0.0),
            )
            for each in tracks
        ]

    def path_m(self) -> PointsM:
        """(N, 2) where the camera was, in site metres."""
        return np.array(self._path).reshape(-1, 2)

    def _with_heading(
        self, frame: Frame, time_ns: int, found: Detections, prior: CameraPrior
    ) -> CameraPrior:
        """The prior with what the pictures' motion shows of the camera."""
        if self._check is not None:
            return self._check.take(frame, time_ns, found, prior, self._below_m(prior))
        return prior

    def _below_m(self, prior: CameraPrior) -> float:
        """The ground's height below the camera; 0 where it is not known."""
        if self._ground is None or not prior.knows_place:
            return 0.0
        below_m = float(self._ground(prior.position_m[None, :2])[0])
        return below_m if np.isfinite(below_m) else 0.0


class PictureFollower:
    """Detections of a flight that nothing places, tracked in the first frame's pixels; after a cut all begins anew.

    `segment` counts the stretches between cuts, from 1, `impossible_size` the detections that are far too small or far
    too large for their class beside the scene's cars: they are in no track.
    """

    def __init__(self, settings: TrackerSettings) -> None:
        self._settings = replace(settings, unit_m=IN_PICTURES.unit_m)
        self._motion, self._tracker = ImageMotion(), Tracker(self._settings)
        self._earlier, self._scene = list[Track](), SceneScale()
        self.segment, self.impossible_size = 1, 0
        self._recalled = 0  # segments of an earlier process

    @property
    def guessed(self) -> int:
        """Frames so far that show no motion that fits."""
        return self._motion.guessed

    def take(self, frame: Frame, time_ns: int, found: Detections) -> Taken:
        """Take the camera's motion out of a frame's detections and give them to their tracks."""
        is_impossible = self._judged(found, frame.image.shape[:2])
        sightings, outline = self._motion.locate(found, frame, time_ns)
        kept = tuple(None if out else each for each, out in zip(sightings, is_impossible))
        return self._follow(
            Located(time_ns, kept, (), outline, None, self._recalled + self._motion.segments)
        )

    def recall(self, located: Located, found: Detections, size_px: tuple[int, int]) -> Taken:
        """Give detections that an earlier process located to their tracks; `size_px` is the frame's height and width.

        The next frame is taken as after a cut: the camera has moved since.
        """
        self._judged(found, size_px)
        self._recalled = located.segment
        return self._follow(located)

    def _judged(self, found: Detections, size_px: tuple[int, int]) -> Mask:
        """Which detections (N,) have a size that their class cannot have beside the scene's cars."""
        self._scene.see(found, size_px)
        is_impossible = self._scene.impossible(found, size_px)
        self.impossible_size += int(is_impossible.sum())
        return is_impossible

    def _follow(self, located: Located) -> Taken:
        late = self._finished() if located.segment != self.segment else frozenset()
        self.segment = located.segment
        update = self._tracker.update(
            [each for each in located.sightings if each is not None],
            time_ns=located.time_ns,
            footprint_m=located.outline_m,
        )
        taken = _taken(located, update)
        return replace(taken, new_ids=taken.new_ids | late, segment=self.segment)

    def _finished(self) -> frozenset[int]:
        """End the segment's tracks and begin anew; the ids that its end confirms."""
        known = {track.id for track in self._tracker.tracks() if track.confirmed}
        ended = self._tracker.finish()
        self._earlier += ended
        self._tracker = Tracker(self._settings, first_id=self._tracker.next_id)
        return frozenset(track.id for track in ended) - known

    def tracks(self) -> Sequence[Track]:
        """All tracks as they are known now."""
        return [*self._earlier, *self._tracker.tracks()]

    def finish(self) -> Sequence[Track]:
        """All tracks when nothing more comes."""
        return [*self._earlier, *self._tracker.finish()]

    def path_m(self) -> PointsM:
        """(0, 2): nothing is known of where the camera was."""
        return np.zeros((0, 2))


def _taken(located: Located, update: TrackUpdate) -> Taken:
    ids = iter(update.track_ids)
    of_detections = [0 if each is None else next(ids) for each in located.sightings]
    return Taken(
        located.sightings, of_detections, frozenset(update.new), frozenset(update.merged), located
    )
