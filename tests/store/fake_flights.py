"""Small made-up sites and flights for the store's tests; as a program, it kills itself at random moments."""

import hashlib
import os
import random
import signal
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from types import FrameType

import numpy as np
import rasterio
from fake_changes import fake_change

from sorvolo.geometry.camera import Camera
from sorvolo.geometry.geodesy import Geodetic, utm_epsg
from sorvolo.geometry.ground import footprint
from sorvolo.geometry.homography import site_from_image_homography
from sorvolo.geometry.pose import Pose, site_from_gimbal_rotation
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.catalogue_place import is_site
from sorvolo.survey.flight import Site
from sorvolo.survey.mosaic import PlacedFrame, Status

ORIGIN = Geodetic(46.5, 13.25, 310.0)
SITE = Site("field", ORIGIN, f"EPSG:{utm_epsg(46.5, 13.25)}", 0.05, height_reference="ellipsoidal")
LOCAL_SITE = Site("pond", Geodetic(0.0, 0.0), "", 1.0, is_local=True)
CAMERA = Camera(96, 54, 80.0, 80.0, 47.5, 26.5, np.array([-0.1, 0.02, 0.0, 0.0, 0.0]))
_NO_BOXES = np.zeros((0, 4), np.int64)


def tile(colour: int, opaque_columns: int = 512) -> np.ndarray:
    """A tile with a gradient, of one red; transparent right of some column."""
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
        name or str(index),
        index,
        1_700_000_000_123_456_000 + index,
        status,
        "blurred" if lost else "",
        CAMERA,
        None if lost else pose,
        np.full((3, 3), np.nan) if lost else site_from_image_homography(CAMERA, pose),
        np.full((4, 2), np.nan) if lost else footprint(CAMERA, pose),
        np.nan if lost else 0.4,
        np.nan if lost else 0.02,
        gps_residual_m=np.array([0.1, -0.2, np.nan]),
    )


def image(seed: int) -> np.ndarray:
    """A smooth image that JPEG keeps within a few grey levels."""
    y, x = np.mgrid[:54, :96]
    return np.dstack([x * 2, y * 4, np.full_like(x, (seed * 37) % 256)]).astype(np.uint8)


def map_flight(
    archive: Archive, flight_id: str, colour: int, count: int = 4, *, compared: bool = False
) -> int:
    """Map a fake flight of `count` tiles, painted `count` deep, and as many frames, and commit it.

    A flight that is `compared` finds `count` changes and saves as many masks, of its colour.
    """
    settings = {"method": "planar", "colour": colour, "count": count}
    changes = (
        [fake_change(number, flight_id, size_m=colour / 100) for number in range(count)]
        if compared
        else None
    )
    with archive.begin_flight(flight_id, f"print-{flight_id}", settings) as writer:
        paths = {}
        for index in range(count):
            paths[index] = writer.save_image(index, image(index))
            for column in range(index + 1):  # repainted again and again, as a canvas does
                writer.tiles[column - 1, 0] = tile(colour + index)
            writer.flush()
            if compared:
                writer.save_masks(
                    str(index), np.full((8, 8), colour, np.uint8), np.ones((8, 8), bool), _NO_BOXES
                )
        placed = [frame(index) for index in range(count)] + [frame(count, Status.REJECTED)]
        return writer.commit(
            placed, paths, {"colour": colour}, f"<html>{colour}</html>", changes=changes
        )


def check_whole(folder: Path) -> None:
    """Raise AssertionError (or the archive's own error) unless the site is whole and of one piece."""
    if not is_site(folder):
        assert all(path.name.startswith((".tmp-", "site.lock")) for path in folder.glob("*"))
        return
    with Archive.open(folder, write=False) as archive:
        complete = archive.versions()
        for version in complete:
            assert len(list(archive.tiles(version.id).items())) == version.tiles
        flights = {flight.id: flight for flight in archive.flights() if flight.status == "complete"}
        for flight_id, flight in flights.items():
            keyframes = archive.keyframes(flight_id)
            assert [keyframe.index for keyframe in keyframes] == list(
                range(flight.settings["count"])
            )
            for keyframe in keyframes:
                assert (
                    np.abs(archive.image(keyframe).astype(int) - image(keyframe.index)).mean() < 4
                )
            changes = archive.changes(flight_id)
            assert [change.number for change in changes] == list(range(flight.settings["count"]))
            assert {change.length_m for change in changes} == {flight.settings["colour"] / 100}
        if complete:
            newest = flights[complete[-1].flight_id].settings
            for column in range(newest["count"]):
                # the last coat: every tile of the newest flight has its last frame's colour
                expected = tile(newest["colour"] + newest["count"] - 1)
                assert np.array_equal(archive.tiles()[column - 1, 0], expected)
        if archive.mosaic_path.exists():
            with rasterio.open(archive.mosaic_path) as mosaic:
                assert mosaic.read().shape[0] == 4


