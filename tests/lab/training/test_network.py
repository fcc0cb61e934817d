"""The network: laws of boxes and regions, Table 3.2, and that a small one learns, goes on and exports."""

from copy import deepcopy
from itertools import islice

import numpy as np
import pytest

torch = pytest.importorskip("torch")

import onnxruntime
from hypothesis import given, settings
from hypothesis import strategies as st
from onnx import TensorProto, helper

from sorvolo.lab.thesis.four_steps import proposal_loss
from sorvolo.lab.thesis.network import ExtendedStack
from sorvolo.lab.training.backbones import EfficientNetLite0, FeaturePyramid
from sorvolo.lab.training.faster_rcnn import (
    AnchorSettings,
    FasterRCNN,
    ProposalNetwork,
    Proposed,
    Reach,
    ResidualStack,
    fast,
    proposal_stem,
)
from sorvolo.lab.training.joint import (
    Answer,
    JointSettings,
    JointTraining,
    joint_proposal_loss,
    match_boxes,
    region_loss,
)
from sorvolo.lab.training.onnx_export import check_export, export_onnx
from sorvolo.lab.training.regions import (
    TwoLayerHead,
    boxes_from_offsets,
    iou_matrix,
    offsets_from_boxes,
    pooled_levels,
    roi_align,
    suppress,
)
from sorvolo.lab.training.samples import (
    Augmentation,
    Share,
    TrainingSample,
    cut_sample,
)
from sorvolo.survey.labels import LabelledPicture, LabelledSet

_SIDE_PX = 64

torch.set_num_threads(
    1
)  # threads that wait for each other cost more than they give on pictures this small


class _TinyBackbone(torch.nn.Module):
    channels, strides = (16, 24), (4, 8)

    def __init__(self):
        super().__init__()

        def step(inner, out):
            return torch.nn.Sequential(
                torch.nn.Conv2d(inner, out, 3, 2, 1, bias=False),
                torch.nn.BatchNorm2d(out),
                torch.nn.ReLU(),
            )

        self.stem = torch.nn.Sequential(step(3, 12), step(12, 16))
        self.deep = step(16, 24)

    def forward(self, images):
        fine = self.stem(images / 128.0 - 1)
        return [fine, self.deep(fine)]


def tiny(stem="extended-residual"):
    torch.manual_seed(5)
    backbone = _TinyBackbone()
    neck = FeaturePyramid(backbone.channels, 16)
    anchors = (AnchorSettings((8, 14)), AnchorSettings((22, 32)))
    proposals = ProposalNetwork(neck.channels, backbone.strides, anchors, stem, 16, light=True)
    return FasterRCNN(
        backbone, neck, proposals, TwoLayerHead(16, 32, 2), Reach(before=200, regions=60)
    )


def fours(samples):
    """The samples in batches of four."""
    return (samples[index : index + 4] for index in range(0, len(samples), 4))


def squares(count, seed):
    """Pictures of bright squares (class 0) and dark discs (class 1) on grey noise."""
    rng = np.random.default_rng(seed)
    rows, columns = np.mgrid[:_SIDE_PX, :_SIDE_PX]
    out = []
    for _ in range(count):
        image = rng.normal(110, 8, (_SIDE_PX, _SIDE_PX, 3)).clip(0, 255).astype(np.uint8)
        boxes, labels = [], []
        for corner in rng.permutation([(1, 2), (34, 1), (2, 33), (34, 34)])[: rng.integers(1, 4)]:
            x, y = corner + rng.integers(0, 8, 2)
            side, label = int(rng.integers(10, 22)), int(rng.integers(2))
            if label == 0:
                image[y : y + side, x : x + side] = 230
            else:
                image[
                    (rows - y - side / 2 + 0.5) ** 2 + (columns - x - side / 2 + 0.5) ** 2
                    < side**2 / 4
                ] = 15
            boxes.append((x, y, x + side, y + side))
            labels.append(label)
        known = np.ones(2, bool)
        out.append(
            TrainingSample(image, np.array(boxes, float), np.array(labels), np.zeros((0, 4)), known)
        )
    return out


