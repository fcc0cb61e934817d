"""The NPU Drone-Map dataset's folder (the thesis's Table 4.1): high flights, and the mosaics of Bu et al. of them.

As published, a sequence is a folder: `SEQ-kfs` has key frames `rgb/TIME.jpg`, trajectory.txt (time, then x, y, z in
metres east, north and up of GPS.Origin, then a quaternion) and config.cfg; `SEQ-unified` has frames.txt (time, picture)
and gps.txt (time, longitude, latitude, altitude), both in seconds.
"""

import re
import shutil
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from PIL import Image
from PIL.ExifTags import GPS, IFD, Base

from sorvolo.errors import InputError
from sorvolo.geometry.arrays import Floats
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.geodesy import Geodetic, LocalFrame
from sorvolo.lab.datasets.text_files import read_text
from sorvolo.lab.simulation.flight_files import write_camera
from sorvolo.lab.thesis.umcd_folder import PICTURE_ENDINGS, UmcdVideo, videos_in
from sorvolo.store.atomic import atomic_write_bytes, writing

ENVIRONMENT = "NPU"
"""Of its videos, beside UMCD's environments."""

_KEYFRAMES, _FRAMES = "trajectory.txt", "frames.txt"
_EPOCH_S = 1_420_070_400.0  # 2015: its times count from anywhere


@dataclass(frozen=True)
class NpuSequence:
    """A sequence's video, or its folder as published, and the published mosaic of it; None where there is none."""

    video: UmcdVideo
    mosaic: Path | None


def read_npu_folder(place: Path) -> tuple[NpuSequence, ...]:
    """The sequences in a folder: as published, or a video each, in a folder of the sequence's name or under that name.

    The mosaic (GeoTIFF or picture) lies in the sequence's folder, or beside the video under its name. Raises InputError
    for a folder with neither.
    """
    if not place.is_dir():
        raise InputError(f"{place}: no such folder; give the folder of the NPU Drone-Map dataset")
    found = [
        NpuSequence(UmcdVideo(ENVIRONMENT, each.name, each), _mosaic(each, ""))
        for each in sorted({place, *place.iterdir()})
        if (each / _KEYFRAMES).is_file() or (each / _FRAMES).is_file()
    ]
    videos = videos_in(place)
    if not (videos or found):
        raise InputError(
            f"{place}: no videos; give the folder of the NPU Drone-Map dataset, with a folder of each sequence "
            f"({_KEYFRAMES} or {_FRAMES} in it) or a video of it"
        )
    in_folder = Counter(each.video.parent for each in videos)
    for each in videos:
        folder = each.video.parent
        is_alone = folder != place and in_folder[folder] == 1
        name = folder.name if is_alone else each.name
        video = replace(each, environment=ENVIRONMENT, name=name, has_telemetry=bool(each.texts))
        found.append(NpuSequence(video, _mosaic(folder, "" if is_alone else each.name)))
    return tuple(found)


def photos_of_sequence(folder: Path, to: Path) -> tuple[Path, Path | None]:
    """A published sequence as photos with their places, one a second (the thesis's 4.1.2), and its calibration.

    Raises InputError for files that are not of the published form.
    """
    with writing(to):
        shutil.rmtree(to, ignore_errors=True)
        (to / "photos").mkdir(parents=True)
    config = read_text(folder / "config.cfg") if (folder / "config.cfg").is_file() else ""
    rows = _keyframes(folder, config) if (folder / _KEYFRAMES).is_file() else _seconds(folder)
    last_s, count = -np.inf, 0
    for time_s, picture, lonlat_height, above_ground_m in rows:
        if time_s - last_s < 1.0 or not picture.is_file():
            continue
        last_s, count = time_s, count + 1
        tagged = _tagged(picture.read_bytes(), time_s, lonlat_height, above_ground_m)
        atomic_write_bytes(to / "photos" / f"{count:06d}.jpg", tagged, durable=False)
    if not count:
        raise InputError(f"{folder}: none of the pictures that its list names is there")
    return to / "photos", _camera(config, to / "camera.xml")


def _keyframes(folder: Path, config: str) -> Iterator[tuple[float, Path, Floats, float]]:
    origin, plane = _numbers(config, r"GPS\.Origin"), _numbers(config, "Plane")
    if len(origin) < 3:
        raise InputError(f"{folder}: config.cfg states no GPS.Origin (longitude latitude altitude)")
    frame = LocalFrame(Geodetic(origin[1], origin[0], origin[2]))
    ground_m = plane[2] if len(plane) >= 3 else 0.0
    for line in read_text(folder / _KEYFRAMES).splitlines():
        name, *rest = line.split() or [""]
        pose = [float(each) for each in rest if _is_number(each)]
        if not _is_number(name) or len(pose) < 3:
            continue
        latitude, longitude, height = frame.wgs84_from_site(np.array([pose[:3]]))
        place = np.array([longitude[0], latitude[0], height[0]])
        yield float(name), folder / "rgb" / f"{name}.jpg", place, pose[2] - ground_m


