"""Inputs as flights: what becomes a flight, under which name, with which camera and telemetry."""

import os
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from real_data import real_data
from sorvolo.capture.photos import PhotoSource
from sorvolo.capture.source import open_sources, safe_name
from sorvolo.errors import InputError
from sorvolo.geometry.camera import Camera
from sorvolo.lab.simulation.flight_files import write_camera
from sorvolo.survey.flight import Frame

av = pytest.importorskip("av")

SRT = """1
00:00:00,000 --> 00:00:01,000
<font size="36">SrtCnt : 1, DiffTime : 1000ms
2021-06-01 10:00:00.000
[iso : 100] [latitude: 46.500000] [longitude: -92.250000] [rel_alt: 40.000 abs_alt: 240.000] </font>

2
00:00:01,000 --> 00:00:02,000
<font size="36">SrtCnt : 2, DiffTime : 1000ms
2021-06-01 10:00:01.000
[iso : 100] [latitude: 46.500050] [longitude: -92.250000] [rel_alt: 40.000 abs_alt: 240.000] </font>
"""


def write_video(
    path: Path, seed: int = 0, rotation: int | None = None, *, with_sound: bool = False
) -> Path:
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=5)
        stream.width, stream.height, stream.pix_fmt = 96, 64, "yuv420p"
        if rotation is not None:
            stream.set_display_rotation(rotation)
        sound = container.add_stream("aac", rate=44100) if with_sound else None
        for index in range(10):
            image = np.full((64, 96, 3), (20 * index + seed) % 255, np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        if sound is not None:
            silence = np.zeros((1, 44100), np.float32)
            frame = av.AudioFrame.from_ndarray(silence, format="fltp", layout="mono")
            frame.rate = 44100
            container.mux(sound.encode(frame))
            container.mux(sound.encode(None))
        container.mux(stream.encode(None))
    return path


def write_photos(folder: Path, count: int = 3) -> Path:
    folder.mkdir(exist_ok=True)
    for index in range(count):
        pixels = np.random.default_rng(index).integers(0, 255, (48, 64, 3), np.uint8)
        Image.fromarray(pixels).save(folder / f"IMG_{index}.jpg")
    return folder


def test_names_are_safe_for_folders() -> None:
    assert safe_name("Flug über der Düne (2)") == "Flug_ber_der_D_ne_2_".strip("_")
    assert safe_name("../../etc") == "etc" and safe_name("...") == "flight"
    assert safe_name("DJI_0001") == "DJI_0001"


def test_videos_folders_and_single_photos_become_flights(tmp_path: Path) -> None:
    video = write_video(tmp_path / "DJI_0001.mp4")
    folder = write_photos(tmp_path / "beach")
    single = sorted(write_photos(tmp_path / "more", 2).iterdir())
    found = open_sources([video, folder, *single])
    assert [(source.name, source.kind, source.frame_count) for source in found] == [
        ("DJI_0001", "video", 10),
        ("beach", "photos", 3),
        ("more", "photos", 2),
    ]
    assert found[1].inputs == ("IMG_0.jpg", "IMG_1.jpg", "IMG_2.jpg")
    assert len(found[0].telemetry) == len(found[1].telemetry) == 0


def test_a_folder_of_videos_is_as_many_flights(tmp_path: Path) -> None:
    write_video(tmp_path / "a.mp4"), write_video(tmp_path / "b.mkv")
    (tmp_path / "readme.txt").write_text("x")
    assert [source.name for source in open_sources([tmp_path])] == ["a", "b"]


def test_equal_names_get_their_folder_before_them(tmp_path: Path) -> None:
    for seed, card in enumerate(("card1", "card2")):
        (tmp_path / card).mkdir()
        write_video(tmp_path / card / "DJI_0001.mp4", seed)
    found = open_sources([tmp_path / "card1" / "DJI_0001.mp4", tmp_path / "card2" / "DJI_0001.mp4"])
    assert [source.name for source in found] == ["card1_DJI_0001", "card2_DJI_0001"]


def test_telemetry_is_found_beside_the_video_or_given(tmp_path: Path) -> None:
    video = write_video(tmp_path / "DJI_0001.mp4")
    (tmp_path / "DJI_0001.SRT").write_text(SRT)
    (beside,) = open_sources([video])
    assert beside.telemetry["latitude_deg"].tolist() == [46.5, 46.50005]
    other = tmp_path / "elsewhere"
    other.mkdir()
    (other / "log.srt").write_text(SRT.replace("46.5", "47.5"))
    (given,) = open_sources([video], telemetry=other / "log.srt")
    assert given.telemetry["latitude_deg"][0] == 47.5
    with pytest.raises(InputError, match="one telemetry file for 2 flights"):
        open_sources([video, write_photos(tmp_path / "p")], telemetry=other / "log.srt")


def test_unreadable_telemetry_is_an_error_only_when_asked_for(tmp_path: Path) -> None:
    video = write_video(tmp_path / "DJI_0001.mp4")
    broken = tmp_path / "DJI_0001.SRT"
    broken.write_text("1\n00:00:00,000 --> 00:00:01,000\n[latitude: x] [longitude: y]\n")
    with pytest.raises(InputError, match="DJI_0001"):
        open_sources([video], telemetry=broken)
    (source,) = open_sources([video])
    assert len(source.telemetry) == 0


def test_the_fingerprint_follows_the_input(tmp_path: Path) -> None:
    video = write_video(tmp_path / "a.mp4")
    first = open_sources([video])[0].fingerprint
    assert open_sources([video])[0].fingerprint == first
    assert open_sources([video], camera="aov=60")[0].fingerprint == first
    (tmp_path / "a.SRT").write_text(SRT)
    assert open_sources([video])[0].fingerprint == first
    write_video(tmp_path / "a.mp4", seed=9)
    assert open_sources([video])[0].fingerprint != first


def test_another_flight_of_a_known_name_gets_its_own(tmp_path: Path) -> None:
    """Drones begin to count anew on each card: Friday's DJI_0001 is not Monday's."""
    video = write_video(tmp_path / "DJI_0001.mp4")
    monday = open_sources([video])[0]
    again = open_sources([video], known={"DJI_0001": monday.fingerprint})[0]
    assert again.name == "DJI_0001"
    friday = open_sources([video], known={"DJI_0001": "another", "DJI_0001-2": "and another"})[0]
    assert friday.name == "DJI_0001-3"
    once_more = open_sources(
        [video], known={"DJI_0001": "another", "DJI_0001-2": monday.fingerprint}
    )[0]
    assert once_more.name == "DJI_0001-2"


def test_the_camera_fits_the_frames_as_delivered(tmp_path: Path) -> None:
    lying = open_sources([write_video(tmp_path / "a.mp4")])[0].camera
    standing = open_sources([write_video(tmp_path / "b.mp4", rotation=90)])[0].camera
    assert (standing.camera.width_px, standing.camera.height_px) == (64, 96)
    assert standing.camera.fx_px == pytest.approx(lying.camera.fx_px)
    assert "GUESS" in lying.origin and lying.focal_sigma >= 0.1
    given = open_sources([tmp_path / "a.mp4"], camera="aov=60")[0].camera
    assert given.camera.angle_of_view_deg[0] == pytest.approx(60)


def test_the_calibration_beside_a_flight_is_used_unless_another_is_named(tmp_path: Path) -> None:
    video = write_video(tmp_path / "a.mp4")
    (guessed,) = open_sources([video])
    write_camera(tmp_path / "camera.xml", Camera.from_angle_of_view(96, 64, 47.0))
    (own,) = open_sources([video])
    (named,) = open_sources([video], camera="aov=60")
    assert "camera.xml" in own.camera.origin and "camera.xml" not in guessed.camera.origin
    assert named.camera.camera.fx_px < own.camera.camera.fx_px


def test_what_is_missing_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no input"):
        open_sources([])
    with pytest.raises(
        InputError, match=r"no such file or folder: .*nowhere; a video, a folder of photos.*rtsp://"
    ):
        open_sources([tmp_path / "nowhere"])
    os.mkfifo(tmp_path / "waits.mp4")
    for path in ("", tmp_path / "waits.mp4"):  # of a shell's variable that is not set, of a pipe
        with pytest.raises(InputError, match="no such file or folder"):
            open_sources([path])
    with pytest.raises(
        InputError, match=r"^foo://x: no such file, and no address that is known; give rtsp://"
    ):
        open_sources(["foo://me:secret@x"])
    with pytest.raises(InputError, match="serial:/dev/x: a receiver gives telemetry"):
        open_sources(["serial:/dev/x"])
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="holds no pictures or videos"):
        open_sources([tmp_path / "empty"])
    (tmp_path / "empty" / "100MEDIA").mkdir()
    with pytest.raises(InputError, match="100MEDIA"):
        open_sources([tmp_path / "empty"])


