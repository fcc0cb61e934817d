"""The same flights mapped and compared with a catalogue in PostgreSQL and in SQLite: the same rows, the same files."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import select

from postgres_server import PostgresServer
from small_flights import simulate_into
from sorvolo.cli.main import main
from sorvolo.lab.simulation.presets import preset
from sorvolo.store.site import schema
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.catalogue_place import VARIABLE, is_site

_TIMES = {"started_utc", "finished_utc", "created_utc", "at_utc"}


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two flights along one strip, some things come and gone between them."""
    folder, demo = tmp_path_factory.mktemp("flown") / "flown", preset("demo")
    settings = replace(
        demo,
        flights=2,
        scene=replace(demo.scene, people=0, cars=1, small_objects=4, has_scenery=False),
        path=replace(demo.path, length_m=16, strips=1),
        imaging=replace(demo.imaging, width_px=320, height_px=180, fps=4),
    )
    return simulate_into(folder, settings)


def run(capsys: pytest.CaptureFixture[str], *words: object) -> dict[str, Any]:
    assert main([*map(str, words), "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def fly(
    flown: Path,
    site: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    url: str = "",
) -> dict[str, Any]:
    """Map, compare, review, history: as a user does, who names the database for the map and then for all commands."""
    camera = ("--camera", flown / "camera.xml", "--model", "none")
    for _ in range(2):  # the second time it is mapped already
        run(
            capsys,
            "map",
            flown / "flight1",
            "--site",
            site,
            *camera,
            *(["--catalogue", url] if url else []),
        )
    monkeypatch.setenv(VARIABLE, url)
    main([str(each) for each in ("compare", flown / "flight2", "--site", site, *camera, "--json")])
    capsys.readouterr()
    with Archive.open(site, write=False) as archive:
        changes = archive.changes()
    assert changes
    assert main(["review", str(site), "--confirm", changes[0].id]) == 0
    capsys.readouterr()
    return run(capsys, "history", site)


def rows(site: Path) -> dict[str, list[dict[str, Any]]]:
    """Every row of the catalogue but when it was written; of settings what does not name the site."""
    with (
        Archive.open(site, write=False) as archive,
        archive.catalogue.reading() as connection,
    ):
        found = {}
        for table in schema.metadata.sorted_tables:
            kept = [
                each
                for each in connection.execute(
                    select(table).order_by(*table.primary_key)
                ).mappings()
            ]
            found[table.name] = [
                {key: value for key, value in each.items() if key not in _TIMES} for each in kept
            ]
    return found


@pytest.mark.long
def test_the_same_rows_in_either(
    flown: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    postgres: PostgresServer,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    in_file = fly(flown, tmp_path / "a" / "site", capsys, monkeypatch)
    on_server = fly(flown, tmp_path / "b" / "site", capsys, monkeypatch, postgres.url)
    one, other = tmp_path / "a" / "site", tmp_path / "b" / "site"
    assert (one / "site.db").is_file() and is_site(other) and not (other / "site.db").exists()
    expected, found = rows(one), rows(other)
    assert (
        len(expected["keyframes"]) > 4
        and len(expected["changes"]) > 0
        and len(expected["reviews"]) == 1
    )
    for table, kept in expected.items():
        assert found[table] == kept, table
    times = {"date_utc"}
    assert [
        {key: value for key, value in each.items() if key not in times}
        for each in in_file["versions"]
    ] == [
        {key: value for key, value in each.items() if key not in times}
        for each in on_server["versions"]
    ]
    tiles = [{path.name for path in site.glob("tiles/*/*.png")} for site in (one, other)]
    assert (
        tiles[0] == tiles[1]
        and (one / "mosaic.tif").read_bytes() == (other / "mosaic.tif").read_bytes()
    )
