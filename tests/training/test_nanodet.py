"""NanoDet: its TensorFlow.js graph read and run in NumPy, its weights in torch, its boxes, its ONNX file."""

import base64
import json
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from torch.nn import functional

from sorvolo.detection.session import Session
from sorvolo.errors import InputError
from sorvolo.lab.training.nanodet import (
    BINS,
    CocoDetector,
    FinerNanoDetHead,
    NanoDetBackbone,
    NanoDetHead,
    boxes_from_bins,
    cells,
    head_of_class,
    nanodet_from_graph,
)
from sorvolo.lab.training.onnx_export import onnx_from_module
from sorvolo.lab.training.tfjs_graph import read_graph, run_graph


def _text(value: str) -> dict[str, str]:
    return {"s": base64.b64encode(value.encode()).decode()}


def _write(
    folder: Path, nodes: list[dict], values: dict[str, np.ndarray], **changes: object
) -> Path:
    """A graph model on disk, its float weights in half precision."""
    entries, data = [], b""
    for name, value in values.items():
        entry = {"name": name, "shape": list(value.shape), "dtype": "int32"}
        if value.dtype.kind == "f":
            entry |= {
                "dtype": "float32",
                "quantization": {"dtype": "float16", "original_dtype": "float32"},
            }
        entries.append(entry)
        data += value.astype("<f2" if value.dtype.kind == "f" else "<i4").tobytes()
        nodes = [*nodes, {"name": name, "op": "Const"}]
    (folder / "net.bin").write_bytes(data)
    document = {
        "modelTopology": {"node": nodes},
        "signature": {"outputs": {"out:0": {}}},
        "weightsManifest": [{"paths": ["net.bin"], "weights": entries} | changes],
    }
    (folder / "net.json").write_text(json.dumps(document))
    return folder / "net.json"


def _small_graph(folder: Path, rng: np.random.Generator) -> tuple[Path, dict[str, np.ndarray]]:
    """A padded convolution of stride 2, its bias, leaky, pooled, halved by a resize, cut in two: what NanoDet has."""
    values = {
        "pads": np.array([[0, 0], [0, 0], [1, 1], [1, 1]]),
        "nhwc": np.array([0, 2, 3, 1]),
        "nchw": np.array([0, 3, 1, 2]),
        "kernel": rng.normal(size=(3, 3, 3, 6)).astype(np.float32),
        "bias": rng.normal(size=6).astype(np.float32),
        "size": np.array([3, 4]),
        "parts": np.array([2, 4]),
        "axis": np.array(1),
    }
    window = {"padding": _text("VALID"), "data_format": _text("NHWC")}
    nodes = [
        {"name": "x", "op": "Placeholder"},
        {"name": "padded", "op": "Pad", "input": ["x", "pads"]},
        {"name": "rows", "op": "Transpose", "input": ["padded", "nhwc"]},
        {
            "name": "conv",
            "op": "Conv2D",
            "input": ["rows", "kernel"],
            "attr": window | {"strides": {"list": {"i": ["1", "2", "2", "1"]}}},
        },
        {"name": "added", "op": "Add", "input": ["conv", "bias"]},
        {"name": "active", "op": "LeakyRelu", "input": ["added"], "attr": {"alpha": {"f": 0.1}}},
        {
            "name": "pooled",
            "op": "MaxPool",
            "input": ["active"],
            "attr": window
            | {
                "strides": {"list": {"i": ["1", "1", "1", "1"]}},
                "ksize": {"list": {"i": ["1", "3", "3", "1"]}},
            },
        },
        {
            "name": "half",
            "op": "ResizeBilinear",
            "input": ["pooled", "size"],
            "attr": {"half_pixel_centers": {"b": True}, "align_corners": {"b": False}},
        },
        {"name": "channels", "op": "Transpose", "input": ["half", "nchw"]},
        {"name": "split", "op": "SplitV", "input": ["channels", "parts", "axis"]},
        {"name": "out", "op": "Sigmoid", "input": ["split:1"]},
    ]
    return _write(folder, nodes, values), values


