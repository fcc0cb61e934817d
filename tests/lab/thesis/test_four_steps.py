"""The thesis's network and schedule: Table 3.2, regions cut as ONNX cuts them, four steps that go on after a kill."""

import hashlib
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")

import onnxruntime
from hypothesis import given
from hypothesis import settings as examples
from hypothesis import strategies as st
from onnx import TensorProto, helper

from sorvolo.errors import InputError
from sorvolo.lab.thesis import resnet
from sorvolo.lab.thesis.faster_rcnn import (
    FasterRCNN,
    ProposalNetwork,
    Proposed,
    StageHead,
    boxes_from_offsets,
    offsets_from_boxes,
    roi_align,
)
from sorvolo.lab.thesis.four_steps import (
    LOSS_NAMES,
    FourStepTraining,
    match_boxes,
    proposal_loss,
    region_loss,
)
from sorvolo.lab.thesis.network import ExtendedStack, thesis_network
from sorvolo.lab.training.learning import Answer
from sorvolo.lab.training.onnx_export import check_export, export_onnx
from sorvolo.lab.training.progress import History, checkpoint_bytes, read_checkpoint, restore
from sorvolo.lab.training.samples import TrainingSample
from sorvolo.lab.training.settings import TrainSettings
from sorvolo.lab.training.start import load_start, start_learner

torch.set_num_threads(1)


