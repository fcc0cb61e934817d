"""What searching a picture in several sizes changes: benchmarks/pyramid.py DATA --scenes DIR --things DIR

Decision 0084. Development pictures of fit_second_look.py (DIR: its scenes), shown as large as BASES names, as if their
scale were not known; and, for cars, every tenth picture of the videos of `cats` that are not held out. Each is searched
at every one of SIZES without a second look. Written are AP50 of each size alone and of pyramids of some of them
(SETTINGS: sizes, `known_px`, `octaves`); and, with the second look, what the model reports at its threshold, right
and false, at one size and by its pyramid. No set that detection_data.py holds out, but for `cats`' other videos.
Writes results/pyramid.json.
"""

import argparse
import json
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from detection_data import cats
from fit_second_look import PERSON, THERMAL, Shot, shots
from pack_pyramid import DAYLIGHT as PACKED
from provenance import commit, machine
from rendered_people import read_scenes
from second_look import Looker
from sorvolo.detection.contract import Pyramid
from sorvolo.detection.pyramid import agreed_in_sizes
from sorvolo.detection.session import Seen
from sorvolo.geometry.arrays import ImageRGB
from sorvolo.lab.evaluation.detection_scores import score_set
from sorvolo.store.exports.plain import plain_json
from sorvolo.survey.labels import LabelledPicture, LabelledSet
from sorvolo.survey.objects import Detections
from train_default_model import CLASSES, reader

RESULTS = Path(__file__).parent / "results" / "pyramid.json"
CAR, LEAST, MOST_PX = 1, 0.02, 6_600_000
BASES: Mapping[str, tuple[float, ...]] = {
    THERMAL: (0.5, 1.0),
    "tinyperson": (0.4,),
    "rendered people": (0.5, 1.0),
    "rendered things": (0.5, 1.0),
    "fixed_wing": (1.0,),
    "painted": (1.0,),
    "brighton_beach": (0.5,),
    "caliterra": (0.5,),
    "cats": (1.0,),
}
SIZES = (0.5, 0.75, 1.0, 1.5, 2.0, 3.0)
SETTINGS = (
    *(
        (sizes, 32, 1.0)
        for sizes in ((1.0, 1.5), (1.0, 1.5, 2.0), (1.0, 1.5, 2.0, 3.0), (0.5, 0.75, 1.0))
    ),
    *((SIZES, known_px, octaves) for known_px in (24, 32, 44) for octaves in (0.7, 1.0, 1.5)),
)
EVERY = 4  # HIT-UAV has many frames: those whose number this divides


@dataclass(frozen=True, eq=False)
class Searched:
    """A picture's set with its size, its labels, what was seen at each size, and the reports with a second look."""

    place: str
    truth: LabelledPicture
    seen: Mapping[float, Seen]
    reports: Mapping[str, Seen]


