"""Streaming through what happens in the field: cut links, slow links, wrong tokens, wrong pictures, clocks set anew."""

import shutil
import ssl
import subprocess
import threading
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import av
import pytest
from stream_flights import RATE, HeldFootage, write_track, write_video
from stream_server import TOKEN, StreamServer

from sorvolo.capture.live.reconnect import LiveSettings
from sorvolo.capture.source import open_sources
from sorvolo.errors import InputError, SettingsError
from sorvolo.station.client import StreamClient, StreamReport, StreamSettings, stream_url
from sorvolo.station.footage import Footage, open_footage
from sorvolo.station.ingest import IngestLimits
from sorvolo.station.messages import Kind
from sorvolo.station.spool import Spool
from waiting import wait_for

ALL = StreamSettings(speed=0, latency_s=float("inf"))


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("flights")
    write_track(folder / "flight.csv")
    return write_video(folder / "flight.mp4", bframes=2)


def client(
    video: Path,
    server: StreamServer,
    spool: Path,
    *,
    token: str = TOKEN,
    stream: str = "drone",
    settings: StreamSettings = ALL,
    stop: threading.Event | None = None,
    held: Callable[[Footage], Footage] = lambda footage: footage,
) -> StreamClient:
    stop = stop or threading.Event()
    footage = held(open_footage(str(video), None, None, LiveSettings(first_s=3, give_up_s=1), stop))
    url = stream_url(server.url, stream)
    return StreamClient(footage, Spool(spool, settings.spool_bytes), url, token, settings, stop)


class InTheAir:
    """A client whose flight stands still before its 16th picture of 30, with what comes before at the station."""

    def __init__(
        self,
        flight: Path,
        server: StreamServer,
        spool: Path,
        stop: threading.Event | None = None,
        settings: StreamSettings = ALL,
    ) -> None:
        self.client = client(flight, server, spool, stop=stop, settings=settings, held=self._held)
        self.thread = threading.Thread(target=self.client.run, daemon=True)
        self.thread.start()
        wait_for(lambda: self.client.report.frames >= 10)

    def _held(self, footage: Footage) -> Footage:
        self._footage = HeldFootage(footage, before=15)
        return self._footage

    def goes_on(self) -> None:
        self._footage.goes_on.set()


def kept(server: StreamServer, stream: str = "drone") -> Path:
    (path,) = (server.folder / stream).glob("*.ts")
    return path


def times(path: Path) -> list[int]:
    """The times of all pictures that a decoder finds, in order, in tenths of a second from the first."""
    with av.open(str(path)) as container:
        found = [round(float(frame.time) * RATE) for frame in container.decode(video=0)]
    return [each - found[0] for each in found]


def test_a_flight_arrives_whole_with_its_telemetry(flight: Path, tmp_path: Path) -> None:
    with StreamServer(tmp_path / "streams") as server:
        sending = client(flight, server, tmp_path / "spool")
        report = sending.run()
        path = kept(server)
        assert sending.is_complete and report.frames == 30 and report.late == report.overflowed == 0
        assert times(path) == list(range(30))
        assert path.with_name(path.name + ".ended").exists()
        (before,), (after,) = open_sources([flight]), open_sources([path])
        assert after.telemetry["latitude_deg"] == pytest.approx(
            before.telemetry["latitude_deg"], abs=1e-6
        )
        assert after.telemetry["height_above_takeoff_m"] == pytest.approx(40.0, abs=0.01)
        assert after.telemetry["body_yaw_deg"] == pytest.approx(0.0, abs=0.01)
        assert after.telemetry.video_time_ns == pytest.approx(
            [500_000_000 * each for each in range(7)], abs=2e6
        )
        assert after.telemetry.time_ns == pytest.approx(before.telemetry.time_ns, abs=2e6)


def test_a_server_killed_in_mid_flight_loses_and_doubles_nothing(
    flight: Path, tmp_path: Path
) -> None:
    with StreamServer(tmp_path / "streams") as server:
        drone = InTheAir(flight, server, tmp_path / "spool")
        server.kill()
        with kept(server).open("ab") as file:  # a message of which only a part was written
            file.write(b"\x47" + bytes(500))
        wait_for(lambda: not drone.client.report.is_linked)
        time.sleep(0.5)  # the outage's length
        server.start()
        drone.goes_on()
        drone.thread.join(60)
        report = drone.client.report
        assert not drone.thread.is_alive()
        assert times(kept(server)) == list(range(30))
        assert report.outages == 1 and report.outage_s > 0.4
        assert report.frames == 30 and report.late == 0


def test_a_client_that_restarts_goes_on_with_its_flight(flight: Path, tmp_path: Path) -> None:
    with StreamServer(tmp_path / "streams") as server:
        stop = threading.Event()
        drone = InTheAir(
            flight, server, tmp_path / "spool", stop, StreamSettings(speed=0, flush_s=0.2)
        )
        first = drone.client
        server.kill()
        drone.goes_on()
        wait_for(lambda: first._spool.counts().waiting > 0)
        stop.set()
        drone.thread.join(60)
        assert not first.is_complete and first.report.spooled > 0
        server.start()
        with pytest.raises(InputError, match="another sorvolo stream uses this spool"):
            client(flight, server, tmp_path / "spool")
        first._spool.close()
        again = client(flight, server, tmp_path / "spool")
        again.run()
        assert times(kept(server)) == list(range(30))


