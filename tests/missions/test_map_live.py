"""Maps of flights that are still going on, sent over the loopback by a simulated drone, against their truth."""

import json
import socket
import threading
import time
from datetime import UTC, datetime
from functools import reduce
from operator import xor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from live_sender import free_port, sending, udp_url

from sorvolo.capture.live.klv import encode
from sorvolo.capture.live.reconnect import LiveSettings
from sorvolo.capture.source import open_sources
from sorvolo.cli import main as cli
from sorvolo.geometry.geodesy import Geodetic, LocalFrame
from sorvolo.geometry.pose import gimbal_angles_from_rotation, site_from_gimbal_rotation
from sorvolo.missions.compare.flights import compare_flights
from sorvolo.missions.flight.settings import CompareSettings, MapSettings
from sorvolo.missions.inspect import inspect_input
from sorvolo.missions.map.flights import map_flights
from sorvolo.survey.findings import ViewStatus
from sorvolo.survey.flight import Frame

_LIVE = LiveSettings(keeps_all=True, silent_s=4.0, give_up_s=5.0, first_s=30.0)
_MAP = MapSettings(model="none")
_CLOCK_NS = 1_760_000_000 * 10**9  # the drone's at its first frame: not this computer's
_LOADED_S = 0.7  # what is still on its way when the sender ends


class FilmedFlight:
    """A simulated flight that can be sent: its pictures, and its telemetry as metadata packets or sentences."""

    def __init__(self, folder: Path) -> None:
        self.camera, self.truth = folder / "camera.xml", folder / "truth"
        (source,) = open_sources([folder / "flight1" / "flight1.mp4"], None, self.camera)
        self.rate, self.telemetry = round(source.frame_rate_hz), source.telemetry
        self.images = [
            each.image for each in source.frames(lambda *_: True) if isinstance(each, Frame)
        ]
        self.seconds = self.telemetry.video_time_ns / 1e9
        self.level = level = site_from_gimbal_rotation(0.0, 0.0, 0.0)
        printed = self.telemetry
        self.ground_m = float(
            np.median(printed["orthometric_height_m"] - printed["height_above_takeoff_m"])
        )
        self.headings = printed["body_yaw_deg"] % 360
        self.relative = [
            gimbal_angles_from_rotation(
                level
                @ site_from_gimbal_rotation(heading, 0.0, 0.0).T
                @ site_from_gimbal_rotation(*angles)
            )
            for heading, *angles in zip(
                self.headings,
                printed["camera_yaw_deg"],
                printed["camera_pitch_deg"],
                printed["camera_roll_deg"],
            )
        ]


class Drone:
    """It stands and sends until it may fly, then flies and sends until it has landed; then `landed` is set.

    It begins with frame `first` of the flight, its clock `later_s` ahead.
    """

    def __init__(
        self,
        flight: FilmedFlight,
        *,
        metadata: bool,
        speed: float = 2.0,
        count: int = 10_000,
        first: int = 0,
        later_s: int = 0,
    ) -> None:
        self._first, self._later_ns = first, later_s * 10**9
        self._flight, self._metadata, self._speed = flight, metadata, speed
        self._count = min(count, len(flight.images))
        self._took_off: int | None = None
        self._wants_to_fly = False
        self.took_off_s: float | None = None
        self.port, self.landed = free_port(), threading.Event()

    @property
    def address(self) -> str:
        return f"udp://127.0.0.1:{self.port}"

    def fly(self) -> None:
        self._wants_to_fly = True

    def flight_s(self, utc_s: float) -> float:
        """Seconds since take-off of a moment by the drone's clock."""
        assert self._took_off is not None
        return utc_s - _CLOCK_NS / 1e9 - self._took_off / self._flight.rate

    def sent(self) -> Any:
        flight = self._flight
        return sending(
            udp_url(self.port),
            size=flight.images[0].shape[1::-1],
            klv=self._metadata,
            image=self._image,
            klv_of=self._klv,
            rate=flight.rate,
            speed=self._speed,
        )

    def _frame(self, index: int) -> int:
        if self._wants_to_fly and self._took_off is None:
            self._took_off, self.took_off_s = index, time.monotonic()
        return self._first + (0 if self._took_off is None else index - self._took_off)

    def _image(self, index: int) -> Any:
        frame = self._frame(index)
        if frame >= self._count:
            if not self.landed.is_set():
                threading.Timer(_LOADED_S, self.landed.set).start()
            raise OSError("landed")  # ends the sender
        return self._flight.images[frame]

    def _klv(self, index: int) -> bytes:
        """ST 0601: the aircraft level, the sensor turned against it as the gimbal is against north and horizon."""
        flight = self._flight
        printed, at_s = flight.telemetry, self._frame(index) / flight.rate
        nearest = int(np.argmin(np.abs(flight.seconds - at_s)))
        azimuth, elevation, roll = flight.relative[nearest]
        latitude, longitude, height_m = (
            float(np.interp(at_s, flight.seconds, printed[name]))
            for name in ("latitude_deg", "longitude_deg", "orthometric_height_m")
        )
        return encode(
            _CLOCK_NS + self._later_ns + index * 10**9 // flight.rate,
            {
                "platform_heading_deg": float(flight.headings[nearest]),
                "platform_pitch_deg": 0.0,
                "platform_roll_deg": 0.0,
                "sensor_relative_azimuth_deg": azimuth,
                "sensor_relative_elevation_deg": elevation,
                "sensor_relative_roll_deg": roll % 360,
                "sensor_latitude_deg": latitude,
                "sensor_longitude_deg": longitude,
                "sensor_true_altitude_m": height_m,
                "frame_center_elevation_m": flight.ground_m,
            },
        )


