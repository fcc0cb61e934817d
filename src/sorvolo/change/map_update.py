"""The map brought up to date: changes' later pictures painted into its tiles; by how much it grew."""

from collections.abc import Iterable, Mapping, MutableMapping

import cv2
import numpy as np

from sorvolo.change.outlines import dilated
from sorvolo.geometry.arrays import Floats32, ImageRGBA, Matrix3, PointsM
from sorvolo.geometry.grid import SiteGrid, TileIndex
from sorvolo.geometry.homography import apply_homography, shifted
from sorvolo.survey.findings import Change, ChangeKind, Patch

# How a change is mixed into the map. Lengths in px of the tile.
_GROWN_PX = 6  # beyond the outline: covers the thing's blurred rim
_FEATHER_PX = 4  # over which old and new mix: no seam
# times brighter or darker, each channel: more is another surface, not another light
_MOST_GAIN = 1.6
_LEAST_RING_PX = 50  # of unchanged ground around, in px of the patch: of fewer no gain is taken


def is_painted(change: Change) -> bool:
    """Whether a change belongs into the map: what moves does not."""
    return change.kind != ChangeKind.MOVING


def paint_changes(
    changes: Iterable[Change], tiles: MutableMapping[TileIndex, ImageRGBA], site_grid: SiteGrid
) -> None:
    """Paint what changed into the map: only the tiles that it touches become new."""
    for change in changes:
        if not is_painted(change):
            continue
        grid_from_site = site_grid.grid_from_site_affine(change.outline_m.mean(axis=0), 50.0)
        height, width = change.patch.changed.shape
        corners = np.array([[0.0, 0.0], [width, 0.0], [width, height], [0.0, height]]) - 0.5
        outline = apply_homography(grid_from_site @ change.patch.site_from_patch, corners)
        for index in sorted(site_grid.grid.tiles_touched(outline)):
            if index in tiles:
                old = tiles[index]
                new = patched(old, site_grid.grid.tile_window(index), grid_from_site, change.patch)
                if new is not old:
                    tiles[index] = new


def grown_m2(
    outlines_m: Iterable[PointsM],
    before: Mapping[TileIndex, ImageRGBA],
    after: Mapping[TileIndex, ImageRGBA],
    site_grid: SiteGrid,
) -> float:
    """Ground in the tiles under these outlines that the map shows `after` and did not show `before`."""
    outlines = [site_grid.grid_from_site(each) for each in outlines_m]
    touched = frozenset[TileIndex]().union(
        *(site_grid.grid.tiles_touched(outline) for outline in outlines)
    )
    grown = sum(_seen_px(after, each) - _seen_px(before, each) for each in touched)
    return grown * site_grid.grid.m_per_px**2


def patched(
    tile_rgba: ImageRGBA,
    tile_window: tuple[int, int, int, int],
    grid_from_site: Matrix3,
    patch: Patch,
) -> ImageRGBA:
    """The tile with the patch's changed region as the flight saw it; the very same tile if nothing of it changes.

    `tile_window` is x0, y0, x1, y1 of the tile in grid pixels, `grid_from_site` (3, 3) the affine map from site metres
    to the grid. Only the changed region, grown by a few pixels, is painted, its channels multiplied by the gain that
    makes the unchanged ground around it alike, and mixed in over a few pixels. Alpha never gets less; pixels outside
    stay as they are.
    """
    x0, y0, x1, y1 = tile_window
    tile_from_grid = shifted(-x0, -y0)
    tile_from_patch = (tile_from_grid @ grid_from_site @ patch.site_from_patch)[:2]
    scale = float(np.sqrt(abs(np.linalg.det(tile_from_patch[:, :2]))))
    grow = max(1, round(_GROWN_PX / scale))
    weight = _weight(patch, grow, max(1, round(_FEATHER_PX / scale)))
    size = (x1 - x0, y1 - y0)
    laid_weight = cv2.warpAffine(weight, tile_from_patch, size, flags=cv2.INTER_LINEAR)
    known = (
        cv2.warpAffine(patch.after[..., 3], tile_from_patch, size, flags=cv2.INTER_LINEAR) >= 250
    )
    touched = (laid_weight > 1 / 512) & known
    if not touched.any():
        return tile_rgba
    laid = cv2.warpAffine(
        patch.after[..., :3],
        tile_from_patch,
        size,
        flags=cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    ).astype(np.float32)
    laid *= _gains(patch, grow)
    share = laid_weight[..., None].copy()
    share[tile_rgba[..., 3] == 0] = 1.0  # nothing there to mix with
    mixed = tile_rgba[..., :3] * (1 - share) + laid * share
    result = tile_rgba.copy()
    result[touched, :3] = np.clip(np.rint(mixed[touched]), 0, 255).astype(np.uint8)
    result[touched, 3] = 255
    return result


def _seen_px(tiles: Mapping[TileIndex, ImageRGBA], index: TileIndex) -> int:
    return int(np.count_nonzero(tiles[index][..., 3])) if index in tiles else 0


def _weight(patch: Patch, grow: int, feather: int) -> Floats32:
    """(height, width) 1 in the changed region and a little around, falling to 0 over the feather."""
    outside = np.where(patch.changed, 0, 1).astype(np.uint8)
    if outside.all():
        return np.zeros(outside.shape, np.float32)
    distance = cv2.distanceTransform(outside, cv2.DIST_L2, 5)
    weight = np.clip((grow + feather - distance) / feather, 0, 1).astype(np.float32)
    # the patch's own rim must not become an edge in the map
    weight[[0, -1]], weight[:, [0, -1]] = 0, 0
    return weight


def _gains(patch: Patch, grow: int) -> Floats32:
    """(3,) what the later picture's channels are multiplied with to look like the map's ground around the change."""
    ring = (
        ~dilated(patch.changed, 2 * grow + 1)
        & (patch.before[..., 3] > 0)
        & (patch.after[..., 3] > 0)
    )
    if np.count_nonzero(ring) < _LEAST_RING_PX:
        return np.ones(3, np.float32)
    before = np.median(patch.before[ring][:, :3], axis=0) + 1.0
    after = np.median(patch.after[ring][:, :3], axis=0) + 1.0
    return np.clip(before / after, 1 / _MOST_GAIN, _MOST_GAIN).astype(np.float32)
