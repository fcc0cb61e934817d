"""Mode 2 on small simulated flights with a truth-fed detector: what is found, placed, written, and sent."""

import csv
import json
import re
import shlex
import socket
import sys
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import fromstring

import av
import cv2
import numpy as np
import pytest
import rasterio
from rasterio.transform import Affine
from toy_models import rectangle_model
from truth_detector import TruthDetector

from small_flights import simulate_into, small_flight
from sorvolo.capture.source import open_sources
from sorvolo.detection.contract import ModelInfo
from sorvolo.detection.detector import Detector
from sorvolo.errors import InputError, SettingsError, StoreError
from sorvolo.geometry.arrays import ImageRGB
from sorvolo.lab.datasets import read_dataset
from sorvolo.lab.simulation.settings import OutputSettings, SensorSettings
from sorvolo.missions.flight.sample_frames import pictures_move
from sorvolo.missions.watch.flights import watch
from sorvolo.missions.watch.run import WatchUpdate
from sorvolo.missions.watch.settings import WatchOutputs, WatchSettings
from sorvolo.survey.objects import CLASSES, Detections, no_detections
from sorvolo.tracking import headings

_FLOWN = replace(
    small_flight(
        77,
        height_m=25,
        speed_m_s=6,
        length_m=40,
        spacing_m=8,
        size_px=(480, 270),
        people=3,
        cars=2,
        output=OutputSettings(telemetry="all", truth_step=1),
    ),
    sensor=SensorSettings(noise_m=(0.4, 0.4, 0.2)),
)


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("watch") / "flown"
    return simulate_into(folder, _FLOWN)


def _video(flown: Path) -> Path:
    return flown / "flight1" / "flight1.mp4"


def _watch(
    flown: Path,
    folder: Path,
    detector: TruthDetector,
    settings: WatchSettings = WatchSettings(),
    **outputs: Any,
) -> list[WatchUpdate]:
    written = WatchOutputs(folder=folder, **outputs)
    return list(
        watch(_video(flown), settings, written, camera=flown / "camera.xml", detector=detector)
    )


def _read(path: Path) -> Any:
    return json.loads(path.read_text())


def _seen_objects(flown: Path) -> dict[int, tuple[str, np.ndarray]]:
    """The objects that are in at least five frames: class and place in the truth's metres."""
    boxes = _read(flown / "truth" / "flight1" / "boxes.json")["annotations"]
    often = {each["object_id"] for each in boxes}
    often = {each for each in often if sum(box["object_id"] == each for box in boxes) >= 5}
    features = _read(flown / "truth" / "objects.geojson")["features"]
    return {
        each["properties"]["id"]: (
            each["properties"]["class"],
            np.mean(np.array(each["geometry"]["coordinates"][0][:-1]), axis=0),
        )
        for each in features
        if each["properties"]["id"] in often
    }


def _metres(degrees: np.ndarray, latitude_deg: float) -> np.ndarray:
    return degrees * np.array([np.cos(np.radians(latitude_deg)), 1.0]) * 111_200


def test_a_receiver_that_had_stopped_places_nothing_unless_the_drone_hovered(
    flown: Path, detector: TruthDetector, tmp_path: Path
) -> None:
    """All fixes are one place: where the pictures move on, things lie tens of metres off, stated to a metre."""
    log, hover = tmp_path / "still.csv", tmp_path / "hover.mp4"
    rows = [f"{0.2 * k:.1f},41.8923377,12.6032935,25.0" for k in range(150)]
    log.write_text("\n".join(["offsetTime,latitude,longitude,relativeHeight", *rows]) + "\n")
    with av.open(str(_video(flown))) as source, av.open(str(hover), "w") as target:
        stream = target.add_stream("libx264", rate=5)
        stream.width, stream.height = 480, 270
        picture = next(source.decode(video=0)).to_ndarray(format="rgb24")
        for _ in range(20):
            target.mux(stream.encode(av.VideoFrame.from_ndarray(picture)))
        target.mux(stream.encode())
    assert not pictures_move(open_sources([hover])[0])
    written = WatchOutputs(folder=tmp_path / "watch")
    camera = flown / "camera.xml"
    list(watch(_video(flown), outputs=written, telemetry=log, camera=camera, detector=detector))
    texts = [each["text"] for each in _read(tmp_path / "watch" / "report.json")["notices"]]
    assert any(
        "all one place, and the pictures move: no object is placed" in each for each in texts
    )
    assert not (tmp_path / "watch" / "tracks.geojson").exists()


_Rows = list[dict[str, str]]


def _rows(flown: Path) -> _Rows:
    return list(csv.DictReader((flown / "flight1" / "flight1.csv").open()))


def _written(rows: _Rows, log: Path) -> Path:
    with log.open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    return log


def _swapped(rows: _Rows) -> _Rows:
    return [row | {"Latitude": row["Longitude"], "Longitude": row["Latitude"]} for row in rows]


