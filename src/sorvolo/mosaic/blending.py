"""How overlapping frames mix: multi-band blending of the frames that win a window's pixels, without bleeding.

Burt and Adelson 1983, with one economy: in the two finest bands the winner of a pixel takes all, for texture
is sharpest unmixed; the coarser bands, which carry colour, are averaged with the winners' masks as weights.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TypeAlias, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from sorvolo.geometry.arrays import Bytes, ImageGray, ImageRGB, Mask, Numbers, shrunk

BANDS = 5
"""Bands of the pyramid: four Laplacians and the residual."""

ALIGN_PX = 1 << (BANDS - 1)
"""Windows and layers start and end at multiples of this, so that all pyramids lie on the same samples."""

LAYER_APRON_PX = 64
"""How far a layer must reach beyond the pixels it wins: mask and image pyramids together spread 60 px."""

WINDOW_APRON_PX = 80
"""How far a window must reach beyond the pixels wanted of it, so that they do not depend on where it ends."""

FILL_PX = 8
"""Image pixels that `coarse_fill` takes as one."""

_HARD_BANDS = 2  # of the finest detail, taken from one frame alone: mixed, it would blur

_Pixel = TypeVar("_Pixel", np.uint8, np.float32)

Winners: TypeAlias = NDArray[np.int16]
"""(height, width) number of the layer that wins each pixel, -1 where there is none."""


@dataclass(frozen=True, eq=False)
class Layer:
    """One frame warped into a window: its top-left pixel is the window's (x_px, y_px).

    Outside the frame the image must be continued plausibly (reflected), never filled with a colour.
    """

    number: int
    x_px: int
    y_px: int
    image: ImageRGB


def blend(labels: Winners, layers: Iterable[Layer]) -> ImageRGB:
    """Blend the layers of a window, shape (height, width, 3); pixels labelled -1 have no meaning.

    The window's sides and the layers' places and sides are multiples of ALIGN_PX. Each layer should reach
    LAYER_APRON_PX beyond the pixels that it wins, as far as the window goes.
    """
    height, width = labels.shape
    bands = _Bands(height, width)
    for layer in layers:
        rows = slice(layer.y_px, layer.y_px + layer.image.shape[0])
        columns = slice(layer.x_px, layer.x_px + layer.image.shape[1])
        bands.add(layer, pixels_of(labels[rows, columns], layer.number))
    return bands.picture()


def pixels_of(labels: Winners, number: int) -> ImageGray:
    """(height, width) 255 where this layer wins, else 0."""
    return (labels == number).view(np.uint8) * np.uint8(255)


def winners_from_shares(
    shares: Iterable[tuple[int, int, int, Bytes]], height: int, width: int
) -> Winners:
    """(height, width) the number of the layer with the largest share at each pixel, the first of equals.

    Each share is (number, x_px, y_px, values): a patch of the window where the layer may win, 0 where it must
    not.
    """
    best = np.zeros((height, width), np.uint8)
    labels = np.full((height, width), -1, np.int16)
    for number, x, y, share in shares:
        here = slice(y, y + share.shape[0]), slice(x, x + share.shape[1])
        wins = share > best[here]
        labels[here][wins] = number
        np.maximum(best[here], share, out=best[here])
    return labels


def fill_invalid(image: ImageRGB, valid: Mask) -> ImageRGB:
    """The image with its invalid pixels continued from the valid ones around them, so that bands may cross
    there.
    """
    if valid.all():
        return image
    known = valid.astype(np.float32)
    colours, weights = image.astype(np.float32) * known[..., None], known
    levels = []
    while min(weights.shape) > 2 and weights.min() <= 0:
        levels.append((colours, weights))
        colours, weights = _coarser(colours), _coarser(weights)
    filled = colours / np.maximum(weights, 1e-6)[..., None]
    for colours, weights in reversed(levels):
        wider = cv2.pyrUp(filled, dstsize=weights.shape[1::-1])
        filled = np.where(
            weights[..., None] > 1e-3, colours / np.maximum(weights, 1e-3)[..., None], wider
        )
    result = np.clip(filled, 0, 255).astype(np.uint8)
    result[valid] = image[valid]
    return result


def coarse_fill(image: ImageRGB, valid: Mask) -> ImageRGB:
    """The image at an eighth of its size (rounded up), by its valid pixels alone, continued where there are none.

    Enough for what lies beyond a frame's border: only the coarse bands of a blend look there.
    """
    height, width = valid.shape
    below, beside = -height % FILL_PX, -width % FILL_PX
    size = (width + beside) // FILL_PX, (height + below) // FILL_PX
    known = valid.astype(np.uint8) * np.uint8(255)
    seen = cv2.copyMakeBorder(cv2.copyTo(image, known), 0, below, 0, beside, cv2.BORDER_CONSTANT)
    share = cv2.copyMakeBorder(known, 0, below, 0, beside, cv2.BORDER_CONSTANT)
    colours, weights = (shrunk(each, size).astype(np.float32) for each in (seen, share))
    small = np.clip(colours * 255 / np.maximum(weights, 1)[..., None] + 0.5, 0, 255).astype(
        np.uint8
    )
    return fill_invalid(small, weights > 64)


class _Bands:
    """A window's pyramid while its layers are added; only `add` changes it."""

    def __init__(self, height: int, width: int) -> None:
        soft = range(_HARD_BANDS, BANDS)
        self._fine = [np.zeros((height >> k, width >> k, 3), np.int16) for k in range(_HARD_BANDS)]
        self._sums = [np.zeros((height >> k, width >> k, 3), np.float32) for k in soft]
        self._weights = [np.full((height >> k, width >> k), 1e-9, np.float32) for k in soft]
        self._winners = np.zeros((height, width, 3), np.uint8)

    def add(self, layer: Layer, mask: ImageGray) -> None:
        """Add a layer where its `mask`, of its image's height and width, is 255."""
        gaussian, share = layer.image, mask.astype(np.float32)
        rows = slice(layer.y_px, layer.y_px + layer.image.shape[0])
        here = rows, slice(layer.x_px, layer.x_px + layer.image.shape[1])
        self._winners[here] = cv2.copyTo(layer.image, mask, self._winners[here])
        for k in range(BANDS):
            rows = slice(layer.y_px >> k, (layer.y_px + layer.image.shape[0]) >> k)
            here = rows, slice(layer.x_px >> k, (layer.x_px + layer.image.shape[1]) >> k)
            coarser = _coarser(gaussian) if k < BANDS - 1 else None
            if k < _HARD_BANDS:
                winner = np.ascontiguousarray(mask[:: 1 << k, :: 1 << k])
                self._fine[k][here] = cv2.copyTo(
                    _laplacian(gaussian, coarser, cv2.CV_16S), winner, self._fine[k][here]
                )
            else:
                self._sums[k - _HARD_BANDS][here] += (
                    _laplacian(gaussian, coarser, cv2.CV_32F) * share[..., None]
                )
                self._weights[k - _HARD_BANDS][here] += share
            if coarser is not None:
                gaussian, share = coarser, _coarser(share)

    def picture(self) -> ImageRGB:
        """The bands added up again, (height, width, 3).

        Brighter neighbours take at most three quarters of what a pixel lacks to white: they burn none.
        """
        coarse = [total / weight[..., None] for total, weight in zip(self._sums, self._weights)]
        soft: Numbers = coarse[-1]
        for band in coarse[-2::-1]:
            soft = cv2.pyrUp(soft, dstsize=band.shape[1::-1]) + band
        picture = cv2.pyrUp(soft.round().astype(np.int16), dstsize=self._fine[-1].shape[1::-1])
        for k in range(_HARD_BANDS - 1, 0, -1):
            picture = cv2.pyrUp(
                cv2.add(picture, self._fine[k]), dstsize=self._fine[k - 1].shape[1::-1]
            )
        brightest = (np.arange(256) + 3 * 255) // 4
        most = cv2.LUT(self._winners, brightest.astype(np.uint8))
        return cv2.min(cv2.add(picture, self._fine[0], dtype=cv2.CV_8U), most)  # type: ignore[return-value]


def _coarser(picture: NDArray[_Pixel]) -> NDArray[_Pixel]:
    return np.asarray(cv2.pyrDown(picture), picture.dtype)


def _laplacian(gaussian: ImageRGB, coarser: ImageRGB | None, depth: int) -> Numbers:
    """(height, width, 3) of OpenCV's `depth`; of the coarsest band, without a `coarser` one, float32."""
    if coarser is None:
        return gaussian.astype(np.float32)
    return cv2.subtract(gaussian, cv2.pyrUp(coarser, dstsize=gaussian.shape[1::-1]), dtype=depth)  # type: ignore[return-value]
