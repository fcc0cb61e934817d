"""What a camera makes of a picture."""

import numpy as np


def camera(image: np.ndarray, seed: int) -> np.ndarray:
    """The picture (h, w, 3) uint8 with the noise of a sensor."""
    noise = np.random.default_rng(seed).normal(0, 2, image.shape)
    return np.clip(image + noise, 0, 255).astype(np.uint8)
