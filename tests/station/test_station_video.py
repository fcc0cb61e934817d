"""A drone's pictures in the browser: begun at a key frame, dropped forward for the slow, never decoded."""

import json
from io import BytesIO

import av
import pytest
from stream_flights import write_video
from test_stream_messages import units

from sorvolo.station.messages import Hello, Kind, Message
from sorvolo.station.video import Mode, VideoHub, Viewer, annexb_bytes

FLIGHT = "a" * 16


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> list[Message]:
    video = write_video(tmp_path_factory.mktemp("video") / "v.mp4", bframes=2)
    shift = 200_000  # a client lets the flight's clock begin with the first decoded picture
    return [
        Message(
            each.kind,
            each.seq,
            each.pts_us + shift,
            each.payload,
            each.is_key,
            (each.dts_us or 0) + shift,
        )
        for each in units(video, "h264")
        if each.kind is Kind.VIDEO
    ]


def hub_with(pictures: list[Message]) -> VideoHub:
    hub = VideoHub()
    hub.begin(Hello(FLIGHT, "h264", 160, 120, 10.0))
    for each in pictures:
        hub.show(each)
    return hub


def taken(viewer: Viewer) -> list[bytes | str]:
    """Everything that waits for a viewer."""
    found = []
    while (item := viewer.take()) is not None:
        found.append(item)
    return found


def decoded(data: bytes) -> list[int]:
    with av.open(BytesIO(data)) as container:
        return [round(float(frame.time) * 1e6) for frame in container.decode(video=0)]


@pytest.mark.parametrize("mode", ["annexb", "fmp4"])
def test_a_new_viewer_begins_at_the_last_key_frame(pictures: list[Message], mode: Mode) -> None:
    hub = hub_with(pictures[:15])
    hub.epoch_us = 7
    viewer = hub.join(mode)
    for each in pictures[15:]:
        hub.show(each)
    first, *rest = taken(viewer)
    assert json.loads(str(first)) == {
        "type": "format",
        "codec": "avc1.4d400a",
        "width": 160,
        "height": 120,
        "fps": 10.0,
        "mode": mode,
        "epoch_us": 7,
    }
    expected = pictures[10:]
    if mode == "annexb":
        assert rest == [annexb_bytes(each) for each in expected]
        raw = BytesIO(b"".join(each[8:] for each in rest if isinstance(each, bytes)))
        with av.open(raw, format="h264") as container:
            assert sum(1 for _ in container.decode(video=0)) == 20
        return
    data = b"".join(each for each in rest if isinstance(each, bytes))
    assert decoded(data) == sorted(
        each.pts_us for each in expected
    )  # the flight's own times, to the microsecond


def test_late_and_early_viewers_share_what_was_packed_once(pictures: list[Message]) -> None:
    hub = hub_with([])
    early = hub.join("fmp4")
    for each in pictures[:12]:
        hub.show(each)
    late = hub.join("fmp4")
    for each in pictures[12:]:
        hub.show(each)
    for viewer, count in ((early, 30), (late, 20)):
        data = b"".join(each for each in taken(viewer) if isinstance(each, bytes))
        assert len(decoded(data)) == count


def test_a_slow_viewer_is_dropped_forward_to_a_key_frame_and_others_are_not(
    pictures: list[Message],
) -> None:
    hub = hub_with([])
    slow, quick = hub.join("annexb"), hub.join("annexb")
    got = []
    for _ in range(8):
        for each in pictures:
            hub.show(each)
        got += [each for each in taken(quick) if isinstance(each, bytes)]
    assert len(got) == 240 and quick.dropped == 0
    rest = [each for each in taken(slow) if isinstance(each, bytes)]
    assert slow.dropped == 240 - len(rest) > 100
    keys = {annexb_bytes(each) for each in pictures if each.is_key}
    assert rest[0] in keys


def test_who_joins_long_after_a_key_frame_waits_for_the_next(pictures: list[Message]) -> None:
    """What is kept for new viewers is bounded; pictures without those that they need are not shown."""
    hub = hub_with([pictures[0], *pictures[1:10] * 101])
    viewer = hub.join("annexb")
    hub.show(pictures[1])
    assert [isinstance(each, str) for each in taken(viewer)] == [True]
    hub.show(pictures[10])
    assert taken(viewer) == [annexb_bytes(pictures[10])]


def test_boxes_come_between_the_pictures(pictures: list[Message]) -> None:
    hub = hub_with(pictures[:1])
    viewer = hub.join("annexb")
    hub.note({"type": "boxes", "pts_us": 200_000, "boxes": []})
    hub.show(pictures[1])
    kinds = [
        json.loads(each)["type"] if isinstance(each, str) else "picture" for each in taken(viewer)
    ]
    assert kinds == ["format", "picture", "boxes", "picture"]


def test_who_left_gets_nothing(pictures: list[Message]) -> None:
    hub = hub_with(pictures[:1])
    viewer = hub.join("annexb")
    hub.leave(viewer)
    taken(viewer)
    hub.show(pictures[1])
    assert hub.viewers == 0 and taken(viewer) == []
