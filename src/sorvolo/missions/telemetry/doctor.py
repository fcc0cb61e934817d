"""`sorvolo telemetry`: a mapped flight's telemetry corrected by its map, and what was wrong with it."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from math import hypot, isfinite, nan
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from sorvolo.capture.correction import (
    corrected_poses,
    even_times_s,
    fitted,
    headings_deg,
    path_fit,
    telemetry_faults,
)
from sorvolo.capture.flight_telemetry import FlightTelemetry
from sorvolo.capture.live.klv import VmtiTarget
from sorvolo.capture.live.klv_telemetry import mux_klv
from sorvolo.capture.source import Source, opened_sources
from sorvolo.capture.video import VideoSource
from sorvolo.errors import InputError
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.pose import Pose, gimbal_angles_from_rotation
from sorvolo.missions.flight.headline import doubt_about
from sorvolo.missions.flight.settings import MapSettings
from sorvolo.missions.flight.setup import FlightSetup, prepare
from sorvolo.missions.watch.cot_sender import CotPlace, CotTls, send_all
from sorvolo.paths import AnyPath, as_path
from sorvolo.store.atomic import atomic_path, atomic_write_bytes, make_folder
from sorvolo.store.exports.detection_files import LINES, find_watched
from sorvolo.store.exports.places import longitude_latitude
from sorvolo.store.exports.plain import json_bytes, plain_json
from sorvolo.store.exports.telemetry_files import (
    cot_track,
    geo_txt,
    is_dated,
    name_for_odm,
    track_csv,
    track_gpx,
)
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.catalogue_place import is_site
from sorvolo.survey.control import ControlRole
from sorvolo.survey.corrected import AS_THE_MAP, Bias, CorrectedFrame, PathFit, TelemetryFaults
from sorvolo.survey.flight import Site
from sorvolo.survey.mosaic import Status
from sorvolo.survey.wording import counted

_HOLDING = 2  # control points that hold a map's scale and direction
_REPORT = "telemetry.json"
_UNDIAGNOSED = "no diagnosis was made: it takes the flight's own video or photos, with --site"
_INTERPOLATED = "interpolated"  # a camera by telemetry, corrected by the frames before and after
_KLV_STEP_S = 0.2  # between samples, five a second; by choice
_UNTRACKED = 1_000_000  # from here on count detections that belong to no track; by choice


@dataclass(frozen=True)
class CotReceiver:
    """Whom Cursor on Target events are sent to."""

    place: CotPlace
    tls: CotTls = field(default_factory=CotTls)


@dataclass(frozen=True, eq=False)
class _Solved:
    """A camera, when it was there, seconds into the flight, and how well and by what it is known. `name` is its frame's,
    "" between frames."""

    name: str
    index: int
    time_ns: int
    camera: Camera
    pose: Pose
    seconds: float
    sigma_m: float
    status: str


@dataclass(frozen=True, eq=False)
class _Compared:
    """A flight whose own telemetry was compared with its map; the map shifted its clock by `applied_s`. `names` are
    those of the compared frames."""

    setup: FlightSetup
    track: FlightTelemetry
    applied_s: float
    faults: TelemetryFaults
    names: Sequence[str]


@dataclass(frozen=True)
class TelemetryOutcome:
    """What was wrong with a flight's telemetry, in `sentences`, and the files, by name, that have it right.

    `cot_sent` is how many Cursor on Target events were sent, None where none were to be. `report` is telemetry.json.
    """

    flight: str
    folder: Path
    frames: int
    sentences: tuple[str, ...]
    warnings: tuple[str, ...]
    paths: Mapping[str, Path]
    cot_sent: int | None
    report: Mapping[str, Any]


def correct_telemetry(
    site_folder: AnyPath,
    folder: AnyPath,
    *,
    flight: str = "",
    source: AnyPath | None = None,
    telemetry: str | None = None,
    camera: str | None = None,
    cot: CotReceiver | None = None,
    watched: AnyPath | None = None,
) -> TelemetryOutcome:
    """Write a flight's corrected telemetry into `folder`.

    Without `flight` it is the site's only one, or that of `source`. With `source`, the flight's video or photos, its
    own telemetry is compared with the map, and a video is written again as a transport stream with corrected metadata,
    and with the detections of `watched`, the folder of a watch of this video.
    The events of cot.xml, with their own times, are sent to `cot`. Raises InputError for a site without
    GPS, a flight that it has not, a source of another flight or without a fix at any of its frames, a folder that has
    another flight's files, a receiver that takes nothing or would get events without a date, and without `source` for a
    folder with a diagnosis, which would be lost.
    """
    site_folder = Path(site_folder)
    folder = Path(folder)
    source = as_path(source)
    with Archive.open(site_folder, write=False) as archive:
        site = archive.site()
        if site.is_local:
            raise InputError(
                f"{site_folder} was mapped without GPS: its cameras have no place on Earth to write down; map the "
                "flight into another folder with its log (`sorvolo map --telemetry FILE`)"
            )
        if source is None:
            name = _flight(archive, flight)
            _check_folder(folder, name, site)
            if _earlier(folder).get("faults"):
                raise InputError(
                    f"{folder} has the diagnosis of {name} and files corrected by it, which files of the map alone "
                    "would replace: use those, give the flight's video or photos with --site for new ones, or another "
                    "folder with --out"
                )
            return _written(
                site, name, folder, _solved(archive, name, 0), None, archive.report(name), cot
            )
        with opened_sources([source], telemetry, camera) as sources:
            opened = sources[0]
            name = _flight(archive, flight or opened.name)
            mapped = archive.report(name)
            # a live source has no file that it could be recognised by
            if _mapped(archive)[name] != opened.fingerprint and not mapped.get("delay_s"):
                first = next(iter(mapped.get("inputs") or ()), "another file")
                if first == opened.inputs[0]:
                    first = "another file of that name"
                raise InputError(
                    f"{source} is of another flight: {name} of {archive.folder} was mapped from {first}. Give that, or leave "
                    "--flight out for a flight of its own"
                )
            _check_folder(folder, name, site)
            seen = None if watched is None else _detections(Path(watched), opened)
            asked = MapSettings(offset_s=_clock(mapped)[1])
            setup = prepare(opened, asked, site, telemetry_named=telemetry is not None)
            solved = _solved(archive, name, _first_ns(setup))
            solved, compared = _compared(setup, solved, mapped)
            return _written(site, name, folder, solved, compared, mapped, cot, seen)


def mapped_flights(site_folder: Path) -> dict[str, str]:
    """The fingerprint of each flight that the site has frames of, by name; none where there is no site yet."""
    if not is_site(site_folder):
        return {}
    with Archive.open(site_folder, write=False) as archive:
        return _mapped(archive)


def chosen_flight(site_folder: Path, wanted: str = "") -> str:
    """The site's flight of this name, without one its only flight. Raises InputError where there is no such one."""
    with Archive.open(site_folder, write=False) as archive:
        return _flight(archive, wanted)


