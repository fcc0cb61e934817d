"""`sorvolo evaluate changes`: reports made from the truth, spoilt in known ways, come back as those numbers."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from small_flights import simulate_into
from sorvolo.cli.evaluate import evaluate_app
from sorvolo.errors import InputError, SettingsError, StoreError
from sorvolo.lab.evaluation.change_metrics import compared_ground
from sorvolo.lab.evaluation.changes import evaluate_changes
from sorvolo.lab.evaluation.frame_rows import time_ns_of
from sorvolo.lab.simulation.settings import (
    ImagingSettings,
    LaterSettings,
    OutputSettings,
    PathSettings,
    SceneSettings,
    SimulationSettings,
)
from sorvolo.store.exports.plain import utc_text
from sorvolo.store.site.archive import Archive
from sorvolo.survey.flight import Site

SETTINGS = SimulationSettings(
    seed=21,
    scene=SceneSettings(
        "dirt", people=2, cars=1, small_objects=3, has_scenery=False, moving_share=0.4
    ),
    path=PathSettings(height_m=14, speed_m_s=4, length_m=24, strips=1),
    imaging=ImagingSettings(320, 240, fps=10),
    later=LaterSettings(people=2, cars=1, small_objects=2, removed=2, moved=1),
    output=OutputSettings(truth_step=10),
)
SHIFT_DEG = 4e-6  # the map lies 0.44 m north of the truth


@pytest.fixture(scope="module")
def simulated(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("changes") / "simulated"
    return simulate_into(folder, SETTINGS)


def shifted(geometry: dict, north_deg: float, east_deg: float = 0.0) -> dict:
    ring = [[x + east_deg, y + north_deg] for x, y in geometry["coordinates"][0]]
    return {"type": "Polygon", "coordinates": [ring]}


def features(path: Path) -> list[dict]:
    return json.loads(path.read_text())["features"]


def write(path: Path, found: list[dict]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({"type": "FeatureCollection", "features": found}))


@pytest.fixture
def site(simulated, tmp_path) -> Path:
    """A site whose map is the truth, 0.44 m too far north, and whose second flight reports every true event."""
    folder = tmp_path / "site"
    with Archive.open(folder, write=True) as archive:
        archive.create_site(Site("field", SETTINGS.scene.origin, "EPSG:32633", 0.03))
    for name in ("flight1", "flight2"):
        rows = [
            {
                **each,
                "geometry": shifted(each["geometry"], SHIFT_DEG),
                "properties": {
                    **each["properties"],
                    "status": "vision" if name == "flight1" else "compared",
                },
            }
            for each in features(simulated / "truth/frames.geojson")
            if each["properties"]["flight"] == name
        ]
        write(folder / "flights" / name / "frames.geojson", rows)
    events = [
        {
            "type": "Feature",
            "geometry": shifted(each["geometry"], SHIFT_DEG),
            "properties": {
                "id": f"flight2-{each['properties']['number']}",
                "kind": each["properties"]["kind"],
                "sigma_m": 0.05,
            },
        }
        for each in features(simulated / "truth/flight2/events.geojson")
    ]
    write(folder / "flights/flight2/changes.geojson", events)
    return folder


def edit(site: Path, change) -> None:
    path = site / "flights/flight2/changes.geojson"
    events = features(path)
    change(events)
    write(path, events)


def test_a_perfect_report_is_perfect(site, simulated):
    (measured,) = evaluate_changes(site, simulated)
    scores = measured.events
    assert scores.must_find >= 6
    assert (scores.found_share, scores.twice, scores.false) == (1.0, 0, 0)
    assert scores.named_right == scores.found
    assert scores.error_median_m < 0.02
    assert scores.within_two_sigma > 0.9
    assert (
        scores.world_within_two_sigma < 0.6
    )  # to the north all of it is 0.44 m off, and 0.05 m is stated
    assert measured.map_shift_m == pytest.approx(0.444, abs=0.01)
    assert measured.masks is None
    assert any("--masks" in remark for remark in measured.remarks)
    assert any("late" in remark for remark in measured.remarks)


def test_each_fault_is_counted_as_what_it_is(site, simulated):
    (measured,) = evaluate_changes(site, simulated)
    before, missed = measured.events, measured.match.pairs[0]

    def spoil(events):
        events[:] = [each for each in events if each["properties"]["id"] != missed.found.id]
        again = next(
            each for each in events if each["properties"]["id"] == measured.match.pairs[1].found.id
        )
        events.append({**again, "properties": {**again["properties"], "id": "again"}})
        events.append(
            {
                **again,
                "geometry": shifted(again["geometry"], 30e-5),
                "properties": {**again["properties"], "id": "false"},
            }
        )

    edit(site, spoil)
    (measured,) = evaluate_changes(site, simulated)
    after = measured.events
    assert (after.found, after.twice, after.false) == (before.found - 1, 1, 1)
    assert after.false_per_hectare == pytest.approx(1e4 / after.compared_m2)
    assert [each.id for each in measured.match.missed] == [missed.true.id]


def test_late_needs_to_know_when(site, simulated):
    (measured,) = evaluate_changes(site, simulated)
    assert measured.events.judged_late == 0
    third_ns = {pair.found.id: int(pair.true.clear_ns[2]) for pair in measured.match.pairs}
    for delay_s, late in ((0.9, 0), (1.1, len(third_ns)), (None, None)):

        def announce(events, delay_s=delay_s):
            for each in events:
                at_ns = third_ns.get(each["properties"]["id"])
                given = (
                    None
                    if at_ns is None or delay_s is None
                    else utc_text(at_ns + round(delay_s * 1e9))
                )
                each["properties"]["announced"] = given

        edit(site, announce)
        (given,) = evaluate_changes(site, simulated)
        assert given.events.judged_late == len(third_ns)
        assert given.events.late == late or (
            late is None and given.events.late > 0
        )  # only after the last frame


def test_a_clock_without_a_date_is_understood(site, simulated):
    """A log without dates counts from 1970: frames and announcements do, the truth does not."""
    (measured,) = evaluate_changes(site, simulated)
    start_ns = 1_779_000_000 * 10**9
    path = site / "flights/flight2/frames.geojson"
    rows = features(path)
    for row in rows:
        row["properties"]["time"] = utc_text(time_ns_of(row["properties"]["time"]) - start_ns)
    write(path, rows)
    stated = {
        pair.found.id: int(pair.true.clear_ns[2]) - start_ns + 700_000_000
        for pair in measured.match.pairs
    }

    def announce(events):
        for each in events:
            at_ns = stated.get(each["properties"]["id"])
            each["properties"]["announced"] = None if at_ns is None else utc_text(at_ns)

    edit(site, announce)
    (given,) = evaluate_changes(site, simulated)
    assert [pair.delay_s for pair in given.match.pairs] == pytest.approx(
        [0.7] * len(stated), abs=1e-3
    )


def test_only_what_lies_on_compared_ground_must_be_found(site, simulated):
    (whole,) = evaluate_changes(site, simulated)
    path = site / "flights/flight2/frames.geojson"
    rows = features(path)
    for row in rows[len(rows) // 2 :]:
        row["properties"]["status"] = "not-aligned"
    write(path, rows)
    (half,) = evaluate_changes(site, simulated)
    assert half.events.must_find < whole.events.must_find
    assert half.events.compared_m2 < 0.8 * whole.events.compared_m2
    assert half.events.false == 0  # what is outside is neither found nor false
    assert half.events.optional > whole.events.optional


def test_photos_under_their_folders_name_are_paired_by_time(site, simulated):
    for name, new in (("flight1", "photos"), ("flight2", "photos-2")):
        (site / "flights" / name).rename(site / "flights" / new)
    (measured,) = evaluate_changes(site, simulated)
    assert measured.flight == "photos-2"
    assert measured.events.found_share == 1.0
    assert measured.map_shift_m == pytest.approx(0.444, abs=0.01)


def test_masks_of_a_site_are_judged_where_frames_are_common(site, simulated):
    masks = site / "flights/flight2/masks"
    masks.mkdir()
    sizes = []
    for path in sorted((simulated / "truth/flight2/changes").iterdir())[:3]:
        mask = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        mask[:10] = 128
        sizes.append(mask.size)
        cv2.imwrite(str(masks / f"{int(path.stem):06d}.png"), mask)
    cv2.imwrite(str(masks / "000001.png"), mask)
    (masks / "boxes.json").write_text("{}")
    (measured,) = evaluate_changes(site, simulated)
    scores = measured.masks
    assert (scores.compared, scores.only_found) == (3, 1)
    assert scores.pixels.unknown == 3 * 10 * 320
    assert scores.pixels.fp == scores.pixels.fn == 0
    assert scores.pixels.tp + scores.pixels.tn + scores.pixels.unknown == sum(sizes)
    assert scores.frames.tp + scores.frames.tn == 3


def mask_folder(folder: Path, masks: dict[str, np.ndarray]) -> Path:
    folder.mkdir()
    for name, mask in masks.items():
        cv2.imwrite(str(folder / name), mask)
    return folder


def test_mask_folders_of_any_form(tmp_path):
    truth = np.zeros((20, 30), np.uint8)
    truth[5:15, 5:15] = 1  # any value but zero
    colour = np.zeros((20, 30, 4), np.uint8)
    colour[..., 3] = 255
    colour[5:15, 10:20, 2] = 200
    jpeg = np.where(truth > 0, 255, 0).astype(np.uint8)
    found = mask_folder(tmp_path / "found", {"a.png": colour, "0007.jpg": jpeg, "c.png": truth * 0})
    true = mask_folder(
        tmp_path / "true",
        {"a.bmp": truth, "7.png": truth * 200, "c.tif": truth * 0, "d.png": truth},
    )
    (measured,) = evaluate_changes(found, true)
    counts = measured.masks.pixels
    assert abs(counts.tp - 150) <= 2 and abs(counts.fp - 50) <= 2 and abs(counts.fn - 50) <= 2
    assert (measured.masks.frames.tp, measured.masks.frames.tn) == (2, 1)
    assert (measured.masks.compared, measured.masks.only_true) == (3, 1)
    (strict,) = evaluate_changes(found, true, least_px=150)
    assert (strict.masks.frames.unknown, strict.masks.frames.tn) == (2, 1)


def test_what_cannot_be_measured_names_the_reason(site, simulated, tmp_path):
    empty = tmp_path / "empty"
    empty.mkdir()
    small = mask_folder(tmp_path / "small", {"0.png": np.zeros((5, 5), np.uint8)})
    other = mask_folder(tmp_path / "other", {"x.png": np.zeros((5, 5), np.uint8)})
    for found, truth, words in (
        (tmp_path / "nothing", simulated, "no such folder"),
        (empty, small, "no masks in it"),
        (small, empty, "neither the truth"),
        (small, empty / "nosuch", "no such folder: .*nosuch; give the folder"),
        (small, other, "no mask in"),
        (small, simulated, "differ in size"),
        (site, small, "writes_masks"),
    ):
        with pytest.raises(InputError, match=words):
            evaluate_changes(found, truth)
    with pytest.raises(SettingsError, match="flight2"):
        evaluate_changes(site, simulated, flight="flight9")
    (small / "1.png").write_bytes(b"no picture")
    (small / "00.png").write_bytes((small / "0.png").read_bytes())
    with pytest.raises(InputError, match="one frame"):
        evaluate_changes(small, small)
    (small / "00.png").unlink()
    with pytest.raises(InputError, match="as a picture"):
        evaluate_changes(small, small)
    (site / "flights/flight2/changes.geojson").unlink()
    with pytest.raises(InputError, match="sorvolo compare"):
        evaluate_changes(site, simulated)


def test_a_flight_that_is_there_only_in_part_is_refused(site, simulated):
    path = site / "flights/flight2/frames.geojson"
    path.write_text(path.read_text()[:200])
    with pytest.raises(InputError, match="cannot be read"):
        evaluate_changes(site, simulated)
    path.unlink()
    with pytest.raises(InputError, match="only in part"):
        evaluate_changes(site, simulated)


def test_a_report_that_is_none_is_refused(site, simulated, tmp_path):
    edit(site, lambda events: events[0]["properties"].pop("kind"))
    with pytest.raises(InputError, match=r"formats\.md"):
        evaluate_changes(site, simulated)
    other = tmp_path / "other"
    (other / "flights/flight2").mkdir(parents=True)
    write(other / "flights/flight2/changes.geojson", [])
    with pytest.raises(StoreError):
        evaluate_changes(other, simulated)
    simulate_into(tmp_path / "single", replace(SETTINGS, flights=1))
    with pytest.raises(InputError, match="second flight"):
        evaluate_changes(site, tmp_path / "single")


def test_the_command_prints_tables_and_json(site, simulated):
    runner = CliRunner()
    plain = runner.invoke(
        evaluate_app, ["changes", str(site), "--truth", str(simulated)], env={"COLUMNS": "160"}
    )
    assert plain.exit_code == 0
    assert "reported twice" in plain.output and "found 100.0%" in plain.output
    answer = runner.invoke(
        evaluate_app, ["changes", str(site), "--truth", str(simulated), "--json"]
    )
    (content,) = json.loads(answer.output)
    assert content["events"]["found_share"] == 1.0
    assert content["pixels"] is None
    assert len(content["lists"]["found"]) == content["events"]["found"]
    masks = simulated / "truth/flight2/changes"
    table = runner.invoke(
        evaluate_app, ["changes", str(masks), "--truth", str(masks)], env={"COLUMNS": "160"}
    )
    assert "100.00%" in table.output


def test_compared_ground_is_what_both_saw():
    square = np.array([[0.0, 0], [10, 0], [10, 10], [0, 10]])
    ground = compared_ground([square, square + 2], [square + np.array([5.0, 0.0])])
    assert ground.area_m2 == pytest.approx(5 * 10 + 2 * 8, rel=0.03)
    assert ground.holds(np.array([[6.0, 5], [4, 5], [11, 11], [50, -50]])).tolist() == [
        True,
        False,
        False,
        False,
    ]
    assert compared_ground([], [square]).area_m2 == 0
    assert not compared_ground([], []).holds(square).any()
