"""Weights of people's second look: benchmarks/fit_second_look.py DATA OUT --model FILE --scenes DIR --things DIR

The model searches development pictures, without a second look. What it reports is cut out and shown to another model
(--by), its longer side LOOK_PX long. A logistic regression of the report's own log-odds and the other's states how
likely the report is right; each set is judged by weights that did not see it. The threshold is the least of THRESHOLDS
at which photos of each real ground have at most ALARMS false reports each.

Development pictures: real ground (the flights `caliterra` to its 46th photo and `fixed_wing`, without people, and
`brighton_beach`, whose people are in brighton_people.json; the second painted over as well), tinyperson's and hituav's
validation parts (the latter black hot and tinted: real people from above, which the head for people learnt only of
other flights), and people and things of rendered_people.py (DIR: scenes of seeds that no shipped model learnt from) on
`fixed_wing`. No set that detection_data.py holds out. Writes OUT/reports.npz, read again where it is there, and
OUT/second_look.json, which pack_second_look.py takes.
"""

import argparse
import json
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from detection_data import hituav, tinyperson
from fit_people import nobody
from own_scale import own_scale
from pack_opinion import LOOK_PX
from painted_grounds import painted_ground
from people_samples import Source, ground, shown
from provenance import commit
from rendered_people import Scene, read_scenes
from sorvolo.detection.contract import SecondLook
from sorvolo.detection.detector import Detector
from sorvolo.detection.models import find_model
from sorvolo.detection.second_look import SheetSettings, opinions
from sorvolo.detection.session import Seen, Session
from sorvolo.geometry.arrays import ImageRGB
from sorvolo.geometry.box_overlap import cover_matrix, iou_matrix
from sorvolo.lab.training.samples import Share
from sorvolo.survey.labels import LabelledPicture, LabelledSet
from train_default_model import reader
from train_judge import RIGHT_IOU, UNSURE_IOU, fitted

PERSON, THERMAL = 0, "hituav"
LEAST, POSITIONS = 0.3, 2
PEOPLE = Path(__file__).parent / "brighton_people.json"
RENDERED, PAINTED, FRAMES, SIDE_PX, SEED = 60, 15, 60, 640, 5
THRESHOLDS, ALARMS = (
    (0.5, 0.55, 0.6, 0.65, 0.7, 0.75, 0.8, 0.85, 0.9),
    0.12,
)  # 2 of brighton_beach's 18 photos
BARE = ("caliterra", "fixed_wing", "brighton_beach")
TINT = (8, 0, -8)  # levels
MOST_CUTS, MOST_OF_A_SET = (
    160,
    60,
)  # right reports, and false ones, of a set count as so many at most
ALOFT = "IMG_9364.jpg"  # before it the ground is nearer and shows the crew


class Report(NamedTuple):
    """A report of a development picture: its set and picture, its score and the other look's, and if it is right."""

    place: str
    picture: str
    score: float
    again: float
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
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--model", default="default")
    parser.add_argument(
        "--by", default="second-opinion", help="who looks a second time; '' for the same model"
    )
    parser.add_argument("--scenes", type=Path, required=True, help="people and things")
    parser.add_argument(
        "--things", type=Path, required=True, help="scenes of which only the things are laid"
    )
    wishes = parser.parse_args()
    wishes.out.mkdir(parents=True, exist_ok=True)
    path = wishes.out / "reports.npz"
    if not path.is_file():
        collected(wishes, path)
    with np.load(path) as file:
        photos = json.loads(str(file["photos"]))
        columns = [file[name] for name in Report._fields]
    reports = [Report(*row) for row in zip(*columns)]
    found = {"commit": commit(), "person": fit_of(reports, photos) | {"by": wishes.by}}
    (wishes.out / "second_look.json").write_text(json.dumps(found, indent=1) + "\n")
    print(json.dumps(found, indent=1), flush=True)


