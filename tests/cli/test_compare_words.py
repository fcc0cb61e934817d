"""What `sorvolo compare` says in the end."""

from io import StringIO
from pathlib import Path

from rich.console import Console

from sorvolo.cli.compare import show_results


def test_what_was_told_live_and_did_not_last_is_named(tmp_path: Path) -> None:
    result = {
        "flight": "b", "seconds": 9.0, "peak_memory_mb": 300.0, "warnings": [], "changes": {"features": []},
        "comparison": {"views": {"compared": 7}, "compared_area_m2": 100.0, "reasons": {}},
        "taken_back": ["b-4", "b-7"],
    }
    console = Console(record=True, width=120, file=StringIO())
    show_results([result], tmp_path, console)
    assert "taken back" in (text := console.export_text()) and "b-4, b-7" in text
    show_results([result | {"taken_back": []}], tmp_path, console)
    assert "taken back" not in console.export_text()