class _TinyBackbone(torch.nn.Module):
    """Features of stride 16, 12 channels."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = torch.nn.Sequential(
            torch.nn.Conv2d(3, 8, 4, 4),
            torch.nn.BatchNorm2d(8),
            torch.nn.ReLU(),
            torch.nn.Conv2d(8, 12, 4, 4),
        )

    def forward(self, images: "torch.Tensor") -> "torch.Tensor":
        return self.layers(images.float() / 128 - 1)


def _learner(steps: int = 8) -> FourStepTraining:
    torch.manual_seed(0)
    proposals = ProposalNetwork(resnet.convolution(12, 12, 3), 12, 16)
    head = StageHead(torch.nn.Conv2d(12, 16, 3), 16, 2)
    return FourStepTraining(FasterRCNN(_TinyBackbone(), proposals, head), steps, 3)


def _batch(number: int) -> list[TrainingSample]:
    rng = np.random.default_rng(number)
    image = rng.integers(60, 100, (64, 96, 3)).astype(np.uint8)
    image[16:32, 16:32] = (200, 60, 60)
    boxes = np.array([[16, 16, 32, 32]])
    none = np.zeros((0, 4))
    return [TrainingSample(image, boxes, np.array([1]), none, np.ones(2, bool))] * 2


@pytest.mark.parametrize("killed_after", [1, 3, 7])
def test_a_resumed_run_has_the_losses_of_one_that_was_not_stopped(killed_after: int) -> None:
    whole, first, second = _learner(), _learner(), _learner()
    wanted = [whole.learn(_batch(number)).losses for number in range(8)]
    for number in range(killed_after):
        first.learn(_batch(number))
    saved = checkpoint_bytes(first, {}, History())
    restore(second, read_checkpoint(saved, "checkpoint"), {})
    found = [second.learn(_batch(number)).losses for number in range(killed_after, 8)]
    assert found == wanted[killed_after:]
    for name, value in second.average.state_dict().items():
        assert torch.equal(value, whole.average.state_dict()[name]), name


_Weights = dict[str, dict[str, "torch.Tensor"]]


def _copies(learner: FourStepTraining) -> _Weights:
    return {
        part: {name: each.clone() for name, each in module.state_dict().items()}
        for part, module in learner.model.named_children()
    }


def _moved(before: _Weights, after: _Weights) -> set[str]:
    return {
        part
        for part, now in after.items()
        if any(not torch.equal(value, before[part][name]) for name, value in now.items())
    }


def test_the_four_steps_train_what_they_should() -> None:
    learner = _learner()
    states, learnt = [_copies(learner)], []
    for number in range(8):
        losses = learner.learn(_batch(number)).losses
        if number % 2:
            states.append(_copies(learner))
            learnt.append({name for name in LOSS_NAMES if losses[name] > 0})
            assert learner.is_whole == (number == 7)
    # the second step begins again from the first weights, so its shared layers are neither
    assert [_moved(*each) for each in pairwise(states)] == [
        {"backbone", "proposals"},
        {"backbone", "head"},
        {"proposals"},
        {"head"},
    ]
    assert learnt == [set(LOSS_NAMES[:2]), set(LOSS_NAMES[2:])] * 2


def test_the_second_step_begins_from_the_first_weights_and_the_first_steps_proposals() -> None:
    learner = _learner()
    start = _copies(learner)
    learner.learn(_batch(0))
    learner.learn(_batch(1))
    first = _copies(learner)
    learner._enter(1)
    assert "backbone" not in _moved(start, _copies(learner))
    assert learner._proposer is not None
    for name, value in learner._proposer[0].state_dict().items():
        assert torch.equal(value, first["backbone"][name])


def test_the_preset_thesis_learns_in_four_steps() -> None:
    settings = TrainSettings("thesis", "standard", weights="none", steps=4)
    learner = start_learner(settings, ("person", "car"), load_start(settings), "cpu")
    assert isinstance(learner, FourStepTraining) and learner.phase == "1/4 proposals"
    assert all(each.requires_grad for each in learner.model.parameters())


@pytest.mark.parametrize("is_small", [True, pytest.param(False, marks=pytest.mark.long)])
def test_the_exported_file_finds_the_same(is_small: bool) -> None:
    torch.manual_seed(1)
    classes = ("person", "car")
    model = _learner().model if is_small else thesis_network(classes, "standard")
    picture = np.random.default_rng(3).integers(0, 255, (64, 96, 3), dtype=np.uint8)
    check = check_export(model, export_onnx(model, {"classes": classes}), [picture])
    assert check.is_good and check.detections > 5, check


def test_the_thesis_stack_has_the_tables_layers() -> None:
    stack = ExtendedStack(1024)
    filters = [[64, 96, 64]] * 2 + [[64, 96, 64, 224]] + [[192] * 3] * 4 + [[320] + [384] * 4] * 2
    assert [layer.channels for layer in stack.layers] == [sum(each) for each in filters]
    assert stack.eval()(torch.zeros(1, 1024, 5, 7)).shape == (1, 1856, 5, 7)
    assert 13.3e6 < sum(each.numel() for each in stack.parameters()) < 13.5e6


_BOX = st.tuples(st.floats(0, 80), st.floats(0, 80), st.floats(1, 60), st.floats(1, 60)).map(
    lambda b: (b[0], b[1], b[0] + b[2], b[1] + b[3])
)


@examples(max_examples=50, deadline=None)
@given(st.lists(_BOX, min_size=1, max_size=6), st.lists(_BOX, min_size=1, max_size=6))
def test_offsets_lead_back_to_their_boxes(
    boxes: list[tuple[float, ...]], anchors: list[tuple[float, ...]]
) -> None:
    count = min(len(boxes), len(anchors))
    b, a = (torch.tensor(each[:count], dtype=torch.float64) for each in (boxes, anchors))
    assert torch.allclose(boxes_from_offsets(offsets_from_boxes(b, a), a), b, atol=1e-6)


def test_regions_are_cut_as_onnx_cuts_them() -> None:
    features = torch.randn(1, 3, 20, 24)
    boxes = torch.tensor(
        [[0.0, 0, 96, 80], [10.3, 7.7, 31.2, 60.1], [50, 20, 54, 23], [60, 60, 96, 80]]
    )
    node = helper.make_node(
        "RoiAlign",
        ["x", "r", "b"],
        ["y"],
        output_height=7,
        output_width=7,
        sampling_ratio=2,
        spatial_scale=0.25,
        mode="avg",
        coordinate_transformation_mode="half_pixel",
    )
    graph = helper.make_graph(
        [node],
        "roi",
        [
            helper.make_tensor_value_info("x", TensorProto.FLOAT, [1, 3, 20, 24]),
            helper.make_tensor_value_info("r", TensorProto.FLOAT, [4, 4]),
            helper.make_tensor_value_info("b", TensorProto.INT64, [4]),
        ],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, None)],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    session = onnxruntime.InferenceSession(
        model.SerializeToString(), providers=["CPUExecutionProvider"]
    )
    feed = {"x": features.numpy(), "r": boxes.numpy(), "b": np.zeros(4, np.int64)}
    ours = roi_align(features, boxes, torch.zeros(4, dtype=torch.int64), 4).numpy()
    assert np.abs(session.run(None, feed)[0] - ours).max() < 1e-4


def _answer(
    boxes: object, labels: object, ignored: object = (), known: object = (True, True)
) -> Answer:
    return Answer(
        torch.tensor(boxes, dtype=torch.float32).reshape(-1, 4),
        torch.tensor(labels, dtype=torch.int64),
        torch.tensor(ignored, dtype=torch.float32).reshape(-1, 4),
        torch.tensor(known),
    )


def test_ignored_regions_teach_nothing() -> None:
    anchors = torch.tensor([[0.0, 0, 20, 20], [40, 40, 50, 50], [80, 80, 90, 90]])
    answer = _answer([[0, 0, 24, 24]], [0], [[78, 78, 95, 95]])
    assert match_boxes(anchors, answer, over=0.5, under=0.4).tolist() == [0, -1, -2]
    assert match_boxes(anchors, answer, over=0.7, under=0.4).tolist() == [-2, -1, -2]


@pytest.mark.parametrize(("wide_px", "is_positive"), [(15, True), (13, False)])
def test_the_thesis_learns_only_from_anchors_that_overlap_by_more_than_0_7(
    wide_px: int, is_positive: bool
) -> None:
    anchors = torch.tensor([[0.0, 0, 20, 20], [60, 60, 80, 80]])
    proposed = Proposed(torch.zeros(1, 2), torch.ones(1, 2, 4), anchors)
    answer = _answer([[0, 0, wide_px, 20]], [0])
    _, box = proposal_loss(proposed, [answer], torch.Generator().manual_seed(1))
    assert (float(box) > 0) is is_positive


def test_a_class_without_labels_is_not_unlearnt() -> None:
    scores = torch.tensor([[0.0, 3.0, 0.0]], requires_grad=True)
    offsets, regions = torch.zeros(1, 4), torch.tensor([[0.0, 0, 9, 9]])
    for known, learns in (((True, True), True), ((True, False), False)):
        answer = _answer([], [], known=known)
        loss, box = region_loss(scores, offsets, regions, torch.tensor([-1]), answer)
        (gradient,) = torch.autograd.grad(loss, scores)
        assert (abs(float(gradient[0, 1])) > 0.1) == learns and float(box) == 0.0


def test_a_package_must_have_its_hash(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No network is used: an address that nothing answers stands for the registry."""
    monkeypatch.setenv("SORVOLO_CACHE", str(tmp_path))
    monkeypatch.setattr(resnet, "PACKAGE_URL", "http://127.0.0.1:9/resnet.tgz")
    cached = tmp_path / "weights" / "resnet.tgz"
    cached.parent.mkdir()
    cached.write_bytes(b"cut short")
    with pytest.raises(InputError, match=r"cannot be fetched.*weights FILE"):
        resnet.imagenet_weights("auto")
    for name, fault in ((str(cached), r"resnet\.tgz is not"), ("gone.tgz", "no weights at gone")):
        with pytest.raises(InputError, match=rf"{fault}.*for the preset thesis"):
            resnet.imagenet_weights(name)

    monkeypatch.setattr(resnet, "PACKAGE_SHA256", hashlib.sha256(b"cut short").hexdigest())
    monkeypatch.setattr(
        resnet, "resnet50_from_tarball", lambda data: {"size": torch.tensor(len(data))}
    )
    start = resnet.imagenet_weights("auto")
    assert (start.origin, start.identity, int(start.layers["size"])) == (
        "resnet.tgz (MIT)",
        "ImageNet",
        9,
    )
