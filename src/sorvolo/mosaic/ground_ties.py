"""Image points whose place on the Earth is known: what ties a map to control points or to a base map."""

from dataclasses import dataclass

import numpy as np

from sorvolo.geometry.arrays import Floats, Matrix3, PointsM, Rows
from sorvolo.geometry.homography import apply_homography, fit_similarity

# pairs of points that may give the similarity: 600 find it among two thirds of wild ones
_MOST_GUESSES = 600
_MILD = 2.5  # robust sigmas


@dataclass(frozen=True, eq=False)
class GroundTies:
    """M points of keyframes with their known places: what `PoseGraph.tie_to_ground` takes.

    `ideal` counts focal lengths of the calibrated camera from the optical centre, without its lens's distortion;
    `sigma_px` is at registration size.
    """

    keyframe_ids: Rows  # (M,)
    ideal: Floats  # (M, 2)
    place_m: PointsM  # (M, 3) in the site
    sigma_px: Floats  # (M,) of the point in the picture
    sigma_m: Floats  # (M,) of the place
    common_m: float = 0.0  # what all places err in common, one sigma

    def of(self, chosen: Rows) -> "GroundTies":
        """Some of them, by index or mask (M,)."""
        return GroundTies(
            self.keyframe_ids[chosen],
            self.ideal[chosen],
            self.place_m[chosen],
            self.sigma_px[chosen],
            self.sigma_m[chosen],
            self.common_m,
        )

    def __len__(self) -> int:
        return len(self.keyframe_ids)


def similarity_of_most(points_a: PointsM, points_b: PointsM) -> Matrix3 | None:
    """Similarity a_from_b (3, 3) that more than half of the pairs, (N, 2) each, agree on; None below two points.

    Least median of squares over pairs of points (Rousseeuw 1984), then least squares over those that agree.
    """
    if len(points_a) < 2 or np.ptp(points_b, axis=0).max() <= 0:
        return None
    if len(points_a) < 4:  # nothing can be left out
        return fit_similarity(points_a, points_b)
    a, b = points_a @ np.array([1, 1j]), points_b @ np.array([1, 1j])
    # Index pairs of points: all of them while they are few, else some, the same each time.
    count = len(a)
    first, second = np.triu_indices(count, 1)
    if len(first) > _MOST_GUESSES:
        chosen = np.random.default_rng(count).choice(len(first), _MOST_GUESSES, replace=False)
        first, second = first[chosen], second[chosen]
    apart = np.abs(b[first] - b[second]) > 0.2 * np.median(
        np.abs(b - np.median(b.real) - 1j * np.median(b.imag))
    )
    first, second = first[apart], second[apart]
    if not len(first):
        return fit_similarity(points_a, points_b)
    turn = (a[first] - a[second]) / (b[first] - b[second])
    shift = a[first] - turn * b[first]
    miss = np.abs(turn[:, None] * b + shift[:, None] - a)
    agreeing = (len(a) + 3) // 2  # two points of each guess agree anyway
    score = np.partition(miss, agreeing - 1, axis=1)[:, agreeing - 1]
    best = miss[int(np.argmin(score))]
    keep = best <= max(_MILD * float(score.min()), 1e-9)
    for _ in range(2):
        change = fit_similarity(points_a[keep], points_b[keep])
        best = np.linalg.norm(apply_homography(change, points_b) - points_a, axis=1)
        keep = best <= max(_MILD * float(np.partition(best, agreeing - 1)[agreeing - 1]), 1e-9)
    return change
