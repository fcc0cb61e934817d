"""Labelled pictures divided into parts that share no video, so that a score on one part holds for new videos."""

import re
from collections.abc import Sequence
from pathlib import Path, PurePath

import numpy as np

from sorvolo.errors import InputError, SettingsError
from sorvolo.survey.flight import Notice
from sorvolo.survey.labels import LabelledSet

_SHUFFLES = 16  # few, so that seeds still differ; enough that no large video lands in a small part by bad luck
_EXPORTED = re.compile(r"[_.](jpe?g|png|bmp|tiff?)(\.rf\.[0-9a-z]+)?$", re.IGNORECASE)


def shared_groups(first: LabelledSet, second: LabelledSet) -> tuple[Notice, ...]:
    """A warning when pictures of one video lie in both sets, else nothing: neighbours look alike, so scores flatter."""
    both = sorted(
        {each.group for each in first.pictures} & {each.group for each in second.pictures}
    )
    if not both:
        return ()
    count = sum(each.group in both for each in second.pictures)
    names = ", ".join(both[:5]) + (", ..." if len(both) > 5 else "")
    return (
        Notice(
            "shared_groups",
            count,
            (
                f"{len(both)} videos ({names}) lie in both {first.name} and {second.name}, with {count} pictures in the "
                "latter; their frames look alike, so the score will be too good: split by video"
            ),
        ),
    )


def shuffled(count: int, seed: int = 0) -> list[int]:
    """The numbers from 0 to `count` - 1 in random order, always the same for a seed."""
    return [int(each) for each in np.random.default_rng(seed).permutation(count)]


def frame_number(path: str) -> int | None:
    """The last number in a picture's file name, by which neighbours in time are known; None without one."""
    numbers = re.findall(r"\d+", stem_of(path))
    return int(numbers[-1]) if numbers else None


def stem_of(path: str) -> str:
    """A picture's file name without its ending, nor that of an export ("_jpg.rf.0f3a")."""
    name = path.replace("\\", "/").rsplit("/", 1)[-1]
    return _EXPORTED.sub("", name.rsplit(".", 1)[0])


def _places(labelled: LabelledSet) -> list[tuple[str, int]]:
    """Where each picture lies in time: its sequence ("" where the whole set is one) and its frame number."""
    numbers = []
    for each in labelled.pictures:
        number = frame_number(each.path)
        if number is None:
            raise InputError(
                f"{each.path}: no number in its name, so its neighbours in time are unknown"
            )
        numbers.append(number)
    is_one_sequence = len(set(numbers)) == len(numbers)
    groups = ["" if is_one_sequence else each.group for each in labelled.pictures]
    return list(zip(groups, numbers))


def _blocks(places: Sequence[tuple[str, int]], block: int) -> list[list[int]]:
    """Rows of the pictures in blocks of about `block` neighbours in time, each within one sequence."""
    sequences: dict[str, list[int]] = {}
    for row in sorted(range(len(places)), key=lambda row: places[row]):
        sequences.setdefault(places[row][0], []).append(row)
    blocks: list[list[int]] = []
    for rows in sequences.values():
        blocks += [
            each.tolist()
            for each in np.array_split(np.array(rows), max(1, round(len(rows) / block)))
        ]
    return blocks


_BLOCKS, _GAP = 10, 10  # of a set of too few videos; frames left out between them, at most


