"""`sorvolo plan` from options to files."""

import json
import math
import zipfile
from xml.etree import ElementTree

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from sorvolo.cli.plan import plan as plan_command
from sorvolo.detection.models import find_model
from sorvolo.detection.session import read_info
from sorvolo.errors import InputError, SettingsError
from sorvolo.geometry.planning import FRONT_CRITICAL_M, Task
from sorvolo.missions.plan_flight import (
    PlanSettings,
    answer_questions,
    camera_to_plan_with,
    plan_over,
    through_trees,
    write_plan,
)
from sorvolo.survey.area import Area

THESIS_LENS = camera_to_plan_with(f"focal_px={1.7 / 6.97e-3}", (1280, 720))
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
    # a lens of 1.7 mm, pixels of 6.97 um, a person who faces the camera: 0.75 m
    lens = ("--camera", f"focal_px={1.7 / 6.97e-3}", "--size", "1280x720")
    thesis = (*lens, "--task", "detection", "--critical-m", 0.75, "--json")
    result = run(*thesis, "--model", "none", "--max-height", 150)
    assert result.exit_code == 0, result.output
    answers = json.loads(result.output)
    heights_m = answers["maximum_heights_m"]
    assert math.floor(heights_m["detection"] * 100) == 12195
    assert math.floor(heights_m["recognition"] * 100) == 3048
    assert math.floor(heights_m["identification"] * 100) == 1524
    assert answers["height_m"] == heights_m["detection"]
    assert answers["fulfilled_tasks"] == ["detection"] and answers["bounded_by"] == "task"


def test_no_flight_is_planned_above_the_laws_limit():
    mavic = ("--camera", "Mavic 2 Pro", "--model", "none")  # no detector bounds it
    answers = json.loads(run(*mavic, "--task", "detection", "--json").output)
    assert answers["maximum_heights_m"]["detection"] == pytest.approx(1715.65, abs=0.01)
    assert (answers["height_m"], answers["bounded_by"]) == (120.0, "ceiling")
    table = " ".join(run(*mavic, "--task", "detection").output.split())
    assert (
        "120.00 m above ground" in table
        and "highest flight allowed" not in table.split("flight height")[0]
    )
    higher = json.loads(run(*mavic, "--max-height", 200, "--json").output)
    assert higher["height_m"] == 200.0
    assert "get a permit" in " ".join(run(*mavic, "--max-height", 200).output.split())
    refused = run(*mavic, "--height", 150)
    assert isinstance(refused.exception, SettingsError) and "max_height_m" in str(refused.exception)


def test_the_packaged_detector_bounds_the_height_by_its_own_word():
    least_px = read_info(find_model("default")).best_px["person"][0]
    answers = json.loads(
        run("--camera", "aov=70", "--size", "1920x1080", "--task", "detection", "--json").output
    )
    assert answers["bounded_by"] == "detector"
    # a person from above is 0.6 m long, and that many pixels at this height
    assert 0.6 / answers["ground_sampling_m"] == pytest.approx(least_px)
    alone = json.loads(
        run("--camera", "aov=70", "--task", "detection", "--model", "none", "--json").output
    )
    assert alone["bounded_by"] == "ceiling" and "detector" not in alone["height_bounds_m"]
    too_high = run("--camera", "aov=70", "--height", 100)
    assert "the detector will miss people" in " ".join(too_high.output.split())


def test_another_object_is_not_bounded_by_how_people_are_found():
    answers = answer_questions(THESIS_LENS, PlanSettings(critical_m=4.0, person_m=None))
    assert set(answers.height_bounds_m) == {"task", "ceiling"}


def test_answers_fit_together():
    settings = PlanSettings(
        Task.DETECTION, FRONT_CRITICAL_M, height_m=20, speed_m_s=4, forward_overlap=0.6
    )
    answers = answer_questions(THESIS_LENS, settings)
    assert answers.height_m == 20.0
    assert set(answers.fulfilled_tasks) == {"detection", "recognition"}
    assert answers.footprint_m[0] == pytest.approx(answers.ground_sampling_m * 1280)
    assert answers.footprint_m[1] == pytest.approx(answers.ground_sampling_m * 720)
    assert answers.photo_spacing_m == pytest.approx(0.4 * answers.footprint_m[1])
    assert answers.minimum_frame_rate_hz == pytest.approx(4.0 / answers.photo_spacing_m)


