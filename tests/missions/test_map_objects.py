"""Objects through whole missions: a small simulated site mapped and compared with a detector that knows the truth."""

import json
import os
import shutil
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from rich.console import Console
from truth_detector import Knowing

from small_flights import simulate_into, small_flight
from sorvolo.cli.printing import announce_people
from sorvolo.cli.search import _map_all
from sorvolo.cli.sites import OpenedSite
from sorvolo.errors import InputError, SettingsError
from sorvolo.geometry.arrays import ImageRGB
from sorvolo.geometry.camera import Camera
from sorvolo.lab.evaluation.changes import evaluate_changes
from sorvolo.lab.simulation.settings import OutputSettings
from sorvolo.missions import worker
from sorvolo.missions.compare.classes import ChangeClasses, class_at
from sorvolo.missions.compare.flights import compare_flights
from sorvolo.missions.compare.objects import settled
from sorvolo.missions.flight.detector_protocol import ObjectDetector
from sorvolo.missions.flight.map_objects import ObjectFinder, open_detector
from sorvolo.missions.flight.settings import CompareSettings, MapSettings
from sorvolo.missions.flight.threads import made_at_low_priority
from sorvolo.missions.map.flights import map_flights
from sorvolo.missions.mission import flight_outcome
from sorvolo.missions.search.settings import SearchOutputs, SearchSettings
from sorvolo.store.site.archive import Archive
from sorvolo.survey.findings import Change, ChangeKind, Patch, Verdict
from sorvolo.survey.flight import CameraPrior, Frame, PosedFrame
from sorvolo.survey.map_objects import MapObject, ObjectSearch, SearchedFrames
from sorvolo.survey.objects import Detections, Sighting, no_detections
from sorvolo.survey.wording import counted


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two flights over a site with people, cars and small objects; boxes of every frame."""
    folder = tmp_path_factory.mktemp("objects") / "simulated"
    settings = replace(
        small_flight(
            5,
            speed_m_s=6,
            length_m=24,
            spacing_m=6,
            size_px=(320, 180),
            fps=4,
            noise_m=0.2,
            people=3,
            cars=3,
            small_objects=3,
            output=OutputSettings(truth_step=1),
        ),
        flights=2,
    )
    return simulate_into(folder, settings)


@pytest.fixture(scope="module")
def mapped(simulated: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first flight mapped while it is searched."""
    site = tmp_path_factory.mktemp("objects") / "site"
    for _ in map_flights([simulated / "flight1/flight1.mp4"], site, detector=Knowing(simulated)):
        pass
    return site


@pytest.fixture(scope="module")
def compared(simulated: Path, mapped: Path) -> Path:
    """The second flight compared with that map."""
    for _ in compare_flights(
        [simulated / "flight2/flight2.mp4"], mapped, detector=Knowing(simulated, "flight2")
    ):
        pass
    return mapped


def report_of(site: Path, flight: str) -> dict[str, Any]:
    """report.json."""
    return dict(json.loads((site / "flights" / flight / "report.json").read_text()))


def test_map_finds_each_object_once(simulated: Path, mapped: Path) -> None:
    """All that was seen clearly is found once, within decimetres of the others, under its class."""
    with Archive.open(mapped, write=False) as archive:
        found = [each.thing for each in archive.objects("flight1")]
        frame = archive.site().frame
    truth = json.loads((simulated / "truth/objects.geojson").read_text())["features"]
    targets = [
        (each["properties"], frame.ground_from_lonlat(each["geometry"]["coordinates"][0][:-1]))
        for each in truth
        if each["geometry"] and 1 in each["properties"]["flights"]
    ]
    offsets_m = np.array(
        [[thing.position_m - ring_m.mean(axis=0) for _, ring_m in targets] for thing in found]
    )
    nearest = np.linalg.norm(offsets_m, axis=2).argmin(axis=1)
    off_m = offsets_m[np.arange(len(found)), nearest]
    assert len(found) >= 5
    assert len(set(nearest)) == len(found)
    assert np.linalg.norm(off_m, axis=1).max() < 1.0
    named = [targets[k][0] for k in nearest]
    assert [each["class"] for each in named] == [each.label for each in found]
    stated_m = np.array([each.sigma_m for each in found])
    assert (np.abs(off_m) <= 2 * stated_m[:, None]).mean() > 0.8
    missed_m = [abs(a.length_m - b["length_m"]) for a, b in zip(found, named, strict=True)]
    assert np.nanmedian(missed_m) < 0.3


