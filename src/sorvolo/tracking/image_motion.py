"""The ground's motion through pictures: without telemetry to a first one, and from each searched frame to the next."""

from dataclasses import dataclass

import cv2
import numpy as np

from sorvolo.geometry.arrays import (
    Floats,
    ImageGray,
    ImageRGB,
    Mask,
    Matrix3,
    PointsPx,
    frozen,
    shrunk,
)
from sorvolo.survey.flight import Frame
from sorvolo.survey.objects import Detections, Sighting

_UNTIL = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.03)

_WIDTH_PX = 480  # of the pictures in which motion is looked for
_POINTS = 180  # that are followed, ...
_LEAST_POINTS = 90  # ... new ones where fewer are left
_WINDOW_PX = (17, 17)  # around a point that is followed (Lucas and Kanade)
_LEVELS = 4  # of smaller pictures, for longer steps
_THERE_AND_BACK_PX = 0.7  # points that miss by more on the way back are left out
_FIT_PX = 1.5  # a point that agrees lies so near
_LEAST_INLIERS = 12  # points that must agree ...
_LEAST_INLIER_SHARE = 0.35  # ... and of all

_FAILURES = 4  # pictures in a row after which the way is lost
_CUT_LIKENESS = 0.2  # of small thumbnails: less is another scene
_THUMBNAIL_PX = (32, 18)  # columns, rows of those thumbnails
_BOX_SIGMA = 0.08  # of a box's middle, in shares of its side
_LEAST_SIGMA_PX = 1.0  # however small the box
_DRIFT_SHARE = 0.004  # of the way gone over the ground, as one goes from points to new points
_GUESS_SHARE = 0.3  # of a step that was guessed


@dataclass(frozen=True, eq=False)
class _View:
    """One small picture with the points followed in it, (N, 2), and where those lie in the first picture's pixels."""

    gray: ImageGray
    thumbnail: Floats
    points_px: PointsPx
    places_px: PointsPx


