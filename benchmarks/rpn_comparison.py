"""Does the extended proposal network find more than the standard one? python benchmarks/rpn_comparison.py DATA LITE0

HIT-UAV's thermal frames, training and held-out blocks of ids; the `fast` preset, scaled down to what two cores can do:
the same few iterations, samples, optimiser and batch norms in every arm, three seeds each. Arms: the standard stem; the
thesis's nine modules, an eighth as wide; a plain stack of 3x3 convolutions of the nine modules' cost; our residual one.
Writes results/rpn_comparison.json with the differences and their intervals over the seeds (Student's t).
"""

import argparse
import json
import sys
import time
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy import stats
from torch import nn

from detection_data import hituav
from mosaic_methods import commit, machine
from sorvolo.lab.evaluation.detection_metrics import judged_classes, match_pictures
from sorvolo.lab.training.drawing import batches_from
from sorvolo.lab.training.faster_rcnn import FasterRCNN
from sorvolo.lab.training.feature_pyramid import convolution
from sorvolo.lab.training.joint import JointSettings, JointTraining
from sorvolo.lab.training.presets import fast
from sorvolo.lab.training.samples import Augmentation, Share
from sorvolo.lab.training.seeing import see
from sorvolo.lab.training.weights import read_weights
from sorvolo.survey.labels import LabelledSet
from sorvolo.survey.objects import CLASSES
from train_default_model import reader

ARMS = ("standard", "extended", "equal-cost", "extended-residual")


def main() -> None:
    """Train every arm with every seed, measure, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("weights", type=Path)
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--side", type=int, default=256)
    parser.add_argument("--batch", type=int, default=4)
    parser.add_argument("--seeds", type=int, nargs="+", default=[301, 302, 303])
    parser.add_argument(
        "--every", type=int, default=4, help="of the held-out pictures, one in so many"
    )
    parser.add_argument(
        "--out", type=Path, default=Path(__file__).parent / "results" / "rpn_comparison.json"
    )
    wishes = parser.parse_args()
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    parts = hituav(wishes.data)
    held_out = parts["test"].only(parts["test"].pictures[:: wishes.every])
    rows: list[dict[str, Any]] = []
    for seed in wishes.seeds:
        for arm in ARMS:
            started_s = time.process_time()
            torch.manual_seed(seed)
            model = arm_model(arm)
            model.backbone.load_imagenet(read_weights(wishes.weights).layers)
            training = JointTraining(
                model, JointSettings(steps=wishes.steps, batch=wishes.batch, averaging=0.99), seed
            )
            share = Share(parts["train"], 1.0, (0.7, 1.6), thermal=True)
            crops = Augmentation(side_px=wishes.side)
            drawn = batches_from([share], CLASSES, reader(), crops, seed=seed, batch=wishes.batch)
            for batch in islice(drawn, wishes.steps):
                training.learn(batch)
            trained_s = time.process_time() - started_s
            row = {
                "seed": seed,
                "arm": arm,
                "cpu_s": round(trained_s),
                **score(training.average, held_out),
            }
            rows.append(row)
            print(row, file=sys.stderr, flush=True)
            document = {
                "machine": machine(),
                "commit": commit(),
                "seeds": wishes.seeds,
                "steps": wishes.steps,
                "batch": wishes.batch,
                "side_px": wishes.side,
                "pictures": len(held_out),
                "stem_weights_at_stride_4": stem_weights(),
                "runs": rows,
                "differences": differences(rows),
            }
            wishes.out.write_text(json.dumps(document, indent=1) + "\n")


def arm_model(arm: str) -> FasterRCNN:
    """The `fast` preset with the arm's stems."""
    if arm != "equal-cost":
        return fast(CLASSES, arm)  # type: ignore[arg-type]
    model = fast(CLASSES, "standard")
    for index, wide in enumerate(model.neck.channels):
        model.proposals.stems[index] = nn.Sequential(
            *(convolution(wide, wide, 3) for _ in range(plain_layers()))
        )
    return model


def plain_layers() -> int:
    """How many 3x3 convolutions have as many weights as the nine modules at this width."""
    extended, _ = (
        weights_of(fast(CLASSES, each).proposals.stems[0]) for each in ("extended", "standard")
    )
    return max(1, round(extended / weights_of(convolution(64, 64, 3))))


def stem_weights() -> dict[str, int]:
    """Each arm's weights between the finest level and its proposals: what a position costs."""
    return {arm: weights_of(arm_model(arm).proposals.stems[0]) for arm in ARMS}


def weights_of(module: nn.Module) -> int:
    """Convolution weights."""
    return sum(each.numel() for each in module.parameters() if each.ndim == 4)


def score(model: FasterRCNN, labelled: LabelledSet) -> dict[str, float]:
    """AP50 and AP of people and cars."""
    read = reader()
    found = [see(model, CLASSES, read(each.path)) for each in labelled.pictures]
    _, _, numbers = match_pictures(labelled, found, judged_classes(labelled, CLASSES[:2]))
    out = {f"{name}_ap50": round(each.ap50, 4) for name, each in numbers.items()}
    out.update({f"{name}_ap": round(each.ap, 4) for name, each in numbers.items()})
    return out


def differences(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Each other arm minus standard, and extended minus its equal in cost: mean and 95 % interval over seeds."""
    out = []
    for better, base in (
        ("extended", "standard"),
        ("equal-cost", "standard"),
        ("extended-residual", "standard"),
        ("extended", "equal-cost"),
    ):
        for measure in ("person_ap50", "car_ap50"):
            pairs = [
                (a[measure], b[measure])
                for a in rows
                for b in rows
                if a["arm"] == better and b["arm"] == base and a["seed"] == b["seed"]
            ]
            if len(pairs) < 2:
                continue
            gaps = np.array([a - b for a, b in pairs])
            half = float(stats.t.ppf(0.975, len(gaps) - 1) * gaps.std(ddof=1) / np.sqrt(len(gaps)))
            mean = float(gaps.mean())
            out.append(
                {
                    "of": better,
                    "against": base,
                    "measure": measure,
                    "mean": round(mean, 4),
                    "low": round(mean - half, 4),
                    "high": round(mean + half, 4),
                    "seeds": len(gaps),
                }
            )
    return out


if __name__ == "__main__":
    main()
