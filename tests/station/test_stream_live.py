"""A camera's own stream sent on: MPEG-TS over UDP with KLV, a camera that restarts, what an earlier flight left."""

import json
import socket
import threading
import time
from itertools import pairwise
from pathlib import Path

import pytest
from stream_flights import write_video
from stream_server import TOKEN, StreamServer
from test_stream_messages import units

from sorvolo.capture.live.reconnect import LiveSettings
from sorvolo.errors import InputError
from sorvolo.station.client import StreamClient, StreamSettings, remains_of, stream_url
from sorvolo.station.footage import ArrivalClock, FootagePiece, Timeline, open_footage
from sorvolo.station.messages import Hello, Kind
from sorvolo.station.spool import Spool
from sorvolo.station.transport_stream import FlightFile


@pytest.fixture(scope="module")
def stream(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A second of a camera's transport stream with KLV."""
    folder = tmp_path_factory.mktemp("camera")
    file = FlightFile(folder / "camera.ts", "h264")
    for each in units(write_video(folder / "v.mp4", seconds=1), "h264"):
        file.append(each)
    file.close()
    return (folder / "camera.ts").read_bytes()


@pytest.fixture
def port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


class Camera:
    """Sends its stream over and over, as a camera that restarts: each time its clock begins anew."""

    def __init__(self, stream: bytes, port: int, pause_s: float) -> None:
        self._stream, self._port, self._pause_s = stream, port, pause_s
        self.off = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self.off.set()
        self._thread.join(5)

    def _run(self) -> None:
        step = 7 * 188
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            while not self.off.is_set():
                for at in range(0, len(self._stream), step):
                    sender.sendto(self._stream[at : at + step], ("127.0.0.1", self._port))
                    time.sleep(step / len(self._stream))
                self.off.wait(self._pause_s)


def taken(port: int, seconds: float) -> tuple[list[FootagePiece], list[str]]:
    """What a client takes from the camera in so many seconds, and what it noticed."""
    stop = threading.Event()
    footage = open_footage(
        f"udp://127.0.0.1:{port}", None, None, LiveSettings(first_s=10, give_up_s=3), stop
    )
    threading.Timer(seconds, stop.set).start()
    return list(footage.pieces(0, stop)), list(footage.notices())


def test_a_camera_that_restarts_is_one_flight(stream: bytes, port: int) -> None:
    camera = Camera(stream, port, pause_s=0.3)
    try:
        pieces, notices = taken(port, 3.5)
    finally:
        camera.close()
    pictures = [each for each in pieces if each.kind is Kind.VIDEO]
    samples = [json.loads(each.payload) for each in pieces if each.kind is Kind.TELEMETRY]
    assert len(pictures) > 10 and any("began anew" in each for each in notices)
    steps = [after.dts_us - before.dts_us for before, after in pairwise(pictures)]
    assert (
        min(steps) > 0 and max(steps) < 4_000_000
    )  # FFmpeg holds the last picture back over the pause
    assert (
        sum(
            each["columns"].get("latitude_deg") == pytest.approx(45.0, abs=1e-6) for each in samples
        )
        >= 2
    )


def test_no_camera_and_wrong_wishes_are_named(port: int, tmp_path: Path) -> None:
    live, stop = LiveSettings(first_s=0.3), threading.Event()
    with pytest.raises(InputError, match=r"no picture within .* is the camera sending"):
        open_footage(f"udp://127.0.0.1:{port}", None, None, live, stop)
    with pytest.raises(InputError, match="comes from a receiver"):
        open_footage(f"udp://127.0.0.1:{port}", str(tmp_path / "log.csv"), None, live, stop)
    (tmp_path / "a.ts").write_bytes(b"G")
    with pytest.raises(InputError, match="takes the camera's address, or a recording"):
        open_footage(f"follow:{tmp_path / 'a.ts'}", None, None, live, stop)


def test_a_timeline_never_jumps_back() -> None:
    timeline = Timeline(5_000_000)
    shown = []
    for dts_us, now_us in (
        (900, 0),
        (40_900, 40_000),
        (7, 2_040_000),
        (40_007, 2_080_000),
        (99_000_000, 2_120_000),
    ):
        shown.append(dts_us + timeline.shift(dts_us, now_us))
    assert (
        shown == [5_000_000, 5_040_000, 7_040_000, 7_080_000, 7_120_000] and timeline.restarts == 2
    )


def test_late_pictures_do_not_move_the_time_of_a_camera_without_telemetry() -> None:
    """The one that came soonest counts; a clock that is slow by 30 ms a minute is followed."""
    clock, began_ns, second_ns = ArrivalClock(), 1_760_000_000 * 10**9, 10**9
    late_ms = [900, 40, 8, 90, 30, 8, 200, 8]
    found = [
        clock.utc_ns(1_000_000 * step, began_ns + step * second_ns + late * 10**6)
        - step * second_ns
        - began_ns
        for step, late in enumerate(late_ms)
    ]
    assert found[0] == 900 * 10**6 and all(7_900_000 < each < 12_000_000 for each in found[2:])
    slow = [
        clock.utc_ns(1_000_000 * step, began_ns + round(step * second_ns * 1.0005))
        for step in range(60, 600)
    ]
    assert abs(slow[-1] - began_ns - round(599 * second_ns * 1.0005)) < 10_000_000
    assert clock.utc_ns(600_000_000, began_ns + 660 * second_ns) == began_ns + 660 * second_ns


def test_what_an_earlier_flight_left_is_sent_as_that_flight(stream: bytes, tmp_path: Path) -> None:
    spool = Spool(tmp_path / "spool", 1_000_000)
    spool.stated(Hello(spool.flight, "h264", 160, 120, 10.0, "old").to_json())
    left = units(write_video(tmp_path / "v.mp4", seconds=1), "h264")
    hour_ago_ns = time.time_ns() - 3_600_000_000_000
    for each in left:
        spool.append(
            each.kind,
            each.pts_us,
            each.payload,
            taken_ns=hour_ago_ns,
            is_key=each.is_key,
            dts_us=each.dts_us,
        )
    spool.close()
    again = Spool(tmp_path / "spool", 1_000_000)
    assert (
        remains_of(again, hour_ago_ns + 1) is None
    )  # a client that came back at once goes on with its flight
    remains = remains_of(again, time.time_ns())
    assert remains is not None and remains.name == "old"
    with StreamServer(tmp_path / "streams") as server:
        client = StreamClient(
            remains,
            again,
            stream_url(server.url, "drone"),
            TOKEN,
            StreamSettings(latency_s=1),
            threading.Event(),
        )
        report = client.run()
        assert client.is_complete and report.late == 0 and report.frames == 10
        (path,) = (tmp_path / "streams" / "drone").glob(f"*_{again.flight}.ts")
        assert path.with_name(path.name + ".ended").exists()