@pytest.fixture(scope="module")
def flight(filmed: Path) -> FilmedFlight:
    return FilmedFlight(filmed)


def the_report(site: Path) -> dict[str, Any]:
    (report,) = (site / "flights").glob("*/report.json")
    return json.loads(report.read_text())


def corner_error_m(site: Path, flight: FilmedFlight, drone: Drone) -> float:
    """Root mean square error of the corners of the frames placed in flight, matched to the truth by their UTC."""
    true = json.loads((flight.truth / "frames.geojson").read_text())
    frame = LocalFrame(Geodetic(**true["site"]))
    (frames,) = (site / "flights").glob("*/frames.geojson")
    errors_m = []
    for each in json.loads(frames.read_text())["features"]:
        number = (
            drone.flight_s(datetime.fromisoformat(each["properties"]["time"]).timestamp())
            * flight.rate
        )
        if each["geometry"] is not None and number > 0.5:
            assert abs(number - round(number)) < 0.1  # the frame's own time, not when it came
            errors_m.append(
                _corners_m(each, frame) - _corners_m(true["features"][round(number)], frame)
            )
    assert len(errors_m) >= 5
    return float(np.sqrt((np.concatenate(errors_m) ** 2).sum(axis=1).mean()))


def _corners_m(feature: dict[str, Any], frame: LocalFrame) -> Any:
    lonlat = np.array(feature["geometry"]["coordinates"][0])[:4]
    return frame.site_from_wgs84(lonlat[:, 1], lonlat[:, 0], np.full(4, frame.origin.height_m))[
        :, :2
    ]


def fly_and_map(drone: Drone, site: Path, **kwargs: Any) -> int:
    """Map what the drone sends, which takes off when the first frame is on the map; how many frames were looked at."""
    count = 0
    with drone.sent():
        for _ in map_flights([drone.address], site, _MAP, live=_LIVE, until=drone.landed, **kwargs):
            count += 1
            drone.fly()
    return count


@pytest.fixture(scope="module")
def mapped_live(
    flight: FilmedFlight, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, Drone, int]:
    """The map of a stream with metadata, the drone that sent it, and how many frames were looked at."""
    site, drone = tmp_path_factory.mktemp("live") / "site", Drone(flight, metadata=True)
    return site, drone, fly_and_map(drone, site, camera=flight.camera)


def test_a_stream_with_metadata_becomes_a_map_like_a_files(
    flight: FilmedFlight, mapped_live: tuple[Path, Drone, int]
) -> None:
    site, drone, count = mapped_live
    report = the_report(site)
    assert count >= 7 and report["georeferenced"] and report["frames"]["vision"] >= 7
    assert report["telemetry"]["format"] == "klv" and report["telemetry"]["attitude"] == "gimbal"
    assert report["telemetry"]["samples"] > 60 and "ground given" in report["telemetry"]["height"]
    assert report["flight"].startswith("127.0.0.1") and report["inputs"] == [drone.address]
    assert corner_error_m(site, flight, drone) < 0.4
    assert (site / "mosaic.tif").is_file()
    delay_s = report["delay_s"]
    assert delay_s["frames"] >= report["frames"]["vision"] - 2  # each, once the map has begun
    assert 0 < delay_s["median"] <= delay_s["p95"] <= delay_s["largest"] < 60


