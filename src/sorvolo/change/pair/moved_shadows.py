"""Shadows of tall things that lie elsewhere on the later date: the same ground in other light with a sharp edge."""

import cv2
import numpy as np
from cv2.typing import MatLike
from numpy.typing import NDArray

from sorvolo.change.pair.regions import Image
from sorvolo.geometry.arrays import Floats, Mask

STEPS = 24  # to an octave, of differences of logarithms; these are 8 bit, 128 alike
ALIKE = 128
LEVELS = (8, 14, 22)  # steps darker or brighter: more comes free of what it touches
MOST_TINT = 15  # steps between the colours: a shadow takes somewhat less of blue
MOST_SPREAD, MOST_OFF = 3.0, 9  # steps from a shadow's own depth, mean, and of each pixel
LEAST_WIDTH = 5  # pixels of the pictures given: narrower shadows are those of people and small things, which tell them
LEAST_ALIKE, ALIKE_OF_FEW = 0.35, 2.5  # correlation of the ground's details within; more where few pixels tell
FINEST = 9  # pixels: details are what is smaller
APART = 1  # pixels that the pictures may be apart
MOST_ASKED = 4000  # pixels that are asked
SHARP, LEAST_SHARP = 0.4, 0.4  # of its depth is left beside a shadow, at most, along so much of its edge
BESIDE = 9  # pixels, the width of the window by which that is beside it
LARGEST = 0.05  # of the picture: what is larger is a cloud, and smooth gains follow it
HOLE = 11  # pixels wide, at most: what stands in a shadow and is no ground
NEAR = 15  # pixels: how far the depth of a shadow is the same
MOST_APART = 6  # steps from a shadow's depth: ground beside it that it covers, too
LEAST_PART, MOST_UNLIKE = -0.25, 0.5  # of a shadow's depth, and between the colours: else it is no shadow's edge
RIM, SOFT = 2, 5  # pixels on both sides of a shadow's edge, where it is blurred; outside where it is soft


