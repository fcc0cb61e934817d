"""Which ground changed as an area: cells of a flight's ground to connected areas, each with how sure it is."""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sorvolo.geometry.arrays import Mask

Cells = NDArray[np.float32]


@dataclass(frozen=True)
class AreaSettings:
    """When ground is reported as an area. Lengths in cells: a view's longer side is about 160 of them."""

    least_cells: int = (
        110  # an area's size: of a view 140 m wide 85 m2; smaller things are found by their outline
    )
    least_m2: float = 25.0  # nor smaller, however low the flight: a car has 8 m2, what leans beside a roof 5 to 10
    same: float = 0.5  # likeness from which ground is surely the same
    other: float = 0.55  # likeness from which on a difference counts less and less ...
    other_range: float = 0.2  # ... and this much below in full
    scales: tuple[int, ...] = (3, 7, 11)  # sides of the windows over which a difference is averaged
    quiet_percent: float = 80.0  # of the same ground differs less than one unit
    least_units: tuple[float, float] = (
        0.05,
        0.25,
    )  # octaves of colour and of detail: no unit is smaller
    seed: float = 3.0  # units by which an area's core differs
    recoloured: float = (
        2.0  # units by which the colour differs of ground that belongs to an area by its colour now
    )
    most: float = 6.0  # units that one sign counts at most
    least_contact: float = 0.1  # of its rim lies on another area: they are one
    contact: int = 4  # how near that is
    touches: float = 0.02  # the same where both have one surface now ...
    gap: int = 3  # ... how near that is ...
    one_surface: float = 0.15  # ... whose colours are so many octaves apart at most
    light: int = 71  # over which light, camera and season differ smoothly: seen where ground is surely the same ...
    least_same: float = (
        0.05  # ... in this share of a window; where less is, a wider window counts as well
    )


@dataclass(frozen=True, eq=False)
class GroundSigns:
    """Means over the views, (rows, columns) each, of what `AreaSigns` shows; `known` where enough views saw it."""

    likeness: Cells
    colour: Cells
    detail: Cells
    surface: Cells
    known: Mask


def segments(signs: GroundSigns, settings: AreaSettings) -> Iterator[tuple[Mask, float]]:
    """The areas: their cells (rows, columns), and by how many units their ground differs from what it was.

    A unit is what the ground that is surely the same differs by: light, cameras and season make that. From cores of
    `seed` units an area grows over connected ground that is nearer to the core's change than to no change.
    """
    if np.count_nonzero(signs.known) < settings.least_cells:
        return
    known = signs.known.astype(np.float32)
    same = signs.known & (signs.likeness > settings.same)
    trust = np.where(same, signs.likeness, 0).astype(np.float32) if same.any() else known
    signs_of = np.dstack([signs.colour, signs.detail]).astype(np.float32)
    change = np.asarray(
        (signs_of - _light(signs_of, trust, settings)) * known[..., None], np.float32
    )
    core = np.zeros(known.shape, np.float32)
    for side in settings.scales:
        mean = _smooth(change, known, side) / _scale(_smooth(change, known, side), same, settings)
        likeness = _smooth(signs.likeness[..., None], known, side)[..., 0]
        np.maximum(core, _units(mean, settings) * _otherness(likeness, mean, settings), out=core)
    finest = settings.scales[0]
    near = np.asarray(_smooth(change, known, finest) / _scale(change, same, settings), np.float32)
    free = signs.known & (
        _otherness(_smooth(signs.likeness[..., None], known, finest)[..., 0], near, settings) > 0
    )
    cores = cv2.morphologyEx(
        (core > settings.seed).view(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)
    )
    for cells in _joined(
        list(_grown(cores > 0, near, free, signs.surface, settings)), signs.surface, settings
    ):
        yield cells, float(np.mean(core[cells]))


def _grown(
    cores: Mask, near: Cells, free: Mask, surface: Cells, settings: AreaSettings
) -> Iterator[Mask]:
    """Areas around cores, the largest core first; ground belongs to one of them only.

    Ground belongs to an area when its change is nearer to the core's than to none, or when its colour changed and is
    the core's now.
    """
    recoloured = np.hypot(near[..., 0], near[..., 1]) > settings.recoloured
    count, labels, stats, _ = cv2.connectedComponentsWithStats(cores.view(np.uint8), connectivity=4)
    taken = np.zeros(cores.shape, bool)
    for label in sorted(range(1, count), key=lambda each: -int(stats[each, cv2.CC_STAT_AREA])):
        own = (labels == label) & ~taken
        if np.count_nonzero(own) < settings.least_cells / 4:
            continue
        middle = np.median(near[own], axis=0)
        apart = surface - np.median(surface[own], axis=0)
        alike = recoloured & (np.hypot(apart[..., 0], apart[..., 1]) < settings.one_surface)
        alike = free & ~taken & (alike | (near @ middle > 0.5 * float(middle @ middle)))
        whole = _whole(_connected(alike | own, own)) & ~taken
        if np.count_nonzero(whole) >= settings.least_cells:
            taken |= whole
            yield whole


