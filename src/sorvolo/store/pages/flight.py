"""The flight report as one page of HTML that needs no other file, no network and no script."""

import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np
from markupsafe import Markup

from sorvolo.geometry.arrays import ImageRGBA
from sorvolo.store.exports.places import SYSTEMS, place_words
from sorvolo.store.pages.plots import (
    TrackColumns,
    gps_along,
    gps_scatter,
    residuals_along,
    round_length,
    track_plan,
)
from sorvolo.store.pages.words import (
    area_words,
    at,
    finite_or_none,
    join_words,
    jpeg_uri,
    known,
    length_words,
    number_at,
    picture_uri,
    plural,
    render,
    seconds_words,
    with_unit,
)
from sorvolo.survey.flight import Site
from sorvolo.survey.mosaic import Status

_TRACK_NUMBERS = (
    "east_m",
    "north_m",
    "up_m",
    "residual_px",
    "sigma_m",
    "gps_east_m",
    "gps_north_m",
    "gps_up_m",
)
_STATUS_WORDS = {
    Status.VISION: ("matched", "its picture matches its neighbours"),
    Status.GPS_ONLY: (
        "GPS only",
        "matches no neighbour; placed by telemetry alone, so its edges may be metres off",
    ),
    Status.REJECTED: ("not placed", "has no place in the map; see the reasons"),
}
_ROLE_WORDS = {
    "control": "ties the map",
    "check": "check point",
    "excluded": "left out: contradicts the others",
    "unseen": "in no frame that has a place",
}
_STAGE_WORDS = {
    "undistort": "removing the lens's distortion",
    "register": "matching frames",
    "compare": "comparing views with the map",
    "evidence": "gathering evidence over views",
    "heights": "measuring heights",
    "paint": "painting the map",
    "detect": "waiting for the detector, and placing its detections",
    "store": "saving pictures and tiles",
    "report": "making this report",
}


def report_page(
    report: Mapping[str, Any],
    picture: ImageRGBA,
    object_crops: Mapping[str, bytes] = MappingProxyType({}),
    site: Site | None = None,
) -> str:
    """report.html of one flight: `report` as in report.json (docs/formats.md), `picture` the map, (H, W, 4).

    `object_crops` are the JPEG pictures of the objects, by their ids; `site` gives them coordinates. What is None, NaN
    or missing in the report is shown as unknown or left out. All text is escaped.
    """
    total, cpu_s = number_at(report, "seconds", "total"), number_at(report, "cpu_s", "total")
    parts = [
        None if total is None else f"{seconds_words(total)} in all",
        None if cpu_s is None else f"{seconds_words(cpu_s)} of processor time",
        with_unit("at most {:.0f} MB of memory", number_at(report, "peak_memory_mb")),
        _reading(report),
    ]
    page = render(
        "flight.html",
        title=f"{report.get('flight')} - flight report",
        flight=known(report.get("flight")),
        site=known(report.get("site")),
        inputs=_inputs(report),
        headline=_headline(report),
        summary=_summary(report),
        is_comparison=bool(report.get("comparison")),
        warning_lines=at(report, "warnings") or [],
        picture=_picture(report, picture),
        figures=_key_figures(report),
        control=_control(report),
        objects=objects_section(report, object_crops, site),
        statuses=_statuses(report),
        reasons=[
            (count, reason) for reason, count in (at(report, "frames", "reasons") or {}).items()
        ],
        plots=_plots(report),
        camera_rows=_camera_and_telemetry(report),
        notices=[
            (known(each.get("count")), known(each.get("text")), known(each.get("code")))
            for each in at(report, "notices") or []
        ],
        stages=_stages(report),
        effort=", ".join(part for part in parts if part),
        settings=[
            (name, _setting_words(value)) for name, value in (at(report, "settings") or {}).items()
        ],
        versions=list(
            {"sorvolo": known(report.get("sorvolo")), **(at(report, "versions") or {})}.items()
        ),
    )
    return str(page)


def _setting_words(value: Any) -> str:
    """What was wished for, as a person reads it."""
    if value is None:
        return "chosen from the flight"
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {_setting_words(each)}" for name, each in value.items())
    if isinstance(value, Sequence) and not isinstance(value, str):
        return ", ".join(map(_setting_words, value)) or "none"
    return str(value)


