"""Photos: EXIF and XMP of several makers, order and time, sizes, orientations, copies and damage."""

import io
import math
import random
import struct
import zlib
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image, ImageOps
from PIL.ExifTags import GPS, IFD, Base
from PIL.TiffImagePlugin import IFDRational

from real_data import real_data
from sorvolo.capture.decoding import decode_photo
from sorvolo.capture.photo_metadata import read_photo_metadata
from sorvolo.capture.photos import PhotoSource, read_album
from sorvolo.capture.source import open_sources
from sorvolo.capture.sync import tie_clocks, track_from_telemetry
from sorvolo.errors import InputError
from sorvolo.geometry.geodesy import Geodetic, LocalFrame
from sorvolo.geometry.pose import site_from_body_nadir_rotation, site_from_gimbal_rotation
from sorvolo.survey.flight import Frame, LostFrame

DJI = """<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
<rdf:Description rdf:about="DJI Meta Data" xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" {attributes}>
{elements}</rdf:Description></rdf:RDF></x:xmpmeta>"""
SENSEFLY = """<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
<rdf:Description rdf:about="" xmlns:Camera="http://pix4d.com/camera/1.0"><Camera:Yaw>{0}</Camera:Yaw>
<Camera:Pitch>{1}</Camera:Pitch><Camera:Roll>{2}</Camera:Roll>
<Camera:GPSXYAccuracy>1.5</Camera:GPSXYAccuracy><Camera:GPSZAccuracy>25/10</Camera:GPSZAccuracy>
</rdf:Description></rdf:RDF></x:xmpmeta>"""


