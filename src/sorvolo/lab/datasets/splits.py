"""Labelled pictures divided into parts that share no video, so that a score on one part holds for new videos."""

import re
from collections import Counter
from collections.abc import Hashable, Mapping, Sequence
from pathlib import Path, PurePath
from typing import TypeVar

import numpy as np

from sorvolo.errors import InputError, SettingsError
from sorvolo.geometry.arrays import Floats
from sorvolo.survey.flight import Notice
from sorvolo.survey.labels import LabelledSet

_Group = TypeVar("_Group", bound=Hashable)

_SHUFFLES = 16  # few, so that seeds still differ; enough that no large video lands in a small part by bad luck
_EXPORTED = re.compile(r"[_.](jpe?g|png|bmp|tiff?)(\.rf\.[0-9a-z]+)?$", re.IGNORECASE)


def split_by_group(
    labelled: LabelledSet, shares: Mapping[str, float], seed: int = 0
) -> dict[str, LabelledSet]:
    """Whole groups (videos, flights) to each part, such as {"train": 0.8, "test": 0.2} of the pictures, by chance.

    Every part gets at least one group; the shares are met as closely as whole groups allow. The same seed gives the
    same parts whatever the pictures' order. Raises SettingsError for impossible shares, InputError when there are fewer
    groups than parts.
    """
    _demand_shares(shares)
    sizes = Counter(picture.group for picture in labelled.pictures)
    if len(sizes) < len(shares):
        raise InputError(
            f"{labelled.name}: {len(sizes)} videos cannot make {len(shares)} parts that share none; take fewer parts, "
            "name how videos are distinguished, or split by blocks of consecutive frames"
        )
    part_of = _assigned(sizes, shares, seed)
    return {
        part: labelled.only([each for each in labelled.pictures if part_of[each.group] == part])
        for part in shares
    }


def split_by_blocks(
    labelled: LabelledSet,
    shares: Mapping[str, float],
    block: int = 100,
    gap: int = 10,
    seed: int = 0,
) -> dict[str, LabelledSet]:
    """Whole blocks of `block` pictures with consecutive frame numbers to each part, for sets of few, long videos.

    Frame numbers are the last ones in the pictures' names. Where all of a set differ they are one sequence, else each
    group is one. Where two parts meet, pictures whose numbers are within `gap` of the other part's are near-duplicates:
    the part with the larger share drops them and counts them. Raises SettingsError for impossible shares, InputError
    when names have no number or there are fewer blocks than parts.
    """
    _demand_shares(shares)
    if block < 1 or gap < 0:
        raise SettingsError(f"block must be at least 1 and gap at least 0, got {block} and {gap}")
    places = _places(labelled)
    blocks = _blocks(places, block)
    if len(blocks) < len(shares):
        raise InputError(
            f"{labelled.name}: {len(labelled)} pictures make {len(blocks)} blocks of {block}, fewer than the "
            f"{len(shares)} parts; take smaller blocks"
        )
    chosen = _assigned({index: len(each) for index, each in enumerate(blocks)}, shares, seed)
    members = {
        part: [row for index, each in enumerate(blocks) if chosen[index] == part for row in each]
        for part in shares
    }
    by_share = sorted(shares, key=lambda part: -shares[part])
    parts = {}
    for part in shares:
        smaller = [row for other in by_share[by_share.index(part) + 1 :] for row in members[other]]
        kept = _far_from(members[part], smaller, places, gap)
        text = f"{{}} pictures of {part} are within {gap} frames of another part and were left out"
        left_out = len(members[part]) - len(kept)
        notices = (
            (Notice("left_out_at_borders", left_out, text.format(left_out)),) if left_out else ()
        )
        pictures = tuple(labelled.pictures[row] for row in kept)
        parts[part] = LabelledSet(
            labelled.name, labelled.classes, pictures, labelled.unlabelled, notices
        )
    return parts


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


