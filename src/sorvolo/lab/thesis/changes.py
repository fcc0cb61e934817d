"""Section 3.2: changes between two aligned pictures, step by step (equations 3.18 to 3.22, Table 4.2, Figure 3.14).

docs/errata.md lists where the text is read otherwise than it is printed.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from sorvolo import kernels
from sorvolo.change.compare import Comparison, checked_pair
from sorvolo.change.robust import as_bgr
from sorvolo.errors import SettingsError
from sorvolo.geometry.arrays import Boxes, Bytes, Floats, ImageGray, Mask
from sorvolo.geometry.summary import SIGMA_PER_MEDIAN_DEVIATION

_TABLE_LEVEL, _TABLE_SHARE = 40, 0.3  # T_gray and T_H of Table 4.2

Picture = Bytes
"""(height, width, 3) uint8, red green blue."""


@dataclass(frozen=True)
class ThesisSettings:
    """Table 4.2: window sizes as (width, height), and thresholds; shares lie in 0 to 1."""

    averaging_px: tuple[int, int] = (10, 10)  # W_a
    pattern_px: tuple[int, int] = (15, 15)  # W_l
    # T_gray, called T_diff in section 3.2; None: from each pair's light
    gray_threshold: int | None = _TABLE_LEVEL
    # T_H, of the three strings together; None: from each pair's light
    hamming_share: float | None = _TABLE_SHARE
    isolation_px: tuple[int, int] = (37, 37)  # W_i
    isolation_share: float = 0.25  # T_iso
    # at most T_iso of a window black; else at least T_iso white: see docs/errata.md
    isolation_as_printed: bool = False
    area_share: float = 0.000648  # T_area, of the frame
    least_distance: float = 0.3  # T_B

    def __post_init__(self) -> None:
        most = kernels.LARGEST_WINDOW_PX
        for name in ("averaging_px", "pattern_px", "isolation_px"):
            match window := getattr(self, name):
                case (int(width), int(height)) if (
                    1 <= min(width, height) <= max(width, height) <= most
                ):
                    pass
                case _:
                    raise SettingsError(
                        f"{name} is {window}; give width and height as whole numbers from 1 to {most}"
                    )
        for name in ("hamming_share", "isolation_share", "area_share", "least_distance"):
            share = getattr(self, name)
            if not (share is None and name == "hamming_share") and not 0 <= share <= 1:
                raise SettingsError(f"{name} is {share}; give a number from 0 to 1")
        level = self.gray_threshold
        if level is not None and not (isinstance(level, int) and 0 <= level <= 255):
            raise SettingsError(f"gray_threshold is {level}; give a whole number from 0 to 255")

    def in_light(self, light_levels: float) -> "ThesisSettings":
        """With T_diff and T_H as numbers, where they were left to the light.

        Section 3.2: the more the light of T and Q differs, the higher both are; it gives no formula. Here Table 4.2's
        values hold for like light, T_diff is at least twice the gray levels that light alone leaves between the
        pre-processed pictures (`light_difference`), and T_H rises with it, to 0.45 at most.
        """
        level = min(max(_TABLE_LEVEL, round(2 * light_levels)), 255)
        share = min(_TABLE_SHARE * level / _TABLE_LEVEL, 0.45)
        return replace(
            self,
            gray_threshold=level if self.gray_threshold is None else self.gray_threshold,
            hamming_share=share if self.hamming_share is None else self.hamming_share,
        )

    @property
    def most_differing_bits(self) -> int:
        """How many bits of the three binary strings together may differ between pixels that are the same."""
        assert self.hamming_share is not None  # `in_light` made it a number
        return _whole_share(self.hamming_share, 3 * self.pattern_px[0] * self.pattern_px[1])

    @property
    def most_black(self) -> int:
        """How many pixels of W_i may be black around one that stays, by the chosen reading of equation 3.21."""
        share = self.isolation_share if self.isolation_as_printed else 1 - self.isolation_share
        return _whole_share(share, self.isolation_px[0] * self.isolation_px[1])


@dataclass(frozen=True, eq=False)
class ThesisReference:
    """A picture as the difference needs it: made once for the reference, used for every query.

    `picture` (h, w, 3) BGR, as the kernels take it; `known` (h, w) uint8, 0 where nothing is known, None where all is;
    `tables` (3, 256) equalise it; `planes` (3, h, w) and `gray` (h, w) are the equalised picture after the micro-differences removal
    with the window `averaging_px`.
    """

    picture: Picture
    known: ImageGray | None
    tables: Bytes
    planes: Bytes
    gray: ImageGray
    averaging_px: tuple[int, int]


@dataclass(frozen=True, eq=False)
class ThesisSteps:
    """Every picture of Figure 3.14, (a) to (h) in order, and the boxes."""

    reference_equalised: Picture
    query_equalised: Picture
    reference_averaged: Picture
    query_averaged: Picture
    difference: ImageGray  # M_diff
    without_isolations: ImageGray
    changes: ImageGray  # N at the end
    highlighted: Picture  # N applied to the query
    boxes: Boxes

    def pictures(self) -> dict[str, Bytes]:
        """The pictures by name, such as "a-reference-equalised", in the figure's order; RGB or gray."""
        shown = [each.name for each in fields(self) if each.name != "boxes"]
        return {
            f"{letter}-{name.replace('_', '-')}": getattr(self, name)
            for letter, name in zip("abcdefgh", shown)
        }


