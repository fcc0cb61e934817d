"""The report page: whole, self-contained, escaped, honest, and the same whatever is unknown."""

import base64
import math
import re
from typing import Any

import cv2
import numpy as np
import pytest
from fake_reports import fake_picture, fake_report
from html_checker import checked
from hypothesis import given
from hypothesis import strategies as st

from sorvolo.store.exports.plain import plain_json
from sorvolo.store.pages.flight import report_page
from sorvolo.store.pages.plots import Scale, TrackColumns, round_length, track_plan


def _words(page: str) -> str:
    return " ".join(" ".join(checked(page).text).split())


def test_page_needs_nothing_else() -> None:
    page = report_page(fake_report(), fake_picture())
    checker = checked(page)
    assert "script" not in checker.names and "link" not in checker.names
    assert len(checker.addresses) == 1 and checker.addresses[0].startswith(
        "data:image/jpeg;base64,"
    )
    assert "http" not in page and "url(" not in page and "@import" not in page


def test_a_later_flight_fits_the_map_and_made_none() -> None:
    words = _words(
        report_page(fake_report() | {"comparison": {"against_version": 1}}, fake_picture())
    )
    assert re.search(r"\d+ of 60 frames matched the map", words) and "changes.html" in words
    assert "a frame and the map" in words
    alone = _words(report_page(fake_report(), fake_picture()))
    assert ": a map of" in alone and "changes.html" not in alone and "and its neighbours" in alone


def test_picture_is_the_map_on_grey() -> None:
    picture = fake_picture(noise=0.0)
    page = report_page(fake_report(), picture)
    data = base64.b64decode(re.search(r"base64,([^\"]+)", page)[1])  # type: ignore[index]
    shown = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    assert shown.shape == picture[..., :3].shape
    seen = cv2.erode(picture[..., 3], np.ones((17, 17))) > 0
    unseen = cv2.dilate(picture[..., 3], np.ones((17, 17))) == 0
    assert np.abs(shown[seen].astype(int) - picture[..., :3][seen]).mean() < 3
    assert np.abs(shown[unseen].astype(int) - 236).max() < 8


def test_large_pictures_are_made_to_fit() -> None:
    rng = np.random.default_rng(1)
    noise = np.dstack([rng.integers(0, 256, (1600, 1600, 3)), np.full((1600, 1600), 255)]).astype(
        np.uint8
    )
    assert len(report_page(fake_report(), noise)) < 2_200_000


def test_settings_are_words() -> None:
    thesis = {"bands": 5, "side_px": None}
    wishes = {
        "overlap": 0.7,
        "crs": None,
        "checks": [],
        "classes": ["person", "car"],
        "thesis": thesis,
    }
    words = _words(report_page(fake_report() | {"settings": wishes}, fake_picture()))
    for shown in (
        "overlap 0.7",
        "crs chosen from the flight",
        "checks none",
        "classes person, car",
        "thesis bands 5, side_px chosen from the flight",
    ):
        assert shown in words


def test_nothing_seen_is_no_picture() -> None:
    page = report_page(fake_report(), np.zeros((4, 4, 4), np.uint8))
    assert "img" not in checked(page).names


def test_everything_from_outside_is_escaped() -> None:
    evil = '<script>alert("1")</script>&\'"><img src=x>'
    report = _with_every_text(fake_report(), evil)
    page = report_page(report, fake_picture(60, 40))
    checker = checked(page)
    assert "script" not in checker.names and checker.names.count("img") == 1
    assert "<script" not in page and "alert(&#34;1&#34;)" in page


def _with_every_text(value: Any, text: str) -> Any:
    """The report with every text that a file or a person gave replaced; keys of reasons and settings, too."""
    if isinstance(value, dict):
        changed = {
            key: each if key == "status" else _with_every_text(each, text)
            for key, each in value.items()
        }
        if "reasons" in changed:
            changed["reasons"] = {text: 1}
        return changed
    if isinstance(value, list):
        return [_with_every_text(each, text) for each in value]
    return text if isinstance(value, str) else value


