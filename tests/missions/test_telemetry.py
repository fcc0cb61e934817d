"""The telemetry doctor on simulated flights whose compass, clock and heights are wrong by known amounts."""

import csv
import json
import socket
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import av
import numpy as np
import pytest

from small_flights import simulate_into, small_flight
from sorvolo.capture.correction import telemetry_faults
from sorvolo.capture.live.klv_telemetry import read_klv_file
from sorvolo.cli.main import main
from sorvolo.errors import InputError
from sorvolo.geometry.pose import Pose, site_from_gimbal_rotation
from sorvolo.missions.flight.settings import MapSettings
from sorvolo.missions.map.flights import map_flights
from sorvolo.missions.telemetry.doctor import CotReceiver, correct_telemetry
from sorvolo.missions.telemetry.words import fault_sentences
from sorvolo.missions.watch.cot_sender import CotPlace
from sorvolo.simulation.settings import OutputSettings
from sorvolo.survey.corrected import Bias
from sorvolo.survey.flight import CameraPrior

COMPASS_DEG, CLOCK_S, HEIGHT_M = 7.0, 0.4, 6.0


@pytest.fixture(scope="module")
def faulty(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A filmed flight whose log turns the compass by 7 degrees, lags by 0.4 s, and is 6 m too high."""
    folder = tmp_path_factory.mktemp("faulty") / "flight"
    settings = small_flight(
        77, height_m=30, length_m=40, spacing_m=9, size_px=(320, 240), fps=6, output=OutputSettings(telemetry="csv")
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
def corrected(faulty: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], Path]:
    """Its report, and the folder of its files."""
    folder = tmp_path_factory.mktemp("corrected")
    video, camera = faulty / "flight1" / "flight1.mp4", faulty / "camera.xml"
    for _ in map_flights([video], folder / "site", MapSettings(model="none"), camera=camera):
        pass
    report = correct_telemetry(folder / "site", folder / "out", source=video, camera=str(camera))
    return report, folder


def test_the_known_faults_are_measured_and_put_in_words(corrected: tuple[dict[str, Any], Path]) -> None:
    faults = corrected[0]["faults"]
    assert faults["heading_deg"]["value"] == pytest.approx(COMPASS_DEG, abs=0.7)
    assert faults["clock_s"]["value"] == pytest.approx(CLOCK_S, abs=0.1)
    assert faults["height_m"]["value"] == pytest.approx(HEIGHT_M, abs=1.0)
    words = "; ".join(corrected[0]["sentences"])
    assert "too far clockwise" in words and "too high" in words and "ahead of the pictures" in words


def test_frames_whose_angles_are_far_beside_the_others_are_named() -> None:
    """A compass 3 degrees off, and pictures of one strip turned by half a turn: the median alone would hide these."""
    poses = [Pose(site_from_gimbal_rotation(45.0, -90.0, 0.0), np.array([4.0 * k, 0.0, 30.0])) for k in range(12)]
    priors = [
        CameraPrior(
            pose.translation_m, np.ones(3), site_from_gimbal_rotation(48.0 + 180.0 * (4 <= k < 8), -90.0, 0.0),
            np.ones(3),
        ) for k, pose in enumerate(poses)
    ]
    faults = telemetry_faults(priors, poses, Bias(0.0, 0.01), Bias(1.0, 0.01), knows_height=True)
    assert faults.outlying == (4, 5, 6, 7) and faults.outlying_deg == pytest.approx(180, abs=5)
    assert faults.heading_deg.value == pytest.approx(3, abs=0.1)
    names = [f"{k}.jpg" for k in range(12)]
    (words,) = [each for each in fault_sentences(faults, names) if "far beside" in each]
    assert "4 frames of 12" in words and words.endswith("4.jpg, 5.jpg, 6.jpg, 7.jpg")
    straight = telemetry_faults(priors[:4], poses[:4], Bias(0.0, 0.01), Bias(1.0, 0.01), knows_height=True)
    assert not straight.outlying and not any("far beside" in each for each in fault_sentences(straight, names))


def test_corrected_cameras_lie_where_the_drone_flew(corrected: tuple[dict[str, Any], Path], faulty: Path) -> None:
    true = {
        int(each["properties"]["frame"]): each["properties"]
        for each in json.loads((faulty / "truth" / "frames.geojson").read_text())["features"]
    }
    rows = list(csv.DictReader((corrected[1] / "out" / "track.csv").read_text().splitlines()))
    assert len(rows) >= 8
    for row in rows:
        truth = true[int(row["index"])]
        assert float(row["above_ground_m"]) == pytest.approx(truth["height_above_ground_m"], abs=1.2)
        north_m = (float(row["latitude_deg"]) - truth["camera_latitude_deg"]) * 111_200
        east_m = (float(row["longitude_deg"]) - truth["camera_longitude_deg"]) * 111_200 * np.cos(np.radians(41.9))
        assert np.hypot(east_m, north_m) < 1.5
        assert 0 < float(row["sigma_m"]) < 3


def test_the_video_gets_corrected_metadata_and_keeps_its_pictures(
    corrected: tuple[dict[str, Any], Path], faulty: Path
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
        assert metadata.telemetry["latitude_deg"][k] == pytest.approx(float(row["latitude_deg"]), abs=1.5e-5)
        turn = (metadata.telemetry["camera_yaw_deg"][k] - float(row["yaw_deg"]) + 180) % 360 - 180
        pitch = float(row["pitch_deg"])
        if pitch > -88:  # straight down, yaw and roll are one
            assert abs(turn) < 8
        assert metadata.telemetry["camera_pitch_deg"][k] == pytest.approx(pitch, abs=4)
    across_deg = metadata.lens["sensor_horizontal_fov_deg"] if metadata.lens else float("nan")
    assert across_deg == pytest.approx(float(rows[0]["horizontal_fov_deg"]), abs=0.05)


def test_files_for_other_programs_hold_the_same_places(corrected: tuple[dict[str, Any], Path]) -> None:
    out = corrected[1] / "out"
    rows = list(csv.DictReader((out / "track.csv").read_text().splitlines()))
    first, *lines = (out / "geo.txt").read_text().splitlines()
    assert first == "EPSG:4326" and len(lines) == len(rows)
    for line, row in zip(lines, rows):
        name, lon, lat, height, _, pitch, *_ = line.split()
        assert name == row["name"] and float(lon) == pytest.approx(float(row["longitude_deg"]), abs=1e-8)
        assert float(lat) == pytest.approx(float(row["latitude_deg"]), abs=1e-8)
        assert float(height) == pytest.approx(float(row["height_m"]), abs=1e-2)
        assert float(pitch) == pytest.approx(float(row["pitch_deg"]) + 90, abs=1e-2)
    space = {"g": "http://www.topografix.com/GPX/1/1"}
    points = ElementTree.parse(out / "track.gpx").getroot().findall(".//g:trkpt", space)
    latitudes = [float(row["latitude_deg"]) for row in rows]
    assert [float(each.get("lat", "0")) for each in points] == pytest.approx(latitudes)
    events = [ElementTree.fromstring(line) for line in (out / "cot.xml").read_bytes().splitlines()]
    assert len(events) == len(rows) and len({event.get("uid") for event in events}) == 1
    sensor = events[-1].find("detail/sensor")
    assert sensor is not None
    assert float(sensor.get("fov", "0")) == pytest.approx(float(rows[0]["horizontal_fov_deg"]), abs=0.1)
    assert float(sensor.get("elevation", "0")) < -60 and 20 < float(sensor.get("range", "0")) < 45
    assert events[-1].find("detail/track") is not None


def test_the_track_is_sent_to_a_team(corrected: tuple[dict[str, Any], Path], tmp_path: Path) -> None:
    """Every event, in order; a receiver that is not there is an error, and the files are written all the same."""
    site = corrected[1] / "site"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(5)
        place = CotPlace("udp", "127.0.0.1", receiver.getsockname()[1])
        report = correct_telemetry(site, tmp_path / "sent", cot=CotReceiver(place))
        events = [receiver.recv(10_000) for _ in range(report["frames"])]
    assert report["cot_sent"] == report["frames"]
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
    report = correct_telemetry(tmp_path / "site", tmp_path / "out", source=video, camera=str(camera))
    assert abs(report["faults"]["heading_deg"]["value"]) < 0.6
    assert abs(report["faults"]["height_m"]["value"]) < 0.8
    alone = correct_telemetry(tmp_path / "site", tmp_path / "alone")
    assert alone["faults"] is None and "geo.txt" in alone["files"]
    assert (tmp_path / "alone" / "geo.txt").read_text() == (tmp_path / "out" / "geo.txt").read_text()


def test_what_is_missing_is_named(filmed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["telemetry", str(filmed / "flight1" / "flight1.mp4")]) == 1
    assert "--site" in capsys.readouterr().err
    lonely = tmp_path / "video.mp4"
    lonely.write_bytes((filmed / "flight1" / "flight1.mp4").read_bytes())
    for _ in map_flights([lonely], tmp_path / "site", MapSettings(model="none"), camera=filmed / "camera.xml"):
        pass
    with pytest.raises(InputError, match="without GPS"):
        correct_telemetry(tmp_path / "site", tmp_path / "out")
