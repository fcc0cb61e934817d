"""The simulated site's ground: a picture of level ground in site metres, procedural or a given orthophoto."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple, TypeAlias

import cv2
import numpy as np
from numpy.random import Generator

from sorvolo.errors import SettingsError
from sorvolo.geometry.arrays import Floats, ImageRGB
from sorvolo.lab.simulation.ground_painting import (
    GroundArea,
    GroundCanvas,
    GroundRaster,
    away_from,
    distance_to_curve,
    rectangle,
    rectangle_cover,
    scatter,
    soft,
)
from sorvolo.search.drawing.noise import FieldF32

_Block: TypeAlias = tuple[float, float, float, float]  # west, south, east, north, m
_NOWHERE: Floats = np.zeros((0, 3))


class GroundKind(StrEnum):
    """The grounds that can be made; the first three are the thesis's environments."""

    DIRT = "dirt"
    COUNTRYSIDE = "countryside"
    URBAN = "urban"
    SAND = "sand"


class GroundLayout(NamedTuple):
    """Where on the ground things may stand, in site metres: rows of (east, north, yaw_deg), each (N, 3)."""

    houses: Floats = _NOWHERE
    trees: Floats = _NOWHERE
    bushes: Floats = _NOWHERE
    parkings: Floats = _NOWHERE


@dataclass(frozen=True, eq=False)
class PaintedGround:
    """The ground's picture and the places on it where things stand."""

    raster: GroundRaster
    layout: GroundLayout


def orthophoto_ground(rgb: ImageRGB, m_per_px: float) -> PaintedGround:
    """A given orthophoto as ground, its middle at the site's origin, north up; nothing is planted on it."""
    if m_per_px <= 0:
        raise SettingsError(f"the orthophoto's pixel size must be positive, got {m_per_px} m")
    height, width = rgb.shape[:2]
    raster = GroundRaster(
        rgb,
        np.zeros((height, width), np.uint8),
        -width * m_per_px / 2,
        height * m_per_px / 2,
        (m_per_px, m_per_px),
    )
    return PaintedGround(raster, GroundLayout())


def paint_ground(
    kind: GroundKind, area: GroundArea, m_per_px: float, rng: Generator
) -> PaintedGround:
    """Paint `area` at `m_per_px`; the same `rng` state gives the same ground."""
    canvas = GroundCanvas(area, m_per_px, rng)
    painter = {
        GroundKind.DIRT: _dirt,
        GroundKind.COUNTRYSIDE: _countryside,
        GroundKind.URBAN: _urban,
        GroundKind.SAND: _sand,
    }[kind]
    layout = painter(canvas)
    grown = cv2.resize(canvas.vegetation, canvas.size_px, interpolation=cv2.INTER_LINEAR)
    vegetation = np.asarray(grown, np.uint8)
    raster = GroundRaster(canvas.rgb, vegetation, area.west_m, area.north_m, (m_per_px, m_per_px))
    return PaintedGround(raster, layout)


