"""What moves while it is seen: changed blobs followed over views in ground metres, and which of them really move.

A thing of height h stands in the picture where its top hides the ground: seen from a camera at height H that flies with
v, its blob moves over the ground with -v h / (H - h). So what a blob moves against the camera's own way proves nothing
as long as some h below 0.6 H explains it; only the rest of its motion counts.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from sorvolo.change.motion.blobs import Blob, blobs_of
from sorvolo.errors import SettingsError
from sorvolo.geometry.arrays import Floats
from sorvolo.survey.findings import ComparedView

_POINTS = 12  # of a track are kept


@dataclass(frozen=True)
class ParallaxSettings:
    """What a thing's height may explain of a blob's motion, and when nothing does (before 0014; photos 0016).

    Shares are of the camera's own way over the ground; a thing h high, seen from H, has h / (H - h).
    """

    most: float = 1.5  # h = 0.6 H: no taller thing is expected
    unlikely: float = 0.5  # h = H / 3: no thing that came is so high
    least_own: float = 0.35  # of a mover's speed that no height explains
    rigid_views: int = 5  # a blob that keeps its size over so many views, ...
    rigid_lengths: float = 2.0  # ... on a way of so many of its lengths, moves whatever its direction ...
    rigid_m: float = 2.5  # ... if it is no longer, m
    photos_apart_s: float = 0.7  # views that are seldom, on average; they may show a blob ...
    floats_m: float = 1.3  # ... no longer than this, m, too far from any foot that it could stand on
    steady_area: float = 1.7  # the largest by the smallest of one that keeps its size, and ...
    steady_length: float = 1.35  # ... the longest by the shortest


@dataclass(frozen=True)
class IdentitySettings:
    """When two tracks show one thing (before 0014)."""

    near_m: float = 0.4  # two that move alike so near each other: now with its shadow, now without
    lost_for_s: float = 45.0  # a thing that moves steadily is known again after so long: on the next strip, too


@dataclass(frozen=True)
class MovingSettings:
    """When something counts as moving."""

    least_views: int = 5
    least_photos: int = 3  # of views so far apart in time as photos are: chance seldom fits three of them
    least_move_m: float = 1.0  # beyond what alignment and a swaying crown do
    least_lengths: float = 1.0  # of its own: then its places do not overlap, and nothing that grew explains it
    least_length_m: float = 0.3  # a person from above; smaller specks jump about
    most_speed_m_s: float = 3.0  # of something small ...
    most_lengths_s: float = 4.0  # ... and lengths a second more: a car of 4 m may go 19 m/s
    most_step_m: float = 6.0  # between two views: further away anything could be it
    forget_s: float = 2.5  # a track without a blob for so long has ended ...
    forget_views: int = 2  # ... and so many views
    parallax: ParallaxSettings = field(default_factory=ParallaxSettings)
    identity: IdentitySettings = field(default_factory=IdentitySettings)

    def __post_init__(self) -> None:
        if not 3 <= self.least_photos <= self.least_views:
            raise SettingsError(
                "moving needs at least 3 views to see a steady velocity, of photos no more than of a video, "
                f"got {self.least_views} and {self.least_photos}"
            )
        if min(self.least_move_m, self.least_lengths, self.most_speed_m_s, self.most_step_m, self.forget_s) <= 0:
            raise SettingsError("moving: distances, speeds and times must be above 0")

    def fastest_m_s(self, length_m: float) -> float:
        """The greatest speed that something of this length may have."""
        return self.most_speed_m_s + self.most_lengths_s * length_m


@dataclass(frozen=True, eq=False)
class TrackPoint:
    """A blob at a time, with the camera's place (2,) then."""

    time_ns: int
    blob: Blob
    camera_m: Floats


@dataclass(frozen=True, eq=False)
class Motion:
    """How a track moves: `velocity_m_s` (2,) as fitted, `own_m_s` (2,) what no parallax explains.

    `camera_m_s` (2,) is the camera's velocity meanwhile. `path_m` is how far the thing's own motion took it, `error_m`
    the rms distance of its points from steady motion.
    """

    velocity_m_s: Floats
    camera_m_s: Floats
    own_m_s: Floats
    path_m: float
    error_m: float

    @property
    def speed_m_s(self) -> float:
        """The length of its velocity."""
        return float(np.hypot(*self.velocity_m_s))


