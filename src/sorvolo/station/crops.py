"""Pictures around a place, cut from frames that sites kept and from the videos of flights."""

import json
import subprocess
import threading
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from anyio import CapacityLimiter, to_thread
from fastapi import APIRouter, Response
from fastapi.responses import FileResponse

from sorvolo.child_process import python_command
from sorvolo.geometry.arrays import ImageRGB, PointsM
from sorvolo.station.collections import Findings, SiteCollections
from sorvolo.station.inputs import Inputs
from sorvolo.station.problems import Problem
from sorvolo.station.security import FOR_VIEWERS
from sorvolo.station.sites import SiteShelf
from sorvolo.store.exports.change_files import CROPS, crop_name, crop_names
from sorvolo.store.images import BytesCache, jpeg_from_image, rgba_from_png
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.catalogue import StoredKeyframe

CROP_PX, CROP_M = 320, 10.0
"""How large a picture of a place is, and how much ground it shows."""

_KEPT = "private, max-age=86400"
_AT_ONCE = 2  # key frames decoded: a strip asks for dozens, and those that wait must not take threads from the rest


class JpegResponse(Response):
    """A picture as JPEG."""

    media_type = "image/jpeg"


def crop_routes(shelf: SiteShelf, findings: Findings) -> APIRouter:
    """Pictures by the id of what they show; never by a path."""
    cutting = CapacityLimiter(_AT_ONCE)
    router = APIRouter(prefix="/api/sites/{site}/crops", tags=["crops"], dependencies=FOR_VIEWERS)

    @router.get("/change/{change_id}/{n}.jpg", response_class=JpegResponse)
    def of_change(site: str, change_id: str, n: int) -> Response:
        """A change: 0 before, 1 after."""
        archive = shelf.open(site)
        found = next((each for each in archive.changes() if each.id == change_id), None)
        if found is None or n not in (0, 1):
            raise Problem(
                404, "no such picture: 0 is before and 1 after, of a change that the site has"
            )
        file = f"flights/{found.flight_id}/changes/{crop_names(found.id)[n]}"
        rgba = rgba_from_png(_read(archive, file), file)
        return _jpeg(np.where(rgba[..., 3:] > 0, rgba[..., :3], 127).astype(np.uint8))

    @router.get("/object/{object_id}/{n}.jpg", response_class=JpegResponse)
    def of_object(site: str, object_id: str, n: int) -> Response:
        """An object as its best frame shows it."""
        archive = shelf.open(site)
        found = next((each for each in archive.objects() if each.thing.id == object_id), None)
        if found is None or n != 0:
            raise Problem(404, "no such picture: 0 is the best one, of an object that the site has")
        data = _read(archive, f"flights/{found.flight_id}/{CROPS}/{crop_name(found.thing.id)}")
        return JpegResponse(data, headers={"cache-control": _KEPT})

    @router.get("/finding/{finding_id}/{n}.jpg", response_class=JpegResponse)
    def of_finding(site: str, finding_id: str, n: int) -> Response:
        """What a watch found, as its best frame shows it."""
        if n != 0:
            raise Problem(404, "no such picture: 0 is the best one")
        return JpegResponse(
            findings.crop(site, finding_id), headers={"cache-control": "private, no-cache"}
        )

    @router.get("/frame/{flight}/{index}/{east_mm}/{north_mm}.jpg", response_class=JpegResponse)
    async def of_frame(site: str, flight: str, index: int, east_mm: int, north_mm: int) -> Response:
        """The ground around a place (site millimetres), north up, cut from a key frame."""

        def made() -> Response:
            archive = shelf.open(site)
            place_m = np.array([east_mm, north_mm]) / 1000
            return _jpeg(cut(archive, keyframe(archive, flight, index), place_m))

        return await to_thread.run_sync(made, limiter=cutting)

    return router


def keyframe(archive: Archive, flight: str, index: int) -> StoredKeyframe:
    """A key frame by its flight and number. Raises Problem (404)."""
    found = [each for each in archive.keyframes(flight) if each.index == index]
    if not found:
        raise Problem(404, f"{flight[:80]!r} has no key frame {index}")
    return found[0]


def cut(archive: Archive, frame: StoredKeyframe, place_m: PointsM) -> ImageRGB:
    """(320, 320, 3) of 10 m of ground around a place, north up, as the key frame shows it; grey where it does not.

    Raises StoreError where its picture is gone.
    """
    m_per_px = CROP_M / CROP_PX
    site_from_crop = np.array(
        [
            [m_per_px, 0, place_m[0] - m_per_px * (CROP_PX - 1) / 2],
            [0, -m_per_px, place_m[1] + m_per_px * (CROP_PX - 1) / 2],
            [0, 0, 1],
        ]
    )
    image = archive.image(frame)
    image_from_crop = np.linalg.inv(frame.site_from_image) @ site_from_crop
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    cropped = cv2.warpPerspective(
        image, image_from_crop, (CROP_PX, CROP_PX), flags=flags, borderValue=(127,) * 3
    )
    return np.asarray(cropped, np.uint8)


def _read(archive: Archive, file: str) -> bytes:
    try:
        return archive.read_file(file)
    except FileNotFoundError as error:
        raise Problem(404, "this picture was not kept") from error


