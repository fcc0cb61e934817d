"""Small files that ask for much memory or time, and files that once ended in a crash: each tried."""

import io
import json
import re
import struct
import threading
import time
import tracemalloc
import zipfile
import zlib
from collections import Counter
from fractions import Fraction
from itertools import pairwise
from pathlib import Path
from xml.sax.saxutils import escape

import av
import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image, PngImagePlugin

from mutations import mutated
from sorvolo.capture import decoding
from sorvolo.capture.areas import read_area
from sorvolo.capture.calibration import read_camera
from sorvolo.capture.control_points import read_control_points
from sorvolo.capture.decoding import decode_photo
from sorvolo.capture.live.addresses import is_live_address, live_address
from sorvolo.capture.live.links import SentenceBuffer
from sorvolo.capture.live.reader import StreamFacts
from sorvolo.capture.live.reconnect import LiveSettings
from sorvolo.capture.live.stream import LiveStream
from sorvolo.capture.photo_metadata import read_photo_metadata
from sorvolo.capture.photos import read_album, read_picture
from sorvolo.capture.source import open_sources
from sorvolo.capture.telemetry import read_telemetry
from sorvolo.errors import InputError
from sorvolo.lab.datasets.parsed import shown_size_px


def png_of(width_px: int, height_px: int) -> bytes:
    """A PNG of one colour: some hundred kilobytes for hundreds of megapixels."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    deflate = zlib.compressobj(9)
    row = bytes(1 + (width_px + 7) // 8)
    rows = b"".join(deflate.compress(row) for _ in range(height_px)) + deflate.flush()
    header = struct.pack(">IIBBBBB", width_px, height_px, 1, 0, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")
    )


def test_a_small_png_of_many_pixels_is_refused_before_it_is_decoded(tmp_path: Path) -> None:
    bomb = tmp_path / "bomb.png"
    bomb.write_bytes(png_of(17_000, 17_000))
    assert bomb.stat().st_size < 1_000_000
    with pytest.raises(InputError, match=r"17000x17000 pixels; at most 64 megapixels"):
        read_album([bomb])
    with pytest.raises(InputError, match="64 megapixels"):
        decode_photo(bomb.read_bytes(), bomb.name)


def test_the_size_of_a_png_is_read_without_its_pixels(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Pillow decodes a PNG that has no EXIF before its pixels to look for it behind them: 1.2 GB for a small file."""

    def decoded(_: PngImagePlugin.PngImageFile) -> None:
        pytest.fail("the pixels were decoded")

    monkeypatch.setattr(PngImagePlugin.PngImageFile, "load", decoded)
    (tmp_path / "bomb.png").write_bytes(png_of(17_000, 17_000))
    with pytest.raises(InputError, match="64 megapixels"):
        read_photo_metadata(tmp_path / "bomb.png")
    assert shown_size_px(tmp_path / "bomb.png") == (17_000, 17_000, 1)


