"""A site made by a stranger reads, writes, deletes and fetches nothing outside its folder."""

import http.server
import os
import shutil
import sqlite3
import subprocess
import sys
import threading
import zlib
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from fake_flights import SITE, image, map_flight, tile
from hypothesis import given, settings
from hypothesis import strategies as st

from mutations import mutated
from sealing import seal_again
from sorvolo.errors import InputError, SettingsError, StoreError
from sorvolo.lab.simulation.flight_files import read_orthophoto
from sorvolo.store.atomic import atomic_write_bytes
from sorvolo.store.images import image_from_jpeg, jpeg_from_image, rgba_from_png
from sorvolo.store.nofollow import read_below
from sorvolo.store.rasters.base_map import BaseMap
from sorvolo.store.rasters.geotiff import parse_crs, read_raster
from sorvolo.store.rasters.height_model import read_height_model
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.files import is_plain_name


@pytest.fixture(scope="module")
def honest(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small site with one flight that was mapped and one that was compared."""
    folder = tmp_path_factory.mktemp("honest") / "site"
    with Archive.open(folder, write=True) as archive:
        archive.create_site(SITE)
        map_flight(archive, "a", 20, count=2)
        map_flight(archive, "b", 60, count=2, compared=True)
    return folder


@pytest.fixture
def site(honest: Path, tmp_path: Path) -> Path:
    """A copy of it to craft with, and beside it a folder that it must not touch."""
    shutil.copytree(honest, tmp_path / "site")
    outside = tmp_path / "outside"
    for name in ("keyframes/1", "7", "changes", "masks"):
        (outside / name).mkdir(parents=True)
    (outside / "victim.txt").write_text("precious")
    (outside / "report.json").write_text('{"flight": "SECRET"}')
    (outside / "keyframes" / "1" / "000000.jpg").write_bytes(jpeg_from_image(image(9)))
    (outside / "7" / "precious.jpg").write_text("precious")
    (outside / ".tmp-precious").write_text("precious")
    return tmp_path / "site"


@pytest.fixture
def untouched(site: Path) -> Iterator[Path]:
    """The folder beside the site, which the test must leave as it was."""

    def content() -> dict[str, bytes]:
        return {
            str(path): path.read_bytes() if path.is_file() else b""
            for path in sorted(outside.rglob("*"))
        }

    outside = site.parent / "outside"
    before = content()
    around = {path.name for path in site.parent.iterdir()}
    yield outside
    assert content() == before
    assert {path.name for path in site.parent.iterdir()} == around


@pytest.fixture
def web() -> Iterator[tuple[str, list[str]]]:
    """The address of a server on this machine, and the paths that were asked of it."""
    asked: list[str] = []

    class Answer(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            asked.append(self.path)
            self.send_response(404)
            self.end_headers()

        do_HEAD = do_GET

        def log_message(self, *_: object) -> None:
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Answer)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}/map.tif", asked
    server.shutdown()
    server.server_close()


def craft(site: Path, *statements: str) -> None:
    """Change the catalogue as a stranger could."""
    with sqlite3.connect(site / "site.db") as connection:
        connection.execute("PRAGMA foreign_keys = OFF")
        for each in statements:
            connection.execute(each)
    connection.close()
    seal_again(site / "site.db")


OWED = "UPDATE runs SET files_written = 0"


@pytest.mark.parametrize(
    "name", ["../../../outside/victim.txt", "..", "a/b.txt", "/tmp/x.txt", "", "no ending"]
)
def test_documents_are_written_into_their_flights_folder_only(
    site: Path, untouched: Path, name: str
) -> None:
    craft(
        site,
        OWED,
        f"UPDATE documents SET name = '{name}', content = x'6576696c' WHERE name = 'report.html'",
    )
    with pytest.raises(StoreError, match="document"):
        Archive.open(site, write=True)


def test_leftovers_are_deleted_in_their_flights_folder_only(site: Path, untouched: Path) -> None:
    craft(
        site, OWED, "INSERT INTO leftovers SELECT max(id), '../../../outside/victim.txt' FROM runs"
    )
    with pytest.raises(StoreError, match="document"):
        Archive.open(site, write=True)


@pytest.mark.parametrize("name", ["../../outside", "..", ".", "/outside"])
def test_a_flights_id_names_no_folder_elsewhere(site: Path, untouched: Path, name: str) -> None:
    names = [
        f"UPDATE {table} SET {column} = '{name}' WHERE {column} = 'b'"
        for table, column in (("flights", "id"), ("runs", "flight_id"), ("versions", "flight_id"))
    ]
    craft(site, OWED, *names)
    with pytest.raises(StoreError, match="flight"):
        Archive.open(site, write=True)
    with Archive.open(site, write=False) as archive, pytest.raises(StoreError, match="flight"):
        archive.report(name)


@pytest.mark.parametrize(
    "path",
    [
        "../outside/keyframes/1/000000.jpg",
        "flights/a/keyframes/../../../../outside/keyframes/1/000000.jpg",
        "/etc/passwd",
        "flights/a/report.json",
        "site.db",
    ],
)
def test_a_keyframes_image_lies_in_its_flight(site: Path, untouched: Path, path: str) -> None:
    craft(site, f"UPDATE keyframes SET image_path = '{path}'")
    with Archive.open(site, write=False) as archive, pytest.raises(StoreError, match="keyframe"):
        archive.keyframes()


def test_a_tiles_name_is_a_hash(site: Path, untouched: Path) -> None:
    shutil.copy(next(site.glob("tiles/*/*.png")), untouched / "victim.png")
    try:
        craft(site, "UPDATE version_tiles SET sha256 = '../../outside/victim'")
        with Archive.open(site, write=False) as archive, pytest.raises(StoreError, match="tile"):
            dict(archive.tiles())
        with (
            Archive.open(site, write=True) as archive,
            pytest.raises(StoreError, match="tile"),
            archive.begin_flight("c", "", {}) as writer,
        ):
            writer.tiles[0, 0]
        assert (untouched / "victim.png").exists()
    finally:
        (untouched / "victim.png").unlink()


@pytest.mark.parametrize("name", ["../../../outside/victim", "a/../../b", ".hidden", ""])
def test_a_changes_id_names_no_picture_elsewhere(site: Path, untouched: Path, name: str) -> None:
    craft(site, OWED, f"UPDATE changes SET id = '{name}' WHERE number = 1")
    with Archive.open(site, write=False) as archive, pytest.raises(StoreError, match="change"):
        archive.changes()
    with pytest.raises(StoreError, match="change"):
        Archive.open(site, write=True)


@pytest.mark.parametrize(
    "place",
    [
        "flights",
        "flights/a",
        "flights/b/changes",
        "flights/a/keyframes",
        "flights/a/keyframes/1",
        "tiles",
        "tiles/00",
        "flights/b/staged",
        "flights/c",
    ],
)
def test_a_link_to_a_folder_is_refused(site: Path, untouched: Path, place: str) -> None:
    craft(site, OWED)
    at = site / place
    if at.is_dir():
        shutil.rmtree(at)
    at.symlink_to(untouched, target_is_directory=True)
    with pytest.raises(StoreError, match="link"):
        Archive.open(site, write=True)


@pytest.mark.parametrize(
    "place",
    [
        "site.lock",
        "site.db",
        "mosaic.tif",
        "live.png",
        "flights/a/report.json",
        ".tmp-x",
        "flights/a/keyframes/1/000000.jpg",
    ],
)
def test_a_link_to_a_file_is_refused(site: Path, untouched: Path, place: str) -> None:
    (site / place).unlink(missing_ok=True)
    (site / place).symlink_to(untouched / "victim.txt")
    with pytest.raises(StoreError, match="link"):
        Archive.open(site, write=True)


def test_reading_follows_no_link_either(site: Path, untouched: Path) -> None:
    keyframes = site / "flights" / "a" / "keyframes" / "1"
    shutil.rmtree(keyframes)
    keyframes.symlink_to(untouched / "keyframes" / "1", target_is_directory=True)
    with Archive.open(site, write=False) as archive, pytest.raises(StoreError, match="link"):
        archive.image(archive.keyframes("a")[0])
    (site / "flights" / "b" / "report.json").unlink()
    (site / "flights" / "b" / "report.json").symlink_to(untouched / "report.json")
    with pytest.raises(StoreError, match="link"):
        Archive.open(site, write=False)


def test_a_pipe_in_the_place_of_a_file_does_not_wait_for_ever(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "x")
    with pytest.raises(StoreError, match="no plain file"):
        read_below(tmp_path, "x")
    with pytest.raises(StoreError, match="no path below"):
        read_below(tmp_path, "../x")
    (tmp_path / "y").write_bytes(bytes(100))
    with pytest.raises(StoreError, match="MB"):
        read_below(tmp_path, "y", most_bytes=99)


def test_the_site_folder_itself_may_be_a_link(site: Path) -> None:
    (site.parent / "link").symlink_to(site, target_is_directory=True)
    with Archive.open(site.parent / "link", write=True) as archive:
        assert len(archive.flights()) == 2


def test_a_rollback_journal_is_refused(site: Path, untouched: Path) -> None:
    """SQLite would delete the file that a journal names as its master."""
    (site / "site.db-journal").write_bytes(b"\xd9\xd5\x05\xf9\x20\xa1\x63\xd7")
    for write in (False, True):
        with pytest.raises(StoreError, match="journal"):
            Archive.open(site, write=write)


def test_a_crs_that_is_an_address_is_not_fetched(
    site: Path, untouched: Path, web: tuple[str, list[str]]
) -> None:
    address, asked = web
    with Archive.open(site, write=True) as archive:
        grid = archive.site_grid().grid
    for crs in (address, f"/vsicurl/{address}", "+proj=utm +zone=33", "EPSG:32633 "):
        with pytest.raises(SettingsError, match="EPSG"):
            parse_crs(crs, grid)
    craft(site, f"UPDATE versions SET export_crs = '{address}'")
    (site / "mosaic.tif").unlink()
    with pytest.raises(StoreError, match="EPSG"):
        Archive.open(site, write=True)
    craft(site, "UPDATE versions SET export_crs = ''", f"UPDATE site SET crs = '{address}'")
    with pytest.raises(StoreError, match="EPSG"):
        Archive.open(site, write=True)
    assert not asked


def test_a_users_raster_fetches_and_opens_nothing_else(
    tmp_path: Path, web: tuple[str, list[str]]
) -> None:
    address, asked = web
    secret = tmp_path / "secret.png"
    cv2.imwrite(str(secret), np.full((8, 8, 3), 99, np.uint8))
    readers = (
        lambda path: read_raster(path, 100),
        lambda path: read_orthophoto(path, 0.1),
        lambda path: read_height_model(path, (13.0, 46.0, 14.0, 47.0)),
    )
    bands = "".join(
        f'<VRTRasterBand dataType="Byte" band="{band}"><SimpleSource><SourceFilename>{{source}}</SourceFilename>'
        f"<SourceBand>{band}</SourceBand></SimpleSource></VRTRasterBand>"
        for band in (1, 2, 3)
    )
    vrt = tmp_path / "map.tif"
    for source in (f"/vsicurl/{address}", str(secret)):
        vrt.write_text(
            f'<VRTDataset rasterXSize="8" rasterYSize="8">{bands.format(source=source)}</VRTDataset>'
        )
        for reader in readers:
            with pytest.raises(InputError):
                reader(vrt)
    for path in (f"/vsicurl/{address}", address, f"/vsizip/{secret}/x.tif", "\0", "x" * 5000):
        for reader in readers:
            with pytest.raises(InputError, match="no such file"):
                reader(Path(path))
    assert not asked


def raster_of(path: Path, side_px: int, bands: int, dtype: str, *, written: bool = True) -> Path:
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        width=side_px,
        height=side_px,
        count=bands,
        dtype=dtype,
        crs="EPSG:32632",
        transform=rasterio.Affine(0.5, 0, 500_000, 0, -0.5, 5_100_000),
        tiled=True,
        compress="deflate",
        SPARSE_OK=not written,
        bigtiff="YES" if side_px > 10_000 else "NO",
    ) as sink:
        if written:
            sink.write(np.arange(bands * side_px**2).reshape(bands, side_px, side_px).astype(dtype))
    return path


def test_a_small_raster_of_many_pixels_is_no_ground_to_simulate_over(tmp_path: Path) -> None:
    sparse = raster_of(tmp_path / "sparse.tif", 40_000, 3, "uint8", written=False)
    assert sparse.stat().st_size < 1_000_000
    with pytest.raises(InputError, match="40000 x 40000 pixels; at most 500 million"):
        read_orthophoto(sparse)


@pytest.mark.parametrize("rows", [(0.5, 0, 0.5), (0.4, 0.3, -0.4)])
def test_a_base_map_that_is_upside_down_or_turned_is_refused(
    tmp_path: Path, rows: tuple[float, float, float]
) -> None:
    across, turned, down = rows
    place = rasterio.Affine(across, turned, 300_000, turned, down, 4_640_000)
    about = {"width": 64, "height": 64, "count": 3, "dtype": "uint8", "crs": "EPSG:32633"}
    with rasterio.open(tmp_path / "a.tif", "w", driver="GTiff", transform=place, **about) as sink:
        sink.write(np.ones((3, 64, 64), np.uint8))
    with pytest.raises(InputError, match="warp it with gdalwarp"):
        BaseMap.open(tmp_path / "a.tif")


def test_a_raster_in_coordinates_of_a_building_site_has_no_place_on_earth(tmp_path: Path) -> None:
    local = 'LOCAL_CS["site",LOCAL_DATUM["site",0],UNIT["metre",1],AXIS["Easting",EAST],AXIS["Northing",NORTH]]'
    for bands, dtype, reader in (
        (3, "uint8", BaseMap.open),
        (1, "float32", lambda path: read_height_model(path, (8.9, 46.0, 9.1, 46.1))),
    ):
        path = tmp_path / f"{dtype}.tif"
        with rasterio.open(
            path,
            "w",
            driver="GTiff",
            width=64,
            height=64,
            count=bands,
            dtype=dtype,
            crs=local,
            transform=rasterio.Affine(0.5, 0, 1000, 0, -0.5, 2000),
        ) as sink:
            sink.write(np.ones((bands, 64, 64), dtype))
        with pytest.raises(InputError, match="a local coordinate reference system"):
            reader(path)


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_any_raster_is_read_or_refused(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    folder = tmp_path_factory.getbasetemp()
    colours, heights = (
        raster_of(folder / "a.tif", 64, 3, "uint8"),
        raster_of(folder / "b.tif", 64, 1, "float32"),
    )
    reader, valid = data.draw(
        st.sampled_from(
            [
                (lambda path: read_raster(path, 100), colours),
                (read_orthophoto, colours),
                (lambda path: BaseMap.open(path).bounds_deg, colours),
                (lambda path: read_height_model(path, (8.9, 46.0, 9.1, 46.1)), heights),
            ]
        )
    )
    path = folder / "any.tif"
    path.write_bytes(mutated(data, valid.read_bytes(), 4))
    try:
        reader(path)
    except InputError:
        pass


@pytest.mark.parametrize("value", ["0", "-1", "9e999", "'wide'", "x'00'"])
def test_a_pixel_size_that_cannot_be_is_named(site: Path, value: str) -> None:
    craft(site, f"UPDATE site SET m_per_px = {value}")
    with pytest.raises(StoreError, match="site"):
        Archive.open(site, write=False).site_grid()


@pytest.mark.parametrize(
    ("table", "column", "value"),
    [
        ("keyframes", "camera", '{"width_px": 0}'),
        ("keyframes", "camera", "[]"),
        ("keyframes", "rotation", "[1]"),
        ("keyframes", "site_from_image", "7"),
        ("keyframes", "status", "seen"),
        ("changes", "properties", "{}"),
        ("changes", "kind", "exploded"),
        ("site", "latitude_deg", "text"),
    ],
)
def test_values_that_no_sorvolo_wrote_are_named(
    site: Path, table: str, column: str, value: str
) -> None:
    craft(site, f"UPDATE {table} SET {column} = '{value}'")
    with (
        Archive.open(site, write=False) as archive,
        pytest.raises(StoreError, match=r"site\.db is damaged"),
    ):
        archive.keyframes(), archive.changes(), archive.site()


@pytest.mark.parametrize("column", ["flight_id", "created_utc"])
def test_a_version_whose_text_is_none_is_named(site: Path, column: str) -> None:
    craft(site, f"UPDATE versions SET {column} = x'ff00'")
    with Archive.open(site, write=False) as archive, pytest.raises(StoreError, match="damaged"):
        archive.versions()


def _png(width: int, height: int) -> bytes:
    """A PNG of so many transparent pixels, small as a file."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return (
            len(data).to_bytes(4, "big") + kind + data + zlib.crc32(kind + data).to_bytes(4, "big")
        )

    rows = zlib.compress(bytes((4 * width + 1) * 8)) if width * height < 1e6 else b""
    header = width.to_bytes(4, "big") + height.to_bytes(4, "big") + b"\x08\x06\0\0\0"
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")
    )


