"""Files appear whole or not at all, also on a disk that is full."""

import sqlite3
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from fake_flights import ORIGIN, SITE, image, map_flight

from sorvolo.errors import StoreError
from sorvolo.geometry.grid import SiteGrid
from sorvolo.store.atomic import atomic_path, atomic_write_bytes, remove_leftovers, scratch_folder
from sorvolo.store.rasters.geotiff import write_cog
from sorvolo.store.site.archive import Archive


def test_a_file_is_replaced_and_nothing_else_is_left(tmp_path: Path) -> None:
    path = tmp_path / "report.json"
    atomic_write_bytes(path, b"old")
    atomic_write_bytes(path, b"new")
    assert path.read_bytes() == b"new"
    assert list(tmp_path.iterdir()) == [path]


def test_a_failed_write_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "report.json"
    atomic_write_bytes(path, b"old")
    with pytest.raises(ZeroDivisionError), atomic_path(path) as temporary:
        temporary.write_bytes(b"half")
        raise ZeroDivisionError
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_the_temporary_name_keeps_the_ending_and_is_in_the_same_folder(tmp_path: Path) -> None:
    with atomic_path(tmp_path / "map.kmz") as temporary:
        assert temporary.suffix == ".kmz"
        assert temporary.parent == tmp_path
        assert not (tmp_path / "map.kmz").exists()
        temporary.write_bytes(b"x")
    assert (tmp_path / "map.kmz").read_bytes() == b"x"


def test_leftovers_of_killed_writers_go_and_other_files_stay(tmp_path: Path) -> None:
    (tmp_path / ".tmp-1-0-a.png").write_bytes(b"half")
    (tmp_path / ".tmp-1-1-scratch").mkdir()
    (tmp_path / ".tmp-1-1-scratch" / "plain.tif").write_bytes(b"half")
    (tmp_path / "a.png").write_bytes(b"whole")
    assert remove_leftovers([tmp_path]) == 2
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]


def test_a_scratch_folder_goes_away(tmp_path: Path) -> None:
    with scratch_folder(tmp_path) as scratch:
        (scratch / "x").write_bytes(b"x")
    assert not any(tmp_path.iterdir())


def test_a_file_that_grows_too_large_is_a_full_disk(tmp_path: Path) -> None:
    program = (
        "import resource, signal, sys\n"
        "from pathlib import Path\n"
        "from sorvolo.errors import StoreError\n"
        "from sorvolo.store.atomic import atomic_write_bytes\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))\n"
        "path = Path(sys.argv[1]) / 'x'\n"
        "atomic_write_bytes(path, b'a' * 1000)\n"
        "try:\n"
        "    atomic_write_bytes(path, b'b' * 1001)\n"
        "except StoreError as error:\n"
        "    print(error)\n"
    )
    result = subprocess.run(
        [sys.executable, "-c", program, str(tmp_path)], capture_output=True, text=True
    )
    assert result.stdout.startswith("disk full: "), result.stderr
    assert (tmp_path / "x").read_bytes() == b"a" * 1000
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize("place", ["nowhere/x.kml", "file/x.kml", "folder", f"{'x' * 250}.kml"])
def test_a_place_that_cannot_be_written_is_named_as_it_was_given(
    place: str, tmp_path: Path
) -> None:
    """The temporary file beside it has a name that nobody knows; GDAL and SQLite would print it."""
    (tmp_path / "file").write_bytes(b"x")
    (tmp_path / "folder").mkdir()
    path = tmp_path / place
    with pytest.raises(StoreError, match="cannot write") as bytes_refused:
        atomic_write_bytes(path, b"x")
    with (
        pytest.raises(StoreError, match="cannot write") as file_refused,
        atomic_path(path) as temporary,
    ):
        sqlite3.connect(temporary).execute("CREATE TABLE t (x)").connection.close()
    for refused in (bytes_refused, file_refused):
        assert f"cannot write {path} (" in str(refused.value)
        assert ".tmp-" not in str(refused.value)
    assert sorted(each.name for each in tmp_path.iterdir()) == ["file", "folder"]