def _stopped_half_way(rows: _Rows) -> _Rows:
    half = len(rows) // 2
    place = {name: rows[half][name] for name in ("Latitude", "Longitude")}
    return rows[:half] + [row | place for row in rows[half:]]


def _times(rows: _Rows, name: str, factor: float) -> _Rows:
    return [row | {name: str(factor * float(row[name]))} for row in rows]


@pytest.mark.parametrize(
    ("changed", "headline"),
    [
        (_swapped, "positions are a mirror image"),
        (_stopped_half_way, "do not follow the pictures"),
        (lambda rows: _times(rows, "relativeHeight", 1 / 0.3048), "(feet, a slope"),
        (lambda rows: _times(rows, "Gimbal:pitch", -1.0), "have no place on the ground"),
        (lambda rows: rows[15:], "its clock is off: about -1."),  # it begins 1.5 s after the video
        (lambda rows: rows, ""),
    ],
    ids=["swapped", "stopped", "feet", "upwards", "late", "right"],
)
def test_telemetry_that_the_pictures_contradict_makes_no_clean_headline(
    flown: Path,
    detector: TruthDetector,
    tmp_path: Path,
    changed: Callable[[_Rows], _Rows],
    headline: str,
) -> None:
    """Each ended as a right watch did: places 8 to 4,000,000 m off, stated to 1.3 m, or nobody there."""
    log = _written(changed(_rows(flown)), tmp_path / "log.csv")
    written = WatchOutputs(folder=tmp_path / "watch")
    camera = flown / "camera.xml"
    list(watch(_video(flown), outputs=written, telemetry=log, camera=camera, detector=detector))
    found = _read(tmp_path / "watch" / "report.json")["headline"]
    assert headline in found["text"] and found["complete"] is (not headline), found
    assert "no person" not in found["text"]


def test_a_straight_flight_says_that_nothing_checks_its_clock(tmp_path: Path) -> None:
    """It fits the log of any moment; this table counts from the video's own first frame. The accuracy of places left out
    how far the drone flies while a clock is off."""
    truth = OutputSettings(telemetry="all", truth_step=1)
    made = simulate_into(tmp_path / "made", small_flight(5, length_m=50, people=1, output=truth))
    detector, sigmas_m = TruthDetector(made), dict[bool, float]()
    for log, is_unsure in (("other/flight1.gpx", True), ("flight1.csv", False)):
        written = WatchOutputs(folder=tmp_path / str(is_unsure))
        settings = WatchSettings(ground_elevation_m=35.0 if is_unsure else None)
        given = {"telemetry": made / "flight1" / log, "camera": made / "camera.xml"}
        list(watch(_video(made), settings, outputs=written, detector=detector, **given))
        notices = _read(tmp_path / str(is_unsure) / "report.json")["notices"]
        assert ("clock_unchecked" in {each["code"] for each in notices}) is is_unsure
        tracks = _read(tmp_path / str(is_unsure) / "tracks.geojson")["features"]
        sigmas_m[is_unsure] = min(each["properties"]["sigma_m"] for each in tracks)
    # three seconds, where a log's first sample is tied to the first frame, at 5 m/s, along the flight
    more_m = np.sqrt(sigmas_m[True] ** 2 - sigmas_m[False] ** 2)
    assert more_m == pytest.approx(3 * 5 / np.sqrt(2), rel=0.1)


def test_each_object_once_at_its_place(
    flown: Path, detector: TruthDetector, tmp_path: Path
) -> None:
    folder = tmp_path / "watch"
    updates = _watch(flown, folder, detector)
    reported = [track.id for update in updates for track in update.new]
    assert len(reported) == len(set(reported))
    truth = _seen_objects(flown)
    tracks = _read(folder / "tracks.geojson")["features"]
    assert len(truth) >= 4
    assert sorted(each["properties"]["class"] for each in tracks) == sorted(
        name for name, _ in truth.values()
    )
    for each in tracks:
        place = np.array(each["geometry"]["coordinates"])
        near_m = [
            np.linalg.norm(_metres(place - middle, place[1]))
            for name, middle in truth.values()
            if name == each["properties"]["class"]
        ]
        assert min(near_m) < 1.5, each["properties"]
        assert 0 < each["properties"]["sigma_m"] < 3
        assert (folder / each["properties"]["crop"]).stat().st_size > 300
    report = _read(folder / "report.json")
    assert report["objects"]["total"] == len(tracks) and report["georeferenced"]
    assert report["model"]["licence"] == "CC0-1.0" and report["ended"] == "the source ended"
    assert report["frames"]["detected"] == len(updates) == report["frames"]["read"]
    lines = [json.loads(line) for line in (folder / "detections.jsonl").read_text().splitlines()]
    assert (
        len(lines)
        == report["detections"]["total"]
        == sum(len(update.detections) for update in updates)
    )
    assert len(_read(folder / "detections.geojson")["features"]) == len(lines)
    assert {each["properties"]["id"] for each in tracks} <= {line["track"] for line in lines}
    page = (folder / "report.html").read_text()
    assert "2 cars" in page
    assert "http://" not in page and "https://" not in page


