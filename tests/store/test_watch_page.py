"""The page of a watch: its content, that it is whole and needs nothing else, and that names stay text."""

import re
from typing import Any

import numpy as np
from html_checker import checked

from sorvolo.store.pages.watch import watch_page

_REPORT: dict[str, Any] = {
    "sorvolo": "0.1.0",
    "flight": "DJI<1>",
    "georeferenced": True,
    "first_frame": "2026-05-01T10:00:00Z",
    "last_frame": "2026-05-01T10:01:00Z",
    "ended": "the source ended",
    "looked_for": ["person", "car"],
    "objects": {"total": 2, "by_class": {"person": 1, "car": 1}},
    "headline": {"text": "1 car; 13 of 331 pictures, 38 % of the ground looked at"},
    "frames": {
        "read": 100,
        "detected": 50,
        "with_detections": 20,
        "skipped": 3,
        "lost": 1,
        "reasons": {},
    },
    "detections": {"total": 40, "placed": 39, "not_placed": 1},
    "latency_s": {"median": 0.05, "max": 0.2},
    "frames_per_second": 20.0,
    "seconds": {"total": 5.0, "detect": 4.0},
    "model": {
        "name": "fast",
        "licence": "Apache-2.0 & others",
        "classes": ["person", "car", "small object"],
    },
    "camera": {"origin": "guess"},
    "telemetry": {"height": "above take-off", "attitude": "gimbal"},
    "notices": [{"code": "x", "count": 1, "text": "a <notice>"}],
    "warnings": ["a <warning>"],
    "settings": {"classes": []},
    "versions": {"python": "3.11"},
}


def _track(number: int, **changes: Any) -> dict[str, Any]:
    track = {
        "id": number,
        "class": "person",
        "score": 0.8,
        "latitude": 41.9,
        "longitude": 12.6,
        "east_m": 10.0 * number,
        "north_m": 5.0,
        "sigma_m": 1.2,
        "velocity_m_s": None,
        "views": 5,
        "passes": 2,
        "first_seen": "2026-05-01T10:00:00Z",
        "last_seen": "2026-05-01T10:00:09Z",
        "best_frame": "17",
    }
    return track | changes


def test_a_page_states_what_where_and_how_sure() -> None:
    tracks = [_track(1), _track(2, **{"class": "car", "velocity_m_s": [3.0, 4.0]})]
    way_m = np.column_stack([np.linspace(0, 50, 9), np.zeros(9)])
    page = checked(watch_page(_REPORT, tracks, {1: b"\xff\xd8picture"}, way_m))
    text = " ".join(page.text)
    assert "1 car; 13 of 331 pictures, 38 % of the ground looked at." in text
    assert "Looked for: person, car." in text
    assert (
        "41.900000, 12.600000" in text
        and "1.2 m" in text
        and "5.0 m/s" in text
        and "passes" in text
    )
    assert (
        "a <notice>" in text
        and "a <warning>" in text
        and "DJI<1>" in text
        and "Apache-2.0 & others" in text
    )
    assert (
        page.names.count("img") == 1
        and page.names.count("circle") == 4
        and "polyline" in page.names
    )
    assert all(address.startswith(("data:", "#")) for address in page.addresses)
    assert (
        "1 more without a picture here" in text
        and "40, of which 1 without a place on the ground" in text
    )


def test_neighbours_on_the_map_have_names_that_can_be_read() -> None:
    tracks = [
        _track(k, east_m=east_m)
        for k, east_m in ((11, 30.0), (12, 30.0), (13, 30.2), (14, 0.0), (15, 60.0))
    ]
    page = watch_page(_REPORT, tracks, {}, np.zeros((0, 2)))
    found = re.findall(r'<text class="label" x="([\d.-]+)" y="([\d.-]+)">(1\d)<', page)
    assert [name for _, _, name in found] == ["11", "12", "13", "14", "15"]
    lefts, bases = np.array([[float(x), float(y)] for x, y, _ in found]).T
    apart = (np.abs(np.subtract.outer(lefts, lefts)) >= 14) | (
        np.abs(np.subtract.outer(bases, bases)) >= 11
    )
    assert (apart | np.eye(5, dtype=bool)).all()


def test_a_day_is_given_once_in_a_row() -> None:
    days = {"first_seen": "2026-05-01T23:59:58Z", "last_seen": "2026-05-02T00:00:01Z"}
    page = watch_page(_REPORT, [_track(1), _track(2, **days)], {}, np.zeros((0, 2)))
    assert (
        ">2026-05-01 10:00:00<" in page and ">10:00:09<" in page and ">2026-05-02 00:00:01<" in page
    )


def test_nothing_found_and_nothing_known_is_a_page_too() -> None:
    text = " ".join(checked(watch_page({"flight": "x"}, [], {}, np.zeros((0, 2)))).text)
    assert "Looked for: objects." in text
    only_way = checked(watch_page(_REPORT, [], {}, np.array([[0.0, 0.0], [40.0, 10.0]])))
    assert "polyline" in only_way.names and "circle" not in only_way.names


def test_a_flight_that_nothing_places_is_drawn_in_pixels() -> None:
    local = _REPORT | {"georeferenced": False}
    track = {key: value for key, value in _track(1).items() if key not in ("latitude", "longitude")}
    page = checked(watch_page(local, [track | {"x_px": 100.0, "y_px": 50.0}], {}, np.zeros((0, 2))))
    text = " ".join(page.text)
    assert "100, 50 px" in text and "nothing places this flight" in text
    assert "40, of which none with a place on the ground" in text


def test_what_no_clock_dated_is_timed_from_the_start() -> None:
    report = {
        "flight": "f",
        "first_frame": "1970-01-01T00:00:00Z",
        "last_frame": "1970-01-01T00:00:14.000000Z",
    }
    track = _track(
        1, first_seen="1970-01-01T00:00:03Z", last_seen="1970-01-01T00:00:09.5Z", x_px=1.0, y_px=2.0
    )
    page = watch_page(report, [track], {}, np.zeros((0, 2)))
    assert "1970" not in page
    assert "00:00:00 to 00:00:14" in page and ">00:00:03<" in page and ">00:00:09<" in page
