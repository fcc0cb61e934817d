"""`sorvolo heights` on a mapped flight: files that fit each other, and refusals that name what to do."""

import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import copclib
import numpy as np
import pytest
import rasterio
import rasterio.windows
from fake_changes import fake_change
from pyproj import CRS

from real_data import real_data
from small_flights import simulate_into
from sorvolo.cli.main import main
from sorvolo.errors import GeometryError, InputError, NotFoundError, SettingsError, StoreError
from sorvolo.lab.simulation.settings import (
    ImagingSettings,
    OutputSettings,
    PathSettings,
    SceneSettings,
    SensorSettings,
    SimulationSettings,
)
from sorvolo.missions.compare.report import with_height_changes
from sorvolo.missions.compare.run import _earlier_pictures
from sorvolo.missions.flight.settings import MapSettings
from sorvolo.missions.heights.measure import (
    heights_stamps,
    measure_profile,
    measure_volume,
    read_field,
    without_heights,
    write_contours,
)
from sorvolo.missions.heights.run import make_heights
from sorvolo.missions.map.flights import map_flights
from sorvolo.missions.map.ground import shape_of
from sorvolo.missions.search.prepare import heights_for
from sorvolo.missions.site.history import export_version
from sorvolo.mosaic.graph_report import GraphReport
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.files import HeightFile
from sorvolo.survey.findings import ChangeKind

_SURVEY = SimulationSettings(
    seed=12,
    flights=1,
    scene=SceneSettings(people=0, cars=2, small_objects=2, has_scenery=True),
    path=PathSettings(height_m=25, speed_m_s=4, length_m=20, strips=2, strip_spacing_m=8),
    imaging=ImagingSettings(width_px=400, height_px=300, fps=6, noise=1.0),
    sensor=SensorSettings(noise_m=(0.1, 0.1, 0.1)),
    output=OutputSettings(photos=True, photo_overlap=0.8),
)


@pytest.fixture(scope="module")
def with_heights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A site with one small photo survey, and heights of it from `map --heights`."""
    folder = tmp_path_factory.mktemp("heights")
    simulate_into(folder / "made", _SURVEY)
    photos = folder / "made" / "flight1" / "photos"
    assert (
        main(
            [
                "map",
                str(photos),
                "--site",
                str(folder / "site"),
                "--model",
                "none",
                "--heights",
                "--json",
            ]
        )
        == 0
    )
    assert list((folder / "site").glob("flights/*/heights.tif")), "map --heights makes heights"
    return folder / "site"


@pytest.fixture(scope="module")
def mapped(with_heights: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same site without its heights."""
    site = Path(shutil.copytree(with_heights, tmp_path_factory.mktemp("heights") / "site"))
    (made,) = site.glob("flights/*/heights.tif")
    for name in ("heights.tif", "terrain.tif", "orthophoto.tif", "heights.json"):
        (made.parent / name).unlink(missing_ok=True)
    return site