def _found_share(model, pictures):
    """Of the true boxes, those with a detection of their class, score over 0.5 and overlap over 0.5."""
    right = total = 0
    for each in pictures:
        with torch.no_grad():
            boxes, scores, labels = model.eval()(
                torch.from_numpy(each.image.transpose(2, 0, 1))[None]
            )
        overlap = iou_matrix(torch.from_numpy(each.boxes).float(), boxes).numpy()
        for row, label in enumerate(each.labels):
            total += 1
            right += bool(
                ((overlap[row] > 0.5) & (labels.numpy() == label) & (scores.numpy() > 0.5)).any()
            )
    return right / total


def trained_for(steps):
    training = JointTraining(
        tiny(), JointSettings(steps=steps, batch=4, rate=3e-3, averaging=0.9, warm_steps=10), 1
    )
    return training, [training.learn(each).loss for each in fours(squares(steps * 4, 1))]


@pytest.fixture(scope="module")
def trained():
    """A network that has learnt a little: it finds some squares."""
    return trained_for(60)


@pytest.mark.long
def test_a_small_network_learns_what_it_has_not_seen():
    training, losses = trained_for(200)
    assert np.mean(losses[-10:]) < 0.5 * np.mean(losses[:10])
    unseen = squares(40, 2)
    assert _found_share(training.average, unseen) > 0.7
    assert _found_share(tiny(), unseen) < 0.1


def test_the_exported_graph_gives_what_torch_gives(trained):
    model = trained[0].average
    exported = export_onnx(model, {"classes": ["square", "disc"], "name": "tiny"})
    rng = np.random.default_rng(3)
    wide = rng.integers(0, 255, (64, 160, 3), dtype=np.uint8)
    check = check_export(model, exported, [*(each.image for each in squares(6, 4)), wide])
    assert check.is_good, check
    assert check.detections > 6


def test_an_order_of_equal_scores_is_no_difference_of_the_export():
    model = fast(["square", "disc"]).eval()
    for (
        layer
    ) in model.proposals.scores:  # all anchors are as likely: which are looked at is anyone's guess
        torch.nn.init.zeros_(layer.weight)
    pictures = [np.random.default_rng(3).integers(0, 255, (128, 160, 3), dtype=np.uint8)]
    check = check_export(model, export_onnx(model, {"classes": ["square", "disc"]}), pictures)
    assert check.is_good and check.undecided > 200, check


def test_another_network_s_file_is_no_export_of_this_one(trained):
    model = deepcopy(trained[0].average)
    exported = export_onnx(model, {"classes": ["square", "disc"]})
    with torch.no_grad():
        model.head.offsets.bias += 0.05
    check = check_export(model, exported, [each.image for each in squares(4, 4)])
    assert not check.is_good and check.box_px > 0.5, check


def test_training_goes_on_from_its_state_as_if_it_had_not_stopped():
    pictures = squares(8 * 4, 7)
    whole = JointTraining(tiny(), JointSettings(steps=8, batch=4), 3)
    wanted = [whole.learn(each).loss for each in islice(fours(pictures), 8)]
    first = JointTraining(tiny(), JointSettings(steps=8, batch=4), 3)
    stream = fours(pictures)
    for _ in range(5):
        first.learn(next(stream))
    second = JointTraining(tiny("extended-residual"), JointSettings(steps=8, batch=4), 99)
    second.load_state(first.state())
    again = [second.learn(next(stream)).loss for _ in range(3)]
    assert again == pytest.approx(wanted[5:], rel=1e-4)


@pytest.mark.parametrize("stem", ["standard", "extended", "extended-residual"])
def test_every_proposal_network_runs_and_learns_from_all_its_parts(stem):
    model = tiny(stem)
    training = JointTraining(model, JointSettings(steps=3, batch=2), 1)
    training.learn(squares(2, 1))
    missing = [name for name, weight in model.named_parameters() if weight.grad is None]
    assert not missing


def test_the_thesis_stack_has_the_tables_layers():
    stack = ExtendedStack(1024)
    filters = (
        [[each for each in (64, 96, 64)]] * 2
        + [[64, 96, 64, 224]]
        + [[192] * 3] * 4
        + [[320] + [384] * 4] * 2
    )
    assert [layer.channels for layer in stack.layers] == [sum(each) for each in filters]
    features = torch.zeros(1, 1024, 5, 7)
    assert stack.eval()(features).shape == (1, 1856, 5, 7)
    millions = sum(each.numel() for each in stack.parameters()) / 1e6
    assert 10 < millions < 20


