"""The pose graph's keyframes and links as arrays that stay stacked while they grow, as the solver wants them."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sorvolo.geometry.arrays import Floats, Mask, Matrix3, PointsM, Rows
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.homography import apply_homography, fit_similarity
from sorvolo.geometry.pose import Pose
from sorvolo.geometry.summary import SIGMA_PER_MEDIAN_DEVIATION
from sorvolo.mosaic.bundle import LINKS_AT_ONCE, Linked, Nodes, Pairs, linearise
from sorvolo.mosaic.graph_settings import INDEPENDENT_PAIRS, PAIRS_PER_LINK
from sorvolo.mosaic.ground_ties import similarity_of_most
from sorvolo.mosaic.shelf import Shelf, ShelvedRows
from sorvolo.survey.flight import CameraPrior
from sorvolo.survey.mosaic import Link

# stands in for an infinite sigma; its weight is nothing, its arithmetic finite
_UNKNOWN_SIGMA_M = 1e6
_FIRST_ROOM = 16  # rows; then they double


class _Column:
    """One of `_Rows`' columns, (N, *shape): a view, good until the next row or `keep`."""

    def __init__(self, kind: type, *shape: int) -> None:
        self.kind, self.shape = kind, shape

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    def __get__(self, rows: "_Rows", owner: type) -> NDArray[Any]:
        return rows._columns[self.name][: rows._count]


class _Rows:
    """Equally long columns; a row more costs the same however long they are."""

    def __init__(self) -> None:
        self._columns: dict[str, NDArray[Any]] = {
            each.name: np.zeros((_FIRST_ROOM, *each.shape), each.kind)
            for each in vars(type(self)).values()
            if isinstance(each, _Column)
        }
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def _add(self, **row: Any) -> None:
        """One value for each column."""
        if self._count == len(next(iter(self._columns.values()))):
            self._columns = {
                name: _with_twice_the_room(each) for name, each in self._columns.items()
            }
        for name, value in row.items():
            self._columns[name][self._count] = value
        self._count += 1

    def keep(self, chosen: Mask) -> None:
        """Drop the rows where `chosen` (N,) is False."""
        count = int(np.sum(chosen))
        for each in self._columns.values():
            each[:count] = each[: self._count][chosen]
        self._count = count


class NodeRows(_Rows):
    """Where each keyframe stands and what telemetry reports of it; rows are views and may be written to."""

    rotations = _Column(float, 3, 3)  # site_from_camera
    centres_m = _Column(float, 3)
    prior_centres_m = _Column(float, 3)  # by telemetry
    stated_sigma_m = _Column(float, 3)  # as telemetry states it, infinite: not known
    prior_rotations = _Column(float, 3, 3)  # by telemetry
    stated_sigma_rad = _Column(float, 3)  # about the camera's own axes, infinite: not known
    own = _Column(bool)  # of the flight that is mapped

    def append(self, prior: CameraPrior, pose: Pose, *, own: bool) -> None:
        """A keyframe more, at `pose` for now."""
        self._add(rotations=pose.rotation, centres_m=pose.translation_m, own=own)
        self.set_prior(len(self) - 1, prior)

    def set_prior(self, at: int, prior: CameraPrior) -> None:
        """Replace the telemetry of a keyframe."""
        self.prior_centres_m[at], self.stated_sigma_m[at] = prior.position_m, prior.position_sigma_m
        self.prior_rotations[at], self.stated_sigma_rad[at] = (
            prior.rotation,
            np.radians(prior.attitude_sigma_deg),
        )

    def nodes(self, place: Floats, contradicted: Rows, at: Rows | slice = slice(None)) -> Nodes:
        """For the solver: stated sigmas of places times `place` (3,), no angles where contradicted; all nodes, or those
        `at` some rows."""
        sigma_m, sigma_rad = self.stated_sigma_m[at] * place, self.stated_sigma_rad[at].copy()
        sigma_rad[np.isin(np.arange(len(self))[at], contradicted)] = np.inf
        return Nodes(
            self.rotations[at],
            self.centres_m[at],
            self.prior_centres_m[at],
            np.where(np.isfinite(sigma_m), np.maximum(sigma_m, 1e-3), _UNKNOWN_SIGMA_M),
            self.prior_rotations[at],
            np.where(np.isfinite(sigma_rad), np.maximum(sigma_rad, 1e-4), _UNKNOWN_SIGMA_M),
            self.own[at],
        )