def _inputs(report: Mapping[str, Any]) -> str:
    inputs = [str(each) for each in at(report, "inputs") or []]
    return ", ".join(inputs[:3]) + (f" and {len(inputs) - 3} more" if len(inputs) > 3 else "")


def _headline(report: Mapping[str, Any]) -> str:
    vision, blind, rejected = (_count(report, status) for status in Status)
    selected = int(at(report, "frames", "selected") or 0)
    ground = _ground(report)
    if report.get("comparison"):  # a later flight: its map is that of the flights before, updated
        return f"{vision} of {selected} frames matched the map{ground}."
    if not vision + blind:
        return f"None of {selected} frames could be placed: there is no map of this flight."
    if at(report, "headline", "quality") not in (None, "map"):
        text = str(at(report, "headline", "text"))
        return f"{text[:1].upper()}{text[1:]}."
    counts = f"{vision} of {selected} frames matched"
    more = f", {blind} placed by GPS only" if blind else ""
    lost = f", {rejected} not placed" if rejected else ""
    return f"{counts}{more}{lost}: a map{ground}."


def _ground(report: Mapping[str, Any]) -> str:
    """The map's area and ground resolution; "" without GPS."""
    if not report.get("georeferenced"):
        return ""
    gsd_m = number_at(report, "ground_sampling_distance_m")
    resolution = (
        f" at a ground resolution of {length_words(gsd_m)} per pixel" if gsd_m is not None else ""
    )
    return f" of {area_words(number_at(report, 'area_m2'))}{resolution}"


def _summary(report: Mapping[str, Any]) -> str:
    if not report.get("georeferenced"):
        return (
            "The flight has no GPS: the map has a frame of its own, without metres and without north. It cannot be "
            "laid over other maps, and no file with coordinates is written."
        )
    sigma_m, gps_m = number_at(report, "sigma_m"), number_at(report, "gps_residual_m", "median")
    why = str(at(report, "shape", "why") or "")
    sentences = [f"{why[:1].upper()}{why[1:]}."] if why else []
    if sigma_m is not None:
        sources = "control points" if report.get("control") else "GPS fixes"
        sources = "places on the base map" if report.get("base") else sources
        sentences.append(
            f"Position accuracy {length_words(sigma_m)} (1 sigma, including the error shared by all {sources})."
        )
    if gps_m is not None:
        sentences.append(f"The cameras are {length_words(gps_m)} from their GPS fixes (median).")
    return " ".join(sentences)


def _picture(report: Mapping[str, Any], picture: ImageRGBA) -> dict[str, Any] | None:
    if not picture.size or not picture[..., 3].any():
        return None
    height_px, width_px = picture.shape[:2]
    shown = {
        "address": picture_uri(picture),
        "width": width_px,
        "height": height_px,
        "bar_share": 0.0,
        "bar_words": "",
        "caption": "The map. Grey ground was never photographed.",
    }
    area_m2 = number_at(report, "area_m2")
    if report.get("georeferenced") and area_m2:
        # the report does not hold how much the picture was shrunk, but what area its seen pixels cover
        width_m = math.sqrt(area_m2 / np.count_nonzero(picture[..., 3])) * width_px
        length_m = round_length(width_m / 4)
        shown |= {
            "bar_share": length_m / width_m,
            "bar_words": f"{length_m:g} m",
            "caption": "The map, north up. Grey ground was never photographed.",
        }
    return shown


