"""A whole map brought to its GPS fixes or to known ground by a similarity, where it lies far off."""

from dataclasses import dataclass

import numpy as np

from sorvolo.geometry.arrays import Floats, Matrix3, PointsM
from sorvolo.geometry.homography import apply_homography, fit_similarity
from sorvolo.mosaic.graph_rows import NodeRows
from sorvolo.mosaic.ground_ties import similarity_of_most


@dataclass(frozen=True)
class AlignmentSettings:
    """When a map is moved as a whole; a smaller change is the solve's, which knows more than a similarity."""

    rounds: int = 3  # trimmed: a few wild fixes must not turn the map
    wild: float = 3.0  # times the median miss: such a fix is left out
    most_uncertain: float = (
        0.15  # relative, of scale and turn by these fixes: beyond, they leave them open
    )
    least_sigmas: float = 3.0  # of scale or turn, or ...
    least_scale: float = 0.02  # ... relative, ...
    least_turn_rad: float = 0.03  # 1.7 degrees
    times_nearer: float = 3.0  # known ground: the places have to come so much nearer


def change_to_fixes(
    places_m: PointsM,
    fixes_m: PointsM,
    sigma_m: Floats,
    settings: AlignmentSettings = AlignmentSettings(),
) -> Matrix3 | None:
    """The similarity (3, 3) of the ground that brings cameras, (N, 2), to their fixes, (N, 2), of sigmas (N,).

    None where the fixes leave it open, or it would change next to nothing.
    """
    for _ in range(settings.rounds):
        spread_m = float(np.sqrt(((fixes_m - fixes_m.mean(0)) ** 2).sum(1).mean()))
        uncertainty = float(np.median(sigma_m)) / (np.sqrt(len(fixes_m)) * max(spread_m, 1e-9))
        if (
            len(fixes_m) < 3
            or uncertainty > settings.most_uncertain
            or np.ptp(places_m, axis=0).max() <= 0
        ):
            return None
        change = fit_similarity(fixes_m, places_m)
        miss_m = np.linalg.norm(places_m @ change[:2, :2].T + change[:2, 2] - fixes_m, axis=1)
        keep = miss_m <= max(settings.wild * float(np.median(miss_m)), 1e-6)
        if keep.all():
            break
        fixes_m, places_m = fixes_m[keep], places_m[keep]
    scale, turn = _scale_and_turn(change)
    least = settings.least_sigmas * uncertainty
    keeps_scale = abs(np.log(scale)) < max(least, settings.least_scale)
    return None if keeps_scale and abs(turn) < max(least, settings.least_turn_rad) else change


def change_to_ground(
    places_m: PointsM, known_m: PointsM, settings: AlignmentSettings = AlignmentSettings()
) -> Matrix3 | None:
    """The similarity (3, 3) that brings places of the map, (N, 2), to where they are known to lie, wild ones left out.

    None where they leave it open, or it would bring them little nearer.
    """
    change = similarity_of_most(known_m, places_m)
    if change is None:
        return None
    before_m = np.median(np.linalg.norm(places_m - known_m, axis=1))
    after_m = np.median(np.linalg.norm(apply_homography(change, places_m) - known_m, axis=1))
    return change if before_m > settings.times_nearer * after_m else None


def move_all(rows: NodeRows, change: Matrix3) -> None:
    """Shift, turn and scale all cameras by a similarity of the ground."""
    scale, turn = _scale_and_turn(change)
    matrix = np.array(
        [[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1.0]]
    )
    centres_m = rows.centres_m
    rows.rotations[:] = matrix @ rows.rotations
    centres_m[:] = np.column_stack(
        [centres_m[:, :2] @ change[:2, :2].T + change[:2, 2], centres_m[:, 2] * scale]
    )


def _scale_and_turn(change: Matrix3) -> tuple[float, float]:
    return float(np.hypot(change[0, 0], change[1, 0])), float(
        np.arctan2(change[1, 0], change[0, 0])
    )
