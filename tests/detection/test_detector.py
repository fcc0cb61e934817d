"""The detector on pictures of every kind, with a model that finds bright rectangles exactly."""

import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from toy_models import CLASSES, draw, rectangle_model

import sorvolo
from sorvolo.detection.detector import Detector
from sorvolo.detection.session import Seen, Session
from sorvolo.errors import InputError, SettingsError

_BOXES = [(10, 20, 50, 80), (170, 60, 200, 90), (60, 100, 90, 120)]


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return rectangle_model(tmp_path_factory.mktemp("models") / "toy.onnx")


@pytest.fixture(scope="module")
def detector(model: Path) -> Detector:
    return Detector.load(model, provider="cpu", threads=1)


@pytest.fixture
def picture() -> np.ndarray:
    return draw((120, 200), _BOXES, labels=[0, 1, 2], scores=[250, 200, 225])


@pytest.mark.parametrize("provider", ["cpu", "openvino", "auto"])
def test_finds_what_is_there(model: Path, picture: np.ndarray, provider: str) -> None:
    if provider == "openvino":
        pytest.importorskip("openvino")
    detections = sorvolo.Detector.load(str(model), provider=provider, threads=1).detect(picture)
    assert detections.names == ["person", "small object", "car"], "best first"
    np.testing.assert_allclose(detections.boxes_px, [_BOXES[0], _BOXES[2], _BOXES[1]])
    np.testing.assert_allclose(detections.scores, np.array([250, 225, 200]) / 255, atol=1e-6)


