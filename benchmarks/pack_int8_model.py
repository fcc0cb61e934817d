"""The packaged model in eight bits, and what that costs: python benchmarks/pack_int8_model.py DATA (after packing).

Calibrated on pictures of the training sets, compared with the float32 model on pictures that neither learnt from; the
card states by how much each class's AP differs. Where more than half a point is lost, nothing is written: what --parts
names stays in float then, and it is tried again.
"""

import argparse
import hashlib
import json
import tempfile
from datetime import UTC, datetime
from pathlib import Path

from detection_data import SMALL, aerial_cars, cats, tinyperson
from detector_accuracy import held_out
from pack_default_model import HOME
from provenance import note_scoring
from sorvolo.detection.detector import Detector
from sorvolo.detection.quantise import quantise
from sorvolo.lab.datasets import read_dataset
from sorvolo.lab.evaluation.detection_scores import score_set
from sorvolo.lab.evaluation.detector import LEAST_SCORE
from sorvolo.lab.simulate.pictures import simulate_pictures
from sorvolo.lab.simulation.pictures import PictureSettings
from sorvolo.survey.labels import LabelledSet
from sorvolo.survey.objects import CLASSES
from train_default_model import reader
from training_shares import SIMULATED_SEED

MOST_LOST = 0.005  # of AP in a class of a set, beyond which nothing is written
# 64 channels wide, and the first layers, a few channels of large values: in eight bits they lose most of what is lost
FLOAT_PARTS = (
    "aerial/neck",
    "aerial/proposals",
    "aerial/backbone/_conv_stem",
    "aerial/backbone/_blocks.0",
    "aerial/backbone/_blocks.1",
    "aerial/backbone/_blocks.2",
    "aerial/backbone/_blocks.3",
    "backbone/stem",
    "backbone/stages.0",
    "softened",
)
CALIBRATION_OF_EACH, MOST_PICTURES = 16, 60
_LATER = (
    "version",
    "best_px",
    "second_look",
    "second_look_fit",
    "second_look_measured",
    "pyramid",
    "format",
    "calibration",
)
_KEPT = ("preset", "classes", "thresholds", "on_request", "licence", "trained_on", "fails")


def main() -> None:
    """Quantise, compare, write the model and its card."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", type=Path)
    parser.add_argument(
        "--home", type=Path, default=HOME, help="folder of default.onnx, into which the other goes"
    )
    parser.add_argument("--parts", nargs="+", default=FLOAT_PARTS, help="what stays in float")
    parser.add_argument(
        "--try", dest="tried", type=Path, help="only compare on training pictures, write it here"
    )
    wishes = parser.parse_args()
    whole = wishes.home / "default.onnx"
    with tempfile.TemporaryDirectory() as folder:
        found = quantise(
            whole, calibration(wishes.data, Path(folder)), float_parts=tuple(wishes.parts)
        )
        small = Path(folder) / "small.onnx"
        small.write_bytes(found.model)
        print(
            len(found.model),
            "bytes,",
            found.convolutions,
            "of",
            found.of,
            "convolutions",
            flush=True,
        )
        sets = development(wishes.data) if wishes.tried else not_learnt(wishes.data, Path(folder))
        scoring = {} if wishes.tried else note_scoring("pack_int8_model, pictures not learnt from")
        against = {}
        for labelled in sets:
            against[labelled.name] = compared(labelled, whole, small)
            print(labelled.name, against[labelled.name], flush=True)
    if wishes.tried:
        wishes.tried.write_bytes(found.model)
        return
    lost = {
        f"{label} on {name}": round(row["float32_AP"] - row["int8_AP"], 4)
        for name, rows in against.items()
        for label, row in rows.items()
    }
    if max(lost.values()) > MOST_LOST:
        raise SystemExit(f"more than half a point of AP is lost: {lost}")
    (wishes.home / "default-int8.onnx").write_bytes(found.model)
    float_card = json.loads((wishes.home / "default.json").read_text())
    card = {
        "name": "default-int8",
        "of": f"default, version {float_card['version']}",
        "precision": "int8",
        **{key: float_card[key] for key in _KEPT},
        **{key: float_card[key] for key in _LATER if key in float_card},
        "created": f"{datetime.now(UTC):%Y-%m-%d}",
        "sha256": hashlib.sha256(found.model).hexdigest(),
        "bytes": len(found.model),
        "convolutions": f"{found.convolutions} of {found.of}",
        "calibrated_on": "pictures of the training sets: aerial cars, TinyPerson, simulated",
        "against_float32": against,
        **scoring,
        "remark": f"for CPUs with eight-bit instructions; loses {100 * max(lost.values()):.1f} points of AP at most",
    }
    (wishes.home / "default-int8.json").write_text(json.dumps(card, indent=1) + "\n")


def calibration(data: Path, folder: Path) -> list:
    """Pictures of the training sets by day, and simulated ones."""
    for _ in simulate_pictures(
        folder / "made", PictureSettings(CALIBRATION_OF_EACH, SIMULATED_SEED)
    ):
        pass
    sets = [aerial_cars(data)["train"], tinyperson(data)["train"], read_dataset(folder / "made")]
    read = reader()
    return [read(each.path) for labelled in sets for each in _some(labelled, CALIBRATION_OF_EACH)]


def development(data: Path) -> list[LabelledSet]:
    """Pictures on which the parts that stay in float may be chosen."""
    sets = (aerial_cars(data)["train"], tinyperson(data)["val"])
    return [each.only(_some(each, CALIBRATION_OF_EACH)) for each in sets]


def not_learnt(data: Path, folder: Path) -> list[LabelledSet]:
    """Pictures that no part of the model was trained on."""
    sets = [
        held_out(name, data, folder, 1) for name in ("aerial_cars", "semantic_drone", "pictures")
    ]
    street = cats(data)["train"]
    sets.append(
        LabelledSet(
            "cats, its other videos", CLASSES, street.pictures, frozenset((CLASSES[0], SMALL))
        )
    )
    return [each.only(_some(each, MOST_PICTURES)) for each in sets if each is not None]


def compared(labelled: LabelledSet, whole: Path, small: Path) -> dict[str, dict[str, float]]:
    """Of each labelled class the AP of both models."""
    read = reader()
    out: dict[str, dict[str, float]] = {}
    for precision, path in (("float32", whole), ("int8", small)):
        detector = Detector.load(path)
        found = [
            detector.detect(read(each.path), least_score=LEAST_SCORE) for each in labelled.pictures
        ]
        scores = score_set(labelled, found, CLASSES, detector.info.thresholds, draws=20)
        for row in scores.classes:
            if row.labels:
                value = scores.intervals[f"AP {row.label}"].value
                out.setdefault(row.label, {"labels": row.labels})[f"{precision}_AP"] = round(
                    value, 4
                )
    return out


def _some(labelled: LabelledSet, count: int) -> list:
    """So many of a set's pictures, evenly taken."""
    return list(labelled.pictures[:: max(1, len(labelled) // count)][:count])


if __name__ == "__main__":
    main()
