"""Live sources on real loopback streams: times, metadata, outages, silence, sizes, and who calls whom."""

import socket
import threading
import time
from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import av
import numpy as np
import pytest
from live_sender import (
    EPOCH_NS,
    RATE,
    dialling,
    free_port,
    number_of,
    sending,
    sending_apart,
    udp_url,
)
from rtsp_server import RtspServer

from sorvolo.capture.live.addresses import StreamAddress, live_address
from sorvolo.capture.live.reader import StreamReader, open_stream
from sorvolo.capture.live.reconnect import LiveSettings
from sorvolo.capture.live.stream import LiveStream
from sorvolo.capture.source import open_sources, opened_sources
from sorvolo.errors import InputError
from sorvolo.survey.flight import Frame, LostFrame

S = 10**9
ALL = LiveSettings(keeps_all=True, silent_s=1.0, give_up_s=20.0, first_s=20.0)


def every_frame(_index: int, _time_ns: int) -> bool:
    return True


def taken(source: Any, count: int) -> list[tuple[float, Frame]]:
    """The next frames, each with when it was there; the stream stays open."""
    found = []
    for arrived_s, frame in source:
        assert isinstance(frame, Frame)
        found.append((arrived_s, frame))
        if len(found) == count:
            break
    return found


def open_live(address: str, settings: LiveSettings = ALL, **kwargs: Any) -> LiveStream:
    (source,) = open_sources([address], live=settings, **kwargs)
    assert isinstance(source, LiveStream)
    return source


