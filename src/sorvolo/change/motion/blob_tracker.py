"""What moves while it is seen: changed blobs are followed as sightings, and those that no parallax explains move."""

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from sorvolo.change.motion.blobs import Blob, BlobSettings, blobs_of
from sorvolo.change.motion.parallax import (
    Motion,
    ParallaxSettings,
    TrackPoint,
    floats,
    goes_with_camera,
    is_rigid,
    may_move,
    motion,
    shown_alone,
)
from sorvolo.errors import SettingsError
from sorvolo.geometry.arrays import Floats, Labels
from sorvolo.survey.findings import ComparedView
from sorvolo.survey.objects import Sighting
from sorvolo.tracking.association import PairSettings
from sorvolo.tracking.tracker import Tracker, TrackerSettings


@dataclass(frozen=True)
class SightingSettings:
    """How a blob becomes a sighting of something that may move; as measured from view to view (0026)."""

    place_m: float = 0.03  # sigma of its place: what alignment leaves ...
    place_share: float = (
        0.05  # ... and this share of its length: its outline is drawn anew in each view
    )
    car_m: float = 2.5  # what is longer may move as cars do, the rest as people do
    colour_levels: float = (
        40.0  # grey levels that turn a blob's looks by a radian: 19 in 20 keep theirs within 20
    )
    tracker: TrackerSettings = field(
        default_factory=lambda: TrackerSettings(
            sure_score=0.0, new_per_m2=1e-3, pairs=PairSettings(size_sigma=0.25, least_size=-4.0)
        )
    )


@dataclass(frozen=True)
class MovingSettings:
    """When something counts as moving."""

    least_views: int = 5  # of a video
    least_photos: int = (
        3  # of views so far apart in time as photos are: chance seldom fits three of them
    )
    least_move_m: float = 1.0  # beyond what alignment and a swaying crown do
    least_lengths: float = (
        1.0  # of its own: then its places do not overlap, and nothing that grew explains it
    )
    least_length_m: float = 0.3  # a person from above; smaller specks jump about
    most_speed_m_s: float = 3.0  # of something small ...
    most_lengths_s: float = 4.0  # ... and lengths a second more: a car of 4 m may go 19 m/s
    forget_s: float = 2.5  # what was not seen for so long is judged anew ...
    forget_views: int = 2  # ... and for so many views
    points: int = 12  # of a track are judged, the last ones ...
    slow_points: int = (
        36  # ... or, as something long may need so many views to go its own length, so many
    )
    parallax: ParallaxSettings = field(default_factory=ParallaxSettings)
    blobs: BlobSettings = field(default_factory=BlobSettings)
    sightings: SightingSettings = field(default_factory=SightingSettings)

    def __post_init__(self) -> None:
        if not 3 <= self.least_photos <= self.least_views <= self.points:
            raise SettingsError(
                "moving needs at least 3 views to see a steady velocity, of photos no more than of a video, "
                f"no more than the {self.points} that are judged, got {self.least_views} and {self.least_photos}"
            )
        if min(self.least_move_m, self.least_lengths, self.most_speed_m_s, self.forget_s) <= 0:
            raise SettingsError("moving: distances, speeds and times must be above 0")

    def fastest_m_s(self, length_m: float) -> float:
        """The greatest speed that something of this length may have."""
        return self.most_speed_m_s + self.most_lengths_s * length_m