def test_a_graph_run_in_numpy_is_what_torch_computes(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    path, values = _small_graph(tmp_path, rng)
    x = rng.normal(size=(1, 3, 16, 20)).astype(np.float32)
    found = run_graph(read_graph(path), {"x": x}, ["out"])["out"]
    kernel = torch.from_numpy(values["kernel"].astype(np.float16).astype(np.float32)).permute(
        3, 2, 0, 1
    )
    bias = torch.from_numpy(values["bias"].astype(np.float16).astype(np.float32))
    y = functional.leaky_relu(functional.conv2d(torch.from_numpy(x), kernel, bias, 2, 1), 0.1)
    y = functional.max_pool2d(y, 3, 1)
    y = functional.interpolate(y, (3, 4), mode="bilinear", align_corners=False)
    np.testing.assert_allclose(found, y[:, 2:].sigmoid().numpy(), atol=2e-6)


def test_a_graph_whose_weights_are_cut_or_lie_elsewhere_is_refused(tmp_path: Path) -> None:
    path, values = _small_graph(tmp_path, np.random.default_rng(3))
    (tmp_path / "net.bin").write_bytes((tmp_path / "net.bin").read_bytes() + b"ab")
    with pytest.raises(InputError, match="its manifest describes"):
        read_graph(path)
    with pytest.raises(InputError, match="another folder"):
        read_graph(_write(tmp_path, [], values, paths=["../net.bin"]))
    with pytest.raises(InputError, match="no graph model at"):
        read_graph(tmp_path / "none.json")


def test_a_graph_with_an_unknown_operation_is_refused_when_run(tmp_path: Path) -> None:
    path = _write(tmp_path, [{"name": "out", "op": "Rot13", "input": []}], {})
    with pytest.raises(InputError, match="Rot13"):
        run_graph(read_graph(path), {}, ["out"])


def test_weights_of_a_graph_reach_their_layers_and_the_first_takes_rgb(tmp_path: Path) -> None:
    backbone, head = NanoDetBackbone(), NanoDetHead()
    layers = [each for each in backbone.modules() if isinstance(each, torch.nn.Conv2d)] + list(
        head.sideways
    )
    layers += [layer for pair in zip(head.towers, head.outputs) for layer in pair]
    nodes, values = [], {}
    for index, layer in enumerate(layers):
        name = "PartitionedCall/convolution" + (f"_{index}" if index else "")
        shape = tuple(layer.weight.shape[axis] for axis in (2, 3, 1, 0))
        values[f"w{index}"] = np.full(shape, index, np.float32)
        values[f"b{index}"] = np.full(shape[3], -index, np.float32)
        nodes += [
            {"name": name, "op": "Conv2D", "input": ["x", f"w{index}"]},
            {
                "name": f"PartitionedCall/Add_{100 - index}",
                "op": "Add",
                "input": [name, f"b{index}"],
            },
        ]
    values["w0"][:, :, 0] = 7  # blue
    graph = read_graph(_write(tmp_path, nodes, values))
    backbone, head = nanodet_from_graph(graph)
    assert len(layers) == 34
    assert backbone.stem.weight[:, 2].unique().tolist() == [7] and backbone.stem.weight[
        :, :2
    ].unique().tolist() == [0]
    assert head.outputs[2].weight.unique().tolist() == [33] and head.outputs[
        2
    ].bias.unique().tolist() == [-33]
    assert head.sideways[0].bias.unique().tolist() == [-25]
    with pytest.raises(InputError, match="no NanoDet-g"):
        nanodet_from_graph(
            read_graph(
                _write(tmp_path, nodes[2:], {k: v for k, v in values.items() if k[1:] != "0"})
            )
        )


def test_a_head_of_one_class_sees_what_the_whole_head_sees_until_it_learns() -> None:
    torch.manual_seed(5)
    whole = NanoDetHead(6)
    own = head_of_class(whole, 3)
    levels = [
        torch.randn(1, width, 64 // stride, 96 // stride)
        for width, stride in zip((128, 256, 512), (8, 16, 32))
    ]
    with torch.no_grad():
        for one, all_classes in zip(own(levels), whole(levels)):
            np.testing.assert_allclose(one[:, 0], all_classes[:, 3], atol=1e-6)
            np.testing.assert_allclose(one[:, 1:], all_classes[:, 6:], atol=1e-6)
        own.more[0].bias.fill_(1.0)
        assert not np.allclose(own(levels)[0][:, 0], whole(levels)[0][:, 3], atol=1e-3)
    assert [len(each.bias) for each in own.outputs] == [1 + 4 * BINS] * 3


def test_a_finer_head_gives_a_level_more_and_the_others_as_before() -> None:
    torch.manual_seed(6)
    finer = FinerNanoDetHead(3)
    strides_and_widths = zip(NanoDetBackbone.strides, NanoDetBackbone.channels)
    levels = [
        torch.randn(1, width, 64 // stride, 96 // stride) for stride, width in strides_and_widths
    ]
    with torch.no_grad():
        fine, *others = finer(levels)
        assert fine.shape == (1, 3 + 4 * BINS, 16, 24)
        for one, known in zip(others, finer.coarse(levels)):
            np.testing.assert_array_equal(one, known)
        before = fine.clone()
        levels[0][:, :, 0, 0] += 5.0  # what only the finest features show
        after, *still = finer(levels)
    assert not np.allclose(after[..., 0, 0], before[..., 0, 0], atol=1e-3)
    np.testing.assert_array_equal(after[..., 8:, 8:], before[..., 8:, 8:])
    for one, known in zip(still, others):
        np.testing.assert_array_equal(one, known)
    assert finer.strides == (4, 8, 16, 32) == NanoDetBackbone.strides


def test_bins_and_cells_are_boxes_around_the_cells_centre() -> None:
    output = torch.zeros(1, 1 + 4 * BINS, 2, 3)
    for side, strides_away in enumerate((1, 2, 3, 4)):
        output[0, 1 + side * BINS + strides_away] = 50  # sure that the side lies so far away
    scores, bins, places = cells([output], [8], 1)
    boxes = boxes_from_bins(bins[0], places)
    assert scores.shape == (1, 6, 1)
    assert places[4].tolist() == [12, 12, 8]
    np.testing.assert_allclose(boxes[4], [12 - 8, 12 - 16, 12 + 24, 12 + 32], atol=1e-4)


@pytest.mark.parametrize("finer", [False, True])
def test_the_onnx_file_gives_what_torch_gives_at_any_size(tmp_path: Path, finer: bool) -> None:
    torch.manual_seed(4)
    head = FinerNanoDetHead(6) if finer else NanoDetHead(6)
    for layer in (
        [*head.coarse.outputs, head.fine_output]
        if isinstance(head, FinerNanoDetHead)
        else head.outputs
    ):
        torch.nn.init.normal_(layer.weight, std=0.3)
    model = CocoDetector(NanoDetBackbone(), head, ((0,), (2, 5))).eval()
    info = {
        "name": "toy",
        "classes": ["person", "car"],
        "thresholds": {"person": 0.5, "car": 0.5},
        "stride": 32,
        "best_px": {"person": [12, 130], "car": [14, 220]},
    }
    path = tmp_path / "toy.onnx"
    path.write_bytes(onnx_from_module(model, info))
    session = Session(path, "cpu", 1)
    for height, width in ((64, 96), (160, 128)):
        picture = np.random.default_rng(height).integers(0, 256, (height, width, 3), dtype=np.uint8)
        seen = session.see(picture)
        with torch.no_grad():
            boxes, scores, labels = model(torch.from_numpy(picture).permute(2, 0, 1)[None])
        real = (boxes[:, 2] > boxes[:, 0]) & (boxes[:, 3] > boxes[:, 1])
        assert len(seen.scores) == int(real.sum()) > 5
        np.testing.assert_allclose(seen.scores, scores[real], atol=1e-5)
        assert set(labels.tolist()) == {0, 1}