@pytest.mark.parametrize("name", ["nowhere", "file"])
def test_a_scratch_folder_in_no_folder_names_that(name: str, tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"x")
    with (
        pytest.raises(StoreError, match="cannot write") as refused,
        scratch_folder(tmp_path / name),
    ):
        pass
    assert f"cannot write {tmp_path / name} (" in str(refused.value)


@pytest.fixture
def small_disk(tmp_path: Path):
    disk = tmp_path / "disk"
    disk.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=6m", "tmpfs", str(disk)],
        capture_output=True,
        text=True,
    )
    if mounted.returncode:
        pytest.skip(f"no small disk could be mounted: {mounted.stderr.strip()}")
    yield disk
    subprocess.run(["umount", "-l", str(disk)], check=True)


def test_a_full_disk_is_named_and_leaves_the_site_whole(small_disk: Path) -> None:
    folder = small_disk / "site"
    ballast = small_disk / "ballast"
    noise = np.random.default_rng(1).integers(1, 255, (512, 512, 4), dtype=np.uint8)
    with Archive.open(folder, write=True) as archive:
        archive.create_site(SITE)
        map_flight(archive, "first", 20)
        ballast.write_bytes(b"x" * 3_000_000)
        with (
            pytest.raises(StoreError, match="disk full"),
            archive.begin_flight("second", "", {}) as writer,
        ):
            for index in range(20):
                writer.save_image(index, image(index))
                writer.tiles[index, 3] = np.roll(noise, index, axis=0)
                writer.flush()
    with Archive.open(folder, write=False) as archive:
        assert [flight.id for flight in archive.flights()] == ["first"]
        assert len(dict(archive.tiles())) == 4
        assert len([archive.image(keyframe) for keyframe in archive.keyframes()]) == 4
    ballast.unlink()
    with Archive.open(folder, write=True) as archive:
        map_flight(archive, "second", 90)
        assert len(archive.keyframes()) == 8


def test_a_disk_that_fills_while_the_map_is_exported_is_made_good_later(small_disk: Path) -> None:
    folder = small_disk / "site"
    noise = np.random.default_rng(1).integers(1, 255, (512, 512, 4), dtype=np.uint8)
    noise[..., 3] = 255
    with Archive.open(folder, write=True) as archive:
        archive.create_site(SITE)
        with archive.begin_flight("first", "", {}) as writer:
            for column in range(3):  # 2.4 MB of tiles fit, the GeoTIFF and its scratch file do not
                writer.tiles[column, 0] = np.roll(noise, column, axis=0)
            with pytest.raises(StoreError):
                writer.commit([], {}, {}, "")
        assert len(archive.tiles()) == 3
        assert not archive.mosaic_path.exists()
        assert not list(folder.glob(".tmp-*"))
    subprocess.run(["mount", "-o", "remount,size=40m", str(small_disk)], check=True)
    with Archive.open(folder, write=True) as archive:
        assert archive.mosaic_path.exists()
        assert (archive.folder / "mosaic.kmz").exists()


def test_a_disk_that_fills_at_any_step_of_a_raster_is_named(small_disk: Path) -> None:
    """GDAL writes a file, its pyramid and its copy: each can be what no longer fits, with another error each."""
    noise = np.random.default_rng(1).integers(1, 255, (512, 512, 4), dtype=np.uint8)
    noise[..., 3] = 255
    tiles = {(column, 0): np.roll(noise, column, axis=0) for column in range(3)}
    grid = SiteGrid.at(ORIGIN, 0.05, SITE.crs)
    written = 0
    for free_kb in (*range(1000, 2600, 400), *range(2600, 3200, 20), 12_000):
        size = f"remount,size={free_kb}k"
        subprocess.run(["mount", "-o", size, str(small_disk)], check=True)
        try:
            write_cog(tiles, grid, small_disk / "map.tif")
            written += 1
            (small_disk / "map.tif").unlink()
        except StoreError as error:
            assert "MB free on its disk" in str(error) or "disk full" in str(error)
        assert not list(small_disk.iterdir())
    assert written == 1
