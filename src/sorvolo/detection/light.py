"""Any picture of a drone's to RGB of eight bits, and whether it was taken by a thermal camera."""

import numpy as np

from sorvolo.errors import InputError
from sorvolo.geometry.arrays import Anything, Floats, ImageRGB

_LEAST_SPAN = 64  # counts; a thermal frame of one temperature is not stretched until its noise fills the range
_STRETCH_PERCENT = (0.5, 99.5)
_COLOUR_LEVELS = 10  # grey through a video's coding strays by up to five; daylight pictures of ours reach 17 and more
_COLOUR_SHARE = 0.01  # of a picture may have colour and the picture still be grey: a logo, a cross-hair
_GLIMPSE_STEP = 4


def rgb_from_picture(picture: Anything) -> ImageRGB:
    """Any picture as (H, W, 3) uint8 RGB; it may be a read-only view into what was given.

    Taken are uint8 and uint16 of shape (H, W), (H, W, 1), (H, W, 3) and (H, W, 4), whose alpha is dropped. Grey of
    sixteen bits is a thermal camera's raw frame and is stretched between its 0.5th and 99.5th percentile; colour of
    sixteen bits keeps its upper eight. Raises InputError for anything else.
    """
    _check(picture)
    if picture.ndim == 2 or picture.shape[2] == 1:
        grey = picture if picture.ndim == 2 else picture[:, :, 0]
        eight = grey if grey.dtype == np.uint8 else _stretched(grey)
        return np.broadcast_to(eight[:, :, None], (*eight.shape, 3))
    colour = picture[:, :, :3]
    return colour if colour.dtype == np.uint8 else _upper_bits(colour)


def is_thermal(picture: Anything) -> bool:
    """Whether a picture is a thermal camera's: one channel, or three that say the same.

    A daylight picture has some colour somewhere, even over sea, sand or asphalt; a thermal one has none, white hot or
    black hot. False-colour palettes count as colour, and a monochrome daylight camera counts as thermal. Raises
    InputError as `rgb_from_picture` does.
    """
    _check(picture)
    if picture.ndim == 2 or picture.shape[2] == 1:
        return True
    red, green, blue = (picture[::_GLIMPSE_STEP, ::_GLIMPSE_STEP, channel] for channel in range(3))
    spread = np.maximum(np.maximum(red, green), blue) - np.minimum(np.minimum(red, green), blue)
    levels = _COLOUR_LEVELS * (256 if picture.dtype == np.uint16 else 1)
    return bool(np.count_nonzero(spread > levels) <= _COLOUR_SHARE * spread.size)


def _check(picture: Anything) -> None:
    found = f"{getattr(picture, 'dtype', type(picture).__name__)} of shape {getattr(picture, 'shape', '?')}"
    needed = "needed is a NumPy array of uint8 or uint16, (H, W), (H, W, 1), (H, W, 3) RGB or (H, W, 4) RGBA"
    if not isinstance(picture, np.ndarray) or picture.dtype not in (np.uint8, np.uint16):
        advice = ""
        if isinstance(picture, np.ndarray) and picture.dtype.kind == "f":
            advice = "; bring values from 0 to 1 to eight bits with (255 * picture).astype('uint8')"
        raise InputError(f"this is no picture: {found}; {needed}{advice}")
    if picture.ndim not in (2, 3) or (picture.ndim == 3 and picture.shape[2] not in (1, 3, 4)) or picture.size == 0:
        advice = ""
        if picture.ndim == 3 and picture.shape[0] in (1, 3, 4):
            advice = "; the channels come first here: picture.transpose(1, 2, 0) puts them last"
        raise InputError(f"this is no picture: {found}; {needed}{advice}")


def _stretched(grey: Anything) -> Anything:
    """(H, W) uint8: sixteen bits of heat, stretched over what occurs in the frame."""
    low, high = _range(grey)
    scaled = (grey.astype(np.float32) - np.float32(low)) * np.float32(255 / (high - low))
    return np.clip(scaled + 0.5, 0, 255).astype(np.uint8)


def _range(grey: Anything) -> Floats:
    low, high = np.percentile(grey, _STRETCH_PERCENT)
    spare = max(0.0, _LEAST_SPAN - (high - low)) / 2
    return np.array([low - spare, high + spare])


def _upper_bits(colour: Anything) -> ImageRGB:
    return (colour >> 8).astype(np.uint8)
