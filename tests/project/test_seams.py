"""What another package adds, each by a few lines: a telemetry reader, a source, a detector, an export."""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import sorvolo
from small_flights import simulate_into, small_flight
from sorvolo.build import added
from sorvolo.capture.source import open_sources
from sorvolo.errors import SorvoloWarning
from sorvolo.missions.flight.detector_protocol import load_detector

PLUGIN = """
import json
from pathlib import Path

import numpy as np
import sorvolo


class Log:
    def recognises(head):
        return head.startswith(b"HERD1")

    def read(data, name):
        rows = np.array([line.split() for line in data.splitlines()[1:]], float)
        columns = {"latitude_deg": rows[:, 1], "longitude_deg": rows[:, 2], "height_above_takeoff_m": rows[:, 3]}
        return sorvolo.Telemetry("herd", (rows[:, 0] * 1e9).astype(int), columns)


def source(address):
    image = np.random.default_rng(0).integers(0, 255, (90, 160, 3), np.uint8)
    return sorvolo.frames([(10**9, image), (2 * 10**9, image)], camera="aov=70", name=address)


class Herd:
    version = "1"

    def detect(self, image):
        return sorvolo.Detections(np.zeros((0, 4)), np.zeros(0), np.zeros(0, int), ("cow",))


def export(site, flight):
    with sorvolo.Archive.open(site, write=False) as archive:
        (Path(site) / "herd.txt").write_text(f"{flight}: {len(archive.keyframes(flight))}")


def broken(site, flight):
    raise OSError("no herd here")
"""
ENTRIES = """[sorvolo.telemetry]
gone = not_there:Log
herd = herd_plugin:Log
[sorvolo.sources]
herd = herd_plugin:source
[sorvolo.detectors]
herd = herd_plugin:Herd
[sorvolo.exports]
herd = herd_plugin:export
lost = herd_plugin:broken
gone = not_there:export
"""


@pytest.fixture
def herd(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    package = tmp_path / "herd-1.0.dist-info"
    package.mkdir()
    (package / "METADATA").write_text("Metadata-Version: 2.1\nName: herd\nVersion: 1.0\n")
    (package / "entry_points.txt").write_text(ENTRIES)
    (tmp_path / "herd_plugin.py").write_text(PLUGIN)
    monkeypatch.syspath_prepend(tmp_path)
    added.cache_clear()
    yield
    added.cache_clear()


@pytest.mark.usefixtures("herd")
def test_a_package_adds_a_reader_a_source_and_a_detector(tmp_path: Path) -> None:
    log = tmp_path / "flight.herd"
    log.write_text("HERD1\n" + "\n".join(f"{1e9 + k} 52.{k:03d} 10 {30 + k}" for k in range(9)))
    (source,) = open_sources(["herd:north"], telemetry=None)
    assert (source.name, source.frame_count, source.frame_rate_hz) == ("north", 2, 1.0)
    picture = next(source.frames(lambda *_: True)).image
    with pytest.warns(
        SorvoloWarning, match=r"the telemetry reader 'gone' is left out: .*not_there:Log"
    ):
        given = sorvolo.frames([(1, picture), (2, picture)], telemetry=log)
    assert given.telemetry.format == "herd" and given.telemetry["latitude_deg"][8] == 52.008
    detector = load_detector("herd")
    assert (detector.classes, detector.info.name, detector.info.version) == (("cow",), "Herd", "1")
    assert load_detector("default").info.name == "default"


@pytest.mark.usefixtures("herd")
def test_frames_from_memory_are_mapped_and_given_to_exports(tmp_path: Path) -> None:
    flown = simulate_into(tmp_path / "flown", small_flight(7, length_m=20)) / "flight1"
    (video,) = open_sources([next(flown.glob("*.mp4"))])
    pictures = [(each.time_ns, each.image) for each in video.frames(lambda *_: True)]
    flight = sorvolo.frames(
        pictures, camera=flown.parent / "camera.xml", telemetry=video.telemetry, name="memory"
    )
    settings = sorvolo.MapSettings(model="none")
    with pytest.warns(SorvoloWarning) as told:
        (made,) = sorvolo.map_flights(flight, tmp_path / "site", settings).result()
    words = "\n".join(str(each.message) for each in told)
    assert "the export 'lost' of memory failed: OSError: no herd" in words
    assert "the export 'gone' of memory failed: ImportError: not_there:export" in words
    assert made.trusted and made.frames["vision"] == made.frames["selected"] > 3, made
    assert 0 < made.residual_px < 1 and made.done_utc == "" and made.paths["mosaic.tif"].is_file()
    assert json.loads(made.paths["report.json"].read_bytes())["headline"]["text"] == made.headline
    keyframes = int((tmp_path / "site" / "herd.txt").read_text().removeprefix("memory: "))
    assert keyframes == made.frames["vision"]
    (again,) = sorvolo.map_flights(flight, tmp_path / "site", settings).result()
    assert again.done_utc and again.frames == made.frames


def test_what_frames_must_be() -> None:
    picture = np.zeros((48, 64, 3), np.uint8)
    for pictures, words in (
        ([(0, picture)], "1 frames of 1 sizes; give two or more"),
        ([(0, picture), (1, picture[:24])], "2 frames of 2 sizes"),
        ([(1, picture), (1, picture)], "times do not increase"),
        ([(0, picture[..., 0]), (1, picture[..., 0])], "are no RGB pictures"),
    ):
        with pytest.raises(sorvolo.InputError, match=words):
            sorvolo.frames(pictures)
    flight = sorvolo.frames([(0, picture), (1, picture)])
    for option in (
        {"telemetry": "log.csv"},
        {"camera": "aov=70"},
    ):  # of which nothing would be used
        with pytest.raises(sorvolo.InputError, match="give them to `frames`"):
            open_sources([flight], **option)


def test_a_broken_package_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = tmp_path / "odd-1.0.dist-info"
    package.mkdir()
    (package / "METADATA").write_text("Metadata-Version: 2.1\nName: odd\nVersion: 1.0\n")
    (package / "entry_points.txt").write_text("[sorvolo.sources]\nodd = not_there:Odd\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ImportError, match=r"not_there:Odd.*sorvolo\.sources, cannot be loaded"):
        open_sources(["odd:1"])
