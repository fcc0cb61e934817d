"""A later flight against the map: from files to changes, and a map brought up to date."""

import json
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from small_flights import simulate_into, small_flight
from sorvolo.capture.calibration import camera_from_option, guess_camera
from sorvolo.capture.source import opened_sources
from sorvolo.change.reference import ReferenceMap
from sorvolo.change.views import FlightCamera, ViewMaker, ViewOutcome
from sorvolo.cli.main import main
from sorvolo.errors import InputError, SettingsError, SorvoloWarning, StoreError
from sorvolo.geometry.geodesy import Geodetic
from sorvolo.geometry.homography import apply_homography
from sorvolo.lab.evaluation.changes import evaluate_changes
from sorvolo.lab.simulation.settings import LaterSettings, OutputSettings, SimulationSettings
from sorvolo.lab.thesis.changes import ThesisComparison, ThesisSettings
from sorvolo.missions.compare.flights import _begun, compare_flights
from sorvolo.missions.flight.known_camera import known_camera
from sorvolo.missions.flight.settings import CompareSettings, MapSettings
from sorvolo.missions.flight.setup import check_place, prepare
from sorvolo.missions.heights.run import run_of
from sorvolo.missions.map.flights import map_flights
from sorvolo.missions.map.painting import KnownKeyframes
from sorvolo.mosaic.selection import every
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.files import HeightFile
from sorvolo.survey.findings import CompareUpdate, Verdict, ViewStatus
from sorvolo.survey.flight import Frame, PosedFrame
from sorvolo.survey.mosaic import Status

_OBJECTS = {"cars": 1, "small_objects": 3, "output": OutputSettings(truth_step=2)}
_LATER = LaterSettings(people=0, cars=1, small_objects=3, removed=2, moved=0)
_PAIR = replace(
    small_flight(41, height_m=12, length_m=20, spacing_m=5, noise_m=0.2, fps=2.5, **_OBJECTS),
    flights=2,
    later=_LATER,
)
_SURVEY = replace(
    small_flight(
        41,
        height_m=18,
        length_m=36,
        spacing_m=7,
        size_px=(480, 270),
        noise_m=0.2,
        fps=3,
        **_OBJECTS,
    ),
    flights=2,
    later=_LATER,
)

_MAP, _COMPARE = MapSettings(model="none"), CompareSettings(model="none")
_WITH_MASKS = CompareSettings(model="none", writes_masks=True)
_FEW_VIEWS = replace(_COMPARE, views_per_second=1.25)  # every other frame


@dataclass(frozen=True)
class Survey:
    """A map, a copy of it with which a later flight was compared, and what that comparison reported."""

    mapped: Path
    compared: Path
    updates: list[CompareUpdate]


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two short flights over one site, the second finding other objects and other light; with the truth."""
    folder = tmp_path_factory.mktemp("pair") / "flown"
    return simulate_into(folder, _PAIR)


@pytest.fixture(scope="module")
def surveyed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two such flights that show enough ground, finely enough, to measure how much is found of what changed there."""
    folder = tmp_path_factory.mktemp("survey") / "flown"
    return simulate_into(folder, _SURVEY)


@pytest.fixture(scope="module")
def survey(surveyed: Path, tmp_path_factory: pytest.TempPathFactory) -> Survey:
    """Their map, and a copy of it with which the second was compared."""
    mapped = tmp_path_factory.mktemp("survey") / "mapped"
    for _ in map_flights([surveyed / "flight1"], mapped, _MAP, camera=surveyed / "camera.xml"):
        pass
    shutil.copytree(mapped, mapped.with_name("compared"))
    return Survey(
        mapped,
        mapped.with_name("compared"),
        compare(surveyed, mapped.with_name("compared"), _WITH_MASKS),
    )


