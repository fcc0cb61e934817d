"""Videos read by the key frames of their streams: the same frames, fewer decoded; in full where a stream is odd."""

import random
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from test_video import all_frames, open_video, write_video

from sorvolo.capture.video import VideoSource
from sorvolo.capture.video_spans import SparseReading
from sorvolo.capture.video_stream import stamp_of
from sorvolo.survey.flight import Frame

# `write_video` gives 25 frames a second, and a key frame of the stream each ten
X264 = {"preset": "fast", "x264-params": "bframes=2:scenecut=0"}
OPEN_X264 = {"preset": "fast", "x264-params": "bframes=2:scenecut=0:open-gop=1"}
OPEN_X265 = {
    "x265-params": "log-level=none:keyint=10:min-keyint=10:scenecut=0:open-gop=1:bframes=3"
}


def sparse(
    step_s: float, *, enough: bool, wanted: range = range(10**6), longest_s: float = 2.5
) -> SparseReading:
    return SparseReading(
        step_s, lambda index, _: index in wanted, lambda before, after: enough, longest_s
    )


def read(source: VideoSource, reading: SparseReading) -> list[Frame]:
    found = list(source.frames(lambda index, _: reading.wanted(index, 0), reading))
    assert all(isinstance(each, Frame) for each in found)
    return found  # type: ignore[return-value]


def same(found: list[Frame], source: VideoSource) -> bool:
    """Whether they are frames of the whole video, to the last bit."""
    whole = all_frames(source)
    return all(
        (each.index, each.time_ns) == (whole[each.index].index, whole[each.index].time_ns)
        and np.array_equal(each.image, whole[each.index].image)  # type: ignore[union-attr]
        for each in found
    )


@pytest.mark.parametrize(
    ("name", "codec", "options"),
    [
        ("a.mp4", "libx264", X264),
        ("a.ts", "libx264", X264),
        ("b.mp4", "libx264", OPEN_X264),
        ("a.mkv", "libx265", OPEN_X265),
        ("b.mkv", "mjpeg", {}),
    ],
)
def test_key_frames_are_those_of_the_whole_video_and_the_rest_is_not_decoded(
    tmp_path: Path, name: str, codec: str, options: dict[str, str]
) -> None:
    source = open_video(
        write_video(
            tmp_path / name,
            45,
            codec=codec,
            options=options,
            pix_fmt="yuvj420p" if codec == "mjpeg" else "yuv420p",
        )
    )
    found = read(source, sparse(0.4, enough=True))
    assert [each.index for each in found][:5] == [0, 10, 20, 30, 40]
    reading = source.reading
    assert (
        not reading.whole_because
        and reading.decoded + reading.skipped == 45
        and reading.decoded <= 10
    )
    assert source.notices() == ()
    assert same(found, source)


@pytest.mark.parametrize(
    ("codec", "options"),
    [("libx264", X264), ("libx264", OPEN_X264), ("libx265", OPEN_X265)],
    ids=["closed", "open", "hevc"],
)
def test_what_lies_between_is_decoded_where_key_frames_are_not_enough(
    tmp_path: Path, codec: str, options: dict[str, str]
) -> None:
    source = open_video(write_video(tmp_path / "a.mkv", 45, codec=codec, options=options))
    found = read(source, sparse(0.12, enough=False))
    indexes = [each.index for each in found]
    assert {0, 10, 20, 30, 40} <= set(indexes) and max(
        np.diff(indexes)
    ) <= 6  # 3 are due, a reference comes within 3
    assert source.reading.skipped > 5  # pictures that no other refers to
    assert same(found, source)


def test_the_end_of_a_video_is_looked_at(tmp_path: Path) -> None:
    source = open_video(write_video(tmp_path / "a.mp4", 39, options=X264))
    assert read(source, sparse(0.12, enough=True))[-1].index >= 35


def test_what_was_taken_before_is_left_out_and_the_rest_comes_the_same(tmp_path: Path) -> None:
    source = open_video(write_video(tmp_path / "a.mp4", 60, options=X264))

    def odd(before: Frame, _: Frame) -> bool:
        return before.index % 20 == 0

    def indexes(wanted: range | set[int]) -> list[int]:
        reading = SparseReading(0.12, lambda index, _: index in wanted, odd)
        return [each.index for each in read(source, reading)]

    whole = indexes(range(60))
    assert any(each % 10 for each in whole[2:5])  # there are such between
    assert indexes(range(34, 60)) == [each for each in whole if each >= 34]
    wanted = {whole[3], *range(34, 60)}
    assert indexes(wanted) == [each for each in whole if each in wanted]


def test_key_frames_nearer_than_the_step_are_passed_over(tmp_path: Path) -> None:
    source = open_video(write_video(tmp_path / "a.mp4", 60, options=X264))
    assert [each.index for each in read(source, sparse(0.75, enough=True))][:3] == [0, 20, 40]


@pytest.mark.parametrize(
    ("name", "options", "longest_s", "reason"),
    [
        ("a.mp4", {"x264-params": "keyint=250:scenecut=0"}, 1.0, "more than 1 s apart"),
        ("a.h264", X264, 2.5, "no time stamps"),
    ],
)
def test_a_stream_that_gives_no_key_frames_is_read_in_full(
    tmp_path: Path, name: str, options: dict[str, str], longest_s: float, reason: str
) -> None:
    source = open_video(write_video(tmp_path / name, 45, options=options))
    found = read(source, sparse(0.4, enough=True, longest_s=longest_s))
    assert [each.index for each in found] == list(range(45))
    assert reason in source.reading.whole_because and source.reading.decoded == 45


def test_damage_is_counted_as_it_is_in_a_full_reading(tmp_path: Path) -> None:
    path = write_video(tmp_path / "a.ts", 60, options=X264)
    data = bytearray(path.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 188 * 6] = random.Random(3).randbytes(188 * 6)
    path.write_bytes(bytes(data))
    source, full = open_video(path), open_video(path)
    found = read(source, sparse(0.4, enough=True))
    all_frames(full)
    assert "damaged" in source.reading.whole_because or "stamps" in source.reading.whole_because
    assert source.notices() == full.notices() and full.notices()
    assert found[-1].time_ns > 2.2e9 and (np.diff([each.index for each in found]) > 0).all()


def test_a_stamp_is_the_nearest_nanosecond() -> None:
    chance = random.Random(4)
    for _ in range(2000):
        base = Fraction(
            chance.choice([1, 7, 1001]),
            chance.choice([24, 12_800, 30_000, 90_000, 1 << 40, 2 * 10**9]),
        )
        pts = chance.randint(-(10**7), 10**9)
        assert stamp_of(SimpleNamespace(pts=pts, time_base=base)) == round(pts * base * 10**9)  # type: ignore[arg-type]
    assert stamp_of(SimpleNamespace(pts=None, time_base=Fraction(1, 25))) is None  # type: ignore[arg-type]