def test_heights_of_a_mapped_flight_are_files_that_fit_each_other(
    mapped: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    map_before = (mapped / "mosaic.tif").read_bytes()
    of_map = json.loads(next(mapped.glob("flights/*/report.json")).read_text())
    assert not of_map["shape"]["is_flat"] and of_map["residual_px"]["median"] < 1
    assert [each["frames"] for each in of_map["pieces"]] == [of_map["frames"]["vision"]]
    assert main(["heights", str(mapped), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)["heights"]
    folder = mapped / "flights" / report["flight"]
    with (
        rasterio.open(folder / "heights.tif") as heights,
        rasterio.open(folder / "terrain.tif") as ground,
    ):
        up_m, sigma_m = heights.read()
        assert heights.transform == ground.transform and heights.crs == ground.crs
        bare_m = ground.read(1)
        assert heights.units == ("metre", "metre")
    known = np.isfinite(up_m)
    assert known.mean() > 0.5 and np.isfinite(bare_m).all()
    assert (sigma_m[known] > 0).all() and np.isnan(sigma_m[~known]).all()
    # the simulated ground is level, and a house, trees and cars stand on it
    assert np.median(np.abs(up_m[known] - np.median(bare_m))) < 0.3
    assert np.percentile(up_m[known] - np.median(bare_m), 99) > 2.0
    with (
        rasterio.open(folder / "orthophoto.tif") as picture,
        rasterio.open(mapped / "mosaic.tif") as flat,
    ):
        assert picture.res == flat.res and picture.crs == flat.crs
        assert (picture.read(4) == 255).mean() > 0.3
        # the map was made with --heights: it is the same orthophoto
        window = rasterio.windows.from_bounds(*flat.bounds, picture.transform)
        again, mapped_px = picture.read(window=window, boundless=True), flat.read()
        both = (again[3] == 255) & (mapped_px[3] == 255)
        assert both.mean() > 0.3
        assert np.mean(np.abs(again[:3] - mapped_px[:3].astype(float))[:, both] < 20) > 0.95
    assert report["surface"]["holes_share"] < 0.2
    judged = report["surface"]["own_points"]
    assert judged["points"] > 100 and judged["within_2_sigma"] > 0.9 and judged["factor"] >= 1
    assert (mapped / "mosaic.tif").read_bytes() == map_before


def _write(site: Path, path: Path, text: str) -> None:
    """Write a file as the site does, so that it counts as no damage."""
    name = path.relative_to(site).as_posix()
    with Archive.open(site, write=True) as archive, archive.replacing(name):
        path.write_text(text)


@pytest.mark.long
def test_heights_of_a_map_that_contradicts_itself_or_mixes_lenses_state_it(
    mapped: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    site = Path(shutil.copytree(mapped, tmp_path / "site"))
    (path,) = site.glob("flights/*/report.json")
    report = json.loads(path.read_text())
    report["headline"] = {
        "quality": "contradictory",
        "text": "a map that contradicts itself: two scales",
    }
    report["notices"] = [{"code": "zoom", "count": 2, "text": "different focal lengths"}]
    _write(site, path, json.dumps(report))
    assert main(["heights", str(site), "--json"]) == 3
    warnings = " ".join(json.loads(capsys.readouterr().out)["heights"]["warnings"])
    assert "two scales" in warnings and "each focal length as a flight of their own" in warnings


def test_heights_name_what_is_missing(mapped: Path, tmp_path: Path) -> None:
    with pytest.raises(NotFoundError, match="nowhere"):
        list(make_heights(mapped, flight="nowhere"))
    with pytest.raises(StoreError, match="no site"):
        list(make_heights(tmp_path / "none"))
    with pytest.raises(SettingsError, match="cell_m"):
        next(make_heights(mapped, 0.0))


def test_more_cells_than_can_be_handled_are_refused_before_the_work_begins(mapped: Path) -> None:
    with pytest.raises(GeometryError, match="give cells larger than"):
        next(make_heights(mapped, 0.001))


def test_a_flight_without_gps_has_no_heights(tmp_path: Path) -> None:
    imaging, path = (
        replace(_SURVEY.imaging, width_px=240, height_px=180),
        replace(_SURVEY.path, length_m=12, strips=1),
    )
    silent = replace(
        _SURVEY,
        seed=13,
        imaging=imaging,
        path=path,
        output=replace(_SURVEY.output, telemetry="none"),
    )
    simulate_into(tmp_path / "made", silent)
    list(
        map_flights(
            [tmp_path / "made" / "flight1" / "photos"], tmp_path / "site", MapSettings(model="none")
        )
    )
    with pytest.raises(InputError, match="no GPS"):
        list(make_heights(tmp_path / "site"))


def _area(site: Path, path: Path) -> Path:
    """A square of 16 m around the middle of the cameras, as GeoJSON."""
    frames = json.loads(next(site.glob("flights/*/frames.geojson")).read_text())["features"]
    places = np.array(
        [
            [each["properties"][f"camera_{axis}_deg"] for axis in ("longitude", "latitude")]
            for each in frames
        ]
    )
    middle = places.mean(axis=0)
    half = 8 / 111_000 / np.array([np.cos(np.radians(middle[1])), 1.0])
    corners = middle + half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]])
    polygon = {"type": "Polygon", "coordinates": [corners.tolist()]}
    path.write_text(json.dumps(polygon))
    return path