def _seconds(folder: Path) -> Iterator[tuple[float, Path, Floats, float]]:
    fixes = np.array(
        [
            [float(each) for each in line.split()[:4]]
            for line in read_text(folder / "gps.txt").splitlines()
            if len(line.split()) >= 4 and all(map(_is_number, line.split()[:4]))
        ]
    ).reshape(-1, 4)
    if len(fixes) < 2:
        raise InputError(f"{folder}: gps.txt has no fixes (time longitude latitude altitude)")
    for line in read_text(folder / _FRAMES).splitlines():
        words = line.split(maxsplit=1)
        if len(words) == 2 and _is_number(words[0]):
            time_s = float(words[0])
            place = np.array([np.interp(time_s, fixes[:, 0], fixes[:, each]) for each in (1, 2, 3)])
            yield time_s, folder / words[1].strip(), place, float("nan")


def _tagged(jpeg: bytes, time_s: float, lonlat_height: Floats, above_ground_m: float) -> bytes:
    """The very JPEG with its time and place in EXIF, and its height above ground, where known, in DJI's XMP."""
    moment = datetime.fromtimestamp(_EPOCH_S + time_s % 1e8, UTC)
    exif = Image.Exif()
    detail = exif.get_ifd(IFD.Exif)
    detail[Base.DateTimeOriginal] = moment.strftime("%Y:%m:%d %H:%M:%S")
    detail[Base.SubsecTimeOriginal] = f"{moment.microsecond // 1000:03d}"
    detail[Base.OffsetTimeOriginal] = "+00:00"
    longitude, latitude, height_m = lonlat_height.tolist()
    exif.get_ifd(IFD.GPSInfo).update(
        {
            GPS.GPSLatitudeRef: "N" if latitude >= 0 else "S",
            GPS.GPSLatitude: (abs(latitude) // 1, abs(latitude) % 1 * 60, 0.0),
            GPS.GPSLongitudeRef: "E" if longitude >= 0 else "W",
            GPS.GPSLongitude: (abs(longitude) // 1, abs(longitude) % 1 * 60, 0.0),
            GPS.GPSAltitudeRef: b"\x00" if height_m >= 0 else b"\x01",
            GPS.GPSAltitude: abs(height_m),
        }
    )
    segments = [exif.tobytes()]
    if np.isfinite(above_ground_m):
        segments.append(
            b"http://ns.adobe.com/xap/1.0/\0"
            b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
            b'<rdf:Description rdf:about="" xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" '
            b'drone-dji:RelativeAltitude="%+.3f"/></rdf:RDF></x:xmpmeta>' % above_ground_m
        )
    head = b"".join(b"\xff\xe1" + (len(each) + 2).to_bytes(2, "big") + each for each in segments)
    return jpeg[:2] + head + jpeg[2:]


def _camera(config: str, path: Path) -> Path | None:
    """OpenCV's calibration file of `Paraments` (width height fx fy cx cy k1 k2 p1 p2 k3); None without them."""
    numbers = _numbers(config, r"\S+\.Paraments")
    if len(numbers) < 6:
        return None
    width, height, fx, fy, cx, cy, *distortion = numbers
    k = np.array([*distortion, 0, 0, 0, 0, 0][:5], np.float64)
    write_camera(path, Camera(int(width), int(height), fx, fy, cx, cy, k))
    return path


def _numbers(config: str, key: str) -> list[float]:
    """The numbers of a line `key = [1 2 3]`; none where there is no such line."""
    match = re.search(rf"^\s*{key}\s*=\s*(.*)$", config, re.MULTILINE)
    return [] if match is None else [float(e) for e in re.findall(r"-?[\d.]+(?:e-?\d+)?", match[1])]


def _is_number(word: str) -> bool:
    return re.fullmatch(r"-?\d+(\.\d*)?(e[-+]?\d+)?", word, re.IGNORECASE) is not None


def _mosaic(folder: Path, start: str) -> Path | None:
    files = (
        path
        for path in sorted(folder.iterdir())
        if path.suffix.lower() in PICTURE_ENDINGS and path.is_file()
    )
    return next((path for path in files if path.stem.lower().startswith(start.lower())), None)