def picture(width: int = 80, height: int = 60, seed: int = 0) -> Image.Image:
    """Smooth random colours with a red top-left and a blue top-right corner."""
    rough = np.random.default_rng(seed).integers(
        60, 180, (height // 10 + 1, width // 10 + 1, 3), np.uint8
    )
    pixels = np.asarray(
        Image.fromarray(rough).resize((width, height), Image.Resampling.BICUBIC)
    ).copy()
    pixels[:20, :20], pixels[:20, -20:] = (220, 30, 30), (30, 30, 220)
    return Image.fromarray(pixels)


def dms(degrees: float) -> tuple[IFDRational, IFDRational, IFDRational]:
    degrees = abs(degrees)
    whole, minutes = int(degrees), int(degrees % 1 * 60)
    seconds = (degrees - whole - minutes / 60) * 3600
    return (
        IFDRational(whole, 1),
        IFDRational(minutes, 1),
        IFDRational(round(seconds * 100_000), 100_000),
    )


def write_photo(
    path: Path,
    place: Sequence[float] | None = (46.5, -92.25, 198.5),
    local: str = "",
    utc: str = "",
    xmp: str = "",
    image: Image.Image | None = None,
    orientation: int = 1,
    seed: int = 0,
    extra: dict[int, object] | None = None,
    gps_extra: dict[int, object] | None = None,
    zone: str = "",
) -> Path:
    exif = Image.Exif()
    exif[Base.Make], exif[Base.Model] = "DJI\0\0\0\0", "FC300S\0\0"
    exif[Base.Orientation] = orientation
    detail = exif.get_ifd(IFD.Exif)
    detail[Base.FocalLength] = IFDRational(361, 100)
    if local:
        detail[Base.DateTimeOriginal], _, fraction = local.partition(".")
        if fraction:
            detail[Base.SubsecTimeOriginal] = fraction
    if zone:
        detail[Base.OffsetTimeOriginal] = zone
    detail.update(extra or {})
    gps = exif.get_ifd(IFD.GPSInfo)
    if place is not None:
        latitude, longitude, altitude = place
        gps[GPS.GPSLatitudeRef], gps[GPS.GPSLatitude] = "S" if latitude < 0 else "N", dms(latitude)
        gps[GPS.GPSLongitudeRef], gps[GPS.GPSLongitude] = (
            "W" if longitude < 0 else "E",
            dms(longitude),
        )
        gps[GPS.GPSAltitudeRef] = b"\1" if altitude < 0 else b"\0"
        gps[GPS.GPSAltitude] = IFDRational(round(abs(altitude) * 1000), 1000)
    if utc:
        day, _, clock = utc.partition(" ")
        gps[GPS.GPSDateStamp] = day
        parts = [float(part) for part in clock.split(":")]
        gps[GPS.GPSTimeStamp] = tuple(IFDRational(round(part * 1000), 1000) for part in parts)
    gps.update(gps_extra or {})
    options = {"xmp": xmp.encode()} if xmp else {}
    (image or picture(seed=seed)).save(path, exif=exif, quality=95, **options)
    return path


def flight(folder: Path, count: int = 4, **options: object) -> list[Path]:
    """Photos 2 s and about 11 m apart, flown north."""
    return [
        write_photo(
            folder / f"IMG_{index + 8}.jpg",
            (46.5 + 1e-4 * index, -92.25, 198.5),
            utc=f"2021:06:01 10:00:{2 * index:02d}",
            seed=index,
            **options,  # type: ignore[arg-type]
        )
        for index in range(count)
    ]


def open_photos(*paths: Path) -> PhotoSource:
    (source,) = open_sources(paths)
    assert isinstance(source, PhotoSource)
    return source


def all_frames(source: PhotoSource) -> list[Frame | LostFrame]:
    return list(source.frames(lambda index, time_ns: True))


def codes(source: PhotoSource) -> dict[str, int]:
    """All notices but one: photos of these tests often share a place."""
    notices = (*source.notices(), *source.telemetry.notices)
    return {notice.code: notice.count for notice in notices if notice.code != "repeated_fix"}


@given(
    latitude=st.floats(-89.9, 89.9),
    longitude=st.floats(-179.9, 179.9),
    altitude=st.floats(-400, 9000),
)
@settings(
    max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
def test_places_come_back(
    tmp_path: Path, latitude: float, longitude: float, altitude: float
) -> None:
    path = write_photo(tmp_path / "a.jpg", (latitude, longitude, altitude))
    columns = read_photo_metadata(path).columns
    assert columns["latitude_deg"] == pytest.approx(latitude, abs=1e-8)
    assert columns["longitude_deg"] == pytest.approx(longitude, abs=1e-8)
    assert columns["orthometric_height_m"] == pytest.approx(altitude, abs=1e-3)


def test_padded_texts_and_focal_lengths(tmp_path: Path) -> None:
    metadata = read_photo_metadata(
        write_photo(
            tmp_path / "a.jpg",
            extra={
                Base.FocalPlaneXResolution: IFDRational(254_000, 10),
                Base.FocalPlaneResolutionUnit: 2,
                Base.FocalLengthIn35mmFilm: 20,
                Base.ExifImageWidth: 4000,
            },
        )
    )
    assert (metadata.make, metadata.model) == ("DJI", "FC300S")
    assert metadata.focal_length_mm == pytest.approx(3.61) and metadata.focal_length_35mm == 20
    assert metadata.focal_plane_px_per_mm == pytest.approx(1000) and metadata.full_width_px == 4000


@pytest.mark.parametrize(
    "broken",
    [
        {GPS.GPSLatitude: (IFDRational(0, 0), IFDRational(0, 0), IFDRational(0, 0))},
        {GPS.GPSLatitude: (IFDRational(46, 1), IFDRational(30, 0), IFDRational(1, 1))},
        {GPS.GPSLatitude: (IFDRational(146, 1), IFDRational(0, 1), IFDRational(0, 1))},
        {GPS.GPSLatitude: (IFDRational(46, 1), IFDRational(75, 1), IFDRational(0, 1))},
        {GPS.GPSLatitude: (IFDRational(465, 10), IFDRational(30, 1), IFDRational(0, 1))},
    ],
)
def test_zero_denominators_and_impossible_places_are_no_place(
    tmp_path: Path, broken: dict[int, object]
) -> None:
    metadata = read_photo_metadata(write_photo(tmp_path / "a.jpg", gps_extra=broken))
    assert "latitude_deg" not in metadata.columns and "longitude_deg" not in metadata.columns
    assert math.isnan(
        read_photo_metadata(
            write_photo(tmp_path / "b.jpg", extra={Base.FocalLength: IFDRational(0, 0)})
        ).focal_length_mm
    )


@pytest.mark.parametrize("as_elements", [False, True])
def test_dji_words_as_attributes_and_elements(tmp_path: Path, as_elements: bool) -> None:
    words = {
        "RelativeAltitude": "+39.80",
        "GimbalYawDegree": "-135.00",
        "GimbalPitchDegree": "-89.90",
        "GimbalRollDegree": "+180.00",
        "FlightYawDegree": "+46.00",
        "FlightPitchDegree": "+1.80",
        "FlightRollDegree": "-3.00",
        "FlightXSpeed": "+3.0",
        "FlightYSpeed": "-4.0",
    }
    attributes = (
        "" if as_elements else " ".join(f'drone-dji:{key}="{text}"' for key, text in words.items())
    )
    elements = (
        "".join(f"<drone-dji:{key}>{text}</drone-dji:{key}>" for key, text in words.items())
        if as_elements
        else ""
    )
    xmp = DJI.format(attributes=attributes, elements=elements)
    columns = read_photo_metadata(write_photo(tmp_path / "a.jpg", xmp=xmp)).columns
    assert columns["height_above_takeoff_m"] == 39.8 and columns["orthometric_height_m"] == 198.5
    assert [columns[f"camera_{axis}_deg"] for axis in ("yaw", "pitch", "roll")] == [
        -135,
        -89.9,
        180,
    ]
    assert [columns[f"body_{axis}_deg"] for axis in ("yaw", "pitch", "roll")] == [46, 1.8, -3]
    assert columns["speed_m_s"] == 5 and columns["course_deg"] == pytest.approx(306.87, abs=0.01)


def test_an_rtk_height_is_ellipsoidal(tmp_path: Path) -> None:
    xmp = DJI.format(
        elements="",
        attributes=(
            'drone-dji:AltitudeType="RtkAlt" drone-dji:RtkStdLon="0.03" drone-dji:RtkStdLat="0.03" '
            'drone-dji:RtkStdHgt="0.05"'
        ),
    )
    columns = read_photo_metadata(write_photo(tmp_path / "a.jpg", xmp=xmp)).columns
    assert columns["ellipsoidal_height_m"] == 198.5 and "orthometric_height_m" not in columns
    assert (
        columns["horizontal_sigma_m"] == pytest.approx(0.03) and columns["vertical_sigma_m"] == 0.05
    )


XMP = """<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
<rdf:Description rdf:about="" xmlns:{prefix}="{address}">{body}</rdf:Description></rdf:RDF></x:xmpmeta>"""


def xmp_of(prefix: str, address: str, values: dict[str, str]) -> str:
    body = "".join(f"<{prefix}:{name}>{text}</{prefix}:{name}>" for name, text in values.items())
    return XMP.format(prefix=prefix, address=address, body=body)


def test_sensefly_photos_state_three_heights_and_the_bodys_attitude(tmp_path: Path) -> None:
    xmp = xmp_of(
        "sensefly",
        "http://ns.sensefly.com/sensefly/1.0/",
        {
            "AltitudeAMSL": "313.379",
            "AltitudeWGS84": "277.870",
            "Course": "0.0",
            "GroundSpeed": "6.7",
            "Heading": "43.89",
            "Height": "65.5",
            "PitchAngle": "2.86",
            "RollAngle": "-3.84",
            "UTCTime": "2013-06-04T17:50:31",
        },
    )
    metadata = read_photo_metadata(
        write_photo(
            tmp_path / "a.jpg",
            (41.0, -83.3, 277.87),
            local="2013:06:04 13:49:57",
            xmp=xmp,
            gps_extra={GPS.GPSTrack: IFDRational(4389, 100)},
        )
    )
    found = metadata.columns
    assert found["ellipsoidal_height_m"] == 277.87 and found["orthometric_height_m"] == 313.379
    assert found["height_above_takeoff_m"] == 65.5 and found["speed_m_s"] == 6.7
    assert [found[f"body_{axis}_deg"] for axis in ("yaw", "pitch", "roll")] == [43.89, 2.86, -3.84]
    assert "course_deg" not in found and "camera_yaw_deg" not in found
    assert metadata.utc_ns == 1_370_368_231 * 10**9


@pytest.mark.parametrize("form", ["resource", "attributes"])
def test_skydio_photos_state_the_cameras_attitude_as_a_structure(tmp_path: Path, form: str) -> None:
    angles = {"Roll": "0.5", "Pitch": "-89.5", "Yaw": "120.25"}
    structures = ""
    for name, shift in (
        ("CameraOrientationFLU", 7.0),
        ("CameraOrientationNED", 0.0),
        ("VehicleOrientationNED", 3.0),
    ):
        moved = {axis: str(float(text) + shift) for axis, text in angles.items()}
        inside = "".join(
            f"<drone-skydio:{axis}>{text}</drone-skydio:{axis}>" for axis, text in moved.items()
        )
        attributes = " ".join(f'drone-skydio:{axis}="{text}"' for axis, text in moved.items())
        structures += (
            f'<drone-skydio:{name} rdf:parseType="Resource">{inside}</drone-skydio:{name}>'
            if form == "resource"
            else f"<drone-skydio:{name} {attributes}/>"
        )
    body = "<drone-skydio:AbsoluteAltitude>310.5</drone-skydio:AbsoluteAltitude>" + structures
    body += "<drone-skydio:RelativeAltitude>42.25</drone-skydio:RelativeAltitude>"
    xmp = XMP.format(
        prefix="drone-skydio", address="https://www.skydio.com/drone-skydio/1.0/", body=body
    )
    found = read_photo_metadata(
        write_photo(tmp_path / "a.jpg", (46.5, 11.2, 355.0), xmp=xmp)
    ).columns
    assert [found[f"camera_{axis}_deg"] for axis in ("yaw", "pitch", "roll")] == [
        120.25,
        -89.5,
        0.5,
    ]
    assert [found[f"body_{axis}_deg"] for axis in ("yaw", "pitch", "roll")] == [123.25, -86.5, 3.5]
    assert found["height_above_takeoff_m"] == 42.25 and found["orthometric_height_m"] == 310.5


@pytest.mark.parametrize(
    ("flag", "column"), [("50", "ellipsoidal_height_m"), ("16", "orthometric_height_m")]
)
def test_autel_photos_by_their_rtk_flag(tmp_path: Path, flag: str, column: str) -> None:
    xmp = xmp_of(
        "drone",
        "http://www.example.org/1.0/",
        {
            "AbsoluteAltitude": "250.0",
            "RelativeAltitude": "60.0",
            "GimbalYawDegree": "10",
            "GimbalPitchDegree": "-90",
            "GimbalRollDegree": "0",
            "FlightYawDegree": "12",
            "RtkFlag": flag,
        },
    )
    found = read_photo_metadata(
        write_photo(tmp_path / "a.jpg", (46.5, 11.2, 250.0), xmp=xmp)
    ).columns
    assert found[column] == 250.0 and found["height_above_takeoff_m"] == 60.0
    assert found["camera_pitch_deg"] == -90 and found["body_yaw_deg"] == 12
    assert len({"ellipsoidal_height_m", "orthometric_height_m"} & set(found)) == 1


def test_parrot_photos_state_angles_and_the_height_above_takeoff(tmp_path: Path) -> None:
    body = "".join(
        f"<drone-parrot:{name}>{text}</drone-parrot:{name}>"
        for name, text in {
            "CameraYawDegree": "80",
            "CameraPitchDegree": "-88",
            "CameraRollDegree": "1",
            "DroneYawDegree": "81",
            "DronePitchDegree": "4",
            "DroneRollDegree": "-2",
        }.items()
    ) + (
        '<Camera:AboveGroundAltitude xmlns:Camera="http://pix4d.com/camera/1.0/">33.5</Camera:AboveGroundAltitude>'
        '<Camera:VertCS xmlns:Camera="http://pix4d.com/camera/1.0/">ellipsoidal</Camera:VertCS>'
    )
    xmp = XMP.format(
        prefix="drone-parrot", address="http://www.parrot.com/drone-parrot/1.0/", body=body
    )
    found = read_photo_metadata(
        write_photo(tmp_path / "a.jpg", (46.5, 11.2, 250.0), xmp=xmp)
    ).columns
    assert [found[f"camera_{axis}_deg"] for axis in ("yaw", "pitch", "roll")] == [80, -88, 1]
    assert [found[f"body_{axis}_deg"] for axis in ("yaw", "pitch", "roll")] == [81, 4, -2]
    assert found["height_above_takeoff_m"] == 33.5 and found["ellipsoidal_height_m"] == 250.0


def test_djis_calibration_in_xmp_becomes_the_camera(tmp_path: Path) -> None:
    data = "2021-01-01;3713.29,3712.5,5.84,-16.9,-0.1123,0.0149,-0.0002,0.0001,-0.0272"
    xmp = DJI.format(
        elements="", attributes=f'drone-dji:DewarpFlag="0" drone-dji:DewarpData="{data}"'
    )
    photo = write_photo(
        tmp_path / "a.jpg", xmp=xmp, image=picture(548, 364), extra={Base.ExifImageWidth: 5480}
    )
    found = open_photos(photo).camera
    assert found.focal_sigma == 0.005 and "XMP: calibrated" in found.origin
    assert found.camera.fx_px == pytest.approx(371.329) and found.camera.cx_px == pytest.approx(
        273.5 + 0.584
    )
    assert found.camera.distortion.tolist() == [-0.1123, 0.0149, -0.0002, 0.0001, -0.0272]
    taken_out = xmp.replace('DewarpFlag="0"', 'DewarpFlag="1"')
    assert not open_photos(
        write_photo(tmp_path / "b.jpg", xmp=taken_out, image=picture(548, 364))
    ).camera.camera.distortion.any()


@pytest.mark.parametrize("maker", ["dji", "skydio"])
def test_the_lenss_design_in_xmp_becomes_the_camera(tmp_path: Path, maker: str) -> None:
    if maker == "dji":
        xmp = DJI.format(
            elements="",
            attributes=(
                'drone-dji:CalibratedFocalLength="366.67" drone-dji:CalibratedOpticalCenterX="276.0" '
                'drone-dji:CalibratedOpticalCenterY="182.0"'
            ),
        )
    else:
        body = "".join(
            f'<drone-skydio:{name} rdf:parseType="Resource"><drone-skydio:X>{x}</drone-skydio:X>'
            f"<drone-skydio:Y>{y}</drone-skydio:Y></drone-skydio:{name}>"
            for name, x, y in (
                ("CalibratedFocalLength", 366.67, 366.67),
                ("CalibratedOpticalCenter", 276, 182),
            )
        )
        xmp = XMP.format(
            prefix="drone-skydio", address="https://www.skydio.com/drone-skydio/1.0/", body=body
        )
    found = open_photos(write_photo(tmp_path / "a.jpg", xmp=xmp, image=picture(548, 364))).camera
    assert found.focal_sigma == 0.01 and found.camera.fx_px == pytest.approx(366.67)
    assert found.camera.cx_px == pytest.approx(275.5) and found.camera.cy_px == pytest.approx(181.5)


@pytest.mark.parametrize(
    "attributes",
    [
        'drone-dji:CalibratedFocalLength="0"',
        'drone-dji:CalibratedFocalLength="nan"',
        'drone-dji:DewarpData="1,2"',
        'drone-dji:DewarpData="x;1,1,0,0,0,0,0,0,0"',
        'drone-dji:DewarpData="x;300,300,0,0,-9,0,0,0,0"',
    ],
)
def test_a_lens_in_xmp_that_cannot_be_is_passed_over(tmp_path: Path, attributes: str) -> None:
    xmp = DJI.format(elements="", attributes=attributes)
    assert "preset Phantom 3" in open_photos(write_photo(tmp_path / "a.jpg", xmp=xmp)).camera.origin


def test_stated_errors_become_the_priors_own(tmp_path: Path) -> None:
    body = "".join(
        f"<Camera:{name}>{text}</Camera:{name}>"
        for name, text in {
            "Yaw": "30",
            "Pitch": "1",
            "Roll": "2",
            "IMUYawAccuracy": "1.5",
            "IMUPitchAccuracy": "0.4",
            "IMURollAccuracy": "0.4",
            "GPSXYAccuracy": "0.04",
            "GPSZAccuracy": "0.06",
        }.items()
    )
    xmp = XMP.format(prefix="Camera", address="http://pix4d.com/camera/1.0", body=body)
    write_photo(tmp_path / "a.jpg", xmp=xmp, utc="2021:06:01 10:00:00")
    source = open_photos(tmp_path / "a.jpg")
    clock = tie_clocks(source.telemetry, np.zeros(1), kind="photos", start_ns=source.start_ns)
    frame = LocalFrame(Geodetic(46.5, -92.25))
    prior = track_from_telemetry(source.telemetry, clock, frame)[0].prior(0.0)
    assert prior.attitude_sigma_deg == pytest.approx([0.4, 0.4, 1.5])
    assert prior.position_sigma_m == pytest.approx([0.04, 0.04, 0.06])


@pytest.mark.parametrize(
    ("tags", "sigma_m"),
    [
        ({GPS.GPSDOP: IFDRational(12, 10)}, 1.8),
        ({GPS.GPSHPositioningError: IFDRational(7, 10)}, 0.7),
        ({}, None),
    ],
)
def test_exif_states_the_positions_error(
    tmp_path: Path, tags: dict[int, object], sigma_m: float | None
) -> None:
    found = read_photo_metadata(write_photo(tmp_path / "a.jpg", gps_extra=tags)).columns
    assert found.get("horizontal_sigma_m") == (None if sigma_m is None else pytest.approx(sigma_m))


def dji_place(latitude: float, longitude: float) -> str:
    place = f'drone-dji:GpsLatitude="{latitude:+.8f}" drone-dji:GpsLongitude="{longitude:+.8f}"'
    return DJI.format(attributes=place, elements="")


NO_REFERENCES = {GPS.GPSLatitudeRef: "", GPS.GPSLongitudeRef: ""}
SOUTH_WEST, NORTH_EAST = (-46.5, -92.25), (46.5, 92.25)


@pytest.mark.parametrize(
    "gps, xmp, place, code",
    [
        (NO_REFERENCES, "", NORTH_EAST, "sign_assumed"),
        (NO_REFERENCES, dji_place(*SOUTH_WEST), SOUTH_WEST, "sign_by_xmp"),
        (NO_REFERENCES, dji_place(*NORTH_EAST), NORTH_EAST, ""),
        (NO_REFERENCES, dji_place(0, 0), NORTH_EAST, "sign_assumed"),
        ({GPS.GPSLatitudeRef: "O"}, "", (46.5, -92.25), "sign_assumed"),
        ({GPS.GPSLatitudeRef: "North"}, dji_place(*SOUTH_WEST), SOUTH_WEST, "sign_by_xmp"),
        ({GPS.GPSLatitudeRef: "South", GPS.GPSLongitudeRef: "west"}, "", SOUTH_WEST, ""),
        (
            {GPS.GPSLatitudeRef: "s", GPS.GPSLongitudeRef: "W"},
            dji_place(*SOUTH_WEST),
            SOUTH_WEST,
            "",
        ),
        ({}, dji_place(-46.5003, -92.25), SOUTH_WEST, "position_contradicted"),
        ({}, dji_place(-46.50003, -92.25), SOUTH_WEST, ""),
        ({GPS.GPSStatus: "V"}, dji_place(*SOUTH_WEST), SOUTH_WEST, "void_fix_by_xmp"),
        ({GPS.GPSStatus: "A"}, "", SOUTH_WEST, ""),
        (
            {GPS.GPSLatitude: dms(0), GPS.GPSLongitude: dms(0)},
            dji_place(*SOUTH_WEST),
            SOUTH_WEST,
            "",
        ),
    ],
)
def test_positions_in_exif_and_xmp_are_held_against_each_other(
    tmp_path: Path, gps: dict[int, object], xmp: str, place: tuple[float, float], code: str
) -> None:
    write_photo(tmp_path / "a.jpg", (*SOUTH_WEST, 198), xmp=xmp, gps_extra=gps)
    source = open_photos(tmp_path)
    found = [source.telemetry[name][0] for name in ("latitude_deg", "longitude_deg")]
    assert found == pytest.approx(place, abs=1e-7)
    assert set(codes(source)) - {"photo_without_time"} == ({code} if code else set())


def test_a_void_fix_is_no_place_and_no_missing_one(tmp_path: Path) -> None:
    write_photo(tmp_path / "a.jpg", gps_extra={GPS.GPSStatus: "V"})
    source = open_photos(tmp_path)
    assert not source.telemetry.has_fixes
    assert codes(source) == {"void_fix": 1, "photo_without_time": 1}


def test_a_real_fixed_wing_flight_states_heights_and_attitude() -> None:
    source = open_photos(real_data("flights/fixed_wing"))
    telemetry = source.telemetry
    ground_m = telemetry["orthometric_height_m"] - telemetry["height_above_takeoff_m"]
    assert np.ptp(ground_m) < 0.5 and np.isfinite(telemetry["body_roll_deg"]).all()
    # the geoid lies 33 to 36 m below the ellipsoid there
    assert np.median(
        telemetry["ellipsoidal_height_m"] - telemetry["orthometric_height_m"]
    ) == pytest.approx(-35, abs=2)
    assert source.start_origin == "UTC in the photos' EXIF"


@pytest.mark.parametrize("angles", [(30.0, 5.0, -8.0), (200.0, 0.0, 0.0), (10.0, 60.0, 20.0)])
def test_sensefly_angles_count_from_the_nadir(
    tmp_path: Path, angles: tuple[float, float, float]
) -> None:
    path = write_photo(tmp_path / "a.jpg", xmp=SENSEFLY.format(*angles))
    columns = read_photo_metadata(path).columns
    gimbal = [columns[f"camera_{axis}_deg"] for axis in ("yaw", "pitch", "roll")]
    expected = site_from_body_nadir_rotation(*angles)
    assert site_from_gimbal_rotation(*gimbal) == pytest.approx(expected, abs=1e-6)
    assert columns["horizontal_sigma_m"] == 1.5 and columns["vertical_sigma_m"] == 2.5


def test_times_are_utc_where_something_states_it(tmp_path: Path) -> None:
    ten_ns = 1_622_541_600 * 1_000_000_000
    gps = read_photo_metadata(
        write_photo(tmp_path / "a.jpg", utc="2021:06:01 10:00:00.5", local="2021:06:01 03:00:00")
    )
    assert gps.utc_ns == ten_ns + 500_000_000
    zoned = read_photo_metadata(
        write_photo(tmp_path / "b.jpg", local="2021:06:01 12:00:00.25", zone="+02:00")
    )
    assert zoned.utc_ns == ten_ns + 250_000_000
    local = read_photo_metadata(write_photo(tmp_path / "c.jpg", local="2021:06:01 12:00:00"))
    assert local.utc_ns == 0 and local.local_ns == ten_ns + 7200 * 1_000_000_000
    none = read_photo_metadata(write_photo(tmp_path / "d.jpg", local="0000:00:00 00:00:00"))
    assert (none.utc_ns, none.local_ns) == (0, 0)


def test_a_flight_is_sorted_by_time_then_by_name(tmp_path: Path) -> None:
    for number, second in ((10, 4), (9, 4), (2, 6), (30, 2)):
        write_photo(
            tmp_path / f"IMG_{number}.jpg", utc=f"2021:06:01 10:00:{second:02d}", seed=number
        )
    source = open_photos(tmp_path)
    frames = all_frames(source)
    assert [frame.name for frame in frames] == [
        "IMG_30.jpg",
        "IMG_9.jpg",
        "IMG_10.jpg",
        "IMG_2.jpg",
    ]
    assert [frame.time_ns - source.start_ns for frame in frames] == [
        0,
        2_000_000_000,
        2_001_000_000,
        4_000_000_000,
    ]
    assert source.telemetry.time_ns.tolist() == [frame.time_ns for frame in frames]
    assert source.kind == "photos" and source.frame_count == 4 and math.isnan(source.frame_rate_hz)


def test_photos_of_different_days_are_no_silent_flight(tmp_path: Path) -> None:
    """Two flights in one folder, or a clock that was reset: changes between them would be painted over each other."""
    for folder, second_day in (("one", "2026:06:01 17:00:0"), ("two", "2026:06:02 12:00:0")):
        (tmp_path / folder).mkdir()
        for index, day in enumerate(["2026:06:01 12:00:0"] * 2 + [second_day] * 2):
            path = tmp_path / folder / f"{index}.jpg"
            write_photo(path, local=f"{day}{index}", utc=f"{day}{index}", seed=index)
    assert codes(open_photos(tmp_path / "one")) == {"gap": 1}
    assert codes(open_photos(tmp_path / "two")) == {"gap": 1, "days_apart": 1}


def test_an_unknown_zone_is_reported_and_no_time_too(tmp_path: Path) -> None:
    (tmp_path / "local").mkdir()
    for index in range(3):
        write_photo(
            tmp_path / "local" / f"{index}.jpg", local=f"2021:06:01 12:00:0{index}", seed=index
        )
    assert codes(open_photos(tmp_path / "local")) == {"time_zone_unknown": 3}
    (tmp_path / "none").mkdir()
    for index in range(3):
        write_photo(tmp_path / "none" / f"{index}.jpg", seed=index)
    untimed = open_photos(tmp_path / "none")
    assert codes(untimed) == {"photo_without_time": 3}
    assert untimed.start_ns == 0 and "unknown" in untimed.start_origin


def test_a_gps_clock_that_stands_still_is_replaced_by_the_cameras(tmp_path: Path) -> None:
    for index, gps_second in enumerate((0, 2, 2, 6)):
        write_photo(
            tmp_path / f"{index}.jpg",
            utc=f"2021:06:01 10:00:0{gps_second}",
            local=f"2021:06:01 05:00:0{2 * index}",
            seed=index,
        )
    source = open_photos(tmp_path)
    assert np.diff(source.telemetry.time_ns).tolist() == [2_000_000_000] * 3
    assert source.start_ns == 1_622_541_600 * 1_000_000_000


@pytest.mark.parametrize("day", ["2021:06:01", "2021:06:02"])
def test_photos_across_midnight_stay_in_order(tmp_path: Path, day: str) -> None:
    """A receiver that keeps yesterday's date for a while puts the photos behind midnight a day too early."""
    utc = ["2021:06:01 23:59:58", f"{day} 00:00:00", "2021:06:02 00:00:02"]
    local = ["2021:06:02 01:59:58", "2021:06:02 02:00:00", "2021:06:02 02:00:02"]
    for index in range(3):
        write_photo(tmp_path / f"{index}.jpg", utc=utc[index], local=local[index], seed=index)
    source = open_photos(tmp_path)
    assert source.inputs == ("0.jpg", "1.jpg", "2.jpg")
    assert np.diff(source.telemetry.time_ns).tolist() == [2_000_000_000] * 2
    assert codes(source) == ({"gps_date": 1} if day == "2021:06:01" else {})


def test_a_photo_without_gps_is_delivered_but_has_no_sample(tmp_path: Path) -> None:
    flight(tmp_path)
    write_photo(tmp_path / "IMG_7.jpg", None, utc="2021:06:01 10:00:03", seed=9)
    source = open_photos(tmp_path)
    frames = all_frames(source)
    assert all(isinstance(frame, Frame) for frame in frames) and len(frames) == 5
    assert len(source.telemetry) == 4 and frames[2].time_ns not in source.telemetry.time_ns
    assert codes(source) == {"photo_without_gps": 1}


def test_null_and_teleporting_fixes_are_dropped_and_counted(tmp_path: Path) -> None:
    flight(tmp_path, 8)
    write_photo(tmp_path / "null.jpg", (0, 0, 0), utc="2021:06:01 10:00:05", seed=20)
    write_photo(tmp_path / "far.jpg", (47.5, -92.25, 198), utc="2021:06:01 10:00:07", seed=21)
    source = open_photos(tmp_path)
    found = codes(source)
    assert found["null_fix"] == 1 and found["jump"] == 1
    # a photo whose fix is dropped keeps its sample: it may still state how the camera looked
    assert np.isfinite(source.telemetry["latitude_deg"]).sum() == 8
    assert len(source.telemetry) == 10 and len(all_frames(source)) == 10


def test_corrupt_duplicate_empty_and_foreign_files(tmp_path: Path) -> None:
    good = flight(tmp_path)
    (tmp_path / "IMG_8 copy.jpg").write_bytes(good[0].read_bytes())
    cut = write_photo(tmp_path / "IMG_20.jpg", utc="2021:06:01 10:00:20", seed=30)
    cut.write_bytes(cut.read_bytes()[:-400])
    (tmp_path / "IMG_21.jpg").touch()
    (tmp_path / "IMG_22.jpg").write_bytes(b"not a picture")
    (tmp_path / "notes.txt").write_text("windy")
    (tmp_path / "._IMG_8.jpg").write_bytes(b"a resource fork")
    source = open_photos(tmp_path)
    lost = {
        frame.name: frame.reason for frame in all_frames(source) if isinstance(frame, LostFrame)
    }
    assert sorted(lost) == ["IMG_20.jpg", "IMG_21.jpg", "IMG_22.jpg", "IMG_8 copy.jpg"]
    assert lost["IMG_8 copy.jpg"] == "duplicate of IMG_8.jpg"
    assert all(
        reason.startswith("corrupt: ") for name, reason in lost.items() if name != "IMG_8 copy.jpg"
    )
    found = codes(source)
    assert found == {
        "duplicate_photo": 1,
        "unreadable_photo": 2,
        "corrupt_photo": 1,
        "ignored_file": 1,
        "photo_without_time": 2,
        "gap": 1,
    }


@pytest.mark.parametrize("orientation", range(1, 9))
def test_orientation_is_applied_as_viewers_do(tmp_path: Path, orientation: int) -> None:
    path = write_photo(tmp_path / "a.jpg", orientation=orientation)
    with Image.open(path) as stored:
        expected = np.asarray(ImageOps.exif_transpose(stored).convert("RGB")).astype(int)
    image = all_frames(open_photos(path))[0].image
    assert image.shape == expected.shape and np.abs(image - expected).max() <= 3


def test_a_photo_that_lies_across_is_turned_to_fit(tmp_path: Path) -> None:
    flight(tmp_path)
    # a tag that a camera looking down wrote by mistake, and a picture that really was turned
    write_photo(tmp_path / "IMG_90.jpg", utc="2021:06:01 10:01:00", orientation=6, seed=5)
    turned = picture(seed=6).transpose(Image.Transpose.ROTATE_90)
    write_photo(tmp_path / "IMG_91.jpg", utc="2021:06:01 10:01:02", image=turned)
    source = open_photos(tmp_path)
    frames = all_frames(source)
    assert {frame.image.shape for frame in frames} == {(60, 80, 3)}
    assert codes(source) == {"rotated_photo": 2, "gap": 1}
    for frame, seed in zip(frames[-2:], (5, 6), strict=True):
        assert np.abs(frame.image.astype(int) - np.asarray(picture(seed=seed))).mean() < 6


WIDE, ZOOM, HEAT = (4.4, 24), (30.0, 162), (9.1, 40)


def write_lens(path: Path, lens: tuple[float, int | None], source: str = "", seed: int = 0) -> Path:
    focal_mm, film_mm = lens
    film = {} if film_mm is None else {Base.FocalLengthIn35mmFilm: film_mm}
    xmp = DJI.format(attributes=f'drone-dji:ImageSource="{source}"', elements="") if source else ""
    extra = {Base.FocalLength: IFDRational(round(100 * focal_mm), 100), **film}
    return write_photo(path, utc=f"2021:06:01 10:00:{seed:02d}", xmp=xmp, extra=extra, seed=seed)


@pytest.mark.parametrize(
    ("most", "others", "names", "way"),
    [
        ((WIDE, "WideCamera"), (ZOOM, "ZoomCamera"), ("DJI_{}_W", "DJI_{}_Z"), "*_Z.jpg"),
        ((WIDE, ""), (HEAT, "InfraredCamera"), ("DJI_{}_W", "DJI_{}_T"), "*_T.jpg"),
        (((4.4, None), ""), ((4.4, None), ""), ("DJI_{}_W", "DJI_{}_T"), "*_T.jpg"),
        ((WIDE, ""), (WIDE, "InfraredCamera"), ("IMG_{}", "IRX_{}"), "IRX_*"),
        (((4.4, None), ""), ((9.1, None), ""), ("DJI_1{}", "DJI_2{}"), "a folder of their own"),
        ((HEAT, "InfraredCamera"), (WIDE, ""), ("DJI_2{}", "DJI_1{}"), "a folder of their own"),
    ],
)
def test_each_lens_and_light_is_a_flight_of_its_own(
    tmp_path: Path,
    most: tuple[tuple[float, int | None], str],
    others: tuple[tuple[float, int | None], str],
    names: tuple[str, str],
    way: str,
) -> None:
    for seed in range(4):
        write_lens(tmp_path / f"{names[0].format(seed)}.jpg", *most, seed=seed)
    second = [
        write_lens(tmp_path / f"{names[1].format(seed)}.jpg", *others, seed=seed + 10)
        for seed in range(3)
    ]
    source = open_photos(tmp_path)
    assert source.inputs == tuple(f"{names[0].format(seed)}.jpg" for seed in range(4))
    (found,) = [each for each in source.notices() if each.code == "other_camera"]
    assert found.count == 3 and second[0].name in found.text and way in found.text
    assert "zoom" not in codes(source) and len(source.telemetry) == 4
    alone = open_photos(*second)
    assert alone.frame_count == 3 and "other_camera" not in codes(alone)
    assert alone.fingerprint != source.fingerprint


def test_the_wide_ones_are_mapped_where_wide_and_thermal_are_as_many(tmp_path: Path) -> None:
    for seed in range(3):
        write_lens(tmp_path / f"DJI_{seed}_T.JPG", HEAT, "InfraredCamera", seed)
        write_lens(tmp_path / f"DJI_{seed}_V.JPG", WIDE, "WideCamera", seed)
        write_lens(tmp_path / f"DJI_{seed}_Z.JPG", ZOOM, "ZoomCamera", seed)
    assert open_photos(tmp_path).inputs == tuple(f"DJI_{seed}_V.JPG" for seed in range(3))


def test_photos_without_a_focal_length_stay_with_the_most(tmp_path: Path) -> None:
    for seed in range(3):
        write_lens(tmp_path / f"DJI_{seed}.JPG", WIDE, seed=seed)
    write_lens(tmp_path / "DJI_3.JPG", (4.5, 24), seed=3)  # rounded another way
    picture(seed=4).save(tmp_path / "DJI_4.JPG")
    assert open_photos(tmp_path).frame_count == 5


def test_other_sizes_are_resampled_or_lost(tmp_path: Path) -> None:
    flight(tmp_path)
    write_photo(tmp_path / "IMG_90.jpg", utc="2021:06:01 10:00:08", image=picture(160, 120))
    write_photo(tmp_path / "IMG_91.jpg", utc="2021:06:01 10:00:10", image=picture(80, 40))
    source = open_photos(tmp_path)
    frames = all_frames(source)
    assert isinstance(frames[4], Frame) and frames[4].image.shape == (60, 80, 3)
    assert isinstance(frames[5], LostFrame)
    assert frames[5].reason == "size 80x40 differs from the flight's 80x60"
    assert codes(source) == {"resized_photo": 1, "other_size": 1}


@pytest.mark.parametrize("mode", ["L", "RGBA", "CMYK", "P", "I;16", "LA"])
@pytest.mark.parametrize("suffix", [".tif", ".png", ".jpg"])
def test_every_pixel_type_becomes_rgb(tmp_path: Path, mode: str, suffix: str) -> None:
    image = picture()
    if mode == "I;16":
        values = np.asarray(image.convert("L")).astype(np.uint16) * 257
        converted = Image.fromarray(values)
    else:
        converted = image.convert(mode)
    buffer = io.BytesIO()
    try:
        converted.save(buffer, {".tif": "TIFF", ".png": "PNG", ".jpg": "JPEG"}[suffix])
    except OSError:
        pytest.skip(f"there is no {mode} in {suffix}")
    decoded = decode_photo(buffer.getvalue(), "a")
    assert decoded.shape == (60, 80, 3) and decoded.dtype == np.uint8
    reference = image.convert("L").convert("RGB") if mode in ("L", "LA", "I;16") else image
    tolerance = 25 if mode == "P" else 12  # a palette of few colours
    assert np.abs(decoded.astype(int) - np.asarray(reference)).mean() < tolerance


def test_sixteen_bit_colour_keeps_its_upper_bits() -> None:
    colours = np.random.default_rng(0).integers(0, 65_536, (30, 40, 3), np.uint16)
    for suffix in (".tiff", ".png"):
        data = cv2.imencode(suffix, colours[:, :, ::-1])[1].tobytes()
        decoded = decode_photo(data, "a").astype(int)
        assert np.abs(decoded - colours.astype(int) // 256).max() <= 1


def test_only_wanted_photos_are_decoded(tmp_path: Path) -> None:
    paths = flight(tmp_path)
    source = open_photos(tmp_path)
    paths[1].unlink()  # a photo that is not wanted is not opened any more
    asked: list[int] = []

    def wanted(index: int, time_ns: int) -> bool:
        asked.append(index)
        return index != 1

    assert [type(frame) for frame in source.frames(wanted)] == [Frame, Frame, Frame]
    assert asked == [0, 1, 2, 3]


def test_a_consumer_that_stops_early_ends_the_thread(tmp_path: Path) -> None:
    flight(tmp_path)
    frames = open_photos(tmp_path).frames(lambda index, time_ns: True)
    assert next(frames).index == 0
    frames.close()  # type: ignore[attr-defined]
    assert next(frames, None) is None


def test_huge_and_float_pictures_are_refused_before_decoding(tmp_path: Path) -> None:
    huge = tmp_path / "huge.png"
    picture().save(huge)
    data = bytearray(huge.read_bytes())
    data[16:24] = struct.pack(">II", 20_000, 16_000)  # a header that claims more than is there
    data[29:33] = struct.pack(">I", zlib.crc32(data[12:29]))
    huge.write_bytes(data)
    with pytest.raises(InputError, match="megapixels"):
        read_photo_metadata(huge)
    heights = tmp_path / "dem.tif"
    Image.fromarray(np.zeros((10, 10), np.float32)).save(heights)
    with pytest.raises(InputError, match="floating-point"):
        read_photo_metadata(heights)


@settings(
    max_examples=150, deadline=5000, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    seed=st.integers(0, 2**32),
    flips=st.integers(0, 40),
    keep=st.floats(0.001, 1.0),
    suffix=st.sampled_from([".jpg", ".tif", ".png"]),
    in_header=st.booleans(),
)
def test_damaged_photos_are_lost_not_errors(
    tmp_path: Path, seed: int, flips: int, keep: float, suffix: str, in_header: bool
) -> None:
    chance = random.Random(seed)
    path = tmp_path / f"a{suffix}"
    write_photo(
        path, utc="2021:06:01 10:00:00", xmp=SENSEFLY.format(1, 2, 3) if suffix == ".jpg" else ""
    )
    data = bytearray(path.read_bytes())
    for _ in range(flips):
        data[chance.randrange(min(len(data), 700) if in_header else len(data))] ^= (
            1 << chance.randrange(8)
        )
    path.write_bytes(bytes(data[: max(1, int(keep * len(data)))]))
    try:
        source = open_photos(path)
    except InputError:
        return
    assert len(all_frames(source)) == 1


def test_an_album_of_nothing_readable_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_bytes(b"no")
    with pytest.raises(InputError, match="none of the 1 pictures can be read"):
        read_album([tmp_path / "a.jpg"])
