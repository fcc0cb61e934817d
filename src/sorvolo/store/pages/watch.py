"""A watch as one page of HTML: what was found, where, how certain, and how the watch itself went.

The page needs no other file, no network and no script.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from markupsafe import Markup

from sorvolo.geometry.arrays import Floats
from sorvolo.store.exports.annotated import boxes_meet
from sorvolo.store.exports.places import SYSTEMS, degrees_words
from sorvolo.store.exports.plain import NO_PLACE_FILES
from sorvolo.store.pages.plots import round_length
from sorvolo.store.pages.words import (
    at,
    finite_or_none,
    join_words,
    jpeg_uri,
    known,
    number_at,
    render,
    seconds_words,
    with_unit,
)

_WIDE_PX, _HIGH_PX, _RIM_PX = 940.0, 560.0, 36.0
_LETTER_PX, _LINE_PX = 7.5, 12.0  # of the map's labels
_ROWS = 3  # so many lines a label may lie from its dot
_CROPS_BYTES = 8_000_000  # of all crops in the page together
_COLOURS = 6  # that the styles of pages have, c0 to c5
_FILES = "tracks.geojson, tracks.kml (Google Earth), tracks.gpx (GPS receivers)"
_LOCAL_FILES = "tracks.json, coordinates in pixels of the first picture. " + NO_PLACE_FILES
_FACTS = {
    "thresholds": "reported from a score of",
    "calibrated": "half are right at 0.5",
    "trained_on": "trained on",
}
_Track = Mapping[str, Any]


def watch_page(
    report: Mapping[str, Any], tracks: Sequence[_Track], crops: Mapping[int, bytes], drone_m: Floats
) -> str:
    """report.html of one watch: `report` as in report.json, `tracks` the properties of the list of tracks.

    `crops` are JPEG files by track, and `drone_m` (N, 2) the camera's places in site metres, none for a flight that
    nothing places. All text is escaped.
    """
    shown = _crops(tracks, crops)
    is_local = not report.get("georeferenced")
    page = render(
        "watch.html",
        title=f"{report.get('flight')} - watch",
        flight=known(report.get("flight")),
        first=_when(report.get("first_frame")),
        last=_when(report.get("last_frame")),
        headline=known(at(report, "headline", "text")),
        looked_for=", ".join(map(str, report.get("looked_for") or ["objects"])),
        warning_lines=report.get("warnings") or [],
        maps=_maps(report, tracks, drone_m),
        rows=_rows(tracks, is_local=is_local),
        systems=() if is_local else tuple(SYSTEMS.items()),
        files=_LOCAL_FILES if is_local else _FILES,
        crops=shown,
        without_crop=len(tracks) - len(shown),
        course=_course(report),
        notices=[str(each["text"]) for each in report.get("notices") or []],
        model=_model_rows(report.get("model") or {}),
        others=[_model_rows(each) for each in report.get("other_models") or []],
        versions=join_words(
            f"Sorvolo {known(report.get('sorvolo'))},",
            ", ".join(f"{name} {value}" for name, value in (report.get("versions") or {}).items()),
        ),
    )
    return str(page)


def _model_rows(facts: Mapping[str, Any]) -> list[tuple[str, str]]:
    return [
        (_FACTS.get(str(name), str(name)), known(_plain(value))) for name, value in facts.items()
    ]


@dataclass(frozen=True)
class _Spot:
    """An object on the map's drawing, px, with the place of its name."""

    x: float
    y: float
    radius: float
    style: str
    words: str
    name: str
    label_x: float
    label_y: float


def _maps(
    report: Mapping[str, Any], tracks: Sequence[_Track], drone_m: Floats
) -> list[dict[str, Any]]:
    """One map, or one for each segment of a flight that was followed in the picture: their pixels are not the same."""
    is_local = not report.get("georeferenced")
    note = (
        "Pixels of the first frame, or the first after a cut, with the camera's own motion removed: nothing places "
        "this flight on the ground."
        if is_local
        else "North is up. The dashed line is the path of the camera. The pale discs show the position accuracy (1 sigma)."
    )
    maps = []
    for title, of_one in _by_segment(tracks):
        drawing = _drawing(of_one, drone_m, is_local=is_local)
        if drawing:
            keys = [(f"c{k % _COLOURS}", name) for k, name in enumerate(_classes(of_one))]
            maps.append({"title": title, "legend": keys, "drawing": drawing, "note": note})
    return maps