def test_the_largest_photos_are_decoded_at_half_their_size(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(decoding, "LARGEST_FRAME_PX", 200_000)
    small = np.random.default_rng(3).integers(0, 255, (5, 6, 3), dtype=np.uint8)
    large = cv2.resize(small, (501, 400), interpolation=cv2.INTER_LINEAR)
    path = tmp_path / "a.jpg"
    path.write_bytes(cv2.imencode(".jpg", large)[1].tobytes())
    (source,) = open_sources([path])
    (frame,) = source.frames(lambda index, time_ns: True)
    assert frame.image.shape == (200, 251, 3)
    halved = cv2.resize(large[:, :, ::-1], (251, 200), interpolation=cv2.INTER_AREA)
    assert np.abs(frame.image.astype(int) - halved).mean() < 3
    assert (source.camera.camera.width_px, source.camera.camera.height_px) == (251, 200)
    assert {notice.code for notice in source.notices()} >= {"reduced_photo"}
    # labels on pictures count the pixels of the file
    assert read_picture(path).shape == (400, 501, 3)


def test_a_subtitle_of_many_megabytes_costs_no_multiple_of_itself(tmp_path: Path) -> None:
    cue = "1\n00:00:00,000 --> 00:00:01,000\n[latitude: 46.1] [longitude: 11.2] "
    path = tmp_path / "bomb.srt"
    path.write_text(cue + "[rel_alt: 1.5] " * 2_000_000)
    tracemalloc.start()
    began_s = time.process_time()
    telemetry = read_telemetry(path)
    peak_bytes = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(telemetry) == 1 and telemetry["latitude_deg"][0] == 46.1
    assert peak_bytes < 3 * path.stat().st_size and time.process_time() - began_s < 10


def test_an_area_of_a_hundred_thousand_points_is_read_in_seconds(tmp_path: Path) -> None:
    angles = np.linspace(0, 2 * np.pi, 100_000, endpoint=False)
    ring = np.column_stack([12 + 0.01 * np.cos(angles), 45 + 0.007 * np.sin(angles)])
    path = tmp_path / "circle.geojson"
    began_s = time.process_time()
    path.write_text(json.dumps({"type": "Polygon", "coordinates": [ring.tolist()]}))
    area = read_area(path)
    assert area.contains(np.array([[12.0, 45.0], [12.02, 45.0]])).tolist() == [True, False]
    assert area.area_m2 == pytest.approx(np.pi * 788 * 778, rel=0.01)
    path.write_text(json.dumps({"type": "LineString", "coordinates": ring.tolist()}))
    corridor = read_area(path)
    assert corridor.contains(np.array([[12.0, 45.0], [12.01, 45.0]])).tolist() == [False, True]
    assert time.process_time() - began_s < 20


def test_an_area_of_too_many_polygons_is_refused(tmp_path: Path) -> None:
    square = [[12, 45], [12.1, 45], [12.1, 45.1]]
    path = tmp_path / "many.geojson"
    path.write_text(json.dumps({"type": "MultiPolygon", "coordinates": [[square]] * 10_001}))
    with pytest.raises(InputError, match="10001 polygons"):
        read_area(path)


def test_a_kmz_with_a_negative_offset_is_refused(tmp_path: Path) -> None:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("doc.kml", "<kml/>")
    data = bytearray(buffer.getvalue())
    directory = data.index(b"PK\x01\x02")
    end = data.index(b"PK\x05\x06")
    for offset in (0xFFFF_FFF0, 0x7FFF_FFFF, 1):
        struct.pack_into("<I", data, directory + 42, offset)
        path = tmp_path / "a.kmz"
        path.write_bytes(data)
        with pytest.raises(InputError, match="broken KMZ"):
            read_area(path)
    struct.pack_into("<I", data, end + 16, directory + 100)  # the directory lies before the file
    path.write_bytes(data)
    with pytest.raises(InputError, match="broken KMZ"):
        read_area(path)


@pytest.mark.parametrize("digits", [400, 5000])
@pytest.mark.parametrize(
    "text",
    [
        "fx: {0}\nfy: 1000\ncx: 500\ncy: 400\nwidth: 1000\nheight: 800",
        "camera_matrix: [{0}, 0, 500, 0, 1000, 400, 0, 0, 1]",
        "camera_matrix:\n rows: {0}\n cols: 3\n data: [1000, 0, 500, 0, 1000, 400, 0, 0, 1]",
    ],
)
def test_a_camera_file_with_a_number_of_hundreds_of_digits_is_refused(
    tmp_path: Path, text: str, digits: int
) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text(text.format("9" * digits))
    with pytest.raises(InputError):
        read_camera(path, 1000, 800)


def test_a_camera_file_with_a_truth_value_is_read(tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text("fx: 900\nfy: 900\ncx: 500\ncy: 400\nwidth: 1000\nheight: 800\nfisheye: false")
    assert read_camera(path, 1000, 800).camera.fx_px == 900
    path.write_text(path.read_text().replace("false", "true"))
    with pytest.raises(InputError, match="fisheye"):
        read_camera(path, 1000, 800)


def test_an_area_with_a_number_of_hundreds_of_digits_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "area.geojson"
    for digits in (400, 5000):
        path.write_text(
            '{"type": "Polygon", "coordinates": [[[%s, 45], [12, 45], [12, 46]]]}' % ("9" * digits)
        )
        with pytest.raises(InputError):
            read_area(path)


def test_a_stream_whose_clock_restarts_at_once_keeps_its_first_frames() -> None:
    address = live_address("udp://:5999")
    stream = LiveStream(address, None, LiveSettings(keeps_all=True), threading.Event(), None)  # type: ignore[arg-type]
    stream.opened(StreamFacts("h264", "mpegts", 25.0, False))
    stream.restarted()
    for stamp_ns in (5_000_000_000, 5_040_000_000, 0, 40_000_000, 700_000_000, 800_000_000):
        decoded = av.VideoFrame.from_ndarray(np.zeros((48, 64, 3), np.uint8), "rgb24")
        decoded.time_base = Fraction(1, 1000)
        if stamp_ns == 0:
            stream.restarted()
        stream.frame(decoded, stamp_ns, stamp_ns / 1e9)
    assert stream.size_px == (64, 48) and stream.start_ns > 0
    stream.ended()
    frames = list(stream.frames(lambda index, time_ns: True))
    assert [frame.index for frame in frames] == [0, 1, 2, 3, 4, 5]
    assert all(frame.image.shape == (48, 64, 3) for frame in frames)
    assert all(a.time_ns < b.time_ns for a, b in pairwise(frames))


def heic_of(image: Image.Image) -> bytes:
    pillow_heif = pytest.importorskip("pillow_heif")
    buffer = io.BytesIO()
    exif = Image.Exif()
    exif[271], exif[272], exif[274] = "Apple", "iPhone", 6
    pillow_heif.from_pillow(image).save(buffer, quality=95, exif=exif.tobytes())
    return buffer.getvalue()


@pytest.fixture
def checks() -> Image.Image:
    blocks = np.random.default_rng(1).integers(0, 255, (15, 20, 3), dtype=np.uint8)
    return Image.fromarray(np.kron(blocks, np.ones((8, 8, 1), np.uint8)))


def test_heic_pictures_are_photos(tmp_path: Path, checks: Image.Image) -> None:
    path = tmp_path / "a.heic"
    path.write_bytes(heic_of(checks))
    (source,) = open_sources([path])
    assert source.kind == "photos"
    (frame,) = source.frames(lambda index, time_ns: True)
    assert frame.image.shape[2] == 3 and {frame.image.shape[0], frame.image.shape[1]} == {120, 160}
    shown = frame.image if frame.image.shape[0] == 120 else np.rot90(frame.image)
    flat = np.asarray(checks).astype(int)
    assert min(np.abs(shown.astype(int) - each).mean() for each in (flat, flat[::-1, ::-1])) < 12
    path.rename(tmp_path / "a.mp4")
    with pytest.raises(InputError, match="HEIC picture, not a video"):
        open_sources([tmp_path / "a.mp4"])


def test_heic_without_its_extra_states_what_to_install(
    tmp_path: Path, checks: Image.Image, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.heic"
    path.write_bytes(heic_of(checks))
    monkeypatch.setitem(__import__("sys").modules, "pillow_heif", None)
    with pytest.raises(InputError, match=r"pip install 'sorvolo\[heic\]'"):
        open_sources([path])
    heic = path.read_bytes()
    path.write_bytes(heic[:60])
    with pytest.raises(InputError):
        open_sources([path])


def dng_of(image: np.ndarray) -> bytes:
    """A DNG of one directory with an uncompressed 16-bit RGGB mosaic of the picture."""
    height_px, width_px = image.shape[:2]
    mosaic = np.zeros((height_px, width_px), np.uint16)
    for (y, x), channel in {(0, 0): 0, (0, 1): 1, (1, 0): 1, (1, 1): 2}.items():
        mosaic[y::2, x::2] = image[y::2, x::2, channel].astype(np.uint16) * 257
    identity = b"".join(struct.pack("<ii", value, 1) for value in (1, 0, 0, 0, 1, 0, 0, 0, 1))
    camera = b"DJI\0"
    model = b"FC3582\0\0"
    entries = {
        254: (4, 1, 0),
        256: (4, 1, width_px),
        257: (4, 1, height_px),
        258: (3, 1, 16),
        259: (3, 1, 1),
        262: (3, 1, 32803),
        271: (2, 4, camera),
        272: (2, 7, model),
        273: (4, 1, None),
        277: (3, 1, 1),
        278: (4, 1, height_px),
        279: (4, 1, mosaic.nbytes),
        33421: (3, 2, struct.pack("<HH", 2, 2)),
        33422: (1, 4, bytes([0, 1, 1, 2])),
        50706: (1, 4, bytes([1, 4, 0, 0])),
        50708: (2, 7, model),
        50721: (10, 9, identity),
    }
    directory_bytes = 2 + 12 * len(entries) + 4
    extra, at = b"", 8 + directory_bytes
    rows = b""
    for tag, (kind, count, value) in sorted(entries.items()):
        if value is None:
            value = at + 200
        if isinstance(value, bytes) and len(value) > 4:
            field, extra = struct.pack("<I", at + len(extra)), extra + value
        else:
            field = value.ljust(4, b"\0") if isinstance(value, bytes) else struct.pack("<I", value)
        rows += struct.pack("<HHI", tag, kind, count) + field
    head = b"II*\0" + struct.pack("<I", 8) + struct.pack("<H", len(entries)) + rows + bytes(4)
    return head + extra.ljust(200, b"\0") + mosaic.tobytes()


def test_dng_pictures_are_photos(tmp_path: Path) -> None:
    pytest.importorskip("rawpy")
    ramp = np.zeros((120, 160, 3), np.uint8)
    ramp[:, :80, 0] = ramp[:, 80:, 2] = 200
    path = tmp_path / "a.dng"
    path.write_bytes(dng_of(ramp))
    (source,) = open_sources([path])
    (frame,) = source.frames(lambda index, time_ns: True)
    assert frame.image.shape == (120, 160, 3)
    left, right = frame.image[20:100, 20:60].mean((0, 1)), frame.image[20:100, 100:140].mean((0, 1))
    assert left[0] > 3 * left[2] and right[2] > 3 * right[0]
    assert "Mini 3 Pro" in source.camera.origin
    path.write_bytes(path.read_bytes()[:5000])
    try:
        (lost,) = open_sources([path])[0].frames(lambda index, time_ns: True)
        assert lost.reason.startswith("corrupt")
    except InputError:
        pass


def test_dng_without_its_extra_states_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.dng"
    path.write_bytes(dng_of(np.zeros((64, 64, 3), np.uint8)))
    monkeypatch.setitem(__import__("sys").modules, "rawpy", None)
    with pytest.raises(InputError, match=r"pip install 'sorvolo\[raw\]'"):
        open_sources([path])


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"no picture at all", "no JPEG, TIFF, PNG, HEIC or DNG picture"),
        (b"", "no JPEG, TIFF, PNG, HEIC or DNG picture"),
    ],
)
def test_why_a_picture_cannot_be_read_is_plain(tmp_path: Path, data: bytes, words: str) -> None:
    path = tmp_path / "a.jpg"
    path.write_bytes(data)
    with pytest.raises(InputError, match=words) as caught:
        open_sources([path])
    assert "0x" not in str(caught.value) and "BytesIO" not in str(caught.value)


