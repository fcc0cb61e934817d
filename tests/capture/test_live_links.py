"""A receiver's sentences by UDP, TCP, serial port and a growing log, beside a live stream."""

import math
import os
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path

import pytest
from live_sender import EPOCH_NS, RATE, free_port, sending, udp_url

from sorvolo.capture.live.links import TelemetryLink
from sorvolo.capture.live.reconnect import LiveSettings
from sorvolo.capture.live.stream import LiveStream
from sorvolo.capture.source import open_sources
from sorvolo.capture.telemetry.autopilot_logs import MavlinkBuffer
from sorvolo.capture.telemetry.nmea import Epoch
from sorvolo.errors import InputError, SettingsError
from sorvolo.missions.flight.settings import MapSettings
from sorvolo.missions.flight.setup import prepare

S = 10**9
SETTINGS = LiveSettings(keeps_all=True, silent_s=0.4, give_up_s=20.0)


def sentences(utc_ns: int, seconds: float = 0.0) -> bytes:
    """GGA and RMC of a flight north at 5 m/s, 160 m above the sea."""
    moment = datetime.fromtimestamp(utc_ns / S, UTC)
    clock = f"{moment:%H%M%S}.{moment.microsecond // 10_000:02d}"
    minutes = 30 + 60 * 5.0 * seconds / 111_320
    both = (
        f"GNGGA,{clock},46{minutes:010.7f},N,01118.0000000,E,1,12,0.8,160.0,M,48.0,M,,",
        f"GNRMC,{clock},A,46{minutes:010.7f},N,01118.0000000,E,9.719,0.00,{moment:%d%m%y},,,A",
    )
    lines = b""
    for body in both:
        total = 0
        for letter in body.encode():
            total ^= letter
        lines += f"${body}*{total:02X}\r\n".encode()
    return lines


@contextmanager
def speaking(send: Callable[[bytes], object], every_s: float = 0.1) -> Iterator[None]:
    """A receiver that sends the time and its place until the end."""
    is_over, began_ns = threading.Event(), time.time_ns()

    def speak() -> None:
        while not is_over.wait(every_s):
            now_ns = time.time_ns()
            try:
                send(sentences(now_ns, (now_ns - began_ns) / S))
            except OSError:
                return

    thread = threading.Thread(target=speak, daemon=True)
    thread.start()
    try:
        yield
    finally:
        is_over.set()
        thread.join(2)


class Ear:
    """What a link gives on."""

    def __init__(self) -> None:
        self.epochs: list[tuple[int, Epoch]] = []
        self._came = threading.Condition()

    def __call__(self, arrived_ns: int, epoch: Epoch) -> None:
        with self._came:
            self.epochs.append((arrived_ns, epoch))
            self._came.notify_all()

    def wait(self, count: int, timeout_s: float = 60.0) -> bool:
        with self._came:
            return self._came.wait_for(lambda: len(self.epochs) >= count, timeout_s)

    def is_right(self) -> bool:
        return all(
            0 <= arrived_ns - epoch.time_ns < 2 * S
            and epoch.values["orthometric_height_m"] == 160.0
            and abs(epoch.values["speed_m_s"] - 5) < 0.01
            for arrived_ns, epoch in self.epochs
        )


def heard_from(address: str, ear: Ear) -> TelemetryLink:
    link = TelemetryLink(address, SETTINGS, ear)
    link.start()
    return link


def test_udp() -> None:
    port, ear = free_port(), Ear()
    link = heard_from(f"udp://:{port}", ear)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        with speaking(lambda data: sender.sendto(data.rstrip(b"\r\n"), ("127.0.0.1", port))):
            assert ear.wait(5)
        silent_from_s = time.monotonic()
        while not link.outages.silent_s and time.monotonic() < silent_from_s + 5:
            time.sleep(0.02)
        assert link.outages.silent_s > 0  # noticed, and reported when it is over
        count = len(ear.epochs)
        with speaking(lambda data: sender.sendto(data, ("127.0.0.1", port))):
            assert ear.wait(count + 3)
    link.close()
    assert ear.is_right()
    assert [notice.code for notice in link.notices()] == ["telemetry_outage"]


