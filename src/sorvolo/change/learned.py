"""How much two pictures differ in learned features, beside what unchanged ground of the same pair differs."""

from functools import lru_cache
from importlib.resources import files
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sorvolo.geometry.arrays import Bytes, Floats32, Mask
from sorvolo.geometry.summary import SIGMA_PER_MEDIAN_DEVIATION

Image = NDArray[np.uint8]
"""(h, w, 3) uint8 BGR."""

_WHOLE_PX = 32  # the network's input has sides that are multiples of this
_LAYERS = ("finest", "fine", "coarse", "coarsest")  # at strides of 4, 8, 16 and 32 px


# How features are compared.
# cells of a layer that a feature is looked for around: alignment is good to less than a cell
_REACH = 1
_LEAST_MIDDLE = (0.8, 0.55)  # of distance, in features' standard deviations, and of 1 - cosine:
_LEAST_SPREAD = (0.25, 0.17)  # two dates have these at least; no pair is taken as calmer
_LEAST_KNOWN = 64  # cells of a layer; too few to know unchanged ground by
_MOST_SPREADS = 8.0  # spreads; beyond, more means no more
_DIRECTION = 2.0  # weight of the angle between features, beside 1 of their distance


def learned_difference(
    reference: Image,
    query: Image,
    known: Mask,
) -> Floats32:
    """(h, w) by how many spreads the features of two aligned pictures lie farther apart than they mostly do.

    Features are those of EfficientNet-Lite0 (`learned_difference.onnx`), each channel in units of its standard
    deviation over the pictures, compared with the nearest of those around: by their distance and by the cosine between
    them. Both are centred on the median of the `known` ground and divided by their spread there (1.48 times the median
    deviation): the scale is what light, season, traffic and alignment do to unchanged ground in this very pair, and at
    least what they do between two dates. The mean over four layers; 0 where nothing is `known`.
    """
    height, width = query.shape[:2]
    total = np.zeros((height, width), np.float32)
    for one, other in zip(learned_features(reference), learned_features(query), strict=True):
        # Pixels of a picture of this width along a cell of a layer.
        stride = (width + -width % _WHOLE_PX) // one.shape[2]
        rows, columns = -(-height // stride), -(-width // stride)
        held = cv2.resize(
            _padded(known.view(np.uint8), stride), (columns, rows), interpolation=cv2.INTER_NEAREST
        ).astype(bool)
        if np.count_nonzero(held) < _LEAST_KNOWN:
            return np.zeros((height, width), np.float32)
        apart = _apart(one[:, :rows, :columns], other[:, :rows, :columns], held)
        for row, weight in enumerate((1.0, _DIRECTION)):
            spreads = np.float32(weight) * _in_spreads(
                apart[row],
                held,
                _LEAST_MIDDLE[row],
                _LEAST_SPREAD[row],
            )
            larger = cv2.resize(
                spreads, (columns * stride, rows * stride), interpolation=cv2.INTER_LINEAR
            )
            total += larger[:height, :width]
    total /= np.float32(len(_LAYERS) * (1 + _DIRECTION))
    total[~known] = 0
    return total


def learned_features(image: Image) -> list[Floats32]:
    """The layers (channels, rows, columns) of a picture; about 50 ms for 800 x 450 on one core."""
    height, width = image.shape[:2]
    padded = cv2.copyMakeBorder(
        image, 0, -height % _WHOLE_PX, 0, -width % _WHOLE_PX, cv2.BORDER_REFLECT_101
    )
    planes = np.ascontiguousarray(padded[..., ::-1].transpose(2, 0, 1))
    return [each[0] for each in _network().run(list(_LAYERS), {"image": planes[None]})]


def _padded(image: Bytes, stride: int) -> Bytes:
    height, width = image.shape
    return np.asarray(
        cv2.copyMakeBorder(image, 0, -height % stride, 0, -width % stride, cv2.BORDER_REPLICATE),
        np.uint8,
    )


def _in_spreads(
    measure: Floats32, held: Mask, least_middle: float, least_spread: float
) -> Floats32:
    """A measure (rows, columns) less its median where `held`, in spreads, at most this many."""
    median = float(np.median(measure[held]))
    spread = max(
        SIGMA_PER_MEDIAN_DEVIATION * float(np.median(np.abs(measure[held] - median))), least_spread
    )
    away = (measure - np.float32(max(median, least_middle))) / np.float32(spread)
    return np.asarray(np.clip(away, -_MOST_SPREADS, _MOST_SPREADS), np.float32)


def _apart(one: Floats32, other: Floats32, held: Mask) -> tuple[Floats32, Floats32]:
    """How far each feature of `one` (channels, rows, columns) lies from the nearest of `other` around it: root of the
    mean square over channels, and one less the cosine, (rows, columns) each."""
    deviation = np.sqrt((one[:, held].var(axis=1) + other[:, held].var(axis=1)) / 2) + np.float32(
        1e-4
    )
    ours, theirs = (
        np.asarray(
            (each - each[:, held].mean(axis=1)[:, None, None]) / deviation[:, None, None],
            np.float32,
        )
        for each in (one, other)
    )
    _, rows, columns = ours.shape
    around = np.pad(theirs, ((0, 0), (_REACH, _REACH), (_REACH, _REACH)), mode="edge")
    own, power = (np.square(each).sum(axis=0) for each in (ours, around))
    nearest, likest = (
        np.full((rows, columns), np.inf, np.float32),
        np.full((rows, columns), -1.0, np.float32),
    )
    for dy in range(2 * _REACH + 1):
        for dx in range(2 * _REACH + 1):
            part = np.s_[dy : dy + rows, dx : dx + columns]
            products = np.einsum("chw,chw->hw", ours, around[:, part[0], part[1]])
            np.minimum(nearest, own + power[part] - 2 * products, out=nearest)
            np.maximum(likest, products / np.sqrt(np.maximum(own * power[part], 1e-12)), out=likest)
    return np.sqrt(np.maximum(nearest, 0) / np.float32(len(ours))), 1 - likest


@lru_cache(maxsize=1)
def _network() -> Any:
    """The packaged model, opened once."""
    import onnxruntime  # 30 MB of memory, for flights over restless ground

    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    options.intra_op_num_threads = 1  # frames are compared in threads already
    stored = files("sorvolo.change").joinpath("learned_difference.onnx").read_bytes()
    return onnxruntime.InferenceSession(stored, options, providers=["CPUExecutionProvider"])
