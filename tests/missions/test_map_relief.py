"""`sorvolo map` over hills: the flat map reports that the ground is not level, and over level ground it does not."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from small_flights import simulate_into, small_flight
from sorvolo.cli.main import main
from sorvolo.simulation.settings import OutputSettings

_LEVEL = small_flight(
    6, length_m=20, spacing_m=8, noise_m=0.3, size_px=(400, 300), output=OutputSettings(photos=True, photo_overlap=0.7)
)


@pytest.mark.parametrize("relief_m", [0.0, 7.0])
def test_the_report_names_ground_that_is_not_level(relief_m: float, tmp_path: Path) -> None:
    simulate_into(tmp_path / "made", replace(_LEVEL, scene=replace(_LEVEL.scene, relief_m=relief_m)))
    photos = tmp_path / "made" / "flight1" / "photos"
    camera = str(tmp_path / "made" / "camera.xml")
    assert main(["map", str(photos), "--site", str(tmp_path / "site"), "--model", "none", "--camera", camera]) == 0
    report = json.loads(next((tmp_path / "site").glob("flights/*/report.json")).read_text())
    assert any("the ground is not level" in each for each in report["warnings"]) == (relief_m > 0)