@dataclass(frozen=True, eq=False)
class BlobTrack:
    """One blob over time, by its number: its first point, the last few, how many, and the sum of their scores.

    `older` are those before the last few. `leg` numbers how often anything came into view: this track and others.
    `moves` as soon as it was once seen to, `moves_now` on this leg.
    """

    number: int
    first: TrackPoint
    points: tuple[TrackPoint, ...]
    count: int
    score_sum: float
    leg: int = 0
    moves: bool = False
    moves_now: bool = False
    older: tuple[TrackPoint, ...] = ()

    @property
    def last(self) -> TrackPoint:
        """Where it was seen last."""
        return self.points[-1]

    @property
    def velocity_m_s(self) -> Floats:
        """(2,) over its last points; zeros while there is but one."""
        return motion(self.points).velocity_m_s if len(self.points) > 1 else np.zeros(2)

    def with_point(
        self, point: TrackPoint, oldest_ns: int, settings: MovingSettings
    ) -> "BlobTrack":
        """The track, one view longer; points from before a gap, last seen before `oldest_ns`, are judged no more."""
        known = (*self.older, *self.points) if self.last.time_ns >= oldest_ns else ()
        points = (*known, point)[-settings.slow_points :]
        return replace(
            self,
            points=points[-settings.points :],
            older=points[: -settings.points],
            count=self.count + 1,
            score_sum=self.score_sum + point.blob.score,
            moves_now=self.moves_now and bool(known),
        )

    def joined(self, gone: "BlobTrack") -> "BlobTrack":
        """This track and another of the same thing; the points of the one seen last count."""
        first, last = sorted((self, gone), key=lambda each: each.last.time_ns)
        return BlobTrack(
            self.number,
            min(self.first, gone.first, key=lambda each: each.time_ns),
            last.points,
            first.count + last.count,
            first.score_sum + last.score_sum,
            last.leg,
            self.moves or gone.moves,
            last.moves_now,
            last.older,
        )


@dataclass(frozen=True, eq=False)
class MovingBlobs:
    """What moves in one view. For each box of the view: whether it shows something that moves, and whether
    it may (so that nobody should call it a change of the ground yet), and the leg of its track, 0 for none. `movers`
    are the tracks that moved in this view, `merged` numbers that turned out to be an earlier track's, with that one's.
    """

    is_moving: NDArray[np.bool_]
    may_move: NDArray[np.bool_]
    legs: Labels
    movers: tuple[BlobTrack, ...]
    merged: Mapping[int, int]


