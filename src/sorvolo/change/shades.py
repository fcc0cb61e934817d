"""Shadows of tall things that lie elsewhere on the later date: the same ground in other light with a sharp edge."""

import cv2
import numpy as np
from numpy.typing import NDArray

from sorvolo.geometry.arrays import Anything, Mask

LEVELS = (0.35, 0.6, 0.9)  # octaves darker or brighter: more comes free of what it touches
MOST_TINT = 0.6  # octaves between the colours: a shadow takes somewhat less of blue
MOST_SPREAD = 0.12  # octaves, median distance from a shadow's own depth
LEAST_WIDTH = 5  # pixels of the pictures given: narrower shadows are those of people and small things, which tell them
LEAST_ALIKE, ALIKE_OF_FEW = 0.35, 1.5  # correlation of the ground's details within; more where few pixels tell
FINEST = 9  # pixels: details are what is smaller
APART = 2  # pixels that the pictures may be apart
MOST_ASKED = 6000  # pixels that are asked
MOST_APART = 0.25  # octaves from a shadow's depth: ground beside it that it covers, too
RIM = 2  # pixels on both sides of a shadow's edge, where it is blurred
LARGEST = 0.25  # of the picture: smooth gains follow what is larger
LARGEST_HOLE, NOTCH = 150, 7  # pixels; pixels wide
SHARP, LEAST_SHARP = 0.4, 0.4  # of its depth is left beside a shadow, at most, along so much of its edge
BESIDE = 9  # pixels, the width of the window by which that is beside it
NEAR = 15  # pixels: how far the depth of a shadow is the same


def moved_shades(
    before: NDArray[np.float32], after: NDArray[np.float32], known: Mask | None
) -> NDArray[np.float32] | None:
    """Octaves (h, w, 3) by which ground is brighter that a shadow left (below 0: darker, it came); None if nowhere.

    `before` and `after` (h, w, 3) are logarithms to base 2 of two pictures in the same light; nothing is said
    where not `known` (h, w). What changes its brightness evenly, keeps its finest structure and is wide enough is the
    same ground under another shadow; a new thing hides the ground's structure.
    """
    apart = np.asarray(cv2.blur(after - before, (3, 3)), np.float32)
    bands = cv2.split(apart)
    alike = cv2.max(cv2.max(*bands[:2]), bands[2]) - cv2.min(cv2.min(*bands[:2]), bands[2]) < MOST_TINT
    if known is not None:
        alike &= known
    middle = np.asarray((bands[0] + bands[1] + bands[2]) * np.float32(1 / 3), np.float32)
    octaves = np.zeros_like(apart)
    details: tuple[NDArray[np.float32], NDArray[np.float32]] | None = None
    for sign in (-1, 1):
        shaded = np.zeros(alike.shape, bool)
        for level in LEVELS:
            count, labels = _pieces((sign * middle > level) & alike & ~shaded)
            if count == 1:
                break
            details = details or (_details(before), _details(after))
            shaded |= (_is_sharp(labels, count, sign * middle) & _kept(labels, count, middle, *details))[labels]
        if shaded.any():
            octaves += _octaves(shaded, apart, sign)
    if known is not None:
        octaves[~known] = 0
    return octaves if octaves.any() else None


def _pieces(mask: Mask) -> tuple[int, NDArray[np.int32]]:
    """The wide enough pieces of a mask: how many with the ground, which is 0, and the labels (h, w)."""
    window = np.ones((LEAST_WIDTH, LEAST_WIDTH), np.uint8)
    opened = cv2.morphologyEx(mask.view(np.uint8), cv2.MORPH_OPEN, window)
    count, labels = cv2.connectedComponents(opened, connectivity=4)
    return count, np.asarray(labels, np.int32)