def test_a_picture_that_announces_too_many_pixels_is_not_decoded() -> None:
    with pytest.raises(StoreError, match="289 million pixels"):
        rgba_from_png(_png(17_000, 17_000), "tile")
    jpeg = bytearray(jpeg_from_image(image(1)))
    at = jpeg.index(b"\xff\xc0")
    jpeg[at + 5 : at + 9] = b"\xff\xff\xff\xff"
    with pytest.raises(StoreError, match="4295 million pixels"):
        image_from_jpeg(bytes(jpeg), "keyframe")
    assert image_from_jpeg(jpeg_from_image(image(1)), "keyframe").shape == (54, 96, 3)
    bitmap = cv2.imencode(".bmp", image(1))[1].tobytes()
    for data in (b"", b"\xff\xd8", b"\xff\xd8\xff\xe0\0\0", _png(8, 8)[:20], bitmap):
        for decode in (image_from_jpeg, rgba_from_png):
            with pytest.raises(StoreError, match="damaged"):
                decode(data, "picture")


def test_a_disk_that_is_full_when_the_catalogue_is_made_is_named(tmp_path: Path) -> None:
    program = (
        "import resource, signal, sys\n"
        "from pathlib import Path\n"
        "from sorvolo.errors import StoreError\n"
        "from sorvolo.store.site.archive import Archive\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))\n"
        "try:\n"
        "    Archive.open(Path(sys.argv[1]), write=True)\n"
        "except StoreError as error:\n"
        "    print(error)\n"
    )
    result = subprocess.run(
        [sys.executable, "-c", program, str(tmp_path / "s")], capture_output=True, text=True
    )
    assert "site.db" in result.stdout and "disk" in result.stdout, result.stderr
    assert not (tmp_path / "s" / "site.db").exists()
    with Archive.open(tmp_path / "s", write=True) as archive:
        assert not archive.has_site


