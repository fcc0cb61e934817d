"""The pose graph's keyframes and links as arrays that stay stacked while they grow, as the solver wants them."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sorvolo.geometry.arrays import Floats, Rows
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.pose import Pose
from sorvolo.mosaic.bundle import LINKS_AT_ONCE, Nodes, Pairs
from sorvolo.mosaic.shelf import Shelf, ShelvedRows
from sorvolo.survey.flight import CameraPrior
from sorvolo.survey.mosaic import Link

_UNKNOWN_SIGMA_M = (
    1e6  # stands in for an infinite sigma; its weight is nothing, its arithmetic finite
)
_FIRST_ROOM = 16  # rows; then they double


class _Columns:
    """Equally long columns, each (N, ...); appending costs the same however long they are."""

    def __init__(self, **shapes: tuple[type, tuple[int, ...]]) -> None:
        self._columns: dict[str, NDArray[Any]] = {
            name: np.zeros((_FIRST_ROOM, *shape), dtype) for name, (dtype, shape) in shapes.items()
        }
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def column(self, name: str) -> NDArray[Any]:
        """(N, ...) a view, good until the next `append` or `keep`."""
        return self._columns[name][: self._count]

    def append(self, **row: Any) -> None:
        """One value for each column."""
        if self._count == len(next(iter(self._columns.values()))):
            self._columns = {
                name: _with_twice_the_room(each) for name, each in self._columns.items()
            }
        for name, value in row.items():
            self._columns[name][self._count] = value
        self._count += 1

    def keep(self, chosen: NDArray[np.bool_]) -> None:
        """Drop the rows where `chosen` (N,) is False."""
        count = int(np.sum(chosen))
        for each in self._columns.values():
            each[:count] = each[: self._count][chosen]
        self._count = count


class NodeRows:
    """Where each keyframe stands and what telemetry reports of it; rows are views and may be written to."""

    def __init__(self) -> None:
        self._rows = _Columns(
            rotations=(float, (3, 3)),
            centres_m=(float, (3,)),
            prior_centres_m=(float, (3,)),
            prior_sigma_m=(float, (3,)),
            prior_rotations=(float, (3, 3)),
            prior_sigma_rad=(float, (3,)),
            own=(bool, ()),
        )

    def __len__(self) -> int:
        return len(self._rows)

    @property
    def rotations(self) -> Floats:
        """(N, 3, 3) site_from_camera."""
        return self._rows.column("rotations")

    @property
    def centres_m(self) -> Floats:
        """(N, 3)."""
        return self._rows.column("centres_m")

    @property
    def prior_centres_m(self) -> Floats:
        """(N, 3) by telemetry."""
        return self._rows.column("prior_centres_m")

    @property
    def prior_rotations(self) -> Floats:
        """(N, 3, 3) by telemetry."""
        return self._rows.column("prior_rotations")

    @property
    def stated_sigma_m(self) -> Floats:
        """(N, 3) as telemetry states it, infinite: not known."""
        return self._rows.column("prior_sigma_m")

    @property
    def stated_sigma_rad(self) -> Floats:
        """(N, 3) about the camera's own axes, infinite: not known."""
        return self._rows.column("prior_sigma_rad")

    @property
    def own(self) -> NDArray[np.bool_]:
        """(N,) bool: of the flight that is mapped."""
        return self._rows.column("own")

    def append(self, prior: CameraPrior, pose: Pose, *, own: bool) -> None:
        """A keyframe more, at `pose` for now."""
        self._rows.append(rotations=pose.rotation, centres_m=pose.translation_m, own=own)
        self.set_prior(len(self) - 1, prior)

    def set_prior(self, at: int, prior: CameraPrior) -> None:
        """Replace the telemetry of a keyframe."""
        self.prior_centres_m[at], self.stated_sigma_m[at] = prior.position_m, prior.position_sigma_m
        self.prior_rotations[at], self.stated_sigma_rad[at] = (
            prior.rotation,
            np.radians(prior.attitude_sigma_deg),
        )

    def nodes(
        self, place: Floats, attitude: Floats, contradicted: Rows, at: Rows | slice = slice(None)
    ) -> Nodes:
        """For the solver: stated sigmas times `place` and `attitude`, (3,) each, no angles where contradicted; all
        nodes, or those `at` some rows."""
        sigma_m, sigma_rad = self.stated_sigma_m[at] * place, self.stated_sigma_rad[at] * attitude
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


class LinkRows:
    """The links and their matched points; the points of older ones lie on the `shelf`, if there is one."""

    def __init__(
        self, pairs_per_link: int, independent_pairs: float, shelf: Shelf | None = None
    ) -> None:
        self._most, self._independent = pairs_per_link, independent_pairs
        self._rows = _Columns(
            old=(int, ()),
            new=(int, ()),
            pairs=(int, ()),
            points=(int, ()),
            focal_px=(float, ()),
            sigma_px=(float, ()),
            relief_m=(float, ()),
        )
        self._points = ShelvedRows("points", (2, pairs_per_link, 2), float, shelf)

    def __len__(self) -> int:
        return len(self._rows)

    @property
    def old(self) -> Rows:
        """(L,) node index."""
        return self._rows.column("old")

    @property
    def new(self) -> Rows:
        """(L,) node index."""
        return self._rows.column("new")

    @property
    def relief_m(self) -> Floats:
        """(L,) height of things above the ground."""
        return self._rows.column("relief_m")

    @property
    def sigma_px(self) -> Floats:
        """(L,) across the parallax."""
        return self._rows.column("sigma_px")

    def append(
        self, each: Link, old: tuple[int, Camera], new: tuple[int, Camera], sigma_px: float
    ) -> None:
        """A link more, between two nodes and their registration cameras; its relief is that of the others."""
        pick = np.arange(len(each.new_px))
        if len(pick) > self._most:
            pick = np.linspace(0, len(pick) - 1, self._most).round().astype(int)
        points = np.zeros((2, self._most, 2))
        points[0, : len(pick)] = _ideal(old[1], each.old_px[pick])
        points[1, : len(pick)] = _ideal(new[1], each.new_px[pick])
        self._rows.append(
            old=old[0],
            new=new[0],
            pairs=len(pick),
            points=len(self._points),
            focal_px=new[1].fx_px,
            sigma_px=sigma_px,
            relief_m=float(np.median(self.relief_m)) if len(self) else 0.1,
        )
        self._points.append(points)

    def keep(self, chosen: NDArray[np.bool_]) -> None:
        """Drop the links where `chosen` (L,) is False."""
        self._rows.keep(chosen)

    def of(self, chosen: Rows) -> Pairs:
        """The matched points of some links, each link's padded to the same number, for the solver."""
        old, new, pairs, points, focal_px, sigma_px, relief_m = (
            self._rows.column(name)[chosen]
            for name in ("old", "new", "pairs", "points", "focal_px", "sigma_px", "relief_m")
        )
        exists = np.arange(self._most) < pairs[:, None]
        weight = exists * np.minimum(1.0, self._independent / np.maximum(pairs, 1))[:, None]
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
