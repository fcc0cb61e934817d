"""What a second look at a report is worth: benchmarks/fit_second_look.py DATA OUT --scenes DIR --things DIR

The packaged model (--model) searches development pictures. What it reports from LEAST on is cut out and looked at again
at LOOKS_PX (second_look_sheets.py). A logistic regression of the report's own log-odds and the mean of the looks'
says how likely the report is right; its shift is then moved until the share KEPT of the right reports above the
model's threshold stay there: all that is gained goes into fewer false alarms.

Development pictures: real ground without people and cars (the flights `caliterra` to its 46th photo and `fixed_wing`),
the training parts of tinyperson, mannequin and aerial_cars, and people and things of rendered_people.py (DIR: scenes of
seeds that no shipped model learnt from) on the ground of `fixed_wing`. Neither photos of brighton_beach nor any set
that detection_data.py holds out.

The trial of decision 0046: the people and things are `rendered_people.py --scenes 12 --seed 2` and `--scenes 75 --seed
3`. Writes OUT/reports.npz and OUT/second_look.json, which second_look.py measures.
"""

import argparse
import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from detection_data import aerial_cars, mannequin, tinyperson
from fit_people import nobody
from people_samples import Source, ground, shown
from rendered_people import Scene, read_scenes
from second_look_sheets import SecondLook, SheetSettings, opinions
from sorvolo.detection.detector import Detector
from sorvolo.detection.models import find_model
from sorvolo.detection.session import Seen, Session
from sorvolo.geometry.arrays import ImageRGB
from sorvolo.geometry.box_overlap import cover_matrix, iou_matrix
from sorvolo.survey.labels import LabelledPicture, LabelledSet
from sorvolo.training.samples import Share
from train_default_model import reader
from train_judge import RIGHT_IOU, UNSURE_IOU, bare_ground, fitted, odds

JUDGED = {"person": 0, "car": 1}
LOOKS_PX, LEAST, KEPT, FOLDS = (34.0, 68.0), 0.4, 0.98, 5
MOST_OF_A_SET = 60  # right reports, and false ones, of a set count as so many at most
RENDERED, SIDE_PX, SEED = 60, 640, 5
MOST_CUTS = 160
ALOFT = "IMG_9364.jpg"


class Report(NamedTuple):
    """A report of a development picture: its set, picture and class, its score and the looks', and if it is right."""

    place: str
    picture: str
    label: int
    score: float
    again: np.ndarray  # (looks,)
    is_right: bool


@dataclass(frozen=True, eq=False)
class Shot:
    """A picture (H, W, 3) with its labels (LabelledPicture) and the classes that are labelled in it."""

    place: str
    name: str
    image: ImageRGB
    truth: LabelledPicture
    classes: tuple[str, ...]
    m_per_px: float | None = None