def test_tcp_that_breaks_is_called_again() -> None:
    ear = Ear()
    with socket.create_server(("127.0.0.1", 0)) as server:
        link = heard_from(f"tcp://127.0.0.1:{server.getsockname()[1]}", ear)
        for round_ in range(1, 3):
            connection, _ = server.accept()
            with connection, speaking(connection.sendall):
                assert ear.wait(3 * round_)
    link.close()
    assert ear.is_right() and link.outages.notices()[0].count >= 1


def test_a_log_that_grows(tmp_path: Path) -> None:
    log, ear = tmp_path / "log.nmea", Ear()
    log.write_bytes(sentences(time.time_ns()))
    link = heard_from(f"follow:{log}", ear)
    with log.open("ab", buffering=0) as file, speaking(file.write):
        assert ear.wait(4)
    link.close()
    assert ear.is_right()


def test_a_serial_port() -> None:
    pytest.importorskip("serial", reason="pyserial is not installed")
    receiver, computer = os.openpty()
    ear = Ear()
    link = heard_from(f"serial:{os.ttyname(computer)}?baud=4800", ear)

    def send_in_pieces(data: bytes) -> None:
        for at in range(0, len(data), 50):
            os.write(receiver, data[at : at + 50])

    with speaking(send_in_pieces):
        assert ear.wait(4)
    link.close()
    os.close(receiver)
    os.close(computer)
    assert ear.is_right()


