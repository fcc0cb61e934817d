"""Scores become shares: what a model's file states of them, and what the detector makes of it."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from toy_models import draw, info_of, rectangle_model

from sorvolo.detection.contract import CALIBRATED, METADATA_KEY, ScoreCalibration
from sorvolo.detection.detector import Detector
from sorvolo.detection.fusing import in_own_scale, platt_fit, platt_scaled, scaled_thresholds
from sorvolo.detection.models import installed_models
from sorvolo.errors import InputError

BOXES = [(20, 20, 60, 60), (100, 30, 150, 80), (200, 120, 240, 170)]
PEOPLE = {"person": {"slope": 0.8, "shift": -1.5}}


def loaded(folder: Path, **changed: Any) -> Detector:
    return Detector.load(rectangle_model(folder / "toy.onnx", **changed), provider="cpu", threads=1)


def test_scores_are_scaled_by_class_and_best_first(tmp_path: Path) -> None:
    """People lose by the fit and come after the car that they had outscored; boxes stay with their scores."""
    picture = draw((256, 320), BOXES, labels=[0, 1, 0], scores=[240, 200, 220])
    plain = loaded(tmp_path).detect(picture, least_score=0.0)
    fitted = loaded(tmp_path, calibration=PEOPLE).detect(picture, least_score=0.0)
    assert list(plain.names) == ["person", "person", "car"]
    assert list(fitted.names) == ["car", "person", "person"]
    assert list(fitted.scores) == sorted(fitted.scores, reverse=True)
    own = plain.scores[:2].astype(float)
    expected = 1 / (1 + np.exp(1.5 - 0.8 * np.log(own / (1 - own))))
    np.testing.assert_allclose(fitted.scores[1:], expected, atol=1e-5)
    assert fitted.scores[0] == plain.scores[2]
    np.testing.assert_array_equal(fitted.boxes_px, plain.boxes_px[[2, 0, 1]])


def test_thresholds_are_of_what_comes_out(tmp_path: Path) -> None:
    picture = draw((256, 320), BOXES[:1], scores=[225])  # own score 0.88: 0.53 when scaled
    for least, count in ((0.5, 1), (0.56, 0)):
        detector = loaded(
            tmp_path,
            calibration=PEOPLE,
            thresholds={"person": least, "car": 0.5, "small object": 0.5},
        )
        assert len(detector.detect(picture)) == count
        assert detector.thresholds_for(picture)["person"] == least


def test_a_fit_finds_what_scores_mean() -> None:
    """Reports right as often as a known scale states: it is found again, and then 0.5 means half."""
    rng = np.random.default_rng(5)
    own, truth = rng.uniform(0.02, 0.98, 200_000), ScoreCalibration(0.7, -1.4)
    right = rng.random(len(own)) < platt_scaled(own, truth)
    fit = platt_fit(own, right)
    assert fit is not None
    assert fit.slope == pytest.approx(truth.slope, abs=0.05) and fit.shift == pytest.approx(
        truth.shift, abs=0.05
    )
    scores = platt_scaled(own, fit)
    half = (scores > 0.4) & (scores < 0.6)
    assert right[half].mean() == pytest.approx(0.5, abs=0.03)


def test_no_scale_where_scores_tell_nothing() -> None:
    own = np.array([0.2, 0.4, 0.6, 0.8])
    assert platt_fit(own, np.ones(4, bool)) is None and platt_fit(own, np.zeros(4, bool)) is None
    assert platt_fit(own, own < 0.5) is None


def test_thresholds_go_there_and_back(tmp_path: Path) -> None:
    info = loaded(tmp_path, calibration=PEOPLE).info
    own = in_own_scale(info)
    assert own["car"] == info.thresholds["car"] and own["person"] > info.thresholds["person"]
    assert scaled_thresholds(own, info.calibration) == pytest.approx(dict(info.thresholds))


@pytest.mark.parametrize("score", [0.0, 1.0])
def test_scores_at_the_ends_stay_between(score: float) -> None:
    assert 0 < platt_scaled(score, ScoreCalibration(1.2, -0.5)) < 1


@pytest.mark.parametrize(
    "wrong",
    [
        {"dog": PEOPLE["person"]},
        {"person": {"slope": 0.0, "shift": 0.0}},
        {"person": {"slope": -1.0, "shift": 0.0}},
        {"person": {"slope": 1.0}},
        {"person": {"slope": 1.0, "shift": float("inf")}},
        ["person"],
    ],
)
def test_a_scale_that_cannot_be(wrong: Any) -> None:
    with pytest.raises(InputError, match="cannot be used"):
        info_of(calibration=wrong)


@pytest.mark.parametrize(
    "model", [each for each in installed_models() if each.is_packaged], ids=lambda each: each.name
)
def test_packaged_models_name_the_contract_that_brought_it(model: Any) -> None:
    """An older version would report scores of one scale by thresholds of another: it refuses the file."""
    metadata = {
        each.key: each.value
        for each in onnx.load(model.path, load_external_data=False).metadata_props
    }
    fields = json.loads(metadata[METADATA_KEY])
    assert fields["format"] == (CALIBRATED if "calibration" in fields else 1)
