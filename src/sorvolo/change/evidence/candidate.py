"""One change while views of it come in: its pictures, its outline by majority, and how sure it is by now."""

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from sorvolo.change.evidence.cells import CellWindow
from sorvolo.change.shape.kinds import kind_of
from sorvolo.change.shape.outlines import measures, outline_of
from sorvolo.change.shape.patches import Cut, PatchWindow, cut, moved, patch_of
from sorvolo.change.shape.shadows import things_of
from sorvolo.errors import GeometryError
from sorvolo.geometry.arrays import Floats, Mask, Matrix3, PointsM
from sorvolo.geometry.homography import apply_homography
from sorvolo.survey.findings import Change, ChangeKind, ComparedView

_MOST_PX = 512
_VOTING_VIEWS = 40  # more of them hardly move the outline
_BETTER = 1.15  # a view's pictures replace the older ones when it is so much better
_GOOD = 0.75  # quality beyond which no better pictures are looked for
_ASIDE = 0.15  # of the flying height: views from further aside count less
_LEAST_WEIGHT = 0.1
_NEVER_WHOLE = 0.5  # of the score is left of what all views show cut off, from places far apart ...
_FAR_APART = 0.5  # ... of the flying height; from nearer what leans over a rim looks alike in all of them
_ONE_PLACE = 0.05  # of the flying height: seen from no wider apart, a ghost of something tall looks the same