def _mapped(archive: Archive) -> dict[str, str]:
    return {each.id: each.fingerprint for each in archive.flights() if archive.keyframes(each.id)}


def _flight(archive: Archive, wanted: str) -> str:
    known = [*_mapped(archive)]
    if not known:
        raise InputError(
            f"{archive.folder} has no mapped flight: map one first, or give its video with --site"
        )
    if wanted and wanted not in known:
        raise InputError(
            f"{archive.folder} has no flight {wanted!r}, only {', '.join(known)}: choose one of these, or map it first"
        )
    if not wanted and len(known) != 1:
        raise InputError(
            f"{archive.folder} has the flights {', '.join(known)}; choose one with --flight"
        )
    return wanted or known[0]


def _earlier(folder: Path) -> dict[str, Any]:
    """The report whose files the folder has; empty where it has none."""
    try:
        report = json.loads((folder / _REPORT).read_bytes())
    except (OSError, ValueError):
        return {}
    return report if isinstance(report, dict) else {}


def _check_folder(folder: Path, name: str, site: Site) -> None:
    """Raise InputError for a folder that has the files of another flight: some would be replaced, and some stay."""
    earlier = _earlier(folder)
    if earlier and (earlier.get("flight"), earlier.get("site")) != (name, site.name):
        raise InputError(
            f"{folder} has the telemetry of {earlier.get('flight')} of {earlier.get('site')}, not of {name} of "
            f"{site.name}: give another folder with --out, or delete that one"
        )


