"""Ground that changed as an area, gathered over a flight's views: each area is one change, however large.

The ground is divided into cells. Cells whose structure is that of the map are the same ground, and show what light,
season and cameras do on this flight. An area is connected ground of other structure whose colour and roughness differ
much more than that, in the views on the whole and in most of them alone.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from sorvolo.change.ground import GroundSums
from sorvolo.change.light import OCTAVES
from sorvolo.change.outlines import dilated, measures, opened, outline_of, place_sigma_m
from sorvolo.geometry.arrays import (
    Bytes,
    Floats32,
    ImageRGB,
    Mask,
    Matrix3,
    shrunk,
    size_within,
    square,
)
from sorvolo.geometry.homography import resized
from sorvolo.survey.findings import Change, ChangeKind, ComparedView

_SKY = np.array(
    [0.7, -0.7], np.float32
)  # blue and red over green, by which light from the sky differs from the sun's

Signs = NDArray[np.float32]


# What light from the sky explains of a colour, in octaves for each octave of brightness.
_SKY_MOST = 0.35  # along the sky's own colour
_SKY_OTHER = 0.08  # of any other colour


# How structure, colour and roughness are compared. Lengths in px of the small pictures.
_SIDE_PX = 320  # longest side at which views are examined: areas are large
_WINDOW_PX = 11  # over which structure is compared
_REACH_PX = 1  # alignment may be off by as much
_BETWEEN_PX = (1, 7)  # structure is what lies between these sizes
_MOST_DETAIL = 0.2  # octaves: the rim of a shadow is no more than a coarse texture
_COLOUR_PX = 7  # over which colour and brightness are averaged
# grey levels of detail that noise and compression make, in the darker of both pictures
_NOISE_LEVELS = 1.5
_LEANS = 0.3  # likeness of one date's pictures below which ground leans ...
_ROUGH = 6.0  # ... where its detail has so many times the power of noise


@dataclass(frozen=True, eq=False)
class AreaSigns:
    """A view's ground on both dates at a small size, (h, w) each.

    `likeness` is the correlation of structure, -1 to 1: near 1 the ground is the same one in whatever light. `colour`
    (h, w, 2) is by how many octaves blue and red over green differ, less what light from the sky explains; `detail`
    by how many octaves the ground is rougher now, `surface` (h, w, 2) its colour now. `known` where both dates show it.
    """

    likeness: Signs
    colour: Signs
    detail: Signs
    surface: Signs
    known: Mask
    view_from_signs: Matrix3


def area_signs(view: ComparedView, leans: Mask | None = None) -> AreaSigns:
    """Compare the ground of a view with the map's. What `leans` (h, w) is not known."""
    height, width = view.valid.shape
    size = size_within(view.image, _SIDE_PX)
    valid = view.valid if leans is None else view.valid & ~leans
    known = shrunk(valid.view(np.uint8) * np.uint8(255), size) == 255
    before, after = (_octaves(image, size) for image in (view.reference, view.image))
    levels = [_level(each) for each in (before, after)]
    likeness, detail, _ = _structure(levels[0], levels[1])
    surface = _colour(after)
    brighter = _centred(_blurred(levels[1] - levels[0], _COLOUR_PX), known)
    colour = _centred(_blurred(surface - _colour(before), _COLOUR_PX), known)
    return AreaSigns(
        likeness,
        _without_sky(colour, brighter),
        detail,
        surface,
        known,
        resized(width / size[0], height / size[1]),
    )


def level_of(picture: ImageRGB) -> Signs:
    """How bright a picture, (h, w, 3), is, in octaves, at the size at which views are examined."""
    return _level(_octaves(picture, size_within(picture, _SIDE_PX)))


def leaning(reference: Signs, picture: ImageRGB, seen: Mask) -> Mask:
    """(h, w) where two pictures of one date, (h, w, 3), have structure and not the same one: crowns and walls that lean
    another way. Of such ground no area is reported. The first is given by its `level_of`, `seen` is where both show
    the ground."""
    height, width = seen.shape
    likeness, _, rough = _structure(reference, level_of(picture))
    found = (likeness < _LEANS) & (rough > _ROUGH)
    window = square(_WINDOW_PX)
    whole = cv2.morphologyEx(found.view(np.uint8), cv2.MORPH_CLOSE, window)
    return (cv2.resize(whole, (width, height), interpolation=cv2.INTER_NEAREST) > 0) & seen