def packets(
    utc_ns: int, boot_ms: int, *, system: int = 1, latitude: int = 528_000_000
) -> list[bytes]:
    """An autopilot's clock, attitude and position; with `utc_ns` 0 it has no date."""
    mavlink = pytest.importorskip("pymavlink.dialects.v20.ardupilotmega")
    vehicle = mavlink.MAVLink(None, srcSystem=system, srcComponent=1)
    gimbal = mavlink.MAVLink(None, srcSystem=system, srcComponent=154)
    place = (latitude, 132_000_000, 160_000, 55_000, 400, 300, 0, 9000)
    return [
        vehicle.system_time_encode(utc_ns // 1000, boot_ms).pack(vehicle),
        vehicle.attitude_encode(boot_ms, 0.1, -0.2, 0.5 * math.pi, 0, 0, 0).pack(vehicle),
        gimbal.attitude_encode(boot_ms, 0.0, -1.2, 2.0, 0, 0, 0).pack(gimbal),
        vehicle.global_position_int_encode(boot_ms, *place).pack(vehicle),
    ]


def test_an_autopilot_s_packets() -> None:
    port, ear = free_port(), Ear()
    link = heard_from(f"mavlink:udp://:{port}", ear)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        while not ear.wait(1, 0.2):  # the first position decides whose packets count
            for each in packets(time.time_ns(), 5000):
                sender.sendto(each, ("127.0.0.1", port))
        for number in range(5):
            heard, now_ns, boot_ms = len(ear.epochs), time.time_ns(), 5100 + 100 * number
            sent = packets(now_ns, boot_ms)
            if number == 3:
                sent.append(sent[-1][:20] + b"?" + sent[-1][21:])  # a bit that fell over
            sent += packets(now_ns, boot_ms, system=7)  # another vehicle
            for each in sent:
                sender.sendto(each, ("127.0.0.1", port))
            assert ear.wait(heard + 1)
    link.close()
    for _, epoch in ear.epochs[-5:]:
        assert abs(time.time_ns() - epoch.time_ns) < 30 * S
        assert epoch.values["latitude_deg"] == pytest.approx(52.8)
        assert epoch.values["orthometric_height_m"] == 160.0
        assert epoch.values["speed_m_s"] == pytest.approx(5.0)
        assert epoch.values["body_yaw_deg"] == pytest.approx(90.0, abs=1e-4)
        assert epoch.values["body_pitch_deg"] == pytest.approx(math.degrees(-0.2), abs=1e-4)
    counts = {each.code: each.count for each in link.notices()}
    assert (counts["bad_packet"], counts["other_vehicle"]) == (1, 1)


@pytest.mark.parametrize("dated_from", [0, 10, 90])
def test_an_autopilot_s_clock_does_not_jump_when_it_states_the_date(dated_from: int) -> None:
    """This computer's clock is a minute ahead of the vehicle's, and nothing may be lost for it."""
    pytest.importorskip("pymavlink")
    buffer, vehicle_ns, times_ns = MavlinkBuffer(Counter()), EPOCH_NS, []
    for number in range(60):
        boot_ms, passed_ns = 5000 + 100 * number, number * S // 10
        utc_ns = vehicle_ns + passed_ns if number >= dated_from else 0
        data = b"".join(packets(utc_ns, boot_ms))
        times_ns += [each.time_ns for each in buffer.take(data, vehicle_ns + 60 * S + passed_ns)]
    assert {b - a for a, b in pairwise(times_ns)} == {S // 10}
    ahead_s = 60 if dated_from > 30 else 0
    assert times_ns[-1] == vehicle_ns + ahead_s * S + 59 * S // 10
    assert len(times_ns) == 60 - max(1, min(dated_from, 30))
    again = buffer.take(b"".join(packets(0, 20, latitude=0)), 0)
    assert again == []  # switched on anew, its clock begins anew
    (restarted,) = buffer.take(b"".join(packets(vehicle_ns + 90 * S, 700)), 0)
    assert restarted.time_ns == vehicle_ns + 90 * S


def test_a_link_that_breaks_stays_with_its_vehicle() -> None:
    pytest.importorskip("pymavlink")
    ear = Ear()
    with socket.create_server(("127.0.0.1", 0)) as server:
        link = heard_from(f"mavlink:tcp://127.0.0.1:{server.getsockname()[1]}", ear)
        for count, systems in ((1, [1]), (3, [7, 1])):
            connection, _ = server.accept()
            with connection:
                for system in systems:
                    latitude = 528_000_000 + system * 10_000_000
                    sent = packets(time.time_ns(), 5000, system=system, latitude=latitude)
                    connection.sendall(sent[-1] + b"".join(sent))  # the position names the vehicle
                assert ear.wait(count)
    link.close()
    assert {round(epoch.values["latitude_deg"], 6) for _, epoch in ear.epochs} == {53.8}
    assert {each.code: each.count for each in link.notices()}["other_vehicle"] == 1


@pytest.mark.parametrize(
    ("address", "words"),
    [
        ("mavlink:tcp://:5", "no link; give serial:"),
        ("tcp://:5", "no link; give serial:"),
        ("udp://host", "no link"),
        ("follow:/no/such", "no such file"),
        ("serial:/dev/no_such", "no such serial port"),
        ("serial:/dev/null?baud=fast", "baud=fast is no number"),
        ("serial:/dev/null?speed=1", "unknown option speed"),
    ],
)
def test_links_that_cannot_be(address: str, words: str) -> None:
    if address.startswith("serial"):
        pytest.importorskip("serial", reason="pyserial is not installed")
    with pytest.raises((InputError, SettingsError), match=words):
        TelemetryLink(address, SETTINGS, lambda *_: None)


@pytest.mark.parametrize("has_metadata", [False, True])
def test_a_receiver_beside_a_stream_gives_where_each_frame_was_taken(has_metadata: bool) -> None:
    """The pictures' clock is this computer's or, with metadata, another: both are tied by when things come."""
    video, gps = free_port(), free_port()
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
        speaking(lambda data: sender.sendto(data, ("127.0.0.1", gps)), 0.2),
        sending(udp_url(video), klv=has_metadata),
    ):
        (source,) = open_sources(
            [f"udp://:{video}"],
            telemetry=f"udp://:{gps}",
            live=LiveSettings(keeps_all=True, silent_s=2.0),
        )
        assert isinstance(source, LiveStream)
        setup = prepare(source, MapSettings(), None, telemetry_named=True)
        assert setup.telemetry is not None
        first_samples = setup.telemetry.version
        assert first_samples >= 2
        priors = []
        for frame in source.frames(lambda index, _: index % 5 == 0):
            priors.append(setup.prior(frame, first=False))  # type: ignore[arg-type]
            if len(priors) == 12:
                break
        source.close()
    assert source.telemetry.format == "nmea" and setup.telemetry.version > first_samples
    assert all(prior.knows_place for prior in priors)
    north_m = [prior.position_m[1] for prior in priors]
    steps_m = [b - a for a, b in pairwise(north_m)]
    assert all(
        abs(step_m - 5.0 * 5 / RATE) < 0.4 for step_m in steps_m
    )  # 5 m/s north, a frame in 5
    # heights keep their zero while the telemetry grows, and no metadata came in between
    assert len({round(float(prior.position_m[2]), 3) for prior in priors}) == 1
    expected = "arrived" if not has_metadata else "ST 0601"
    assert (
        expected in source.start_origin
        and (source.start_ns > EPOCH_NS + 1000 * S) is not has_metadata
    )
