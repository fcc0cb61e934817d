"""Whether a thing came, left, or was replaced, from the pictures of the ground before and after, without a detector.

A thing stands out from the ground around it. Where only the later picture stands out it appeared, where only the
earlier one does it disappeared, where both do one took the other's place.
"""

import cv2
import numpy as np

from sorvolo.geometry.arrays import ImageRGBA, Mask
from sorvolo.survey.findings import ChangeKind, Patch

_CLEARLY = 1.6  # times as much as the other date


def kind_of(patch: Patch) -> ChangeKind:
    """What happened inside the patch's changed region; never `moving`."""
    before, after = stands_out(patch.before, patch.changed), stands_out(patch.after, patch.changed)
    if after > _CLEARLY * before:
        return ChangeKind.APPEARED
    if before > _CLEARLY * after:
        return ChangeKind.DISAPPEARED
    return ChangeKind.REPLACED


def stands_out(picture: ImageRGBA, changed: Mask) -> float:
    """How much the changed region differs from the ground around it: 0 not at all, 1 clearly."""
    reach = int(np.clip(0.35 * np.sqrt(np.count_nonzero(changed)), 3, 40))
    known = picture[..., 3] > 0
    inside = changed & known
    near = cv2.dilate(changed.view(np.uint8), np.ones((5, 5), np.uint8)) > 0
    around = (cv2.dilate(changed.view(np.uint8), np.ones((2 * reach + 5, 2 * reach + 5), np.uint8)) > 0) & ~near & known
    if not inside.any() or not around.any():
        return 0.0
    lab = cv2.cvtColor(np.ascontiguousarray(picture[..., :3]), cv2.COLOR_RGB2LAB).astype(np.float32)
    ring = lab[around]
    middle = np.median(ring, axis=0)
    width = 1.4826 * np.median(np.abs(ring - middle), axis=0) + 4.0
    return float(np.mean(np.minimum(np.linalg.norm((lab[inside] - middle) / width, axis=1), 8.0)))
