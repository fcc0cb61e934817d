"""The preflight: numbers that follow from the flight, and findings that state what to do."""

import json
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from PIL import Image
from PIL.ExifTags import GPS, IFD, Base
from PIL.TiffImagePlugin import IFDRational
from typer import Typer
from typer.testing import CliRunner

from real_data import real_data
from sorvolo.cli.inspect import inspect
from sorvolo.geometry.track import find_strips, length_m, speeds_m_s
from sorvolo.missions.inspect import Inspection, Level, inspect_input

M_PER_DEG = 111_132.0
XMP = """<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
<rdf:Description xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" drone-dji:RelativeAltitude="{height}"
drone-dji:GimbalYawDegree="{yaw}" drone-dji:GimbalPitchDegree="{pitch}" drone-dji:GimbalRollDegree="0"/>
</rdf:RDF></x:xmpmeta>"""


def write_photo(
    path: Path,
    north_m: float,
    east_m: float,
    second: int,
    height: str = "+50.0",
    pitch: str = "-90.0",
    texture: int = 60,
    yaw: str = "0",
) -> None:
    exif = Image.Exif()
    exif[Base.Model] = "FC300S"
    gps = exif.get_ifd(IFD.GPSInfo)
    for tag, reference, value in (
        (GPS.GPSLatitude, "N", north_m / M_PER_DEG),
        (GPS.GPSLongitude, "E", 10 + east_m / 111_320),
    ):
        degrees = IFDRational(round(value * 10_000_000), 10_000_000)
        gps[tag] = (degrees, IFDRational(0, 1), IFDRational(0, 1))
        gps[tag - 1] = reference
    gps[GPS.GPSDateStamp] = "2021:06:01"
    gps[GPS.GPSTimeStamp] = tuple(IFDRational(part, 1) for part in (10, second // 60, second % 60))
    low, high = 120 - texture, 121 + texture
    pixels = np.random.default_rng(second).integers(low, high, (90, 160, 3), np.uint8)
    xmp = XMP.format(height=height, pitch=pitch, yaw=yaw).encode()
    Image.fromarray(pixels).save(path, exif=exif, xmp=xmp)


def lawnmower(folder: Path, **options: Any) -> Path:
    """Three strips of eight photos: 5 m/s, one photo in 2 s, strips 25 m apart, 50 m high."""
    folder.mkdir()
    second = 0
    for strip in range(3):
        along = range(8) if strip % 2 == 0 else range(7, -1, -1)
        for step in along:
            write_photo(
                folder / f"{second:03d}.jpg", 1000 + 10 * step, 25 * strip, second, **options
            )
            second += 2
        second += 4
    return folder


def one(path: Path, **options: Path) -> Inspection:
    (inspection,) = inspect_input([path], **options)
    return inspection


def texts(inspection: Inspection, level: Level) -> str:
    return "\n".join(finding.text for finding in inspection.findings if finding.level == level)


def write_video(
    path: Path,
    metadata: dict[str, str] | None = None,
    rate: int = 10,
    step_px: int = 1,
    grain_px: int = 1,
) -> Path:
    """Ground of random grains that the camera passes over by `step_px` a frame."""
    wide = 160 + 4 * rate * step_px
    ground = np.random.default_rng(0).integers(
        0, 255, (120 // grain_px, wide // grain_px + 1, 3), np.uint8
    )
    ground = np.kron(ground, np.ones((grain_px, grain_px, 1), np.uint8))
    with av.open(str(path), "w") as container:
        container.metadata.update(metadata or {})
        stream = container.add_stream("libx264", rate=rate)
        stream.width, stream.height, stream.pix_fmt = 160, 90, "yuv420p"
        stream.codec_context.gop_size = rate // 2 or 1  # sample frames are at whole pictures
        for index in range(4 * rate):
            image = np.ascontiguousarray(ground[:90, index * step_px : index * step_px + 160])
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode(None))
    return path


def write_srt(path: Path, seconds: int = 4, speed_m_s: float = 10.0, hour: int = 10) -> Path:
    cues = [
        f"{second + 1}\n00:00:{second:02d},000 --> 00:00:{second + 1:02d},000\n"
        f"2021-06-01 {hour:02d}:00:{second:02d}.000\n"
        f"[latitude: {speed_m_s * second / M_PER_DEG + 0.5:.7f}] [longitude: 10.0000000] "
        "[rel_alt: 20.000 abs_alt: 320.000]\n"
        for second in range(seconds)
    ]
    path.write_text("\n".join(cues))
    return path


def test_a_lawnmower_of_photos_gives_its_plan_back(tmp_path: Path) -> None:
    found = one(lawnmower(tmp_path / "site"))
    flight = found.flight
    focal_px = found.camera.focal_px
    assert found.name == "site" and found.frames.count == 24 and found.frames.interval_s == 2
    assert flight.height_m == 50 and flight.height_reference == "above take-off"
    assert flight.gsd_m == pytest.approx(50 / focal_px)
    assert flight.footprint_m == pytest.approx((160 * 50 / focal_px, 90 * 50 / focal_px))
    assert flight.speed_m_s == pytest.approx(5, rel=0.02)
    assert flight.strips == 3
    assert flight.side_overlap == pytest.approx(1 - 25 / flight.footprint_m[0], abs=0.01)
    assert flight.forward_overlap == pytest.approx(1 - 10 / flight.footprint_m[1], abs=0.01)
    # eqs 3.16-3.17: 70 % overlap leaves 30 % of the image's length to fly between two frames
    assert flight.frame_interval_s == pytest.approx(0.3 * flight.footprint_m[1] / 5, rel=0.02)
    assert flight.camera_pitch_deg == -90
    assert not texts(found, Level.PROBLEM)


def test_the_footprint_turns_with_the_camera(tmp_path: Path) -> None:
    turned = one(lawnmower(tmp_path / "site", yaw="-90.0")).flight
    assert turned.forward_overlap == pytest.approx(1 - 10 / turned.footprint_m[0], abs=0.01)
    assert turned.side_overlap == pytest.approx(1 - 25 / turned.footprint_m[1], abs=0.01)


@pytest.mark.parametrize(("pitch", "level"), [("-5.0", Level.PROBLEM), ("-60.0", Level.WARNING)])
def test_a_camera_that_looks_at_the_horizon(tmp_path: Path, pitch: str, level: Level) -> None:
    found = one(lawnmower(tmp_path / "site", pitch=pitch))
    assert "the camera looks" in texts(found, level)


def test_a_height_of_zero_and_thin_overlap(tmp_path: Path) -> None:
    assert "the height is 0.0 m" in texts(
        one(lawnmower(tmp_path / "zero", height="+0.0")), Level.PROBLEM
    )
    low = one(lawnmower(tmp_path / "low", height="+10.0"))
    assert "consecutive photos overlap by" in texts(low, Level.PROBLEM)
    assert "neighbouring strips overlap by 0 %" in texts(low, Level.WARNING)


def test_water_is_distinguished_from_ground(tmp_path: Path) -> None:
    found = one(lawnmower(tmp_path / "water", texture=0))
    assert "hardly any texture" in texts(found, Level.WARNING)


def test_a_video_with_subtitles_is_tied_to_them(tmp_path: Path) -> None:
    video = write_video(tmp_path / "a.mp4")
    write_srt(tmp_path / "a.SRT", 5)
    found = one(video)
    assert found.telemetry.samples == 5 and found.telemetry.rate_hz == 1
    assert (
        found.telemetry.tie == "telemetry counts from the video's first frame"
        and found.telemetry.covered_s == 4
    )
    assert found.flight.speed_m_s == pytest.approx(10, rel=0.02) and found.flight.height_m == 20
    assert found.frames.codec == "h264" and found.frames.rate_hz == 10
    assert "too few" not in texts(found, Level.PROBLEM)


def test_a_log_without_a_date_is_shown_without_one(tmp_path: Path) -> None:
    video = write_video(tmp_path / "a.mp4", metadata={"creation_time": "2026-05-12T09:00:00Z"})
    rows = [f"{second},{0.5 + second / M_PER_DEG:.7f},10.0,20.0" for second in range(5)]
    (tmp_path / "a.csv").write_text(
        "offsetTime,latitude,longitude,relativeHeight\n" + "\n".join(rows) + "\n"
    )
    app = Typer()
    app.command()(inspect)
    shown = " ".join(CliRunner().invoke(app, [str(video)]).output.split())
    assert "1970-01-01 00:00" not in shown and "without a date" in shown
    assert "its 5 rows take the video's" in shown


def test_too_few_frames_a_second_for_the_speed(tmp_path: Path) -> None:
    video = write_video(tmp_path / "a.mp4", rate=1)
    write_srt(tmp_path / "a.SRT", 5, speed_m_s=30)
    assert "frames a second are too few for 70 % overlap" in texts(one(video), Level.PROBLEM)


def write_gpx(path: Path, start: str) -> Path:
    points = "".join(
        f'<trkpt lat="{0.5 + 1e-4 * second}" lon="10"><ele>300</ele>'
        f"<time>{start[:17]}{second:02d}Z</time></trkpt>"
        for second in range(20)
    )
    path.write_text(
        '<?xml version="1.0"?><gpx version="1.1" creator="t" xmlns="http://www.topografix.com/GPX/1/1">'
        f"<trk><trkseg>{points}</trkseg></trk></gpx>"
    )
    return path


def test_telemetry_of_another_hour_or_another_day(tmp_path: Path) -> None:
    video = write_video(tmp_path / "a.mp4", {"creation_time": "2021-06-01T10:00:05Z"})
    fits = one(video, telemetry=write_gpx(tmp_path / "fits.gpx", "2021-06-01T10:00:00"))
    assert fits.telemetry.tie == "both carry UTC" and fits.telemetry.covered_s == pytest.approx(
        4, abs=0.2
    )
    assert not texts(fits, Level.PROBLEM)
    zone = one(video, telemetry=write_gpx(tmp_path / "zone.gpx", "2021-06-01T12:00:00"))
    assert "no time in common" in texts(zone, Level.PROBLEM)
    (advice,) = [each.advice for each in zone.findings if each.level == Level.PROBLEM]
    assert "--offset 7200 if the camera's clock is 2 h behind" in advice
    day = one(video, telemetry=write_gpx(tmp_path / "day.gpx", "2021-07-09T10:00:00"))
    assert "begins 37 d 23 h 59 min 55 s after" in texts(day, Level.PROBLEM)


def test_a_hovering_drone_is_no_flight(tmp_path: Path) -> None:
    still = write_video(tmp_path / "still.mp4", step_px=0, grain_px=6)
    assert "the drone hovers: all pictures show" in texts(one(still), Level.PROBLEM)
    moving = write_video(tmp_path / "moving.mp4", step_px=8, grain_px=6)
    assert "hovers" not in texts(one(moving), Level.PROBLEM)
    write_srt(tmp_path / "moving.SRT", 5, speed_m_s=0.1)
    assert "the drone hovers: 0." in texts(one(moving), Level.PROBLEM)


def test_a_video_alone_has_no_scale_and_a_guessed_camera(tmp_path: Path) -> None:
    found = one(write_video(tmp_path / "a.mp4"))
    warnings = texts(found, Level.WARNING)
    assert "no scale and no place on Earth" in warnings and "focal length is uncertain" in warnings
    assert all(finding.advice for finding in found.findings)


def test_json_holds_plain_values_only(tmp_path: Path) -> None:
    plain = one(write_video(tmp_path / "a.mp4")).as_json()
    again = json.loads(json.dumps(plain, allow_nan=False))
    assert again["flight"]["height_m"] is None and again["frames"]["width_px"] == 160
    assert {"level", "text", "advice"} == set(again["findings"][0])


def test_the_command_prints_a_table_or_json(tmp_path: Path) -> None:
    app = Typer()
    app.command()(inspect)
    video = write_video(tmp_path / "a.mp4")
    shown = CliRunner().invoke(app, [str(video)])
    assert shown.exit_code == 0 and "h264" in shown.output and "no positions" in shown.output
    plain = CliRunner().invoke(app, [str(video), "--json"])
    assert json.loads(plain.output)[0]["name"] == "a"
    assert "Example" in CliRunner().invoke(app, ["--help"]).output


@pytest.mark.parametrize("bearing_deg", [0, 37, 90, 170])
def test_strips_at_any_bearing_with_noise(bearing_deg: float) -> None:
    noise = np.random.default_rng(4)
    along = np.concatenate([np.linspace(0, 100, 200), np.full(20, 100.0), np.linspace(100, 0, 200)])
    across = np.concatenate([np.zeros(200), np.linspace(0, 30, 20), np.full(200, 30.0)])
    sine, cosine = np.sin(np.radians(bearing_deg)), np.cos(np.radians(bearing_deg))
    points = np.outer(along, [sine, cosine]) + np.outer(across, [cosine, -sine])
    strips = find_strips(points + noise.normal(0, 0.5, points.shape))
    assert strips.count == 2 and strips.spacing_m == pytest.approx(30, abs=1.5)
    assert abs((strips.bearing_deg - bearing_deg + 90) % 180 - 90) < 4
    assert length_m(points) == pytest.approx(230, rel=0.05)


def test_a_circle_has_no_strips_and_a_hover_no_speed() -> None:
    turn = np.linspace(0, 2 * np.pi, 100)
    assert find_strips(50 * np.column_stack([np.cos(turn), np.sin(turn)])).count == 0
    assert speeds_m_s(np.zeros((50, 2)), np.arange(50.0)).max() == 0
    assert find_strips(np.zeros((0, 2))).count == 0 and length_m(np.zeros((1, 2))) == 0


def test_the_real_flight_is_described_as_it_was_flown() -> None:
    flight = one(real_data("flights/brighton_beach")).flight
    assert flight.height_m == pytest.approx(40.1, abs=0.2) and flight.gsd_m == pytest.approx(
        0.017, abs=0.001
    )
    assert (
        flight.strips == 3
        and 0.5 < flight.side_overlap < 0.75
        and 0.5 < flight.forward_overlap < 0.75
    )