class BlobTracker:
    """The blobs of a flight's views while they come. Only `follow` changes it."""

    def __init__(self, settings: MovingSettings = MovingSettings()) -> None:
        self._settings = settings
        self._tracker = Tracker(settings.sightings.tracker)
        self._tracks: dict[int, BlobTrack] = {}
        self._legs = 0
        self._times_ns: deque[int] = deque(maxlen=settings.forget_views + 1)  # of the last views

    def follow(self, view: ComparedView) -> MovingBlobs:
        """Take the next view's blobs; views come in order of time."""
        settings, now_ns, camera_m = self._settings, view.time_ns, np.array(view.camera_m[:2])
        oldest_ns = min([now_ns - round(settings.forget_s * 1e9), *self._times_ns])
        self._times_ns.append(now_ns)
        blobs = blobs_of(view, settings.blobs)
        colours = (
            np.array([each.colour for each in blobs]).reshape(-1, 3)
            / settings.sightings.colour_levels
        )
        sees_horizon = not np.isfinite(view.outline_m).all()
        update = self._tracker.update(
            [_sighting(view, each, settings.sightings) for each in blobs],
            time_ns=now_ns,
            footprint_m=None if sees_horizon else view.outline_m,
            appearance=np.hstack([np.cos(colours), np.sin(colours)]),
        )
        self._join(update.merged)
        is_moving, held = np.zeros(len(view.boxes), bool), np.zeros(len(view.boxes), bool)
        legs = np.zeros(len(view.boxes), np.int64)
        shown: dict[int, BlobTrack] = {}
        for blob, number in zip(blobs, update.track_ids):
            if number not in shown:  # else it is a part of a surer blob
                shown[number] = self._prolonged(
                    number, TrackPoint(now_ns, blob, camera_m), oldest_ns
                )
            track = shown[number]
            legs[blob.box] = track.leg
            held[blob.box] = may_move(track.points, settings.parallax)
            is_moving[blob.box] = track.moves and held[blob.box]
        self._tracks.update(shown)
        self._forget(oldest_ns)
        movers = tuple(each for each in shown.values() if each.moves_now)
        return MovingBlobs(is_moving, held, legs, movers, update.merged)

    def _join(self, merged: Mapping[int, int]) -> None:
        for gone, kept in merged.items():
            younger = self._tracks.pop(gone, None)
            older = self._tracks.get(kept)
            if younger is not None:
                self._tracks[kept] = (
                    replace(younger, number=kept) if older is None else older.joined(younger)
                )

    def _prolonged(self, number: int, point: TrackPoint, oldest_ns: int) -> BlobTrack:
        """The track with one more point, judged anew."""
        known = self._tracks.get(number)
        if known is None:
            return BlobTrack(number, point, (point,), 1, point.blob.score, self._next_leg())
        track = known.with_point(point, oldest_ns, self._settings)
        if len(track.points) == 1:
            return replace(track, leg=self._next_leg())
        moves_now = track.moves_now or self._is_mover(track)
        return replace(track, moves=track.moves or moves_now, moves_now=moves_now)

    def _next_leg(self) -> int:
        self._legs += 1
        return self._legs

    def _forget(self, oldest_ns: int) -> None:
        """Only movers are remembered for longer: what stands is judged anew when it comes back into view."""
        self._tracks = {
            number: each
            for number, each in self._tracks.items()
            if each.moves or each.last.time_ns >= oldest_ns
        }

    def _is_mover(self, track: BlobTrack) -> bool:
        """Whether enough views show a plausible thing that moves steadily, by more than parallax explains."""
        are_photos, alone = (
            self._are_photos(track),
            shown_alone(track.points, self._settings.parallax),
        )
        if self._moves(track.points, are_photos) or (
            len(alone) < len(track.points) and self._moves(alone, are_photos)
        ):
            return True
        slow = (*track.older, *track.points)
        length_m = float(np.median([each.blob.length_m for each in track.points]))
        return bool(track.older) and self._goes_its_length(
            slow, motion(slow, self._settings.parallax), length_m
        )

    def _moves(self, points: Sequence[TrackPoint], are_photos: bool) -> bool:
        """Whether points show it: a motion of its own, or a size that keeps what leans could not keep."""
        settings, parallax = self._settings, self._settings.parallax
        if len(points) < (settings.least_photos if are_photos else settings.least_views):
            return False
        move, length_m = (
            motion(points, parallax),
            float(np.median([each.blob.length_m for each in points])),
        )
        if self._goes_its_length(points, move, length_m):
            return True
        return _is_plausible(points, move, length_m, settings) and (
            is_rigid(points, length_m, parallax)
            or (are_photos and floats(points, move, length_m, parallax))
        )

    def _goes_its_length(self, points: Sequence[TrackPoint], move: Motion, length_m: float) -> bool:
        """Whether a thing of this length plausibly goes far enough by a motion that no parallax explains."""
        settings = self._settings
        needed_m = max(settings.least_move_m, settings.least_lengths * length_m)
        is_own = float(np.hypot(*move.own_m_s)) > settings.parallax.least_own * move.speed_m_s
        return is_own and move.path_m > needed_m and _is_plausible(points, move, length_m, settings)

    def _are_photos(self, track: BlobTrack) -> bool:
        """Whether the views were taken seldom while the track lasted."""
        seen = [each for each in self._times_ns if each >= track.points[0].time_ns]
        return len(seen) > 1 and (
            seen[-1] - seen[0]
        ) * 1e-9 >= self._settings.parallax.photos_apart_s * (len(seen) - 1)


def _sighting(view: ComparedView, blob: Blob, settings: SightingSettings) -> Sighting:
    """A blob as the tracker takes it: its place, and which things move as something of its size does."""
    x, y, w, h = (float(each) for each in view.boxes[blob.box])
    sigma_m = settings.place_m + settings.place_share * blob.length_m
    return Sighting(
        view.index,
        view.name,
        view.time_ns,
        "car" if blob.length_m >= settings.car_m else "person",
        float(np.clip(blob.score, 0, 1)),
        np.array([x, y, x + w, y + h]),
        blob.place_m,
        sigma_m**2 * np.eye(2),
        np.array([blob.length_m, blob.area_m2 / max(blob.length_m, 1e-6)]),
    )


def _is_plausible(
    points: Sequence[TrackPoint], move: Motion, length_m: float, settings: MovingSettings
) -> bool:
    """Whether a thing of this length may be so fast, goes steadily enough, and not about as the camera does."""
    seconds = (points[-1].time_ns - points[0].time_ns) * 1e-9
    is_steady = move.error_m < 0.05 + 0.03 * (move.speed_m_s * seconds + length_m)
    is_possible = settings.least_length_m <= length_m and move.speed_m_s <= settings.fastest_m_s(
        length_m
    )
    return is_possible and is_steady and not goes_with_camera(move)
