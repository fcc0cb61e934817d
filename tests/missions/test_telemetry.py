"""The telemetry doctor on simulated flights whose compass, clock and heights are wrong by known amounts."""

import csv
import json
import re
import shutil
import socket
import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import av
import numpy as np
import pytest
from stanag4609.st0601 import decode_uas_local_set
from stanag4609.st0903 import resolve_vtarget_location

from sealing import seal_again, write_again
from small_flights import simulate_into, small_flight
from sorvolo.capture.correction import corrected_poses, fitted, path_fit, telemetry_faults
from sorvolo.capture.live.klv_telemetry import read_klv_file
from sorvolo.capture.source import opened_sources
from sorvolo.cli.main import main
from sorvolo.errors import InputError
from sorvolo.geometry.pose import Pose, gimbal_angles_from_rotation, site_from_gimbal_rotation
from sorvolo.lab.simulation.settings import OutputSettings
from sorvolo.missions.flight.settings import MapSettings
from sorvolo.missions.map.flights import map_flights
from sorvolo.missions.telemetry.doctor import (
    CotReceiver,
    TelemetryOutcome,
    correct_telemetry,
    fault_sentences,
    mapped_flights,
)
from sorvolo.missions.watch.cot_sender import CotPlace
from sorvolo.store.exports.detection_files import DetectionLines, claimed_folder
from sorvolo.survey.corrected import AS_THE_MAP, Bias
from sorvolo.survey.flight import CameraPrior

COMPASS_DEG, CLOCK_S, HEIGHT_M = 7.0, 0.4, 6.0


