"""The versions of a map listed, found by date, and written as they were."""

import json
import sqlite3
from contextlib import closing
from datetime import UTC, datetime, timedelta
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from fake_changes import fake_change
from fake_flights import LOCAL_SITE, SITE, frame, map_flight, tile
from rasterio.warp import transform as warp_transform

from sealing import seal_again
from sorvolo.cli.main import main
from sorvolo.errors import InputError, SettingsError, StoreError
from sorvolo.missions.site.history import export_version, find_version, site_history
from sorvolo.store.images import png_from_rgba
from sorvolo.store.site.archive import Archive
from sorvolo.survey.findings import ChangeKind, Verdict


@pytest.fixture
def site(tmp_path: Path) -> Path:
    """Version 1 by mapping flight a (two tiles), version 2 by comparing flight b (another tile at one place)."""
    with Archive.open(tmp_path / "site", write=True) as archive:
        archive.create_site(SITE)
        map_flight(archive, "a", 20, count=2)
        with archive.begin_flight("b", "", {}) as writer:
            writer.tiles[0, 0] = tile(90)
            changes = [fake_change(1), fake_change(2, kind=ChangeKind.MOVING)]
            writer.commit([frame(0)], {}, {}, "<html></html>", changes=changes)
        archive.review("b-1", Verdict.CONFIRMED)
    return tmp_path / "site"


def test_versions_are_listed_with_what_each_cost_and_found(site: Path) -> None:
    first, second = site_history(site)
    assert (first.version, first.flight, first.kind, first.over, first.tiles) == (
        1,
        "a",
        "map",
        0,
        2,
    )
    assert (first.tiles_changed, first.changes) == (2, {})
    assert (second.version, second.flight, second.kind, second.over, second.tiles) == (
        2,
        "b",
        "compare",
        1,
        2,
    )
    assert (second.tiles_changed, second.tiles_removed) == (1, 0)
    assert first.bytes_changed == len(png_from_rgba(tile(21)))  # two tiles alike are one file
    assert second.bytes_changed == len(png_from_rgba(tile(90)))
    assert second.changes == {"appeared": 1, "moving": 1} and (
        second.confirmed,
        second.rejected,
    ) == (1, 0)


def test_a_version_that_was_made_again_keeps_its_counts(site: Path) -> None:
    with Archive.open(site, write=True) as archive, archive.begin_flight("b", "", {}) as writer:
        writer.commit([frame(0)], {}, {}, "<html></html>", changes=[])
    _, second, third = site_history(site)
    assert (
        second.is_replaced
        and second.changes == {"appeared": 1, "moving": 1}
        and second.confirmed == 0
    )
    assert (
        not third.is_replaced
        and third.changes == {}
        and third.over == 1
        and third.tiles_changed == 0
    )


def test_a_date_means_its_whole_day_and_a_time_its_minute_or_second(site: Path) -> None:
    with sqlite3.connect(site / "site.db") as connection:  # flights whose clocks have no date
        connection.execute("UPDATE flown SET first_ns = 7, last_ns = 8")
    connection.close()
    seal_again(site / "site.db")
    with Archive.open(site, write=False) as archive:
        made = [datetime.fromisoformat(version.created_utc) for version in archive.versions()]
        assert find_version(archive, "1").id == 1
        assert find_version(archive, made[1].date().isoformat()).id == 2
        assert find_version(archive, made[1].strftime("%Y%m%d")).id == 2
        for spec in ("minutes", "seconds"):  # a list shows a version's time without the rest
            assert find_version(archive, made[1].isoformat(timespec=spec)).id == 2
            assert find_version(archive, made[1].isoformat(" ", spec).replace("+00:00", "")).id == 2
        assert find_version(archive, made[1].strftime("%Y%m%dT%H%MZ")).id == 2
        assert find_version(archive, made[0].isoformat(timespec="milliseconds")).id == 1
        east = made[0].astimezone(tz=None).isoformat()
        assert find_version(archive, east).id == 1
        with pytest.raises(InputError, match="had no map"):
            find_version(archive, (made[0] - timedelta(days=1)).date().isoformat())
        with pytest.raises(InputError, match=r"no version 9.* 1, 2"):
            find_version(archive, "9")
        assert find_version(archive, made[1].isoformat("_")).id == 2
        with pytest.raises(SettingsError, match="yesterday"):
            find_version(archive, "yesterday")


def test_maps_are_dated_by_their_flights(site: Path) -> None:
    assert [each.flown_utc[:10] for each in site_history(site)] == ["2023-11-14"] * 2
    with Archive.open(site, write=False) as archive:
        assert find_version(archive, "2023-11-14").id == 2
        with pytest.raises(InputError, match="had no map"):
            find_version(archive, "2023-11-13")