def test_without_telemetry_objects_are_counted_in_the_picture(
    flown: Path, detector: TruthDetector, tmp_path: Path
) -> None:
    bare = tmp_path / "bare.mp4"
    bare.write_bytes(_video(flown).read_bytes())
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(0.2)
        port = receiver.getsockname()[1]
        outputs = WatchOutputs(folder=tmp_path / "watch", cot=f"udp://127.0.0.1:{port}")
        updates = list(watch(bare, outputs=outputs, camera=flown / "camera.xml", detector=detector))
        with pytest.raises(TimeoutError):
            receiver.recv(10_000)
    report = _read(tmp_path / "watch" / "report.json")
    codes = {each["code"] for each in report["notices"]}
    assert {"not_on_ground", "cot_without_place"} <= codes and not report["georeferenced"]
    counts = report["detections"]
    assert (
        counts["placed"] == 0 and counts["not_placed"] + counts["set_aside"] == counts["total"] > 0
    )
    truth = _seen_objects(flown)
    # without GPS the way back is another way, on which objects count again; a false alarm may count as well
    assert len(truth) <= report["objects"]["total"] <= 2 * len(truth) + 1 and updates
    folder = tmp_path / "watch"
    assert not [*folder.glob("*.geojson"), *folder.glob("*.kml"), *folder.glob("*.gpx")]
    assert _read(folder / "detections.json")["crs"] is None
    assert "No GeoJSON, KML or GPX is written" in (folder / "report.html").read_text()
    tracks = _read(folder / "tracks.json")
    assert tracks["crs"] is None and "x_px" in tracks["features"][0]["properties"]


@pytest.mark.parametrize("has_telemetry", [True, pytest.param(False, marks=pytest.mark.long)])
def test_views_never_exceed_the_frames_searched(
    flown: Path, tmp_path: Path, has_telemetry: bool
) -> None:
    """With the packaged detector: each track's views are frames that show it, each counted once."""
    video = _video(flown)
    if not has_telemetry:
        video = tmp_path / "bare.mp4"
        video.write_bytes(_video(flown).read_bytes())
    settings = WatchSettings(least_score=0.3, frames_per_second=5.001 / 5)
    folder = tmp_path / "watch"
    found = Detector.load("default", provider="cpu", threads=1)
    deque(
        watch(
            video,
            settings,
            WatchOutputs(folder=folder),
            camera=flown / "camera.xml",
            detector=found,
        ),
        0,
    )
    searched = _read(folder / "report.json")["frames"]["detected"]
    lines = [json.loads(line) for line in (folder / "detections.jsonl").read_text().splitlines()]
    features = _read(folder / ("tracks.geojson" if has_telemetry else "tracks.json"))["features"]
    views = {each["properties"]["id"]: each["properties"]["views"] for each in features}
    assert views and max(views.values()) >= 3, "a car that several frames show is one track"
    for track, count in views.items():
        assert count <= searched
        assert count <= len({line["frame"] for line in lines if line["track"] == track})


def test_after_a_cut_places_and_objects_begin_anew(
    flown: Path, detector: TruthDetector, tmp_path: Path
) -> None:
    """The same pictures upside down after a few of noise: other objects, in pixels of their own first picture."""
    random = np.random.default_rng(1)
    with av.open(str(_video(flown))) as video:
        pictures = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)][:15]
    noise = [random.integers(0, 255, pictures[0].shape, np.uint8) for _ in range(6)]
    frames = [*pictures, *noise, *(np.ascontiguousarray(each[::-1, ::-1]) for each in pictures)]
    (tmp_path / "photos").mkdir()
    for number, picture in enumerate(frames):
        cv2.imwrite(str(tmp_path / "photos" / f"{number:03d}.png"), picture[..., ::-1])
    finder = _InTheMiddle(detector.info)
    updates = list(
        watch(tmp_path / "photos", outputs=WatchOutputs(folder=tmp_path / "watch"), detector=finder)
    )
    first, last = updates[0].segment, updates[-1].segment
    assert first == 1 and last > 1
    tracks = [each["properties"] for each in _read(tmp_path / "watch" / "tracks.json")["features"]]
    assert {first, last} <= {each["segment"] for each in tracks}
    assert len({each["id"] for each in tracks}) == len(tracks)
    height, width = pictures[0].shape[:2]
    assert all(abs(each["x_px"]) < 3 * width and abs(each["y_px"]) < 3 * height for each in tracks)
    lines = [
        json.loads(line)
        for line in (tmp_path / "watch" / "detections.jsonl").read_text().splitlines()
    ]
    assert lines[0]["segment"] == 1 and lines[-1]["segment"] == last
    assert f"segment {last}" in (tmp_path / "watch" / "report.html").read_text()


