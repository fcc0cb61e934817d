"""Real people cut out of pictures from straight above, to be planted in place of drawn ones."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Self

import cv2
import numpy as np

from sorvolo.geometry.arrays import Floats, ImageGray, ImageRGB, ImageRGBA, Mask, shrunk, square
from sorvolo.registration.features import FeatureSettings, gray_from_rgb, sift_features
from sorvolo.registration.matching import fit_homography, match
from sorvolo.search.drawing.objects import GROUND_LEVEL, Body, Thing, ThingLabel
from sorvolo.search.drawing.view import DrawnPatch

if TYPE_CHECKING:
    from sorvolo.search.drawing.planted import FrameLight

LONGEST_M, SHORTEST_M = 2.6, 0.25
"""A person from straight above, with arms and a rucksack, is no longer and no shorter; by choice."""

_DIFFERS = 5.0  # times the usual difference from the ground without the person
_LEAST_DIFFERENCE = 18.0  # grey levels of one channel
_SHADE = 0.1  # of the light: so alike a shadow darkens all channels
_DARKEST_SHADE = 0.3
_HEIGHT_M = 0.15  # over the ground, at which a cut-out lies: what it hides throws a little shadow
_FEWEST_PAIRS = 12  # of features, by which two pictures show the same ground

FEWEST_PICTURES = 3
"""Of which two show each piece of ground without the person."""


@dataclass(frozen=True, eq=False)
class CutOut:
    """A person from straight above: `texture` RGBA as it shows in full daylight, colours multiplied by alpha, in a
    thermal one levels of warmth; its pixels cover `m_per_px`. `name` is the picture's."""

    name: str
    texture: ImageRGBA
    m_per_px: float
    is_thermal: bool

    @classmethod
    def of(
        cls, name: str, image: ImageRGB, alpha: Floats, m_per_px: float, light: "FrameLight | None"
    ) -> Self | None:
        """Cut a person out by (H, W) `alpha`, 0 to 1, and take the picture's light off; None where nothing is there.

        With no `light` the colours count as they are: the picture shows no surroundings by which it could be known.
        """
        rows, columns = np.nonzero(alpha > 0.5)
        if not len(rows):
            return None
        part = slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1)
        colours, share = image[part].astype(np.float64), alpha[part][..., None]
        is_thermal = bool((np.ptp(colours[share[..., 0] > 0.5], axis=1) < 10).mean() > 0.99)
        if light is not None:
            is_thermal = light.is_thermal
            colours = (colours - light.haze) / light.gain + GROUND_LEVEL * is_thermal
        texture = np.dstack([np.clip(colours, 0, 255) * share, 255 * share])
        return cls(name, np.round(texture).astype(np.uint8), m_per_px, is_thermal)

    @property
    def size_m(self) -> tuple[float, float]:
        """Width and height of the picture on the ground."""
        height, width = self.texture.shape[:2]
        return width * self.m_per_px, height * self.m_per_px

    @property
    def is_of_a_size(self) -> bool:
        """Whether a person can be so long."""
        return SHORTEST_M <= max(self.size_m) <= LONGEST_M


@dataclass(frozen=True)
class CutThing(Thing):
    """A plant that shows a cut-out, level on the ground."""

    cut_out: CutOut = field(kw_only=True)

    @classmethod
    def new(cls, number: int, place_m: Floats, cut_outs: Sequence[CutOut], seed: int) -> Self:
        """One of these people, turned as it happens; `place_m` (2,) is where it lies."""
        rng = np.random.default_rng([seed, number, 32])
        own = cut_outs[int(rng.integers(len(cut_outs)))]
        east_m, north_m = (float(each) for each in place_m)
        size_m = (*own.size_m, _HEIGHT_M)
        turn_deg, own_seed = float(rng.uniform(0, 360)), int(rng.integers(2**31))
        return cls(
            number, ThingLabel.PERSON, "cut-out", east_m, north_m, turn_deg, size_m, own_seed, cut_out=own
        )  # fmt: skip

    def body(self, m_per_px: float) -> Body:
        """The cut-out as one level leaf, its texture no finer than views of `m_per_px` show."""
        texture, (width_m, height_m) = self.cut_out.texture, self.cut_out.size_m
        size = max(1, round(width_m / m_per_px)), max(1, round(height_m / m_per_px))
        if size[0] < texture.shape[1]:
            texture = shrunk(texture, size)
        corners_m = np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]]) * [width_m / 2, height_m / 2]
        level_m = np.column_stack([corners_m, np.full(4, _HEIGHT_M)])
        return Body((DrawnPatch.spanned(level_m, texture, np.zeros(3)),))


