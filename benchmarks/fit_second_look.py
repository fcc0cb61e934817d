"""Weights of people's second look: benchmarks/fit_second_look.py DATA OUT --scenes DIR --things DIR

The packaged model (--model) searches development pictures. What it reports is cut out and looked at again at LOOKS_PX.
A logistic regression of the report's own log-odds and the mean of the looks' says how likely the report is right; its
shift is then moved until as many right reports as before, no set counting for more than MOST_OF_A_SET, lie above the
model's threshold: all that is gained goes into fewer false alarms. Which looks and from which score on (TRIED) was
chosen on these pictures, each set judged by weights that did not see it.

Development pictures: real ground without people (the flights `caliterra` to its 46th photo and `fixed_wing`, as they
are and painted over), the training parts of tinyperson, mannequin and hituav (its frames black hot and tinted: real
people from above), and people and things of rendered_people.py (DIR: scenes of seeds that no shipped model learnt
from) on both flights. Neither photos of brighton_beach nor any set that detection_data.py holds out.

Decision 0049: people and things are `rendered_people.py --scenes 24 --seed 2` and `--scenes 30 --seed 3`. Writes
OUT/reports.npz, read again where it is there, and OUT/second_look.json, which pack_second_look.py takes.
"""

import argparse
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from detection_data import hituav, mannequin, tinyperson
from fit_people import nobody
from painted_grounds import painted_ground
from people_samples import Source, ground, shown
from rendered_people import Scene, read_scenes
from sorvolo.detection.contract import SecondLook
from sorvolo.detection.detector import Detector
from sorvolo.detection.models import find_model
from sorvolo.detection.second_look import SheetSettings, opinions
from sorvolo.detection.session import Seen, Session
from sorvolo.geometry.arrays import ImageRGB
from sorvolo.geometry.box_overlap import cover_matrix, iou_matrix
from sorvolo.survey.labels import LabelledPicture, LabelledSet
from sorvolo.training.samples import Share
from train_default_model import reader
from train_judge import RIGHT_IOU, UNSURE_IOU, fitted, odds

PERSON, THERMAL = 0, "hituav"
LOOKS_PX, SEEN, LEAST = (34.0, 68.0), 0.05, 0.3
RENDERED, PAINTED, FRAMES, SIDE_PX, SEED = 60, 15, 60, 640, 5
TINT = (8, 0, -8)  # levels
MOST_CUTS, MOST_OF_A_SET = 160, 60  # right reports, and false ones, of a set count as so many at most
TRIED = {  # looks, how much larger one may show a report
    "34 px": ((34.0,), np.inf), "68 px": ((68.0,), np.inf), "34 and 68 px": ((34.0, 68.0), np.inf),
    "34 px, 68 if no larger": ((34.0, 68.0), 1.0), "34 px, 68 if 1.5 times as large at most": ((34.0, 68.0), 1.5),
    "34 px, 68 if 2 times as large at most": ((34.0, 68.0), 2.0),
}
TRIED_LEAST = (0.3, 0.4, 0.5, 0.6, 0.7)
CHOSEN, CHOSEN_LEAST = "34 px, 68 if 1.5 times as large at most", 0.5  # decision 0049
ALOFT = "IMG_9364.jpg"  # before it the ground is nearer and shows the crew


class Report(NamedTuple):
    """A report of a development picture: its set and picture, its score and the looks', and if it is right."""

    place: str
    picture: str
    score: float
    side_px: float  # its longer side
    again: np.ndarray  # (looks,)
    is_right: bool


@dataclass(frozen=True, eq=False)
class Shot:
    """A picture (H, W, 3) with its labels (LabelledPicture) and its people labelled."""

    place: str
    name: str
    image: ImageRGB
    truth: LabelledPicture
    m_per_px: float | None = None


