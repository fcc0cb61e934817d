"""The network: it learns two pictures by heart, goes through its file unchanged, and unlearns nothing unlabelled."""

from copy import deepcopy

import numpy as np
import pytest

torch = pytest.importorskip("torch")

import onnx
from hypothesis import given, settings
from hypothesis import strategies as st

from sorvolo.detection.contract import METADATA_KEY
from sorvolo.errors import InputError
from sorvolo.lab.training.boxes import iou_matrix, suppress
from sorvolo.lab.training.learning import (
    Answer,
    SingleStageTraining,
    assigned,
    collate,
    dense_losses,
)
from sorvolo.lab.training.onnx_export import (
    check_export,
    export_onnx,
    read_layers,
    round_weights,
)
from sorvolo.lab.training.samples import TrainingSample
from sorvolo.lab.training.single_stage import BINS, STRIDES, SingleStage, cells

_SIDE_PX = 64
_CLASSES = ("square", "disc")

torch.set_num_threads(
    1
)  # threads that wait for each other cost more than they give on pictures this small


def _two_pictures() -> list[TrainingSample]:
    """A bright square and a dark disc on gray noise, then the two the other way round."""
    rng = np.random.default_rng(3)
    rows, columns = np.mgrid[:_SIDE_PX, :_SIDE_PX]
    out = []
    for square, disc in (((6, 8), (36, 34)), ((38, 30), (4, 10))):
        image = rng.normal(110, 8, (_SIDE_PX, _SIDE_PX, 3)).clip(0, 255).astype(np.uint8)
        image[square[1] : square[1] + 18, square[0] : square[0] + 18] = 230
        image[(rows - disc[1] - 9.5) ** 2 + (columns - disc[0] - 9.5) ** 2 < 100] = 15
        boxes = np.array(
            [(*square, square[0] + 18, square[1] + 18), (*disc, disc[0] + 20, disc[1] + 20)]
        )
        labels = np.array([0, 1])
        out.append(TrainingSample(image, boxes, labels, np.zeros((0, 4)), np.ones(2, bool)))
    return out


@pytest.fixture(scope="module")
def trained() -> SingleStage:
    """A network that knows the two pictures; its weights are as a file holds them."""
    torch.manual_seed(5)
    training = SingleStageTraining(SingleStage(2), 50, "cpu", is_tuned=False)
    for _ in range(50):
        training.learn(_two_pictures())
    return round_weights(training.average)


@pytest.fixture(scope="module")
def exported(trained: SingleStage) -> bytes:
    return export_onnx(trained, {"classes": [*_CLASSES], "name": "tiny"})


def test_two_pictures_are_learnt_by_heart(trained: SingleStage) -> None:
    for each in _two_pictures():
        with torch.no_grad():
            boxes, scores, labels = trained(torch.from_numpy(each.image.transpose(2, 0, 1))[None])
        assert (scores[:-1] >= scores[1:]).all() and (scores > trained.least_score).all()
        assert len(scores) <= 300
        for label in (0, 1):
            wanted = torch.from_numpy(each.boxes[label : label + 1]).float()
            own = labels == label
            overlap = iou_matrix(boxes[own], wanted)[:, 0]
            assert overlap[0] > 0.6 and scores[own][0] > 1.3 * scores[own][overlap == 0].max()


def test_the_exported_file_gives_what_torch_gives(trained: SingleStage, exported: bytes) -> None:
    wide = np.random.default_rng(3).integers(0, 255, (64, 160, 3), dtype=np.uint8)
    check = check_export(trained, exported, [*(each.image for each in _two_pictures()), wide])
    assert check.is_good and check.detections > 4, check

    other = deepcopy(trained)
    with torch.no_grad():
        other.head.fine_output.bias[-BINS:] += torch.arange(BINS) * 0.1
    check = check_export(other, exported, [each.image for each in _two_pictures()])
    assert not check.is_good and check.box_px > 0.5, check


def test_the_file_stores_weights_in_a_quarter_of_the_bytes(exported: bytes) -> None:
    count = sum(each.numel() for each in SingleStage(2).parameters())
    assert len(exported) < 1.1 * count
    file = onnx.load_model_from_string(exported)
    assert "head.fine_output.weight_quantized" in {each.name for each in file.graph.initializer}
    assert [each.key for each in file.metadata_props] == [METADATA_KEY]


def test_weights_are_carried_on_by_the_name_of_the_class(
    trained: SingleStage, exported: bytes
) -> None:
    torch.manual_seed(6)
    fresh = SingleStage(2)
    tuned = deepcopy(fresh)
    tuned.carry_on(read_layers(exported), _CLASSES, ("boat", "square"))
    for name, value in tuned.state_dict().items():
        of_file, new = trained.state_dict()[name], fresh.state_dict()[name]
        if "output" not in name:
            assert torch.equal(value, of_file), name
            continue
        assert torch.equal(value[2:], of_file[2:]), name  # the sides of boxes are of all classes
        assert torch.equal(value[1], of_file[0]), name
        assert torch.equal(value[0], new[0]), name
        if name.endswith("bias"):
            assert value[0] == pytest.approx(-4.6)


def test_other_networks_are_refused(exported: bytes) -> None:
    layers = read_layers(exported)
    with pytest.raises(InputError, match=r"another network .*head\.fine_output\.weight is missing"):
        SingleStage(2).carry_on(
            {name: each for name, each in layers.items() if "fine_output" not in name},
            _CLASSES,
            _CLASSES,
        )
    with pytest.raises(InputError, match=r"outputs\.0\.weight has the shape \[46, 128, 1, 1\]"):
        SingleStage(2).carry_on(layers, ("square",), _CLASSES)