@dataclass(frozen=True, eq=False)
class Track:
    """One blob over time: its first point, its last few, how many, and the sum of their scores.

    `mover` is the number of the moving thing that it is, 0 = not known to move.
    """

    first: TrackPoint
    points: tuple[TrackPoint, ...]
    count: int
    score_sum: float
    velocity_m_s: Floats  # (2,) over its last points; zeros while there is but one
    mover: int = 0

    @property
    def last(self) -> TrackPoint:
        """Where it was seen last."""
        return self.points[-1]

    @property
    def seconds(self) -> float:
        """The time over which its last points are spread."""
        return (self.points[-1].time_ns - self.points[0].time_ns) * 1e-9

    def with_point(self, point: TrackPoint, settings: ParallaxSettings) -> "Track":
        """The track, one view longer."""
        points = (*self.points, point)[-_POINTS:]
        velocity_m_s = motion(points, settings).velocity_m_s
        return Track(
            self.first, points, self.count + 1, self.score_sum + point.blob.score, velocity_m_s, self.mover,
        )


@dataclass(frozen=True, eq=False)
class Followed:
    """What moves in one view. For each box of the view: whether it shows something that moves, and whether
    it may (so that nobody should call it a change of the ground yet). `movers` are the tracks that moved in this view.
    """

    is_moving: NDArray[np.bool_]
    may_move: NDArray[np.bool_]
    movers: tuple[Track, ...]


def motion(points: Sequence[TrackPoint], settings: ParallaxSettings = ParallaxSettings()) -> Motion:
    """The steady motion that fits a track's points best (least squares), N >= 2, less what parallax explains."""
    # plain numbers: a dozen points are too few for arrays to be faster
    start_ns, count = points[0].time_ns, len(points)
    times = [(each.time_ns - start_ns) * 1e-9 for each in points]
    middle_s = sum(times) / count
    spread = [each - middle_s for each in times]
    weight = max(sum(each * each for each in spread), 1e-12)
    places = [complex(each.blob.place_m[0], each.blob.place_m[1]) for each in points]
    cameras = [complex(each.camera_m[0], each.camera_m[1]) for each in points]
    velocity = sum(s * place for s, place in zip(spread, places)) / weight
    camera = sum(s * place for s, place in zip(spread, cameras)) / weight
    centre = sum(places) / count
    rest = sum(abs(place - centre - s * velocity) ** 2 for s, place in zip(spread, places))
    against = -(velocity * camera.conjugate()).real
    parallax = min(max(against / abs(camera) ** 2, 0.0), settings.most) if abs(camera) > 1e-2 else 0.0
    own = velocity + parallax * camera
    return Motion(
        np.array([velocity.real, velocity.imag]), np.array([camera.real, camera.imag]),
        np.array([own.real, own.imag]), abs(own) * times[-1], (rest / count) ** 0.5,
    )


