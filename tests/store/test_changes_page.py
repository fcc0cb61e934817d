"""The page of changes: whole, self-contained, escaped, and honest about what was not compared."""

import json
import re
from dataclasses import replace
from importlib.resources import files
from typing import Any

import cv2
import numpy as np
import pytest
from fake_changes import fake_change, fake_comparison
from fake_flights import LOCAL_SITE, SITE
from fake_reports import fake_picture, fake_report
from html_checker import checked
from hypothesis import given, settings
from hypothesis import strategies as st

from sorvolo.geometry.grid import SiteGrid
from sorvolo.store.exports.ground_files import coverage_geojson
from sorvolo.store.exports.map_pictures import Picture
from sorvolo.store.pages.changes import changes_page
from sorvolo.store.site.change_records import StoredChange, stored_changes
from sorvolo.survey.coverage import CoveredGround, Gap
from sorvolo.survey.findings import Change, ChangeKind, Verdict

KINDS = list(ChangeKind)
SCRIPT = (files("sorvolo.store.pages") / "templates" / "swipe.js").read_text().strip()


def page_of(changes: list[Change], report: dict[str, Any] | None = None, **changed: Any) -> str:
    stored = [replace(each, **changed) for each in stored_changes("b", changes)]
    return page_of_stored(stored, changes, report)


def page_of_stored(
    stored: list[StoredChange], changes: list[Change], report: dict[str, Any] | None = None
) -> str:
    picture = Picture(fake_picture(300, 200), (-150.5, -100.5), 1)
    crops = {each.id: (each.patch.before, each.patch.after) for each in changes}
    reported = (
        fake_report(5) | {"flight": "b", "comparison": fake_comparison()}
        if report is None
        else report
    )
    return changes_page(reported, stored, picture, picture, SITE, crops)


@pytest.mark.parametrize("count", [0, 1, 12, 150])
def test_any_number_of_changes_makes_a_whole_page(count: int) -> None:
    changes = [
        fake_change(k + 1, kind=KINDS[k % 5], east_m=k % 13 - 6, north_m=k % 9 - 4, size_m=0.5)
        for k in range(count)
    ]
    page = page_of(changes)
    checker = checked(page)
    assert checker.names.count("article") == count
    assert checker.names.count("img") == 2 * count + 2
    assert sum("pin" in each.split() for each in checker.classes) == count
    ids = set(re.findall(r'id="([^"]+)"', page))
    targets = {each[1:] for each in checker.addresses if each.startswith("#")}
    assert targets <= ids and (count == 0 or {"map", "change-1", f"change-{count}"} <= targets)
    for kind in KINDS:  # each box of the legend rules over things that are there
        assert (f'id="show-{kind.value}"' in page) == (f'data-kind="{kind.value}"' in page)
    assert len(page) < 2_000_000


def test_small_things_far_apart_are_not_said_to_touch() -> None:
    changes = [fake_change(k + 1, east_m=40.0 * k, size_m=0.5) for k in range(3)]
    assert re.search(r"2 more changes listed with number \d<", page_of(changes))


def test_the_page_needs_nothing_else() -> None:
    page = page_of([fake_change(1)])
    for address in checked(page).addresses:
        assert address.startswith(("data:image/jpeg;base64,", "#"))
    assert "http" not in page and "@import" not in page and "url(" not in page
    assert page.count("<script>") == 1 and SCRIPT in page


def test_the_numbers_stand_on_their_ground() -> None:
    change = fake_change(1, east_m=2.0, north_m=3.0, size_m=1.0)
    page = page_of([change])
    grid = SiteGrid.at(SITE.origin, SITE.m_per_px, SITE.crs)
    corners = grid.grid_from_site(change.outline_m) + np.array([150.5, 100.5])
    drawn = re.search(r'<polygon class="appeared" [^>]*points="([^"]+)"', page)
    assert drawn is not None
    points = np.array(
        [[float(number) for number in pair.split(",")] for pair in drawn.group(1).split()]
    )
    gaps = np.linalg.norm(points[:, None] - corners[None], axis=-1)
    assert gaps.min(axis=1).max() < 0.1 and gaps.min(axis=0).max() < 0.5
    pin = re.search(r"left:([\d.]+)%;top:([\d.]+)%", page)
    assert pin is not None
    assert np.allclose(
        [float(pin.group(1)) * 3, float(pin.group(2)) * 2],
        [corners[:, 0].max(), corners[:, 1].min()],
        atol=0.01,
    )


