"""A map tied to control points: what they are held against, which of them cannot be right, and how well it fits."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from sorvolo.errors import InputError
from sorvolo.geometry.arrays import Floats, Matrix3, PointsM, Rows
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.geodesy import LocalFrame
from sorvolo.geometry.homography import apply_homography, fit_similarity
from sorvolo.geometry.units import FOOT_M
from sorvolo.mosaic.ground_ties import GroundTies, similarity_of_most
from sorvolo.mosaic.planar import PlanarMapper
from sorvolo.survey.control import (
    ControlMark,
    ControlReport,
    ControlResidual,
    ControlRole,
    GroundControl,
)

LEAST_CONTROL = 3  # points: two fix a similarity, the third shows whether they are right


_MARK_PX = 1.0  # with which a person marks, px of the frame
_EXCLUDED_SIGMAS = 5.0  # beyond which a point may be wrong ...
_EXCLUDED_TIMES = 4.0  # ... if it also misses so many times as much as the others
_MOST_MISFIT = 0.12  # of the points' spread: more, and the points are not those in the pictures
_LEAST_SPREAD_M = 0.1  # rms: closer together they give no scale and no north
_MOST_OFF_GPS_M = 60.0  # no receiver errs so far: the points' CRS is another
_MOST_SCALE = 1.3  # between GPS and the points
# spread across over spread along, or over that of a picture's ground: less is one line
_ON_LINE = 0.1
# times the rms miss, by choice: heights in feet that fit so much better are in feet
_CLEARLY_BETTER = 0.5
# their spread over that of the flight's cameras, below which they hold a corner of it
_IN_CORNER = 0.3


@dataclass(frozen=True)
class ControlSettings:
    """How control points are weighed, and when one of them is taken for wrong."""

    sigma_m: float = 0.05  # of the survey, horizontal
    checks: tuple[
        str, ...
    ] = ()  # labels held back; one that ends in * stands for all that begin so

    def holds_back(self, label: str) -> bool:
        """Whether this point measures the map in place of tying it."""
        return any(
            label.startswith(each[:-1]) if each.endswith("*") else label == each
            for each in self.checks
        )


@dataclass(frozen=True, eq=False)
class _Seen:
    """Points with marks in placed frames: `point` (M,) is the index of each mark's point in `labels`."""

    labels: tuple[str, ...]
    point: Rows
    ties: GroundTies

    def of(self, chosen: set[str]) -> GroundTies:
        """The ties of some of the points."""
        return self.ties.of(np.array([self.labels[k] in chosen for k in self.point], bool))

    def misses(self, places_m: PointsM) -> tuple[PointsM, Floats]:
        """Mean miss of each point's marks, (P, 2) m, and how far they scatter, (P,)."""
        off_m = places_m - self.ties.place_m[:, :2]
        mean = np.array([off_m[self.point == k].mean(axis=0) for k in range(len(self.labels))])
        scatter = np.sqrt(((off_m - mean[self.point]) ** 2).sum(axis=1))
        return mean, np.array(
            [np.sqrt((scatter[self.point == k] ** 2).mean()) for k in range(len(self.labels))]
        )


@dataclass(frozen=True, eq=False)
class ControlProblem:
    """A flight's control: marks in the frames' own pixels, the keyframe that shows each frame, the camera as
    calibrated, and other readings of the file to name a mistake by."""

    control: GroundControl
    keyframe_of: Mapping[str, int]
    camera: Camera
    frame: LocalFrame
    is_datum: bool  # nothing else knows where the flight was
    other_readings: Callable[[], Iterable[tuple[str, GroundControl]]] = field(default=lambda: ())


def tie_control(
    mapper: PlanarMapper, problem: ControlProblem, settings: ControlSettings
) -> ControlReport:
    """Tie the map to its control points, points that contradict the others excluded one by one.

    Raises InputError where too few are seen, and where they do not fit the pictures at all.
    """
    seen = _seen(mapper, problem, problem.control, settings)
    used = {label for label in seen.labels if not settings.holds_back(label)}
    if len(used) < LEAST_CONTROL:
        raise InputError(
            f"{problem.control.name}: {len(used)} control points are marked in frames that have a place and are not "
            f"held back, at least {LEAST_CONTROL} are needed; mark more points, in more photos"
        )
    _check_fit(mapper, problem, seen, used, settings)
    excluded: set[str] = set()
    while True:
        mapper.tie_to_ground(seen.of(used), is_datum=problem.is_datum)
        misses, scatter = seen.misses(mapper.ground_places_m(seen.ties))
        # How far a point that is right may miss, one sigma: its survey's error and that of its
        # marks.
        heights_m = [mapper.pose(each).translation_m[2] for each in seen.ties.keyframe_ids.tolist()]
        expected_m = float(
            np.hypot(settings.sigma_m, _MARK_PX * np.median(heights_m) / problem.camera.fx_px)
        )
        # The used point that misses most, where it misses more than surveying, marking and the
        # others allow.
        miss_m = {
            label: float(np.linalg.norm(misses[k]))
            for k, label in enumerate(seen.labels)
            if label in used
        }
        worst = max(miss_m, key=lambda label: miss_m[label])
        usual_m = float(np.median([value for label, value in miss_m.items() if label != worst]))
        limit_m = max(_EXCLUDED_SIGMAS * expected_m, _EXCLUDED_TIMES * usual_m)
        wrong = worst if miss_m[worst] > limit_m else None
        if wrong is None or len(used) == LEAST_CONTROL:
            break
        used.remove(wrong)
        excluded.add(wrong)
    rows = {
        label: (misses[k], scatter[k], int((seen.point == k).sum()))
        for k, label in enumerate(seen.labels)
    }
    residuals = tuple(
        _residual(problem.control, number, rows, used, excluded)
        for number in range(len(problem.control.points))
    )
    cameras_m = np.array([mapper.pose(each).translation_m for each in mapper.placed()])
    picture_m = float(np.median(cameras_m[:, 2])) * problem.camera.width_px / problem.camera.fx_px
    remarks = (
        *_misfit_remarks(mapper, seen, used, expected_m),
        *layout_remarks(
            np.unique(seen.of(used).place_m[:, :2], axis=0), cameras_m[:, :2], picture_m
        ),
    )
    missed_m = _rms_m(misses[np.array([label not in excluded for label in seen.labels], bool)])
    mapper.note_ground_miss(float(np.sqrt(max(0.0, missed_m**2 - expected_m**2) / 2)))
    return ControlReport(
        problem.control.name, problem.control.crs, settings.sigma_m, residuals, remarks
    )


