"""Under which conditions ground was seen: how finely, how often, how sharp, in which light, on what ground."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from sorvolo.geometry.arrays import (
    Floats,
    Floats16,
    ImageRGB,
    Mask,
    PointsM,
    Vector3,
    frozen,
    shrunk,
)
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.ground import footprint, is_on_ground
from sorvolo.geometry.pose import Pose

_Grey = NDArray[np.float32]


# Metres on the ground over which crowns are recognised: each by choice, since only what all of them give together was
# measured.
_LEAF_M = 0.1  # along a pixel on which leaves show ...
_LEAVES_M = 0.5  # ... and over which their roughness is taken
_AROUND_M = 1.25  # over which a wood's roughness is taken
_EVEN_M = 0.75  # over which lightness is taken for shadows: grass in one has lighter spots
_SHADOWS_M = (1.0, 2.0, 4.0)  # the widths of shadows that are followed to what throws them
_CROWN_M = 1.5  # the narrowest crown, and over which it must be so
_WOOD_M = 8.0  # the narrowest wood: shadows of single trees are narrower
# a gap among crowns that is no wider is forest: smooth or dark crowns, and their shade ...
_GAP_M = 6.0
# ... where the crowns themselves are so wide: shrubs on a lawn and rims of things are none
_STAND_M = 2.5

# How crowns are recognised on a small picture.
_GREEN = 0.05  # excess green, (2 g - r - b) / (r + g + b), of plants
_PLANTS = 0.6  # share of green ground around a place of plants; by choice
_LEAVES = 0.14  # rms of lightness within `_LEAVES_M` over its mean, or the frame's where lighter: lit crowns
_ROUGH = 0.2  # rms of lightness over its mean within `_AROUND_M`: woods, shadows too
_DARK = 0.6  # of the frame's lightness: shadows
# of a shadow's width: how far from within it, towards the sun, what throws it reaches
_THROWN = 2.5
_LEAST_GREY = 8.0  # grey levels: below, a mean is noise; by choice


def plants_in(small: _Grey, m_per_px: float) -> Mask:
    """(H, W) where a small colour picture (H, W, 3) shows plants."""
    green = (2 * small[..., 1] - small[..., 0] - small[..., 2]) / np.maximum(small.sum(axis=2), 1)
    wide = _odd_px(_CROWN_M, m_per_px)
    return np.asarray(cv2.blur((green > _GREEN).astype(np.float32), (wide, wide)) > _PLANTS, bool)


def crowns_in(
    image: ImageRGB,
    small: _Grey,
    image_m_per_px: float,
    m_per_px: float,
    sunward: Floats | None,
) -> Mask:
    """(H, W) where crowns show in a frame; `small` (H, W, 3) is its small picture, whose pixel covers `m_per_px`.

    `sunward` (2,) is the direction to the sun in the picture, x before y; None where it is unknown or straight above:
    then crowns that are as smooth as grass go unseen.
    """
    lightness = small.mean(axis=2)
    usual = max(float(np.median(lightness)), _LEAST_GREY)
    plants, wide = plants_in(small, m_per_px), _odd_px(_CROWN_M, m_per_px)
    even = _odd_px(_EVEN_M, m_per_px)
    dark = cv2.blur(lightness, (even, even)) < _DARK * usual
    leaf_roughness = _leaf_roughness(image, image_m_per_px, usual, lightness.shape)
    leaves = cv2.blur(leaf_roughness, (wide, wide)) > _LEAVES
    single = _opened(plants & leaves & ~dark, _CROWN_M, m_per_px)
    if sunward is not None:
        thrower = plants & ~dark & _towards_sun(dark, sunward, m_per_px)
        single |= _opened(thrower, _SHADOWS_M[0], m_per_px)
    around = _odd_px(_AROUND_M, m_per_px)
    roughness = _rough(lightness, around, _LEAST_GREY)
    is_rough = cv2.blur(roughness, (wide, wide)) > _ROUGH
    wood = _wood(plants & (is_rough | single), m_per_px) & plants
    return _closed(single | wood, m_per_px)


def _leaf_roughness(
    image: ImageRGB, m_per_px: float, usual: float, shape: tuple[int, ...]
) -> _Grey:
    """The roughness of leaves, laid on a small picture of (H, W)."""
    scale = max(1.0, _LEAF_M / m_per_px)
    size = max(8, round(image.shape[1] / scale)), max(8, round(image.shape[0] / scale))
    fine = np.asarray(shrunk(image, size), np.float32).mean(axis=2)
    around = _odd_px(_LEAVES_M, max(m_per_px, _LEAF_M))
    # over the frame's lightness where it is darker there: shadows are rough over their own mean by their rims alone
    rough = _rough(fine, around, usual)
    return np.asarray(shrunk(rough, (shape[1], shape[0])), np.float32)


def _towards_sun(dark: Mask, sunward: Floats, m_per_px: float) -> Mask:
    """(H, W) where what throws the shadows may stand: about as wide as they are, on their sunny side."""
    found = np.zeros_like(dark)
    for width_m in _SHADOWS_M:
        reach_px = max(1, round(_THROWN * width_m / m_per_px))
        line = np.zeros((2 * reach_px + 1, 2 * reach_px + 1), np.uint8)
        end_x, end_y = (round(reach_px - reach_px * float(each)) for each in sunward)
        cv2.line(line, (reach_px, reach_px), (end_x, end_y), 1)
        found |= cv2.dilate(_opened(dark, width_m, m_per_px).astype(np.uint8), line) > 0
    return found


def _wood(rough: Mask, m_per_px: float) -> Mask:
    """The wide parts of rough plants, with the narrow gaps in them."""
    wide, spare = _widened(rough, round(_WOOD_M / m_per_px))
    closed = cv2.morphologyEx(wide, cv2.MORPH_CLOSE, _disc(_STAND_M, m_per_px))
    return _opened(closed > 0, _WOOD_M, m_per_px)[spare:-spare, spare:-spare]


def _closed(crowns: Mask, m_per_px: float) -> Mask:
    """The crowns (H, W) with the narrow gaps between them, where they are those of a stand of trees."""
    wide, spare = _widened(crowns, max(3, round(_GAP_M / m_per_px)))
    stand = _opened(wide > 0, _STAND_M, m_per_px).astype(np.uint8)
    closed = cv2.morphologyEx(stand, cv2.MORPH_CLOSE, _disc(_GAP_M, m_per_px))
    return np.asarray(crowns | (closed[spare:-spare, spare:-spare] > 0), bool)


def _widened(mask: Mask, spare: int) -> tuple[NDArray[np.uint8], int]:
    """A mask with so many pixels more on each side: beyond the picture the forest may go on, and what lies at its edge is
    judged by what the picture shows."""
    around = (spare, spare, spare, spare)
    return np.asarray(cv2.copyMakeBorder(mask.astype(np.uint8), *around, cv2.BORDER_REFLECT)), spare


def _opened(mask: Mask, width_m: float, m_per_px: float) -> Mask:
    return np.asarray(
        cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, _disc(width_m, m_per_px)) > 0, bool
    )


def _disc(width_m: float, m_per_px: float) -> NDArray[np.uint8]:
    side_px = max(3, round(width_m / m_per_px))
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side_px, side_px)), np.uint8)


def _rough(lightness: _Grey, around_px: int, least: float) -> _Grey:
    """Rms of lightness around each pixel over its mean there, or over `least` where it is darker."""
    mean = cv2.blur(lightness, (around_px, around_px))
    rms = np.sqrt(np.maximum(cv2.blur(lightness**2, (around_px, around_px)) - mean**2, 0))
    return rms / np.maximum(mean, least)


def _odd_px(width_m: float, m_per_px: float) -> int:
    return max(3, 2 * round(width_m / m_per_px / 2) + 1)


CONDITIONS = ("resolution", "views", "single view", "blur", "texture", "light", "slant", "trees")
"""What a probability of detection is explained by: the columns of `Conditions.columns`."""

_CROWN_SHARE = 0.5  # of the views of a cell: crowns lean apart, ground does not
_RAISED_M = 2.0  # above the ground: higher than people and cars
_LEAST_SUN = 0.1  # sine of the sun's height: lower, shadows are longer than pictures; or its way along the ground
_SPARE = 0.3  # of a frame's ground, beside it: its edges bend where the lens does
FARTHEST = 3.0  # tangent of the angle from straight down: beyond it nothing is measured

AboveGround: TypeAlias = Callable[[PointsM], tuple[Floats, Floats]]
"""How high the surface lies above the bare ground at places (N, 2), m, and its sigma, m; NaN where unknown."""


_LOOK_M = 0.25  # along its pixels
_WINDOW = 5  # of them: 1.25 m, about a person and what is around


@dataclass(frozen=True, eq=False)
class FrameLook:
    """One frame as the ground under it is judged: small maps of it, `scale` of its pixels each.

    `lightness` is in grey levels, 0 to 255; `texture` is the rms of lightness within 1.25 m over its mean there (no
    unit), both in half precision, for memory; `plants` is where it is green, `crowns` whether trees or bushes show.
    """

    camera: Camera
    site_from_camera: Pose
    blur_px: float
    scale: float
    lightness: Floats16
    texture: Floats16
    plants: Mask
    crowns: Mask


@dataclass(frozen=True, eq=False)
class Conditions:
    """Of N places: `views` (N,) frames that show each, `columns` (N, 8) as CONDITIONS has them (NaN where unseen).

    They are logarithm of metres a pixel, logarithm of views, whether one view only, logarithm of the blur in metres,
    texture over lightness, lightness, tangent of the angle from straight down: means over the views; and `crowns` (N,),
    the share of the views in which trees or bushes stand there. `roofs` (N,) is where something without leaves, and
    higher than people and cars, stands by the heights of the flight.
    """

    views: Floats
    columns: Floats
    crowns: Floats
    roofs: Mask

    def __post_init__(self) -> None:
        for name in ("views", "columns", "crowns"):
            object.__setattr__(self, name, frozen(getattr(self, name)))
        object.__setattr__(self, "roofs", frozen(self.roofs, np.bool_))

    @property
    def seen(self) -> Mask:
        """(N,) whether any frame shows it."""
        return np.asarray(self.views > 0, bool)

    @property
    def under_trees(self) -> Mask:
        """(N,) whether crowns hide the ground in most views."""
        return np.asarray(self.crowns > _CROWN_SHARE, bool)

    @property
    def beside_trees(self) -> Mask:
        """(N,) whether any view shows crowns there: they may hide some of the ground."""
        return np.asarray(self.crowns > 0, bool)

    def at(self, rows: NDArray[np.intp]) -> "Conditions":
        """Of M of the places, by their numbers (M,); below 0: of one that no frame shows."""
        known = rows >= 0
        return Conditions(
            np.where(known, self.views[rows], 0),
            np.where(known[:, None], self.columns[rows], np.nan),
            np.where(known, self.crowns[rows], 0),
            known & self.roofs[rows],
        )

    def m_per_px(self) -> Floats:
        """(N,) the ground that a pixel covers, the geometric mean over the views."""
        return np.exp(self.columns[:, CONDITIONS.index("resolution")])


def look_at(
    image: ImageRGB,
    camera: Camera,
    site_from_camera: Pose,
    blur_px: float,
    sun: Vector3 | None = None,
) -> FrameLook:
    """The small maps of a frame (H, W, 3); `sun` (3,) is the direction to the sun in the site, None: not known."""
    m_per_px = max(float(site_from_camera.translation_m[2]), 1.0) / camera.fx_px
    scale = max(1.0, _LOOK_M / m_per_px)
    small_m = max(m_per_px, _LOOK_M)
    size = max(8, round(camera.width_px / scale)), max(8, round(camera.height_px / scale))
    small = np.asarray(shrunk(image, size), np.float32)
    lightness = small.mean(axis=2)
    texture = _rough(lightness, _odd_px(_WINDOW * _LOOK_M, small_m), _LEAST_GREY)
    crowns = crowns_in(image, small, m_per_px, small_m, _sunward(site_from_camera, sun))
    return FrameLook(
        camera,
        site_from_camera,
        blur_px,
        camera.width_px / size[0],
        lightness.astype(np.float16),
        texture.astype(np.float16),
        plants_in(small, small_m),
        crowns,
    )


def _sunward(site_from_camera: Pose, sun: Vector3 | None) -> Floats | None:
    """(2,) the direction to the sun in a picture, of length 1; None where there is none."""
    if sun is None or sun[2] < _LEAST_SUN:
        return None
    direction = (site_from_camera.rotation.T @ np.array([sun[0], sun[1], 0.0]))[:2]
    length = float(np.hypot(*direction))
    return None if length < _LEAST_SUN else direction / length


def gather(
    looks: Iterable[FrameLook],
    places_m: PointsM | Sequence[Floats],
    reach_m: float,
    above: AboveGround | None = None,
) -> Conditions:
    """The conditions of places (N, 2); a frame counts that shows what reaches `reach_m` about a place whole.

    What stands higher than people and cars by `above` hides the ground as well as the crowns that the pictures show.
    """
    gathering = Gathering(places_m, reach_m, above)
    for look in looks:
        gathering.add(look)
    return gathering.conditions()


class Gathering:
    """Conditions of places, as `gather` takes them, while looks come one by one and none is kept."""

    def __init__(
        self, places_m: PointsM | Sequence[Floats], reach_m: float, above: AboveGround | None = None
    ) -> None:
        self._places_m = np.reshape(np.asarray(places_m, np.float64), (-1, 2))
        self._reach_m, self._above = reach_m, above
        count = len(self._places_m)
        self._views, self._sums = np.zeros(count), np.zeros((count, 5))
        self._crowns, self._plants = np.zeros(count), np.zeros(count)

    def add(self, look: FrameLook) -> None:
        """Count what one frame shows."""
        about = np.flatnonzero(_about(look, self._places_m))
        if not len(about):
            return
        shown, pixels, m_per_px, slant = _projected(look, self._places_m[about], self._reach_m)
        if not shown.any():
            return
        at = about[shown]
        rows, columns = look.lightness.shape
        x, y = (pixels[shown] / look.scale).astype(int).clip(0, [columns - 1, rows - 1]).T
        near_m = m_per_px[shown]
        self._sums[at] += np.column_stack(
            [
                np.log(near_m),
                np.log(look.blur_px * near_m),
                look.texture[y, x],
                look.lightness[y, x],
                slant[shown],
            ]
        )
        self._crowns[at] += look.crowns[y, x]
        self._plants[at] += look.plants[y, x]
        self._views[at] += 1

    def conditions(self) -> Conditions:
        """What the looks so far show."""
        views = self._views.copy()
        with np.errstate(invalid="ignore", divide="ignore"):
            means, share, green = (
                self._sums / views[:, None],
                self._crowns / views,
                self._plants / views,
            )
            log_views = np.where(views > 0, np.log(views), np.nan)
        roofs = np.zeros(len(views), bool)
        if self._above is not None and len(views):
            raised = _raised(*self._above(self._places_m)) & (views > 0)
            roofs = raised & (green <= _CROWN_SHARE)
            share = np.where(roofs, 0.0, np.where(raised, 1.0, share))
        columns = np.column_stack(
            [
                means[:, 0],
                log_views,
                np.where(views > 0, views == 1, np.nan),
                means[:, 1:],
                share,
            ]
        )
        return Conditions(views, columns, np.nan_to_num(share), roofs)


def _raised(above_m: Floats, sigma_m: Floats) -> Mask:
    """(N,) where something stands that hides who is under it.

    The opposite does not follow: under closed crowns nothing of the ground shows, and crowns may pass for it.
    """
    with np.errstate(invalid="ignore"):
        return np.asarray((above_m > _RAISED_M) & (above_m > 2 * sigma_m), bool)


def _about(look: FrameLook, places_m: PointsM) -> Mask:
    """Which places (N, 2) lie in the box around a frame's ground, a little wider: none that it shows is left out."""
    outline_m = footprint(look.camera, look.site_from_camera)
    if not is_on_ground(outline_m):
        return np.ones(len(places_m), bool)
    low, high = outline_m.min(axis=0), outline_m.max(axis=0)
    spare = _SPARE * (high - low)
    return np.asarray(((places_m >= low - spare) & (places_m <= high + spare)).all(axis=1), bool)


