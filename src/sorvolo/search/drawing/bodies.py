"""The bodies of things: the textured patches that people, cars, boxes, trees and houses are made of."""

import cv2
import numpy as np

from sorvolo.geometry.arrays import Floats, ImageRGBA
from sorvolo.search.drawing.noise import fractal
from sorvolo.search.drawing.objects import (
    Body,
    Light,
    Part,
    StandingPart,
    Thing,
    ThingLabel,
)
from sorvolo.search.drawing.people import build_person
from sorvolo.search.drawing.view import DrawnPatch, cut_out, opaque

_BOTH_SIDES = np.zeros(3)
_UP = np.array([0.0, 0.0, 1.0])
_PAINTS = np.array(
    [
        [222, 224, 226],
        [196, 200, 204],
        [60, 62, 66],
        [28, 30, 34],
        [150, 26, 28],
        [28, 62, 128],
        [70, 92, 78],
        [190, 158, 60],
    ],
    np.float64,
)


def build_body(thing: Thing, light: Light, m_per_px: float) -> Body:
    """The object's parts with their light painted in, textured finely enough for views of `m_per_px`."""
    texel_m = max(m_per_px, 0.004)
    rng = np.random.default_rng([thing.seed, 7])
    to_object = Light(thing.turn.T @ light.sun, light.ambient)
    builders = {
        ThingLabel.PERSON: build_person,
        ThingLabel.CAR: _car,
        ThingLabel.SMALL: _small,
        ThingLabel.TREE: _tree,
        ThingLabel.HOUSE: _house,
    }
    return Body(tuple(builders[thing.label](thing, to_object, texel_m, rng)))


def _texels(length_m: float, texel_m: float) -> int:
    return int(np.clip(round(length_m / texel_m), 1, 2048))


def _plain(
    size_m: tuple[float, float],
    texel_m: tuple[float, float],
    colour: Floats,
    grain: float,
    rng: np.random.Generator,
) -> Floats:
    """(height, width, 3) a coloured surface with a little grain, as float."""
    shape = (_texels(size_m[1], texel_m[1]), _texels(size_m[0], texel_m[0]))
    field = fractal(rng, shape, max(texel_m), (0.04, 0.15, 0.6), (0.6, 0.8, 1.0))
    return colour * (1 + grain * field[..., None].astype(np.float64))


def _as_texture(rgb: Floats, shade: float) -> ImageRGBA:
    return opaque(np.clip(rgb * shade, 0, 255).astype(np.uint8))


def _quad(
    a: Floats, b: Floats, c: Floats, d: Floats, texture: ImageRGBA, normal: Floats
) -> DrawnPatch:
    return DrawnPatch.spanned(
        np.array([a, b, c, d], np.float64), texture, np.asarray(normal, np.float64)
    )


def _lid(corners_m: Floats, rgb: Floats, light: Light) -> DrawnPatch:
    """A level face over corners (4, 3), counter-clockwise seen from above."""
    a, b, c, d = corners_m
    return _quad(d, c, b, a, _as_texture(rgb, light.shade(_UP)), _UP)


def _level(
    centre_m: tuple[float, float, float], size_m: tuple[float, float], texture: ImageRGBA
) -> DrawnPatch:
    """A level leaf, its texture's top to the left (+y) and its right forward (+x)."""
    x, y, z = centre_m
    a, b = size_m[0] / 2, size_m[1] / 2
    corners = np.array([[x - a, y + b, z], [x + a, y + b, z], [x + a, y - b, z], [x - a, y - b, z]])
    return DrawnPatch.spanned(corners, texture, _BOTH_SIDES)


def _disc(size_m: tuple[float, float], texel_m: float, colour: Floats, shade: float) -> ImageRGBA:
    rows, columns = max(3, _texels(size_m[1], texel_m)), max(3, _texels(size_m[0], texel_m))
    y, x = np.mgrid[0:rows, 0:columns]
    radius = np.hypot((x + 0.5) / columns * 2 - 1, (y + 0.5) / rows * 2 - 1)
    alpha = np.clip((1 - radius) * min(rows, columns) / 2 + 0.5, 0, 1).astype(np.float32)
    lit = np.clip(colour * shade * (1.08 - 0.2 * radius[..., None]), 0, 255)
    return cut_out(lit.astype(np.uint8), alpha)