def main() -> None:
    """Search, put together, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", type=Path, help="the folder of the labelled sets")
    parser.add_argument("--model", default="default")
    parser.add_argument("--scenes", type=Path, required=True, help="people and things")
    parser.add_argument(
        "--things", type=Path, required=True, help="scenes of which only the things are laid"
    )
    parser.add_argument("--results", type=Path, default=RESULTS)
    wishes = parser.parse_args()
    looker = Looker(wishes.model)
    by_place: dict[str, list[Searched]] = {}
    for shot in (
        *shots(wishes.data, read_scenes(wishes.scenes), read_scenes(wishes.things)),
        *streets(wishes.data),
    ):
        for each in searched(looker, shot):
            if each.place not in by_place:
                print(each.place, flush=True)
            by_place.setdefault(each.place, []).append(each)
    thresholds = looker.whole.info.thresholds
    rows = {
        place: sizes_of(each) | {"reported": reported(each, thresholds)}
        for place, each in by_place.items()
    }
    wishes.results.write_text(
        json.dumps(
            plain_json(
                {
                    "benchmark": "pyramid",
                    "machine": machine(),
                    "commit": commit(),
                    "date": time.strftime("%Y-%m-%d"),
                    "model": wishes.model,
                    "version": looker.whole.info.version,
                    "packed": PACKED,
                    "sets": rows,
                }
            ),
            indent=1,
        )
        + "\n"
    )


def streets(data: Path) -> Iterator[Shot]:
    """Pictures of streets from above, for cars."""
    read = reader()
    for each in cats(data)["train"].pictures[::10]:
        yield Shot("cats", each.path, read(each.path), each)


def searched(looker: Looker, shot: Shot) -> Iterator[Searched]:
    """A picture in each of its bases, searched in all sizes."""
    if shot.place == THERMAL and int(shot.name[-4:]) % EVERY:
        return
    label = CAR if shot.place == "cats" else PERSON
    for base in BASES[shot.place]:
        picture = resized(shot.image, base)
        seen = {size: first_look(looker, picture, size) for size in SIZES if fits(picture, size)}
        truth = LabelledPicture(
            shot.name,
            picture.shape[1],
            picture.shape[0],
            shot.truth.group,
            shot.truth.boxes_px * base,
            shot.truth.labels,
            shot.truth.ignored_px * base,
        )
        sizes = (1.0, *PACKED["times"])
        packed = pyramid_of(
            sizes, seen, label, PACKED["known_px"], PACKED["octaves"], PACKED["shift"]
        )
        reports = {"one size": only(seen[1.0], label), "pyramid": packed}
        again = {
            name: looker.whole._seen_again(looker.whole._session, picture, each, (CLASSES[label],))
            for name, each in reports.items()
        }
        yield Searched(f"{shot.place}, {base}", truth, seen, again)


def resized(picture: ImageRGB, times: float) -> ImageRGB:
    """The picture so many times as large."""
    way = cv2.INTER_AREA if times < 1 else cv2.INTER_LINEAR
    shown = (
        picture if times == 1 else cv2.resize(picture, None, fx=times, fy=times, interpolation=way)
    )
    return np.ascontiguousarray(shown, np.uint8)


def fits(picture: ImageRGB, size: float) -> bool:
    """Whether the picture is searched at this size."""
    return size <= 1 or picture.shape[0] * picture.shape[1] * size**2 <= MOST_PX


def first_look(looker: Looker, picture: ImageRGB, size: float) -> Seen:
    """What is seen in a picture shown so many times as large, in its own pixels."""
    found = looker.detector.detect(resized(picture, size), classes=CLASSES[:2], least_score=LEAST)
    return Seen(found.boxes_px / np.float32(size), found.scores, found.labels)


def only(seen: Seen, label: int) -> Seen:
    """What is of one class."""
    mine = seen.labels == label
    return Seen(seen.boxes_px[mine], seen.scores[mine], seen.labels[mine])


def pyramid_of(
    sizes: Sequence[float],
    seen: Mapping[float, Seen],
    label: int,
    known_px: float,
    octaves: float,
    shift: float = 0.0,
) -> Seen:
    """What the looks in these sizes agree on."""
    there = [size for size in sizes if size in seen]
    return agreed_in_sizes(
        [seen[size] for size in there],
        there,
        label,
        Pyramid(tuple(sizes), float(known_px), float(octaves), shift),
    )


def sizes_of(pictures: Sequence[Searched]) -> dict[str, object]:
    """AP50 of each size alone and of each pyramid."""
    label = CAR if pictures[0].place.startswith("cats") else PERSON
    labels = sum(int(np.count_nonzero(each.truth.labels == label)) for each in pictures)
    rows: dict[str, object] = {"pictures": len(pictures), "labels": labels, "class": CLASSES[label]}
    if not labels:
        return rows
    every = [size for size in SIZES if all(size in each.seen for each in pictures)]
    rows["alone"] = {
        str(size): accuracy(pictures, [only(each.seen[size], label) for each in pictures], label)
        for size in every
    }
    rows["pyramids"] = [
        {"sizes": sizes, "known_px": known_px, "octaves": octaves}
        | accuracy(
            pictures,
            [pyramid_of(sizes, each.seen, label, known_px, octaves) for each in pictures],
            label,
        )
        for sizes, known_px, octaves in SETTINGS
    ]
    return rows


def accuracy(pictures: Sequence[Searched], found: Sequence[Seen], label: int) -> dict[str, float]:
    """AP50 and AP of a class, percent."""
    scores = score_set(
        as_set(pictures), as_detections(found), CLASSES, dict.fromkeys(CLASSES, 0.5), draws=1
    )
    row = next(each for each in scores.classes if each.label == CLASSES[label])
    return {"AP50": round(100 * row.coco.ap50, 1), "AP": round(100 * row.coco.ap, 1)}


def reported(pictures: Sequence[Searched], thresholds: Mapping[str, float]) -> dict[str, object]:
    """Reports at the model's threshold, right and false, at one size and by the pyramid; AP50 after the second look."""
    label = CAR if pictures[0].place.startswith("cats") else PERSON
    rows: dict[str, object] = {}
    for name in pictures[0].reports:
        found = [each.reports[name] for each in pictures]
        count = sum(
            int(np.count_nonzero(each.scores >= thresholds[CLASSES[label]])) for each in found
        )
        rows[name] = {"reports": count}
        if any((each.truth.labels == label).any() for each in pictures):
            scores = score_set(as_set(pictures), as_detections(found), CLASSES, thresholds, draws=1)
            row = next(each for each in scores.classes if each.label == CLASSES[label])
            rows[name] = accuracy(pictures, found, label) | {
                "found": round(100 * row.reported.recall, 1),
                "right": round(100 * row.reported.precision, 1),
            }
    return rows


def as_set(pictures: Sequence[Searched]) -> LabelledSet:
    """The pictures as a labelled set."""
    return LabelledSet(
        pictures[0].place,
        CLASSES,
        tuple(replace(each.truth, path=str(row)) for row, each in enumerate(pictures)),
        frozenset({CLASSES[2]}),
    )


def as_detections(found: Sequence[Seen]) -> list[Detections]:
    """What was seen, as the scores take it."""
    return [Detections(each.boxes_px, each.scores, each.labels, CLASSES) for each in found]


if __name__ == "__main__":
    main()