def _first_ns(setup: FlightSetup) -> int:
    """The UTC of the flight's first frame, from which its seconds count."""
    return setup.utc_ns(setup.source.start_ns)


def _solved(archive: Archive, name: str, first_ns: int) -> list[_Solved]:
    stored = [each for each in archive.keyframes(name) if each.status is not Status.REJECTED]
    begin_ns = first_ns or min((each.time_ns for each in stored), default=0)
    solved = [
        _Solved(
            each.name,
            each.index,
            each.time_ns,
            each.camera,
            each.site_from_camera,
            (each.time_ns - begin_ns) / 1e9,
            each.sigma_m,
            each.status.value,
        )
        for each in stored
        if each.site_from_camera is not None
    ]
    if not solved:
        raise InputError(f"no frame of {name} has a camera in space; map it with --method planar")
    return sorted(solved, key=lambda each: each.seconds)


def _compared(
    setup: FlightSetup, solved: Sequence[_Solved], report: Mapping[str, Any]
) -> tuple[list[_Solved], _Compared]:
    """The cameras in the fixes' own scale and direction, by telemetry where the map is doubtful; and what was wrong
    with the telemetry by the frames that pictures placed."""
    track = setup.telemetry
    seen = [number for number, each in enumerate(solved) if each.status == Status.VISION]
    if not seen:
        raise InputError(
            "no frame of the flight was placed by its pictures, so that telemetry has nothing to be compared with: "
            "leave the video out, and files are written by the map alone"
        )
    first = setup.source.inputs[0]
    if track is None:
        raise InputError(
            f"{first}: no telemetry with positions was found in it or beside it; give it as --telemetry"
        )
    clock, _, applied_s = _clock(report)
    priors = track.priors([solved[k].seconds for k in seen], applied_s, setup.plan.smooth_s)
    if not any(each.knows_place for each in priors):
        raise InputError(
            f"{first}: at none of the {counted(len(seen), 'frame')} that their pictures placed its telemetry has a "
            "position: check that the log is of this flight, or give another one with --telemetry"
        )
    sigma_s = clock.sigma if isfinite(clock.sigma) else track.clock.sigma_s
    # a base map or control points may hold the map's scale and direction
    points = (report.get("control") or {}).get("points", [])
    held = sum(each["role"] == ControlRole.CONTROL for each in points) >= _HOLDING
    path = (
        AS_THE_MAP
        if held or report.get("base")
        else path_fit(priors, [solved[k].pose for k in seen], sigma_s)
    )
    poses = fitted([each.pose for each in solved], path)
    faults = telemetry_faults(
        priors, [poses[k] for k in seen], clock, path, knows_height=track.knows_ground
    )
    compared = _Compared(setup, track, applied_s, faults, [solved[k].name for k in seen])
    moved = [replace(each, pose=pose) for each, pose in zip(solved, poses)]
    for row, apart_m in zip(faults.apart, faults.apart_m):
        moved[seen[row]] = replace(
            moved[seen[row]], sigma_m=max(apart_m, solved[seen[row]].sigma_m)
        )
    return _without_misplaced(moved, [seen[row] for row in faults.misplaced], compared), compared


