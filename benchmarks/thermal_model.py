"""Is a model for thermal frames alone better than the packaged one? python benchmarks/thermal_model.py WEIGHTS DATA

WEIGHTS are those of `train_default_model.py DATA OUT --thermal --start default --steps 2600`. Both models are run as
exported and shown frames as `tiles="auto"` shows them; AP by pycocotools, differences over the same draws of flights.
Writes results/thermal_model.json.
"""

import argparse
import json
import tempfile
from dataclasses import asdict
from pathlib import Path
from typing import Any

import onnx
import torch

from detection_data import hituav
from detector_accuracy import held_out
from mosaic_methods import commit, machine
from pack_default_model import BEST_PX
from sorvolo.detection.contract import METADATA_KEY
from sorvolo.detection.detector import Detector
from sorvolo.detection.models import find_model
from sorvolo.detection.scores import Arm, compare_arms
from sorvolo.store.exports.plain import plain_json
from sorvolo.survey.labels import LabelledSet
from sorvolo.survey.objects import CLASSES
from sorvolo.training.onnx_export import export_onnx
from sorvolo.training.presets import fast
from train_default_model import reader

RESULTS = Path(__file__).parent / "results" / "thermal_model.json"
THRESHOLDS = dict.fromkeys(CLASSES, 0.5)


def main() -> None:
    """Compare on validation frames, held-out frames and simulated thermal pictures; write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("weights", type=Path)
    parser.add_argument("data", type=Path)
    parser.add_argument("--packaged", default="default")
    parser.add_argument("--threads", type=int, default=1)
    wishes = parser.parse_args()
    model = fast(CLASSES)
    model.load_state_dict(torch.load(wishes.weights, weights_only=True))
    info = {"name": "thermal", "classes": list(CLASSES), "thermal": True, "thresholds": THRESHOLDS, "best_px": BEST_PX}
    sets: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "thermal.onnx"
        file.write_bytes(export_onnx(model, info))
        packaged = Path(folder) / "default.onnx"
        packaged.write_bytes(by_itself(find_model(wishes.packaged).read_bytes()))
        detectors = {
            name: Detector.load(each, threads=wishes.threads)
            for name, each in (("default", packaged), ("thermal", file))
        }
        measured = {
            "hituav val": hituav(wishes.data)["val"], "hituav test": held_out("hituav", wishes.data, Path(folder), 1),
            "pictures_thermal": held_out("pictures_thermal", wishes.data, Path(folder), 1),
        }
        for name, labelled in measured.items():
            if labelled is not None:
                sets[name] = compared(labelled, detectors)
                print(name, json.dumps(plain_json(sets[name])), flush=True)
    RESULTS.write_text(json.dumps(plain_json({
        "benchmark": "thermal_model", "machine": machine(), "commit": commit(), "sets": sets,
    }), indent=1) + "\n")


def by_itself(exported: bytes) -> bytes:
    """The model file without the name of another that looks at thermal frames in its place."""
    model = onnx.load_model_from_string(exported)
    for entry in model.metadata_props:
        if entry.key == METADATA_KEY:
            entry.value = json.dumps(json.loads(entry.value) | {"thermal_by": ""})
    return model.SerializeToString()


def compared(labelled: LabelledSet, detectors: dict[str, Detector]) -> dict[str, Any]:
    """AP50 and AP by class of each model, and by how much the later one's are higher."""
    read = reader()
    arms = []
    for name, detector in detectors.items():
        found = tuple(
            detector.detect(read(each.path), tiles="auto", m_per_px=each.m_per_px, least_score=0.02)
            for each in labelled.pictures
        )
        arms.append(Arm(name, CLASSES, (found,), (THRESHOLDS,)))
    compared = compare_arms(labelled, arms)
    of_class = [f"{kind} {label}" for label in compared.labels if compared.labels[label] for kind in ("AP50", "AP")]
    return {
        "pictures": compared.pictures, "groups": compared.groups, "labels": compared.labels,
        **{arm.name: {key: arm.mean[key] for key in of_class} for arm in compared.arms},
        "difference": {key: asdict(compared.differences[0][key]) for key in of_class},
    }


if __name__ == "__main__":
    main()
