"""A watch as one page of HTML: what was found, where, how certain, and how the watch itself went.

The page needs no other file, no network and no script.
"""

import math
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
    jpeg_uri,
    known,
    render,
)

_WIDE_PX, _HIGH_PX, _RIM_PX = 940.0, 560.0, 36.0
_LETTER_PX, _LINE_PX = 7.5, 12.0  # of the map's labels
_ROWS = 3  # so many lines a label may lie from its dot
_CROPS_BYTES = 8_000_000  # of all crops in the page together
_COLOURS = 6  # that the styles of pages have, c0 to c5
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
    is_local = not report.get("georeferenced")
    has_cuts = len({each.get("segment") for each in tracks}) > 1
    page = render(
        "watch.html",
        report,
        title=f"{report.get('flight')} - watch",
        # one map, or one for each segment of a flight that was followed in the picture: their pixels are not the same
        maps=[
            {"title": title, "classes": _classes(of_one), "colours": _COLOURS, "drawing": drawing}
            for title, of_one in _by_segment(tracks)
            if (drawing := _drawing(of_one, drone_m, is_local=is_local))
        ],
        rows=[
            (each, _place(each, is_local, has_cuts), math.hypot(*each.get("velocity_m_s") or ()))
            for each in tracks
        ],
        systems=() if is_local else tuple(SYSTEMS.items()),
        no_place_files=NO_PLACE_FILES,
        crops=_crops(tracks, crops),
        model=_model_rows(report.get("model") or {}),
        others=[_model_rows(each) for each in report.get("other_models") or []],
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
        return middle_px + signs * (points - (low + high) / 2) * scale

    bar = round_length(0.25 * (_WIDE_PX - 2 * _RIM_PX) / scale)
    places_px = on_drawing(places)
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
    return render(
        "plots/places.svg",
        width=_WIDE_PX,
        height=height_px,
        rim=_RIM_PX,
        path=on_drawing(path[:: max(1, len(path) // 1000)]).tolist(),
        spots=spots,
        bar=bar * scale,
        bar_words=f"{bar:g} {'px' if is_local else 'm'}",
    )


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


def _place(track: _Track, is_local: bool, has_cuts: bool) -> list[tuple[str, str]]:
    if is_local:
        of_segment = f" in segment {track['segment']}" if has_cuts else ""
        return [("site", f"{track['x_px']:.0f}, {track['y_px']:.0f} px{of_segment}")]
    return list(degrees_words(track["latitude"], track["longitude"]).items())


def _crops(tracks: Sequence[_Track], crops: Mapping[int, bytes]) -> list[tuple[_Track, str]]:
    """The tracks whose picture the page has room for, with its address."""
    left, shown = _CROPS_BYTES, []
    for each in tracks:
        data = crops.get(each["id"])
        if data is not None and len(data) <= left:
            left -= len(data)
            shown.append((each, jpeg_uri(data)))
    return shown


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {each}" for name, each in value.items())
    return ", ".join(map(str, value)) if isinstance(value, list | tuple) else value


def _classes(tracks: Sequence[_Track]) -> list[str]:
    return list(dict.fromkeys(str(each["class"]) for each in tracks))
