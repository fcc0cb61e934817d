"""The flight report as one page of HTML that needs no other file, no network and no script."""

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from sorvolo.geometry.arrays import ImageRGBA
from sorvolo.store.pages.objects import OBJECTS_STYLE, objects_section
from sorvolo.store.pages.plots import (
    TrackColumns,
    gps_along,
    gps_scatter,
    residuals_along,
    round_length,
    track_plan,
)
from sorvolo.store.pages.report_style import STYLE
from sorvolo.store.pages.words import (
    area_words,
    at,
    bullet_list,
    escaped,
    finite_or_none,
    join_words,
    length_words,
    number_at,
    page_of,
    picture_uri,
    seconds_words,
    table_of,
    with_unit,
)
from sorvolo.survey.mosaic import Status

_TRACK_NUMBERS = (
    "east_m", "north_m", "up_m", "residual_px", "sigma_m", "gps_east_m", "gps_north_m", "gps_up_m",
)
_STATUS_WORDS = {
    Status.VISION: "placed by what it shows: it fits its neighbours",
    Status.GPS_ONLY: "fits no neighbour; placed where telemetry says, so its edges may be metres off",
    Status.REJECTED: "has no place in the map; the reason says why",
}
_STAGE_WORDS = {
    "undistort": "taking out the lens's distortion",
    "register": "finding where frames lie",
    "paint": "painting the map",
    "detect": "waiting for the detector, and placing what it saw",
    "store": "saving pictures and tiles",
    "report": "making this report",
}


def report_page(
    report: Mapping[str, Any], picture: ImageRGBA, object_crops: Mapping[str, bytes] = MappingProxyType({})
) -> str:
    """report.html of one flight: `report` as in report.json (docs/formats.md), `picture` the map, (H, W, 4).

    `object_crops` are the JPEG pictures of what stands there, by the objects' ids.
    What is None, NaN or missing in the report is shown as unknown or left out. All text is escaped.
    """
    track = _track(report)
    body = [
        _header(report),
        _warnings(report),
        _picture(report, picture),
        _key_figures(report),
        objects_section(report, object_crops),
        _frames(report),
        _plots(report, track),
        _camera_and_telemetry(report),
        _notices(report),
        _effort(report),
        _settings(report),
    ]
    title = f"{escaped(report.get('flight'))} - flight report"
    return page_of(title, STYLE + OBJECTS_STYLE, body)


def _header(report: Mapping[str, Any]) -> str:
    inputs = [escaped(each) for each in at(report, "inputs") or []]
    named = ", ".join(inputs[:3]) + (f" and {len(inputs) - 3} more" if len(inputs) > 3 else "")
    return (
        f'<header><p class="over">Flight <b>{escaped(report.get("flight"))}</b> on the site '
        f'<b>{escaped(report.get("site"))}</b>{": " + named if named else ""}</p>'
        f"<h1>{_headline(report)}</h1><p>{_second_sentence(report)}</p></header>"
    )


def _headline(report: Mapping[str, Any]) -> str:
    vision, blind, rejected = (_count(report, status) for status in Status)
    selected = int(at(report, "frames", "selected") or 0)
    place = ""
    if report.get("georeferenced"):
        area, gsd = area_words(number_at(report, "area_m2")), number_at(report, "ground_sampling_distance_m")
        place = f" of {area}" + (f" at {length_words(gsd)} a pixel" if gsd is not None else "")
    if report.get("comparison"):  # a later flight: its map is that of the flights before, brought up to date
        return f"{'All' if vision == selected else f'{vision} of'} {selected} views fit the map{place}."
    if not vision + blind:
        return f"None of {selected} selected frames could be placed: there is no map of this flight."
    if vision == selected:
        return f"All {selected} selected frames fit together and make a map{place}."
    how = f"{vision} by what they show" + (f", {blind} by GPS alone" if blind else "")
    lost = f"; {rejected} could not be placed" if rejected else ""
    return f"{vision + blind} of {selected} selected frames make a map{place}: {how}{lost}."


