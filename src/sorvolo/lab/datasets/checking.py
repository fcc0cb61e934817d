"""Parsed labels made into records: our classes, boxes within the picture, groups; what is wrong is counted."""

import re
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sorvolo.errors import InputError
from sorvolo.geometry.arrays import Floats
from sorvolo.lab.datasets.parsed import (
    SHARES,
    LabelFinding,
    ParsedPicture,
    ParsedSet,
    findings_in,
    notices_of,
    shown_size_px,
)
from sorvolo.lab.datasets.splits import group_of
from sorvolo.survey.flight import Notice
from sorvolo.survey.labels import LabelledPicture, LabelledSet
from sorvolo.survey.objects import CLASSES

PERSON, CAR, SMALL = CLASSES

DEFAULT_CLASSES: Mapping[str, str] = {
    name: label
    for label, names in (
        (
            PERSON,
            "person, persons, people, pedestrian, pedestrians, human, humans, man, woman, child, swimmer, victim, mannequin",
        ),
        (CAR, "car, cars, vehicle, vehicles, van, minivan, minibus, suv, taxi, pickup, automobile"),
        (
            SMALL,
            "small object, small objects, box, small box, big box, suitcase, metal suitcase, bag, backpack, handbag, luggage, tire, tyre, gas bottle",
        ),
    )
    for name in names.split(", ")
}
"""Common names and the class they stand for unless the user maps them; compared as `plain` writes them."""

LOOK_ALIKES = frozenset(
    [
        "truck",
        "lorry",
        "bus",
        "othervehicle",
        "other vehicle",
        "biker",
        "bicyclist",
        "cyclist",
        "rider",
        "motorcyclist",
        "skater",
        "bicycle",
        "bike",
        "motor",
        "motorcycle",
        "motorbike",
        "scooter",
        "tricycle",
        "awning tricycle",
        "cart",
    ]
)
"""Names of what looks like a class of ours but is none: calling a truck a car, or a cyclist a person, is neither right
nor wrong."""

DEFAULT_IGNORED = LOOK_ALIKES | {
    "ignored regions",
    "ignored",
    "ignore",
    "dontcare",
    "dont care",
    "others",
    "crowd",
}
"""Names that become regions where nothing counts: look-alikes, and what a set ignores itself."""


def plain(name: str) -> str:
    """A name for comparison: lower case, single spaces for any of space, underscore and hyphen."""
    return " ".join(name.lower().replace("_", " ").replace("-", " ").replace("'", "").split())


@dataclass(frozen=True)
class Naming:
    """`targets` gives our class of a plain name, `ignored` holds the plain names that become ignored regions."""

    targets: Mapping[str, str]
    ignored: frozenset[str]

    def classes(self, names: Iterable[str]) -> tuple[str, ...]:
        """Our classes that these names of the set stand for: the usual ones first, in the order of `CLASSES`."""
        found = {self.targets[plain(name)] for name in names if self.is_target(name)}
        usual = [each for each in CLASSES if each in found]
        return (*usual, *sorted(found - set(CLASSES)))

    def is_target(self, name: str) -> bool:
        """Whether a name of the set becomes a class."""
        return plain(name) in self.targets and not self.is_ignored(name)

    def target(self, name: str) -> str:
        """Our class of a name that becomes one."""
        return self.targets[plain(name)]

    def is_ignored(self, name: str) -> bool:
        """Whether a name of the set becomes an ignored region."""
        return plain(name) in self.ignored


def naming(classes: Mapping[str, str] | None, ignore: Iterable[str]) -> Naming:
    """What the user asked for; without `classes` the usual names are known and their look-alikes ignored."""
    asked = frozenset(plain(name) for name in ignore)
    if classes is None:
        return Naming(DEFAULT_CLASSES, asked | DEFAULT_IGNORED)
    return Naming({plain(name): target for name, target in classes.items()}, asked)


