"""How far a map's frames lie from the truth, or from known camera places."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sorvolo.geometry.arrays import Floats
from sorvolo.mosaic.map_quality import (
    CornerErrors,
    Spread,
    corner_errors,
    position_errors,
    spread_of,
)
from sorvolo.survey.frame_rows import FrameRow
from sorvolo.survey.mosaic import Status


@dataclass(frozen=True)
class TruthErrors:
    """A flight's errors against truth ("all" for all together): frames placed by vision, and by GPS alone."""

    flight: str
    corners: CornerErrors
    gps_only: Spread
    cameras: Spread


@dataclass(frozen=True)
class PositionErrors:
    """Camera positions against a table: as they lie, and after the best similarity."""

    absolute: Spread
    shape: Spread
    missing: int


def truth_errors(
    name: str, pairs: Sequence[tuple[FrameRow, FrameRow]], m_per_px: float
) -> TruthErrors:
    """The errors of a flight's frames, each given beside the true one."""
    corners = corner_errors(
        *_outlines_m(pairs, Status.VISION), m_per_px, *_true_cameras_and_fixes_m(pairs)
    )
    by_gps_m = [
        np.linalg.norm(mine - true, axis=1)
        for mine, true in zip(*_outlines_m(pairs, Status.GPS_ONLY))
    ]
    cameras_m = [
        float(np.linalg.norm(mine.camera_m - true.camera_m))
        for mine, true in pairs
        if mine.has_camera and true.has_camera
    ]
    return TruthErrors(
        name,
        corners,
        spread_of(np.array(by_gps_m), m_per_px),
        spread_of(np.array(cameras_m), m_per_px),
    )


def table_errors(
    cameras: Sequence[FrameRow], places_m: Sequence[Sequence[float]], missing: int, m_per_px: float
) -> PositionErrors:
    """Cameras against a table's places (east, north, height of each); heights count where all are known.

    `missing` of the table's frames have no camera.
    """
    mine = np.array([[*each.camera_m, each.camera_height_m] for each in cameras])
    reference = np.array(places_m, np.float64)
    if not (np.isfinite(mine).all() and np.isfinite(reference).all()):
        mine, reference = mine[:, :2], reference[:, :2]
    return PositionErrors(*position_errors(mine, reference, m_per_px), missing)


def _outlines_m(
    pairs: Sequence[tuple[FrameRow, FrameRow]], status: Status
) -> tuple[Floats, Floats]:
    """(N, 4, 2) the estimated and the true outlines of the frames with this status that have both."""
    both = [
        pair
        for pair in pairs
        if pair[0].status == status and pair[0].has_outline and pair[1].has_outline
    ]
    mine = np.array([each.outline_m for each, _ in both]).reshape(-1, 4, 2)
    return mine, np.array([each.outline_m for _, each in both]).reshape(-1, 4, 2)


def _true_cameras_and_fixes_m(pairs: Sequence[tuple[FrameRow, FrameRow]]) -> tuple[Floats, Floats]:
    """(N, 2) the true camera positions and the GPS fixes of the frames that have both."""
    fixed = [true for _, true in pairs if true.has_fix and true.has_camera]
    cameras_m = np.array([true.camera_m for true in fixed]).reshape(-1, 2)
    return cameras_m, np.array([true.fix_m for true in fixed]).reshape(-1, 2)