def sheet_of(cut_outs: Sequence[CutOut]) -> ImageRGBA:
    """(H, W, 4) all of them in a row, 1 cm a pixel, clear where nobody is."""
    shown = [
        shrunk(each.texture, (max(1, round(100 * width)), max(1, round(100 * height))))
        for each in cut_outs
        for width, height in [each.size_m]
    ]
    side = max(max(each.shape[:2]) for each in shown) + 10
    sheet: ImageRGBA = np.zeros((side, side * len(shown), 4), np.uint8)
    for number, each in enumerate(shown):
        height, width = each.shape[:2]
        sheet[5 : 5 + height, number * side + 5 : number * side + 5 + width] = each
    return sheet


def alphas_by_difference(images: Sequence[ImageRGB], m_per_px: float) -> list[Floats]:
    """Where each of several pictures (H, W, 3) of the same ground shows the person who is elsewhere in the others.

    (H, W) each, 0 to 1; zeros for a picture that does not lie on the others, or differs in nothing of a person's size.
    The ground without the person is the pictures' median, each laid on the others by its features. Shadows, which
    darken all channels alike, are no part of a person.
    """
    nothing = [np.zeros(each.shape[:2]) for each in images]
    if len(images) < FEWEST_PICTURES:
        return nothing
    height, width = images[0].shape[:2]
    settings, middle = FeatureSettings(), len(images) // 2
    features = [sift_features(gray_from_rgb(each), settings) for each in images]
    all_known: ImageGray = np.full((height, width), 255, np.uint8)
    laid, homographies = [], []
    for image, own in zip(images, features):
        fit = None
        pairs = match(own, features[middle], None, 0.0)
        if len(pairs) >= _FEWEST_PAIRS and image.shape == images[middle].shape:
            ends_px = own.points_px[pairs[:, 0]], features[middle].points_px[pairs[:, 1]]
            fit = fit_homography(*ends_px, 3.0)
        homographies.append(None if fit is None else fit[0])
        if fit is not None:
            shown, is_shown = (
                cv2.warpPerspective(
                    each, fit[0], (width, height), flags=cv2.WARP_INVERSE_MAP | cv2.INTER_LINEAR
                )
                for each in (image, np.full((height, width), 255, np.uint8))
            )
            laid.append(shown)
            all_known = np.minimum(all_known, is_shown).astype(np.uint8)
    if len(laid) < FEWEST_PICTURES:
        return nothing
    ground = np.median(np.array(laid), axis=0).astype(np.uint8)
    alphas = []
    for image, own_from_middle in zip(images, homographies):
        if own_from_middle is None:
            alphas.append(np.zeros(image.shape[:2]))
            continue
        below, is_known = (
            np.asarray(cv2.warpPerspective(each, own_from_middle, (width, height)), np.uint8)
            for each in (ground, all_known)
        )
        alphas.append(_differing(image, below, is_known > 254, m_per_px))
    return alphas


def _differing(image: ImageRGB, ground: ImageRGB, is_known: Mask, m_per_px: float) -> Floats:
    """(H, W), 0 to 1, where a picture differs from the ground by a thing of a person's size, the largest."""
    soft = [cv2.GaussianBlur(each, (0, 0), 1.0).astype(np.float32) for each in (image, ground)]
    difference = np.abs(soft[0] - soft[1]).max(axis=2)
    usual = float(np.median(difference[is_known])) if is_known.any() else 0.0
    light = (soft[0] + 4) / (soft[1] + 4)
    is_shade = (np.ptp(light, axis=2) < _SHADE) & (light.mean(axis=2) > _DARKEST_SHADE)
    is_shade &= light.mean(axis=2) < 1
    differs = (difference > max(_DIFFERS * usual, _LEAST_DIFFERENCE)) & is_known
    if np.ptp(image, axis=2).mean() > 2:  # in grey pictures nothing tells a shadow from a body
        differs &= ~is_shade
    side = max(3, round(0.06 / m_per_px) | 1)
    whole = cv2.morphologyEx(differs.astype(np.uint8), cv2.MORPH_OPEN, square(3))
    whole = cv2.morphologyEx(whole, cv2.MORPH_CLOSE, square(side))
    count, parts, stats, _ = cv2.connectedComponentsWithStats(whole)
    sizes_m = stats[:, [cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT]].max(axis=1) * m_per_px
    fits = [number for number in range(1, count) if SHORTEST_M <= sizes_m[number] <= LONGEST_M]
    if not fits:
        return np.zeros(image.shape[:2])
    largest = max(fits, key=lambda number: int(stats[number, cv2.CC_STAT_AREA]))
    return np.asarray(
        cv2.GaussianBlur((parts == largest).astype(np.float32), (0, 0), 0.7), np.float64
    )
