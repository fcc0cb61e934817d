"""What moves while it is seen: changed blobs followed over views in ground metres, and which of them really move.

A thing of height h stands in the picture where its top hides the ground: seen from a camera at height H that flies with
v, its blob moves over the ground with -v h / (H - h). So what a blob moves against the camera's own way proves nothing
as long as some h below 0.6 H explains it; only the rest of its motion counts.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from sorvolo.change.cells import scale_m_per_px
from sorvolo.change.shadows import shadow_of_arrival, thing_of
from sorvolo.errors import SettingsError
from sorvolo.geometry.arrays import Floats, Mask, PointsM
from sorvolo.geometry.homography import apply_homography
from sorvolo.geometry.polygons import signed_area
from sorvolo.survey.findings import ComparedView

_MOST_PARALLAX = 0.6 / (1 - 0.6)  # h / (H - h) of a thing 0.6 times as high as the camera flies
_UNLIKELY_PARALLAX = 0.5  # no thing that came is a third as high as the camera flies
_POINTS = 12  # of a track, that its velocity is fitted to
_MOST_BOXES = 64
_RIM_PX = 2
_AROUND_PX = 4
_RIGID_POINTS, _RIGID_LENGTHS, _RIGID_LENGTH_M = 5, 2.0, 2.5
_LOST_FOR_S = 20.0  # a thing that moves steadily is known again after so long
_UPRIGHT_M, _PERSON_M = 1.0, 1.9  # narrower than this it may be a person, who leans as this height does at most


@dataclass(frozen=True)
class MovingSettings:
    """When something counts as moving."""

    least_views: int = 5
    least_move_m: float = 1.0  # beyond what alignment and a swaying crown do
    least_lengths: float = 1.2  # of its own: then its places do not overlap, and nothing that grew explains it
    least_length_m: float = 0.3  # a person from above; smaller specks jump about
    most_speed_m_s: float = 3.0  # of something small ...
    most_lengths_s: float = 4.0  # ... and lengths a second more: a car of 4 m may go 19 m/s
    most_step_m: float = 6.0  # between two views: further away anything could be it
    forget_s: float = 2.5  # a track without a blob for so long has ended

    def __post_init__(self) -> None:
        if self.least_views < 3:
            raise SettingsError(f"moving needs at least 3 views to see a steady velocity, got {self.least_views}")
        if min(self.least_move_m, self.least_lengths, self.most_speed_m_s, self.most_step_m, self.forget_s) <= 0:
            raise SettingsError("moving: distances, speeds and times must be above 0")

    def fastest_m_s(self, length_m: float) -> float:
        """The greatest speed that something of this length may have."""
        return self.most_speed_m_s + self.most_lengths_s * length_m


@dataclass(frozen=True, eq=False)
class Blob:
    """One changed piece of a view: where it stands on the ground (2,), its size, and its mean colour (3,)."""

    box: int  # row of the view's boxes
    place_m: Floats
    length_m: float
    area_m2: float
    colour: Floats
    score: float


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

    def with_point(self, point: TrackPoint) -> "Track":
        """The track, one view longer."""
        points = (*self.points, point)[-_POINTS:]
        return Track(
            self.first, points, self.count + 1, self.score_sum + point.blob.score, motion(points).velocity_m_s,
            self.mover,
        )


@dataclass(frozen=True, eq=False)
class Followed:
    """What one view says about motion. For each box of the view: whether it shows something that moves, and whether
    it may (so that nobody should call it a change of the ground yet). `movers` are the tracks that moved in this view.
    """

    is_moving: NDArray[np.bool_]
    may_move: NDArray[np.bool_]
    movers: tuple[Track, ...]


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
    parallax = min(max(against / abs(camera) ** 2, 0.0), _MOST_PARALLAX) if abs(camera) > 1e-2 else 0.0
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

    def follow(self, view: ComparedView) -> Followed:
        """Take the next view's blobs; views come in order of time."""
        now_ns, settings = view.time_ns, self._settings
        gone = [each for each in self._tracks if (now_ns - each.last.time_ns) * 1e-9 > settings.forget_s]
        self._lost += [each for each in gone if each.mover]
        self._lost = [each for each in self._lost if (now_ns - each.last.time_ns) * 1e-9 <= _LOST_FOR_S]
        tracks = [each for each in self._tracks if each not in gone]
        blobs = _blobs(view)
        is_moving, may_move = np.zeros(len(view.boxes), bool), np.zeros(len(view.boxes), bool)
        movers: list[Track] = []
        pairs = _pairs(tracks, blobs, now_ns, settings)
        taken = {blob for _, blob in pairs}
        for index, blob_index in pairs:
            blob = blobs[blob_index]
            track = tracks[index].with_point(TrackPoint(now_ns, blob, np.array(view.camera_m[:2])))
            move = motion(track.points)
            if not track.mover and self._moves(track, move, view):
                track = replace(track, mover=self._number_of(track, move))
            if track.mover:
                movers.append(track)
            # a thing that stopped is a change of the ground, whatever it was before
            recent = motion(track.points[-5:])
            may_move[blob.box] = _may_move(track, recent)
            is_moving[blob.box] = bool(track.mover) and may_move[blob.box]
            tracks[index] = track
        camera_m = np.array(view.camera_m[:2])
        for blob_index, blob in enumerate(blobs):
            if blob_index not in taken:
                point = TrackPoint(now_ns, blob, camera_m)
                tracks.append(Track(point, (point,), 1, blob.score, np.zeros(2)))
                may_move[blob.box] = True  # nobody knows yet
        whole = {blob.box for blob in blobs}
        unsteady = [
            each for each in tracks
            if each.mover or (each.count > 2 and _may_move(each, motion(each.points[-5:])))
        ]
        _follow_over_rim(view, unsteady, whole, is_moving, may_move)
        self._tracks = tracks
        return Followed(is_moving, may_move, tuple(movers))

    def _moves(self, track: Track, move: Motion, view: ComparedView) -> bool:
        settings = self._settings
        length_m = float(np.median([each.blob.length_m for each in track.points]))
        needed_m = max(settings.least_move_m, settings.least_lengths * length_m)
        speed_m_s = float(np.hypot(*move.velocity_m_s))
        is_own = move.path_m > needed_m and float(np.hypot(*move.own_m_s)) > 0.35 * speed_m_s
        return (
            track.count >= settings.least_views
            and settings.least_length_m <= length_m
            and speed_m_s <= settings.fastest_m_s(length_m)
            and (is_own or _is_rigid(track, length_m))
            and float(np.hypot(*(move.velocity_m_s - move.camera_m_s))) > 0.3 * float(np.hypot(*move.camera_m_s))
            and move.error_m < 0.05 + 0.03 * speed_m_s * track.seconds
            and not _is_still_there(track.points[0], view)
        )

    def _number_of(self, track: Track, move: Motion) -> int:
        start = track.points[0]
        for lost in self._lost:
            gap_s = (start.time_ns - lost.last.time_ns) * 1e-9
            expected_m = lost.last.blob.place_m + gap_s * lost.velocity_m_s
            speed_m_s = float(np.hypot(*move.velocity_m_s))
            is_near = float(np.hypot(*(start.blob.place_m - expected_m))) < 1.0 + 0.4 * gap_s * speed_m_s
            is_steady = float(np.hypot(*(move.velocity_m_s - lost.velocity_m_s))) < 0.3 + 0.5 * speed_m_s
            if gap_s > 0 and is_near and is_steady and _alike(lost.last.blob, start.blob):
                self._lost.remove(lost)
                return lost.mover
        self._movers += 1
        return self._movers


