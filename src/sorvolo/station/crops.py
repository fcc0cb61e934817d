"""Pictures of objects and changes that missions stored, and of any place, cut on demand from key frames."""

import cv2
import numpy as np
from anyio import CapacityLimiter, to_thread
from fastapi import APIRouter, Depends, Response

from sorvolo.geometry.arrays import ImageRGB, PointsM
from sorvolo.station.problems import Problem
from sorvolo.station.security import needs
from sorvolo.station.sites import SiteShelf
from sorvolo.station.tokens import Role
from sorvolo.station.watch_findings import Findings
from sorvolo.store.exports.change_files import crop_names
from sorvolo.store.exports.object_files import CROPS, crop_name
from sorvolo.store.images import jpeg_from_image, rgba_from_png
from sorvolo.store.nofollow import read_below
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
    router = APIRouter(
        prefix="/api/sites/{site}/crops", tags=["crops"], dependencies=[Depends(needs(Role.VIEW))]
    )

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
        return read_below(archive.folder, file)
    except FileNotFoundError as error:
        raise Problem(404, "this picture was not kept") from error


def _jpeg(image: ImageRGB) -> Response:
    return JpegResponse(jpeg_from_image(image), headers={"cache-control": _KEPT})
