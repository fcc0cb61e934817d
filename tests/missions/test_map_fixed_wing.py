"""A fixed-wing survey, simulated small: banked, rolled, blown off its nose's way, with 60 % overlap; and a real one."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from real_data import real_data
from small_flights import simulate_into
from sorvolo.cli import main as cli
from sorvolo.errors import SettingsError
from sorvolo.lab.simulation.path import fly
from sorvolo.lab.simulation.presets import preset
from sorvolo.lab.simulation.settings import MotionSettings, PathSettings


def report_of(site: Path) -> dict[str, Any]:
    return json.loads(next(site.glob("flights/*/report.json")).read_text())


def test_a_small_survey_is_mapped_whole_and_in_one_piece(tmp_path: Path) -> None:
    wing = preset("fixed-wing")
    small = replace(
        wing,
        seed=7,
        scene=replace(wing.scene, people=0, cars=0, small_objects=0, has_scenery=False),
        path=replace(wing.path, length_m=110, strips=2),
        imaging=replace(wing.imaging, width_px=400, height_px=300),
    )
    simulate_into(tmp_path / "flown", small)
    photos = tmp_path / "flown" / "flight1" / "photos"
    site, camera = tmp_path / "site", str(tmp_path / "flown" / "camera.xml")
    assert (
        cli.main(["map", str(photos), "--site", str(site), "--model", "none", "--camera", camera])
        == 0
    )
    report = report_of(site)
    assert report["frames"]["vision"] == report["frames"]["selected"] >= 9
    assert [each["frames"] for each in report["pieces"]] == [report["frames"]["selected"]]
    assert report["gps_residual_m"]["rms"] < 4.0
    assert report["height_above_ground_m"] == pytest.approx(65, abs=4)


def test_wind_makes_a_wing_faster_downwind_and_turns_its_nose_and_turns_bank_it() -> None:
    path = PathSettings(
        height_m=65, speed_m_s=13, length_m=300, strips=2, strip_spacing_m=40, heading_deg=90
    )
    calm = MotionSettings(0, 0, 0, 0, is_fixed_wing=True)
    windy = replace(calm, wind_m_s=5.0, wind_from_deg=270.0)  # along the first strip
    across = replace(calm, wind_m_s=5.0, wind_from_deg=0.0)
    times = np.linspace(3.0, 8.0, 6)

    def flown(motion: MotionSettings) -> tuple[float, float]:
        found = fly(path, motion, np.random.default_rng(1))
        speed = np.linalg.norm(found.velocity_m_s(times)[:, :2], axis=1).mean()
        return float(speed), float(found.heading_deg(times).mean())

    assert flown(calm) == pytest.approx((13.0, 90.0), abs=0.1)
    assert flown(windy) == pytest.approx((18.0, 90.0), abs=0.1)
    speed, heading = flown(across)
    assert speed == pytest.approx(12.0, abs=0.1) and heading == pytest.approx(
        90 - np.degrees(np.arcsin(5 / 13)), abs=1
    )

    whole = fly(path, calm, np.random.default_rng(1))
    banks = [abs(float(whole.bank(each))) for each in np.linspace(0, whole.duration_s, 200)]
    assert max(banks) > 15 and float(np.median(banks)) < 1
    level = fly(path, replace(calm, is_fixed_wing=False), np.random.default_rng(1))
    assert max(abs(float(level.bank(each))) for each in np.linspace(0, level.duration_s, 50)) == 0
    with pytest.raises(SettingsError, match="too strong"):
        fly(path, replace(calm, wind_m_s=12.0), np.random.default_rng(1))
    with pytest.raises(SettingsError, match="fixed wings only"):
        MotionSettings(wind_m_s=3.0)


@pytest.mark.long
def test_a_real_survey_is_one_map_within_what_its_receiver_errs(tmp_path: Path) -> None:
    photos = real_data("flights/fixed_wing")
    coarse = [
        "--gsd",
        "0.4",
        "--model",
        "none",
    ]  # how finely it is painted has nothing to do with where it lies
    assert cli.main(["map", str(photos), "--site", str(tmp_path / "site"), *coarse]) == 0
    report = report_of(tmp_path / "site")
    assert (
        report["frames"]["vision"] >= 0.95 * report["frames"]["selected"]
        and len(report["pieces"]) == 1
    )
    assert report["gps_residual_m"]["rms"] <= 3.0
    assert report["height_above_ground_m"] == pytest.approx(65, abs=5)
