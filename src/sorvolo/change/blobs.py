"""The changed blobs of one view as they stand on the ground, less the shadows that they throw and what leans."""

from dataclasses import dataclass

import cv2
import numpy as np

from sorvolo.change.outlines import hull_of
from sorvolo.change.things import thing_of
from sorvolo.geometry.arrays import Floats, Mask, PointsM
from sorvolo.geometry.homography import apply_homography
from sorvolo.geometry.polygons import signed_area
from sorvolo.survey.findings import ComparedView, Shade

# Which changed pieces of a view are followed, and where they stand.
_RIM_PX = 2  # a blob that comes nearer to the view's rim may be cut by it
_MOST_BOXES = 64  # of a view, the surest
_AROUND_PX = 4  # of a box, what belongs to its thing
_MOST_OF_VIEW = 0.15  # share of its pixels: what is larger is not followed
_MOST_UNKNOWN = 0.1  # share of a box's rim that may lie on unknown ground
_UPRIGHT_M = 1.0  # narrower than this it may be a person ...
_PERSON_M = 1.9  # ... who leans as this height does at most


@dataclass(frozen=True, eq=False)
class Blob:
    """One changed piece of a view: where it stands on the ground (2,), its size, and its mean colour (3,)."""

    box: int  # row of the view's boxes
    place_m: Floats
    length_m: float
    area_m2: float
    colour: Floats
    score: float


def blobs_of(view: ComparedView) -> list[Blob]:
    """The blobs that lie whole inside the view; one cut by its rim would seem to move with the camera."""
    chosen = np.argsort(-view.scores, kind="stable")[:_MOST_BOXES]
    blobs = [_blob(view, int(index)) for index in chosen if _is_whole(view, int(index))]
    return [each for each in blobs if each is not None]


def _is_whole(view: ComparedView, index: int) -> bool:
    """Whether a box lies on known ground, off the view's rim, and is no large part of the view."""
    height, width = view.changed.shape
    x, y, w, h = (int(each) for each in view.boxes[index])
    is_inside = (
        x >= _RIM_PX and y >= _RIM_PX and x + w <= width - _RIM_PX and y + h <= height - _RIM_PX
    )
    is_small = w * h <= _MOST_OF_VIEW * width * height
    return is_inside and is_small and _is_known_around(view.valid, x, y, w, h)


def _blob(view: ComparedView, index: int) -> Blob | None:
    """The thing in a box where it stands on the ground; None where nothing of it is left, or beyond the horizon."""
    left, top, _, thing = _around(view, index)
    ys, xs = np.nonzero(thing)
    if not len(xs):
        return None
    x, y, w, h = left + int(xs.min()), top + int(ys.min()), int(np.ptp(xs)) + 1, int(np.ptp(ys)) + 1
    part = thing[ys.min() : ys.max() + 1, xs.min() : xs.max() + 1].view(np.uint8) * np.uint8(255)
    moments = cv2.moments(part, binaryImage=True)
    hull = hull_of(part) + np.array([x, y])
    hull_m = apply_homography(view.site_from_image, hull.astype(np.float64))
    middle = np.array([[x + moments["m10"] / moments["m00"], y + moments["m01"] / moments["m00"]]])
    place_m = apply_homography(view.site_from_image, middle)[0]
    if not (np.isfinite(hull_m).all() and np.isfinite(place_m).all()):
        return None
    foot_m = _foot_m(hull_m, hull_m, view.camera_m, view.m_per_px)
    place_m = place_m if foot_m is None else foot_m.mean(axis=0)
    colour = np.array(cv2.mean(view.image[y : y + h, x : x + w], part)[:3])
    area_m2 = moments["m00"] * view.m_per_px**2
    return Blob(
        index, place_m, max(w, h) * view.m_per_px, area_m2, colour, float(view.scores[index])
    )


def standing_outline_m(view: ComparedView, blob: Blob) -> PointsM | None:
    """(N, 2) where a blob of the view stands on the ground, without its shadow and, if it may be a person, without the
    body that leans away from the camera; None where nothing of it is left."""
    left, top, changed, thing = _around(view, blob.box)
    if not thing.any():
        return None
    all_m, thing_m = (
        apply_homography(view.site_from_image, np.argwhere(mask)[:, ::-1] + [left, top])
        for mask in (changed, thing)
    )
    if not np.isfinite(all_m).all():
        return None
    outline_m = _foot_m(thing_m, all_m, view.camera_m, view.m_per_px)
    if outline_m is None:
        outline_m = np.asarray(
            cv2.convexHull(thing_m.astype(np.float32)).reshape(-1, 2), np.float64
        )
    return outline_m if len(outline_m) >= 3 and abs(signed_area(outline_m)) > 0 else None


def _around(view: ComparedView, box: int) -> tuple[int, int, Mask, Mask]:
    """What changed in one of the view's boxes and close around it, and the thing in that: left, top, both masks."""
    x, y, w, h = (int(each) for each in view.boxes[box])
    window = (
        slice(max(y - _AROUND_PX, 0), y + h + _AROUND_PX),
        slice(max(x - _AROUND_PX, 0), x + w + _AROUND_PX),
    )
    changed = view.changed[window] > 0
    thing = thing_of(changed, (view.shade[window] & Shade.LATER) > 0)
    return window[1].start, window[0].start, changed, thing


def _foot_m(
    thing_m: PointsM, changed_m: PointsM, camera_m: Floats, m_per_px: float
) -> PointsM | None:
    """(4, 2) the ground under something narrow that leans away from the camera; None for what does not.

    The feet are at its near end, no nearer than a person's would be, and a person is about as long as wide from above.
    `thing_m` are points of the lit thing: dark trousers may be missing, so `changed_m` bounds how near it begins.
    """
    away = thing_m.mean(axis=0) - camera_m[:2]
    distance_m = float(np.hypot(*away))
    if distance_m < 1e-6:
        return None
    site_from_lean = np.array([away, [-away[1], away[0]]]) / distance_m
    thing, changed = ((each - camera_m[:2]) @ site_from_lean.T for each in (thing_m, changed_m))
    (_, left), (far, right) = thing.min(axis=0), thing.max(axis=0)
    width_m = right - left + m_per_px
    nearest = far * (1 - _PERSON_M / max(float(camera_m[2]), 2 * _PERSON_M)) - width_m
    behind = changed[
        (changed[:, 1] >= left) & (changed[:, 1] <= right) & (changed[:, 0] >= nearest), 0
    ]
    near = float(behind.min(initial=far))
    if width_m > _UPRIGHT_M or far - near <= width_m:
        return None
    middle = near + width_m - m_per_px
    corners = np.array([[near, left], [middle, left], [middle, right], [near, right]])
    return corners @ site_from_lean + camera_m[:2]


def _is_known_around(valid: Mask, x: int, y: int, w: int, h: int) -> bool:
    rim = 2 * (w + h)
    part = valid[max(y - 1, 0) : y + h + 1, max(x - 1, 0) : x + w + 1]
    unknown = part.size - int(np.count_nonzero(part))
    return unknown < _MOST_UNKNOWN * rim