class ImageMotion:
    """Follows the ground through pictures of one size, in order of time. Only `locate` changes it.

    Corners are followed by pyramidal Lucas-Kanade (Bouguet 2001) with detected objects masked out, and a similarity
    from each picture to the first one is fitted to them by RANSAC. A picture whose motion is not found goes on as the
    last ones did and is counted in `guessed`; a cut, or several of those, begins a new of the `segments`, whose first
    picture its places are counted in: they have nothing to do with those of the segments before.
    """

    def __init__(self) -> None:
        self.segments, self.guessed = 1, 0
        self._last: _View | None = None
        self._first_from_image = np.eye(2, 3)
        self._step = np.eye(2, 3)  # image from last image
        self._way_px, self._guessed_px = 0.0, 0.0
        self._failures = 0

    def locate(
        self, found: Detections, frame: Frame, time_ns: int
    ) -> tuple[list[Sighting], PointsPx]:
        """Each detection's place in pixels of its segment's first picture, and (4, 2) what the picture shows of them.

        A sighting's `shared_sigma_m` is how far the way may have drifted since its segment began, in pixels.
        """
        height_px, width_px = frame.image.shape[:2]
        self._follow(frame.image, found.boxes_px.astype(np.float64))
        outline = _moved(
            self._first_from_image,
            np.array(
                [
                    [-0.5, -0.5],
                    [width_px - 0.5, -0.5],
                    [width_px - 0.5, height_px - 0.5],
                    [-0.5, height_px - 0.5],
                ]
            ),
        )
        scale = float(np.sqrt(abs(np.linalg.det(self._first_from_image[:, :2]))))
        drift_px = _DRIFT_SHARE * self._way_px + self._guessed_px
        boxes = found.boxes_px.astype(np.float64)
        places = _moved(self._first_from_image, (boxes[:, :2] + boxes[:, 2:]) / 2 - 0.5)
        sides = (boxes[:, 2:] - boxes[:, :2]) * scale
        turn = self._first_from_image[:, :2] / max(scale, 1e-9)
        own = np.maximum(_BOX_SIGMA * sides, _LEAST_SIGMA_PX * scale) ** 2
        return [
            Sighting(
                frame.index,
                frame.name,
                time_ns,
                label,
                float(found.scores[row]),
                found.boxes_px[row],
                places[row],
                turn @ np.diag(own[row]) @ turn.T + drift_px**2 * np.eye(2),
                np.sort(sides[row])[::-1],
                drift_px,
            )
            for row, label in enumerate(found.names)
        ], outline

    def _follow(self, image: ImageRGB, boxes_px: Floats) -> None:
        """Find where a picture lies."""
        shrink = min(1.0, _WIDTH_PX / image.shape[1])
        size = (round(image.shape[1] * shrink), round(image.shape[0] * shrink))
        small = shrunk(image, size) if shrink < 1 else image
        gray = np.asarray(cv2.cvtColor(small, cv2.COLOR_RGB2GRAY), np.uint8)
        thumbnail = shrunk(gray, _THUMBNAIL_PX).astype(np.float64)
        if self._last is None or self._last.gray.shape != gray.shape:
            if self._last is not None:
                self._begin_segment()
            self._look_anew(gray, thumbnail, boxes_px, shrink, np.zeros((0, 2)), np.zeros((0, 2)))
            return
        here, places = _followed(self._last, gray)
        first_from_small, inliers = _similarity(here, places)
        if first_from_small is None:
            # (2,) by how much the picture as a whole has moved (phase correlation).
            window = cv2.createHanningWindow(gray.shape[::-1], cv2.CV_32F)
            (x, y), _ = cv2.phaseCorrelate(
                self._last.gray.astype(np.float32), gray.astype(np.float32), window
            )
            here, places = _followed(self._last, gray, np.array([x, y]))
            first_from_small, inliers = _similarity(here, places)
        if first_from_small is None:
            self._lose(gray, thumbnail, boxes_px, shrink)
            return
        first_from_image = _composed(first_from_small, _small_from_full(shrink))
        middle = np.array([[image.shape[1] / 2, image.shape[0] / 2]])
        gone = _moved(first_from_image, middle) - _moved(self._first_from_image, middle)
        self._way_px += float(np.hypot(*gone[0]))
        self._step = _composed(_inverse(self._first_from_image), first_from_image)
        self._first_from_image, self._failures = first_from_image, 0
        self._look_anew(gray, thumbnail, boxes_px, shrink, here[inliers], places[inliers])

    def _lose(self, gray: ImageGray, thumbnail: Floats, boxes_px: Floats, shrink: float) -> None:
        """A picture whose motion is not found: a guess, or another segment."""
        assert self._last is not None
        self._failures += 1
        # Correlation of two thumbnails; 1 for two flat ones.
        a, b = self._last.thumbnail - self._last.thumbnail.mean(), thumbnail - thumbnail.mean()
        size = float(np.sqrt((a * a).sum() * (b * b).sum()))
        is_cut = (float((a * b).sum() / size) if size > 1e-6 else 1.0) < _CUT_LIKENESS
        if self._failures >= _FAILURES or is_cut:
            self._begin_segment()
            self._look_anew(gray, thumbnail, boxes_px, shrink, np.zeros((0, 2)), np.zeros((0, 2)))
            return
        self.guessed += 1
        before = self._first_from_image
        self._first_from_image = _composed(before, self._step)
        gone = self._first_from_image[:, 2] - before[:, 2]
        # the points of the last good picture stay
        self._guessed_px += _GUESS_SHARE * float(np.hypot(*gone)) + 2.0

    def _begin_segment(self) -> None:
        self.segments += 1
        self._failures, self._way_px, self._guessed_px, self._step = 0, 0.0, 0.0, np.eye(2, 3)
        self._first_from_image = np.eye(2, 3)

    def _look_anew(
        self,
        gray: ImageGray,
        thumbnail: Floats,
        boxes_px: Floats,
        shrink: float,
        here: PointsPx,
        places: PointsPx,
    ) -> None:
        """Keep a picture's points, new ones where there are few, none on objects."""
        if len(here) < _LEAST_POINTS:
            free = np.full(gray.shape, 255, np.uint8)
            for left, top, right, bottom in np.clip(boxes_px * shrink, 0, None).astype(int):
                free[max(top - 2, 0) : bottom + 3, max(left - 2, 0) : right + 3] = 0
            for x, y in here.astype(int):
                cv2.circle(free, (int(x), int(y)), 8, 0, -1)
            corners = cv2.goodFeaturesToTrack(gray, _POINTS - len(here), 0.01, 8, mask=free)
            if corners is not None:
                fresh = np.asarray(corners.reshape(-1, 2), np.float64)
                first_from_small = _composed(
                    self._first_from_image, _inverse(_small_from_full(shrink))
                )
                here = np.concatenate([here, fresh])
                places = np.concatenate([places, _moved(first_from_small, fresh)])
        self._last = _View(gray, thumbnail, here, places)


def _small_from_full(shrink: float) -> Floats:
    """(2, 3): pixel centres stay on pixel centres."""
    return np.array([[shrink, 0, 0.5 * shrink - 0.5], [0, shrink, 0.5 * shrink - 0.5]])