@pytest.mark.parametrize(
    ("east_m", "north_m", "beside"),
    [(0.0, 0.0, "0,-100%"), (7.2, 0.0, "-100%,-100%"), (0.0, 4.8, "0,0"), (7.2, 4.8, "-100%,0")],
)
def test_a_number_stands_beside_its_outline_and_within_the_map(
    east_m: float, north_m: float, beside: str
) -> None:
    page = page_of([fake_change(1, east_m=east_m, north_m=north_m, size_m=0.4)])
    assert f"transform:translate({beside})" in page


def test_names_are_escaped() -> None:
    evil = '<img src=x onerror="alert(1)">&Überflug'
    report = fake_report(5) | {
        "flight": evil,
        "site": evil,
        "warnings": [evil],
        "comparison": fake_comparison(reasons={evil: 2}, chosen={evil: evil}, method=evil),
    }
    page = page_of([fake_change(1)], report, note=evil, class_after=evil)
    assert "<img src=x" not in page
    assert page.count("&amp;Überflug") >= 8
    checked(page)


def test_the_headline_counts_and_does_not_count_what_moves() -> None:
    changes = [fake_change(1), fake_change(2, kind=ChangeKind.MOVING, velocity_m_s=(-1.0, 0.0))]
    page = page_of(changes)
    text = " ".join("".join(checked(page).text).split())
    assert "1 change on 3 412 m²" in text and ": 1 appeared; also 1 moving object." in text
    assert "1.0 m/s to the west" in text
    assert "180 of 197 views were compared" in text and "3.1% of the ground" in text


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"views": {"compared": 0, "not-aligned": 40}}, "No view could be compared"),
        ({"views": {"compared": 10, "not-aligned": 40}}, "40 of 50 views: not-aligned"),
        ({"unknown_share": 0.42}, "42% of the ground under the views was unknown"),
        ({"suppressed": 3}, "3 changes left out"),
        ({"map_updated": False}, "not updated"),
        ({"reasons": {"too few points fit": 9}}, "too few points fit"),
        ({"candidates": {"withdrawn": {"a passing shadow": 2}}}, "a passing shadow"),
    ],
)
def test_what_was_not_compared_is_reported(changed: dict[str, Any], words: str) -> None:
    report = fake_report(5) | {"warnings": [], "comparison": fake_comparison(**changed)}
    assert words in "".join(checked(page_of([], report)).text)


SQUARE = np.array([[-8.0, -8.0], [-2.0, -8.0], [-2.0, -2.0], [-8.0, -2.0]])
COVERED = [
    CoveredGround(((SQUARE, SQUARE[::-1] / 2 - 2.5),), 30.0, None, "", 0.3, np.nan),
    CoveredGround(((SQUARE + 9.0,),), 36.0, Gap.REJECTED, "no single plane <fits>", np.nan, np.nan),
    CoveredGround(((SQUARE * [-1.0, 1.0],),), 12.0, Gap.DARK, "", np.nan, np.nan),
]