def _without_misplaced(
    solved: Sequence[_Solved], misplaced: Sequence[int], compared: _Compared
) -> list[_Solved]:
    """The frames, those where the map is doubtful placed by telemetry between the others, as KLV is."""
    if not misplaced:
        return list(solved)
    kept = [each for number, each in enumerate(solved) if number not in misplaced]
    doubted = [solved[number] for number in misplaced]
    poses = _between([each.seconds for each in doubted], kept, compared)
    scatter_m = compared.faults.position_m.scatter
    laid = [
        replace(each, pose=pose, sigma_m=hypot(each.sigma_m, scatter_m), status=_INTERPOLATED)
        for each, pose in zip(doubted, poses)
    ]
    return sorted([*kept, *laid], key=lambda each: each.seconds)


def _between(
    times_s: Sequence[float], solved: Sequence[_Solved], compared: _Compared
) -> list[Pose]:
    """The cameras at any moments, by telemetry as the solved frames correct it."""
    smooth_s, key_s = compared.setup.plan.smooth_s, [each.seconds for each in solved]
    priors, key_priors = (
        compared.track.priors(each, compared.applied_s, smooth_s) for each in (times_s, key_s)
    )
    return corrected_poses(times_s, priors, key_s, key_priors, [each.pose for each in solved])


def _clock(report: Mapping[str, Any]) -> tuple[Bias, float | None, float]:
    """The clock offset that the map found, the one that it was given (None: none), and the one that it applied beyond
    that, s."""
    offset = report.get("time_offset") or {}
    value, sigma = (
        nan if offset.get(key) is None else float(offset[key]) for key in ("estimate_s", "sigma_s")
    )
    applied_s = float(offset.get("applied_s") or 0.0)
    if offset.get("origin") == "given":
        return Bias(value, sigma), applied_s, 0.0
    return Bias(value, sigma), None, applied_s


def _written(
    site: Site,
    name: str,
    folder: Path,
    solved: Sequence[_Solved],
    compared: _Compared | None,
    mapped: Mapping[str, Any],
    cot: CotReceiver | None,
    seen: Mapping[int, Sequence[VmtiTarget]] | None = None,
) -> TelemetryOutcome:
    """Write all files; `seen` are the detections by the index of their frame."""
    frames = [_frame(each, site) for each in solved]
    texts = {
        "geo.txt": geo_txt(frames).encode(),
        "track.csv": track_csv(frames, site.height_reference).encode(),
        "track.gpx": track_gpx(frames, name),
    }
    if is_dated(frames):
        texts["cot.xml"] = cot_track(
            frames, name, is_ellipsoidal=site.height_reference == "ellipsoidal"
        )
    elif cot is not None:
        raise InputError(
            f"the date of {name} is not known, and Cursor on Target events need one: map the flight with a log that "
            "has a date (`sorvolo map --telemetry FILE`), or leave --cot out"
        )
    make_folder(folder)
    if "cot.xml" not in texts:
        (folder / "cot.xml").unlink(missing_ok=True)  # an earlier version's, with invented dates
    for file, text in texts.items():
        atomic_write_bytes(folder / file, text)
    files, sentences = [*texts], [_UNDIAGNOSED]
    if compared is not None:
        sentences = fault_sentences(compared.faults, compared.names)
    video = None if compared is None else _video(compared.setup.source)
    if compared is not None and video is not None:
        with atomic_path(folder / f"{name}.ts") as temporary:
            # between two keyframes the frames follow each other evenly
            index, seconds = zip(*((each.index, each.seconds) for each in solved))
            shown = {
                float(np.interp(number, index, seconds)): targets
                for number, targets in (seen or {}).items()
                if index[0] <= number <= index[-1]
            }
            samples = _samples(compared, solved, site, shown)
            mux_klv(video, temporary, *samples, site.height_reference, shown)
            if seen is not None:
                taken, found = (sum(map(len, each.values())) for each in (shown, seen))
                words = f"{taken} of {counted(found, 'detection')} are in {name}.ts as VMTI"
                rest = "; the frames of the others lie before the map's first or after its last"
                sentences.append(words + rest * (taken < found))
        files.append(f"{name}.ts")
    report = dict(
        plain_json(
            {
                "flight": name,
                "site": site.name,
                "frames": len(frames),
                "height_reference": site.height_reference,
                "faults": None if compared is None else asdict(compared.faults),
                "sentences": sentences,
                "files": files,
                "warnings": _warnings(site, mapped, frames),
            }
        )
    )
    atomic_write_bytes(folder / _REPORT, json_bytes(report))
    sent = None if cot is None else send_all(texts["cot.xml"].splitlines(), cot.place, cot.tls)
    return TelemetryOutcome(
        name,
        folder,
        len(frames),
        tuple(report["sentences"]),
        tuple(report["warnings"]),
        {each: folder / each for each in files},
        sent,
        report,
    )


