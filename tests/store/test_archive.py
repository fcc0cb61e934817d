"""A flight enters a site whole or not at all; versions share tiles; readers and the writer do not collide."""

import hashlib
import json
import sqlite3
import subprocess
import sys
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from fake_flights import CAMERA, LOCAL_SITE, SITE, frame, image, map_flight, tile

from sorvolo.errors import GeometryError, NotFoundError, SettingsError, StoreError
from sorvolo.geometry.homography import apply_homography
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.catalogue_place import is_site
from sorvolo.store.site.schema import FORMAT
from sorvolo.store.site.tiles import TileBlobs
from sorvolo.survey.mosaic import Status


@pytest.fixture
def folder(tmp_path: Path, kind: str) -> Path:
    return tmp_path / "site"


@pytest.fixture
def file_folder(tmp_path: Path) -> Path:
    """For what holds of a catalogue in the site's folder alone, or has nothing to do with catalogues."""
    return tmp_path / "site"


def opened(folder: Path) -> Archive:
    """The site to be written, made where there is none."""
    archive = Archive.open(folder, write=True)
    if not archive.has_site:
        archive.create_site(SITE)
    return archive


def test_a_site_comes_back_as_it_was_and_only_once(folder: Path) -> None:
    with opened(folder) as archive:
        map_flight(archive, "a", 20)
    with Archive.open(folder, write=True) as archive:
        assert archive.has_site
        assert archive.site() == SITE
        with pytest.raises(StoreError, match="field"):
            archive.create_site(SITE)


def test_a_site_that_no_flight_entered_is_forgotten(folder: Path) -> None:
    with opened(folder):  # as good as a kill between create_site and begin_flight
        pass
    with Archive.open(folder, write=True) as archive:
        assert not archive.has_site
        archive.create_site(replace(SITE, m_per_px=0.25))
        map_flight(archive, "a", 20)
        assert archive.site().m_per_px == 0.25


def test_an_empty_archive_has_no_site(tmp_path: Path) -> None:
    with Archive.open(tmp_path / "new" / "site", write=True) as archive:
        assert not archive.has_site
        assert archive.flights() == archive.versions() == archive.keyframes() == []
        assert dict(archive.tiles()) == dict(archive.live_tiles()) == {}
        with pytest.raises(StoreError):
            archive.site()


def test_a_flight_comes_back_whole(folder: Path) -> None:
    with opened(folder) as archive:
        version = map_flight(archive, "morning", 20)
    with Archive.open(folder, write=False) as archive:
        (flight,) = archive.flights()
        assert (flight.id, flight.rank, flight.status, flight.method) == (
            "morning",
            0,
            "complete",
            "planar",
        )
        assert flight.fingerprint == "print-morning"
        assert flight.settings["colour"] == 20
        assert flight.frames == {"vision": 4, "gps-only": 0, "rejected": 1}
        assert flight.started_utc <= flight.finished_utc
        (entry,) = archive.versions()
        assert (entry.id, entry.flight_id, entry.tiles) == (version, "morning", 4)
        tiles = archive.tiles()
        assert set(tiles) == {(-1, 0), (0, 0), (1, 0), (2, 0)}
        assert np.array_equal(tiles[2, 0], tile(23))
        assert (5, 5) not in tiles and tiles.get((5, 5)) is None
        keyframes = archive.keyframes()
        assert [keyframe.index for keyframe in keyframes] == [0, 1, 2, 3]
        for keyframe in keyframes:
            made = frame(keyframe.index)
            assert keyframe.time_ns == made.time_ns
            assert keyframe.status is Status.VISION
            assert np.array_equal(keyframe.site_from_image, made.site_from_image)
            assert keyframe.site_from_camera is not None
            assert np.array_equal(
                keyframe.site_from_camera.rotation, made.site_from_camera.rotation
            )
            assert not keyframe.camera.is_distorted
            assert np.abs(archive.image(keyframe).astype(int) - image(keyframe.index)).max() < 12
    flight_folder = folder / "flights" / "morning"
    assert json.loads((flight_folder / "report.json").read_text()) == {"colour": 20}
    assert (flight_folder / "report.html").read_text() == "<html>20</html>"
    assert len(json.loads((flight_folder / "frames.geojson").read_text())["features"]) == 5
    assert {path.name for path in folder.iterdir()} >= {
        "mosaic.tif",
        "preview.png",
        "mosaic.kmz",
    } and is_site(folder)


