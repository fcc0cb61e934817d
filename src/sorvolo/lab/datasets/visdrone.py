"""VisDrone: a text file for each picture (DET) or each video (VID), a line of numbers with commas for each box."""

import re
from pathlib import Path
from typing import TypeAlias

from sorvolo.errors import InputError
from sorvolo.lab.datasets.parsed import (
    LabelFinding,
    ParsedBox,
    ParsedPicture,
    ParsedSet,
    files_below,
    findings_in,
    frames_by_video,
    is_label_file,
    no_frames,
    paired,
    pictures_around,
    read_text,
)

FORM = "VisDrone"
NAMES = (
    "ignored regions",
    "pedestrian",
    "people",
    "bicycle",
    "car",
    "van",
    "truck",
    "tricycle",
    "awning-tricycle",
    "bus",
    "motor",
    "others",
)
"""Categories 0 to 11 of the VisDrone toolkits; 0 and 11 are ignored."""

_IGNORED = {0, len(NAMES) - 1}
_DET, _VID = 8, 10  # numbers a line
_LINE = re.compile(r"\s*-?\d+\s*(,\s*-?\d+\s*){7}(,\s*-?\d+\s*,\s*-?\d+\s*)?,?\s*", re.ASCII)

_RowsByFile: TypeAlias = dict[Path, list[list[int]]]


def read_visdrone(place: Path) -> ParsedSet:
    """A folder with `annotations/` and `images/` (DET) or `sequences/` (VID), or one text file beside its pictures.

    A line of DET is left, top, width, height, score, category, truncation, occlusion; of VID the frame (from 1) and the
    target come first. Score 0 and the categories "ignored regions" and "others" are ignored; truncated and occluded
    objects count. Raises InputError when no line is of either form.
    """
    files = (
        [place]
        if place.is_file()
        else [path for path in files_below(place, ".txt") if is_label_file(path)]
    )
    parsed = {path: _rows(path) for path in files}
    malformed = findings_in(parsed.values())
    rows = {
        path: found for path, (found, _) in parsed.items() if found or not read_text(path).strip()
    }
    # 8 (DET) or 10 (VID). Raises InputError for no line, and for lines of both lengths
    lengths = {len(row) for found in rows.values() for row in found}
    if not lengths:
        raise InputError(
            f"{place}: no line is a VisDrone label (8 or 10 whole numbers with commas)"
        )
    if len(lengths) > 1:
        raise InputError(
            f"{place}: lines of 8 and of 10 numbers; read pictures (DET) and videos (VID) one by one"
        )
    length = lengths.pop()
    pictures = pictures_around(place, FORM)
    read = _video_frames if length == _VID else _separate_pictures
    labelled, lonely = read(place, rows, pictures)
    return ParsedSet(FORM, labelled, NAMES, (*malformed, *lonely))


def looks_like_visdrone(line: str) -> bool:
    """Whether a line is 8 or 10 whole numbers with commas between."""
    return _LINE.fullmatch(line) is not None


def _rows(path: Path) -> tuple[list[list[int]], list[LabelFinding]]:
    """The numbers of the file's lines, and the lines that are no labels."""
    rows, findings = [], []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        if looks_like_visdrone(line) and len(line) < 300:
            rows.append([int(word) for word in line.strip().strip(",").split(",")])
        elif line.strip():
            findings.append(LabelFinding("malformed_labels", f"{path.name}, line {number}"))
    return rows, findings


def _box(row: list[int]) -> ParsedBox:
    left, top, width, height, score, category = row[-_DET:-2]
    name = NAMES[category] if 0 <= category < len(NAMES) else str(category)
    return ParsedBox(
        name, left, top, left + width, top + height, score == 0 or category in _IGNORED
    )


def _separate_pictures(
    place: Path, rows: _RowsByFile, pictures: list[Path]
) -> tuple[tuple[ParsedPicture, ...], list[LabelFinding]]:
    label_of, lonely = paired(pictures, rows, place, FORM)
    result = []
    for path in pictures:
        found = rows[label_of[path]] if path in label_of else []
        # the video it was taken from comes first
        sequence = re.fullmatch(r"(\d{7})_\d+_d_\d+", path.stem)
        result.append(
            ParsedPicture(path, tuple(map(_box, found)), None, sequence[1] if sequence else "")
        )
    return tuple(result), lonely


def _video_frames(
    place: Path, rows: _RowsByFile, pictures: list[Path]
) -> tuple[tuple[ParsedPicture, ...], list[LabelFinding]]:
    frames = frames_by_video(pictures, [path.stem for path in rows])
    if not any(frames.values()):
        raise no_frames(place, FORM, frames)
    result: list[ParsedPicture] = []
    findings = []
    for path, found in rows.items():
        boxes: dict[int, list[ParsedBox]] = {number: [] for number in frames[path.stem]}
        lonely = set()
        for row in found:
            if row[0] in boxes:
                boxes[row[0]].append(_box(row))
            else:
                lonely.add(row[0])
        findings.append(
            LabelFinding(
                "labels_without_picture",
                f"{path.stem}, frame {min(lonely, default=0)}",
                len(lonely),
            )
        )
        result += [
            ParsedPicture(frames[path.stem][number], tuple(each), None, path.stem)
            for number, each in boxes.items()
        ]
    return tuple(result), findings