def _octaves(shaded: Mask, apart: NDArray[np.float32], sign: int) -> NDArray[np.float32]:
    """(h, w, 3) how deep the shadow is where `shaded`, smooth; about its rim the part of it that all colours show.

    What stands in it and is no ground leaves holes: they are as deep.
    """
    weights = shaded.astype(np.float32)
    sums = cv2.blur(np.dstack([apart * weights[..., None], weights]), (NEAR, NEAR))
    depth = sums[..., :3] / np.maximum(sums[..., 3:], np.float32(1e-6))
    # narrow parts beside it
    near = cv2.dilate(shaded.view(np.uint8), np.ones((NEAR, NEAR), np.uint8)) > 0
    shaded = shaded | (near & (np.abs(apart - depth).max(axis=2) < MOST_APART))
    _, holes, stats, _ = cv2.connectedComponentsWithStats((~shaded).view(np.uint8), connectivity=4)
    whole = shaded | (stats[:, cv2.CC_STAT_AREA] < LARGEST_HOLE)[holes]
    closed = cv2.morphologyEx(whole.view(np.uint8), cv2.MORPH_CLOSE, np.ones((NOTCH, NOTCH), np.uint8))
    window = np.ones((2 * RIM + 1, 2 * RIM + 1), np.uint8)
    inner, outer = (each(closed, window) > 0 for each in (cv2.erode, cv2.dilate))
    share = np.clip((apart / np.where(np.abs(depth) < LEVELS[0] / 2, sign * LEVELS[0] / 2, depth)).min(axis=2), 0, 1)
    return np.asarray(depth * (np.where(inner, 1, share) * outer)[..., None], np.float32)


def _details(logarithm: NDArray[np.float32]) -> NDArray[np.float32]:
    gray = logarithm.mean(axis=2)
    return np.asarray(gray - cv2.blur(gray, (FINEST, FINEST)), np.float32)


def _is_sharp(labels: NDArray[np.int32], count: int, octaves: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Which pieces (count,) of `labels` (h, w) end all at once; the edge of a cloud's shadow is soft."""
    named = labels.astype(np.uint16)
    outer = cv2.dilate(named, np.ones((BESIDE, BESIDE), np.uint8))
    outer[cv2.dilate(named, np.ones((3, 3), np.uint8)) > 0] = 0
    ring = outer > 0
    depth = np.bincount(labels.ravel(), octaves.ravel(), count) / np.maximum(np.bincount(labels.ravel()), 1)
    own = outer[ring]
    ends = np.bincount(own, octaves[ring] < SHARP * depth[own], count)
    return np.asarray(ends >= LEAST_SHARP * np.maximum(np.bincount(own, minlength=count), 1))


def _kept(
    labels: NDArray[np.int32], count: int, middle: NDArray[np.float32], before: NDArray[np.float32],
    after: NDArray[np.float32],
) -> NDArray[np.bool_]:
    """Which pieces (count,) of `labels` (h, w), 0 none, show the same finest structure in both pictures, evenly dimmed.

    The correlation of the details is the best of all shifts up to `APART`.
    """
    inner: Anything = cv2.erode((labels > 0).view(np.uint8), np.ones((3, 3), np.uint8))
    rows, columns = np.nonzero(inner)
    if len(rows) == 0:
        return np.zeros(count, bool)
    step = -(-len(rows) // MOST_ASKED)
    rows, columns = rows[::step], columns[::step]
    own = labels[rows, columns]
    number = np.maximum(np.bincount(own, minlength=count), 1)
    depth, a = (_without_mean(each[rows, columns], own, number) for each in (middle, after))
    is_even = np.bincount(own, np.abs(depth), count) < MOST_SPREAD * number
    energy = np.bincount(own, a * a, count)
    width = before.shape[1] + 2 * APART
    padded = cv2.copyMakeBorder(before, APART, APART, APART, APART, cv2.BORDER_REPLICATE).ravel()
    best = np.full(count, -1.0)
    places = rows * width + columns
    for shift in (y * width + x for y in range(2 * APART + 1) for x in range(2 * APART + 1)):
        b = _without_mean(padded[places + shift], own, number)
        common = np.bincount(own, a * b, count)
        best = np.maximum(best, common / np.sqrt(energy * np.bincount(own, b * b, count) + 1e-9))
    is_even &= np.bincount(labels.ravel(), minlength=count) < LARGEST * labels.size
    kept = is_even & (best > LEAST_ALIKE + ALIKE_OF_FEW / np.sqrt(number))
    kept[0] = False
    return np.asarray(kept)


def _without_mean(
    values: NDArray[np.float32], own: NDArray[np.int32], number: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Values (N,) less the mean of their own piece."""
    return np.asarray(values - (np.bincount(own, values, len(number)) / number)[own])
