"""How small a thing the comparison finds on a flight: things of known sizes are drawn into its own views."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from sorvolo.change.light import BLACK_LEVEL
from sorvolo.change.outlines import dilated
from sorvolo.geometry.arrays import Bytes, Floats, Floats32, ImageRGB, Mask, shrunk
from sorvolo.survey.findings import ComparedView

_COLOURS = np.array(
    [  # of cars, clothes and tarpaulins: white, silver, black, red, blue, yellow, green
        [235, 235, 230],
        [180, 182, 184],
        [28, 28, 32],
        [190, 40, 35],
        [40, 75, 160],
        [220, 180, 40],
        [60, 110, 60],
    ],
    np.float32,
)


# How a planted thing is painted. Lengths in its own sides.
_WIDTH = 0.6  # of its length: between a person seen from above and a car
_BAND = (0.45, 0.8)  # length and width of a darker band across it ...
_BAND_SHADE = 0.55  # ... and the share of light that it lacks
_SHADOW = 0.22  # how far its shadow reaches
_SHADE = 0.5  # the share of light that the shadow lacks


# What is drawn into which views. Sizes are the longer sides of things in pixels of a compared view.
SIZES_PX = (5.0, 7.0, 10.0, 14.0, 20.0, 28.0, 40.0)
CONTRASTS = (1.0, 0.35)  # plain and faint: of the thing's own colour, the rest is the ground's
_APART_PX = 100  # a grid of this side, so that each thing stands on ground of its own
_FIRST_STEP = 4  # every fourth view at first ...
_STEPS_ALIKE = 6  # ... and after this many a half of them: planting costs a third of a comparison
_SHOWN = 0.25  # of a thing's pixels marked as changed: found
_WANTED = 0.8  # of the things of a size found: that size is found
_LEAST_PLANTED = 10  # things of a contrast: fewer show nothing
_LEAST = 0.5  # of the largest things found: on ground with less the comparison is blind


@dataclass(frozen=True)
class Planted:
    """One thing that was drawn: its longer side, by how much it differs, how rough the ground is, whether found."""

    size_px: float
    contrast: float
    texture: float
    found: bool


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """How small a thing of one contrast is found, from all that were planted.

    A thing of s pixels on ground of texture t is found with the probability 1 / (1 + exp(-w . (1, log s, log t))).
    `weights` (3,) are NaN where nothing was found; where too few were planted, nothing `is_known`.
    """

    contrast: float
    is_known: bool
    weights: Floats

    def smallest_px(self, texture: Floats) -> Floats:
        """The size in pixels that is found in `wanted` of all cases on ground of these textures; NaN: none known."""
        if not self.is_known:
            return np.full(len(texture), np.nan)
        bias, by_size, by_texture = self.weights
        needed = np.log(_WANTED / (1 - _WANTED))
        size = np.exp((needed - bias - by_texture * np.log(texture)) / by_size)
        return np.where(size <= max(SIZES_PX), size, np.nan)

    def is_blind(self, texture: Floats) -> Mask:
        """Whether on ground of these textures most of the largest things are missed."""
        if not self.is_known:
            return np.zeros(len(texture), bool)
        logit = self.weights @ np.array(
            [
                np.ones(len(texture)),
                np.full(len(texture), np.log(max(SIZES_PX))),
                np.log(texture),
            ]
        )
        needed = np.log(_LEAST / (1 - _LEAST))
        return ~(logit >= needed)


class Planting:
    """Chooses views of a flight and plants things in them. Only `plant` and `pass_over` change it."""

    def __init__(self) -> None:
        self._views = self._planted = 0
        self._step = _FIRST_STEP

    def plant(self, view: ComparedView, find: Callable[[ImageRGB], Mask]) -> tuple[Planted, ...]:
        """Things planted in the view, if it is its turn. `find` (h, w) marks what differs between the map and a picture
        that stands in for the view's own."""
        if not self.pass_over():
            return ()
        return planted_in(view, find, np.random.default_rng(self._planted))

    def pass_over(self) -> bool:
        """Count a view in which an earlier process planted; whether it was its turn."""
        is_due = self._views % self._step == 0
        self._views += 1
        if is_due:
            self._planted += 1
            if self._planted % _STEPS_ALIKE == 0:
                self._step *= 2
        return is_due


