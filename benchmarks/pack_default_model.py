"""A model file from trained weights: benchmarks/pack_default_model.py WEIGHTS DATA (`make model`, `make long-model`).

WEIGHTS is what train_default_model.py left; run.json beside it states the preset. `fast` becomes the model `default`,
in the package unless --out names another folder, `accurate` becomes accurate.onnx, beside its weights.

Reporting thresholds come from validation pictures, which neither train nor measure: blocks of HIT-UAV, videos of
TinyPerson, simulated pictures of a seed of their own. The graph is checked against torch. With --measured FILE, the
figures of detector_accuracy.py go into the card.
"""

import argparse
import hashlib
import json
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import torch

from detection_data import hituav, in_order, tinyperson
from sorvolo.detection.detector import Detector
from sorvolo.lab.datasets import read_dataset
from sorvolo.lab.evaluation.detection_metrics import (
    ClassMatch,
    counts_at,
    judged_classes,
    match_pictures,
)
from sorvolo.lab.simulate.pictures import simulate_pictures
from sorvolo.lab.simulation.pictures import PictureSettings
from sorvolo.lab.training.onnx_export import check_export, export_onnx
from sorvolo.lab.training.weights import SOURCES
from sorvolo.survey.labels import LabelledSet
from sorvolo.survey.objects import CLASSES
from train_default_model import RUN, network_of, reader
from training_shares import SIMULATED_PICTURES, SIMULATED_SEED

HOME = Path(__file__).parents[1] / "src" / "sorvolo" / "detection" / "data"
VALIDATION_SEED, VALIDATION_PICTURES = 2, 60
BEST_PX = {
    "person": [12, 130],
    "car": [14, 110],
    "small object": [10, 130],
}  # what training shows it, and finds well
LABELLED = (
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
    ("aerial cars, flights", "CC BY-SA", "Yauhen Kharuzhy and the Minsk OpenStreetMap community"),
    (
        f"simulated pictures, seed {SIMULATED_SEED}, {SIMULATED_PICTURES} of them",
        "Apache-2.0",
        "sorvolo simulate",
    ),
    (
        "ground of two flights of photos, with composed small objects",
        "BSD-2-Clause, CC0",
        "brighton_beach, caliterra",
    ),
)
TRAINED_ON = (
    *LABELLED,
    ("ImageNet weights of EfficientNet-Lite0", "Apache-2.0", "Tan and Le 2019"),
)
TRAINING = (
    "6,500 steps of four crops of 384 px from ImageNet, the layers up to stride 8 frozen; 5,600 steps from there; then "
    "7,000 with those layers learning too, from the 1,750th on without turning pictures from aslant; then 12,000 with "
    "thermal frames shown larger, from the 2,550th on with simulated people drawn limb by limb"
)
NOT_LEARNT = (
    "small objects were never seen in real labelled pictures, only composed and simulated",
    "daylight people come from beaches, one pond and simulation: other clothing, poses and ground are not known",
    "trucks and buses count as nothing in particular; bicycles and their riders likewise",
)
FAILS = (
    "people below 10 px: most are missed; crowds more so",
    *NOT_LEARNT,
    "windows and hatches on roofs are reported as small objects, cones and birds as people",
    "false-colour thermal palettes look like daylight to it",
    "thermal frames are seen by the model `thermal` (thermal_by): the figures of hituav and pictures_thermal are its",
)


@dataclass(frozen=True)
class Recipe:
    """A model's statements: `info` is what distinguishes its metadata, `sets` those of its card's figures, or all.

    `validation` makes the pictures by which thresholds are chosen, from the data's folder and one to write to.
    """

    info: Mapping[str, Any]
    trained_on: Sequence[tuple[str, str, str]]  # what, licence, source
    training: str
    fails: Sequence[str]
    validation: Callable[[Path, Path], list[LabelledSet]]
    sets: Sequence[str] | None = None
    remark: str = ""


