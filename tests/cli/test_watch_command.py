"""`sorvolo watch` with a real model file: the summary, JSON, the errors, and Ctrl-C in the middle."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from toy_models import rectangle_model

from sorvolo.cli import main as cli
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.geodesy import Geodetic, LocalFrame
from sorvolo.lab.simulation.flight_files import video_writer, write_camera, write_telemetry
from sorvolo.survey.flight import Telemetry

_WIDTH, _HEIGHT, _FPS, _STEP_PX = 320, 240, 10.0, 4
_START_NS = 1_780_000_000_000_000_000
_CAMERA = Camera.from_angle_of_view(_WIDTH, _HEIGHT, 60.0)
_HEIGHT_M = 8.0  # so low that pictures are searched as they are
_M_PER_PX = _HEIGHT_M / _CAMERA.fx_px
_ORIGIN = LocalFrame(Geodetic(41.9, 12.6, 0.0))
_BOXES = ((200, 100, 216, 112), (330, 60, 346, 76))  # on the ground as the first frame sees it, px


def _fly(folder: Path, frames: int, *, with_telemetry: bool = True) -> Path:
    """A drone flies east over dark ground with two bright boxes; the camera looks down, its top to the north."""
    folder.mkdir(exist_ok=True)
    rng = np.random.default_rng(3)
    ground = np.clip(
        rng.normal(30, 8, (_HEIGHT // 4, (_WIDTH + frames * _STEP_PX) // 4 + 1)), 0, 70
    ).astype(np.uint8)
    ground = np.kron(ground, np.ones((4, 4), np.uint8))
    for left, top, right, bottom in _BOXES:
        ground[top:bottom, left:right] = 250
    video = folder / "flight.mp4"
    with video_writer(video, (_WIDTH, _HEIGHT), _FPS, _START_NS, 8) as write:
        for number in range(frames):
            window = ground[:, number * _STEP_PX : number * _STEP_PX + _WIDTH]
            write(np.repeat(window[..., None], 3, axis=2))
    write_camera(folder / "camera.xml", _CAMERA)
    if with_telemetry:
        times_ns = _START_NS + np.arange(frames) * 100_000_000
        east_m = np.arange(frames) * _STEP_PX * _M_PER_PX
        latitude, longitude, _ = _ORIGIN.wgs84_from_site(
            np.column_stack([east_m, np.zeros((frames, 2))])
        )
        level = np.zeros(frames)
        write_telemetry(
            folder / "flight.srt",
            Telemetry(
                "srt",
                times_ns,
                {
                    "latitude_deg": latitude,
                    "longitude_deg": longitude,
                    "height_above_takeoff_m": level + _HEIGHT_M,
                    "orthometric_height_m": level + 100,
                    "camera_yaw_deg": level,
                    "camera_pitch_deg": level - 90,
                    "camera_roll_deg": level,
                },
                times_ns - _START_NS,
            ),
        )
    return video


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return rectangle_model(tmp_path_factory.mktemp("model") / "toy.onnx")


def _arguments(video: Path, model: Path, out: Path) -> list[str]:
    return [
        "watch",
        str(video),
        "--model",
        str(model),
        "--camera",
        str(video.parent / "camera.xml"),
        "--out",
        str(out),
    ]


def test_json_then_words(model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    video, out = _fly(tmp_path / "flight", 30), tmp_path / "out"
    assert cli.main([*_arguments(video, model, out), "--json", "--classes", "small object"]) == 0
    (printed,) = json.loads(capsys.readouterr().out)["watches"]
    assert (
        printed["objects"] == {"total": 2, "by_class": {"small object": 2}}
        and printed["georeferenced"]
    )
    assert printed["folder"] == str(out)
    for (left, top, right, bottom), feature in zip(_BOXES, printed["tracks"]["features"]):
        east_m = ((left + right - 1) / 2 - _CAMERA.cx_px) * _M_PER_PX
        north_m = (_CAMERA.cy_px - (top + bottom - 1) / 2) * _M_PER_PX
        longitude, latitude = feature["geometry"]["coordinates"]
        place = _ORIGIN.site_from_wgs84(np.array([latitude]), np.array([longitude]), np.zeros(1))[0]
        assert place[:2] == pytest.approx((east_m, north_m), abs=0.5)

    assert cli.main([*_arguments(video, model, out), "--fps", "5"]) == 0
    words = capsys.readouterr().out
    assert "2 small objects" in words and "15 of 30 frames searched" in words
    first = printed["tracks"]["features"][0]["properties"]
    assert f"{first['latitude']:.5f}" in words and str(out / "report.html") in words.replace(
        "\n", ""
    )


def test_nothing_found_is_no_error(
    model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    video = _fly(tmp_path / "flight", 6, with_telemetry=False)
    assert cli.main([*_arguments(video, model, tmp_path / "out"), "--classes", "car"]) == 0
    out = capsys.readouterr().out
    assert "nothing" in out and "followed in the picture" in " ".join(out.split())


@pytest.mark.parametrize(
    ("extra", "words"),
    [
        (["--classes", "boat"], "knows no 'boat'"),
        (["--cot", "tak.local"], "udp://host:port"),
        (["--cot", "udp://tak.invalid"], "'tak.invalid' has no address"),
        (["--model", "no-such-model"], "no-such-model"),
        (["--alert-command", "no-such-program"], "no program"),
        (["--alert-url", "ftp://x"], "web address"),
    ],
)
def test_wrong_wishes_are_reported_before_anything_is_written(
    model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], extra: list[str], words: str
) -> None:
    video = _fly(tmp_path / "flight", 3)
    assert cli.main([*_arguments(video, model, tmp_path / "out"), *extra]) == 1
    assert words in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_placeholder_inside_a_shells_program_is_warned_of(
    model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = _arguments(_fly(tmp_path / "flight", 3), model, tmp_path / "out")
    assert cli.main([*arguments, "--alert-command", "sh -c 'echo {crop}'", "--json"]) == 0
    shown = capsys.readouterr()
    assert "{crop} stands inside a program for a shell" in " ".join(shown.err.split())
    assert any("{crop}" in each for each in json.loads(shown.out)["watches"][0]["warnings"])
    assert cli.main([*arguments, "--alert-command", "sh -c 'echo \"$1\"' alert {crop}"]) == 0
    assert "warning" not in capsys.readouterr().err


@pytest.fixture(scope="module")
def long_flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return _fly(tmp_path_factory.mktemp("long") / "flight", 1500)


@pytest.mark.parametrize(
    "signal_number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.long)]
)
def test_a_stop_ends_well_with_everything_written(
    model: Path, long_flight: Path, tmp_path: Path, signal_number: int
) -> None:
    video, out = long_flight, tmp_path / "out"
    command = [
        sys.executable,
        "-m",
        "sorvolo",
        *_arguments(video, model, out),
        "--save",
        "video",
        "--json",
    ]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as running:
        deadline = time.monotonic() + 60
        lines = out / "detections.jsonl"
        while not (lines.exists() and lines.stat().st_size > 3000) and time.monotonic() < deadline:
            time.sleep(0.01)
        os.kill(running.pid, signal_number)
        printed, err = running.communicate(timeout=60)
    assert running.returncode == 3, err
    (watch,) = json.loads(printed)["watches"]
    assert watch["ended"] == "stopped on demand"
    assert 0 < watch["frames"]["detected"] < 1500
    assert watch["looked_at"]["share"] < 0.9 and not watch["headline"]["complete"]
    assert watch["objects"]["total"] >= 1
    assert (out / "annotated.mp4").exists() and (out / "report.html").exists()