def _misfit_remarks(
    mapper: PlanarMapper, seen: _Seen, used: set[str], expected_m: float
) -> tuple[str, ...]:
    """In words, that the points miss the tied map by more than they err: its ground is not level, or their heights are
    wrong. Whether heights in feet would fit is judged by how well map and points fit each other after a similarity."""
    misses, _ = seen.misses(mapper.ground_places_m(seen.ties))
    is_used = np.array([label in used for label in seen.labels], bool)
    missed_m = _rms_m(misses[is_used])
    if missed_m <= _EXCLUDED_SIGMAS * expected_m:
        return ()
    found = f"the control points miss the map by {missed_m:.2f} m (rms), and {expected_m:.2f} m was to be expected"
    in_feet = replace(seen, ties=replace(seen.ties, place_m=seen.ties.place_m * (1.0, 1.0, FOOT_M)))
    as_read_m, as_feet_m = (_unlike_m(mapper, each, is_used) for each in (seen, in_feet))
    if as_feet_m < _CLEARLY_BETTER * as_read_m:
        return (f"{found}; their heights (z) fit far better as feet: give them in metres",)
    return (f"{found}: the ground is not level, or their heights (z) are wrong",)


def _unlike_m(mapper: PlanarMapper, seen: _Seen, is_used: Rows) -> float:
    """Rms miss of some of the points after the best similarity."""
    misses, _ = seen.misses(mapper.ground_places_m(seen.ties))
    first = [int(np.argmax(seen.point == k)) for k in range(len(seen.labels))]
    places_m = seen.ties.place_m[first, :2][is_used]
    on_map_m = places_m + misses[is_used]
    return _rms_m(apply_homography(fit_similarity(places_m, on_map_m), on_map_m) - places_m)


def _rms_m(off_m: PointsM) -> float:
    return float(np.sqrt((off_m**2).sum(axis=1).mean()))


def layout_remarks(places_m: PointsM, cameras_m: PointsM, picture_m: float) -> tuple[str, ...]:
    """In words, how control points at (P, 2) lie badly for a flight with cameras over (N, 2), whose pictures are
    `picture_m` wide on the ground: on one line, or all in one corner. Their residuals are small, however far off the
    map is elsewhere."""
    along_m, across_m = _spreads_m(places_m)
    if across_m < _ON_LINE * min(along_m, picture_m / np.sqrt(12)):
        return (
            f"the control points lie on one line ({4 * along_m:.0f} m long, {4 * across_m:.1f} m wide): they do not "
            "show how the map lies beside it; add points to both sides, or hold some back there (--check)",
        )
    reach_m = _spreads_m(cameras_m)[0]
    if along_m < _IN_CORNER * reach_m:
        return (
            f"the control points reach over {4 * along_m:.0f} m of a flight of {4 * reach_m:.0f} m: they do not show "
            "how the map lies away from them; spread them over the whole area",
        )
    return ()


def _spreads_m(places_m: PointsM) -> tuple[float, float]:
    """The standard deviations of places, (N, 2), along the line that fits them best, and across it."""
    along, across = np.linalg.svd(places_m - places_m.mean(axis=0), compute_uv=False)[:2] / np.sqrt(
        len(places_m)
    )
    return float(along), float(across)


def _residual(
    control: GroundControl,
    number: int,
    rows: Mapping[str, tuple[Floats, float, int]],
    used: set[str],
    excluded: set[str],
) -> ControlResidual:
    point = control.points[number]
    if point.label not in rows:
        return ControlResidual(point, ControlRole.UNSEEN, 0, np.nan, np.nan, np.nan)
    miss, scatter, marks = rows[point.label]
    role = (
        ControlRole.CONTROL
        if point.label in used
        else (ControlRole.EXCLUDED if point.label in excluded else ControlRole.CHECK)
    )
    return ControlResidual(point, role, marks, float(miss[0]), float(miss[1]), float(scatter))


