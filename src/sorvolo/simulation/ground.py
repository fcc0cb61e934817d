"""The simulated site's ground: a picture of level ground in site metres, procedural or a given orthophoto."""

from dataclasses import dataclass, replace
from enum import StrEnum

import cv2
import numpy as np

from sorvolo.errors import SettingsError
from sorvolo.geometry.arrays import Floats, ImageGray, ImageRGB, PointsM, PointsPx
from sorvolo.simulation.noise import FieldF32, fractal, layer

_COARSE = 4  # materials are mixed on a raster this many times coarser than the picture


class GroundKind(StrEnum):
    """The grounds that can be made; the first three are the thesis's environments."""

    DIRT = "dirt"
    COUNTRYSIDE = "countryside"
    URBAN = "urban"
    SAND = "sand"


@dataclass(frozen=True)
class Area:
    """An upright rectangle of ground in site metres."""

    west_m: float
    south_m: float
    east_m: float
    north_m: float

    @property
    def size_m(self) -> tuple[float, float]:
        """Width and height."""
        return self.east_m - self.west_m, self.north_m - self.south_m


@dataclass(frozen=True, eq=False)
class GroundRaster:
    """A picture of the ground: the outer corner of its top-left pixel lies at (west_m, north_m), north is up.

    `vegetation` (height, width) uint8 tells how much a pixel can move in the wind.
    """

    rgb: ImageRGB
    vegetation: ImageGray
    west_m: float
    north_m: float
    m_per_px: tuple[float, float]

    @property
    def area(self) -> Area:
        """The ground that it shows."""
        height, width = self.rgb.shape[:2]
        return Area(
            self.west_m, self.north_m - height * self.m_per_px[1], self.west_m + width * self.m_per_px[0], self.north_m
        )

    def raster_from_site(self, points_m: PointsM) -> PointsPx:
        """(N, 2) pixels of east, north, shape (N, 2)."""
        matrix = self.raster_from_site_matrix
        return points_m @ matrix[:2, :2].T + matrix[:2, 2]

    @property
    def raster_from_site_matrix(self) -> Floats:
        """(3, 3) affine map from east, north to pixels."""
        mx, my = self.m_per_px
        return np.array([[1 / mx, 0, -self.west_m / mx - 0.5], [0, -1 / my, self.north_m / my - 0.5], [0, 0, 1]])

    def resampled(self, m_per_px: float) -> "GroundRaster":
        """The same ground averaged to coarser pixels; itself when its own are not finer."""
        height, width = self.rgb.shape[:2]
        new_width, new_height = round(width * self.m_per_px[0] / m_per_px), round(height * self.m_per_px[1] / m_per_px)
        if new_width >= width or new_height >= height:
            return self
        size = (new_width, new_height)
        return replace(
            self,
            rgb=cv2.resize(self.rgb, size, interpolation=cv2.INTER_AREA),
            vegetation=cv2.resize(self.vegetation, size, interpolation=cv2.INTER_AREA),
            m_per_px=(self.m_per_px[0] * width / new_width, self.m_per_px[1] * height / new_height),
        )


@dataclass(frozen=True, eq=False)
class Layout:
    """Where on the ground things may stand, in site metres: rows of (east, north, yaw_deg), each (N, 3).

    `blocked` (N, 3) are circles (east, north, radius) where nothing else should stand.
    """

    houses: Floats
    trees: Floats
    bushes: Floats
    parkings: Floats
    blocked: Floats


@dataclass(frozen=True, eq=False)
class PaintedGround:
    """The ground's picture and what it says about where things stand."""

    raster: GroundRaster
    layout: Layout


def orthophoto_ground(rgb: ImageRGB, m_per_px: float) -> PaintedGround:
    """A given orthophoto as ground, its middle at the site's origin, north up; nothing is planted on it."""
    if m_per_px <= 0:
        raise SettingsError(f"the orthophoto's pixel size must be positive, got {m_per_px} m")
    height, width = rgb.shape[:2]
    raster = GroundRaster(
        rgb, np.zeros((height, width), np.uint8), -width * m_per_px / 2, height * m_per_px / 2, (m_per_px, m_per_px)
    )
    return PaintedGround(raster, Layout(*[np.zeros((0, 3))] * 5))


