"""Metadata inside recorded videos; videos and folders of photos that are read while they are written."""

import shutil
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from live_sender import EPOCH_NS, RATE, Sender, number_of, packet_of, picture
from PIL import Image
from PIL.ExifTags import GPS, IFD, Base

from sorvolo.capture.flight_telemetry import FlightTelemetry
from sorvolo.capture.live.growing import GrowingFile
from sorvolo.capture.live.growing_folder import GrowingFolder
from sorvolo.capture.live.klv import encode
from sorvolo.capture.live.reconnect import LiveSettings, Outages
from sorvolo.capture.live.stream import LiveStream
from sorvolo.capture.source import open_sources
from sorvolo.errors import InputError
from sorvolo.missions.flight.settings import MapSettings
from sorvolo.missions.flight.setup import prepare
from sorvolo.survey.flight import Frame, LostFrame

S = 10**9
ALL = LiveSettings(keeps_all=True, silent_s=0.5, give_up_s=1.5, first_s=20.0)


def every_frame(_index: int, _time_ns: int) -> bool:
    return True


def write_ts(path: Path, count: int = 30, **kwargs: Any) -> Path:
    sender = Sender(str(path), count=count, speed=1000.0, **kwargs)
    sender.run()
    assert sender.error is None
    return path


def test_a_recorded_video_with_metadata_needs_no_other_telemetry(tmp_path: Path) -> None:
    (source,) = open_sources([write_ts(tmp_path / "film.ts", klv=True)])
    telemetry = source.telemetry
    assert telemetry.format == "klv" and len(telemetry) == 30
    assert telemetry.video_time_ns[0] == 0 and telemetry.video_time_ns[-1] == pytest.approx(
        29 * S // RATE, abs=S // 50
    )
    assert telemetry.time_ns[0] == EPOCH_NS and telemetry["camera_pitch_deg"][3] == pytest.approx(
        -90, abs=1e-3
    )
    assert source.camera.camera.angle_of_view_deg[0] == pytest.approx(62, abs=0.01)
    assert source.ground_elevation_m == pytest.approx(100, abs=0.2)
    setup = prepare(source, MapSettings(), None, telemetry_named=False)
    assert setup.track is not None and setup.track.attitude == "gimbal"
    assert setup.track.up_m[0] == pytest.approx(60, abs=0.4) and np.isfinite(
        setup.track.altitude_offset_sigma_m
    )
    assert setup.clock is not None and setup.clock.first_frame_utc_ns == EPOCH_NS


def as_synchronous(data: bytes) -> bytes:
    """The transport stream with its metadata declared as synchronous: stream type 0x15 in every program map."""
    changed = bytearray(data)
    for at in range(0, len(changed), 188):
        head = changed[at : at + 8]
        if head[1] & 0x40 and head[3] >> 4 == 1 and head[4] == 0 and head[5] == 2:
            section = changed[at + 5 : at + 8 + ((head[6] & 15) << 8 | head[7])]
            entry = 12 + ((section[10] & 15) << 8 | section[11])
            while entry < len(section) - 4:
                section[entry] = 0x15 if section[entry] == 0x06 else section[entry]
                entry += 5 + ((section[entry + 3] & 15) << 8 | section[entry + 4])
            section[-4:] = _crc32_mpeg(section[:-4]).to_bytes(4, "big")
            changed[at + 5 : at + 5 + len(section)] = section
    return bytes(changed)


def _crc32_mpeg(data: bytes) -> int:
    crc = 0xFFFFFFFF
    for each in data:
        crc ^= each << 24
        for _ in range(8):
            crc = (crc << 1 ^ (0x04C11DB7 if crc & 0x80000000 else 0)) & 0xFFFFFFFF
    return crc


