"""How overlapping frames mix: multi-band blending of the frames that win a window's pixels, without bleeding.

Burt and Adelson 1983, with one economy: in the two finest bands the winner of a pixel takes all, for texture
is sharpest unmixed; the coarser bands, which carry colour, are averaged with the winners' masks as weights.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from sorvolo.geometry.arrays import Anything, ImageRGB, Mask

BANDS = 5
"""Bands of the pyramid: four Laplacians and the residual."""

ALIGN_PX = 1 << (BANDS - 1)
"""Windows and layers start and end at multiples of this, so that all pyramids lie on the same samples."""

LAYER_APRON_PX = 64
"""How far a layer must reach beyond the pixels it wins: mask and image pyramids together spread 60 px."""

WINDOW_APRON_PX = 80
"""How far a window must reach beyond the pixels wanted of it, so that they do not depend on where it ends."""

_HARD_BANDS = 2

Labels: TypeAlias = NDArray[np.int16]
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


def blend(labels: Labels, layers: Iterable[Layer]) -> ImageRGB:
    """Blend the layers of a window, shape (height, width, 3); pixels labelled -1 have no meaning.

    The window's sides and the layers' places and sides are multiples of ALIGN_PX. Each layer should reach
    LAYER_APRON_PX beyond the pixels that it wins, as far as the window goes.
    """
    height, width = labels.shape
    fine = [np.zeros((height >> k, width >> k, 3), np.int16) for k in range(_HARD_BANDS)]
    sums = [np.zeros((height >> k, width >> k, 3), np.float32) for k in range(_HARD_BANDS, BANDS)]
    weights = [np.full((height >> k, width >> k), 1e-9, np.float32) for k in range(_HARD_BANDS, BANDS)]
    for layer in layers:
        rows = slice(layer.y_px, layer.y_px + layer.image.shape[0])
        columns = slice(layer.x_px, layer.x_px + layer.image.shape[1])
        mask = pixels_of(labels[rows, columns], layer.number)
        gaussian: Anything = layer.image
        share: Anything = mask
        for k in range(BANDS):
            here = slice(rows.start >> k, rows.stop >> k), slice(columns.start >> k, columns.stop >> k)
            coarser = _coarser(gaussian) if k < BANDS - 1 else None
            if k < _HARD_BANDS:
                band = _laplacian(gaussian, coarser, cv2.CV_16S)
                winner = mask[:: 1 << k, :: 1 << k]
                fine[k][here] = cv2.copyTo(band, np.ascontiguousarray(winner), fine[k][here])
                share = _coarser(share if k else mask.astype(np.float32))
            else:
                band = _laplacian(gaussian, coarser, cv2.CV_32F)
                sums[k - _HARD_BANDS][here] += band * share[..., None]
                weights[k - _HARD_BANDS][here] += share
                share = _coarser(share) if k < BANDS - 1 else share
            gaussian = gaussian if coarser is None else coarser
    coarse: list[Anything] = [total / weight[..., None] for total, weight in zip(sums, weights)]
    picture = coarse[-1]
    for band in coarse[-2::-1]:
        picture = cv2.pyrUp(picture, dstsize=band.shape[1::-1]) + band
    picture = cv2.pyrUp(picture.round().astype(np.int16), dstsize=fine[-1].shape[1::-1])
    for k in range(_HARD_BANDS - 1, 0, -1):
        picture = cv2.pyrUp(cv2.add(picture, fine[k]), dstsize=fine[k - 1].shape[1::-1])
    return cv2.add(picture, fine[0], dtype=cv2.CV_8U)  # type: ignore[return-value]


def pixels_of(labels: Labels, number: int) -> NDArray[np.uint8]:
    """(height, width) 255 where this layer wins, else 0."""
    return (labels == number).view(np.uint8) * np.uint8(255)


def winners_from_shares(
    shares: Iterable[tuple[int, int, int, NDArray[np.uint8]]], height: int, width: int
) -> Labels:
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
    colours: Anything = image.astype(np.float32) * known[..., None]
    weights: Anything = known
    levels = []
    while min(weights.shape) > 2 and weights.min() <= 0:
        levels.append((colours, weights))
        colours, weights = cv2.pyrDown(colours), cv2.pyrDown(weights)
    filled = colours / np.maximum(weights, 1e-6)[..., None]
    for colours, weights in reversed(levels):
        wider = cv2.pyrUp(filled, dstsize=weights.shape[1::-1])
        filled = np.where(weights[..., None] > 1e-3, colours / np.maximum(weights, 1e-3)[..., None], wider)
    result = np.clip(filled, 0, 255).astype(np.uint8)
    result[valid] = image[valid]
    return result


def _coarser(gaussian: Anything) -> Anything:
    return cv2.pyrDown(gaussian)


def _laplacian(gaussian: Anything, coarser: Anything | None, depth: int) -> Anything:
    if coarser is None:
        return gaussian.astype(np.float32)
    return cv2.subtract(gaussian, cv2.pyrUp(coarser, dstsize=gaussian.shape[1::-1]), dtype=depth)
