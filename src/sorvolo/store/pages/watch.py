"""A watch as one page of HTML: what was found, where, how sure, and how the watch itself went.

The page needs no other file, no network and no script.
"""

import base64
from collections import Counter
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np

from sorvolo.geometry.arrays import Floats
from sorvolo.store.pages.plots import round_length
from sorvolo.store.pages.report_style import STYLE
from sorvolo.store.pages.words import (
    at,
    bullet_list,
    escaped,
    finite_or_none,
    join_words,
    number_at,
    page_of,
    seconds_words,
    table_of,
    with_unit,
)
from sorvolo.survey.wording import counted_list

_WIDE_PX, _HIGH_PX, _RIM_PX = 940.0, 560.0, 36.0
_LETTER_PX, _LINE_PX = 7.5, 12.0  # of the map's labels
_ROWS = 3  # so many lines a label may lie from its dot
_CROPS_BYTES = 8_000_000  # of all crops in the page together
_Box = tuple[float, float, float, float]  # left, top, right, bottom
_COLOURS = ("#d9480f", "#1971c2", "#a61e77", "#2b8a3e", "#6741d9", "#b08900")
_WATCH_STYLE = """
.found{display:grid;grid-template-columns:repeat(auto-fill,minmax(170px,1fr));gap:16px}
.found figure{margin:0;border:1px solid var(--rule);border-radius:10px;overflow:hidden}
.found img{display:block;width:100%;height:150px;object-fit:contain;background:#222}
.found figcaption{margin:0;padding:8px 10px;font-size:.84rem;line-height:1.4}
.found b{color:var(--ink)}
svg .drone{fill:none;stroke:var(--soft);stroke-width:1.2;stroke-dasharray:5 4}
svg .way{fill:none;stroke-width:1.6}
"""


def watch_page(
    report: Mapping[str, Any], tracks: Sequence[Mapping[str, Any]], crops: Mapping[int, bytes], drone_m: Floats
) -> str:
    """report.html of one watch: `report` as in report.json, `tracks` the properties of tracks.geojson.

    `crops` are JPEG files by track, and `drone_m` (N, 2) the camera's places in site metres, none for a flight that
    nothing places. All text is escaped.
    """
    body = [
        _header(report, tracks),
        _warnings(report),
        *_maps(report, tracks, drone_m),
        _table(report, tracks),
        _crops(tracks, crops),
        _how_it_went(report),
        _model(report),
    ]
    return page_of(f"{escaped(report.get('flight'))} - watch", STYLE + _WATCH_STYLE, body)


def _header(report: Mapping[str, Any], tracks: Sequence[Mapping[str, Any]]) -> str:
    counts = Counter(str(each["class"]) for each in tracks)
    looked_for = ", ".join(at(report, "settings", "classes") or at(report, "model", "classes") or [])
    frames = at(report, "frames", "detected")
    return (
        f'<header><p class="over">Watch of <b>{escaped(report.get("flight"))}</b>, '
        f'{_when(report.get("first_frame"))} to {_when(report.get("last_frame"))}</p>'
        f"<h1>Found: {escape(counted_list(dict(counts.most_common())))}.</h1>"
        f"<p>{escaped(frames)} frames were searched for {escape(looked_for)}. Each object is counted once, however "
        "many frames and passes saw it. What no frame showed clearly, or nobody flew over, is not here.</p></header>"
    )


def _warnings(report: Mapping[str, Any]) -> str:
    warnings = [escaped(each) for each in report.get("warnings") or []]
    return f'<section class="warn"><h2>Look at this first</h2>{bullet_list(warnings)}</section>' if warnings else ""


def _maps(report: Mapping[str, Any], tracks: Sequence[Mapping[str, Any]], drone_m: Floats) -> list[str]:
    """One map, or one for each segment of a flight that was followed in the picture: their pixels are not the same."""
    segments = sorted({each.get("segment", 0) for each in tracks})
    if len(segments) < 2:
        return [_map(report, tracks, drone_m, "Where")]
    of_segments = {name: [each for each in tracks if each.get("segment", 0) == name] for name in segments}
    return [_map(report, of_one, drone_m, f"Where, segment {name}") for name, of_one in of_segments.items()]


