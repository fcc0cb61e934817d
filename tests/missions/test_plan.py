"""`sorvolo plan` from options to files."""

import json
import math
from xml.etree import ElementTree

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from sorvolo.cli.plan import plan as plan_command
from sorvolo.errors import InputError, SettingsError
from sorvolo.geometry.planning import BOTTOM_CRITICAL_M, FRONT_CRITICAL_M, Task
from sorvolo.missions.plan_flight import (
    PlanSettings,
    answer_questions,
    camera_to_plan_with,
    critical_dimension_m,
    plan_over,
    write_plan,
)
from sorvolo.survey.area import Area

THESIS_LENS = camera_to_plan_with("", 1.7, 6.97, (1280, 720))
FIELD = [[12.5, 41.9], [12.503, 41.9], [12.503, 41.902], [12.5, 41.902]]
AREA = Area(((np.array(FIELD),),), "field")
APP = typer.Typer()
APP.command()(plan_command)


@pytest.fixture
def field_file(tmp_path):
    path = tmp_path / "field.geojson"
    path.write_text(json.dumps({"type": "Polygon", "coordinates": [[*FIELD, FIELD[0]]]}))
    return path


def run(*arguments):
    return CliRunner().invoke(APP, [str(each) for each in arguments])


def test_the_thesiss_heights_come_out_of_the_command():
    result = run("--focal-mm", 1.7, "--pixel-um", 6.97, "--task", "detection", "--facing", "front", "--json")
    assert result.exit_code == 0, result.output
    answers = json.loads(result.output)
    heights_m = answers["maximum_heights_m"]
    assert math.floor(heights_m["detection"] * 100) == 12195
    assert math.floor(heights_m["recognition"] * 100) == 3048
    assert math.floor(heights_m["identification"] * 100) == 1524
    assert answers["height_m"] == heights_m["detection"]
    assert answers["fulfilled_tasks"] == ["detection"]


def test_answers_fit_together():
    settings = PlanSettings(Task.DETECTION, FRONT_CRITICAL_M, height_m=20, speed_m_s=4, forward_overlap=0.6)
    answers = answer_questions(THESIS_LENS, settings)
    assert answers.height_m == 20.0
    assert set(answers.fulfilled_tasks) == {"detection", "recognition"}
    assert answers.footprint_m[0] == pytest.approx(answers.ground_sampling_m * 1280)
    assert answers.footprint_m[1] == pytest.approx(answers.ground_sampling_m * 720)
    assert answers.photo_spacing_m == pytest.approx(0.4 * answers.footprint_m[1])
    assert answers.minimum_frame_rate_hz == pytest.approx(4.0 / answers.photo_spacing_m)


def test_the_critical_dimension_is_the_persons_unless_given():
    assert critical_dimension_m("front", math.nan) == FRONT_CRITICAL_M
    assert critical_dimension_m("bottom", math.nan) == BOTTOM_CRITICAL_M
    assert critical_dimension_m("bottom", 2.0) == 2.0


def test_a_preset_plans_with_its_full_photo():
    model = camera_to_plan_with("Mavic 2 Pro", math.nan, math.nan, None)
    assert (model.camera.width_px, model.camera.height_px) == (5472, 3648)


@pytest.mark.parametrize(("option", "focal_mm", "pixel_um"), [
    ("", math.nan, math.nan), ("", 4.0, math.nan), ("Mavic 2 Pro", 4.0, 2.0), ("", 0.0, 2.0), ("", 4.0, -2.0),
])
def test_a_camera_that_is_not_told_is_asked_for(option, focal_mm, pixel_um):
    with pytest.raises(SettingsError):
        camera_to_plan_with(option, focal_mm, pixel_um, None)


def test_a_nonsense_camera_lists_the_presets():
    with pytest.raises(InputError, match="Phantom 3"):
        camera_to_plan_with("Concorde", math.nan, math.nan, None)


@pytest.fixture
def flight():
    answers = answer_questions(THESIS_LENS, PlanSettings(height_m=30.0, side_overlap=0.3))
    return plan_over(AREA, answers, PlanSettings(height_m=30.0, side_overlap=0.3))