def _video(source: Source) -> Path | None:
    """The video file of a flight; None for photos, and for chapters, which are several files."""
    if not isinstance(source, VideoSource) or len(source.files) > 1:
        return None
    return source.info.path


def _detections(folder: Path, source: Source) -> dict[int, list[VmtiTarget]]:
    """What a watch of this source found, by the index of the frame. Raises InputError for another folder or source."""
    if not isinstance(source, VideoSource) or _video(source) is None or any(source.info.turn):
        raise InputError(
            f"{source.inputs[0]}: detections go into the KLV of one upright video, and this is photos, chapters or a "
            "turned video: leave --detections out"
        )
    known = find_watched(folder)
    if known != source.fingerprint:
        found = "the watch of another flight" if known else "no folder of `sorvolo watch`"
        raise InputError(
            f"{folder} is {found}: give the one of {source.inputs[0]}, or make it: sorvolo watch {source.inputs[0]}"
        )
    seen: dict[int, list[VmtiTarget]] = {}
    try:
        with (folder / LINES).open(encoding="utf-8") as lines:
            for number, line in enumerate(lines, _UNTRACKED):
                row = json.loads(line)
                place = (float(row.get(name, nan)) for name in ("latitude", "longitude"))
                others = seen.setdefault(int(row["frame"]), [])
                is_free = row["track"] not in (None, *(each.number for each in others))
                track = row["track"] if is_free else number  # a number stands once in a frame
                box_px = [*map(float, row["box_px"])]
                others.append(VmtiTarget(track, row["class"], float(row["score"]), box_px, *place))
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(
            f"{folder / LINES} is gone or damaged ({error!r}); watch the flight again"
        ) from error
    return seen


def _samples(
    compared: _Compared, solved: Sequence[_Solved], site: Site, also_s: Iterable[float]
) -> tuple[list[CorrectedFrame], list[float]]:
    """The corrected camera five times a second, and at these moments, by the telemetry between the solved frames; and the aircraft's
    headings, deg."""
    times_s = sorted({*even_times_s([each.seconds for each in solved], _KLV_STEP_S), *also_s})
    poses = _between(times_s, solved, compared)
    first_ns = _first_ns(compared.setup)
    stated_deg = compared.track.body_headings_deg(times_s, compared.applied_s)
    rows = [
        _frame(
            _Solved(
                "",
                number,
                first_ns + round(time_s * 1e9),
                solved[0].camera,
                pose,
                time_s,
                nan,
                _INTERPOLATED,
            ),
            site,
        )
        for number, (time_s, pose) in enumerate(zip(times_s, poses))
    ]
    return rows, headings_deg(stated_deg, compared.faults.heading_deg, times_s, poses)