def test_why_a_cut_jpeg_cannot_be_decoded_is_plain(checks: Image.Image) -> None:
    buffer = io.BytesIO()
    checks.save(buffer, "JPEG")
    with pytest.raises(InputError, match=r"the file ends before the picture does\); copy it again"):
        decode_photo(buffer.getvalue()[:-2000], "a.jpg")


KML = (
    "<kml><Document><Polygon><outerBoundaryIs><LinearRing><coordinates>12,45,0 12.01,45,0 12.01,45.01,0</coordinates>"
    "</LinearRing></outerBoundaryIs></Polygon></Document></kml>"
)


@settings(max_examples=100, deadline=None)
@given(st.data())
def test_any_kmz_is_read_or_refused(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    buffer = io.BytesIO()
    method = data.draw(st.sampled_from([zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED]))
    with zipfile.ZipFile(buffer, "w", method) as archive:
        archive.writestr("doc.kml", KML)
    path = tmp_path_factory.getbasetemp() / "any.kmz"
    path.write_bytes(mutated(data, buffer.getvalue()))
    try:
        assert read_area(path).area_m2 > 0
    except InputError:
        pass


XMP = """<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
<rdf:Description xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" drone-dji:RelativeAltitude="+39.8"
 drone-dji:DewarpData="2021;3713.29,3713.29,5.8,-16.9,-0.11,0.01,0,0,-0.02" drone-dji:RtkStdLon="0.01"
 xmlns:Camera="http://pix4d.com/camera/1.0/"><Camera:Yaw>3980/100</Camera:Yaw><Camera:Pitch>1</Camera:Pitch>
<Camera:Roll>2</Camera:Roll><s:CameraOrientationNED xmlns:s="https://www.skydio.com/drone-skydio/1.0/" s:Yaw="1"
 s:Pitch="-90"/></rdf:Description></rdf:RDF></x:xmpmeta>"""
NUMBERS = st.one_of(
    st.floats().map(str),
    st.integers().map(str),
    st.text(max_size=8),
    st.sampled_from(["1e999", "-0", "1/0", "9" * 400]),
)


@settings(max_examples=120, deadline=None)
@given(st.data())
def test_any_xmp_is_read_or_named_as_damaged(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    text = XMP
    for _ in range(data.draw(st.integers(0, 6))):
        number = escape(data.draw(NUMBERS), {'"': "&quot;"})
        found = data.draw(st.sampled_from(re.findall(r"[-+]?[0-9]+[0-9./]*", XMP)))
        text = text.replace(found, number, 1)
    packet = text.encode("utf-8", "replace")
    packet = mutated(data, packet, 4) if data.draw(st.booleans()) else packet
    path = tmp_path_factory.getbasetemp() / "any_xmp.jpg"
    Image.new("RGB", (64, 48), (90, 120, 60)).save(path, xmp=packet)
    (source,) = open_sources([path])
    assert source.camera.camera.width_px == 64
    for column in source.telemetry.columns.values():
        assert not np.isinf(column).any()


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_any_heic_and_dng_is_read_or_refused(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    pytest.importorskip("rawpy")
    kind = data.draw(st.sampled_from([".heic", ".dng"]))
    picture = np.kron(np.arange(48, dtype=np.uint8).reshape(6, 8), np.ones((8, 8), np.uint8))
    colours = np.repeat(picture[:, :, None], 3, axis=2)
    valid = heic_of(Image.fromarray(colours)) if kind == ".heic" else dng_of(colours)
    path = tmp_path_factory.getbasetemp() / f"any{kind}"
    path.write_bytes(mutated(data, valid))
    try:
        (source,) = open_sources([path])
    except InputError:
        return
    assert len(list(source.frames(lambda index, time_ns: True))) == 1


CONTROL = (
    "WGS84 UTM 32N\n# a comment\n"
    "678001.25 5032001.5 101.25 1024.5 768.25 one.jpg gcp1\n678101.25 5032101.5 102.5 200 300 two.jpg gcp2\n"
)
CRS_LINES = st.one_of(
    st.text(max_size=30),
    st.builds("EPSG:{}".format, st.integers(0, 10**9)),
    st.sampled_from(
        [
            "WGS84",
            "EPSG:4326",
            "EPSG:4978",
            "EPSG:2263",
            "+proj=utm +zone=32",
            "+proj=tmerc +k=nan +a=0",
        ]
    ),
)


@settings(max_examples=100, deadline=None)
@given(st.data())
def test_any_control_points_are_read_or_refused(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    text = (
        CONTROL
        if data.draw(st.booleans())
        else CONTROL.replace("WGS84 UTM 32N", data.draw(CRS_LINES), 1)
    )
    for _ in range(data.draw(st.integers(0, 3))):
        text = text.replace(
            data.draw(st.sampled_from(re.findall(r"[0-9.]+", CONTROL))), data.draw(NUMBERS), 1
        )
    packet = text.encode("utf-8", "replace")
    path = tmp_path_factory.getbasetemp() / "gcp_list.txt"
    path.write_bytes(mutated(data, packet, 3) if data.draw(st.booleans()) else packet)
    try:
        read = read_control_points(path)
        control = read.control
    except InputError:
        return
    assert control.points and all(abs(each.latitude_deg) <= 90 for each in control.points)
    assert all(words for words, _ in read.other_readings())


@settings(max_examples=120, deadline=None)
@given(st.lists(st.binary(max_size=80), max_size=8), st.integers(0, 2**62))
def test_any_bytes_from_a_receiver_are_counted(parts: list[bytes], now_ns: int) -> None:
    good = b"$GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,*47\r\n"
    buffer = SentenceBuffer(Counter())
    for part in [*parts, good, b"", *parts]:
        for epoch in buffer.take(part, now_ns):
            assert all(isinstance(value, float) for value in epoch.values.values())


@settings(max_examples=100, deadline=None)
@given(
    st.one_of(
        st.text(max_size=40),
        st.tuples(
            st.sampled_from(["rtsp", "udp", "tcp", "rtmp", "http", "webcam", "follow"]),
            st.text(max_size=30),
        ).map(lambda parts: "://".join(parts)),
    )
)
def test_any_address_is_understood_or_refused(text: str) -> None:
    if is_live_address(text):
        try:
            live_address(text)
        except InputError:
            pass