def _is_rigid(track: Track, length_m: float) -> bool:
    """Whether a blob went far without changing its size, so that no parallax explains it after all.

    What leans over the ground stands on it: its ghost grows and shrinks with the camera's way, down to nothing.
    """
    if len(track.points) < _RIGID_POINTS or length_m > _RIGID_LENGTH_M:
        return False
    way_m = float(np.hypot(*(track.last.blob.place_m - track.points[0].blob.place_m)))
    areas = [each.blob.area_m2 for each in track.points]
    lengths = [each.blob.length_m for each in track.points]
    return (
        way_m > max(1.0, _RIGID_LENGTHS * length_m)
        and max(areas) < 1.7 * min(areas)
        and max(lengths) < 1.35 * min(lengths)
    )


def _may_move(track: Track, move: Motion) -> bool:
    if track.count < 3:
        return True
    recent = track.points[-5:]
    camera_m = recent[-1].camera_m - recent[0].camera_m
    way_m = move.velocity_m_s * (recent[-1].time_ns - recent[0].time_ns) * 1e-9
    camera_way_m = float(np.hypot(*camera_m))
    against_m = -float(way_m @ camera_m) / camera_way_m if camera_way_m > 0.1 else 0.0
    is_ghost = against_m > max(_UNLIKELY_PARALLAX * camera_way_m, 0.25)
    return bool(move.path_m > max(0.25, 2 * move.error_m) or is_ghost)