class LinkRows(_Rows):
    """The links and their matched points; the points of older ones lie on the `shelf`, if there is one."""

    old = _Column(int)  # node index
    new = _Column(int)
    pairs = _Column(int)  # how many
    points = _Column(int)  # index on the shelf
    focal_px = _Column(float)
    sigma_px = _Column(float)  # across the parallax
    relief_m = _Column(float)  # height of things above the ground

    def __init__(self, shelf: Shelf | None = None) -> None:
        super().__init__()
        self._points = ShelvedRows("points", (2, PAIRS_PER_LINK, 2), float, shelf)

    def append(
        self, each: Link, old: tuple[int, Camera], new: tuple[int, Camera], sigma_px: float
    ) -> None:
        """A link more, between two nodes and their registration cameras; its relief is that of the others."""
        pick = np.arange(len(each.new_px))
        if len(pick) > PAIRS_PER_LINK:
            pick = np.linspace(0, len(pick) - 1, PAIRS_PER_LINK).round().astype(int)
        points = np.zeros((2, PAIRS_PER_LINK, 2))
        points[0, : len(pick)] = _ideal(old[1], each.old_px[pick])
        points[1, : len(pick)] = _ideal(new[1], each.new_px[pick])
        self._add(
            old=old[0],
            new=new[0],
            pairs=len(pick),
            points=len(self._points),
            focal_px=new[1].fx_px,
            sigma_px=sigma_px,
            relief_m=float(np.median(self.relief_m)) if len(self) else 0.1,
        )
        self._points.append(points)

    def of(self, chosen: Rows) -> Pairs:
        """The matched points of some links, each link's padded to the same number, for the solver."""
        old, new, pairs, points, focal_px, sigma_px, relief_m = (
            getattr(self, name)[chosen]
            for name in ("old", "new", "pairs", "points", "focal_px", "sigma_px", "relief_m")
        )
        exists = np.arange(PAIRS_PER_LINK) < pairs[:, None]
        weight = exists * np.minimum(1.0, INDEPENDENT_PAIRS / np.maximum(pairs, 1))[:, None]
        found = self._points.read(points)
        return Pairs(old, new, found[:, 0], found[:, 1], weight, focal_px, sigma_px, relief_m)

    def batches(self) -> Iterator[Pairs]:
        """See `Linked`."""
        for first in range(0, len(self), LINKS_AT_ONCE):
            yield self.of(np.arange(first, min(first + LINKS_AT_ONCE, len(self))))


def _with_twice_the_room(column: NDArray[Any]) -> NDArray[Any]:
    """The column with as many rows again, which take memory only once they are written."""
    wider = np.empty((2 * len(column), *column.shape[1:]), column.dtype)
    wider[: len(column)] = column
    return wider


def _ideal(camera: Camera, points_px: Floats) -> Floats:
    return (points_px - [camera.cx_px, camera.cy_px]) / [camera.fx_px, camera.fy_px]


_ROUNDS = 3  # trimmed: a few wild fixes must not turn the map
_WILD = 3.0  # times the median miss: such a fix is left out
_MOST_UNCERTAIN = 0.15  # relative, of scale and turn by these fixes: beyond, they leave them open
_LEAST_SIGMAS = 3.0  # of scale or turn, or ...
_LEAST_SCALE = 0.02  # ... relative, ...
_LEAST_TURN_RAD = 0.03  # 1.7 degrees
_TIMES_NEARER = 3.0  # known ground: the places have to come so much nearer


def change_to_fixes(
    places_m: PointsM,
    fixes_m: PointsM,
    sigma_m: Floats,
) -> Matrix3 | None:
    """The similarity (3, 3) of the ground that brings cameras, (N, 2), to their fixes, (N, 2), of sigmas (N,).

    None where the fixes leave it open, or it would change next to nothing.
    """
    for _ in range(_ROUNDS):
        spread_m = float(np.sqrt(((fixes_m - fixes_m.mean(0)) ** 2).sum(1).mean()))
        uncertainty = float(np.median(sigma_m)) / (np.sqrt(len(fixes_m)) * max(spread_m, 1e-9))
        if len(fixes_m) < 3 or uncertainty > _MOST_UNCERTAIN or np.ptp(places_m, axis=0).max() <= 0:
            return None
        change = fit_similarity(fixes_m, places_m)
        miss_m = np.linalg.norm(places_m @ change[:2, :2].T + change[:2, 2] - fixes_m, axis=1)
        keep = miss_m <= max(_WILD * float(np.median(miss_m)), 1e-6)
        if keep.all():
            break
        fixes_m, places_m = fixes_m[keep], places_m[keep]
    scale, turn = _scale_and_turn(change)
    least = _LEAST_SIGMAS * uncertainty
    keeps_scale = abs(np.log(scale)) < max(least, _LEAST_SCALE)
    return None if keeps_scale and abs(turn) < max(least, _LEAST_TURN_RAD) else change


def change_to_ground(places_m: PointsM, known_m: PointsM) -> Matrix3 | None:
    """The similarity (3, 3) that brings places of the map, (N, 2), to where they are known to lie, wild ones left out.

    None where they leave it open, or it would bring them little nearer.
    """
    change = similarity_of_most(known_m, places_m)
    if change is None:
        return None
    before_m = np.median(np.linalg.norm(places_m - known_m, axis=1))
    after_m = np.median(np.linalg.norm(apply_homography(change, places_m) - known_m, axis=1))
    return change if before_m > _TIMES_NEARER * after_m else None


