"""Under which conditions ground was seen: how finely, how often, how sharp, in which light, on what ground."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from sorvolo.geometry.arrays import Floats, ImageRGB, Mask, PointsM, frozen
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.pose import Pose

CONDITIONS = ("resolution", "views", "single view", "blur", "texture", "light", "slant", "trees")
"""What a probability of detection is explained by: the columns of `Conditions.columns`."""

_CROWN_SHARE = 0.5  # of the views of a cell: crowns lean apart, ground does not
_FARTHEST = 3.0  # tangent of the angle from straight down: beyond it nothing is measured


@dataclass(frozen=True)
class LookSettings:
    """How ground is judged on a small picture."""

    look_m: float = 0.25  # along its pixels
    window: int = 5  # of them: 1.25 m, about a person and what is around
    green: float = 0.05  # excess green, (2 g - r - b) / (r + g + b), of plants ...
    plants: float = 0.6  # ... in this share of what is around
    rough: float = 0.2  # rms of lightness over its mean within 1.25 m: crowns are rough, lawns are not
    crown_m: float = 1.5  # over which a crown must be so
    gap_m: float = 6.0  # a gap among crowns that is no wider is forest: smooth or dark crowns, and their shade ...
    stand_m: float = 2.5  # ... where the crowns themselves are so wide: shrubs on a lawn and rims of things are none


@dataclass(frozen=True, eq=False)
class FrameLook:
    """One frame as the ground under it is judged: small maps of it, `scale` of its pixels each.

    `lightness` is in grey levels, 0 to 255; `texture` is the rms of lightness within 1.25 m over its mean there (no
    unit); `crowns` is whether trees or bushes show.
    """

    camera: Camera
    site_from_camera: Pose
    blur_px: float
    scale: float
    lightness: Floats
    texture: Floats
    crowns: Mask


@dataclass(frozen=True, eq=False)
class Conditions:
    """Of N places: `views` (N,) frames that show each, `columns` (N, 8) as CONDITIONS has them (NaN where unseen).

    They are logarithm of metres a pixel, logarithm of views, whether one view only, logarithm of the blur in metres,
    texture over lightness, lightness, tangent of the angle from straight down: means over the views; and `crowns` (N,),
    the share of the views in which trees or bushes stand there.
    """

    views: Floats
    columns: Floats
    crowns: Floats

    def __post_init__(self) -> None:
        for name in ("views", "columns", "crowns"):
            object.__setattr__(self, name, frozen(getattr(self, name)))

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

    def m_per_px(self) -> Floats:
        """(N,) the ground that a pixel covers, the geometric mean over the views."""
        return np.exp(self.columns[:, CONDITIONS.index("resolution")])


def look_at(
    image: ImageRGB, camera: Camera, site_from_camera: Pose, blur_px: float, settings: LookSettings = LookSettings()
) -> FrameLook:
    """The small maps of a frame (H, W, 3)."""
    m_per_px = max(float(site_from_camera.translation_m[2]), 1.0) / camera.fx_px
    look_m = settings.look_m
    scale = max(1.0, look_m / m_per_px)
    size = max(8, round(camera.width_px / scale)), max(8, round(camera.height_px / scale))
    small = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.float32)
    lightness = small.mean(axis=2)
    around = max(3, 2 * round(settings.window * look_m / max(m_per_px, look_m) / 2) + 1)
    mean = cv2.blur(lightness, (around, around))
    texture = np.sqrt(np.maximum(cv2.blur(lightness**2, (around, around)) - mean**2, 0)) / np.maximum(mean, 8)
    green = (2 * small[..., 1] - small[..., 0] - small[..., 2]) / np.maximum(small.sum(axis=2), 1)
    wide = max(3, 2 * round(settings.crown_m / max(m_per_px, look_m) / 2) + 1)
    is_plant = cv2.blur((green > settings.green).astype(np.float32), (wide, wide)) > settings.plants
    is_rough = cv2.blur(texture, (wide, wide)) > settings.rough
    return FrameLook(
        camera, site_from_camera, blur_px, camera.width_px / size[0], lightness, texture,
        _closed(is_plant & is_rough, settings, max(m_per_px, look_m)),
    )


def _closed(crowns: Mask, settings: LookSettings, m_per_px: float) -> Mask:
    """The crowns (H, W) with the narrow gaps between them, where they are those of a stand of trees."""
    gap_px, stand_px = (max(3, round(each / m_per_px)) for each in (settings.gap_m, settings.stand_m))
    gap, stand = (cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (each, each)) for each in (gap_px, stand_px))
    # beyond the picture the forest may go on: what lies at its edge is judged by what the picture shows
    wide = cv2.copyMakeBorder(crowns.astype(np.uint8), gap_px, gap_px, gap_px, gap_px, cv2.BORDER_REFLECT)
    closed = cv2.morphologyEx(cv2.morphologyEx(wide, cv2.MORPH_OPEN, stand), cv2.MORPH_CLOSE, gap)
    return np.asarray(crowns | (closed[gap_px:-gap_px, gap_px:-gap_px] > 0), bool)


def gather(looks: Sequence[FrameLook], places_m: PointsM | Sequence[Floats], reach_m: float) -> Conditions:
    """The conditions of places (N, 2); a frame counts that shows what reaches `reach_m` about a place whole."""
    places_m = np.reshape(np.asarray(places_m, np.float64), (-1, 2))
    count = len(places_m)
    views, sums, crowns = np.zeros(count), np.zeros((count, 5)), np.zeros(count)
    for look in looks:
        shown, pixels, m_per_px, slant = _projected(look, places_m, reach_m)
        if not shown.any():
            continue
        rows, columns = look.lightness.shape
        x, y = (pixels[shown] / look.scale).astype(int).clip(0, [columns - 1, rows - 1]).T
        near_m = m_per_px[shown]
        sums[shown] += np.column_stack([
            np.log(near_m), np.log(look.blur_px * near_m), look.texture[y, x], look.lightness[y, x], slant[shown],
        ])
        crowns[shown] += look.crowns[y, x]
        views[shown] += 1
    with np.errstate(invalid="ignore", divide="ignore"):
        means, share = sums / views[:, None], crowns / views
        log_views = np.where(views > 0, np.log(views), np.nan)
    columns = np.column_stack([
        means[:, 0], log_views, np.where(views > 0, views == 1, np.nan), means[:, 1], means[:, 2], means[:, 3],
        means[:, 4], share,
    ])
    return Conditions(views, columns, np.nan_to_num(share))


def _projected(look: FrameLook, places_m: PointsM, reach_m: float) -> tuple[Mask, Floats, Floats, Floats]:
    """Which places (N, 2) a frame shows whole; their pixels (N, 2), metres a pixel (N,), tangents of the slant (N,)."""
    camera, pose = look.camera, look.site_from_camera
    points = np.column_stack([places_m, np.zeros(len(places_m))])
    local = (points - pose.translation_m) @ pose.rotation
    pixels = camera.pixels_from_points(local)
    plain = camera.undistorted().pixels_from_points(local)
    distance_m = np.linalg.norm(points - pose.translation_m, axis=1)
    m_per_px = distance_m / camera.fx_px
    slant = np.hypot(*(points[:, :2] - pose.translation_m[:2]).T) / max(float(pose.translation_m[2]), 1e-3)
    size = np.array([camera.width_px, camera.height_px])
    margin = (reach_m / m_per_px + 2.0)[:, None]
    with np.errstate(invalid="ignore"):
        # far outside, a lens's polynomial folds back into the picture: there the plain camera decides
        near = ((plain > -0.3 * size) & (plain < 1.3 * size)).all(axis=1)
        shown = near & ((pixels >= margin) & (pixels <= size - 1 - margin)).all(axis=1) & (slant < _FARTHEST)
    return np.asarray(shown & (local[:, 2] > 0), bool), pixels, m_per_px, slant