def _jpeg(image: ImageRGB) -> Response:
    return JpegResponse(jpeg_from_image(image), headers={"cache-control": _KEPT})


_WITHIN_S = 30.0  # a browser gives up later; by choice
_CACHE_BYTES = 32_000_000  # some hundred pictures; by choice
_CUTTING = threading.Semaphore(1)
_VIDEOS_AT_ONCE = 3  # one is cut, others wait or are kept already; more would take threads from all other requests


class FlightVideos:
    """Finds a flight's video among the inputs, by the name that its report keeps. Threads may share it."""

    def __init__(self, inputs: Inputs) -> None:
        self._inputs = inputs

    def find(self, archive: Archive, flight: str) -> Path | None:
        """The flight's video; None where it was no video, is gone, or two inputs have its name."""
        return self.of(archive, [flight]).get(flight)

    def of(self, archive: Archive, flights: Iterable[str]) -> dict[str, Path]:
        """The videos of these flights, of those that `find` would find."""
        paths: dict[str, list[Path]] = {}
        for path in self._inputs.videos():
            paths.setdefault(path.name, []).append(path)
        if not paths:
            return {}
        known, found = {each.id for each in archive.flights()}, {}
        for flight in known.intersection(flights):
            names = archive.report(flight).get("inputs")
            named = (
                paths.get(str(names[0]), []) if isinstance(names, list) and len(names) == 1 else []
            )
            if len(named) == 1:
                found[flight] = named[0]
        return found


def video_routes(shelf: SiteShelf, collections: SiteCollections, videos: FlightVideos) -> APIRouter:
    """A flight's video, and pictures of a place cut from it."""
    router = APIRouter(prefix="/api/sites/{site}", tags=["memory"], dependencies=FOR_VIEWERS)
    cutting = CapacityLimiter(_VIDEOS_AT_ONCE)
    cache = BytesCache[tuple[Any, ...], bytes](_CACHE_BYTES, len)

    @router.get("/flights/{flight}/video", response_class=FileResponse)
    def video(site: str, flight: str) -> Response:
        """The video that the flight was made of, as it is; ranges are answered, so that a browser can jump."""
        return FileResponse(
            _demanded(shelf.open(site), flight, videos), headers={"cache-control": "private"}
        )

    @router.get(
        "/crops/video/{flight}/{frame}/{east_mm}/{north_mm}.jpg", response_class=JpegResponse
    )
    async def crop(site: str, flight: str, frame: int, east_mm: int, north_mm: int) -> Response:
        """The ground around a place (site millimetres), north up, from a frame of the flight's video."""

        def made() -> Response:
            archive = shelf.open(site)
            path = _demanded(archive, flight, videos)
            feature = next(
                (
                    each
                    for each in collections.get(site, "frames").features
                    if each["id"] == f"{flight}:{frame}"
                ),
                None,
            )
            if feature is None:
                raise Problem(404, f"{flight[:80]!r} has no frame {frame}")
            ring = archive.site().frame.ground_from_lonlat(
                feature["geometry"]["coordinates"][0][:4]
            )
            place_m = np.array([east_mm, north_mm]) / 1000
            key = (str(path), path.stat().st_mtime_ns, frame, east_mm, north_mm)
            data = cache.get(key, lambda: _cut(path, frame, _crop_corners(ring, place_m)))
            return JpegResponse(data, headers={"cache-control": "private, max-age=86400"})

        return await to_thread.run_sync(made, limiter=cutting)

    return router


def _demanded(archive: Archive, flight: str, videos: FlightVideos) -> Path:
    path = videos.find(archive, flight)
    if path is None:
        raise Problem(
            404,
            f"the video of {flight[:80]!r} is no longer below the station's folder, or there was none",
        )
    return path


def _crop_corners(ring_m: Any, place_m: Any) -> Sequence[Sequence[float]]:
    """(4, 2) where the corners of a crop lie in the picture, as shares of its width and height.

    `ring_m` (4, 2) are the picture's own corners on the ground.
    """
    unit = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    picture_from_site = cv2.getPerspectiveTransform(
        (np.asarray(ring_m) - place_m).astype(np.float32), unit
    )
    half = CROP_M / 2
    corners = (
        np.array([[-half, half, 1], [half, half, 1], [half, -half, 1], [-half, -half, 1]])
        @ picture_from_site.T
    )
    shares: list[list[float]] = (corners[:, :2] / corners[:, 2:]).tolist()
    return shares


def _cut(path: Path, frame: int, corners: Sequence[Sequence[float]]) -> bytes:
    """A JPEG of a piece of a video's frame, decoded in a process of its own. Raises Problem (404)."""
    order = json.dumps({"path": str(path), "frame": frame, "corners": corners, "side_px": CROP_PX})
    with _CUTTING:
        try:
            done = subprocess.run(
                python_command("sorvolo.station.cut_video"),
                input=order.encode(),
                capture_output=True,
                timeout=_WITHIN_S,
                check=False,
            )
        except subprocess.TimeoutExpired as error:
            raise Problem(404, "this frame took too long to decode") from error
    if done.returncode or not done.stdout.startswith(b"\xff\xd8"):
        raise Problem(404, "this frame could not be decoded")
    return done.stdout
