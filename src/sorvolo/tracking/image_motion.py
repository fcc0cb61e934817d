"""The camera's own motion taken out of pictures that nothing places: sightings in a first picture's pixels."""

from dataclasses import dataclass

import cv2
import numpy as np

from sorvolo.geometry.arrays import Floats, ImageGray, ImageRGB, PointsPx
from sorvolo.survey.flight import Frame
from sorvolo.survey.objects import Detections, Sighting

_WIDTH_PX = 480  # of the pictures in which motion is looked for
_POINTS, _LEAST_POINTS = 180, 90
_LEAST_INLIERS, _LEAST_INLIER_SHARE = 12, 0.35
_FIT_PX = 1.5  # in the small picture
_THERE_AND_BACK_PX = 0.7
_FAILURES = 4  # pictures in a row after which the way is lost
_CUT_LIKENESS = 0.2  # of small thumbnails: less is another scene
_THUMBNAIL_PX = (32, 18)
_BOX_SIGMA, _LEAST_SIGMA_PX = 0.08, 1.0  # of a box's side
_DRIFT_SHARE = 0.004  # of the way gone over the ground, as one goes from points to new points
_GUESS_SHARE = 0.3  # of a step that was guessed
_WINDOW_PX, _LEVELS = (17, 17), 4
_UNTIL = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.03)


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

    def locate(self, found: Detections, frame: Frame, time_ns: int) -> tuple[list[Sighting], PointsPx]:
        """Each detection's place in pixels of its segment's first picture, and (4, 2) what the picture shows of them.

        A sighting's `shared_sigma_m` is how far the way may have drifted since its segment began, in pixels.
        """
        height_px, width_px = frame.image.shape[:2]
        self._follow(frame.image, found.boxes_px.astype(np.float64))
        outline = _moved(self._first_from_image, np.array([
            [-0.5, -0.5], [width_px - 0.5, -0.5], [width_px - 0.5, height_px - 0.5], [-0.5, height_px - 0.5],
        ]))
        scale = float(np.sqrt(abs(np.linalg.det(self._first_from_image[:, :2]))))
        drift_px = _DRIFT_SHARE * self._way_px + self._guessed_px
        boxes = found.boxes_px.astype(np.float64)
        places = _moved(self._first_from_image, (boxes[:, :2] + boxes[:, 2:]) / 2 - 0.5)
        sides = (boxes[:, 2:] - boxes[:, :2]) * scale
        turn = self._first_from_image[:, :2] / max(scale, 1e-9)
        own = np.maximum(_BOX_SIGMA * sides, _LEAST_SIGMA_PX * scale) ** 2
        return [
            Sighting(
                frame.index, frame.name, time_ns, label, float(found.scores[row]), found.boxes_px[row], places[row],
                turn @ np.diag(own[row]) @ turn.T + drift_px**2 * np.eye(2), np.sort(sides[row])[::-1], drift_px,
            )
            for row, label in enumerate(found.names)
        ], outline

    def _follow(self, image: ImageRGB, boxes_px: Floats) -> None:
        """Find where a picture lies."""
        shrink = min(1.0, _WIDTH_PX / image.shape[1])
        gray = _small_gray(image, shrink)
        thumbnail = cv2.resize(gray, _THUMBNAIL_PX, interpolation=cv2.INTER_AREA).astype(np.float64)
        if self._last is None or self._last.gray.shape != gray.shape:
            if self._last is not None:
                self._begin_segment()
            self._look_anew(gray, thumbnail, boxes_px, shrink, np.zeros((0, 2)), np.zeros((0, 2)))
            return
        here, places = _followed(self._last, gray)
        first_from_small, inliers = _similarity(here, places)
        if first_from_small is None:
            here, places = _followed(self._last, gray, _whole_step(self._last.gray, gray))
            first_from_small, inliers = _similarity(here, places)
        if first_from_small is None:
            self._lose(gray, thumbnail, boxes_px, shrink)
            return
        first_from_image = _composed(first_from_small, _small_from_full(shrink))
        self._note_step(first_from_image, image.shape)
        self._first_from_image, self._failures = first_from_image, 0
        self._look_anew(gray, thumbnail, boxes_px, shrink, here[inliers], places[inliers])

    def _note_step(self, first_from_image: Floats, shape: tuple[int, ...]) -> None:
        middle = np.array([[shape[1] / 2, shape[0] / 2]])
        gone = _moved(first_from_image, middle) - _moved(self._first_from_image, middle)
        self._way_px += float(np.hypot(*gone[0]))
        self._step = _composed(_inverse(self._first_from_image), first_from_image)

    def _lose(self, gray: ImageGray, thumbnail: Floats, boxes_px: Floats, shrink: float) -> None:
        """A picture whose motion is not found: a guess, or another segment."""
        assert self._last is not None
        self._failures += 1
        if self._failures >= _FAILURES or _likeness(self._last.thumbnail, thumbnail) < _CUT_LIKENESS:
            self._begin_segment()
            self._look_anew(gray, thumbnail, boxes_px, shrink, np.zeros((0, 2)), np.zeros((0, 2)))
            return
        self.guessed += 1
        before = self._first_from_image
        self._first_from_image = _composed(before, self._step)
        gone = self._first_from_image[:, 2] - before[:, 2]
        self._guessed_px += _GUESS_SHARE * float(np.hypot(*gone)) + 2.0  # the points of the last good picture stay

    def _begin_segment(self) -> None:
        self.segments += 1
        self._failures, self._way_px, self._guessed_px, self._step = 0, 0.0, 0.0, np.eye(2, 3)
        self._first_from_image = np.eye(2, 3)

    def _look_anew(
        self, gray: ImageGray, thumbnail: Floats, boxes_px: Floats, shrink: float, here: PointsPx, places: PointsPx
    ) -> None:
        """Keep a picture's points, new ones where there are few, none on objects."""
        if len(here) < _LEAST_POINTS:
            free = np.full(gray.shape, 255, np.uint8)
            for left, top, right, bottom in np.clip(boxes_px * shrink, 0, None).astype(int):
                free[max(top - 2, 0):bottom + 3, max(left - 2, 0):right + 3] = 0
            for x, y in here.astype(int):
                cv2.circle(free, (int(x), int(y)), 8, 0, -1)
            corners = cv2.goodFeaturesToTrack(gray, _POINTS - len(here), 0.01, 8, mask=free)
            if corners is not None:
                fresh = np.asarray(corners.reshape(-1, 2), np.float64)
                first_from_small = _composed(self._first_from_image, _inverse(_small_from_full(shrink)))
                here = np.concatenate([here, fresh])
                places = np.concatenate([places, _moved(first_from_small, fresh)])
        self._last = _View(gray, thumbnail, here, places)


