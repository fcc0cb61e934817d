"""Two detectors in one graph: how their scores and boxes become one."""

from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from sorvolo.detection.session import Session
from sorvolo.lab.training.nanodet import CocoDetector, NanoDetBackbone, NanoDetHead
from sorvolo.lab.training.onnx_export import onnx_from_module
from sorvolo.lab.training.presets import fast
from sorvolo.lab.training.together import Together, TogetherSettings, fused
from sorvolo.survey.objects import CLASSES

INFO = {
    "name": "toy",
    "classes": list(CLASSES),
    "thresholds": dict.fromkeys(CLASSES, 0.5),
    "stride": 32,
    "best_px": {name: [12, 130] for name in CLASSES},
}
UNSEEN = TogetherSettings().unseen_odds


def _found(*rows: tuple[float, ...]):
    """Boxes, scores and labels of rows of left, top, right, bottom, score, label."""
    table = torch.tensor(rows, dtype=torch.float32).reshape(-1, 6)
    return table[:, :4], table[:, 4], table[:, 5].long()


def _odds(score: float) -> float:
    return float(np.log(score / (1 - score)))


def test_what_both_see_gets_the_mean_of_their_log_odds_and_a_box_between_theirs() -> None:
    boxes, scores, labels = fused(
        _found((10, 10, 30, 30, 0.9, 0)), _found((12, 10, 32, 30, 0.6, 0))
    )
    expected = 1 / (1 + np.exp(-(_odds(0.9) + _odds(0.6)) / 2))
    np.testing.assert_allclose(scores, [expected, expected], atol=1e-5)
    np.testing.assert_allclose(boxes, [[11, 10, 31, 30]] * 2)
    assert labels.tolist() == [0, 0]


@pytest.mark.parametrize(
    "other",
    [
        (10, 10, 30, 30, 0.9, 1),  # another class
        (25, 10, 45, 30, 0.9, 0),  # elsewhere
    ],
)
def test_what_one_alone_sees_is_weighed_against_the_others_silence(
    other: tuple[float, ...],
) -> None:
    boxes, scores, _ = fused(_found((10, 10, 30, 30, 0.9, 0)), _found(other))
    np.testing.assert_allclose(
        scores, [1 / (1 + np.exp(-(_odds(0.9) + UNSEEN) / 2))] * 2, atol=1e-5
    )
    np.testing.assert_allclose(boxes, [[10, 10, 30, 30], other[:4]])


def test_where_the_other_sees_nothing_at_all_its_silence_counts() -> None:
    nothing = _found()
    for pair in (
        (_found((10, 10, 30, 30, 0.9, 0)), nothing),
        (nothing, _found((10, 10, 30, 30, 0.9, 0))),
    ):
        boxes, scores, labels = fused(*pair)
        assert boxes.tolist() == [[10, 10, 30, 30]] and labels.tolist() == [0]
        assert float(scores[0]) == pytest.approx(
            1 / (1 + np.exp(-(_odds(0.9) + UNSEEN) / 2)), abs=1e-5
        )
    assert all(len(each) == 0 for each in fused(nothing, nothing))


class _Finds(torch.nn.Module):
    """Always finds the same."""

    def __init__(self, *rows: tuple[float, ...]) -> None:
        super().__init__()
        self.rows = rows

    def forward(self, images):
        return _found(*self.rows)


def test_one_box_of_a_thing_is_reported_best_first() -> None:
    model = Together(
        _Finds((10, 10, 30, 30, 0.9, 0), (50, 50, 70, 60, 0.7, 1)),
        _Finds((12, 10, 32, 30, 0.6, 0), (80, 80, 90, 90, 0.99, 2)),
    )
    boxes, scores, labels = model(torch.zeros(1, 3, 96, 96))
    assert labels.tolist() == [0, 2, 1]
    np.testing.assert_allclose(boxes[0], [11, 10, 31, 30])
    assert (np.diff(scores.numpy()) < 0).all()


def test_the_exported_graph_finds_what_torch_finds(tmp_path: Path) -> None:
    torch.manual_seed(3)
    head = NanoDetHead(3, deeper=True)
    coco = CocoDetector(NanoDetBackbone(), head, ((0,), (1,), (2,)))
    model = Together(fast(CLASSES), coco).eval()
    file = tmp_path / "toy.onnx"
    file.write_bytes(onnx_from_module(model, INFO))
    session = Session(file, "cpu", 1)
    rng = np.random.default_rng(5)
    for size in ((96, 128), (160, 96)):
        picture = rng.integers(0, 256, (*size, 3)).astype(np.uint8)
        seen = session.see(picture)
        with torch.no_grad():
            boxes, scores, _ = model(torch.from_numpy(picture.transpose(2, 0, 1).copy())[None])
        assert len(scores) and len(seen.scores) == len(scores)
        np.testing.assert_allclose(seen.scores, scores, atol=1e-4)
        np.testing.assert_allclose(
            np.sort(seen.boxes_px, axis=0), np.sort(boxes, axis=0), atol=0.05
        )


def test_of_two_boxes_of_one_score_the_first_networks_stays_whatever_the_rounding(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # the first finds one thing; the second finds two that overlap it, the worse one better placed
    first = _Finds((10, 10, 30, 30, 0.8, 0))
    second = _Finds((14, 10, 34, 30, 0.7, 0), (11, 10, 31, 30, 0.7, 0))
    every, all_scores, labels = fused(first(None), second(None))
    assert float(all_scores.max() - all_scores.min()) < 1e-6  # a tie of three, of different boxes
    assert len({tuple(each) for each in every.tolist()}) > 1
    rounded = all_scores + torch.tensor(
        [0.0, 1e-6, 0.0]
    )  # as another order of the same sums may give
    monkeypatch.setattr("sorvolo.lab.training.together.fused", lambda *_: (every, rounded, labels))
    boxes, *_ = Together(first, second)(torch.zeros(1, 3, 96, 96))
    np.testing.assert_allclose(boxes, every[:1])