def _prism(base_m: Floats, top_m: Floats, walls: list[Floats], light: Light) -> list[DrawnPatch]:
    """The side faces of a prism or its frustum: base and top corners (4, 3), counter-clockwise seen from above."""
    faces = []
    for i in range(4):
        j = (i + 1) % 4
        normal = np.cross(base_m[j] - base_m[i], top_m[i] - base_m[i])
        normal = normal / np.linalg.norm(normal)
        # seen from outside, the counter-clockwise neighbour stands on the right
        texture = _as_texture(walls[i], light.shade(normal))
        faces.append(_quad(top_m[i], top_m[j], base_m[j], base_m[i], texture, normal))
    return faces


def _rectangle(length_m: float, width_m: float, z_m: float, x_m: float = 0.0) -> Floats:
    a, b = length_m / 2, width_m / 2
    return np.array([[x_m - a, -b, z_m], [x_m + a, -b, z_m], [x_m + a, b, z_m], [x_m - a, b, z_m]])


def _box_walls(
    length_m: float,
    width_m: float,
    height_m: float,
    texel_m: float,
    colour: Floats,
    grain: float,
    rng: np.random.Generator,
) -> list[Floats]:
    # walls are seen from above, foreshortened: fewer texels upwards keep them from flickering
    texels = (texel_m, 2.5 * texel_m)
    return [
        _plain((side, height_m), texels, colour, grain, rng) for side in (length_m, width_m) * 2
    ]