def test_the_ground_that_was_not_compared_lies_on_the_map_and_in_a_table() -> None:
    comparison = fake_comparison(coverage={"compared_m2": 21_300.0, "not_compared_m2": 4_100.0})
    picture = Picture(fake_picture(300, 200), (-150.5, -100.5), 1)
    features = json.loads(json.dumps(coverage_geojson(COVERED, SITE)))["features"]
    page = changes_page(
        fake_report(5) | {"flight": "b", "comparison": comparison},
        [],
        picture,
        picture,
        SITE,
        {},
        coverage=features,
    )
    checker = checked(page)
    text = " ".join("".join(checker.text).split())
    assert "No change was found in 2.13 ha; 4 100 m² could not be compared." in text
    assert "its views could not be compared: no single plane <fits>" in text
    assert "black shadow or night on one of the dates" in text
    assert "0.30 m" in text and "none of the drawn sizes" in text
    assert page.count('<path class="gaps"') == 2 and page.count('<path class="sizes"') == 1
    assert 'id="show-gaps"' in page and 'id="show-sizes"' in page
    path = re.search(r'<path class="gaps" d="M([^Z]+)Z', page)
    assert path is not None
    drawn = np.array(
        [[float(number) for number in pair.split()] for pair in path.group(1).split("L")]
    )
    grid = SiteGrid.at(SITE.origin, SITE.m_per_px, SITE.crs)
    corners = grid.grid_from_site(SQUARE + 9.0) + np.array([150.5, 100.5])
    assert np.linalg.norm(drawn[:, None] - corners[None], axis=-1).min(axis=1).max() < 0.1


@pytest.mark.parametrize(
    "broken", [[None], [{}], ["x"], [{"properties": {"gap": "unheard-of", "area_m2": "x"}}]]
)
def test_a_broken_coverage_file_takes_no_page_away(broken: list[Any]) -> None:
    picture = Picture(fake_picture(300, 200), (-150.5, -100.5), 1)
    report = fake_report(5) | {"flight": "b", "comparison": fake_comparison()}
    checked(changes_page(report, [], picture, picture, SITE, {}, coverage=broken))


def test_nothing_to_look_at_first_when_all_is_well() -> None:
    report = fake_report(5) | {"warnings": [], "comparison": fake_comparison()}
    assert "Read this first" not in page_of([fake_change(1)], report)


def test_verdicts_are_shown_and_rejected_ones_can_be_hidden() -> None:
    changes = [fake_change(1), fake_change(2)]
    stored = stored_changes("b", changes)
    stored[1] = replace(stored[1], verdict=Verdict.REJECTED, note="a shadow")
    page = page_of_stored(stored, changes)
    assert (
        'id="show-rejected"' in page
        and "a shadow" in page
        and "Reviewed by a person: 1 rejected." in page
    )
    assert page.count("is-rejected") > page_of(changes).count("is-rejected")


def test_times_without_a_date_are_times_into_the_flight() -> None:
    page = page_of([fake_change(1)], first_seen_ns=125_400_000_000)
    assert "2:05 into the flight" in page and "1970" not in page and "2023-11-14 22:13:23" in page


def test_pictures_that_are_gone_are_reported_to_be() -> None:
    changes = [fake_change(1)]
    page = changes_page({}, stored_changes("b", changes), None, None, LOCAL_SITE, {})
    assert page.count("the picture is missing") == 2
    assert 'class="swipe' not in page
    checked(page)


@settings(max_examples=25)
@given(
    st.dictionaries(
        st.sampled_from(["flight", "site", "warnings", "georeferenced", "comparison"]),
        st.none()
        | st.fixed_dictionaries(
            {},
            optional={
                "views": st.none()
                | st.dictionaries(st.sampled_from(["compared", "lost"]), st.integers(0, 9)),
                "reasons": st.none(),
                "unknown_share": st.none() | st.floats(0, 1),
                "chosen": st.none(),
                "votes": st.none(),
                "residual_px": st.none(),
            },
        ),
    )
)
def test_whatever_is_unknown_the_page_is_whole(report: dict[str, Any]) -> None:
    checked(page_of([], report))
    checked(
        page_of(
            [fake_change(1, size_m=0.3)], report, sigma_m=np.nan, area_m2=np.nan, length_m=np.nan
        )
    )


def test_crops_stay_small_when_there_are_many() -> None:
    large = cv2.resize(
        np.random.default_rng(1).integers(0, 255, (64, 64, 4), dtype=np.uint8), (512, 512)
    )
    large[..., 3] = 255
    changes = [fake_change(k + 1) for k in range(100)]
    crops = {each.id: (large, large) for each in changes}
    assert len(changes_page({}, stored_changes("b", changes), None, None, SITE, crops)) < 9_000_000
