"""Ground that changed as an area, gathered over a flight's views: each area is one change, however large.

The ground is divided into cells. Cells whose structure is that of the map are the same ground, and show what light,
season and cameras do on this flight. An area is connected ground of other structure whose colour and roughness differ
much more than that, in the views on the whole and in most of them alone.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from sorvolo.change.areas.connected_areas import AreaSettings, GroundSigns, segments
from sorvolo.change.areas.ground_pictures import GroundPictureSettings
from sorvolo.change.areas.ground_sums import GroundSums
from sorvolo.change.areas.signs import AreaSigns, SignSettings, area_signs
from sorvolo.change.shape.outlines import mask_of, measures, outline_of
from sorvolo.change.shape.place_sigma import place_sigma_m
from sorvolo.geometry.arrays import Mask, PointsM
from sorvolo.survey.findings import Change, ChangeKind, ComparedView, Patch

_SUMS = ("seen", "agree", "likeness", "blue", "red", "detail", "blue_now", "red_now")


@dataclass(frozen=True)
class AreaVotes:
    """When the views of an area's ground make it one (0025). Units: see `segments`."""

    least_views: int = 2  # that saw a cell
    agreeing_views: float = 2.5  # on the mean that show an area by themselves: two may lean alike
    agreeing_share: float = (
        0.5  # of the views of an area's ground must differ from the map there, each by itself
    )
    own_units: float = 2.0  # by which a view alone differs
    sure_units: float = 6.0  # an area that differs by so much is sure
    least_score: float = 0.3  # 0 to 1


@dataclass(frozen=True)
class AreaMapSettings:
    """How views are gathered to areas (0025)."""

    cell_px: int = 2  # a cell's side, in pixels of the small size at which views are examined
    picture_px: int = 8  # pixels of an area's pictures, along a cell's side
    most_cells: int = 4_000_000  # of the raster, which bounds its memory: views beyond are left out
    votes: AreaVotes = field(default_factory=AreaVotes)
    segments: AreaSettings = field(default_factory=AreaSettings)
    signs: SignSettings = field(default_factory=SignSettings)
    pictures: GroundPictureSettings = field(default_factory=GroundPictureSettings)


@dataclass(frozen=True)
class ApartSettings:
    """When a change is a part of an area, or an area only changes (0025)."""

    inside: float = 0.7  # share of a change within an area: it is a part of it ...
    stands_out: float = 1.5  # ... unless it differs by so many spreads of the ground around
    explained: float = 0.5  # share of an area within things: it is nothing more than they


class AreaMap:
    """The areas of one flight while its views come in. Only `add` changes it."""

    def __init__(self, settings: AreaMapSettings = AreaMapSettings()) -> None:
        self._settings = settings
        self._ground = GroundSums(_SUMS, settings.most_cells, settings.pictures)

    def add(self, view: ComparedView, leans: Mask | None = None) -> None:
        """Take in one view, of which earlier pictures show that some ground `leans` (h, w)."""
        settings = self._settings
        cell_m = (
            settings.cell_px
            * view.m_per_px
            * max(1.0, max(view.valid.shape) / settings.signs.side_px)
        )
        window = self._ground.window_of(view, cell_m, cell_m / settings.picture_px)
        if window is None:
            return
        signs = area_signs(view, leans, settings.signs)
        planes = {
            "agree": _differs(signs, settings.segments, settings.votes.own_units),
            "likeness": signs.likeness,
            "blue": signs.colour[..., 0],
            "red": signs.colour[..., 1],
            "detail": signs.detail,
            "blue_now": signs.surface[..., 0],
            "red_now": signs.surface[..., 1],
        }
        known = signs.known.astype(np.float32)
        laid = self._ground.add(
            view, window, view.site_from_image @ signs.view_from_signs, planes, known
        )
        self._ground.show(view, window, laid["agree"] != 0)

    def conclude(self, id_prefix: str, first_number: int) -> tuple[Change, ...]:
        """After the last view: all areas, the largest first, numbered from `first_number` on."""
        sums, votes = self._ground.sums, self._settings.votes
        seen = sums["seen"]
        if not seen.size:
            return ()
        known = seen >= votes.least_views
        mean = {
            name: np.asarray(values / np.maximum(seen, 1), np.float32)
            for name, values in sums.items()
        }
        colour, surface = (
            np.dstack([mean["blue"], mean["red"]]),
            np.dstack([mean["blue_now"], mean["red_now"]]),
        )
        signs = GroundSigns(mean["likeness"], colour, mean["detail"], surface, known)
        found = []
        for cells, units in segments(signs, self._settings.segments):
            if np.count_nonzero(cells) * self._ground.cell_m**2 < self._settings.segments.least_m2:
                continue
            agreement = float(mean["agree"][cells].mean())
            score = agreement * min(1.0, units / votes.sure_units)
            views = float(sums["agree"][cells].mean())
            is_shown = agreement >= votes.agreeing_share and views >= votes.agreeing_views
            if is_shown and score >= votes.least_score:
                found.append(self._record(cells, score))
        found.sort(key=lambda each: -each.area_m2)
        return tuple(
            replace(each, id=f"{id_prefix}-{first_number + place}")
            for place, each in enumerate(found)
        )

    # ---- inside -----------------------------------------------------------------------------------------------

    def _record(self, cells: Mask, score: float) -> Change:
        cell_m = self._ground.cell_m
        site_from_cell = self._ground.window.site_from_cell(cell_m)
        outline_m = outline_of(cells, site_from_cell, 0.5, 1.0)
        if outline_m is None:
            raise AssertionError("an area has cells")
        size = measures(outline_m)
        return Change(
            "",
            ChangeKind.AREA,
            score,
            outline_m,
            *self._ground.span_ns,
            round(float(self._ground.sums["agree"][cells].mean())),
            float(np.count_nonzero(cells)) * cell_m**2,
            size.length_m,
            place_sigma_m(self._ground.residual_m, cell_m, 0.0),
            self._ground.patch(outline_m),
        )


