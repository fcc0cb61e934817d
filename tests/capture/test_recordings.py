"""What is one recording: chapters that a camera cut are joined, small copies and duplicates are no flights."""

import os
import shutil
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from sorvolo.capture.flight_telemetry import tied_clock
from sorvolo.capture.recordings import recordings
from sorvolo.capture.source import Source, open_sources
from sorvolo.cluster.flights import find_flights
from sorvolo.errors import InputError
from sorvolo.survey.flight import Frame

av = pytest.importorskip("av")

BEGIN = datetime(2026, 5, 1, 12, 44, tzinfo=UTC)
RATE_HZ, FRAMES = 5, 10


def write_video(
    path: Path,
    seed: int = 0,
    side_px: int = 96,
    begin: datetime | None = BEGIN,
    frames: int = FRAMES,
) -> Path:
    """Frames of a texture of this seed that moves, of (side, 2/3 side) px."""
    texture = np.random.default_rng(seed).integers(0, 255, (16, 24 + 3 * frames), np.uint8)
    form = "matroska" if path.suffix.lower() == ".mkv" else "mp4"
    with av.open(str(path), "w", format=form) as container:
        if begin is not None:
            container.metadata["creation_time"] = begin.isoformat().replace("+00:00", "Z")
        stream = container.add_stream("libx264", rate=RATE_HZ)
        stream.width, stream.height, stream.pix_fmt = side_px, side_px * 2 // 3, "yuv420p"
        for index in range(frames):
            part = texture[:, 3 * index : 3 * index + 24]
            image = np.kron(part, np.ones((side_px // 24, side_px // 24), np.uint8))
            picture = np.repeat(image[..., None], 3, axis=2)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode(None))
    return path


def write_gpx(path: Path, begin: datetime, seconds: int) -> Path:
    points = "".join(
        f'<trkpt lat="{46.5 + 1e-5 * second:.6f}" lon="-92.25"><ele>240</ele>'
        f"<time>{(begin + timedelta(seconds=second)):%Y-%m-%dT%H:%M:%SZ}</time></trkpt>"
        for second in range(seconds)
    )
    path.write_text(
        '<?xml version="1.0"?><gpx version="1.1" creator="x" xmlns="http://www.topografix.com/GPX/1/1">'
        f"<trk><trkseg>{points}</trkseg></trk></gpx>"
    )
    return path


def of_notices(source: Source, code: str) -> list[str]:
    return [each.text for each in source.notices() if each.code == code]


@pytest.mark.parametrize(
    ("whole", "copy"),
    [
        ("GX010373.MP4", "GL010373.LRV"),
        ("DJI_0001.MP4", "DJI_0001.LRF"),
        ("VID_20260501_124400_00_001.mp4", "LRV_20260501_124400_01_001.lrv"),
        ("flight.mp4", "flight_proxy.mp4"),
        ("GX010373.MP4", "GL010373.MP4"),
        ("DJI_0001.MP4", "for the phone.mp4"),
    ],
)
def test_a_small_copy_is_left_out_and_named(tmp_path: Path, whole: str, copy: str) -> None:
    write_video(tmp_path / whole, side_px=192), write_video(tmp_path / copy, side_px=96)
    (source,) = open_sources([tmp_path])
    assert (source.inputs, source.camera.camera.width_px) == ((whole,), 192)
    assert of_notices(source, "left_out_copy") == [f"{copy}: a copy of {whole}, left out"]
    (alone,) = open_sources([tmp_path / copy])  # who names it wants it
    assert alone.inputs == (copy,) and not of_notices(alone, "left_out_copy")
    assert [each.path.name for each in find_flights([tmp_path], tmp_path / "maps")] == [whole]


def test_a_copy_without_its_original_is_all_there_is(tmp_path: Path) -> None:
    write_video(tmp_path / "GL010373.LRV")
    (source,) = open_sources([tmp_path])
    assert source.inputs == ("GL010373.LRV",)


def test_duplicates_and_second_lenses_are_no_flights(tmp_path: Path) -> None:
    whole = write_video(tmp_path / "a.mp4")
    shutil.copy(whole, tmp_path / "b again.mp4")
    write_video(tmp_path / "VID_20260501_124400_00_001.insv", 3)
    write_video(tmp_path / "VID_20260501_124400_10_001.insv", 4)
    found = recordings(sorted(tmp_path.iterdir()))
    assert {each.chapters[0].name: [copy.name for copy in each.copies] for each in found} == {
        "a.mp4": ["b again.mp4"],
        "VID_20260501_124400_00_001.insv": ["VID_20260501_124400_10_001.insv"],
    }


def test_recordings_as_long_as_each_other_are_no_copies(tmp_path: Path) -> None:
    for seed, name in enumerate(("flight1.mp4", "flight10.mp4", "flight.mp4")):
        write_video(tmp_path / name, seed, side_px=96 + 96 * seed, begin=None)
    assert len(recordings(sorted(tmp_path.iterdir()))) == 3


@pytest.mark.parametrize(
    ("names", "next_begin_s"),
    [
        (("GX010106.MP4", "GX020106.MP4"), 0.0),  # a GoPro states the first one's start in each
        (("GOPR0106.MP4", "GP010106.MP4"), 0.0),
        (("DJI_0001.MP4", "DJI_0002.MP4"), FRAMES / RATE_HZ),
        (("DJI_20260501124400_0001_V.MP4", "DJI_20260501124402_0002_V.MP4"), FRAMES / RATE_HZ),
        (("MAX_0001.MP4", "MAX_0002.MP4"), FRAMES / RATE_HZ),
    ],
)
def test_chapters_are_one_flight(
    tmp_path: Path, names: tuple[str, str], next_begin_s: float
) -> None:
    for number, name in enumerate(names):
        begin = BEGIN + timedelta(seconds=number * next_begin_s)
        write_video(tmp_path / name, number, begin=begin)
    for inputs in ([tmp_path], [tmp_path / names[0]], [tmp_path / each for each in names[::-1]]):
        (source,) = open_sources(inputs)
        assert (source.inputs, source.frame_count) == (names, 2 * FRAMES)
        assert len(of_notices(source, "joined_chapters")) == 1
    frames = [each for each in source.frames(lambda *_: True) if isinstance(each, Frame)]
    assert [each.index for each in frames] == list(range(2 * FRAMES))
    times_s = np.array([each.time_ns - frames[0].time_ns for each in frames]) / 1e9
    np.testing.assert_allclose(times_s, np.arange(2 * FRAMES) / RATE_HZ, atol=1e-6)
    assert np.abs(frames[0].image.astype(int) - frames[FRAMES].image).mean() > 20
    wanted = [each.index for each in source.frames(lambda index, _: index in (3, 14))]
    assert wanted == [3, 14]
    flights = find_flights([tmp_path], tmp_path / "maps")
    assert [each.path.name for each in flights] == [names[0]]


def test_a_file_cut_at_4_gb_goes_on_though_both_state_one_start(tmp_path: Path) -> None:
    first, other = (write_video(tmp_path / f"DJI_000{n}.MP4", n, frames=30) for n in (1, 2))
    assert len(recordings([first, other])) == 2
    os.truncate(first, 3_900_000_000)  # a sparse file
    assert len(recordings([first, other])) == 1


@pytest.mark.parametrize("logs", [("flight",), ("GX020106",), ("GX010106", "GX020106")])
def test_one_log_is_of_all_chapters(tmp_path: Path, logs: tuple[str, ...]) -> None:
    for number in (1, 2):
        write_video(tmp_path / f"GX0{number}0106.MP4", number)
    write_video(tmp_path / "GL010106.LRV", 1)
    for number, name in enumerate(logs):
        begin = BEGIN + timedelta(seconds=3 * number)
        write_gpx(tmp_path / f"{name}.gpx", begin, 6 // len(logs))
    (source,) = open_sources([tmp_path])
    assert tied_clock(source, source.telemetry).sample_s.tolist() == [0, 1, 2, 3, 4, 5]


def test_each_chapters_subtitles_count_from_its_own_start(tmp_path: Path) -> None:
    for number in (0, 1):
        name = f"DJI_000{number + 1}"
        write_video(tmp_path / f"{name}.MP4", number, begin=BEGIN + timedelta(seconds=2 * number))
        cues = (
            f"{each + 1}\n00:00:0{each},000 --> 00:00:0{each + 1},000\n[latitude: 46.5] [longitude: -92.{number}{each}] "
            "[rel_alt: 40.0 abs_alt: 240.0]\n"
            for each in (0, 1)
        )
        (tmp_path / f"{name}.SRT").write_text("\n".join(cues))
    (source,) = open_sources([tmp_path])
    assert tied_clock(source, source.telemetry).sample_s.tolist() == [0, 1, 2, 3]


def test_a_pause_makes_another_flight(tmp_path: Path) -> None:
    write_video(tmp_path / "DJI_0001.MP4", 1)
    write_video(tmp_path / "DJI_0002.MP4", 2, begin=BEGIN + timedelta(seconds=40))
    write_video(tmp_path / "DJI_0004.MP4", 3, begin=BEGIN + timedelta(seconds=42))
    assert [source.name for source in open_sources([tmp_path])] == [
        "DJI_0001", "DJI_0002", "DJI_0004",
    ]  # fmt: skip


def test_a_later_chapter_alone_is_tied_to_no_log_by_its_clock(tmp_path: Path) -> None:
    video = write_video(tmp_path / "GX020106.MP4")
    log = write_gpx(tmp_path / "GX020106.gpx", BEGIN - timedelta(seconds=5), 60)
    (source,) = open_sources([video], log)
    assert len(of_notices(source, "later_chapter")) == 1
    with pytest.raises(InputError, match=r"is chapter 2 of a recording.*offset_s SECONDS"):
        tied_clock(source, source.telemetry)
    assert tied_clock(source, source.telemetry, 17.8).sample_s[0] == pytest.approx(-5 - 17.8)
    write_video(tmp_path / "GX010106.MP4", 1)
    (whole,) = open_sources([tmp_path], log)
    assert tied_clock(whole, whole.telemetry).sample_s[0] == pytest.approx(-5)