def test_report_crops_and_site_file(mapped: Path) -> None:
    """The report states what was found and shows it; the crops are pictures; both files hold the same objects."""
    reported = report_of(mapped, "flight1")["objects"]
    own = json.loads((mapped / "flights/flight1/objects.geojson").read_text())["features"]
    assert (
        reported["count"] == len(own) == sum(reported["classes"].values()) == len(reported["list"])
    )
    assert reported["model"] == "truth"
    assert reported["frames"] > 3
    for each in own:
        assert (
            (mapped / "flights/flight1" / each["properties"]["crop"])
            .read_bytes()
            .startswith(b"\xff\xd8")
        )
    page = (mapped / "flights/flight1/report.html").read_text()
    assert "Objects on the map" in page
    assert own[0]["id"] in page


def test_the_headline_counts_what_was_looked_at_and_people_are_events(
    mapped: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of a map as of a watch: what was found in how much ground, and each person told by name and place."""
    report = report_of(mapped, "flight1")
    text, objects = report["headline"]["text"], report["objects"]
    found = objects["classes"]
    assert f"; {counted(found['person'], 'person')}" in text and "100 % for person" in text
    assert text.endswith(objects["headline"]["text"])
    assert objects["looked_at"]["classes"]["person"]["share"] > 0.99
    # half of the ground is in pixels too coarse for a bag, which nobody asked for
    assert objects["headline"]["complete"] and objects["looked_at"]["share"] < 0.9
    assert (mapped / "flights/flight1/searched.geojson").is_file()

    lines = BytesIO()
    outcome = flight_outcome(mapped / "flights/flight1", report)
    worker._mapped(worker.Journal(lines), mapped, [outcome])
    events = [json.loads(each) for each in lines.getvalue().splitlines()]
    people = [row for row in objects["list"] if row["class"] == "person"]
    assert [each["type"] for each in events] == [worker.PERSON_FOUND] * len(people) != []
    told = {each["data"]["feature"]["properties"]["id"] for each in events}
    with Archive.open(mapped, write=False) as archive:
        findings = [each for each in archive.register().findings if each.id in told]
    seen = {sighting.id for each in findings for sighting in each.sightings}
    assert seen == {row["id"] for row in people}

    announce_people(report, mapped, Console(force_terminal=True, width=200))
    shown = capsys.readouterr().out
    assert shown.count("\a") == shown.count("PERSON FOUND") == len(people)


def test_a_search_that_maps_a_flight_tells_of_its_people(
    simulated: Path, mapped: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    site = shutil.copytree(mapped, tmp_path / "site")
    place, flight = OpenedSite(site, str(site)), str(simulated / "flight1/flight1.mp4")
    _map_all([flight], place, SearchSettings(), SearchOutputs(tmp_path / "out"), None, "", 1.0)
    people = report_of(site, "flight1")["objects"]["classes"]["person"]
    told = capsys.readouterr().err
    assert told.count("PERSON FOUND") == people > 0


def test_compare_names_changes(simulated: Path, compared: Path) -> None:
    """What the truth's detector saw is what changes are named; the later flight's objects replace the earlier one's."""
    (measured,) = evaluate_changes(compared, simulated, flight="flight2")
    assert measured.classes is not None
    assert measured.classes.right >= 2
    assert measured.classes.wrong <= 1
    assert measured.classes.unnamed <= 1
    with Archive.open(compared, write=False) as archive:
        newest, searches = archive.newest_objects(), archive.searches()
    assert {each.date for each in searches} == {"flight1", "flight2"}
    assert sum(each.flight_id == "flight2" for each in newest) >= 4
    assert any(each.finding.dates == ("flight1", "flight2") for each in newest)
    assert "is now" in (compared / "flights/flight2/changes.html").read_text()


def test_without_a_model(simulated: Path, tmp_path: Path) -> None:
    """Mapping works, and the report states that nothing was looked for."""
    for _ in map_flights(
        [simulated / "flight1/flight1.mp4"], tmp_path / "site", MapSettings(model="none")
    ):
        pass
    assert report_of(tmp_path / "site", "flight1")["objects"]["why_not"] == "no model was wanted"
    assert (
        "No objects were searched for"
        in (tmp_path / "site/flights/flight1/report.html").read_text()
    )
    assert not (tmp_path / "site/objects.geojson").exists()


def test_a_model_that_is_not_there(simulated: Path, tmp_path: Path) -> None:
    """A name that is not installed is reported before anything is mapped; "none" is no error."""
    assert open_detector("none") is None
    with pytest.raises(InputError, match="no model 'nosuch'"):
        next(
            map_flights(
                [simulated / "flight1/flight1.mp4"], tmp_path / "site", MapSettings(model="nosuch")
            )
        )
    with pytest.raises(InputError, match="no model 'nosuch'"):
        open_detector(CompareSettings(model="nosuch").mapping.model)


# ---- what a change is ------------------------------------------------------------------------------------------------


def change_at(kind: ChangeKind, velocity_m_s: tuple[float, float] = (0.0, 0.0)) -> Change:
    """A change of a square metre around east 10, north 20."""
    outline_m = np.array([[9.5, 19.5], [10.5, 19.5], [10.5, 20.5], [9.5, 20.5]])
    rgba = np.full((20, 20, 4), 255, np.uint8)
    changed = np.zeros((20, 20), bool)
    changed[5:15, 5:15] = True
    return Change(
        "f-1",
        kind,
        0.9,
        outline_m,
        0,
        10 * 10**9,
        5,
        1.0,
        1.0,
        0.1,
        Patch(9.0, 21.0, 0.1, rgba, rgba, changed, np.zeros((20, 20), np.uint8)),
        np.array(velocity_m_s),
    )


def standing(
    label: str, east_m: float, north_m: float, length_m: float, *, moving: bool = False
) -> MapObject:
    """An object that three of four frames saw."""
    velocity = np.array([1.0, 0.0]) if moving else np.zeros(2)
    return MapObject(
        label,
        label,
        0.8,
        np.array([east_m, north_m]),
        0.3,
        length_m,
        0.5,
        3,
        4,
        0,
        1,
        moving,
        velocity,
    )


def sighting(
    label: str, east_m: float, north_m: float, seconds: float, score: float = 0.8
) -> Sighting:
    """One view of something a metre long."""
    place_m, size_m = np.array([east_m, north_m]), np.array([1.0, 0.5])
    return Sighting(
        1,
        "1",
        int(seconds * 1e9),
        label,
        score,
        np.array([0, 0, 9, 9]),
        place_m,
        0.01 * np.eye(2),
        size_m,
    )


def test_the_object_in_a_change() -> None:
    """The nearest in place and size, not what passes by, and nothing from afar."""
    change = change_at(ChangeKind.APPEARED)
    person, car = standing("person", 10.1, 20.0, 0.6), standing("car", 10.3, 21.4, 4.4)
    assert class_at(change, [car, person]) == "person"
    assert class_at(change, [car]) == "car"
    assert class_at(change, [standing("person", 10.0, 22.0, 0.6)]) == ""
    assert class_at(change, [standing("person", 10.0, 20.0, 0.6, moving=True)]) == ""


def test_sightings_on_the_way_of_what_moves() -> None:
    """At 2 m/s east it was 6 m further west three seconds before; what stands there at other times is not it."""
    change = change_at(ChangeKind.MOVING, (2.0, 0.0))
    assert class_at(change, [sighting("person", 4.0, 20.0, 7.0)]) == "person"
    assert class_at(change, [sighting("person", 4.0, 26.0, 7.0)]) == ""
    assert class_at(change, [sighting("car", 10.0, 20.0, 3.0)]) == ""
    still = change_at(ChangeKind.APPEARED)
    reported = [
        sighting("car", 10.0, 20.0, 3.0, 0.9),
        *(sighting("person", 10.2, 20.0, s, 0.5) for s in (4.0, 5.0)),
    ]
    assert class_at(still, reported) == "person"


class Sees(Knowing):
    """Sees one car in the middle of any picture."""

    def __init__(self, simulated: Path, score: float) -> None:
        super().__init__(simulated)
        self._score = score

    def detect(
        self,
        image: ImageRGB,
        *,
        tiles: object = None,
        m_per_px: float | None = None,
        least_score: float | None = None,
        classes: Sequence[str] | None = None,
        from_above: bool = False,
        overlapping: bool = False,
        is_part: bool = False,
    ) -> Detections:
        """See `Knowing.detect`."""
        x, y = image.shape[1] / 2, image.shape[0] / 2
        box_px = np.array([[x - 5, y - 5, x + 5, y + 5]])
        return Detections(box_px, np.array([self._score]), np.array([1]), self.classes)


def test_whom_a_comparison_alone_saw_is_in_every_list(
    simulated: Path, mapped: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Seen in no frame by the detector, recognised in the changes' own pictures: headline, files, page and alarm."""

    class NamesChanges(Sees):
        def detect(self, image: ImageRGB, *, is_part: bool = False, **_: object) -> Detections:
            found = super().detect(image)
            person = replace(found, labels=np.array([0]))
            return person if is_part else no_detections(self.classes)

    site = shutil.copytree(mapped, tmp_path / "site")
    flight, detector = simulated / "flight2/flight2.mp4", NamesChanges(simulated, 0.9)
    for _ in compare_flights([flight], site, detector=detector, again=True):
        pass
    report = report_of(site, "flight2")
    came = [
        each["properties"]
        for each in json.loads((site / "flights/flight2/changes.geojson").read_text())["features"]
        if each["properties"]["class_after"] == "person"
    ]
    assert f"; {counted(len(came), 'person')}" in report["comparison"]["headline"]["text"]
    assert {each["id"] for each in report["objects"]["list"]} == {each["id"] for each in came}
    for folder in (site, site / "flights/flight2"):
        features = json.loads((folder / "objects.geojson").read_text())["features"]
        shown = [
            each["properties"] for each in features if "flight2" in each["properties"]["flights"]
        ]
        assert {each["object"] for each in shown} == {each["id"] for each in came}
        assert all((folder / each["crop"]).is_file() for each in shown)
    announce_people(report, site, Console(force_terminal=True, width=200))
    assert capsys.readouterr().out.count("PERSON FOUND") == len(came) > 0
    with Archive.open(site, write=True) as archive:
        archive.review(came[0]["id"], Verdict.REJECTED)
    for folder in (site, site / "flights/flight2"):
        assert came[0]["id"] not in (folder / "objects.geojson").read_text()


def test_what_left_or_came_where_another_thing_stands_was_replaced(simulated: Path) -> None:
    here, beside = standing("car", 10.2, 20.0, 1.2), standing("car", 10.8, 20.0, 1.2)
    small, walks = (
        standing("small object", 10.0, 20.0, 0.4),
        standing("car", 10.2, 20.0, 1.2, moving=True),
    )
    person = standing("person", 10.0, 20.0, 0.8)
    left, came = change_at(ChangeKind.DISAPPEARED), change_at(ChangeKind.APPEARED)
    classes = ChangeClasses(Sees(simulated, 0.1), [person])
    named = classes.final(left, [here], [])
    assert (named.kind, named.class_before, named.class_after) == (
        ChangeKind.REPLACED,
        "person",
        "car",
    )
    assert classes.final(came, (), ()).kind == ChangeKind.REPLACED
    for other in (beside, small, walks):
        assert classes.final(left, [other], []).kind == ChangeKind.DISAPPEARED
    assert ChangeClasses(Sees(simulated, 0.1), []).final(came, (), ()).kind == ChangeKind.APPEARED


def test_changes_and_objects_of_a_flight_are_one_list() -> None:
    """What a change saw leave stands there still; whom it saw come and no frame shows is there, once."""
    left = replace(change_at(ChangeKind.DISAPPEARED), class_before="person")
    came = replace(change_at(ChangeKind.APPEARED), id="f-2", class_after="person")
    here, away = standing("person", 10.2, 20.0, 0.8), standing("person", 40.0, 20.0, 0.8)
    search = ObjectSearch("", ("person", "car"), (), SearchedFrames(np.zeros((0, 4, 2))), 9, 9, 0)

    def states(changes: list[Change], *objects: MapObject) -> tuple[list[str], list[str]]:
        kept, found = settled(changes, replace(search, objects=objects), "f")
        return [each.id for each in kept], [each.id for each in found.objects]

    assert states([left], here) == ([], ["person"])
    assert states([left], away) == (["f-1"], ["person"])
    assert states([came], away) == (["f-2"], ["person", "f-2"])
    assert states([came], here) == (["f-2"], ["person"])
    assert states([left, came]) == (["f-1", "f-2"], ["f-2"])
    assert states([replace(came, class_after="small object")]) == (["f-2"], [])


def test_a_changes_own_pictures_are_the_last_word(simulated: Path) -> None:
    """Where no flight saw an object, the detector looks at the change's pictures; each kind has the side it has."""
    classes = ChangeClasses(Sees(simulated, 0.8), [standing("person", 10.0, 20.0, 0.6)])
    for kind, before, after in (
        (ChangeKind.APPEARED, "", "car"),
        (ChangeKind.DISAPPEARED, "person", ""),
        (ChangeKind.REPLACED, "person", "car"),
        (ChangeKind.MOVING, "", "car"),
    ):
        named = classes.final(change_at(kind), (), ())
        assert (named.class_before, named.class_after) == (before, after)
    unsure = ChangeClasses(Sees(simulated, 0.1), []).final(change_at(ChangeKind.REPLACED), (), ())
    assert (unsure.class_before, unsure.class_after) == ("", "")


def test_what_is_longer_than_its_class_has_none(simulated: Path) -> None:
    """A person stands before a heap of 9 m that came: the heap is not a person; a car may be a part of it."""
    heap = replace(change_at(ChangeKind.APPEARED), length_m=9.0)
    for label, named in (("person", ""), ("car", "car")):
        found = [standing(label, 10.0, 20.0, 4.0)]
        assert ChangeClasses(Sees(simulated, 0.1), []).final(heap, found, []).class_after == named
    glint = replace(heap, length_m=0.45)  # a part of the car beside it
    for label, named in (("person", "person"), ("car", "")):
        found = [standing(label, 10.0, 20.0, 4.0)]
        assert ChangeClasses(Sees(simulated, 0.9), []).final(glint, found, []).class_after == named


def test_a_changes_own_pictures_are_searched_for_the_classes_asked_for(simulated: Path) -> None:
    """Without any, for all that the model knows: the ground itself shows that something changed."""
    asked = []

    class Notes(Sees):
        def detect(
            self,
            image: ImageRGB,
            *,
            tiles: object = None,
            m_per_px: float | None = None,
            least_score: float | None = None,
            classes: Sequence[str] | None = None,
            from_above: bool = False,
            overlapping: bool = False,
            is_part: bool = False,
        ) -> Detections:
            asked.append(classes)
            return super().detect(image)

    for classes in ((), ("person",)):
        ChangeClasses(Notes(simulated, 0.8), [], classes).final(
            change_at(ChangeKind.APPEARED), (), ()
        )
    assert asked == [None, ("person",)]


def test_compare_refuses_a_class_that_the_model_does_not_know(
    simulated: Path, mapped: Path
) -> None:
    wanted = CompareSettings(classes=("boat",))
    with pytest.raises(
        SettingsError, match="the model knows no 'boat'; it knows person, car, small object"
    ):
        next(
            compare_flights(
                [simulated / "flight2/flight2.mp4"], mapped, wanted, detector=Knowing(simulated)
            )
        )


def test_a_class_that_is_reported_on_request_alone_is_not_looked_for(
    simulated: Path, tmp_path: Path
) -> None:
    """The map's objects are people and cars where the model is too unsure of small objects."""
    knowing = Knowing(simulated)
    knowing.info = replace(knowing.info, on_request=("small object",))
    for _ in map_flights([simulated / "flight1/flight1.mp4"], tmp_path / "site", detector=knowing):
        pass
    reported = report_of(tmp_path / "site", "flight1")["objects"]
    assert reported["looked_for"] == ["person", "car"]
    assert set(reported["classes"]) == {"person", "car"} and reported["count"] > 0


def test_frames_of_another_light_are_reported_by_their_own_thresholds(
    simulated: Path, tmp_path: Path
) -> None:
    """As thermal frames by the night model's: what the day's model would not report is on the map."""

    class Night(Knowing):
        """Of frames of this light all is reported from 0.3 on."""

        def thresholds_for(self, picture: ImageRGB, **_: object) -> dict[str, float]:
            return dict.fromkeys(self.classes, 0.3)

    night = Night(simulated)
    night.info = replace(night.info, thresholds=dict.fromkeys(night.classes, 0.999))
    for _ in map_flights([simulated / "flight1/flight1.mp4"], tmp_path / "site", detector=night):
        pass
    assert report_of(tmp_path / "site", "flight1")["objects"]["count"] >= 5


def test_small_objects_are_looked_for_where_they_are_asked_for(
    simulated: Path, tmp_path: Path
) -> None:
    asked: list[tuple[str, ...]] = []

    class Listening(Knowing):
        """Notes what was asked for."""

        def detect(
            self,
            image: ImageRGB,
            *,
            tiles: object = None,
            m_per_px: float | None = None,
            least_score: float | None = None,
            classes: Sequence[str] | None = None,
            from_above: bool = False,
            overlapping: bool = False,
            is_part: bool = False,
        ) -> Detections:
            asked.append(tuple(classes or ()))
            assert overlapping, "a thing is seen in many frames, none is worth several sizes"
            return no_detections(self.classes)

    detector = Listening(simulated)
    detector.info = replace(detector.info, on_request=("small object",))
    video, camera = simulated / "flight1" / "flight1.mp4", simulated / "camera.xml"
    for classes, wanted in (((), ("person", "car")), (("small object",), ("small object",))):
        settings = MapSettings(classes=classes)
        for _ in map_flights(
            [video], tmp_path / f"site{len(classes)}", settings, camera=camera, detector=detector
        ):
            pass
        assert asked and set(asked) == {wanted}
        asked.clear()
    with pytest.raises(SettingsError, match="bicycle"):
        list(
            map_flights(
                [video],
                tmp_path / "none",
                MapSettings(classes=("bicycle",)),
                camera=camera,
                detector=detector,
            )
        )


@pytest.mark.parametrize(
    ("side_px", "is_live", "most"),
    [
        (400, False, 3),
        (400, True, 8),  # of a live flight all wait, and the map does not
        (3600, False, 1),
        (3600, True, 8),
    ],
)
def test_large_photos_wait_for_the_detector_one_by_one_but_those_of_a_live_flight_on_disk(
    tmp_path: Path, side_px: int, is_live: bool, most: int
) -> None:
    """In memory four photos of 100 megapixels would take a gigabyte."""
    seen: list[int] = []
    may_go_on = threading.Event()
    if most < 8:
        may_go_on.set()

    class Slow:
        classes, notices, provider = ("person",), (), "nowhere"
        info = SimpleNamespace(usual_classes=("person",), name="slow")

        def thresholds_for(self, image: ImageRGB, **_: object) -> dict[str, float]:
            return {"person": 0.5}

        def detect(self, image: ImageRGB, **_: object) -> Detections:
            assert may_go_on.wait(60)
            time.sleep(0.02)
            seen.append(int(image[-1, -1, 1]) if image.shape == (side_px, side_px, 3) else -1)
            return no_detections(self.classes)

    camera = Camera.from_angle_of_view(640, 480, 60)
    finder = ObjectFinder(
        cast(ObjectDetector, Slow()), camera, live_folder=tmp_path if is_live else None
    )
    prior = CameraPrior(np.array([0, 0, 40.0]), np.ones(3), np.diag([1.0, -1, -1]), np.ones(3))
    unfinished = []
    for index in range(8):
        image = np.broadcast_to(np.uint8(index), (side_px, side_px, 3))
        finder.look(PosedFrame(Frame(index, str(index), index, image), prior))
        unfinished.append(index + 1 - len(seen))
    assert max(unfinished) <= most and (most < 8 or unfinished[-1] == 8)
    may_go_on.set()
    finder._take(0)
    assert list(finder._seen) == list(range(8))
    finder.close()
    assert seen == list(range(8))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(
    sys.platform != "linux", reason="a thread has a priority of its own on Linux alone"
)
def test_a_live_flights_detector_works_at_low_priority() -> None:
    def own() -> int:
        return os.getpriority(os.PRIO_PROCESS, threading.get_native_id())

    before = own()
    assert made_at_low_priority(own) >= 10 and own() == before
