"""The parts of a live source by themselves: clock, queue, growing telemetry, addresses, pauses, sentences."""

import threading
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sorvolo.capture.live.addresses import (
    FollowedPath,
    StreamAddress,
    is_live_address,
    live_address,
)
from sorvolo.capture.live.links import SentenceBuffer, is_link
from sorvolo.capture.live.reader import Backlog
from sorvolo.capture.live.reconnect import Backoff, LiveSettings, Outages
from sorvolo.capture.live.stream import Arrived, ClockTie, FrameQueue, StreamClock
from sorvolo.capture.live.telemetry_log import TelemetryLog
from sorvolo.errors import InputError, SettingsError

S = 10**9
UTC = 1_760_000_000 * S


def arrived(index: int) -> Arrived:
    decoded: Any = SimpleNamespace(width=100, height=100)  # 15,000 bytes
    return Arrived(index, index, 0.0, decoded)


def test_arrivals_are_timed_by_the_least_delayed() -> None:
    clock = StreamClock()
    for stamp, delay in ((0, 1.2), (0.5, 0.7), (1.0, 0.2), (1.1, 0.3)):  # a burst, then live
        clock.arrived(int(stamp * S), UTC + int((stamp + delay) * S))
    assert clock.settle() is ClockTie.ARRIVAL
    assert clock.utc_ns(int(1.1 * S)) == UTC + int(1.3 * S)


def test_a_camera_clock_that_drifts_is_followed() -> None:
    clock = StreamClock()
    clock.arrived(0, UTC)
    clock.settle()
    for second in range(1, 1200):  # 20 ms a minute, for 20 minutes
        utc_ns = UTC + int(second * S * (1 + 0.02 / 60))
        clock.arrived(second * S, utc_ns)
        found_ns = clock.frame_utc_ns(second * S)
    assert abs(found_ns - utc_ns) < 0.01 * S


def test_stated_times_win_and_stay_in_force_over_an_outage() -> None:
    clock = StreamClock()
    clock.stated(ClockTie.METADATA, 5 * S, UTC - 3600 * S)  # the drone's clock is an hour behind
    clock.stated(ClockTie.SENDER_REPORT, 5 * S, UTC - 7 * S)
    clock.arrived(5 * S, UTC)
    assert clock.settle() is ClockTie.METADATA
    assert clock.frame_utc_ns(5 * S) == UTC - 3600 * S
    assert clock.host_from_tie_ns() == 3600 * S
    clock.restart()  # from here on the metadata is missing: arrivals go on by the drone's clock
    clock.arrived(0, UTC + 20 * S)
    assert clock.frame_utc_ns(0) == UTC - 3600 * S + 20 * S


def test_times_of_frames_always_increase() -> None:
    clock = StreamClock()
    clock.arrived(0, UTC)
    first = clock.frame_utc_ns(0)
    clock.restart()
    clock.arrived(100, UTC - 50 * S)  # this computer's clock was set back
    assert clock.frame_utc_ns(100) == first + 1


def test_every_frame_waits_until_memory_ends() -> None:
    queue = FrameQueue(most_bytes=45_000, blocks=False)
    for index in range(5):
        queue.put(arrived(index))
    assert queue.holds_any
    queue.end()
    assert [each.index for each in iter(lambda: queue.take(0), None)] == [2, 3, 4]
    assert queue.skipped == 2 and queue.is_over and not queue.holds_any


def test_a_file_waits_for_its_reader() -> None:
    queue = FrameQueue(most_bytes=30_000, blocks=True)
    writer = threading.Thread(
        target=lambda: [queue.put(arrived(index)) for index in range(6)], daemon=True
    )
    writer.start()
    taken = []
    while len(taken) < 6 and (each := queue.take(2)) is not None:
        taken.append(each.index)
    writer.join(2)
    assert taken == [0, 1, 2, 3, 4, 5] and queue.skipped == 0


def test_of_long_telemetry_the_newest_samples_are_given_alone() -> None:
    log = TelemetryLog("klv", "udp://:1")
    for second in range(3000):  # more than there is room for at first
        log.add(
            UTC + second * S,
            {"latitude_deg": 46.5, "longitude_deg": 11.3, "speed_m_s": second % 100},
        )
    newest = log.telemetry(newest=10)
    assert newest.time_ns.tolist() == [UTC + second * S for second in range(2990, 3000)]
    assert (
        newest["speed_m_s"].tolist() == list(range(90, 100))
        and np.isnan(newest["course_deg"]).all()
    )
    assert len(log.telemetry()) == log.version == 3000 and len(log.telemetry(newest=5000)) == 3000
    times_ns, samples = log.samples(2998)
    assert times_ns.tolist() == newest.time_ns[-2:].tolist() and len(samples) == 2


