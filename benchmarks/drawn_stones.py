"""Stones drawn from real textures, for what is nobody: facets under one sun, a cast shadow, any shape of outline."""

from dataclasses import dataclass, replace

import cv2
import numpy as np

from people_samples import Shown, laid, softened
from sorvolo.geometry.arrays import ImageRGB


@dataclass(frozen=True)
class StoneSettings:
    """How many stones lie on a picture, and how large they are."""

    most: int = 8
    sizes_m: tuple[float, float] = (0.25, 2.2)
    px_per_m: tuple[float, float] = (15.0, 80.0)
    sides_px: tuple[float, float] = (10.0, 220.0)
    together: float = 0.4  # share of pictures on which they lie in a heap


def with_stones(
    below: Shown,
    texture: ImageRGB,
    rng: np.random.Generator,
    settings: StoneSettings = StoneSettings(),
) -> Shown:
    """The picture with some stones of a real picture's `texture` on it, none over a person."""
    side = below.image.shape[0]
    px_per_m = float(np.exp(rng.uniform(*np.log(settings.px_per_m))))
    picture, owner = below.image.astype(np.float32), np.zeros((side, side), np.int32)
    sunlight, soft = float(rng.uniform(0.2, 0.8)), max(0.0, rng.normal(0.3, 0.45))
    middle, is_heap = rng.uniform(0.1, 0.9, 2) * side, rng.random() < settings.together
    plain = np.array([[1.0, 1.0, 1.0], [0.0, 0.0, 0.0]])
    for _ in range(int(rng.integers(1, settings.most + 1))):
        cut = stone(texture, px_per_m, rng, settings)
        cut[..., :3] *= cut[..., 3:4] / 255
        cut = softened(cut, soft)
        centre = (
            middle + rng.normal(0, 1.5, 2) * px_per_m if is_heap else rng.uniform(0, 1, 2) * side
        )
        left, top = corner = np.round(centre - cut.shape[0] / 2).astype(int)
        over = (below.boxes[:, 0] < left + cut.shape[1]) & (below.boxes[:, 2] > left)
        over &= (below.boxes[:, 1] < top + cut.shape[0]) & (below.boxes[:, 3] > top)
        if not over.any():
            laid(picture, owner, cut, corner, 1, plain, sunlight)
    return replace(below, image=np.clip(picture, 0, 255).astype(np.uint8))


def stone(
    texture: ImageRGB,
    px_per_m: float,
    rng: np.random.Generator,
    settings: StoneSettings = StoneSettings(),
) -> np.ndarray:
    """(n, n, 5) float32: colours, cover and shade of one stone and its shadow, in pixels of the picture."""
    size_px = float(
        np.clip(np.exp(rng.uniform(*np.log(settings.sizes_m))) * px_per_m, *settings.sides_px)
    )
    side = int(size_px * 2.2) + 8
    rows, columns = np.mgrid[:side, :side].astype(np.float32)
    turn, aspect = rng.uniform(0, np.pi), rng.uniform(0.35, 1)
    across, along = columns - side / 2, rows - side / 2
    u = (across * np.cos(turn) + along * np.sin(turn)) / (size_px / 2)
    v = (along * np.cos(turn) - across * np.sin(turn)) / (size_px / 2 * aspect)
    angle = np.arctan2(v, u)
    edge = 1 + sum(
        rng.normal(0, 0.16 / k) * np.cos(k * angle + rng.uniform(0, 6.3)) for k in range(2, 7)
    )
    cover = np.clip((edge - np.hypot(u, v)) * size_px / 4 + 0.5, 0, 1)
    sun, height = rng.uniform(0, 2 * np.pi), rng.uniform(0.4, 1.3)
    tone = _lit(u, v, sun, height, rng)
    if rng.random() < 0.3:
        tone = cv2.GaussianBlur(tone, (0, 0), max(size_px * 0.05, 0.5))
    colours = _coloured(texture, side, rng) * tone[..., None]
    reach_px, shade = rng.uniform(0.05, 0.7) * size_px * aspect, np.zeros((side, side), np.float32)
    for share in np.linspace(0.15, 1, 6):
        moved = np.array(
            [[1, 0, -np.cos(sun) * reach_px * share], [0, 1, -np.sin(sun) * reach_px * share]],
            np.float32,
        )
        shade = np.maximum(shade, cv2.warpAffine(cover, moved, (side, side)))
    return np.dstack([np.clip(colours, 0, 255), cover * 255, shade * 255 * (1 - cover)]).astype(
        np.float32
    )


def _lit(
    u: np.ndarray, v: np.ndarray, sun: float, height: float, rng: np.random.Generator
) -> np.ndarray:
    """(n, n) how bright each place is: some facets, more or less rounded, under one sun."""
    count = int(rng.integers(3, 12))
    slopes, offsets = rng.normal(0, 0.9, (count, 2)), rng.uniform(0.4, 1, count)
    planes = offsets[:, None, None] + slopes[:, 0, None, None] * u + slopes[:, 1, None, None] * v
    facet, smooth = planes.argmin(0), rng.uniform(0, 1)
    east = smooth * u - (1 - smooth) * slopes[facet, 0] * 0.7
    south = smooth * v - (1 - smooth) * slopes[facet, 1] * 0.7
    light = (east * np.cos(sun) + south * np.sin(sun)) * np.cos(height) + np.sin(height)
    ambient = rng.uniform(0.25, 0.9)
    return np.asarray(
        ambient + (1 - ambient) * np.clip(light / np.sqrt(east**2 + south**2 + 1), 0, None) * 1.3
    )


def _coloured(texture: ImageRGB, side: int, rng: np.random.Generator) -> np.ndarray:
    """(side, side, 3) a piece of the texture, enlarged or not, in the colour of stones or in its own."""
    own = min(int(side / rng.uniform(0.5, 2)) + 2, *(each - 1 for each in texture.shape[:2]))
    top, left = (int(rng.integers(each - own)) for each in texture.shape[:2])
    piece = np.rot90(texture[top : top + own, left : left + own], int(rng.integers(4))).copy()
    piece = cv2.resize(piece, (side, side)).astype(np.float32)
    mean = piece.mean((0, 1))
    base = (
        np.exp(rng.normal(np.log(120), 0.45))
        * np.array([1.03, 1, 0.95])
        * rng.uniform(0.93, 1.07, 3)
    )
    if rng.random() < 0.4:
        base = mean * np.exp(rng.normal(0.1, 0.3))
    return np.asarray(
        (1 + (piece - mean) / max(float(mean.mean()), 20) * rng.uniform(0.4, 1.6)) * base
    )
