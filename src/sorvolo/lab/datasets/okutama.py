"""Okutama-Action: a text file for each video, a line for each person and frame, in pixels of the 4K original."""

import re
from pathlib import Path

from sorvolo.errors import InputError
from sorvolo.lab.datasets.parsed import (
    LabelFinding,
    ParsedBox,
    ParsedSet,
    findings_in,
    first_line,
    label_files,
    labelled_frames,
    read_lines,
)

FORM = "Okutama-Action"
_LINE = re.compile(
    r"\s*(?P<track>\d+)\s+(?P<left>-?\d+)\s+(?P<top>-?\d+)\s+(?P<right>-?\d+)\s+(?P<bottom>-?\d+)\s+(?P<frame>\d+)"
    r"\s+(?P<lost>[01])\s+[01]\s+[01]\s+\"?(?P<name>[^\"\s]+)\"?(\s+\"[^\"]*\")*\s*"
)
_ORIGINAL_PX = (3840.0, 2160.0)  # Okutama-Action's videos are 4K; labels count these pixels
_SIZE_IN_PATH = re.compile(r"(\d{3,4})x(\d{3,4})")


def read_okutama(place: Path) -> ParsedSet:
    """A folder with label files (`1.1.1.txt`) and frames in folders of the videos' names (`1.1.1/0.jpg`).

    A line is track, xmin, ymin, xmax, ymax, frame, lost, occluded, generated, "Person" and actions. Lines marked lost
    are left out: the person is not in view. Edges are in pixels of the 3840x2160 video, or of the size that a folder
    above the label file names, and scaled to the frames (published at 1280x720). Of a video labelled twice, with single
    and with multiple actions, the boxes are the same: the first file counts. Raises InputError when no line is of this
    form, or no frame is there.
    """
    files = label_files(place, lambda path: looks_like_okutama(first_line(path)))
    files_of = {path.stem: path for path in reversed(files)}
    read = {video: _boxes(path) for video, path in sorted(files_of.items())}
    labelled = {video: by_frame for video, (by_frame, _) in read.items()}
    if not any(labelled.values()):
        raise InputError(
            f'{place}: no line is an {FORM} label (track, four edges, frame, three flags, "Person")'
        )
    sizes = {video: _labelled_size(path) for video, path in files_of.items()}
    pictures, lonely = labelled_frames(place, FORM, labelled, sizes)
    return ParsedSet(FORM, pictures, ("Person",), (*findings_in(read.values()), *lonely))


def looks_like_okutama(line: str) -> bool:
    """Whether a line is one of this form."""
    return _LINE.fullmatch(line) is not None


def _boxes(path: Path) -> tuple[dict[int, list[ParsedBox]], list[LabelFinding]]:
    """The file's boxes by frame; frames where all are lost have none. And its lines that are no labels."""
    found: dict[int, list[ParsedBox]] = {}
    matches, findings = read_lines(
        path, lambda line: _LINE.fullmatch(line) if len(line) < 1000 else None
    )
    for match in matches:
        of_frame = found.setdefault(int(match["frame"]), [])
        if match["lost"] == "0":
            left, top, right, bottom = map(float, match.group("left", "top", "right", "bottom"))
            of_frame.append(ParsedBox(match["name"], left, top, right, bottom))
    return found, findings


def _labelled_size(path: Path) -> tuple[float, float]:
    for part in reversed(path.parts[:-1]):
        if match := _SIZE_IN_PATH.search(part):
            return float(match[1]), float(match[2])
    return _ORIGINAL_PX