def _structure(before: Signs, after: Signs) -> tuple[Signs, Signs, Signs]:
    """The best correlation of detail over small shifts, by how many octaves there is more of it, and how many times as
    strong as noise it is where there is less of it."""
    window, most = (_WINDOW_PX, _WINDOW_PX), np.float32(_MOST_DETAIL)
    fine, coarse = ((side, side) for side in _BETWEEN_PX)
    details = [
        np.clip(cv2.blur(each, fine) - cv2.blur(each, coarse), -most, most)
        for each in (before, after)
    ]
    noise = np.square(np.float32(_NOISE_LEVELS / np.log(2)) * np.exp2(-np.minimum(before, after)))
    power = [cv2.blur(each * each + noise, window) for each in details]
    best = np.full(before.shape, -1.0, np.float32)
    pad = _REACH_PX
    shifted, their_power = (
        cv2.copyMakeBorder(each, pad, pad, pad, pad, cv2.BORDER_REFLECT_101)
        for each in (details[0], power[0])
    )
    height, width = before.shape
    for dy in range(2 * pad + 1):
        for dx in range(2 * pad + 1):
            part = np.s_[dy : dy + height, dx : dx + width]
            products = cv2.blur(details[1] * shifted[part], window)
            np.maximum(best, products / np.sqrt(power[1] * their_power[part]), out=best)
    rough = np.minimum(*power) / cv2.blur(noise, window)
    return (
        best,
        np.asarray(0.5 * np.log2(power[1] / power[0]), np.float32),
        np.asarray(rough, np.float32),
    )


def _blurred(values: Signs, side_px: int) -> Signs:
    return np.asarray(cv2.blur(values, (side_px, side_px)), np.float32)


def _centred(values: Signs, known: Mask) -> Signs:
    """Values less their middle one on known ground."""
    return (
        np.asarray(values - np.median(values[known], axis=0), np.float32) if known.any() else values
    )


def _without_sky(colour: Signs, brighter: Signs) -> Signs:
    """The colour less what a shadow explains: ground that lost the sun's light is bluer."""
    along = colour @ _SKY
    explained = -_SKY_MOST * brighter
    taken = np.clip(along, np.minimum(explained, 0), np.maximum(explained, 0))
    left = colour - taken[..., None] * _SKY
    length = np.maximum(np.hypot(left[..., 0], left[..., 1]), 1e-6)
    other = _SKY_OTHER * np.abs(brighter)
    return np.asarray(left * (np.maximum(length - other, 0) / length)[..., None], np.float32)


def _colour(octaves: Signs) -> Signs:
    """(h, w, 2) blue and red over green."""
    return np.asarray(
        np.dstack([octaves[..., 2] - octaves[..., 1], octaves[..., 0] - octaves[..., 1]]),
        np.float32,
    )


def _octaves(image: Bytes, size: tuple[int, int]) -> Signs:
    small = shrunk(image, size)
    return np.asarray(cv2.LUT(small, OCTAVES), np.float32)


def _level(octaves: Signs) -> Signs:
    """(h, w) the mean of the three colours; a sum of planes is five times as fast as NumPy's along a short axis."""
    return np.asarray(
        (octaves[..., 0] + octaves[..., 1] + octaves[..., 2]) / np.float32(3), np.float32
    )


Cells = NDArray[np.float32]


