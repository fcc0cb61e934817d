"""Telemetry on disk: recognised by content, found beside a video; every unusable one has its error."""

import os
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sorvolo.capture.telemetry import TELEMETRY_READERS, find_telemetry_beside, read_telemetry
from sorvolo.errors import InputError

NMEA = b"$GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,*47\r\n"
SRT = b"1\n00:00:00,000 --> 00:00:01,000\nGPS(-58.4563,-34.7386,19) BAROMETER:20.1\n\n"
GPX = (
    b'<gpx version="1.1"><trk><trkseg><trkpt lat="48.1" lon="11.5">'
    b"<time>2016-05-04T10:00:00Z</time></trkpt>"
    b"</trkseg></trk></gpx>"
)
UMCD = b"offsetTime,Longitude,Latitude\n0.0,11.5,48.1\n0.1,11.5,48.1\n"
SAMPLES = {"nmea": NMEA, "dji_srt": SRT, "gpx": GPX, "table": UMCD}
BEGINNINGS = {
    "ulog": b"ULog\x01\x12\x35\x01" + bytes(8),
    "mcap": b"\x89MCAP0\r\n\1",
    "dataflash": b"\xa3\x95\x80\x80\x59FMT\0",
    "tlog": 3 * (b"\0\6\0" + bytes(5) + b"\xfe\1\0\1\1\0" + bytes(3)),
}


def write(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("name", SAMPLES)
@pytest.mark.parametrize("suffix", [".txt", ".csv", ".srt", ""])
def test_the_content_decides_not_the_suffix(tmp_path, name, suffix):
    telemetry = read_telemetry(write(tmp_path / f"flight{suffix}", SAMPLES[name]))
    assert telemetry.format == name
    assert telemetry.has_fixes


def test_every_reader_is_listed_by_its_own_name():
    assert set(TELEMETRY_READERS) == {*SAMPLES, *BEGINNINGS}
    for name, data in (SAMPLES | BEGINNINGS).items():
        assert [
            other for other, reader in TELEMETRY_READERS.items() if reader.recognises(data)
        ] == [name]


@pytest.mark.parametrize(
    "data, words",
    [
        (b"", "empty file"),
        (bytes(range(256)) * 10, "binary"),
        (
            b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR",
            "a binary file, not a log in text; read are DJI's and Autel's subtitles",
        ),
        (
            b"\0\0\0\x14ftypmp41\x13\x10\x18mp41\0",
            r"a video, no log \(telemetry inside a GoPro video",
        ),
        (
            b"dear diary, today I flew\nand back\n",
            "no known telemetry format, it begins with 'dear diary, today I flew';",
        ),
        (b"a,b,c\n1,2,3\n", "no known telemetry format"),
        (b"offsetTime,Longitude,Latitude\n", "no usable table"),
        (b"offsetTime,Longitude,Latitude\n0,0,0\n", "0/0"),
        (NMEA.replace(b"545", b"546"), "bad checksum"),
    ],
)
def test_unusable_files_state_what_was_found(tmp_path, data, words):
    path = write(tmp_path / "flight.csv", data)
    with pytest.raises(InputError, match=words) as caught:
        read_telemetry(path)
    assert str(path) in str(caught.value)


def test_what_is_no_file(tmp_path):
    with pytest.raises(InputError, match="a folder"):
        read_telemetry(tmp_path)
    with pytest.raises(InputError, match="no such"):
        read_telemetry(tmp_path / "missing.srt")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    with pytest.raises(InputError, match="cannot be read"):
        read_telemetry(tmp_path / "loop")


def test_a_huge_file_is_refused_before_it_is_read(tmp_path):
    with (tmp_path / "video.srt").open("wb") as stream:
        os.truncate(stream.fileno(), 600_000_000)  # sparse: takes no room on the disk
    with pytest.raises(InputError, match="600 MB is too large"):
        read_telemetry(tmp_path / "video.srt")


def test_the_videos_own_name_wins_in_any_case(tmp_path):
    video = write(tmp_path / "DJI_0001.MP4", b"")
    write(tmp_path / "telemetry.csv", UMCD)
    assert find_telemetry_beside(video) == tmp_path / "telemetry.csv"
    named = write(tmp_path / "dji_0001_telemetry.csv", UMCD)
    assert find_telemetry_beside(video) == named
    own = write(tmp_path / "dji_0001.Srt", SRT)
    assert find_telemetry_beside(video) == own


def test_only_what_a_reader_recognises_counts(tmp_path):
    video = write(tmp_path / "a.mp4", b"")
    write(tmp_path / "a.srt", b"1\n00:00:01,000 --> 00:00:02,000\nHello there.\n")
    assert find_telemetry_beside(video) is None
    log = write(tmp_path / "a.log", NMEA)
    assert find_telemetry_beside(video) == log


def test_an_unclear_choice_is_none(tmp_path):
    video = write(tmp_path / "a.mp4", b"")
    lone = write(tmp_path / "flight.gpx", GPX)
    write(tmp_path / "notes.txt", b"windy")
    assert find_telemetry_beside(video) == lone
    write(tmp_path / "other.gpx", GPX)
    assert find_telemetry_beside(video) is None
    (tmp_path / "other.gpx").unlink()
    write(tmp_path / "b.mp4", b"")
    assert find_telemetry_beside(video) is None


def test_a_folder_of_photos(tmp_path):
    folder = tmp_path / "photos"
    folder.mkdir()
    write(folder / "a.jpg", b"")
    assert find_telemetry_beside(folder) is None
    track = write(folder / "track.gpx", GPX)
    assert find_telemetry_beside(folder) == track
    assert find_telemetry_beside(tmp_path / "nowhere" / "a.mp4") is None


@settings(max_examples=100, deadline=None)
@given(
    st.one_of(
        st.binary(max_size=200),
        st.lists(
            st.sampled_from(
                [
                    b"$GPGGA,",
                    b"<gpx",
                    b">",
                    b"latitude",
                    b",",
                    b"longitude",
                    b"\n",
                    b"GPS(",
                    b"1",
                    b"-->",
                    b"00:00:00,000",
                    b")",
                    b"*",
                    b"4F",
                    b"\xff\xfe",
                    b"\0",
                    b'"',
                    b"<!DOCTYPE",
                    b"<trkpt",
                ]
            ),
            max_size=30,
        ).map(b"".join),
    )
)
def test_random_bytes_raise_only_input_errors(data):
    for reader in TELEMETRY_READERS.values():
        assert reader.recognises(data) in (True, False)
        try:
            reader.read(data, "noise")
        except InputError:
            pass


def test_djis_own_flight_record_is_named(tmp_path):
    path = write(tmp_path / "DJIFlightRecord_2026-05-01_[12-44-00].txt", bytes(range(256)))
    with pytest.raises(InputError, match=r"DJI's own flight record, .* export it as CSV"):
        read_telemetry(path)
