"""What drones send, in bytes: messages, access units, the transport stream that survives being cut."""

import math
from pathlib import Path

import av
import pytest
from hypothesis import given
from hypothesis import strategies as st
from stream_flights import write_video

from sorvolo.capture.live.klv import local_sets
from sorvolo.capture.live.klv_telemetry import columns_of
from sorvolo.errors import InputError
from sorvolo.station.messages import (
    Hello,
    Kind,
    Message,
    MessageSample,
    begins_decoding,
    codec_string,
    hello_from_json,
    message_from_bytes,
    sample_from_json,
    with_parameter_sets,
)
from sorvolo.station.transport_stream import FlightFile, local_set

TIME_NS = 1_714_557_600_000_000_000


def units(video: Path, codec: str) -> list[Message]:
    """A video's pictures as messages, with a moment of telemetry after every fifth."""
    found: list[Message] = []
    with av.open(str(video)) as container:
        stream = container.streams.video[0]
        filtering = av.BitStreamFilterContext(f"{codec}_mp4toannexb", stream)
        for packet in container.demux(stream):
            for unit in filtering.filter(packet) if packet.size else ():
                pts, dts = (round(each * unit.time_base * 1e6) for each in (unit.pts, unit.dts))
                found.append(
                    Message(
                        Kind.VIDEO, len(found) + 1, pts, bytes(unit), bool(unit.is_keyframe), dts
                    )
                )
                if len(found) % 5 == 0:
                    sample = MessageSample(
                        TIME_NS + 1000 * pts,
                        {"latitude_deg": 45.0, "longitude_deg": 9.0 + pts * 1e-9},
                    )
                    found.append(
                        Message(Kind.TELEMETRY, len(found) + 1, pts, sample.to_json().encode())
                    )
    return found