def _map(
    report: Mapping[str, Any], tracks: Sequence[Mapping[str, Any]], drone_m: Floats, title: str
) -> str:
    """Objects and the camera's path seen from above; north is up, in a local frame the first frame's top."""
    is_local = not report.get("georeferenced")
    x_key, y_key = ("x_px", "y_px") if is_local else ("east_m", "north_m")
    places = np.array([[each[x_key], each[y_key]] for each in tracks], dtype=np.float64).reshape(-1, 2)
    path = drone_m[np.isfinite(drone_m).all(axis=1)] if len(drone_m) else np.zeros((0, 2))
    everything = np.vstack([places, path])
    if not len(everything):
        return ""
    up = -1.0 if is_local else 1.0  # pixels count downwards
    low, high = everything.min(axis=0), everything.max(axis=0)
    span = np.maximum(high - low, 1.0 if not is_local else 50.0)
    scale = float(min((_WIDE_PX - 2 * _RIM_PX) / span[0], (_HIGH_PX - 2 * _RIM_PX) / span[1]))
    height_px = float(span[1] * scale) + 2 * _RIM_PX

    def at_px(point: Floats) -> tuple[float, float]:
        x = _WIDE_PX / 2 + (point[0] - (low[0] + high[0]) / 2) * scale
        return float(x), float(height_px / 2 - up * (point[1] - (low[1] + high[1]) / 2) * scale)

    parts = []
    if len(path):
        thinned = path[:: max(1, len(path) // 1000)]
        line = " ".join(f"{x:.1f},{y:.1f}" for x, y in map(at_px, thinned))
        parts.append(f'<polyline class="drone" points="{line}"/>')
    classes = list(dict.fromkeys(str(each["class"]) for each in tracks))
    dots_px = [at_px(place) for place in places]
    for each, (x, y), label in zip(tracks, dots_px, _labels(dots_px, [str(each["id"]) for each in tracks])):
        colour = _colour(classes, each)
        radius = max(4.0, float(each.get("sigma_m") or 0.0) * scale)
        name = escape(f"{each['class']} {each['id']}")
        parts.append(
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius:.1f}" fill="{colour}" fill-opacity=".18"></circle>'
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4" fill="{colour}"><title>{name}</title></circle>'
            f"{label}"
        )
    unit = "px" if is_local else "m"
    bar = round_length(0.25 * (_WIDE_PX - 2 * _RIM_PX) / scale)
    parts.append(
        f'<path class="ink" d="M{_RIM_PX},{height_px - 10:.1f} h{bar * scale:.1f}"/>'
        f'<text class="label" x="{_RIM_PX + bar * scale + 6:.1f}" y="{height_px - 6:.1f}">{bar:g} {unit}</text>'
    )
    key = " ".join(
        f'<span class="key" style="background:{_COLOURS[k % len(_COLOURS)]}"></span>{escape(name)}'
        for k, name in enumerate(classes)
    )
    where = (
        "Pixels of the first frame, or the first after a cut, the camera's own motion taken out: nothing placed this "
        "flight on the ground."
        if is_local else "North is up; the dashed line is the camera's way. The pale discs are one sigma of the place."
    )
    return (
        f'<section><h2>{escape(title)}</h2><p>{key}</p><svg viewBox="0 0 {_WIDE_PX:.0f} {height_px:.0f}" role="img">'
        f"<title>Where the objects are</title>{''.join(parts)}</svg><p class=\"note\">{where}</p></section>"
    )


def _labels(dots_px: Sequence[tuple[float, float]], names: Sequence[str]) -> list[str]:
    """Each dot's name as SVG, beside it where no name or dot stands yet: right, left, above, below, or farther off."""
    taken = [(x - 4, y - 4, x + 4, y + 4) for x, y in dots_px]
    labels = []
    for (x, y), name in zip(dots_px, names):
        wide = _LETTER_PX * len(name)
        sides = [
            (x + dx, y + dy, x + dx + wide, y + dy + _LINE_PX)
            for row in range(_ROWS) for dx, dy in (
                (7.0, row * _LINE_PX - 6), (-7 - wide, row * _LINE_PX - 6),
                (-wide / 2, -(row + 1) * _LINE_PX - 6), (-wide / 2, row * _LINE_PX + 6),
            )
        ]
        place = next((each for each in sides if not any(_meet(each, other) for other in taken)), sides[0])
        taken.append(place)
        labels.append(f'<text class="label" x="{place[0]:.1f}" y="{place[3] - 2:.1f}">{escape(name)}</text>')
    return labels


def _meet(one: _Box, other: _Box) -> bool:
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]