class _InTheMiddle:
    """Finds a person in the middle of every picture that is not noise."""

    classes, provider, notices, others = CLASSES, "the middle", (), ()

    def __init__(self, info: ModelInfo) -> None:
        self.info = info

    def detect(self, image: ImageRGB, **_: object) -> Detections:
        if np.abs(np.diff(image.astype(int), axis=0)).mean() > 50:
            return no_detections(CLASSES)
        height, width = image.shape[:2]
        box = [width / 2 - 8, height / 2 - 8, width / 2 + 8, height / 2 + 8]
        return Detections(
            np.array([box]), np.array([0.9]), np.array([CLASSES.index("person")]), CLASSES
        )


def test_heights_without_a_ground_are_reported_and_can_be_helped(
    flown: Path, detector: TruthDetector, tmp_path: Path
) -> None:
    log = flown / "flight1" / "other" / "flight1.nmea"
    assert log.exists()
    outputs = WatchOutputs(folder=tmp_path / "unknown")
    few = WatchSettings(frames_per_second=1)
    list(
        watch(
            _video(flown),
            few,
            outputs,
            telemetry=log,
            camera=flown / "camera.xml",
            detector=detector,
        )
    )
    report = _read(tmp_path / "unknown" / "report.json")
    assert not report["georeferenced"]
    assert any("--ground-elevation" in each["text"] for each in report["notices"])
    outputs = WatchOutputs(folder=tmp_path / "known")
    settings = replace(few, ground_elevation_m=83.3 - 48.3)
    list(
        watch(
            _video(flown),
            settings,
            outputs,
            telemetry=log,
            camera=flown / "camera.xml",
            detector=detector,
        )
    )
    report = _read(tmp_path / "known" / "report.json")
    assert report["georeferenced"]
    assert any("straight down" in each["text"] for each in report["notices"])


def test_a_height_model_places_what_its_heights_alone_cannot(
    flown: Path, detector: TruthDetector, tmp_path: Path
) -> None:
    """Level ground given as a model is level ground given as a number; both together are not taken."""
    log = flown / "flight1" / "other" / "flight1.nmea"
    ground_m = 83.3 - 48.3
    model = tmp_path / "ground.tif"
    with rasterio.open(
        model,
        "w",
        driver="GTiff",
        width=200,
        height=200,
        count=1,
        dtype="float32",
        crs="EPSG:4326",
        transform=Affine(1e-4, 0, 12.5935, 0, -1e-4, 41.9025),
    ) as sink:
        sink.write(np.full((1, 200, 200), ground_m, np.float32))
    few = WatchSettings(frames_per_second=1)
    places = []
    for name, settings in (
        ("number", replace(few, ground_elevation_m=ground_m)),
        ("model", replace(few, height_model=str(model))),
    ):
        outputs = WatchOutputs(folder=tmp_path / name)
        list(
            watch(
                _video(flown),
                settings,
                outputs,
                telemetry=log,
                camera=flown / "camera.xml",
                detector=detector,
            )
        )
        assert _read(tmp_path / name / "report.json")["georeferenced"]
        tracks = _read(tmp_path / name / "tracks.geojson")["features"]
        places.append(
            [(each["properties"]["east_m"], each["properties"]["north_m"]) for each in tracks]
        )
    assert len(places[0]) > 3 and len(places[0]) == len(places[1])
    assert np.abs(np.subtract(*places)).max() < 0.05  # the model's own error is in the weights
    notices = _read(tmp_path / "model" / "report.json")["notices"]
    assert any("the height model's ground" in each["text"] for each in notices)
    with pytest.raises(SettingsError, match="not both"):
        replace(few, height_model=str(model), ground_elevation_m=3.0)
    # one that counts from the ellipsoid would put the ground tens of metres off
    with rasterio.open(model, "r+") as stored:
        stored.crs = "EPSG:4979"
    with pytest.raises(InputError, match="from ellipsoid, and the telemetry's are orthometric"):
        list(watch(_video(flown), settings, outputs, telemetry=log, camera=flown / "camera.xml"))


def test_those_who_want_it_are_alerted(
    flown: Path, detector: TruthDetector, tmp_path: Path
) -> None:
    script = tmp_path / "hook.py"
    script.write_text(
        "import json, sys\n"
        "reported = json.load(sys.stdin)\n"
        "open(sys.argv[1], 'a').write(json.dumps([sys.argv[2:], reported]) + '\\n')\n"
        "sys.exit(0 if open(reported['crop'], 'rb').read(2) == b'\\xff\\xd8' else 1)\n"
    )
    out = tmp_path / "alerts.jsonl"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(0.2)
        port = receiver.getsockname()[1]
        _watch(
            flown,
            tmp_path / "watch",
            detector,
            cot=f"udp://127.0.0.1:{port}",
            alert_command=f"{sys.executable} {script} {out} {{id}} '{{class}}'",
            alert_url="http://127.0.0.1:9/dead",
        )
        events = []
        while True:
            try:
                events.append(fromstring(receiver.recv(10_000)))
            except TimeoutError:
                break
    reported = [json.loads(line) for line in out.read_text().splitlines()]
    tracks = _read(tmp_path / "watch" / "tracks.geojson")["features"]
    assert {each["properties"]["id"] for each in tracks} <= {body["id"] for _, body in reported}
    assert all(words == [str(body["id"]), body["class"]] for words, body in reported)
    assert len({body["id"] for _, body in reported}) == len(reported)
    uids = [event.get("uid", "") for event in events]
    assert {uid.rsplit(".", 1)[1] for uid in uids} >= {
        str(each["properties"]["id"]) for each in tracks
    }
    assert len(uids) <= 4 * len(set(uids))  # at its pace, not with each frame
    notices = {each["code"]: each for each in _read(tmp_path / "watch" / "report.json")["notices"]}
    assert notices["alert_url_failed"]["count"] == len(reported)
    assert "alert_command_failed" not in notices