def _small_gray(image: ImageRGB, shrink: float) -> ImageGray:
    size = (round(image.shape[1] * shrink), round(image.shape[0] * shrink))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA) if shrink < 1 else image
    return np.asarray(cv2.cvtColor(small, cv2.COLOR_RGB2GRAY), np.uint8)


def _small_from_full(shrink: float) -> Floats:
    """(2, 3): pixel centres stay on pixel centres."""
    return np.array([[shrink, 0, 0.5 * shrink - 0.5], [0, shrink, 0.5 * shrink - 0.5]])


def _followed(last: _View, gray: ImageGray, step_px: Floats | None = None) -> tuple[PointsPx, PointsPx]:
    """Points found again, (M, 2), and their places; those that lead elsewhere on the way back are left out."""
    if len(last.points_px) < _LEAST_INLIERS:
        return np.zeros((0, 2)), np.zeros((0, 2))
    start = last.points_px.astype(np.float32).reshape(-1, 1, 2)
    step = np.zeros(2, np.float32) if step_px is None else step_px.astype(np.float32)
    flags = cv2.OPTFLOW_USE_INITIAL_FLOW
    end, there, _ = cv2.calcOpticalFlowPyrLK(
        last.gray, gray, start, start + step, winSize=_WINDOW_PX, maxLevel=_LEVELS, criteria=_UNTIL, flags=flags
    )
    back, again, _ = cv2.calcOpticalFlowPyrLK(
        gray, last.gray, end, end - step, winSize=_WINDOW_PX, maxLevel=_LEVELS, criteria=_UNTIL, flags=flags
    )
    miss = np.linalg.norm((back - start).reshape(-1, 2), axis=1)
    good = (there.ravel() == 1) & (again.ravel() == 1) & (miss < _THERE_AND_BACK_PX)
    return end.reshape(-1, 2)[good].astype(np.float64), last.places_px[good]


def _whole_step(last: ImageGray, gray: ImageGray) -> Floats:
    """(2,) by how much the picture as a whole has moved (phase correlation)."""
    window = cv2.createHanningWindow(gray.shape[::-1], cv2.CV_32F)
    (x, y), _ = cv2.phaseCorrelate(last.astype(np.float32), gray.astype(np.float32), window)
    return np.array([x, y])


def _similarity(here: PointsPx, places: PointsPx) -> tuple[Floats | None, Floats]:
    """(2, 3) first picture from small picture by most points, and which (N,) they are; None where too few agree."""
    nothing = np.zeros(len(here), bool)
    if len(here) < _LEAST_INLIERS:
        return None, nothing
    origin = places.mean(axis=0)  # a long way leads to large numbers
    spread = np.ptp(places, axis=0).max() / max(np.ptp(here, axis=0).max(), 1e-9)
    cv2.setRNGSeed(1)
    fit, kept = cv2.estimateAffinePartial2D(
        here, places - origin, method=cv2.RANSAC, ransacReprojThreshold=_FIT_PX * max(spread, 1e-3), maxIters=500,
        confidence=0.999, refineIters=10,
    )
    if fit is None:
        return None, nothing
    inliers = kept.ravel().astype(bool)
    enough = max(_LEAST_INLIERS, _LEAST_INLIER_SHARE * len(here))
    if inliers.sum() < enough or not np.isfinite(fit).all():
        return None, nothing
    fit[:, 2] += origin
    return np.asarray(fit, np.float64), inliers


def _likeness(first: Floats, second: Floats) -> float:
    """Correlation of two thumbnails; 1 for two flat ones."""
    a, b = first - first.mean(), second - second.mean()
    size = float(np.sqrt((a * a).sum() * (b * b).sum()))
    return float((a * b).sum() / size) if size > 1e-6 else 1.0


def _moved(transform: Floats, points: PointsPx) -> PointsPx:
    return np.asarray(points @ transform[:, :2].T + transform[:, 2])


def _composed(outer: Floats, inner: Floats) -> Floats:
    return np.column_stack([outer[:, :2] @ inner[:, :2], outer[:, :2] @ inner[:, 2] + outer[:, 2]])


def _inverse(transform: Floats) -> Floats:
    back = np.linalg.inv(transform[:, :2])
    return np.column_stack([back, -back @ transform[:, 2]])
