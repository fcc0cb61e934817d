"""`sorvolo map` on a small simulated flight: the summary, JSON, the files, and a stop in the middle."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from small_flights import simulate_into
from sorvolo.cli import main as cli
from sorvolo.cli.progress import words_of
from sorvolo.cli.simulate import _is_simulated, _next_steps
from sorvolo.lab.simulation.presets import preset
from sorvolo.lab.simulation.settings import SimulationSettings
from sorvolo.store.site.archive import Archive
from sorvolo.survey.mosaic import MosaicUpdate, Status


def _settings() -> SimulationSettings:
    demo = preset("demo")
    return replace(
        demo,
        flights=1,
        scene=replace(demo.scene, people=0, cars=0, small_objects=0, has_scenery=False),
        path=replace(demo.path, length_m=24, strips=1),
        imaging=replace(demo.imaging, width_px=480, height_px=270, fps=5),
    )


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    folder = tmp_path_factory.mktemp("map") / "simulated"
    simulate_into(folder, _settings())
    yield folder


def _arguments(simulated: Path, site: Path) -> list[str]:
    video, camera = simulated / "flight1" / "flight1.mp4", simulated / "camera.xml"
    return ["map", "--model", "none", str(video), "--site", str(site), "--camera", str(camera)]


def test_json_then_words(
    simulated: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    site = tmp_path / "site"
    assert cli.main([*_arguments(simulated, site), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert Path(printed["preview_png"]).is_file() and Path(printed["mosaic_tif"]).is_file()
    (report,) = printed["flights"]
    assert report["flight"] == "flight1" and "track" not in report
    assert (
        report["frames"]["selected"] == sum(report["frames"][status.value] for status in Status) > 2
    )

    assert cli.main(_arguments(simulated, site)) == 0
    words = capsys.readouterr().out
    assert "flight1" in words and f"{report['frames']['selected']} selected" in words
    assert str(site / "flights" / "flight1" / "report.html") in words.replace("\n", "")
    assert str(site / "mosaic.tif") in words

    assert cli.main(["evaluate", "mosaic", str(site), "--truth", str(simulated), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["site"] == "site"


def test_a_stop_leaves_the_site_as_it_was(simulated: Path, tmp_path: Path) -> None:
    site = tmp_path / "site"
    command = [sys.executable, "-m", "sorvolo", *_arguments(simulated, site)]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as running:
        deadline = time.monotonic() + 60
        while not (site / "site.db").exists() and time.monotonic() < deadline:
            time.sleep(0.02)
        os.kill(running.pid, signal.SIGINT)
        out, err = running.communicate(timeout=60)
    assert running.returncode == 130, err
    assert out == ""
    assert (
        err.splitlines()[-1]
        == "stopped; unfinished work was discarded, everything before it is unchanged"
    )
    with Archive.open(site, write=False) as archive:
        assert not [flight for flight in archive.flights() if flight.status == "complete"]


def test_demo_takes_its_own_flights_again_and_no_others(simulated: Path, tmp_path: Path) -> None:
    assert _is_simulated(simulated, _settings())
    assert not _is_simulated(simulated, replace(_settings(), seed=2))
    assert not _is_simulated(tmp_path, _settings())
    (tmp_path / "simulation.json").write_text('{"settings": []')
    assert not _is_simulated(tmp_path, _settings())


def test_demo_ends_with_the_address_of_a_station() -> None:
    *_, where, command = _next_steps(Path("demo-site"), Path("demo-site/site"))
    assert "http://127.0.0.1:8750/" in where and command.split() == [
        "sorvolo",
        "serve",
        "demo-site",
        "--open",
    ]


def test_demo_leaves_other_peoples_files(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    precious = tmp_path / "simulation" / "thesis.txt"
    precious.parent.mkdir()
    precious.write_text("years of work")
    assert cli.main(["demo", str(tmp_path)]) == 1
    assert "is not empty" in capsys.readouterr().err
    assert precious.read_text() == "years of work"


def test_bar_words() -> None:
    update = MosaicUpdate("flight1", "7", Status.VISION, "", 40, 100, 8, 7, 3, 4.0)
    assert words_of(update) == "10.0 frames/s, 7 of 8 frames matched"
    assert words_of(replace(update, seconds=0.0)) == "7 of 8 frames matched"
