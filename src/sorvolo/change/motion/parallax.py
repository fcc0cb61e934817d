"""Parallax as one of the motions that a changed blob may show: what a thing's height explains of it, and what moves.

A thing of height h stands in the picture where its top hides the ground: seen from a camera at height H that flies with
v, its blob moves over the ground with -v h / (H - h). So what a blob moves against the camera's own way proves nothing
as long as some h below 0.6 H explains it; only the rest of its motion counts.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from sorvolo.change.motion.blobs import Blob
from sorvolo.geometry.arrays import Floats


@dataclass(frozen=True)
class ParallaxSettings:
    """What a thing's height may explain of a blob's motion, and when nothing does (before 0014; photos 0016).

    Shares are of the camera's own way over the ground; a thing h high, seen from H, has h / (H - h).
    """

    most: float = 1.5  # h = 0.6 H: no taller thing is expected
    unlikely: float = 0.5  # h = H / 3: no thing that came is so high
    least_own: float = 0.35  # of a mover's speed that no height explains
    rigid_views: int = 5  # a blob that keeps its size over so many views, ...
    rigid_lengths: float = (
        2.0  # ... on a way of so many of its lengths, moves whatever its direction ...
    )
    rigid_m: float = 2.5  # ... if it is no longer, m
    photos_apart_s: float = 0.7  # views that are seldom, on average; they may show a blob ...
    floats_m: float = (
        1.3  # ... no longer than this, m, too far from any foot that it could stand on
    )
    steady_area: float = 1.7  # the largest by the smallest of one that keeps its size, and ...
    steady_length: float = 1.35  # ... the longest by the shortest


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
    parallax = (
        min(max(against / abs(camera) ** 2, 0.0), settings.most) if abs(camera) > 1e-2 else 0.0
    )
    own = velocity + parallax * camera
    return Motion(
        np.array([velocity.real, velocity.imag]),
        np.array([camera.real, camera.imag]),
        np.array([own.real, own.imag]),
        abs(own) * times[-1],
        (rest / count) ** 0.5,
    )


def may_move(points: Sequence[TrackPoint], settings: ParallaxSettings) -> bool:
    """Whether a blob may be something that moves, or only leans: a thing that stopped is neither, whatever it was."""
    if len(points) < 3:
        return True
    recent = points[-5:]
    move = motion(recent, settings)
    camera_m = recent[-1].camera_m - recent[0].camera_m
    way_m = move.velocity_m_s * (recent[-1].time_ns - recent[0].time_ns) * 1e-9
    camera_way_m = float(np.hypot(*camera_m))
    against_m = -float(way_m @ camera_m) / camera_way_m if camera_way_m > 0.1 else 0.0
    is_ghost = against_m > max(settings.unlikely * camera_way_m, 0.25)
    return bool(move.path_m > max(0.25, 2 * move.error_m) or is_ghost)


def goes_with_camera(move: Motion) -> bool:
    """Whether something moves about as the camera does: a fault of the picture."""
    apart_m_s = float(np.hypot(*(move.velocity_m_s - move.camera_m_s)))
    return apart_m_s <= 0.3 * float(np.hypot(*move.camera_m_s))


def is_rigid(points: Sequence[TrackPoint], length_m: float, settings: ParallaxSettings) -> bool:
    """Whether a blob went far without changing its size, so that no parallax explains it after all.

    What leans over the ground stands on it: its ghost grows and shrinks with the camera's way, down to nothing.
    """
    if len(points) < settings.rigid_views or length_m > settings.rigid_m:
        return False
    return _way_m(points) > max(1.0, settings.rigid_lengths * length_m) and _keeps_its_size(
        points, settings
    )


def floats(
    points: Sequence[TrackPoint], move: Motion, length_m: float, settings: ParallaxSettings
) -> bool:
    """Whether a small blob of steady size is far from where anything tall enough to move so would stand.

    What leans is seen from its foot to its top; the foot of a thing whose top moves against the camera's way with a
    share k of its speed lies (top + k camera) / (1 + k). Photos show it too seldom to see it grow.
    """
    camera_m_s = float(np.hypot(*move.camera_m_s))
    k = -float(move.velocity_m_s @ move.camera_m_s) / max(camera_m_s, 1e-6) ** 2
    if length_m > settings.floats_m or k <= 0 or not _keeps_its_size(points, settings):
        return False  # where k is not above 0, no height explains it
    apart_m = [
        k / (1 + k) * float(np.hypot(*(each.blob.place_m - each.camera_m))) for each in points
    ]
    return (
        _way_m(points) > settings.rigid_lengths * length_m and float(np.median(apart_m)) > length_m
    )


def shown_alone(points: Sequence[TrackPoint], settings: ParallaxSettings) -> tuple[TrackPoint, ...]:
    """The points less those of single views in which the blob has another length than just before and after, where it
    has one length: its shadow or a neighbour was joined with it there, and its place is not the thing's."""
    kept = list(points[:1])
    for point, after in pairwise(points[1:]):
        before_m, here_m, after_m = (each.blob.length_m for each in (kept[-1], point, after))
        around = sorted((before_m, after_m))
        is_other = (
            not around[1] / settings.steady_length <= here_m <= around[0] * settings.steady_length
        )
        if not is_other or around[1] >= settings.steady_length * around[0]:
            kept.append(point)
    return (*kept, *points[1:][-1:])


def _way_m(points: Sequence[TrackPoint]) -> float:
    """How far a blob's last points lead over the ground."""
    return float(np.hypot(*(points[-1].blob.place_m - points[0].blob.place_m)))


def _keeps_its_size(points: Sequence[TrackPoint], settings: ParallaxSettings) -> bool:
    """Whether a blob's area and length have hardly changed: nothing that grew explains its motion."""
    areas = [each.blob.area_m2 for each in points]
    lengths = [each.blob.length_m for each in points]
    return max(areas) < settings.steady_area * min(areas) and max(
        lengths
    ) < settings.steady_length * min(lengths)