# When ground is reported as an area. Lengths in cells: a view's longer side is about 160 of them.
# an area's size: of a view 140 m wide 85 m2; smaller things are found by their outline
_LEAST_CELLS = 110
# nor smaller, however low the flight: a car has 8 m2, what leans beside a roof 5 to 10
_LEAST_M2 = 25.0
_SAME = 0.5  # likeness from which ground is surely the same
_AREA_OTHER = 0.55  # likeness from which on a difference counts less and less ...
_OTHER_RANGE = 0.2  # ... and this much below in full
_SCALES = (3, 7, 11)  # sides of the windows over which a difference is averaged
_QUIET_PERCENT = 80.0  # of the same ground differs less than one unit
_LEAST_UNITS = (0.05, 0.25)  # octaves of colour and of detail: no unit is smaller
_SEED = 3.0  # units by which an area's core differs
# units by which the colour differs of ground that belongs to an area by its colour now
_RECOLOURED = 2.0
_AREA_MOST = 6.0  # units that one sign counts at most
_LEAST_CONTACT = 0.1  # of its rim lies on another area: they are one
_CONTACT = 4  # how near that is
_TOUCHES = 0.02  # the same where both have one surface now ...
_GAP = 3  # ... how near that is ...
_ONE_SURFACE = 0.15  # ... whose colours are so many octaves apart at most
# over which light, camera and season differ smoothly: seen where ground is surely the same ...
_LIGHT = 71
_LEAST_SAME = 0.05  # ... in this share of a window; where less is, a wider window counts as well


@dataclass(frozen=True, eq=False)
class GroundSigns:
    """Means over the views, (rows, columns) each, of what `AreaSigns` shows; `known` where enough views saw it."""

    likeness: Cells
    colour: Cells
    detail: Cells
    surface: Cells
    known: Mask


def segments(signs: GroundSigns) -> Iterator[tuple[Mask, float]]:
    """The areas: their cells (rows, columns), and by how many units their ground differs from what it was.

    A unit is what the ground that is surely the same differs by: light, cameras and season make that. From cores of
    `seed` units an area grows over connected ground that is nearer to the core's change than to no change.
    """
    if np.count_nonzero(signs.known) < _LEAST_CELLS:
        return
    known = signs.known.astype(np.float32)
    same = signs.known & (signs.likeness > _SAME)
    trust = np.where(same, signs.likeness, 0).astype(np.float32) if same.any() else known
    signs_of = np.dstack([signs.colour, signs.detail]).astype(np.float32)
    change = np.asarray((signs_of - _light(signs_of, trust)) * known[..., None], np.float32)
    core = np.zeros(known.shape, np.float32)
    for side in _SCALES:
        mean = _smooth(change, known, side) / _scale(_smooth(change, known, side), same)
        likeness = _smooth(signs.likeness[..., None], known, side)[..., 0]
        np.maximum(core, _units(mean) * _otherness(likeness, mean), out=core)
    finest = _SCALES[0]
    near = np.asarray(_smooth(change, known, finest) / _scale(change, same), np.float32)
    free = signs.known & (
        _otherness(_smooth(signs.likeness[..., None], known, finest)[..., 0], near) > 0
    )
    for cells in _joined(
        list(_grown(opened(core > _SEED), near, free, signs.surface)), signs.surface
    ):
        yield cells, float(np.mean(core[cells]))


def _grown(cores: Mask, near: Cells, free: Mask, surface: Cells) -> Iterator[Mask]:
    """Areas around cores, the largest core first; ground belongs to one of them only.

    Ground belongs to an area when its change is nearer to the core's than to none, or when its colour changed and is
    the core's now.
    """
    recoloured = np.hypot(near[..., 0], near[..., 1]) > _RECOLOURED
    count, labels, stats, _ = cv2.connectedComponentsWithStats(cores.view(np.uint8), connectivity=4)
    taken = np.zeros(cores.shape, bool)
    for label in sorted(range(1, count), key=lambda each: -int(stats[each, cv2.CC_STAT_AREA])):
        own = (labels == label) & ~taken
        if np.count_nonzero(own) < _LEAST_CELLS / 4:
            continue
        middle = np.median(near[own], axis=0)
        apart = surface - np.median(surface[own], axis=0)
        alike = recoloured & (np.hypot(apart[..., 0], apart[..., 1]) < _ONE_SURFACE)
        alike = free & ~taken & (alike | (near @ middle > 0.5 * float(middle @ middle)))
        whole = _whole(_connected(alike | own, own)) & ~taken
        if np.count_nonzero(whole) >= _LEAST_CELLS:
            taken |= whole
            yield whole