def test_the_map_is_written_as_it_was(site: Path, tmp_path: Path) -> None:
    for at, red in (("1", 21), ("2", 90), (None, 90)):
        assert export_version(site, at, tmp_path / "map.tif").id == (1 if at == "1" else 2)
        with rasterio.open(tmp_path / "map.tif") as written:
            assert written.count == 4 and written.crs.to_string() == SITE.crs
            assert written.read(1)[0, -1] == red
    export_version(site, "1", tmp_path / "map.png")
    picture = cv2.imread(str(tmp_path / "map.png"), cv2.IMREAD_UNCHANGED)
    assert np.array_equal(picture[:, 512:, 2], tile(21)[..., 0])
    export_version(site, "1", tmp_path / "map.KMZ")
    assert (tmp_path / "map.KMZ").read_bytes()[:2] == b"PK"
    export_version(site, "1", tmp_path / "map.mbtiles")
    with (
        rasterio.open(tmp_path / "map.mbtiles") as web,
        rasterio.open(tmp_path / "map.tif") as map_,
    ):
        assert web.crs.to_epsg() == 3857 and len(web.overviews(1)) >= 2
        middle = warp_transform(map_.crs, web.crs, *([each] for each in map_.xy(256, 768)))
        assert abs(next(web.sample([(middle[0][0], middle[1][0])]))[0] - 21) <= 1
    with closing(sqlite3.connect(tmp_path / "map.mbtiles")) as table:
        words = dict(table.execute("SELECT name, value FROM metadata"))
    assert words["name"] == words["description"] == SITE.name
    export_version(site, "1", tmp_path / "map.pdf")
    written = (tmp_path / "map.pdf").read_bytes()
    assert written[:5] == b"%PDF-" and b"/GPTS" in written
    assert b"/Title (" + SITE.name.encode() + b")" in written
    names = {"site", "map.tif", "map.png", "map.KMZ", "map.mbtiles", "map.pdf"}
    assert {path.name for path in tmp_path.iterdir()} == names


def test_what_cannot_be_written_is_refused(site: Path, tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match=r"\.tif, \.png, \.kmz, \.mbtiles or \.pdf"):
        export_version(site, None, tmp_path / "map.jpg")
    with pytest.raises(InputError, match="no folder"):
        export_version(site, None, tmp_path / "none" / "map.tif")
    with pytest.raises(StoreError, match="no site"):
        site_history(tmp_path / "none")
    with Archive.open(tmp_path / "pond", write=True) as archive:
        archive.create_site(LOCAL_SITE)
        map_flight(archive, "a", 20, count=1)
    for ending in ("kmz", "mbtiles", "pdf"):
        with pytest.raises(SettingsError, match="no place on Earth"):
            export_version(tmp_path / "pond", None, tmp_path / f"map.{ending}")


def test_lists_fit_a_terminal_of_eighty_letters(
    site: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with (
        Archive.open(site, write=True) as archive,
        archive.begin_flight("flight12", "", {}) as writer,
    ):
        changes = [fake_change(3, kind=ChangeKind.DISAPPEARED)]
        writer.commit([frame(0)], {}, {}, "<html></html>", changes=changes)
    monkeypatch.setenv("COLUMNS", "80")
    for command in ("history", "review"):
        assert main([command, str(site)]) == 0
        shown = capsys.readouterr().out
        for word in (
            "disappeared",
            "confirmed",
            "2023-11-14",
            "1 moving" if command == "history" else "moving",
        ):
            assert word in shown, f"{command} cuts {word}"


def test_a_site_without_a_map_is_listed_as_such(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As a flight leaves it that was refused before its first frame."""
    with Archive.open(tmp_path / "site", write=True):
        pass
    assert main(["history", str(tmp_path / "site")]) == 0
    printed = capsys.readouterr()
    assert "no map yet" in printed.out and not printed.err


def test_the_command_lists_and_writes(
    site: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "160")
    assert main(["history", str(site)]) == 0
    shown = capsys.readouterr().out
    assert "1 appeared" in shown and "1 moving" in shown
    assert main(["history", str(site), "--json"]) == 0
    versions = json.loads(capsys.readouterr().out)["versions"]
    assert [each["kind"] for each in versions] == ["map", "compare"]
    target = tmp_path / "then.tif"
    today = datetime.now(UTC).date().isoformat()
    assert main(["history", str(site), "--at", today, "--export", str(target), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["version"]["version"] == 2 and target.is_file()
    assert main(["history", str(site), "--at", "1", "--export", str(target)]) == 0
    assert "version 1, flight a" in capsys.readouterr().out
    assert main(["history", str(site), "--at", "1"]) == 1
    assert "--export" in capsys.readouterr().err
    assert main(["history", str(site), "--at", "1999-01-01", "--export", str(target)]) == 1
    assert "had no map" in capsys.readouterr().err