def test_a_site_folder_is_no_flight(tmp_path: Path) -> None:
    """It holds mosaic.tif and preview.png, which are pictures by their endings."""
    site = write_photos(tmp_path / "site", 1)
    (site / "site.db").touch()
    with pytest.raises(
        InputError, match=r"a site folder \(it has site\.db\), no flight; give .*site"
    ):
        open_sources([site])


@pytest.mark.parametrize("name", ["log.srt", "log.csv", "log.mp4"])
def test_telemetry_given_as_input_is_refused_with_where_it_belongs(
    tmp_path: Path, name: str
) -> None:
    (tmp_path / name).write_text(SRT)
    with pytest.raises(InputError, match=r"a telemetry file, no video or photo; .* telemetry"):
        open_sources([tmp_path / name])


def test_a_playlist_reads_no_other_file(tmp_path: Path) -> None:
    write_video(tmp_path / "secret.ts")
    playlist = tmp_path / "list.mp4"
    playlist.write_text(
        "#EXTM3U\n#EXT-X-TARGETDURATION:2\n#EXTINF:2,\nhttp://127.0.0.1:9/x.ts\n#EXT-X-ENDLIST\n"
    )
    with pytest.raises(InputError, match=r"list\.mp4"):
        open_sources([playlist])


def test_real_phantom_photos() -> None:
    (source,) = open_sources([real_data("flights/brighton_beach")])
    assert isinstance(source, PhotoSource)
    assert source.frame_count == len(source.telemetry) == 18
    assert np.abs(source.telemetry["height_above_takeoff_m"] - 40).max() < 0.5
    assert np.abs(source.telemetry["camera_pitch_deg"] + 90).max() < 0.2
    assert "Phantom 3" in source.camera.origin
    assert source.telemetry["latitude_deg"][0] == pytest.approx(46.8426071, abs=1e-7)
    frames = list(source.frames(lambda index, time_ns: index in (0, 17)))
    assert [frame.name for frame in frames] == ["DJI_0018.JPG", "DJI_0035.JPG"]
    assert all(
        isinstance(frame, Frame) and frame.image.shape == (2250, 4000, 3) for frame in frames
    )