def _second_sentence(report: Mapping[str, Any]) -> str:
    if not report.get("georeferenced"):
        return (
            "The flight has no GPS: the map lies in a frame of its own, without metres and without north, "
            "and cannot be laid over other maps."
        )
    sigma, gps = number_at(report, "sigma_m"), number_at(report, "gps_residual_m", "median")
    parts = ["What changed is told in changes.html."] if report.get("comparison") else []
    if sigma is not None:
        parts.append(
            f"The map lies in its place to {length_words(sigma)} (one sigma), what all its GPS fixes may err in common "
            "included."
        )
    if gps is not None:
        parts.append(f"The cameras lie {length_words(gps)} from their GPS fixes (median).")
    return " ".join(parts)


def _warnings(report: Mapping[str, Any]) -> str:
    warnings = at(report, "warnings") or []
    if not warnings:
        return ""
    items = bullet_list(escaped(each) for each in warnings)
    return f'<section class="warn"><h2>Look at this first</h2>{items}</section>'


def _picture(report: Mapping[str, Any], picture: ImageRGBA) -> str:
    if not picture.size or not picture[..., 3].any():
        return ""
    height_px, width_px = picture.shape[:2]
    bar, caption = "", "The map. Grey was never seen."
    area_m2 = number_at(report, "area_m2")
    if report.get("georeferenced") and area_m2:
        caption = "The map, north up. Grey was never seen."
        # the report does not say how much the picture was shrunk, but what area its seen pixels cover
        width_m = math.sqrt(area_m2 / np.count_nonzero(picture[..., 3])) * width_px
        length_m = round_length(width_m / 4)
        bar = f'<div class="scale" style="width:{100 * length_m / width_m:.2f}%">{length_m:g} m</div>'
    return (
        f'<figure class="map"><div class="frame"><img src="{picture_uri(picture)}" width="{width_px}" '
        f'height="{height_px}" alt="The map">{bar}</div><figcaption>{caption}</figcaption></figure>'
    )


def _key_figures(report: Mapping[str, Any]) -> str:
    unit = _unit(report)
    cpu_s = number_at(report, "registration_cpu_s_per_keyframe")
    figures = [
        ("by vision", f"{_count(report, Status.VISION)} of {at(report, 'frames', 'selected') or 0}",
         f"frames selected from {at(report, 'frames', 'total') or 'an unknown number'}"),
        ("area", area_words(number_at(report, "area_m2")) if unit == "m" else None, "seen by at least one frame"),
        ("a pixel", length_words(number_at(report, "ground_sampling_distance_m")) if unit == "m" else None,
         "of the map on the ground; pictures: "
         + (length_words(number_at(report, "native_ground_sampling_distance_m")) or "unknown")),
        ("residual", with_unit("{:.2f} px", number_at(report, "residual_px", "median")),
         f"median misfit of a frame to {'the map' if report.get('comparison') else 'its neighbours'}; 95 % below "
         + (with_unit("{:.2f} px", number_at(report, "residual_px", "p95")) or "unknown")),
        ("GPS", length_words(number_at(report, "gps_residual_m", "median")) if unit == "m" else None,
         "median distance of cameras and fixes, level; rms "
         + (length_words(number_at(report, "gps_residual_m", "rms")) or "unknown")),
        ("in its place to", length_words(number_at(report, "sigma_m")) if unit == "m" else None,
         "one sigma, what all GPS fixes may err in common included"),
        ("flown at",
         with_unit("{:.1f} m", number_at(report, "height_above_ground_m")) if unit == "m" else None,
         "above the ground, median"),
        ("took", seconds_words(number_at(report, "seconds", "total")),
         (f"{1000 * cpu_s:.0f} ms CPU a frame to find its place" if cpu_s is not None else "in all")),
    ]
    tiles = "".join(
        f'<div><dt>{name}</dt><dd>{escaped(value)}</dd><p>{escaped(words)}</p></div>'
        for name, value, words in figures if value
    )
    return f'<dl class="figures">{tiles}</dl>'