def main() -> None:
    """Look, fit, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--model", default="default-int8")
    parser.add_argument("--scenes", type=Path, required=True, help="people and things")
    parser.add_argument("--things", type=Path, required=True, help="scenes of which only the things are laid")
    wishes = parser.parse_args()
    wishes.out.mkdir(parents=True, exist_ok=True)
    detector = Detector.load(wishes.model, provider="cpu", threads=1)
    session = Session(find_model(wishes.model), "cpu", 1)
    reports: list[Report] = []
    for shot in shots(wishes.data, read_scenes(wishes.scenes), read_scenes(wishes.things)):
        if not reports or reports[-1].place != shot.place:
            print(shot.place, len(reports), flush=True)
        reports += reported(detector, session, shot)
    found = {
        name: fit_of(name, [each for each in reports if each.label == label], detector.info.thresholds[name])
        for name, label in JUDGED.items()
    }
    names = ("place", "picture", "label", "score", "again", "is_right")
    columns = {name: np.array([getattr(each, name) for each in reports]) for name in names}
    np.savez(wishes.out / "reports.npz", **columns)
    (wishes.out / "second_look.json").write_text(json.dumps(found, indent=1) + "\n")
    print(json.dumps(found), flush=True)


def shots(data: Path, scenes: list[Scene], things: list[Scene]) -> Iterator[Shot]:
    """All development pictures."""
    read = reader()
    plan: list[tuple[LabelledSet, int, tuple[float, ...], tuple[str, ...], float | None]] = [
        (aloft(bare_ground(data, "caliterra")), 1, (1.0,), tuple(JUDGED), 0.035),
        (bare_ground(data, "fixed_wing"), 1, (1.0, 1.5), tuple(JUDGED), None),
        (tinyperson(data)["train"], 3, (2.0,), ("person",), None),
        (mannequin(data)["train"], 6, (0.6, 1.0), ("person",), None),
        (aerial_cars(data)["train"], 2, (1.0, 0.6), ("car",), None),
    ]
    for labelled, step, scales, classes, m_per_px in plan:
        for picture in labelled.pictures[::step]:
            whole = read(picture.path)
            for scale in scales:
                way = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
                image = np.ascontiguousarray(cv2.resize(whole, None, fx=scale, fy=scale, interpolation=way))
                truth = LabelledPicture(
                    picture.path, 1, 1, picture.group, picture.boxes_px * scale, picture.labels,
                    picture.ignored_px * scale,
                )
                yield Shot(labelled.name, Path(picture.path).stem, image, truth, classes, m_per_px)
    rng, source = np.random.default_rng(SEED), Source(Share(ground(data, "fixed_wing"), 1.0, (0.5, 2.0)), 1.0)
    kinds = {"rendered people": scenes, "rendered things": [nobody(each) for each in things]}
    for place, own in kinds.items():
        for number in range(RENDERED):
            made = shown(source, own, read, SIDE_PX, rng)
            none = np.zeros(len(made.boxes), np.int64)
            truth = LabelledPicture("", SIDE_PX, SIDE_PX, place, made.boxes, none, made.ignored)
            yield Shot(place, str(number), made.image, truth, ("person",))


def aloft(flight: LabelledSet) -> LabelledSet:
    """Without the photos of the climb, whose ground is nearer and shows the crew."""
    return flight.only([each for each in flight.pictures if Path(each.path).name >= ALOFT])


def reported(detector: Detector, session: Session, shot: Shot) -> Iterator[Report]:
    """What the model reports of a picture, and how that looks again."""
    first = detector.detect(
        shot.image, tiles="auto", m_per_px=shot.m_per_px, classes=shot.classes, least_score=LEAST
    )
    seen = Seen(first.boxes_px, first.scores, first.labels)
    how = SecondLook(LOOKS_PX, own=1.0, again=0.0, shift=0.0, least=LEAST)
    hows = {JUDGED[name]: how for name in shot.classes}
    again = opinions(seen, shot.image, session.see, hows, SheetSettings(most=MOST_CUTS))
    hidden = cover_matrix(seen.boxes_px, shot.truth.ignored_px).max(1, initial=0) > 0.5
    for row, scores in again.items():
        label = int(seen.labels[row])
        own = shot.truth.boxes_px[shot.truth.labels == label]
        best = float(iou_matrix(seen.boxes_px[row : row + 1], own).max(initial=0))
        if best >= RIGHT_IOU or (best <= UNSURE_IOU and not hidden[row]):
            yield Report(shot.place, shot.name, label, float(seen.scores[row]), scores, best >= RIGHT_IOU)


def fit_of(name: str, reports: Sequence[Report], threshold: float) -> dict[str, object]:
    """A class's weights, and what every set keeps at the threshold by weights that did not see its picture."""
    right, weights = np.array([each.is_right for each in reports]), balanced(reports)
    inputs = np.column_stack([odds(np.array([each.score for each in reports])), mean_odds(reports)])
    part = np.array([int(hashlib.sha256(each.picture.encode()).hexdigest(), 16) % FOLDS for each in reports])
    crossed = np.zeros(len(reports))
    for number in range(FOLDS):
        rest, own = part != number, part == number
        crossed[own] = shifted(inputs, right, weights, rest, inputs[:, 0], threshold)[own]
    least = float(odds(np.array(threshold)))
    kept: dict[str, dict[str, int]] = {}
    for each, before, after in zip(reports, inputs[:, 0] >= least, crossed >= least):
        row = kept.setdefault(each.place, dict.fromkeys(("right_before", "right", "false_before", "false"), 0))
        kind = "right" if each.is_right else "false"
        row[f"{kind}_before"] += int(before)
        row[kind] += int(after)
    fit, shift = weights_of(inputs, right, weights, np.ones(len(reports), bool), threshold)
    found = SecondLook(LOOKS_PX, float(fit[0]), float(fit[1]), shift, LEAST)
    rounded = {key: each if key == "looks_px" else round(each, 3) for key, each in asdict(found).items()}
    return {"weights": rounded, "threshold": threshold, "reports": len(reports), "crossed": kept}


def shifted(
    inputs: np.ndarray, right: np.ndarray, weights: np.ndarray, rows: np.ndarray, before: np.ndarray, threshold: float
) -> np.ndarray:
    """(N,) log-odds of all reports by what some rows teach."""
    fit, shift = weights_of(inputs, right, weights, rows, threshold)
    return np.asarray(inputs @ fit[:2] + shift)


def weights_of(
    inputs: np.ndarray, right: np.ndarray, weights: np.ndarray, rows: np.ndarray, threshold: float
) -> tuple[np.ndarray, float]:
    """The regression of some rows, (3,), and the shift at which enough right reports stay above the threshold."""
    fit = fitted(inputs[rows], right[rows].astype(float), weights[rows])
    least = float(odds(np.array(threshold)))
    after = np.sort(inputs[rows & right] @ fit[:2])[::-1]
    many = int(KEPT * np.count_nonzero(inputs[rows & right, 0] >= least))
    return fit, least - float(after[max(many, 1) - 1])


def balanced(reports: Sequence[Report]) -> np.ndarray:
    """(N,) weights by which no set's right or false reports outweigh the others'."""
    kinds = [(each.place, each.is_right) for each in reports]
    return np.array([min(1.0, MOST_OF_A_SET / kinds.count(each)) for each in kinds])


def mean_odds(reports: Sequence[Report]) -> np.ndarray:
    """(N,) the mean log-odds of the looks, bounded as `second_look_sheets` bounds them."""
    scores = np.clip(np.stack([each.again for each in reports]), 1e-3, 1 - 1e-3)
    return np.asarray(np.log(scores / (1 - scores)).mean(1))


if __name__ == "__main__":
    main()