def test_a_residual_stack_adds_nothing_at_first():
    features = torch.randn(1, 32, 9, 9)
    stack = ResidualStack(32).eval()
    assert torch.allclose(stack(features), stack.standard(features), atol=1e-6)


def test_every_stem_shows_how_wide_it_is():
    for kind in ("standard", "extended", "extended-residual"):
        for light in (True, False)[: 1 if kind == "extended-residual" else 2]:
            stem = proposal_stem(kind, 16, 16, light=light).eval()
            assert stem(torch.zeros(1, 16, 6, 6)).shape[1] == stem.channels


def test_imagenet_weights_fold_to_the_same_function():
    """A block with batch norm, computed by hand, against the folded one."""
    net = EfficientNetLite0().eval()
    generator = torch.Generator().manual_seed(2)
    weights = {}
    for name, value in net.state_dict().items():
        layer, kind = name.rsplit(".", 1)
        if kind == "weight":
            weights[name] = torch.randn(value.shape, generator=generator) * 0.1
        norm = {
            "_conv_stem": "_bn0",
            "_expand_conv": "_bn0",
            "_depthwise_conv": "_bn1",
            "_project_conv": "_bn2",
        }
        base = ".".join([*layer.split(".")[:-1], norm[layer.split(".")[-1]]])
        for part, low in (
            ("weight", 0.5),
            ("bias", -0.5),
            ("running_mean", -0.5),
            ("running_var", 0.5),
        ):
            weights.setdefault(
                f"{base}.{part}", low + torch.rand(value.shape[0], generator=generator)
            )
    net.load_imagenet(weights)
    image = torch.rand(1, 3, 32, 32, generator=generator) * 255
    padded = torch.nn.functional.pad((image - 127) / 128, (0, 1, 0, 1))
    raw = torch.nn.functional.conv2d(padded, weights["_conv_stem.weight"], stride=2)
    bn = [weights[f"_bn0.{part}"] for part in ("running_mean", "running_var", "weight", "bias")]
    wanted = torch.nn.functional.batch_norm(raw, *bn, eps=1e-3)
    assert torch.allclose(net._conv_stem((image - 127) / 128), wanted, atol=1e-4)
    assert [each.shape[1:] for each in net(image)] == [(24, 8, 8), (40, 4, 4), (112, 2, 2)]
    with pytest.raises(KeyError):
        net.load_imagenet({})


_BOX = st.tuples(st.floats(0, 80), st.floats(0, 80), st.floats(1, 60), st.floats(1, 60)).map(
    lambda b: (b[0], b[1], b[0] + b[2], b[1] + b[3])
)


@settings(max_examples=50, deadline=None)
@given(st.lists(_BOX, min_size=1, max_size=6), st.lists(_BOX, min_size=1, max_size=6))
def test_offsets_lead_back_to_their_boxes(boxes, anchors):
    count = min(len(boxes), len(anchors))
    b, a = (torch.tensor(each[:count], dtype=torch.float64) for each in (boxes, anchors))
    assert torch.allclose(boxes_from_offsets(offsets_from_boxes(b, a), a), b, atol=1e-6)


@settings(max_examples=50, deadline=None)
@given(st.lists(_BOX, min_size=2, max_size=12), st.integers(0, 100))
def test_suppression_keeps_no_two_that_overlap_and_loses_none_that_stands_alone(boxes, seed):
    b = torch.tensor(boxes)
    scores = torch.rand(1, len(boxes), generator=torch.Generator().manual_seed(seed))
    kept = suppress(b, scores, 100, 0.5, 0.0)[:, 1]
    overlap = iou_matrix(b, b)
    among = overlap[kept][:, kept] - torch.eye(len(kept))
    assert (among <= 0.5 + 1e-6).all()
    for index in set(range(len(boxes))) - set(kept.tolist()):
        better = [int(k) for k in kept if scores[0, k] >= scores[0, index]]
        assert (overlap[index][better] > 0.5 - 1e-6).any()


def test_regions_are_cut_as_onnx_cuts_them():
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
    ours = roi_align(features, boxes, torch.zeros(4, dtype=torch.int64), 4, 7).numpy()
    assert np.abs(session.run(None, feed)[0] - ours).max() < 1e-4