def _joined(areas: list[Mask], surface: Cells) -> list[Mask]:
    """The areas, those made one that touch and have one surface now, or touch along a good part of the smaller's rim:
    what was there before may differ from place to place."""
    joined: list[Mask] = []
    for cells in sorted(areas, key=lambda each: -int(np.count_nonzero(each))):
        near, wide = (_rim(cells, reach) for reach in (_CONTACT, _GAP))
        beside = [
            _share(wide, each) > _TOUCHES
            if _is_one_surface(cells, each, surface)
            else _share(near, each) > _LEAST_CONTACT
            for each in joined
        ]
        if any(beside):
            first = beside.index(True)
            joined[first] = _whole(joined[first] | cells, _GAP)
        else:
            joined.append(cells)
    return joined


def _is_one_surface(a: Mask, b: Mask, surface: Cells) -> bool:
    """Whether two areas have one colour now."""
    apart = np.median(surface[a], axis=0) - np.median(surface[b], axis=0)
    return bool(np.hypot(*apart) < _ONE_SURFACE)


def _share(rim: Mask, cells: Mask) -> float:
    """The share of a rim that lies on some cells."""
    return float((rim & cells).sum() / max(1, rim.sum()))


def _rim(cells: Mask, reach: int) -> Mask:
    """The cells around, up to this many away."""
    return dilated(cells, 2 * reach + 1) & ~cells


def _connected(cells: Mask, own: Mask) -> Mask:
    """The pieces of cells that hold some of an area's own, thin bridges cut."""
    without = opened(cells)
    _, labels = cv2.connectedComponents(without.view(np.uint8), connectivity=4)
    held = np.unique(labels[own & without])
    return np.isin(labels, held[held > 0])


