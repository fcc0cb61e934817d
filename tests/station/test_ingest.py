"""What a station refuses from a drone: wrong first words, bytes of something else, too much, times that cannot be."""

import asyncio
import time
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sorvolo.station.ingest import BUSY_CODE, REFUSED_CODE, Ingest, IngestLimits, LinkClosed
from sorvolo.station.messages import Hello, Kind, Message, MessageSample
from sorvolo.station.video import VideoHub

HELLO = Message(
    Kind.HELLO, 0, 0, Hello("a" * 16, "h264", 160, 120, 10.0).to_json().encode()
).to_bytes()
KEY = b"\x00\x00\x00\x01\x67\x42\x00\x0a\x00\x00\x00\x01\x68\xce\x00\x00\x01\x65\x88\x84"


class Drone:
    """A link that sends what it is given, then goes away; notes how it was closed."""

    def __init__(self, *messages: bytes, waits: bool = False) -> None:
        self._messages, self._waits = list(messages), waits
        self.closed: tuple[int, str] | None = None

    async def receive(self) -> bytes:
        if self._messages:
            return self._messages.pop(0)
        if self._waits:
            await asyncio.sleep(30)
        raise LinkClosed

    async def send(self, text: str) -> None:
        pass

    async def close(self, code: int, reason: str) -> None:
        self.closed = self.closed or (code, reason)


def served(
    folder: Path,
    *messages: bytes,
    stream: str = "drone",
    limits: IngestLimits | None = None,
    waits: bool = False,
) -> Drone:
    drone = Drone(*messages, waits=waits)
    ingest = Ingest(folder, limits or IngestLimits(free_bytes=0, message_bytes=2000, silent_s=0.1))
    asyncio.run(ingest.serve(stream, drone))
    return drone


def picture(seq: int = 1, pts_us: int = 0, payload: bytes = KEY) -> bytes:
    return Message(Kind.VIDEO, seq, pts_us, payload, is_key=True).to_bytes()


@pytest.mark.parametrize(
    ("messages", "words"),
    [
        ([b""], "26 at least"),
        ([picture()], "the first message must be a hello"),
        ([HELLO.replace(b"h264", b"vp80")], "h264 or hevc"),
        ([HELLO[:40]], "no JSON"),
        ([HELLO, HELLO], "in the middle of a flight"),
        ([HELLO, b"?" * 40], "unknown kind"),
        ([HELLO, picture(payload=b"GIF89a")], "none: it has no pictures"),
        ([HELLO, picture(payload=KEY[8:])], "no parameter sets"),
        ([HELLO, picture(payload=KEY + bytes(2000))], "2,000 at most"),
        ([HELLO, picture(pts_us=-1)], "at the time -1 us"),
        ([HELLO, picture(pts_us=2**60)], "at the time"),
        ([HELLO, Message(Kind.TELEMETRY, 1, 0, b"[]").to_bytes()], "no JSON object"),
    ],
)
def test_what_cannot_be_is_refused_for_good_and_in_words(
    tmp_path: Path, messages: list[bytes], words: str
) -> None:
    drone = served(tmp_path / "streams", *messages)
    assert (
        drone.closed is not None and drone.closed[0] == REFUSED_CODE and words in drone.closed[1]
    ), drone.closed


def test_what_may_pass_later_is_not_refused_for_good(tmp_path: Path) -> None:
    drone = served(tmp_path / "streams", HELLO, waits=True)
    assert drone.closed == (BUSY_CODE, "nothing came for 0 s")
    drone = served(tmp_path / "streams", HELLO, limits=IngestLimits(free_bytes=10**18))
    assert (
        drone.closed is not None
        and drone.closed[0] == BUSY_CODE
        and "disk is full" in drone.closed[1]
    )
    drone = served(tmp_path / "streams", HELLO, limits=IngestLimits(streams=0, free_bytes=0))
    assert drone.closed is not None and drone.closed[0] == BUSY_CODE


def test_a_stream_that_falls_silent_after_its_hello_is_free_for_the_drone_s_next_link(
    tmp_path: Path,
) -> None:
    """It is listed as not connected, its flight is not over, and goes on."""
    states: list[bool] = []
    limits = IngestLimits(free_bytes=0, silent_s=0.05)
    ingest = Ingest(tmp_path, limits, lambda _, state: states.append(state["is_connected"]))

    async def fly() -> tuple[Drone, Drone]:
        silent, back = Drone(HELLO, waits=True), Drone(HELLO, picture())
        await ingest.serve("drone", silent)
        assert ingest.state("drone")["is_connected"] is False
        await ingest.serve("drone", back)
        return silent, back

    silent, back = asyncio.run(fly())
    assert silent.closed is not None and silent.closed[0] == BUSY_CODE and back.closed is None
    assert states == [True, False, True, False]
    state = ingest.state("drone")
    assert state["frames"] == 1 and [each["is_over"] for each in state["flights"]] == [False]