def map_for_ever(folder: Path, seed: int) -> None:
    """Map two flights in turn, again and again."""
    while True:
        seed += 1
        with Archive.open(folder, write=True) as archive:
            if not archive.has_site:
                archive.create_site(SITE)
            map_flight(
                archive, f"flight-{seed % 2}", 10 + seed % 200, count=2 + seed % 2, compared=True
            )


def _forked(task: Callable[..., None], *arguments: object) -> int:
    """Run the task in a child and return its process id; a child that fails exits with 1 and a traceback."""
    child = os.fork()
    if child == 0:
        try:
            task(*arguments)
            os._exit(0)
        except BaseException:
            traceback.print_exc()
            os._exit(1)
    return child


def kill_at_random(folder: Path, seed: int, rounds: int) -> None:
    """Kill a mapping child after a random time and look whether the site is whole; exit with 1 if not."""
    chance = random.Random(seed)
    for number in range(rounds):
        child = _forked(map_for_ever, folder, number)
        time.sleep(chance.uniform(0.01, 0.9))
        os.kill(child, signal.SIGKILL)
        _, ending = os.waitpid(child, 0)
        if os.WIFEXITED(ending):  # it failed by itself before it was killed
            sys.exit(f"round {number}: the mapping child failed")
        _expect_whole(folder, f"round {number}")


def kill_at_steps(folder: Path, seed: int, rounds: int) -> None:
    """Kill a mapping child at `rounds` of its steps over the whole run, and at every one around its commit.

    A step is a call in the modules that order the writing.
    """
    steps = folder.with_name("steps")
    os.waitpid(_forked(_map_to_step, folder, seed, 1_000_000, steps), 0)
    count, commit = (int(word) for word in steps.read_text().split())
    spread = np.linspace(0, 0.95 * count, rounds).astype(int)
    around = [*range(commit - 6, commit + 5), *range(commit + 5, commit + 50, 7)]
    for place in sorted({*spread.tolist(), *around}):
        seed += 2  # the same flight in another colour
        _, ending = os.waitpid(_forked(_map_to_step, folder, seed, place, steps), 0)
        if not os.WIFSIGNALED(ending):
            sys.exit(f"step {place} of {count}: the mapping child was not killed")
        _expect_whole(folder, f"step {place} of {count}")


def _map_to_step(folder: Path, seed: int, last: int, steps: Path) -> None:
    """Map one flight and be killed at a step; else write how many there were and which was the commit."""
    count = commit = 0

    def watch(called: FrameType, event: str, _: object) -> None:
        nonlocal count, commit
        ordering = (
            "archive.py",
            "flight_writer.py",
            "catalogue.py",
            "database.py",
            "upkeep.py",
            "atomic.py",
        )
        if event != "call" or not called.f_code.co_filename.endswith(ordering):
            return
        if count == last:
            os.kill(os.getpid(), signal.SIGKILL)
        count += 1
        if called.f_code.co_name == "complete_run":
            commit = count

    with Archive.open(folder, write=True) as archive:
        if not archive.has_site:
            archive.create_site(SITE)
        sys.setprofile(watch)
        map_flight(
            archive, f"flight-{seed % 2}", 10 + seed % 200, count=2 + seed % 2, compared=True
        )
        sys.setprofile(None)
    steps.write_text(f"{count} {commit}")


def _expect_whole(folder: Path, when: str) -> None:
    _, ending = os.waitpid(_forked(check_whole, folder), 0)
    if ending:
        sys.exit(f"{when}: the site is not whole")


def mapped_site(folder: Path, flights: int = 1, colour: int = 50) -> Path:
    """A new site with some flights of two frames each, compared, of plain colours."""
    with Archive.open(folder, write=True) as archive:
        archive.create_site(SITE)
        for number in range(flights):
            map_flight(archive, f"flight-{number}", colour + number, count=2, compared=True)
    return folder


def hashes(folder: Path) -> dict[str, str]:
    """SHA-256 of each file of a site but the catalogue's, by path."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in folder.rglob("*")
        if path.is_file() and not path.name.startswith("site.")
    }


if __name__ == "__main__":
    kills = {"random": kill_at_random, "steps": kill_at_steps}
    kills[sys.argv[1]](Path(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4]))