def test_marks_are_one_for_each_frame() -> None:
    report = fake_report(40)
    residuals = report_page(report, fake_picture(60, 40)).split("<h2>")
    plot = next(each for each in residuals if each.startswith("How well"))
    classes = _classes_of_marks(plot)
    frames = report["frames"]
    assert (classes.count("vision"), classes.count("gps-only"), classes.count("rejected")) == (
        frames["vision"],
        frames["gps-only"],
        frames["rejected"],
    )
    plan = next(each for each in residuals if each.startswith("The track"))
    assert _classes_of_marks(plan).count("rejected") == 0
    assert plan.count('class="fix"') == frames["vision"] + frames["gps-only"]


def _classes_of_marks(part: str) -> list[str]:
    return re.findall(r'<(?:circle|rect|path) class="(vision|gps-only|rejected)"', part)


def test_fix_lies_at_camera_less_residual() -> None:
    report = fake_report(8)
    report["track"] = [
        {
            "frame": "a",
            "status": "vision",
            "east_m": 0.0,
            "north_m": 0.0,
            "up_m": 1.0,
            "residual_px": 1.0,
            "sigma_m": 1.0,
            "gps_east_m": -10.0,
            "gps_north_m": 0.0,
            "gps_up_m": 0.0,
        },
        {
            "frame": "b",
            "status": "vision",
            "east_m": 0.0,
            "north_m": 10.0,
            "up_m": 1.0,
            "residual_px": 1.0,
            "sigma_m": 1.0,
            "gps_east_m": 0.0,
            "gps_north_m": 0.0,
            "gps_up_m": 0.0,
        },
    ]
    page = report_page(report, fake_picture(60, 40))
    plan = next(each for each in page.split("<h2>") if each.startswith("The track"))
    fixes, cameras = (
        [
            (float(x), float(y))
            for x, y in re.findall(rf'class="{name}" cx="([\d.]+)" cy="([\d.]+)"', plan)
        ]
        for name in ("fix", "vision")
    )
    assert fixes[0][0] > cameras[0][0] and fixes[0][1] == cameras[0][1]  # 10 m to the east
    assert fixes[1] == cameras[1] and cameras[1][1] < cameras[0][1]  # north is up
    assert fixes[0][0] - cameras[0][0] == pytest.approx(cameras[0][1] - cameras[1][1], abs=0.2)


@pytest.mark.parametrize(
    ("counts", "words"),
    [
        ((60, 0, 0), "60 of 60 frames matched: a map of 3\u202f412 m\u00b2"),
        (
            (55, 3, 2),
            "55 of 60 frames matched, 3 placed by GPS only, 2 not placed: a map of 3\u202f412 m\u00b2 at a "
            "ground resolution of 3 cm per pixel.",
        ),
        ((0, 0, 60), "there is no map"),
    ],
)
def test_headline_is_honest(counts: tuple[int, int, int], words: str) -> None:
    report = fake_report()
    report["frames"] |= dict(zip(("vision", "gps-only", "rejected"), counts))
    page = report_page(report, fake_picture(60, 40))
    headline = re.search("<h1>(.*?)</h1>", page)[1]  # type: ignore[index]
    assert words in headline


def test_local_map_promises_no_metres() -> None:
    page = report_page(fake_report(georeferenced=False), fake_picture(60, 40))
    headline = _words(page).split("Frames")[0]
    assert "without metres and without north" in headline
    assert " m\u00b2" not in headline and "cm" not in headline and 'class="scale"' not in page
    words = _words(page)
    assert (
        "units" not in words and "GPS fix" not in words and "position accuracy" not in words.lower()
    )