def _projected(
    look: FrameLook, places_m: PointsM, reach_m: float
) -> tuple[Mask, Floats, Floats, Floats]:
    """Which places (N, 2) a frame shows whole; their pixels (N, 2), metres a pixel (N,), tangents of the slant (N,)."""
    camera, pose = look.camera, look.site_from_camera
    points = np.column_stack([places_m, np.zeros(len(places_m))])
    local = (points - pose.translation_m) @ pose.rotation
    pixels = camera.pixels_from_points(local)
    plain = camera.undistorted().pixels_from_points(local)
    distance_m = np.linalg.norm(points - pose.translation_m, axis=1)
    m_per_px = distance_m / camera.fx_px
    slant = np.hypot(*(points[:, :2] - pose.translation_m[:2]).T) / max(
        float(pose.translation_m[2]), 1e-3
    )
    size = np.array([camera.width_px, camera.height_px])
    margin = (reach_m / m_per_px + 2.0)[:, None]
    with np.errstate(invalid="ignore"):
        # far outside, a lens's polynomial folds back into the picture: there the plain camera decides
        near = ((plain > -0.3 * size) & (plain < 1.3 * size)).all(axis=1)
        shown = (
            near
            & ((pixels >= margin) & (pixels <= size - 1 - margin)).all(axis=1)
            & (slant < FARTHEST)
        )
    return np.asarray(shown & (local[:, 2] > 0), bool), pixels, m_per_px, slant
