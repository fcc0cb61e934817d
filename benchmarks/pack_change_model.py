"""Pack the network whose features `compare` sets side by side on restless ground, as one ONNX file with the package.

python benchmarks/pack_change_model.py [--output FILE]

It is the backbone of NanoDet-g (RangiLyu, Apache-2.0, trained on COCO 2017) up to its stride of 16, taken with its
weights unchanged out of the packaged detector. The file is checked against the detector's own tensors on pictures of
several sizes; nothing is written where they differ.
"""

import argparse
from pathlib import Path

import numpy as np
import onnx
import onnxruntime

SOURCE = Path(__file__).parent.parent / "src" / "sorvolo" / "detection" / "data" / "default.onnx"
OUTPUT = Path(__file__).parent.parent / "src" / "sorvolo" / "change" / "pair" / "learned_difference.onnx"
LAYERS = {
    "fine": "/backbone/stages.0/Concat_1_output_0",
    "middle": "/backbone/stages.1/Concat_2_output_0",
    "coarse": "/backbone/stages.2/Concat_2_output_0",
}
"""The packed file's outputs, at strides of 4, 8 and 16 px, by their names in the detector."""


def main() -> None:
    """Cut out, check, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=OUTPUT)
    options = parser.parse_args()
    whole = onnx.load(SOURCE)
    made = cut_out(whole)
    difference = most_difference(whole, made)
    if difference > 0:
        raise SystemExit(f"the features differ from the detector's by {difference:.1e}: nothing was written")
    options.output.write_bytes(made.SerializeToString())
    print(f"{options.output}: {options.output.stat().st_size} bytes, the features are the detector's own")


def cut_out(whole: onnx.ModelProto) -> onnx.ModelProto:
    """The part of the detector that makes the layers: RGB (1, 3, H, W) uint8, sides that 32 divides, to features."""
    nodes, wanted = [], set(LAYERS.values())
    for node in reversed(whole.graph.node):
        if wanted.intersection(node.output):
            nodes.append(node)
            wanted.update(node.input)
    weights = [each for each in whole.graph.initializer if each.name in wanted]
    channels = {"fine": 64, "middle": 128, "coarse": 256}
    named = [
        onnx.helper.make_node("Identity", [tensor], [name], name=f"name_{name}") for name, tensor in LAYERS.items()
    ]
    outputs = [
        onnx.helper.make_tensor_value_info(
            name, onnx.TensorProto.FLOAT, [1, channels[name], f"rows_{name}", f"columns_{name}"]
        ) for name in LAYERS
    ]
    graph = onnx.helper.make_graph([*reversed(nodes), *named], "features", whole.graph.input, outputs, weights)
    made = onnx.helper.make_model(graph, opset_imports=whole.opset_import, ir_version=whole.ir_version)
    made.doc_string = (
        "Backbone of NanoDet-g to a stride of 16 (RangiLyu, https://github.com/RangiLyu/nanodet, COCO 2017), "
        "Apache-2.0, weights as in the packaged detector"
    )
    onnx.checker.check_model(made)
    return made


def most_difference(whole: onnx.ModelProto, made: onnx.ModelProto) -> float:
    """The largest difference of any feature between the detector and the file, over pictures of three sizes."""
    shown = onnx.ModelProto()
    shown.CopyFrom(whole)
    shown.graph.output.extend(onnx.helper.make_tensor_value_info(each, onnx.TensorProto.FLOAT, None)
                              for each in LAYERS.values())
    theirs, ours = (
        onnxruntime.InferenceSession(each.SerializeToString(), providers=["CPUExecutionProvider"])
        for each in (shown, made)
    )
    rng, most = np.random.default_rng(1), 0.0
    for height, width in ((96, 128), (352, 640), (448, 800)):
        image = rng.integers(0, 256, (1, 3, height, width), np.uint8)
        expected = theirs.run(list(LAYERS.values()), {"image": image})
        for one, other in zip(ours.run(list(LAYERS), {"image": image}), expected):
            most = max(most, float(np.abs(one - other).max()))
    return most


if __name__ == "__main__":
    main()
