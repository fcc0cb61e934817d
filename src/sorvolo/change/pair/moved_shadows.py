"""Shadows of tall things that lie elsewhere on the later date: the same ground in other light with a sharp edge."""

from dataclasses import dataclass

import cv2
import numpy as np
from cv2.typing import MatLike
from numpy.typing import NDArray

from sorvolo.change.pair.regions import Image
from sorvolo.geometry.arrays import Floats, Mask

STEPS = 24  # to an octave, of differences of logarithms; these are 8 bit, 128 alike
ALIKE = 128  # the grey level, 0 to 255, that stands for no difference of two pictures


@dataclass(frozen=True)
class MovedShadowSettings:
    """What is the same ground under another shadow (0014). Lengths in px of the pictures given, a quarter of a view's.

    Depths are in steps, `STEPS` to an octave.
    """

    levels: tuple[int, ...] = (
        8,
        14,
        22,
    )  # darker or brighter by so much: more comes free of what it touches
    most_tint: int = 15  # between the colours: a shadow takes somewhat less of blue
    least_width_px: int = (
        5  # narrower shadows are those of people and small things, which reveal them
    )
    least_alike: float = 0.35  # correlation of the ground's details within, at least, and ...
    alike_of_few: float = 2.5  # ... so much more, by the root of the number of pixels
    sharp: float = (
        0.4  # of its depth is left beside a shadow, at most, along as large a share of its edge
    )
    largest: float = 0.05  # of the picture: what is larger is a cloud, and smooth gains follow it
    near_px: int = 15  # how far the depth of a shadow is the same
    most_apart: int = 6  # from a shadow's depth: ground beside it that it covers, too
    rim_px: int = 2  # on both sides of a shadow's edge, where it is blurred


def moved_shades(
    before: Image,
    after: Image,
    known: Mask | None,
    settings: MovedShadowSettings = MovedShadowSettings(),
) -> NDArray[np.float32] | None:
    """Octaves (h, w, 3) by which ground is brighter that a shadow left (below 0: darker, it came); None if nowhere.

    `before` and `after` (h, w, 3) uint8 are logarithms, 2 `STEPS` an octave, of two pictures in the same light; nothing
    is reported where not `known` (h, w). What changes its brightness evenly, keeps its finest structure and is wide
    enough is the same ground under another shadow; a new thing hides the ground's structure.
    """
    apart = np.asarray(cv2.blur(cv2.addWeighted(after, 0.5, before, -0.5, ALIKE), (3, 3)), np.uint8)
    blue, green, red = cv2.split(apart)
    tint = cv2.subtract(cv2.max(cv2.max(blue, green), red), cv2.min(cv2.min(blue, green), red))
    alike = cv2.threshold(tint, settings.most_tint - 1, 255, cv2.THRESH_BINARY_INV)[1]
    if known is not None:
        alike = cv2.min(alike, known.view(np.uint8) * np.uint8(255))
    middle = cv2.addWeighted(cv2.addWeighted(blue, 0.5, red, 0.5, 0), 2 / 3, green, 1 / 3, 0)
    octaves: NDArray[np.float32] | None = None
    for sign in (-1, 1):
        shaded = _shaded(middle, alike, sign, (before, after), settings)
        if shaded.any():
            octaves = np.zeros(apart.shape, np.float32) if octaves is None else octaves
            x, y, wide, high = cv2.boundingRect(shaded)
            near = settings.near_px
            part = (
                slice(max(0, y - near), y + high + near),
                slice(max(0, x - near), x + wide + near),
            )
            octaves[part] += _octaves(shaded[part], apart[part], settings)
    if octaves is not None and known is not None:
        octaves[~known] = 0
    return octaves


def _shaded(
    middle: MatLike,
    alike: MatLike,
    sign: int,
    pictures: tuple[Image, Image],
    settings: MovedShadowSettings,
) -> Image:
    """Where (h, w), 255 or 0, ground became brighter (`sign` 1) or darker (-1) under another shadow.

    `middle` (h, w) is by how much, `alike` (h, w) where all colours did so, in `pictures` before and after.
    """
    shaded = np.zeros(middle.shape, np.uint8)
    brighter = cv2.addWeighted(middle, sign, middle, 0, ALIKE - sign * ALIKE)
    details: tuple[Image, Image] | None = None
    for level in settings.levels:
        differs = cv2.threshold(brighter, ALIKE + level, 255, cv2.THRESH_BINARY)[1]
        pieces = _Pieces(
            cv2.min(cv2.min(differs, alike), cv2.bitwise_not(shaded)), middle, settings
        )
        if pieces.count == 1:
            break
        kept = pieces.are_shadows()
        if kept.any():
            details = details or (_details(pictures[0]), _details(pictures[1]))
            shaded[pieces.show_the_same(kept, *details)[pieces.labels]] = 255
    return shaded


