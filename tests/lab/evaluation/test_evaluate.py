"""`sorvolo evaluate mosaic`: known displacements come back as the numbers they are; wrong files are named."""

import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from rasterio.warp import calculate_default_transform, reproject
from typer.testing import CliRunner

from sorvolo.cli.evaluate import evaluate_app
from sorvolo.errors import InputError, StoreError
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.geodesy import Geodetic, Projection
from sorvolo.geometry.ground import footprint
from sorvolo.geometry.homography import apply_homography, site_from_image_homography
from sorvolo.geometry.pose import NADIR_CAMERA_NORTH_UP, Pose
from sorvolo.lab.evaluation.changes import evaluate_changes
from sorvolo.lab.evaluation.mosaic import evaluate_mosaic
from sorvolo.mosaic.canvas import Canvas
from sorvolo.mosaic.canvas_frame import CanvasFrame
from sorvolo.store.site.archive import Archive
from sorvolo.survey.flight import Site
from sorvolo.survey.mosaic import PlacedFrame, Status

CAMERA = Camera(320, 240, 300.0, 300.0, 159.5, 119.5)
SITE = Site("field", Geodetic(45.5, 9.2, 150.0), "EPSG:32632", 0.1)
M_PER_PX = 0.1
HEIGHT_M = 30.0
MISPLACED_M = np.array([0.3, 0.4])


