"""Any picture of a drone's to RGB of eight bits, and whether it was taken by a thermal camera."""

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from sorvolo.errors import InputError
from sorvolo.geometry.arrays import ImageGray, ImageRGB

Picture: TypeAlias = NDArray[np.uint8] | NDArray[np.uint16]
"""(H, W) or (H, W, 1) grey, (H, W, 3) RGB, (H, W, 4) RGBA: any picture that a drone's camera makes."""

_LEAST_SPAN = 64  # counts; a thermal frame of one temperature is not stretched until its noise fills the range
_STRETCH_PERCENT = (
    0.5,
    99.5,
)  # percentiles that become black and white: single hot pixels take no range; by choice
_COLOUR_LEVELS = 10  # grey through a video's coding strays by up to five; daylight pictures of ours reach 17 and more
# of a picture may have colour and the picture still be grey: a logo, a cross-hair
_COLOUR_SHARE = 0.01
_GLIMPSE_STEP = 4  # px between the pixels that are asked whether there is colour


def rgb_from_picture(picture: Picture) -> ImageRGB:
    """Any picture as (H, W, 3) uint8 RGB; it may be a read-only view into what was given.

    Taken are uint8 and uint16 of shape (H, W), (H, W, 1), (H, W, 3) and (H, W, 4), whose alpha is dropped. Grey of
    sixteen bits is a thermal camera's raw frame and is stretched between its 0.5th and 99.5th percentile; colour of
    sixteen bits keeps its upper eight. Raises InputError for anything else.
    """
    _check(picture)
    if picture.ndim == 2 or picture.shape[2] == 1:
        grey = picture if picture.ndim == 2 else picture[:, :, 0]
        eight = _stretched(grey) if grey.dtype == np.uint16 else np.asarray(grey, np.uint8)
        return np.broadcast_to(eight[:, :, None], (*eight.shape, 3))
    colour = picture[:, :, :3]
    return (
        (colour >> 8).astype(np.uint8)
        if colour.dtype == np.uint16
        else np.asarray(colour, np.uint8)
    )


def is_thermal(picture: Picture) -> bool:
    """Whether a picture is a thermal camera's: one channel, or three alike.

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


def _check(picture: object) -> None:
    found = f"{getattr(picture, 'dtype', type(picture).__name__)} of shape {getattr(picture, 'shape', '?')}"
    needed = "needed is a NumPy array of uint8 or uint16, (H, W), (H, W, 1), (H, W, 3) RGB or (H, W, 4) RGBA"
    if not isinstance(picture, np.ndarray) or picture.dtype not in (np.uint8, np.uint16):
        raise InputError(f"this is no picture: {found}; {needed}{_type_advice(picture)}")
    if (
        picture.ndim not in (2, 3)
        or (picture.ndim == 3 and picture.shape[2] not in (1, 3, 4))
        or picture.size == 0
    ):
        raise InputError(f"this is no picture: {found}; {needed}{_shape_advice(picture.shape)}")


def _type_advice(picture: object) -> str:
    if isinstance(picture, np.ndarray) and picture.dtype.kind == "f":
        return "; bring values from 0 to 1 to eight bits with (255 * picture).astype('uint8')"
    return ""


def _shape_advice(shape: tuple[int, ...]) -> str:
    if len(shape) == 3 and shape[0] in (1, 3, 4):
        return "; the channels come first here: picture.transpose(1, 2, 0) puts them last"
    return ""


def _stretched(grey: Picture) -> ImageGray:
    """(H, W) uint8: sixteen bits of heat, stretched over what occurs in the frame."""
    low, high = np.percentile(grey, _STRETCH_PERCENT)
    spare = max(0.0, _LEAST_SPAN - (high - low)) / 2
    low, high = low - spare, high + spare
    scaled = (grey.astype(np.float32) - np.float32(low)) * np.float32(255 / (high - low))
    return np.clip(scaled + 0.5, 0, 255).astype(np.uint8)