def move_all(rows: NodeRows, change: Matrix3) -> None:
    """Shift, turn and scale all cameras by a similarity of the ground."""
    scale, turn = _scale_and_turn(change)
    matrix = np.array(
        [[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1.0]]
    )
    centres_m = rows.centres_m
    rows.rotations[:] = matrix @ rows.rotations
    centres_m[:] = np.column_stack(
        [centres_m[:, :2] @ change[:2, :2].T + change[:2, 2], centres_m[:, 2] * scale]
    )


def _scale_and_turn(change: Matrix3) -> tuple[float, float]:
    return float(np.hypot(change[0, 0], change[1, 0])), float(
        np.arctan2(change[1, 0], change[0, 0])
    )


_ENOUGH = 8  # frames from which telemetry's own errors are learnt


@dataclass(frozen=True, eq=False)
class Trust:
    """Factors on the stated sigmas of places, (3,), and the nodes whose angles are plainly wrong."""

    place: Floats = field(default_factory=lambda: np.ones(3))
    contradicted: Rows = field(default_factory=lambda: np.zeros(0, int))


@dataclass(frozen=True, eq=False)
class LinkNoise:
    """What each of L links shows: its noise across the parallax, px, and the relief along it, m; (L,) each."""

    across_px: Floats
    relief_m: Floats

    def is_false(self, typical_px: float) -> Mask:
        """(L,) where a link cannot be true, if most links' noise is `typical_px`."""
        return self.across_px > max(6.0, 8 * typical_px)


def link_noise(nodes: Nodes, pairs: Linked, shared: Floats) -> LinkNoise:
    """The noise of at least one link, by the cameras as they stand."""
    found = [_noise(nodes, some, shared) for some in pairs.batches()]
    return LinkNoise(
        np.concatenate([each.across_px for each in found]),
        np.concatenate([e.relief_m for e in found]),
    )


def miss_px(nodes: Nodes, pairs: Linked, shared: Floats) -> Iterator[tuple[Rows, Rows, Floats]]:
    """Of some links after the others their old and new nodes, (l,) each, and how far each pair is transferred amiss,
    (l, K); NaN where there is none."""
    for some in pairs.batches():
        miss = np.linalg.norm(linearise(nodes, some, shared).residual_px, axis=-1)
        miss[some.weight <= 0] = np.nan
        yield some.old, some.new, miss


def telemetry_trust(rows: NodeRows, tied: Mask, miss_m: Floats) -> Trust:
    """How good telemetry really is, from how it departs from the pictures, once there are enough of them.

    Fixes scatter more or less than they claim, and are scaled to what they show. Angles that are plainly wrong are left
    out one by one. `tied` (N,): the flight's keyframes that have links; `miss_m` (N, 3): their
    cameras' distance from telemetry's places.
    """
    stated_m, stated_rad = rows.stated_sigma_m, rows.stated_sigma_rad
    size = Rotation.from_matrix(
        rows.prior_rotations.transpose(0, 2, 1) @ rows.rotations
    ).magnitude()
    angled = np.isfinite(stated_rad[:, 2])
    contradicted = np.flatnonzero(
        tied & angled & (size > np.maximum(5 * stated_rad.max(axis=1), np.radians(15)))
    )
    place = np.ones(3)
    fixed = tied & np.isfinite(stated_m[:, 0])
    if fixed.sum() >= _ENOUGH:
        ratio = np.linalg.norm(miss_m[fixed, :2], axis=1) / stated_m[fixed, 0] / 1.1774
        place[:2] = np.clip(np.median(ratio), 0.5, 20.0)
    high = tied & np.isfinite(stated_m[:, 2])
    if high.sum() >= _ENOUGH:
        times = SIGMA_PER_MEDIAN_DEVIATION * np.median(np.abs(miss_m[high, 2]) / stated_m[high, 2])
        place[2] = np.clip(times, 0.5, 20.0)
    return Trust(place, contradicted)


def _noise(nodes: Nodes, pairs: Pairs, shared: Floats) -> LinkNoise:
    line = linearise(nodes, pairs, shared)
    length = np.linalg.norm(line.parallax, axis=-1)
    along = line.parallax / np.maximum(length, 1e-9)[..., None]
    miss_along = np.abs((line.residual_px * along).sum(-1))
    miss_across = np.abs(
        line.residual_px[..., 0] * along[..., 1] - line.residual_px[..., 1] * along[..., 0]
    )
    unused = pairs.weight <= 0
    with np.errstate(all="ignore"):
        across = SIGMA_PER_MEDIAN_DEVIATION * np.nanmedian(
            np.where(unused, np.nan, miss_across), axis=1
        )
        sigma_along = SIGMA_PER_MEDIAN_DEVIATION * np.nanmedian(
            np.where(unused, np.nan, miss_along), axis=1
        )
        reach = np.nanmedian(np.where(unused, np.nan, length), axis=1)
    return LinkNoise(
        across, np.sqrt(np.maximum(sigma_along**2 - across**2, 0)) / np.maximum(reach, 1e-6)
    )