def _table(report: Mapping[str, Any], tracks: Sequence[Mapping[str, Any]]) -> str:
    if not tracks:
        return ""
    is_local = not report.get("georeferenced")
    has_cuts = len({each.get("segment") for each in tracks}) > 1
    rows = []
    for each in tracks:
        if is_local:
            of_segment = f" in segment {each['segment']}" if has_cuts else ""
            place = f"{each['x_px']:.0f}, {each['y_px']:.0f} px{of_segment}"
        else:
            place = f"{each['latitude']:.6f}, {each['longitude']:.6f}"
        sigma = with_unit("{:.1f}" + (" px" if is_local else " m"), finite_or_none(each.get("sigma_m"))) or ""
        speed = each.get("velocity_m_s")
        motion = f"{np.hypot(*speed):.1f} {'px' if is_local else 'm'}/s" if speed else "stands"
        first, last = _when(each["first_seen"]), _when(each["last_seen"])
        cells = (
            escaped(each["id"]), escaped(each["class"]), f"{each['score']:.2f}", place, sigma, motion,
            f"{each['views']} in {each['passes']}", first, last if first[:10] != last[:10] else last[-8:],
        )
        rows.append(tuple(f'<span class="whole">{cell}</span>' for cell in cells))
    names = ("", "class", "score", "place", "within", "moves", "views in passes", "first seen", "last seen")
    return (
        f"<section><h2>All objects</h2>{table_of(rows, names)}<p class=\"note\">Within: one sigma of the place, per "
        "axis. Times are UTC, or from the source's start where it has no date. For other programs: tracks.geojson.</p>"
        "</section>"
    )


def _when(utc: object) -> str:
    """A time to read; what no clock dated counts from 1970 on, and so is told as the time since the start."""
    day, _, clock = str(utc or "")[:19].partition("T")
    return escaped(clock if day == "1970-01-01" else f"{day} {clock}".strip())


def _crops(tracks: Sequence[Mapping[str, Any]], crops: Mapping[int, bytes]) -> str:
    left, items = _CROPS_BYTES, []
    for each in tracks:
        data = crops.get(each["id"])
        if data is None or len(data) > left:
            continue
        left -= len(data)
        address = "data:image/jpeg;base64," + base64.b64encode(data).decode()
        name = escape(f"{each['class']} {each['id']}")
        items.append(
            f'<figure><img src="{address}" alt="{name}"><figcaption><b>{name}</b><br>score {each["score"]:.2f}, '
            f"frame {escaped(each['best_frame'])}</figcaption></figure>"
        )
    missing = len(tracks) - len(items)
    note = f'<p class="note">{missing} more have no picture here; see the folder objects.</p>' if missing else ""
    return f'<section><h2>Best views</h2><div class="found">{"".join(items)}</div>{note}</section>' if items else ""


def _how_it_went(report: Mapping[str, Any]) -> str:
    frames, seconds = report.get("frames") or {}, report.get("seconds") or {}
    total = number_at(report, "seconds", "total")
    rate = number_at(report, "frames_per_second")
    latency = report.get("latency_s") or {}
    missing = f"{escaped(at(report, 'detections', 'not_placed'))} without"
    unplaced = missing if report.get("georeferenced") else "none with"
    rows = [
        ("frames", join_words(
            f"{escaped(frames.get('detected'))} searched of {escaped(frames.get('read'))} read,",
            f"{escaped(frames.get('skipped'))} skipped to keep up,", f"{escaped(frames.get('lost'))} unusable",
        )),
        ("detections", join_words(
            f"{escaped(at(report, 'detections', 'total'))}, of which {unplaced} a place on the ground",
            f"and {short} set aside, far too short for their class" if (short := at(report, "detections", "set_aside"))
            else "",
        )),
        ("took", join_words(seconds_words(total), with_unit("({:.1f} frames a second)", rate))),
        ("of it", ", ".join(
            f"{escape(name)} {seconds_words(finite_or_none(value))}"
            for name, value in seconds.items() if name != "total"
        )),
        ("from frame to result", join_words(
            f"{seconds_words(finite_or_none(latency.get('median')))} (median),",
            f"{seconds_words(finite_or_none(latency.get('max')))} at most",
        )),
        ("height", escaped(at(report, "telemetry", "height"))),
        ("attitude", escaped(at(report, "telemetry", "attitude"))),
        ("camera", escaped(at(report, "camera", "origin"))),
        ("ended", escaped(report.get("ended"))),
    ]
    notices = bullet_list(escaped(each["text"]) for each in report.get("notices") or [])
    heading = "<h3>Found and survived</h3>" if report.get("notices") else ""
    return f"<section><h2>How it went</h2>{table_of(rows)}{heading}{notices if heading else ''}</section>"


def _model(report: Mapping[str, Any]) -> str:
    rows = [(escape(str(name)), escaped(_plain(value))) for name, value in (report.get("model") or {}).items()]
    versions = ", ".join(f"{name} {value}" for name, value in (report.get("versions") or {}).items())
    return (
        f"<section><h2>Model and versions</h2>{table_of(rows)}"
        f'<p class="note">Sorvolo {escaped(report.get("sorvolo"))}, {escape(versions)}</p></section>'
    )


def _plain(value: Any) -> Any:
    return ", ".join(map(str, value)) if isinstance(value, list | tuple) else value


def _colour(classes: Sequence[str], track: Mapping[str, Any]) -> str:
    return _COLOURS[classes.index(str(track["class"])) % len(_COLOURS)]