def test_a_stream_of_many_flights_states_its_newest(tmp_path: Path) -> None:
    """Thousands of its states are kept as events: each with all flights ever, a station would grow with each flight."""
    folder = tmp_path / "drone"
    folder.mkdir()
    for number in range(25):
        (folder / f"20260101T0000{number:02d}Z_{number:016x}.ts").write_bytes(b"12345")
    ingest = Ingest(tmp_path, IngestLimits(free_bytes=0))
    state = ingest.state("drone")
    assert state["flight_count"] == 25 and len(state["flights"]) == 10
    assert state["flights"][-1] == {
        "flight": f"20260101T000024Z_{24:016x}",
        "bytes": 5,
        "is_over": False,
    }
    newest = ingest.newest("drone")
    assert newest is not None and newest.stem == state["flights"][-1]["flight"]
    assert ingest.kept_bytes("drone") == 125


@pytest.mark.parametrize(
    ("seconds", "is_known"), [(0, True), (-50, True), (-3600, False), (3600, False)]
)
def test_the_delay_of_pictures_is_stated_where_the_clocks_agree(
    tmp_path: Path, seconds: int, is_known: bool
) -> None:
    """Clocks apart, or a recorded flight: no page is given the flight's zero to count from."""
    ingest = Ingest(tmp_path, IngestLimits(free_bytes=0))
    sample = MessageSample(time.time_ns() + seconds * 1_000_000_000, {"latitude_deg": 46.0})
    stated = Message(Kind.TELEMETRY, 1, 2_000_000, sample.to_json().encode()).to_bytes()
    asyncio.run(ingest.serve("drone", Drone(HELLO, stated)))
    assert ingest.hub("drone").epoch_us == (
        sample.time_ns // 1000 - 2_000_000 if is_known else None
    )


def test_names_that_were_asked_for_once_are_forgotten(tmp_path: Path) -> None:
    """Whoever asks for many streams fills no memory, and keeps no drone out."""
    ingest = Ingest(tmp_path)
    watched = ingest.hub("watched")
    watched.join("annexb")
    for number in range(1000):
        ingest.hub(f"x{number}")
    assert ingest.hub("watched") is watched and len(ingest._hubs) == 2


def test_a_flight_comes_back_with_its_own_pictures_alone(tmp_path: Path) -> None:
    served(tmp_path / "streams", HELLO, picture())
    other = Message(
        Kind.HELLO, 0, 0, Hello("a" * 16, "hevc", 160, 120).to_json().encode()
    ).to_bytes()
    drone = served(tmp_path / "streams", other)
    assert drone.closed is not None and "this flight is h264, and now hevc comes" in drone.closed[1]
    assert len(list((tmp_path / "streams" / "drone").glob("*.ts"))) == 1


@settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    st.lists(
        st.one_of(
            st.binary(max_size=60),
            st.builds(
                lambda kind, seq, pts, payload, key: Message(
                    kind, seq, pts, payload, key
                ).to_bytes(),
                st.sampled_from([Kind.VIDEO, Kind.TELEMETRY]),
                st.integers(0, 9),
                st.integers(-5, 10**7),
                st.one_of(st.binary(max_size=30), st.just(KEY), st.just(b'{"time_ns": 5}')),
                st.booleans(),
            ),
        ),
        max_size=6,
    )
)
def test_no_bytes_break_the_station(tmp_path: Path, messages: list[bytes]) -> None:
    """Whatever comes is taken or refused; the file stays whole and the numbers in it increase."""
    drone = served(tmp_path / "streams", HELLO, *messages)
    assert drone.closed is None or drone.closed[0] in (REFUSED_CODE, BUSY_CODE)
    (path,) = (tmp_path / "streams" / "drone").glob("*.ts")
    assert path.stat().st_size % 188 == 0


def test_parameter_sets_that_ffmpeg_does_not_take_leave_the_other_viewers_their_pictures(
    tmp_path: Path,
) -> None:
    """Fragments need a header made of them, access units do not."""
    hub = VideoHub()
    hub.begin(Hello("a" * 16, "h264", 160, 120, 10.0))
    pages = hub.join("annexb"), hub.join("fmp4")
    hub.show(Message(Kind.VIDEO, 1, 0, KEY, is_key=True))
    assert [
        len([each for each in iter(page.take, None) if isinstance(each, bytes)]) for page in pages
    ] == [1, 0]
