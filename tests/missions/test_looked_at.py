"""What was looked at: counted on the ground and in pictures, and never claimed for ground that nobody looked at."""

import json

import numpy as np
import pytest

from sorvolo.capture.live.stream import BEGUN_LATE
from sorvolo.detection.contract import ModelInfo
from sorvolo.errors import SettingsError
from sorvolo.geometry.geodesy import Geodetic
from sorvolo.missions.flight.looked_at import LookedAt, ground_for, looked_at, searched_document
from sorvolo.missions.flight.map_objects import with_objects
from sorvolo.missions.flight.settings import CompareSettings, MapSettings
from sorvolo.missions.mission import is_good
from sorvolo.missions.watch.run import headline_of_watch
from sorvolo.missions.watch.settings import WatchSettings
from sorvolo.search.looked_ground import ClassGround, LookedGround, near_ground
from sorvolo.survey.flight import Notice, Site

_SITE = Site("field", Geodetic(46.5, 11.3, 0.0), "EPSG:32632", 1.0)
_INFO = ModelInfo(
    "m",
    ("person", "car"),
    {"person": 0.5, "car": 0.5},
    {"person": (4.0, 60.0), "car": (4.0, 60.0)},
    licence="CC0-1.0",
)
_BOTH = ("person", "car")


def _frame(east_m: float, side_m: float = 40.0) -> np.ndarray:
    """The corners of a square frame from here on to the east."""
    corners_m = [[0.0, side_m], [side_m, side_m], [side_m, 0.0], [0.0, 0.0]]
    return np.array(corners_m) + np.array([east_m, 0.0])


def _flown(looks: dict[float, float], frames: int = 10) -> LookedGround:
    """Ten squares side by side; `looks` is where one was searched, and with what pixels, m."""
    ground = ground_for(_SITE, _INFO, _BOTH)
    for number in range(frames):
        ground.show(_frame(40.0 * number))
    for east_m, m_per_px in looks.items():
        ground.look(_frame(east_m), m_per_px, _BOTH)
    return ground


def test_ground_is_counted_by_what_became_of_it() -> None:
    ground = _flown({0.0: 0.05, 40.0: 0.05, 80.0: 0.2})
    assert ground.flown_m2 == pytest.approx(16_000, rel=0.02)
    person, car = ground.of_classes().values()
    assert person.share == pytest.approx(0.2, abs=0.01)
    assert person.coarse_m2 == pytest.approx(1600, rel=0.05)  # 20 cm a pixel show cars, no people
    assert car.share == pytest.approx(0.3, abs=0.01) and car.coarse_m2 == 0
    assert person.skipped_m2 == car.skipped_m2 == pytest.approx(11_200, rel=0.02)
    assert ground.new_share(_frame(20.0)) == 0
    assert ground.new_share(_frame(100.0)) == pytest.approx(0.5, abs=0.05)
    assert ground.new_share(_frame(-500.0)) == 1  # the cells grow towards all sides

    features = json.loads(searched_document(ground, _SITE)["searched.geojson"])["features"]
    areas = {
        (each["properties"]["state"], *each["properties"]["classes"]): each["properties"]["area_m2"]
        for each in features
    }
    assert areas["looked at", "person"] == pytest.approx(3200, rel=0.05)
    assert areas["looked at", "car"] == pytest.approx(4800, rel=0.05)
    assert areas["too coarse", "person"] == pytest.approx(1600, rel=0.05)
    longitude, latitude = features[0]["geometry"]["coordinates"][0][0]
    assert longitude == pytest.approx(11.3, abs=0.01) and latitude == pytest.approx(46.5, abs=0.01)


def test_a_frame_far_from_all_others_takes_no_memory() -> None:
    ground = _flown({})
    ground.show(_frame(5e6))
    assert ground.flown_m2 == pytest.approx(16_000, rel=0.02)


def test_ground_near_the_horizon_is_not_shown() -> None:
    outline_m = np.array([[-900.0, 4000.0], [900.0, 4000.0], [20.0, 0.0], [-20.0, 0.0]])
    near_m = near_ground(outline_m, np.array([0.0, 0.0, 50.0]))
    assert np.linalg.norm(near_m, axis=1).max() == pytest.approx(150)
    assert np.array_equal(near_m[2:], outline_m[2:])