def test_frames_come_in_order_with_the_times_of_their_metadata() -> None:
    port = free_port()
    with sending(udp_url(port), klv=True):
        source = open_live(f"udp://:{port}")
        frames = [frame for _, frame in taken(source.arrivals(every_frame), 25)]
        source.close()
    assert [frame.index for frame in frames] == list(range(25))
    for frame in frames:
        # each picture's time is that of the drone's clock, not this computer's
        sent = round((frame.time_ns - EPOCH_NS) / S * RATE)
        assert number_of(frame.image) == sent % 38
        assert abs(frame.time_ns - EPOCH_NS - sent * S // RATE) < 0.01 * S
    assert "ST 0601" in source.start_origin and source.kind == "video" and source.is_live
    telemetry = source.telemetry
    assert (
        telemetry.format == "klv"
        and len(telemetry) >= 25
        and source.telemetry_version == len(telemetry)
    )
    assert telemetry.time_ns[0] <= source.start_ns
    last = int(np.searchsorted(telemetry.time_ns, frames[-1].time_ns - 1000))
    assert telemetry["camera_pitch_deg"][last] == pytest.approx(-90, abs=1e-3)
    expected_deg = 46.5 + 5.0 * (frames[-1].time_ns - EPOCH_NS) / S / 111_320
    assert telemetry["latitude_deg"][last] == pytest.approx(expected_deg, abs=1e-6)
    assert source.ground_elevation_m == pytest.approx(100, abs=0.2)
    assert source.camera.camera.angle_of_view_deg[0] == pytest.approx(62.0, abs=0.01)
    assert "field of view" in source.camera.origin and not source.notices()


def test_the_first_frames_of_a_sender_that_begins_late_are_kept() -> None:
    port = free_port()
    opened: list[LiveStream] = []
    opening = threading.Thread(target=lambda: opened.append(open_live(f"udp://:{port}")))
    opening.start()
    time.sleep(1.0)
    with sending(udp_url(port)) as sender:
        opening.join(20)
        (source,) = opened
        time.sleep(0.3)  # a mission prepares itself
        frames = taken(source.arrivals(lambda index, _: index % 2 == 0), 30)
        late_s = time.monotonic() - sender.sent_s[number_of(frames[0][1].image) + 58]
        source.close()
    assert number_of(frames[0][1].image) <= 2  # 30 where what came while it was opened is lost
    assert [frame.index for _, frame in frames] == list(range(0, 60, 2))
    assert late_s < 1.0 and not any(notice.code == "skipped_frame" for notice in source.notices())


def test_a_stream_of_few_frames_a_second_is_opened_after_a_few() -> None:
    """FFmpeg by itself waits for twenty pictures or its time limit, to know their rate."""
    port = free_port()
    address = live_address(f"udp://:{port}")
    assert isinstance(address, StreamAddress)
    options, timeout_s = dict(address.options), (10, 5)
    with (
        sending(udp_url(port), rate=4) as sender,
        av.open(
            address.url, format=address.container, options=options, timeout=timeout_s
        ) as container,
    ):
        sent = len(sender.sent_s)
        rate = container.streams.video[0].average_rate
    assert rate == 4 and sent <= 15  # six on an idle computer


def test_without_metadata_frames_are_timed_by_when_they_came() -> None:
    port = free_port()
    with sending(udp_url(port)) as sender:
        source = open_live(f"udp://:{port}")
        frames = taken(source.arrivals(every_frame), 15)
        source.close()
        ahead_s = time.time() - time.monotonic()
    steps = {round((b.time_ns - a.time_ns) / S * RATE, 1) for (_, a), (_, b) in pairwise(frames)}
    assert steps == {1.0}
    for _, frame in frames:
        sent_s = min(
            (s for index, s in sender.sent_s.items() if index % 38 == number_of(frame.image)),
            key=lambda s: abs(s + ahead_s - frame.time_ns / S),
        )
        assert abs(frame.time_ns / S - (sent_s + ahead_s)) < 0.5
    assert [notice.code for notice in source.notices()] == ["arrival_times"]
    assert (
        "arrived" in source.start_origin and source.ground_elevation_m != source.ground_elevation_m
    )


def test_a_sender_that_dies_and_comes_back_is_one_flight_with_an_outage(
    caplog: pytest.LogCaptureFixture,
) -> None:
    port = free_port()
    frames: list[Frame] = []
    with sending(udp_url(port), klv=True):
        source = open_live(f"udp://:{port}")
        arrivals = source.arrivals(every_frame)
        frames += [frame for _, frame in taken(arrivals, 10)]

    def read_on() -> None:
        for _, frame in arrivals:
            assert isinstance(frame, Frame)
            frames.append(frame)
            if frame.time_ns > EPOCH_NS + 410 * S // RATE:
                return

    silent_from_s = time.monotonic()
    reader = threading.Thread(target=read_on, daemon=True)
    reader.start()
    while source.silent_s == 0 and time.monotonic() < silent_from_s + 10:
        time.sleep(0.02)
    noticed_s = time.monotonic() - silent_from_s
    while "silent for" not in caplog.text and time.monotonic() < silent_from_s + 10:
        time.sleep(0.02)  # the reading thread logs it a moment after it counts the silence
    assert 0.5 < noticed_s < 8.0 and "silent for" in caplog.text
    with sending(udp_url(port), klv=True, first=400):
        reader.join(20)
    assert not reader.is_alive()
    source.close()
    assert [frame.index for frame in frames] == list(range(len(frames)))
    assert all(a.time_ns < b.time_ns for a, b in pairwise(frames))
    for frame in frames:  # the second sender's stamps begin anew; its metadata ties them again
        assert number_of(frame.image) == round((frame.time_ns - EPOCH_NS) / S * RATE) % 38
    (outage,) = [notice for notice in source.notices() if notice.code == "outage"]
    assert outage.count == 1 and "back after" in caplog.text


def test_a_source_that_stays_silent_has_ended() -> None:
    port = free_port()
    with sending(udp_url(port), count=40):
        source = open_live(
            f"udp://:{port}", LiveSettings(keeps_all=True, silent_s=0.5, give_up_s=1.0)
        )
        began_s = time.monotonic()
        frames = list(source.frames(every_frame))
    assert frames and time.monotonic() - began_s < 10
    assert source.frame_count == len(frames)


@pytest.mark.long
def test_a_stream_that_is_decoded_too_slowly_is_shown_as_it_is_now(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Half the rate can be decoded: after ten seconds what is seen would be five seconds old, and ever older."""
    take, port = StreamReader._take, free_port()

    def slow_take(self: StreamReader, packet: Any) -> bool:
        time.sleep(0.0 if packet.stream.type == "data" else 2.0 / RATE)
        return take(self, packet)

    monkeypatch.setattr(StreamReader, "_take", slow_take)
    late_s: dict[int, float] = {}
    with sending(udp_url(port), klv=True) as sender:
        source = open_live(f"udp://:{port}", LiveSettings(silent_s=2.0))
        began_s = time.monotonic()
        for _, frame in source.arrivals(every_frame):
            index = round((frame.time_ns - EPOCH_NS) / S * RATE)
            late_s[index] = time.monotonic() - sender.sent_s[index]
            if time.monotonic() - began_s > 10.0:
                break
        source.close()
    assert max(late_s.values()) < 3.5, late_s
    (left_out,) = [notice for notice in source.notices() if notice.code == "behind"]
    assert left_out.count > 10 and len(late_s) > 20


def test_frames_of_another_size_are_fitted_and_of_another_shape_lost() -> None:
    port = free_port()
    source: LiveStream | None = None
    results: list[Frame | LostFrame] = []
    for size, first in (((160, 96), 0), ((320, 192), 400), ((96, 160), 800)):
        with sending(udp_url(port), klv=True, size=size, first=first):
            if source is None:
                source = open_live(f"udp://:{port}")
                arrivals = source.frames(every_frame)
            for each in arrivals:
                results.append(each)
                if (each.time_ns - EPOCH_NS) / S * RATE > first + 5:
                    break
    assert source is not None
    source.close()
    by_sender = [
        [each for each in results if (each.time_ns - EPOCH_NS) // (400 * S // RATE) == k]
        for k in range(3)
    ]
    assert all(
        isinstance(each, Frame) and each.image.shape == (96, 160, 3)
        for each in by_sender[0] + by_sender[1]
    )
    assert number_of(by_sender[1][-1].image) >= 0 and len(by_sender[1]) >= 2  # type: ignore[union-attr]
    assert by_sender[2] and all(
        isinstance(each, LostFrame)
        and each.reason == "size 96x160 differs from the flight's 160x96"
        for each in by_sender[2]
    )
    counts = {notice.code: notice.count for notice in source.notices()}
    assert counts["size_changed"] == len(by_sender[1]) and counts["other_shape"] == len(
        by_sender[2]
    )


def test_a_flight_ends_when_it_is_stopped() -> None:
    port, until = free_port(), threading.Event()
    with (
        sending(udp_url(port)),
        opened_sources([f"udp://:{port}"], live=ALL, until=until) as (source,),
    ):
        frames = source.frames(every_frame)
        next(frames)
        until.set()
        assert list(frames) == []


@pytest.fixture
def server() -> Iterator[RtspServer]:
    server = RtspServer()
    server.start()
    yield server
    server.close()


def test_rtsp_with_the_senders_clock_and_a_broken_connection(server: RtspServer) -> None:
    source = open_live(server.address)
    frames = source.frames(every_frame)
    first = [next(frames) for _ in range(5)]
    server.hang_up()
    after = []
    for each in frames:
        after.append(each)
        if any(notice.code == "outage" for notice in source.notices()) and len(after) > 20:
            break
    source.close()
    assert server.methods.count("PLAY") == 2 and "DESCRIBE" in server.methods
    assert source.start_origin == "the sender's RTCP reports"
    assert all(abs(each.time_ns / S - time.time()) < 20 for each in (*first, *after))
    assert all(a.time_ns < b.time_ns and a.index + 1 == b.index for a, b in pairwise(first + after))


def test_a_server_that_refuses_is_an_error_at_once() -> None:
    server = RtspServer(password=True)
    server.start()
    began_s = time.monotonic()
    with pytest.raises(
        InputError, match=r"401.*check the address, the name and the password"
    ) as refused:
        open_live(server.address.replace("//", "//me:secret@"))
    server.close()
    assert time.monotonic() - began_s < 10 and "secret" not in str(refused.value)


@pytest.mark.parametrize(
    "dialled_s",
    [
        pytest.param(0.5, id="at once"),
        pytest.param(
            2.8, id="just before nobody calling would be noticed"
        ),  # once it was hung up on at 3 s
    ],
)
@pytest.mark.parametrize(
    ("here", "there", "container"),
    [
        ("rtmp://:{}/live/x", "rtmp://127.0.0.1:{}/live/x", "flv"),
        ("tcp://:{}", "tcp://127.0.0.1:{}", "mpegts"),
    ],
)
def test_streams_that_are_pushed(here: str, there: str, container: str, dialled_s: float) -> None:
    port = free_port(socket.SOCK_STREAM)
    with (
        dialling(port, at_s=dialled_s) as (listens, own),
        sending_apart(there.format(own), container=container, count=10_000),
    ):
        listens.set()
        source = open_live(here.format(port))
        numbers = [number_of(frame.image) for _, frame in taken(source.arrivals(every_frame), 5)]
        source.close()
    assert all((b - a) % 38 == 1 for a, b in pairwise(numbers))


def test_nothing_there_is_an_error_with_a_reason() -> None:
    port = free_port()
    short = LiveSettings(first_s=0.5)
    with pytest.raises(
        InputError, match=rf"udp://:{port}: no picture within 0 s .*is the drone sending"
    ):
        open_live(f"udp://:{port}", short)
    with pytest.raises(InputError, match="Connection refused"):
        open_live(f"tcp://127.0.0.1:{free_port(socket.SOCK_STREAM)}", short)
    with pytest.raises(InputError, match="a live source takes its telemetry from a receiver"):
        open_live(f"udp://:{port}", short, telemetry="log.srt")
    with pytest.raises(InputError, match="recorded flight's telemetry is a file"):
        open_sources([__file__], telemetry="udp://:1")


MOVED = "302 Found\r\nCSeq: {cseq}\r\nLocation: INNER\r\n\r\n"


@pytest.fixture
def inner() -> Iterator[RtspServer]:
    server = RtspServer()
    server.start()
    yield server
    server.close()


def opened_at(server: RtspServer, *, follows: bool) -> bytes:
    """The first picture of a camera, as it was sent."""
    address = live_address(server.address)
    assert isinstance(address, StreamAddress)
    with open_stream(address, 5.0, LiveSettings(follows_redirects=follows)) as container:
        return bytes(next(container.demux(video=0)))


@pytest.mark.parametrize(
    "says",
    [
        "RTSP/1.0 " + MOVED,
        "R\rTSP/1.0   " + MOVED,
        "RTSP/1.0 200 OK\r\nCSeq: {cseq}\r\nContent-Length: 1\r\n\r\nxRTSP/1.0 " + MOVED,
        "$\0\0\1xRTSP/1.0 " + MOVED,
    ],
    ids=["plain", "veiled", "behind a body", "behind a picture"],
)
def test_a_camera_that_redirects_leads_nowhere_else(inner: RtspServer, says: str) -> None:
    """FFmpeg by itself goes wherever it is sent: to addresses that nobody checked."""
    camera = RtspServer(says=says.replace("INNER", inner.address))
    camera.start()
    with pytest.raises((av.FFmpegError, OSError)) as refused:
        opened_at(camera, follows=False)
    assert camera.methods and not inner.methods
    if says.startswith("RTSP/1.0 302"):
        assert f"redirects to {inner.address}" in str(refused.value)
    assert opened_at(camera, follows=True) and "PLAY" in inner.methods
    camera.close()


def test_a_camera_is_read_over_its_own_connection_alone(inner: RtspServer) -> None:
    assert opened_at(inner, follows=False)[:3] == opened_at(inner, follows=True)[:3]
    transport = "Transport: RTP/AVP;unicast;client_port=4000-4001;source=10.0.0.1"
    camera = RtspServer(says=f"RTSP/1.0 200 OK\r\nCSeq: {{cseq}}\r\n{transport}\r\n\r\n")
    camera.start()
    with pytest.raises(PermissionError, match="by UDP"):
        opened_at(camera, follows=False)
    camera.address = f"rtsp://127.0.0.1:{free_port()}/live"
    with pytest.raises(ConnectionRefusedError):
        opened_at(camera, follows=False)
    camera.close()