class GatheredChange:
    """All that views told of one change. `see`, `vote` and `show` change it."""

    def __init__(self, number: int, first_seen_ns: int) -> None:
        self.number = number
        self.is_told = False
        self.announced_ns = -1
        self.is_taken_back = False  # told, but it turned out to be nothing
        self.first_seen_ns = self.last_seen_ns = first_seen_ns
        self.views = self.asked = 0
        self._weight_for = self._weight_asked = 0.0
        self.weakness = 1.0  # factor of the score, for what too few views say
        self.calmness = 1.0  # factor of the score, for how calm the ground around is
        self.whole = 0  # views that showed all of it: in the others it ends at a rim
        self.held = 0  # views in which it seemed to move, or nobody could tell
        self.cells: CellWindow | None = None
        self._score_sum = 0.0
        self._residual_m_sum = 0.0
        self._places: list[Floats] = []
        self._camera_low = np.full(3, np.inf)
        self._camera_high = np.full(3, -np.inf)
        self._window: PatchWindow | None = None
        self._pictures: Cut | None = None
        self._quality = 0.0
        self._votes = 0
        self._yes: NDArray[np.uint8] = np.zeros((0, 0), np.uint8)
        self._asked_px: NDArray[np.uint8] = np.zeros((0, 0), np.uint8)
        self._kind: ChangeKind | None = None
        self._kind_outline: PointsM | None = None

    def see(
        self, time_ns: int, score: float, place_m: Floats | None, view: ComparedView | None, weight: float
    ) -> None:
        """One more view flagged it; `view` is None for one of those before it was found, whose pictures are gone.

        `weight` says how much this view counts in `share`; see `upright_weight`.
        """
        self.views += 1
        self.asked += 1
        self._weight_for += weight
        self._weight_asked += weight
        self._score_sum += score
        self.first_seen_ns, self.last_seen_ns = min(self.first_seen_ns, time_ns), max(self.last_seen_ns, time_ns)
        if place_m is not None and len(self._places) < 64:
            self._places.append(place_m)
        if view is not None:
            self._residual_m_sum += view.residual_px * view.m_per_px if np.isfinite(view.residual_px) else 0.0

    def from_camera(self, camera_m: Floats) -> None:
        """The camera's place (3,) in a view that flagged it."""
        self._camera_low = np.minimum(self._camera_low, camera_m)
        self._camera_high = np.maximum(self._camera_high, camera_m)

    def miss(self, weight: float) -> None:
        """One more view that could have shown it does not."""
        self.asked += 1
        self._weight_asked += weight

    def recount(self, views: int, asked: int) -> None:
        """Count anew what views said of it: `views` of `asked` flagged what is left of it."""
        views, asked = max(views, 1), max(asked, views, 1)
        self._score_sum *= views / max(self.views, 1)
        self._weight_for = self._weight_asked * views / asked
        self.whole = round(self.whole * views / max(self.views, 1))
        self._residual_m_sum *= views / max(self.views, 1)
        self.views, self.asked = views, asked

    @property
    def share(self) -> float:
        """The share of the views that show it, of those that could, each with its weight."""
        return self._weight_for / self._weight_asked if self._weight_asked else 1.0

    @property
    def score(self) -> float:
        """0 to 1: mean sureness of its boxes x (views that show it + 1) / (views that could + 2), which is the mean of
        a share under Bayes; halved if all of them looked from one place, less if few
        of them show all of it (at the rim walls lean in whole, and ends are no outlines), above all from places near
        each other, and on restless ground."""
        if not self.views:
            return 0.0
        score = self._score_sum / self.views * (self.views + 1) / (self.asked + 2) * self.weakness * self.calmness
        never_whole = _NEVER_WHOLE * min(self._heights_apart() / _FAR_APART, 1.0)
        wholeness = never_whole + (1 - never_whole) * min(2 * self.whole / self.views, 1.0)
        return float(np.clip(score * (0.5 if self.is_from_one_place else 1.0) * wholeness, 0, 1))

    @property
    def is_from_one_place(self) -> bool:
        """Whether all of several views that show it looked from one place, as from a drone that hovers."""
        return self.views > 1 and self._heights_apart() < _ONE_PLACE

    @property
    def flying_height_m(self) -> float:
        """The largest of the views that show it."""
        return max(float(self._camera_high[2]), 1e-6)

    def _heights_apart(self) -> float:
        """How far apart the views that show it were taken, in flying heights."""
        return float(np.hypot(*(self._camera_high - self._camera_low)[:2])) / self.flying_height_m

    def wants(self, low_m: Floats, high_m: Floats, view: ComparedView) -> float:
        """How much better, as a factor, the view's pictures are than those it has; infinite if it has to grow."""
        if self._window is None or not self._window.holds(low_m, high_m) or self._pictures is None:
            return np.inf
        if self._quality > _GOOD:
            return 0.0
        return quality(view, low_m, high_m) / max(self._quality, 1e-9)

    @property
    def still_votes(self) -> bool:
        """Whether more masks would make the outline better."""
        return self._votes < _VOTING_VIEWS

    def show(self, view: ComparedView, low_m: Floats, high_m: Floats, m_per_px: float) -> None:
        """Take the view's pictures of the box of ground if they are better, or wherever there were none."""
        old = self._window
        if old is None or not old.holds(low_m, high_m):
            self._window = PatchWindow.around(low_m, high_m, m_per_px, _MOST_PX)
            if old is not None and self._pictures is not None:
                self._yes = moved(self._yes, self._window, old)
                self._asked_px = moved(self._asked_px, self._window, old)
                self._pictures = Cut(
                    moved(self._pictures.before, self._window, old), moved(self._pictures.after, self._window, old)
                )
        window = self._window
        if window is None:
            raise GeometryError(f"change {self.number}: no ground to show")
        if not self._yes.size:
            self._yes = np.zeros((window.height_px, window.width_px), np.uint8)
            self._asked_px = np.zeros_like(self._yes)
        new, good = cut(view, window), quality(view, low_m, high_m)
        if self._pictures is None:
            self._pictures, self._quality = new, good
        elif good > _BETTER * self._quality:
            self._pictures, self._quality = new.over(self._pictures), good
        else:
            self._pictures = self._pictures.over(new)

    def vote(self, site_from_image: Matrix3, changed: NDArray[np.uint8], valid: Mask) -> None:
        """Count one view's mask, pixel by pixel, towards the outline."""
        if self._window is None or self._votes >= 250:
            return
        self._votes += 1
        patch_from_image = np.linalg.inv(self._window.site_from_patch) @ site_from_image
        size = self._window.size_px
        self._yes += cv2.warpPerspective(changed, patch_from_image, size, flags=cv2.INTER_LINEAR) >= 128
        self._asked_px += cv2.warpPerspective(valid.view(np.uint8), patch_from_image, size, flags=cv2.INTER_NEAREST) > 0

    def outline_m(self, cells: Mask, cell_m: float, join_m: float) -> PointsM | None:
        """(N, 2) its outline: what most masks call changed, on or beside its cells; by its cells alone if that is
        nothing. `cells` is the raster of its own cells in its window."""
        if self.cells is None:
            return None
        majority = self._majority(cells, cell_m)
        if majority is not None and self._window is not None:
            window = self._window
            tolerance_px = max(0.5 * cell_m / window.m_per_px, 0.5)
            return outline_of(majority, window.site_from_patch, tolerance_px, join_m / window.m_per_px)
        return outline_of(cells, self.cells.site_from_cell(cell_m), 0.5, join_m / cell_m)

    def _majority(self, cells: Mask, cell_m: float) -> Mask | None:
        """What most masks call changed, on or beside its cells, in its pictures; None if that is hardly anything."""
        window = self._window
        if self.cells is None or window is None or not self._votes:
            return None
        padded = cv2.copyMakeBorder(cells.astype(np.uint8), 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=0)
        grown = cv2.dilate(padded, np.ones((3, 3), np.uint8))
        cells_from_padded = np.array([[1, 0, -1], [0, 1, -1], [0, 0, 1.0]])
        site_from_cells = self.cells.site_from_cell(cell_m)
        patch_from_cells = np.linalg.inv(window.site_from_patch) @ site_from_cells @ cells_from_padded
        near = cv2.warpAffine(grown, patch_from_cells[:2], window.size_px, flags=cv2.INTER_NEAREST) > 0
        majority = np.asarray((2 * self._yes.astype(np.int16) > self._asked_px) & near)
        is_enough = np.count_nonzero(majority) * window.m_per_px**2 >= 0.3 * np.count_nonzero(cells) * cell_m**2
        return majority if is_enough else None

    def parted(self, whole: Change, cells: Mask, cell_m: float, join_m: float) -> list[Change]:
        """The records of the things that `whole` holds, the largest first, all under its id; `whole` if it is one."""
        majority = self._majority(cells, cell_m)
        old, pictures = self._window, self._pictures
        if majority is None or old is None or pictures is None:
            return [whole]
        things = things_of(whole.patch, whole.kind, majority)
        tolerance_px = max(0.5 * cell_m / old.m_per_px, 0.5)
        parts = []
        for mask, kind in things:
            outline_m = outline_of(mask, old.site_from_patch, tolerance_px, join_m / old.m_per_px)
            if len(things) < 2 or outline_m is None:
                return [whole]
            window = PatchWindow.around(outline_m.min(axis=0), outline_m.max(axis=0), old.m_per_px, _MOST_PX)
            near = Cut(moved(pictures.before, window, old), moved(pictures.after, window, old))
            size = measures(outline_m)
            parts.append(replace(
                whole, kind=kind, outline_m=outline_m, area_m2=size.area_m2, length_m=size.length_m,
                patch=patch_of(window, near, outline_m),
            ))
        return parts

    def change(self, id_prefix: str, outline_m: PointsM, cell_m: float) -> Change:
        """The record of what is known of it.

        `sigma_m` is the root of the sum of squares of: the mean alignment residual on the ground; a cell's rounding,
        its side / sqrt(12); and the spread of its middle over the views, per axis, / sqrt(views).
        """
        if self._window is None or self._pictures is None:
            raise GeometryError(f"change {self.number}: nothing was seen of it")
        patch = patch_of(self._window, self._pictures, outline_m)
        if self._kind is None or self._kind_outline is None or self._kind_outline is not outline_m:
            self._kind, self._kind_outline = kind_of(patch), outline_m
        size = measures(outline_m)
        residual_m = self._residual_m_sum / max(self.views, 1)
        spread_m = float(np.sqrt(np.mean(np.var(self._places, axis=0)))) if len(self._places) > 1 else 0.0
        sigma_m = np.sqrt(residual_m**2 + cell_m**2 / 12 + spread_m**2 / max(len(self._places), 1))
        return Change(
            f"{id_prefix}-{self.number}", self._kind, self.score, outline_m, self.first_seen_ns, self.last_seen_ns,
            self.views, size.area_m2, size.length_m, float(sigma_m), patch, announced_ns=self.announced_ns,
        )


