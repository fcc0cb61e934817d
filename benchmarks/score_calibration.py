"""How often reports of each score are right: python benchmarks/score_calibration.py DATA OUT [--model default] [--fit]

DATA holds `detection` and `flights`. The model searches photos that none of its networks learnt from, in its own scale
(its `calibration` taken out), in each way that users search: as one frame of many (`one`) and as a picture of unknown
scale (`sizes`); flights, at half size, by the scale of their ground (`known`). What it reports from LEAST on is written
to OUT, set by set, and read again where it is there. A report is right by the rules of AP50: IoU 0.5 with a label.

With --fit slope and shift of each class's log-odds are fitted (Platt 1999) on the videos and flights of FIT, which
count the same; benchmarks/pack_calibration.py writes them into the models. Without, the scale is judged that the model
states: in tenths of the score, which share is right, by groups that nothing was fitted on and by those of FIT.
`semantic_drone` and `cats` may not be learnt from and are never among FIT. What photos of flights show is known: the
people of brighton_people.json and the cars of flight_cars.json.

Writes results/score_calibration.json.
"""

import argparse
import json
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

import detection_data
from own_scale import own_scale
from provenance import commit, machine, note_scoring
from sorvolo.detection.calibration import platt_fit, platt_scaled
from sorvolo.detection.contract import Calibration
from sorvolo.detection.detector import Detector
from sorvolo.detection.models import find_model
from sorvolo.detection.session import Session
from sorvolo.geometry.calibration_bins import calibration_bins
from sorvolo.lab.evaluation.detection_metrics import TENTHS, match_pictures
from sorvolo.survey.labels import LabelledPicture, LabelledSet
from sorvolo.survey.objects import CLASSES, Detections
from train_default_model import reader

HERE = Path(__file__).parent
RESULTS = HERE / "results" / "score_calibration.json"
LEAST, SCALE, SHOWN = 0.05, 0.5, ("person", "car")


@dataclass(frozen=True)
class Photos:
    """Pictures of a labelled set, or of a flight from `first` on: each `step`-th; `m_per_px` of a flight's at SCALE."""

    part: str = "test"
    step: int = 1
    first: str = ""
    m_per_px: float | None = None


DAYLIGHT = {
    "tinyperson val": Photos("val"),
    "tinyperson": Photos(),
    "aerial_cars": Photos(),
    "semantic_drone": Photos(),
    "cats": Photos(step=4),
    "brighton_beach": Photos(m_per_px=0.034),
    "caliterra": Photos(first="IMG_9400.jpg", m_per_px=0.07),
    "fixed_wing": Photos(m_per_px=0.072),
}
THERMAL = {"hituav val": Photos("val", 2), "hituav": Photos(step=6)}
GROUND = ("brighton_beach", "caliterra", "fixed_wing")
HITUAV = (
    "hituav val",
    "1_60_60_0",
    "1_60_70_0",
    "1_70_30_0",
    "0_60_30_0",
    "0_60_40_0",
    "0_60_50_0",
    "0_60_60_0",
    "0_70_60_0",
    "0_70_80_0",
    "0_70_90_0",
    "0_80_40_0",
    "0_80_60_0",
    "0_80_80_0",
    "0_80_90_0",
)
"""Its validation block, and the first and third of four held-out blocks: by night and by day, 60 to 80 m high."""

FIT = {
    "default": {"person": ("bb_V0018", "bb_V0031"), "car": ("DJI-00760", *GROUND)},
    "thermal": {"person": HITUAV, "car": HITUAV},
}
SECOND_LOOK = ("tinyperson val", *GROUND)
"""Whose people weights of the second look were fitted on: for people they are neither fitted on nor held out."""