def test_on_a_slow_link_old_pictures_go_to_the_next_key_frame(tmp_path: Path) -> None:
    flight = write_video(
        tmp_path / "plain.mp4", seconds=2.4
    )  # shown in the order in which they are sent
    with StreamServer(
        tmp_path / "streams", pause_s=0.25
    ) as server:  # 4 messages a second, of the 11 that come
        settings = StreamSettings(latency_s=0.8)
        report = client(flight, server, tmp_path / "spool", settings=settings).run()
        found = times(kept(server))
        assert report.late > 0 and report.frames + report.late == 24 and len(found) == report.frames
        gaps = [after for before, after in pairwise(found) if after != before + 1]
        assert gaps and all(each % 10 == 0 for each in gaps)  # key frames stand at every tenth
        assert (
            max(report.delays_s) < 6.0
        )  # 0.8 s, and what a link that takes 4 of them a second holds


def test_a_full_spool_gives_up_the_oldest_pictures(tmp_path: Path) -> None:
    spool = Spool(tmp_path / "spool", 1_500_000)
    for number in range(30):
        spool.append(Kind.VIDEO, number, bytes(100_000), taken_ns=number, is_key=number % 10 == 0)
        spool.append(Kind.TELEMETRY, number, b"{}", taken_ns=number)
    found = []
    while (message := spool.next()) is not None:
        found.append(message)
    pictures = [each.pts_us for each in found if each.kind is Kind.VIDEO]
    assert pictures == list(range(20, 30))
    assert sum(each.kind is Kind.TELEMETRY for each in found) == 30
    assert spool.counts().overflowed == 20
    spool.acknowledge(60)
    assert (
        spool.is_empty
        and sum(each.stat().st_size for each in (tmp_path / "spool").glob("*.spool")) < 400_000
    )


def test_a_wrong_token_is_no_outage(flight: Path, tmp_path: Path) -> None:
    with StreamServer(tmp_path / "streams") as server:
        with pytest.raises(InputError, match="refuses the token"):
            client(flight, server, tmp_path / "spool", token="guess").run()
        assert not (tmp_path / "streams").exists()


def test_tls_with_an_authority_of_one_s_own(flight: Path, tmp_path: Path) -> None:
    if shutil.which("openssl") is None:
        pytest.skip("openssl is not installed")
    key, certificate = tmp_path / "key.pem", tmp_path / "cert.pem"
    subprocess.run(
        [
            "openssl",
            "req",
            "-x509",
            "-newkey",
            "rsa:2048",
            "-nodes",
            "-days",
            "2",
            "-subj",
            "/CN=station",
            "-addext",
            "subjectAltName=IP:127.0.0.1",
            "-keyout",
            str(key),
            "-out",
            str(certificate),
        ],
        check=True,
        capture_output=True,
    )
    tls = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    tls.load_cert_chain(certificate, key)
    with StreamServer(tmp_path / "streams", tls=tls) as server:
        with pytest.raises(
            InputError, match=r"certificate is not trusted .* give its authority as ca"
        ):
            client(flight, server, tmp_path / "spool1").run()
        trusting = StreamSettings(speed=0, authority=certificate)
        assert client(flight, server, tmp_path / "spool2", settings=trusting).run().frames == 30
        with pytest.raises(SettingsError, match="no usable certificate"):
            client(
                flight, server, tmp_path / "spool3", settings=StreamSettings(authority=flight)
            ).run()


def test_pictures_that_no_browser_plays_are_refused_at_once(tmp_path: Path) -> None:
    video = write_video(tmp_path / "old.avi", codec="mjpeg", seconds=0.5)
    with pytest.raises(InputError, match=r"mjpeg.*h264 or hevc.*ffmpeg -i INPUT"):
        open_footage(str(video), None, None, LiveSettings(), threading.Event())


def test_a_stream_that_is_not_what_it_states_is_refused(flight: Path, tmp_path: Path) -> None:
    with StreamServer(tmp_path / "streams") as server:
        sending = client(flight, server, tmp_path / "spool")
        object.__setattr__(sending._footage.format, "codec", "hevc")
        with pytest.raises(InputError, match=r"refuses the stream: what was sent as .*hevc"):
            sending.run()


def test_two_drones_of_one_name(flight: Path, tmp_path: Path) -> None:
    with StreamServer(tmp_path / "streams") as server:
        drone = InTheAir(flight, server, tmp_path / "spool1")
        second = client(flight, server, tmp_path / "spool2")
        also = threading.Thread(target=second.run, daemon=True)
        also.start()
        wait_for(
            lambda: (
                second.report.words == "another drone sends as drone; give --stream another name"
            )
        )
        drone.goes_on()
        for each in (drone.thread, also):
            each.join(60)
            assert not each.is_alive()
        files = sorted((tmp_path / "streams" / "drone").glob("*.ts"))
        assert [times(each) for each in files] == [
            list(range(30))
        ] * 2  # one after the other, never mixed


def test_a_full_disk_is_waited_for(flight: Path, tmp_path: Path) -> None:
    with StreamServer(tmp_path / "streams", limits=IngestLimits(free_bytes=10**18)) as server:
        stop = threading.Event()
        sending = client(
            flight,
            server,
            tmp_path / "spool",
            settings=StreamSettings(speed=0, flush_s=0.1),
            stop=stop,
        )

        def show(report: StreamReport) -> None:
            if "disk is full" in report.words and report.spooled == 30:
                stop.set()

        sending.run(show)
        assert "disk is full" in sending.report.words and sending.report.spooled == 30


def test_a_clock_that_restarts_is_joined(tmp_path: Path) -> None:
    video = write_video(tmp_path / "a.ts", seconds=1.0)
    (tmp_path / "b.ts").write_bytes(
        video.read_bytes() * 2
    )  # the second half begins at the first one's time
    with StreamServer(tmp_path / "streams") as server:
        sending = client(tmp_path / "b.ts", server, tmp_path / "spool")
        sending.run()
        found = times(kept(server))
        assert len(found) == 20 and found == sorted(found) and found[-1] <= 25
        assert any("began anew" in each for each in sending._footage.notices())