class _Pieces:
    """The wide enough pieces of a mask (h, w), 0 or 255: `count` of them with the ground, which is 0 in `labels`.

    `middle` (h, w) is how much brighter the ground became.
    """

    def __init__(self, mask: MatLike, middle: MatLike, settings: MovedShadowSettings) -> None:
        self._settings = settings
        window = np.ones((settings.least_width_px, settings.least_width_px), np.uint8)
        self._opened = cv2.morphologyEx(mask, cv2.MORPH_OPEN, window)
        self.count, self.labels = 1, self._opened
        if cv2.countNonZero(self._opened) == 0:
            return
        self.count, self.labels = cv2.connectedComponents(
            self._opened, connectivity=4, ltype=cv2.CV_16U
        )
        # some of the pixels that lie within pieces, 4000 at most, and whose they are
        places = _places(cv2.erode(self._opened, np.ones((3, 3), np.uint8)))
        step = max(1, -(-len(places) // 4000))
        self._places, self._share = places[::step], step / self.labels.size
        own = self.labels.ravel()[self._places]
        order = np.argsort(own, kind="stable")  # piece by piece
        self._places, self._own = self._places[order], own[order]
        held = np.bincount(self._own, minlength=self.count)
        self._is_held, self._number = held > 0, np.maximum(held, 1)
        self._middle, self._steps = middle, _steps(middle, self._places)
        self._depth = self._mean(self._steps)

    def are_shadows(self) -> NDArray[np.bool_]:
        """Which (count,) are no more than a part of the picture, and end all at once.

        The edge of a cloud's shadow is soft.
        """
        fits = self._is_held & (self._number * self._share < self._settings.largest)
        if not fits.any():
            return fits
        outer = cv2.dilate(self.labels, np.ones((9, 9), np.uint8))
        outer[cv2.dilate(self._opened, np.ones((3, 3), np.uint8)) > 0] = 0
        ring = _places(outer)
        own, sharp = outer.ravel()[ring], self._settings.sharp
        ends = np.bincount(
            own, np.abs(_steps(self._middle, ring)) < sharp * np.abs(self._depth)[own], self.count
        )
        return fits & (ends >= sharp * np.maximum(np.bincount(own, minlength=self.count), 1))

    def show_the_same(
        self, asked: NDArray[np.bool_], before: Image, after: Image
    ) -> NDArray[np.bool_]:
        """Which (count,) of those `asked` show the same structure in the details (h, w) of both pictures.

        They may be a pixel apart.
        """
        chosen = asked[self._own]
        places, own = self._places[chosen], self._own[chosen]
        kept, starts = np.unique(own, return_index=True)
        number = np.diff(np.append(starts, len(own)))

        def centred(values: Floats) -> Floats:
            means = np.add.reduceat(values, starts, axis=-1) / number
            return values - np.repeat(means, number, axis=-1)

        padded = cv2.copyMakeBorder(before, 1, 1, 1, 1, cv2.BORDER_REPLICATE)
        rows, columns = np.divmod(places, before.shape[1])
        shifts = np.array([y * padded.shape[1] + x for y in range(3) for x in range(3)])
        a = centred(_steps(after, places))
        b = centred(_steps(padded, rows * padded.shape[1] + columns + shifts[:, None]))
        energies = np.add.reduceat(a * a, starts) * np.add.reduceat(b * b, starts, axis=1)
        alike = np.add.reduceat(a * b, starts, axis=1) / np.sqrt(energies + 1e-9)
        same = np.zeros(self.count, bool)
        same[kept] = alike.max(
            axis=0
        ) > self._settings.least_alike + self._settings.alike_of_few / np.sqrt(number)
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
    """What is smaller than 9 pixels."""
    gray = cv2.cvtColor(logarithm, cv2.COLOR_BGR2GRAY)
    return np.asarray(cv2.addWeighted(gray, 1, cv2.blur(gray, (9, 9)), -1, ALIKE), np.uint8)


def _octaves(shaded: Image, apart: Image, settings: MovedShadowSettings) -> NDArray[np.float32]:
    """(h, w, 3) how deep the shadow is where `shaded`, smooth; about its rim the part of it that all colours show."""
    near, rim = (
        (settings.near_px, settings.near_px),
        np.ones((2 * settings.rim_px + 1,) * 2, np.uint8),
    )
    steps = apart.astype(np.float32) - ALIKE
    known = np.asarray(cv2.blur(shaded.astype(np.float32), near))
    share = np.maximum(known, np.float32(1e-3))
    depth = cv2.divide(cv2.blur(cv2.copyTo(steps, shaded), near), cv2.merge([share] * 3), scale=255)
    # narrow parts beside it
    off = cv2.split(cv2.absdiff(steps, depth))
    beside = (cv2.max(cv2.max(off[0], off[1]), off[2]) < settings.most_apart) & (known > 0.5)
    whole = cv2.max(shaded, np.asarray(beside).view(np.uint8) * np.uint8(255))
    parts = cv2.split(steps / np.where(depth == 0, np.float32(1), depth))
    part = np.clip(cv2.min(cv2.min(parts[0], parts[1]), parts[2]), 0, 1)
    part[cv2.dilate(whole, rim) == 0] = 0
    part[cv2.erode(whole, rim) > 0] = 1
    return np.asarray(cv2.multiply(depth, cv2.merge([part] * 3), scale=1 / STEPS), np.float32)
