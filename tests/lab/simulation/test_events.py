"""The list of true events: what came, left, moved or moves, and the frames in which it can be seen well."""

import json
from dataclasses import replace

import numpy as np
import pytest

from small_flights import simulate_into
from sorvolo.errors import SettingsError
from sorvolo.lab.simulation.flight import has_changed, simulate_flights
from sorvolo.lab.simulation.presets import preset
from sorvolo.lab.simulation.rendering import render_labels
from sorvolo.lab.simulation.settings import (
    ImagingSettings,
    LaterSettings,
    OutputSettings,
    PathSettings,
    RevisitSettings,
    SceneSettings,
    SimulationSettings,
    WeatherSettings,
)
from sorvolo.lab.simulation.truth import JOINED_GAP_M, change_mask, event_features, true_events
from sorvolo.lab.simulation.world import World, build_day

SETTINGS = SimulationSettings(
    seed=11,
    scene=SceneSettings("dirt", people=3, cars=2, small_objects=3, moving_share=0.6),
    path=PathSettings(height_m=14, speed_m_s=4, length_m=16, strips=1),
    imaging=ImagingSettings(320, 240, fps=10),
    later=LaterSettings(
        people=1, cars=1, small_objects=2, removed=2, moved=2, weather=WeatherSettings(wind_m=0.0)
    ),
    output=OutputSettings(truth_step=5),
)


@pytest.fixture(scope="module")
def later():
    return list(simulate_flights(SETTINGS))[1]


def test_each_thing_that_changed_is_one_event_per_place(later):
    first = {thing.id: thing for thing in later.world.days[0]}
    today = {thing.id: thing for thing in later.day.things}
    left = {id for id, thing in first.items() if has_changed(thing, today.get(id))}
    came = {id for id, thing in today.items() if id not in first or has_changed(first[id], thing)}
    events = true_events(later)
    assert sorted(e.before.id for e in events if e.before is not None) == sorted(left)
    assert sorted(e.after.id for e in events if e.after is not None) == sorted(came)
    assert {e.after.id for e in events if e.kind == "moving"} == {
        thing.id for thing in today.values() if thing.is_moving
    }
    assert any(e.kind == "moving" for e in events)
    moved = left & {id for id in came if not today[id].is_moving}
    assert moved  # gone here, new there


def test_the_first_flight_finds_nothing_new():
    assert true_events(next(simulate_flights(SETTINGS))) == []


