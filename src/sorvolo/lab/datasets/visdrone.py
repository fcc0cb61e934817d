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
    findings_in,
    is_label_file,
    label_files,
    labelled_frames,
    paired,
    pictures_around,
    read_lines,
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
    parsed = {path: read_lines(path, _row) for path in label_files(place, is_label_file)}
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
    read = _video_frames if lengths == {_VID} else _separate_pictures
    labelled, lonely = read(place, rows)
    return ParsedSet(FORM, labelled, NAMES, (*malformed, *lonely))


def looks_like_visdrone(line: str) -> bool:
    """Whether a line is 8 or 10 whole numbers with commas between."""
    return _LINE.fullmatch(line) is not None


def _row(line: str) -> list[int] | None:
    """The numbers of a line; None where it is no label."""
    if len(line) >= 300 or not looks_like_visdrone(line):
        return None
    return [int(word) for word in line.strip().strip(",").split(",")]


def _box(row: list[int]) -> ParsedBox:
    left, top, width, height, score, category = row[-_DET:-2]
    name = NAMES[category] if 0 <= category < len(NAMES) else str(category)
    return ParsedBox(
        name, left, top, left + width, top + height, score == 0 or category in _IGNORED
    )


def _separate_pictures(
    place: Path, rows: _RowsByFile
) -> tuple[tuple[ParsedPicture, ...], list[LabelFinding]]:
    pictures = pictures_around(place, FORM)
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
    place: Path, rows: _RowsByFile
) -> tuple[tuple[ParsedPicture, ...], list[LabelFinding]]:
    labelled: dict[str, dict[int, list[ParsedBox]]] = {path.stem: {} for path in rows}
    for path, found in rows.items():
        for row in found:
            labelled[path.stem].setdefault(row[0], []).append(_box(row))
    return labelled_frames(place, FORM, labelled)
