"""What strangers do with the library, each in a script of at most fifteen lines; run as they stand."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from small_flights import simulate_into, small_flight

SCRIPTS = {
    "a map's finds in geopandas": '''
        import sorvolo
        (made,) = sorvolo.map_flights(video, "field", camera=camera).result()
        with sorvolo.Archive.open("field", write=False) as archive:
            found = archive.findings(made.flight)
            table = found.to_geodataframe()
        assert table.crs.to_epsg() == 4326 and len(table) == len(found)
        assert found.__geo_interface__["type"] == "FeatureCollection"
    ''',
    "two GeoTIFFs compared": '''
        import numpy as np, rasterio, sorvolo
        with rasterio.open(old) as before, rasterio.open(new) as after:
            reference, query = (each.read((1, 2, 3)).transpose(1, 2, 0) for each in (before, after))
            known = (before.dataset_mask() > 0) & (after.dataset_mask() > 0)
            mask, boxes = sorvolo.compare_images(reference, query, valid=known)
            places = [before.xy(y + height / 2, x + width / 2) for x, y, width, height in boxes]
        assert len(places) == 1 and np.hypot(places[0][0] - 120, places[0][1] + 80) < 6
    ''',
    "frames from memory": '''
        import av, sorvolo
        pictures = []
        with av.open(video) as opened:
            for frame in opened.decode(video=0):
                pictures.append((int(frame.time * 1e9), frame.to_ndarray(format="rgb24")))
        flight = sorvolo.frames(pictures, camera=camera, name="memory")
        mission = sorvolo.map_flights(flight, "memory", sorvolo.MapSettings(model="none"))
        statuses = [update.status for update in mission]
        (made,) = mission.result()
        assert made.trusted and len(statuses) == made.frames["selected"] > 3
    ''',
    "a detector of one's own": '''
        import numpy as np, sorvolo
        class Bright:
            version = "1"
            def detect(self, image):
                y, x = np.unravel_index(image.sum(axis=2).argmax(), image.shape[:2])
                box = [[x - 8, y - 8, x + 8, y + 8]]
                return sorvolo.Detections(box, [0.9], [0], ("light",))
        outputs = sorvolo.WatchOutputs(folder="lights")
        (seen,) = sorvolo.watch(video, outputs=outputs, camera=camera, detector=Bright()).result()
        assert seen.frames["detected"] > 5 and seen.paths["report.html"].is_file()
    ''',
    "a telemetry reader of one's own": '''
        import numpy as np, sorvolo
        rows = np.loadtxt("flight.own")
        columns = {"latitude_deg": rows[:, 1], "longitude_deg": rows[:, 2]}
        own = sorvolo.Telemetry("own", (rows[:, 0] * 1e9).astype(int), columns)
        image = np.random.default_rng(0).integers(0, 255, (90, 160, 3), np.uint8)
        flight = sorvolo.frames([(0, image), (10**9, image)], camera="aov=70", telemetry=own)
        assert flight.telemetry.has_fixes
    ''',
    "an evaluation on COCO labels": '''
        import sorvolo
        sets = sorvolo.read_sets(["labelled"], held_out=0.5)
        measured = sorvolo.evaluate_detector([["default"]], sets)
        (scores,) = measured.sets
        assert 0 < scores.pictures <= 4 and "person" in [each.label for each in scores.classes]
    ''',
}  # fmt: skip


def write_inputs(folder: Path, filmed: Path) -> dict[str, str]:
    import rasterio
    from PIL import Image

    ground = np.random.default_rng(3).integers(60, 120, (160, 240, 3), np.uint8)
    changed = ground.copy()
    changed[64:96, 104:136] = (240, 220, 30)
    for name, picture in (("old", ground), ("new", changed)):
        with rasterio.open(
            folder / f"{name}.tif", "w", driver="GTiff", width=240, height=160, count=3, dtype="uint8",
            transform=rasterio.Affine(1, 0, 0, 0, -1, 0), crs="EPSG:32633",
        ) as opened:  # fmt: skip
            opened.write(picture.transpose(2, 0, 1))
    (folder / "flight.own").write_text("0 52 13\n1 52.0001 13\n")
    labelled = folder / "labelled"
    labelled.mkdir()
    images, boxes = [], []
    for number in range(4):
        Image.fromarray(ground).save(labelled / f"{number}.jpg")
        images.append({"id": number, "file_name": f"{number}.jpg", "width": 240, "height": 160})
        boxes.append({"id": number, "image_id": number, "category_id": 1, "bbox": [9, 9, 30, 50]})
    document = {"images": images, "annotations": boxes, "categories": [{"id": 1, "name": "person"}]}
    (labelled / "labels.json").write_text(json.dumps(document))
    flight = next(filmed.glob("flight1/*.mp4"))
    return {
        "video": str(flight),
        "camera": str(filmed / "camera.xml"),
        "old": "old.tif",
        "new": "new.tif",
    }


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, str]]:
    folder = tmp_path_factory.mktemp("scripts")
    flown = simulate_into(folder / "flown", small_flight(7, length_m=16, people=1))
    return folder, write_inputs(folder, flown)


@pytest.mark.parametrize("name", SCRIPTS)
def test_a_script_of_fifteen_lines(
    name: str, inputs: tuple[Path, dict[str, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    if "geopandas" in SCRIPTS[name] or "geodataframe" in SCRIPTS[name]:
        pytest.importorskip("geopandas")
    folder, names = inputs
    monkeypatch.chdir(folder)
    lines = [re.sub("^ {8}", "", line) for line in SCRIPTS[name].strip("\n").splitlines()]
    assert len(lines) <= 16  # the last is the closing quotes' own
    exec(compile("\n".join(lines), name, "exec"), dict(names))
