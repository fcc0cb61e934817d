"""A height model as a picture: colours by height, shaded by a sun in the north-west."""

import cv2
import numpy as np

from sorvolo.geometry.arrays import Floats32, ImageRGBA
from sorvolo.heights.surface import Surface

_LONGEST_PX = 1600  # a screen's width; by choice
_SUN = np.array([-0.5, 0.5, 0.7]) / np.linalg.norm([-0.5, 0.5, 0.7])


def relief_picture(surface: Surface) -> ImageRGBA:
    """(H, W, 4) the shaded heights; holes are transparent."""
    known = np.isfinite(surface.up_m)
    if not known.any():
        return np.zeros((1, 1, 4), np.uint8)
    scale = min(1.0, _LONGEST_PX / max(surface.up_m.shape))
    up_m: Floats32 = np.where(known, surface.up_m, np.nanmedian(surface.up_m)).astype(np.float32)
    size = (max(1, round(up_m.shape[1] * scale)), max(1, round(up_m.shape[0] * scale)))
    up_m = np.asarray(cv2.resize(up_m, size, interpolation=cv2.INTER_AREA), np.float32)
    seen = cv2.resize(known.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.5
    down, across = (
        np.gradient(up_m, surface.lattice.cell_m / scale)
        if min(up_m.shape) > 1
        else (up_m * 0, up_m * 0)
    )
    light = (-across * _SUN[0] + down * _SUN[1] + _SUN[2]) / np.sqrt(1 + across**2 + down**2)
    low, high = np.percentile(up_m[seen], [1, 99]) if seen.any() else (0.0, 1.0)
    level = np.clip((up_m - low) / max(high - low, 0.1) * 255, 0, 255).astype(np.uint8)
    colours = cv2.cvtColor(cv2.applyColorMap(level, cv2.COLORMAP_VIRIDIS), cv2.COLOR_BGR2RGB)
    shaded = np.clip(colours * (0.3 + 0.9 * np.clip(light, 0, 1)[..., None]), 0, 255).astype(
        np.uint8
    )
    return np.dstack([shaded, np.where(seen, 255, 0).astype(np.uint8)])
