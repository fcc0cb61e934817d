"""What `sorvolo compare` prints in the end."""

from io import StringIO
from pathlib import Path

import pytest
from rich.console import Console

from sorvolo.cli.compare import show_results
from sorvolo.cli.options import PlaceFormat


def test_withdrawn_changes_are_named(tmp_path: Path) -> None:
    result = {
        "flight": "b", "seconds": 9.0, "peak_memory_mb": 300.0, "warnings": [], "notices": [],
        "changes": {"features": []},
        "comparison": {"views": {"compared": 7}, "compared_area_m2": 100.0, "reasons": {}},
        "withdrawn": ["b-4", "b-7"],
    }
    console = Console(record=True, width=120, file=StringIO())
    show_results([result], tmp_path, console)
    assert "withdrawn (not confirmed by the whole flight): b-4, b-7" in console.export_text()
    show_results([result | {"withdrawn": []}], tmp_path, console)
    assert "withdrawn (" not in console.export_text()


def test_notices_and_the_report_are_shown_as_by_map(tmp_path: Path) -> None:
    result = {
        "flight": "b", "seconds": 9.0, "peak_memory_mb": 300.0, "changes": {"features": []}, "withdrawn": [],
        "comparison": {"views": {"compared": 7}, "compared_area_m2": 100.0, "reasons": {}},
        "notices": [{"code": "no_date", "count": 1, "text": "the table has no date"}], "warnings": ["look here"],
    }
    console = Console(record=True, width=300, file=StringIO())
    show_results([result], tmp_path, console)
    text = console.export_text()
    assert "note     the table has no date" in text and "warning  look here" in text
    assert f"report  {tmp_path / 'flights' / 'b' / 'report.html'}" in text


def test_how_much_the_map_grew_is_shown(tmp_path: Path) -> None:
    comparison = {"views": {"compared": 7, "outside": 5}, "compared_area_m2": 100.0, "reasons": {}}
    result = {
        "flight": "b", "seconds": 9.0, "peak_memory_mb": 300.0, "warnings": [], "notices": [],
        "changes": {"features": []},
        "comparison": comparison | {"extension": {"frames": 3, "shown_as_well": 2, "area_m2": 350.4}}, "withdrawn": [],
    }
    console = Console(record=True, width=120, file=StringIO())
    show_results([result], tmp_path, console)
    assert "the map grew by 350 m2 from 3 frames; 2 more frames show the same ground" in console.export_text()


@pytest.mark.parametrize(("georeference", "shown", "not_shown"), [
    ({}, ["1 change found", "length m", "latitude, longitude", "41.250000, 12.500000", "100 m2"], ["units"]),
    ({"crs": None}, ["length units", "east, north", "12.5, 41.2", "100 square units"], ["latitude", " m2"]),
])
def test_a_map_without_metres_is_not_shown_in_metres(
    tmp_path: Path, georeference: dict, shown: list[str], not_shown: list[str]
) -> None:
    ring = [[12.0, 41.0], [13.0, 41.0], [13.0, 41.5], [12.0, 41.5], [12.0, 41.0]]
    change = {
        "geometry": {"coordinates": [ring]},
        "properties": {
            "id": "b-1", "kind": "appeared", "length_m": 1.0, "sigma_m": 2.0, "views": 9, "score": 0.7,
            "class_before": None, "class_after": None,
        },
    }
    result = {
        "flight": "b", "seconds": 9.0, "peak_memory_mb": 300.0, "warnings": [], "notices": [], "withdrawn": [],
        "changes": {"features": [change]} | georeference,
        "comparison": {"views": {"compared": 7}, "compared_area_m2": 100.0, "reasons": {}},
    }
    console = Console(record=True, width=120, file=StringIO())
    show_results([result], tmp_path, console)
    text = console.export_text()
    assert all(words in text for words in shown)
    assert not any(words in text for words in not_shown)


@pytest.mark.parametrize(("form", "place"), [("utm", "33T 29053"), ("mgrs", "33T TF 90533 69524")])
def test_places_are_written_as_asked_for(tmp_path: Path, form: str, place: str) -> None:
    ring = [[12.4, 41.2], [12.6, 41.2], [12.6, 41.3], [12.4, 41.3], [12.4, 41.2]]
    change = {"geometry": {"coordinates": [ring]}, "properties": {
        "id": "b-1", "kind": "appeared", "length_m": 1.0, "sigma_m": 2.0, "views": 9, "score": 0.7,
        "class_before": None, "class_after": "car",
    }}
    result = {
        "flight": "b", "seconds": 9.0, "peak_memory_mb": 300.0, "warnings": [], "notices": [], "withdrawn": [],
        "changes": {"features": [change]},
        "comparison": {"views": {"compared": 7}, "compared_area_m2": 100.0, "reasons": {}},
    }
    console = Console(record=True, width=120, file=StringIO())
    show_results([result], tmp_path, console, PlaceFormat(form))
    assert place in console.export_text()
