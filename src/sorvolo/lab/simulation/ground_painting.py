"""The painter's tools: a raster of ground in site metres, mixed coarsely and then detailed."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from sorvolo.geometry.arrays import Floats, ImageGray, ImageRGB, shrunk
from sorvolo.search.drawing.noise import FieldF32, fractal, layer

_COARSE = 4  # materials are mixed on a raster this many times coarser than the picture


@dataclass(frozen=True)
class GroundArea:
    """An upright rectangle of ground in site metres."""

    west_m: float
    south_m: float
    east_m: float
    north_m: float

    @classmethod
    def around(cls, points_m: Floats, margin_m: float) -> "GroundArea":
        """The area of points (N, 2), larger by a margin on each side."""
        low, high = points_m.min(axis=0) - margin_m, points_m.max(axis=0) + margin_m
        return cls(*low.tolist(), *high.tolist())

    @property
    def size_m(self) -> tuple[float, float]:
        """Width and height."""
        return self.east_m - self.west_m, self.north_m - self.south_m

    @property
    def corners_m(self) -> Floats:
        """(4, 2) from the south-west on, counter-clockwise."""
        return rectangle(self.west_m, self.south_m, self.east_m, self.north_m)


@dataclass(frozen=True, eq=False)
class GroundRaster:
    """A picture of the ground: the outer corner of its top-left pixel lies at (west_m, north_m), north is up.

    `vegetation` (height, width) uint8 is how much a pixel can move in the wind.
    """

    rgb: ImageRGB
    vegetation: ImageGray
    west_m: float
    north_m: float
    m_per_px: tuple[float, float]

    @property
    def area(self) -> GroundArea:
        """The ground that it shows."""
        height, width = self.rgb.shape[:2]
        return GroundArea(
            self.west_m,
            self.north_m - height * self.m_per_px[1],
            self.west_m + width * self.m_per_px[0],
            self.north_m,
        )

    @property
    def raster_from_site_matrix(self) -> Floats:
        """(3, 3) affine map from east, north to pixels."""
        mx, my = self.m_per_px
        return np.array(
            [[1 / mx, 0, -self.west_m / mx - 0.5], [0, -1 / my, self.north_m / my - 0.5], [0, 0, 1]]
        )

    def resampled(self, m_per_px: float) -> "GroundRaster":
        """The same ground averaged to coarser pixels; itself when its own are not finer."""
        height, width = self.rgb.shape[:2]
        new_width = round(width * self.m_per_px[0] / m_per_px)
        new_height = round(height * self.m_per_px[1] / m_per_px)
        if new_width >= width or new_height >= height:
            return self
        size = (new_width, new_height)
        return replace(
            self,
            rgb=shrunk(self.rgb, size),
            vegetation=shrunk(self.vegetation, size),
            m_per_px=(self.m_per_px[0] * width / new_width, self.m_per_px[1] * height / new_height),
        )


class GroundCanvas:
    """The ground while it is painted: a coarse mix of materials first, then fine strokes on the full raster."""

    def __init__(self, area: GroundArea, m_per_px: float, rng: Generator) -> None:
        self.area, self.m_per_px, self.rng = area, m_per_px, rng
        width, height = (int(np.ceil(side_m / m_per_px)) for side_m in area.size_m)
        self.size_px = width, height
        self.coarse_shape = (-(-height // _COARSE), -(-width // _COARSE))
        self.colour = np.zeros((*self.coarse_shape, 3), np.float32)
        self.grain = np.zeros(self.coarse_shape, np.float32)
        self.vegetation = np.zeros(self.coarse_shape, np.uint8)
        self.rgb: ImageRGB = np.zeros((1, 1, 3), np.uint8)
        rows, columns = np.mgrid[0 : self.coarse_shape[0], 0 : self.coarse_shape[1]].astype(
            np.float32
        )
        step = np.float32(m_per_px * _COARSE)
        self.east = area.west_m + (columns + 0.5) * step
        self.north = area.north_m - (rows + 0.5) * step

    def field(self, *scales_m: float) -> FieldF32:
        """Unit noise on the coarse raster, equal parts of these scales."""
        return fractal(
            self.rng, self.coarse_shape, self.m_per_px * _COARSE, scales_m, [1.0] * len(scales_m)
        )

    def lay(
        self,
        cover: FieldF32,
        colour: tuple[float, float, float],
        grain: float,
        mottle: FieldF32,
        is_plant: bool = False,
    ) -> None:
        """Cover the ground, where `cover` is 1, with a material of this colour, coarse mottle and fine grain."""
        share = np.clip(cover, 0, 1).astype(np.float32)
        material = np.array(colour, np.float32) * (1 + mottle[..., None])
        self.colour += (material - self.colour) * share[..., None]
        self.grain += (np.float32(grain) - self.grain) * share
        plant = 255.0 if is_plant else 0.0
        self.vegetation = (self.vegetation + (plant - self.vegetation) * share).astype(np.uint8)

    def develop(
        self,
        fine_scales_m: tuple[float, ...] = (0.0, 0.03, 0.07, 0.16),
        weights: tuple[float, ...] = (0.4, 0.8, 1.0, 0.9),
    ) -> None:
        """Bring the mix to the full raster and add its grain."""
        width, height = self.size_px
        scales = [max(scale, self.m_per_px) for scale in fine_scales_m]
        detail = fractal(self.rng, (height, width), self.m_per_px, scales, weights)
        tint = layer(self.rng, (height, width), max(0.09 / self.m_per_px, 1.5))
        self.rgb = np.empty((height, width, 3), np.uint8)
        band = 512  # rows at a time: the whole in float would fill the memory
        wide = cv2.resize(
            self.colour, (width, self.coarse_shape[0]), interpolation=cv2.INTER_LINEAR
        )
        wide_grain = cv2.resize(
            self.grain, (width, self.coarse_shape[0]), interpolation=cv2.INTER_LINEAR
        )
        for top in range(0, height, band):
            rows = np.arange(top, min(top + band, height), dtype=np.float32)
            source = np.clip(
                (rows + 0.5) * self.coarse_shape[0] / height - 0.5, 0, self.coarse_shape[0] - 1
            )
            first = source.astype(int)
            second = np.minimum(first + 1, self.coarse_shape[0] - 1)
            share = (source - first)[:, None].astype(np.float32)
            colour = wide[first] + (wide[second] - wide[first]) * share[..., None]
            grain = wide_grain[first] + (wide_grain[second] - wide_grain[first]) * share
            part = slice(top, top + len(rows))
            gain = 1 + grain * detail[part]
            shift = grain * tint[part] * 0.22
            colour *= gain[..., None]
            colour[..., 0] *= 1 + shift
            colour[..., 2] *= 1 - shift
            self.rgb[part] = np.clip(colour, 4, 250).astype(np.uint8)

    def px(self, points_m: Floats) -> Floats:
        """(N, 2) full-raster pixels of east, north."""
        first_m = [self.area.west_m, self.area.north_m]
        return (np.asarray(points_m) - first_m) * [1, -1] / self.m_per_px - 0.5

    def polygon(self, points_m: Floats, colour: Sequence[float] | Floats) -> None:
        """Fill a polygon of site metres with one colour, its edge smooth."""
        cv2.fillPoly(self.rgb, self._drawn(points_m), [float(c) for c in colour], cv2.LINE_AA, 4)

    def stroke(
        self,
        points_m: Sequence[Sequence[float]] | Floats,
        width_m: float,
        colour: Sequence[float] | Floats,
    ) -> None:
        """Draw a line of site metres."""
        width, own = max(1, round(width_m / self.m_per_px)), [float(c) for c in colour]
        cv2.polylines(self.rgb, self._drawn(points_m), False, own, width, cv2.LINE_AA, 4)

    def _drawn(self, points_m: Sequence[Sequence[float]] | Floats) -> list[NDArray[np.int32]]:
        """Points as OpenCV draws them, in sixteenths of a pixel."""
        return [np.round(self.px(np.asarray(points_m)) * 16).astype(np.int32).reshape(-1, 1, 2)]

    def stones(
        self,
        per_m2: float,
        sizes_m: tuple[float, float],
        colour: tuple[float, float, float],
        cover: FieldF32 | None,
    ) -> None:
        """Scatter stones, each with a lit face and a dark foot, more where `cover` is high."""
        width_m, height_m = self.area.size_m
        count = int(min(per_m2 * width_m * height_m, 60000))
        x = self.rng.uniform(0, self.size_px[0], count)
        y = self.rng.uniform(0, self.size_px[1], count)
        radii = (
            sizes_m[0]
            * (sizes_m[1] / sizes_m[0]) ** (self.rng.uniform(0, 1, count) ** 2.2)
            / 2
            / self.m_per_px
        )
        turns, flat = self.rng.uniform(0, 180, count), self.rng.uniform(0.55, 1.0, count)
        tones = self.rng.uniform(0.62, 1.25, count)
        chance = self.rng.uniform(0, 1, count)
        for i in range(count):
            if cover is not None and chance[i] > cover[int(y[i]) // _COARSE, int(x[i]) // _COARSE]:
                continue
            at = np.array([x[i], y[i]])
            axes = (int(radii[i] * 16), int(radii[i] * flat[i] * 16))
            if axes[1] < 4:
                continue
            tone = [c * tones[i] for c in colour]
            for shift, shade in ((0.35, 0.5), (0.0, 1.0), (-0.25, 1.18)):
                centre = tuple(np.round((at + shift * radii[i]) * 16).astype(int).tolist())
                size = axes if shift >= 0 else (axes[0] * 6 // 10, axes[1] * 6 // 10)
                cv2.ellipse(
                    self.rgb,
                    centre,
                    size,
                    turns[i],
                    0,
                    360,
                    [min(250.0, c * shade) for c in tone],
                    -1,
                    cv2.LINE_AA,
                    4,
                )


def rectangle(west_m: float, south_m: float, east_m: float, north_m: float) -> Floats:
    """(4, 2) the corners from the south-west on, counter-clockwise."""
    return np.array([[west_m, south_m], [east_m, south_m], [east_m, north_m], [west_m, north_m]])


def soft(field: FieldF32, threshold: float, softness: float) -> FieldF32:
    """1 where the field exceeds the threshold, 0 below, with an edge of this softness."""
    return np.clip((field - np.float32(threshold)) / np.float32(softness) + np.float32(0.5), 0, 1)


def distance_to_curve(
    canvas: GroundCanvas, angle_deg: float, offset_m: float, wander_m: float, scale_m: float
) -> FieldF32:
    """(height, width) signed metres from a wandering line through the area, positive on its left."""
    angle = np.radians(angle_deg)
    along = canvas.east * np.float32(np.cos(angle)) + canvas.north * np.float32(np.sin(angle))
    across = canvas.north * np.float32(np.cos(angle)) - canvas.east * np.float32(np.sin(angle))
    low, high = float(along.min()), float(along.max())
    knots = canvas.rng.standard_normal(int((high - low) / scale_m) + 6)
    at = np.arange(len(knots)) * scale_m + low - 2 * scale_m
    fine = np.linspace(low, high, 512)
    # smooth enough through a few averages of the piecewise line
    curve = np.convolve(
        np.interp(fine, at, knots), np.hanning(41) / np.hanning(41).sum(), mode="same"
    )
    bend = np.interp(along.ravel(), fine, curve).reshape(along.shape) * wander_m
    return (across - np.float32(offset_m) - bend).astype(np.float32)


def scatter(
    canvas: GroundCanvas, per_m2: float, gap_m: float, margin_m: float, keep: FieldF32 | None = None
) -> Floats:
    """(N, 3) random places at least `gap_m` apart, with a random heading, where `keep` is above a half."""
    width_m, height_m = canvas.area.size_m
    rng = canvas.rng
    chosen: list[tuple[float, float]] = []
    for _ in range(int(per_m2 * width_m * height_m * 3)):
        u = rng.uniform(margin_m, max(margin_m + 0.1, width_m - margin_m))
        v = rng.uniform(margin_m, max(margin_m + 0.1, height_m - margin_m))
        row = min(int(v / canvas.m_per_px) // _COARSE, canvas.coarse_shape[0] - 1)
        column = min(int(u / canvas.m_per_px) // _COARSE, canvas.coarse_shape[1] - 1)
        if keep is not None and keep[row, column] < 0.5:
            continue
        if all(np.hypot(u - a, v - b) > gap_m for a, b in chosen):
            chosen.append((u, v))
        if len(chosen) >= per_m2 * width_m * height_m:
            break
    points = np.array(chosen).reshape(-1, 2)
    places = np.column_stack(
        [canvas.area.west_m + points[:, 0], canvas.area.north_m - points[:, 1]]
    )
    return np.column_stack([places, rng.uniform(0, 360, len(places))])


def rectangle_cover(
    canvas: GroundCanvas, west: float, south: float, east: float, north: float
) -> FieldF32:
    """1 inside an upright rectangle of site metres, 0 outside."""
    inside = np.minimum(
        np.minimum(canvas.east - west, east - canvas.east),
        np.minimum(canvas.north - south, north - canvas.north),
    )
    return soft(inside.astype(np.float32), 0.0, canvas.m_per_px * _COARSE)


def away_from(canvas: GroundCanvas, places: Floats, radius_m: float) -> FieldF32:
    """0 within `radius_m` of the places, (N, 3), 1 elsewhere."""
    free = np.ones(canvas.coarse_shape, np.float32)
    for east, north, _ in places:
        free[np.hypot(canvas.east - east, canvas.north - north) < radius_m] = 0
    return free
