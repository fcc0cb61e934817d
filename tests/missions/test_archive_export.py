"""`sorvolo archive export`: a table that GeoPandas, STAC tools and DuckDB read, and the documentation's queries."""

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import fake_flights
import pytest
import shapely
from fake_bucket import BUCKET, served_bucket

from sorvolo.cli.main import main
from sorvolo.missions.site.copy import copy_site
from sorvolo.store.site.archive import Archive
from sorvolo.survey.findings import Verdict

ROOT = Path(__file__).parents[2]
pytest.importorskip("pyarrow", reason="Parquet needs pyarrow: pip install 'sorvolo[archive]'")


@pytest.fixture(scope="module")
def maps(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two sites on Earth, one without, and one that is damaged."""
    root = tmp_path_factory.mktemp("archive") / "maps"
    for name in ("north/field", "south"):
        with Archive.open(root / name, write=True) as archive:
            archive.create_site(fake_flights.SITE)
            for number in range(2 if name == "south" else 1):
                fake_flights.map_flight(
                    archive, f"flight-{number}", 50 + number, count=2, compared=True
                )
            archive.review(archive.changes()[0].id, Verdict.CONFIRMED)
    with Archive.open(root / "pond", write=True) as archive:
        archive.create_site(fake_flights.LOCAL_SITE)
        fake_flights.map_flight(archive, "flight-0", 50, count=1)
    (root / "broken").mkdir()
    (root / "broken/site.db").write_bytes(b"no catalogue")
    return root


@pytest.fixture(scope="module")
def table(maps: Path) -> Path:
    out = maps.parent / "archive.parquet"
    assert main(["archive", "export", str(maps), "--out", str(out)]) == 1  # one site cannot be read
    return out


def rows_of(table: Path) -> list[dict[str, Any]]:
    import pyarrow.parquet

    return pyarrow.parquet.read_table(table).to_pylist()


def test_every_site_flight_version_and_change_has_a_row(
    table: Path, maps: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = {each["id"]: each for each in rows_of(table)}
    kinds = [each["sorvolo:kind"] for each in rows.values()]
    assert {kind: kinds.count(kind) for kind in set(kinds)} == {
        "site": 2,
        "flight": 3,
        "version": 3,
        "change": 6,
    }
    flight = rows["south/flight-1"]
    assert flight["start_datetime"] <= flight["datetime"] <= flight["end_datetime"]
    assert flight["datetime"].isoformat().startswith("2023-11-14T22:13:20.123456")
    report = table.parent / flight["assets"]["report"]["href"]
    assert report.read_text() == (maps / "south/flights/flight-1/report.html").read_text()
    reviews = [each["sorvolo:review"] for each in rows.values() if each["sorvolo:kind"] == "change"]
    assert reviews.count("confirmed") == 2 and reviews.count(None) == 4
    change = next(each for each in rows.values() if each["sorvolo:kind"] == "change")
    assert (table.parent / change["assets"]["before"]["href"]).is_file()
    assert main(["archive", "export", str(maps), "--out", str(table), "--json"]) == 1
    outcome = json.loads(capsys.readouterr().out)
    assert (
        outcome["local"] == ["pond"]
        and list(outcome["faults"]) == ["broken"]
        and outcome["rows"] == 14
    )


def test_geometries_lie_where_the_site_is(table: Path, maps: Path) -> None:
    for each in rows_of(table):
        place, box = shapely.from_wkb(each["geometry"]), each["bbox"]
        assert place.is_valid and place.bounds == (
            box["xmin"],
            box["ymin"],
            box["xmax"],
            box["ymax"],
        )
        assert (
            place.distance(
                shapely.Point(fake_flights.ORIGIN.longitude_deg, fake_flights.ORIGIN.latitude_deg)
            )
            < 1e-3
        )
        if each["sorvolo:kind"] == "version":
            with Archive.open(maps / each["sorvolo:site"], write=False) as archive:
                tiles = len(archive.tiles(each["sorvolo:version"]))
            area_m2 = place.area * 111_320**2 * 0.6884  # cosine of 46.5 degrees
            assert area_m2 == pytest.approx(tiles * (512 * 0.05) ** 2, rel=0.01)


def test_it_is_geoparquet_1_1_and_stac_geoparquet_1_1(table: Path) -> None:
    import pyarrow.parquet

    metadata = pyarrow.parquet.read_schema(table).metadata
    geo = json.loads(metadata[b"geo"])
    assert geo["version"] == "1.1.0" and geo["primary_column"] == "geometry"
    column = geo["columns"]["geometry"]
    assert (
        column["encoding"] == "WKB" and "crs" not in column
    )  # the default: longitude and latitude in WGS84
    assert set(column["geometry_types"]) <= {"Point", "Polygon", "MultiPolygon"}
    assert column["covering"] == {
        "bbox": {each: ["bbox", each] for each in ("xmin", "ymin", "xmax", "ymax")}
    }
    places = [shapely.from_wkb(each["geometry"]) for each in rows_of(table)]
    assert column["bbox"] == list(shapely.union_all(places).bounds)
    assert {place.geom_type for place in places} == set(column["geometry_types"])
    stac = json.loads(metadata[b"stac-geoparquet"])
    assert stac["version"] == "1.1.0" and set(stac["collections"]) == {"north/field", "south"}


def test_geopandas_reads_it_by_its_boxes(table: Path) -> None:
    geopandas = pytest.importorskip(
        "geopandas", reason="needs geopandas: pip install 'sorvolo[notebooks]'"
    )
    found = geopandas.read_parquet(table)
    assert len(found) == 14 and found.crs == "OGC:CRS84"
    assert len(geopandas.read_parquet(table, bbox=(13.249, 46.499, 13.251, 46.501))) == 14
    assert len(geopandas.read_parquet(table, bbox=(14, 46, 15, 47))) == 0


def test_the_rows_are_stac_items_again(table: Path) -> None:
    pystac = pytest.importorskip("pystac", reason="needs pystac")
    for row in rows_of(table):
        item = pystac.Item(
            row["id"],
            shapely.geometry.mapping(shapely.from_wkb(row["geometry"])),
            list(row["bbox"].values()),
            row["datetime"],
            {"sorvolo:kind": row["sorvolo:kind"]},
            collection=row["collection"],
            assets={
                name: pystac.Asset.from_dict(each) for name, each in row["assets"].items() if each
            },
        )
        again = pystac.Item.from_dict(item.to_dict(include_self_link=False, transform_hrefs=False))
        assert again.id == row["id"] and again.datetime == row["datetime"]


def _queries() -> Iterator[str]:
    text = (ROOT / "docs/archives.md").read_text()
    return (each[1] for each in re.finditer(r"```sql\n(.*?)```", text, re.DOTALL))


@pytest.mark.parametrize("query", _queries())
def test_the_documentations_queries_find_something(
    table: Path, query: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    duckdb = pytest.importorskip("duckdb", reason="needs duckdb: pip install duckdb")
    monkeypatch.chdir(table.parent)
    with duckdb.connect() as connection:
        assert connection.sql(query).to_arrow_table().num_rows > 0


def test_an_archive_in_a_bucket(
    maps: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SORVOLO_CACHE", str(tmp_path / "cache"))
    with served_bucket():
        for _ in copy_site(str(maps / "south"), f"s3://{BUCKET}/archive/south"):
            pass
        out = tmp_path / "all.parquet"
        assert main(["archive", "export", f"s3://{BUCKET}/archive", "--out", str(out)]) == 0
    rows = {each["id"]: each for each in rows_of(out)}
    assert rows["south"]["assets"]["map"]["href"] == f"s3://{BUCKET}/archive/south/mosaic.tif"
    report = rows["south/flight-0"]["assets"]["report"]["href"]
    assert re.fullmatch(rf"s3://{BUCKET}/archive/south/files/../[0-9a-f]{{64}}\.html", report)


def test_bad_input_is_named(maps: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for root, out, words in (
        (tmp_path / "nowhere", tmp_path / "a.parquet", "no such folder"),
        (maps, tmp_path / "a.csv", "give a file name with that ending"),
        (maps, tmp_path / "no/a.parquet", "make it first"),
    ):
        assert main(["archive", "export", str(root), "--out", str(out)]) == 1
        assert words in capsys.readouterr().err
    (tmp_path / "empty").mkdir()
    assert (
        main(["archive", "export", str(tmp_path / "empty"), "--out", str(tmp_path / "a.parquet")])
        == 0
    )
    assert rows_of(tmp_path / "a.parquet") == []
