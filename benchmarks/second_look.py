"""What people's second look changes: benchmarks/second_look.py DATA [--model default] [--sets ...]

Decisions 0049 and 0054. DATA holds `detection` and `flights`. Every set is searched once; what the model reports is
counted before and after the second look that its file states, at the model's thresholds. Flights that hardly show
anyone (false_alarms.py: brighton_beach and caliterra, at full size) give reports a photo; how many are right was
counted by eye on the crops that --out FOLDER gets (`kept`, `gone`, `new`), and is given with --right
FLIGHT:CLASS=BEFORE,AFTER. Labelled sets (detection_data.py, held-out parts) give what is found and right at the
thresholds, and AP50. Processor seconds of each look. Writes results/second_look_people.json; results/second_look.json
is the trial of decision 0046.
"""

import argparse
import json
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np

import detection_data
from false_alarms import FIRST, M_PER_PX, SCALE, SHOWN, crop, possible, sheet
from own_scale import own_scale
from provenance import commit, machine, note_scoring
from sorvolo.detection.detector import Detector
from sorvolo.detection.models import find_model
from sorvolo.detection.session import Seen, Session
from sorvolo.geometry.arrays import ImageRGB
from sorvolo.lab.evaluation.detection_scores import score_set
from sorvolo.lab.evaluation.detector import LEAST_SCORE
from sorvolo.store.exports.plain import plain_json
from sorvolo.survey.labels import LabelledSet
from sorvolo.survey.objects import Detections
from train_default_model import reader

RESULTS = Path(__file__).parent / "results" / "second_look_people.json"
SETS = (
    *FIRST,
    "semantic_drone",
    "sdd",
    "tinyperson",
    "tinyperson val",
    "mannequin",
    "aerial_cars",
    "cats",
)
LEAST, EVERY = LEAST_SCORE, {"mannequin": 4}
BECAME = {(False, False): "", (True, True): "kept", (True, False): "gone", (False, True): "new"}
SCORES = (0.5, 0.6, 0.7, 0.78, 0.84, 0.9, 0.94, 0.96)


class Looker:
    """A model that looks once, and again as its file states, both in the own scale; counts what they take, processor
    seconds."""

    def __init__(self, model: str) -> None:
        whole, session = (Session(find_model(model), "cpu", 1) for _ in range(2))
        whole.info = own_scale(whole.info)
        session.info = own_scale(session.info, second_look={})
        self.whole = Detector(whole)
        self.detector = Detector(session)
        self.first_s = self.again_s = 0.0

    def looks(
        self,
        picture: ImageRGB,
        classes: tuple[str, ...],
        m_per_px: float | None = None,
        least: float = LEAST,
    ) -> tuple[Detections, Detections]:
        """What is found at first and after the second look."""
        began_s = time.process_time()
        found = self.detector.detect(
            picture, tiles="auto", m_per_px=m_per_px, classes=classes, least_score=least
        )
        looked_s = time.process_time()
        seen = Seen(found.boxes_px, found.scores, found.labels)
        seen = self.whole._seen_again(self.whole._session, picture, seen, classes)
        self.first_s += looked_s - began_s
        self.again_s += time.process_time() - looked_s
        return found, Detections(seen.boxes_px, seen.scores, seen.labels, found.classes)


@dataclass
class Crops:
    """Crops of a flight's reports of each class, by what became of them."""

    of: dict[str, list[np.ndarray]] = field(default_factory=dict)

    def write(self, folder: Path, flight: str) -> None:
        """One sheet each."""
        folder.mkdir(parents=True, exist_ok=True)
        for name, each in self.of.items():
            cv2.imwrite(str(folder / f"{flight}-{name}.png"), sheet(each))


def main() -> None:
    """Look, count, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", type=Path)
    parser.add_argument("--model", default="default")
    parser.add_argument("--sets", nargs="+", default=SETS)
    parser.add_argument("--right", nargs="*", default=[])
    parser.add_argument("--out", type=Path)
    parser.add_argument("--results", type=Path, default=RESULTS)
    wishes = parser.parse_args()
    known = json.loads(wishes.results.read_text())["sets"] if wishes.results.is_file() else {}
    for name in wishes.sets if not wishes.right else ():
        looker = Looker(wishes.model)
        row = (
            flight(looker, wishes.data, name, wishes.out)
            if name in FIRST
            else labelled(looker, wishes.data, name)
        )
        known[name] = (
            row
            | note_scoring(f"second_look, {name}")
            | {
                "first_look_s": round(looker.first_s, 1),
                "second_look_s": round(looker.again_s, 1),
            }
        )
        print(name, json.dumps(known[name]), flush=True)
    for each in wishes.right:
        judged(known, each)
    wishes.results.write_text(
        json.dumps(
            plain_json(
                {
                    "benchmark": "second_look",
                    "machine": machine(),
                    "commit": commit(),
                    "date": time.strftime("%Y-%m-%d"),
                    "model": wishes.model,
                    "weights": json.loads(
                        find_model(wishes.model).with_suffix(".json").read_text()
                    )["second_look"],
                    "sets": known,
                }
            ),
            indent=1,
        )
        + "\n"
    )


def judged(known: dict, wish: str) -> None:
    """Put what --right states, FLIGHT:CLASS=BEFORE,AFTER, into the sets' rows."""
    where, counts = wish.split("=")
    name, label = where.split(":")
    row = known[name][label]
    for when, count in zip(("before", "after"), counts.split(",")):
        row[f"right_{when}_by_eye"] = int(count)
        row[f"false_a_photo_{when}"] = round((row[when] - int(count)) / known[name]["photos"], 3)