def main() -> None:
    """Look where that was not done yet, fit, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--model", default="default-int8")
    parser.add_argument("--scenes", type=Path, required=True, help="people and things")
    parser.add_argument("--things", type=Path, required=True, help="scenes of which only the things are laid")
    wishes = parser.parse_args()
    wishes.out.mkdir(parents=True, exist_ok=True)
    path = wishes.out / "reports.npz"
    if not path.is_file():
        collected(wishes, path)
    with np.load(path) as file:
        columns = [file[name] for name in Report._fields]
    reports = [Report(*row) for row in zip(*columns)]
    threshold = Detector.load(wishes.model, provider="cpu", threads=1).info.thresholds["person"]
    trials = {
        f"{name}, from {least}": fit_of(reports, *how, least, threshold)["crossed_all"]
        for name, how in TRIED.items() for least in TRIED_LEAST
    }
    chosen = fit_of(reports, *TRIED[CHOSEN], CHOSEN_LEAST, threshold)
    found = {"person": chosen, "trials": trials}
    (wishes.out / "second_look.json").write_text(json.dumps(found, indent=1) + "\n")
    print(json.dumps(found, indent=1), flush=True)


def collected(wishes: argparse.Namespace, path: Path) -> None:
    """Search all development pictures by the model without a second look, and write what it reports."""
    session = Session(find_model(wishes.model), "cpu", 1)
    session.info = replace(session.info, second_look={})
    reports: list[Report] = []
    for shot in shots(wishes.data, read_scenes(wishes.scenes), read_scenes(wishes.things)):
        if not reports or reports[-1].place != shot.place:
            print(shot.place, len(reports), flush=True)
        reports += reported(Detector(session), session, shot)
    np.savez(path, **{name: np.array([getattr(each, name) for each in reports]) for name in Report._fields})


def shots(data: Path, scenes: list[Scene], things: list[Scene]) -> Iterator[Shot]:
    """All development pictures."""
    read = reader()
    flights = ground(data, "fixed_wing"), ground(data, "caliterra", ALOFT, "IMG_9399.jpg")
    plan: list[tuple[LabelledSet, int, tuple[float, ...], float | None]] = [
        (flights[1], 2, (1.0,), 0.035),
        (flights[0], 2, (1.0, 1.5), None),
        (tinyperson(data)["train"], 3, (2.0,), None),
        (mannequin(data)["train"], 6, (0.6, 1.0), None),
        (thermal(hituav(data)["train"], read), 1, (2.0,), None),
    ]
    for labelled, step, scales, m_per_px in plan:
        for picture in labelled.pictures[::step]:
            whole = read(picture.path)
            if labelled.name == THERMAL:
                whole = tinted(whole)
            for scale in scales:
                way = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
                image = np.ascontiguousarray(cv2.resize(whole, None, fx=scale, fy=scale, interpolation=way))
                truth = LabelledPicture(
                    picture.path, 1, 1, picture.group, picture.boxes_px * scale, picture.labels,
                    picture.ignored_px * scale,
                )
                yield Shot(labelled.name, Path(picture.path).stem, image, truth, m_per_px)
    rng = np.random.default_rng(SEED)
    none = np.zeros((0, 4))
    for flight in flights:
        for number in range(PAINTED):
            photo = read(flight.pictures[int(rng.integers(len(flight.pictures)))].path)
            yield Shot("painted", f"{flight.name}-{number}", painted_ground(photo, rng), _nobody(none, none), None)
        source = Source(Share(flight, 1.0, (0.5, 2.0)), 1.0)
        kinds = {"rendered people": scenes, "rendered things": [nobody(each) for each in things]}
        for place, own in kinds.items():
            for number in range(RENDERED):
                made = shown(source, own, read, SIDE_PX, rng)
                yield Shot(
                    f"{place}, {flight.name}", str(number), made.image, _nobody(made.boxes, made.ignored), None
                )


def thermal(frames: LabelledSet, read: Callable[[str], ImageRGB]) -> LabelledSet:
    """Frames from the air that show people: real ones from above, of which neither network for people learnt."""
    own = [each for each in frames.pictures if np.any(each.labels == PERSON)]
    return replace(frames.only(own[:: max(1, len(own) // FRAMES)]), name=THERMAL)


def tinted(frame: ImageRGB) -> ImageRGB:
    """A thermal frame (H, W, 3) black hot and in colour, else another network would look at it."""
    return np.clip((255 - frame.astype(int)) + np.array(TINT), 0, 255).astype(np.uint8)


def _nobody(boxes: np.ndarray, ignored: np.ndarray) -> LabelledPicture:
    return LabelledPicture("", 1, 1, "", boxes, np.zeros(len(boxes), np.int64), ignored)


def reported(detector: Detector, session: Session, shot: Shot) -> Iterator[Report]:
    """What the model reports of a picture, and how that looks again."""
    first = detector.detect(
        shot.image, tiles="auto", m_per_px=shot.m_per_px, classes=("person",), least_score=SEEN
    )
    seen = Seen(first.boxes_px, first.scores, first.labels)
    how = SecondLook(LOOKS_PX, own=1.0, again=0.0, shift=0.0, least=LEAST, enlarged=np.inf)
    again = opinions(seen, shot.image, session.see, {PERSON: how}, SheetSettings(cuts=(MOST_CUTS, MOST_CUTS)))
    hidden = cover_matrix(seen.boxes_px, shot.truth.ignored_px).max(1, initial=0) > 0.5
    own = shot.truth.boxes_px[shot.truth.labels == PERSON]
    taken: set[int] = set()
    for row, score in enumerate(seen.scores.tolist()):
        overlaps = iou_matrix(seen.boxes_px[row : row + 1], own)[0]
        best = float(overlaps.max(initial=0))
        is_right = best >= RIGHT_IOU and (nearest := int(overlaps.argmax())) not in taken
        if is_right:
            taken.add(nearest)
        if is_right or (best <= UNSURE_IOU and not hidden[row]):
            side_px = float(max(seen.boxes_px[row, 2:] - seen.boxes_px[row, :2]))
            looks = again.get(row, np.full(len(LOOKS_PX), np.nan))
            yield Report(shot.place, shot.name, score, side_px, looks, is_right)


def fit_of(
    reports: Sequence[Report], looks_px: tuple[float, ...], enlarged: float, least: float, threshold: float
) -> dict[str, Any]:
    """Weights, and what every set keeps at the threshold by weights that did not see that set."""
    scores, again = np.array([each.score for each in reports]), mean_odds(reports, looks_px, enlarged)
    right, places = np.array([each.is_right for each in reports]), np.array([each.place for each in reports])
    inputs = np.column_stack([bounded_odds(scores), again])
    rows, before = scores >= least, scores >= threshold
    counts = np.zeros(len(reports))
    counts[rows] = balanced(places[rows], right[rows])

    def seen_again(learnt: np.ndarray, judged: np.ndarray) -> np.ndarray:
        fit = fitted(inputs[learnt], right[learnt].astype(float), counts[learnt])
        return np.asarray(inputs[judged] @ fit[:2] + fit[2])

    crossed = np.full(len(reports), -np.inf)
    for place in set(places.tolist()):
        crossed[rows & (places == place)] = seen_again(rows & (places != place), rows & (places == place))
    after = crossed >= kept_from(crossed, counts * right, before)
    fit = fitted(inputs[rows], right[rows].astype(float), counts[rows])
    all_odds = np.where(rows, inputs @ fit[:2] + fit[2], -np.inf)
    shift = fit[2] + float(odds(np.array(threshold))) - kept_from(all_odds, counts * right, before)
    weights = {"own": fit[0], "again": fit[1], "shift": shift, "least": least, "enlarged": min(enlarged, 1000.0)}
    return {
        "looks_px": list(looks_px), **{name: round(float(each), 3) for name, each in weights.items()},
        "threshold": threshold, "reports": int(np.count_nonzero(rows)),
        "crossed_all": {
            name: [round(float(counts[each & kind].sum()), 1) for each in (before, after)]
            for name, kind in (("right", right), ("false", ~right))
        },
        "crossed": {
            str(place): {
                name: [int(np.count_nonzero(each & kind & (places == place))) for each in (before, after)]
                for name, kind in (("right", right), ("false", ~right))
            }
            for place in dict.fromkeys(places.tolist())
        },
    }


def mean_odds(reports: Sequence[Report], looks_px: tuple[float, ...], enlarged: float) -> np.ndarray:
    """(N,) the mean log-odds of the looks that each report would get."""
    how = SecondLook(looks_px, own=1.0, again=0.0, shift=0.0, least=LEAST, enlarged=enlarged)
    own = np.array([[side_px in how.sides_px(each.side_px) for side_px in LOOKS_PX] for each in reports])
    return np.asarray(np.average(bounded_odds(np.stack([each.again for each in reports])), axis=1, weights=own))


def kept_from(after: np.ndarray, counts: np.ndarray, before: np.ndarray) -> float:
    """From which log-odds on as many (by `counts`) are reported as `before` (N,) were."""
    order = np.argsort(-after, kind="stable")
    enough = np.searchsorted(np.cumsum(counts[order]), counts[before].sum() - 1e-9)
    return float(after[order[enough]])


def bounded_odds(scores: np.ndarray) -> np.ndarray:
    """Log-odds, bounded as `second_look` bounds them."""
    inside = np.nan_to_num(np.clip(scores, 1e-3, 1 - 1e-3), nan=0.5)
    return np.asarray(np.log(inside / (1 - inside)))


def balanced(places: np.ndarray, right: np.ndarray) -> np.ndarray:
    """(N,) weights by which no set's right or false reports outweigh the others'."""
    weights = np.zeros(len(places))
    for place in set(places.tolist()):
        for kind in (False, True):
            own = (places == place) & (right == kind)
            weights[own] = min(1.0, MOST_OF_A_SET / max(1, np.count_nonzero(own)))
    return weights


if __name__ == "__main__":
    main()