def main() -> None:
    """Search what was not searched yet, fit, judge, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--model", default="default", choices=sorted(FIT))
    parser.add_argument("--file", type=Path, help="of the model; else the installed one")
    parser.add_argument("--fit", action="store_true")
    parser.add_argument("--results", type=Path, default=RESULTS)
    wishes = parser.parse_args()
    wishes.out.mkdir(parents=True, exist_ok=True)
    session = Session(wishes.file or find_model(wishes.model), "cpu", 1)
    stated = session.info
    session.info = own_scale(stated)
    plan = THERMAL if wishes.model == "thermal" else DAYLIGHT
    reports = [
        each
        for name, photos in plan.items()
        for each in reports_of(
            name, pictures_of(wishes.data, name, photos), photos, Detector(session), wishes.out
        )
    ]
    found: dict[str, Any] = {}
    for label in SHOWN:
        own = [each for each in reports if each.label == label]
        names = FIT[wishes.model][label]
        fit = (
            fit_of([each for each in own if each.is_of(names)])
            if wishes.fit
            else stated.calibration[label]
        )
        found[label] = {"slope": fit.slope, "shift": fit.shift, "fit_on": names} | judged(
            own, names, fit
        )
        print(label, json.dumps(found[label], indent=1), flush=True)
    document = json.loads(wishes.results.read_text()) if wishes.results.is_file() else {}
    document[wishes.model] = {
        "benchmark": "score_calibration",
        "machine": machine(),
        "commit": commit(),
        "date": time.strftime("%Y-%m-%d"),
        "version": stated.version,
        **note_scoring(f"score_calibration, {' '.join(plan)}"),
        "classes": found,
    }
    wishes.results.write_text(json.dumps(document, indent=1) + "\n")


@dataclass(frozen=True, eq=False)
class Reports:
    """What was reported of a class in a group's pictures, looked at in one way: scores (N,), and which are right."""

    label: str
    place: str
    group: str
    way: str
    scores: np.ndarray
    right: np.ndarray
    labels: int

    def is_of(self, names: Sequence[str]) -> bool:
        """Whether it is of one of these groups, or sets."""
        return self.group in names or self.place in names

    def kind(self, names: Sequence[str]) -> str:
        """What it is beside slope and shift that are fitted on the groups of these names."""
        is_known = self.label == SHOWN[0] and self.place in SECOND_LOOK
        return (
            "fitted on" if self.is_of(names) else "of the second look" if is_known else "held out"
        )


def pictures_of(data: Path, name: str, photos: Photos) -> LabelledSet:
    """The pictures with their labels; those of flights as large as they are."""
    if name in GROUND:
        return flight(data, name, photos.first)
    labelled = getattr(detection_data, name.split()[0])(data / "detection")[photos.part]
    order = np.random.default_rng(0).permutation(len(labelled))[:: photos.step]
    return labelled.only([labelled.pictures[each] for each in order])


def flight(data: Path, name: str, first: str) -> LabelledSet:
    """Photos of a flight, with the people and cars that are known to be on them."""
    known = [
        json.loads((HERE / each).read_text())
        for each in ("brighton_people.json", "flight_cars.json")
    ]
    pictures = []
    for path in sorted((data / "flights" / name).glob("*.[jJ][pP][gG]")):
        if path.name < first:
            continue
        boxes, ignored = [np.zeros((0, 4))] * 2, np.zeros((0, 4))
        if name == GROUND[0]:
            boxes[0] = np.array(known[0]["people"].get(path.stem, []), float).reshape(-1, 4)
            ignored = np.array(known[0]["around"].get(path.stem, []), float).reshape(-1, 4)
        boxes[1] = np.array(known[1]["cars"].get(f"{name}/{path.stem}", []), float).reshape(-1, 4)
        pictures.append(
            LabelledPicture(
                str(path),
                1,
                1,
                name,
                np.concatenate(boxes).astype(np.float32),
                np.repeat([0, 1], [len(each) for each in boxes]),
                ignored.astype(np.float32),
            )
        )
    return LabelledSet(name, CLASSES, tuple(pictures), frozenset({CLASSES[2]}))


def reports_of(
    name: str, labelled: LabelledSet, photos: Photos, detector: Detector, out: Path
) -> Iterator[Reports]:
    """What the model reports of each class in each group of the pictures, in each way of looking."""
    path = out / f"{name}.json"
    if not path.is_file():
        path.write_text(
            json.dumps([_searched(each.path, photos, name, detector) for each in labelled.pictures])
        )
        print(name, len(labelled), "searched", flush=True)
    seen = {each["path"]: each["seen"] for each in json.loads(path.read_text())}
    groups = sorted({each.group for each in labelled.pictures})
    shown = {
        labelled.classes[label] for each in labelled.pictures for label in each.labels.tolist()
    }
    names = (
        SHOWN if name in GROUND else [each for each in SHOWN if each in shown - labelled.unlabelled]
    )
    for group, label in ((group, label) for group in groups for label in names):
        pictures = [each for each in labelled.pictures if each.group == group]
        own = labelled.only([_sized(each) for each in pictures])
        for way in sorted(seen[Path(pictures[0].path).name]):
            found = [_detections(seen[Path(each.path).name][way]) for each in pictures]
            (match,), _, _ = match_pictures(own, found, [label])
            counts = ~match.ignored[0]
            yield Reports(
                label,
                name,
                group,
                way,
                match.scores[counts],
                match.right[0][counts],
                len(match.true_scores),
            )