def _frames(report: Mapping[str, Any]) -> str:
    selected = max(1, int(at(report, "frames", "selected") or 0))
    bar = "".join(
        f'<span class="{status}" style="width:{100 * _count(report, status) / selected:.2f}%"></span>'
        for status in Status
    )
    rows = [
        (f'<i class="key {status}"></i>{status}', str(_count(report, status)), words)
        for status, words in _STATUS_WORDS.items()
    ]
    reasons = at(report, "frames", "reasons") or {}
    why = ""
    if reasons:
        table = table_of([(str(count), escaped(reason)) for reason, count in reasons.items()], ("frames", "why"))
        why = f"<h3>Reasons and remarks</h3>{table}"
    return (
        f'<section><h2>What became of the frames</h2><div class="shares">{bar}</div>'
        f'{table_of(rows, ("status", "frames", "meaning"))}{why}</section>'
    )


def _plots(report: Mapping[str, Any], track: TrackColumns) -> str:
    if not len(track):
        return ""
    unit = _unit(report)
    plan = track_plan(track, unit=unit)
    scatter, along = gps_scatter(track, unit=unit), gps_along(track, unit=unit)
    key = " ".join(f'<i class="key {status}"></i>{status}' for status in Status) + "."
    tied = "Each camera is tied to its GPS fix (ring) by a grey line." if scatter else ""
    parts = []
    if plan:
        parts.append(
            f"<h2>The track</h2>{plan}<p class='note'>{key} {tied} The line follows the order of the flight."
            "</p>"
        )
    parts.append(
        f"<h2>How well frames fit their neighbours</h2>{residuals_along(track)}<p class='note'>{key} A frame "
        "that was not fitted to any other is drawn at zero. Small and even is good; a peak is where trees, "
        "houses or blur disturb.</p>"
    )
    if scatter:
        parts.append(
            f"<h2>The map against GPS</h2>{scatter}{along}<p class='note'>The "
            "camera's place in the map less its GPS fix. Points around zero are the receiver's noise, the "
            "dashed circle holds half of them; a slow swing is its drift, a saw-tooth from strip to strip a "
            "clock offset. Along the flight: "
            "<i class='key east'></i>east <i class='key north'></i>north <i class='key up'></i>up.</p>"
        )
    return f'<section>{"".join(parts)}</section>'


def _camera_and_telemetry(report: Mapping[str, Any]) -> str:
    camera, telemetry = at(report, "camera") or {}, at(report, "telemetry") or {}
    unit = _unit(report)
    found_sigma = number_at(report, "camera", "focal_found_sigma_relative")
    distortion = at(report, "camera", "distortion_k1_k2_p1_p2_k3") or []
    rows = [
        ("camera", camera.get("origin")),
        ("picture", f"{camera.get('width_px')} x {camera.get('height_px')} px"),
        ("focal length", join_words(
            with_unit("{:.1f} px", number_at(report, "camera", "focal_px")),
            _within(number_at(report, "camera", "focal_sigma_relative")),
        )),
        ("focal length found", join_words(
            with_unit("{:.1f} px", number_at(report, "camera", "focal_found_px")), _within(found_sigma)
        )),
        ("distortion k1 k2 p1 p2 k3", "  ".join(f"{each:.4g}" for each in distortion if each is not None)),
        ("distortion found besides",
         with_unit("{:+.4f} (radial)", number_at(report, "camera", "radial_found"))),
        ("telemetry",
         join_words(telemetry.get("format"), with_unit("with {:.0f} samples", telemetry.get("samples")))),
        ("tied to the frames by", telemetry.get("tie")),
        ("height from", telemetry.get("height")),
        ("attitude from", telemetry.get("attitude")),
        ("clock offset", _clock_offset(report)),
        ("altitude offset found", with_unit("{:+.2f} " + unit, number_at(report, "altitude_offset_m"))),
        ("relief seen", with_unit("{:.2f} " + unit, number_at(report, "relief_m"))),
        ("links between frames", join_words(
            with_unit("{:.0f} kept,", number_at(report, "links", "kept")),
            with_unit("{:.0f} dropped as false", number_at(report, "links", "dropped_as_false")),
        )),
        ("brightness differences left", with_unit("{:.1%}", number_at(report, "colour_spread"))),
    ]
    known = [(name, escaped(value)) for name, value in rows if value not in (None, "", "none")]
    return f"<section><h2>Camera, telemetry and clocks</h2>{table_of(known)}</section>"


