"""Heights with their sigma over a lattice, asked by place, and brought onto another lattice."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from sorvolo.errors import GeometryError, InputError
from sorvolo.geometry.arrays import Floats, Floats32, Mask, Matrix3, PointsM
from sorvolo.geometry.polygons import points_inside
from sorvolo.heights.lattice import Lattice

_MOST_POINTS = 200_000  # of a line: ten kilometres in steps of 5 cm


@dataclass(frozen=True, eq=False)
class HeightField:
    """`up_m` and `sigma_m` (H, W) float32 over a lattice, NaN in holes."""

    lattice: Lattice
    up_m: Floats32
    sigma_m: Floats32

    def __post_init__(self) -> None:
        if self.up_m.shape != self.lattice.shape or self.sigma_m.shape != self.lattice.shape:
            raise GeometryError(
                f"heights {self.up_m.shape} do not fit a lattice of {self.lattice.shape}"
            )

    def at(self, points_m: PointsM) -> tuple[Floats, Floats]:
        """(N,) heights and sigmas at site points, (N, 2), between cells; NaN outside and beside holes."""
        some = 1 << 20  # OpenCV takes no more than 32766 rows at a time
        bands = [
            self._bands_at(points_m[first : first + some])
            for first in range(0, max(len(points_m), 1), some)
        ]
        heights, sigmas = (np.concatenate(each) for each in zip(*bands))
        return heights, sigmas

    def on(self, lattice: Lattice, shift_m: Floats | None = None) -> "HeightField":
        """The same heights over another lattice, moved by (east, north), m."""
        points = lattice.points_m().reshape(-1, 2) - (np.zeros(2) if shift_m is None else shift_m)
        up_m, sigma_m = (each.reshape(lattice.shape).astype(np.float32) for each in self.at(points))
        return HeightField(lattice, up_m, sigma_m)

    def inside(self, polygons: Sequence[Sequence[PointsM]]) -> Mask:
        """(H, W) which cells lie within polygons of rings, site metres."""
        points = self.lattice.points_m().reshape(-1, 2)
        within = np.zeros(len(points), bool)
        for rings in polygons:
            within |= points_inside(rings, points)
        return within.reshape(self.lattice.shape)

    def _bands_at(self, points_m: PointsM) -> tuple[Floats, Floats]:
        side = 1024
        # none is a row as well
        padded = np.full((max(1, -(-len(points_m) // side)) * side, 2), 1e9)
        padded[: len(points_m)] = points_m
        cells = self.lattice.cells_from_site(padded).astype(np.float32).reshape(-1, side, 2)
        heights, sigmas = (
            cv2.remap(
                band, cells[..., 0], cells[..., 1], cv2.INTER_LINEAR, borderValue=float("nan")
            ).ravel()
            for band in (self.up_m, self.sigma_m)
        )
        return heights[: len(points_m)].astype(np.float64), sigmas[: len(points_m)].astype(
            np.float64
        )


def standing(surface: HeightField, ground: HeightField) -> tuple[Floats32, Matrix3]:
    """(H, W) what stands on the bare ground, m above it, 0 in holes, and the map from site metres to its cells.

    What lies within two sigma of the ground is ground.
    """
    above_m = surface.up_m - ground.up_m
    with np.errstate(invalid="ignore"):
        stands = above_m > 2 * surface.sigma_m
    cells_from_site: Matrix3 = np.asarray(
        np.linalg.inv(surface.lattice.site_from_cells), np.float64
    )
    return np.where(stands, above_m, 0).astype(np.float32), cells_from_site


def above_ground(
    surface: HeightField, ground: HeightField, points_m: PointsM
) -> tuple[Floats, Floats]:
    """(N,) how high the surface lies above the bare ground at site points, (N, 2), m, and its sigma; NaN in holes."""
    up_m, sigma_m = surface.at(points_m)
    bare_m, _ = ground.at(points_m)
    return up_m - bare_m, sigma_m


def along(points_m: PointsM, step_m: float) -> tuple[PointsM, Floats]:
    """(M, 2) points every `step_m` along a line through `points_m`, (N, 2), and their way from its start, (M,), m.

    Raises InputError for a line of more than 200,000 points.
    """
    lengths = np.linalg.norm(np.diff(points_m, axis=0), axis=1)
    ways = np.concatenate([[0.0], np.cumsum(lengths)])
    if not ways[-1] <= _MOST_POINTS * step_m:
        raise InputError(
            f"a line of {ways[-1] / 1000:,.1f} km in steps of {step_m:g} m; at most {_MOST_POINTS:,} points are taken: "
            "draw a shorter line, or give a longer step"
        )
    wanted = np.append(np.arange(0.0, ways[-1], step_m), ways[-1])
    return np.column_stack([np.interp(wanted, ways, points_m[:, axis]) for axis in (0, 1)]), wanted
