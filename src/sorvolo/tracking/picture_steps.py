"""How the whole picture moves between the frames that are searched, so that boxes can follow it."""

from dataclasses import dataclass, replace

import cv2
import numpy as np

from sorvolo.geometry.arrays import ImageGray, Matrix3, frozen
from sorvolo.tracking.image_motion import FlowSettings, followed_points

STEP_S = 0.1
"""Of a flight between two pictures that are compared: steps much longer find too little of the picture again."""

SMALL_WIDTH_PX = 320
"""Of the pictures that are compared: 3 ms of processor time a step."""

_FLOW = replace(FlowSettings(), fit_px=1.0)


@dataclass(frozen=True, eq=False)
class PictureStep:
    """Where the ground of one picture lies in a later one: `to_from` (3, 3) takes its pixels there, homogeneous."""

    from_ns: int
    to_ns: int
    to_from: Matrix3

    def __post_init__(self) -> None:
        object.__setattr__(self, "to_from", frozen(self.to_from))


class PictureSteps:
    """Compares each picture with the one before it. Only `add` changes it.

    The homography of level ground, fitted to corners that are followed (Bouguet 2001) by RANSAC: a camera that looks
    aslant shows near ground move faster than far ground, which a similarity cannot express.
    """

    def __init__(self) -> None:
        self._last: tuple[int, ImageGray] | None = None

    def add(self, time_ns: int, gray: ImageGray, width_px: int) -> PictureStep | None:
        """The step to a small picture from the last one, in pixels of the picture as it was taken, `width_px` wide.

        None for the first one, and where the two do not show the same ground.
        """
        last, self._last = self._last, (time_ns, gray)
        if last is None or last[1].shape != gray.shape or time_ns <= last[0]:
            return None
        to_from = _homography(last[1], gray)
        if to_from is None:
            return None
        shrink = gray.shape[1] / width_px
        offset = 0.5 * shrink - 0.5  # pixel centres stay on pixel centres
        small_from_full = np.array([[shrink, 0, offset], [0, shrink, offset], [0, 0, 1.0]])
        whole = np.linalg.inv(small_from_full) @ to_from @ small_from_full
        return PictureStep(last[0], time_ns, whole / whole[2, 2])


def _homography(last: ImageGray, gray: ImageGray) -> Matrix3 | None:
    corners = cv2.goodFeaturesToTrack(last, _FLOW.points, 0.01, 8)
    if corners is None or len(corners) < _FLOW.least_inliers:
        return None
    start = np.asarray(corners.reshape(-1, 2), np.float64)
    end, good = followed_points(last, gray, start, _FLOW)
    if good.sum() < _FLOW.least_inliers:
        return None
    cv2.setRNGSeed(1)
    found, kept = cv2.findHomography(start[good], end[good], cv2.RANSAC, _FLOW.fit_px, maxIters=500)
    if found is None or kept.sum() < max(
        _FLOW.least_inliers, _FLOW.least_inlier_share * good.sum()
    ):
        return None
    return (
        np.asarray(found, np.float64)
        if np.isfinite(found).all() and np.linalg.det(found) > 0
        else None
    )