def _clock_offset(report: Mapping[str, Any]) -> str:
    origin, applied = at(report, "time_offset", "origin"), number_at(report, "time_offset", "applied_s")
    estimate, sigma = number_at(report, "time_offset", "estimate_s"), number_at(report, "time_offset", "sigma_s")
    nothing = origin in (None, "none") or applied is None
    words = "none applied" if nothing else f"{applied:+.3f} s applied, {origin}"
    if estimate is not None:
        words += f"; motion shows {estimate:+.3f} s" + (f" \u00b1 {sigma:.3f} s" if sigma is not None else "")
    before, after = number_at(report, "time_offset", "rms_at_zero_m"), number_at(report, "time_offset", "rms_m")
    if before is not None and after is not None:
        words += f" (path against GPS: {before:.2f} m rms without it, {after:.2f} m with it)"
    return words


def _notices(report: Mapping[str, Any]) -> str:
    notices = at(report, "notices") or []
    if not notices:
        return ""
    rows = [(escaped(each.get("count")), escaped(each.get("text")), f"<code>{escaped(each.get('code'))}</code>")
            for each in notices]
    return (
        "<section><h2>Found, counted and survived</h2>"
        + table_of(rows, ("times", "what", "code")) + "</section>"
    )


def _effort(report: Mapping[str, Any]) -> str:
    wall, cpu = at(report, "seconds") or {}, at(report, "cpu_s") or {}
    stages = {name: finite_or_none(value) for name, value in wall.items() if name != "total"}
    total = finite_or_none(wall.get("total")) or 0.0
    spent = sum(each or 0.0 for each in stages.values())
    longest = max([total - spent, *(each or 0.0 for each in stages.values()), 1e-9])
    rows = [(_STAGE_WORDS.get(name, name), each, finite_or_none(cpu.get(name))) for name, each in stages.items()]
    if total > spent:
        rows.append(("reading frames, and the rest", total - spent, None))
    table = table_of(
        [
            (escaped(name), f'<div class="bar" style="width:{100 * (each or 0) / longest:.1f}%"></div>',
             seconds_words(each), seconds_words(cpu_s) if cpu_s is not None else "")
            for name, each, cpu_s in rows
        ],
        ("stage", "", "time", "CPU"),
    )
    sums = ", ".join(part for part in (
        f"{seconds_words(total)} in all",
        join_words(seconds_words(finite_or_none(cpu.get("total"))), "of CPU") if cpu.get("total") is not None else "",
        with_unit("at most {:.0f} MB of memory", number_at(report, "peak_memory_mb")) or "",
    ) if part)
    return f"<section><h2>Time and memory</h2>{table}<p class='note'>{escaped(sums)}</p></section>"


def _settings(report: Mapping[str, Any]) -> str:
    chosen = [(escaped(name), escaped("as the flight gives it" if value is None else value))
              for name, value in (at(report, "settings") or {}).items()]
    versions = {"sorvolo": report.get("sorvolo"), **(at(report, "versions") or {})}
    made = [(escaped(name), escaped(value)) for name, value in versions.items()]
    return (
        '<section><h2>Settings and versions</h2><div class="pair">'
        f'{table_of(chosen, ("setting", "value"))}{table_of(made, ("software", "version"))}</div></section>'
    )


def _track(report: Mapping[str, Any]) -> TrackColumns:
    rows = at(report, "track") or []
    unknown = float("nan")
    columns = {
        name: np.array([unknown if (number := finite_or_none(row.get(name))) is None else number for row in rows])
        for name in _TRACK_NUMBERS
    }
    return TrackColumns(
        tuple(str(row.get("frame")) for row in rows), tuple(str(row.get("status")) for row in rows), columns
    )


def _count(report: Mapping[str, Any], status: Status) -> int:
    return int(at(report, "frames", status.value) or 0)


def _unit(report: Mapping[str, Any]) -> str:
    return "m" if report.get("georeferenced") else "units"


def _within(sigma: float | None) -> str | None:
    return None if sigma is None else f"\u00b1 {100 * sigma:.2g} %" if sigma else "(kept as given)"