def planted_in(
    view: ComparedView, find: Callable[[ImageRGB], Mask], rng: np.random.Generator
) -> tuple[Planted, ...]:
    """Draw things of all sizes and contrasts where the view shows no change, and see which are found."""
    rough = texture(view)
    picture = view.image.copy()
    free = view.valid & ~dilated(view.changed, 9)
    drawn: list[tuple[float, float, float, tuple[slice, slice], Mask]] = []
    for number, place in enumerate(_places(free, rng)):
        size = SIZES_PX[number % len(SIZES_PX)]
        contrast = CONTRASTS[number // len(SIZES_PX) % len(CONTRASTS)]
        window, mask = _draw(picture, place, size, contrast, rng)
        scale = rough.shape[0] / view.valid.shape[0]
        here = rough[
            min(int(place[1] * scale), rough.shape[0] - 1),
            min(int(place[0] * scale), rough.shape[1] - 1),
        ]
        drawn.append((size, contrast, float(here), window, mask))
    if not drawn:
        return ()
    marked = find(picture)
    return tuple(
        Planted(size, contrast, here, bool(marked[window][mask].mean() >= _SHOWN))
        for size, contrast, here, window, mask in drawn
    )


def texture(view: ComparedView) -> Floats32:
    """How rough the ground is that a view shows, (h / 8, w / 8): the mean distance of a pixel from its surroundings in
    octaves of light, never less than what the eight bits of a picture leave."""
    gray = cv2.resize(
        cv2.cvtColor(view.image, cv2.COLOR_RGB2GRAY),
        None,
        fx=0.5,
        fy=0.5,
        interpolation=cv2.INTER_AREA,
    )
    level = np.log2(gray.astype(np.float32) + np.float32(BLACK_LEVEL))
    detail = cv2.absdiff(level, cv2.blur(level, (9, 9)))
    size = max(1, gray.shape[1] // 4), max(1, gray.shape[0] // 4)
    coarse = shrunk(cv2.blur(detail, (13, 13)), size)
    return np.asarray(np.maximum(coarse, 2e-3), np.float32)


def are_enough(planted: Sequence[Planted], contrast: float) -> bool:
    """Whether so many things of this contrast were planted that they show how small a thing is found."""
    return sum(each.contrast == contrast for each in planted) >= _LEAST_PLANTED


def sensitivities(planted: Sequence[Planted]) -> tuple[Sensitivity, ...]:
    """What was found of everything planted, a record for each contrast."""
    of_contrast = [
        [each for each in planted if each.contrast == contrast] for contrast in CONTRASTS
    ]
    return tuple(
        Sensitivity(contrast, are_enough(planted, contrast), _weights(own))
        for contrast, own in zip(CONTRASTS, of_contrast, strict=True)
    )


def recall_curve(planted: Sequence[Planted]) -> list[dict[str, Any]]:
    """How many things of each contrast and size were planted and found, as a report has it."""
    curve = []
    for contrast in CONTRASTS:
        for size in SIZES_PX:
            found = [
                each.found for each in planted if (each.contrast, each.size_px) == (contrast, size)
            ]
            curve.append(
                {"contrast": contrast, "size_px": size, "planted": len(found), "found": sum(found)}
            )
    return curve


def _places(free: Mask, rng: np.random.Generator) -> list[tuple[float, float]]:
    """Middles of things in random order, x and y: on known ground without change, each in a square of its own."""
    half = _APART_PX // 2
    around = int(max(SIZES_PX)) + 4
    places = []
    for y in range(half, free.shape[0] - half + 1, _APART_PX):
        for x in range(half, free.shape[1] - half + 1, _APART_PX):
            part = free[max(y - around, 0) : y + around + 1, max(x - around, 0) : x + around + 1]
            if part.shape == (2 * around + 1,) * 2 and part.all():
                places.append((float(x), float(y)))
    return [places[index] for index in rng.permutation(len(places))]


def _draw(
    picture: ImageRGB,
    place: tuple[float, float],
    size_px: float,
    contrast: float,
    rng: np.random.Generator,
) -> tuple[tuple[slice, slice], Mask]:
    """Paint a thing over the ground, seen from above with its shadow: where that is, and which pixels are the thing's.

    It is a rectangle with a darker band across it, turned at random, with the soft rim of a lens.
    """
    reach = int(size_px) + 4
    x, y = int(place[0]) - reach, int(place[1]) - reach
    window = np.s_[y : y + 2 * reach + 1, x : x + 2 * reach + 1]
    ground, middle = picture[window].astype(np.float32), reach + rng.random(2)
    sides = np.array([size_px, _WIDTH * size_px])
    turn_deg = float(rng.uniform(0, 180))
    body, band, shadow = (
        _rectangle(len(ground), centre, size, turn_deg)[..., None]
        for centre, size in (
            (middle, sides),
            (middle, sides * _BAND),
            (middle + _SHADOW * size_px, sides),
        )
    )
    thing = _COLOURS[rng.integers(len(_COLOURS))] * (1 - _BAND_SHADE * band) + rng.normal(
        0, 2.0, ground.shape
    )
    under = ground * (1 - _SHADE * contrast * shadow)
    painted = under * (1 - body) + body * (ground + contrast * (thing - ground))
    picture[window] = np.clip(np.rint(painted), 0, 255).astype(np.uint8)
    return window, body[..., 0] > 0.5


def _rectangle(side_px: int, middle: Floats, sides: Floats, turn_deg: float) -> Floats32:
    """The share of each pixel, (side_px, side_px), that a rectangle covers behind a lens."""
    corners = cv2.boxPoints((middle.tolist(), sides.tolist(), turn_deg))
    fine: Bytes = np.zeros((8 * side_px,) * 2, np.uint8)
    cv2.fillPoly(fine, [np.rint(corners * 8).astype(np.int32)], 255)
    mask = shrunk(fine, (side_px, side_px)).astype(np.float32) / 255
    return np.asarray(cv2.GaussianBlur(mask, (0, 0), 0.6), np.float32)


def _weights(planted: Sequence[Planted]) -> Floats:
    """(3,) logistic regression by Newton's method, drawn a little towards recall that grows with size; NaN where
    nothing was found."""
    if not any(each.found for each in planted):
        return np.full(3, np.nan)
    x = np.array([[1.0, np.log(each.size_px), np.log(each.texture)] for each in planted])
    y = np.array([each.found for each in planted], float)
    prior, strength = np.array([0.0, 2.0, 0.0]), np.diag([1e-3, 0.2, 0.2])
    weights = prior.copy()
    for _ in range(30):
        chance = 1 / (1 + np.exp(-np.clip(x @ weights, -30, 30)))
        gradient = x.T @ (y - chance) - strength @ (weights - prior)
        curvature = (x * (chance * (1 - chance))[:, None]).T @ x + strength
        step = np.linalg.solve(curvature, gradient)
        weights = weights + step * min(1.0, 5.0 / float(np.linalg.norm(step) + 1e-12))
    return weights if weights[1] > 0 else np.full(3, np.nan)