def joined(older: GatheredChange, younger: GatheredChange) -> GatheredChange:
    """The one change that two have become, under the older one's number; neither is to be used any more.

    What views said of the surer of both, and its pictures, count for it; what was told of either stays told.
    """
    surer, other = (younger, older) if younger.score > older.score else (older, younger)
    told = older if older.is_told else younger
    surer.number, surer.is_told, surer.announced_ns = older.number, told.is_told, told.announced_ns
    surer.first_seen_ns = min(older.first_seen_ns, younger.first_seen_ns)
    surer.last_seen_ns = max(older.last_seen_ns, younger.last_seen_ns)
    if surer.cells is None or other.cells is None:
        surer.cells = surer.cells or other.cells
    else:
        surer.cells = surer.cells.joined(other.cells)
    return surer


def upright_weight(camera_m: Floats, place_m: Floats) -> float:
    """How much a view's word on a place (2,) counts: most from right above, where also the map looks from.

    What stands tall leans away on either date when seen from aside, least from above; a change is there in all views.
    """
    aside = float(np.hypot(*(camera_m[:2] - place_m))) / max(float(camera_m[2]), 1e-6)
    return _LEAST_WEIGHT + float(np.exp(-0.5 * (aside / _ASIDE) ** 2))


def quality(view: ComparedView, low_m: Floats, high_m: Floats) -> float:
    """How well a view shows a box of ground: the more central and the less oblique the better, half if cut off."""
    height, width = view.changed.shape
    corners = np.array([[low_m[0], low_m[1]], [high_m[0], low_m[1]], [high_m[0], high_m[1]], [low_m[0], high_m[1]]])
    pixels = apply_homography(np.linalg.inv(view.site_from_image), corners)
    if not np.isfinite(pixels).all():
        return 1e-3
    off = np.abs(pixels.mean(axis=0) / [width, height] - 0.5).max()
    is_whole = (pixels >= 0).all() and (pixels < [width, height]).all()
    to_camera = view.camera_m - np.append(corners.mean(axis=0), 0.0)
    upright = float(to_camera[2] / max(np.linalg.norm(to_camera), 1e-9))
    return float(max(1 - 1.4 * off, 0.05) * max(upright, 0.05) * (1.0 if is_whole else 0.5))
