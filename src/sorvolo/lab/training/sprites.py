"""Small objects drawn onto real ground: no real labelled pictures of them can be had, so training composes them."""

from typing import Any, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from sorvolo.geometry.arrays import Floats, ImageRGB

Pixels: TypeAlias = NDArray[np.floating[Any]]
"""(height, width, 3) or (height, width) of float32 while a picture is worked on."""

_MOST = 5  # objects of a picture; by choice
_FINE = 4  # sub-pixels a side while drawing


def paste_small_objects(
    image: ImageRGB, taken: Floats, rng: np.random.Generator
) -> tuple[ImageRGB, Floats]:
    """The picture (H, W, 3) with a few boxes, cases, bags and tyres drawn on it, and their boxes (N, 4) px.

    `taken` (M, 4) is where others stand; nothing is drawn there. Shadows of one picture fall the same way.
    """
    height, width = image.shape[:2]
    out = image.astype(np.float32)
    sun = rng.uniform(0, 2 * np.pi)
    long = rng.uniform(0.0, 1.2)  # of a shadow, in heights
    typical = float(np.exp(rng.uniform(np.log(9), np.log(48))))
    placed: list[Floats] = []
    for _ in range(int(rng.integers(1, _MOST + 1))):
        size = typical * rng.uniform(0.6, 1.5)
        ratio = rng.uniform(0.45, 1.0)
        size = min(size, 0.3 * min(width, height))
        centre = rng.uniform(size, np.array([width, height]) - size)
        near = np.array([*(centre - size), *(centre + size)])
        others = np.vstack([taken.reshape(-1, 4), *placed]) if placed else taken.reshape(-1, 4)
        if (
            len(others)
            and (
                (others[:, 0] < near[2])
                & (others[:, 2] > near[0])
                & (others[:, 1] < near[3])
                & (others[:, 3] > near[1])
            ).any()
        ):
            continue
        placed.append(_draw(out, centre, size, ratio, sun, long, rng)[None])
    boxes = np.vstack(placed) if placed else np.zeros((0, 4))
    return np.clip(out, 0, 255).astype(np.uint8), boxes


def _draw(
    out: Pixels,
    centre: Floats,
    size: float,
    ratio: float,
    sun: float,
    long: float,
    rng: np.random.Generator,
) -> Floats:
    """Draw one object and its shadow into `out`; its box (4,)."""
    reach = int(np.ceil(size * 1.6)) + 2
    x0, y0 = (int(v) - reach for v in centre)
    side = 2 * reach
    shape = _outline(size, ratio, rng)
    local = (centre - (x0, y0))[None] + shape
    shadow = local + size * 0.45 * long * np.array([np.cos(sun), np.sin(sun)])
    dark = _filled([local, shadow], side)
    mask = _filled([local], side)
    ground = _window(out, x0, y0, side)
    tone = rng.uniform(15, 235) + rng.uniform(-45, 45, 3) * (rng.random() < 0.7)
    surface = np.ones((side, side, 3), np.float32) * np.clip(tone, 5, 250).astype(np.float32)
    grain = cv2.GaussianBlur(rng.normal(0, 1, (side, side)).astype(np.float32), (0, 0), 1.0)
    surface += (rng.uniform(2, 14) * grain)[..., None]
    lid = _filled([(local - local.mean(0)) * rng.uniform(0.25, 0.75) + local.mean(0)], side)
    surface += (rng.uniform(-45, 45) * lid)[..., None]
    depth = rng.uniform(0.3, 0.7) * (long > 0.1)
    drawn = ground * (1 - depth * dark[..., None])
    drawn = drawn * (1 - mask[..., None]) + surface * mask[..., None]
    soft = rng.uniform(0.3, 0.9)
    drawn = cv2.GaussianBlur(drawn, (0, 0), soft) if size > 10 else drawn
    blend = cv2.GaussianBlur(np.maximum(mask, dark), (0, 0), 1.0)[..., None]
    _put(out, x0, y0, ground * (1 - blend) + drawn * blend)
    corner = np.array([x0, y0])
    low, high = local.min(0) + corner, local.max(0) + corner
    height, width = out.shape[:2]
    return np.clip(np.array([*low, *high]), 0, [width, height, width, height])


def _outline(size: float, ratio: float, rng: np.random.Generator) -> Floats:
    """(N, 2) around zero: a turned rectangle, a rounded one, or an ellipse."""
    turn = rng.uniform(0, np.pi)
    if rng.random() < 0.7:
        corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1.0]])
    else:
        angles = np.linspace(0, 2 * np.pi, 16, endpoint=False)
        corners = np.stack([np.cos(angles), np.sin(angles)], 1)
        if rng.random() < 0.5:
            corners = np.sign(corners) * np.abs(corners) ** 0.6
    scaled = corners * (size / 2, size * ratio / 2)
    return scaled @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])


def _filled(shapes: list[Floats], side: int) -> Pixels:
    """(side, side) 0 to 1: how much of each pixel the hull of the shapes covers."""
    fine = np.zeros((side * _FINE, side * _FINE), np.uint8)
    hull = cv2.convexHull((np.vstack(shapes) * _FINE).astype(np.float32))
    cv2.fillConvexPoly(fine, hull.astype(np.int32), 255)
    return (
        np.asarray(cv2.resize(fine, (side, side), interpolation=cv2.INTER_AREA), np.float32) / 255
    )


def _window(out: Pixels, x0: int, y0: int, side: int) -> Pixels:
    rows = np.clip(np.arange(y0, y0 + side), 0, out.shape[0] - 1)
    columns = np.clip(np.arange(x0, x0 + side), 0, out.shape[1] - 1)
    return out[rows[:, None], columns[None]]


def _put(out: Pixels, x0: int, y0: int, patch: Pixels) -> None:
    height, width = out.shape[:2]
    left, top = max(0, -x0), max(0, -y0)
    right, bottom = min(patch.shape[1], width - x0), min(patch.shape[0], height - y0)
    out[y0 + top : y0 + bottom, x0 + left : x0 + right] = patch[top:bottom, left:right]
