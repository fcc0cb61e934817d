"""What `sorvolo compare` prints in the end."""

from io import StringIO
from pathlib import Path

import pytest
from rich.console import Console

from sorvolo.cli.compare import _class_words, show_results
from sorvolo.missions.compare.report import comparison_headline

COVERED = {
    "in_short": "1 car came",
    "headline": {"quality": "compared", "text": "1 change in 100 m2; 20 m2 could not be compared"},
    "coverage": {
        "compared_m2": 100.0,
        "not_compared_m2": 20.0,
        "gaps_m2": {"leaning": 19.5, "dark": 0.5},
        "smallest_m": 0.3,
        "faint_m": None,
        "large_found": 0.9,
        "faint_known": True,
        "is_enough": True,
    },
}


@pytest.mark.parametrize(
    ("kind", "before", "after", "words"),
    [
        ("appeared", None, "car", "car"),
        ("replaced", "car", "person", "car to person"),
        ("appeared", None, None, "unknown object"),
        ("area", None, None, ""),
    ],
)
def test_a_thing_of_no_known_class_is_called_an_unknown_object(
    kind: str, before: str | None, after: str | None, words: str
) -> None:
    assert _class_words(kind, before, after) == words


def test_withdrawn_changes_are_named(tmp_path: Path) -> None:
    result = {
        "flight": "b",
        "seconds": 9.0,
        "peak_memory_mb": 300.0,
        "warnings": [],
        "notices": [],
        "changes": {"features": []},
        "objects": {},
        "comparison": {"views": {"compared": 7}, "reasons": {}, **COVERED},
        "withdrawn": ["b-4", "b-7"],
    }
    console = Console(record=True, width=120, file=StringIO())
    show_results([result], tmp_path, console)
    assert "withdrawn (not confirmed by the whole flight): b-4, b-7" in console.export_text()
    show_results([result | {"withdrawn": []}], tmp_path, console)
    assert "withdrawn (" not in console.export_text()


def test_notices_and_the_report_are_shown_as_by_map(tmp_path: Path) -> None:
    result = {
        "flight": "b",
        "seconds": 9.0,
        "peak_memory_mb": 300.0,
        "changes": {"features": []},
        "objects": {},
        "withdrawn": [],
        "comparison": {"views": {"compared": 7}, "reasons": {}, **COVERED},
        "notices": [{"code": "no_date", "count": 1, "text": "the table has no date"}],
        "warnings": ["look here"],
    }
    console = Console(record=True, width=300, file=StringIO())
    show_results([result], tmp_path, console)
    text = console.export_text()
    assert "note     the table has no date" in text and "warning  look here" in text
    assert f"report  {tmp_path / 'flights' / 'b' / 'report.html'}" in text


def test_how_much_the_map_grew_is_shown(tmp_path: Path) -> None:
    comparison = {"views": {"compared": 7, "outside": 5}, "reasons": {}, **COVERED}
    result = {
        "flight": "b",
        "seconds": 9.0,
        "peak_memory_mb": 300.0,
        "warnings": [],
        "notices": [],
        "changes": {"features": []},
        "objects": {},
        "comparison": comparison
        | {"extension": {"frames": 3, "shown_as_well": 2, "area_m2": 350.4}},
        "withdrawn": [],
    }
    console = Console(record=True, width=120, file=StringIO())
    show_results([result], tmp_path, console)
    assert (
        "the map grew by 350 m2 from 3 frames; 2 more frames show the same ground"
        in console.export_text()
    )


