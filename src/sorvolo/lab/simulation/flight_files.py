"""Flights as files that drones leave behind: video, photos, telemetry, camera and truth; the same bytes each time."""

import io
import json
import os
import platform
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from fractions import Fraction
from importlib.metadata import version
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import rasterio
from PIL import Image
from PIL.ExifTags import GPS, IFD, Base
from PIL.TiffImagePlugin import IFDRational

from sorvolo import __version__
from sorvolo.errors import InputError, SettingsError
from sorvolo.geometry.arrays import ImageGray, ImageRGB
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.units import KNOT_M_S
from sorvolo.paths import Json, JsonView
from sorvolo.store.atomic import atomic_path, atomic_write_bytes, writing
from sorvolo.store.rasters.geotiff import open_raster
from sorvolo.survey.flight import Frame, Telemetry

UMCD_COLUMNS = [
    "Tick#",
    "offsetTime",
    "flightTime(msec)",
    "Longitude",
    "Latitude",
    "numSats",
    "gpsAltitude(meters)",
    "baroAlt(meters)",
    "vpsHeight(M)",
    "relativeHeight",
    "accelX(M/S2)",
    "accelY(M/S2)",
    "accelZ(M/S2)",
    "gyroX(degrees/s)",
    "gyroY(degrees/s)",
    "gyroZ(degrees/s)",
    "magX",
    "magY",
    "magZ",
    "magMod",
    "velN(M/S)",
    "velE(M/S)",
    "velD(M/S)",
    "vel(M/S)",
    "quatW",
    "quatX",
    "quatY",
    "quatZ",
    "Roll",
    "Pitch",
    "Yaw",
    "errorX",
    "errorY",
    "errorZ",
    "error",
    "accel(M/S2)",
    "gyro(degrees/s)",
    "distancHP(M)",
    "distanceTravelled(M)",
    "directionOfTravel",
    "IMUTemp(C)",
    "batteryTemp(C)",
    "ratedCapacity",
    "remaingCapacity",
    "batteryCycleCount",
    "batteryLifePercentage",
    "Gimbal:roll",
    "Gimbal:pitch",
    "Gimbal:yaw",
    "Gimbal:Xroll",
    "Gimbal:Xpitch",
    "Gimbal:Yyaw",
    "MotorSpeed:RFront",
    "MotorSpeed:LFront",
    "MotorSpeed:LBack",
    "MotorSpeed:RBack",
    "MotorLoad:RFront",
    "MotorLoad:LFront",
    "MotorLoad:LBack",
    "MotorLoad:RBack",
]
"""The sixty columns of the thesis's Table 2.2, spelled as there."""

# acceleration, rotation, magnetometer
_UMCD_IDLE_INSTRUMENTS = (
    "0.0",
    "0.0",
    "-9.81",
    *["0.0"] * 3,
    *["0"] * 4,
)
# errors, size of the acceleration and of the rotation
_UMCD_IDLE_ERRORS = (
    *["0.0"] * 4,
    "9.81",
    "0.0",
)
_UMCD_MOTORS = (*["5200"] * 4, *["38"] * 4)  # speed and load of the four motors
_MOST_GROUND_PX = 500_000_000  # of an orthophoto to simulate over: its colours take 1.5 GB then
_GPX = "http://www.topografix.com/GPX/1/1"
_DJI = "http://www.dji.com/drone-dji/1.0/"
_SENSOR_WIDTH_MM = 6.3  # what a small drone's 1/2.3 inch sensor measures