def test_qgroundcontrol_plan(tmp_path, flight):
    path = tmp_path / "field.plan"
    write_plan(path, flight, AREA)
    plan = json.loads(path.read_text())
    assert (plan["fileType"], plan["version"]) == ("Plan", 1)
    assert plan["geoFence"]["version"] == plan["rallyPoints"]["version"] == 2
    mission = plan["mission"]
    assert mission["version"] == 2
    assert {"cruiseSpeed", "hoverSpeed", "firmwareType", "vehicleType", "plannedHomePosition"} <= set(mission)
    items = mission["items"]
    assert [item["doJumpId"] for item in items] == list(range(1, len(items) + 1))
    assert all(item["type"] == "SimpleItem" and len(item["params"]) == 7 for item in items)
    commands = [item["command"] for item in items]
    assert commands[0] == 22
    assert commands[-1] == 20
    waypoints = [item for item in items if item["command"] == 16]
    assert len(waypoints) == len(flight.waypoints_m)
    latitude_deg, longitude_deg, _ = AREA.frame.wgs84_from_site(flight.waypoints_m)
    found = np.array([item["params"][4:] for item in waypoints])
    np.testing.assert_allclose(found[:, 0], latitude_deg, atol=1e-8)
    np.testing.assert_allclose(found[:, 1], longitude_deg, atol=1e-8)
    assert (found[:, 2] == 30.0).all()
    # the camera goes on at every pass's start, off at its end
    triggers = [item["params"][0] for item in items if item["command"] == 206]
    assert triggers[::2] == pytest.approx([flight.photo_spacing_m] * len(flight.passes_m), abs=0.006)
    assert set(triggers[1::2]) == {0}


def test_geojson_and_kml_hold_the_same_path(tmp_path, flight):
    write_plan(tmp_path / "field.geojson", flight, AREA)
    write_plan(tmp_path / "field.kml", flight, AREA)
    line, *points = json.loads((tmp_path / "field.geojson").read_text())["features"]
    assert line["geometry"]["type"] == "LineString"
    assert line["properties"]["photos"] == flight.photo_count
    assert [point["geometry"]["coordinates"] for point in points] == line["geometry"]["coordinates"]
    tree = ElementTree.parse(tmp_path / "field.kml")
    texts = [each.text for each in tree.iter() if each.tag.endswith("coordinates")]
    path = np.array([[float(number) for number in place.split(",")] for place in texts[0].split()])
    np.testing.assert_allclose(path[:, :2], line["geometry"]["coordinates"], atol=1e-9)
    assert (path[:, 2] == 30.0).all()


def test_another_ending_is_refused_and_nothing_is_left(tmp_path, flight):
    with pytest.raises(SettingsError, match=r"\.plan, \.geojson"):
        write_plan(tmp_path / "field.shp", flight, AREA)
    assert list(tmp_path.iterdir()) == []


def test_the_command_covers_an_area(tmp_path, field_file):
    out = tmp_path / "field.plan"
    result = run("--camera", "aov=70", "--height", 40, "--area", field_file, "--out", out, "--json")
    assert result.exit_code == 0, result.output
    answer = json.loads(result.output)
    assert answer["plan"]["photos"] > 50
    assert answer["plan"]["written"] == [str(out)]
    assert out.exists()


def test_the_table_tells_when_the_height_is_too_great(field_file):
    result = run("--camera", "FC300S", "--task", "identification", "--height", 200, "--area", field_file)
    assert result.exit_code == 0, result.output
    plain = " ".join(result.output.split())
    assert "too high for identification" in plain
    assert "120 m above ground" in plain
    assert "photos" in plain


@pytest.mark.parametrize("arguments", [
    ["--camera", "aov=70", "--out", "x.plan"], ["--camera", "aov=70", "--size", "big"],
    ["--camera", "aov=70", "--overlap", "1"], ["--camera", "aov=70", "--speed", "0"],
    ["--camera", "aov=70", "--height", "-3"], ["--camera", "aov=70", "--critical-m", "0"], [],
])
def test_options_that_cannot_be_are_one_clear_error(arguments):
    result = run(*arguments)
    assert isinstance(result.exception, SettingsError)