def _follow_over_rim(
    view: ComparedView, tracks: Sequence[Track], whole: set[int], is_moving: NDArray[np.bool_],
    may_move: NDArray[np.bool_],
) -> None:
    """Mark the boxes that are cut by the view's rim, thus no blobs, and lie where an unsteady thing must be by now."""
    if not tracks:
        return
    m_per_px = scale_m_per_px(view)
    image_from_site = np.linalg.inv(view.site_from_image)
    for track in tracks:
        ahead_s = (view.time_ns - track.last.time_ns) * 1e-9
        expected_m = track.last.blob.place_m + ahead_s * track.velocity_m_s
        pixel = apply_homography(image_from_site, expected_m[None])[0]
        reach_px = 0.75 * track.last.blob.length_m / m_per_px + _RIM_PX
        for index, (x, y, w, h) in enumerate(view.boxes):
            nearest = np.clip(pixel, [x, y], [x + w, y + h])
            if index not in whole and float(np.hypot(*(pixel - nearest))) < reach_px:
                may_move[index] = True
                is_moving[index] |= bool(track.mover)


def _is_still_there(first: TrackPoint, view: ComparedView) -> bool:
    """Whether the view still shows a change where the track began; not if it cannot tell."""
    pixel = apply_homography(np.linalg.inv(view.site_from_image), first.blob.place_m[None])[0]
    height, width = view.changed.shape
    if not np.isfinite(pixel).all() or not (0 <= pixel[0] < width - 1 and 0 <= pixel[1] < height - 1):
        return False
    x, y = round(pixel[0]), round(pixel[1])
    reach = 2 * _AROUND_PX
    window = slice(max(y - reach, 0), y + reach), slice(max(x - reach, 0), x + reach)
    changed = view.changed[window] > 0
    dark = shadow_of_arrival(view.reference[window], view.image[window], changed)
    # the shadow of what walked on may lie where it set out
    return bool((changed & ~dark)[y - window[0].start, x - window[1].start])


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


def _blobs(view: ComparedView) -> list[Blob]:
    """The blobs that lie whole inside the view; one cut by its rim would seem to move with the camera."""
    height, width = view.changed.shape
    m_per_px = scale_m_per_px(view)
    blobs = []
    for index in np.argsort(-view.scores, kind="stable")[:_MOST_BOXES]:
        x, y, w, h = (int(each) for each in view.boxes[index])
        if x < _RIM_PX or y < _RIM_PX or x + w > width - _RIM_PX or y + h > height - _RIM_PX:
            continue
        if w * h > 0.15 * width * height or not _is_known_around(view.valid, x, y, w, h):
            continue
        window = slice(max(y - _AROUND_PX, 0), y + h + _AROUND_PX), slice(max(x - _AROUND_PX, 0), x + w + _AROUND_PX)
        changed = view.changed[window] > 0
        thing = thing_of(changed, shadow_of_arrival(view.reference[window], view.image[window], changed))
        ys, xs = np.nonzero(thing)
        if not len(xs):
            continue
        x, y = window[1].start + int(xs.min()), window[0].start + int(ys.min())
        w, h = int(np.ptp(xs)) + 1, int(np.ptp(ys)) + 1
        part = thing[ys.min():ys.max() + 1, xs.min():xs.max() + 1].view(np.uint8) * np.uint8(255)
        moments = cv2.moments(part, binaryImage=True)
        if moments["m00"] <= 0:
            continue
        hull = cv2.convexHull(cv2.findNonZero(part)).reshape(-1, 2) + np.array([x, y])
        hull_m = apply_homography(view.site_from_image, hull.astype(np.float64))
        middle = np.array([[x + moments["m10"] / moments["m00"], y + moments["m01"] / moments["m00"]]])
        place_m = apply_homography(view.site_from_image, middle)[0]
        if not (np.isfinite(hull_m).all() and np.isfinite(place_m).all()):
            continue
        foot_m = _foot_m(hull_m, hull_m, view.camera_m, m_per_px)
        place_m = place_m if foot_m is None else foot_m.mean(axis=0)
        colour = np.array(cv2.mean(view.image[y : y + h, x : x + w], part)[:3])
        area_m2 = moments["m00"] * m_per_px**2
        score = float(view.scores[index])
        blobs.append(Blob(int(index), place_m, max(w, h) * m_per_px, area_m2, colour, score))
    return blobs