def collected(wishes: argparse.Namespace, path: Path) -> None:
    """Search all development pictures by the model without a second look, and write what it reports."""
    session = Session(find_model(wishes.model), "cpu", 1)
    session.info = own_scale(session.info, second_look={}, pyramid={})
    by = Session(find_model(wishes.by), "cpu", 1) if wishes.by else session
    reports: list[Report] = []
    photos: Counter[str] = Counter()
    for shot in shots(wishes.data, read_scenes(wishes.scenes), read_scenes(wishes.things)):
        if not photos[shot.place]:
            print(shot.place, len(reports), flush=True)
        photos[shot.place] += 1
        reports += reported(Detector(session), by, shot)
    columns = {name: np.array([getattr(each, name) for each in reports]) for name in Report._fields}
    np.savez(path, photos=json.dumps(photos), **columns)


def shots(data: Path, scenes: list[Scene], things: list[Scene]) -> Iterator[Shot]:
    """All development pictures."""
    read = reader()
    flight = ground(data, "fixed_wing")
    plan: list[tuple[LabelledSet, int, tuple[float, ...], float | None]] = [
        (ground(data, "caliterra", ALOFT, "IMG_9399.jpg"), 2, (1.0,), 0.035),
        (flight, 2, (1.0, 1.5), None),
        (with_people(ground(data, "brighton_beach")), 1, (1.0,), 0.0172),
        (tinyperson(data)["val"], 1, (2.5,), None),
        (thermal(hituav(data)["val"], read), 1, (2.0,), None),
    ]
    for labelled, step, scales, m_per_px in plan:
        for picture in labelled.pictures[::step]:
            whole = read(picture.path)
            if labelled.name == THERMAL:
                whole = tinted(whole)
            for scale in scales:
                way = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
                image = np.ascontiguousarray(
                    cv2.resize(whole, None, fx=scale, fy=scale, interpolation=way)
                )
                truth = LabelledPicture(
                    picture.path,
                    1,
                    1,
                    picture.group,
                    picture.boxes_px * scale,
                    picture.labels,
                    picture.ignored_px * scale,
                )
                yield Shot(labelled.name, Path(picture.path).stem, image, truth, m_per_px)
    rng = np.random.default_rng(SEED)
    none = np.zeros((0, 4))
    for number in range(PAINTED):
        photo = read(flight.pictures[int(rng.integers(len(flight.pictures)))].path)
        yield Shot("painted", str(number), painted_ground(photo, rng), _nobody(none, none), None)
    source = Source(Share(flight, 1.0, (0.5, 2.0)), 1.0)
    for place, own in {
        "rendered people": scenes,
        "rendered things": [nobody(each) for each in things],
    }.items():
        for number in range(RENDERED):
            made = shown(source, own, read, SIDE_PX, rng)
            yield Shot(place, str(number), made.image, _nobody(made.boxes, made.ignored), None)


def with_people(flight: LabelledSet) -> LabelledSet:
    """The flight with its people."""
    known = json.loads(PEOPLE.read_text())

    def labelled(picture: LabelledPicture) -> LabelledPicture:
        people, around = (
            np.array(known[what].get(Path(picture.path).stem, []), np.float32).reshape(-1, 4)
            for what in ("people", "around")
        )
        return replace(
            picture, boxes_px=people, labels=np.full(len(people), PERSON), ignored_px=around
        )

    return flight.only([labelled(each) for each in flight.pictures])