def _searched(path: str, photos: Photos, name: str, detector: Detector) -> dict[str, Any]:
    """What is found in one picture, in each way of looking, boxes in the pixels of the file."""
    picture, scale = reader()(path), 1.0
    ways: dict[str, dict[str, Any]] = {"sizes": {}, "one": {"overlapping": True}}
    if name in GROUND:
        scale = SCALE if name != GROUND[2] else 1.0  # fixed_wing's photos are small
        picture = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        ways = {
            "sizes": {},
            "known": {"overlapping": True, "from_above": True, "m_per_px": photos.m_per_px},
        }
    seen = {}
    for way, how in ways.items():
        found = detector.detect(picture, tiles="auto", classes=SHOWN, least_score=LEAST, **how)
        seen[way] = {
            "boxes": (found.boxes_px / scale).tolist(),
            "scores": found.scores.tolist(),
            "labels": found.labels.tolist(),
        }
    return {"path": Path(path).name, "seen": seen}


def _detections(seen: Mapping[str, Any]) -> Detections:
    return Detections(
        np.array(seen["boxes"], np.float32).reshape(-1, 4),
        np.array(seen["scores"], np.float32),
        np.array(seen["labels"], np.int64),
        CLASSES,
    )


def _sized(picture: LabelledPicture) -> LabelledPicture:
    """With some size, where that of the file was not read: boxes beyond it are none."""
    return replace(picture, width_px=10_000, height_px=10_000) if picture.width_px == 1 else picture


def fit_of(reports: Sequence[Reports]) -> Calibration:
    """The scale of a class's reports; each group counts the same."""
    rows = [each for each in reports if len(each.scores)]
    sizes: dict[str, int] = {}
    for each in rows:
        sizes[each.group] = sizes.get(each.group, 0) + len(each.scores)
    mean = sum(sizes.values()) / len(sizes)
    counts = np.concatenate([np.full(len(each.scores), mean / sizes[each.group]) for each in rows])
    scores, right = (
        np.concatenate([getattr(each, key) for each in rows]) for key in ("scores", "right")
    )
    fit = platt_fit(scores.astype(float), right, counts)
    assert fit is not None  # of the packaged models right reports score higher
    return Calibration(round(fit.slope, 3), round(fit.shift, 3))


def judged(reports: Sequence[Reports], names: Sequence[str], fit: Calibration) -> dict[str, Any]:
    """In tenths of the scaled score, how many, and which share is right: of all that is held out, and set by set."""
    sets = []
    for place, kind, way in dict.fromkeys(
        (each.place, each.kind(names), each.way) for each in reports
    ):
        rows = [
            each
            for each in reports
            if (each.place, each.kind(names), each.way) == (place, kind, way)
        ]
        sets.append(
            {
                "set": place,
                "is": kind,
                "way": way,
                "groups": len(rows),
                "labels": sum(each.labels for each in rows),
                "tenths": tenths(rows, fit),
            }
        )
    return {
        "held out": tenths([each for each in reports if each.kind(names) == "held out"], fit),
        "sets": sets,
    }


def tenths(reports: Sequence[Reports], fit: Calibration) -> list[dict[str, float | int]]:
    """Where there are any: how many, their mean score, and which share is right with its interval of 90 %."""
    if not reports:
        return []
    scores = platt_scaled(np.concatenate([each.scores for each in reports]).astype(float), fit)
    rows = calibration_bins(scores, np.concatenate([each.right for each in reports]), TENTHS)
    return [
        {
            "from": each.low,
            "count": each.count,
            "score": round(each.stated, 3),
            "right": round(each.found, 3),
            "right_low": round(each.found_low, 3),
            "right_high": round(each.found_high, 3),
        }
        for each in rows
    ]


if __name__ == "__main__":
    main()