def _demand_shares(shares: Mapping[str, float]) -> None:
    if (
        not shares
        or not all(0 < share <= 1 for share in shares.values())
        or abs(sum(shares.values()) - 1) > 1e-6
    ):
        raise SettingsError(f"shares must be above 0 and sum up to 1, got {dict(shares)}")


def _assigned(
    sizes: Mapping[_Group, int], shares: Mapping[str, float], seed: int
) -> dict[_Group, str]:
    """A part for every group: of a few shuffles the one that meets the shares best."""
    rng = np.random.default_rng(seed)
    groups = sorted(sizes, key=str)
    parts = list(shares)
    wanted = np.array(list(shares.values())) * sum(sizes.values())
    best: dict[_Group, str] = {}
    least = np.inf
    for _ in range(_SHUFFLES):
        chosen, missed = _dealt(
            [groups[index] for index in rng.permutation(len(groups))], sizes, wanted
        )
        if missed < least:
            best, least = {group: parts[part] for group, part in chosen.items()}, missed
    return best


def _dealt(
    groups: Sequence[_Group], sizes: Mapping[_Group, int], wanted: Floats
) -> tuple[dict[_Group, int], float]:
    """Each group in turn to the part that lacks most; and by how many pictures the parts miss what was wanted."""
    lacking = wanted.copy()
    empty = set(range(len(wanted)))
    chosen: dict[_Group, int] = {}
    for index, group in enumerate(groups):
        open_parts = sorted(empty) if len(groups) - index <= len(empty) else range(len(wanted))
        part = max(open_parts, key=lambda each: (lacking[each], -each))
        chosen[group] = part
        lacking[part] -= sizes[group]
        empty.discard(part)
    return chosen, float(np.abs(lacking).sum())


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


def _far_from(
    rows: Sequence[int], others: Sequence[int], places: Sequence[tuple[str, int]], gap: int
) -> list[int]:
    """The rows none of whose neighbours within `gap` frames is among the others."""
    taken: dict[str, list[int]] = {}
    for row in others:
        taken.setdefault(places[row][0], []).append(places[row][1])
    kept = []
    for row in rows:
        sequence, number = places[row]
        if sequence not in taken or np.abs(np.array(taken[sequence]) - number).min() > gap:
            kept.append(row)
    return kept


_BLOCKS, _GAP = (
    10,
    10,
)  # into which a set of too few videos is cut; frames left out between them, at most


def hold_out(
    labelled: LabelledSet, share: float, seed: int
) -> tuple[LabelledSet, LabelledSet, list[str]]:
    """What is learnt from, what is held out, and notices about that; whole videos wherever there are enough.

    `sorvolo train --val SHARE` and `read_sets` take it from here. Raises
    SettingsError for a share outside 0 to below 1.
    """
    if not 0 <= share < 1:
        raise SettingsError(f"the share to hold out must lie in 0 to below 1, got {share}")
    shares = {"learnt": 1 - share, "held out": share}
    empty = labelled.only([])
    if share == 0:
        return labelled, empty, []
    try:
        parts = split_by_group(labelled, shares, seed)
        if share / 3 <= len(parts["held out"]) / len(labelled) <= min(3 * share, (1 + share) / 2):
            return parts["learnt"], parts["held out"], []
    except InputError:
        pass  # too few videos: blocks of frames are held out below
    block = max(1, len(labelled) // _BLOCKS)
    try:
        parts = split_by_blocks(labelled, shares, block, min(_GAP, block // 2), seed)
    except InputError as error:
        return labelled, empty, [f"nothing of {labelled.name} is held out: {error}"]
    text = (
        f"{labelled.name} has too few videos to hold whole ones out: blocks of about {block} neighbouring frames were "
        "instead; frames of one video look alike, so the score will be too good"
    )
    remarks = [
        f"{labelled.name}: {notice.text}" for each in parts.values() for notice in each.notices
    ]
    return parts["learnt"], parts["held out"], [text, *remarks]


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
