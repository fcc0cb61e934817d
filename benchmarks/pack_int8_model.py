"""The packaged model in eight bits, and what that costs: python benchmarks/pack_int8_model.py DATA (after packing).

Calibrated on pictures of the training sets, compared with the float32 model on held-out pictures; the card says by how
much each class's AP differs. Its remark states where more than half a point is lost.
"""

import argparse
import hashlib
import json
import tempfile
from datetime import UTC, datetime
from pathlib import Path

from detection_data import SMALL, aerial_cars, cats, hituav, tinyperson
from detector_accuracy import held_out
from pack_default_model import HOME
from sorvolo.detection.detector import Detector
from sorvolo.detection.quantise import quantise
from sorvolo.detection.scores import score_set
from sorvolo.missions.simulate.pictures import simulate_pictures
from sorvolo.simulation.pictures import PictureSettings
from sorvolo.store.datasets import read_dataset
from sorvolo.survey.labels import LabelledSet
from sorvolo.survey.objects import CLASSES
from thermal_model import by_itself
from train_default_model import SIMULATED_SEED, reader

MOST_LOST = 0.005  # of AP, beyond which the card says so
# 64 channels wide, and the first layers, a few channels of large values: in eight bits they lose most of what is lost
FLOAT_PARTS = ("neck", "proposals", "backbone/_conv_stem", "backbone/_blocks.0")
CALIBRATION_OF_EACH, MOST_PICTURES = 16, 150
_KEPT = ("preset", "classes", "thresholds", "licence", "trained_on", "fails")


def main() -> None:
    """Quantise, compare, write the model and its card."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("--home", type=Path, default=HOME, help="folder of default.onnx, into which the other goes")
    wishes = parser.parse_args()
    read = reader()
    whole = wishes.home / "default.onnx"
    with tempfile.TemporaryDirectory() as folder:
        for _ in simulate_pictures(Path(folder) / "made", PictureSettings(CALIBRATION_OF_EACH, SIMULATED_SEED)):
            pass
        sets = [
            hituav(wishes.data)["train"], aerial_cars(wishes.data)["train"], tinyperson(wishes.data)["train"],
            read_dataset(Path(folder) / "made"),
        ]
        calibration = [read(each.path) for labelled in sets for each in _some(labelled, CALIBRATION_OF_EACH)]
        alone = Path(folder) / "alone.onnx"  # looks at thermal frames itself, as the small one is to
        alone.write_bytes(by_itself(whole.read_bytes()))
        found = quantise(alone, calibration, float_parts=FLOAT_PARTS)
        small = Path(folder) / "small.onnx"
        small.write_bytes(found.model)
        against = {}
        for name in ("hituav", "aerial_cars", "pictures", "pictures_thermal"):
            labelled = held_out(name, wishes.data, Path(folder), 1)
            if labelled is not None:
                against[name] = compared(labelled.only(_some(labelled, MOST_PICTURES)), alone, small)
                print(name, against[name], flush=True)
        street = cats(wishes.data)["train"]
        named = LabelledSet("cats", CLASSES, tuple(_some(street, MOST_PICTURES)), frozenset((CLASSES[0], SMALL)))
        against["cats, its other videos (never learnt from)"] = compared(named, alone, small)
    lost = {
        f"{label} on {name}": round(row["float32_AP"] - row["int8_AP"], 4)
        for name, rows in against.items() for label, row in rows.items()
        if row["float32_AP"] - row["int8_AP"] > MOST_LOST
    }
    print("lost", lost, flush=True)
    (wishes.home / "default-int8.onnx").write_bytes(found.model)
    points = [f"{100 * value:.1f} points of {name}" for name, value in lost.items()] or ["half a point at most"]
    float_card = json.loads((wishes.home / "default.json").read_text())
    card = {
        "name": "default-int8", "of": "default", "precision": "int8", **{key: float_card[key] for key in _KEPT},
        "created": f"{datetime.now(UTC):%Y-%m-%d}", "sha256": hashlib.sha256(found.model).hexdigest(),
        "bytes": len(found.model), "convolutions": f"{found.convolutions} of {found.of}",
        "calibrated_on": "pictures of the training sets: HIT-UAV, aerial cars, TinyPerson, simulated",
        "against_float32": against,
        "remark": f"about twice as quick on CPUs with eight-bit instructions; loses {'; '.join(points)}",
    }
    (wishes.home / "default-int8.json").write_text(json.dumps(card, indent=1) + "\n")


def compared(labelled: LabelledSet, whole: Path, small: Path) -> dict[str, dict[str, float]]:
    """Of each labelled class the AP of both models."""
    read = reader()
    out: dict[str, dict[str, float]] = {}
    for precision, path in (("float32", whole), ("int8", small)):
        detector = Detector.load(path)
        found = [detector.detect(read(each.path), least_score=0.02) for each in labelled.pictures]
        scores = score_set(labelled, found, CLASSES, detector.info.thresholds, draws=20)
        for row in scores.classes:
            if row.labels:
                value = scores.intervals[f"AP {row.label}"].value
                out.setdefault(row.label, {"labels": row.labels})[f"{precision}_AP"] = round(value, 4)
    return out


def _some(labelled: LabelledSet, count: int) -> list:
    """So many of a set's pictures, evenly taken."""
    return list(labelled.pictures[:: max(1, len(labelled) // count)][:count])


if __name__ == "__main__":
    main()
