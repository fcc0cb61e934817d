"""What moves while it is seen: changed blobs are followed over views, and those that no parallax explains move."""

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sorvolo.change.blobs import Blob, blobs_of, standing_outline_m
from sorvolo.change.outlines import aside_of, measures, place_sigma_m
from sorvolo.change.patches import PatchWindow, cut, patch_of
from sorvolo.geometry.arrays import Floats, Labels, Mask
from sorvolo.survey.findings import Change, ChangeKind, ComparedView
from sorvolo.survey.objects import Sighting
from sorvolo.tracking.tracker import Tracker, TrackerSettings

# What a thing's height may explain of a blob's motion, and when nothing does. Shares are of the
# camera's own way over the ground; a thing h high, seen from H, has h / (H - h).
_MOST_PARALLAX = 1.5  # h = 0.6 H: no taller thing is expected
_UNLIKELY = 0.5  # h = H / 3: no thing that came is so high
_LEAST_OWN = 0.35  # of a mover's speed that no height explains
_RIGID_VIEWS = 5  # a blob that keeps its size over so many views, ...
_RIGID_LENGTHS = 2.0  # ... on a way of so many of its lengths, moves whatever its direction ...
_RIGID_M = 2.5  # ... if it is no longer, m
_PHOTOS_APART_S = 0.7  # views that are seldom, on average; they may show a blob ...
_FLOATS_M = 1.3  # ... no longer than this, m, too far from any foot that it could stand on
_STEADY_AREA = 1.7  # the largest by the smallest of one that keeps its size, and ...
_STEADY_LENGTH = 1.35  # ... the longest by the shortest


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


def motion(points: Sequence[TrackPoint]) -> Motion:
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
    parallax = (
        min(max(against / abs(camera) ** 2, 0.0), _MOST_PARALLAX) if abs(camera) > 1e-2 else 0.0
    )
    own = velocity + parallax * camera
    return Motion(
        np.array([velocity.real, velocity.imag]),
        np.array([camera.real, camera.imag]),
        np.array([own.real, own.imag]),
        abs(own) * times[-1],
        (rest / count) ** 0.5,
    )


def may_move(points: Sequence[TrackPoint]) -> bool:
    """Whether a blob may be something that moves, or only leans: a thing that stopped is neither, whatever it was."""
    if len(points) < 3:
        return True
    recent = points[-5:]
    move = motion(recent)
    camera_m = recent[-1].camera_m - recent[0].camera_m
    way_m = move.velocity_m_s * (recent[-1].time_ns - recent[0].time_ns) * 1e-9
    camera_way_m = float(np.hypot(*camera_m))
    against_m = -float(way_m @ camera_m) / camera_way_m if camera_way_m > 0.1 else 0.0
    is_ghost = against_m > max(_UNLIKELY * camera_way_m, 0.25)
    return bool(move.path_m > max(0.25, 2 * move.error_m) or is_ghost)


def goes_with_camera(move: Motion) -> bool:
    """Whether something moves about as the camera does: a fault of the picture."""
    apart_m_s = float(np.hypot(*(move.velocity_m_s - move.camera_m_s)))
    return apart_m_s <= 0.3 * float(np.hypot(*move.camera_m_s))


def is_rigid(points: Sequence[TrackPoint], length_m: float) -> bool:
    """Whether a blob went far without changing its size, so that no parallax explains it after all.

    What leans over the ground stands on it: its ghost grows and shrinks with the camera's way, down to nothing.
    """
    if len(points) < _RIGID_VIEWS or length_m > _RIGID_M:
        return False
    return _way_m(points) > max(1.0, _RIGID_LENGTHS * length_m) and _keeps_its_size(points)