@pytest.fixture(scope="module")
def mapped(flown: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first flight's map; copied by those who change it."""
    site = tmp_path_factory.mktemp("pair") / "site"
    for _ in map_flights([flown / "flight1"], site, _MAP, camera=flown / "camera.xml"):
        pass
    return site


@pytest.fixture
def site(mapped: Path, tmp_path: Path) -> Path:
    shutil.copytree(mapped, tmp_path / "site")
    return tmp_path / "site"


@pytest.fixture(scope="module")
def compared(
    flown: Path, mapped: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, list[CompareUpdate]]:
    site = tmp_path_factory.mktemp("pair") / "compared"
    shutil.copytree(mapped, site)
    return site, compare(flown, site, _WITH_MASKS)


def compare(
    flown: Path, site: Path, settings: CompareSettings | None = None, *, again: bool = False
) -> list[CompareUpdate]:
    wanted = settings or CompareSettings(model="none")
    return list(
        compare_flights([flown / "flight2"], site, wanted, camera=flown / "camera.xml", again=again)
    )


def features(site: Path, flight: str = "flight2") -> list[dict]:
    return json.loads((site / "flights" / flight / "changes.geojson").read_text())["features"]


def report(site: Path, flight: str = "flight2") -> dict:
    return json.loads((site / "flights" / flight / "report.json").read_text())


def files(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def test_most_changes_are_found_and_few_are_false(survey, surveyed):
    measured = evaluate_changes(survey.compared, truth=surveyed)
    events = measured[0].events
    assert events.must_find == 6
    assert events.found == events.must_find
    assert events.false <= 1
    assert events.twice == 0


def test_changes_are_announced_once_while_the_flight_lasts(survey):
    site, updates = survey.compared, survey.updates
    announced = [change.id for update in updates for change in update.announced]
    assert len(announced) == len(set(announced)) > 0
    assert {each["properties"]["id"] for each in features(site)} & set(announced)
    assert all(update.status is ViewStatus.COMPARED for update in updates)
    assert any(update.announced for update in updates[:-1])


def test_the_files_hold_what_was_found(survey):
    site, updates = survey.compared, survey.updates
    folder = site / "flights" / "flight2"
    for each in features(site):
        own = each["properties"]
        assert own["kind"] in ("appeared", "disappeared", "replaced", "moving")
        assert own["first_seen"] <= own["last_seen"]
        assert own["sigma_m"] > 0
        for side in ("before", "after"):
            assert (
                cv2.imdecode(
                    np.frombuffer(
                        (folder / "changes" / f"{own['id']}-{side}.png").read_bytes(), np.uint8
                    ),
                    cv2.IMREAD_COLOR,
                )
                is not None
            )
    printed = report(site)["comparison"]
    assert printed["views"]["compared"] == len(updates)
    assert printed["compared_area_m2"] > 200
    settings = asdict(_WITH_MASKS)
    assert report(site)["settings"] == json.loads(json.dumps(settings))
    assert "changes.html" in {path.name for path in folder.iterdir()}


def test_masks_have_the_frames_own_pixels(survey):
    site, updates = survey.compared, survey.updates
    masks = site / "flights" / "flight2" / "masks"
    mask = cv2.imdecode(
        np.frombuffer((masks / "0.png").read_bytes(), np.uint8), cv2.IMREAD_UNCHANGED
    )
    assert mask.shape == (270, 480)
    assert set(np.unique(mask)) <= {0, 128, 255}
    assert len(list(masks.glob("*.png"))) == len(updates)
    boxes = json.loads((masks / "boxes.json").read_text())
    assert any(boxes.values())


def test_the_map_is_painted_where_the_ground_changed_and_nowhere_else(survey):
    with Archive.open(survey.mapped, write=False) as archive:
        before = dict(archive.tiles())
    with Archive.open(survey.compared, write=False) as archive:
        after = dict(archive.tiles())
        grid, frame = archive.site_grid(), archive.site().frame
        outlines = [change.outline_m for change in archive.changes()]
    touched = np.zeros(0)
    centres = grid.grid_from_site(np.array([outline.mean(axis=0) for outline in outlines]))
    reach = max(np.ptp(outline, axis=0).max() for outline in outlines) / grid.grid.m_per_px + 20
    assert frame is not None
    changed = 0
    for index, tile in before.items():
        ys, xs = np.nonzero((tile != after[index]).any(axis=-1) & (tile[..., 3] == 255))
        if len(xs):
            points = np.column_stack([xs, ys]) + np.array(index) * grid.grid.tile_px
            touched = np.linalg.norm(points[:, None] - centres[None], axis=2).min(axis=1)
            assert touched.max() < reach
            changed += len(xs)
    assert changed > 0


def test_the_same_flight_again_gives_the_same_and_doubles_nothing(compared, flown, tmp_path):
    shutil.copytree(compared[0], tmp_path / "again")
    first = files(compared[0] / "flights" / "flight2" / "changes")
    assert compare(flown, tmp_path / "again", _WITH_MASKS) == []
    compare(flown, tmp_path / "again", _WITH_MASKS, again=True)
    assert files(tmp_path / "again" / "flights" / "flight2" / "changes") == first
    assert features(tmp_path / "again") == features(compared[0])
    with Archive.open(tmp_path / "again", write=False) as archive:
        assert [each.id for each in archive.flights()] == ["flight1", "flight2"]
        again = dict(archive.tiles())
    with Archive.open(compared[0], write=False) as archive:
        once = dict(archive.tiles())
    assert once.keys() == again.keys()
    assert all(np.array_equal(once[index], again[index]) for index in once)


def test_a_flight_from_before_the_map_turns_all_changes_round_and_states_so(flown, tmp_path):
    """What had been taken away was reported as appeared, exit code 0."""
    camera = flown / "camera.xml"
    for _ in map_flights([flown / "flight2"], tmp_path, _MAP, camera=camera):
        pass
    for _ in compare_flights([flown / "flight1"], tmp_path, _FEW_VIEWS, camera=camera):
        pass
    headline = report(tmp_path, "flight1")["comparison"]["headline"]
    assert headline["quality"] == "doubtful" and "flown before the map" in headline["text"]
    codes = [each["code"] for each in report(tmp_path, "flight1")["notices"]]
    assert "earlier_flight" in codes


def test_a_map_that_lost_its_key_frames_is_no_base_to_rely_on(flown, site):
    """Of 37 key frames 22 were gone, and three false changes of up to 12 m stood in a clean headline."""
    for gone in sorted((site / "flights" / "flight1" / "keyframes").rglob("*.jpg"))[::2]:
        gone.unlink()
    with pytest.warns(SorvoloWarning, match="are gone: left out"):
        compare(flown, site, _FEW_VIEWS)
    headline = report(site)["comparison"]["headline"]
    assert headline["quality"] == "doubtful" and "key frames are damaged" in headline["text"]


def test_heights_made_since_are_a_reason_to_compare_again(compared, flown, tmp_path):
    site, settings = tmp_path / "higher", _WITH_MASKS
    shutil.copytree(compared[0], site)
    assert compare(flown, site, settings) == []
    with Archive.open(site, write=False) as archive:
        run = run_of(archive.keyframes("flight1"))
        report = archive.height_path("flight1", HeightFile.REPORT)
    report.write_text(json.dumps({"run": run, "cell_m": 0.2}))
    again = compare_flights([flown / "flight2"], site, settings, camera=flown / "camera.xml")
    next(again)  # a changed area has its height change by them
    again.cancel()


def test_stopping_half_way_leaves_the_site_as_it_was(flown, site):
    with Archive.open(site, write=False) as archive:
        before = [each.id for each in archive.versions()]
    updates = compare_flights([flown / "flight2"], site, _COMPARE, camera=flown / "camera.xml")
    for _ in range(5):
        next(updates)
    updates.cancel()
    with Archive.open(site, write=False) as archive:
        assert [each.id for each in archive.versions()] == before
        assert [each.id for each in archive.flights()] == ["flight1"]
    assert not (site / "flights" / "flight2").exists()


def test_a_view_that_fails_beside_the_rest_is_reported_and_leaves_the_site_as_it_was(
    flown, site, monkeypatch
):
    begun, compare_with_map = [], ViewMaker.compare_with_map

    def fails(self, posed, *tried, **how):
        begun.append(posed.frame.index)
        if len(begun) == 6:
            raise StoreError("a tile is damaged")
        return compare_with_map(self, posed, *tried, **how)

    monkeypatch.setattr(ViewMaker, "compare_with_map", fails)
    before, printed = files(site), []
    with pytest.raises(StoreError, match="a tile is damaged"):
        for each in compare_flights(
            [flown / "flight2"], site, _COMPARE, camera=flown / "camera.xml"
        ):
            printed.append(each.frame_name)
    assert len(printed) == 5 and printed == sorted(printed), "those before it are printed, in order"
    after = files(site)
    assert {name for name in after if "flight2" in name} == set()
    assert all(
        after[name] == content
        for name, content in before.items()
        if name.endswith((".tif", ".geojson"))
    )


@pytest.mark.long
def test_the_pictures_of_changes_are_no_finer_than_the_views(flown, compared, tmp_path):
    fine = tmp_path / "fine"
    with Archive.open(compared[0], write=False) as archive:
        own_m_per_px = archive.site_grid().grid.m_per_px
    for _ in map_flights(
        [flown / "flight1"],
        fine,
        replace(_MAP, m_per_px=own_m_per_px / 2),
        camera=flown / "camera.xml",
    ):
        pass
    compare(flown, fine)
    assert len(features(fine)) == len(features(compared[0]))

    def rows(site):
        return sum(
            len(cv2.imread(str(each)))
            for each in (site / "flights/flight2/changes").glob("*-after.png")
        )

    assert rows(fine) == pytest.approx(rows(compared[0]), rel=0.2), (
        "twice as many were there to be drawn"
    )


@pytest.mark.parametrize(
    "waiting, announced_at",
    [
        ([False] * 5, [0, 1, 2, 3, 4]),  # each before the next frame is asked for
        (
            [True] * 5,
            [2, 3, 4, 5, 5],
        ),  # three at work at once; the rest when no frame comes any more
        ([True, True, False, False, False], [2, 2, 2, 3, 4]),
    ],
)
def test_a_live_view_is_reported_at_once_unless_the_next_one_waits_already(waiting, announced_at):
    asked = []

    def frames():
        for index in range(5):
            asked.append(index)
            yield Frame(index, str(index), index, np.zeros((2, 2, 3), np.uint8))
        asked.append(5)

    setup = SimpleNamespace(prior=lambda frame, first: None)
    run = SimpleNamespace(begin=lambda posed, *_, **__: posed.frame.index, lose=None)
    begun = _begun(frames(), setup, lambda posed: True, run, lambda: 2 * waiting[asked[-1]])
    found = [(each, asked[-1]) for each in begun]
    assert [each for each, _ in found] == [0, 1, 2, 3, 4]
    assert [last for _, last in found] == announced_at


def test_a_rejected_change_does_not_come_back_with_the_next_flight(flown, site, tmp_path):
    """Nor is the map painted, where it is not to be brought up to date."""
    few = replace(_FEW_VIEWS, updates_map=False)
    with Archive.open(site, write=False) as archive:
        before = dict(archive.tiles())
    compare(flown, site, few)
    with Archive.open(site, write=False) as archive:
        after = dict(archive.tiles())
    assert before.keys() == after.keys()
    assert all(np.array_equal(before[index], after[index]) for index in before)
    (rejected, *others) = features(site)
    with Archive.open(site, write=True) as archive:
        archive.review(rejected["id"], Verdict.REJECTED)
    compare(flown, site, few)
    assert [each["geometry"] for each in features(site)] == [
        each["geometry"] for each in (rejected, *others)
    ]
    assert features(site)[0]["properties"]["review"] == "rejected"
    for suffix in (".mp4", ".csv"):
        shutil.copy(flown / "flight2" / f"flight2{suffix}", tmp_path / f"next{suffix}")
    list(compare_flights([tmp_path / "next.mp4"], site, few, camera=flown / "camera.xml"))
    assert [each["geometry"] for each in features(site, "next")] == [
        each["geometry"] for each in others
    ]
    assert report(site, "next")["comparison"]["suppressed"] == 1


def test_a_flight_without_telemetry_finds_itself(flown, site, tmp_path):
    shutil.copy(flown / "flight2" / "flight2.mp4", tmp_path / "silent.mp4")
    updates = list(
        compare_flights([tmp_path / "silent.mp4"], site, _COMPARE, camera=flown / "camera.xml")
    )
    assert sum(each.status is ViewStatus.COMPARED for each in updates) >= 0.8 * len(updates)
    assert features(site, "silent")


@pytest.mark.long
def test_a_guessed_camera_becomes_the_one_that_mapping_found(surveyed, tmp_path):
    site, bare = tmp_path / "site", tmp_path / "no-camera-file"
    shutil.copytree(surveyed, bare, ignore=shutil.ignore_patterns("camera.xml"))
    for _ in map_flights([bare / "flight1"], site, _MAP):
        pass
    found = report(site, "flight1")["camera"]
    for _ in compare_flights(
        [bare / "flight2"], site, replace(_COMPARE, updates_map=False, views_per_second=1)
    ):
        pass
    printed = report(site)["camera"]
    assert printed["focal_px"] == pytest.approx(found["focal_found_px"]) != found["focal_px"]
    assert (
        "as flight flight1 of this site found it" in printed["origin"]
        and found["origin"] in printed["origin"]
    )
    assert printed["focal_sigma_relative"] < found["focal_sigma_relative"]
    assert report(site)["comparison"]["residual_px"]["median"] < 1.0  # 1.4 with the guess
    with Archive.open(site, write=False) as archive:
        calibrated = camera_from_option(str(surveyed / "camera.xml"), 480, 270)
        assert known_camera(calibrated, archive) is calibrated
        other = guess_camera(1280, 720)
        assert known_camera(other, archive) == other


def test_a_guessed_camera_names_one_that_was_given_for_pictures_of_its_size(site):
    with Archive.open(site, write=False) as archive:
        guess = known_camera(guess_camera(320, 180), archive)
        assert guess.camera.fx_px == guess_camera(320, 180).camera.fx_px, (
            "another camera may have the same size"
        )
        assert (
            "flight flight1 of this site had one" in guess.origin and "camera.xml" in guess.origin
        )
        another = guess_camera(1280, 720)
        assert known_camera(another, archive).origin == another.origin


def test_the_thesis_method_compares_too_and_shows_its_steps(flown, site, tmp_path):
    method = ThesisComparison(ThesisSettings(gray_threshold=None))
    settings = replace(_FEW_VIEWS, method=method)
    updates = list(
        compare_flights(
            [flown / "flight2"],
            site,
            settings,
            camera=flown / "camera.xml",
            steps=tmp_path / "steps",
        )
    )
    assert report(site)["comparison"]["method"] == "thesis"
    assert report(site)["settings"]["method"]["settings"]["gray_threshold"] is None
    pictures = list((tmp_path / "steps").rglob("*.png"))
    assert len(pictures) >= 7 * len(updates)


def test_steps_of_another_method_are_refused(flown, site):
    with pytest.raises(SettingsError, match="choose another method"):
        list(
            compare_flights(
                [flown / "flight2"],
                site,
                _COMPARE,
                camera=flown / "camera.xml",
                steps=Path("steps"),
            )
        )


def test_steps_within_the_site_folder_are_refused(tmp_path):
    thesis = CompareSettings(ThesisComparison(), model="none")
    for steps in (tmp_path / "site" / "flights" / "steps", tmp_path / "other" / ".." / "site"):
        with pytest.raises(SettingsError, match="lies in the site folder"):
            list(compare_flights([tmp_path / "later"], tmp_path / "site", thesis, steps=steps))


@pytest.mark.parametrize(
    "make",
    [
        lambda: CompareSettings(votes=4, voters=3),
        lambda: CompareSettings(views_per_second=0.0),
        lambda: CompareSettings(method="nope"),
        lambda: MapSettings(method=ThesisComparison()),
    ],
)
def test_settings_are_checked(make: Callable[[], object]):
    with pytest.raises(SettingsError):
        make()


def test_a_site_without_a_map_shows_how_to_make_one(flown, tmp_path):
    with pytest.raises(StoreError, match="sorvolo map"):
        list(
            compare_flights(
                [flown / "flight2"], tmp_path / "none", _COMPARE, camera=flown / "camera.xml"
            )
        )
    assert not (tmp_path / "none").exists()


def test_the_first_flight_cannot_be_compared_with_its_own_map(flown, site):
    with pytest.raises(InputError, match="flight1"):
        list(compare_flights([flown / "flight1"], site, _COMPARE, camera=flown / "camera.xml"))


def elsewhere(
    tmp_path: Path, metres_east: float, like: SimulationSettings = _PAIR
) -> Iterator[Path]:
    """A short flight over other ground, so far east of the site's."""
    scene = replace(
        like.scene, origin=Geodetic(41.8923127, 12.6035418 + metres_east / 83_000, 83.3)
    )
    moved = replace(
        like, flights=1, scene=scene, path=replace(like.path, length_m=8, strips=1), seed=77
    )
    simulate_into(tmp_path / "elsewhere", moved)
    yield tmp_path / "elsewhere"


def test_a_flight_over_another_place_is_refused(site, tmp_path):
    folder = next(elsewhere(tmp_path, 3_000))
    with pytest.raises(InputError, match="km from the site"):
        list(compare_flights([folder / "flight1"], site, _COMPARE, camera=folder / "camera.xml"))


@pytest.mark.parametrize("shown_east_m, is_there", [(8_000.0, True), (6_000.0, False)])
def test_a_place_is_another_one_far_from_the_ground_that_is_shown_not_from_where_it_began(
    site, shown_east_m, is_there
):
    with Archive.open(site, write=False) as archive:
        known = archive.site()
    track = SimpleNamespace(
        east_north_m=np.array([[np.nan, np.nan], [9_000.0, 0.0], [9_500.0, 0.0]])
    )
    shown_m = np.array([[0.0, 0.0], [shown_east_m, 0.0]])
    if is_there:
        check_place(known, track, "next", shown_m)
    else:
        with pytest.raises(InputError, match="is 3 km from the site"):
            check_place(known, track, "next", shown_m)


def test_a_flight_that_only_extends_the_map_is_warned_of(site, tmp_path):
    """Its telemetry may as well be off: then the same ground lies in the map twice."""
    folder = next(elsewhere(tmp_path, 150))
    updates = list(
        compare_flights([folder / "flight1"], site, _COMPARE, camera=folder / "camera.xml")
    )
    assert {each.status for each in updates} == {ViewStatus.OUTSIDE}
    assert any(
        "none of" in warning and "metres off" in warning
        for warning in report(site, "flight1-2")["warnings"]
    )


def test_other_ground_in_the_same_place_is_refused_and_leaves_no_trace(survey, tmp_path):
    site, folder = tmp_path / "site", next(elsewhere(tmp_path, 0, _SURVEY))
    shutil.copytree(survey.mapped, site)
    one_a_second = replace(_COMPARE, views_per_second=1)
    with pytest.raises(InputError, match="no frame of flight1-2 could be compared: it"):
        list(
            compare_flights([folder / "flight1"], site, one_a_second, camera=folder / "camera.xml")
        )
    assert not (site / "flights" / "flight1-2").exists()


def test_a_frame_that_does_not_fit_is_recorded_with_its_residual(flown, site):
    with (
        Archive.open(site, write=False) as archive,
        opened_sources([flown / "flight2"], camera=flown / "camera.xml") as sources,
    ):
        setup = prepare(sources[0], _MAP, archive.site(), telemetry_named=False, finds_itself=True)
        grid = archive.site_grid()
        flight = FlightCamera(sources[0].camera.camera, setup.usual_height_m, 1280, setup.utc_ns)
        views = ViewMaker(flight, ReferenceMap(archive.tiles(), grid.grid), grid, None, None)
        frame = next(iter(sources[0].frames(every(1.0))))
        outcome = ViewOutcome(ViewStatus.NOT_ALIGNED, "its points fit the map badly", 3.5, 0.0)
        placed = views.placed(PosedFrame(frame, setup.prior(frame, first=True)), outcome, 0.3)
    assert placed.status is Status.REJECTED
    assert (placed.reason, placed.residual_px) == ("its points fit the map badly", 3.5)


def test_ground_beside_the_map_extends_it(surveyed, tmp_path, monkeypatch):
    """The map is made of the frames over the western half alone; the second flight goes over all of it.

    As across dates, its features join none of the map's keyframes: where its views lie on the map places it.
    """
    frames = json.loads((surveyed / "truth" / "frames.geojson").read_text())["features"]
    first = np.array(
        [
            [each["properties"]["camera_longitude_deg"], each["properties"]["camera_latitude_deg"]]
            for each in frames
            if each["properties"]["flight"] == "flight1"
        ]
    )
    (west, south), (east, north) = first.min(axis=0) - 1e-4, np.median(first, axis=0)
    north = first[:, 1].max() + 1e-4
    ring = [[west, south], [east, south], [east, north], [west, north], [west, south]]
    (tmp_path / "west.geojson").write_text(json.dumps({"type": "Polygon", "coordinates": [ring]}))
    for _ in map_flights(
        [surveyed / "flight1"],
        tmp_path / "site",
        _MAP,
        camera=surveyed / "camera.xml",
        area=tmp_path / "west.geojson",
    ):
        pass
    with Archive.open(tmp_path / "site", write=False) as archive:
        before = dict(archive.tiles())
    laid, placed = {}, ViewMaker.placed

    def noted(*arguments):
        frame = placed(*arguments)
        laid[frame.index] = frame
        return frame

    monkeypatch.setattr(ViewMaker, "placed", noted)
    monkeypatch.setattr(KnownKeyframes, "for_graph", lambda _: [])
    compare(surveyed, tmp_path / "site", replace(_COMPARE, views_per_second=1.5))
    with Archive.open(tmp_path / "site", write=False) as archive:
        after = dict(archive.tiles())
    area = {
        version: sum(int(np.count_nonzero(tile[..., 3])) for tile in tiles.values())
        for version, tiles in (("before", before), ("after", after))
    }
    assert area["after"] > 1.3 * area["before"]
    assert features(tmp_path / "site")
    printed = report(tmp_path / "site")
    extension = printed["comparison"]["extension"]
    with Archive.open(tmp_path / "site", write=False) as archive:
        grown_m2 = (area["after"] - area["before"]) * archive.site().m_per_px ** 2
    assert extension["frames"] > 2 and extension["shown_as_well"] > 0
    with Archive.open(tmp_path / "site", write=False) as archive:
        extending = [each for each in archive.keyframes() if each.flight_id == "flight2"]
    corners = np.array([[0, 0], [480, 0], [480, 270], [0, 270]], float)
    apart_m = [
        float(
            np.linalg.norm(
                np.subtract(
                    *(
                        apply_homography(frame.site_from_image, corners)
                        for frame in (each, laid[each.index])
                    )
                ),
                axis=1,
            ).max()
        )
        for each in extending
        if laid[each.index].status is Status.VISION
    ]
    assert apart_m and max(apart_m) < 0.2
    assert extension["area_m2"] == pytest.approx(grown_m2, rel=1e-6)
    assert not any("have no place" in warning for warning in printed["warnings"])
    views = printed["comparison"]["views"]
    assert printed["frames"]["rejected"] == views["not-aligned"], (
        "who extends the map does not fail"
    )
    page = (tmp_path / "site" / "flights" / "flight2" / "changes.html").read_text()
    assert f"shown by {extension['frames']} frames" in page


def test_the_command_prints_the_changes_as_json(flown, site, capsys, tmp_path):
    camera = str(flown / "camera.xml")
    flight = str(flown / "flight2")
    masks = tmp_path / "masks"
    options = ["--camera", camera, "--json", "--model", "none", "--masks", str(masks)]
    assert main(["compare", flight, "--site", str(site), *options]) == 0
    printed = json.loads(capsys.readouterr().out)["flights"][0]
    assert printed["flight"] == "flight2"
    assert (
        len(list((masks / "flight2").glob("*.png"))) == printed["comparison"]["views"]["compared"]
    )
    assert len(printed["changes"]["features"]) == sum(printed["comparison"]["changes"].values()) > 0
    assert not set(printed["withdrawn"]) & {
        each["properties"]["id"] for each in printed["changes"]["features"]
    }


@pytest.mark.long  # kills at each step, and going on after one, have tests of their own
def test_killed_half_way_the_site_stays_whole_and_the_same_command_ends_well(
    compared, flown, site, tmp_path
):
    command = [
        sys.executable,
        "-m",
        "sorvolo",
        "compare",
        str(flown / "flight2"),
        "--site",
        str(site),
        "--camera",
        str(flown / "camera.xml"),
        "--masks",
        str(tmp_path / "masks"),
        "--model",
        "none",
    ]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        started = time.monotonic()
        while (
            not list(site.glob("flights/flight2/staged/*/masks/*.png")) and process.poll() is None
        ):
            assert time.monotonic() - started < 120
            time.sleep(0.02)
        process.kill()
    with Archive.open(site, write=False) as archive:
        assert [each.flight_id for each in archive.versions()] == ["flight1"]
        assert archive.changes() == []
    compare(flown, site, _WITH_MASKS)
    assert features(site) == features(compared[0])
    assert not list(site.glob("flights/flight2/staged"))


@pytest.mark.parametrize(
    ("brightness", "printed"),
    [
        pytest.param(0.4, "dark or of the ground's colour", marks=pytest.mark.long),
        pytest.param(0.06, "means little", marks=pytest.mark.long),
    ],
)
def test_a_flight_in_the_dark_is_reported_to_show_less_and_paints_no_black_ground(
    site, tmp_path, brightness, printed
):
    weather = replace(_PAIR.later.weather, brightness=brightness)
    dark = replace(_PAIR, later=replace(_PAIR.later, weather=weather))
    simulate_into(tmp_path / "dark", dark)
    shutil.copytree(site, tmp_path / "thesis")
    compare(tmp_path / "dark", site, replace(_COMPARE, views_per_second=1.0))
    (warning,) = (each for each in report(site)["warnings"] if "times as bright as the map" in each)
    assert printed in warning
    is_night = printed == "means little"
    assert report(site)["comparison"]["most_missed"] == is_night
    assert (
        "too dark" in (site / "flights" / "flight2" / "changes.html").read_text().lower()
    ) == is_night
    assert has_grown(site) != is_night
    if is_night:
        assert report(site)["comparison"]["changes"]["area"] == 0
        compare(
            tmp_path / "dark",
            tmp_path / "thesis",
            replace(_COMPARE, method=ThesisComparison(), views_per_second=1.0),
        )
        assert not has_grown(tmp_path / "thesis")


def has_grown(site: Path) -> bool:
    with Archive.open(site, write=False) as archive:
        before, after = (archive.tiles(version.id) for version in archive.versions())
        return after.keys() != before.keys() or any(
            np.count_nonzero(after[index][..., 3]) > np.count_nonzero(before[index][..., 3])
            for index in before
        )
