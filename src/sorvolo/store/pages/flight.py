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
    residuals_along,
    round_length,
    track_plan,
)
from sorvolo.store.pages.words import (
    at,
    finite_or_none,
    jpeg_uri,
    known,
    number_at,
    picture_uri,
    render,
    seconds_words,
    with_unit,
)
from sorvolo.survey.flight import Site

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
_ROLE_WORDS = {
    "control": "ties the map",
    "check": "check point",
    "excluded": "left out: contradicts the others",
    "unseen": "in no frame that has a place",
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
    # name, seconds, and seconds of processor time where known, of each stage and of the rest
    wall, cpu = at(report, "seconds") or {}, at(report, "cpu_s") or {}
    stages = {name: finite_or_none(value) or 0.0 for name, value in wall.items() if name != "total"}
    rest = (finite_or_none(wall.get("total")) or 0.0) - sum(stages.values())
    rows = [(name, value, finite_or_none(cpu.get(name))) for name, value in stages.items()]
    if rest > 0:
        rows.append(("reading frames, and the rest", rest, None))
    longest = max([value for _, value, _ in rows] + [1e-9])
    page = render(
        "flight.html",
        report,
        title=f"{report.get('flight')} - flight report",
        picture=_picture(report, picture),
        control=_control(report),
        objects=objects_section(report, object_crops, site),
        reasons=[
            (count, reason) for reason, count in (at(report, "frames", "reasons") or {}).items()
        ],
        plots=_plots(report),
        notices=[
            [known(each.get(name)) for name in ("count", "text", "code")]
            for each in at(report, "notices") or []
        ],
        stages=[
            {
                "name": name,
                "share": value / longest,
                "time": seconds_words(value),
                "cpu": "" if cpu_s is None else seconds_words(cpu_s),
            }
            for name, value, cpu_s in rows
        ],
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
            *(with_unit(each.get(name), "{:+.3f}") or "" for name in ("east_m", "north_m")),
            with_unit(each.get("distance_m"), "{:.3f}") or "",
        )
        for each in control.get("points") or []
    ]
    source = f"From {known(control.get('file'))}, {known(control.get('crs'))}"
    return {"words": ". ".join([source, *sentences]) + ".", "rows": rows}


def _plots(report: Mapping[str, Any]) -> dict[str, str]:
    # without GPS there is nothing that its positions could be compared with
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
    track = TrackColumns(
        tuple(str(row.get("frame")) for row in rows),
        tuple(str(row.get("status")) for row in rows),
        columns,
    )
    if not len(track):
        return {"plan": "", "residuals": "", "along": ""}
    unit = "m" if report.get("georeferenced") else ""
    return {
        "plan": track_plan(track, unit=unit),
        "residuals": residuals_along(track),
        "along": gps_along(track, unit=unit),
    }


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
    rows = at(search, "list") or []
    is_local = site.is_local if site is not None else not report.get("georeferenced", True)
    return render(
        "objects.html",
        search,
        rows=_rows(rows[:_MOST_ROWS], crops, site),
        more=max(0, len(rows) - _MOST_ROWS),
        has_metres=not is_local,
        systems=() if site is None or is_local else tuple(SYSTEMS.items()),
    )


def _rows(
    rows: list[Mapping[str, Any]], crops: Mapping[str, bytes], site: Site | None
) -> list[tuple[Mapping[str, Any], str, list[tuple[str, str]]]]:
    """Each object with its picture, "" for none, and its place in each notation."""
    left, listed = _MOST_CROP_BYTES, []
    for row in rows:
        crop = crops.get(str(row.get("id")), b"")
        left -= len(crop)
        listed.append((row, jpeg_uri(crop) if crop and left > 0 else "", _place(row, site)))
    return listed


def _place(row: Mapping[str, Any], site: Site | None) -> list[tuple[str, str]]:
    east, north = finite_or_none(row.get("east_m")), finite_or_none(row.get("north_m"))
    if east is None or north is None:
        return []
    if site is None:
        return [("site", f"{east:+.1f}, {north:+.1f}")]
    return list(place_words(np.array([east, north]), site).items())
