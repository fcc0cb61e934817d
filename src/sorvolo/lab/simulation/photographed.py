"""What a drone's camera does to a single picture: light, haze, blur, noise and compression, drawn at random."""

import cv2
import numpy as np

from sorvolo.geometry.arrays import Floats, ImageRGB
from sorvolo.lab.simulation.flight import line_kernel
from sorvolo.search.drawing.noise import layer


def photographed(image: ImageRGB, gains: Floats, rng: np.random.Generator) -> ImageRGB:
    """The rendered picture as a camera records it; `gains` (3,) is the light's colour and strength.

    In the dark the camera turns its own gain up, and its noise with it.
    """
    height, width = image.shape[:2]
    light = image.astype(np.float32) * gains.astype(np.float32)
    light *= (
        1 + 0.12 * np.clip(layer(rng, (height, width), 0.4 * width), -2, 2)[..., None]
    )  # clouds' shadows
    if rng.uniform() < 0.2:
        air = rng.uniform(170, 230) * np.array([0.96, 1.0, 1.05]) * gains
        haze = np.float32(rng.uniform(0.05, 0.4))
        light += haze * (air.astype(np.float32) - light)
    y, x = np.mgrid[0:height, 0:width].astype(np.float32)
    radius2 = ((x - width / 2) ** 2 + (y - height / 2) ** 2) / (width / 2) ** 2
    light /= (1 + np.float32(rng.uniform(0, 0.3)) * radius2)[..., None]
    camera_gain = float(np.clip(rng.uniform(60, 150) / max(light.mean(), 1.0), 0.6, 5.0))
    light *= np.float32(camera_gain if rng.uniform() < 0.7 else np.clip(camera_gain, 0.8, 1.25))
    balance = rng.normal(1, 0.05, 3).astype(np.float32)
    light = _blurred(light * balance, rng)
    noise = rng.uniform(0.5, 3.5) * max(1.0, camera_gain) ** 0.7
    light += np.float32(noise) * rng.standard_normal(light.shape, dtype=np.float32)
    bent = 255 * np.clip(light / 255, 0, 1) ** np.float32(rng.uniform(0.8, 1.25))
    return recompressed(np.round(bent).astype(np.uint8), rng)


def recompressed(image: ImageRGB, rng: np.random.Generator) -> ImageRGB:
    """The picture after lossy compression, colour at half its resolution as in videos."""
    quality = int(rng.integers(45, 96))
    _, data = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
    return np.ascontiguousarray(cv2.imdecode(data, cv2.IMREAD_COLOR)[..., ::-1])  # type: ignore[index]


def _blurred(
    image: np.ndarray[tuple[int, ...], np.dtype[np.float32]], rng: np.random.Generator
) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
    """Out of focus a little, and in a third of the pictures moved during the exposure."""
    sigma_px = rng.uniform(0.0, 1.1)
    if sigma_px > 0.3:
        image = np.asarray(cv2.GaussianBlur(image, (0, 0), sigma_px), np.float32)
    if rng.uniform() < 0.33:
        length_px, angle = rng.uniform(1, 7), rng.uniform(0, np.pi)
        kernel = line_kernel(length_px * np.array([np.cos(angle), np.sin(angle)]))
        image = np.asarray(cv2.filter2D(image, -1, kernel), np.float32)
    return image