def prepare_reference(
    picture: Picture,
    valid: Mask | None = None,
    settings: ThesisSettings | None = None,
    threads: int = 1,
) -> ThesisReference:
    """The pre-processing of one RGB picture (h, w, 3): equalised by channel, then averaged over W_a.

    Where `valid` (h, w) is False nothing is known: those pixels take no part in the equalisation.
    """
    settings = settings or ThesisSettings()
    known = None if valid is None or valid.all() else np.ascontiguousarray(valid).view(np.uint8)
    picture = as_bgr(picture)
    tables = kernels.equalising_tables(picture, known, threads)
    planes, gray = kernels.averaged(picture, tables, *settings.averaging_px, threads)
    return ThesisReference(picture, known, tables, planes, gray, settings.averaging_px)


def compare_thesis(
    reference: Picture | ThesisReference,
    query: Picture,
    valid: Mask | None = None,
    settings: ThesisSettings | None = None,
    threads: int = 1,
) -> Comparison:
    """The changes between two aligned RGB pictures (h, w, 3), by section 3.2; the same with any number of threads.

    Where `valid` (h, w) is False, or was for a prepared reference, the answer is unknown: such pixels take no part in
    the equalisation, are never different (nor are those whose average reaches into them), are never in the mask and
    do not count in histograms. A box that lost all its white pixels to another one that was removed is removed, too.
    Raises InputError where the sizes differ, SettingsError where the reference was prepared with another window.
    """
    return _compare(reference, query, valid, settings or ThesisSettings(), threads)[-1]


