"""What `sorvolo compare` says in the end."""

from io import StringIO
from pathlib import Path

import pytest
from rich.console import Console

from sorvolo.cli.compare import show_results


def test_what_was_told_live_and_did_not_last_is_named(tmp_path: Path) -> None:
    result = {
        "flight": "b", "seconds": 9.0, "peak_memory_mb": 300.0, "warnings": [], "notices": [],
        "changes": {"features": []},
        "comparison": {"views": {"compared": 7}, "compared_area_m2": 100.0, "reasons": {}},
        "taken_back": ["b-4", "b-7"],
    }
    console = Console(record=True, width=120, file=StringIO())
    show_results([result], tmp_path, console)
    assert "taken back" in (text := console.export_text()) and "b-4, b-7" in text
    show_results([result | {"taken_back": []}], tmp_path, console)
    assert "taken back" not in console.export_text()


def test_notices_and_the_report_are_told_as_by_map(tmp_path: Path) -> None:
    result = {
        "flight": "b", "seconds": 9.0, "peak_memory_mb": 300.0, "changes": {"features": []}, "taken_back": [],
        "comparison": {"views": {"compared": 7}, "compared_area_m2": 100.0, "reasons": {}},
        "notices": [{"code": "no_date", "count": 1, "text": "the table has no date"}], "warnings": ["look here"],
    }
    console = Console(record=True, width=300, file=StringIO())
    show_results([result], tmp_path, console)
    text = console.export_text()
    assert "note     the table has no date" in text and "warning  look here" in text
    assert f"report  {tmp_path / 'flights' / 'b' / 'report.html'}" in text


def test_how_much_the_map_grew_is_told(tmp_path: Path) -> None:
    comparison = {"views": {"compared": 7, "outside": 5}, "compared_area_m2": 100.0, "reasons": {}}
    result = {
        "flight": "b", "seconds": 9.0, "peak_memory_mb": 300.0, "warnings": [], "notices": [],
        "changes": {"features": []},
        "comparison": comparison | {"extension": {"frames": 3, "shown_as_well": 2, "area_m2": 350.4}}, "taken_back": [],
    }
    console = Console(record=True, width=120, file=StringIO())
    show_results([result], tmp_path, console)
    assert "the map grew by 350 m2: 3 frames extended it; 2 more show the same ground" in console.export_text()


@pytest.mark.parametrize(("georeference", "shown", "not_shown"), [
    ({}, ["long m", "latitude, longitude", "204.250000, 289.500000", "100 m2"], ["units"]),
    ({"crs": None}, ["long units", "north, east", "204.2, 289.5", "100 square units"], ["latitude", " m2"]),
])
def test_a_map_without_metres_is_not_told_in_metres(
    tmp_path: Path, georeference: dict, shown: list[str], not_shown: list[str]
) -> None:
    ring = [[289.0, 204.0], [290.0, 204.0], [290.0, 204.5], [289.0, 204.5], [289.0, 204.0]]
    change = {
        "geometry": {"coordinates": [ring]},
        "properties": {
            "id": "b-1", "kind": "appeared", "length_m": 1.0, "sigma_m": 2.0, "views": 9, "score": 0.7,
            "class_before": None, "class_after": None,
        },
    }
    result = {
        "flight": "b", "seconds": 9.0, "peak_memory_mb": 300.0, "warnings": [], "notices": [], "taken_back": [],
        "changes": {"features": [change]} | georeference,
        "comparison": {"views": {"compared": 7}, "compared_area_m2": 100.0, "reasons": {}},
    }
    console = Console(record=True, width=120, file=StringIO())
    show_results([result], tmp_path, console)
    text = console.export_text()
    assert all(words in text for words in shown)
    assert not any(words in text for words in not_shown)