def floats(points: Sequence[TrackPoint], move: Motion, length_m: float) -> bool:
    """Whether a small blob of steady size is far from where anything tall enough to move so would stand.

    What leans is seen from its foot to its top; the foot of a thing whose top moves against the camera's way with a
    share k of its speed lies (top + k camera) / (1 + k). Photos show it too seldom to see it grow.
    """
    camera_m_s = float(np.hypot(*move.camera_m_s))
    k = -float(move.velocity_m_s @ move.camera_m_s) / max(camera_m_s, 1e-6) ** 2
    if length_m > _FLOATS_M or k <= 0 or not _keeps_its_size(points):
        return False  # where k is not above 0, no height explains it
    apart_m = [
        k / (1 + k) * float(np.hypot(*(each.blob.place_m - each.camera_m))) for each in points
    ]
    return _way_m(points) > _RIGID_LENGTHS * length_m and float(np.median(apart_m)) > length_m


def _way_m(points: Sequence[TrackPoint]) -> float:
    """How far a blob's last points lead over the ground."""
    return float(np.hypot(*(points[-1].blob.place_m - points[0].blob.place_m)))


def _keeps_its_size(points: Sequence[TrackPoint]) -> bool:
    """Whether a blob's area and length have hardly changed: nothing that grew explains its motion."""
    areas = [each.blob.area_m2 for each in points]
    lengths = [each.blob.length_m for each in points]
    return max(areas) < _STEADY_AREA * min(areas) and max(lengths) < _STEADY_LENGTH * min(lengths)


# How a blob becomes a sighting of something that may move; as measured from view to view.
_PLACE_M = 0.03  # sigma of its place: what alignment leaves ...
_PLACE_SHARE = 0.05  # ... and this share of its length: its outline is drawn anew in each view
_CAR_M = 2.5  # what is longer may move as cars do, the rest as people do
# grey levels that turn a blob's looks by a radian: 19 in 20 keep theirs within 20
_COLOUR_LEVELS = 40.0
_TRACKER = TrackerSettings(sure_score=0.0, new_per_m2=0.001, size_sigma=0.25, least_size=-4.0)


# When something counts as moving.
_LEAST_VIEWS = 5  # of a video
_LEAST_PHOTOS = 3  # of views so far apart in time as photos are: chance seldom fits three of them
_LEAST_MOVE_M = 1.0  # beyond what alignment and a swaying crown do
# of its own: then its places do not overlap, and nothing that grew explains it
_LEAST_LENGTHS = 1.0
_LEAST_LENGTH_M = 0.3  # a person from above; smaller specks jump about
_MOST_SPEED_M_S = 3.0  # of something small ...
_MOST_LENGTHS_S = 4.0  # ... and lengths a second more: a car of 4 m may go 19 m/s
_FORGET_S = 2.5  # what was not seen for so long is judged anew ...
_FORGET_VIEWS = 2  # ... and for so many views
_POINTS = 12  # of a track are judged, the last ones


