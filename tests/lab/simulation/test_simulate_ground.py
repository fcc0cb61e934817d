"""`sorvolo simulate --ground FILE.tif`: flights over an orthophoto of one's own, mapped and laid back over it."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from rasterio.transform import from_origin

from sorvolo.cli import main as cli

_EAST_M, _NORTH_M, _M_PER_PX = 500_000.0, 4_640_000.0, 0.1


@pytest.fixture(scope="module")
def orthophoto(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """100 m of ground with detail at every scale, in UTM 33 N."""
    rng = np.random.default_rng(5)
    picture = np.zeros((1000, 1000, 3), np.float32)
    for octave in (2, 8, 32, 128):
        noise = rng.normal(0, 1, (1000 // octave + 2, 1000 // octave + 2, 3)).astype(np.float32)
        picture += cv2.resize(noise, (1000, 1000), interpolation=cv2.INTER_CUBIC)
    path = tmp_path_factory.mktemp("ground") / "ortho.tif"
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        width=1000,
        height=1000,
        count=3,
        dtype="uint8",
        crs="EPSG:32633",
        transform=from_origin(_EAST_M, _NORTH_M, _M_PER_PX, _M_PER_PX),
    ) as file:
        file.write(np.clip(120 + 20 * picture, 0, 255).astype(np.uint8).transpose(2, 0, 1))
    return path


@pytest.mark.long
def test_a_flight_over_an_orthophoto_is_mapped_back_onto_it(
    orthophoto: Path, tmp_path: Path
) -> None:
    simulation, site = tmp_path / "simulation", tmp_path / "site"
    assert (
        cli.main(
            [
                "simulate",
                str(simulation),
                "--preset",
                "survey",
                "--ground",
                str(orthophoto),
                "--photos",
                "--seed",
                "3",
                "--flights",
                "1",
                "--length",
                "20",
                "--strips",
                "2",
                "--height",
                "20",
            ]
        )
        == 0
    )
    photos = simulation / "flight1" / "photos"
    camera = simulation / "camera.xml"
    options = ["--model", "none", "--camera", str(camera), "--gsd", "0.1"]
    assert cli.main(["map", str(photos), "--site", str(site), *options]) == 0
    with (
        rasterio.open(site / "mosaic.tif") as mosaic,
        rasterio.open(simulation / "truth" / "ground.tif") as ground,
    ):
        rgba = mosaic.read()
        rows, columns = np.nonzero(rgba[3] == 255)
        assert len(rows) > 20_000
        x, y = ~ground.transform @ (mosaic.transform @ (columns + 0.5, rows + 0.5))
        truth = ground.read()[:3, np.floor(y).astype(int), np.floor(x).astype(int)].mean(axis=0)
        drawn = ground.read()[:3].astype(int).mean(axis=0)
    assert np.corrcoef(rgba[:3, rows, columns].mean(axis=0), truth)[0, 1] > 0.7
    with rasterio.open(orthophoto) as file:
        mine = file.read().astype(int).mean(axis=0)
    assert drawn[drawn > 0].std() == pytest.approx(
        mine.std(), rel=0.35
    )  # its texture, objects and light apart


def test_a_file_that_is_no_orthophoto(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "ground.tif").write_bytes(b"no picture")
    assert (
        cli.main(["simulate", str(tmp_path / "made"), "--ground", str(tmp_path / "ground.tif")])
        == 1
    )
    assert "ground.tif" in capsys.readouterr().err and not (tmp_path / "made").exists()