def _differs(signs: AreaSigns, settings: AreaSettings, own_units: float) -> NDArray[np.float32]:
    """1 where a view by itself shows another ground: other structure, and other colour or roughness than elsewhere."""
    same = signs.known & (signs.likeness > settings.same)
    colour, detail = settings.least_units
    length = np.hypot(signs.colour[..., 0], signs.colour[..., 1])
    middle = 0.0
    if np.count_nonzero(same) > 100:
        middle = float(np.median(signs.detail[same]))
        colour = max(colour, float(np.percentile(length[same], settings.quiet_percent)))
        detail = max(
            detail,
            float(np.percentile(np.abs(signs.detail[same] - middle), settings.quiet_percent)),
        )
    differs = np.hypot(length / colour, (signs.detail - middle) / detail) > own_units
    return (differs & signs.known & (signs.likeness < settings.other)).astype(np.float32)


def with_areas(
    changes: Sequence[Change],
    areas: Sequence[Change],
    settings: ApartSettings = ApartSettings(),
    lies_apart: Callable[[PointsM], bool] = lambda _: False,
) -> list[Change]:
    """Changes and areas, each piece of ground reported once.

    A change that is a part of an area is left out, unless it is a thing that stands out from the ground around it on
    either date, or whose outline, (N, 2), `lies_apart` by evidence of another kind. An area that things explain for the
    most part is left out itself.
    """
    parts = [
        each
        for each in changes
        if each.kind is not ChangeKind.MOVING
        and any(_inside(each, area.outline_m) > settings.inside for area in areas)
        and not _is_thing(each.patch, settings.stands_out)
    ]
    things = [each for each in changes if each not in parts]
    still = [each for each in things if each.kind is not ChangeKind.MOVING]
    kept = [area for area in areas if _explained(area, still) < settings.explained]
    return things + [each for each in parts if lies_apart(each.outline_m)] + kept


def _explained(area: Change, things: Sequence[Change]) -> float:
    """The share of an area that lies within things."""
    shape, site_from_patch = area.patch.changed.shape, area.patch.site_from_patch
    own, theirs = mask_of(area.outline_m, site_from_patch, shape), np.zeros(shape, bool)
    for each in things:
        theirs |= mask_of(each.outline_m, site_from_patch, shape)
    return float((own & theirs).sum() / max(1, own.sum()))


def _inside(change: Change, outline_m: PointsM) -> float:
    """The share of a change that lies within an outline, (N, 2)."""
    shape, site_from_patch = change.patch.changed.shape, change.patch.site_from_patch
    own, theirs = (mask_of(each, site_from_patch, shape) for each in (change.outline_m, outline_m))
    return float((own & theirs).sum() / max(1, own.sum()))


def _is_thing(patch: Patch, stands_out: float) -> bool:
    """Whether what changed differs from the ground around it by more than that ground varies, before or after."""
    reach = max(3, round(0.15 * max(patch.changed.shape)))
    near = cv2.dilate(patch.changed.astype(np.uint8), np.ones((2 * reach + 1,) * 2, np.uint8)) > 0
    for picture in (patch.before, patch.after):
        known = picture[..., 3] > 0
        ring, own = near & ~patch.changed & known, patch.changed & known
        if np.count_nonzero(ring) < 20 or not own.any():
            continue
        levels = np.log2(picture[..., :3].astype(np.float32) + 8.0)
        spread = levels[ring].std(axis=0) + 0.1
        contrast = np.median(levels[own], axis=0) - np.median(levels[ring], axis=0)
        if float(np.abs(contrast / spread).max()) > stands_out:
            return True
    return False