class BlobTracker:
    """The blobs of a flight's views while they come. Only `follow` changes it."""

    def __init__(self, settings: MovingSettings = MovingSettings()) -> None:
        self._settings = settings
        self._tracks: list[Track] = []
        self._lost: list[Track] = []
        self._movers = 0
        self._times_ns: deque[int] = deque(maxlen=settings.forget_views + 1)  # of the last views

    def follow(self, view: ComparedView) -> Followed:
        """Take the next view's blobs; views come in order of time."""
        now_ns, camera_m, parallax = view.time_ns, np.array(view.camera_m[:2]), self._settings.parallax
        tracks = self._still_followed(now_ns)
        self._times_ns.append(now_ns)
        blobs = blobs_of(view)
        is_moving, may_move = np.zeros(len(view.boxes), bool), np.zeros(len(view.boxes), bool)
        movers: list[Track] = []
        pairs = _pairs(tracks, blobs, now_ns, self._settings)
        for index, blob_index in pairs:
            blob = blobs[blob_index]
            track = tracks[index].with_point(TrackPoint(now_ns, blob, camera_m), parallax)
            move = motion(track.points, parallax)
            if not track.mover and self._moves(track, move):
                track = replace(track, mover=self._number_of(track, move, tracks))
            if track.mover:
                movers.append(track)
            # a thing that stopped is a change of the ground, whatever it was before
            may_move[blob.box] = _may_move(track, motion(track.points[-5:], parallax), parallax)
            is_moving[blob.box] = bool(track.mover) and may_move[blob.box]
            tracks[index] = track
        taken = {blob for _, blob in pairs}
        for blob in (each for index, each in enumerate(blobs) if index not in taken):
            point = TrackPoint(now_ns, blob, camera_m)
            tracks.append(Track(point, (point,), 1, blob.score, np.zeros(2)))
            may_move[blob.box] = True  # nobody knows yet
        self._tracks = tracks
        return Followed(is_moving, may_move, tuple(movers))

    def _still_followed(self, now_ns: int) -> list[Track]:
        """The tracks that are not too old; movers among the others are lost for a while."""
        oldest_ns = min([now_ns - round(self._settings.forget_s * 1e9), *self._times_ns])
        gone = [each for each in self._tracks if each.last.time_ns < oldest_ns]
        self._lost += [each for each in gone if each.mover]
        longest_s = self._settings.identity.lost_for_s
        self._lost = [each for each in self._lost if (now_ns - each.last.time_ns) * 1e-9 <= longest_s]
        return [each for each in self._tracks if each not in gone]

    def _moves(self, track: Track, move: Motion) -> bool:
        """Whether enough views show a plausible thing that moves steadily, by more than parallax explains."""
        settings, are_photos = self._settings, self._are_photos(track)
        length_m = float(np.median([each.blob.length_m for each in track.points]))
        if track.count < (settings.least_photos if are_photos else settings.least_views):
            return False
        if not _is_plausible(track, move, length_m, settings) or _goes_with_camera(move):
            return False
        needed_m = max(settings.least_move_m, settings.least_lengths * length_m)
        parallax = settings.parallax
        is_own = move.path_m > needed_m and float(np.hypot(*move.own_m_s)) > parallax.least_own * move.speed_m_s
        return is_own or _is_rigid(track, length_m, parallax) or (
            are_photos and _floats(track, move, length_m, parallax)
        )

    def _are_photos(self, track: Track) -> bool:
        """Whether the views were taken seldom while the track lasted."""
        seen = [each for each in self._times_ns if each >= track.points[0].time_ns]
        return len(seen) > 1 and (seen[-1] - seen[0]) * 1e-9 >= self._settings.parallax.photos_apart_s * (len(seen) - 1)

    def _number_of(self, track: Track, move: Motion, others: Sequence[Track]) -> int:
        """The number of the mover that the track shows: of one of `others` at the same place, of a lost one, or new."""
        now_ns, start = track.last.time_ns, track.points[0]
        for other in others:
            expected_m = other.last.blob.place_m + (now_ns - other.last.time_ns) * 1e-9 * other.velocity_m_s
            is_there = float(np.hypot(*(track.last.blob.place_m - expected_m))) < self._settings.identity.near_m
            if other.mover and is_there and _goes_with(move, other):
                return other.mover
        for lost in self._lost:
            gap_s = (start.time_ns - lost.last.time_ns) * 1e-9
            expected_m = lost.last.blob.place_m + gap_s * lost.velocity_m_s
            is_near = float(np.hypot(*(start.blob.place_m - expected_m))) < 1.0 + 0.4 * gap_s * move.speed_m_s
            if gap_s > 0 and is_near and _goes_with(move, lost) and _alike(lost.last.blob, start.blob):
                self._lost.remove(lost)
                return lost.mover
        self._movers += 1
        return self._movers


def _is_plausible(track: Track, move: Motion, length_m: float, settings: MovingSettings) -> bool:
    """Whether a thing of this length may be so fast, and its track is steady enough."""
    is_steady = move.error_m < 0.05 + 0.03 * (move.speed_m_s * track.seconds + length_m)
    return settings.least_length_m <= length_m and move.speed_m_s <= settings.fastest_m_s(length_m) and is_steady


def _goes_with_camera(move: Motion) -> bool:
    apart_m_s = float(np.hypot(*(move.velocity_m_s - move.camera_m_s)))
    return apart_m_s <= 0.3 * float(np.hypot(*move.camera_m_s))


def _goes_with(move: Motion, track: Track) -> bool:
    """Whether the track's velocity is about that of `move`."""
    apart_m_s = float(np.hypot(*(move.velocity_m_s - track.velocity_m_s)))
    return apart_m_s < 0.3 + 0.5 * float(np.hypot(*move.velocity_m_s))


