"""How far a flight's frames are distorted on a map: what a homography adds up to, and a similarity cannot (3.1.1)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sorvolo.geometry.arrays import Floats
from sorvolo.geometry.polygons import signed_area


@dataclass(frozen=True)
class OutlineDistortion:
    """Over all frames: the largest ratio of two opposite sides (1: none is a trapezium), the largest area over the
    smallest, and how far the path bends: its largest distance from the chord of its ends, over the chord.
    """

    sides: float
    areas: float
    bend: float
    frames: int


def outline_distortion(outlines_m: Sequence[Floats]) -> OutlineDistortion:
    """Measure the outlines of the frames that lie on the map, (4, 2) metres each, in the order of the flight.

    NaN where there is no frame; the bend where the ends are closer to each other than half a frame is wide.
    """
    known = [each for each in outlines_m if np.isfinite(each).all()]
    if not known:
        return OutlineDistortion(np.nan, np.nan, np.nan, 0)
    corners = np.array(known)
    lengths = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
    pairs = np.stack([lengths[:, :2], lengths[:, 2:]])
    areas = np.abs([signed_area(each) for each in corners])
    return OutlineDistortion(
        float((pairs.max(axis=0) / pairs.min(axis=0)).max()),
        float(areas.max() / areas.min()),
        _bend(corners.mean(axis=1), float(np.sqrt(areas[0]))),
        len(known),
    )


def _bend(centres_m: Floats, width_m: float) -> float:
    chord = centres_m[-1] - centres_m[0]
    length = float(np.linalg.norm(chord))
    if length < width_m / 2:
        return float("nan")
    away = centres_m - centres_m[0]
    return float(np.abs(away[:, 0] * chord[1] - away[:, 1] * chord[0]).max() / length**2)