@pytest.fixture(scope="module")
def faulty(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A filmed flight whose log turns the compass by 7 degrees, lags by 0.4 s, and is 6 m too high."""
    folder = tmp_path_factory.mktemp("faulty") / "flight"
    settings = small_flight(
        77,
        height_m=30,
        length_m=40,
        spacing_m=9,
        size_px=(320, 240),
        fps=6,
        output=OutputSettings(telemetry="csv"),
    )
    settings = replace(settings, sensor=replace(settings.sensor, clock_offset_s=CLOCK_S))
    simulate_into(folder, settings)
    _made_wrong(next((folder / "flight1").glob("*.csv")))
    return folder


def _made_wrong(path: Path) -> None:
    """Turn the gimbal's yaw in a simulated log and raise its heights; the camera is placed by the gimbal's angles."""
    rows = list(csv.reader(path.read_text().splitlines()))
    for column, name in enumerate(rows[0]):
        for row in rows[1:]:
            if "yaw" in name.lower():
                row[column] = f"{(float(row[column]) + COMPASS_DEG + 180) % 360 - 180:.4f}"
            elif name == "relativeHeight":
                row[column] = f"{float(row[column]) + HEIGHT_M:.3f}"
    with path.open("w", newline="") as file:
        csv.writer(file).writerows(rows)


@pytest.fixture(scope="module")
def corrected(
    faulty: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[TelemetryOutcome, Path]:
    """Its report, and the folder of its files."""
    folder = tmp_path_factory.mktemp("corrected")
    video, camera = faulty / "flight1" / "flight1.mp4", faulty / "camera.xml"
    for _ in map_flights([video], folder / "site", MapSettings(model="none"), camera=camera):
        pass
    report = correct_telemetry(folder / "site", folder / "out", source=video, camera=str(camera))
    return report, folder


def test_the_known_faults_are_measured_and_put_in_words(
    corrected: tuple[TelemetryOutcome, Path],
) -> None:
    faults = corrected[0].report["faults"]
    assert faults["heading_deg"]["value"] == pytest.approx(COMPASS_DEG, abs=0.7)
    assert faults["clock_s"]["value"] == pytest.approx(CLOCK_S, abs=0.1)
    assert faults["height_m"]["value"] == pytest.approx(HEIGHT_M, abs=1.0)
    words = "; ".join(corrected[0].sentences)
    assert "too far clockwise" in words and "too high" in words and "ahead of the pictures" in words


def test_frames_whose_angles_are_far_beside_the_others_are_named() -> None:
    """A compass 3 degrees off, and pictures of one strip turned by half a turn: the median alone would hide these."""
    poses = [
        Pose(site_from_gimbal_rotation(45.0, -90.0, 0.0), np.array([4.0 * k, 0.0, 30.0]))
        for k in range(12)
    ]
    priors = [
        CameraPrior(
            pose.translation_m,
            np.ones(3),
            site_from_gimbal_rotation(48.0 + 180.0 * (4 <= k < 8), -90.0, 0.0),
            np.ones(3),
        )
        for k, pose in enumerate(poses)
    ]
    faults = telemetry_faults(priors, poses, Bias(0.0, 0.01), AS_THE_MAP, knows_height=True)
    assert faults.outlying == (4, 5, 6, 7) and faults.outlying_deg == pytest.approx(180, abs=5)
    assert faults.heading_deg.value == pytest.approx(3, abs=0.1)
    names = [f"{k}.jpg" for k in range(12)]
    (words,) = [each for each in fault_sentences(faults, names) if "far beside" in each]
    assert "4 frames of 12" in words and words.endswith("4.jpg, 5.jpg, 6.jpg, 7.jpg")
    straight = telemetry_faults(
        priors[:4], poses[:4], Bias(0.0, 0.01), AS_THE_MAP, knows_height=True
    )
    assert not straight.outlying and not any(
        "far beside" in each for each in fault_sentences(straight, names)
    )


def test_where_place_and_angles_leave_the_log_the_map_is_doubted_not_the_log() -> None:
    """Two pictures laid 12 m aside and turned by 27 degrees passed for wrong angles of the log; a fix that jumped by
    15 m may be either's fault, and is no fault of the angles."""
    poses, priors = _strips()
    aside = (
        site_from_gimbal_rotation(27.0, -90.0, 0.0) @ site_from_gimbal_rotation(0.0, -90.0, 0.0).T
    )
    mapped = [
        Pose(aside @ each.rotation, each.translation_m + np.array([0.0, 12.0, 3.0]))
        if k in (4, 5)
        else each
        for k, each in enumerate(poses)
    ]
    log = [
        replace(
            each,
            position_m=each.position_m + np.array([15.0 * (k == 20), 0.0, 0.0]),
            rotation=site_from_gimbal_rotation(100.0, -90.0, 0.0) if k == 9 else each.rotation,
        )
        for k, each in enumerate(priors)
    ]
    path = path_fit(log, mapped, 0.0)
    faults = telemetry_faults(log, fitted(mapped, path), Bias(0.0, 0.01), path, knows_height=True)
    assert (faults.misplaced, faults.apart, faults.outlying) == ((4, 5), (20,), (9,))
    assert faults.misplaced_m == pytest.approx(
        [12.4, 12.4], abs=1
    ) and faults.apart_m == pytest.approx([15.0], abs=1)
    words = "; ".join(fault_sentences(faults, [str(k) for k in range(len(poses))]))
    assert (
        "the map is doubtful at 2 frames of 26" in words and "follow the log there: 4, 5;" in words
    )
    assert "at 1 frame of 26 the map or the log is wrong" in words and "accuracy: 20;" in words
    sound = telemetry_faults(
        priors, poses, Bias(0.0, 0.01), path_fit(priors, poses, 0.0), knows_height=True
    )
    assert not (sound.misplaced or sound.apart or sound.outlying)


def test_a_misplaced_frame_is_laid_by_the_log(
    corrected: tuple[TelemetryOutcome, Path], faulty: Path, tmp_path: Path
) -> None:
    """It stays out of the correction of the frames around it, and its accuracy is not the map's."""
    site, out = tmp_path / "site", tmp_path / "out"
    shutil.copytree(corrected[1] / "site", site)
    before = list(csv.DictReader((corrected[1] / "out" / "track.csv").read_text().splitlines()))
    wrong = before[len(before) // 2]
    with closing(sqlite3.connect(site / "site.db")) as database, database:
        where = f"where frame_index = {wrong['index']}"
        ((place, turned),) = database.execute(
            f"select translation_m, rotation from keyframes {where}"
        )
        aside = (
            site_from_gimbal_rotation(30.0, -90.0, 0.0)
            @ site_from_gimbal_rotation(0.0, -90.0, 0.0).T
        )
        database.execute(
            f"update keyframes set translation_m = ?, rotation = ? {where}",
            (
                json.dumps((np.array(json.loads(place)) + np.array([12.0, 0.0, 3.0])).tolist()),
                json.dumps((aside @ np.array(json.loads(turned)).reshape(3, 3)).tolist()),
            ),
        )
    seal_again(site / "site.db")
    report = correct_telemetry(
        site, out, source=faulty / "flight1" / "flight1.mp4", camera=str(faulty / "camera.xml")
    )
    (words,) = [each for each in report.sentences if "the map is doubtful at 1 frame" in each]
    assert words.endswith(f": {wrong['name']}")
    (row,) = [
        each
        for each in csv.DictReader((out / "track.csv").read_text().splitlines())
        if each["name"] == wrong["name"]
    ]
    assert row["status"] == "interpolated" and float(row["sigma_m"]) > float(wrong["sigma_m"])
    east_m, north_m = (
        (float(row[each]) - float(wrong[each])) * 111_200
        for each in ("longitude_deg", "latitude_deg")
    )
    assert np.hypot(east_m * np.cos(np.radians(41.9)), north_m) < 1.5
    assert float(row["height_m"]) == pytest.approx(float(wrong["height_m"]), abs=1.0)


def _strips(clock_s: float = 0.0) -> tuple[list[Pose], list[CameraPrior]]:
    """The true cameras of a flight in two strips of 60 m, 20 m apart, at 5 m/s; and its log, whose fixes scatter by
    0.2 m, whose clock is off by `clock_s` and whose compass by 7 degrees."""
    rng = np.random.default_rng(3)
    poses, priors = [], []
    for east_m, speed_m_s in ((0.0, 5.0), (20.0, -5.0)):
        for north_m in np.arange(-30.0, 30.1, 5.0):
            yaw_deg, velocity_m_s = (
                (0.0 if speed_m_s > 0 else 180.0),
                np.array([0.0, speed_m_s, 0.0]),
            )
            place_m = np.array([east_m, north_m, 30.0])
            poses.append(Pose(site_from_gimbal_rotation(yaw_deg, -90.0, 0.0), place_m))
            priors.append(
                CameraPrior(
                    place_m + clock_s * velocity_m_s + rng.normal(0, 0.2, 3) * [1, 1, 0],
                    np.ones(3),
                    site_from_gimbal_rotation(yaw_deg + 7.0, -90.0, 0.0),
                    np.ones(3),
                    velocity_m_s,
                )
            )
    return poses, priors


def test_a_map_that_the_compass_turned_does_not_hide_the_compass() -> None:
    """Wrong heights made the map 1.3 times as large, the compass turned it by 2 degrees: its fixes show both."""
    poses, priors = _strips()
    turn = site_from_gimbal_rotation(2.0, -90.0, 0.0) @ site_from_gimbal_rotation(0.0, -90.0, 0.0).T
    mapped = [Pose(turn @ each.rotation, 1.3 * turn @ each.translation_m) for each in poses]
    path = path_fit(priors, mapped, 0.02)
    assert path.scale.value == pytest.approx(1 / 1.3, abs=0.01)
    assert (
        path.turn_deg.value == pytest.approx(2.0, abs=3 * path.turn_deg.sigma)
        and path.turn_deg.sigma < 0.5
    )
    found = fitted(mapped, path)
    for pose, truth in zip(found, poses):  # about the middle of the map, wherever that lies
        apart_m = (
            pose.translation_m
            - found[0].translation_m
            - truth.translation_m
            + poses[0].translation_m
        )
        assert np.linalg.norm(apart_m) < 0.8
    faults = telemetry_faults(priors, found, Bias(0.0, 0.02), path, knows_height=True)
    assert faults.heading_deg.value == pytest.approx(7.0, abs=3 * faults.heading_deg.sigma)
    assert faults.heading_deg.sigma >= path.turn_deg.sigma
    words = "; ".join(fault_sentences(faults, [""] * len(poses)))
    assert (
        "1.30 times as large as its GPS track and turned by" in words
        and "clockwise against it" in words
    )
    sound = telemetry_faults(
        priors,
        fitted(poses, path_fit(priors, poses, 0.02)),
        Bias(0.0, 0.02),
        path_fit(priors, poses, 0.02),
        knows_height=True,
    )
    assert "times as large" not in "; ".join(fault_sentences(sound, [""] * len(poses)))


def test_a_turn_that_the_clock_explains_is_not_taken_for_one() -> None:
    """0.2 s at 5 m/s shift two strips against each other, which looks like a turn."""
    poses, priors = _strips(clock_s=0.2)
    sure, unsure = (path_fit(priors, poses, sigma_s).turn_deg for sigma_s in (0.0, 0.2))
    assert sure.value == unsure.value and abs(sure.value) > 0.5
    assert np.sqrt(unsure.sigma**2 - sure.sigma**2) == pytest.approx(abs(sure.value), rel=0.5)


@pytest.mark.parametrize("off_deg", [179.0, -179.5, 3.0])
def test_a_compass_is_measured_all_round_the_circle(off_deg: float) -> None:
    """A camera mounted the other way round is off by half a turn, on both sides of 180 degrees."""
    poses = [
        Pose(site_from_gimbal_rotation(45.0, -90.0, 0.0), np.array([4.0 * k, 0.0, 30.0]))
        for k in range(12)
    ]
    priors = [
        CameraPrior(
            pose.translation_m,
            np.ones(3),
            site_from_gimbal_rotation(45.0 + off_deg + k % 3, -90.0, 0.0),
            np.ones(3),
        )
        for k, pose in enumerate(poses)
    ]
    found = telemetry_faults(
        priors, poses, Bias(0.0, 0.01), AS_THE_MAP, knows_height=True
    ).heading_deg
    assert (found.value - off_deg - 1 + 180) % 360 - 180 == pytest.approx(0, abs=0.01)
    assert found.scatter < 2 and found.sigma < 1


def test_what_cannot_be_known_of_a_compass_is_not_called_right() -> None:
    """Five photos where a strip turns, three of them half a turn off; and a hovering flight, whose track has no
    direction."""
    turned_deg = [2.0, 3.0, 179.0, -178.0, 177.0]
    poses = [
        Pose(site_from_gimbal_rotation(0.0, -90.0, 0.0), np.array([30.0 * k, 0.0, 30.0]))
        for k in range(5)
    ]
    priors = [
        CameraPrior(
            pose.translation_m, np.ones(3), site_from_gimbal_rotation(each, -90.0, 0.0), np.ones(3)
        )
        for pose, each in zip(poses, turned_deg)
    ]
    faults = telemetry_faults(
        priors, poses, Bias(0.0, 0.01), path_fit(priors, poses, 0.0), knows_height=True
    )
    names = [f"{k}.jpg" for k in range(5)]
    words = fault_sentences(faults, names)
    assert (
        "whether the compass was right cannot be known: the frames' angles disagree with each other"
        in words
    )
    assert any("3 frames of 5" in each and each.endswith("2.jpg, 3.jpg, 4.jpg") for each in words)
    rng = np.random.default_rng(1)
    near = [Pose(poses[0].rotation, rng.normal((0, 0, 30), 0.3)) for _ in range(8)]
    fixes = [
        CameraPrior(each.translation_m + rng.normal(0, 1, 3), np.ones(3), each.rotation, np.ones(3))
        for each in near
    ]
    hovering = telemetry_faults(
        fixes, near, Bias(0.0, 0.01), path_fit(fixes, near, 0.0), knows_height=True
    )
    assert any(
        "cannot be known: the GPS track is too short" in each
        for each in fault_sentences(hovering, names)
    )
    few = telemetry_faults(
        fixes[:3], near[:3], Bias(0.0, 0.01), path_fit(fixes[:3], near[:3], 0.0), knows_height=True
    )
    assert any(
        "cannot be known: too few frames have a fix" in each for each in fault_sentences(few, names)
    )


def test_heights_that_made_the_map_are_not_confirmed_by_it() -> None:
    """Two frames: 12 m too high in the log made the map 1.4 times as large, and "heights were right within 0.1 m"."""
    poses, priors = _strips()
    mapped = [Pose(each.rotation, 1.4 * each.translation_m) for each in poses]
    high = [
        replace(each, position_m=each.position_m + np.array([0.0, 0.0, 12.0])) for each in priors
    ]
    for count, words in ((2, "cannot be known: too few frames have a fix"), (26, "m too high")):
        path = path_fit(high[:count], mapped[:count], 0.0)
        faults = telemetry_faults(
            high[:count], fitted(mapped[:count], path), Bias(0.0, 0.01), path, knows_height=True
        )
        (found,) = [
            each
            for each in fault_sentences(faults, [""] * count)
            if "heights above the ground" in each
        ]
        assert words in found
    assert faults.height_m.value == pytest.approx(12.0, abs=3 * faults.height_m.sigma)


def test_between_frames_of_a_log_without_angles_the_camera_turns_as_the_pictures_show() -> None:
    """Its course turns before the nose does: followed, it put the camera up to 51 degrees beside."""
    key_s, times_s = [0.0, 2.0, 4.0], [0.0, 0.5, 1.0, 1.5, 2.0, 3.0]
    solved = [
        Pose(site_from_gimbal_rotation(yaw_deg, -90.0, 0.0), np.array([5.0 * yaw_deg, 0.0, 30.0]))
        for yaw_deg in (0.0, 20.0, 40.0)
    ]

    def priors(moments_s: list[float], sigma: float) -> list[CameraPrior]:
        """Of a course that is 60 degrees further from the first half second on."""
        return [
            CameraPrior(
                np.array([50.0 * s + 3.0, 40.0 * (s == 1.0) * np.isinf(sigma), 30.0]),
                np.full(3, sigma),
                site_from_gimbal_rotation(10.0 * s + 60.0 * (s >= 0.5), -90.0, 0.0),
                np.array([12.0, 12.0, sigma]),
            )
            for s in moments_s
        ]

    found = corrected_poses(times_s, priors(times_s, np.inf), key_s, priors(key_s, np.inf), solved)
    for second, pose in zip(times_s, found):
        truth = Pose(
            site_from_gimbal_rotation(10.0 * second, -90.0, 0.0),
            np.array([50.0 * second, 0.0, 30.0]),
        )
        np.testing.assert_allclose(pose.rotation, truth.rotation, atol=1e-6)
        np.testing.assert_allclose(pose.translation_m, truth.translation_m, atol=1e-6)
    stated = corrected_poses(times_s, priors(times_s, 1.0), key_s, priors(key_s, 1.0), solved)[1]
    turned_deg = gimbal_angles_from_rotation(stated.rotation)[
        0
    ]  # the log's 65, less a quarter of the 60 at 2 s
    assert turned_deg == pytest.approx(65.0 - 15.0, abs=0.01)
    np.testing.assert_allclose(stated.translation_m, [25.0, 0.0, 30.0], atol=1e-6)


def test_a_clock_that_is_known_to_seconds_only_is_not_called_right() -> None:
    """10 s of straight flight: "the clocks agree within 14.29 s"."""
    poses, priors = _strips()
    for sigma_s, words in (
        (6.7, "whether the clocks agree cannot be known"),
        (0.4, "the clocks agree within 1.68 s"),
    ):
        clock_s = Bias(-0.88, sigma_s)
        faults = telemetry_faults(
            priors, poses, clock_s, path_fit(priors, poses, 0.0), knows_height=True
        )
        assert fault_sentences(faults, [""] * len(poses))[0].startswith(words)


@pytest.mark.parametrize("quality", ["contradictory", "doubtful", "map"])
def test_a_doubt_about_the_map_is_passed_on(
    corrected: tuple[TelemetryOutcome, Path], tmp_path: Path, quality: str
) -> None:
    site = tmp_path / "site"
    shutil.copytree(corrected[1] / "site", site)
    path = site / "flights" / "flight1" / "report.json"
    mapped = {
        **json.loads(path.read_text()),
        "headline": {"quality": quality, "text": "too large by half"},
        "warnings": ["by half", "is it the telemetry of this flight?"],
    }
    write_again(site, "flights/flight1/report.json", json.dumps(mapped))
    report = correct_telemetry(site, tmp_path / "out")
    assert ("too large by half" in report.warnings) == (quality != "map")
    assert "of the map: is it the telemetry of this flight?" in report.warnings
    assert ("of the map: by half" in report.warnings) == (
        quality == "map"
    )  # else the headline has it


def test_a_map_that_control_points_hold_is_not_bent_to_the_fixes(
    corrected: tuple[TelemetryOutcome, Path], faulty: Path, tmp_path: Path
) -> None:
    site = tmp_path / "site"
    shutil.copytree(corrected[1] / "site", site)
    path = site / "flights" / "flight1" / "report.json"
    mapped = {**json.loads(path.read_text()), "control": {"points": [{"role": "control"}] * 3}}
    write_again(site, "flights/flight1/report.json", json.dumps(mapped))
    report = correct_telemetry(
        site,
        tmp_path / "out",
        source=faulty / "flight1" / "flight1.mp4",
        camera=str(faulty / "camera.xml"),
    )
    assert report.report["faults"]["path"]["turn_deg"] == {
        "value": 0.0,
        "sigma": 0.0,
        "scatter": None,
    }
    assert corrected[0].report["faults"]["path"]["turn_deg"]["sigma"] > 0


def test_corrected_cameras_lie_where_the_drone_flew(
    corrected: tuple[TelemetryOutcome, Path], faulty: Path
) -> None:
    true = {
        int(each["properties"]["frame"]): each["properties"]
        for each in json.loads((faulty / "truth" / "frames.geojson").read_text())["features"]
    }
    rows = list(csv.DictReader((corrected[1] / "out" / "track.csv").read_text().splitlines()))
    assert len(rows) >= 8
    for row in rows:
        truth = true[int(row["index"])]
        assert float(row["above_ground_m"]) == pytest.approx(
            truth["height_above_ground_m"], abs=1.2
        )
        north_m = (float(row["latitude_deg"]) - truth["camera_latitude_deg"]) * 111_200
        east_m = (
            (float(row["longitude_deg"]) - truth["camera_longitude_deg"])
            * 111_200
            * np.cos(np.radians(41.9))
        )
        assert np.hypot(east_m, north_m) < 1.5
        assert 0 < float(row["sigma_m"]) < 3


def test_the_video_gets_corrected_metadata_and_keeps_its_pictures(
    corrected: tuple[TelemetryOutcome, Path], faulty: Path
) -> None:
    film = corrected[1] / "out" / "flight1.ts"
    with av.open(str(film)) as copy, av.open(str(faulty / "flight1" / "flight1.mp4")) as original:
        pictures = [frame.to_ndarray(format="rgb24") for frame in copy.decode(video=0)]
        before = [frame.to_ndarray(format="rgb24") for frame in original.decode(video=0)]
    assert len(pictures) == len(before)
    assert all(np.array_equal(a, b) for a, b in zip(pictures, before))
    metadata = read_klv_file(film)
    assert metadata is not None and len(metadata.telemetry) > 20
    rows = list(csv.DictReader((corrected[1] / "out" / "track.csv").read_text().splitlines()))
    for row in rows:
        k = int(np.argmin(np.abs(metadata.telemetry.video_time_ns / 1e9 - float(row["video_s"]))))
        assert abs(metadata.telemetry.video_time_ns[k] / 1e9 - float(row["video_s"])) < 0.2
        assert metadata.telemetry["latitude_deg"][k] == pytest.approx(
            float(row["latitude_deg"]), abs=1.5e-5
        )
        turn = (metadata.telemetry["camera_yaw_deg"][k] - float(row["yaw_deg"]) + 180) % 360 - 180
        pitch = float(row["pitch_deg"])
        if pitch > -88:  # straight down, yaw and roll are one
            assert abs(turn) < 8
        assert metadata.telemetry["camera_pitch_deg"][k] == pytest.approx(pitch, abs=4)
    across_deg = metadata.lens["sensor_horizontal_fov_deg"] if metadata.lens else float("nan")
    assert across_deg == pytest.approx(float(rows[0]["horizontal_fov_deg"]), abs=0.05)


def test_what_a_watch_found_is_in_the_metadata_of_its_frame(
    corrected: tuple[TelemetryOutcome, Path], faulty: Path, tmp_path: Path
) -> None:
    video, camera = faulty / "flight1" / "flight1.mp4", str(faulty / "camera.xml")
    rows = list(csv.DictReader((corrected[1] / "out" / "track.csv").read_text().splitlines()))
    shown = rows[len(rows) // 2]
    sees = {
        "frame": shown["name"],
        "class": "person",
        "score": 0.8,
        "box_px": [10, 20, 30, 40],
        "track": 4,
        "latitude": float(shown["latitude_deg"]),
        "longitude": float(shown["longitude_deg"]),
    }
    with opened_sources([video], None, camera) as (source,):
        fingerprint = source.fingerprint
    for name, mark, box in (
        ("sound", fingerprint, [10, 20, 30, 40]),
        ("cut", fingerprint, None),
        ("other", "another", [10, 20, 30, 40]),
    ):
        with claimed_folder(tmp_path / name, "flight1", mark):
            with DetectionLines(tmp_path / name) as lines:
                lines.append([sees | {"box_px": box}, sees | {"box_px": [1, 2, 3, 4]}])
    (tmp_path / "none").mkdir()

    def correct(name: str) -> TelemetryOutcome:
        return correct_telemetry(
            corrected[1] / "site",
            tmp_path / "out",
            source=video,
            camera=camera,
            watched=tmp_path / name,
        )

    for name, words in (("other", "another flight"), ("none", "no folder"), ("cut", "damaged")):
        with pytest.raises(InputError, match=words):
            correct(name)
    assert "2 of 2 detections are in flight1.ts" in correct("sound").sentences[-1]
    found = []
    with av.open(str(tmp_path / "out" / "flight1.ts")) as film:
        for packet in film.demux(data=0):
            data = bytes(packet)
            if data and (stated := decode_uas_local_set(data)).get(74):
                first_s = film.streams.video[0].start_time * film.streams.video[0].time_base
                found.append((float(packet.pts * packet.time_base - first_s), stated))
    ((seconds, stated),) = found
    assert seconds == pytest.approx(float(shown["video_s"]), abs=0.01)
    target, double = stated.get(74).value.targets  # both of one track: a number stands once
    assert (target.target_id, target.value(5)) == (4, 80) and double.target_id > 1_000_000
    assert stated.get(74).value.value(8) == 320
    place = resolve_vtarget_location(
        target,
        frame_center_latitude=stated.get(23).value,
        frame_center_longitude=stated.get(24).value,
    )
    assert place is not None and place.latitude == pytest.approx(sees["latitude"], abs=5e-6)


def test_the_metadata_has_the_aircrafts_heading(
    corrected: tuple[TelemetryOutcome, Path], faulty: Path
) -> None:
    """Tag 5 on the straight stretches is where the drone flew, without the 7 degrees that its compass was off; it swung
    all round where the camera looked straight down."""
    metadata = read_klv_file(corrected[1] / "out" / "flight1.ts")
    assert metadata is not None
    samples = metadata.telemetry
    true = [
        each["properties"]
        for each in json.loads((faulty / "truth" / "frames.geojson").read_text())["features"]
        if each["properties"]["flight"] == "flight1"
    ]
    path_m = (
        np.array(
            [
                [
                    each["camera_longitude_deg"] * np.cos(np.radians(41.9)),
                    each["camera_latitude_deg"],
                ]
                for each in true
            ]
        )
        * 111_200
    )
    steps_m = np.diff(path_m, axis=0)
    courses_deg = np.degrees(np.arctan2(steps_m[:, 0], steps_m[:, 1]))
    off_deg = []
    for row in range(len(samples)):
        frame = round(float(samples.video_time_ns[row]) / 1e9 * 6)  # six frames a second
        around_deg = courses_deg[max(frame - 4, 0) : frame + 4]
        if len(around_deg) and np.abs((around_deg - around_deg[0] + 180) % 360 - 180).max() < 3:
            off_deg.append((samples["body_yaw_deg"][row] - around_deg[0] + 180) % 360 - 180)
    assert len(off_deg) > 20
    assert np.abs(off_deg).max() < 6 and abs(np.median(off_deg)) < 2


def test_files_for_other_programs_hold_the_same_places(
    corrected: tuple[TelemetryOutcome, Path],
) -> None:
    out = corrected[1] / "out"
    rows = list(csv.DictReader((out / "track.csv").read_text().splitlines()))
    first, *lines = (out / "geo.txt").read_text().splitlines()
    assert first == "EPSG:4326" and len(lines) == len(rows)
    for line, row in zip(lines, rows):
        name, lon, lat, height, *_ = line.split()
        assert name == row["name"] and float(lon) == pytest.approx(
            float(row["longitude_deg"]), abs=1e-8
        )
        assert float(lat) == pytest.approx(float(row["latitude_deg"]), abs=1e-8)
        assert float(height) == pytest.approx(float(row["height_m"]), abs=1e-2)
    space = {"g": "http://www.topografix.com/GPX/1/1"}
    points = ElementTree.parse(out / "track.gpx").getroot().findall(".//g:trkpt", space)
    latitudes = [float(row["latitude_deg"]) for row in rows]
    assert [float(each.get("lat", "0")) for each in points] == pytest.approx(latitudes)
    events = [ElementTree.fromstring(line) for line in (out / "cot.xml").read_bytes().splitlines()]
    assert len(events) == len(rows) and len({event.get("uid") for event in events}) == 1
    sensor = events[-1].find("detail/sensor")
    assert sensor is not None
    assert float(sensor.get("fov", "0")) == pytest.approx(
        float(rows[0]["horizontal_fov_deg"]), abs=0.1
    )
    assert float(sensor.get("elevation", "0")) < -60 and 20 < float(sensor.get("range", "0")) < 45
    assert events[-1].find("detail/track") is not None


def test_the_track_is_sent_to_a_team(
    corrected: tuple[TelemetryOutcome, Path], tmp_path: Path
) -> None:
    """Every event, in order; a receiver that is not there is an error, and the files are written all the same."""
    site = corrected[1] / "site"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(5)
        place = CotPlace("udp", "127.0.0.1", receiver.getsockname()[1])
        report = correct_telemetry(site, tmp_path / "sent", cot=CotReceiver(place))
        events = [receiver.recv(10_000) for _ in range(report.frames)]
    assert report.cot_sent == report.frames
    assert events == (tmp_path / "sent" / "cot.xml").read_bytes().splitlines()
    with socket.create_server(("127.0.0.1", 0)) as closed:
        nobody = CotPlace("tls", "127.0.0.1", closed.getsockname()[1])
    with pytest.raises(InputError, match="nothing could be sent"):
        correct_telemetry(site, tmp_path / "unsent", cot=CotReceiver(nobody))
    assert (tmp_path / "unsent" / "cot.xml").exists()


def test_a_sound_log_is_called_sound(filmed: Path, tmp_path: Path) -> None:
    video, camera = filmed / "flight1" / "flight1.mp4", filmed / "camera.xml"
    for _ in map_flights([video], tmp_path / "site", MapSettings(model="none"), camera=camera):
        pass
    report = correct_telemetry(
        tmp_path / "site", tmp_path / "out", source=video, camera=str(camera)
    )
    assert abs(report.report["faults"]["heading_deg"]["value"]) < 0.6
    assert abs(report.report["faults"]["height_m"]["value"]) < 0.8
    alone = correct_telemetry(tmp_path / "site", tmp_path / "alone")
    assert alone.report["faults"] is None and "geo.txt" in alone.paths
    assert (tmp_path / "alone" / "geo.txt").read_text() == (
        tmp_path / "out" / "geo.txt"
    ).read_text()


def test_results_go_into_the_folder_of_their_flight(
    corrected: tuple[TelemetryOutcome, Path],
    faulty: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Of a map alone too; and such a run does not take the place of a diagnosis."""
    site, results = tmp_path / "field", tmp_path / "field-telemetry"
    shutil.copytree(corrected[1] / "site", site)
    assert main(["telemetry", str(site)]) == 0
    assert [each.name for each in results.iterdir()] == ["flight1"]
    assert "no diagnosis was made" in capsys.readouterr().out
    video = [str(faulty / "flight1" / "flight1.mp4"), "--camera", str(faulty / "camera.xml")]
    assert main(["telemetry", *video, "--site", str(site)]) == 0
    assert "no diagnosis" not in capsys.readouterr().out
    diagnosed = {each.name: each.read_bytes() for each in (results / "flight1").iterdir()}
    assert "flight1.ts" in diagnosed and [each.name for each in results.iterdir()] == ["flight1"]
    assert main(["telemetry", str(site), "--flight", "flight1"]) == 1
    assert "has the diagnosis of flight1" in capsys.readouterr().err
    assert {each.name: each.read_bytes() for each in (results / "flight1").iterdir()} == diagnosed
    assert main(["telemetry", str(site), "--out", str(tmp_path / "other")]) == 0
    assert json.loads((tmp_path / "other" / "telemetry.json").read_text())["faults"] is None


def test_a_flight_is_recognised_under_any_name_and_another_one_refused(
    corrected: tuple[TelemetryOutcome, Path],
    faulty: Path,
    filmed: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """A video of another flight was mapped, compared with the flight of --flight all the same, and its figures, which
    were no numbers, took the place of the right ones."""
    site, out = tmp_path / "field", tmp_path / "out"
    shutil.copytree(corrected[1] / "site", site)
    for suffix in (".mp4", ".csv"):
        shutil.copy(faulty / "flight1" / f"flight1{suffix}", tmp_path / f"DJI_7{suffix}")
    command = ["--site", str(site), "--out", str(out)]
    assert (
        main(
            [
                "telemetry",
                str(tmp_path / "DJI_7.mp4"),
                *command,
                "--camera",
                str(faulty / "camera.xml"),
            ]
        )
        == 0
    )
    assert "Telemetry of flight1" in capsys.readouterr().out and len(mapped_flights(site)) == 1
    right = (out / "telemetry.json").read_bytes()
    other = str(filmed / "flight1" / "flight1.mp4")
    assert main(["telemetry", other, *command, "--flight", "flight1"]) == 1
    assert (
        f"{other} is of another flight: flight1 of {site} was mapped from another file of that name"
        in (capsys.readouterr().err)
    )
    assert main(["telemetry", other, *command, "--flight", "DJI_8"]) == 1
    assert "has no flight 'DJI_8', only flight1: leave --flight out" in capsys.readouterr().err
    assert len(mapped_flights(site)) == 1 and (out / "telemetry.json").read_bytes() == right

    log, text = tmp_path / "earlier.gpx", next((filmed / "flight1").rglob("*.gpx")).read_text()
    log.write_text(re.sub(r"T\d\d:", "T07:", text))
    with pytest.raises(InputError, match=r"no time in common.*offset_s -18000 .*5 h ahead"):
        correct_telemetry(site, out, source=faulty / "flight1" / "flight1.mp4", telemetry=str(log))


def test_what_other_programs_cannot_take_is_warned_of(
    corrected: tuple[TelemetryOutcome, Path], tmp_path: Path
) -> None:
    """A flight without a date has no events; photos whose names have spaces are not found by OpenDroneMap."""
    site, out = tmp_path / "site", tmp_path / "out"
    shutil.copytree(corrected[1] / "site", site)
    with closing(sqlite3.connect(site / "site.db")) as database, database:
        database.execute(
            "update keyframes set name = 'IMG ' || name, time_ns = time_ns % 60000000000"
        )
    seal_again(site / "site.db")
    with pytest.raises(InputError, match="the date of flight1 is not known"):
        correct_telemetry(site, out, cot=CotReceiver(CotPlace("udp", "127.0.0.1", 9)))
    assert not out.exists()
    report = correct_telemetry(site, out)
    assert "cot.xml" not in report.paths and not (out / "cot.xml").exists()
    undated, spaced = report.warnings[-2:]
    assert "GPX and CSV have no times" in undated and "OpenDroneMap finds 'IMG 0' once" in spaced
    assert (out / "geo.txt").read_text().splitlines()[1].startswith("IMG_0 ")


def test_files_of_two_flights_do_not_mix(
    corrected: tuple[TelemetryOutcome, Path], faulty: Path, tmp_path: Path
) -> None:
    """An earlier flight's transport stream stayed beside the files of the next."""
    out = tmp_path / "out"
    out.mkdir()
    (out / "telemetry.json").write_text(json.dumps({"flight": "flight7", "site": "field"}))
    for source in (None, faulty / "flight1" / "flight1.mp4"):
        with pytest.raises(
            InputError, match="has the telemetry of flight7 of field, not of flight1 of site"
        ):
            correct_telemetry(
                corrected[1] / "site", out, source=source, camera=str(faulty / "camera.xml")
            )
    assert [each.name for each in out.iterdir()] == ["telemetry.json"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["{video}"], "flight1.mp4 is no map: give the map that this flight is in"),
        (["nowhere"], "no such file or folder: nowhere; give a flight's video"),
        (["{site}", "--site", "{site}"], "is a map, and so is --site"),
        (["{site}", "--camera", "{camera}"], "--camera and --detections belong to a flight"),
        (["{site}", "--detections", "x"], "--camera and --detections belong to a flight"),
        (["{site}", "--cot-ca", "x.pem"], "--cot-ca and --cot-cert are for --cot tls://host:port"),
        (["rtsp://camera/live", "--site", "{site}"], "rtsp:// is the address of a live stream"),
        (["{lonely}", "--site", "new"], "no telemetry with positions was found in it or beside it"),
    ],
)
def test_what_was_given_wrongly_is_named_before_the_work(
    corrected: tuple[TelemetryOutcome, Path],
    faulty: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    arguments: list[str],
    words: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    lonely = tmp_path / "lonely.mp4"
    shutil.copy(faulty / "flight1" / "flight1.mp4", lonely)
    places = {
        "video": faulty / "flight1" / "flight1.mp4",
        "site": corrected[1] / "site",
        "camera": faulty / "camera.xml",
        "lonely": lonely,
    }
    assert main(["telemetry", *(each.format(**places) for each in arguments)]) == 1
    assert words in capsys.readouterr().err
    assert [each.name for each in tmp_path.iterdir()] == ["lonely.mp4"]


def test_what_is_missing_is_named(
    filmed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["telemetry", str(filmed / "flight1" / "flight1.mp4")]) == 1
    assert "--site" in capsys.readouterr().err
    lonely = tmp_path / "video.mp4"
    lonely.write_bytes((filmed / "flight1" / "flight1.mp4").read_bytes())
    for _ in map_flights(
        [lonely], tmp_path / "site", MapSettings(model="none"), camera=filmed / "camera.xml"
    ):
        pass
    with pytest.raises(InputError, match="without GPS"):
        correct_telemetry(tmp_path / "site", tmp_path / "out")