def _frame(each: _Solved, site: Site) -> CorrectedFrame:
    pose = each.pose
    longitudes, latitudes = longitude_latitude(pose.translation_m[None], site)
    yaw_deg, pitch_deg, roll_deg = gimbal_angles_from_rotation(pose.rotation)
    up_m = float(pose.translation_m[2])
    across_deg, along_deg = each.camera.angle_of_view_deg
    return CorrectedFrame(
        each.name,
        each.index,
        each.time_ns,
        each.seconds,
        float(latitudes[0]),
        float(longitudes[0]),
        site.origin.height_m + up_m,
        up_m,
        yaw_deg,
        pitch_deg,
        roll_deg,
        each.sigma_m if isfinite(each.sigma_m) else nan,
        across_deg,
        along_deg,
        each.status,
    )


def _warnings(site: Site, mapped: Mapping[str, Any], frames: Sequence[CorrectedFrame]) -> list[str]:
    """The warnings about the map that all is measured by, and what the files leave out."""
    doubt = doubt_about(mapped)
    warnings = [doubt] if doubt else []
    warnings += [
        f"of the map: {each}" for each in mapped.get("warnings") or () if each not in doubt
    ]
    if site.height_reference not in ("ellipsoidal", "orthometric"):
        warnings.append(
            f"heights are {site.height_reference}: geo.txt, GPX and CSV hold them as such, and KLV and Cursor on "
            "Target leave the height out, since both want it above the ellipsoid or the sea"
        )
    if not is_dated(frames):
        warnings.append(
            "neither the frames nor the log have a date: GPX and CSV have no times, KLV counts from 1970, and cot.xml "
            "is not written, since its events need a date"
        )
    spaced = [each.name for each in frames if name_for_odm(each.name) != each.name]
    if spaced:
        warnings.append(
            f"geo.txt cannot hold names with spaces, which {counted(len(spaced), 'frame')} of {len(frames)} have: "
            f"OpenDroneMap finds {spaced[0]!r} once the photo is renamed {name_for_odm(spaced[0])!r}"
        )
    return warnings


_LEAST_TILT_DEG = 0.5  # a smaller one matters to nobody
_MOST_HEADING_DEG = 10.0  # within more than this "right" is no knowledge; by choice
_TOO_FEW = "too few frames have a fix"
_MOST_NAMED = 6  # frames in a sentence


def fault_sentences(faults: TelemetryFaults, names: Sequence[str]) -> list[str]:
    """One sentence for each quantity that telemetry states; `names` are those of the compared frames."""
    return [
        *_bias_words(
            faults.clock_s,
            (0.04, 1.0, 0.01),
            "the clocks cannot be compared: the motion does not show an offset",
            "whether the clocks agree cannot be known: the flight turns too little to show an offset",
            "the clocks agree within {:.2f} s",
            "the telemetry's clock was {value:.2f} s {side} the pictures (1 sigma {sigma:.2f} s)",
            ("ahead of", "behind"),
        ),
        *_bias_words(
            faults.heading_deg,
            (0.5, _MOST_HEADING_DEG, 0.1),
            "telemetry has no heading to compare",
            f"whether the compass was right cannot be known: {_why_unknown(faults.path)}",
            "the compass was right within {:.1f} deg",
            "the compass was {value:.1f} deg off, too far {side} (1 sigma {sigma:.1f} deg; scatter {scatter:.1f} deg)",
            ("clockwise", "counter-clockwise"),
        ),
        *_outlying(faults, names),
        *_misplaced(faults, names),
        *_tilt(faults.tilt_deg),
        *_bias_words(
            faults.height_m,
            (0.3, 10.0, 0.1),
            "telemetry has no height above the ground to compare",
            "whether heights above the ground were right cannot be known: "
            + (
                "the GPS track is too short for its scatter"
                if isfinite(faults.path.scale.value)
                else _TOO_FEW
            ),
            "heights above the ground were right within {:.1f} m",
            "heights above the ground were {value:.1f} m {side} (1 sigma {sigma:.1f} m)",
            ("too high", "too low"),
        ),
        *_map(faults.path),
        f"fixes scatter by {faults.position_m.scatter:.2f} m about the path in the pictures (1 sigma per axis)",
    ]


