"""The daylight model: two networks in one graph, and how its scores come about."""

from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from sorvolo.detection.session import Session
from sorvolo.lab.training.daylight import (
    Calibration,
    Daylight,
    DaylightSettings,
    Judge,
    Softened,
    odds_from_scores,
    one_hot,
)
from sorvolo.lab.training.exported import load_exported
from sorvolo.lab.training.nanodet import CocoDetector, NanoDetBackbone, NanoDetHead
from sorvolo.lab.training.onnx_export import onnx_from_module
from sorvolo.lab.training.presets import fast
from sorvolo.survey.objects import CLASSES

INFO = {
    "name": "toy",
    "classes": list(CLASSES),
    "thresholds": dict.fromkeys(CLASSES, 0.5),
    "stride": 32,
    "best_px": {name: [12, 130] for name in CLASSES},
}

PLAIN = Calibration()
ELSEWHERE, THE_SAME = [50.0, 40, 60, 60], [8.0, 8, 24, 25]


class _Aerial(torch.nn.Module):
    """Always finds the same: a person, a car and a small object."""

    def forward(self, images):
        boxes = torch.tensor([[8.0, 8, 24, 24], [32, 32, 80, 64], [70, 10, 90, 30]])
        return boxes, torch.tensor([0.9, 0.8, 0.7]), torch.tensor([0, 1, 2])


class _Coco(torch.nn.Module):
    """Always finds one person; its score maps are `support` everywhere."""

    def __init__(self, box: list[float], score: float, support: float = 0.0) -> None:
        super().__init__()
        self.box, self.score, self.coco_of_class = torch.tensor([box]), torch.tensor([score]), [[0]]
        self.backbone, self.head = NanoDetBackbone(), NanoDetHead()
        for layer in self.head.outputs:
            torch.nn.init.zeros_(layer.weight)
            torch.nn.init.constant_(layer.bias, support)

    def found(self, outputs, size_px):
        return self.box, self.score, torch.zeros(1, dtype=torch.int64)


def _silent_judge(answers: list[float]) -> Judge:
    """Judges every candidate alike."""
    judge = Judge(3)
    with torch.no_grad():
        for each in judge.decide.parameters():
            each.zero_()
        judge.decide[2].bias.copy_(torch.tensor(answers))
    return judge


def _model(
    coco: _Coco,
    said_of_cars: float = 0.0,
    car: Calibration = PLAIN,
    person: Calibration = PLAIN,
    aerial_person: Calibration = PLAIN,
) -> Daylight:
    return Daylight(
        _Aerial(), coco, _silent_judge([9, said_of_cars, 9]), {1: car}, person, aerial_person
    )


def _found(model: Daylight) -> dict[str, list[float]]:
    with torch.no_grad():
        _, scores, labels = model(torch.zeros(1, 3, 64, 96, dtype=torch.uint8))
    out: dict[str, list[float]] = {name: [] for name in CLASSES}
    for score, label in zip(scores.tolist(), labels.tolist()):
        out[CLASSES[label]].append(score)
    return out


def _sigmoid(odds: float) -> float:
    return float(1 / (1 + np.exp(-odds)))


def test_a_judged_score_is_the_mean_of_both_opinions_and_unjudged_ones_stay() -> None:
    found = _found(_model(_Coco(ELSEWHERE, 0.5), said_of_cars=-3.0))
    assert found["car"] == pytest.approx([_sigmoid((np.log(4.0) - 3) / 2)], abs=1e-5)
    assert found["small object"] == pytest.approx([0.7]) and found["person"] == pytest.approx(
        [0.9, 0.5], abs=1e-5
    )


def test_an_aerial_person_is_believed_as_nanodet_supports_it() -> None:
    supported = Calibration(1.0, -1.0, support=0.5)
    found = _found(_model(_Coco(ELSEWHERE, 0.5, support=-4.0), aerial_person=supported))
    assert found["person"] == pytest.approx(
        sorted([0.5, _sigmoid(np.log(9.0) - 1 - 2)], reverse=True), abs=1e-4
    )


def test_a_person_that_both_networks_find_is_one_with_the_better_score() -> None:
    assert _found(_model(_Coco(THE_SAME, 0.6)))["person"] == pytest.approx([0.9], abs=1e-5)
    strict = Calibration(1.0, -4.0)
    assert _found(_model(_Coco(THE_SAME, 0.6), aerial_person=strict))["person"] == pytest.approx(
        [0.6], abs=1e-5
    )


def test_calibrations_are_of_their_own_class() -> None:
    found = _found(
        _model(_Coco(ELSEWHERE, 0.5), person=Calibration(1.0, -2.0), car=Calibration(2.0, 1.0))
    )
    assert found["person"] == pytest.approx([0.9, _sigmoid(-2)], abs=1e-5)
    assert found["car"] == pytest.approx([_sigmoid(2 * np.log(4.0) / 2 + 1)], abs=1e-5)