def _joined(areas: list[Mask], surface: Cells, settings: AreaSettings) -> list[Mask]:
    """The areas, those made one that touch and have one surface now, or touch along a good part of the smaller's rim:
    what was there before may differ from place to place."""
    joined: list[Mask] = []
    for cells in sorted(areas, key=lambda each: -int(np.count_nonzero(each))):
        near, wide = (_rim(cells, reach) for reach in (settings.contact, settings.gap))
        beside = [
            _share(wide, each) > settings.touches
            if _is_one_surface(cells, each, surface, settings)
            else _share(near, each) > settings.least_contact
            for each in joined
        ]
        if any(beside):
            first = beside.index(True)
            joined[first] = _whole(joined[first] | cells, settings.gap)
        else:
            joined.append(cells)
    return joined


def _is_one_surface(a: Mask, b: Mask, surface: Cells, settings: AreaSettings) -> bool:
    """Whether two areas have one colour now."""
    apart = np.median(surface[a], axis=0) - np.median(surface[b], axis=0)
    return bool(np.hypot(*apart) < settings.one_surface)


def _share(rim: Mask, cells: Mask) -> float:
    """The share of a rim that lies on some cells."""
    return float((rim & cells).sum() / max(1, rim.sum()))


def _rim(cells: Mask, reach: int) -> Mask:
    """The cells around, up to this many away."""
    return np.asarray(
        (cv2.dilate(cells.view(np.uint8), np.ones((2 * reach + 1,) * 2, np.uint8)) > 0) & ~cells
    )


def _connected(cells: Mask, own: Mask) -> Mask:
    """The pieces of cells that hold some of an area's own, thin bridges cut."""
    opened = cv2.morphologyEx(cells.view(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    _, labels = cv2.connectedComponents(opened, connectivity=4)
    held = np.unique(labels[own & (opened > 0)])
    return np.isin(labels, held[held > 0])


def _whole(cells: Mask, gap: int = 2) -> Mask:
    """The cells without gaps up to twice `gap` wide, and without small holes."""
    window = np.ones((2 * gap + 1,) * 2, np.uint8)
    padded = cv2.copyMakeBorder(
        cells.view(np.uint8), gap, gap, gap, gap, cv2.BORDER_CONSTANT, value=0
    )
    closed = np.ascontiguousarray(
        cv2.morphologyEx(padded, cv2.MORPH_CLOSE, window)[gap:-gap, gap:-gap]
    )
    outlines, _ = cv2.findContours(closed, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    for outline in outlines:
        if cv2.contourArea(outline) < 40:
            cv2.drawContours(closed, [outline], -1, 1.0, cv2.FILLED)
    return np.asarray(closed > 0)


def _units(change: Cells, settings: AreaSettings) -> Cells:
    """(rows, columns) by how many units the ground differs, colour and detail together."""
    colour = np.minimum(np.hypot(change[..., 0], change[..., 1]), settings.most)
    detail = np.minimum(np.abs(change[..., 2]), settings.most)
    return np.asarray(np.hypot(colour, detail), np.float32)


def _scale(change: Cells, same: Mask, settings: AreaSettings) -> NDArray[np.float32]:
    """(3,) octaves of a unit of colour (twice) and of detail, by the ground that is the same."""
    colour, detail = settings.least_units
    if np.count_nonzero(same) >= settings.least_cells:
        percent = settings.quiet_percent
        colour = max(colour, float(np.percentile(np.hypot(*change[same][:, :2].T), percent)))
        detail = max(detail, float(np.percentile(np.abs(change[same][:, 2]), percent)))
    return np.array([colour, colour, detail], np.float32)


def _otherness(likeness: Cells, change: Cells, settings: AreaSettings) -> Cells:
    """From 0 where structure and colour (`change` is in units) stayed to 1 where either is another one."""
    structure = (settings.other - likeness) / settings.other_range
    colour = (np.hypot(change[..., 0], change[..., 1]) - settings.seed) / settings.seed
    return np.asarray(np.clip(np.maximum(structure, colour), 0, 1), np.float32)


def _light(values: Cells, trust: Cells, settings: AreaSettings) -> Cells:
    """Values (rows, columns, n) of the ground around that is the same, by `trust` in it: over the usual window where
    that holds enough, else over wider ones as well. A change of any width is not taken for light."""
    light, missing, side = np.zeros_like(values), np.ones(trust.shape, np.float32), settings.light
    while missing.any():
        share = cv2.blur(trust, (side, side), borderType=cv2.BORDER_CONSTANT)
        is_last = side > 2 * max(trust.shape)
        enough = (
            missing
            if is_last
            else missing * np.minimum(np.asarray(share, np.float32) / settings.least_same, 1)
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