def _car(thing: Thing, light: Light, texel_m: float, rng: np.random.Generator) -> list[Part]:
    length, width, height = thing.size_m
    paint = _PAINTS[rng.integers(len(_PAINTS))] * rng.uniform(0.85, 1.05)
    glass = np.array([38.0, 46, 54])
    waist = 0.58 * height if thing.kind != "van" else 0.52 * height
    walls = _box_walls(length, width, waist - 0.18, texel_m, paint * 0.92, 0.02, rng)
    for wall in walls[0::2]:
        rows, columns = wall.shape[:2]
        for at in (0.2, 0.79):  # wheels
            half = int(0.34 / length * columns)
            wall[rows // 3 :, max(0, int(at * columns) - half) : int(at * columns) + half] = 26
    side = _rectangle(length * 0.98, width * 0.96, waist)
    parts: list[Part] = [*_prism(_rectangle(length, width, 0.18), side, walls, light)]
    deck = _plain((length * 0.98, width * 0.96), (texel_m, texel_m), paint, 0.015, rng)
    rows, columns = deck.shape[:2]
    hood = int(0.3 * columns) if thing.kind != "van" else int(0.15 * columns)
    cv2.rectangle(
        deck,
        (columns - hood, rows // 7),
        (columns - 2, rows - rows // 7),
        tuple(paint * 0.9),
        1,
        cv2.LINE_AA,
    )
    deck[: rows // 6, -max(1, columns // 30) :] = deck[-(rows // 6) :, -max(1, columns // 30) :] = (
        235,
        232,
        215,
    )
    deck[: rows // 6, : max(1, columns // 40)] = deck[-(rows // 6) :, : max(1, columns // 40)] = (
        170,
        30,
        26,
    )
    parts.append(_lid(side, deck, light))
    back, front = {"hatchback": (-0.49, 0.2), "saloon": (-0.36, 0.2), "van": (-0.49, 0.36)}[
        thing.kind
    ]
    rake = {"hatchback": (0.04, 0.14), "saloon": (0.12, 0.15), "van": (0.01, 0.1)}[thing.kind]
    cabin, roof = (front - back) * length, (front - back - sum(rake)) * length
    base = _rectangle(cabin, width * 0.9, waist, (front + back) / 2 * length)
    top = _rectangle(roof, width * 0.72, height, (front - rake[1] + back + rake[0]) / 2 * length)
    windows = _box_walls(cabin, width * 0.9, height - waist, texel_m, glass, 0.12, rng)
    parts += _prism(base, top, windows, light)
    shine = _plain((roof, width * 0.72), (texel_m, texel_m), paint * 1.03, 0.015, rng)
    parts.append(_lid(top, shine, light))
    return parts


def _small(thing: Thing, light: Light, texel_m: float, rng: np.random.Generator) -> list[Part]:
    length, width, height = thing.size_m
    if thing.kind == "tyre":
        rubber = _disc((length, width), texel_m, np.array([30.0, 30, 33]), 1.0)
        rows, columns = rubber.shape[:2]
        y, x = np.mgrid[0:rows, 0:columns]
        hole = np.hypot((x + 0.5) / columns * 2 - 1, (y + 0.5) / rows * 2 - 1) < 0.5
        rubber[hole] = 0
        return [_level((0, 0, z), (length, width), rubber) for z in (0.02, 0.5 * height, height)]
    if thing.kind == "gas bottle":
        colour = np.array([[200.0, 60, 40], [60, 110, 170], [190, 190, 186]])[rng.integers(3)]
        side = np.full(
            (max(2, _texels(height, 2 * texel_m)), max(2, _texels(width, texel_m)), 3), colour * 0.8
        )
        return [
            StandingPart(0.0, (width, 0.92 * height), opaque(side.astype(np.uint8))),
            _level(
                (0, 0, 0.9 * height),
                (length, width),
                _disc((length, width), texel_m, colour, light.shade(_UP)),
            ),
            _level(
                (0, 0, height),
                (0.12, 0.12),
                _disc((0.12, 0.12), texel_m, np.array([90.0, 88, 84]), 1.0),
            ),
        ]
    colours = {
        "box": (178, 138, 92),
        "big box": (170, 130, 86),
        "suitcase": (44, 46, 70),
        "metal suitcase": (176, 180, 186),
        "bag": (92, 44, 40),
    }
    colour = np.array(colours[thing.kind], np.float64) * rng.uniform(0.85, 1.15)
    taper = 0.8 if thing.kind == "bag" else 1.0
    walls = _box_walls(length, width, height, texel_m, colour, 0.05, rng)
    lid = _plain((length * taper, width * taper), (texel_m, texel_m), colour, 0.05, rng)
    rows, columns = lid.shape[:2]
    if "box" in thing.kind:
        tape = max(1, round(rows * 0.12))
        lid[(rows - tape) // 2 : (rows + tape) // 2 + 1] = (206, 184, 142)
    elif "suitcase" in thing.kind:
        lid[:: max(2, rows // 5)] *= 0.7
        lid[rows // 2 - rows // 8 : rows // 2 + rows // 8 + 1, -max(1, columns // 8) :] = (
            30,
            30,
            32,
        )
    top = _rectangle(length * taper, width * taper, height)
    return [*_prism(_rectangle(length, width, 0.0), top, walls, light), _lid(top, lid, light)]


def _tree(thing: Thing, light: Light, texel_m: float, rng: np.random.Generator) -> list[Part]:
    """A crown of leafy layers, denser and darker inside, bright on the sun's side, above a trunk."""
    width, _, height = thing.size_m
    is_bush = thing.kind == "bush"
    green = np.array([[66.0, 88, 42], [82, 98, 48], [54, 78, 44], [98, 104, 56]])[rng.integers(4)]
    low = 0.05 * height if is_bush else 0.3 * height
    # a crown that is few pixels wide needs few layers
    count = int(np.clip(width / texel_m / 14, 3, 4 if is_bush else 9))
    parts: list[Part] = []
    if not is_bush:
        bark = np.full(
            (_texels(low, 2 * texel_m) + 1, max(2, _texels(0.3, texel_m)), 3),
            (84, 66, 50),
            np.uint8,
        )
        parts.append(StandingPart(0.0, (0.3, low * 1.3), opaque(bark)))
    side = max(6, _texels(width, texel_m))
    y, x = np.mgrid[0:side, 0:side].astype(np.float32)
    x, y = (x + 0.5) / side * 2 - 1, 1 - (y + 0.5) / side * 2
    lobes = fractal(rng, (side, side), texel_m, (0.25 * width, 0.12 * width), (1.0, 0.6))
    sun = light.sun / light.sun[2]
    for level in range(count):
        share = (level + 0.5) / count  # 0 at the crown's foot, 1 at its top
        reach = np.sqrt(max(0.03, 1 - (1.7 * share - 0.7) ** 2))
        leaves = fractal(rng, (side, side), texel_m, (0.05, 0.11, 0.24, 0.55), (0.9, 1.2, 0.9, 0.7))
        radius = np.hypot(x, y) * (1 + 0.13 * lobes)
        alpha = np.clip(4.0 * (reach * 0.93 - radius) * side * texel_m / 0.5 + 0.9 * leaves, 0, 1)
        alpha *= np.clip(1.35 + 0.55 * leaves - 0.5 * share, 0.25, 1)
        lit = 0.5 + 0.5 * share + 0.16 * (x * sun[0] + y * sun[1]) + 0.27 * leaves + 0.1 * lobes
        rgb = np.clip(green * np.clip(lit, 0.25, 1.7)[..., None], 0, 255)
        sway = (
            np.array(thing.sway_m) * (0.3 + share)
            if not is_bush
            else np.array(thing.sway_m) * share
        )
        sway = thing.turn[:2, :2].T @ sway
        z = low + (height - low) * share
        parts.append(
            _level((sway[0], sway[1], z), (width, width), cut_out(rgb.astype(np.uint8), alpha))
        )
    return parts


def _house(thing: Thing, light: Light, texel_m: float, rng: np.random.Generator) -> list[Part]:
    length, width, height = thing.size_m
    plaster = np.array([[226.0, 214, 190], [214, 196, 160], [206, 178, 150], [220, 220, 214]])[
        rng.integers(4)
    ]
    is_flat = thing.kind == "flat roof"
    eaves = height if is_flat else height - 0.28 * width
    walls = _box_walls(length, width, eaves, texel_m, plaster, 0.05, rng)
    for wall in walls:
        _paint_windows(wall, eaves)
    base, top = _rectangle(length, width, 0.0), _rectangle(length, width, eaves)
    parts: list[Part] = list(_prism(base, top, walls, light))
    if is_flat:
        return parts + _flat_roof(length, width, height, light, texel_m, rng)
    gable = _plain((width, height - eaves), (texel_m, 2.5 * texel_m), plaster, 0.04, rng)
    rows, columns = gable.shape[:2]
    slope = (
        np.abs((np.arange(columns) + 0.5) / columns * 2 - 1)[None, :]
        <= ((np.arange(rows) + 0.5) / rows)[:, None]
    )
    for sign in (1.0, -1.0):
        normal = np.array([sign, 0.0, 0.0])
        x, left = sign * length / 2, -sign * width / 2
        texture = cut_out(
            np.clip(gable * light.shade(normal), 0, 255).astype(np.uint8), slope.astype(np.float32)
        )
        parts.append(
            _quad(
                np.array([x, left, height]),
                np.array([x, -left, height]),
                np.array([x, -left, eaves]),
                np.array([x, left, eaves]),
                texture,
                normal,
            )
        )
    out, drop = (
        0.35,
        0.35 * 0.56,
    )  # the roof hangs over the walls, downhill at the pitch of 0.28 / 0.5
    for sign in (1.0, -1.0):
        normal = np.array([0.0, sign * 0.56, 1.0]) / np.hypot(1, 0.56)
        tiles = _roof_tiles((length + 2 * out, (width / 2 + out) * 1.146), texel_m, rng)
        end, edge = length / 2 + out, sign * (width / 2 + out)
        ridge = [np.array([-sign * end, 0.0, height]), np.array([sign * end, 0.0, height])]
        foot = [
            np.array([sign * end, edge, eaves - drop]),
            np.array([-sign * end, edge, eaves - drop]),
        ]
        # seen from above and downhill, the ridge is the texture's top
        corners = (ridge[1], ridge[0], foot[1], foot[0])
        parts.append(_quad(*corners, _as_texture(tiles, light.shade(normal)), normal))
    return parts


def _roof_tiles(size_m: tuple[float, float], texel_m: float, rng: np.random.Generator) -> Floats:
    clay = np.array([[172.0, 98, 70], [156, 92, 72], [128, 84, 70]])[rng.integers(3)]
    tiles = _plain(size_m, (texel_m, texel_m), clay, 0.1, rng)
    rows, columns = tiles.shape[:2]
    fine = 6  # drawn finely and averaged: rows of tiles would alias
    along = np.arange(columns * fine) / fine * texel_m
    down = np.arange(rows * fine) / fine * texel_m
    across = (0.5 + 0.5 * np.cos(2 * np.pi * along / 0.24)).reshape(columns, fine).mean(axis=1)
    courses = ((down % 0.36) < 0.07).reshape(rows, fine).mean(axis=1)
    tiles *= (0.84 + 0.26 * across)[None, :, None] * (1 - 0.35 * courses)[:, None, None]
    patches = cv2.resize(
        rng.standard_normal((int(size_m[1] / 0.36) + 1, int(size_m[0] / 0.24) + 1)),
        (columns, rows),
        interpolation=cv2.INTER_AREA if texel_m > 0.24 else cv2.INTER_NEAREST,
    )
    return tiles * (1 + 0.07 * patches[..., None])


def _flat_roof(
    length: float,
    width: float,
    height: float,
    light: Light,
    texel_m: float,
    rng: np.random.Generator,
) -> list[Part]:
    felt = _plain(
        (length, width),
        (texel_m, texel_m),
        np.array([142.0, 140, 136]) * rng.uniform(0.7, 1.2),
        0.09,
        rng,
    )
    rows = felt.shape[0]
    rim = max(1, round(0.25 / texel_m))
    felt[:rim] = felt[-rim:] = felt[:, :rim] = felt[:, -rim:] = (206, 204, 198)
    for seam in np.arange(1.2, length - 0.6, 1.6):
        cv2.line(
            felt,
            (int(seam / texel_m), rim),
            (int(seam / texel_m), rows - rim),
            (112, 110, 108),
            1,
            cv2.LINE_AA,
        )
    parts: list[Part] = [_lid(_rectangle(length, width, height), felt, light)]
    for _ in range(int(rng.integers(1, 4))):
        a, b, c = rng.uniform(0.8, 1.6), rng.uniform(0.8, 1.3), rng.uniform(0.6, 1.1)
        x = rng.uniform(-0.35, 0.35) * length
        y = rng.uniform(-0.32, 0.32) * width
        foot = _rectangle(a, b, height) + np.array([x, y, 0.0])
        top = foot + np.array([0.0, 0.0, c])
        metal = np.array([190.0, 192, 194])
        walls = _box_walls(a, b, c, texel_m, metal * 0.85, 0.04, rng)
        parts += _prism(foot, top, walls, light)
        lid = _plain((a, b), (texel_m, texel_m), metal, 0.03, rng)
        fan = min(lid.shape[:2])
        cv2.circle(
            lid,
            (lid.shape[1] // 2, lid.shape[0] // 2),
            max(1, fan // 3),
            (70, 72, 74),
            -1,
            cv2.LINE_AA,
        )
        parts.append(_lid(top, lid, light))
    return parts


def _paint_windows(wall: Floats, height_m: float) -> None:
    rows, columns = wall.shape[:2]
    floors = max(1, round(height_m / 3.0))
    for floor in range(floors):
        top = int((floor + 0.25) / floors * rows)
        bottom = max(top + 1, int((floor + 0.7) / floors * rows))
        windows = max(1, columns * 3 // max(rows * 4, 1))
        for window in range(windows):
            left = int((window + 0.35) / windows * columns)
            right = max(left + 1, int((window + 0.6) / windows * columns))
            wall[top:bottom, left:right] = (62, 74, 84)
