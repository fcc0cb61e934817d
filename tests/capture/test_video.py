"""Videos: every container and pixel format, broken clocks, cut and bit-flipped files."""

import random
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sorvolo.capture.live.reconnect import LiveSettings
from sorvolo.capture.source import open_sources
from sorvolo.capture.video import VideoSource, read_video_info
from sorvolo.capture.video_spans import SparseReading
from sorvolo.capture.video_stream import top_boxes
from sorvolo.errors import InputError
from sorvolo.survey.flight import Frame, LostFrame

FRAGMENTED = {"movflags": "frag_keyframe+empty_moov"}


def textured(width: int, height: int, count: int) -> list[np.ndarray]:
    """Frames that slide over chequered random ground, so that no two are alike; red left, blue right."""
    shape = (height + count) // 8 + 1, (width + 2 * count) // 8 + 1
    squares = np.random.default_rng(1).integers(60, 180, shape)
    ground = np.kron(squares, np.ones((8, 8), int)).astype(np.uint8)
    frames = []
    for index in range(count):
        window = ground[index : index + height, 2 * index : 2 * index + width]
        image = np.repeat(window[:, :, None], 3, axis=2)
        image[: height // 4, : width // 2] = (220, 30, 30)
        image[: height // 4, width // 2 :] = (30, 30, 220)
        frames.append(image)
    return frames


def write_video(
    path: Path,
    count: int = 30,
    size: tuple[int, int] = (160, 120),
    pix_fmt: str = "yuv420p",
    codec: str = "libx264",
    pts: list[int] | None = None,
    container_options: dict[str, str] | None = None,
    metadata: dict[str, str] | None = None,
    rotation: int | None = None,
    options: dict[str, str] | None = None,
) -> Path:
    with av.open(str(path), "w", options=container_options or {}) as container:
        container.metadata.update(metadata or {})
        stream = container.add_stream(codec, rate=25, options=options or {})
        stream.width, stream.height = size
        stream.pix_fmt = pix_fmt
        stream.codec_context.gop_size = 10
        stream.codec_context.time_base = Fraction(1, 1000)
        if rotation is not None:
            stream.set_display_rotation(rotation)
        for index, image in enumerate(textured(*size, count)):
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            frame.pts, frame.time_base = (pts[index] if pts else 40 * index), Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def open_video(path: Path) -> VideoSource:
    (source,) = open_sources([path])
    assert isinstance(source, VideoSource)
    return source


def all_frames(source: VideoSource) -> list[Frame | LostFrame]:
    return list(source.frames(lambda index, time_ns: True))


def codes(source: VideoSource) -> set[str]:
    return {notice.code for notice in source.notices()}


@pytest.mark.parametrize("name", ["a.mp4", "a.mkv", "a.ts", "a.mov"])
def test_every_container_gives_every_frame(tmp_path: Path, name: str) -> None:
    source = open_video(write_video(tmp_path / name))
    frames = all_frames(source)
    assert [frame.index for frame in frames] == list(range(30))
    assert [frame.name for frame in frames[:2]] == ["0", "1"]
    assert abs(source.frame_count - 30) <= 1 and source.frame_rate_hz == pytest.approx(25, rel=0.05)
    assert frames[0].time_ns == source.start_ns == 0
    step_s = np.diff([frame.time_ns for frame in frames]) / 1e9
    assert step_s == pytest.approx(0.04, abs=0.0011)
    assert source.notices() == ()
    for frame, image in zip(frames[::7], textured(160, 120, 30)[::7], strict=False):
        assert isinstance(frame, Frame) and frame.image.dtype == np.uint8
        assert frame.image.shape == (120, 160, 3)
        assert np.abs(frame.image.astype(int) - image).mean() < 8


@pytest.mark.parametrize(
    ("pix_fmt", "codec", "size"),
    [
        ("yuv420p", "libx264", (158, 118)),
        ("yuv444p", "libx264", (159, 117)),
        ("yuvj420p", "mjpeg", (160, 120)),
        ("yuv420p10le", "libx265", (160, 120)),
        ("gray", "libx264", (160, 120)),
        ("bgr0", "ffv1", (31, 17)),
    ],
)
def test_odd_sizes_and_pixel_formats(
    tmp_path: Path, pix_fmt: str, codec: str, size: tuple[int, int]
) -> None:
    if codec == "libx265" and codec not in av.codecs_available:
        pytest.skip("this PyAV has no libx265 encoder")
    options = {"x265-params": "log-level=none"} if codec == "libx265" else {}
    path = write_video(tmp_path / "a.mkv", 4, size, pix_fmt, codec, options=options)
    source = open_video(path)
    frames = all_frames(source)
    assert len(frames) == 4
    image = frames[0].image
    assert image.shape == (size[1], size[0], 3)
    if pix_fmt == "gray":
        assert np.ptp(image.astype(int), axis=2).max() <= 2
    else:
        assert image[2, 2, 0] > 180 > 80 > image[2, 2, 2] and image[2, -3, 2] > 180


@pytest.mark.parametrize("rotation", [0, 90, 180, -90])
def test_rotation_is_applied_as_players_do(tmp_path: Path, rotation: int) -> None:
    upright = textured(160, 120, 1)[0]
    source = open_video(write_video(tmp_path / "a.mp4", 3, rotation=rotation))
    image = all_frames(source)[0].image
    # FFmpeg's display rotation is counterclockwise, as np.rot90
    expected = np.rot90(upright, rotation // 90)
    assert image.shape == expected.shape
    assert np.abs(image.astype(int) - expected).mean() < 8
    camera = source.camera.camera
    assert (camera.width_px, camera.height_px) == image.shape[1::-1]


def test_a_variable_rate_and_a_late_first_frame_keep_the_true_times(tmp_path: Path) -> None:
    pts = [5000, 5040, 5080, 5300, 5340, 5345, 6000]
    source = open_video(
        write_video(
            tmp_path / "a.mkv",
            7,
            pts=pts,
            metadata={"creation_time": "2021-06-01T10:00:00.500000Z"},
        )
    )
    frames = all_frames(source)
    assert source.start_ns == 1_622_541_600_500_000_000 and "creation_time" in source.start_origin
    assert [(frame.time_ns - source.start_ns) // 1_000_000 for frame in frames] == [
        p - 5000 for p in pts
    ]


def test_a_clock_that_was_never_set_is_unknown(tmp_path: Path) -> None:
    path = write_video(tmp_path / "a.mkv", 3, metadata={"creation_time": "1970-01-01T00:00:07Z"})
    assert read_video_info(path).start_ns == 0


def test_wanted_is_asked_for_every_frame_and_rules(tmp_path: Path) -> None:
    source = open_video(write_video(tmp_path / "a.mp4"))
    asked: list[tuple[int, int]] = []

    def wanted(index: int, time_ns: int) -> bool:
        asked.append((index, time_ns))
        return index % 10 == 3

    assert [frame.index for frame in source.frames(wanted)] == [3, 13, 23]
    assert [index for index, _ in asked] == list(range(30))


def test_times_increase_whatever_the_stamps_do(tmp_path: Path) -> None:
    # two transport streams one after the other: the clock starts anew in the middle
    first, second = write_video(tmp_path / "1.ts"), write_video(tmp_path / "2.ts", 20)
    joined = tmp_path / "joined.ts"
    joined.write_bytes(first.read_bytes() + second.read_bytes())
    source = open_video(joined)
    times = [frame.time_ns for frame in all_frames(source)]
    assert len(times) >= 48 and (np.diff(times) > 0).all()
    assert times[-1] < 3e9
    assert codes(source) & {"backward_pts", "missing_pts"}


def test_a_raw_stream_without_stamps_is_timed_by_its_rate(tmp_path: Path) -> None:
    source = open_video(write_video(tmp_path / "a.h264"))
    times = [frame.time_ns for frame in all_frames(source)]
    assert len(times) == 30 and (np.diff(times) > 0).all()


@pytest.mark.parametrize(
    ("name", "container_options"),
    [("a.ts", {}), ("a.mkv", {}), ("a.mp4", FRAGMENTED)],
    ids=["ts", "mkv", "fragmented"],
)
def test_a_cut_file_delivers_what_is_there_and_reports_it(
    tmp_path: Path, name: str, container_options: dict[str, str]
) -> None:
    path = write_video(tmp_path / name, 60, container_options=container_options)
    data = path.read_bytes()
    path.write_bytes(data[: int(0.6 * len(data)) // 188 * 188 + 100])
    source = open_video(path)
    frames = all_frames(source)
    assert 20 <= len(frames) < 50
    assert "truncated" in codes(source)


def test_a_whole_file_is_not_called_cut(tmp_path: Path) -> None:
    for name, options in (("a.ts", {}), ("a.mkv", {}), ("a.mp4", FRAGMENTED), ("b.mp4", {})):
        assert not read_video_info(
            write_video(tmp_path / name, 5, container_options=options)
        ).is_cut


def test_a_cut_mp4_states_that_its_index_is_missing(tmp_path: Path) -> None:
    path = write_video(tmp_path / "a.mp4")
    data = path.read_bytes()
    assert "moov" in top_boxes(path)
    path.write_bytes(data[: len(data) * 6 // 10])
    with pytest.raises(InputError, match=r"moov atom not found.*copy it again.*MKV or TS"):
        open_sources([path])


def test_damage_in_the_middle_does_not_end_the_video(tmp_path: Path) -> None:
    path = write_video(tmp_path / "a.ts", 60)
    data = bytearray(path.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 188 * 6] = random.Random(3).randbytes(188 * 6)
    path.write_bytes(bytes(data))
    source = open_video(path)
    frames = all_frames(source)
    assert len(frames) > 40 and frames[-1].time_ns > 2.2e9
    assert codes(source) & {
        "decode_error",
        "damaged_frame",
        "backward_pts",
    }  # whichever of them the damage hit


def _joined(folder: Path, *size_px: tuple[int, int]) -> Path:
    """Twenty frames of each size, one after another in one file."""
    parts = [
        write_video(folder / f"{number}.ts", 20, size=size) for number, size in enumerate(size_px)
    ]
    joined = folder / "joined.ts"
    joined.write_bytes(b"".join(part.read_bytes() for part in parts))
    return joined


def test_a_frame_of_another_shape_is_lost_with_its_reason(tmp_path: Path) -> None:
    source = open_video(_joined(tmp_path, (160, 120), (160, 96)))
    lost = [frame for frame in all_frames(source) if isinstance(frame, LostFrame)]
    assert len(lost) >= 15 and lost[0].reason == "size 160x96 differs from the flight's 160x120"
    assert {each.code: each.count for each in source.notices()}["other_shape"] == len(lost)


def test_frames_of_another_size_but_the_same_shape_are_brought_to_the_first_one_s(
    tmp_path: Path,
) -> None:
    source = open_video(_joined(tmp_path, (160, 120), (128, 96)))
    frames = all_frames(source)
    assert len(frames) >= 35 and not any(isinstance(frame, LostFrame) for frame in frames)
    last = frames[-1]
    assert isinstance(last, Frame) and last.image.shape == (120, 160, 3)
    assert (
        last.image[10, 20, 0] > 180 and last.image[10, 140, 2] > 180
    )  # red left, blue right, as in all frames
    assert {each.code: each.count for each in source.notices()}["size_changed"] >= 15


def test_what_is_no_video_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        open_sources([tmp_path / "none.mp4"])
    empty = tmp_path / "empty.mp4"
    empty.touch()
    with pytest.raises(InputError, match="empty"):
        open_sources([empty])
    text = tmp_path / "text.mp4"
    text.write_text("this is no video\n" * 100)
    with pytest.raises(InputError, match=r"text\.mp4"):
        open_sources([text])
    sound = tmp_path / "sound.wav"
    with av.open(str(sound), "w") as container:
        stream = container.add_stream("pcm_s16le", rate=8000)
        audio = av.AudioFrame.from_ndarray(
            np.zeros((1, 8000), np.int16), format="s16", layout="mono"
        )
        audio.sample_rate = 8000
        container.mux(stream.encode(audio))
    with pytest.raises(InputError, match="no video in it, only audio"):
        open_sources([sound])


def test_a_list_of_files_named_as_a_video_opens_none_of_them(tmp_path: Path) -> None:
    write_video(tmp_path / "other.mp4")
    named = tmp_path / "flight.mp4"
    named.write_text("ffconcat version 1.0\nfile other.mp4\n")
    with av.open(str(named)) as container:
        assert container.format.name == "concat"  # what FFmpeg by itself does with it
    with pytest.raises(InputError, match="list of other files"):
        open_sources([named])
    with pytest.raises(InputError, match="no picture"):
        open_sources([f"follow:{named}"], live=LiveSettings(first_s=0.5, give_up_s=0.5))


def test_sample_frames_are_spread_over_the_video(tmp_path: Path) -> None:
    source = open_video(write_video(tmp_path / "a.mp4", 60))
    samples = source.sample_frames(4)
    assert len(samples) == 4 and len({frame.index for frame in samples}) >= 3
    assert samples[-1].index >= 40


@pytest.fixture(scope="module")
def originals(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("originals")
    for name in ("a.mp4", "a.ts", "a.mkv"):
        write_video(folder / name, 12, (64, 48))
    return folder


@settings(
    max_examples=60, deadline=10_000, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    name=st.sampled_from(["a.mp4", "a.ts", "a.mkv"]),
    seed=st.integers(0, 2**32),
    flips=st.integers(0, 200),
    keep=st.floats(0.02, 1.0),
    sparse=st.sampled_from([None, 0.04, 0.4]),
)
def test_damaged_files_raise_nothing_but_input_errors(
    tmp_path: Path,
    originals: Path,
    name: str,
    seed: int,
    flips: int,
    keep: float,
    sparse: float | None,
) -> None:
    chance = random.Random(seed)
    data = bytearray((originals / name).read_bytes())
    for _ in range(flips):
        data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
    path = tmp_path / name
    path.write_bytes(bytes(data[: max(1, int(keep * len(data)))]))
    try:
        source = open_video(path)
        reading = (
            None
            if sparse is None
            else SparseReading(sparse, lambda *_: True, lambda *_: seed % 2 == 0)
        )
        times = [frame.time_ns for frame in source.frames(lambda index, time_ns: True, reading)]
    except InputError:
        return
    assert len(times) <= 200 and (np.diff(times) > 0).all()
