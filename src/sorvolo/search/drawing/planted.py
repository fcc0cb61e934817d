"""People and things planted into a real frame: drawn to scale, in its own light, blur and noise."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from sorvolo.geometry.arrays import BoxesPx, Floats, ImageRGB, ImageRGBA, Vector3, frozen, square
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.pose import Pose
from sorvolo.search.drawing.bodies import build_body
from sorvolo.search.drawing.cut_outs import CutThing
from sorvolo.search.drawing.objects import (
    GROUND_LEVEL,
    POSES,
    Body,
    Light,
    Thing,
    ThingLabel,
    new_kind,
    new_size,
    own_shadow,
    warm_body,
)
from sorvolo.search.drawing.view import (
    DrawnPatch,
    DrawnView,
    Window,
    camera_view,
    ray_grid,
    sample_patches,
)

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
        strength >= cv2.dilate(strength, square(3)) - 1e-3
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


_Overlay = NDArray[np.float32]

_OVERHEAD: Vector3 = np.array([0.0, 0.0, 1.0])
_LEAST_SUN = 0.12  # of the sun's height over the horizon, as a sine: lower, shadows are longer than the picture knows
_DRAWN_SOFT_PX = 0.42  # as soft as patches are drawn without any blur
_SPARE_PX = 12  # around what is drawn, for the blur
_MISSING = ("standing", "walking", "waving", "crouching", "sitting", "lying")
_MISSING_SHARE = (
    0.2,
    0.15,
    0.1,
    0.1,
    0.2,
    0.25,
)  # how often missing people stand, walk ... or lie: our assumption


@dataclass(frozen=True, eq=False)
class PlantedThing:
    """A frame with its plants. `boxes_px` (N, 4) has each thing's box where nothing hid it, NaN where it is out of
    sight."""

    image: ImageRGB
    boxes_px: BoxesPx


def new_plant(number: int, label: str, place_m: Floats, seed: int) -> Thing:
    """A person, a car or a small object of a random kind, pose and dress; `place_m` (2,) is where it stands."""
    rng = np.random.default_rng([seed, number, 31])
    what = ThingLabel(label)
    kind = (
        str(rng.choice(_MISSING, p=_MISSING_SHARE))
        if what is ThingLabel.PERSON
        else new_kind(what, rng)
    )
    assert what is not ThingLabel.PERSON or kind in POSES
    return Thing(
        number,
        what,
        kind,
        float(place_m[0]),
        float(place_m[1]),
        float(rng.uniform(0, 360)),
        new_size(what, kind, rng),
        int(rng.integers(2**31)),
    )


def plant(
    image: ImageRGB,
    camera: Camera,
    site_from_camera: Pose,
    things: Sequence[Thing],
    light: FrameLight,
    sun: Vector3 | None,
    seed: int,
) -> PlantedThing:
    """The frame with these things in it, far ones first.

    `camera` is the frame's own, `sun` (3,) the direction to the sun, None for none. Grain follows from `seed`; a thing
    looks alike in all frames of one light.
    """
    canvas = np.array(image, np.uint8)
    view = camera_view(camera, site_from_camera, ray_grid(camera) if camera.is_distorted else None)
    boxes = np.full((len(things), 4), np.nan, np.float32)
    eye_m = site_from_camera.translation_m
    order = sorted(
        range(len(things)), key=lambda k: -float(np.hypot(*(things[k].place_m(0)[:2] - eye_m[:2])))
    )
    for k in order:
        thing = things[k]
        m_per_px = float(np.linalg.norm(eye_m - thing.place_m(0))) / camera.fx_px
        body, shadow = _looks(thing, light, sun, m_per_px)
        patches = body.placed(thing.turn, thing.place_m(0), view.eye_m)
        drawn = _drawn(view, patches)
        if drawn is None:
            continue
        window, overlay = drawn
        boxes[k] = _box(window, overlay)
        rng = np.random.default_rng([seed, thing.id])
        if shadow is not None and (cast := _drawn(view, [shadow])) is not None:
            _lay(canvas, *cast, light, rng, is_shadow=True)
        _lay(canvas, window, overlay, light, rng, is_shadow=False)
    return PlantedThing(canvas, boxes)


def _looks(
    thing: Thing, light: FrameLight, sun: Vector3 | None, m_per_px: float
) -> tuple[Body, DrawnPatch | None]:
    """The body and its shadow on the ground, where there is one."""
    has_sun = sun is not None and float(sun[2]) > _LEAST_SUN and not light.is_thermal
    towards = sun if has_sun and sun is not None else _OVERHEAD
    sunlight = Light(towards, 1.0 - 0.58 * light.shadow if has_sun else 1.0)
    if isinstance(thing, CutThing):
        body = thing.body(m_per_px)
        if light.is_thermal:
            return body, None
    else:
        body = build_body(thing, sunlight, m_per_px)
    if light.is_thermal:
        return warm_body(thing, body, np.random.default_rng([thing.seed, 3])), None
    if not has_sun or light.shadow <= 0.05:
        return body, None
    shadow = own_shadow(thing, body, sunlight, m_per_px)
    alpha = shadow.texture[..., 3].astype(np.float32) * light.shadow
    texture = shadow.texture.copy()
    texture[..., 3] = alpha.astype(np.uint8)
    return body, replace(shadow, texture=texture).moved(np.eye(3), thing.place_m(0))


def _drawn(view: DrawnView, patches: Sequence[DrawnPatch]) -> tuple[Window, _Overlay] | None:
    """Patches painted over nothing: their window with some room around, and (H, W, 4) colours times alpha, 0 to 255."""
    samples = [
        (window, sample) for window, sample in sample_patches(view, patches) if sample[..., 3].any()
    ]
    if not samples:
        return None
    windows = np.array([window for window, _ in samples])
    size = view.camera.width_px, view.camera.height_px
    x0, y0 = (max(0, int(each) - _SPARE_PX) for each in windows.min(axis=0)[:2])
    x1, y1 = (min(most, int(each) + _SPARE_PX) for most, each in zip(size, windows.max(axis=0)[2:]))
    overlay = np.zeros((y1 - y0, x1 - x0, 4), np.float32)
    for (left, top, right, bottom), sample in samples:
        part = overlay[top - y0 : bottom - y0, left - x0 : right - x0]
        part *= 1 - sample[..., 3:].astype(np.float32) / 255
        part += sample
    return (x0, y0, x1, y1), overlay


def _box(window: Window, overlay: _Overlay) -> Floats:
    """(4,) the box around what is more than half opaque; NaN for less than two pixels of it."""
    rows, columns = np.nonzero(overlay[..., 3] > 127)
    if len(rows) < 2:
        return np.full(4, np.nan)
    x0, y0 = window[:2]
    return np.array(
        [x0 + columns.min(), y0 + rows.min(), x0 + columns.max() + 1, y0 + rows.max() + 1],
        np.float64,
    )


def _lay(
    canvas: ImageRGBA | ImageRGB,
    window: Window,
    overlay: _Overlay,
    light: FrameLight,
    rng: np.random.Generator,
    *,
    is_shadow: bool,
) -> None:
    """Blur the overlay as the frame is blurred, give it the frame's light and grain, and lay it on, in place."""
    x0, y0, x1, y1 = window
    soft = _blurred(np.asarray(overlay, np.float32), light.blur_px2)
    alpha = soft[..., 3:] / 255
    base = GROUND_LEVEL if light.is_thermal else 0.0
    colours = alpha * light.haze.astype(np.float32) + light.gain.astype(np.float32) * (
        soft[..., :3] - base * alpha
    )
    if is_shadow:
        colours = alpha * 0.15 * light.haze.astype(np.float32)
    below = canvas[y0:y1, x0:x1].astype(np.float32)
    grain = np.float32(light.noise) * rng.standard_normal(below.shape, dtype=np.float32)
    laid = colours + (1 - alpha) * below + np.sqrt(alpha * (2 - alpha)) * grain * (not is_shadow)
    canvas[y0:y1, x0:x1] = np.clip(np.round(laid), 0, 255).astype(np.uint8)


def _blurred(overlay: _Overlay, blur_px2: Floats) -> _Overlay:
    """By a normal blur of this covariance; a pixel's own area, by which patches are drawn soft already, is left out."""
    values, vectors = np.linalg.eigh(blur_px2)
    values = np.maximum(values - _DRAWN_SOFT_PX**2, 1e-4)
    if values.max() < 0.02:
        return overlay
    reach = int(np.ceil(3 * np.sqrt(values.max())))
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    inverse = (vectors / values) @ vectors.T
    kernel = np.exp(
        -0.5 * (inverse[0, 0] * x * x + 2 * inverse[0, 1] * x * y + inverse[1, 1] * y * y)
    )
    return np.asarray(
        cv2.filter2D(overlay, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REPLICATE),
        np.float32,
    )