def thermal(frames: LabelledSet, read: Callable[[str], ImageRGB]) -> LabelledSet:
    """Frames from the air that show people: real ones from above, of which neither network for people learnt."""
    own = [each for each in frames.pictures if np.any(each.labels == PERSON)]
    return replace(frames.only(own[:: max(1, len(own) // FRAMES)]), name=THERMAL)


def tinted(frame: ImageRGB) -> ImageRGB:
    """A thermal frame (H, W, 3) black hot and in colour, else another network would look at it."""
    return np.clip((255 - frame.astype(int)) + np.array(TINT), 0, 255).astype(np.uint8)


def _nobody(boxes: np.ndarray, ignored: np.ndarray) -> LabelledPicture:
    return LabelledPicture("", 1, 1, "", boxes, np.zeros(len(boxes), np.int64), ignored)


def reported(detector: Detector, by: Session, shot: Shot) -> Iterator[Report]:
    """What the model reports of a picture, and what the other one makes of that."""
    first = detector.detect(
        shot.image, tiles="auto", m_per_px=shot.m_per_px, classes=("person",), least_score=LEAST
    )
    seen = Seen(first.boxes_px, first.scores, first.labels)
    how = SecondLook(
        (LOOK_PX,), own=1.0, again=0.0, shift=0.0, least=LEAST, enlarged=np.inf, positions=POSITIONS
    )
    again = opinions(
        seen, shot.image, by.see, {PERSON: how}, SheetSettings(cuts=(MOST_CUTS, MOST_CUTS))
    )
    rows, right = judged_reports(
        seen.boxes_px, shot.truth.boxes_px[shot.truth.labels == PERSON], shot.truth.ignored_px
    )
    for row in rows.tolist():
        looked = (
            float(1 / (1 + np.exp(-bounded_odds(again[row]).mean()))) if row in again else np.nan
        )
        yield Report(shot.place, shot.name, float(seen.scores[row]), looked, bool(right[row]))


def judged_reports(
    boxes_px: np.ndarray, people_px: np.ndarray, ignored_px: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the reports (N, 4), best first, of which it is known whether they are right; (N,) which are."""
    hidden = cover_matrix(boxes_px, ignored_px).max(1, initial=0) > 0.5
    overlaps = iou_matrix(boxes_px, people_px)
    right, unsure, taken = np.zeros(len(boxes_px), bool), np.zeros(len(boxes_px), bool), set()
    for row in range(len(boxes_px)):
        best = overlaps[row].max(initial=0)
        right[row] = best >= RIGHT_IOU and int(overlaps[row].argmax()) not in taken
        if right[row]:
            taken.add(int(overlaps[row].argmax()))
        unsure[row] = not right[row] and (best > UNSURE_IOU or hidden[row])
    return np.flatnonzero(~unsure), right


def fit_of(reports: Sequence[Report], photos: Mapping[str, int]) -> dict[str, Any]:
    """Weights and threshold, and what every set keeps at the thresholds by weights that did not see that set."""
    own = bounded_odds(np.minimum([each.score for each in reports], SheetSettings().surest))
    again = bounded_odds(np.array([each.again for each in reports]))
    right, places = (
        np.array([each.is_right for each in reports]),
        np.array([each.place for each in reports]),
    )
    inputs, counts = np.column_stack([own, again]), balanced(places, right, MOST_OF_A_SET)
    crossed = np.zeros(len(reports))
    for place in photos:
        mine = places == place
        fit = fitted(inputs[~mine], right[~mine].astype(float), counts[~mine])
        crossed[mine] = 1 / (1 + np.exp(-(inputs[mine] @ fit[:2] + fit[2])))
    fit = fitted(inputs, right.astype(float), counts)

    def above(place: str, threshold: float) -> list[int]:
        mine = (places == place) & (crossed >= threshold)
        return [int(np.count_nonzero(mine & right)), int(np.count_nonzero(mine & ~right))]

    quiet = [
        each
        for each in THRESHOLDS
        if all(above(place, each)[1] <= ALARMS * photos[place] for place in BARE)
    ]
    weights = {
        "own": fit[0],
        "again": fit[1],
        "shift": fit[2],
        "least": LEAST,
        "enlarged": 1000.0,
        "threshold": min(quiet, default=max(THRESHOLDS)),
    }
    return {
        "looks_px": [LOOK_PX],
        "positions": POSITIONS,
        **{name: round(float(each), 3) for name, each in weights.items()},
        "reports": len(reports),
        "photos": dict(photos),
        "right_and_false": {
            str(each): {place: above(place, each) for place in photos} for each in THRESHOLDS
        },
    }


def bounded_odds(scores: np.ndarray) -> np.ndarray:
    """Log-odds, bounded as `second_look` bounds them."""
    inside = np.nan_to_num(np.clip(scores, 1e-3, 1 - 1e-3), nan=0.5)
    return np.asarray(np.log(inside / (1 - inside)))


def balanced(places: np.ndarray, right: np.ndarray, most: int) -> np.ndarray:
    """(N,) weights by which no set's right reports, nor its false ones, count for more than `most`."""
    weights = np.zeros(len(places))
    for place in set(places.tolist()):
        for kind in (False, True):
            own = (places == place) & (right == kind)
            weights[own] = min(1.0, most / max(1, np.count_nonzero(own)))
    return weights


if __name__ == "__main__":
    main()