def _dirt(canvas: GroundCanvas) -> GroundLayout:
    ones = np.ones(canvas.coarse_shape, np.float32)
    field = canvas.field
    canvas.lay(ones, (158, 134, 104), 0.085, 0.07 * field(14, 5, 1.6) + 0.03 * field(0.6, 0.3))
    canvas.lay(soft(field(9, 3, 1.0), 0.9, 0.5), (186, 164, 134), 0.06, 0.04 * field(1.5, 0.5))
    canvas.lay(soft(field(7, 2.5, 0.8), 1.0, 0.6), (128, 106, 82), 0.1, 0.06 * field(1.0, 0.4))
    gravel = soft(field(11, 4), 1.1, 0.7)
    canvas.lay(0.7 * gravel, (150, 142, 132), 0.2, 0.05 * field(0.5, 0.25))
    weeds = soft(field(6, 1.6, 0.45), 1.15, 0.3)
    canvas.lay(0.8 * weeds, (112, 112, 66), 0.24, 0.15 * field(0.7, 0.3), is_plant=True)
    for angle, offset in ((canvas.rng.uniform(-25, 25), 0.0), (canvas.rng.uniform(50, 110), 3.0)):
        distance = distance_to_curve(canvas, angle, offset, 2.0, 18.0)
        canvas.lay(
            0.55 * soft(-np.abs(distance), -1.9, 0.9), (176, 152, 120), 0.07, 0.05 * field(2.0, 0.6)
        )
        for rut in (-0.85, 0.85):
            near = np.abs(distance - rut) + 0.05 * field(1.0, 0.4)
            canvas.lay(
                0.75 * soft(-near, -0.22, 0.16), (122, 100, 76), 0.07, 0.08 * field(2.0, 0.5, 0.25)
            )
    canvas.develop()
    canvas.stones(1.4, (0.05, 0.4), (164, 152, 136), np.clip(0.25 + gravel, 0, 1))
    return GroundLayout(bushes=scatter(canvas, 0.004, 3.0, 2.0))


def _countryside(canvas: GroundCanvas) -> GroundLayout:
    ones = np.ones(canvas.coarse_shape, np.float32)
    field, rng = canvas.field, canvas.rng
    canvas.lay(
        ones, (104, 116, 62), 0.17, 0.1 * field(16, 6, 2) + 0.06 * field(0.7, 0.35), is_plant=True
    )
    canvas.lay(
        0.8 * soft(field(8, 2.4, 0.8), 0.7, 0.8),
        (138, 134, 78),
        0.16,
        0.06 * field(1.2, 0.4),
        is_plant=True,
    )
    canvas.lay(
        0.8 * soft(field(6, 2.0, 0.6), 0.95, 0.6),
        (78, 98, 50),
        0.2,
        0.08 * field(0.9, 0.4),
        is_plant=True,
    )
    border = distance_to_curve(
        canvas, rng.uniform(-12, 12), 0.22 * canvas.area.size_m[1], 0.8, 25.0
    )
    crop = soft(border, 1.2, 0.5)
    _plant_rows(canvas, crop, rng.uniform(-10, 10), 1.1, (134, 112, 82), (92, 116, 52))
    stubble = soft(
        -distance_to_curve(canvas, rng.uniform(70, 100), -0.30 * canvas.area.size_m[0], 1.0, 30.0),
        0.5,
        0.4,
    )
    stubble *= 1 - crop
    _plant_rows(canvas, stubble, rng.uniform(70, 110), 0.55, (158, 140, 98), (196, 176, 122))
    path = distance_to_curve(canvas, rng.uniform(-20, 20), -0.02 * canvas.area.size_m[1], 2.5, 22.0)
    edge = 0.25 * field(1.5, 0.5)
    canvas.lay(
        soft(-np.abs(path) + edge, -1.5, 0.5), (182, 160, 126), 0.085, 0.05 * field(2.5, 0.8, 0.4)
    )
    canvas.lay(
        0.75 * soft(-np.abs(path) + edge, -0.3, 0.35),
        (124, 126, 74),
        0.2,
        0.1 * field(0.8, 0.35),
        is_plant=True,
    )
    canvas.lay(
        0.9 * soft(field(4, 1.2, 0.4), 1.7, 0.3), (160, 138, 106), 0.1, 0.05 * field(0.8, 0.3)
    )
    canvas.develop()
    canvas.stones(0.25, (0.05, 0.22), (176, 166, 150), soft(-np.abs(path), -1.8, 1.2))
    # a few flowers and dry tufts: points of colour that real meadows have
    canvas.stones(0.5, (0.05, 0.13), (206, 198, 92), 1 - crop)
    open_land = (1 - crop) * (1 - stubble) * soft(np.abs(path), 4.0, 0.1)
    houses = scatter(canvas, 1 / 2200, 22.0, 9.0, open_land * soft(-np.abs(path), -14.0, 0.1))
    far_from_houses = open_land * away_from(canvas, houses, 8.5)
    trees = scatter(canvas, 1 / 150, 5.0, 3.0, far_from_houses)
    hedge = soft(-np.abs(border), -0.7, 0.2) + far_from_houses * soft(field(9.0, 3.0), 1.0, 0.2)
    bushes = scatter(canvas, 1 / 90, 1.6, 1.0, hedge)
    return GroundLayout(houses, trees, bushes)