def _bias_words(
    found: Bias,
    limits: tuple[float, float, float],
    absent: str,
    unknown: str,
    right: str,
    wrong: str,
    sides: tuple[str, str],
) -> list[str]:
    """What a bias amounts to: not measured, not known, right within so much, or so far to one side.

    `limits`: smaller ones matter to nobody; within more than the second "right" would mislead, and the third is what
    the words resolve. One that surely is an error is known, however large its sigma.
    """
    least, most, step = limits
    if not isfinite(found.value):
        return [absent]
    is_sure = isfinite(found.sigma) and found.is_significant
    if not 2 * found.sigma <= most and not is_sure:
        return [unknown]
    if abs(found.value) < least or not found.is_significant:
        return [right.format(max(abs(found.value) + 2 * found.sigma, step))]
    side = sides[found.value < 0]
    return [
        wrong.format(value=abs(found.value), side=side, sigma=found.sigma, scatter=found.scatter)
    ]


def _why_unknown(path: PathFit) -> str:
    if not isfinite(path.turn_deg.value):
        return _TOO_FEW
    if 2 * path.turn_deg.sigma > _MOST_HEADING_DEG:
        return f"the GPS track is too short for its scatter (its direction: 1 sigma {path.turn_deg.sigma:.0f} deg)"
    return "the frames' angles disagree with each other"


def _map(path: PathFit) -> list[str]:
    """What the corrected files were changed by against the map."""
    found = []
    if path.sure_scale != 1:
        found.append(f"{1 / path.sure_scale:.2f} times as large as its GPS track")
    if path.sure_turn_deg:
        side = "clockwise" if path.sure_turn_deg > 0 else "counter-clockwise"
        found.append(
            f"turned by {abs(path.sure_turn_deg):.1f} deg {side} against {'it' if found else 'its GPS track'} (1 sigma "
            f"{path.turn_deg.sigma:.1f} deg)"
        )
    return (
        [f"the map is {' and '.join(found)}: the corrected cameras follow the track"]
        if found
        else []
    )


def _outlying(faults: TelemetryFaults, names: Sequence[str]) -> list[str]:
    if not faults.outlying:
        return []
    return [
        f"the stated angles of {counted(len(faults.outlying), 'frame')} of {len(names)} are far beside the others', by "
        f"{faults.outlying_deg:.0f} deg in the median, so that places by telemetry alone are wrong there: "
        f"{_named(faults.outlying, names)}"
    ]


def _misplaced(faults: TelemetryFaults, names: Sequence[str]) -> list[str]:
    """Where the map itself is doubtful."""
    found = []
    if faults.misplaced:
        found.append(
            f"the map is doubtful at {counted(len(faults.misplaced), 'frame')} of {len(names)}, where the log "
            f"contradicts both places (by {median(faults.misplaced_m):.1f} m in the median) and angles; the corrected "
            f"cameras follow the log there: {_named(faults.misplaced, names)}"
        )
    if faults.apart:
        found.append(
            f"at {counted(len(faults.apart), 'frame')} of {len(names)} the map or the log is wrong, "
            f"{median(faults.apart_m):.1f} m apart in the median; the corrected cameras follow the map, with that as "
            f"their accuracy: {_named(faults.apart, names)}"
        )
    return found


def _named(rows: Sequence[int], names: Sequence[str]) -> str:
    """Which frames these are, the first of them by name."""
    more = f" and {len(rows) - _MOST_NAMED} more" if len(rows) > _MOST_NAMED else ""
    return f"{', '.join(names[row] for row in rows[:_MOST_NAMED])}{more}"


def _tilt(found: Bias) -> list[str]:
    if not isfinite(found.value) or found.value < _LEAST_TILT_DEG or not found.is_significant:
        return []
    return [
        f"the camera looked {found.value:.1f} deg beside where telemetry puts it (1 sigma {found.sigma:.1f} deg)"
    ]
