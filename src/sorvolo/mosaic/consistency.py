"""Whether a finished map agrees with itself: its pieces in one scale, its cameras where GPS and heights have them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sorvolo.geometry.arrays import Floats, PointsM
from sorvolo.geometry.homography import apply_homography, fit_similarity
from sorvolo.mosaic.flight_figures import FlightFigures
from sorvolo.mosaic.graph_report import GraphReport
from sorvolo.survey.mosaic import PlacedFrame, Status
from sorvolo.survey.wording import counted

_LEAST_FRAMES = 4  # of a piece, for its scale to be known
_MOST_SCALE = 0.2  # relative, between pieces or between a piece and GPS ...
_SCALE_SIGMAS = 4.0  # ... and so many times what the fixes leave open
_MOST_RMS_M = 25.0  # of cameras from their fixes ...
_RMS_SIGMAS = 8.0  # ... or so many stated sigmas
_MOST_OFF_M = 5.0  # median, if it is also a quarter of how far the flight reaches
_OFF_SHARE = 0.25
_LEAST_ALIKE = 0.6  # rms misfit over the fixes' spread: more, and the path is another one
# of the height above ground: heights of frames that scatter so against telemetry's
_MOST_UNEVEN = 0.35
_LEAST_UNEVEN_M = 8.0
_HEIGHTS_DIFFER = 0.15  # of the stated height: more is reported ...
_HEIGHTS_DIFFER_M = 4.0  # ... if it is so many metres as well


@dataclass(frozen=True)
class Piece:
    """Frames tied to each other by their pictures. `scale` is the map's over that of GPS, NaN where fixes are few."""

    frames: int
    first: str
    last: str
    scale: float
    scale_sigma: float
    height_m: float  # above the ground, median


@dataclass(frozen=True)
class Stated:
    """What telemetry states of a flight: sigma of its fixes, and the median height above ground of the placed frames,
    NaN where the ground's own height is not known."""

    position_sigma_m: float
    height_m: float
    source: str  # in words: "the photos' heights"


@dataclass(frozen=True)
class Consistency:
    """The pieces of a map, the largest first; `faults`, in words, make it no map to rely on, `steps` one to check,
    `remarks` neither."""

    pieces: tuple[Piece, ...]
    faults: tuple[str, ...]
    steps: tuple[str, ...]
    remarks: tuple[str, ...]


NOTHING_KNOWN = Consistency((), (), (), ())


def consistency(
    placed: Sequence[PlacedFrame],
    pieces: Sequence[Sequence[int]],
    figures: FlightFigures,
    stated: Stated,
    graph: GraphReport | None = None,
) -> Consistency:
    """Hold a map against itself and against telemetry. `pieces` are the frames, by index, that links tie together."""
    by_index = {each.index: each for each in placed if each.status is not Status.REJECTED}
    groups = sorted(
        ([by_index[k] for k in ids if k in by_index] for ids in pieces),
        key=lambda group: -len(group),
    )
    found = [_piece(group, stated) for group in groups]
    known = tuple(each for each in found if each is not None)
    frames = list(by_index.values())
    faults = [
        *_scale_faults(known),
        *_gps_faults(frames, figures, stated),
        *_height_faults(frames, figures),
    ]
    steps = [
        *_steps(groups[: len(known)], figures),
        *(_gps_doubts(figures) if not faults else []),
        *_relief_doubts(figures, graph),
    ]
    return Consistency(known, tuple(faults), tuple(steps), tuple(_height_remarks(figures, stated)))


def _steps(groups: Sequence[Sequence[PlacedFrame]], figures: FlightFigures) -> list[str]:
    """Pieces that lie beside each other, tied by telemetry alone: two areas far apart are none."""
    centres = [np.array([each.outline_m.mean(axis=0) for each in group]) for group in groups]
    beside = [
        k
        for k in range(1, len(groups))
        if any(
            float(np.linalg.norm(centres[k][:, None] - other[None], axis=-1).min())
            < 0.6 * figures.diagonal_m
            for other in centres[:k]
        )
    ]
    if not beside:
        return []
    listed = "; ".join(
        f"{counted(len(groups[k]), 'frame')} from {groups[k][0].name} to {groups[k][-1].name}"
        for k in [0, *beside][:4]
    )
    return [
        f"the map is in {len(beside) + 1} pieces that no picture ties together ({listed}): expect steps of some metres "
        "between them; fly with more overlap, or give control points (--gcp)"
    ]


def _relief_doubts(figures: FlightFigures, graph: GraphReport | None) -> list[str]:
    """Slopes that may move the map by more than all else does, and by more than stated angles usually err."""
    if graph is None or figures.sigma_m is None:
        return []
    otherwise_m = float(np.sqrt(max(figures.sigma_m**2 - graph.lean_m**2, 0.0)))
    if graph.lean_m <= max(otherwise_m, graph.lean_stated_m):
        return []
    return [
        f"the ground is not level: over its slopes the flat map may lie {figures.sigma_m:.1f} m off (1 sigma), "
        f"{otherwise_m:.1f} m if it were level; give control points (--gcp), or use `sorvolo heights`, which measures "
        "the ground and makes a true orthophoto"
    ]