def test_telemetry_grows_and_is_waited_for() -> None:
    log = TelemetryLog("nmea", "udp://:1")
    assert not len(log.telemetry()) and not log.wait_for_fixes(1, time.monotonic() + 0.01)
    log.add(UTC, {"latitude_deg": 46.5, "longitude_deg": 11.3})
    before = log.telemetry()
    threading.Timer(
        0.05, lambda: log.add(UTC + S, {"latitude_deg": 46.50001, "longitude_deg": 11.3})
    ).start()
    assert log.wait_past(UTC + 1, time.monotonic() + 5) and log.version == 2
    assert len(before) == 1 and len(log.telemetry()) == 2
    assert not log.wait_past(UTC + 2 * S, time.monotonic() + 0.01)
    log.add(UTC + S, {"latitude_deg": 0.0})  # late: it comes too late to be put in order
    log.add(
        UTC + 2 * S, {"latitude_deg": 60.0, "longitude_deg": 11.3}
    )  # a jump is cleaned away as in a file
    found = log.telemetry()
    assert [notice.code for notice in found.notices] == ["backward_time", "jump"]
    assert np.isfinite(found["latitude_deg"]).sum() == 2


def test_much_telemetry_is_kept() -> None:
    log = TelemetryLog("klv", "x")
    for index in range(3000):
        log.add(UTC + index * S // 10, {"latitude_deg": 46.5 + index * 1e-6, "longitude_deg": 11.3})
    found = log.telemetry()
    assert len(found) == 3000 and found["latitude_deg"][-1] == pytest.approx(46.502999)


def test_addresses(tmp_path: Path) -> None:
    assert (
        is_live_address("rtsp://h/x")
        and is_live_address("webcam:0")
        and is_live_address("follow:x")
    )
    assert not is_live_address("film.mp4") and not is_live_address("C:film.mp4")
    secret = live_address("rtsp://me:pa55@192.168.1.10:554/live")
    assert (
        isinstance(secret, StreamAddress)
        and "pa55" in secret.url
        and secret.shown == "rtsp://192.168.1.10:554/live"
    )
    heard = live_address("udp://:5000")
    assert isinstance(heard, StreamAddress) and heard.url == "udp://0.0.0.0:5000" and heard.waits
    group = live_address("udp://@239.1.2.3:5000")
    assert isinstance(group, StreamAddress) and group.url == "udp://@239.1.2.3:5000"
    pushed = live_address("rtmp://:1935/live")
    assert isinstance(pushed, StreamAddress) and pushed.waits and pushed.options["listen"] == "1"
    film = tmp_path / "film.ts"
    film.write_bytes(b"x")
    assert live_address(f"follow:{film}") == FollowedPath(film)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("udp://host", "no port"),
        ("http:///x", "no host"),
        ("follow:/no/such", "no such file"),
        ("follow:", "nothing"),
        ("webcam:77", "no such file or folder: /dev/video77"),
        ("rtsp://h:99999/x", "no address"),
    ],
)
def test_addresses_that_cannot_be(text: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        live_address(text)


def test_pauses_double_and_start_anew() -> None:
    backoff = Backoff()
    pauses_s = [backoff.next_s() for _ in range(8)]
    for pause_s, usual_s in zip(pauses_s, (0.5, 1, 2, 4, 8, 10, 10, 10)):
        assert 0.75 * usual_s <= pause_s <= 1.25 * usual_s
    backoff.reset()
    assert backoff.next_s() <= 0.625


def test_outages_are_counted_once_with_their_length(caplog: pytest.LogCaptureFixture) -> None:
    outages = Outages("udp://:5")
    outages.lost(time.monotonic() - 2, "silent for 2.0 s")
    outages.lost(time.monotonic(), "refused")
    assert outages.silent_s > 1.9
    outages.back()
    outages.back()
    assert (
        outages.silent_s == 0
        and len(outages.lengths_s) == 1
        and outages.lengths_s[0] == pytest.approx(2, abs=0.2)
    )
    assert caplog.records[0].message == "udp://:5: silent for 2.0 s; trying again"
    assert outages.notices()[0].count == 1


def test_settings_are_checked() -> None:
    with pytest.raises(SettingsError, match="silent_s"):
        LiveSettings(silent_s=0)


GGA = b"$GPGGA,120000.00,4630.0000,N,01118.0000,E,1,12,0.8,160.0,M,48.0,M,,*"
RMC = b"$GPRMC,120000.00,A,4630.0000,N,01118.0000,E,9.719,90.00,010203,,,A*"


def sentence(body: bytes, moment: str = "120000.00") -> bytes:
    text = body.replace(b"120000.00", moment.encode())
    total = 0
    for each in text[1:-1]:
        total ^= each
    return text + f"{total:02X}\r\n".encode()


def test_sentences_make_moments_however_they_are_cut() -> None:
    noon_ns = UTC - UTC % (86_400 * S) + 43_200 * S
    data = b"".join(
        sentence(body, moment) for moment in ("120000.00", "120001.00") for body in (GGA, RMC)
    )
    for cut in (1, 7, 40, 1000):
        counts: Counter[str] = Counter()
        buffer = SentenceBuffer(counts)
        found = [
            each
            for at in range(0, len(data), cut)
            for each in buffer.take(data[at : at + cut], noon_ns + 5 * S)
        ]
        found += buffer.take(b"", noon_ns + 5 * S)  # silence ends the last moment
        # the day is this computer's, whatever date the receiver invents
        assert [each.time_ns for each in found] == [noon_ns, noon_ns + S]
        assert found[0].values["speed_m_s"] == pytest.approx(5.0, abs=0.01) and not +counts
        assert found[1].values["orthometric_height_m"] == 160.0


def test_midnight_between_receiver_and_computer() -> None:
    midnight_ns = UTC - UTC % (86_400 * S) + 86_400 * S
    buffer = SentenceBuffer(Counter())
    buffer.take(sentence(GGA, "235959.80"), midnight_ns + S // 10)
    (found,) = buffer.take(b"", midnight_ns + S // 5)
    assert found.time_ns == midnight_ns - S // 5


def test_bad_sentences_are_counted_and_noise_is_not_kept() -> None:
    counts: Counter[str] = Counter()
    buffer = SentenceBuffer(counts)
    buffer.take(GGA + b"00\r\n", UTC)
    for _ in range(10):
        buffer.take(b"\xff\x00" * 500, UTC)
    assert +counts == {"bad_checksum": 1, "unreadable_line": 2}
    assert [is_link(text) for text in ("serial:/dev/x", "udp://:1", "log.nmea", "a/tcp")] == [
        True,
        True,
        False,
        False,
    ]


def decoded_of(
    step_s: float, jumps: Callable[[float], float] = lambda sent_s: 0.0
) -> list[tuple[float, float, bool]]:
    """Of 60 s of 30 packets a second, a key frame each second, when each was sent, its delay, and if it was decoded,
    which takes `step_s`; `jumps` is what the way takes longer by when it is sent."""
    backlog, now_s, found = Backlog(), 0.0, []
    for index in range(1800):
        sent_s = index / 30
        now_s = max(now_s, sent_s + 0.2 + jumps(sent_s))  # what waits is read at once
        is_decoded = backlog.decodes(round(sent_s * S), is_key=index % 30 == 0, now_s=now_s)
        found.append((sent_s, now_s - sent_s, is_decoded))
        now_s += step_s if is_decoded else 1e-4
    return found


def test_a_computer_too_slow_for_a_stream_shows_what_is_new() -> None:
    found = decoded_of(step_s=0.05)
    decoded = [each for each in found if each[2]]
    assert max(delay_s for _, delay_s, _ in decoded) < 2.0, "24 s without leaving anything out"
    assert len(decoded) > 0.4 * len(found)
    taken_up = [
        sent_s
        for (sent_s, _, now), (_, _, before) in zip(found[1:], found[:-1], strict=True)
        if now > before
    ]
    assert taken_up and all(sent_s % 1 == 0 for sent_s in taken_up), "with key frames"


def test_a_computer_that_is_fast_enough_decodes_everything() -> None:
    assert all(is_decoded for _, _, is_decoded in decoded_of(step_s=0.02))
    # the link stands still for 8 s, then all that waited comes at once
    after_outage = decoded_of(
        step_s=0.02, jumps=lambda sent_s: max(0.0, 28.0 - sent_s) if sent_s >= 20 else 0.0
    )
    assert all(is_decoded for sent_s, _, is_decoded in after_outage if sent_s < 20 or sent_s > 31)
    # a way that takes 3 s longer from now on is no backlog
    longer = decoded_of(step_s=0.02, jumps=lambda sent_s: 3.0 if sent_s >= 20 else 0.0)
    assert all(is_decoded for sent_s, _, is_decoded in longer if sent_s < 20 or sent_s > 22)
