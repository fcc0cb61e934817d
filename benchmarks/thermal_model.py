"""Is one model better than another on thermal frames? python benchmarks/thermal_model.py BEFORE AFTER DATA

BEFORE and AFTER are model files or names of installed models. Both are shown frames as `tiles="auto"` shows them; AP by
pycocotools, differences over the same draws of flights; seconds by the clock for a frame of 640x512, in turn. Writes
results/thermal_finer.json, of version 3 of `thermal` against 2 (thermal_together.json is that of 2 against 1,
thermal_model.json of 1 against `default`); sets that are not asked for stay as they are there.
"""

import argparse
import json
import tempfile
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import onnx

from detection_data import hituav
from detector_accuracy import held_out
from mosaic_methods import commit, machine
from sorvolo.detection.contract import METADATA_KEY
from sorvolo.detection.detector import Detector
from sorvolo.detection.models import find_model
from sorvolo.detection.session import Session
from sorvolo.lab.evaluation.detection_scores import Arm, compare_arms
from sorvolo.store.exports.plain import plain_json
from sorvolo.survey.labels import LabelledSet
from sorvolo.survey.objects import CLASSES
from train_default_model import reader

RESULTS = Path(__file__).parent / "results" / "thermal_finer.json"
THRESHOLDS = dict.fromkeys(CLASSES, 0.5)
TIMED, SHOWN_PX = 10, (768, 960)  # frames; (height, width) as which 640x512 is shown


def main() -> None:
    """Compare on validation frames, held-out frames and simulated thermal pictures; write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("before")
    parser.add_argument("after")
    parser.add_argument("data", type=Path)
    parser.add_argument(
        "--sets", nargs="*", default=["hituav val", "pictures_thermal", "hituav test"]
    )
    parser.add_argument("--threads", type=int, default=1)
    wishes = parser.parse_args()
    known = (
        json.loads(RESULTS.read_text()) if RESULTS.is_file() else {"commit": commit(), "sets": {}}
    )
    sets: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder:
        files = {}
        for name in ("before", "after"):
            files[name] = Path(folder) / f"{name}.onnx"
            files[name].write_bytes(by_itself(find_model(getattr(wishes, name)).read_bytes()))
        detectors = {
            name: Detector.load(each, threads=wishes.threads) for name, each in files.items()
        }
        measured = {
            "hituav val": lambda: hituav(wishes.data)["val"],
            "hituav test": lambda: held_out("hituav", wishes.data, Path(folder), 1),
            "pictures_thermal": lambda: held_out("pictures_thermal", wishes.data, Path(folder), 1),
        }
        for name in wishes.sets:
            labelled = measured[name]()
            if labelled is not None:
                sets[name] = compared(labelled, detectors)
                print(name, json.dumps(plain_json(sets[name])), flush=True)
        seconds = clock_s(files)
    print(seconds)
    RESULTS.write_text(
        json.dumps(
            plain_json(
                {
                    "benchmark": "thermal_model",
                    "machine": machine(),
                    "commit": commit() if sets else known["commit"],
                    "s_a_frame": seconds | {"commit": commit()},
                    "sets": known["sets"] | sets,
                }
            ),
            indent=1,
        )
        + "\n"
    )


def clock_s(files: dict[str, Path]) -> dict[str, Any]:
    """The median time by the clock, on one thread, in which each model looks at a frame."""
    sessions = {name: Session(each, "cpu", 1) for name, each in files.items()}
    picture = (
        np.random.default_rng(1).integers(0, 256, (*SHOWN_PX, 1)).astype(np.uint8).repeat(3, 2)
    )
    took: dict[str, list[float]] = {name: [] for name in files}
    for _ in range(TIMED + 1):
        for name, session in sessions.items():
            began = time.perf_counter()
            session.see(picture)
            took[name].append(time.perf_counter() - began)
    return {name: round(float(np.median(each[1:])), 3) for name, each in took.items()}


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
    of_class = [
        f"{kind} {label}"
        for label in compared.labels
        if compared.labels[label]
        for kind in ("AP50", "AP")
    ]
    return {
        "pictures": compared.pictures,
        "groups": compared.groups,
        "labels": compared.labels,
        **{arm.name: {key: arm.mean[key] for key in of_class} for arm in compared.arms},
        "difference": {key: asdict(compared.differences[0][key]) for key in of_class},
    }


if __name__ == "__main__":
    main()
