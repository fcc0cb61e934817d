"""A model in eight bits: the same objects, smaller weights, boxes and their last convolutions in float."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from toy_models import draw, onnx, rectangle_model, square_model

from sorvolo.detection.detector import Detector
from sorvolo.detection.models import find_model
from sorvolo.errors import InputError, SettingsError
from sorvolo.lab.training.quantise import pool_before_rounding, quantise


def _pictures(count: int) -> list[np.ndarray]:
    rng = np.random.default_rng(count)
    pictures = []
    for _ in range(count):
        places = [
            (x, y, x + 16, y + 16) for x in (20, 80, 140) for y in (12, 60) if rng.random() < 0.7
        ]
        picture = draw((96, 192), places)
        for left, top, right, bottom in places:
            picture[top:bottom, left:right] = rng.integers(190, 256)
        pictures.append(picture)
    return pictures


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return square_model(tmp_path_factory.mktemp("models") / "squares.onnx")


@pytest.mark.parametrize("provider", ["cpu", "openvino"])
def test_finds_the_same(model: Path, tmp_path: Path, provider: str) -> None:
    if provider == "openvino":
        pytest.importorskip("openvino")
    made = quantise(model, _pictures(12), weight_bits=7)  # as this CPU may lack VNNI
    assert (made.convolutions, made.of) == (2, 3), (
        "the last convolution gives the place and stays in float"
    )
    out = tmp_path / "int8.onnx"
    out.write_bytes(made.model)
    whole = Detector.load(model, provider="cpu", threads=1)
    small = Detector.load(out, provider=provider, threads=1)
    assert (small.info.precision, small.info.name, whole.info.precision) == (
        "int8",
        "squares",
        "float32",
    )
    for picture in _pictures(5):
        expected, found = (
            whole.detect(picture, least_score=0.1),
            small.detect(picture, least_score=0.1),
        )
        assert len(expected) == len(found) >= 2
        nearest = np.abs(found.boxes_px - expected.boxes_px[:, None]).max(axis=2).argmin(axis=1)
        assert len(set(nearest)) == len(found)
        np.testing.assert_allclose(found.boxes_px[nearest], expected.boxes_px, atol=4.01)
        np.testing.assert_allclose(found.scores[nearest], expected.scores, atol=0.05)


def test_weights_are_whole_numbers_and_what_handles_boxes_is_not(model: Path) -> None:
    made = onnx.load_model_from_string(quantise(model, _pictures(8)).model)
    kinds = {each.name: each.data_type for each in made.graph.initializer}
    whole = [
        name
        for name, kind in kinds.items()
        if kind == onnx.TensorProto.INT8 and name.endswith("_quantized")
    ]
    assert sorted(whole) == ["far_w_quantized", "near_w_quantized"]
    assert kinds["heat_w"] == onnx.TensorProto.FLOAT
    into = {node.op_type: list(node.input) for node in made.graph.node}
    assert into["NonMaxSuppression"][:2] == ["boxes_3", "scores_3"]


@pytest.mark.parametrize(("bits", "most"), [(8, 127), (7, 64)])
def test_seven_bits_of_weights_leave_room_for_two_products_in_sixteen(
    model: Path, bits: Any, most: int
) -> None:
    made = onnx.load_model_from_string(quantise(model, _pictures(8), weight_bits=bits).model)
    values = {each.name: onnx.numpy_helper.to_array(each) for each in made.graph.initializer}
    assert {
        np.abs(values[f"{name}_w_quantized"].astype(int)).max() for name in ("far", "near")
    } == {most}


def test_too_few_pictures_or_nothing_to_gain(model: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="3 pictures are too few"):
        quantise(model, _pictures(3))
    with pytest.raises(InputError, match="no convolutions that lead"):
        quantise(rectangle_model(tmp_path / "toy.onnx"), _pictures(8))
    (tmp_path / "int8.onnx").write_bytes(quantise(model, _pictures(8)).model)
    with pytest.raises(InputError, match="already"):
        quantise(tmp_path / "int8.onnx", _pictures(8))


def test_convolutions_of_the_head_before_a_fully_connected_layer_are_whole_numbers_too(
    model: Path, tmp_path: Path
) -> None:
    own = onnx.load_model(model)
    means = next(node for node in own.graph.node if node.op_type == "ReduceMean")
    place = list(own.graph.node).index(means)
    own.graph.node.remove(means)
    for node in reversed(
        [
            onnx.helper.make_node("Conv", ["regions", "seen_w"], ["seen"]),
            onnx.helper.make_node("ReduceMean", ["seen"], ["mean"], axes=[2, 3], keepdims=0),
            onnx.helper.make_node("Gemm", ["mean", "told_w"], ["rows"]),
            onnx.helper.make_node("Squeeze", ["rows", "axis1"], ["means"]),
        ]
    ):
        own.graph.node.insert(place, node)
    for name, values in (
        ("seen_w", np.eye(4)[:, :, None, None]),
        ("told_w", np.full((4, 1), 0.25)),
    ):
        own.graph.initializer.append(onnx.numpy_helper.from_array(values.astype(np.float32), name))
    onnx.save(own, tmp_path / "head.onnx")
    made = quantise(tmp_path / "head.onnx", _pictures(12), weight_bits=7)
    assert (made.convolutions, made.of) == (3, 4), (
        "only the one that gives the place stays in float"
    )
    (tmp_path / "head-int8.onnx").write_bytes(made.model)
    whole, small = (
        Detector.load(tmp_path / f"{name}.onnx", provider="cpu") for name in ("head", "head-int8")
    )
    picture = _pictures(5)[0]
    expected, found = whole.detect(picture, least_score=0.1), small.detect(picture, least_score=0.1)
    np.testing.assert_allclose(np.sort(found.scores), np.sort(expected.scores), atol=0.05)
    assert len(found) >= 2


def test_a_leaky_unit_carries_features_on(model: Path, tmp_path: Path) -> None:
    """NanoDet's convolutions are followed by such units: in eight bits as those with plain ones."""
    own = onnx.load_model(model)
    units = [node for node in own.graph.node if node.op_type == "Relu"]
    assert units
    for node in units:
        node.op_type = "LeakyRelu"
    onnx.save(own, tmp_path / "leaky.onnx")
    made = quantise(tmp_path / "leaky.onnx", _pictures(8), weight_bits=7)
    assert (made.convolutions, made.of) == (2, 3)