def test_only_the_classes_asked_for_in_the_frames_asked_for(
    flown: Path, detector: TruthDetector, tmp_path: Path
) -> None:
    settings = WatchSettings(classes=("car",), frames_per_second=5.001 / 7)
    updates = _watch(flown, tmp_path / "watch", detector, settings, save="pictures")
    with av.open(str(_video(flown))) as container:
        frames = sum(1 for _ in container.decode(video=0))
    assert frames % 7 != 1, "frames follow the last one that is searched"
    report = _read(tmp_path / "watch" / "report.json")
    counts = report["frames"]
    assert report["looked_for"] == ["car"]
    assert (
        (counts["read"], counts["detected"]) == (frames, len(updates)) == (frames, -(-frames // 7))
    )
    assert [int(update.frame_name) % 7 for update in updates] == [0] * len(updates)
    lines = [
        json.loads(line)
        for line in (tmp_path / "watch" / "detections.jsonl").read_text().splitlines()
    ]
    assert {line["class"] for line in lines} == {"car"}
    pictures = {int(path.stem) for path in (tmp_path / "watch" / "annotated").iterdir()}
    assert pictures == {int(line["frame"]) for line in lines}
    with pytest.raises(SettingsError, match=r"knows no 'boat'; it knows person, car"):
        _watch(flown, tmp_path / "other", detector, WatchSettings(classes=("boat",)))


def test_what_is_looked_for_is_reported(
    photographs: Path, detector: TruthDetector, tmp_path: Path
) -> None:
    """Classes on request are in the report where they were searched for, not where the model knows them."""
    finder = _Squares(replace(detector.info, on_request=("small object",)))
    outputs = WatchOutputs(folder=tmp_path / "out")
    list(watch(photographs, outputs=outputs, camera="aov=60", detector=finder))
    assert _read(tmp_path / "out" / "report.json")["looked_for"] == ["person", "car"]
    assert "Looked for: person, car." in (tmp_path / "out" / "report.html").read_text()


def test_the_model_that_looked_at_thermal_photos_is_reported(
    photographs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With its thresholds and licence; each photo counts once, however often its middle is looked at as well."""
    monkeypatch.setenv("SORVOLO_MODELS", str(tmp_path / "models"))
    (tmp_path / "models").mkdir()
    night = {
        "name": "night",
        "licence": "CC0-1.0 of the night",
        "thresholds": dict.fromkeys(CLASSES, 0.77),
    }
    rectangle_model(tmp_path / "models" / "night.onnx", **night)
    day = rectangle_model(
        tmp_path / "models" / "day.onnx", name="day", thermal=False, thermal_by="night"
    )
    list(
        watch(
            photographs,
            WatchSettings(model=str(day)),
            WatchOutputs(folder=tmp_path / "out"),
            camera="aov=60",
        )
    )
    report = _read(tmp_path / "out" / "report.json")
    (other,) = report["other_models"]
    assert report["model"]["name"] == "day" and other["name"] == "night"
    assert (other["licence"], other["thresholds"]["car"]) == ("CC0-1.0 of the night", 0.77)
    assert "CC0-1.0 of the night" in (tmp_path / "out" / "report.html").read_text()
    notices = {each["code"]: each["count"] for each in report["notices"]}
    assert notices["thermal_model"] == report["frames"]["detected"] == 4


def test_labels_can_be_read_back(flown: Path, detector: TruthDetector, tmp_path: Path) -> None:
    updates = _watch(flown, tmp_path / "watch", detector, labels=("coco", "yolo"))
    labels = tmp_path / "watch" / "labels"
    coco, yolo = read_dataset(labels / "coco.json"), read_dataset(labels, form="yolo")
    assert len(coco) == len(yolo) == len(list((labels / "images").iterdir()))
    seconds = (updates[-1].time_ns - updates[0].time_ns) / 1e9
    assert seconds / 1.3 <= len(coco) <= seconds + 1
    by_name = {f"flight1_{int(update.frame_name):06d}": update.detections for update in updates}
    for picture in (*coco.pictures, *yolo.pictures):
        found = by_name[Path(picture.path).stem]
        assert np.allclose(np.sort(picture.boxes_px, 0), np.sort(found.boxes_px, 0), atol=0.1)
    assert _read(labels / "coco.json")["annotations"][0]["score"] > 0.29


def test_closing_early_writes_what_was_found(
    flown: Path, detector: TruthDetector, tmp_path: Path
) -> None:
    outputs = WatchOutputs(folder=tmp_path / "watch", save="video")
    watching = watch(_video(flown), outputs=outputs, camera=flown / "camera.xml", detector=detector)
    for _ in range(12):
        next(watching)
    watching.cancel()
    report = _read(tmp_path / "watch" / "report.json")
    assert report["ended"] == "stopped on demand" and report["frames"]["detected"] == 12
    assert (tmp_path / "watch" / "annotated.mp4").exists() and (
        tmp_path / "watch" / "tracks.geojson"
    ).exists()


def test_a_second_watch_replaces_its_own_only(
    flown: Path, detector: TruthDetector, tmp_path: Path
) -> None:
    few = WatchSettings(frames_per_second=0.5)
    _watch(flown, tmp_path / "watch", detector, few)
    _watch(flown, tmp_path / "watch", detector, few)
    other = tmp_path / "other.mp4"
    other.write_bytes(_video(flown).read_bytes())
    outputs = WatchOutputs(folder=tmp_path / "watch")
    with pytest.raises(StoreError, match="holds a watch of flight1"):
        list(watch(other, few, outputs, camera=flown / "camera.xml", detector=detector))


def test_a_source_without_a_picture_is_an_error(detector: TruthDetector, tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "a.jpg").write_bytes(b"no picture")
    with pytest.raises(InputError):
        list(
            watch(
                tmp_path / "photos",
                outputs=WatchOutputs(folder=tmp_path / "out"),
                detector=detector,
            )
        )
    with pytest.raises(InputError, match="no such file"):
        list(watch(tmp_path / "gone.mp4", detector=detector))


def test_a_photo_that_cannot_be_read_is_reported_once(
    photographs: Path, detector: TruthDetector, tmp_path: Path
) -> None:
    (photographs / "IMG_1.jpg").write_bytes(b"no picture")
    cut = photographs / "IMG_2.jpg"
    cut.write_bytes(cut.read_bytes()[:-400])
    list(
        watch(
            photographs,
            outputs=WatchOutputs(folder=tmp_path / "out"),
            camera="aov=60",
            detector=_Squares(detector.info),
        )
    )
    notices = {
        each["code"]: each["count"] for each in _read(tmp_path / "out" / "report.json")["notices"]
    }
    assert notices["lost_frames"] == 2 and not {"unreadable_photo", "corrupt_photo"} & set(notices)


class _Squares:
    """A detector that needs no truth: bright squares on dark ground."""

    classes = ("person",)
    provider, notices, others = "here", (), ()

    def __init__(self, info: Any) -> None:
        self.info = info
        self.overlapping: set[object] = set()

    def detect(
        self, image: ImageRGB, *, tiles: object = None, overlapping: bool = False, **_: object
    ) -> Any:
        from sorvolo.survey.objects import Detections

        if tiles == "auto":  # of frames, not of their middle
            self.overlapping.add(overlapping)
        _, _, stats, _ = cv2.connectedComponentsWithStats((image[..., 0] > 200).astype(np.uint8))
        boxes = [[x, y, x + w, y + h] for x, y, w, h, area in stats[1:] if area > 20]
        count = len(boxes)
        return Detections(
            np.array(boxes, np.float32),
            np.full(count, 0.9),
            np.zeros(count, np.int64),
            self.classes,
        )


@pytest.fixture
def photographs(tmp_path: Path) -> Iterator[Path]:
    folder = tmp_path / "photos"
    folder.mkdir()
    for number in range(4):
        picture = np.full((200, 300, 3), 40, np.uint8)
        picture[100:110, 60 + 20 * number : 70 + 20 * number] = 255
        cv2.imwrite(str(folder / f"IMG_{number}.jpg"), picture)
    yield folder


def test_photos_without_anything_else(
    photographs: Path, detector: TruthDetector, tmp_path: Path
) -> None:
    outputs = WatchOutputs(folder=tmp_path / "out", save="pictures")
    finder = _Squares(detector.info)
    updates = list(watch(photographs, outputs=outputs, camera="aov=60", detector=finder))
    assert [len(update.detections) for update in updates] == [1] * 4
    assert finder.overlapping == {False}, "each may be searched in several sizes"
    assert sorted(path.name for path in (tmp_path / "out" / "annotated").iterdir()) == [
        f"IMG_{number}.jpg" for number in range(4)
    ]


def test_frames_of_a_video_are_not_worth_several_sizes(
    flown: Path, detector: TruthDetector, tmp_path: Path
) -> None:
    finder = _Squares(detector.info)
    settings = WatchSettings(frames_per_second=1)
    assert list(
        watch(_video(flown), settings, WatchOutputs(folder=tmp_path / "out"), detector=finder)
    )
    assert finder.overlapping == {True}


@pytest.mark.parametrize("wrong", [slice(2, None), slice(None)])
def test_a_gimbal_that_is_half_a_turn_off(wrong: slice, photographed: Path, tmp_path: Path) -> None:
    """What they show lies where it lay with the right angles, and the report names them."""
    detector = TruthDetector(photographed, misses=0, false_alarms=0)
    paths = sorted((photographed / "flight1" / "photos").glob("*.jpg"))[::3]
    reports, places = {}, {}
    for name, turned in {"right": paths[:0], "wrong": paths[wrong]}.items():
        (tmp_path / name).mkdir()
        for path in paths:
            photo = path.read_bytes()
            if path in turned:
                stated = re.search(rb'GimbalYawDegree="([^"]+)"', photo)
                assert stated is not None
                yaw_deg = (float(stated[1]) + 360) % 360 - 180
                photo = photo.replace(
                    stated[1], f"{yaw_deg:+{len(stated[1])}.3f}"[: len(stated[1])].encode()
                )
            (tmp_path / name / path.name).write_bytes(photo)
        out = tmp_path / f"{name}-watch"
        list(
            watch(
                tmp_path / name,
                outputs=WatchOutputs(folder=out),
                camera=photographed / "camera.xml",
                detector=detector,
            )
        )
        reports[name] = json.loads((out / "report.json").read_text())
        places[name] = sorted(
            (each["properties"]["class"], *each["geometry"]["coordinates"][:2])
            for each in json.loads((out / "tracks.geojson").read_text())["features"]
        )
    assert [each[0] for each in places["wrong"]] == [
        each[0] for each in places["right"]
    ] and places["right"]
    off_deg = np.array([each[1:] for each in places["wrong"]]) - np.array(
        [each[1:] for each in places["right"]]
    )
    assert np.abs(off_deg).max() < 2e-5  # 2 m
    notices = {row["code"]: row for row in reports["wrong"]["notices"]}
    assert notices["headings_wrong"]["count"] == len(paths[wrong])
    assert all(row["code"] != "headings_wrong" for row in reports["right"]["notices"])


Watched = tuple[list[tuple[str, float, float]], list[str]]


def _watched(
    source: Path, made: Path, detector: TruthDetector, out: Path, telemetry: Path | None = None
) -> Watched:
    """The classes and the places of what a watch finds, and the codes of its notices."""
    list(
        watch(
            source,
            outputs=WatchOutputs(folder=out),
            camera=made / "camera.xml",
            detector=detector,
            telemetry=telemetry,
        )
    )
    places = sorted(
        (each["properties"]["class"], *each["geometry"]["coordinates"][:2])
        for each in _read(out / "tracks.geojson")["features"]
    )
    return places, [row["code"] for row in _read(out / "report.json")["notices"]]


def _turned(flown: Path, off_deg: float, part: slice, log: Path) -> Path:
    """The video's telemetry with a part of its headings off, as a log."""
    rows = _rows(flown)
    for row in rows[part]:
        for name in ("Yaw", "Gimbal:yaw"):
            row[name] = f"{(float(row[name]) + off_deg + 180) % 360 - 180:.4f}"
    return _written(rows, log)


@pytest.fixture(scope="module")
def rightly_headed(
    flown: Path, detector: TruthDetector, tmp_path_factory: pytest.TempPathFactory
) -> Watched:
    """The video watched with the headings that it had."""
    out = tmp_path_factory.mktemp("headed") / "right"
    return _watched(_video(flown), flown, detector, out, flown / "flight1" / "flight1.csv")


@pytest.mark.parametrize(
    ("off_deg", "part"),
    [
        (180.0, slice(42, 62)),
        (180.0, slice(None)),
        (20.0, slice(None)),
        pytest.param(-90.0, slice(42, 62), marks=pytest.mark.long),
        (12.0, slice(None)),
    ],
)
def test_headings_of_a_video_that_are_far_off_are_set_right(
    off_deg: float,
    part: slice,
    flown: Path,
    detector: TruthDetector,
    rightly_headed: Watched,
    tmp_path: Path,
) -> None:
    """The same objects in the same places."""
    log = _turned(flown, off_deg, part, tmp_path / "off.csv")
    (right, before), (found, notices) = (
        rightly_headed,
        _watched(_video(flown), flown, detector, tmp_path / "off", log),
    )
    assert [each[0] for each in found] == [each[0] for each in right] and right
    beside_deg = np.array([each[1:] for each in found]) - np.array([each[1:] for each in right])
    assert np.abs(beside_deg).max() < 2e-5
    assert "headings_wrong" in notices
    assert "headings_wrong" not in before


def _low(row: dict[str, str]) -> None:
    """Its height above take-off a fifth too low."""
    row["relativeHeight"] = f"{0.8 * float(row['relativeHeight']):.3f}"


def _told(
    flown: Path, detector: TruthDetector, out: Path, wrong: Callable[[dict[str, str]], None]
) -> Watched:
    """What a watch finds with a log whose rows are wrong."""
    rows = _rows(flown)
    for row in rows:
        wrong(row)
    return _watched(_video(flown), flown, detector, out, _written(rows, out.with_suffix(".csv")))


def test_heights_that_are_off_are_set_right(
    flown: Path, detector: TruthDetector, rightly_headed: Watched, tmp_path: Path
) -> None:
    """The same objects in the same places."""
    right, before = rightly_headed
    found, notices = _told(flown, detector, tmp_path / "off", _low)
    assert [each[0] for each in found] == [each[0] for each in right]
    beside_deg = np.array([each[1:] for each in found]) - np.array([each[1:] for each in right])
    assert np.abs(beside_deg).max() < 2e-5
    assert "heights_wrong" in notices and "heights_wrong" not in before


def test_heights_of_a_log_without_angles_are_not_called_corrected(
    flown: Path, detector: TruthDetector, tmp_path: Path
) -> None:
    """There only the heading is taken from the pictures."""

    def wrong(row: dict[str, str]) -> None:
        _low(row)
        for name in _ANGLES & row.keys():
            del row[name]

    _, notices = _told(flown, detector, tmp_path / "off", wrong)
    assert "heights_wrong" not in notices


_ANGLES = {"Yaw", "Pitch", "Roll", "quatW", "quatX", "quatY", "quatZ"} | {
    f"Gimbal:{name}" for name in ("yaw", "pitch", "roll", "Xroll", "Xpitch", "Yyaw")
}


def test_a_heading_that_shows_only_later_makes_no_clean_headline(
    flown: Path, detector: TruthDetector, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As live, or after a hover longer than a watch looks ahead: half a turn off until then, things lie elsewhere."""
    monkeypatch.setattr(headings, "_AHEAD_NS", 10**9)
    log = _turned(flown, 180.0, slice(None), tmp_path / "off.csv")
    _, notices = _watched(_video(flown), flown, detector, tmp_path / "off", log)
    assert "headings_wrong" in notices
    headline = _read(tmp_path / "off" / "report.json")["headline"]
    assert (
        "headings are far off, which showed only after" in headline["text"]
        and not headline["complete"]
    )
    for each in _read(tmp_path / "off" / "tracks.geojson")["features"]:
        place = np.array(each["geometry"]["coordinates"])
        off_m = min(
            np.linalg.norm(_metres(place - middle, place[1]))
            for name, middle in _seen_objects(flown).values()
            if name == each["properties"]["class"]
        )
        assert off_m < 3 * each["properties"]["sigma_m"], each["properties"]


@pytest.mark.parametrize("shown_by", [1, 2])
def test_a_photo_that_alone_shows_something_is_enough(
    shown_by: int, detector: TruthDetector, tmp_path: Path
) -> None:
    """Three photos of different ground, one of them, or the last, with a person, who is alerted of once."""
    random = np.random.default_rng(2)
    (tmp_path / "photos").mkdir()
    for number, picture in enumerate(random.integers(0, 150, (3, 240, 320, 3), np.uint8)):
        picture[100:110, 160:170] = 255 if number == shown_by else 90
        cv2.imwrite(str(tmp_path / "photos" / f"{number}.png"), picture)
    save = (
        "import pathlib, sys; pathlib.Path(sys.argv[1]).open('a').write(sys.stdin.read() + chr(10))"
    )
    command = shlex.join([sys.executable, "-c", save, str(tmp_path / "alerts")])
    outputs = WatchOutputs(folder=tmp_path / "out", alert_command=command)
    updates = list(watch(tmp_path / "photos", outputs=outputs, detector=_Squares(detector.info)))
    assert [len(update.detections) for update in updates] == [
        int(number == shown_by) for number in range(3)
    ]
    (track,) = [each["properties"] for each in _read(tmp_path / "out" / "tracks.json")["features"]]
    (alert,) = [json.loads(line) for line in (tmp_path / "alerts").read_text().splitlines()]
    assert (
        track["views"] == 1 and alert["id"] == track["id"] and alert["segment"] == track["segment"]
    )
    assert Path(alert["crop"]).is_file()


@pytest.mark.parametrize(
    "wrong",
    [{"least_score": 1.2}, {"frames_per_second": 0.0}],
)
def test_settings_that_cannot_be(wrong: dict[str, Any]) -> None:
    with pytest.raises(SettingsError):
        WatchSettings(**wrong)


@pytest.mark.parametrize(
    "wrong", [{"save": "gif"}, {"labels": ("voc",)}, {"cot": "tak"}, {"cot_stale_s": 0}]
)
def test_outputs_that_cannot_be(wrong: dict[str, Any]) -> None:
    with pytest.raises(SettingsError):
        WatchOutputs(**wrong)
