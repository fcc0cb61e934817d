"""Pictures of a piece of ground on both dates, cut from the views that show it."""

from dataclasses import dataclass

import cv2
import numpy as np

from sorvolo.change.outlines import mask_of
from sorvolo.geometry.arrays import (
    Bytes,
    Floats,
    ImageGray,
    ImageRGB,
    ImageRGBA,
    Matrix3,
    PointsM,
    shrunk,
)
from sorvolo.geometry.homography import apply_homography, resized
from sorvolo.survey.findings import ComparedView, Patch

_LEAST_MARGIN_M = (
    0.5  # of ground around a change in its pictures, for a person to recognise the place
)
_MARGIN_SHARE = 0.5  # of the change's longer side, where that is more
_LEAST_PART = 1e-6  # of a pixel: less is a rounding error


@dataclass(frozen=True)
class PatchWindow:
    """A piece of ground as a raster, north up; see `Patch`. Its edges lie on whole multiples of `m_per_px`."""

    west_m: float
    north_m: float
    m_per_px: float
    width_px: int
    height_px: int

    @classmethod
    def around(
        cls, low_m: PointsM, high_m: PointsM, m_per_px: float, most_px: int
    ) -> "PatchWindow":
        """The window of a box and of some ground around it; coarser than asked for where it would grow too large."""
        margin_m = max(_LEAST_MARGIN_M, _MARGIN_SHARE * float((high_m - low_m).max()))
        low_m, high_m = low_m - margin_m, high_m + margin_m
        coarse = m_per_px
        while float((high_m - low_m).max()) / coarse > most_px - 2:
            coarse *= 2
        west, south = np.floor(low_m / coarse)
        east, north = np.ceil(high_m / coarse)
        return cls(
            float(west * coarse),
            float(north * coarse),
            coarse,
            int(east - west),
            int(north - south),
        )

    @property
    def site_from_patch(self) -> Matrix3:
        """(3, 3) affine map from the window's pixels to site metres."""
        s = self.m_per_px
        return np.array(
            [[s, 0.0, self.west_m + s / 2], [0.0, -s, self.north_m - s / 2], [0.0, 0.0, 1.0]]
        )

    @property
    def size_px(self) -> tuple[int, int]:
        """Width, height."""
        return self.width_px, self.height_px

    def part(self, other: "PatchWindow") -> tuple[slice, slice, "PatchWindow"]:
        """The pixels of this window that another one touches: their rows, their columns, and the window of them alone.

        It has no pixel where the two lie apart.
        """
        s, reach_m = self.m_per_px, other.m_per_px * np.array(other.size_px)
        low = np.array([other.west_m - self.west_m, self.north_m - other.north_m])
        first = np.maximum(np.floor(low / s + _LEAST_PART), 0).astype(int)
        last = np.minimum(np.ceil((low + reach_m) / s - _LEAST_PART), self.size_px).astype(int)
        (left, top), (width, height) = first.tolist(), np.maximum(last - first, 0).tolist()
        part = PatchWindow(self.west_m + left * s, self.north_m - top * s, s, width, height)
        return slice(top, top + height), slice(left, left + width), part

    def holds(self, low_m: PointsM, high_m: PointsM) -> bool:
        """Whether a box lies inside, with a little ground around it."""
        spare_m = 0.3 * max(_LEAST_MARGIN_M, _MARGIN_SHARE * float((high_m - low_m).max()))
        west, north = self.west_m, self.north_m
        east, south = west + self.width_px * self.m_per_px, north - self.height_px * self.m_per_px
        return bool(
            low_m[0] - spare_m >= west
            and low_m[1] - spare_m >= south
            and high_m[0] + spare_m <= east
            and high_m[1] + spare_m <= north
        )


@dataclass(frozen=True, eq=False)
class Cut:
    """Both dates' pictures of a window, and their shade, as one view has them; 0 (alpha) where it knows nothing."""

    before: ImageRGBA
    after: ImageRGBA
    shade: ImageGray

    def over(self, older: "Cut") -> "Cut":
        """This cut, and the older one where this one knows nothing."""
        known, own = self.after[..., 3], (self.before, self.after, self.shade)
        before, after, shade = (
            np.asarray(cv2.copyTo(each, known, other.copy()), np.uint8)
            for each, other in zip(own, (older.before, older.after, older.shade))
        )
        return Cut(before, after, shade)

    def moved(self, new: "PatchWindow", old: "PatchWindow") -> "Cut":
        """The cut of one window as another one has it."""
        return Cut(
            moved(self.before, new, old), moved(self.after, new, old), moved(self.shade, new, old)
        )


def cut(view: ComparedView, window: PatchWindow) -> Cut:
    """The view's pictures of both dates, resampled to a window of the ground."""
    shrink = max(1, int(window.m_per_px / view.m_per_px))
    patch_from_image = np.linalg.inv(window.site_from_patch) @ view.site_from_image
    shade = cv2.warpPerspective(
        view.shade, patch_from_image, window.size_px, flags=cv2.INTER_NEAREST
    )
    valid = view.valid.view(np.uint8) * np.uint8(255)
    before, after = view.reference, view.image
    if shrink > 1:
        before, after, valid = (_shrunk(each, shrink) for each in (before, after, valid))
        patch_from_image = patch_from_image @ resized(shrink, shrink)
    known = (
        cv2.warpPerspective(valid, patch_from_image, window.size_px, flags=cv2.INTER_LINEAR) >= 250
    )

    def laid(image: ImageRGB) -> ImageRGBA:
        rgb = cv2.warpPerspective(
            image,
            patch_from_image,
            window.size_px,
            flags=cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
        return np.asarray(
            cv2.copyTo(cv2.cvtColor(rgb, cv2.COLOR_RGB2RGBA), known.view(np.uint8)), np.uint8
        )

    return Cut(
        laid(before), laid(after), np.asarray(cv2.copyTo(shade, known.view(np.uint8)), np.uint8)
    )


def moved(image: Bytes, new: PatchWindow, old: PatchWindow) -> Bytes:
    """A raster of one window as another window has it, 0 where they do not overlap."""
    new_from_old = np.linalg.inv(new.site_from_patch) @ old.site_from_patch
    return np.asarray(
        cv2.warpAffine(image, new_from_old[:2], new.size_px, flags=cv2.INTER_NEAREST), np.uint8
    )


def patch_of(window: PatchWindow, pictures: Cut, outline_m: PointsM) -> Patch:
    """The record of a change's pictures; the change itself is what lies inside its outline."""
    changed = mask_of(outline_m, window.site_from_patch, (window.height_px, window.width_px))
    place = window.west_m, window.north_m, window.m_per_px
    return Patch(*place, pictures.before, pictures.after, changed, pictures.shade)


def _shrunk(image: Bytes, factor: int) -> Bytes:
    rows, columns = image.shape[0] // factor, image.shape[1] // factor
    part = image[: rows * factor, : columns * factor]
    return shrunk(part, (columns, rows))


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