def test_a_later_flight_is_compared_live(
    flight: FilmedFlight, mapped_live: tuple[Path, Drone, int]
) -> None:
    site, _, _ = mapped_live
    drone = Drone(flight, metadata=True, speed=1.0, count=30)
    statuses, announced = [], []
    with drone.sent():
        for update in compare_flights(
            [drone.address],
            site,
            CompareSettings(views_per_second=2.0, model="none"),
            camera=flight.camera,
            live=_LIVE,
            until=drone.landed,
        ):
            statuses.append(update.status)
            announced += update.announced
            drone.fly()
    assert statuses.count(ViewStatus.COMPARED) > 0.7 * len(statuses) and len(statuses) > 5
    assert not announced  # the same flight again


@pytest.mark.long  # a stream in real time; receivers and streams have tests of their own
def test_a_receiver_beside_a_stream_places_the_map(flight: FilmedFlight, tmp_path: Path) -> None:
    """Neither states more than it must: pictures without times, positions without the camera's angles."""
    site, drone, gps = (
        tmp_path / "site",
        Drone(flight, metadata=False, speed=1.0, count=42),
        free_port(),
    )
    printed = flight.telemetry
    is_over = threading.Event()

    def speak() -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            while not is_over.wait(0.2):
                at_s = 0.0 if drone.took_off_s is None else time.monotonic() - drone.took_off_s
                place = [
                    float(np.interp(at_s, flight.seconds, printed[name]))
                    for name in (
                        "latitude_deg",
                        "longitude_deg",
                        "orthometric_height_m",
                    )
                ]
                sender.sendto(gga(*place), ("127.0.0.1", gps))

    threading.Thread(target=speak, daemon=True).start()
    fly_and_map(drone, site, camera=flight.camera, telemetry=f"udp://:{gps}")
    is_over.set()
    report = the_report(site)
    assert report["georeferenced"] and report["telemetry"]["format"] == "nmea"
    assert report["telemetry"]["tie"] == "both are timed by when they came"
    assert "arrival_times" in [notice["code"] for notice in report["notices"]]
    frames = json.loads(next((site / "flights").glob("*/frames.geojson")).read_text())["features"]
    outlines = np.concatenate(
        [np.array(each["geometry"]["coordinates"][0]) for each in frames if each["geometry"]]
    )
    true = json.loads((flight.truth / "frames.geojson").read_text())["features"]
    expected = np.concatenate([np.array(each["geometry"]["coordinates"][0]) for each in true[:42]])
    # the ground covered is the same to some metres: 1e-5 deg is about one
    assert np.allclose(np.median(outlines, axis=0), np.median(expected, axis=0), atol=8e-5)


def gga(latitude_deg: float, longitude_deg: float, height_m: float) -> bytes:
    moment = datetime.now(UTC)
    body = (
        f"GPGGA,{moment:%H%M%S}.{moment.microsecond // 10_000:02d},{int(latitude_deg):02d}"
        f"{latitude_deg % 1 * 60:010.7f},N,{int(longitude_deg):03d}{longitude_deg % 1 * 60:010.7f},E,1,12,0.8,"
        f"{height_m:.2f},M,48.0,M,,"
    )
    return f"${body}*{reduce(xor, body.encode()):02X}\r\n".encode()


def test_a_stream_is_inspected(flight: FilmedFlight) -> None:
    drone = Drone(flight, metadata=True, speed=1.0)
    with drone.sent():
        (found,) = inspect_input([drone.address])
    assert (found.kind, found.frames.width_px, found.frames.codec, found.frames.container) == (
        "video",
        320,
        "h264",
        "mpegts",
    )
    assert (
        1.0 < found.frames.duration_s < 5
        and found.telemetry.format == "klv"
        and found.telemetry.positions > 5
    )
    assert found.telemetry.tie == "the metadata came with the frames"


def test_a_source_that_is_not_there_leaves_no_site(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert (
        cli.main(["map", "follow:/no/such.ts", "--site", str(tmp_path / "site"), "--model", "none"])
        == 1
    )
    assert (
        cli.main(
            [
                "map",
                str(tmp_path / "nowhere.mp4"),
                "--site",
                str(tmp_path / "site"),
                "--model",
                "none",
            ]
        )
        == 1
    )
    printed = capsys.readouterr().err
    assert (
        "no such file or folder: /no/such.ts" in printed and "no such file or folder: " in printed
    )
    assert not (tmp_path / "site").exists()