def test_a_keyframe_stored_smaller_sees_the_same_ground(file_folder: Path) -> None:
    full = frame(1)
    with opened(file_folder) as archive, archive.begin_flight("a", "", {}) as writer:
        path = writer.save_image(1, cv2.resize(image(1), (32, 18), interpolation=cv2.INTER_AREA))
        writer.commit([full], {1: path}, {}, "")
        (keyframe,) = archive.keyframes()
    assert (keyframe.camera.width_px, keyframe.camera.height_px) == (32, 18)
    # the outer corners of the image are the same places at both sizes
    full_m = apply_homography(full.site_from_image, CAMERA.undistorted().corners_px)
    small_m = apply_homography(keyframe.site_from_image, keyframe.camera.corners_px)
    assert np.abs(full_m - small_m).max() < 1e-9


def test_images_come_out_of_the_writer_as_out_of_the_archive(file_folder: Path) -> None:
    with opened(file_folder) as archive:
        with archive.begin_flight("a", "", {}, tiles_mb=0, images_mb=0) as writer:
            paths = {index: writer.save_image(index, image(index)) for index in range(3)}
            seen = [writer.image(index) for index in range(3)]
            writer.save_image(0, image(9))
            assert not np.array_equal(writer.image(0), seen[0])
            writer.save_image(0, image(0))
            with pytest.raises(StoreError):
                writer.image(7)
            writer.commit([frame(index) for index in range(3)], paths, {}, "")
        stored = [archive.image(keyframe) for keyframe in archive.keyframes("a")]
        assert all(np.array_equal(one, other) for one, other in zip(stored, seen, strict=True))
        with pytest.raises(NotFoundError, match="no flight 'b'"):
            archive.keyframes("b")


def test_leaving_without_commit_changes_nothing(folder: Path) -> None:
    with opened(folder) as archive:
        map_flight(archive, "a", 20)
        before = (
            archive.flights(),
            archive.versions(),
            sorted(path for path in folder.rglob("*.[pj]*g")),
        )
        with pytest.raises(ZeroDivisionError), archive.begin_flight("b", "", {}) as writer:
            writer.save_image(0, image(0))
            writer.tiles[0, 0] = tile(200)
            writer.tiles[9, 9] = tile(201)
            writer.flush()
            assert len(archive.live_tiles()) == 5
            raise ZeroDivisionError
        assert (archive.flights(), archive.versions(), sorted(folder.rglob("*.[pj]*g"))) == before
        assert np.array_equal(archive.live_tiles()[0, 0], tile(23))
        assert not (folder / "flights" / "b").exists()