def _is_rigid(track: Track, length_m: float, settings: ParallaxSettings) -> bool:
    """Whether a blob went far without changing its size, so that no parallax explains it after all.

    What leans over the ground stands on it: its ghost grows and shrinks with the camera's way, down to nothing.
    """
    if len(track.points) < settings.rigid_views or length_m > settings.rigid_m:
        return False
    return _way_m(track) > max(1.0, settings.rigid_lengths * length_m) and _keeps_its_size(track, settings)


def _floats(track: Track, move: Motion, length_m: float, settings: ParallaxSettings) -> bool:
    """Whether a small blob of steady size is far from where anything tall enough to move so would stand.

    What leans is seen from its foot to its top; the foot of a thing whose top moves against the camera's way with a
    share k of its speed lies (top + k camera) / (1 + k). Photos show it too seldom to see it grow.
    """
    camera_m_s = float(np.hypot(*move.camera_m_s))
    k = -float(move.velocity_m_s @ move.camera_m_s) / max(camera_m_s, 1e-6) ** 2
    if length_m > settings.floats_m or k <= 0 or not _keeps_its_size(track, settings):
        return False  # where k is not above 0, no height explains it
    apart_m = [k / (1 + k) * float(np.hypot(*(each.blob.place_m - each.camera_m))) for each in track.points]
    return _way_m(track) > settings.rigid_lengths * length_m and float(np.median(apart_m)) > length_m


def _way_m(track: Track) -> float:
    """How far a track's last points lead over the ground."""
    return float(np.hypot(*(track.last.blob.place_m - track.points[0].blob.place_m)))


def _keeps_its_size(track: Track, settings: ParallaxSettings) -> bool:
    """Whether a track's area and length have hardly changed: nothing that grew explains its motion."""
    areas = [each.blob.area_m2 for each in track.points]
    lengths = [each.blob.length_m for each in track.points]
    return max(areas) < settings.steady_area * min(areas) and max(lengths) < settings.steady_length * min(lengths)


def _may_move(track: Track, move: Motion, settings: ParallaxSettings) -> bool:
    if track.count < 3:
        return True
    recent = track.points[-5:]
    camera_m = recent[-1].camera_m - recent[0].camera_m
    way_m = move.velocity_m_s * (recent[-1].time_ns - recent[0].time_ns) * 1e-9
    camera_way_m = float(np.hypot(*camera_m))
    against_m = -float(way_m @ camera_m) / camera_way_m if camera_way_m > 0.1 else 0.0
    is_ghost = against_m > max(settings.unlikely * camera_way_m, 0.25)
    return bool(move.path_m > max(0.25, 2 * move.error_m) or is_ghost)


def _alike(a: Blob, b: Blob) -> bool:
    sizes = sorted([a.area_m2, b.area_m2])
    return sizes[1] < 3 * sizes[0] + 0.1 and float(np.abs(a.colour - b.colour).max()) < 70


def _pairs(
    tracks: Sequence[Track], blobs: Sequence[Blob], now_ns: int, settings: MovingSettings
) -> list[tuple[int, int]]:
    """Track and blob that go together: the best pair first, each used once."""
    if not tracks or not blobs:
        return []
    places = np.array([each.place_m for each in blobs])
    areas = np.array([each.area_m2 for each in blobs])
    colours = np.array([each.colour for each in blobs])
    costs = np.full((len(tracks), len(blobs)), np.inf)
    for row, track in enumerate(tracks):
        ahead_s = (now_ns - track.last.time_ns) * 1e-9
        velocity = track.velocity_m_s
        if len(track.points) == 1:
            fastest_m_s = settings.fastest_m_s(track.last.blob.length_m)
            gate_m = 0.3 + min(fastest_m_s * ahead_s, settings.most_step_m)
        else:
            gate_m = 0.3 + 0.25 * float(np.hypot(*velocity)) * ahead_s
        distance = np.hypot(*(places - track.last.blob.place_m - velocity * ahead_s).T)
        growth = np.abs(np.log((areas + 0.02) / (track.last.blob.area_m2 + 0.02)))
        tint = np.abs(colours - track.last.blob.colour).max(axis=1)
        fits = (distance < gate_m) & (growth < np.log(2.5)) & (tint < 45)
        costs[row] = np.where(fits, distance + 0.3 * growth + tint / 100, np.inf)
    found = []
    for flat in np.argsort(costs, axis=None, kind="stable"):
        row, column = divmod(int(flat), len(blobs))
        if np.isfinite(costs[row, column]):
            found.append((row, column))
            costs[row], costs[:, column] = np.inf, np.inf
    return found
