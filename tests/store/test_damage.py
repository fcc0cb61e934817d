"""What was stored is what is read: bits that flip in a site's files and rows are noticed, named and left out."""

import random
import shutil
import sqlite3
import tempfile
from contextlib import closing
from pathlib import Path

import pytest
from fake_flights import SITE, map_flight

from ended_work import ended
from sorvolo.cli.main import main
from sorvolo.errors import SorvoloWarning, StoreError
from sorvolo.store.copies.folder import FolderEnd
from sorvolo.store.copies.transfer import copy
from sorvolo.store.site import schema
from sorvolo.store.site.archive import Archive
from sorvolo.survey.findings import Verdict


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A site with a flight that was mapped and one that was compared, a change of it reviewed."""
    folder = tmp_path_factory.mktemp("whole") / "site"
    with Archive.open(folder, write=True) as archive:
        archive.create_site(SITE)
        map_flight(archive, "a", 20, count=3)
        map_flight(archive, "b", 60, count=2, compared=True)
        archive.review(archive.changes()[0].id, Verdict.CONFIRMED)
    return folder


@pytest.fixture
def site(whole: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(whole, tmp_path / "site"))


def flip(path: Path, seed: int = 0) -> None:
    """Flip one bit of a file, as a worn disk does, in its last half: headers are looked at anyway."""
    data = bytearray(path.read_bytes())
    chance = random.Random(seed)
    data[chance.randrange(len(data) // 2, len(data))] ^= 1 << chance.randrange(8)
    path.write_bytes(data)


def copied(source: Path, target: Path) -> dict[str, str]:
    with tempfile.TemporaryDirectory() as scratch:
        outcome = ended(copy(FolderEnd(source), FolderEnd(target), Path(scratch)))
    return dict(outcome.faults)


def test_keyframes_with_flipped_bits_are_left_out_and_counted(site: Path, tmp_path: Path) -> None:
    images = sorted(site.glob("flights/*/keyframes/*/*.jpg"))
    for seed, path in enumerate(images[:2]):
        flip(path, seed)
    images[3].unlink()
    with Archive.open(site, write=False) as archive:
        with pytest.warns(SorvoloWarning, match="left out") as warned:
            sound = archive.sound_keyframes()
        assert [(each.flight_id, each.index) for each in sound] == [("a", 2), ("b", 1)]
        assert [str(each.message) for each in warned] == [
            "2 key frames of a (0, 1) are damaged: left out",
            "key frame 0 of b is gone: left out",
        ]
        assert [each.count for each in archive.notices] == [2, 1]
        assert len(archive.sound_keyframes("a")) == 1 and len(archive.notices) == 2
        with pytest.raises(StoreError, match=r"000000\.jpg is damaged"):
            archive.image(archive.keyframes()[0])
        assert archive.image(sound[0]).shape == (54, 96, 3)


def test_any_stored_file_that_is_damaged_is_not_copied_as_good(site: Path, tmp_path: Path) -> None:
    paths = [path for path in site.glob("**/*") if path.is_file() and path.parent != site]
    paths += [site / name for name in ("mosaic.tif", "preview.png", "mosaic.kmz")]
    names = {path.relative_to(site).as_posix() for path in paths}
    assert {Path(name).suffix for name in names} >= {".jpg", ".png", ".geojson", ".html", ".tif"}
    for seed, path in enumerate(paths):
        flip(path, seed)
    assert copied(site, tmp_path / "copy") == dict.fromkeys(names, "damaged")
    assert not [name for name in names if (tmp_path / "copy" / name).exists()]


def test_documents_and_maps_that_are_damaged_are_not_used(site: Path) -> None:
    flip(site / "mosaic.tif")
    report = site / "flights/b/report.json"
    report.write_bytes(report.read_bytes().replace(b"60", b"61"))
    with Archive.open(site, write=False) as archive:
        assert archive.is_sound("preview.png") and not archive.is_sound("mosaic.tif")
        with pytest.raises(StoreError, match=r"mosaic.tif is damaged"):
            archive.require_sound("mosaic.tif")
        with pytest.warns(SorvoloWarning, match="report.json is left out"):
            assert archive.report("b") == {}
    with Archive.open(site, write=True) as archive:  # the map's files are made of its tiles again
        assert archive.is_sound("mosaic.tif")


_SEALED = [table.name for table in schema.metadata.sorted_tables if "seal" in table.c]
_CELLS = [  # of each sealed table with rows: a column, and what a flipped bit makes of it
    ("site", "latitude_deg", "latitude_deg + 1"),
    ("keyframes", "site_from_image", "replace(site_from_image, '0', '1')"),
    ("keyframes", "gains", "replace(gains, ']', '}')"),
    ("keyframes", "camera", "x'ff'"),
    ("keyframes", "status", "'wision'"),
    ("version_tiles", "tile_column", "tile_column + 512"),
    ("flown", "first_ns", "first_ns + 4096"),
    ("changes", "properties", "replace(properties, '1', '3')"),
    ("changes", "kind", "'oppeared'"),
    ("reviews", "outline_m", "replace(outline_m, '[', 'K')"),
    ("comparisons", "kinds", "'[]'"),
]


@pytest.mark.parametrize(("table", "column", "value"), _CELLS)
def test_a_damaged_row_is_said_to_be_damaged(
    site: Path, table: str, column: str, value: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with closing(sqlite3.connect(site / "site.db")) as connection, connection:
        connection.execute("PRAGMA foreign_keys = OFF")
        connection.execute(f"UPDATE {table} SET {column} = {value}")
    with (
        Archive.open(site, write=False) as archive,
        pytest.raises(StoreError, match=r"site\.db is damaged: .*restore it from a copy"),
    ):
        archive.keyframes(), archive.reviews(), archive.changes(), archive.site()
        archive.versions(), archive.comparisons(), archive.tiles()
    with pytest.raises(StoreError, match=r"site/site\.db is damaged"):
        copied(site, site.parent / "copy")
    assert main(["history", str(site), "--json"]) in (0, 1)
    assert "bug" not in capsys.readouterr().err


def test_bits_that_flip_anywhere_in_the_catalogue_are_never_called_a_bug(
    site: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    good = (site / "site.db").read_bytes()
    for seed in range(40):
        (site / "site.db").write_bytes(good)
        flip(site / "site.db", seed)
        for command in (["history", str(site)], ["review", str(site)]):
            main(command)
            assert "bug" not in capsys.readouterr().err