def _by_segment(tracks: Sequence[_Track]) -> list[tuple[str, list[_Track]]]:
    """A title and the objects of each segment; all of them under one title where there is one segment."""
    segments = sorted({each.get("segment", 0) for each in tracks})
    if len(segments) < 2:
        return [("Where", list(tracks))]
    return [
        (f"Where, segment {name}", [each for each in tracks if each.get("segment", 0) == name])
        for name in segments
    ]


def _drawing(tracks: Sequence[_Track], drone_m: Floats, *, is_local: bool) -> Markup:
    """Objects and the camera's path seen from above; north is up, in a local frame the first frame's top."""
    x_key, y_key = ("x_px", "y_px") if is_local else ("east_m", "north_m")
    places = np.array([[each[x_key], each[y_key]] for each in tracks], dtype=np.float64).reshape(
        -1, 2
    )
    path = drone_m[np.isfinite(drone_m).all(axis=1)] if len(drone_m) else np.zeros((0, 2))
    everything = np.vstack([places, path])
    if not len(everything):
        return Markup("")
    low, high = everything.min(axis=0), everything.max(axis=0)
    span = np.maximum(high - low, 50.0 if is_local else 1.0)
    scale = float(min((_WIDE_PX - 2 * _RIM_PX) / span[0], (_HIGH_PX - 2 * _RIM_PX) / span[1]))
    height_px = float(span[1] * scale) + 2 * _RIM_PX
    signs = np.array(
        [1.0, 1.0 if is_local else -1.0]
    )  # pixels count downwards, metres north upwards
    middle_px = np.array([_WIDE_PX, height_px]) / 2

    def on_drawing(points: Floats) -> Floats:
        return np.asarray(middle_px + signs * (points - (low + high) / 2) * scale)

    bar = round_length(0.25 * (_WIDE_PX - 2 * _RIM_PX) / scale)
    return render(
        "plots/places.svg",
        width=_WIDE_PX,
        height=height_px,
        rim=_RIM_PX,
        path=on_drawing(path[:: max(1, len(path) // 1000)]).tolist(),
        spots=_spots(tracks, on_drawing(places), scale),
        bar=bar * scale,
        bar_words=f"{bar:g} {'px' if is_local else 'm'}",
    )


def _spots(tracks: Sequence[_Track], places_px: Floats, scale: float) -> list[_Spot]:
    classes = _classes(tracks)
    names = [str(each["id"]) for each in tracks]
    spots = []
    for each, (x, y), name, (label_x, label_y) in zip(
        tracks, places_px, names, _label_places(places_px, names)
    ):
        radius = max(4.0, float(each.get("sigma_m") or 0.0) * scale)
        style = f"c{classes.index(str(each['class'])) % _COLOURS}"
        words = f"{each['class']} {each['id']}"
        spots.append(_Spot(float(x), float(y), radius, style, words, name, label_x, label_y))
    return spots


def _label_places(dots_px: Floats, names: Sequence[str]) -> list[tuple[float, float]]:
    """Where each dot's name stands: beside it where no name or dot is yet: right, left, above, below, or farther."""
    taken = [(x - 4, y - 4, x + 4, y + 4) for x, y in dots_px]
    places = []
    for (x, y), name in zip(dots_px, names):
        wide = _LETTER_PX * len(name)
        sides = [
            (x + dx, y + dy, x + dx + wide, y + dy + _LINE_PX)
            for row in range(_ROWS)
            for dx, dy in (
                (7.0, row * _LINE_PX - 6),
                (-7 - wide, row * _LINE_PX - 6),
                (-wide / 2, -(row + 1) * _LINE_PX - 6),
                (-wide / 2, row * _LINE_PX + 6),
            )
        ]
        place = next(
            (each for each in sides if not any(boxes_meet(each, other) for other in taken)),
            sides[0],
        )
        taken.append(place)
        places.append((float(place[0]), float(place[3] - 2)))
    return places


def _rows(tracks: Sequence[_Track], *, is_local: bool) -> list[dict[str, Any]]:
    has_cuts = len({each.get("segment") for each in tracks}) > 1
    unit = "px" if is_local else "m"
    rows = []
    for each in tracks:
        speed = each.get("velocity_m_s")
        first, last = _when(each["first_seen"]), _when(each["last_seen"])
        rows.append(
            {
                "id": each["id"],
                "name": each["class"],
                "score": f"{each['score']:.2f}",
                "place": _place(each, is_local, has_cuts),
                "accuracy": with_unit(each.get("sigma_m"), "{:.1f} " + unit) or "",
                "motion": f"{np.hypot(*speed):.1f} {unit}/s" if speed else "still",
                "views": each["views"],
                "passes": each["passes"],
                "first": first,
                "last": last if first[:10] != last[:10] else last[-8:],
            }
        )
    return rows


def _place(track: _Track, is_local: bool, has_cuts: bool) -> list[tuple[str, str]]:
    if is_local:
        of_segment = f" in segment {track['segment']}" if has_cuts else ""
        return [("site", f"{track['x_px']:.0f}, {track['y_px']:.0f} px{of_segment}")]
    return list(degrees_words(track["latitude"], track["longitude"]).items())


def _when(utc: object) -> str:
    """A time to read; what no clock dated counts from 1970 on, and is shown as the time since the start."""
    day, _, clock = str(utc or "")[:19].partition("T")
    return clock if day == "1970-01-01" else f"{day} {clock}".strip() or "unknown"


def _crops(tracks: Sequence[_Track], crops: Mapping[int, bytes]) -> list[dict[str, str]]:
    left, shown = _CROPS_BYTES, []
    for each in tracks:
        data = crops.get(each["id"])
        if data is None or len(data) > left:
            continue
        left -= len(data)
        shown.append(
            {
                "address": jpeg_uri(data),
                "name": f"{each['class']} {each['id']}",
                "score": f"{each['score']:.2f}",
                "frame": known(each["best_frame"]),
            }
        )
    return shown


def _course(report: Mapping[str, Any]) -> list[tuple[str, str]]:
    """How the watch went: frames, detections, times, and what the places rest on."""
    frames, latency = report.get("frames") or {}, report.get("latency_s") or {}
    seconds = {
        name: value for name, value in (report.get("seconds") or {}).items() if name != "total"
    }
    missing = (
        f"{known(at(report, 'detections', 'not_placed'))} without"
        if report.get("georeferenced")
        else "none with"
    )
    short = at(report, "detections", "set_aside")
    aside = f"; {short} dropped, of a size that their class cannot have" if short else ""
    rows = [
        (
            "frames",
            f"{known(frames.get('detected'))} searched of {known(frames.get('read'))} read, "
            f"{known(frames.get('skipped'))} left, {known(frames.get('lost'))} unusable",
        ),
        (
            "detections",
            f"{known(at(report, 'detections', 'total'))}, of which {missing} a place on the ground{aside}",
        ),
        (
            "time taken",
            join_words(
                seconds_words(number_at(report, "seconds", "total")),
                with_unit(report.get("frames_per_second"), "({:.1f} frames per second)"),
            ),
        ),
        (
            "of that",
            ", ".join(
                f"{name} {seconds_words(finite_or_none(value))}" for name, value in seconds.items()
            ),
        ),
        (
            "delay from frame to result",
            f"{seconds_words(finite_or_none(latency.get('median')))} (median), "
            f"{seconds_words(finite_or_none(latency.get('max')))} at most",
        ),
        ("height", known(at(report, "telemetry", "height"))),
        ("attitude", known(at(report, "telemetry", "attitude"))),
        ("camera", known(at(report, "camera", "origin"))),
        ("ended", known(report.get("ended"))),
    ]
    return [(name, words) for name, words in rows if words]


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {each}" for name, each in value.items())
    return ", ".join(map(str, value)) if isinstance(value, list | tuple) else value


def _classes(tracks: Sequence[_Track]) -> list[str]:
    return list(dict.fromkeys(str(each["class"]) for each in tracks))