def test_real_canon_photos_are_timed_evenly() -> None:
    (source,) = open_sources([real_data("flights/caliterra")])
    assert source.frame_count == len(source.telemetry) == 75
    steps_s = np.diff(source.telemetry.time_ns) / 1e9
    assert steps_s.min() >= 2 and np.median(steps_s) == 2
    assert source.camera.camera.fx_px == pytest.approx(1452, abs=2)


def test_a_real_video() -> None:
    (source,) = open_sources([real_data("flights/pond_video")])
    counted = sum(1 for _ in source.frames(lambda index, time_ns: index % 100 == 0))
    assert source.frame_count == 558 and counted == 6 and source.notices() == ()


def test_a_table_beside_the_video_that_nobody_can_read_is_named(tmp_path: Path) -> None:
    """A log whose columns are unknown was passed over without a word; one beside it that is read is used."""
    write_video(tmp_path / "DJI_0001.mp4")
    (tmp_path / "DJI_0001.csv").write_text("when,here,there\n1,2,3\n")
    (source,) = open_sources([tmp_path / "DJI_0001.mp4"])
    found = {notice.code: notice.text for notice in source.notices()}
    assert (
        "DJI_0001.csv" in found["unknown_telemetry"]
        and "no known telemetry format" in found["unknown_telemetry"]
    )