def _followed(
    last: _View, gray: ImageGray, step_px: Floats | None = None
) -> tuple[PointsPx, PointsPx]:
    """Points found again, (M, 2), and their places; those that lead elsewhere on the way back are left out."""
    if len(last.points_px) < _LEAST_INLIERS:
        return np.zeros((0, 2)), np.zeros((0, 2))
    end, good = followed_points(last.gray, gray, last.points_px, step_px)
    return end[good], last.places_px[good]


def followed_points(
    last: ImageGray,
    gray: ImageGray,
    points_px: PointsPx,
    step_px: Floats | None = None,
) -> tuple[PointsPx, Mask]:
    """Where points (N, 2) of one small picture lie in another, and which (N,) lead back to where they came from.

    `step_px` (2,) is how far the picture as a whole has moved, where that is known.
    """
    start = points_px.astype(np.float32).reshape(-1, 1, 2)
    step = np.zeros(2, np.float32) if step_px is None else step_px.astype(np.float32)
    flags = cv2.OPTFLOW_USE_INITIAL_FLOW
    end, there, _ = cv2.calcOpticalFlowPyrLK(
        last,
        gray,
        start,
        start + step,
        winSize=_WINDOW_PX,
        maxLevel=_LEVELS,
        criteria=_UNTIL,
        flags=flags,
    )
    back, again, _ = cv2.calcOpticalFlowPyrLK(
        gray,
        last,
        end,
        end - step,
        winSize=_WINDOW_PX,
        maxLevel=_LEVELS,
        criteria=_UNTIL,
        flags=flags,
    )
    miss = np.linalg.norm((back - start).reshape(-1, 2), axis=1)
    good = (there.ravel() == 1) & (again.ravel() == 1) & (miss < _THERE_AND_BACK_PX)
    return end.reshape(-1, 2).astype(np.float64), good


def _similarity(here: PointsPx, places: PointsPx) -> tuple[Floats | None, Floats]:
    """(2, 3) first picture from small picture by most points, and which (N,) they are; None where too few agree."""
    nothing = np.zeros(len(here), bool)
    if len(here) < _LEAST_INLIERS:
        return None, nothing
    origin = places.mean(axis=0)  # a long way leads to large numbers
    spread = np.ptp(places, axis=0).max() / max(np.ptp(here, axis=0).max(), 1e-9)
    cv2.setRNGSeed(1)
    fit, kept = cv2.estimateAffinePartial2D(
        here,
        places - origin,
        method=cv2.RANSAC,
        ransacReprojThreshold=_FIT_PX * max(spread, 1e-3),
        maxIters=500,
        confidence=0.999,
        refineIters=10,
    )
    if fit is None:
        return None, nothing
    inliers = kept.ravel().astype(bool)
    enough = max(_LEAST_INLIERS, _LEAST_INLIER_SHARE * len(here))
    if inliers.sum() < enough or not np.isfinite(fit).all():
        return None, nothing
    fit[:, 2] += origin
    return np.asarray(fit, np.float64), inliers


def _moved(transform: Floats, points: PointsPx) -> PointsPx:
    return points @ transform[:, :2].T + transform[:, 2]


def _composed(outer: Floats, inner: Floats) -> Floats:
    return np.column_stack([outer[:, :2] @ inner[:, :2], outer[:, :2] @ inner[:, 2] + outer[:, 2]])


def _inverse(transform: Floats) -> Floats:
    back = np.linalg.inv(transform[:, :2])
    return np.column_stack([back, -back @ transform[:, 2]])


STEP_S = 0.1
"""Of a flight between two pictures that are compared: steps much longer find too little of the picture again."""

SMALL_WIDTH_PX = 320
"""Of the pictures that are compared: 3 ms of processor time a step."""

_STEP_FIT_PX = 1.0  # a homography that is to carry boxes fits closer


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
    corners = cv2.goodFeaturesToTrack(last, _POINTS, 0.01, 8)
    if corners is None or len(corners) < _LEAST_INLIERS:
        return None
    start = np.asarray(corners.reshape(-1, 2), np.float64)
    end, good = followed_points(last, gray, start)
    if good.sum() < _LEAST_INLIERS:
        return None
    cv2.setRNGSeed(1)
    found, kept = cv2.findHomography(start[good], end[good], cv2.RANSAC, _STEP_FIT_PX, maxIters=500)
    if found is None or kept.sum() < max(_LEAST_INLIERS, _LEAST_INLIER_SHARE * good.sum()):
        return None
    return (
        np.asarray(found, np.float64)
        if np.isfinite(found).all() and np.linalg.det(found) > 0
        else None
    )