@dataclass(frozen=True, eq=False)
class BlobTrack:
    """One blob over time, by its number: its first point, the last few, how many, and the sum of their scores.

    `leg` numbers how often anything came into view: this track and others.
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

    @property
    def last(self) -> TrackPoint:
        """Where it was seen last."""
        return self.points[-1]

    @property
    def velocity_m_s(self) -> Floats:
        """(2,) over its last points; zeros while there is but one."""
        return motion(self.points).velocity_m_s if len(self.points) > 1 else np.zeros(2)

    def with_point(self, point: TrackPoint, oldest_ns: int) -> "BlobTrack":
        """The track, one view longer; points from before a gap, last seen before `oldest_ns`, are judged no more."""
        known = self.points if self.last.time_ns >= oldest_ns else ()
        return replace(
            self,
            points=(*known, point)[-_POINTS:],
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
        )


@dataclass(frozen=True, eq=False)
class MovingBlobs:
    """What moves in one view. For each box of the view: whether it shows something that moves, and whether
    it may (so that nobody should call it a change of the ground yet), and the leg of its track, 0 for none. `movers`
    are the tracks that moved in this view, `merged` numbers that turned out to be an earlier track's, with that one's.
    """

    is_moving: Mask
    may_move: Mask
    legs: Labels
    movers: tuple[BlobTrack, ...]
    merged: Mapping[int, int]


class BlobTracker:
    """The blobs of a flight's views while they come. Only `follow` changes it."""

    def __init__(self) -> None:
        self._tracker = Tracker(_TRACKER)
        self._tracks: dict[int, BlobTrack] = {}
        self._legs = 0
        self._times_ns: deque[int] = deque(maxlen=_FORGET_VIEWS + 1)  # of the last views

    def follow(self, view: ComparedView) -> MovingBlobs:
        """Take the next view's blobs; views come in order of time."""
        now_ns, camera_m = view.time_ns, np.array(view.camera_m[:2])
        oldest_ns = min([now_ns - round(_FORGET_S * 1e9), *self._times_ns])
        self._times_ns.append(now_ns)
        blobs = blobs_of(view)
        colours = np.array([each.colour for each in blobs]).reshape(-1, 3) / _COLOUR_LEVELS
        sees_horizon = not np.isfinite(view.outline_m).all()
        update = self._tracker.update(
            [_sighting(view, each) for each in blobs],
            time_ns=now_ns,
            footprint_m=None if sees_horizon else view.outline_m,
            appearance=np.hstack([np.cos(colours), np.sin(colours)]),
        )
        for gone, kept in update.merged.items():
            younger = self._tracks.pop(gone, None)
            older = self._tracks.get(kept)
            if younger is not None:
                self._tracks[kept] = (
                    replace(younger, number=kept) if older is None else older.joined(younger)
                )
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
            held[blob.box] = may_move(track.points)
            is_moving[blob.box] = track.moves and held[blob.box]
        self._tracks.update(shown)
        self._forget(oldest_ns)
        movers = tuple(each for each in shown.values() if each.moves_now)
        return MovingBlobs(is_moving, held, legs, movers, update.merged)

    def _prolonged(self, number: int, point: TrackPoint, oldest_ns: int) -> BlobTrack:
        """The track with one more point, judged anew."""
        known = self._tracks.get(number)
        if known is None:
            return BlobTrack(number, point, (point,), 1, point.blob.score, self._next_leg())
        track = known.with_point(point, oldest_ns)
        if len(track.points) == 1:
            return replace(track, leg=self._next_leg())
        moves_now = track.moves_now or self._moves(track.points, self._are_photos(track))
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

    def _moves(self, points: Sequence[TrackPoint], are_photos: bool) -> bool:
        """Whether points show it: a motion of its own, or a size that keeps what leans could not keep."""
        if len(points) < (_LEAST_PHOTOS if are_photos else _LEAST_VIEWS):
            return False
        move, length_m = (
            motion(points),
            float(np.median([each.blob.length_m for each in points])),
        )
        if self._goes_its_length(points, move, length_m):
            return True
        return _is_plausible(points, move, length_m) and (
            is_rigid(points, length_m) or (are_photos and floats(points, move, length_m))
        )

    def _goes_its_length(self, points: Sequence[TrackPoint], move: Motion, length_m: float) -> bool:
        """Whether a thing of this length plausibly goes far enough by a motion that no parallax explains."""
        needed_m = max(_LEAST_MOVE_M, _LEAST_LENGTHS * length_m)
        is_own = float(np.hypot(*move.own_m_s)) > _LEAST_OWN * move.speed_m_s
        return is_own and move.path_m > needed_m and _is_plausible(points, move, length_m)

    def _are_photos(self, track: BlobTrack) -> bool:
        """Whether the views were taken seldom while the track lasted."""
        seen = [each for each in self._times_ns if each >= track.points[0].time_ns]
        return len(seen) > 1 and (seen[-1] - seen[0]) * 1e-9 >= _PHOTOS_APART_S * (len(seen) - 1)