def test_a_flight_that_is_left_writes_no_more(
    file_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Threads write tiles: what they had begun has ended, and gone, before another may write the site."""
    with opened(file_folder) as archive:
        map_flight(archive, "a", 20)
        before = sorted(file_folder.rglob("*.png"))
        keep, begun, ended = TileBlobs.keep, [], []

        def slow(self: TileBlobs, data: bytes) -> str:
            begun.append(data)
            time.sleep(0.2)
            sha256 = keep(self, data)
            ended.append(data)
            return sha256

        monkeypatch.setattr(TileBlobs, "keep", slow)
        with (
            pytest.raises(ZeroDivisionError),
            archive.begin_flight("b", "", {}, tiles_mb=1) as writer,
        ):
            for column in range(4):
                writer.tiles[column, 7] = tile(200 + column)
            raise ZeroDivisionError
        assert len(begun) == len(ended)
        assert sorted(file_folder.rglob("*.png")) == before
        time.sleep(0.5)
        assert sorted(file_folder.rglob("*.png")) == before


def test_mapping_again_keeps_the_rank_and_shows_the_former_run_until_the_commit(
    folder: Path,
) -> None:
    with opened(folder) as archive:
        map_flight(archive, "a", 20)
        map_flight(archive, "b", 40)
        former = archive.keyframes("a")
        with archive.begin_flight("a", "again", {}) as writer:
            path = writer.save_image(0, image(5))
            assert [flight.fingerprint for flight in archive.flights()] == ["print-a", "print-b"]
            assert len(archive.keyframes("a")) == 4
            assert archive.image(former[3]).shape == (54, 96, 3)
            writer.commit([frame(0)], {0: path}, {}, "", notes=["second try"])
        assert [(flight.id, flight.rank) for flight in archive.flights()] == [("a", 0), ("b", 1)]
        assert archive.flights()[0].notes == ("second try",)
        assert len(archive.keyframes("a")) == 1
        with pytest.raises(StoreError, match="mapped again"):
            archive.image(former[3])
        assert len(list((folder / "flights" / "a" / "keyframes").iterdir())) == 1


def test_a_version_starts_from_the_newest_one_that_another_flight_made(folder: Path) -> None:
    with opened(folder) as archive:
        first = map_flight(archive, "a", 20, count=2)
        for colour in (40, 60):  # the second time over the version of flight a, not over its own
            with archive.begin_flight("b", "", {}) as writer:
                assert dict.fromkeys(writer.tiles) == dict.fromkeys(archive.tiles(first))
                writer.tiles[colour, 0] = tile(colour)
                newest = writer.commit([], {}, {}, "")
        assert set(archive.tiles()) == {(-1, 0), (0, 0), (60, 0)}
        assert [version.parent_id for version in archive.versions()] == [0, first, first]
        with archive.begin_flight("a", "", {}) as writer:
            assert set(writer.tiles) == set(archive.tiles(newest))


def test_versions_share_the_tiles_in_which_they_agree(folder: Path) -> None:
    with opened(folder) as archive:
        map_flight(archive, "a", 20)
        blobs = set(folder.glob("tiles/*/*.png"))
        with archive.begin_flight("b", "", {}) as writer:
            writer.tiles[0, 0] = tile(99)
            del writer.tiles[1, 0]
            writer.tiles[2, 0] = tile(50, opaque_columns=0)  # fully transparent: taken away
            writer.commit([], {}, {}, "")
        assert set(folder.glob("tiles/*/*.png")) > blobs
        assert len(set(folder.glob("tiles/*/*.png")) - blobs) == 1
        old, new = archive.tiles(1), archive.tiles(2)
        assert len(old) == 4 and len(new) == 2
        assert np.array_equal(old[0, 0], tile(23)) and np.array_equal(new[0, 0], tile(99))
        with pytest.raises(KeyError):
            new[1, 0]
        with pytest.raises(StoreError, match="version 7"):
            archive.tiles(7)
    for blob in folder.glob("tiles/*/*.png"):
        assert blob.stem == hashlib.sha256(blob.read_bytes()).hexdigest()


def test_repainting_leaves_no_blobs_behind(folder: Path) -> None:
    with (
        opened(folder) as archive,
        archive.begin_flight("a", "", {}, tiles_mb=2, images_mb=2) as writer,
    ):
        for colour in range(20, 30):
            for column in range(
                4
            ):  # more than fit into memory, so that some are written between flushes
                writer.tiles[column, 0] = tile(colour, opaque_columns=100 + column)
            writer.flush()
            assert len(list(folder.glob("tiles/*/*.png"))) == 4
        assert np.array_equal(writer.tiles[0, 0], tile(29, opaque_columns=100))


def test_a_tile_must_have_the_sites_size_and_comes_out_read_only(file_folder: Path) -> None:
    with opened(file_folder) as archive, archive.begin_flight("a", "", {}) as writer:
        with pytest.raises(GeometryError, match="512x512"):
            writer.tiles[0, 0] = np.ones((256, 256, 4), np.uint8)
        painted = tile(5)
        writer.tiles[0, 0] = painted
        painted[:] = 0
        assert np.array_equal(writer.tiles[0, 0], tile(5))
        with pytest.raises(ValueError, match="read-only"):
            writer.tiles[0, 0][0, 0] = 0
        with pytest.raises(KeyError):
            del writer.tiles[4, 4]


def test_another_process_reads_the_growing_map(folder: Path) -> None:
    program = (
        "import sys; from pathlib import Path; from sorvolo.store.site.archive import Archive\n"
        "with Archive.open(Path(sys.argv[1]), write=False) as archive:\n"
        "    live, whole = archive.live_tiles(), archive.tiles()\n"
        "    print(len(live), int(live[0, 0][0, 0, 0]), len(whole), int(whole[0, 0][0, 0, 0]))\n"
        "    print(len(archive.keyframes()))\n"
    )
    with opened(folder) as archive:
        map_flight(archive, "a", 20)
        with archive.begin_flight("b", "", {}) as writer:
            writer.tiles[0, 0] = tile(111)
            writer.tiles[8, 8] = tile(112)
            writer.flush()
            command = [sys.executable, "-c", program, str(folder)]
            result = subprocess.run(command, capture_output=True, text=True)
    assert result.stdout.split() == ["5", "111", "4", "23", "4"], result.stderr


def test_a_reader_follows_a_tile_that_is_replaced_under_it(folder: Path) -> None:
    with opened(folder) as archive, archive.begin_flight("a", "", {}) as writer:
        writer.tiles[0, 0] = tile(1)
        writer.flush()
        with Archive.open(folder, write=False) as reader:
            live = reader.live_tiles()
            writer.tiles[0, 0] = tile(2)
            writer.flush()
            assert np.array_equal(live[0, 0], tile(2))
            del writer.tiles[0, 0]
            writer.flush()
            with pytest.raises(StoreError, match="read the map again"):
                live[0, 0]


def test_only_one_writer_and_one_flight_at_a_time(folder: Path) -> None:
    with opened(folder) as archive:
        with pytest.raises(StoreError, match="another process"):
            opened(folder)
        with archive.begin_flight("a", "", {}), pytest.raises(StoreError, match="already"):
            archive.begin_flight("b", "", {})
    with (
        Archive.open(folder, write=False) as archive,
        pytest.raises(StoreError, match="write=True"),
    ):
        archive.begin_flight("a", "", {})


@pytest.mark.parametrize("flight_id", ["", "../up", ".hidden", "a/b", "a\0b"])
def test_a_flight_id_cannot_leave_its_folder(file_folder: Path, flight_id: str) -> None:
    with opened(file_folder) as archive, pytest.raises(SettingsError):
        archive.begin_flight(flight_id, "", {})


def test_a_folder_that_is_no_site_is_refused_and_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.doc").write_text("precious")
    for write in (True, False):
        with pytest.raises(StoreError):
            Archive.open(tmp_path, write=write)
    with pytest.raises(StoreError, match="is a file"):
        Archive.open(tmp_path / "thesis.doc", write=True)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.doc"]


@pytest.mark.parametrize(
    "content", [b"", b"no database at all" * 100, b"SQLite format 3\0" + bytes(5000)]
)
def test_a_catalogue_that_is_none_is_refused_and_left_alone(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "site.db").write_bytes(content)
    for write in (True, False):
        with pytest.raises(StoreError, match=r"site\.db"):
            Archive.open(tmp_path, write=write)
    assert (tmp_path / "site.db").read_bytes() == content


def test_a_damaged_catalogue_is_refused_and_left_alone(file_folder: Path) -> None:
    with opened(file_folder) as archive:
        map_flight(archive, "a", 20)
    whole = (file_folder / "site.db").read_bytes()
    cut = whole[: len(whole) // 2]
    (file_folder / "site.db").write_bytes(cut)
    with pytest.raises(StoreError, match="damaged"):
        opened(file_folder)
    assert (file_folder / "site.db").read_bytes() == cut


def test_another_format_version_is_refused_with_both_versions(file_folder: Path) -> None:
    with opened(file_folder):
        pass
    with sqlite3.connect(file_folder / "site.db") as connection:
        connection.execute(f"PRAGMA user_version = {FORMAT + 6}")
    connection.close()
    for write in (True, False):
        with pytest.raises(StoreError, match=rf"version {FORMAT + 6},.* version {FORMAT};"):
            Archive.open(file_folder, write=write)


def test_a_folder_on_a_read_only_disk_can_be_read_but_not_written(
    file_folder: Path, tmp_path: Path
) -> None:
    with opened(file_folder) as archive:
        map_flight(archive, "a", 20)
    view = tmp_path / "view"
    view.mkdir()
    commands = [
        ["mount", "--bind", str(file_folder), str(view)],
        ["mount", "-o", "remount,bind,ro", str(view)],
    ]
    if any(subprocess.run(command, capture_output=True).returncode for command in commands):
        subprocess.run(["umount", str(view)], capture_output=True)
        pytest.skip("no read-only mount could be made here")
    try:
        with Archive.open(view, write=False) as archive:
            assert len(dict(archive.tiles())) == 4
        with pytest.raises(StoreError, match="cannot write"):
            Archive.open(view, write=True)
        with pytest.raises(StoreError, match="cannot write"):
            Archive.open(view / "below", write=True)
    finally:
        subprocess.run(["umount", "-l", str(view)], check=True)


def test_a_damaged_or_missing_tile_is_named(file_folder: Path) -> None:
    with opened(file_folder) as archive:
        map_flight(archive, "a", 20, count=1)
    (blob,) = file_folder.glob("tiles/*/*.png")
    data = bytearray(blob.read_bytes())
    data[len(data) // 2] ^= 1
    blob.write_bytes(data)
    with Archive.open(file_folder, write=False) as archive:
        with pytest.raises(StoreError, match="damaged"):
            archive.tiles()[-1, 0]
        blob.unlink()
        with pytest.raises(StoreError, match="missing"):
            archive.tiles()[-1, 0]


def test_files_that_a_commit_still_owed_are_written_by_the_next_opening(folder: Path) -> None:
    with opened(folder) as archive:
        map_flight(archive, "a", 20, count=1)
        (archive.folder / "preview.png").unlink()
        ((archive.folder / "preview.png") / "in the way").mkdir(
            parents=True
        )  # as good as a kill: the commit stops here
        with pytest.raises(StoreError, match=r"preview\.png"):
            map_flight(archive, "b", 40, count=3)
        assert [flight.id for flight in archive.flights()] == ["a", "b"]
    (folder / "preview.png" / "in the way").rmdir()
    (folder / "preview.png").rmdir()
    with opened(folder) as archive:
        assert cv2.imread(str(archive.folder / "preview.png"), cv2.IMREAD_UNCHANGED).shape == (
            512,
            3 * 512,
            4,
        )
        archive.mosaic_path.unlink()
    with opened(folder) as archive:
        assert archive.mosaic_path.is_file()


def test_a_flight_without_any_tile_leaves_no_map(folder: Path) -> None:
    with opened(folder) as archive:
        with archive.begin_flight("a", "", {}) as writer:
            writer.commit([frame(0, Status.REJECTED)], {}, {"value": np.nan}, "")
        assert not archive.mosaic_path.exists()
        assert archive.keyframes() == []
        assert json.loads((archive.flight_folder("a") / "report.json").read_text()) == {
            "value": None
        }


def test_a_local_site_has_a_map_without_a_place_on_earth(tmp_path: Path) -> None:
    with Archive.open(tmp_path / "site", write=True) as archive:
        archive.create_site(LOCAL_SITE)
        map_flight(archive, "a", 20, count=1)
        assert archive.mosaic_path.is_file()
        assert not (archive.folder / "mosaic.kmz").exists()
        with archive.begin_flight("b", "", {}) as writer, pytest.raises(SettingsError):
            writer.commit([], {}, {}, "", crs="EPSG:3857")


def test_readers_know_that_the_catalogue_changed_when_they_can_see_it(folder: Path) -> None:
    """The mark stays through a transaction that others cannot see yet, and is another one once they can."""
    read = partial(Archive.open, folder, write=False)
    with opened(folder) as writer, read() as reader, read() as twin:
        before = reader.change_mark()
        assert reader.change_mark() == before != twin.change_mark()
        with writer.catalogue.changing() as connection:
            connection.exec_driver_sql("UPDATE site SET derived_version = 7")
            assert reader.change_mark() == before
        after = reader.change_mark()
        assert after != before
        assert reader.exported_version == 7
        map_flight(writer, "a", 20)
        assert reader.change_mark() != after