def _seen(
    mapper: PlanarMapper, problem: ControlProblem, control: GroundControl, settings: ControlSettings
) -> _Seen:
    marks = [each for each in control.marks if each.frame in problem.keyframe_of]
    marked = {each.label for each in marks}
    labels = tuple(each.label for each in control.points if each.label in marked)
    frame = LocalFrame(control.middle) if problem.is_datum else problem.frame
    # (P, 3) in the site; the points' median height is taken for the ground's, points without one
    # lie there.
    latitude, longitude, height = (
        np.array([getattr(each, name) for each in control.points])
        for name in ("latitude_deg", "longitude_deg", "height_m")
    )
    level = np.full(len(latitude), frame.origin.height_m)
    known = np.isfinite(height)
    up_m = np.where(known, height - (np.median(height[known]) if known.any() else 0.0), 0.0)
    place_of = dict(
        zip(
            (each.label for each in control.points),
            np.column_stack([frame.site_from_wgs84(latitude, longitude, level)[:, :2], up_m]),
            strict=True,
        )
    )
    keyframes, pixels, point = _columns(marks, problem.keyframe_of, labels)
    count = np.bincount(point, minlength=len(labels))[point]
    scale = [mapper.registration_scale(each, problem.camera) for each in keyframes.tolist()]
    ties = GroundTies(
        keyframes,
        problem.camera.rays_from_pixels(pixels)[:, :2],
        np.array([place_of[each.label] for each in marks]).reshape(-1, 3),
        _MARK_PX * np.array(scale),
        settings.sigma_m * np.sqrt(count),  # marks of one point share its error
    )
    return _Seen(labels, point, ties)


def _columns(
    marks: Sequence[ControlMark], keyframe_of: Mapping[str, int], labels: Sequence[str]
) -> tuple[Rows, Floats, Rows]:
    """Keyframe, pixel and point of each mark."""
    rows = [(keyframe_of[each.frame], labels.index(each.label)) for each in marks]
    keyframes, points = np.array(rows, int).reshape(-1, 2).T
    return keyframes, np.array([(each.x_px, each.y_px) for each in marks]).reshape(-1, 2), points


def _check_fit(
    mapper: PlanarMapper,
    problem: ControlProblem,
    seen: _Seen,
    used: set[str],
    settings: ControlSettings,
) -> None:
    """Raise InputError where the points as they are read cannot be those in the pictures."""
    found = _disagreement(mapper, seen, used, problem, settings)
    if not found:
        return
    for words, control in problem.other_readings():
        other = _seen(mapper, problem, control, settings)
        if len(used & set(other.labels)) == len(used) and not _disagreement(
            mapper, other, used, problem, settings
        ):
            raise InputError(
                f"{problem.control.name}: {found}; they fit if {words}: correct the file"
            )
    raise InputError(
        f"{problem.control.name}: {found}; check the CRS in its first line, the order of x and y, and the marks"
    )


def _disagreement(
    mapper: PlanarMapper,
    seen: _Seen,
    used: set[str],
    problem: ControlProblem,
    settings: ControlSettings,
) -> str:
    """In words, how the points cannot be those in the pictures; "" where they can."""
    ties = seen.of(used)
    places_m = mapper.ground_places_m(ties)
    order = np.array([label for label in np.array(seen.labels)[seen.point] if label in used])
    a, b = (
        np.array([each[order == label].mean(axis=0) for label in sorted(used)])
        for each in (ties.place_m[:, :2], places_m)
    )
    spread_m = float(np.linalg.norm(a.std(axis=0)))
    if spread_m < _LEAST_SPREAD_M:
        return f"the control points all lie within {4 * spread_m:.2g} m of each other"
    change = similarity_of_most(a, b) if np.isfinite(b).all() else None
    if change is None:
        return "the control points are marked where no picture shows the ground"
    miss_m = np.sort(np.linalg.norm(apply_homography(change, b) - a, axis=1))[(len(a) + 1) // 2]
    if miss_m > _MOST_MISFIT * spread_m:
        return f"the control points miss those marked by {miss_m:.1f} m on ground {2 * spread_m:.0f} m wide"
    return "" if problem.is_datum else _against_gps(a, b, change, spread_m)


def _against_gps(a: PointsM, b: PointsM, change: Matrix3, spread_m: float) -> str:
    """How surveyed places `a` cannot be those that a map by GPS has at `b`, (P, 2) each; "" where they can."""
    off_m = float(np.median(np.linalg.norm(a - b, axis=1)))
    scale = float(np.hypot(change[0, 0], change[1, 0]))
    if off_m > _MOST_OFF_GPS_M + 0.25 * spread_m:
        return f"the control points lie {off_m:.0f} m from where GPS has what is marked"
    if not 1 / _MOST_SCALE < scale < _MOST_SCALE:
        return f"the control points are {scale:.2f} times as far apart as GPS has what is marked"
    return ""
