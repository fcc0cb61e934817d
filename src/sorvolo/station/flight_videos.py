"""The videos that flights were made of, where they are still below the root: shown, and looked into at a second."""

import json
import subprocess
import threading
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from anyio import CapacityLimiter, to_thread
from fastapi import APIRouter, Depends, Response
from fastapi.responses import FileResponse

from sorvolo.child_process import python_command
from sorvolo.station.collections import SiteCollections
from sorvolo.station.crops import CROP_M, CROP_PX, JpegResponse
from sorvolo.station.inputs import Inputs
from sorvolo.station.problems import Problem
from sorvolo.station.pyramid import BytesCache
from sorvolo.station.security import needs
from sorvolo.station.sites import SiteShelf
from sorvolo.station.tokens import Role
from sorvolo.store.site.archive import Archive

_WITHIN_S = 30.0  # a browser gives up later; by choice
_CACHE_BYTES = 32_000_000  # some hundred pictures; by choice
_CUTTING = threading.Semaphore(1)
_AT_ONCE = 3  # one is cut, others wait or are kept already; more would take threads from all other requests


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
    router = APIRouter(
        prefix="/api/sites/{site}", tags=["memory"], dependencies=[Depends(needs(Role.VIEW))]
    )
    cutting = CapacityLimiter(_AT_ONCE)
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