def test_an_empty_telemetry_file_beside_the_video_is_named(tmp_path: Path) -> None:
    write_video(tmp_path / "DJI_0001.mp4")
    (tmp_path / "DJI_0001.SRT").touch()
    (tmp_path / "other.srt").touch()
    (source,) = open_sources([tmp_path / "DJI_0001.mp4"])
    found = {notice.code: notice.text for notice in source.notices()}
    assert "DJI_0001.SRT" in found["empty_telemetry"] and "0 bytes" in found["empty_telemetry"]
    assert not source.telemetry.has_fixes


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read every file")
def test_telemetry_beside_the_video_that_may_not_be_read_is_named(tmp_path: Path) -> None:
    write_video(tmp_path / "DJI_0001.mp4")
    (tmp_path / "DJI_0001.SRT").write_text(SRT)
    (tmp_path / "DJI_0001.SRT").chmod(0)
    (source,) = open_sources([tmp_path / "DJI_0001.mp4"])
    found = {notice.code: notice.text for notice in source.notices()}
    assert "cannot be read and is not used: Permission denied" in found["unusable_telemetry"]


def test_djis_telemetry_track_is_named_where_nothing_else_has_positions(tmp_path: Path) -> None:
    """A track of sound is renamed in the file to what DJI's metadata track is called."""
    video = write_video(tmp_path / "DJI_0001.mp4", with_sound=True)
    assert "unread_track" not in {each.code for each in open_sources([video])[0].notices()}
    data = video.read_bytes().replace(b"mp4a", b"djmd").replace(b"soun", b"meta")
    video.write_bytes(data.replace(b"SoundHandler\0", b"DJI meta\0\0\0\0\0"))
    (source,) = open_sources([video])
    (words,) = [each.text for each in source.notices() if each.code == "unread_track"]
    assert "(djmd), which is not read" in words and "(.SRT)" in words
    (tmp_path / "DJI_0001.SRT").write_text(SRT)
    assert "unread_track" not in {each.code for each in open_sources([video])[0].notices()}


def test_logs_beside_the_video_that_are_not_used_are_named(tmp_path: Path) -> None:
    """Two logs of which none has the video's name, one more beside the one used, and one of a kind that is not read."""
    write_video(tmp_path / "DJI_0001.mp4")
    rows = "".join(f"41.89000{row},12.6,2026-04-02 12:44:0{row}\n" for row in range(5))
    for name in ("a.csv", "b.csv"):
        (tmp_path / name).write_text(f"latitude,longitude,datetime(utc)\n{rows}")
    (tmp_path / "DJI_0001.fit").write_bytes(b"\x0e\x10\xd9\x07")

    def named() -> dict[str, str]:
        (source,) = open_sources([tmp_path / "DJI_0001.mp4"])
        return {each.code: each.text for each in source.notices()}

    first = named()
    assert "a.csv, b.csv; give one as --telemetry" in first["unused_telemetry"]
    assert "DJI_0001.fit" in first["unknown_telemetry"]
    (tmp_path / "a.csv").rename(tmp_path / "DJI_0001.csv")
    assert "(DJI_0001.csv is): b.csv" in named()["unused_telemetry"]