def test_synchronous_metadata(tmp_path: Path) -> None:
    """ST 1402: an access unit header before each set, in a stream of type 0x15."""

    def klv_of(index: int) -> bytes:
        packet = packet_of(index)
        return b"\0" + bytes([index]) + b"\xdf" + len(packet).to_bytes(2, "big") + packet

    plain = write_ts(tmp_path / "plain.ts", klv=True, klv_of=klv_of)
    (tmp_path / "film.ts").write_bytes(as_synchronous(plain.read_bytes()))
    assert (tmp_path / "film.ts").read_bytes() != plain.read_bytes()
    for film in (plain, tmp_path / "film.ts"):
        (source,) = open_sources([film])
        assert source.telemetry.format == "klv" and len(source.telemetry) == 30
        assert source.telemetry.time_ns[0] == EPOCH_NS


def test_metadata_with_damage_and_without_time(tmp_path: Path) -> None:
    def klv_of(index: int) -> bytes:
        packet = bytearray(packet_of(index))
        if index % 5 == 1:
            packet[-1] ^= 1
        return encode(0, {"sensor_latitude_deg": 1.0}) if index % 5 == 2 else bytes(packet)

    (source,) = open_sources([write_ts(tmp_path / "film.ts", klv=True, klv_of=klv_of)])
    counts = {notice.code: notice.count for notice in source.telemetry.notices}
    assert len(source.telemetry) == 18 and counts["bad_checksum"] == 6 and counts["no_time"] == 6


def test_a_transport_stream_without_metadata_is_a_video_as_ever(tmp_path: Path) -> None:
    (source,) = open_sources([write_ts(tmp_path / "film.ts")])
    assert not len(source.telemetry) and source.ground_elevation_m != source.ground_elevation_m
    assert len(list(source.frames(every_frame))) == 30