def _plant_rows(
    canvas: GroundCanvas,
    cover: FieldF32,
    angle_deg: float,
    period_m: float,
    soil: tuple[float, float, float],
    plants: tuple[float, float, float],
) -> None:
    angle = np.radians(angle_deg)
    across = canvas.north * np.float32(np.cos(angle)) - canvas.east * np.float32(np.sin(angle))
    across = across + np.float32(0.06 * period_m) * canvas.field(6.0, 2.0)
    wave = np.cos(2 * np.pi * across / period_m).astype(np.float32)
    canvas.lay(cover, soil, 0.13, 0.06 * canvas.field(5.0, 1.0, 0.4))
    growth = wave + 0.55 * canvas.field(0.4, 0.25) + 0.25 * canvas.field(7.0, 3.0)
    canvas.lay(
        cover * soft(growth, 0.1, 0.7), plants, 0.2, 0.14 * canvas.field(0.5, 0.3), is_plant=True
    )


def _urban(canvas: GroundCanvas) -> GroundLayout:
    ones = np.ones(canvas.coarse_shape, np.float32)
    field, rng, area = canvas.field, canvas.rng, canvas.area
    canvas.lay(ones, (98, 98, 100), 0.1, 0.05 * field(12, 4, 1.2) + 0.03 * field(0.5, 0.25))
    blocks = _city_blocks(area, rng)
    lawns = [block for block in blocks if rng.uniform() < 0.35]
    yards = [block for block in blocks if block not in lawns]
    _paint_blocks(canvas, blocks, lawns, yards)
    # oil, repairs and wear
    canvas.lay(0.5 * soft(field(3, 0.9, 0.4), 1.6, 0.4), (62, 62, 64), 0.08, 0.03 * field(0.5))
    canvas.develop()
    for west, south, east, north in blocks:
        for inset, tone in ((0.0, 196.0), (1.8, 140.0)):
            ring = rectangle(west + inset, south + inset, east - inset, north - inset)
            canvas.stroke(np.vstack([ring, ring[:1]]), 0.14, (tone, tone - 2, tone - 6))
        for at in np.arange(west + 0.6, east - 0.4, 0.9):
            for low, high in ((south, south + 1.8), (north - 1.8, north)):
                canvas.stroke([[at, low], [at, high]], 0.02, (146, 143, 138))
        for at in np.arange(south + 0.6, north - 0.4, 0.9):
            for low, high in ((west, west + 1.8), (east - 1.8, east)):
                canvas.stroke([[low, at], [high, at]], 0.02, (146, 143, 138))
    for _ in range(int(0.03 * area.size_m[0] * area.size_m[1])):
        start = rng.uniform((area.west_m, area.south_m), (area.east_m, area.north_m))
        steps = np.cumsum(rng.normal(0, 0.35, (8, 2)) + rng.normal(0, 0.3, 2), axis=0)
        canvas.stroke(start + steps, 0.02, (66, 65, 64))
    # the places (east, north, yaw) of houses in the yards, and of the parked cars, whose
    # places are painted
    houses: list[tuple[float, float, float]] = []
    parkings: list[tuple[float, float, float]] = []
    for west, south, east, north in yards:
        parkings += _paint_parking(canvas, west + 2.2, south + 2.2, east - 2.2)
        if north - south > 22 and east - west > 18:
            houses.append(((west + east) / 2, north - 8.5, 0.0))
    white = np.array([222.0, 222, 216])
    for west, south, east, north in blocks:
        for at in np.arange(west, east - 2, 5.0):  # the dashed middle of the road to the south
            canvas.stroke([[at, south - 3.6], [at + 2.5, south - 3.6]], 0.12, white)
        for at in np.arange(south, north - 2, 5.0):
            canvas.stroke([[west - 3.6, at], [west - 3.6, at + 2.5]], 0.12, white)
        # a zebra crossing at each block's corner
        for at in np.arange(south - 6.3, south - 0.6, 0.9):
            stripe = rectangle(east - 3.2, at, east - 0.6, at + 0.45)
            canvas.polygon(stripe, white * rng.uniform(0.88, 1.0))
        hole = rng.uniform(west, east), south - 2.0
        angle = np.linspace(0, 2 * np.pi, 20)
        canvas.polygon(hole + 0.35 * np.column_stack([np.cos(angle), np.sin(angle)]), (70, 68, 66))
    garden = sum(
        (rectangle_cover(canvas, w + 3, s + 3, e - 3, n - 3) for w, s, e, n in lawns), 0 * ones
    )
    trees = scatter(canvas, 1 / 90, 5.0, 1.0, garden)
    kerb_parkings = [
        (w - 1.3, 0.5 * (s + n) + d, 90.0) for w, s, _, n in blocks for d in (-6.0, 1.0)
    ]
    houses_m, parkings_m = (
        np.array(each).reshape(-1, 3) for each in (houses, parkings + kerb_parkings)
    )
    return GroundLayout(houses_m, trees, parkings=parkings_m)


