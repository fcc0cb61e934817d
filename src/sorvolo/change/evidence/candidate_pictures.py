"""The pictures of one candidate for a change: the best of both dates, and its outline by the majority of masks."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from sorvolo.change.evidence.cells import CellWindow
from sorvolo.change.shape.outlines import measures, outline_of
from sorvolo.change.shape.patches import Cut, PatchWindow, cut, moved, patch_of
from sorvolo.change.shape.shadows import ThingSettings, things_of
from sorvolo.errors import GeometryError
from sorvolo.geometry.arrays import Floats, Mask, Matrix3, PointsM
from sorvolo.geometry.homography import apply_homography
from sorvolo.survey.findings import Change, ComparedView, Patch

_MOST_VOTES = 250  # a byte counts them


@dataclass(frozen=True)
class PictureSettings:
    """Which views' pictures a candidate keeps, and how masks make its outline (before 0014; time 0019)."""

    better: float = 1.15  # times as good a view's pictures must be to replace older ones
    good: float = 0.75  # quality, 0 to 1, beyond which no better pictures are searched for
    most_px: int = 512  # longest side of a picture
    enough_votes: int = 40  # masks; more hardly move the outline
    least_majority: float = (
        0.3  # of the area of its cells: if masks agree on less, the cells are the outline
    )
    a_view: int = 6  # cut anew at most, which bounds the time a view takes ...
    most_a_view: int = 30  # ... and as many where views are seldom: there is more time
    views_s: float = 5.0  # views a second up to which there is time for more than `a_view`

    def for_view(self, waited_s: float) -> int:
        """How many pictures there is time for, so long after the last view."""
        return int(np.clip(self.a_view * self.views_s * waited_s, self.a_view, self.most_a_view))


