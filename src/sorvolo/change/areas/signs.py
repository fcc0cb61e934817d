"""What a view shows of ground that changed as an area, and light cannot make: other structure, colour and roughness."""

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from sorvolo.change.pair.illumination import BLACK_LEVEL
from sorvolo.geometry.arrays import ImageRGB, Mask, Matrix3
from sorvolo.survey.findings import ComparedView

_OCTAVES = np.log2(np.arange(256, dtype=np.float32) + np.float32(BLACK_LEVEL))  # of each grey level
_SKY = np.array(
    [0.7, -0.7], np.float32
)  # blue and red over green, by which light from the sky differs from the sun's

Signs = NDArray[np.float32]


@dataclass(frozen=True)
class SkySettings:
    """What light from the sky explains of a colour, in octaves for each octave of brightness (0025)."""

    most: float = 0.35  # along the sky's own colour
    other: float = 0.08  # of any other colour


@dataclass(frozen=True)
class SignSettings:
    """How structure, colour and roughness are compared (0025). Lengths in px of the small pictures."""

    side_px: int = 320  # longest side at which views are examined: areas are large
    window_px: int = 11  # over which structure is compared
    reach_px: int = 1  # alignment may be off by as much
    between_px: tuple[int, int] = (1, 7)  # structure is what lies between these sizes
    most_detail: float = 0.2  # octaves: the rim of a shadow is no more than a coarse texture
    colour_px: int = 7  # over which colour and brightness are averaged
    noise_levels: float = (
        1.5  # grey levels of detail that noise and compression make, in the darker of both pictures
    )
    leans: float = 0.3  # likeness of one date's pictures below which ground leans ...
    rough: float = 6.0  # ... where its detail has so many times the power of noise
    sky: SkySettings = field(default_factory=SkySettings)


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


def area_signs(
    view: ComparedView, leans: Mask | None = None, settings: SignSettings = SignSettings()
) -> AreaSigns:
    """Compare the ground of a view with the map's. What `leans` (h, w) is not known."""
    height, width = view.valid.shape
    size = _small(view.image, settings)
    valid = view.valid if leans is None else view.valid & ~leans
    known = np.asarray(
        cv2.resize(valid.view(np.uint8) * np.uint8(255), size, interpolation=cv2.INTER_AREA) == 255
    )
    before, after = (_octaves(image, size) for image in (view.reference, view.image))
    levels = [_level(each) for each in (before, after)]
    likeness, detail, _ = _structure(levels[0], levels[1], settings)
    surface = _colour(after)
    brighter = _centred(_blurred(levels[1] - levels[0], settings.colour_px), known)
    colour = _centred(_blurred(surface - _colour(before), settings.colour_px), known)
    x, y = width / size[0], height / size[1]
    view_from_signs = np.array([[x, 0, (x - 1) / 2], [0, y, (y - 1) / 2], [0, 0, 1.0]])
    return AreaSigns(
        likeness,
        _without_sky(colour, brighter, settings.sky),
        detail,
        surface,
        known,
        view_from_signs,
    )


def level_of(picture: ImageRGB, settings: SignSettings = SignSettings()) -> Signs:
    """How bright a picture, (h, w, 3), is, in octaves, at the size at which views are examined."""
    return _level(_octaves(picture, _small(picture, settings)))


def leaning(
    reference: Signs, picture: ImageRGB, seen: Mask, settings: SignSettings = SignSettings()
) -> Mask:
    """(h, w) where two pictures of one date, (h, w, 3), have structure and not the same one: crowns and walls that lean
    another way. Of such ground no area is reported. The first is given by its `level_of`, `seen` is where both show
    the ground."""
    height, width = seen.shape
    likeness, _, rough = _structure(reference, level_of(picture, settings), settings)
    found = (likeness < settings.leans) & (rough > settings.rough)
    window = np.ones((settings.window_px, settings.window_px), np.uint8)
    whole = cv2.morphologyEx(found.view(np.uint8), cv2.MORPH_CLOSE, window)
    return np.asarray(
        (cv2.resize(whole, (width, height), interpolation=cv2.INTER_NEAREST) > 0) & seen
    )


def _small(picture: ImageRGB, settings: SignSettings) -> tuple[int, int]:
    """Width and height at which a picture is examined."""
    height, width = picture.shape[:2]
    scale = min(1.0, settings.side_px / max(height, width))
    return max(1, round(width * scale)), max(1, round(height * scale))


def _structure(before: Signs, after: Signs, settings: SignSettings) -> tuple[Signs, Signs, Signs]:
    """The best correlation of detail over small shifts, by how many octaves there is more of it, and how many times as
    strong as noise it is where there is less of it."""
    window, most = (settings.window_px, settings.window_px), np.float32(settings.most_detail)
    fine, coarse = ((side, side) for side in settings.between_px)
    details = [
        np.clip(cv2.blur(each, fine) - cv2.blur(each, coarse), -most, most)
        for each in (before, after)
    ]
    noise = np.square(
        np.float32(settings.noise_levels / np.log(2)) * np.exp2(-np.minimum(before, after))
    )
    power = [cv2.blur(each * each + noise, window) for each in details]
    best = np.full(before.shape, -1.0, np.float32)
    pad = settings.reach_px
    shifted, their_power = (
        cv2.copyMakeBorder(each, pad, pad, pad, pad, cv2.BORDER_REFLECT_101)
        for each in (details[0], power[0])
    )
    height, width = before.shape
    for dy in range(2 * pad + 1):
        for dx in range(2 * pad + 1):
            part = np.s_[dy : dy + height, dx : dx + width]
            products = cv2.blur(details[1] * shifted[part], window)
            np.maximum(best, products / np.sqrt(power[1] * their_power[part]), out=best)
    rough = np.minimum(*power) / cv2.blur(noise, window)
    return (
        best,
        np.asarray(0.5 * np.log2(power[1] / power[0]), np.float32),
        np.asarray(rough, np.float32),
    )


def _blurred(values: Signs, side_px: int) -> Signs:
    return np.asarray(cv2.blur(values, (side_px, side_px)), np.float32)


def _centred(values: Signs, known: Mask) -> Signs:
    """Values less their middle one on known ground."""
    return (
        np.asarray(values - np.median(values[known], axis=0), np.float32) if known.any() else values
    )


def _without_sky(colour: Signs, brighter: Signs, settings: SkySettings) -> Signs:
    """The colour less what a shadow explains: ground that lost the sun's light is bluer."""
    along = colour @ _SKY
    explained = -settings.most * brighter
    taken = np.clip(along, np.minimum(explained, 0), np.maximum(explained, 0))
    left = colour - taken[..., None] * _SKY
    length = np.maximum(np.hypot(left[..., 0], left[..., 1]), 1e-6)
    other = settings.other * np.abs(brighter)
    return np.asarray(left * (np.maximum(length - other, 0) / length)[..., None], np.float32)


def _colour(octaves: Signs) -> Signs:
    """(h, w, 2) blue and red over green."""
    return np.asarray(
        np.dstack([octaves[..., 2] - octaves[..., 1], octaves[..., 0] - octaves[..., 1]]),
        np.float32,
    )


def _octaves(image: NDArray[np.uint8], size: tuple[int, int]) -> Signs:
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.LUT(small, _OCTAVES), np.float32)


def _level(octaves: Signs) -> Signs:
    """(h, w) the mean of the three colours; a sum of planes is five times as fast as NumPy's along a short axis."""
    return np.asarray(
        (octaves[..., 0] + octaves[..., 1] + octaves[..., 2]) / np.float32(3), np.float32
    )
