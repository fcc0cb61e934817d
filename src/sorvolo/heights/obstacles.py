"""What surely stands in the way: from a coarse height model, which heights of a place a camera does not see."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from sorvolo.geometry.arrays import Floats32, Mask, PointsM, Vector3, square
from sorvolo.heights.lattice import Lattice
from sorvolo.heights.views import View, inside

_TIMES = 2  # as coarse as the cells that are asked about
_SAMPLES = 16  # to a side of a window


_MARGIN_CELLS = 1.5  # below the line of sight, down to which a place is seen all the same
_LEAST_CELLS = 4.0  # from lowest to highest: less than that hides nothing
_AROUND_CELLS = 40  # about a window, within which things are looked for


@dataclass(frozen=True, eq=False)
class Obstacles:
    """Heights `up_m` (H, W) float32 without holes over a lattice, of what surely stands there."""

    lattice: Lattice
    up_m: Floats32

    @classmethod
    def surely(cls, lattice: Lattice, up_m: Floats32, patch_cells: int) -> "Obstacles":
        """What surely stands by a height model, (H, W), NaN in holes, made with patches of so many cells.

        Beside an edge such a model is as high as the edge for up to half a patch: only that is sure which stands
        everywhere around, and in holes nothing.
        """
        known = np.isfinite(up_m)
        if not known.any():
            return cls(lattice, np.zeros(up_m.shape, np.float32))
        around = square(patch_cells)
        low = cv2.erode(
            np.where(known, up_m, np.inf).astype(np.float32), around, borderValue=np.inf
        )
        return cls(lattice, np.where(np.isfinite(low), low, np.nanmin(up_m)).astype(np.float32))

    def hidden_below_m(self, window: Lattice, eye_m: Vector3) -> Floats32 | None:
        """(H, W) below which height a camera does not see the cells of a window, -inf where it does; None: sees all.

        Where the camera sees what stands at a cell, nothing below that is hidden by anything else.
        """
        if not self._rises(window):
            return None
        coarse = window.coarser(_TIMES)
        lowest = self._lowest_seen_m(coarse, eye_m)
        lowest[self._on(coarse) >= lowest] = -np.inf
        if np.isneginf(lowest).all():
            return None
        whole = np.repeat(np.repeat(lowest, _TIMES, axis=0), _TIMES, axis=1)
        return np.ascontiguousarray(whole[: window.height, : window.width])

    def shown(self, window: Lattice, views: Sequence[View]) -> tuple[PointsM, Mask]:
        """Places all over a window, (P, 3) on what stands, and which of the views show each, (V, P)."""
        coarse = window.coarser(max(1, min(window.shape) // _SAMPLES))
        up_m = self._on(coarse)
        places = np.dstack([coarse.points_m(), up_m]).reshape(-1, 3)
        shown = np.array([inside(view.pixels_from_site(places), view.camera) for view in views])
        if self._rises(window):
            for row in np.flatnonzero(shown.any(axis=1)).tolist():
                shown[row] &= (
                    up_m >= self._lowest_seen_m(coarse, views[row].site_from_camera.translation_m)
                ).ravel()
        return places, shown

    def _lowest_seen_m(self, window: Lattice, eye_m: Vector3) -> Floats32:
        """(H, W) how low the cells of a window may lie, the margin included, and still be seen from a camera."""
        column, row = np.arange(window.width), np.arange(window.height)[:, None]
        cells = np.linalg.inv(self.lattice.site_from_cells) @ window.site_from_cells
        x, y = (
            np.asarray(each[0] * column + (each[1] * row + each[2]), np.float32)
            for each in cells[:2]
        )
        at = self.lattice.cells_from_site(eye_m[None, :2])[0]
        dx, dy = np.float32(at[0]) - x, np.float32(at[1]) - y
        far = np.maximum(np.hypot(dx, dy), np.float32(1e-3))
        dx, dy = dx / far, dy / far
        lowest = np.full(x.shape, -np.inf, np.float32)
        low_m = float(self.up_m.min())
        high_m = float(self.up_m.max())
        eye_up_m = np.float32(eye_m[2])
        reach = float(far.max()) * min((high_m - low_m) / max(float(eye_up_m) - high_m, 1e-3), 1.0)
        step = _MARGIN_CELLS
        while step < reach:
            stands = cv2.remap(
                self.up_m,
                x + dx * step,
                y + dy * step,
                cv2.INTER_LINEAR,
                borderMode=cv2.BORDER_CONSTANT,
                borderValue=low_m,
            )
            behind = stands - (eye_up_m - stands) * (
                step / np.maximum(far - step, np.float32(1e-3))
            )
            np.maximum(lowest, behind, out=lowest, where=far > step)
            step = max(step + 1.0, step * 1.06)
        lowest -= np.float32(_MARGIN_CELLS * self.lattice.cell_m)
        return lowest

    def _on(self, window: Lattice) -> Floats32:
        """(H, W) what stands at the cells of a window."""
        cells = np.linalg.inv(self.lattice.site_from_cells) @ window.site_from_cells
        return np.asarray(
            cv2.warpAffine(
                self.up_m,
                cells[:2],
                window.shape[::-1],
                flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
                borderMode=cv2.BORDER_REPLICATE,
            ),
            np.float32,
        )

    def _rises(self, window: Lattice) -> bool:
        """Whether anything in a window or around it may hide anything."""
        ends = window.site_from_cells @ np.array(
            [[0, window.width] * 2, [0, 0, window.height, window.height], [1] * 4]
        )
        cells = self.lattice.cells_from_site(ends[:2].T)
        low = np.maximum(np.floor(cells.min(axis=0)).astype(int) - _AROUND_CELLS, 0)
        high = np.maximum(np.ceil(cells.max(axis=0)).astype(int) + _AROUND_CELLS, 0)
        part = self.up_m[low[1] : high[1], low[0] : high[0]]
        return part.size > 0 and float(np.ptp(part)) > _LEAST_CELLS * self.lattice.cell_m