def thesis_steps(
    reference: Picture | ThesisReference,
    query: Picture,
    valid: Mask | None = None,
    settings: ThesisSettings | None = None,
    threads: int = 1,
) -> ThesisSteps:
    """`compare_thesis` with all that lies between: the pictures of Figure 3.14."""
    before, after, difference, kept, found = _compare(
        reference, query, valid, settings or ThesisSettings(), threads
    )
    both = before, after
    equalised = [
        np.asarray(cv2.LUT(each.picture, each.tables.T.reshape(1, 256, 3)), np.uint8)[..., ::-1]
        for each in both
    ]
    averaged = [np.ascontiguousarray(each.planes[::-1].transpose(1, 2, 0)) for each in both]
    return ThesisSteps(
        equalised[0],
        equalised[1],
        averaged[0],
        averaged[1],
        difference,
        kept,
        found.mask,
        np.where(found.mask[..., None] > 0, query, query // 3),
        found.boxes,
    )


def light_difference(before: ThesisReference, after: ThesisReference) -> float:
    """How far the light of two prepared pictures differs, in gray levels: what pre-processing leaves of it.

    1.48 times the median of their absolute difference, a spread that changes do not raise unless they fill half the
    picture. 0 where nothing is known.
    """
    apart = cv2.absdiff(before.gray, after.gray)
    known = apart if after.known is None else apart[after.known > 0]
    return SIGMA_PER_MEDIAN_DEVIATION * float(np.median(known)) if known.size else 0.0


def bhattacharyya_distances(first: NDArray[np.int64], second: NDArray[np.int64]) -> Floats:
    """Equation 3.22 for pairs of histograms (N, bins): 0 the same, 1 nothing in common; 0 where one is empty.

    With the square root of the product of means, without which (as printed) the result would always be near 1.
    """
    counts = np.sqrt(first.sum(axis=1, dtype=np.float64) * second.sum(axis=1))
    shared = np.sqrt(first.astype(np.float64) * second).sum(axis=1)
    overlap = np.divide(shared, counts, out=np.ones(len(first)), where=counts > 0)
    return np.sqrt(np.maximum(0.0, 1.0 - overlap))


def _compare(
    reference: Picture | ThesisReference,
    query: Picture,
    valid: Mask | None,
    settings: ThesisSettings,
    threads: int,
) -> tuple[ThesisReference, ThesisReference, ImageGray, ImageGray, Comparison]:
    """Both pictures prepared, M_diff, that without isolations, and the changes."""
    if isinstance(reference, ThesisReference):
        before = reference
    else:
        picture, _ = checked_pair(reference, query, valid)
        before = prepare_reference(picture, valid, settings, threads)
    _, query = checked_pair(before.picture, query, valid)
    if before.averaging_px != settings.averaging_px:
        raise SettingsError(
            f"the reference was prepared with averaging_px {before.averaging_px}, the settings have "
            f"{settings.averaging_px}; prepare it with these settings"
        )
    if before.known is not None:
        valid = (
            before.known.view(np.bool_) if valid is None else valid & before.known.view(np.bool_)
        )
    after = prepare_reference(query, valid, settings, threads)
    settings = settings.in_light(light_difference(before, after))
    # M_diff: equation 3.19, and where its D is 1 the Hamming distance of the strings of
    # equation 3.20
    assert settings.gray_threshold is not None  # `in_light` made it a number
    apart = cv2.absdiff(before.gray, after.gray)
    different = np.asarray(
        cv2.threshold(apart, settings.gray_threshold - 1, 255, cv2.THRESH_BINARY)[1], np.uint8
    )
    if after.known is not None:
        width, height = settings.averaging_px
        # the reach of W_a to both sides, so that no average that saw the unknown is looked at
        window = np.ones((2 * (height // 2) + 1, 2 * (width // 2) + 1), np.uint8)
        different[cv2.erode(after.known, window, borderValue=1) == 0] = 0
    difference = kernels.texture_changes(
        before.planes,
        after.planes,
        different,
        *settings.pattern_px,
        settings.most_differing_bits,
        threads,
    )
    kept = kernels.without_isolations(
        difference, *settings.isolation_px, settings.most_black, threads
    )
    if after.known is not None:
        kept[after.known == 0] = 0
    # bounding boxes less those too small (T_area) or with similar histograms (T_B), their
    # pixels black
    mask, boxes = kept.copy(), kernels.region_boxes(kept)
    removed = boxes[:, 2] * boxes[:, 3] < settings.area_share * mask.size
    histograms = [
        kernels.gray_histograms(each.picture, each.tables, boxes[~removed], after.known)
        for each in (before, after)
    ]
    removed[~removed] = bhattacharyya_distances(*histograms) < settings.least_distance
    for x, y, width, height in boxes[removed]:
        mask[y : y + height, x : x + width] = 0
    white = [mask[y : y + height, x : x + width].any() for x, y, width, height in boxes]
    return (
        before,
        after,
        difference,
        kept,
        Comparison(mask, boxes[~removed & np.array(white, bool)]),
    )


def _whole_share(share: float, count: int) -> int:
    """The whole part of a share, as if the share were the decimal number that it prints as."""
    return int(round(share * count, 6))


@dataclass(frozen=True)
class ThesisComparison:
    """The method as `compare_flights` takes it."""

    name: ClassVar[str] = "thesis"

    settings: ThesisSettings = field(default_factory=ThesisSettings)

    def compare(self, reference: Picture, query: Picture, valid: Mask) -> Comparison:
        """The changes between two aligned RGB pictures (h, w, 3)."""
        return compare_thesis(reference, query, valid, self.settings)

    def steps(self, reference: Picture, query: Picture, valid: Mask) -> Mapping[str, Bytes]:
        """The pictures of Figure 3.14 by name."""
        return thesis_steps(reference, query, valid, self.settings).pictures()