def paint_ground(kind: GroundKind, area: Area, m_per_px: float, rng: np.random.Generator) -> PaintedGround:
    """Paint `area` at `m_per_px`; the same `rng` state gives the same ground."""
    canvas = _Canvas.over(area, m_per_px, rng)
    painter = {
        GroundKind.DIRT: _dirt, GroundKind.COUNTRYSIDE: _countryside, GroundKind.URBAN: _urban, GroundKind.SAND: _sand,
    }[kind]
    layout = painter(canvas)
    vegetation = cv2.resize(canvas.vegetation, canvas.size_px, interpolation=cv2.INTER_LINEAR)
    raster = GroundRaster(canvas.rgb, vegetation, area.west_m, area.north_m, (m_per_px, m_per_px))
    return PaintedGround(raster, layout)


# -- the painter's tools ---------------------------------------------------------------------------------------


class _Canvas:
    """The ground while it is painted: a coarse mix of materials first, then fine strokes on the full raster."""

    def __init__(self, area: Area, m_per_px: float, size_px: tuple[int, int], rng: np.random.Generator) -> None:
        self.area, self.m_per_px, self.size_px, self.rng = area, m_per_px, size_px, rng
        self.coarse_shape = (-(-size_px[1] // _COARSE), -(-size_px[0] // _COARSE))
        self.colour = np.zeros((*self.coarse_shape, 3), np.float32)
        self.grain = np.zeros(self.coarse_shape, np.float32)
        self.vegetation = np.zeros(self.coarse_shape, np.uint8)
        self.rgb: ImageRGB = np.zeros((1, 1, 3), np.uint8)
        rows, columns = np.mgrid[0:self.coarse_shape[0], 0:self.coarse_shape[1]].astype(np.float32)
        step = np.float32(m_per_px * _COARSE)
        self.east = area.west_m + (columns + 0.5) * step
        self.north = area.north_m - (rows + 0.5) * step

    @classmethod
    def over(cls, area: Area, m_per_px: float, rng: np.random.Generator) -> "_Canvas":
        width_m, height_m = area.size_m
        return cls(area, m_per_px, (int(np.ceil(width_m / m_per_px)), int(np.ceil(height_m / m_per_px))), rng)

    def field(self, *scales_m: float) -> FieldF32:
        """Unit noise on the coarse raster, equal parts of these scales."""
        return fractal(self.rng, self.coarse_shape, self.m_per_px * _COARSE, scales_m, [1.0] * len(scales_m))

    def lay(self, cover: FieldF32, colour: tuple[float, float, float], grain: float, mottle: FieldF32,
            is_plant: bool = False) -> None:
        """Cover the ground, where `cover` is 1, with a material of this colour, coarse mottle and fine grain."""
        share = np.clip(cover, 0, 1).astype(np.float32)
        material = np.array(colour, np.float32) * (1 + mottle[..., None])
        self.colour += (material - self.colour) * share[..., None]
        self.grain += (np.float32(grain) - self.grain) * share
        plant = 255.0 if is_plant else 0.0
        self.vegetation = (self.vegetation + (plant - self.vegetation) * share).astype(np.uint8)

    def develop(self, fine_scales_m: tuple[float, ...] = (0.0, 0.03, 0.07, 0.16),
                weights: tuple[float, ...] = (0.4, 0.8, 1.0, 0.9)) -> None:
        """Bring the mix to the full raster and add its grain."""
        width, height = self.size_px
        scales = [max(scale, self.m_per_px) for scale in fine_scales_m]
        detail = fractal(self.rng, (height, width), self.m_per_px, scales, weights)
        tint = layer(self.rng, (height, width), max(0.09 / self.m_per_px, 1.5))
        self.rgb = np.empty((height, width, 3), np.uint8)
        band = 512  # rows at a time: the whole in float would fill the memory
        wide = cv2.resize(self.colour, (width, self.coarse_shape[0]), interpolation=cv2.INTER_LINEAR)
        wide_grain = cv2.resize(self.grain, (width, self.coarse_shape[0]), interpolation=cv2.INTER_LINEAR)
        for top in range(0, height, band):
            rows = np.arange(top, min(top + band, height), dtype=np.float32)
            source = np.clip((rows + 0.5) * self.coarse_shape[0] / height - 0.5, 0, self.coarse_shape[0] - 1)
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
        return (np.asarray(points_m) - [self.area.west_m, self.area.north_m]) * [1, -1] / self.m_per_px - 0.5

    def polygon(self, points_m: Floats, colour: Floats) -> None:
        """Fill a polygon of site metres with one colour, its edge smooth."""
        cv2.fillPoly(self.rgb, [_shifted(self.px(points_m))], [float(c) for c in colour], cv2.LINE_AA, 4)

    def stroke(self, points_m: Floats, width_m: float, colour: Floats) -> None:
        """Draw a line of site metres."""
        width = max(1, round(width_m / self.m_per_px))
        cv2.polylines(self.rgb, [_shifted(self.px(points_m))], False, [float(c) for c in colour], width, cv2.LINE_AA, 4)

    def stones(self, per_m2: float, sizes_m: tuple[float, float], colour: tuple[float, float, float],
               cover: FieldF32 | None = None) -> None:
        """Scatter stones, each with a lit face and a dark foot, more where `cover` is high."""
        width_m, height_m = self.area.size_m
        count = int(min(per_m2 * width_m * height_m, 60000))
        x, y = self.rng.uniform(0, self.size_px[0], count), self.rng.uniform(0, self.size_px[1], count)
        radii = sizes_m[0] * (sizes_m[1] / sizes_m[0]) ** (self.rng.uniform(0, 1, count) ** 2.2) / 2 / self.m_per_px
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
                    self.rgb, centre, size, turns[i], 0, 360, [min(250.0, c * shade) for c in tone], -1, cv2.LINE_AA, 4
                )


def _shifted(points_px: Floats) -> np.ndarray[tuple[int, ...], np.dtype[np.int32]]:
    return np.round(np.asarray(points_px) * 16).astype(np.int32).reshape(-1, 1, 2)


def _soft(field: FieldF32, threshold: float, softness: float) -> FieldF32:
    """1 where the field exceeds the threshold, 0 below, with an edge of this softness."""
    return np.clip((field - np.float32(threshold)) / np.float32(softness) + np.float32(0.5), 0, 1)


def _distance_to_curve(canvas: _Canvas, angle_deg: float, offset_m: float, wander_m: float, scale_m: float) -> FieldF32:
    """(height, width) signed metres from a wandering line through the area, positive on its left."""
    angle = np.radians(angle_deg)
    along = canvas.east * np.float32(np.cos(angle)) + canvas.north * np.float32(np.sin(angle))
    across = canvas.north * np.float32(np.cos(angle)) - canvas.east * np.float32(np.sin(angle))
    low, high = float(along.min()), float(along.max())
    knots = canvas.rng.standard_normal(int((high - low) / scale_m) + 6)
    at = np.arange(len(knots)) * scale_m + low - 2 * scale_m
    fine = np.linspace(low, high, 512)
    # smooth enough through a few averages of the piecewise line
    curve = np.convolve(np.interp(fine, at, knots), np.hanning(41) / np.hanning(41).sum(), mode="same")
    bend = np.interp(along.ravel(), fine, curve).reshape(along.shape) * wander_m
    return (across - np.float32(offset_m) - bend).astype(np.float32)


def _scatter(canvas: _Canvas, per_m2: float, gap_m: float, margin_m: float, keep: FieldF32 | None = None) -> Floats:
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
    places = np.column_stack([canvas.area.west_m + points[:, 0], canvas.area.north_m - points[:, 1]])
    return np.column_stack([places, rng.uniform(0, 360, len(places))])


# -- the four grounds ------------------------------------------------------------------------------------------


def _dirt(canvas: _Canvas) -> Layout:
    ones = np.ones(canvas.coarse_shape, np.float32)
    field = canvas.field
    canvas.lay(ones, (158, 134, 104), 0.085, 0.07 * field(14, 5, 1.6) + 0.03 * field(0.6, 0.3))
    canvas.lay(_soft(field(9, 3, 1.0), 0.9, 0.5), (186, 164, 134), 0.06, 0.04 * field(1.5, 0.5))
    canvas.lay(_soft(field(7, 2.5, 0.8), 1.0, 0.6), (128, 106, 82), 0.1, 0.06 * field(1.0, 0.4))
    gravel = _soft(field(11, 4), 1.1, 0.7)
    canvas.lay(0.7 * gravel, (150, 142, 132), 0.2, 0.05 * field(0.5, 0.25))
    weeds = _soft(field(6, 1.6, 0.45), 1.15, 0.3)
    canvas.lay(0.8 * weeds, (112, 112, 66), 0.24, 0.15 * field(0.7, 0.3), is_plant=True)
    for angle, offset in ((canvas.rng.uniform(-25, 25), 0.0), (canvas.rng.uniform(50, 110), 3.0)):
        distance = _distance_to_curve(canvas, angle, offset, 2.0, 18.0)
        canvas.lay(0.55 * _soft(-np.abs(distance), -1.9, 0.9), (176, 152, 120), 0.07, 0.05 * field(2.0, 0.6))
        for rut in (-0.85, 0.85):
            near = np.abs(distance - rut) + 0.05 * field(1.0, 0.4)
            canvas.lay(0.75 * _soft(-near, -0.22, 0.16), (122, 100, 76), 0.07, 0.08 * field(2.0, 0.5, 0.25))
    canvas.develop()
    canvas.stones(1.4, (0.05, 0.4), (164, 152, 136), np.clip(0.25 + gravel, 0, 1))
    return Layout(
        np.zeros((0, 3)), np.zeros((0, 3)), _scatter(canvas, 0.004, 3.0, 2.0), np.zeros((0, 3)), np.zeros((0, 3))
    )


def _countryside(canvas: _Canvas) -> Layout:
    ones = np.ones(canvas.coarse_shape, np.float32)
    field, rng = canvas.field, canvas.rng
    canvas.lay(ones, (104, 116, 62), 0.17, 0.1 * field(16, 6, 2) + 0.06 * field(0.7, 0.35), is_plant=True)
    canvas.lay(0.8 * _soft(field(8, 2.4, 0.8), 0.7, 0.8), (138, 134, 78), 0.16, 0.06 * field(1.2, 0.4), is_plant=True)
    canvas.lay(0.8 * _soft(field(6, 2.0, 0.6), 0.95, 0.6), (78, 98, 50), 0.2, 0.08 * field(0.9, 0.4), is_plant=True)
    border = _distance_to_curve(canvas, rng.uniform(-12, 12), 0.22 * canvas.area.size_m[1], 0.8, 25.0)
    crop = _soft(border, 1.2, 0.5)
    _plant_rows(canvas, crop, rng.uniform(-10, 10), 1.1, (134, 112, 82), (92, 116, 52))
    stubble = _soft(-_distance_to_curve(canvas, rng.uniform(70, 100), -0.30 * canvas.area.size_m[0], 1.0, 30.0), 0.5, 0.4)
    stubble *= 1 - crop
    _plant_rows(canvas, stubble, rng.uniform(70, 110), 0.55, (158, 140, 98), (196, 176, 122))
    path = _distance_to_curve(canvas, rng.uniform(-20, 20), -0.02 * canvas.area.size_m[1], 2.5, 22.0)
    edge = 0.25 * field(1.5, 0.5)
    canvas.lay(_soft(-np.abs(path) + edge, -1.5, 0.5), (182, 160, 126), 0.085, 0.05 * field(2.5, 0.8, 0.4))
    canvas.lay(0.75 * _soft(-np.abs(path) + edge, -0.3, 0.35), (124, 126, 74), 0.2, 0.1 * field(0.8, 0.35), is_plant=True)
    canvas.lay(0.9 * _soft(field(4, 1.2, 0.4), 1.7, 0.3), (160, 138, 106), 0.1, 0.05 * field(0.8, 0.3))
    canvas.develop()
    canvas.stones(0.25, (0.05, 0.22), (176, 166, 150), _soft(-np.abs(path), -1.8, 1.2))
    # a few flowers and dry tufts: points of colour that real meadows have
    canvas.stones(0.5, (0.05, 0.13), (206, 198, 92), 1 - crop)
    open_land = (1 - crop) * (1 - stubble) * _soft(np.abs(path), 4.0, 0.1)
    houses = _scatter(canvas, 1 / 2200, 22.0, 9.0, open_land * _soft(-np.abs(path), -14.0, 0.1))
    far_from_houses = open_land * _away_from(canvas, houses, 8.5)
    trees = _scatter(canvas, 1 / 150, 5.0, 3.0, far_from_houses)
    hedge = _soft(-np.abs(border), -0.7, 0.2) + far_from_houses * _soft(field(9.0, 3.0), 1.0, 0.2)
    bushes = _scatter(canvas, 1 / 90, 1.6, 1.0, hedge)
    return Layout(houses, trees, bushes, np.zeros((0, 3)), _circles((houses, 7.5), (trees, 2.4), (bushes, 1.2)))


def _plant_rows(canvas: _Canvas, cover: FieldF32, angle_deg: float, period_m: float,
                soil: tuple[float, float, float], plants: tuple[float, float, float]) -> None:
    angle = np.radians(angle_deg)
    across = canvas.north * np.float32(np.cos(angle)) - canvas.east * np.float32(np.sin(angle))
    across = across + np.float32(0.06 * period_m) * canvas.field(6.0, 2.0)
    wave = np.cos(2 * np.pi * across / period_m).astype(np.float32)
    canvas.lay(cover, soil, 0.13, 0.06 * canvas.field(5.0, 1.0, 0.4))
    growth = wave + 0.55 * canvas.field(0.4, 0.25) + 0.25 * canvas.field(7.0, 3.0)
    canvas.lay(cover * _soft(growth, 0.1, 0.7), plants, 0.2, 0.14 * canvas.field(0.5, 0.3), is_plant=True)


def _urban(canvas: _Canvas) -> Layout:
    ones = np.ones(canvas.coarse_shape, np.float32)
    field, rng, area = canvas.field, canvas.rng, canvas.area
    canvas.lay(ones, (98, 98, 100), 0.1, 0.05 * field(12, 4, 1.2) + 0.03 * field(0.5, 0.25))
    blocks = _city_blocks(area, rng)
    lawns = [block for block in blocks if rng.uniform() < 0.35]
    yards = [block for block in blocks if block not in lawns]
    for west, south, east, north in lawns:
        inside = _rectangle_cover(canvas, west + 1.8, south + 1.8, east - 1.8, north - 1.8)
        canvas.lay(inside, (96, 112, 62), 0.18, 0.1 * field(5, 1.5, 0.4), is_plant=True)
    for west, south, east, north in yards:
        inside = _rectangle_cover(canvas, west + 1.8, south + 1.8, east - 1.8, north - 1.8)
        canvas.lay(inside, (118, 117, 115), 0.09, 0.05 * field(6, 1.5, 0.5))
    for west, south, east, north in blocks:
        rim = _rectangle_cover(canvas, west, south, east, north)
        rim = rim * (1 - _rectangle_cover(canvas, west + 1.8, south + 1.8, east - 1.8, north - 1.8))
        canvas.lay(rim, (168, 164, 156), 0.06, 0.04 * field(3, 0.8))
    # oil, repairs and wear
    canvas.lay(0.5 * _soft(field(3, 0.9, 0.4), 1.6, 0.4), (62, 62, 64), 0.08, 0.03 * field(0.5))
    canvas.develop()
    _paint_kerbs(canvas, blocks)
    _paint_cracks(canvas, 0.03)
    houses, parkings = [], []
    for west, south, east, north in yards:
        parkings += _paint_parking(canvas, west + 2.2, south + 2.2, east - 2.2)
        if north - south > 22 and east - west > 18:
            houses.append(((west + east) / 2, north - 8.5, 0.0))
    _paint_roads(canvas, blocks)
    garden = sum((_rectangle_cover(canvas, w + 3, s + 3, e - 3, n - 3) for w, s, e, n in lawns), 0 * ones)
    trees = _scatter(canvas, 1 / 90, 5.0, 1.0, garden)
    kerb_parkings = [(w - 1.3, 0.5 * (s + n) + d, 90.0) for w, s, _, n in blocks for d in (-6.0, 1.0)]
    house_places = np.array(houses).reshape(-1, 3)
    return Layout(
        house_places, trees, np.zeros((0, 3)), np.array(parkings + kerb_parkings).reshape(-1, 3),
        _circles((house_places, 9.0), (trees, 2.4)),
    )


def _city_blocks(area: Area, rng: np.random.Generator) -> list[tuple[float, float, float, float]]:
    """West, south, east, north of the blocks that roads leave between them."""
    def cuts(low: float, high: float) -> list[tuple[float, float]]:
        spans, at = [], low - rng.uniform(5, 25)
        while at < high:
            size = rng.uniform(26, 42)
            spans.append((at, at + size))
            at += size + rng.uniform(6.5, 8.5)
        return spans
    columns, rows = cuts(area.west_m, area.east_m), cuts(area.south_m, area.north_m)
    return [(w, s, e, n) for w, e in columns for s, n in rows]


def _rectangle_cover(canvas: _Canvas, west: float, south: float, east: float, north: float) -> FieldF32:
    inside = np.minimum(
        np.minimum(canvas.east - west, east - canvas.east), np.minimum(canvas.north - south, north - canvas.north)
    )
    return _soft(inside.astype(np.float32), 0.0, canvas.m_per_px * _COARSE)


def _paint_kerbs(canvas: _Canvas, blocks: list[tuple[float, float, float, float]]) -> None:
    for west, south, east, north in blocks:
        for inset, tone in ((0.0, 196.0), (1.8, 140.0)):
            ring = np.array([
                [west + inset, south + inset], [east - inset, south + inset], [east - inset, north - inset],
                [west + inset, north - inset], [west + inset, south + inset],
            ])
            canvas.stroke(ring, 0.14, np.array([tone, tone - 2, tone - 6]))
        for at in np.arange(west + 0.6, east - 0.4, 0.9):
            for low, high in ((south, south + 1.8), (north - 1.8, north)):
                canvas.stroke(np.array([[at, low], [at, high]]), 0.02, np.array([146, 143, 138]))
        for at in np.arange(south + 0.6, north - 0.4, 0.9):
            for low, high in ((west, west + 1.8), (east - 1.8, east)):
                canvas.stroke(np.array([[low, at], [high, at]]), 0.02, np.array([146, 143, 138]))


def _paint_roads(canvas: _Canvas, blocks: list[tuple[float, float, float, float]]) -> None:
    white = np.array([222.0, 222, 216])
    for west, south, east, north in blocks:
        for at in np.arange(west, east - 2, 5.0):  # the dashed middle of the road to the south
            canvas.stroke(np.array([[at, south - 3.6], [at + 2.5, south - 3.6]]), 0.12, white)
        for at in np.arange(south, north - 2, 5.0):
            canvas.stroke(np.array([[west - 3.6, at], [west - 3.6, at + 2.5]]), 0.12, white)
        for at in np.arange(south - 6.3, south - 0.6, 0.9):  # a zebra crossing at each block's corner
            canvas.polygon(np.array([[east - 3.2, at], [east - 0.6, at], [east - 0.6, at + 0.45], [east - 3.2, at + 0.45]]),
                           white * canvas.rng.uniform(0.88, 1.0))
        hole = np.array([canvas.rng.uniform(west, east), south - 2.0])
        angle = np.linspace(0, 2 * np.pi, 20)
        canvas.polygon(hole + 0.35 * np.column_stack([np.cos(angle), np.sin(angle)]), np.array([70.0, 68, 66]))


def _paint_parking(canvas: _Canvas, west: float, south: float, east: float) -> list[tuple[float, float, float]]:
    """Lines of a row of parking lots, 2.5 m by 5 m; returns their places."""
    lots = []
    edges = np.arange(west + 0.5, east - 0.4, 2.5)
    for edge in edges:
        canvas.stroke(np.array([[edge, south + 0.4], [edge, south + 5.2]]), 0.1, np.array([214.0, 214, 208]))
    for left in edges[:-1]:
        lots.append((float(left) + 1.25, south + 2.8, 90.0))
    return lots


def _paint_cracks(canvas: _Canvas, per_m2: float) -> None:
    width_m, height_m = canvas.area.size_m
    for _ in range(int(per_m2 * width_m * height_m)):
        start = np.array([
            canvas.rng.uniform(canvas.area.west_m, canvas.area.east_m),
            canvas.rng.uniform(canvas.area.south_m, canvas.area.north_m),
        ])
        steps = np.cumsum(canvas.rng.normal(0, 0.35, (8, 2)) + canvas.rng.normal(0, 0.3, 2), axis=0)
        canvas.stroke(start + steps, 0.02, np.array([66.0, 65, 64]))


def _sand(canvas: _Canvas) -> Layout:
    """Bare sand: two to four grey levels of contrast at the scales that features need, and little else."""
    ones = np.ones(canvas.coarse_shape, np.float32)
    field = canvas.field
    canvas.lay(ones, (206, 187, 152), 0.014, 0.012 * field(20, 8) + 0.006 * field(2.5, 0.9) + 0.004 * field(0.4))
    canvas.develop((0.05, 0.12, 0.3), (1.0, 1.0, 1.0))
    return Layout(*[np.zeros((0, 3))] * 5)


def _away_from(canvas: _Canvas, places: Floats, radius_m: float) -> FieldF32:
    free = np.ones(canvas.coarse_shape, np.float32)
    for east, north, _ in places:
        free[np.hypot(canvas.east - east, canvas.north - north) < radius_m] = 0
    return free


def _circles(*groups: tuple[Floats, float]) -> Floats:
    """(N, 3) circles around all places of the groups."""
    return np.concatenate([np.column_stack([places[:, :2], np.full(len(places), radius)]) for places, radius in groups])