@pytest.mark.parametrize(
    ("looked", "counts", "text"),
    [
        (
            looked_at(_flown({0.0: 0.05, 40.0: 0.05, 80.0: 0.05}), 13, 331),
            {"car": 4},
            "4 cars; 13 of 331 pictures, 30 % of the ground looked at",
        ),
        (
            looked_at(_flown({40.0 * k: 0.05 for k in range(10)}), 331, 331),
            {"car": 4},
            "4 cars, no person; 331 of 331 pictures, 100 % of the ground looked at",
        ),
        (
            looked_at(_flown({40.0 * k: 0.2 for k in range(10)}), 10, 10),
            {},
            "no car; 10 of 10 pictures, ground looked at: 0 % for person, 100 % for car (pixels too coarse for person)",
        ),
        (
            LookedAt(2, 40),
            {},
            "not enough looked at to say what is there; 2 of 40 pictures looked at",
        ),
        (LookedAt(40, 40), {}, "no person, no car; 40 of 40 pictures looked at"),
        (
            LookedAt(9, 9, ground={"car": ClassGround(9.8, 0, 0.2)}, flown_m2=10.0),
            {},
            "not enough looked at to say what is there; 9 of 9 pictures, 98 % of the ground looked at",
        ),
    ],
)
def test_a_headline_never_clears_ground_that_was_not_looked_at(
    looked: LookedAt, counts: dict[str, int], text: str
) -> None:
    headline = looked.headline(counts, tuple(looked.ground) or _BOTH)
    assert headline["text"] == text
    assert headline["complete"] == ("no person" in text or "98 %" in text)


def test_what_nobody_looks_for_in_coarse_pixels_is_too_coarse_and_not_skipped() -> None:
    """Detectors look for no people where they cannot be seen; the ground was flown all the same."""
    ground = _flown({})
    for east_m in range(0, 400, 40):
        ground.look(_frame(float(east_m)), 0.2, ["car"])
    person = ground.of_classes()["person"]
    assert person.skipped_m2 == 0 and person.coarse_m2 == pytest.approx(ground.flown_m2)
    looked = looked_at(ground, 10, 10, excuses=True)
    assert looked.is_enough and "too coarse for person" in looked.words()


def test_a_map_answers_for_ground_it_skipped_and_for_classes_that_were_asked_for() -> None:
    coarse = _flown({40.0 * k: 0.2 for k in range(10)})
    assert not looked_at(coarse, 10, 10).is_enough
    assert looked_at(coarse, 10, 10, excuses=True).is_enough
    assert not looked_at(_flown({0.0: 0.05}), 1, 10, excuses=True).is_enough
    assert not looked_at(_flown({0.0: 0.2, 40.0: 0.2}), 2, 10, excuses=True).is_enough
    for quality, found, good in (
        ("map", {"text": "", "complete": True}, True),
        ("compared", {"text": "", "complete": False}, False),
        ("doubtful", {"text": "", "complete": True}, False),
        ("map", None, True),
    ):
        headline = {"quality": quality, "text": "9 of 9 frames matched"}
        assert is_good(with_objects({"objects": {"headline": found}}, headline)) is good


def test_a_watch_that_began_late_states_that() -> None:
    whole = {"text": "1 car, no person; 9 of 9 pictures looked at", "complete": True}
    assert headline_of_watch(whole, ()) == whole
    late = headline_of_watch(whole, (Notice(BEGUN_LATE, 1, ""),))
    assert "before the watch began was not looked at" in late["text"] and not late["complete"]


def test_how_much_is_enough_is_a_share() -> None:
    assert not LookedAt(8, 10).is_enough and LookedAt(8, 10, enough=0.8).is_enough
    for settings in (WatchSettings, MapSettings, CompareSettings):
        with pytest.raises(SettingsError, match="0 to 1, got 90"):
            settings(enough_looked_at=90)