def moved_shades(before: Image, after: Image, known: Mask | None) -> NDArray[np.float32] | None:
    """Octaves (h, w, 3) by which ground is brighter that a shadow left (below 0: darker, it came); None if nowhere.

    `before` and `after` (h, w, 3) uint8 are logarithms, 2 `STEPS` an octave, of two pictures in the same light; nothing
    is said where not `known` (h, w). What changes its brightness evenly, keeps its finest structure and is wide enough
    is the same ground under another shadow; a new thing hides the ground's structure.
    """
    apart = cv2.blur(cv2.addWeighted(after, 0.5, before, -0.5, ALIKE), (3, 3))
    blue, green, red = cv2.split(apart)
    tint = cv2.subtract(cv2.max(cv2.max(blue, green), red), cv2.min(cv2.min(blue, green), red))
    alike = cv2.threshold(tint, MOST_TINT - 1, 255, cv2.THRESH_BINARY_INV)[1]
    if known is not None:
        alike = cv2.min(alike, known.view(np.uint8) * np.uint8(255))
    middle = cv2.addWeighted(cv2.addWeighted(blue, 0.5, red, 0.5, 0), 2 / 3, green, 1 / 3, 0)
    details: tuple[Image, Image] | None = None
    octaves: NDArray[np.float32] | None = None
    for sign in (-1, 1):
        shaded = np.zeros(middle.shape, np.uint8)
        brighter = cv2.addWeighted(middle, sign, middle, 0, ALIKE - sign * ALIKE)
        for level in LEVELS:
            differs = cv2.threshold(brighter, ALIKE + level, 255, cv2.THRESH_BINARY)[1]
            pieces = _Pieces(cv2.min(cv2.min(differs, alike), cv2.bitwise_not(shaded)), middle)
            if pieces.count == 1:
                break
            details = details or (_details(before), _details(after))
            kept = pieces.are_shadows()
            if kept.any():
                kept = pieces.show_the_same(kept, *details)
                shaded |= pieces.like_the_rest(kept)
        if shaded.any():
            if octaves is None:
                octaves = np.zeros(apart.shape, np.float32)
            weak = cv2.min(cv2.threshold(brighter, ALIKE + LEVELS[0] // 2, 255, cv2.THRESH_BINARY)[1], alike)
            x, y, wide, high = cv2.boundingRect(shaded)
            part = slice(max(0, y - NEAR), y + high + NEAR), slice(max(0, x - NEAR), x + wide + NEAR)
            octaves[part] += _octaves(shaded[part], weak[part], apart[part])
    if octaves is not None and known is not None:
        octaves[~known] = 0
    return octaves


class _Pieces:
    """The wide enough pieces of a mask (h, w), 0 or 255: `count` of them with the ground, which is 0 in `labels`.

    `middle` (h, w) is how much brighter the ground became.
    """

    def __init__(self, mask: MatLike, middle: MatLike) -> None:
        window = np.ones((LEAST_WIDTH, LEAST_WIDTH), np.uint8)
        self._opened = cv2.morphologyEx(mask, cv2.MORPH_OPEN, window)
        self.count, self.labels = 1, self._opened
        if cv2.countNonZero(self._opened) == 0:
            return
        self.count, self.labels = cv2.connectedComponents(self._opened, connectivity=4, ltype=cv2.CV_16U)
        # some of the pixels that lie within pieces, and whose they are
        places = _places(cv2.erode(self._opened, np.ones((3, 3), np.uint8)))
        step = max(1, -(-len(places) // MOST_ASKED))
        self._places, self._share = places[::step], step / self.labels.size
        own = self.labels.ravel()[self._places]
        order = np.argsort(own, kind="stable")  # piece by piece
        self._places, self._own = self._places[order], own[order]
        held = np.bincount(self._own, minlength=self.count)
        self._is_held, self._number = held > 0, np.maximum(held, 1)
        self._middle, self._steps = middle, _steps(middle, self._places)
        self._depth = self._mean(self._steps)

    def are_shadows(self) -> NDArray[np.bool_]:
        """Which (count,) are no more than a part of the picture, about as deep everywhere, and end all at once.

        The edge of a cloud's shadow is soft.
        """
        off = self._mean(np.abs(self._steps - self._depth[self._own]))
        fits = self._is_held & (self._number * self._share < LARGEST) & (off < MOST_SPREAD)
        if not fits.any():
            return fits
        outer = cv2.dilate(self.labels, np.ones((BESIDE, BESIDE), np.uint8))
        outer[cv2.dilate(self._opened, np.ones((3, 3), np.uint8)) > 0] = 0
        ring = _places(outer)
        own = outer.ravel()[ring]
        ends = np.bincount(own, np.abs(_steps(self._middle, ring)) < SHARP * np.abs(self._depth)[own], self.count)
        return fits & (ends >= LEAST_SHARP * np.maximum(np.bincount(own, minlength=self.count), 1))

    def like_the_rest(self, kept: NDArray[np.bool_]) -> Image:
        """The pixels (h, w), 255 or 0, of the `kept` pieces (count,) that are about as deep as their piece.

        What is not is a thing in the shadow.
        """
        lowest, highest = (
            np.rint(ALIKE + self._depth + off).clip(0, 255).astype(np.uint8) for off in (-MOST_OFF, MOST_OFF)
        )
        alike = np.zeros(self.labels.shape, np.uint8)
        if not kept.any():
            return alike
        places = np.flatnonzero(kept[self.labels])
        own, steps = self.labels.ravel()[places], self._middle.ravel()[places]
        alike.ravel()[places] = np.uint8(255) * ((steps >= lowest[own]) & (steps <= highest[own]))
        return alike

    def show_the_same(self, asked: NDArray[np.bool_], before: Image, after: Image) -> NDArray[np.bool_]:
        """Which (count,) of those `asked` show the same structure in the details (h, w) of both pictures.

        They may be up to `APART` pixels apart.
        """
        chosen = asked[self._own]
        places, own = self._places[chosen], self._own[chosen]
        kept, starts = np.unique(own, return_index=True)
        number = np.diff(np.append(starts, len(own)))

        def centred(values: Floats) -> Floats:
            means = np.add.reduceat(values, starts, axis=-1) / number
            return values - np.repeat(means, number, axis=-1)

        padded = cv2.copyMakeBorder(before, APART, APART, APART, APART, cv2.BORDER_REPLICATE)
        rows, columns = np.divmod(places, before.shape[1])
        shifts = np.array([y * padded.shape[1] + x for y in range(2 * APART + 1) for x in range(2 * APART + 1)])
        a = centred(_steps(after, places))
        b = centred(_steps(padded, rows * padded.shape[1] + columns + shifts[:, None]))
        energies = np.add.reduceat(a * a, starts) * np.add.reduceat(b * b, starts, axis=1)
        alike = np.add.reduceat(a * b, starts, axis=1) / np.sqrt(energies + 1e-9)
        same = np.zeros(self.count, bool)
        same[kept] = alike.max(axis=0) > LEAST_ALIKE + ALIKE_OF_FEW / np.sqrt(number)
        return same

    def _mean(self, values: Floats) -> Floats:
        """(count,) means of values (N,) over the pixels of each piece."""
        return np.asarray(np.bincount(self._own, values, self.count) / self._number)


def _places(image: MatLike) -> NDArray[np.int64]:
    """Where an image is not 0, counted row by row."""
    return np.flatnonzero(image != 0)


def _steps(image: MatLike, places: NDArray[np.int64]) -> Floats:
    return np.asarray(image.ravel()[places].astype(np.float64) - ALIKE)


def _details(logarithm: Image) -> Image:
    gray = cv2.cvtColor(logarithm, cv2.COLOR_BGR2GRAY)
    return np.asarray(cv2.addWeighted(gray, 1, cv2.blur(gray, (FINEST, FINEST)), -1, ALIKE), np.uint8)


def _octaves(shaded: MatLike, weak: MatLike, apart: MatLike) -> NDArray[np.float32]:
    """(h, w, 3) how deep the shadow is where `shaded`, smooth; about its rim the part of it that all colours show.

    Its rim is as wide as what near it is `weak`, dimmed a little. What stands in it leaves holes: they are as deep.
    """
    steps = apart.astype(np.float32) - ALIKE
    known = np.asarray(cv2.blur(shaded.astype(np.float32), (NEAR, NEAR)))
    share = np.maximum(known, np.float32(1e-3))
    depth = cv2.divide(cv2.blur(cv2.copyTo(steps, shaded), (NEAR, NEAR)), cv2.merge([share] * 3), scale=255)
    # narrow parts beside it
    off = cv2.split(cv2.absdiff(steps, depth))
    beside = (cv2.max(cv2.max(off[0], off[1]), off[2]) < MOST_APART) & (known > 0.5)
    whole = cv2.max(shaded, np.asarray(beside).view(np.uint8) * np.uint8(255))
    window = np.ones((2 * RIM + 1, 2 * RIM + 1), np.uint8)
    soft = cv2.min(weak, cv2.dilate(whole, np.ones((2 * SOFT + 1, 2 * SOFT + 1), np.uint8)))
    parts = cv2.split(steps / np.where(depth == 0, np.float32(1), depth))
    least, most = cv2.min(cv2.min(parts[0], parts[1]), parts[2]), cv2.max(cv2.max(parts[0], parts[1]), parts[2])
    part = np.clip(least, 0, 1)
    part[cv2.max(cv2.dilate(whole, window), soft) == 0] = 0
    # what stands in it hides the ground's light; ground between two shadows shows its own
    hides = (least < LEAST_PART) | (np.asarray(most) - least > MOST_UNLIKE)
    filled = cv2.morphologyEx(whole, cv2.MORPH_CLOSE, np.ones((HOLE, HOLE), np.uint8))
    part[(cv2.erode(whole, window) > 0) | ((filled > 0) & hides)] = 1
    return np.asarray(cv2.multiply(depth, cv2.merge([part] * 3), scale=1 / STEPS), np.float32)