def test_a_region_is_looked_at_on_the_level_of_its_size():
    levels = [torch.full((1, 1, 32 // s, 32 // s), float(s)) for s in (1, 2, 4)]
    boxes = torch.tensor([[0.0, 0, 8, 8], [0, 0, 60, 60], [0, 0, 200, 200]])
    seen = pooled_levels(levels, (4, 8, 16), boxes, torch.zeros(3, dtype=torch.int64), 2)
    assert [float(each.mean()) for each in seen] == [1.0, 2.0, 4.0]


def _answer(boxes, labels, ignored=(), known=(True, True)):
    return Answer(
        torch.tensor(boxes, dtype=torch.float32).reshape(-1, 4),
        torch.tensor(labels, dtype=torch.int64),
        torch.tensor(ignored, dtype=torch.float32).reshape(-1, 4),
        torch.tensor(known),
    )


def test_ignored_regions_teach_nothing_and_true_boxes_always_have_an_anchor():
    anchors = torch.tensor([[0.0, 0, 10, 10], [40, 40, 50, 50], [80, 80, 90, 90]])
    match = match_boxes(
        anchors,
        _answer([[0, 0, 24, 24]], [0], [[78, 78, 95, 95]]),
        over=0.5,
        under=0.4,
        best_too=True,
    )
    assert match.target.tolist() == [0, -1, -2]
    strict = match_boxes(
        anchors, _answer([[0, 0, 24, 24]], [0]), over=0.5, under=0.4, best_too=False
    )
    assert strict.target.tolist() == [-1, -1, -1]


@pytest.mark.parametrize(("wide_px", "is_positive"), [(15, True), (13, False)])
def test_the_thesis_learns_only_from_anchors_that_overlap_by_more_than_0_7(wide_px, is_positive):
    anchors = torch.tensor([[0.0, 0, 20, 20], [60, 60, 80, 80]])
    proposed = Proposed(torch.zeros(1, 2), torch.ones(1, 2, 4), anchors)
    _, box = proposal_loss(
        proposed, [_answer([[0, 0, wide_px, 20]], [0])], torch.Generator().manual_seed(1)
    )
    assert (float(box) > 0) is is_positive


def test_a_class_without_labels_is_not_unlearnt():
    scores = torch.tensor([[0.0, 3.0, 0.0]], requires_grad=True)
    offsets, regions = torch.zeros(1, 4), torch.tensor([[0.0, 0, 9, 9]])
    for known, learns in (((True, True), True), ((True, False), False)):
        answer = _answer([], [], known=known)
        match = match_boxes(regions, answer, over=0.5, under=0.5, best_too=False)
        loss, _ = region_loss(scores, offsets, regions, match, answer, overlap=True)
        (gradient,) = torch.autograd.grad(loss, scores)
        assert (abs(float(gradient[0, 1])) > 0.1) == learns


def test_losses_of_a_batch_without_objects_are_finite():
    model = tiny()
    proposed = model.proposals(model.features(torch.zeros(1, 3, 64, 64)))
    score, box = joint_proposal_loss(proposed, [_answer([], [])])
    assert torch.isfinite(score) and float(box.detach()) == 0.0


def test_crops_carry_their_boxes_along():
    """A bright square on black is where its box lies, however the crop lies."""
    image = np.zeros((300, 400, 3), np.uint8)
    image[100:130, 200:250] = 255
    picture = LabelledPicture(
        "p", 400, 300, "g", np.array([[200, 100, 250, 130]]), np.array([0]), np.zeros((0, 4))
    )
    share = Share(LabelledSet("s", ("car",), (picture,)), 1.0)
    calm = Augmentation(side_px=160, turns=False, blur=0, haze=0, grey=0, noise=0)
    rng = np.random.default_rng(8)
    seen = 0
    for _ in range(20):
        made = cut_sample(image, picture, share, ("person", "car"), calm, rng)
        for box, label in zip(made.boxes, made.labels):
            assert label == 1
            gray = made.image.mean(2)
            rows, columns = np.nonzero(gray > (gray.min() + gray.max()) / 2)
            bright = (columns.min(), rows.min(), columns.max() + 1, rows.max() + 1)
            assert np.abs(np.array(bright) - box).max() < 2.0
            seen += 1
    assert seen > 8
