"""The camera's own motion taken out of pictures that nothing places: sightings in a first picture's pixels."""

from dataclasses import dataclass, field

import cv2
import numpy as np

from sorvolo.geometry.arrays import Floats, ImageGray, ImageRGB, Mask, PointsPx
from sorvolo.survey.flight import Frame
from sorvolo.survey.objects import Detections, Sighting

_UNTIL = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.03)


@dataclass(frozen=True)
class FlowSettings:
    """How points are followed, in the small pictures."""

    width_px: int = 480  # of the pictures in which motion is looked for
    points: int = 180  # that are followed, ...
    least_points: int = 90  # ... new ones where fewer are left
    window_px: tuple[int, int] = (17, 17)  # around a point that is followed (Lucas and Kanade)
    levels: int = 4  # of smaller pictures, for longer steps
    there_and_back_px: float = 0.7  # points that miss by more on the way back are left out
    fit_px: float = 1.5  # a point that agrees lies so near
    least_inliers: int = 12  # points that must agree ...
    least_inlier_share: float = 0.35  # ... and of all


@dataclass(frozen=True)
class ImageMotionSettings:
    """When the way is lost, and how far it may have drifted."""

    failures: int = 4  # pictures in a row after which the way is lost
    cut_likeness: float = 0.2  # of small thumbnails: less is another scene
    thumbnail_px: tuple[int, int] = (32, 18)  # columns, rows of those thumbnails
    box_sigma: float = 0.08  # of a box's middle, in shares of its side
    least_sigma_px: float = 1.0  # however small the box
    drift_share: float = (
        0.004  # of the way gone over the ground, as one goes from points to new points
    )
    guess_share: float = 0.3  # of a step that was guessed
    flow: FlowSettings = field(default_factory=FlowSettings)


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

    def __init__(self, settings: ImageMotionSettings = ImageMotionSettings()) -> None:
        self._settings = settings
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
        drift_px = self._settings.drift_share * self._way_px + self._guessed_px
        boxes = found.boxes_px.astype(np.float64)
        places = _moved(self._first_from_image, (boxes[:, :2] + boxes[:, 2:]) / 2 - 0.5)
        sides = (boxes[:, 2:] - boxes[:, :2]) * scale
        turn = self._first_from_image[:, :2] / max(scale, 1e-9)
        own = (
            np.maximum(self._settings.box_sigma * sides, self._settings.least_sigma_px * scale) ** 2
        )
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
        flow = self._settings.flow
        shrink = min(1.0, flow.width_px / image.shape[1])
        gray = _small_gray(image, shrink)
        thumbnail = cv2.resize(
            gray, self._settings.thumbnail_px, interpolation=cv2.INTER_AREA
        ).astype(np.float64)
        if self._last is None or self._last.gray.shape != gray.shape:
            if self._last is not None:
                self._begin_segment()
            self._look_anew(gray, thumbnail, boxes_px, shrink, np.zeros((0, 2)), np.zeros((0, 2)))
            return
        here, places = _followed(self._last, gray, flow)
        first_from_small, inliers = _similarity(here, places, flow)
        if first_from_small is None:
            here, places = _followed(self._last, gray, flow, _whole_step(self._last.gray, gray))
            first_from_small, inliers = _similarity(here, places, flow)
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
        is_cut = _likeness(self._last.thumbnail, thumbnail) < self._settings.cut_likeness
        if self._failures >= self._settings.failures or is_cut:
            self._begin_segment()
            self._look_anew(gray, thumbnail, boxes_px, shrink, np.zeros((0, 2)), np.zeros((0, 2)))
            return
        self.guessed += 1
        before = self._first_from_image
        self._first_from_image = _composed(before, self._step)
        gone = self._first_from_image[:, 2] - before[:, 2]
        # the points of the last good picture stay
        self._guessed_px += self._settings.guess_share * float(np.hypot(*gone)) + 2.0

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
        flow = self._settings.flow
        if len(here) < flow.least_points:
            free = np.full(gray.shape, 255, np.uint8)
            for left, top, right, bottom in np.clip(boxes_px * shrink, 0, None).astype(int):
                free[max(top - 2, 0) : bottom + 3, max(left - 2, 0) : right + 3] = 0
            for x, y in here.astype(int):
                cv2.circle(free, (int(x), int(y)), 8, 0, -1)
            corners = cv2.goodFeaturesToTrack(gray, flow.points - len(here), 0.01, 8, mask=free)
            if corners is not None:
                fresh = np.asarray(corners.reshape(-1, 2), np.float64)
                first_from_small = _composed(
                    self._first_from_image, _inverse(_small_from_full(shrink))
                )
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


def _followed(
    last: _View, gray: ImageGray, settings: FlowSettings, step_px: Floats | None = None
) -> tuple[PointsPx, PointsPx]:
    """Points found again, (M, 2), and their places; those that lead elsewhere on the way back are left out."""
    if len(last.points_px) < settings.least_inliers:
        return np.zeros((0, 2)), np.zeros((0, 2))
    end, good = followed_points(last.gray, gray, last.points_px, settings, step_px)
    return end[good], last.places_px[good]


def followed_points(
    last: ImageGray,
    gray: ImageGray,
    points_px: PointsPx,
    settings: FlowSettings,
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
        winSize=settings.window_px,
        maxLevel=settings.levels,
        criteria=_UNTIL,
        flags=flags,
    )
    back, again, _ = cv2.calcOpticalFlowPyrLK(
        gray,
        last,
        end,
        end - step,
        winSize=settings.window_px,
        maxLevel=settings.levels,
        criteria=_UNTIL,
        flags=flags,
    )
    miss = np.linalg.norm((back - start).reshape(-1, 2), axis=1)
    good = (there.ravel() == 1) & (again.ravel() == 1) & (miss < settings.there_and_back_px)
    return end.reshape(-1, 2).astype(np.float64), good


def _whole_step(last: ImageGray, gray: ImageGray) -> Floats:
    """(2,) by how much the picture as a whole has moved (phase correlation)."""
    window = cv2.createHanningWindow(gray.shape[::-1], cv2.CV_32F)
    (x, y), _ = cv2.phaseCorrelate(last.astype(np.float32), gray.astype(np.float32), window)
    return np.array([x, y])


def _similarity(
    here: PointsPx, places: PointsPx, settings: FlowSettings
) -> tuple[Floats | None, Floats]:
    """(2, 3) first picture from small picture by most points, and which (N,) they are; None where too few agree."""
    nothing = np.zeros(len(here), bool)
    if len(here) < settings.least_inliers:
        return None, nothing
    origin = places.mean(axis=0)  # a long way leads to large numbers
    spread = np.ptp(places, axis=0).max() / max(np.ptp(here, axis=0).max(), 1e-9)
    cv2.setRNGSeed(1)
    fit, kept = cv2.estimateAffinePartial2D(
        here,
        places - origin,
        method=cv2.RANSAC,
        ransacReprojThreshold=settings.fit_px * max(spread, 1e-3),
        maxIters=500,
        confidence=0.999,
        refineIters=10,
    )
    if fit is None:
        return None, nothing
    inliers = kept.ravel().astype(bool)
    enough = max(settings.least_inliers, settings.least_inlier_share * len(here))
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
