"""Procedural ground and keyframes photographed from it, for the tests of registration."""

import cv2
import numpy as np

from sorvolo.geometry.camera import Camera
from sorvolo.registration.features import (
    FeatureSettings,
    gray_from_rgb,
    normalise_contrast,
    orb_features,
)
from sorvolo.survey.flight import CameraPrior
from sorvolo.survey.mosaic import Keyframe

WIDTH, HEIGHT = 480, 360
CAMERA = Camera.from_angle_of_view(WIDTH, HEIGHT, 62)


def ground(seed: int = 0, spread: float = 30.0) -> np.ndarray:
    """(900, 1200) float ground with detail at several scales; `spread` is its standard deviation in gray levels."""
    rng = np.random.default_rng(seed)
    total = np.zeros((900, 1200), np.float32)
    for octave in (3, 8, 24, 80):
        small = rng.normal(0, 1, (900 // octave + 2, 1200 // octave + 2)).astype(np.float32)
        total += cv2.resize(small, (1200, 900), interpolation=cv2.INTER_CUBIC)
    return 120 + total * (spread / total.std())


def photographed(
    scene: np.ndarray,
    ground_from_image: np.ndarray,
    *,
    gain: float = 1.0,
    noise: float = 1.5,
    seed: int = 0,
) -> np.ndarray:
    """The RGB picture whose pixels see the ground through this homography."""
    image = cv2.warpPerspective(
        scene,
        ground_from_image,
        (WIDTH, HEIGHT),
        flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REFLECT,
    )
    image = image * gain + np.random.default_rng(seed).normal(0, noise, image.shape)
    return np.repeat(np.clip(np.round(image), 0, 255).astype(np.uint8)[..., None], 3, axis=2)


def keyframe(keyframe_id: int, image: np.ndarray) -> Keyframe:
    """The picture ready to be linked, with telemetry that knows nothing."""
    gray = normalise_contrast(gray_from_rgb(image))
    unknown = np.full(3, np.inf)
    prior = CameraPrior(np.zeros(3), unknown, np.eye(3), unknown)
    return Keyframe(keyframe_id, CAMERA, gray, orb_features(gray, FeatureSettings()), prior)


def placed(
    x: float, y: float, turn_deg: float = 0.0, scale: float = 1.0, lean: float = 0.0
) -> np.ndarray:
    """ground_from_image of a view about the ground's point (x, y), turned about the image's middle."""
    a = np.radians(turn_deg)
    to_middle = np.array([[1, 0, -(WIDTH - 1) / 2], [0, 1, -(HEIGHT - 1) / 2], [0, 0, 1.0]])
    turned = np.array(
        [
            [scale * np.cos(a), -scale * np.sin(a), 0],
            [scale * np.sin(a), scale * np.cos(a), 0],
            [lean, -lean / 2, 1],
        ]
    )
    return np.array([[1, 0, x], [0, 1, y], [0, 0, 1.0]]) @ turned @ to_middle