def nothing_maps(place: str, counts: Mapping[str, int], known: Iterable[str]) -> InputError:
    """The error for a set none of whose names becomes a class."""
    found = ", ".join(f"{name} ({count} boxes)" for name, count in counts.items()) or "none"
    return InputError(
        f"{place}: none of its class names ({found}) is one of those looked for ({', '.join(sorted(known))}); state "
        f"which stand for which class, such as --classes {next(iter(counts), 'name')}=person"
    )


_SAME_SHAPE = 0.01  # of the aspect: thumbnails and halved frames are rounded to whole pixels
_CLIPPED_PX = 1.5  # less is rounding, or counting from 1
# share of a box's area within the picture below which it shows nothing of the object
_LEAST_LEFT = 0.1


def labelled_set(
    parsed: ParsedSet,
    place: Path,
    names: Naming,
    unlabelled: Iterable[str],
    pattern: re.Pattern[str] | None,
) -> LabelledSet:
    """The set in our classes. Raises InputError when no name maps, or no picture can be opened."""
    counts = Counter(
        box.name for picture in parsed.pictures for box in picture.boxes if not box.is_ignored
    )
    names, classes = _mapped(parsed, place, names, counts)
    made = [_labelled(picture, place, names, classes, pattern) for picture in parsed.pictures]
    pictures = tuple(picture for picture, _ in made if picture is not None)
    found = notices_of([*parsed.findings, *findings_in(made)])
    if not pictures:
        raise InputError(
            f"{place}: none of its {len(parsed.pictures)} pictures can be used: "
            + "; ".join(each.text for each in found)
        )
    is_unknown = {name: not (names.is_target(name) or names.is_ignored(name)) for name in counts}
    notices = (
        *found,
        *_counted(
            "unmapped_classes",
            {name: count for name, count in counts.items() if is_unknown[name]},
            "classes that stand for none of ours left out",
        ),
        *_counted(
            "look_alikes_ignored",
            {
                name: count
                for name, count in counts.items()
                if names.is_ignored(name) and plain(name) in LOOK_ALIKES
            },
            "look-alikes are neither right nor wrong, as regions to ignore",
            "; --classes THEIRS=OURS,... states which of a set's classes count",
        ),
    )
    return LabelledSet(
        place.stem if place.is_file() else place.name,
        classes,
        pictures,
        frozenset(unlabelled),
        notices,
    )


def _mapped(
    parsed: ParsedSet, place: Path, names: Naming, counts: Counter[str]
) -> tuple[Naming, tuple[str, ...]]:
    """The naming that holds for this set, and our classes in it. Raises InputError when no name maps."""
    every = dict.fromkeys([*counts, *parsed.declared])
    if list(every) == ["0"] and not parsed.declared:
        # the naming of a set whose one class has the number 0 and no name, where the user
        # looks for one class only
        targets = set(names.targets.values())
        names = (
            Naming({**names.targets, "0": targets.pop()}, names.ignored)
            if len(targets) == 1
            else names
        )
    classes = names.classes(every)
    if not classes:
        raise nothing_maps(str(place), {name: counts[name] for name in every}, names.targets)
    return names, classes


def _labelled(
    parsed: ParsedPicture,
    place: Path,
    names: Naming,
    classes: tuple[str, ...],
    pattern: re.Pattern[str] | None,
) -> tuple[LabelledPicture | None, list[LabelFinding]]:
    """The picture in our classes, None where it cannot be used; what was wrong with it or its boxes."""
    name = parsed.path.name
    try:
        width_px, height_px, orientation = shown_size_px(parsed.path)
    except InputError:
        return None, [LabelFinding("unreadable_pictures", name)]
    edges = np.array([box[1:5] for box in parsed.boxes], np.float64).reshape(-1, 4)
    fitted, scaling = _in_picture_px(
        edges, parsed.labelled_size, (width_px, height_px), orientation, name
    )
    if fitted is None:
        return None, scaling
    inside, keep, clipping = _clipped(fitted, width_px, height_px, name)
    kept = ((box, edge_px) for box, edge_px, is_kept in zip(parsed.boxes, inside, keep) if is_kept)
    # boxes of our classes with their class numbers, and boxes to ignore; boxes of other
    # names are left out
    boxes, labels, ignored = [], [], []
    for box, edge_px in kept:
        if box.is_ignored or names.is_ignored(box.name):
            ignored.append(tuple(edge_px.tolist()))
        elif names.is_target(box.name):
            boxes.append(edge_px)
            labels.append(classes.index(names.target(box.name)))
    if parsed.is_ignored:
        ignored = [(0.0, 0.0, float(width_px), float(height_px)), *ignored]
    group = group_of(parsed.path, place, pattern) if pattern or not parsed.group else parsed.group
    return LabelledPicture(
        str(parsed.path),
        width_px,
        height_px,
        group,
        np.array(boxes, np.float32),
        np.array(labels, np.int64),
        np.array(list(dict.fromkeys(ignored)), np.float32),
        parsed.m_per_px,
    ), scaling + clipping


