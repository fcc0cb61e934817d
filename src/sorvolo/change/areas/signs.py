"""What a view shows of ground that changed as an area, and light cannot make: other structure, colour and roughness."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sorvolo.geometry.arrays import ImageRGB, Mask, Matrix3
from sorvolo.survey.findings import ComparedView

SIDE_PX = 320  # longest side at which views are examined: areas are large
_WINDOW_PX = 11  # over which structure is compared
_REACH_PX = 1  # alignment may be off by as much
_FINE_PX, _COARSE_PX = 1, 7  # structure is what lies between these sizes
_MOST_DETAIL = np.float32(0.2)  # octaves: the rim of a shadow is no more than a coarse texture
_COLOUR_PX = 7
_NOISE_LEVELS = 1.5  # grey levels of detail that noise and compression make, in the darker of both pictures
_LEANS, _ROUGH = 0.3, 6.0  # likeness of one date's pictures below which ground leans; power over noise that shows it
_BLACK_LEVEL = 8.0  # grey levels added before logarithms: below it a camera shows noise, not light
_SKY = np.array([0.7, -0.7], np.float32)  # blue and red over green, by which light from the sky differs from the sun's
_MOST_SKY, _OTHER_LIGHT = 0.35, 0.08  # octaves of that for each octave of brightness, at most; of any other colour

Signs = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class AreaSigns:
    """A view's ground on both dates at a small size, (h, w) each.

    `likeness` is the correlation of structure, -1 to 1: near 1 the ground is the same one in whatever light. `colour`
    (h, w, 2) is by how many octaves blue and red over green differ, less what light from the sky explains; `detail`
    by how many octaves the ground is rougher now, `surface` (h, w, 2) its colour now. `known` where both dates show it.
    """

    likeness: Signs
    colour: Signs
    detail: Signs
    surface: Signs
    known: Mask
    view_from_signs: Matrix3


def area_signs(view: ComparedView, leans: Mask | None = None) -> AreaSigns:
    """Compare the ground of a view with the map's. What `leans` (h, w) is not known."""
    height, width = view.valid.shape
    scale = min(1.0, SIDE_PX / max(height, width))
    size = max(1, round(width * scale)), max(1, round(height * scale))
    valid = view.valid if leans is None else view.valid & ~leans
    known = np.asarray(cv2.resize(valid.view(np.uint8) * np.uint8(255), size, interpolation=cv2.INTER_AREA) == 255)
    before, after = (_octaves(image, size) for image in (view.reference, view.image))
    levels = [each.mean(axis=2) for each in (before, after)]
    likeness, detail, _ = _structure(*levels)
    surface = _colour(after)
    brighter = _centred(_blurred(levels[1] - levels[0]), known)
    colour = _centred(_blurred(surface - _colour(before)), known)
    x, y = width / size[0], height / size[1]
    view_from_signs = np.array([[x, 0, (x - 1) / 2], [0, y, (y - 1) / 2], [0, 0, 1.0]])
    return AreaSigns(likeness, _without_sky(colour, brighter), detail, surface, known, view_from_signs)


def leaning(reference: ImageRGB, picture: ImageRGB, seen: Mask) -> Mask:
    """(h, w) where two pictures of one date, (h, w, 3), have structure and not the same one: crowns and walls that lean
    another way. Of such ground no area is reported. `seen` is where both show it."""
    height, width = seen.shape
    scale = min(1.0, SIDE_PX / max(height, width))
    size = max(1, round(width * scale)), max(1, round(height * scale))
    before, after = (_octaves(image, size).mean(axis=2) for image in (reference, picture))
    likeness, _, rough = _structure(before, after)
    found = (likeness < _LEANS) & (rough > _ROUGH)
    whole = cv2.morphologyEx(found.view(np.uint8), cv2.MORPH_CLOSE, np.ones((_WINDOW_PX, _WINDOW_PX), np.uint8))
    return np.asarray((cv2.resize(whole, (width, height), interpolation=cv2.INTER_NEAREST) > 0) & seen)


def _structure(before: Signs, after: Signs) -> tuple[Signs, Signs, Signs]:
    """The best correlation of detail over small shifts, by how many octaves there is more of it, and how many times as
    strong as noise it is where there is less of it."""
    window = (_WINDOW_PX, _WINDOW_PX)
    details = [
        np.clip(cv2.blur(each, (_FINE_PX,) * 2) - cv2.blur(each, (_COARSE_PX,) * 2), -_MOST_DETAIL, _MOST_DETAIL)
        for each in (before, after)
    ]
    noise = np.square(np.float32(_NOISE_LEVELS / np.log(2)) * np.exp2(-np.minimum(before, after)))
    power = [cv2.blur(each * each + noise, window) for each in details]
    best = np.full(before.shape, -1.0, np.float32)
    pad = _REACH_PX
    shifted, their_power = (
        cv2.copyMakeBorder(each, pad, pad, pad, pad, cv2.BORDER_REFLECT_101) for each in (details[0], power[0])
    )
    height, width = before.shape
    for dy in range(2 * pad + 1):
        for dx in range(2 * pad + 1):
            part = np.s_[dy : dy + height, dx : dx + width]
            products = cv2.blur(details[1] * shifted[part], window)
            np.maximum(best, products / np.sqrt(power[1] * their_power[part]), out=best)
    rough = np.minimum(*power) / cv2.blur(noise, window)
    return best, np.asarray(0.5 * np.log2(power[1] / power[0]), np.float32), np.asarray(rough, np.float32)


def _blurred(values: Signs) -> Signs:
    return np.asarray(cv2.blur(values, (_COLOUR_PX, _COLOUR_PX)), np.float32)


def _centred(values: Signs, known: Mask) -> Signs:
    """Values less their middle one on known ground."""
    return np.asarray(values - np.median(values[known], axis=0), np.float32) if known.any() else values


def _without_sky(colour: Signs, brighter: Signs) -> Signs:
    """The colour less what a shadow explains: ground that lost the sun's light is bluer."""
    along = colour @ _SKY
    explained = -_MOST_SKY * brighter
    taken = np.clip(along, np.minimum(explained, 0), np.maximum(explained, 0))
    left = colour - taken[..., None] * _SKY
    length = np.maximum(np.hypot(left[..., 0], left[..., 1]), 1e-6)
    return np.asarray(left * (np.maximum(length - _OTHER_LIGHT * np.abs(brighter), 0) / length)[..., None], np.float32)


def _colour(octaves: Signs) -> Signs:
    """(h, w, 2) blue and red over green."""
    return np.asarray(np.dstack([octaves[..., 2] - octaves[..., 1], octaves[..., 0] - octaves[..., 1]]), np.float32)


def _octaves(image: NDArray[np.uint8], size: tuple[int, int]) -> Signs:
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return np.asarray(np.log2(small.astype(np.float32) + _BLACK_LEVEL), np.float32)