def _key_figures(report: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    cpu_s = number_at(report, "registration_cpu_s_per_keyframe")
    p95 = with_unit("{:.2f} px", number_at(report, "residual_px", "p95")) or "unknown"
    other = "the map" if report.get("comparison") else "its neighbours"
    total = at(report, "frames", "total")
    figures = [
        (
            "frames matched",
            f"{_count(report, Status.VISION)} of {at(report, 'frames', 'selected') or 0}",
            f"selected from {'an unknown number' if total is None else plural(total, 'frame')}",
        ),
        *(_metric_figures(report) if report.get("georeferenced") else []),
        (
            "misalignment",
            with_unit("{:.2f} px", number_at(report, "residual_px", "median")),
            f"median distance between a frame and {other}; 95 % are below {p95}",
        ),
        (
            "time taken",
            seconds_words(number_at(report, "seconds", "total")),
            f"{1000 * cpu_s:.0f} ms of processor time to match a frame"
            if cpu_s is not None
            else "in all",
        ),
    ]
    return [(name, value, words) for name, value, words in figures if value]


def _metric_figures(report: Mapping[str, Any]) -> list[tuple[str, str | None, str]]:
    """The figures that only a flight with GPS has."""
    native = length_words(number_at(report, "native_ground_sampling_distance_m")) or "unknown"
    rms = length_words(number_at(report, "gps_residual_m", "rms")) or "unknown"
    return [
        ("area", area_words(number_at(report, "area_m2")), "seen by at least one frame"),
        (
            "ground resolution",
            length_words(number_at(report, "ground_sampling_distance_m")),
            f"per pixel of the map; of the frames {native}",
        ),
        (
            "position accuracy",
            length_words(number_at(report, "sigma_m")),
            "1 sigma: two of three such maps lie closer to their true position; includes the error shared by all fixes",
        ),
        (
            "distance to GPS",
            length_words(number_at(report, "gps_residual_m", "median")),
            f"median, horizontal, of cameras and their fixes; root mean square {rms}",
        ),
        (
            "flight height",
            with_unit("{:.1f} m", number_at(report, "height_above_ground_m")),
            "above the ground, median",
        ),
    ]


def _control(report: Mapping[str, Any]) -> dict[str, Any] | None:
    """The table of control points, and its sentences."""
    control = at(report, "control")
    if not control:
        return None
    sentences = [
        f"{name} points: {number:.3f} m (root mean square)"
        for name, key in (("Control", "control_rms_m"), ("Check", "check_rms_m"))
        if (number := number_at(report, "control", key)) is not None
    ]
    rows = [
        (
            known(each.get("label")),
            _ROLE_WORDS.get(str(each.get("role")), known(each.get("role"))),
            each.get("marks"),
            *(_signed_m(each.get(name)) for name in ("east_m", "north_m")),
            with_unit("{:.3f}", finite_or_none(each.get("distance_m"))) or "",
        )
        for each in control.get("points") or []
    ]
    source = f"From {known(control.get('file'))}, {known(control.get('crs'))}"
    return {"words": ". ".join([source, *sentences]) + ".", "rows": rows}


def _signed_m(value: Any) -> str:
    return with_unit("{:+.3f}", finite_or_none(value)) or ""


def _statuses(report: Mapping[str, Any]) -> list[dict[str, Any]]:
    selected = max(1, int(at(report, "frames", "selected") or 0))
    return [
        {
            "name": status.value,
            "words": words,
            "meaning": meaning,
            "count": _count(report, status),
            "share": _count(report, status) / selected,
        }
        for status, (words, meaning) in _STATUS_WORDS.items()
    ]


def _plots(report: Mapping[str, Any]) -> dict[str, str]:
    track = _track(report)
    if not len(track):
        return {"plan": "", "residuals": "", "scatter": "", "along": ""}
    unit = "m" if report.get("georeferenced") else ""
    return {
        "plan": track_plan(track, unit=unit),
        "residuals": residuals_along(track),
        "scatter": gps_scatter(track, unit=unit),
        "along": gps_along(track, unit=unit),
    }


def _camera_and_telemetry(report: Mapping[str, Any]) -> list[tuple[str, str]]:
    camera, telemetry = at(report, "camera") or {}, at(report, "telemetry") or {}
    distortion = at(report, "camera", "distortion_k1_k2_p1_p2_k3") or []
    rows = [
        ("camera", camera.get("origin")),
        (
            "picture",
            f"{camera['width_px']} x {camera['height_px']} px" if camera.get("width_px") else None,
        ),
        (
            "focal length",
            join_words(
                with_unit("{:.1f} px", number_at(report, "camera", "focal_px")),
                _within(number_at(report, "camera", "focal_sigma_relative")),
            ),
        ),
        (
            "focal length estimated",
            join_words(
                with_unit("{:.1f} px", number_at(report, "camera", "focal_found_px")),
                _within(number_at(report, "camera", "focal_found_sigma_relative")),
            ),
        ),
        (
            "distortion k1 k2 p1 p2 k3",
            "  ".join(f"{each:.4g}" for each in distortion if each is not None),
        ),
        (
            "further distortion estimated",
            with_unit("{:+.4f} (radial)", number_at(report, "camera", "radial_found")),
        ),
        (
            "telemetry",
            join_words(
                telemetry.get("format"), with_unit("with {:.0f} samples", telemetry.get("samples"))
            ),
        ),
        ("tied to the frames by", telemetry.get("tie")),
        ("height from", telemetry.get("height")),
        ("attitude from", telemetry.get("attitude")),
        ("clock offset", _clock_offset(report)),
        *_estimates(report),
    ]
    return [(name, str(value)) for name, value in rows if value not in (None, "", "none")]


def _estimates(report: Mapping[str, Any]) -> list[tuple[str, str | None]]:
    """What the map's adjustment found besides the frames' positions."""
    kept, dropped = (
        number_at(report, "links", "kept"),
        number_at(report, "links", "dropped_as_false"),
    )
    false = "" if dropped is None else f", {dropped:.0f} dropped as false"
    pairs = None if kept is None else f"{kept:.0f} kept{false}"
    metric = [
        (
            "altitude offset estimated",
            with_unit("{:+.2f} m", number_at(report, "altitude_offset_m")),
        ),
        ("relief of the ground", with_unit("{:.2f} m", number_at(report, "relief_m"))),
    ]
    return [
        *(metric if report.get("georeferenced") else []),
        ("matched pairs of frames", pairs),
        ("brightness differences left", with_unit("{:.1%}", number_at(report, "colour_spread"))),
    ]


def _clock_offset(report: Mapping[str, Any]) -> str:
    origin, applied = (
        at(report, "time_offset", "origin"),
        number_at(report, "time_offset", "applied_s"),
    )
    estimate, sigma = (
        number_at(report, "time_offset", "estimate_s"),
        number_at(report, "time_offset", "sigma_s"),
    )
    nothing = origin in (None, "none") or applied is None
    words = "none applied" if nothing else f"{applied:+.3f} s applied, {origin}"
    if estimate is not None:
        words += f"; estimated from motion: {estimate:+.3f} s" + (
            f" \u00b1 {sigma:.3f} s" if sigma is not None else ""
        )
    before, after = (
        number_at(report, "time_offset", "rms_at_zero_m"),
        number_at(report, "time_offset", "rms_m"),
    )
    if before is not None and after is not None:
        words += (
            f" (path against GPS: {before:.2f} m rms without the offset, {after:.2f} m with it)"
        )
    return words


def _stages(report: Mapping[str, Any]) -> list[dict[str, Any]]:
    """What each stage took, and the rest."""
    # Name, seconds, and seconds of processor time where known, of each stage and of the rest.
    wall, cpu = at(report, "seconds") or {}, at(report, "cpu_s") or {}
    stages = {name: finite_or_none(value) or 0.0 for name, value in wall.items() if name != "total"}
    rest = (finite_or_none(wall.get("total")) or 0.0) - sum(stages.values())
    rows = [
        (_STAGE_WORDS.get(name, name), value, finite_or_none(cpu.get(name)))
        for name, value in stages.items()
    ]
    if rest > 0:
        rows.append(("reading frames, and the rest", rest, None))
    longest = max([value for _, value, _ in rows] + [1e-9])
    return [
        {
            "name": name,
            "share": value / longest,
            "time": seconds_words(value),
            "cpu": "" if cpu_s is None else seconds_words(cpu_s),
        }
        for name, value, cpu_s in rows
    ]


def _reading(report: Mapping[str, Any]) -> str | None:
    """How much of a video was decoded."""
    decoded, skipped = (
        number_at(report, "reading", "decoded"),
        number_at(report, "reading", "skipped"),
    )
    if decoded is None or skipped is None:
        return None
    if why := at(report, "reading", "whole_because"):
        return f"{decoded:.0f} pictures of the video decoded ({why})"
    return f"{decoded:.0f} pictures of the video decoded and {skipped:.0f} skipped"


def _track(report: Mapping[str, Any]) -> TrackColumns:
    """The report's track; without GPS there is nothing that its positions could be compared with."""
    rows = at(report, "track") or []
    unknown = float("nan")
    has_gps = bool(report.get("georeferenced"))
    columns = {
        name: np.array(
            [
                unknown if (number := finite_or_none(row.get(name))) is None else number
                for row in rows
            ]
        )
        if has_gps or not name.startswith("gps_")
        else np.full(len(rows), unknown)
        for name in _TRACK_NUMBERS
    }
    return TrackColumns(
        tuple(str(row.get("frame")) for row in rows),
        tuple(str(row.get("status")) for row in rows),
        columns,
    )


def _count(report: Mapping[str, Any], status: Status) -> int:
    return int(at(report, "frames", status.value) or 0)


def _within(sigma: float | None) -> str | None:
    return None if sigma is None else f"\u00b1 {100 * sigma:.2g} %" if sigma else "(kept as given)"


_MOST_CROP_BYTES = 250_000  # of all pictures together: the page stays one that can be mailed
_MOST_ROWS = 200  # more belong into a table of their own: the page names the file


def objects_section(
    report: Mapping[str, Any], crops: Mapping[str, bytes], site: Site | None = None
) -> Markup:
    """The section on a flight's objects: `report` as in report.json, `crops` JPEG pictures by id.

    `site` gives the places their coordinates; without it they are metres east and north of the site's origin. Empty
    for a report without objects.
    """
    search = at(report, "objects")
    if not isinstance(search, Mapping):
        return Markup("")
    why_not = known(search.get("why_not")) if search.get("model") is None else None
    rows = at(search, "list") or []
    is_local = site.is_local if site is not None else not report.get("georeferenced", True)
    return render(
        "objects.html",
        why_not=why_not,
        words=_words(search),
        rows=_rows(rows[:_MOST_ROWS], crops, site),
        more=max(0, len(rows) - _MOST_ROWS),
        has_metres=not is_local,
        how=_how(search, is_local),
        systems=() if site is None or is_local else tuple(SYSTEMS.items()),
        file="objects.json" if is_local else "objects.geojson",
    )


def _words(search: Mapping[str, Any]) -> str:
    moving = int(number_at(search, "moving") or 0)
    moved = f"; {moving} of them moved" if moving else ""
    return f"{known(at(search, 'headline', 'text'))}{moved}."


def _how(search: Mapping[str, Any], is_local: bool) -> str:
    files = "objects.json" if is_local else "objects.geojson, objects.kml, objects.gpx"
    return (
        f"The model {known(search.get('model'))} searched {known(search.get('frames'))} frames and made "
        f"{plural(number_at(search, 'sightings') or 0, 'detection')}. {known(search.get('dropped'))} of them are left "
        "out: too few of the frames that show the place confirm them. The search took "
        f"{seconds_words(number_at(search, 'seconds'))}, beside the mapping. Files: {files}, and the pictures in "
        "objects/."
    )


def _rows(
    rows: list[Mapping[str, Any]], crops: Mapping[str, bytes], site: Site | None
) -> list[dict[str, Any]]:
    left, listed = _MOST_CROP_BYTES, []
    for row in rows:
        crop = crops.get(str(row.get("id")), b"")
        left -= len(crop)
        score, sigma_m = finite_or_none(row.get("score")), finite_or_none(row.get("sigma_m"))
        listed.append(
            {
                "crop": jpeg_uri(crop) if crop and left > 0 else "",
                "id": known(row.get("id")),
                "name": known(row.get("class")) + (", moving" if row.get("moving") else ""),
                "place": _place(row, site),
                "accuracy": "" if sigma_m is None else f"{sigma_m:.1f} m",
                "size": _size(row),
                "frames": f"{known(row.get('views'))} of {known(row.get('possible_views'))}",
                "score": "" if score is None else f"{score:.2f}",
            }
        )
    return listed


def _place(row: Mapping[str, Any], site: Site | None) -> list[tuple[str, str]]:
    east, north = finite_or_none(row.get("east_m")), finite_or_none(row.get("north_m"))
    if east is None or north is None:
        return []
    if site is None:
        return [("site", f"{east:+.1f}, {north:+.1f}")]
    return list(place_words(np.array([east, north]), site).items())


def _size(row: Mapping[str, Any]) -> str:
    length, width = finite_or_none(row.get("length_m")), finite_or_none(row.get("width_m"))
    return "" if length is None or width is None else f"{length:.1f} x {width:.1f} m"