@pytest.mark.parametrize(
    ("name", "container", "options"),
    [
        ("film.ts", "mpegts", {}),
        ("film.mp4", "mp4", {"movflags": "frag_keyframe+empty_moov+default_base_moof"}),
    ],
)
def test_a_video_is_read_while_it_is_written(
    tmp_path: Path, name: str, container: str, options: dict[str, str]
) -> None:
    has_metadata = container == "mpegts"
    whole = Sender(
        str(tmp_path / f"whole_{name}"),
        count=100,
        speed=1000.0,
        container=container,
        options=options,
        klv=has_metadata,
    )
    whole.run()
    assert whole.error is None
    data = (tmp_path / f"whole_{name}").read_bytes()
    growing = tmp_path / name
    growing.write_bytes(data[: len(data) // 2])

    def grow() -> None:
        with growing.open("ab") as file:
            for at in range(len(data) // 2, len(data), 3000):
                time.sleep(0.03)
                file.write(data[at : at + 3000])
                file.flush()

    threading.Thread(target=grow, daemon=True).start()
    (source,) = open_sources([f"follow:{growing}"], live=ALL)
    assert isinstance(source, LiveStream) and source.name == "film"
    began_s, numbers, times_ns = time.monotonic(), [], []
    for frame in source.frames(every_frame):
        assert isinstance(frame, Frame)
        numbers.append(number_of(frame.image))
        times_ns.append(frame.time_ns)
        time.sleep(0.002)
    # nothing is skipped, however far the reading is ahead or behind, and the end is seen
    assert numbers == [index % 38 for index in range(100)] and source.skipped == 0
    steps_s = np.diff(times_ns) / S
    assert np.allclose(steps_s, 1 / RATE, atol=2e-3) and time.monotonic() - began_s < 30
    if has_metadata:
        assert times_ns[0] == EPOCH_NS and len(source.telemetry) == 100


def test_of_a_file_that_waits_itself_few_decoded_frames_do(tmp_path: Path) -> None:
    """A mission that is slower than the drone would hold 256 MB of them through the flight."""
    film = write_ts(tmp_path / "film.ts", count=40)
    (source,) = open_sources([f"follow:{film}"], live=replace(ALL, most_bytes_of_file=400_000))
    assert isinstance(source, LiveStream)
    frames = source.frames(every_frame)
    first = next(frames)
    assert isinstance(first, Frame)
    frame_bytes = first.image.nbytes // 2  # as it is decoded
    time.sleep(0.5)
    assert frame_bytes <= source._queue._held_bytes <= 400_000 < 39 * frame_bytes
    assert [each.index for each in frames] == list(range(1, 40)) and source.skipped == 0


def test_the_newest_telemetry_places_frames_as_all_of_it_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    film = write_ts(tmp_path / "film.ts", count=60, klv=True)

    def flown() -> tuple[FlightTelemetry, list[Any]]:
        (source,) = open_sources([f"follow:{film}"], live=ALL)
        setup = prepare(source, MapSettings(), None, telemetry_named=False)
        priors = [
            setup.prior(each, first=False)
            for each in source.frames(every_frame)
            if isinstance(each, Frame)
        ]
        assert setup.telemetry is not None and len(source.telemetry) == 60
        return setup.telemetry, priors

    telemetry, wanted = flown()
    assert len(telemetry.samples) == 60
    monkeypatch.setattr("sorvolo.capture.live.stream._NEWEST_SAMPLES", 12)
    telemetry, found = flown()
    assert len(telemetry.samples) == 12
    for each, other in zip(found, wanted, strict=True):
        assert each.position_m == pytest.approx(other.position_m, abs=0.02)
        assert each.rotation == pytest.approx(other.rotation, abs=1e-3)
    seconds = [
        index / RATE for index in range(60)
    ]  # long past: a map asks anew once it knows the clocks' offset
    for index, each in enumerate(telemetry.priors(seconds, 0.0, 0.0)):
        assert each.position_m == pytest.approx(wanted[index].position_m, abs=0.02)
        assert telemetry.prior(seconds[index], 0.0).position_m == pytest.approx(
            each.position_m, abs=0.02
        )


def test_a_film_that_is_no_film_is_refused(tmp_path: Path) -> None:
    plain = tmp_path / "plain.mp4"
    plain.write_bytes(b"\0\0\0\x18ftypisom" + bytes(2000))
    with pytest.raises(InputError, match=r"plain.mp4: no picture within 0 s"):
        open_sources([f"follow:{plain}"], live=LiveSettings(first_s=0.4, give_up_s=0.2))
    with pytest.raises(InputError, match="no such file or folder"):
        open_sources([f"follow:{tmp_path}/none"])


def write_photo(path: Path, index: int, size: tuple[int, int] = (160, 96)) -> None:
    exif = Image.Exif()
    exif[Base.Make], exif[Base.Model] = "DJI", "FC300X"
    exif[Base.DateTime] = f"2021:06:01 10:00:{index:02d}"
    place = exif.get_ifd(IFD.GPSInfo)
    place[GPS.GPSLatitudeRef], place[GPS.GPSLatitude] = "N", (46.0, 30.0, 0.1 * index)
    reference = "" if index == 2 else "E"
    place[GPS.GPSLongitudeRef], place[GPS.GPSLongitude] = reference, (11.0, 18.0, 0.0)
    place[GPS.GPSDateStamp], place[GPS.GPSTimeStamp] = "2021:06:01", (10.0, 0.0, float(index))
    temporary = path.with_suffix(".tmp")
    Image.fromarray(picture(index, size)).save(temporary, format="JPEG", exif=exif, quality=95)
    data = temporary.read_bytes()
    temporary.unlink()
    with path.open("wb") as file:  # as a copy over a slow link: in two parts
        file.write(data[: len(data) // 2])
        file.flush()
        time.sleep(0.1)
        file.write(data[len(data) // 2 :])


def test_photos_are_taken_as_they_are_copied_in(tmp_path: Path) -> None:
    folder = tmp_path / "DCIM"
    folder.mkdir()

    def copy() -> None:
        for index in range(5):
            write_photo(
                folder / f"DJI_{index:04d}.JPG", index, (96, 160) if index == 3 else (160, 96)
            )
        (folder / "DJI_0005.JPG").write_bytes(b"\xff\xd8\xff no picture\xff\xd9")
        shutil.copy(folder / "DJI_0004.JPG", folder / ".hidden.jpg")

    copier = threading.Thread(target=copy, daemon=True)
    copier.start()
    (source,) = open_sources([f"follow:{folder}"], live=ALL)
    assert isinstance(source, GrowingFolder) and source.kind == "photos" and source.name == "DCIM"
    known_when_seen, frames = [], []
    setup = prepare(source, MapSettings(), None, telemetry_named=False)
    for each in source.frames(every_frame):
        frames.append(each)
        if isinstance(each, Frame):
            prior = setup.prior(each, first=False)
            assert prior.knows_place
            assert prior.position_m[1] == pytest.approx(
                0.1 / 3600 * 111_150 * int(each.name[4:8]), abs=0.2
            )
        known_when_seen.append(source.telemetry_version)
    copier.join()
    assert [frame.name for frame in frames] == [f"DJI_{index:04d}.JPG" for index in range(6)]
    assert [isinstance(frame, LostFrame) for frame in frames] == [
        False,
        False,
        False,
        True,
        False,
        True,
    ]
    assert known_when_seen == [1, 2, 3, 4, 5, 5]  # a photo's fix is known when the photo is
    assert [(frame.time_ns - source.start_ns) / S for frame in frames[:5]] == [0, 1, 2, 3, 4]
    assert source.telemetry["latitude_deg"][2] == pytest.approx(46.5 + 0.2 / 3600)
    found = {notice.code: notice.count for notice in source.notices()}
    assert found == {"corrupt_photo": 1, "sign_assumed": 1}
    assert "Phantom 3" in source.camera.origin


def test_a_folder_into_which_nothing_comes(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no photo came within 0 s"):
        open_sources([f"follow:{tmp_path}"], live=LiveSettings(first_s=0.4))
    with pytest.raises(InputError, match="photos carry their own fixes"):
        open_sources([f"follow:{tmp_path}"], telemetry="udp://:10110")


@pytest.mark.parametrize(
    ("keeps_all", "tables", "packet"),
    [
        (True, (0, 50_000), 0),
        (False, (0, 9_000, 21_276, 50_000), 21_276),
        (False, (0, 9_000, 21_277), 9_000),
        (False, (0,), 0),
    ],
)
def test_who_wants_the_newest_frames_begins_near_the_end(
    tmp_path: Path, keeps_all: bool, tables: tuple[int, ...], packet: int
) -> None:
    """20 MB of a transport stream: a map reads all of it, a watch its last 16 MB, from where it is described."""
    path = tmp_path / "long.ts"
    path.write_bytes(
        b"".join(
            (b"\x47\x40\x00" if number in tables else b"\x47\x01\x00") + number.to_bytes(185, "big")
            for number in range(106_383)
        )
    )
    file = GrowingFile(
        path, LiveSettings(keeps_all=keeps_all), Outages("long.ts"), threading.Event()
    )
    data = file.read(188)
    file.close()
    assert data[0] == 0x47 and int.from_bytes(data[3:], "big") == packet
    assert file.is_whole == (packet == 0)


def test_a_file_whose_end_is_stated_ends_at_once(tmp_path: Path) -> None:
    """Without that its reader waits for more."""
    path = tmp_path / "over.ts"
    path.write_bytes(b"\x47" * 188)
    (tmp_path / "over.ts.ended").touch()
    file = GrowingFile(path, LiveSettings(give_up_s=60), Outages("over.ts"), threading.Event())
    began_s = time.monotonic()
    assert (len(file.read(1000)), file.read(1000)) == (188, b"")
    assert time.monotonic() - began_s < 30  # else it waits for 60 s
    file.close()