def _answer(
    boxes: object, labels: object, ignored: object = (), known: object = (True, True)
) -> Answer:
    return Answer(
        torch.tensor(boxes, dtype=torch.float32).reshape(-1, 4),
        torch.tensor(labels, dtype=torch.int64),
        torch.tensor(ignored, dtype=torch.float32).reshape(-1, 4),
        torch.tensor(known),
    )


def _outputs() -> list["torch.Tensor"]:
    """Random outputs of each stride for two classes, of a picture of 64 px."""
    torch.manual_seed(2)
    shapes = [(1, 2 + 4 * BINS, _SIDE_PX // each, _SIDE_PX // each) for each in STRIDES]
    return [torch.randn(shape).requires_grad_() for shape in shapes]


def _taught(answer: Answer) -> "torch.Tensor":
    """(K, 2) how strongly each cell's score of each class is changed."""
    outputs = _outputs()
    sum(dense_losses(outputs, [answer]).values()).backward()  # type: ignore[union-attr]
    grown = [torch.as_tensor(each.grad) for each in outputs]
    return cells(grown, 2)[0][0].abs()


def test_what_is_not_labelled_teaches_nothing() -> None:
    places = cells(_outputs(), 2)[2]
    whole = _taught(_answer([[4, 4, 24, 24]], [0]))
    assert (whole > 0).all()

    ignored = _taught(_answer([[4, 4, 24, 24]], [0], [[32, 0, 64, 64]]))
    inside = (places[:, 0] > 32) & (places[:, 2] < 32)
    assert (ignored[inside] == 0).all() and (ignored[~inside & (places[:, 2] < 32)] > 0).all()

    unknown = _taught(_answer([[4, 4, 24, 24]], [0], known=(True, False)))
    assert (unknown[:, 1] == 0).all() and torch.allclose(unknown[:, 0], whole[:, 0])


def _owners(boxes: object, ignored: object = ()) -> list["torch.Tensor"]:
    """Of each stride the (rows, columns) of things that cells stand for."""
    places = cells(_outputs(), 2)[2]
    sides = [_SIDE_PX // each for each in STRIDES]
    answer = _answer(boxes, [0] * len(boxes), ignored)  # type: ignore[arg-type]
    owner = assigned(
        places,
        [(each, each) for each in sides],
        *(each[None] for each in (answer.boxes, answer.labels, answer.ignored)),
    )[0]
    return [
        part.reshape(each, each) for part, each in zip(owner.split([s * s for s in sides]), sides)
    ]


def test_every_thing_has_cells_of_its_size() -> None:
    fine, *coarser = _owners([[16, 16, 36, 36]])
    assert (fine == 0).any() and all((each == -1).all() for each in coarser[1:])
    rows, columns = torch.nonzero(fine == 0, as_tuple=True)
    assert ((rows * 4 + 2 > 16) & (rows * 4 + 2 < 36)).all() and (columns * 4 + 2 < 36).all()
    fine, *coarser = _owners([[0, 0, 64, 64]])
    assert (fine == -1).all() and any((each == 0).any() for each in coarser)

    # a speck between the cells' centres, and two things that want the same cell
    (fine, *_) = _owners([[12.5, 20.5, 13.5, 21.5]])
    assert torch.nonzero(fine >= 0).tolist() == [[5, 3]]
    (fine, *_) = _owners([[16, 16, 36, 36], [18, 18, 34, 34]])
    assert (fine == 0).any() and (fine == 1).any()
    (fine, *_) = _owners([[16, 16, 36, 36]], [[0, 0, 40, 40]])
    assert (fine[:10, :10] != -1).all() and (fine == 0).any()


@pytest.mark.parametrize("answer", [_answer([], []), _answer([[0, 0, 0.5, 0.5]], [1])])
def test_losses_of_hardly_any_object_are_finite(answer: Answer) -> None:
    losses = dense_losses(_outputs(), [answer])
    assert all(torch.isfinite(each) for each in losses.values()), losses
    assert (float(losses["box"].detach()) > 0) == (len(answer.boxes) > 0)


def test_samples_of_a_batch_may_hold_different_numbers_of_things() -> None:
    one, _ = _two_pictures()
    none = TrainingSample(
        one.image, np.zeros((0, 4)), np.zeros(0, np.int64), np.zeros((0, 4)), one.known
    )
    alone, both = (
        dense_losses([each.repeat(count, 1, 1, 1) for each in _outputs()], collate(batch, "cpu")[1])
        for count, batch in ((1, [one]), (2, [one, none]))
    )
    assert float(both["box"].detach()) == pytest.approx(float(alone["box"].detach()))
    assert both["score"] > alone["score"]


_BOX = st.tuples(st.floats(0, 80), st.floats(0, 80), st.floats(1, 60), st.floats(1, 60)).map(
    lambda b: (b[0], b[1], b[0] + b[2], b[1] + b[3])
)


@settings(max_examples=50, deadline=None)
@given(st.lists(_BOX, min_size=2, max_size=12), st.integers(0, 100))
def test_suppression_keeps_no_two_that_overlap_and_loses_none_that_stands_alone(
    boxes: list[tuple[float, ...]], seed: int
) -> None:
    b = torch.tensor(boxes)
    scores = torch.rand(1, len(boxes), generator=torch.Generator().manual_seed(seed))
    kept = suppress(b, scores, 100, 0.5, 0.0)[:, 1]
    overlap = iou_matrix(b, b)
    among = overlap[kept][:, kept] - torch.eye(len(kept))
    assert (among <= 0.5 + 1e-6).all()
    for index in set(range(len(boxes))) - set(kept.tolist()):
        better = [int(k) for k in kept if scores[0, k] >= scores[0, index]]
        assert (overlap[index][better] > 0.5 - 1e-6).any()