def test_strips_are_so_close_that_enough_pictures_show_each_spot_between_crowns():
    settings = PlanSettings(height_m=45.0)
    thermal = camera_to_plan_with("aov=50", (512, 512))
    half, dense = (
        answer_questions(thermal, through_trees(settings, hidden)) for hidden in (0.5, 0.97)
    )
    assert 3.5 < half.strip_spacing_m < 4.5 and 1.8 < half.photo_spacing_m < 2.3
    assert half.views * 0.5 > 12 and dense.views * 0.03 == pytest.approx(12)
    assert dense.strip_spacing_m < half.strip_spacing_m
    assert "detector" not in half.height_bounds_m
    named = through_trees(PlanSettings(height_m=45.0, model="thermal"), 0.5)
    assert answer_questions(thermal, named).height_bounds_m["detector"] < 120
    closer = through_trees(PlanSettings(forward_overlap=0.97, side_overlap=0.95), 0.5)
    assert (closer.forward_overlap, closer.side_overlap) == (0.97, 0.95)
    shown = run("--camera", "aov=50", "--height", 45, "--through-trees", 0.5, "--size", "512x512")
    assert "200 pictures, 100 of them between crowns" in " ".join(shown.output.split())
    refused = run("--camera", "aov=50", "--through-trees", 0.99)
    assert isinstance(refused.exception, SettingsError) and "0 to 0.97" in str(refused.exception)


def test_a_preset_plans_with_its_full_photo():
    model = camera_to_plan_with("Mavic 2 Pro")
    assert (model.camera.width_px, model.camera.height_px) == (5472, 3648)


def test_a_nonsense_camera_lists_the_presets():
    with pytest.raises(InputError, match="Phantom 3"):
        camera_to_plan_with("Concorde")


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
    assert {
        "cruiseSpeed",
        "hoverSpeed",
        "firmwareType",
        "vehicleType",
        "plannedHomePosition",
    } <= set(mission)
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
    assert triggers[::2] == pytest.approx(
        [flight.photo_spacing_m] * len(flight.passes_m), abs=0.006
    )
    assert set(triggers[1::2]) == {0}
    # MAV_CMD_DO_MOUNT_CONTROL, straight down, before the first pass
    (gimbal,) = (item for item in items if item["command"] == 205)
    assert gimbal["params"][0] == -90 and gimbal["params"][6] == 2
    assert commands.index(205) < commands.index(16)


_NUMBER = (int, float)
_PLAN_KEYS = {  # what QGroundControl's loader asks for (its "Plan File Format", and MissionItem's own check)
    "": {
        "fileType": str,
        "version": int,
        "groundStation": str,
        "mission": dict,
        "geoFence": dict,
        "rallyPoints": dict,
    },
    "mission": {
        "version": int,
        "items": list,
        "plannedHomePosition": list,
        "firmwareType": int,
        "vehicleType": int,
        "cruiseSpeed": _NUMBER,
        "hoverSpeed": _NUMBER,
        "globalPlanAltitudeMode": int,
    },
    "geoFence": {"circles": list, "polygons": list, "version": int},
    "rallyPoints": {"points": list, "version": int},
}
_ITEM_KEYS = {
    "type": str,
    "frame": int,
    "command": int,
    "params": list,
    "autoContinue": bool,
    "doJumpId": int,
}
_PLACE_KEYS = {
    "Altitude": _NUMBER,
    "AltitudeMode": int,
    "AMSLAltAboveTerrain": (type(None), *_NUMBER),
}


def test_qgroundcontrols_loader_finds_all_it_asks_for(tmp_path, flight):
    path = tmp_path / "field.plan"
    write_plan(path, flight, AREA)
    plan = json.loads(path.read_text())
    for part, keys in _PLAN_KEYS.items():
        found = plan[part] if part else plan
        for key, kind in keys.items():
            assert isinstance(found[key], kind), (part, key)
    assert len(plan["mission"]["plannedHomePosition"]) == 3
    for item in plan["mission"]["items"]:
        keys = _ITEM_KEYS | (_PLACE_KEYS if item["frame"] == 3 else {})
        assert all(isinstance(item[key], kind) for key, kind in keys.items()), item
        assert len(item["params"]) == 7
        assert all(each is None or isinstance(each, _NUMBER) for each in item["params"][:4])
        assert all(isinstance(each, _NUMBER) for each in item["params"][4:])


