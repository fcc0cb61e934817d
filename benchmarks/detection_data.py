"""How each labelled set is read, and which of its pictures are held out: the packaged models learnt from the rest.

Split by flight, by video, or (HIT-UAV, whose neighbouring frames are near-duplicates) by blocks of consecutive ids.
"""

import re
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from sorvolo.lab.datasets import read_dataset
from sorvolo.survey.labels import LabelledPicture, LabelledSet
from sorvolo.survey.objects import CLASSES

SMALL = CLASSES[2]
HITUAV_BLOCKS, HITUAV_HELD_OUT, HITUAV_VALIDATION, HITUAV_GAP = 20, (3, 8, 13, 18), (6,), 10
AERIAL_HELD_OUT = ("DJI-00760", "DJI_0762")
TINYPERSON_HELD_OUT = ("bb_V0014", "bb_V0031", "bb_V0018", "chitube_V0006", "bb_V0002", "bb_V0028")
TINYPERSON_VALIDATION = ("bb_V0025", "bb_V0008")
CATS_HELD_OUT = ("1", "4")
_OWN_CARS = re.compile(r"DJI[-_]\d")  # names of what the publisher of aerial_cars took or was given
_TINYPERSON_LARGEST_PX = 60.0  # larger boxes of that set are often regions to ignore


def hituav(data: Path) -> dict[str, LabelledSet]:
    """HIT-UAV's thermal frames as "train", "val" and "test"; bicycles and other vehicles are ignored."""
    whole = read_dataset(
        data / "hituav",
        classes={"Person": "person", "Car": "car"},
        ignore=("Bicycle", "OtherVehicle", "DontCare"),
    )
    whole = in_order(whole)
    ids = np.array([int(re.findall(r"\d+", Path(each.path).stem)[-1]) for each in whole.pictures])
    pictures = [whole.pictures[index] for index in np.argsort(ids, kind="stable")]
    ids = np.sort(ids)
    parts: dict[str, list[LabelledPicture]] = {"train": [], "val": [], "test": []}
    blocks = np.array_split(np.arange(len(pictures)), HITUAV_BLOCKS)
    part_of = {
        index: "test"
        if index in HITUAV_HELD_OUT
        else "val"
        if index in HITUAV_VALIDATION
        else "train"
        for index in range(HITUAV_BLOCKS)
    }
    for index, block in enumerate(blocks):
        own = part_of[index]
        for row in block:
            others = [
                other
                for other in (index - 1, index + 1)
                if 0 <= other < HITUAV_BLOCKS and part_of[other] != own and own != "test"
            ]
            if any(np.abs(ids[blocks[other]] - ids[row]).min() <= HITUAV_GAP for other in others):
                continue
            parts[own].append(pictures[row])
    return {name: whole.only(each) for name, each in parts.items()}


def tinyperson(data: Path) -> dict[str, LabelledSet]:
    """TinyPerson's beaches by video; boxes that are too large to be one person are ignored."""
    whole = in_order(read_dataset(data / "tinyperson", classes={"person": "person"}))
    pictures = []
    for each in whole.pictures:
        large = (
            np.max(each.boxes_px[:, 2:] - each.boxes_px[:, :2], axis=1, initial=0)
            > _TINYPERSON_LARGEST_PX
        )
        pictures.append(
            replace(
                each,
                boxes_px=each.boxes_px[~large],
                labels=each.labels[~large],
                ignored_px=np.vstack([each.ignored_px, each.boxes_px[large]]),
            )
        )
    return _by_name(whole.only(pictures), TINYPERSON_HELD_OUT, TINYPERSON_VALIDATION)


def aerial_cars(data: Path) -> dict[str, LabelledSet]:
    """Cars from above by flight; people may be in the pictures without a label.

    Only the publisher's own pictures: harlem-* and others are of videos and sets under other licences, harlem-* under
    YouTube's, and no part of them may be learnt from.
    """
    whole = in_order(
        read_dataset(
            data / "aerial_cars",
            classes={"car": "car", "minibus": "car"},
            ignore=("truck", "bus", "cyclist"),
            unlabelled=("person", SMALL),
        )
    )
    own = [each for each in whole.pictures if _OWN_CARS.match(Path(each.path).name)]
    return _by_name(whole.only(own), AERIAL_HELD_OUT, ())


def cats(data: Path) -> dict[str, LabelledSet]:
    """A street from above by video; research only, so never part of the default model's training."""
    names = {each: "car" for each in ("0", "vehicle", "car")}
    whole = in_order(read_dataset(data / "cats", classes=names, unlabelled=("person", SMALL)))
    return _by_name(whole, CATS_HELD_OUT, ())


def sdd(data: Path) -> dict[str, LabelledSet]:
    """Stanford Drone Dataset, non-commercial: only to measure."""
    whole = read_dataset(
        data / "sdd",
        classes={"person": "person", "pedestrian": "person", "car": "car"},
        ignore=("biker", "cart", "skater", "bus", "bicyclist"),
        unlabelled=(SMALL,),
    )
    return {"test": in_order(whole)}


def semantic_drone(data: Path) -> dict[str, LabelledSet]:
    """Straight down from 5 to 30 m, of which nothing was learnt or tuned (non-commercial): only to measure."""
    whole = read_dataset(
        data / "semantic_drone",
        classes={"person": "person", "car": "car"},
        ignore=("bicycle", "dog"),
        unlabelled=(SMALL,),
    )
    return {"test": in_order(whole)}


def in_order(labelled: LabelledSet) -> LabelledSet:
    """The set with Sorvolo's own classes in their order, whatever order it was read with."""
    to_own = np.array([CLASSES.index(name) for name in labelled.classes], np.int64)
    pictures = tuple(
        replace(picture, labels=to_own[picture.labels] if len(picture.labels) else picture.labels)
        for picture in labelled.pictures
    )
    return replace(labelled, classes=CLASSES, pictures=pictures)


def _by_name(whole: LabelledSet, test: Iterable[str], val: Iterable[str]) -> dict[str, LabelledSet]:
    """Parts by how the pictures' names begin, up to what is no letter or digit."""

    def begins(each: LabelledPicture, names: Iterable[str]) -> bool:
        return any(
            re.match(re.escape(name) + r"(?![A-Za-z0-9])", Path(each.path).name) for name in names
        )

    held = [each for each in whole.pictures if begins(each, test)]
    checks = [each for each in whole.pictures if begins(each, val)]
    rest = [each for each in whole.pictures if not begins(each, test) and not begins(each, val)]
    return {"train": whole.only(rest), "val": whole.only(checks), "test": whole.only(held)}