def main() -> None:
    """Choose thresholds, export, check, write the model and its card."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("weights", type=Path)
    parser.add_argument("data", type=Path)
    parser.add_argument(
        "--steps", type=int, help="that the weights were trained for; else run.json's"
    )
    parser.add_argument("--measured", type=Path, help="detector_accuracy.json")
    parser.add_argument("--out", type=Path, help="folder for the model and its card")
    wishes = parser.parse_args()
    stated = wishes.weights.parent / RUN
    run = (
        json.loads(stated.read_text())
        if stated.is_file()
        else {"preset": "fast", "step": wishes.steps}
    )
    if wishes.steps is None and run["step"] is None:
        parser.error(f"there is no {stated}; give --steps")
    wishes.steps = wishes.steps or run["step"]
    is_default = run["preset"] == "fast"
    wishes.out = wishes.out or (HOME if is_default else wishes.weights.parent)
    pack(default_recipe(run) if is_default else accurate_recipe(run), run, wishes)


def default_recipe(run: Mapping[str, Any]) -> Recipe:
    """The aerial network of `default`; the packaged one, where there is no run.json."""
    info = {"name": "default", "version": "3", "thermal": True, "thermal_by": "thermal"}
    return Recipe(
        info, TRAINED_ON, described(run) if "steps" in run else TRAINING, FAILS, validation
    )


def accurate_recipe(run: Mapping[str, Any]) -> Recipe:
    """The network for GPUs. How well it finds anything, and what it reports wrongly, is not known before it is run."""
    source, known = SOURCES["resnet50"], SOURCES["resnet50"].name in run["begun"]
    weights = (
        "ImageNet weights of ResNet-50",
        source.licence if known else "as their source states",
        run["begun"],
    )
    info = {"name": "accurate", "version": "1", "thermal": True}
    return Recipe(info, (*LABELLED, weights), described(run), NOT_LEARNT, validation)


def described(run: Mapping[str, Any]) -> str:
    """How long it learnt, from what."""
    return (
        f"{run['step']} of {run['steps']} steps of {run['batch']} crops of {run['side_px']} px, preset "
        f"{run['preset']}, from {run['begun']}"
    )


def pack(recipe: Recipe, run: Mapping[str, Any], wishes: argparse.Namespace) -> None:
    """Do as the command line asks."""
    model = network_of(run)
    model.load_state_dict(torch.load(wishes.weights, weights_only=True))
    info: dict[str, Any] = {
        **recipe.info,
        "preset": run["preset"],
        "classes": list(CLASSES),
        "thresholds": dict.fromkeys(CLASSES, 0.5),
        "best_px": BEST_PX,
        "licence": "CC-BY-SA-4.0",
        "trained_on": "; ".join(f"{name} ({licence})" for name, licence, _ in recipe.trained_on),
        "created": f"{datetime.now(UTC):%Y-%m-%d}",
    }
    name = info["name"]
    with tempfile.TemporaryDirectory() as folder:
        trial = Path(folder) / "trial.onnx"
        trial.write_bytes(export_onnx(model, info | {"thermal_by": ""}))  # its own scores
        sets = recipe.validation(wishes.data, Path(folder))
        info["thresholds"] = best_thresholds(Detector.load(trial), sets)
        print(info["thresholds"], flush=True)
        read = reader()
        pictures = [read(each.path) for labelled in sets for each in labelled.pictures[::20]]
        exported = export_onnx(model, info)
        check = check_export(model, exported, pictures)
    print(check, flush=True)
    if not check.is_good:
        raise SystemExit("the exported graph differs from torch")
    wishes.out.mkdir(parents=True, exist_ok=True)
    (wishes.out / f"{name}.onnx").write_bytes(exported)
    figures = {} if wishes.measured is None else measured(json.loads(wishes.measured.read_text()))
    card = {
        **info,
        "sha256": hashlib.sha256(exported).hexdigest(),
        "bytes": len(exported),
        "steps": wishes.steps,
        "training": recipe.training,
        "trained_on": [{"what": w, "licence": s, "source": f} for w, s, f in recipe.trained_on],
        "export": {"box_px": check.box_px, "score": check.score, "detections": check.detections},
        "fails": recipe.fails,
        **({"remark": recipe.remark} if recipe.remark else {}),
        "measured": {
            each: figures[each] for each in figures if recipe.sets is None or each in recipe.sets
        }
        or None,
    }
    (wishes.out / f"{name}.json").write_text(json.dumps(card, indent=1) + "\n")


def validation(data: Path, folder: Path) -> list[LabelledSet]:
    """The pictures by which thresholds are chosen."""
    settings = PictureSettings(
        pictures=VALIDATION_PICTURES, seed=VALIDATION_SEED, thermal_share=0.15
    )
    for _ in simulate_pictures(folder / "simulated", settings):
        pass
    return [
        hituav(data)["val"],
        tinyperson(data)["val"],
        in_order(read_dataset(folder / "simulated")),
    ]


def best_thresholds(detector: Detector, sets: list[LabelledSet]) -> dict[str, float]:
    """Of each class the score at which F1, as a mean over the sets that have it, is highest."""
    read = reader()
    matches: list[ClassMatch] = []
    for labelled in sets:
        found = [
            detector.detect(read(each.path), tiles="auto", m_per_px=each.m_per_px, least_score=0.02)
            for each in labelled.pictures
        ]
        matches += match_pictures(labelled, found, judged_classes(labelled, CLASSES))[0]
    grid = np.arange(0.1, 0.91, 0.02)
    out = {}
    for name in CLASSES:
        own = [each for each in matches if each.label == name and len(each.true_pictures)]
        means = [np.mean([_f1(each, float(score)) for each in own]) for score in grid]
        out[name] = round(float(grid[int(np.argmax(means))]), 2)
    return out


def _f1(match: ClassMatch, score: float) -> float:
    right, false, missed = counts_at(match, score)
    return 2 * right / max(1, 2 * right + false + missed)


def measured(document: dict[str, Any]) -> dict[str, Any]:
    """The card's share of the accuracy benchmark: AP50 and AP with their intervals, set by set."""
    return {
        name: {
            label: {key: row[key] for key in ("labels", "AP50", "AP")}
            for label, row in each["classes"].items()
        }
        for name, each in document["sets"].items()
    }


if __name__ == "__main__":
    main()