def _in_picture_px(
    edges: Floats,
    labelled: tuple[float, float] | None,
    shown_px: tuple[int, int],
    orientation: int,
    name: str,
) -> tuple[Floats | None, list[LabelFinding]]:
    """Edges, (N, 4), in pixels of the picture as it is shown; None when the labels are of another shape.

    Labels drawn on a picture as stored, before its EXIF orientation, are turned with it.
    """
    if labelled is None or labelled == shown_px:
        return edges, []
    is_scaled = labelled != SHARES
    if is_scaled and not _same_shape(labelled, shown_px):
        if orientation >= 5 and _same_shape(labelled, shown_px[::-1]):
            return _in_picture_px(
                turned(edges, labelled, orientation), labelled[::-1], shown_px, 1, name
            )
        return None, [LabelFinding("other_size", name)]
    fitted = edges * np.tile(np.divide(shown_px, labelled), 2)
    return fitted, [LabelFinding("scaled_labels", name)] if is_scaled else []


def turned(edges: Floats, stored_size: tuple[float, float], orientation: int) -> Floats:
    """Edges, (N, 4), in a picture as stored, as they lie once its EXIF orientation (5 to 8) is applied."""
    left, top, right, bottom = edges.T
    width, height = stored_size
    columns = {
        5: (top, left, bottom, right),
        6: (height - bottom, left, height - top, right),
        7: (height - bottom, width - right, height - top, width - left),
        8: (top, width - right, bottom, width - left),
    }[orientation]
    return np.column_stack(columns)


def _same_shape(size: tuple[float, float], other: tuple[float, float]) -> bool:
    return abs(size[0] * other[1] / (size[1] * other[0]) - 1) <= _SAME_SHAPE


def _clipped(
    edges_px: Floats, width_px: int, height_px: int, name: str
) -> tuple[Floats, list[bool], list[LabelFinding]]:
    """Edges within the picture, which boxes are worth keeping, and what was wrong with the others."""
    with np.errstate(invalid="ignore"):
        sides = edges_px[:, 2:] - edges_px[:, :2]
    limits = np.array([width_px, height_px] * 2, np.float64)
    inside = np.clip(edges_px, 0, limits)
    left = inside[:, 2:] - inside[:, :2]
    empty = (sides <= 0).any(axis=1)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        shows_it = (left > 0).all(axis=1) & ((left / sides).prod(axis=1) >= _LEAST_LEFT)
    outside = ~empty & ~shows_it
    moved = np.abs(inside - edges_px).max(axis=1, initial=0) > _CLIPPED_PX
    return (
        inside,
        list(~empty & ~outside),
        [
            LabelFinding("empty_boxes", name, int(empty.sum())),
            LabelFinding("outside_boxes", name, int(outside.sum())),
            LabelFinding("clipped_boxes", name, int((moved & ~empty & ~outside).sum())),
        ],
    )


def _counted(
    code: str, counts: Mapping[str, int], words: str, more: str = ""
) -> tuple[Notice, ...]:
    """A notice of so many boxes of these names; none where there are no names."""
    if not counts:
        return ()
    total = sum(counts.values())
    named = ", ".join(f"{name} ({count})" for name, count in counts.items())
    return (Notice(code, total, f"{total} boxes of {words}: {named}{more}"),)