def test_scale_bar_is_as_long_as_it_states() -> None:
    report, picture = fake_report(), fake_picture(400, 200)
    report["area_m2"] = np.count_nonzero(picture[..., 3]) * 0.25**2  # 0.25 m a pixel: 100 m wide
    share, length = re.search(
        r'class="scale" style="width:([\d.]+)%">([\d.]+) m', report_page(report, picture)
    ).groups()  # type: ignore[union-attr]
    assert float(length) / (float(share) / 100) == pytest.approx(100.0, rel=1e-3)


def test_unknown_numbers_are_stated_or_left_out() -> None:
    report = _without_numbers(plain_json(fake_report()))
    words = _words(report_page(report, fake_picture(60, 40)))
    assert "None" not in words and "nan" not in words.lower().split()
    assert "Read this first" in words


def _without_numbers(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_numbers(each) for key, each in value.items()}
    if isinstance(value, list):
        return [_without_numbers(each) for each in value]
    return None if isinstance(value, float) else value


@pytest.mark.parametrize("key", list(fake_report()))
def test_any_part_may_be_missing(key: str) -> None:
    report = fake_report(5)
    report[key] = None
    checked(report_page(report, fake_picture(60, 40)))
    del report[key]
    checked(report_page(report, fake_picture(60, 40)))


@given(
    st.lists(
        st.tuples(
            st.sampled_from(["vision", "gps-only", "rejected"]),
            st.lists(
                st.one_of(st.none(), st.floats(-1e7, 1e7), st.just(math.nan), st.just(math.inf)),
                min_size=8,
                max_size=8,
            ),
        ),
        max_size=12,
    )
)
def test_any_track_can_be_drawn(rows: list[tuple[str, list[float | None]]]) -> None:
    names = (
        "east_m",
        "north_m",
        "up_m",
        "residual_px",
        "sigma_m",
        "gps_east_m",
        "gps_north_m",
        "gps_up_m",
    )
    report = fake_report(8)
    report["track"] = [
        {"frame": str(k), "status": status, **dict(zip(names, numbers))}
        for k, (status, numbers) in enumerate(rows)
    ]
    page = report_page(report, np.zeros((2, 2, 4), np.uint8))
    checked(page)
    drawn = "".join(re.findall("<svg.*?</svg>", page, re.DOTALL))
    assert not re.search(r"[\"\s,MLHV](nan|inf)", drawn)


@given(st.floats(1e-6, 1e9))
def test_round_lengths(about: float) -> None:
    length = round_length(about)
    assert 0.39 * about <= length <= about * (1 + 1e-6)
    digit = length / 10 ** math.floor(math.log10(length) + 1e-9)
    assert min(abs(digit - each) for each in (1, 2, 5, 10)) < 1e-6


@given(st.floats(-1e4, 1e4), st.floats(1e-2, 1e4))
def test_ticks_lie_on_the_scale(low: float, span: float) -> None:
    scale = Scale(low, low + span, 0.0, 100.0)
    ticks = list(scale.ticks(5))
    assert 4 <= len(ticks) <= 14
    assert all(-1e-4 <= scale(tick) <= 100.0001 for tick in ticks)


@pytest.mark.parametrize("heading", [1, -1])
def test_the_word_at_the_track_s_start_stands_clear_of_its_marks(heading: int) -> None:
    columns = {
        "east_m": heading * np.arange(5.0) * 10,
        "north_m": np.zeros(5),
        "residual_px": np.ones(5),
        "gps_east_m": np.full(5, 3.0 * heading),
        "gps_north_m": np.zeros(5),
    }
    drawn = track_plan(TrackColumns(tuple("abcde"), ("vision",) * 5, columns), unit="m")
    marks = [float(each) for each in re.findall(r'cx="([0-9.]+)"', drawn)]
    found = re.search(r'x="([0-9.]+)" y="[0-9.]+" text-anchor="(\w+)">start<', drawn)
    assert found is not None
    assert found[2] == ("end" if heading > 0 else "start")
    assert float(found[1]) < min(marks) if heading > 0 else float(found[1]) > max(marks)