def hold_out(
    labelled: LabelledSet, share: float, seed: int
) -> tuple[LabelledSet, LabelledSet, list[str]]:
    """What is learnt from, what is held out, and notices about that; whole videos wherever there are enough.

    Of few videos whole blocks of neighbouring frames are held out, and near-duplicates beside them are left out. The
    same seed gives the same parts whatever the pictures' order. Raises SettingsError for a share outside 0 to below 1.
    """
    if not 0 <= share < 1:
        raise SettingsError(f"the share to hold out must lie in 0 to below 1, got {share}")
    empty, count = labelled.only([]), len(labelled)
    if share == 0:
        return labelled, empty, []
    videos: dict[str, list[int]] = {}
    for row, picture in enumerate(labelled.pictures):
        videos.setdefault(picture.group, []).append(row)
    held = _drawn([videos[name] for name in sorted(videos)], share * count, seed)
    block = max(1, count // _BLOCKS)
    remarks, learnt = [], sorted({*range(count)} - held)
    if not share / 3 <= len(held) / max(1, count) <= min(3 * share, (1 + share) / 2):
        try:
            places = _places(labelled)
        except InputError as error:
            return labelled, empty, [f"nothing of {labelled.name} is held out: {error}"]
        held = _drawn(_blocks(places, block), share * count, seed)
        if not held:
            words = f"{count} pictures are too few to be divided"
            return labelled, empty, [f"nothing of {labelled.name} is held out: {words}"]
        gap, rest = min(_GAP, block // 2), sorted({*range(count)} - held)
        # the rows none of whose neighbours within `gap` frames is among the others
        others = sorted(held)
        taken: dict[str, list[int]] = {}
        for row in others:
            taken.setdefault(places[row][0], []).append(places[row][1])
        learnt = []
        for row in rest:
            sequence, number = places[row]
            if sequence not in taken or np.abs(np.array(taken[sequence]) - number).min() > gap:
                learnt.append(row)
        remarks = [
            f"{labelled.name} has too few videos to hold whole ones out: blocks of about {block} neighbouring frames were "
            "instead; frames of one video look alike, so the score will be too good"
        ]
        if left_out := len(rest) - len(learnt):
            remarks.append(
                f"{labelled.name}: {left_out} pictures are within {gap} frames of held-out ones and were left out"
            )
    parts = (
        labelled.only([labelled.pictures[row] for row in rows]) for rows in (learnt, sorted(held))
    )
    return next(parts), next(parts), remarks


def _drawn(units: Sequence[Sequence[int]], wanted: float, seed: int) -> set[int]:
    """The rows of some whole units, about `wanted` in all: of a few shuffles the one that comes nearest. Nothing of
    fewer than two units; else at least one unit is drawn and one left."""
    rng = np.random.default_rng(seed)
    best: set[int] = set()
    for _ in range(_SHUFFLES if len(units) > 1 else 0):
        drawn: set[int] = set()
        for index in rng.permutation(len(units))[:-1]:
            if not drawn or abs(len(drawn) + len(units[index]) - wanted) < abs(len(drawn) - wanted):
                drawn.update(units[index])
        if not best or abs(len(drawn) - wanted) < abs(len(best) - wanted):
            best = drawn
    return best


_NUMBERED = re.compile(
    r"(?P<video>.*?)[ _.\-]*(?:(?<![a-z])(?:frames?|img|image|picture|[if]))?[ _.\-]*\(?\d+\)?[ _.\-]*",
    re.IGNORECASE,
)
_PLAIN_FOLDERS = frozenset(
    [
        "images",
        "image",
        "imgs",
        "img",
        "jpegimages",
        "pictures",
        "photos",
        "frames",
        "labels",
        "annotations",
        "data",
        "obj_train_data",
        "sequences",
        "train",
        "training",
        "val",
        "valid",
        "validation",
        "test",
        "testing",
    ]
)


def compiled(pattern: str) -> re.Pattern[str]:
    """A user's pattern. Raises SettingsError when it is none, or has not exactly one group."""
    try:
        found = re.compile(pattern)
    except re.error as error:
        raise SettingsError(
            f"group pattern {pattern!r} is no regular expression: {error}"
        ) from error
    if found.groups != 1:
        raise SettingsError(
            f"group pattern {pattern!r} has {found.groups} groups; mark the video's name with exactly one (...)"
        )
    return found


def group_of(path: Path, place: Path, pattern: re.Pattern[str] | None = None) -> str:
    """The picture's video: the folders below `place` that name something, then the file's name up to its last number.

    "bb_V0014_I0003160_jpg.rf.1f.jpg" is of "bb_V0014"; "flight1/photos/DJI_0031.JPG" of "flight1/DJI"; a name without
    a number is a video of its own. A `pattern` is searched in the path below `place`, with "/" between folders, and
    its one group is the answer where it is found.
    """
    below = _below(path, place)
    if pattern is not None and (match := pattern.search(below.as_posix())) and match.group(1):
        return match.group(1)
    stem = stem_of(below.name)
    numbered = _NUMBERED.fullmatch(stem)
    folders = [
        part for part in below.parts[:-1] if part.lower() not in _PLAIN_FOLDERS and part != ".."
    ]
    video = numbered["video"] if numbered else stem
    return "/".join([*folders, video] if video else folders) or place.name


def _below(path: Path, place: Path) -> PurePath:
    folder = place if place.is_dir() else place.parent
    try:
        return path.relative_to(folder)
    except ValueError:  # pictures beside the labels' folder
        return PurePath(*path.parts[-3:])
