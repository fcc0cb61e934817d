"""Small made-up sites and flights for the store's tests; also run as a program that is killed at random moments."""

import sys
from pathlib import Path

import numpy as np

from sorvolo.geometry.camera import Camera
from sorvolo.geometry.geodesy import Geodetic, utm_epsg
from sorvolo.geometry.ground import footprint
from sorvolo.geometry.homography import site_from_image_homography
from sorvolo.geometry.pose import Pose, site_from_gimbal_rotation
from sorvolo.store.archive import Archive
from sorvolo.survey.flight import Site
from sorvolo.survey.mosaic import PlacedFrame, Status

ORIGIN = Geodetic(46.5, 13.25, 310.0)
SITE = Site("field", ORIGIN, f"EPSG:{utm_epsg(46.5, 13.25)}", 0.05, height_reference="ellipsoidal")
LOCAL_SITE = Site("pond", Geodetic(0.0, 0.0), "", 1.0, is_local=True)
CAMERA = Camera(96, 54, 80.0, 80.0, 47.5, 26.5, np.array([-0.1, 0.02, 0.0, 0.0, 0.0]))


def tile(colour: int, opaque_columns: int = 512) -> np.ndarray:
    """A tile with a gradient, so that no two colours give the same bytes; transparent right of some column."""
    rgba = np.zeros((512, 512, 4), np.uint8)
    rgba[..., 0] = colour
    rgba[..., 1] = np.arange(512)[:, None] // 2
    rgba[..., 2] = np.arange(512)[None] // 2
    rgba[:, :opaque_columns, 3] = 255
    return rgba


def frame(index: int, status: Status = Status.VISION, name: str = "") -> PlacedFrame:
    """A frame 20 m up, tilted a little, ten metres further east each time."""
    lost = status is Status.REJECTED
    pose = Pose(site_from_gimbal_rotation(30.0, -85.0, 0.0), np.array([10.0 * index, 5.0, 20.0]))
    return PlacedFrame(
        name or str(index), index, 1_700_000_000_123_456_000 + index, status, "blurred" if lost else "", CAMERA,
        None if lost else pose,
        np.full((3, 3), np.nan) if lost else site_from_image_homography(CAMERA, pose),
        np.full((4, 2), np.nan) if lost else footprint(CAMERA, pose),
        np.nan if lost else 0.4, np.nan if lost else 0.02,
        gps_residual_m=np.array([0.1, -0.2, np.nan]),
    )


def image(seed: int) -> np.ndarray:
    """A smooth image that JPEG keeps within a few grey levels."""
    y, x = np.mgrid[:54, :96]
    return np.dstack([x * 2, y * 4, np.full_like(x, (seed * 37) % 256)]).astype(np.uint8)


def map_flight(archive: Archive, flight_id: str, colour: int, count: int = 4, flushes: bool = True) -> int:
    """Map a fake flight of `count` tiles and frames, and commit it."""
    with archive.begin_flight(flight_id, f"print-{flight_id}", {"method": "planar", "colour": colour}) as writer:
        paths = {}
        for index in range(count):
            paths[index] = writer.save_image(index, image(index))
            for column in range(index + 1):  # repainted again and again, as a canvas does
                writer.tiles[column - 1, 0] = tile(colour + index)
            if flushes:
                writer.flush()
        placed = [frame(index) for index in range(count)] + [frame(count, Status.REJECTED)]
        return writer.commit(placed, paths, {"colour": colour}, f"<html>{colour}</html>")


def main(folder: str, start: int) -> None:
    """Map the same two flights in turn, for ever, telling each commit; meant to be killed."""
    step = start
    while True:
        with Archive.open(Path(folder), write=True) as archive:
            if not archive.has_site:
                archive.create_site(SITE)
            map_flight(archive, f"flight-{step % 2}", 10 + step % 200, count=3)
        print(step, flush=True)
        step += 1


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