def test_clear_views_show_the_whole_thing(later):
    events = [e for e in true_events(later) if e.after is not None and e.clear_views]
    assert len(events) >= 4
    for event in events:
        assert (
            np.diff(event.clear_views).min(initial=2) >= 2
        )  # 0.2 s of a video of ten frames a second
        index = event.clear_views[len(event.clear_views) // 2]
        labels, totals = render_labels(
            later.day.things,
            later.day.bodies,
            later.view(index),
            later.true_poses[index],
            float(later.from_middle_s[index]),
        )
        seen = labels == event.after.id
        assert seen.sum() > 0.5 * totals[event.after.id]
        assert (
            not seen[0].any()
            and not seen[:, 0].any()
            and not seen[-1].any()
            and not seen[:, -1].any()
        )
        place = event.after.place_m(float(later.from_middle_s[index]))[:2]
        assert np.allclose(event.path_m[len(event.clear_views) // 2], place)


def test_what_stands_where_something_left_is_one_replacement(later):
    first = {thing.id: thing for thing in later.world.days[0]}
    today = {thing.id: thing for thing in later.day.things}
    gone = next(thing for id, thing in first.items() if id not in today and thing.label.is_target)
    new = next(thing for thing in later.day.things if thing.id >= 1000 and not thing.is_moving)
    beside = replace(new, east_m=gone.east_m + 0.5 * JOINED_GAP_M, north_m=gone.north_m)
    things = tuple(beside if thing is new else thing for thing in later.day.things)
    world = World(later.world.ground, (later.world.days[0], things))
    day = build_day(world, SETTINGS, 2, SETTINGS.m_per_px)
    events = true_events(replace(later, world=world, day=day))
    (event,) = [e for e in events if gone in (e.before, e.after) or beside in (e.before, e.after)]
    assert (event.kind, event.before, event.after) == ("replaced", gone, beside)
    assert len(event.footprint_m) >= 4


def test_features_are_plain_json_and_repeat_exactly(later):
    features = event_features(later)
    text = json.dumps(features)
    again = list(simulate_flights(SETTINGS))[1]
    assert json.dumps(event_features(again)) == text
    kinds = {feature["properties"]["kind"] for feature in features}
    assert kinds <= {"appeared", "disappeared", "replaced", "moving"}
    for feature in features:
        reported = feature["properties"]
        assert bool(reported["class_before"]) == (reported["kind"] in ("disappeared", "replaced"))
        assert bool(reported["class_after"]) == (reported["kind"] != "disappeared")
        assert bool(reported["path"]) == (
            reported["kind"] == "moving" and bool(reported["clear_views"])
        )


@pytest.mark.long
def test_a_later_flight_may_have_its_own_camera_height_and_heading(tmp_path):
    other = ImagingSettings(480, 270, 75.0, fps=5)
    revisit = RevisitSettings(1.5, 90.0, other)
    settings = replace(SETTINGS, later=replace(SETTINGS.later, revisit=revisit))
    first, second = simulate_flights(settings)
    assert (first.camera.width_px, second.camera.width_px) == (320, 480)
    assert second.frame(3).image.shape == (270, 480, 3)
    assert second.true_poses[3].translation_m[2] > 1.3 * first.true_poses[3].translation_m[2]
    across = abs(
        float(first.path.heading_deg(np.zeros(1))[0] - second.path.heading_deg(np.zeros(1))[0])
    )
    assert abs(across - 90) < 15
    area = second.world.ground.area
    corners = np.array([[area.west_m, area.south_m], [area.east_m, area.north_m]])
    for pose in second.true_poses[::4]:
        rays = second.camera.rays_from_pixels(second.camera.corners_px) @ pose.rotation.T
        ground = pose.translation_m[:2] - rays[:, :2] / rays[:, 2:] * pose.translation_m[2]
        assert (ground > corners[0]).all() and (ground < corners[1]).all()
    simulate_into(tmp_path / "site", settings)
    assert "480" in (tmp_path / "site/flight2/camera.xml").read_text()
    assert "320" in (tmp_path / "site/camera.xml").read_text()
    events = json.loads((tmp_path / "site/truth/flight2/events.geojson").read_text())
    assert len(events["features"]) >= 6
    assert not (tmp_path / "site/truth/flight1/events.geojson").exists()


@pytest.mark.long
def test_night_and_snow_change_the_picture_but_no_event():
    def second(weather: WeatherSettings):
        return list(
            simulate_flights(replace(SETTINGS, later=replace(SETTINGS.later, weather=weather)))
        )[1]

    day, night, snow = (
        second(WeatherSettings(False, False, 0.0)),
        second(WeatherSettings(False, False, 0.0, brightness=0.06)),
        second(WeatherSettings(False, False, 0.0, snow=1.0)),
    )
    brightness = [flight.frame(5).image.mean() for flight in (day, night, snow)]
    assert brightness[1] < 0.15 * brightness[0] < 0.15 * brightness[2]
    ground = snow.day.ground.rgb.astype(int)
    assert np.median(ground.max(axis=2) - ground.min(axis=2)) < 8  # white
    assert [e.kind for e in true_events(day)] == [e.kind for e in true_events(snow)]
    half = second(WeatherSettings(False, False, 0.0, snow=0.5)).day.ground.rgb
    assert 0.3 < (half.min(axis=2) > 190).mean() < 0.7


@pytest.mark.long
def test_a_comparing_preset_has_changes_of_every_kind():
    settings = preset("compare")
    small = replace(
        settings,
        seed=3,
        imaging=ImagingSettings(320, 180, fps=5),
        scene=replace(settings.scene, ground="dirt", has_scenery=False),
    )
    first, second = simulate_flights(small)
    kinds = [event.kind for event in true_events(second)]
    assert len(kinds) >= 10 and {"appeared", "disappeared", "moving"} <= set(kinds)
    assert not any(thing.is_moving for thing in first.day.things)


@pytest.mark.parametrize(
    "make",
    [
        lambda: WeatherSettings(snow=1.5),
        lambda: WeatherSettings(brightness=-1),
        lambda: RevisitSettings(0.1),
    ],
)
def test_impossible_later_flights_are_refused(make):
    with pytest.raises(SettingsError, match="must lie in"):
        make()


def test_a_preset_without_changes_has_none():
    settings = preset("compare-none")
    small = replace(
        settings,
        imaging=ImagingSettings(160, 90, fps=5),
        scene=replace(settings.scene, ground="dirt", has_scenery=False),
    )
    first, second = simulate_flights(small)
    assert true_events(second) == []
    assert not change_mask(second, 5).any()
    assert np.abs(first.day.light.sun - second.day.light.sun).max() > 0.01