def standing_outline_m(view: ComparedView, blob: Blob) -> PointsM | None:
    """(N, 2) where a blob of the view stands on the ground, without its shadow and, if it may be a person, without the
    body that leans away from the camera; None where nothing of it is left."""
    x, y, w, h = (int(each) for each in view.boxes[blob.box])
    window = slice(max(y - _AROUND_PX, 0), y + h + _AROUND_PX), slice(max(x - _AROUND_PX, 0), x + w + _AROUND_PX)
    changed = view.changed[window] > 0
    thing = thing_of(changed, shadow_of_arrival(view.reference[window], view.image[window], changed))
    if not thing.any():
        return None
    corner = np.array([window[1].start, window[0].start])
    all_m, thing_m = (
        apply_homography(view.site_from_image, np.argwhere(mask)[:, ::-1] + corner) for mask in (changed, thing)
    )
    if not np.isfinite(all_m).all():
        return None
    outline_m = _foot_m(thing_m, all_m, view.camera_m, scale_m_per_px(view))
    if outline_m is None:
        outline_m = np.asarray(cv2.convexHull(thing_m.astype(np.float32)).reshape(-1, 2), np.float64)
    return outline_m if len(outline_m) >= 3 and abs(signed_area(outline_m)) > 0 else None


def _foot_m(thing_m: PointsM, changed_m: PointsM, camera_m: Floats, m_per_px: float) -> PointsM | None:
    """(4, 2) the ground under something narrow that leans away from the camera; None for what does not.

    The feet are at its near end, no nearer than a person's would be, and a person is about as long as wide from above.
    `thing_m` are points of the lit thing: dark trousers may be missing, so `changed_m` says how near it begins.
    """
    away = thing_m.mean(axis=0) - camera_m[:2]
    distance_m = float(np.hypot(*away))
    if distance_m < 1e-6:
        return None
    site_from_lean = np.array([away, [-away[1], away[0]]]) / distance_m
    thing, changed = ((each - camera_m[:2]) @ site_from_lean.T for each in (thing_m, changed_m))
    (_, left), (far, right) = thing.min(axis=0), thing.max(axis=0)
    width_m = right - left + m_per_px
    nearest = far * (1 - _PERSON_M / max(float(camera_m[2]), 2 * _PERSON_M)) - width_m
    behind = changed[(changed[:, 1] >= left) & (changed[:, 1] <= right) & (changed[:, 0] >= nearest), 0]
    near = float(behind.min(initial=far))
    if width_m > _UPRIGHT_M or far - near <= width_m:
        return None
    middle = near + width_m - m_per_px
    corners = np.array([[near, left], [middle, left], [middle, right], [near, right]])
    return np.asarray(corners @ site_from_lean + camera_m[:2])


def _is_known_around(valid: Mask, x: int, y: int, w: int, h: int) -> bool:
    rim = 2 * (w + h)
    part = valid[max(y - 1, 0) : y + h + 1, max(x - 1, 0) : x + w + 1]
    unknown = part.size - int(np.count_nonzero(part))
    return unknown < 0.1 * rim