def test_odds_are_bounded_and_one_hot_marks_labels() -> None:
    odds = odds_from_scores(torch.tensor([0.0, 0.5, 1.0]))
    assert odds[1] == 0 and torch.isfinite(odds).all() and float(odds[2]) > 9 > -9 > float(odds[0])
    assert one_hot(torch.tensor([2, 0]), 3).tolist() == [[0, 0, 1], [1, 0, 0]]


def test_a_head_for_people_finds_them_and_nanodet_supports_it() -> None:
    head = NanoDetHead(1, deeper=True)
    for layer, bias in zip(
        head.outputs, (-9.0, -9.0, 2.0)
    ):  # sure of a person in each cell of 32 px
        torch.nn.init.zeros_(layer.weight)
        torch.nn.init.constant_(layer.bias, bias)
    supported = Calibration(1.0, -1.0, support=0.5)
    model = _model(_Coco(THE_SAME, 0.99, support=-4.0), person=supported)
    model.aerial.forward = lambda images: (
        torch.zeros(1, 4),
        torch.tensor([0.01]),
        torch.tensor([1]),
    )
    model.people = head
    assert _found(model)["person"] == pytest.approx([_sigmoid(2 - 1 - 2)], abs=1e-3)


@pytest.mark.parametrize("has_people", [False, True])
def test_its_onnx_file_gives_what_torch_gives_and_can_be_learnt_on_from(
    tmp_path: Path, has_people: bool
) -> None:
    torch.manual_seed(2)
    aerial = fast(CLASSES).eval()
    torch.nn.init.normal_(aerial.head.scores.weight, std=0.3)
    coco = CocoDetector(NanoDetBackbone(), NanoDetHead(), ((0,),))
    people = NanoDetHead(1, deeper=True) if has_people else None
    model = Daylight(
        aerial, coco, Judge(3), {1: Calibration()}, Calibration(support=0.3), people=people
    ).eval()
    path = tmp_path / "toy.onnx"
    path.write_bytes(onnx_from_module(model, INFO))
    picture = np.random.default_rng(1).integers(0, 256, (128, 192, 3), dtype=np.uint8)
    seen = Session(path, "cpu", 1).see(picture)
    planes = torch.from_numpy(picture).permute(2, 0, 1)[None]
    with torch.no_grad():
        boxes, scores, _ = model(planes)
    real = (boxes[:, 2] > boxes[:, 0]) & (boxes[:, 3] > boxes[:, 1])
    assert len(seen.scores) == int(real.sum()) > 3
    # of a network that learnt nothing, many scores are equal but for rounding: those at the end may differ
    np.testing.assert_allclose(seen.scores[:20], scores[real][:20], atol=1e-4)
    again = fast(CLASSES)
    load_exported(again, path.read_bytes(), planes)
    for key in ("head.scores.weight", "neck.smooth.0.0.weight"):
        if key in aerial.state_dict():
            np.testing.assert_allclose(again.state_dict()[key], aerial.state_dict()[key], rtol=1e-4)
    assert torch.equal(again.head.scores.weight, aerial.head.scores.weight)


class _AerialByDay(_Aerial):
    """Finds nothing in a black picture, as the real one now and then."""

    def forward(self, images):
        boxes, scores, labels = super().forward(images)
        own = torch.nonzero(images.to(torch.float32).amax() > 0 * scores)[:, 0]
        return boxes[own], scores[own], labels[own]


def test_its_onnx_file_takes_a_picture_without_any_aerial_candidate(tmp_path: Path) -> None:
    torch.manual_seed(3)
    coco = CocoDetector(NanoDetBackbone(), NanoDetHead(), ((0,),))
    model = Daylight(_AerialByDay(), coco, Judge(3), {1: Calibration()}, Calibration()).eval()
    path = tmp_path / "toy.onnx"
    path.write_bytes(onnx_from_module(model, INFO))
    session = Session(path, "cpu", 1)
    by_day, by_night = (session.see(np.full((64, 96, 3), value, np.uint8)) for value in (200, 0))
    assert {1, 2} <= set(by_day.labels.tolist())
    assert set(by_night.labels.tolist()) <= {0}


def test_a_softened_picture_keeps_its_size_and_level_up_to_its_edges_and_loses_its_finest_pattern() -> (
    None
):
    softened = Softened(DaylightSettings().softened_px)
    flat = torch.full((1, 3, 20, 32), 200, dtype=torch.uint8)
    torch.testing.assert_close(softened(flat), flat.float())
    rows = (torch.arange(20) % 2 * 200.0)[None, None, :, None].expand(1, 3, 20, 32)
    assert softened(rows)[..., 6:14, :].std() < 0.02 * rows.std()
    blocks = (torch.arange(20) // 10 * 200.0)[None, None, :, None].expand(1, 3, 20, 32)
    assert softened(blocks)[..., :6, :].max() < 1 and softened(blocks)[..., -6:, :].min() > 199