@pytest.mark.long
def test_parts_that_are_named_stay_in_float(model: Path) -> None:
    packaged = find_model("thermal")
    whole = quantise(packaged, _pictures(8))
    backbone = quantise(packaged, _pictures(8), float_parts=("aerial/neck", "aerial/proposals"))
    assert 20 < backbone.convolutions < whole.convolutions
    assert {weight.data_type for weight in _weights(backbone.model, "aerial/neck")} == {
        onnx.TensorProto.FLOAT
    }
    parts = "aerial/neck", "aerial/proposals", "aerial/backbone/_blocks.1"
    piece = quantise(packaged, _pictures(8), float_parts=parts)
    assert backbone.convolutions - 3 == piece.convolutions, "the three of block 1, none of block 10"
    with pytest.raises(
        SettingsError, match=r"no part tail; it has aerial/backbone, aerial/head, .*coco/head"
    ):
        quantise(packaged, _pictures(8), float_parts=("tail",))
    with pytest.raises(SettingsError, match="no part neck"):
        quantise(model, _pictures(8), float_parts=("neck",))


def test_weights_stored_in_half_are_quantised_as_others(model: Path, tmp_path: Path) -> None:
    graph = onnx.load_model(model)
    for each in list(graph.graph.initializer):
        values = onnx.numpy_helper.to_array(each)
        if values.ndim == 4:
            graph.graph.initializer.remove(each)
            half = onnx.numpy_helper.from_array(values.astype(np.float16), f"{each.name}_half")
            graph.graph.initializer.append(half)
            cast = onnx.helper.make_node(
                "Cast", [half.name], [each.name], to=onnx.TensorProto.FLOAT
            )
            graph.graph.node.insert(0, cast)
    onnx.save(graph, tmp_path / "half.onnx")
    whole, half = (quantise(path, _pictures(8)) for path in (model, tmp_path / "half.onnx"))
    assert whole.convolutions == half.convolutions > 0


def _weights(model: bytes, part: str) -> list[onnx.TensorProto]:
    """What the part's convolutions are given besides features, through a DequantizeLinear or not."""
    graph = onnx.load_model_from_string(model).graph
    values = {each.name: each for each in graph.initializer}
    makers = {node.output[0]: node for node in graph.node}
    found = []
    for node in graph.node:
        if node.op_type == "Conv" and node.name.startswith(f"/{part}/"):
            name = node.input[1]
            found.append(values[makers[name].input[0] if name in makers else name])
    return found


@pytest.mark.parametrize("is_in_float", [True, False])
def test_a_pool_behind_a_layer_in_float_comes_before_the_rounding(is_in_float: bool) -> None:
    seen = "image" if is_in_float else "seen"
    made = onnx.parser.parse_model(f"""
        <ir_version: 9, opset_import: ["" : 19]>
        squares (float[1, 1, 8, 8] image, float[2, 1, 3, 3] weight, float step, uint8 zero)
            => (float[1, 2, 3, 3] pooled) {{
            rounded = QuantizeLinear(image, step, zero)
            seen = DequantizeLinear(rounded, step, zero)
            felt = Conv({seen}, weight)
            leaky = LeakyRelu<alpha = 0.1>(felt)
            whole = QuantizeLinear(leaky, step, zero)
            back = DequantizeLinear(whole, step, zero)
            largest = MaxPool<kernel_shape = [2, 2], strides = [2, 2]>(back)
            again = QuantizeLinear(largest, step, zero)
            pooled = DequantizeLinear(again, step, zero)
        }}""")
    rng = np.random.default_rng(3)
    given = {
        "image": rng.normal(size=(1, 1, 8, 8)).astype(np.float32),
        "step": np.float32(0.05),
        "zero": np.uint8(99),
        "weight": rng.normal(size=(2, 1, 3, 3)).astype(np.float32),
    }
    before = onnx.reference.ReferenceEvaluator(made).run(None, given)[0]
    pool_before_rounding(made.graph)
    pool = next(each for each in made.graph.node if each.op_type == "MaxPool")
    assert pool.input[0] == ("leaky" if is_in_float else "back")
    assert len(made.graph.node) == (7 if is_in_float else 9)
    np.testing.assert_array_equal(
        onnx.reference.ReferenceEvaluator(made).run(None, given)[0], before
    )