@contextmanager
def video_writer(
    path: Path, size_px: tuple[int, int], fps: float, started_ns: int, crf: int
) -> Iterator[Callable[[ImageRGB], None]]:
    """Write H.264 in MP4 image by image, so that the same images give the same bytes: with one thread, and without
    x264's weighted prediction and macroblock tree, whose look-ahead reads memory that it never wrote.

    Frame i has exactly the time i / fps. The start is the file's creation time, as drones write it. Raises
    StoreError when the disk is full or the folder cannot be written.
    """
    rate = Fraction(fps).limit_denominator(1001)
    with (
        atomic_path(path, durable=False) as temporary,
        av.open(
            str(temporary),
            "w",
            format="mp4",
            container_options={"fflags": "+bitexact", "movflags": "+faststart"},
        ) as container,
    ):
        container.metadata["creation_time"] = _moment(started_ns).strftime("%Y-%m-%dT%H:%M:%S.%fZ")
        stream = container.add_stream("libx264", rate=rate)
        stream.width, stream.height, stream.pix_fmt = *size_px, "yuv420p"
        stream.codec_context.thread_count = 1
        stream.codec_context.time_base = 1 / rate
        stream.options = {
            "crf": str(crf),
            "preset": "veryfast",
            "threads": "1",
            "weightp": "none",
            "mbtree": "0",
            "flags": "+bitexact",
        }
        count = 0

        def write(image: ImageRGB) -> None:
            nonlocal count
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            frame.pts, frame.time_base = count, 1 / rate
            container.mux(stream.encode(frame))
            count += 1

        yield write
        container.mux(stream.encode())


