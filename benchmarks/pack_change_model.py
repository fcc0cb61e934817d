"""Pack the network whose features `compare` sets side by side on restless ground, as one ONNX file with the package.

python benchmarks/pack_change_model.py [--output FILE]

It is EfficientNet-Lite0 (Tan and Le, Apache-2.0, trained on ImageNet) up to its stride of 32, taken with its weights
unchanged out of the packaged `second-opinion`. The file is checked against that model's own tensors on pictures of
several sizes; nothing is written where they differ.
"""

import argparse
from pathlib import Path

import numpy as np
import onnx
import onnxruntime

SOURCE = (
    Path(__file__).parent.parent / "src" / "sorvolo" / "detection" / "data" / "second-opinion.onnx"
)
OUTPUT = Path(__file__).parent.parent / "src" / "sorvolo" / "change" / "learned_difference.onnx"
LAYERS = {
    "finest": ("/looks/lite0/_blocks.2/Add_output_0", 24),
    "fine": ("/looks/lite0/_blocks.4/Add_output_0", 40),
    "coarse": ("/looks/lite0/_blocks.10/Add_output_0", 112),
    "coarsest": ("/looks/lite0/_blocks.15/_project_conv/Conv_output_0", 320),
}
"""The packed file's outputs, at strides of 4, 8, 16 and 32 px: their names in `second-opinion`, and their channels."""


def main() -> None:
    """Cut out, check, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--output", type=Path, default=OUTPUT)
    options = parser.parse_args()
    whole = onnx.load(SOURCE)
    made = cut_out(whole)
    difference = most_difference(whole, made)
    if difference > 0:
        raise SystemExit(
            f"the features differ from the model's by {difference:.1e}: nothing was written"
        )
    options.output.write_bytes(made.SerializeToString())
    print(
        f"{options.output}: {options.output.stat().st_size} bytes, the features are the model's own"
    )


def cut_out(whole: onnx.ModelProto) -> onnx.ModelProto:
    """The part of the model that makes the layers: RGB (1, 3, H, W) uint8, sides that 32 divides, to features."""
    nodes, wanted = [], {tensor for tensor, _ in LAYERS.values()}
    for node in reversed(whole.graph.node):
        if wanted.intersection(node.output):
            nodes.append(node)
            wanted.update(node.input)
    weights = [each for each in whole.graph.initializer if each.name in wanted]
    named = [
        onnx.helper.make_node("Identity", [tensor], [name], name=f"name_{name}")
        for name, (tensor, _) in LAYERS.items()
    ]
    outputs = [
        onnx.helper.make_tensor_value_info(
            name, onnx.TensorProto.FLOAT, [1, channels, f"rows_{name}", f"columns_{name}"]
        )
        for name, (_, channels) in LAYERS.items()
    ]
    graph = onnx.helper.make_graph(
        [*reversed(nodes), *named], "features", whole.graph.input, outputs, weights
    )
    made = onnx.helper.make_model(
        graph, opset_imports=whole.opset_import, ir_version=whole.ir_version
    )
    made.doc_string = (
        "EfficientNet-Lite0 to a stride of 32 (Tan and Le 2019, weights from ImageNet), Apache-2.0, weights as in the "
        "packaged second-opinion"
    )
    onnx.checker.check_model(made)
    return made


def most_difference(whole: onnx.ModelProto, made: onnx.ModelProto) -> float:
    """The largest difference of any feature between the model and the file, over pictures of three sizes."""
    shown = onnx.ModelProto()
    shown.CopyFrom(whole)
    tensors = [tensor for tensor, _ in LAYERS.values()]
    shown.graph.output.extend(
        onnx.helper.make_tensor_value_info(each, onnx.TensorProto.FLOAT, None) for each in tensors
    )
    theirs, ours = (
        onnxruntime.InferenceSession(each.SerializeToString(), providers=["CPUExecutionProvider"])
        for each in (shown, made)
    )
    rng, most = np.random.default_rng(1), 0.0
    for height, width in ((96, 128), (352, 640), (448, 800)):
        image = rng.integers(0, 256, (1, 3, height, width), np.uint8)
        expected = theirs.run(tensors, {"image": image})
        for one, other in zip(ours.run(list(LAYERS), {"image": image}), expected):
            most = max(most, float(np.abs(one - other).max()))
    return most


if __name__ == "__main__":
    main()