def _whole(cells: Mask, gap: int = 2) -> Mask:
    """The cells without gaps up to twice `gap` wide, and without small holes."""
    window = square(2 * gap + 1)
    padded = np.pad(cells.view(np.uint8), gap)
    closed = np.ascontiguousarray(
        cv2.morphologyEx(padded, cv2.MORPH_CLOSE, window)[gap:-gap, gap:-gap]
    )
    outlines, _ = cv2.findContours(closed, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    for outline in outlines:
        if cv2.contourArea(outline) < 40:
            cv2.drawContours(closed, [outline], -1, 1.0, cv2.FILLED)
    return closed > 0


def _units(change: Cells) -> Cells:
    """(rows, columns) by how many units the ground differs, colour and detail together."""
    colour = np.minimum(np.hypot(change[..., 0], change[..., 1]), _AREA_MOST)
    detail = np.minimum(np.abs(change[..., 2]), _AREA_MOST)
    return np.asarray(np.hypot(colour, detail), np.float32)


def _scale(change: Cells, same: Mask) -> Floats32:
    """(3,) octaves of a unit of colour (twice) and of detail, by the ground that is the same."""
    colour, detail = _LEAST_UNITS
    if np.count_nonzero(same) >= _LEAST_CELLS:
        percent = _QUIET_PERCENT
        colour = max(colour, float(np.percentile(np.hypot(*change[same][:, :2].T), percent)))
        detail = max(detail, float(np.percentile(np.abs(change[same][:, 2]), percent)))
    return np.array([colour, colour, detail], np.float32)


def _otherness(likeness: Cells, change: Cells) -> Cells:
    """From 0 where structure and colour (`change` is in units) stayed to 1 where either is another one."""
    structure = (_AREA_OTHER - likeness) / _OTHER_RANGE
    colour = (np.hypot(change[..., 0], change[..., 1]) - _SEED) / _SEED
    return np.asarray(np.clip(np.maximum(structure, colour), 0, 1), np.float32)


def _light(values: Cells, trust: Cells) -> Cells:
    """Values (rows, columns, n) of the ground around that is the same, by `trust` in it: over the usual window where
    that holds enough, else over wider ones as well. A change of any width is not taken for light."""
    light, missing, side = np.zeros_like(values), np.ones(trust.shape, np.float32), _LIGHT
    while missing.any():
        share = cv2.blur(trust, (side, side), borderType=cv2.BORDER_CONSTANT)
        is_last = side > 2 * max(trust.shape)
        enough = (
            missing
            if is_last
            else missing * np.minimum(np.asarray(share, np.float32) / _LEAST_SAME, 1)
        )
        light += enough[..., None] * _smooth(values, trust, side)
        missing = missing - enough
        side = 2 * side + 1
    return light


def _smooth(values: Cells, weights: Cells, side: int) -> Cells:
    """Values (rows, columns, n) averaged with weights over windows of a side."""
    weights = np.asarray(weights, np.float32)
    total = cv2.blur(weights, (side, side), borderType=cv2.BORDER_CONSTANT)
    stack = cv2.blur(
        np.asarray(values * weights[..., None], np.float32),
        (side, side),
        borderType=cv2.BORDER_CONSTANT,
    )
    return np.asarray(stack.reshape(values.shape) / np.maximum(total, 1e-9)[..., None], np.float32)


_SUMS = ("seen", "agree", "likeness", "blue", "red", "detail", "blue_now", "red_now")


# When the views of an area's ground make it one. Units: see `segments`.
_LEAST_VIEWS = 2  # that saw a cell
_AGREEING_VIEWS = 2.5  # on the mean that show an area by themselves: two may lean alike
# of the views of an area's ground must differ from the map there, each by itself
_AGREEING_SHARE = 0.5
_OWN_UNITS = 2.0  # by which a view alone differs
_SURE_UNITS = 6.0  # an area that differs by so much is sure
_LEAST_SCORE = 0.3  # 0 to 1


# How views are gathered to areas.
_CELL_PX = 2  # a cell's side, in pixels of the small size at which views are examined
_PICTURE_PX = 8  # pixels of an area's pictures, along a cell's side
_MOST_CELLS = 4_000_000  # of the raster, which bounds its memory: views beyond are left out


class AreaMap:
    """The areas of one flight while its views come in. Only `add` changes it."""

    def __init__(self) -> None:
        self._ground = GroundSums(_SUMS, _MOST_CELLS)

    def add(self, view: ComparedView, leans: Mask | None = None) -> None:
        """Take in one view, of which earlier pictures show that some ground `leans` (h, w)."""
        cell_m = _CELL_PX * view.m_per_px * max(1.0, max(view.valid.shape) / _SIDE_PX)
        window = self._ground.window_of(view, cell_m, cell_m / _PICTURE_PX)
        if window is None:
            return
        signs = area_signs(view, leans)
        planes = {
            "agree": _differs(signs, _OWN_UNITS),
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
        sums = self._ground.sums
        seen = sums["seen"]
        if not seen.size:
            return ()
        known = seen >= _LEAST_VIEWS
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
        for cells, units in segments(signs):
            if np.count_nonzero(cells) * self._ground.cell_m**2 < _LEAST_M2:
                continue
            agreement = float(mean["agree"][cells].mean())
            score = agreement * min(1.0, units / _SURE_UNITS)
            views = float(sums["agree"][cells].mean())
            is_shown = agreement >= _AGREEING_SHARE and views >= _AGREEING_VIEWS
            if is_shown and score >= _LEAST_SCORE:
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


def _differs(signs: AreaSigns, own_units: float) -> Floats32:
    """1 where a view by itself shows another ground: other structure, and other colour or roughness than elsewhere."""
    same = signs.known & (signs.likeness > _SAME)
    colour, detail = _LEAST_UNITS
    length = np.hypot(signs.colour[..., 0], signs.colour[..., 1])
    middle = 0.0
    if np.count_nonzero(same) > 100:
        middle = float(np.median(signs.detail[same]))
        colour = max(colour, float(np.percentile(length[same], _QUIET_PERCENT)))
        detail = max(
            detail,
            float(np.percentile(np.abs(signs.detail[same] - middle), _QUIET_PERCENT)),
        )
    differs = np.hypot(length / colour, (signs.detail - middle) / detail) > own_units
    return (differs & signs.known & (signs.likeness < _AREA_OTHER)).astype(np.float32)