@given(
    st.sampled_from([Kind.VIDEO, Kind.TELEMETRY]),
    st.integers(1, 2**63),
    st.integers(-(2**62), 2**62),
    st.binary(),
    st.booleans(),
)
def test_a_message_comes_back_from_its_bytes(
    kind: Kind, seq: int, time_us: int, payload: bytes, is_key: bool
) -> None:
    sent = Message(kind, seq, time_us, payload, is_key, time_us - 1)
    assert message_from_bytes(sent.to_bytes()) == sent


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"V", "26 at least"),
        (bytes(30), "unknown kind"),
        (b"X" + bytes(30), "unknown kind"),
    ],
)
def test_what_is_no_message_is_refused(data: bytes, words: str) -> None:
    with pytest.raises(InputError, match=words):
        message_from_bytes(data)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[]", "no JSON object"),
        ("{", "no JSON"),
        ('{"flight": "x"}', "codec"),
        ("[" * 100_000, "at most"),
        (Hello("a" * 16, "h264", 640, 480).to_json().replace("h264", "vp9"), "h264 or hevc"),
        (
            Hello("a" * 16, "h264", 640, 480).to_json().replace('"protocol": 1', '"protocol": 2'),
            "same version",
        ),
        (Hello("a" * 16, "h264", 640, 480).to_json().replace("aaa", "../"), "letters and digits"),
        (Hello("a" * 16, "h264", 640, 480).to_json().replace("640", "1e9"), "1000000000 x 480"),
    ],
)
def test_a_hello_that_cannot_be_is_refused_in_words(text: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        hello_from_json(text)


@pytest.mark.parametrize(
    "text",
    [
        '{"time_ns": -1}',
        '{"time_ns": true}',
        '{"time_ns": 1, "columns": {"speed_m_s": true}}',
        '{"time_ns": "soon"}',
        '{"time_ns": 1, "columns": 5}',
        "{}",
    ],
)
def test_telemetry_that_cannot_be_is_refused(text: str) -> None:
    with pytest.raises(InputError, match="telemetry"):
        sample_from_json(text)


def test_telemetry_keeps_what_is_known_and_drops_the_rest() -> None:
    text = '{"time_ns": 5, "columns": {"latitude_deg": NaN, "speed_m_s": 3, "evil": 1}, "stated": {"slant_range_m": 9}}'
    assert sample_from_json(text) == MessageSample(5, {"speed_m_s": 3.0}, {"slant_range_m": 9.0})


@given(
    st.fixed_dictionaries(
        {},
        optional={
            "latitude_deg": st.floats(-90, 90),
            "longitude_deg": st.floats(-179.99, 179.99),
            "orthometric_height_m": st.floats(-900, 19_000),
            "height_above_takeoff_m": st.floats(-20_000, 20_000),
            "horizontal_sigma_m": st.floats(0, 10_000),
            "speed_m_s": st.floats(0, 1000),
            "course_deg": st.floats(0, 360),
        },
    )
)
def test_a_local_set_states_what_the_telemetry_did(columns: dict[str, float]) -> None:
    (stated,) = local_sets(local_set(MessageSample(TIME_NS, columns)), counts={})  # type: ignore[arg-type]
    assert stated.time_ns == TIME_NS
    found = columns_of(stated)
    assert set(found) == set(columns)
    steps = {"orthometric_height_m": 0.16, "course_deg": 0.003}
    assert all(
        math.isclose(found[name], value, abs_tol=steps.get(name, 2e-5))
        for name, value in columns.items()
    )


def test_a_gimbal_and_an_aircraft_without_one() -> None:
    gimbal = {"camera_yaw_deg": -90.0, "camera_pitch_deg": -80.0, "camera_roll_deg": 0.0}
    found = columns_of(next(local_sets(local_set(MessageSample(TIME_NS, gimbal)), counts={})))  # type: ignore[arg-type]
    assert found["camera_pitch_deg"] == pytest.approx(-80, abs=0.01)
    assert found["camera_yaw_deg"] % 360 == pytest.approx(270, abs=0.01)
    body = {"body_yaw_deg": 20.0, "body_pitch_deg": -40.0, "body_roll_deg": 3.0}
    found = columns_of(next(local_sets(local_set(MessageSample(TIME_NS, body)), counts={})))  # type: ignore[arg-type]
    assert found == pytest.approx(body, abs=0.01)


@pytest.mark.parametrize(
    ("library", "codec", "name"), [("libx264", "h264", "avc1."), ("libx265", "hevc", "hvc1.1.")]
)
def test_a_flight_s_file_is_read_by_anyone_and_survives_being_cut(
    tmp_path: Path, library: str, codec: str, name: str
) -> None:
    messages = units(write_video(tmp_path / "v.mp4", seconds=2, codec=library, bframes=2), codec)
    assert (codec_string(codec, messages[0].payload) or "").startswith(name)
    file = FlightFile(tmp_path / "whole.ts", codec)
    ends = []
    for each in messages:
        file.append(each)
        ends.append(file.size_bytes)
    file.close()
    whole = (tmp_path / "whole.ts").read_bytes()
    with av.open(str(tmp_path / "whole.ts")) as container:
        assert len(container.streams.data) == 1 and sum(1 for _ in container.decode(video=0)) == 20
    for cut in (0, 100, ends[0] - 1, ends[3], ends[7] + 500, len(whole) - 1, len(whole)):
        (tmp_path / "cut.ts").write_bytes(whole[:cut])
        again = FlightFile(tmp_path / "cut.ts", codec)
        assert again.last_seq == sum(end <= cut for end in ends)
        for each in messages[again.last_seq :]:
            again.append(each)
        again.close()
        assert (tmp_path / "cut.ts").read_bytes() == whole


def test_a_hole_that_a_power_cut_left_ends_the_file_there(tmp_path: Path) -> None:
    messages = units(write_video(tmp_path / "v.mp4", seconds=2), "h264")
    file = FlightFile(tmp_path / "f.ts", "h264")
    ends = []
    for each in messages:
        file.append(each)
        ends.append(file.size_bytes)
    file.close()
    with (tmp_path / "f.ts").open(
        "r+b"
    ) as raw:  # the blocks after it reached the disk, these did not
        raw.seek(ends[4] + 200)
        raw.write(bytes(188))
    assert FlightFile(tmp_path / "f.ts", "h264").last_seq == 5


def test_key_frames_get_the_parameter_sets_that_stand_outside() -> None:
    sets, key = b"\x00\x00\x00\x01\x67\x42\x00\x0a\x00\x00\x00\x01\x68\xce", b"\x00\x00\x01\x65\x88"
    assert not begins_decoding("h264", key)
    assert begins_decoding("h264", with_parameter_sets("h264", key, sets))
    assert with_parameter_sets("h264", sets + key, b"other") == sets + key
