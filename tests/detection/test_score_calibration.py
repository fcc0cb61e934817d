"""Scores become shares: what a model's file states of them, and what the detector makes of it."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from toy_models import draw, rectangle_model

from sorvolo.detection.calibration import platt_scaled
from sorvolo.detection.contract import FORMAT, METADATA_KEY
from sorvolo.detection.detector import Detector
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
            tmp_path, calibration=PEOPLE, thresholds={"person": least, "car": 0.5, "small object": 0.5}
        )
        assert len(detector.detect(picture)) == count
        assert detector.thresholds_for(picture)["person"] == least


@pytest.mark.parametrize("score", [0.0, 1.0])
def test_scores_at_the_ends_stay_between(score: float) -> None:
    assert 0 < platt_scaled(np.array([score]), 1.2, -0.5)[0] < 1


@pytest.mark.parametrize(
    "wrong", [
        {"dog": PEOPLE["person"]}, {"person": {"slope": 0.0, "shift": 0.0}}, {"person": {"slope": -1.0, "shift": 0.0}},
        {"person": {"slope": 1.0}}, {"person": {"slope": 1.0, "shift": float("inf")}}, ["person"],
    ],
)
def test_a_scale_that_cannot_be(tmp_path: Path, wrong: Any) -> None:
    with pytest.raises(InputError, match="cannot be used"):
        loaded(tmp_path, calibration=wrong)


@pytest.mark.parametrize("model", [each for each in installed_models() if each.is_packaged], ids=lambda each: each.name)
def test_packaged_models_name_the_contract_that_brought_it(model: Any) -> None:
    """An older version would report scores of one scale by thresholds of another: it refuses the file."""
    metadata = {each.key: each.value for each in onnx.load(model.path, load_external_data=False).metadata_props}
    fields = json.loads(metadata[METADATA_KEY])
    assert fields["format"] == (FORMAT if "calibration" in fields else 1)