def ground() -> np.ndarray:
    """A picture of the site from 60 m west, 60 m north of its origin, 0.1 m a pixel."""
    rng = np.random.default_rng(0)
    total = np.zeros((1200, 1200, 3), np.float32)
    for octave in (5, 20, 80):
        small = rng.normal(0, 1, (1200 // octave, 1200 // octave, 3)).astype(np.float32)
        total += cv2.resize(small, (1200, 1200), interpolation=cv2.INTER_CUBIC)
    return np.clip(128 + 25 * total, 0, 255).astype(np.uint8)


def made_frame(index: int, status: Status) -> tuple[PlacedFrame, np.ndarray]:
    """A frame as the map has it: everything lies 0.3 m east and 0.4 m north of where it was taken."""
    place = np.array([-30.0 + 10.0 * (index % 4), -12.0 + 14.0 * (index // 4), HEIGHT_M])
    pose = Pose(NADIR_CAMERA_NORTH_UP, place + np.array([*MISPLACED_M, 0.0]))
    site_from_image = site_from_image_homography(CAMERA, pose)
    ground_from_site = np.array([[10.0, 0, 600], [0, -10.0, 600], [0, 0, 1]])
    truly = site_from_image_homography(CAMERA, Pose(NADIR_CAMERA_NORTH_UP, place))
    image = cv2.warpPerspective(
        GROUND, np.linalg.inv(ground_from_site @ truly), (320, 240), flags=cv2.INTER_AREA
    )
    outline = footprint(CAMERA, pose) if status is not Status.REJECTED else np.full((4, 2), np.nan)
    placed = PlacedFrame(
        str(index),
        index,
        1_700_000_000_000_000_000 + index,
        status,
        "" if status is Status.VISION else "no match",
        CAMERA,
        None if status is Status.REJECTED else pose,
        site_from_image,
        outline,
        0.4,
        0.1,
    )
    return placed, image


GROUND = ground()
STATUSES = [Status.VISION] * 9 + [Status.GPS_ONLY, Status.GPS_ONLY, Status.REJECTED]


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("evaluate") / "site"
    frames = [made_frame(index, status) for index, status in enumerate(STATUSES)]
    with Archive.open(folder, write=True) as archive:
        archive.create_site(SITE)
        site_grid = archive.site_grid()
        grid_from_site = site_grid.grid_from_site_affine(np.zeros(2), 50.0)
        with archive.begin_flight("flight1", "print", {"method": "planar"}) as writer:
            paths = {
                placed.index: writer.save_image(placed.index, image) for placed, image in frames
            }
            canvas = Canvas(site_grid.grid, writer.tiles, writer.image)
            canvas.paint(
                CanvasFrame(placed.index, 0, 320, 240, grid_from_site @ placed.site_from_image)
                for placed, _ in frames
                if placed.status is not Status.REJECTED
            )
            writer.commit([placed for placed, _ in frames], paths, {}, "<html></html>")
    return folder


@pytest.fixture
def truth(tmp_path) -> Path:
    """Frames where they were taken, and fixes one metre north of the cameras; two frames more."""
    features = []
    for index in range(len(STATUSES) + 2):
        placed, _ = made_frame(index, Status.VISION)
        camera_m = placed.site_from_camera.translation_m[:2] - MISPLACED_M
        latitude, longitude, _ = SITE.frame.wgs84_from_site(
            np.vstack([placed.outline_m - MISPLACED_M, camera_m, camera_m + np.array([0.0, 1.0])])
        )
        ring = [[longitude[i], latitude[i]] for i in (0, 1, 2, 3, 0)]
        features.append(
            {
                "type": "Feature",
                "geometry": {"type": "Polygon", "coordinates": [ring]},
                "properties": {
                    "flight": "flight1",
                    "frame": index,
                    "camera_longitude_deg": longitude[4],
                    "camera_latitude_deg": latitude[4],
                    "fix_longitude_deg": longitude[5],
                    "fix_latitude_deg": latitude[5],
                },
            }
        )
    (tmp_path / "truth").mkdir()
    path = tmp_path / "truth" / "frames.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    return tmp_path


def rewrite(truth: Path, change) -> None:
    path = truth / "truth" / "frames.geojson"
    collection = json.loads(path.read_text())
    for feature in collection["features"]:
        change(feature)
    path.write_text(json.dumps(collection))


def test_displacement_is_split_into_shape_and_datum(site, truth):
    measured = evaluate_mosaic(site, truth=truth)
    (flight,) = measured.flights
    assert (flight.selected, flight.vision, flight.gps_only, flight.rejected) == (12, 9, 2, 1)
    assert flight.unmatched == 0
    (errors,) = measured.truth
    assert errors.corners.absolute.count == 4 * 9
    assert errors.corners.absolute.rms_m == pytest.approx(0.5, abs=1e-3)
    assert errors.corners.absolute.rms_px == pytest.approx(5.0, abs=1e-2)
    assert errors.corners.shape.max_m < 1e-3
    assert errors.corners.floor.rms_m == pytest.approx(1.0, abs=1e-3)
    assert errors.corners.over_floor == pytest.approx(0.5, abs=2e-3)
    assert errors.gps_only.count == 8
    assert errors.gps_only.rms_m == pytest.approx(0.5, abs=1e-3)
    assert errors.cameras.rms_m == pytest.approx(0.5, abs=1e-3)


@pytest.mark.parametrize("part", ["truth", "truth/frames.geojson"])
def test_the_truth_may_be_named_as_folder_or_file(site, truth, part):
    assert len(evaluate_mosaic(site, truth=truth / part).truth) == 1


def test_one_flight_under_another_name_is_still_paired(site, truth):
    rewrite(truth, lambda feature: feature["properties"].update(flight="photos"))
    assert evaluate_mosaic(site, truth=truth).truth[0].corners.absolute.count == 36


def test_frames_unknown_to_the_truth_are_counted(site, truth):
    path = truth / "truth" / "frames.geojson"
    collection = json.loads(path.read_text())
    collection["features"] = collection["features"][:6]
    path.write_text(json.dumps(collection))
    measured = evaluate_mosaic(site, truth=truth)
    assert measured.flights[0].unmatched == 6
    assert measured.truth[0].corners.absolute.count == 24


def test_missing_fixes_leave_the_floor_open(site, truth):
    nothing = {"fix_longitude_deg": None, "fix_latitude_deg": None}
    rewrite(truth, lambda feature: feature["properties"].update(nothing))
    assert math.isnan(evaluate_mosaic(site, truth=truth).truth[0].corners.over_floor)


def test_wrong_truth_is_refused(site, truth, tmp_path):
    def far(feature):
        for point in feature["geometry"]["coordinates"][0]:
            point[1] += 1.0

    rewrite(
        truth,
        lambda feature: feature["properties"].update(frame=f"x{feature['properties']['frame']}"),
    )
    with pytest.raises(InputError, match="no frame is in both"):
        evaluate_mosaic(site, truth=truth)
    rewrite(
        truth,
        lambda feature: feature["properties"].update(frame=feature["properties"]["frame"][1:]),
    )
    rewrite(truth, far)
    with pytest.raises(InputError, match="111 km"):
        evaluate_mosaic(site, truth=truth)
    (truth / "truth" / "frames.geojson").write_text('{"features": [{}]}')
    with pytest.raises(InputError, match=r"formats\.md"):
        evaluate_mosaic(site, truth=truth)
    (truth / "truth" / "frames.geojson").write_bytes(b"\xff\x00")
    with pytest.raises(InputError, match="GeoJSON"):
        evaluate_mosaic(site, truth=truth)
    with pytest.raises(InputError, match="sorvolo simulate"):
        evaluate_mosaic(site, truth=tmp_path / "nothing")
    with pytest.raises(StoreError):
        evaluate_mosaic(tmp_path / "nothing")


@pytest.mark.parametrize("measure", [evaluate_mosaic, evaluate_changes])
def test_site_and_truth_that_are_swapped_are_reported(site, truth, measure):
    with pytest.raises(
        InputError, match=r"a simulation's folder, no site; give the site first, and truth"
    ):
        measure(truth, truth=site)


def test_the_map_hardly_deviates_from_its_frames(site):
    deviation = evaluate_mosaic(site).deviation
    assert deviation.frames == 11
    assert 0 < deviation.mean <= deviation.worst < 0.05
    assert deviation.histogram.sum() == pytest.approx(1.0)


def test_the_map_is_like_itself(site):
    match = evaluate_mosaic(site, reference=site / "mosaic.tif").reference
    assert match.correlation == pytest.approx(1.0, abs=1e-6)
    assert abs(match.shift_east_m) + abs(match.shift_north_m) < 0.01


@pytest.mark.parametrize("crs", ["EPSG:32632", "EPSG:32633"])
def test_a_reference_elsewhere_shows_as_shift(site, tmp_path, crs):
    """The same picture one metre east and half a metre south, in the site's UTM zone and in the next one."""
    with rasterio.open(site / "mosaic.tif") as source:
        pixels, profile = source.read(), source.profile
    profile.update(
        driver="GTiff", transform=rasterio.Affine.translation(1.0, -0.5) @ profile["transform"]
    )
    path = tmp_path / "moved.tif"
    with rasterio.open(path, "w", **profile) as target:
        target.write(pixels)
    if crs != "EPSG:32632":
        path = turned_into(path, crs)
    match = evaluate_mosaic(site, reference=path).reference
    assert match.shift_east_m == pytest.approx(-1.0, abs=0.06)
    assert match.shift_north_m == pytest.approx(0.5, abs=0.06)
    assert match.correlation < 0.8 < match.correlation_after_shift


def turned_into(path: Path, crs: str) -> Path:
    with rasterio.open(path) as source:
        transform, width, height = calculate_default_transform(
            source.crs, crs, source.width, source.height, *source.bounds, resolution=M_PER_PX
        )
        profile = {
            **source.profile,
            "crs": crs,
            "transform": transform,
            "width": width,
            "height": height,
        }
        with rasterio.open(path.with_name("turned.tif"), "w", **profile) as target:
            reproject(
                rasterio.band(source, [1, 2, 3, 4]),
                rasterio.band(target, [1, 2, 3, 4]),
                resampling=rasterio.enums.Resampling.bilinear,
            )
    return path.with_name("turned.tif")


def test_a_reference_that_is_none_is_refused(site, tmp_path):
    (tmp_path / "text.tif").write_text("no picture")
    with pytest.raises(InputError):
        evaluate_mosaic(site, reference=tmp_path / "text.tif")


def positions_file(folder: Path, extra: str) -> Path:
    rows = ["frame,longitude_deg,latitude_deg,height_m"]
    for index in range(6):
        placed, _ = made_frame(index, Status.VISION)
        place = placed.site_from_camera.translation_m - np.array([*MISPLACED_M, 0.0])
        latitude, longitude, height = SITE.frame.wgs84_from_site(place[None])
        rows.append(f"{index},{longitude[0]:.11f},{latitude[0]:.11f},{height[0]:.4f}")
    path = folder / "positions.csv"
    path.write_text("\n".join(rows) + "\n" + extra)
    return path


def test_camera_positions_are_compared(site, tmp_path):
    extra = "none,9.2,45.5,100\n"
    measured = evaluate_mosaic(site, positions=positions_file(tmp_path, extra=extra)).positions
    assert measured.absolute.count == 6
    assert measured.absolute.rms_m == pytest.approx(0.5, abs=0.02)
    assert measured.shape.rms_m < 0.02
    assert measured.missing == 1


@pytest.mark.parametrize(
    "text", ["", "a,b\n1,2\n", "frame,longitude_deg,latitude_deg\n1,x,2\n", "\0\0"]
)
def test_broken_positions_are_refused(site, tmp_path, text):
    path = tmp_path / "broken.csv"
    path.write_text(text)
    with pytest.raises(InputError):
        evaluate_mosaic(site, positions=path)


def test_positions_without_a_column_state_which_there_are(site, tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("name,longitude_deg,latitude_deg\n1,9.2,45.5\n")
    with pytest.raises(
        InputError, match="no column frame, but name, longitude_deg, latitude_deg; needed are"
    ):
        evaluate_mosaic(site, positions=path)


def test_the_command_prints_a_table_and_json(site, truth):
    runner = CliRunner()
    plain = runner.invoke(
        evaluate_app, ["mosaic", str(site), "--truth", str(truth)], env={"COLUMNS": "160"}
    )
    assert plain.exit_code == 0
    assert "shape only" in plain.output
    assert "0.500" in plain.output
    answer = runner.invoke(evaluate_app, ["mosaic", str(site), "--truth", str(truth), "--json"])
    content = json.loads(answer.output)
    assert content["truth"][0]["corners"]["absolute"]["rms_m"] == pytest.approx(0.5, abs=1e-3)
    assert content["reference"] is None
    assert content["deviation"]["frames"] == 11


def test_the_fixture_shows_the_ground_where_it_should(site):
    """Guards the other tests: the painted map is the ground moved by the misplacement."""
    with Archive.open(site, write=False) as archive:
        grid, tiles = archive.site_grid(), archive.tiles()
        picture = np.zeros((512, 512, 4), np.uint8) if (0, 0) not in tiles else tiles[0, 0]
    seen = np.argwhere(picture[..., 3] > 0)
    assert len(seen) > 1000
    pixels = seen[:: len(seen) // 50, ::-1].astype(float)
    projected = grid.grid.projected_from_grid(pixels)
    latitude, longitude = Projection(SITE.crs).wgs84_from_projected(projected)
    places = (
        SITE.frame.site_from_wgs84(latitude, longitude, np.full(len(pixels), 150.0))[:, :2]
        - MISPLACED_M
    )
    where = apply_homography(np.array([[10.0, 0, 600], [0, -10.0, 600], [0, 0, 1]]), places)
    expected = GROUND[np.rint(where[:, 1]).astype(int), np.rint(where[:, 0]).astype(int)].astype(
        int
    )
    shown = picture[pixels[:, 1].astype(int), pixels[:, 0].astype(int), :3].astype(int)
    assert np.abs(expected - shown).mean() < 15