def flight(looker: Looker, data: Path, name: str, out: Path | None) -> dict[str, object]:
    """Reports of a flight at full size, before and after."""
    thresholds, crops = looker.whole.info.thresholds, Crops()
    counts = {label: {"threshold": thresholds[label], "before": 0, "after": 0} for label in SHOWN}
    photos = [
        path
        for path in sorted((data / "flights" / name).glob("*.[jJ][pP][gG]"))
        if path.name >= FIRST[name]
    ]
    for path in photos:
        shown = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_COLOR)
        picture, m_per_px = np.ascontiguousarray(shown[..., ::-1]), M_PER_PX[name] * SCALE
        least = min(how.least for how in looker.whole.info.second_look.values())
        looks = looker.looks(picture, SHOWN, m_per_px, least)
        first, after = (possible(each, shown, m_per_px, thresholds) for each in looks)
        for label, box, was, score in followed(first, after):
            stages = was >= thresholds[label], score >= thresholds[label]
            counts[label]["before"] += stages[0]
            counts[label]["after"] += stages[1]
            if became := BECAME[stages]:
                text = f"{was:.2f} {score:.2f} {path.stem[-4:]}"
                crops.of.setdefault(f"{label}-{became}", []).append(crop(shown, box, text))
    if out is not None:
        crops.write(out, name)
    return {"photos": len(photos), **counts}


def followed(
    first: Detections, after: Detections
) -> Iterator[tuple[str, np.ndarray, float, float]]:
    """Each report's class, box (4,), and its scores before and after."""
    for label, box, score in zip(first.names, first.boxes_px, first.scores):
        same = (after.boxes_px == box).all(axis=1) & (np.array(after.names) == label)
        yield label, box, float(score), float(after.scores[same].max(initial=0.0))


def labelled(looker: Looker, data: Path, name: str) -> dict[str, object]:
    """A labelled set, before and after."""
    chosen, read = held_out(data / "detection", name), reader()
    pairs = [looker.looks(read(each.path), SHOWN) for each in chosen.pictures]
    rows: dict[str, object] = {"pictures": len(chosen)}
    for when, found in zip(("before", "after"), zip(*pairs)):
        scores = score_set(
            chosen, list(found), chosen.classes, looker.whole.info.thresholds, draws=20
        )
        for row in scores.classes:
            if row.labels and row.label in SHOWN:
                of_class = rows.setdefault(row.label, {"labels": row.labels})
                assert isinstance(of_class, dict)
                of_class[when] = {
                    "found": round(row.reported.recall, 4),
                    "right": round(row.reported.precision, 4),
                    "AP50": round(scores.intervals[f"AP50 {row.label}"].value, 4),
                    "found_from_score_on": found_from(row.curve),
                }
    return rows


def found_from(curve: np.ndarray) -> dict[str, tuple[float, float]]:
    """The share found, and the share right, from some scores on; `curve` (N, 3) is score, precision, recall."""
    rows = {}
    for score in SCORES:
        above = curve[curve[:, 0] >= score]
        rows[str(score)] = (
            (round(float(above[-1, 2]), 4), round(float(above[-1, 1]), 4))
            if len(above)
            else (0.0, 1.0)
        )
    return rows


def held_out(data: Path, name: str) -> LabelledSet:
    """The pictures of a labelled set; classes without a label are not judged."""
    kind, _, part = name.partition(" ")
    parts = getattr(detection_data, kind)(data)
    chosen = parts[part or ("test" if "test" in parts else "train")]
    chosen = chosen.only(chosen.pictures[:: EVERY.get(name, 1)])
    labels = {
        chosen.classes[label] for picture in chosen.pictures for label in picture.labels.tolist()
    }
    return replace(chosen, unlabelled=chosen.unlabelled | (set(chosen.classes) - labels))


if __name__ == "__main__":
    main()
