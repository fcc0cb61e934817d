"""What a reader of one form hands over: pictures with boxes as in their files, before names and edges are checked."""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

from sorvolo.survey.flight import Notice

SHARES = (1.0, 1.0)
"""The labelled size of boxes whose edges are shares of the picture's width and height."""


class ParsedBox(NamedTuple):
    """One box by the set's own name of its class; edges as in BoxesPx, in units of the picture's labelled size."""

    name: str
    left: float
    top: float
    right: float
    bottom: float
    is_ignored: bool = False


@dataclass(frozen=True)
class ParsedPicture:
    """One picture's labels. `labelled_size` is the picture's width and height in units of the boxes: None for the
    picture's own pixels. `group` is empty where the form does not name videos. `is_ignored`: nothing but its
    boxes is known of the picture, so the rest of it is a region to ignore.
    """

    path: Path
    boxes: tuple[ParsedBox, ...]
    labelled_size: tuple[float, float] | None = None
    group: str = ""
    m_per_px: float = float("nan")
    is_ignored: bool = False


class Finding(NamedTuple):
    """Something wrong that reading goes on without: a code of `FINDINGS`, where it is, and how many `times` there."""

    code: str
    place: str
    times: int = 1


FINDINGS: Mapping[str, str] = {
    "malformed_labels": "labels could not be read and were left out",
    "labels_without_picture": "label files or records belong to no picture that is there",
    "pictures_without_labels": "pictures have no label file and count as pictures of nothing",
    "unreadable_pictures": "pictures could not be opened and were left out",
    "other_size": "pictures have another shape than their labels state and were left out",
    "scaled_labels": "pictures have another size than their labels state; boxes were scaled",
    "clipped_boxes": "boxes reached beyond the picture and were clipped",
    "outside_boxes": "boxes lay outside their picture and were left out",
    "empty_boxes": "boxes were empty or inverted and were left out",
    "duplicate_pictures": "pictures were listed twice; their boxes were joined",
    "counted_from_zero": "files count pixels from 0, not from 1 as the VOC devkit does, and were read so",
    "no_boxes_for_frame": "frames show objects at unknown places; they are ignored as a whole",
}


def findings_in(read: Iterable[tuple[Any, Iterable[Finding]]]) -> list[Finding]:
    """The findings of what was read piece by piece, each as what it gave and what was wrong there."""
    return [each for _, findings in read for each in findings]


def notices_of(findings: Iterable[Finding]) -> tuple[Notice, ...]:
    """One notice a code, in words: how many in all, and where the first is."""
    counts: Counter[str] = Counter()
    first: dict[str, str] = {}
    for code, place, times in findings:
        if times:
            counts[code] += times
            first.setdefault(code, place)
    return tuple(
        Notice(code, count, f"{count} {FINDINGS[code]}, the first: {first[code]}")
        for code, count in counts.items()
    )


@dataclass(frozen=True)
class ParsedSet:
    """All of one place. `declared` are the names that the set's own list has, if any, in its order; `findings` what
    was wrong in its files.
    """

    form: str
    pictures: tuple[ParsedPicture, ...]
    declared: tuple[str, ...] = ()
    findings: tuple[Finding, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Every class name: those of its list, then those that only boxes have."""
        return tuple(
            dict.fromkeys(
                [*self.declared, *(box.name for each in self.pictures for box in each.boxes)]
            )
        )


Reader: TypeAlias = Callable[[Path], ParsedSet]
"""Reads one form from a file or folder; raises InputError when it is not of that form."""


def joined(pictures: Iterable[ParsedPicture]) -> tuple[tuple[ParsedPicture, ...], list[Finding]]:
    """Each file once: of one that is listed twice the boxes are joined."""
    by_path: dict[Path, ParsedPicture] = {}
    findings = []
    for each in pictures:
        earlier = by_path.get(each.path)
        if earlier is not None:
            findings.append(Finding("duplicate_pictures", each.path.name))
            boxes = tuple(dict.fromkeys(earlier.boxes + each.boxes))
            each = replace(earlier, boxes=boxes)
        by_path[each.path] = each
    return tuple(by_path.values()), findings