def _sighting(view: ComparedView, blob: Blob) -> Sighting:
    """A blob as the tracker takes it: its place, and which things move as something of its size does."""
    x, y, w, h = (float(each) for each in view.boxes[blob.box])
    sigma_m = _PLACE_M + _PLACE_SHARE * blob.length_m
    return Sighting(
        view.index,
        view.name,
        view.time_ns,
        "car" if blob.length_m >= _CAR_M else "person",
        float(np.clip(blob.score, 0, 1)),
        np.array([x, y, x + w, y + h]),
        blob.place_m,
        sigma_m**2 * np.eye(2),
        np.array([blob.length_m, blob.area_m2 / max(blob.length_m, 1e-6)]),
    )


def _is_plausible(points: Sequence[TrackPoint], move: Motion, length_m: float) -> bool:
    """Whether a thing of this length may be so fast, goes steadily enough, and not about as the camera does."""
    seconds = (points[-1].time_ns - points[0].time_ns) * 1e-9
    is_steady = move.error_m < 0.05 + 0.03 * (move.speed_m_s * seconds + length_m)
    is_possible = length_m >= _LEAST_LENGTH_M and move.speed_m_s <= (
        _MOST_SPEED_M_S + _MOST_LENGTHS_S * length_m
    )
    return is_possible and is_steady and not goes_with_camera(move)


class Movers:
    """What moved during one flight. `see` changes it.

    `id_prefix` begins every change's id, `m_per_px` is a pixel of changes' pictures, `cell_m` a side of the evidence's
    cells.
    """

    def __init__(self, id_prefix: str, m_per_px: float, cell_m: float) -> None:
        self._prefix, self._m_per_px, self._cell_m = id_prefix, m_per_px, cell_m
        self._known: dict[int, Change] = {}  # by the tracker's number
        self._legs: set[int] = set()

    @property
    def changes(self) -> tuple[Change, ...]:
        """All of them as they were seen last."""
        return tuple(self._known.values())

    def knows(self, leg: int) -> bool:
        """Whether something was seen to move on a leg of its track."""
        return leg in self._legs

    def see(
        self,
        view: ComparedView,
        moving: MovingBlobs,
        named: Callable[[int], tuple[int, int | None]],
    ) -> list[Change]:
        """Bring what moves in this view up to date; those announced first. `named` gives the number of the change that
        a leg of a track becomes, and when that was announced already; None if it was not."""
        announced = []
        for gone, kept in moving.merged.items():
            twice = self._known.pop(gone, None)
            if twice is not None:
                self._known.setdefault(kept, twice)
        for track in moving.movers:
            self._legs.add(track.leg)
            known = self._known.get(track.number)
            if known is None:
                number, announced_ns = named(track.leg)
                change = self._change(view, track, f"{self._prefix}-{number}")
                if announced_ns is None:
                    announced.append(change)
                else:
                    change = replace(change, announced_ns=announced_ns)
            else:
                change = self._change(view, track, known.id)
                change = replace(
                    change,
                    first_seen_ns=known.first_seen_ns,
                    views=max(change.views, known.views + 1),
                    announced_ns=known.announced_ns,
                )
            self._known[track.number] = change
        return announced

    def _change(self, view: ComparedView, track: BlobTrack, change_id: str) -> Change:
        """A moving thing as this view shows it."""
        m_per_px = view.m_per_px
        outline_m = standing_outline_m(view, track.last.blob)
        if outline_m is None:
            place_m = track.last.blob.place_m
            outline_m = place_m + np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * self._cell_m / 2
        window = PatchWindow.around(
            outline_m.min(axis=0), outline_m.max(axis=0), self._m_per_px, 512
        )
        size = measures(outline_m)
        residual_m = view.residual_px * m_per_px if np.isfinite(view.residual_px) else 0.0
        score = track.score_sum / track.count * (track.count + 1) / (track.count + 2)
        return Change(
            change_id,
            ChangeKind.MOVING,
            float(np.clip(score, 0, 1)),
            outline_m,
            track.first.time_ns,
            track.last.time_ns,
            track.count,
            size.area_m2,
            size.length_m,
            place_sigma_m(residual_m, self._cell_m, aside_of(outline_m, view.camera_m[None])),
            patch_of(window, cut(view, window), outline_m),
            track.velocity_m_s,
            announced_ns=view.time_ns,
        )