def test_what_is_written_follows_no_link(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "victim").write_text("precious")
    (tmp_path / "x.json").symlink_to(tmp_path / "victim")
    atomic_write_bytes(tmp_path / "x.json", b"new")
    assert (tmp_path / "victim").read_text() == "precious"
    assert not (tmp_path / "x.json").is_symlink()
    (tmp_path / ".tmp-1-y").symlink_to(tmp_path / "victim")
    monkeypatch.setattr(
        "sorvolo.store.atomic.temporary_beside", lambda path: path.with_name(".tmp-1-y")
    )
    with pytest.raises(StoreError, match="File exists"):
        atomic_write_bytes(tmp_path / "y", b"new")
    assert (tmp_path / "victim").read_text() == "precious"


@pytest.mark.parametrize(
    "name", ["DJI_0043", "Flug über Ötztal (2)", "e\u0301te\u0301", "地図", "a.b-c_d", "50% [x]"]
)
def test_names_that_flights_have(name: str) -> None:
    assert is_plain_name(name)


@pytest.mark.parametrize(
    "name", ["", ".", "..", ".a", "-rf", "a/b", "a\\b", "a\nb", "a\0", "a\u202eb", "a" * 300]
)
def test_names_that_no_flight_has(name: str) -> None:
    assert not is_plain_name(name)


def test_tiles_of_a_site_are_still_read(site: Path) -> None:
    with Archive.open(site, write=True) as archive:
        assert np.array_equal(archive.tiles()[0, 0], tile(61))
        assert len([archive.image(each) for each in archive.keyframes()]) == 4