def _paint_blocks(
    canvas: GroundCanvas, blocks: Sequence[_Block], lawns: Sequence[_Block], yards: Sequence[_Block]
) -> None:
    """Lawns and paved yards within their pavements."""
    field = canvas.field
    for west, south, east, north in lawns:
        inside = rectangle_cover(canvas, west + 1.8, south + 1.8, east - 1.8, north - 1.8)
        canvas.lay(inside, (96, 112, 62), 0.18, 0.1 * field(5, 1.5, 0.4), is_plant=True)
    for west, south, east, north in yards:
        inside = rectangle_cover(canvas, west + 1.8, south + 1.8, east - 1.8, north - 1.8)
        canvas.lay(inside, (118, 117, 115), 0.09, 0.05 * field(6, 1.5, 0.5))
    for west, south, east, north in blocks:
        rim = rectangle_cover(canvas, west, south, east, north)
        rim = rim * (1 - rectangle_cover(canvas, west + 1.8, south + 1.8, east - 1.8, north - 1.8))
        canvas.lay(rim, (168, 164, 156), 0.06, 0.04 * field(3, 0.8))


def _city_blocks(area: GroundArea, rng: Generator) -> list[_Block]:
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


def _paint_parking(
    canvas: GroundCanvas, west: float, south: float, east: float
) -> list[tuple[float, float, float]]:
    """Lines of a row of parking lots, 2.5 m by 5 m; returns their places."""
    edges = np.arange(west + 0.5, east - 0.4, 2.5)
    for edge in edges:
        canvas.stroke([[edge, south + 0.4], [edge, south + 5.2]], 0.1, (214, 214, 208))
    return [(float(left) + 1.25, south + 2.8, 90.0) for left in edges[:-1]]


def _sand(canvas: GroundCanvas) -> GroundLayout:
    """Bare sand: two to four grey levels of contrast at the scales that features need, and little else."""
    ones = np.ones(canvas.coarse_shape, np.float32)
    field = canvas.field
    canvas.lay(
        ones,
        (206, 187, 152),
        0.014,
        0.012 * field(20, 8) + 0.006 * field(2.5, 0.9) + 0.004 * field(0.4),
    )
    canvas.develop((0.05, 0.12, 0.3), (1.0, 1.0, 1.0))
    return GroundLayout()