def _piece(frames: Sequence[PlacedFrame], stated: Stated) -> Piece | None:
    if len(frames) < 2:
        return None
    centres_m, fixes_m = _centres_and_fixes(frames)
    heights = [
        each.site_from_camera.translation_m[2]
        for each in frames
        if each.site_from_camera is not None
    ]
    scale = sigma = float("nan")
    spread_m = float(np.linalg.norm(fixes_m.std(axis=0))) if len(fixes_m) else 0.0
    if len(fixes_m) >= _LEAST_FRAMES and spread_m > 2 * stated.position_sigma_m:
        change = fit_similarity(fixes_m, centres_m)
        scale = float(1 / max(np.hypot(change[0, 0], change[1, 0]), 1e-9))
        miss_m = np.linalg.norm(apply_homography(change, centres_m) - fixes_m, axis=1)
        noise_m = max(stated.position_sigma_m, float(np.sqrt((miss_m**2).mean() / 2)))
        sigma = noise_m / (np.sqrt(len(fixes_m)) * spread_m)
    height_m = float(np.median(heights)) if heights else float("nan")
    return Piece(len(frames), frames[0].name, frames[-1].name, scale, float(sigma), height_m)


def _centres_and_fixes(frames: Sequence[PlacedFrame]) -> tuple[PointsM, PointsM]:
    """(N, 2) each: camera places and the fixes they are held against, of frames that have both."""
    rows = [
        (each.site_from_camera.translation_m[:2], each.gps_residual_m[:2])
        for each in frames
        if each.site_from_camera is not None and np.isfinite(each.gps_residual_m[:2]).all()
    ]
    centres_m, off_m = (np.array([row[k] for row in rows]).reshape(-1, 2) for k in (0, 1))
    return centres_m, centres_m - off_m


def _scale_faults(pieces: Sequence[Piece]) -> list[str]:
    known = [each for each in pieces if np.isfinite(each.scale)]
    faults = []
    for piece in known[:1]:
        if abs(np.log(piece.scale)) > max(_MOST_SCALE, _SCALE_SIGMAS * piece.scale_sigma):
            faults.append(
                f"the map is {piece.scale:.2f} times as large as its GPS track (frames {piece.first} to {piece.last})"
            )
    for piece in known[1:]:
        apart = abs(np.log(piece.scale / known[0].scale))
        sigma = np.hypot(piece.scale_sigma, known[0].scale_sigma)
        if apart > max(_MOST_SCALE, _SCALE_SIGMAS * sigma):
            faults.append(
                f"its pieces differ in scale: {counted(piece.frames, 'frame')} from {piece.first} to {piece.last} by "
                f"{piece.scale / known[0].scale:.2f} against {counted(known[0].frames, 'frame')} from {known[0].first}"
            )
    return faults


def _gps_faults(
    frames: Sequence[PlacedFrame],
    figures: FlightFigures,
    stated: Stated,
) -> list[str]:
    rms_m = figures.gps_rms_m
    if rms_m is None or len(frames) <= 3:
        return []
    doubts = _gps_doubts(figures)
    if doubts and not _is_alike(frames):
        return doubts
    if rms_m > max(_MOST_RMS_M, _RMS_SIGMAS * stated.position_sigma_m):
        return [
            f"the cameras lie {rms_m:.0f} m from their GPS fixes (root mean square), more than a receiver errs: give "
            "control points (--gcp), or photos with more overlap"
        ]
    return []


def _gps_doubts(figures: FlightFigures) -> list[str]:
    median_m = figures.gps_median_m
    if median_m is None or median_m <= max(_OFF_SHARE * figures.reach_m, _MOST_OFF_M):
        return []
    return [
        f"the pictures' own path and the telemetry disagree by {median_m:.0f} m (median): is this the telemetry of "
        "this flight, is the clock offset right, and are latitude and longitude in their columns, with their signs?"
    ]


def _is_alike(frames: Sequence[PlacedFrame]) -> bool:
    """Whether the fixes follow the cameras' path, however badly: a poor receiver's do, another flight's do not."""
    centres_m, fixes_m = _centres_and_fixes(frames)
    if len(fixes_m) < _LEAST_FRAMES or not np.ptp(centres_m, axis=0).any():
        return False
    left_m = apply_homography(fit_similarity(fixes_m, centres_m), centres_m) - fixes_m
    spread_m = float(np.linalg.norm(fixes_m.std(axis=0)))
    return float(np.sqrt((left_m**2).sum(axis=1).mean())) < _LEAST_ALIKE * spread_m


def _height_faults(frames: Sequence[PlacedFrame], figures: FlightFigures) -> list[str]:
    rows = np.array(
        [
            (each.site_from_camera.translation_m[2], each.gps_residual_m[2])
            for each in frames
            if each.site_from_camera is not None and np.isfinite(each.gps_residual_m[2])
        ]
    ).reshape(-1, 2)
    if len(rows) < _LEAST_FRAMES or figures.height_m is None:
        return []
    up_m, off_m = rows.T
    uneven_m = _uneven_m(off_m)
    # a barometer or a poor receiver, not the map
    telemetry_drifts = _uneven_m(up_m) < _uneven_m(up_m - off_m)
    if telemetry_drifts or uneven_m <= max(_MOST_UNEVEN * figures.height_m, _LEAST_UNEVEN_M):
        return []
    return [
        f"the pictures put frames {uneven_m:.0f} m higher or lower than telemetry, at {figures.height_m:.0f} m above "
        "the ground: the map has several scales; give control points (--gcp), or photos with more overlap"
    ]


def _uneven_m(values_m: Floats) -> float:
    """How far three quarters of the values stay from their median."""
    return float(np.percentile(np.abs(values_m - np.median(values_m)), 75))


def _height_remarks(figures: FlightFigures, stated: Stated) -> list[str]:
    found_m, stated_m = figures.height_m, stated.height_m
    if found_m is None or not np.isfinite(stated_m):
        return []
    if abs(found_m - stated_m) <= max(_HEIGHTS_DIFFER * abs(stated_m), _HEIGHTS_DIFFER_M):
        return []
    return [
        f"{stated.source} give {stated_m:.0f} m above the ground, the pictures and GPS {found_m:.0f} m: the ground "
        "lies higher or lower than the take-off, or the camera's focal length is another (--camera)"
    ]