@pytest.mark.parametrize(
    ("georeference", "shown", "not_shown"),
    [
        (
            {},
            [
                "1 change in 100 m2",
                "length m",
                "latitude, longitude",
                "41.250000, 12.500000",
                "20 m2",
            ],
            ["units"],
        ),
        (
            {"crs": None},
            ["length units", "east, north", "12.5, 41.2", "20 square units"],
            ["latitude", "0.3 m"],
        ),
    ],
)
def test_a_map_without_metres_is_not_shown_in_metres(
    tmp_path: Path, georeference: dict, shown: list[str], not_shown: list[str]
) -> None:
    ring = [[12.0, 41.0], [13.0, 41.0], [13.0, 41.5], [12.0, 41.5], [12.0, 41.0]]
    change = {
        "geometry": {"coordinates": [ring]},
        "properties": {
            "id": "b-1",
            "kind": "appeared",
            "rank": 1,
            "group": "b-1",
            "length_m": 1.0,
            "sigma_m": 2.0,
            "views": 9,
            "score": 0.7,
            "class_before": None,
            "class_after": None,
        },
    }
    result = {
        "flight": "b",
        "seconds": 9.0,
        "peak_memory_mb": 300.0,
        "warnings": [],
        "notices": [],
        "withdrawn": [],
        "changes": {"features": [change]} | georeference,
        "objects": {},
        "comparison": {"views": {"compared": 7}, "reasons": {}, **COVERED},
    }
    console = Console(record=True, width=120, file=StringIO())
    show_results([result], tmp_path, console)
    text = console.export_text()
    assert all(words in text for words in shown)
    assert not any(words in text for words in not_shown)


@pytest.mark.parametrize(("form", "place"), [("utm", "33T 29053"), ("mgrs", "33T TF 90533 69524")])
def test_places_are_written_as_asked_for(tmp_path: Path, form: str, place: str) -> None:
    ring = [[12.4, 41.2], [12.6, 41.2], [12.6, 41.3], [12.4, 41.3], [12.4, 41.2]]
    change = {
        "geometry": {"coordinates": [ring]},
        "properties": {
            "id": "b-1",
            "kind": "appeared",
            "rank": 1,
            "group": "b-1",
            "length_m": 1.0,
            "sigma_m": 2.0,
            "views": 9,
            "score": 0.7,
            "class_before": None,
            "class_after": "car",
        },
    }
    result = {
        "flight": "b",
        "seconds": 9.0,
        "peak_memory_mb": 300.0,
        "warnings": [],
        "notices": [],
        "withdrawn": [],
        "changes": {"features": [change]},
        "objects": {},
        "comparison": {"views": {"compared": 7}, "reasons": {}, **COVERED},
    }
    console = Console(record=True, width=120, file=StringIO())
    show_results([result], tmp_path, console, form)
    assert place in console.export_text()


def test_what_was_not_compared_and_how_small_a_thing_is_found_are_shown(tmp_path: Path) -> None:
    result = {
        "flight": "b",
        "seconds": 9.0,
        "peak_memory_mb": 300.0,
        "warnings": [],
        "notices": [],
        "withdrawn": [],
        "changes": {"features": []},
        "objects": {},
        "comparison": {"views": {"compared": 7}, "reasons": {}, **COVERED},
    }
    console = Console(record=True, width=200, file=StringIO())
    show_results([result], tmp_path, console)
    text = console.export_text()
    assert "Flight b: 1 change in 100 m2; 20 m2 could not be compared" in text
    assert "not compared: 20 m2, crowns or walls lean there" in text and "too dark" not in text
    assert "plain ones are found from 0.3 m; faint ones are not found" in text


@pytest.mark.parametrize(
    ("changes", "compared_m2", "missing_m2", "other_m2", "is_enough", "text"),
    [
        (0, 21_300.0, 4_100.0, 0.0, True, "0 changes in 2.1 ha; 0.4 ha could not be compared"),
        (1, 340.0, 0.0, 120.0, True, "1 change in 340 m2; 0 m2 could not be compared"),
        (
            8,
            3_400.0,
            0.0,
            2_100.0,
            True,
            "not to be relied on, most of the ground surface changed (snow, water, ploughing?), and objects on it may "
            "be missed: 8 changes in 0.3 ha; 0 m2 could not be compared",
        ),
        (
            0,
            4_000.0,
            21_000.0,
            0.0,
            False,
            "not to be relied on, most of the ground could not be compared: 0 changes in 0.4 ha; 2.1 ha could not be "
            "compared",
        ),
    ],
)
def test_the_headline_never_speaks_of_ground_that_was_not_compared(
    changes: int, compared_m2: float, missing_m2: float, other_m2: float, is_enough: bool, text: str
) -> None:
    coverage = {
        "compared_m2": compared_m2,
        "not_compared_m2": missing_m2,
        "is_enough": is_enough,
        "other_ground_m2": other_m2,
    }
    headline = comparison_headline(changes, coverage, is_local=False)
    assert headline == {
        "quality": "doubtful" if text.startswith("not to be") else "compared",
        "text": text,
    }
