"""What a picture shows of how it was taken: its light, blur and noise, so that things planted into it look alike."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sorvolo.geometry.arrays import Floats, ImageRGB, frozen

_Grey = NDArray[np.float32]

_REBLUR_PX = 1.2  # the second blur by which the first is measured
_EDGES = 0.02  # of a picture's pixels: its strongest edges
_SHARPEST = 25.0  # percentile of their blur: the softer edges are shadows and round things
_OF_SHARPEST = 1.1  # what that lacks, by pictures blurred on purpose
_SECTORS = 4  # directions in which blur is measured
_LEAST_BLUR_PX = 0.35  # of a pixel that gathers light over its own area
_MOST_BLUR_PX = 6.0  # beyond, no edge is left by which blur could be measured; by choice
_WEAKEST = 2.0  # grey levels a pixel: below, there is no edge
_BLOCK_PX = 16  # side of the blocks whose spread is the noise; the flattest count
_MOST_NOISE = 12.0  # grey levels
_GREY_LEVELS = 10  # within which the channels of a thermal picture agree


@dataclass(frozen=True, eq=False)
class FrameLight:
    """How a frame was taken, as far as its picture shows it.

    What has the colour c in full daylight shows as `gain` c + `haze` (3,) each; in a thermal frame (`is_thermal`) gain
    counts levels for each level of warmth over the ground, whose level is `haze`, and is negative where hot is black.
    `blur_px2` (2, 2) is the covariance of its blur, `noise` its rms in grey levels, `shadow` from 0 (overcast) to 1
    how much of the light its shadows lack.
    """

    gain: Floats
    haze: Floats
    blur_px2: Floats
    noise: float
    shadow: float
    is_thermal: bool

    def __post_init__(self) -> None:
        for name in ("gain", "haze", "blur_px2"):
            object.__setattr__(self, name, frozen(getattr(self, name)))

    @property
    def blur_px(self) -> float:
        """Its blur along the worst direction, one sigma."""
        return float(np.sqrt(np.linalg.eigvalsh(self.blur_px2)[-1]))


def frame_light(image: ImageRGB) -> FrameLight:
    """The light, blur and noise that a picture (H, W, 3) shows."""
    grey = np.asarray(image, np.float32).mean(axis=2)
    sample = image[::4, ::4].reshape(-1, 3).astype(np.float64)
    is_thermal = bool((np.ptp(sample, axis=1) > _GREY_LEVELS).mean() < 0.01)
    blur_px2, noise = _blur_px2(grey), _noise(grey)
    if is_thermal:
        gain, level = _warmth(sample[:, 0])
        return FrameLight(
            np.full(3, gain), np.full(3, level), blur_px2, noise, 0.0, is_thermal=True
        )
    lightness = sample.mean(axis=1)
    low, middle, high = (float(each) for each in np.percentile(lightness, (1, 50, 98)))
    haze = 0.3 * max(0.0, low - 60.0)  # bare sand has no dark pixels either: rather too little
    # the usual brightness of ground and of bright things: snow does not make a coat white, nor a wood make it black;
    # one gain for all channels, since grass is green in white light
    gain = float(
        np.clip(np.sqrt(max(middle - haze, 1) / 95 * max(high - haze, 1) / 200), 0.08, 1.4)
    )
    dark = float(np.percentile(lightness, 2) / max(float(np.median(lightness)), 1.0))
    shadow = float(np.clip((0.75 - dark) / 0.4, 0, 1))
    return FrameLight(np.full(3, gain), np.full(3, haze), blur_px2, noise, shadow, is_thermal=False)


def _warmth(levels: Floats) -> tuple[float, float]:
    """Levels for each level of warmth, and the ground's level: hot is where the longer tail is, white in doubt."""
    cold, ground, hot = (float(each) for each in np.percentile(levels, (0.2, 50, 99.8)))
    if ground - cold > 1.5 * (hot - ground):
        return -max(ground - cold, 40.0) / 100, ground
    return max(hot - ground, 40.0) / 100, ground


def _noise(grey: _Grey) -> float:
    """The rms of noise (Immerkaer 1996) in the smoothest blocks: elsewhere the ground's own grain is in it."""
    mask = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
    left = np.asarray(cv2.filter2D(grey, -1, mask), np.float64)
    rows, columns = (side // _BLOCK_PX * _BLOCK_PX for side in grey.shape)
    if not rows or not columns:
        return 0.0
    blocks = left[:rows, :columns].reshape(
        rows // _BLOCK_PX, _BLOCK_PX, columns // _BLOCK_PX, _BLOCK_PX
    )
    rms = np.sqrt((blocks**2).mean(axis=(1, 3)))
    # the mean of three channels has less noise than each of them, by the root of three
    return float(min(np.percentile(rms, 2) / 6 * np.sqrt(3), _MOST_NOISE))


def _blur_px2(grey: _Grey) -> Floats:
    """The covariance of a picture's blur, px2: a second blur takes less from soft edges (Zhuo and Sim 2011)."""
    soft = np.asarray(
        cv2.GaussianBlur(np.asarray(grey, np.float32), (0, 0), _REBLUR_PX), np.float32
    )
    x, y = _gradients(np.asarray(grey, np.float32))
    again = np.hypot(*_gradients(soft))
    strength = np.hypot(x, y)
    is_ridge = (
        strength >= cv2.dilate(strength, np.ones((3, 3), np.uint8)) - 1e-3
    )  # an edge's own line, not its slopes
    angle = np.arctan2(y, x) % np.pi
    ratio = np.maximum(strength / np.maximum(again, 1e-6), 1.0001)
    sigmas = np.clip(_OF_SHARPEST * _REBLUR_PX / np.sqrt(ratio**2 - 1), 0.0, _MOST_BLUR_PX)
    every = sigmas[is_ridge & (strength > np.quantile(strength[::2, ::2], 1 - _EDGES))]
    rows, right = [], []
    for sector in range(_SECTORS):
        middle = sector * np.pi / _SECTORS
        inside = np.abs((angle - middle + np.pi / 2) % np.pi - np.pi / 2) < np.pi / _SECTORS / 2
        # edges along a motion keep their strength, those across it lose it: each direction has its own strongest
        is_edge = (
            inside
            & (strength > max(float(np.quantile(strength[inside], 1 - _EDGES)), _WEAKEST))
            & is_ridge
        )
        own = sigmas[is_edge]
        if len(own) >= 12:
            rows.append([np.cos(middle) ** 2, np.sin(2 * middle), np.sin(middle) ** 2])
            right.append(float(np.percentile(own, _SHARPEST)) ** 2)
    if len(rows) < 3:
        sigma = float(np.percentile(every, _SHARPEST)) if len(every) else _LEAST_BLUR_PX
        return max(sigma, _LEAST_BLUR_PX) ** 2 * np.eye(2)
    xx, xy, yy = np.linalg.lstsq(np.array(rows), np.array(right), rcond=None)[0]
    values, vectors = np.linalg.eigh(np.array([[xx, xy], [xy, yy]]))
    return np.asarray(
        (vectors * np.clip(values, _LEAST_BLUR_PX**2, _MOST_BLUR_PX**2)) @ vectors.T, np.float64
    )


def _gradients(picture: _Grey) -> tuple[_Grey, _Grey]:
    mask = np.array([[-0.5, 0, 0.5]], np.float32)
    across, down = cv2.filter2D(picture, -1, mask), cv2.filter2D(picture, -1, mask.T)
    return np.asarray(across, np.float32), np.asarray(down, np.float32)