def write_photo(path: Path, frame: Frame, camera: Camera, row: Mapping[str, float]) -> None:
    """Write a JPEG with telemetry's row in EXIF GPS and DJI's XMP; an empty row writes
    neither.

    EXIF holds the focal length as a length and as its 35 mm equivalent, rounded as cameras do. Raises
    StoreError as `video_writer`.
    """
    moment = _moment(frame.time_ns)
    exif = Image.Exif()
    exif[Base.Make], exif[Base.Model] = "Sorvolo", "Simulated"
    exif[Base.DateTime] = moment.strftime("%Y:%m:%d %H:%M:%S")
    detail = exif.get_ifd(IFD.Exif)
    detail[Base.DateTimeOriginal] = exif[Base.DateTime]
    detail[Base.SubsecTimeOriginal] = f"{moment.microsecond // 1000:03d}"
    detail[Base.OffsetTimeOriginal] = "+00:00"
    detail[Base.FocalLength] = IFDRational(
        round(camera.fx_px / camera.width_px * _SENSOR_WIDTH_MM * 1000), 1000
    )
    detail[Base.FocalLengthIn35mmFilm] = round(camera.fx_px / camera.width_px * 36)
    detail[Base.ExifImageWidth], detail[Base.ExifImageHeight] = camera.width_px, camera.height_px
    xmp = b""
    if row:
        # EXIF's GPS directory
        exif.get_ifd(IFD.GPSInfo).update(
            {
                GPS.GPSLatitudeRef: "N" if row["latitude_deg"] >= 0 else "S",
                GPS.GPSLatitude: _degrees_minutes_seconds(row["latitude_deg"]),
                GPS.GPSLongitudeRef: "E" if row["longitude_deg"] >= 0 else "W",
                GPS.GPSLongitude: _degrees_minutes_seconds(row["longitude_deg"]),
                GPS.GPSAltitudeRef: b"\x00" if row["orthometric_height_m"] >= 0 else b"\x01",
                GPS.GPSAltitude: IFDRational(round(abs(row["orthometric_height_m"]) * 1000), 1000),
                GPS.GPSDateStamp: moment.strftime("%Y:%m:%d"),
                GPS.GPSTimeStamp: (
                    IFDRational(moment.hour, 1),
                    IFDRational(moment.minute, 1),
                    IFDRational(moment.second * 1000 + moment.microsecond // 1000, 1000),
                ),
            }
        )
        values = {
            "UTCAtExposure": f"{moment:%Y-%m-%dT%H:%M:%S}.{moment.microsecond:06d}",
            "GpsLatitude": f"{row['latitude_deg']:.9f}",
            "GpsLongitude": f"{row['longitude_deg']:.9f}",
            "AbsoluteAltitude": f"{row['orthometric_height_m']:+.3f}",
            "RelativeAltitude": f"{row['height_above_takeoff_m']:+.3f}",
            "GimbalYawDegree": f"{(row['camera_yaw_deg'] + 180) % 360 - 180:+.3f}",
            "GimbalPitchDegree": f"{row['camera_pitch_deg']:+.3f}",
            "GimbalRollDegree": f"{row['camera_roll_deg']:+.3f}",
        }
        attributes = " ".join(f'drone-dji:{name}="{value}"' for name, value in values.items())
        xmp = (
            '<?xpacket begin="" id="W5M0MpCehiHzreSzNTczkc9d"?><x:xmpmeta xmlns:x="adobe:ns:meta/">'
            '<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
            f'<rdf:Description rdf:about="" xmlns:drone-dji="{_DJI}" {attributes}/>'
            '</rdf:RDF></x:xmpmeta><?xpacket end="w"?>'
        ).encode()
    buffer = io.BytesIO()
    Image.fromarray(frame.image).save(buffer, "JPEG", quality=93, subsampling=0, exif=exif, xmp=xmp)
    atomic_write_bytes(path, buffer.getvalue(), durable=False)


def write_telemetry(
    path: Path, telemetry: Telemetry, corrupt: Set[int] = frozenset(), geoid_height_m: float = 0.0
) -> None:
    """Write the samples in the format that `telemetry.format` names: csv, srt, srt-gps, nmea or gpx.

    `corrupt` are NMEA samples whose checksum is to be wrong. Raises StoreError as `video_writer`.
    """
    writers = {"csv": _umcd, "srt": _srt, "srt-gps": _srt_gps, "gpx": _gpx}
    if telemetry.format == "nmea":
        text = _nmea(telemetry, corrupt, geoid_height_m)
    else:
        text = writers[telemetry.format](telemetry)
    atomic_write_bytes(path, text.encode(), durable=False)


def write_camera(path: Path, camera: Camera) -> None:
    """Write the camera as OpenCV's XML, the distortion in OpenCV's order, which is named beside it."""
    k = " ".join(repr(float(number)) for number in camera.distortion)
    matrix = " ".join(repr(float(number)) for number in camera.matrix.ravel())
    atomic_write_bytes(
        path,
        f"""<?xml version="1.0"?>
<opencv_storage>
<image_width>{camera.width_px}</image_width>
<image_height>{camera.height_px}</image_height>
<camera_matrix type_id="opencv-matrix">
  <rows>3</rows>
  <cols>3</cols>
  <dt>d</dt>
  <data>{matrix}</data>
</camera_matrix>
<distortion_coefficients type_id="opencv-matrix">
  <rows>1</rows>
  <cols>5</cols>
  <dt>d</dt>
  <data>{k}</data>
</distortion_coefficients>
<distortion_order>"k1 k2 p1 p2 k3"</distortion_order>
</opencv_storage>
""".encode(),
        durable=False,
    )


def write_json(path: Path, value: Any) -> None:
    """Write JSON, or GeoJSON, compactly and in a fixed order."""
    atomic_write_bytes(
        path, (json.dumps(value, separators=(",", ":")) + "\n").encode(), durable=False
    )


def write_mask(path: Path, mask: ImageGray) -> None:
    """Write a 0/255 mask as PNG."""
    _, data = cv2.imencode(".png", mask)
    atomic_write_bytes(path, data.tobytes(), durable=False)


def read_orthophoto(path: Path, m_per_px: float | None = None) -> tuple[ImageRGB, float]:
    """An orthophoto's colours and its metres per pixel: its own where it has a metric CRS, else `m_per_px`.

    Raises InputError for no picture of three 8-bit bands, one too large, and one whose pixel size is not known.
    """
    try:
        with open_raster(path, "an orthophoto", ("GTiff", "PNG", "JPEG")) as source:
            if source.count < 3 or source.dtypes[0] != "uint8":
                raise InputError(
                    f"{path}: {source.count} band(s) of {source.dtypes[0]}; an orthophoto needs red, green"
                    " and blue in 8 bits each"
                )
            own = (
                abs(source.transform.a)
                if source.crs is not None and source.crs.is_projected
                else None
            )
            size_m = m_per_px or own
            if not size_m:
                raise InputError(
                    f"{path}: has no metric coordinate system; give its pixel size with --ground-gsd"
                )
            if source.width * source.height > _MOST_GROUND_PX:
                raise InputError(
                    f"{path}: {source.width} x {source.height} pixels; at most {_MOST_GROUND_PX / 1e6:.0f} million are "
                    "simulated over: cut out the part to fly over (gdal_translate -srcwin)"
                )
            return np.ascontiguousarray(np.moveaxis(source.read([1, 2, 3]), 0, -1)), float(size_m)
    except rasterio.errors.RasterioIOError as error:
        raise InputError(
            f"{path}: cannot be read as a picture: {error}; give a GeoTIFF, PNG or JPEG"
        ) from error


def _moment(time_ns: int) -> datetime:
    return datetime(1970, 1, 1, tzinfo=UTC) + timedelta(microseconds=time_ns // 1000)


def _umcd(telemetry: Telemetry) -> str:
    """Table 2.2's columns, those that no simulated instrument measures at their idle values."""
    rows: list[Sequence[object]] = [UMCD_COLUMNS]
    times_s = (telemetry.time_ns - telemetry.time_ns[:1]) / 1e9
    speed = telemetry["speed_m_s"]
    travelled_m = (
        np.concatenate([[0.0], np.cumsum(speed[1:] * np.diff(times_s))])
        if len(times_s)
        else times_s
    )
    for i, time_s in enumerate(times_s):
        row = {name: float(column[i]) for name, column in telemetry.columns.items()}
        # Columns `Tick#` to `relativeHeight`: time since the first row, place, satellites, heights
        height = f"{row['orthometric_height_m']:.3f}"
        umcd_place = [
            round(time_s * 600),
            f"{time_s:.3f}",
            round(time_s * 1000),
            f"{row['longitude_deg']:.10f}",
            f"{row['latitude_deg']:.10f}",
            14,
            height,
            height,
            "0.0",
            f"{row['height_above_takeoff_m']:.3f}",
        ]
        # Columns `velN(M/S)` to `vel(M/S)`
        course_rad, speed_m_s = np.radians(row["course_deg"]), row["speed_m_s"]
        north_m_s, east_m_s = speed_m_s * np.cos(course_rad), speed_m_s * np.sin(course_rad)
        umcd_velocity = [f"{north_m_s:.3f}", f"{east_m_s:.3f}", "0.0", f"{speed_m_s:.3f}"]
        # Columns `quatW` to `Yaw`
        yaw, pitch, roll = (row[f"body_{axis}_deg"] for axis in ("yaw", "pitch", "roll"))
        umcd_attitude = [
            *(f"{q:.6f}" for q in _quaternion(yaw, pitch, roll)),
            *(f"{angle:.3f}" for angle in (roll, pitch, yaw)),
        ]
        # Columns `IMUTemp(C)` to `batteryLifePercentage`: the charge falls with the flight's time
        rows.append(
            [
                *umcd_place,
                *_UMCD_IDLE_INSTRUMENTS,
                *umcd_velocity,
                *umcd_attitude,
                *_UMCD_IDLE_ERRORS,
                *[f"{travelled_m[i]:.2f}"] * 2,
                f"{row['course_deg']:.2f}",
                "42.0",
                "31.0",
                "4480",
                f"{4480 - time_s:.0f}",
                "12",
                f"{max(5.0, 98 - time_s / 12):.0f}",
                *[f"{row[f'camera_{axis}_deg']:.4f}" for axis in ("roll", "pitch", "yaw")] * 2,
                *_UMCD_MOTORS,
            ]
        )
    return "".join(",".join(map(str, row)) + "\n" for row in rows)


def _quaternion(
    yaw_deg: float, pitch_deg: float, roll_deg: float
) -> tuple[float, float, float, float]:
    """w, x, y, z of the body's attitude (z-y-x)."""
    (cy, cp, cr), (sy, sp, sr) = (
        f(np.radians([yaw_deg, pitch_deg, roll_deg]) / 2) for f in (np.cos, np.sin)
    )
    return (
        float(cr * cp * cy + sr * sp * sy),
        float(sr * cp * cy - cr * sp * sy),
        float(cr * sp * cy + sr * cp * sy),
        float(cr * cp * sy - sr * sp * cy),
    )


def _srt_times(telemetry: Telemetry) -> list[tuple[str, str]]:
    starts_ms = np.round(telemetry.video_time_ns / 1e6).astype(int)
    step_ms = int(np.median(np.diff(starts_ms))) if len(starts_ms) > 1 else 1000
    ends_ms = np.append(
        np.minimum(starts_ms[1:], starts_ms[:-1] + step_ms), starts_ms[-1:] + step_ms
    )
    return [(_srt_time(int(start)), _srt_time(int(end))) for start, end in zip(starts_ms, ends_ms)]


def _srt_time(time_ms: int) -> str:
    seconds, ms = divmod(max(0, time_ms), 1000)
    return f"{seconds // 3600:02d}:{seconds // 60 % 60:02d}:{seconds % 60:02d},{ms:03d}"


def _srt(telemetry: Telemetry) -> str:
    """DJI's subtitles of today: `[name: value]` pairs."""
    blocks = []
    for i, (start, end) in enumerate(_srt_times(telemetry)):
        moment = _moment(int(telemetry.time_ns[i]))
        yaw = (telemetry["camera_yaw_deg"][i] + 180) % 360 - 180  # DJI counts from -180 to 180
        blocks.append(
            f"{i + 1}\n{start} --> {end}\n"
            f'<font size="28">FrameCnt: {i + 1}, DiffTime: 40ms\n'
            f"{moment:%Y-%m-%d %H:%M:%S}.{moment.microsecond // 1000:03d}\n"
            "[iso: 100] [shutter: 1/1000.0] [fnum: 2.8] [ev: 0] [color_md: default] [focal_len: 24.00] "
            f"[latitude: {telemetry['latitude_deg'][i]:.7f}] "
            f"[longitude: {telemetry['longitude_deg'][i]:.7f}] "
            f"[rel_alt: {telemetry['height_above_takeoff_m'][i]:.3f} "
            f"abs_alt: {telemetry['orthometric_height_m'][i]:.3f}] "
            f"[gb_yaw: {yaw:.3f} gb_pitch: {telemetry['camera_pitch_deg'][i]:.3f} "
            f"gb_roll: {telemetry['camera_roll_deg'][i]:.3f}] </font>\n"
        )
    return "\n".join(blocks)


def _srt_gps(telemetry: Telemetry) -> str:
    """DJI's older subtitles: GPS(longitude, latitude, satellites) and the barometer's height above take-off."""
    blocks = []
    for i, (start, end) in enumerate(_srt_times(telemetry)):
        moment = _moment(int(telemetry.time_ns[i]))
        latitude, longitude = telemetry["latitude_deg"][i], telemetry["longitude_deg"][i]
        home = f"HOME({telemetry['longitude_deg'][0]:.6f},{telemetry['latitude_deg'][0]:.6f})"
        blocks.append(
            f"{i + 1}\n{start} --> {end}\n"
            f"{home} {moment:%Y.%m.%d %H:%M:%S}\n"
            f"GPS({longitude:.6f},{latitude:.6f},14) BAROMETER:{telemetry['height_above_takeoff_m'][i]:.1f}\n"
            "ISO:100 Shutter:1000 EV: Fnum:F2.8\n"
        )
    return "\n".join(blocks)


def _nmea(telemetry: Telemetry, corrupt: Set[int], geoid_height_m: float) -> str:
    """GGA and RMC of every sample."""
    lines = []
    for i, time_ns in enumerate(telemetry.time_ns):
        moment = _moment(int(time_ns))
        latitude, longitude = telemetry["latitude_deg"][i], telemetry["longitude_deg"][i]
        clock = f"{moment:%H%M%S}.{moment.microsecond // 10000:02d}"
        place = (
            f"{_degrees_minutes(latitude, 2)},{'N' if latitude >= 0 else 'S'},"
            f"{_degrees_minutes(longitude, 3)},{'E' if longitude >= 0 else 'W'}"
        )
        height_m = telemetry["orthometric_height_m"][i]
        knots = telemetry["speed_m_s"][i] / KNOT_M_S
        for body in (
            f"GPGGA,{clock},{place},1,12,0.8,{height_m:.3f},M,{geoid_height_m:.1f},M,,",
            f"GPRMC,{clock},A,{place},{knots:.3f},{telemetry['course_deg'][i]:.2f},{moment:%d%m%y},,,A",
        ):
            checksum = 0
            for byte in body.encode():
                checksum ^= byte
            lines.append(f"${body}*{checksum ^ 0x55 if i in corrupt else checksum:02X}\r\n")
    return "".join(lines)


def _degrees_minutes(angle_deg: float, digits: int) -> str:
    ten_millionths = round(abs(float(angle_deg)) * 60 * 10**7)
    degrees, rest = divmod(ten_millionths, 60 * 10**7)
    return f"{degrees:0{digits}d}{rest // 10**7:02d}.{rest % 10**7:07d}"


def _gpx(telemetry: Telemetry) -> str:
    points = "".join(
        f'<trkpt lat="{telemetry["latitude_deg"][i]:.9f}" lon="{telemetry["longitude_deg"][i]:.9f}">'
        f"<ele>{telemetry['orthometric_height_m'][i]:.3f}</ele>"
        f"<time>{_moment(int(time_ns)).isoformat(timespec='milliseconds')[:-6]}Z</time></trkpt>\n"
        for i, time_ns in enumerate(telemetry.time_ns)
    )
    return (
        f'<?xml version="1.0" encoding="UTF-8"?>\n<gpx version="1.1" creator="Sorvolo" xmlns="{_GPX}">\n'
        f"<trk><trkseg>\n{points}</trkseg></trk>\n</gpx>\n"
    )


def _degrees_minutes_seconds(angle_deg: float) -> tuple[IFDRational, IFDRational, IFDRational]:
    millionths = round(abs(angle_deg) * 3600 * 10**6)
    degrees, rest = divmod(millionths, 3600 * 10**6)
    minutes, seconds = divmod(rest, 60 * 10**6)
    return IFDRational(degrees, 1), IFDRational(minutes, 1), IFDRational(seconds, 10**6)


MARK = "simulation.json"
"""The file that marks a folder that holds simulated flights, and may be replaced by another simulation."""

PICTURES_MARK = "boxes.json"
"""The same of simulated pictures: their COCO file, so that it is the one JSON file of its folder."""

_MADE_BY = "sorvolo simulate"


@contextmanager
def simulation_folder(folder: Path, mark: str, description: JsonView) -> Iterator[Path]:
    """A hidden folder beside `folder`, holding the file `mark` with the description; renamed when the block ends well.

    Raises SettingsError for a folder that holds anything but an earlier simulation, StoreError for a full disk.
    """
    folder = folder.resolve()
    if folder.exists() and not folder.is_dir():
        raise SettingsError(f"{folder} is a file; choose a folder for the simulation")
    if folder.is_dir() and any(folder.iterdir()) and not _is_ours(folder):
        raise SettingsError(
            f"{folder} is not empty and holds no earlier simulation; choose another folder, or empty it"
        )
    partial = folder.with_name(f".{folder.name}.partial")
    with writing(folder):
        _remove_ours(partial)
        partial.mkdir(parents=True)
    write_json(partial / mark, description)
    yield partial
    # Rename the finished folder to its place; an earlier simulation steps aside first and goes last
    old = folder.with_name(f".{folder.name}.old")
    with writing(folder):
        _remove_ours(old)
        if folder.exists():
            os.replace(folder, old)
        os.replace(partial, folder)
        shutil.rmtree(old, ignore_errors=True)


def simulation_description(settings: JsonView) -> Json:
    """What made the simulation: settings, seed and versions, by which it can be made again."""
    return {
        "made_by": _MADE_BY,
        "versions": {
            "sorvolo": __version__,
            "python": platform.python_version(),
            "numpy": version("numpy"),
            "opencv": version("opencv-contrib-python-headless"),
            "av": version("av"),
        },
        "settings": settings,
    }


def _is_ours(folder: Path) -> bool:
    return any(
        f'"made_by":"{_MADE_BY}"' in _start_of(folder / mark) for mark in (MARK, PICTURES_MARK)
    )


def _start_of(path: Path) -> str:
    try:
        with path.open("rb") as file:
            return file.read(4096).decode("utf-8", "replace")
    except OSError:
        return ""


def _remove_ours(folder: Path) -> None:
    """Delete what a killed simulation left; it wrote its mark first."""
    if folder.is_dir() and (_is_ours(folder) or not any(folder.iterdir())):
        shutil.rmtree(folder)