@pytest.mark.parametrize("size", [(1, 1), (31, 33), (64, 32), (257, 300)])
def test_any_size_is_padded_and_boxes_end_at_the_picture(
    detector: Detector, size: tuple[int, int]
) -> None:
    height, width = size
    picture = draw(size, [(width // 2, height // 2, width, height)])
    np.testing.assert_allclose(
        detector.detect(picture).boxes_px, [(width // 2, height // 2, width, height)]
    )
    assert len(detector.detect(np.zeros(size, np.uint8))) == 0


def test_grey_transparent_and_deep_pictures_look_the_same(
    detector: Detector, picture: np.ndarray
) -> None:
    expected = detector.detect(picture)
    alpha = np.concatenate([picture, np.zeros_like(picture[:, :, :1])], axis=2)
    deep = picture.astype(np.uint16) * 257
    for other in (alpha, deep, np.asfortranarray(picture), np.repeat(picture, 2, axis=1)[:, ::2]):
        found = detector.detect(other)
        np.testing.assert_array_equal(found.boxes_px, expected.boxes_px)
        np.testing.assert_array_equal(found.labels, expected.labels)
    # grey: green is red, and so all are of the class of 200 to 255
    grey = detector.detect(picture[:, :, 0], classes=CLASSES[2])
    assert len(grey) == 3 and set(grey.names) == {"small object"}
    np.testing.assert_array_equal(grey.boxes_px, detector.detect(picture[:, :, :1]).boxes_px)


def test_raw_thermal_frames_are_stretched(detector: Detector) -> None:
    heat = np.full((120, 200), 7300, np.uint16)
    heat[20:80, 10:50] = 7800
    np.testing.assert_allclose(detector.detect(heat, least_score=0.9).boxes_px, [_BOXES[0]])
    assert (
        len(
            detector.detect(
                np.full((120, 200), 7300, np.uint16) + np.arange(200, dtype=np.uint16) % 3
            )
        )
        <= 1
    )


@pytest.mark.parametrize(
    ("wrong", "reason"),
    [
        (np.zeros((4, 4)), "255 \\*"),
        (np.zeros((4, 4, 2), np.uint8), "\\(4, 4, 2\\)"),
        (np.zeros((3, 40, 40), np.uint8), "transpose"),
        (np.zeros((0, 4, 3), np.uint8), "no picture"),
        (np.zeros(7, np.uint8), "no picture"),
        (np.zeros((4, 4, 3), bool), "bool"),
        (None, "NoneType"),
        (["a.jpg"], "list"),
    ],
)
def test_what_is_no_picture_is_refused(detector: Detector, wrong: object, reason: str) -> None:
    with pytest.raises(InputError, match=reason):
        detector.detect(wrong)  # type: ignore[arg-type]


def test_large_cars_are_seen_in_a_smaller_look_and_people_in_the_picture(
    detector: Detector, monkeypatch: pytest.MonkeyPatch
) -> None:
    picture = draw(
        (900, 1200), [(10, 20, 50, 80), (300, 300, 900, 600)], labels=[0, 1], scores=[200, 250]
    )
    scales = []

    def noted(session: Session, rgb: np.ndarray, scale: float = 1.0) -> Seen:
        scales.append(scale)
        return see(session, rgb, scale)

    see = Session.see
    monkeypatch.setattr(Session, "see", noted)
    longest_px = detector.info.best_px["car"][1]
    early = []
    m_per_px = 4.4 / (1.5 * longest_px)
    seen = detector.detect(
        picture,
        tiles="auto",
        m_per_px=m_per_px,
        early=lambda *found: early.append((*scales, *found)),
    )
    assert scales == pytest.approx([1 / 1.5, 1.0])
    assert seen.names == ["car", "person"], "each once, best first"
    np.testing.assert_allclose(seen.boxes_px, [(300, 300, 900, 600), (10, 20, 50, 80)], atol=2)
    ((_, classes, cars),) = early  # after the first look, and never after the last
    assert classes == ("car",) and cars.names == ["car"]
    np.testing.assert_array_equal(cars.boxes_px, seen.boxes_px[:1])
    found = detector.detect(picture, early=lambda *found: early.append(found))
    assert len(found) == 2 and scales[2:] == [1.0] and len(early) == 1, (
        "unknown ground is looked at once"
    )


def test_each_class_has_its_own_threshold(detector: Detector) -> None:
    picture = draw((120, 200), _BOXES, labels=[0, 1, 2], scores=[130, 130, 130])
    found = detector.detect(picture)
    assert found.names == ["person", "car"], (
        "0.51 lies above the thresholds of people and cars, below small objects'"
    )
    assert len(detector.detect(picture, least_score=0.5)) == 3
    assert len(detector.detect(picture, least_score=0.52)) == 0
    assert detector.detect(picture, classes=["car"]).names == ["car"]


@pytest.mark.parametrize(
    "wish",
    [
        {"classes": ["horse"]},
        {"classes": []},
        {"least_score": 2.0},
        {"tiles": 3},
        {"tiles": "some"},
        {"m_per_px": 0},
    ],
)
def test_wishes_that_cannot_be(
    detector: Detector, picture: np.ndarray, wish: dict[str, object]
) -> None:
    with pytest.raises(SettingsError):
        detector.detect(picture, **({"tiles": "auto"} | wish))  # type: ignore[arg-type]


def test_a_sampling_distance_of_nan_is_one_that_is_not_known(
    detector: Detector, picture: np.ndarray
) -> None:
    for tiles in ("auto", 64, None):
        unsaid, nan = (
            detector.detect(picture, tiles=tiles, m_per_px=each) for each in (None, float("nan"))
        )  # type: ignore[call-overload]
        np.testing.assert_array_equal(unsaid.boxes_px, nan.boxes_px)
        assert unsaid.names == nan.names and len(nan) == 3


@pytest.mark.long
def test_a_picture_of_a_hundred_megapixels_is_searched_to_its_last_corner(
    detector: Detector,
) -> None:
    boxes = [(0, 0, 30, 40), (6380, 4400, 6420, 4450), (11960, 8970, 12000, 9000)]
    picture = draw((9000, 12000), boxes)
    found = detector.detect(picture)
    np.testing.assert_allclose(sorted(map(tuple, found.boxes_px.tolist())), boxes, atol=1e-3)


def test_a_model_of_one_size_sees_any_picture(tmp_path: Path) -> None:
    fixed = Detector.load(
        rectangle_model(tmp_path / "fixed.onnx", fixed=(64, 96)), provider="cpu", threads=1
    )
    np.testing.assert_allclose(
        fixed.detect(draw((40, 50), [(10, 5, 30, 25)])).boxes_px, [(10, 5, 30, 25)]
    )
    large = draw((256, 256), [(64, 128, 128, 192)])
    np.testing.assert_allclose(fixed.detect(large).boxes_px, [(64, 128, 128, 192)], atol=4)
    np.testing.assert_allclose(
        fixed.detect(large, tiles="auto").boxes_px, [(64, 128, 128, 192)], atol=1e-3
    )


def test_states_where_it_runs_and_what_it_is(detector: Detector) -> None:
    assert detector.provider == "ONNX Runtime on the CPU, 1 thread"
    assert detector.classes == CLASSES
    assert (detector.info.name, detector.info.stride, detector.info.best_px["car"]) == (
        "toy",
        32,
        (16.0, 200.0),
    )


class TestThermalFramesAndDaylightModels:
    """A model that knows daylight alone hands thermal frames to one that knows both, and reports it."""

    @pytest.fixture(autouse=True)
    def _folder(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.folder = tmp_path / "models"
        self.folder.mkdir()
        monkeypatch.setenv("SORVOLO_MODELS", str(self.folder))
        day = rectangle_model(tmp_path / "day.onnx", name="day", thermal=False)
        self.day = Detector.load(day, provider="cpu", threads=1)

    def test_an_installed_thermal_model_is_used(self, picture: np.ndarray) -> None:
        # its class 2 is the daylight model's 0, so that its labels must be translated
        order = ["small object", "car", "person"]
        rectangle_model(self.folder / "night.onnx", name="night", classes=order)
        (self.folder / "broken.onnx").write_bytes(b"no model")
        assert self.day.detect(picture).names == ["person", "small object", "car"]
        assert self.day.notices == ()
        grey = np.repeat(picture[:, :, :1], 3, axis=2)
        found = self.day.detect(grey)
        assert set(found.names) == {"person"} and found.classes == CLASSES
        (notice,) = self.day.notices
        assert (notice.code, notice.count) == ("thermal_model", 1) and "night" in notice.text

    def test_its_own_thresholds_hold(self) -> None:
        rectangle_model(
            self.folder / "night.onnx", name="night", thresholds=dict.fromkeys(CLASSES, 0.6)
        )
        picture = draw((120, 200), _BOXES, labels=[0, 0, 0], scores=[130, 130, 130])
        grey = np.repeat(picture[:, :, :1], 3, axis=2)
        assert len(self.day.detect(grey)) == 0, (
            "0.51 lies below them, above the daylight model's of people"
        )
        assert len(self.day.detect(grey, least_score=0.4)) == 3

    def test_without_one_it_is_reported(self, picture: np.ndarray, tmp_path: Path) -> None:
        classes = ["boat", "buoy", "raft"]  # none that the packaged model knows
        stated = {
            "thresholds": dict.fromkeys(classes, 0.3),
            "best_px": {each: [4, 300] for each in classes},
        }
        model = rectangle_model(
            tmp_path / "sea.onnx", name="sea", thermal=False, classes=classes, **stated
        )
        sea = Detector.load(model, provider="cpu", threads=1)
        for polarity in (picture[:, :, 0], 255 - picture[:, :, 0]):
            sea.detect(polarity)
        (notice,) = sea.notices
        assert (notice.code, notice.count) == ("thermal_untrained", 2)

    def test_a_model_names_the_one_that_looks_at_thermal_frames(
        self, picture: np.ndarray, tmp_path: Path
    ) -> None:
        known = {"thermal": True, "thermal_by": "night"}
        both = rectangle_model(tmp_path / "both.onnx", name="both", **known)
        grey = draw((120, 200), _BOXES, labels=[0, 0, 0], scores=[130, 130, 130])
        grey = np.repeat(grey[:, :, :1], 3, axis=2)
        assert len(Detector.load(both, provider="cpu", threads=1).detect(grey)) == 3, (
            "not installed: it looks itself"
        )
        high = {"thresholds": dict.fromkeys(CLASSES, 0.6)}
        rectangle_model(self.folder / "another.onnx", name="another")
        rectangle_model(self.folder / "night.onnx", name="night", daylight=False, **high)
        detector = Detector.load(both, provider="cpu", threads=1)
        assert len(detector.detect(picture)) == 3 and detector.notices == detector.others == ()
        assert len(detector.detect(grey)) == 0, "the thresholds are those of the model that looks"
        assert len(detector.detect(grey, least_score=0.4)) == 3
        (notice,) = detector.notices
        assert (notice.code, notice.count) == (
            "thermal_model",
            2,
        ) and "'night', which was trained" in notice.text
        assert [(each.name, count) for each, count in detector.others] == [("night", 2)]

    def test_a_thermal_model_states_that_colour_is_not_known(self, picture: np.ndarray) -> None:
        night = rectangle_model(self.folder / "night.onnx", name="night", daylight=False)
        detector = Detector.load(night, provider="cpu", threads=1)
        detector.detect(picture[:, :, 0])
        assert detector.notices == ()
        detector.detect(picture)
        detector.detect(picture, is_part=True)
        (notice,) = detector.notices
        assert (notice.code, notice.count) == ("daylight_untrained", 1) and "'night'" in notice.text

    def test_threads_that_ask_at_once_get_the_same_model(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        rectangle_model(
            self.folder / "night.onnx", name="night", thresholds=dict.fromkeys(CLASSES, 0.6)
        )
        grey = np.repeat(
            draw((120, 200), _BOXES, labels=[0, 0, 0], scores=[130, 130, 130])[:, :, :1], 3, axis=2
        )

        def slowly(*asked: object) -> Path:
            time.sleep(0.2)
            return self.folder / "night.onnx"

        monkeypatch.setattr("sorvolo.detection.detector.thermal_model", slowly)
        with ThreadPoolExecutor(4) as threads:
            found = list(threads.map(lambda _: len(self.day.detect(grey)), range(4)))
        assert found == [0, 0, 0, 0]

    def test_thresholds_are_those_of_the_model_that_looks(self, picture: np.ndarray) -> None:
        rectangle_model(
            self.folder / "night.onnx", name="night", thresholds=dict.fromkeys(CLASSES, 0.6)
        )
        assert self.day.thresholds_for(picture) == self.day.info.thresholds
        assert set(self.day.thresholds_for(picture[:, :, 0]).values()) == {0.6}
        assert self.day.notices == (), "asking is not looking"


def test_people_who_are_too_small_from_above_are_not_looked_for_and_a_notice_states_it(
    picture: np.ndarray, tmp_path: Path
) -> None:
    detector = Detector.load(rectangle_model(tmp_path / "model.onnx"), provider="cpu", threads=1)
    fine, coarse = 0.09, 0.12
    look = partial(detector.detect, picture, from_above=True)
    assert look(m_per_px=fine).names == look().names == ["person", "small object", "car"]
    assert detector.notices == ()
    assert look(m_per_px=coarse).names == ["small object", "car"]
    assert not len(look(m_per_px=coarse, classes=["person"]))
    assert detector.detect(picture, m_per_px=coarse).names == ["person", "small object", "car"], (
        "from aslant"
    )
    (notice,) = detector.notices
    assert (notice.code, notice.count) == ("people_too_small", 2) and "10 cm" in notice.text
    above = partial(detector.thresholds_for, picture, from_above=True)
    assert list(above(m_per_px=fine)) == list(above()) == list(detector.classes)
    assert list(above(m_per_px=coarse)) == [each for each in detector.classes if each != "person"]
    assert list(detector.thresholds_for(picture, m_per_px=coarse)) == list(detector.classes)