class Pictures:
    """The ground of a candidate on both dates. Only `show` and `vote` change it."""

    def __init__(self, settings: PictureSettings = PictureSettings()) -> None:
        self._settings = settings
        self._window: PatchWindow | None = None
        self._best: Cut | None = None
        self._quality = 0.0
        self._votes = 0
        self._yes: NDArray[np.uint8] = np.zeros((0, 0), np.uint8)
        self._asked: NDArray[np.uint8] = np.zeros((0, 0), np.uint8)

    @property
    def size_px(self) -> int:
        """Pixels of a picture."""
        return 0 if self._window is None else self._window.width_px * self._window.height_px

    def gain(self, low_m: Floats, high_m: Floats, view: ComparedView) -> float:
        """How much better, as a factor, the view shows a box of ground; infinite if the pictures have to grow."""
        if self._window is None or self._best is None or not self._window.holds(low_m, high_m):
            return np.inf
        if self._quality > self._settings.good:
            return 0.0
        return quality(view, low_m, high_m) / max(self._quality, 1e-9)

    @property
    def wants_votes(self) -> bool:
        """Whether more masks would make the outline better."""
        return self._votes < self._settings.enough_votes

    def show(self, view: ComparedView, low_m: Floats, high_m: Floats, m_per_px: float) -> None:
        """Take the view's pictures of the box of ground if they are better, or wherever there were none."""
        window = self._grow(low_m, high_m, m_per_px)
        new, good = cut(view, window), quality(view, low_m, high_m)
        if self._best is None:
            self._best, self._quality = new, good
        elif good > self._settings.better * self._quality:
            self._best, self._quality = new.over(self._best), good
        else:
            self._best = self._best.over(new)

    def vote(self, site_from_image: Matrix3, changed: NDArray[np.uint8], valid: Mask) -> None:
        """Count one view's mask, pixel by pixel, towards the outline."""
        if self._window is None or self._votes >= _MOST_VOTES:
            return
        self._votes += 1
        patch_from_image = np.linalg.inv(self._window.site_from_patch) @ site_from_image
        size = self._window.size_px
        self._yes += (
            cv2.warpPerspective(changed, patch_from_image, size, flags=cv2.INTER_LINEAR) >= 128
        )
        self._asked += (
            cv2.warpPerspective(
                valid.view(np.uint8), patch_from_image, size, flags=cv2.INTER_NEAREST
            )
            > 0
        )

    def outline_m(
        self, window: CellWindow, cells: Mask, cell_m: float, join_m: float
    ) -> PointsM | None:
        """(N, 2) the outline: what most masks call changed, on or beside the candidate's `cells` in a window; that of
        the cells alone if masks agree on too little."""
        majority = self._majority(window, cells, cell_m)
        if majority is not None and self._window is not None:
            own = self._window
            tolerance_px = max(0.5 * cell_m / own.m_per_px, 0.5)
            return outline_of(majority, own.site_from_patch, tolerance_px, join_m / own.m_per_px)
        return outline_of(cells, window.site_from_cell(cell_m), 0.5, join_m / cell_m)

    def patch(self, outline_m: PointsM) -> Patch:
        """The record of the pictures. Raises GeometryError if no view showed any."""
        if self._window is None or self._best is None:
            raise GeometryError("a candidate without pictures has no record")
        return patch_of(self._window, self._best, outline_m)

    def parted(
        self,
        whole: Change,
        window: CellWindow,
        cells: Mask,
        cell_m: float,
        join_m: float,
        settings: ThingSettings,
    ) -> list[Change]:
        """The records of the things that `whole` holds, the largest first, all under its id; `whole` if it is one."""
        majority = self._majority(window, cells, cell_m)
        own, best = self._window, self._best
        if majority is None or own is None or best is None:
            return [whole]
        things = things_of(whole.patch, whole.kind, majority, settings)
        tolerance_px = max(0.5 * cell_m / own.m_per_px, 0.5)
        parts = []
        for mask, kind in things:
            outline_m = outline_of(mask, own.site_from_patch, tolerance_px, join_m / own.m_per_px)
            if len(things) < 2 or outline_m is None:
                return [whole]
            low_m, high_m = outline_m.min(axis=0), outline_m.max(axis=0)
            around = PatchWindow.around(low_m, high_m, own.m_per_px, self._settings.most_px)
            near = best.moved(around, own)
            size = measures(outline_m)
            parts.append(
                replace(
                    whole,
                    kind=kind,
                    outline_m=outline_m,
                    area_m2=size.area_m2,
                    length_m=size.length_m,
                    patch=patch_of(around, near, outline_m),
                )
            )
        return parts

    def _grow(self, low_m: Floats, high_m: Floats, m_per_px: float) -> PatchWindow:
        """The window, large enough for a box of ground; what is known moves along."""
        old = self._window
        if old is not None and old.holds(low_m, high_m):
            return old
        window = self._window = PatchWindow.around(low_m, high_m, m_per_px, self._settings.most_px)
        if old is None or self._best is None:
            self._yes = np.zeros((window.height_px, window.width_px), np.uint8)
            self._asked = np.zeros_like(self._yes)
        else:
            self._yes, self._asked = moved(self._yes, window, old), moved(self._asked, window, old)
            self._best = self._best.moved(window, old)
        return window

    def _majority(self, cell_window: CellWindow, cells: Mask, cell_m: float) -> Mask | None:
        """What most masks call changed, on or beside the cells, in the pictures; None if that is hardly anything."""
        window = self._window
        if window is None or not self._votes:
            return None
        padded = cv2.copyMakeBorder(
            cells.astype(np.uint8), 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=0
        )
        grown = cv2.dilate(padded, np.ones((3, 3), np.uint8))
        cells_from_padded = np.array([[1, 0, -1], [0, 1, -1], [0, 0, 1.0]])
        site_from_padded = cell_window.site_from_cell(cell_m) @ cells_from_padded
        patch_from_cells = np.linalg.inv(window.site_from_patch) @ site_from_padded
        near = (
            cv2.warpAffine(grown, patch_from_cells[:2], window.size_px, flags=cv2.INTER_NEAREST) > 0
        )
        majority = np.asarray((2 * self._yes.astype(np.int16) > self._asked) & near)
        least_m2 = self._settings.least_majority * np.count_nonzero(cells) * cell_m**2
        return majority if np.count_nonzero(majority) * window.m_per_px**2 >= least_m2 else None


def quality(view: ComparedView, low_m: Floats, high_m: Floats) -> float:
    """How well a view shows a box of ground: the more central and the less oblique the better, half if cut off."""
    height, width = view.changed.shape
    corners = np.array(
        [[low_m[0], low_m[1]], [high_m[0], low_m[1]], [high_m[0], high_m[1]], [low_m[0], high_m[1]]]
    )
    pixels = apply_homography(np.linalg.inv(view.site_from_image), corners)
    if not np.isfinite(pixels).all():
        return 1e-3
    off = np.abs(pixels.mean(axis=0) / [width, height] - 0.5).max()
    is_whole = (pixels >= 0).all() and (pixels < [width, height]).all()
    to_camera = view.camera_m - np.append(corners.mean(axis=0), 0.0)
    upright = float(to_camera[2] / max(np.linalg.norm(to_camera), 1e-9))
    return float(max(1 - 1.4 * off, 0.05) * max(upright, 0.05) * (1.0 if is_whole else 0.5))
