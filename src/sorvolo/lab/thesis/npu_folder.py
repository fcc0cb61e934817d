"""The NPU Drone-Map dataset's folder (the thesis's Table 4.1): high flights, and the mosaics of Bu et al. of them.

As published, a sequence is a folder: `SEQ-kfs` has key frames `rgb/TIME.jpg`, trajectory.txt (time, then x, y, z in
metres east, north and up of GPS.Origin, then a quaternion) and config.cfg; `SEQ-unified` has frames.txt (time, picture)
and gps.txt (time, longitude, latitude, altitude), both in seconds.
"""

import re
import shutil
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TypeAlias

import numpy as np

from sorvolo.errors import InputError
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.geodesy import Geodetic, LocalFrame
from sorvolo.lab.datasets.parsed import read_text
from sorvolo.lab.simulation.flight_files import write_camera
from sorvolo.lab.thesis.umcd_folder import PICTURE_ENDINGS, UmcdVideo, videos_in
from sorvolo.store.atomic import atomic_write_bytes, writing

ENVIRONMENT = "NPU"
"""Of its videos, beside UMCD's environments."""

_KEYFRAMES, _FRAMES = "trajectory.txt", "frames.txt"


def read_npu_folder(place: Path) -> dict[UmcdVideo, Path | None]:
    """The sequences in a folder, with the published mosaic of each where there is one: as published, or a video each, in a folder of the sequence's name or under that name.

    The mosaic (GeoTIFF or picture) lies in the sequence's folder, or beside the video under its name. Raises InputError
    for a folder with neither.
    """
    if not place.is_dir():
        raise InputError(f"{place}: no such folder; give the folder of the NPU Drone-Map dataset")
    found = {
        UmcdVideo(ENVIRONMENT, each.name, each): _mosaic(each, "")
        for each in sorted({place, *place.iterdir()})
        if (each / _KEYFRAMES).is_file() or (each / _FRAMES).is_file()
    }
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
        found[video] = _mosaic(folder, "" if is_alone else each.name)
    return found


def photos_of_sequence(folder: Path, to: Path) -> tuple[Path, Path | None]:
    """A published sequence as photos with their places (geo.txt), one a second (the thesis's 4.1.2), and its
    calibration.

    Raises InputError for files that are not of the published form.
    """
    photos = to / "photos"
    with writing(to):
        shutil.rmtree(to, ignore_errors=True)
        photos.mkdir(parents=True)
    config = read_text(folder / "config.cfg") if (folder / "config.cfg").is_file() else ""
    rows = _keyframes(folder, config) if (folder / _KEYFRAMES).is_file() else _seconds(folder)
    geo, last_s = ["EPSG:4326"], -np.inf
    for time_s, picture, (longitude_deg, latitude_deg, height_m) in rows:
        if time_s - last_s >= 1.0 and picture.is_file():
            last_s, name = time_s, f"{len(geo):06d}{picture.suffix}"
            with writing(to):
                shutil.copyfile(picture, photos / name)
            geo.append(f"{name} {longitude_deg:.9f} {latitude_deg:.9f} {height_m:.3f}")
    if len(geo) == 1:
        raise InputError(f"{folder}: none of the pictures that its list names is there")
    atomic_write_bytes(photos / "geo.txt", "\n".join(geo).encode())
    return photos, _camera(config, to / "camera.xml")


_Row: TypeAlias = tuple[float, Path, tuple[float, float, float]]
"""A picture's time, s, its file, and its longitude, latitude and height."""


def _keyframes(folder: Path, config: str) -> Iterator[_Row]:
    origin = _numbers(config, r"GPS\.Origin")
    if len(origin) < 3:
        raise InputError(f"{folder}: config.cfg states no GPS.Origin (longitude latitude altitude)")
    frame = LocalFrame(Geodetic(origin[1], origin[0], origin[2]))
    for name, place_m in _table(folder / _KEYFRAMES, numbers=3):
        latitude, longitude, height = (
            float(e[0]) for e in frame.wgs84_from_site(np.array([place_m]))
        )
        yield float(name), folder / "rgb" / f"{name}.jpg", (longitude, latitude, height)


def _seconds(folder: Path) -> Iterator[_Row]:
    fixes = np.array(
        [[float(time), *place] for time, place in _table(folder / "gps.txt", numbers=3)]
    )
    if len(fixes) < 2:
        raise InputError(f"{folder}: gps.txt has no fixes (time longitude latitude altitude)")
    for line in read_text(folder / _FRAMES).splitlines():
        time, _, picture = line.strip().partition(" ")
        if _is_number(time):
            x, y, z = (float(np.interp(float(time), fixes[:, 0], each)) for each in fixes[:, 1:].T)
            yield float(time), folder / picture.strip(), (x, y, z)


def _table(path: Path, numbers: int) -> Iterator[tuple[str, list[float]]]:
    """The rows of a text file that begin with a time, as written, and so many numbers."""
    for line in read_text(path).splitlines():
        words = line.split()[: numbers + 1]
        if len(words) > numbers and all(map(_is_number, words)):
            yield words[0], [float(each) for each in words[1:]]


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
        each
        for each in sorted(folder.iterdir())
        if each.suffix.lower() in PICTURE_ENDINGS and each.stem.lower().startswith(start.lower())
    )
    return next(files, None)