def test_volumes_profiles_and_contours_are_measured(
    with_heights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    area = _area(with_heights, tmp_path / "area.geojson")
    assert main(["measure", "volume", str(with_heights), "--area", str(area), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (
        found["volume"]["area_m2"] == pytest.approx(256, rel=0.05)
        and found["volume"]["sigma_m3"] > 0
    )
    assert main(["measure", "volume", str(with_heights), "--area", str(area)]) == 0
    assert "above the ground around" in capsys.readouterr().out
    corners = json.loads(area.read_text())["coordinates"][0]
    at = [f"--at={latitude},{longitude}" for longitude, latitude in corners[:3:2]]
    assert main(["measure", "profile", str(with_heights), *at]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("way_m,latitude_deg") and len(lines) > 50
    assert float(lines[-1].split(",")[0]) == pytest.approx(16 * 2**0.5, rel=0.02)
    out = tmp_path / "lines.geojson"
    assert (
        main(
            [
                "measure",
                "contours",
                str(with_heights),
                "--interval",
                "0.125",
                "--out",
                str(out),
            ]
        )
        == 0
    )
    features = json.loads(out.read_text())["features"]
    assert features and all(each["properties"]["height_m"] % 0.125 == 0 for each in features)


def test_heights_as_points_open_in_another_reader(with_heights: Path, tmp_path: Path) -> None:
    """LAZ by `history --export`: its head by LAS 1.4's own table, its points by another decoder than wrote them."""
    out, folder = tmp_path / "points.laz", next(with_heights.glob("flights/*/heights.tif")).parent
    assert main(["history", str(with_heights), "--export", str(out)]) == 0
    data = out.read_bytes()
    assert (data[:4], data[24:26], data[104] & 0x3F) == (b"LASF", b"\x01\x04", 7)
    assert data[6] & 0x10, "the CRS is stated as WKT"
    points = copclib.LazReader(str(out)).GetPoints()
    with rasterio.open(folder / "heights.tif") as heights:
        wkt = data[data.index(b"PROJCS") :].partition(b"\0")[0].decode()
        assert CRS.from_wkt(wkt).to_epsg() == heights.crs.to_epsg()
        places = np.column_stack([points.x, points.y])
        up_m, sigma_m = np.array(list(heights.sample(places))).T
        assert len(places) == np.isfinite(heights.read(1)).sum()
    np.testing.assert_allclose(np.array(points.z), up_m, atol=0.001)
    with rasterio.open(folder / "terrain.tif") as ground:
        above_m = up_m - np.array([each[0] for each in ground.sample(places)])
    classes = np.array(points.classification)
    assert set(classes) == {1, 2} and above_m[classes == 1].min() > 0
    assert np.array_equal(classes == 1, above_m > 2 * sigma_m)
    with rasterio.open(with_heights / "mosaic.tif") as map_:
        rgba = np.array(list(map_.sample(places)))
    seen = rgba[:, 3] > 0
    colours = np.column_stack([points.red, points.green, points.blue])
    assert seen.mean() > 0.5 and (colours[seen] == rgba[seen, :3].astype(int) * 257).mean() > 0.99


def test_points_need_heights_and_the_extra(
    with_heights: Path, mapped: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bare = Path(shutil.copytree(mapped, tmp_path / "bare"))
    for file in bare.glob("flights/*/heights.*"):
        file.unlink()
    with pytest.raises(InputError, match="sorvolo heights"):
        export_version(bare, None, tmp_path / "points.laz")
    monkeypatch.setitem(sys.modules, "lazrs", None)
    with pytest.raises(InputError, match=r"sorvolo\[laz\]"):
        export_version(with_heights, None, tmp_path / "points.laz")
    assert not (tmp_path / "points.laz").exists()


def test_measuring_names_what_is_missing(with_heights: Path, tmp_path: Path) -> None:
    area = _area(with_heights, tmp_path / "area.geojson")
    flight = next(with_heights.glob("flights/*/heights.json")).parent.name
    with pytest.raises(InputError, match="sorvolo heights"):
        measure_volume(with_heights, area, since="april")
    with pytest.raises(SettingsError, match="earlier"):
        measure_volume(with_heights, area, since=flight)
    with pytest.raises(SettingsError, match="two places"):
        measure_profile(with_heights, ["46.8,-91.9"])
    with pytest.raises(SettingsError, match="LAT,LON"):
        measure_profile(with_heights, ["here", "there"])
    with pytest.raises(SettingsError, match="interval_m"):
        write_contours(with_heights, tmp_path / "lines.geojson", 0.0)


def test_heights_of_an_earlier_map_of_the_flight_are_refused(
    with_heights: Path, tmp_path: Path
) -> None:
    report = next(with_heights.glob("flights/*/heights.json"))
    kept = report.read_text()
    try:
        _write(with_heights, report, json.dumps({**json.loads(kept), "run": "999"}))
        with pytest.raises(InputError, match="earlier map"):
            write_contours(with_heights, tmp_path / "lines.geojson", 1.0)
    finally:
        _write(with_heights, report, kept)


def test_a_search_knows_what_stands_high_where_the_site_has_heights(
    with_heights: Path, mapped: Path, tmp_path: Path
) -> None:
    """By the flight's own heights or by another's of the site; without any that can be read it goes by pictures."""
    truth = json.loads((with_heights.parent / "made" / "truth" / "objects.geojson").read_text())[
        "features"
    ]
    rings = [
        each["geometry"]["coordinates"][0] for each in truth if each["properties"]["height_m"] > 2.5
    ]
    with Archive.open(with_heights, write=False) as archive:
        above = heights_for(archive, archive.flights()[0].id)
        other = heights_for(archive, "another")
        frame = archive.site().frame
    assert above is not None and other is not None
    places_m = frame.ground_from_lonlat([np.mean(ring[:-1], axis=0) for ring in rings])
    above_m, sigma_m = above(places_m)
    known = np.isfinite(above_m)
    assert known.any() and (above_m[known] > 1.0).mean() >= 0.5 and (sigma_m[known] > 0).all(), (
        above_m
    )
    np.testing.assert_array_equal(other(places_m)[0], above_m)
    bare = Path(shutil.copytree(mapped, tmp_path / "bare"))
    for each in bare.glob("flights/*/heights.json"):  # of a test that came first
        each.unlink()
    with Archive.open(bare, write=False) as archive:
        assert heights_for(archive, archive.flights()[0].id) is None
    damaged = Path(shutil.copytree(with_heights, tmp_path / "site"))
    (report,) = damaged.glob("flights/*/heights.json")
    report.write_text("{")
    with Archive.open(damaged, write=False) as archive:
        assert heights_for(archive, archive.flights()[0].id) is None


@pytest.mark.parametrize(
    "content", [b"{}", b"[]", b"\xff", b'{"run": 1, "cell_m": 0}', b'{"run": 1, "cell_m": 1e999}']
)
def test_damaged_heights_are_named_and_no_comparison_stops_at_them(
    mapped: Path, tmp_path: Path, content: bytes
) -> None:
    """Comparisons do without them and announce it; who wants heights is asked to make them again."""
    report = next(mapped.glob("flights/*/frames.geojson")).with_name("heights.json")
    kept = report.read_bytes() if report.exists() else None
    report.write_bytes(content)
    try:
        with pytest.raises(
            InputError, match=r"damaged heights.json; make its heights again: sorvolo heights"
        ):
            write_contours(mapped, tmp_path / "lines.geojson", 1.0)
        with Archive.open(mapped, write=False) as archive:
            _earlier_pictures(archive, "later")
            assert heights_stamps(archive, but="later") == {}
            (notice,) = without_heights(archive, "later")
            assert report.parent.name in notice.text and "sorvolo heights" in notice.text
            assert without_heights(archive, report.parent.name) == ()
    finally:
        report.unlink() if kept is None else report.write_bytes(kept)


@pytest.mark.long
def test_brighton_beach_has_heights(tmp_path: Path) -> None:
    photos = real_data("flights/brighton_beach")
    list(map_flights([photos], tmp_path / "site", MapSettings(model="none", m_per_px=0.2)))
    mapped = json.loads(next((tmp_path / "site").glob("flights/*/report.json")).read_text())
    assert not mapped["shape"]["is_flat"] and "not level" in mapped["shape"]["why"]
    assert mapped["headline"]["quality"] == "map" and mapped["residual_px"]["median"] < 1
    report = json.loads(next((tmp_path / "site").glob("flights/*/heights.json")).read_text())
    assert report["cameras"]["views"] == 18 and report["cameras"]["residual_rms_px"] < 1.5
    assert (
        8 < report["surface"]["up_m"]["p99"] - report["surface"]["up_m"]["median"] < 20
    )  # the trees


def test_a_changed_area_has_its_height_change_where_both_flights_have_heights(
    with_heights: Path,
) -> None:
    """The later flight's heights: those of the first, a heap of 0.8 m on them, the whole 0.3 m higher."""
    folder = next(with_heights.glob("flights/*/heights.json")).parent
    other = folder.with_name("other")
    other.mkdir()
    try:
        with rasterio.open(folder / "heights.tif") as earlier:
            profile, (up_m, sigma_m) = earlier.profile, earlier.read()
            rows, columns = up_m.shape
        with Archive.open(with_heights, write=False) as archive:
            cell_m = json.loads((folder / "heights.json").read_text())["cell_m"]
            middle = read_field(archive, folder.name, HeightFile.SURFACE).lattice.points_m()[
                rows // 2, columns // 2
            ]
        side = (
            np.hypot(
                *np.mgrid[-(rows // 2) : rows - rows // 2, -(columns // 2) : columns - columns // 2]
            )
            * cell_m
        )
        with rasterio.open(other / "heights.tif", "w", **profile) as later:
            later.write(np.stack([up_m + 0.3 + 0.8 * (side < 3.0), sigma_m]))
        (other / "heights.json").write_text((folder / "heights.json").read_text())
        around = np.linspace(0, 2 * np.pi, 16, endpoint=False)
        heap = middle + 2.5 * np.column_stack([np.cos(around), np.sin(around)])
        area = replace(fake_change(1, kind=ChangeKind.AREA), outline_m=heap)
        with Archive.open(with_heights, write=False) as archive:
            beyond = replace(area, id="b-9", outline_m=heap + 1000)
            (risen, thing, unseen), (notice,) = with_height_changes(
                archive, "other", [area, fake_change(2), beyond]
            )
            assert (
                unseen.height_change is None
                and notice.count == 1
                and "1 of 2 changed areas" in notice.text
            )
            assert thing.height_change is None and risen.height_change is not None
            assert abs(risen.height_change.rise_m - 0.8) < 2 * risen.height_change.sigma_m
            assert risen.height_change.rise_m == pytest.approx(0.8, abs=0.1)
            (unknown,), notices = with_height_changes(archive, "third", [area])
            assert unknown.height_change is None and not notices
    finally:
        shutil.rmtree(other)


@pytest.mark.parametrize(
    "is_uneven, asked, where, is_flat, why",
    [
        (False, None, {}, True, "level plane"),
        (True, None, {}, False, "not level"),
        (True, False, {}, True, "asked for"),
        (False, True, {}, False, "asked for"),
        (True, None, {"is_tied": True}, True, "tied to known ground"),
        (True, True, {"is_local": True}, True, "GPS"),
        (True, None, {"is_live": True}, True, "101 pictures take long"),
    ],
)
def test_a_map_stands_on_heights_where_its_ground_is_not_level_or_one_asks_for_it(
    is_uneven: bool, asked: bool | None, where: dict[str, bool], is_flat: bool, why: str
) -> None:
    graph = GraphReport(1.0, 0.1, 0.0, 0.0, 3, 0, 0.0, 0.3, is_uneven=is_uneven)
    frames = [SimpleNamespace(site_from_camera=object())] * 101
    shape = shape_of(graph, frames, asked, **{"is_local": False, "is_tied": False} | where)
    assert shape.is_flat is is_flat and why in shape.why