_WPML = "{http://www.dji.com/wpmz/1.0.2}"
_KML = "{http://www.opengis.net/kml/2.2}"
_MISSION_KEYS = {
    "flyToWaylineMode",
    "finishAction",
    "exitOnRCLost",
    "executeRCLostAction",
    "takeOffSecurityHeight",
    "globalTransitionalSpeed",
    "globalRTHHeight",
    "droneInfo",
}
_TEMPLATE_KEYS = {
    "templateType",
    "templateId",
    "autoFlightSpeed",
    "waylineCoordinateSysParam",
    "globalWaypointTurnMode",
    "gimbalPitchMode",
    "globalHeight",
    "globalWaypointHeadingParam",
    "payloadParam",
}
_WAYLINES_KEYS = {"templateId", "waylineId", "autoFlightSpeed", "executeHeightMode"}
_WAYPOINT_KEYS = {
    "index",
    "executeHeight",
    "waypointSpeed",
    "waypointHeadingParam",
    "waypointTurnParam",
}
_GROUP_KEYS = {
    "actionGroupId",
    "actionGroupStartIndex",
    "actionGroupEndIndex",
    "actionGroupMode",
    "actionTrigger",
    "action",
}


def _names(element):
    return {each.tag.removeprefix(_WPML) for each in element if each.tag.startswith(_WPML)}


@pytest.mark.parametrize("drone", ["fly", "m3e", "m30t"])
def test_djis_kmz_holds_what_its_documentation_requires(tmp_path, flight, drone):
    path = tmp_path / "field.kmz"
    write_plan(path, flight, AREA, dji_drone=drone)
    with zipfile.ZipFile(path) as archive:
        assert archive.namelist() == ["wpmz/template.kml", "wpmz/waylines.wpml"]
        template, waylines = (
            ElementTree.fromstring(archive.read(name)) for name in archive.namelist()
        )
    for root, keys in ((template, _TEMPLATE_KEYS), (waylines, _WAYLINES_KEYS)):
        mission = root.find(f"{_KML}Document/{_WPML}missionConfig")
        assert _names(mission) >= _MISSION_KEYS | (set() if drone == "fly" else {"payloadInfo"})
        folder = root.find(f"{_KML}Document/{_KML}Folder")
        assert _names(folder) >= keys
        for group in folder.iter(f"{_WPML}actionGroup"):
            assert _names(group) == _GROUP_KEYS
    placemarks = waylines.findall(f".//{_KML}Placemark")
    assert (
        len(placemarks) == len(flight.waypoints_m) == len(template.findall(f".//{_KML}Placemark"))
    )
    assert all(_names(each) >= _WAYPOINT_KEYS for each in placemarks)
    assert [each.find(f"{_WPML}index").text for each in placemarks] == [
        str(each) for each in range(len(placemarks))
    ]
    assert {each.find(f"{_WPML}executeHeight").text for each in placemarks} == {"30"}
    places = np.array(
        [each.find(f"{_KML}Point/{_KML}coordinates").text.split(",") for each in placemarks], float
    )
    latitude_deg, longitude_deg, _ = AREA.frame.wgs84_from_site(flight.waypoints_m)
    np.testing.assert_allclose(places, np.column_stack([longitude_deg, latitude_deg]), atol=1e-8)
    pitches = [each.text for each in waylines.iter(f"{_WPML}gimbalPitchRotateAngle")]
    assert pitches == ["-90"] and {
        each.text for each in template.iter(f"{_WPML}gimbalPitchAngle")
    } == {"-90"}
    spacings = [float(each.text) for each in waylines.iter(f"{_WPML}actionTriggerParam")]
    assert spacings == pytest.approx([flight.photo_spacing_m] * len(flight.passes_m), abs=0.006)


def test_a_drone_without_djis_number_is_refused(tmp_path, flight):
    with pytest.raises(SettingsError, match="m3e"):
        write_plan(tmp_path / "field.kmz", flight, AREA, dji_drone="anafi")


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
    with pytest.raises(SettingsError, match=r"\.plan, \.kmz"):
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


def test_the_table_marks_heights_that_are_too_great(field_file):
    wanted = ("--task", "identification", "--height", 200, "--max-height", 200)
    result = run("--camera", "FC300S", *wanted, "--area", field_file)
    assert result.exit_code == 0, result.output
    plain = " ".join(result.output.split())
    assert "too high for identification" in plain
    assert "120 m above ground" in plain
    assert "photos" in plain


@pytest.mark.parametrize(
    "arguments",
    [
        ["--camera", "aov=70", "--out", "x.plan"],
        ["--camera", "aov=70", "--size", "big"],
        ["--camera", "aov=70", "--overlap", "1"],
        ["--camera", "aov=70", "--speed", "0"],
        ["--camera", "aov=70", "--height", "-3"],
        ["--camera", "aov=70", "--critical-m", "0"],
    ],
)
def test_options_that_cannot_be_are_one_clear_error(arguments):
    result = run(*arguments)
    assert isinstance(result.exception, SettingsError)
