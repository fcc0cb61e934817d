"""UMCD: a metadata text file for each video, a block for each object: what it is and when it is in view."""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from math import inf, isfinite
from pathlib import Path

from sorvolo.errors import InputError
from sorvolo.lab.datasets.parsed import (
    LabelFinding,
    ParsedBox,
    ParsedPicture,
    ParsedSet,
    frames_by_video,
    label_files,
    read_text,
)

FORM = "UMCD"
_OBJECT = re.compile(r"object\b\s*#?\s*\d*\s*[:.=]?\s*", re.IGNORECASE)
_KNOWN = frozenset(
    {
        "type",
        "shape",
        "dimension",
        "dimensions",
        "size",
        "color",
        "colour",
        "movement",
        "appearance",
    }
)
_NUMBER = re.compile(r"\d{1,9}(?:\.\d{1,9})?")
ROUNDED_S = 1.0  # times of appearance are whole seconds, rounded one way or the other


@dataclass
class _Object:
    """One block while it is read; `boxes` by frame are left, top, width, height in pixels."""

    name: str = ""
    has_type: bool = False
    from_s: float = -inf
    until_s: float = inf
    boxes: dict[int, tuple[float, ...]] = field(default_factory=dict)


@dataclass
class _Video:
    fps: float = 0.0
    objects: list[_Object] = field(default_factory=list)
    malformed: list[LabelFinding] = field(default_factory=list)


def read_umcd(place: Path) -> ParsedSet:
    """A folder with metadata files (`path1.txt`) and frames in folders of the videos' names (`path1/000123.jpg`).

    The thesis (section 2.2) lists what a file holds of each object: type, shape, dimension in cm, colour, movement;
    Table 2.4 adds from which second to which it is in view. It gives no places in the picture. So a frame in which
    no object is in view is a picture of nothing; one with an object of unknown place is ignored as a whole.
    Lines `Box: FRAME LEFT TOP WIDTH HEIGHT` in an object's block (ours, in pixels) give its places. Raises InputError
    when nothing is of this form, times are given without `Fps:`, or no frame is there or of use.
    """
    # The videos of all metadata files that describe objects. Raises InputError when none does.
    read = {path: _parsed(path) for path in label_files(place, looks_like_umcd)}
    videos = {path: video for path, video in read.items() if video.objects}
    if not videos:
        raise InputError(
            f"{place}: no text file describes objects as {FORM}'s do (Type:, Shape:, Dimension:, ...)"
        )
    frames = frames_by_video(place, FORM, [path.stem for path in videos])
    result: list[ParsedPicture] = []
    for path, video in videos.items():
        if not video.fps > 0 and any(each.from_s > -inf for each in video.objects):
            raise InputError(
                f"{path} states at which second objects are in view but not how many frames make a second; add a line "
                "such as 'Fps: 25' before the first object"
            )
        result += _labelled_frames(path.stem, video, frames[path.stem])
    if all(each.is_ignored and not each.boxes for each in result):
        raise InputError(
            f"{place}: {FORM} metadata names what is in its videos but not where in the frames, so nothing can be "
            "learnt from them; add lines 'Box: FRAME LEFT TOP WIDTH HEIGHT' to the objects, or label the frames anew"
        )
    names = dict.fromkeys(each.name for video in videos.values() for each in video.objects)
    findings = [each for video in videos.values() for each in video.malformed]
    findings += [
        LabelFinding("no_boxes_for_frame", each.path.name) for each in result if each.is_ignored
    ]
    return ParsedSet(FORM, tuple(result), tuple(names), tuple(findings))


@dataclass(frozen=True)
class UmcdMetadata:
    """What a video's metadata file states: `fps` (0: not stated), and from which second to which objects are in view.

    `boxed` are the numbers of the frames in which objects have places (lines `Box:`).
    """

    fps: float
    in_view_s: tuple[tuple[float, float], ...]
    boxed: frozenset[int]
    names: tuple[str, ...] = ()  # of the objects

    @property
    def has_times(self) -> bool:
        """Whether it states of every object when it is in view."""
        return bool(self.in_view_s) and all(map(isfinite, sum(self.in_view_s, ())))

    def shows_object(self, time_s: float) -> bool | None:
        """Whether an object is in view at a time; None within a second of where one comes or goes, or unknown."""
        inside_s = [
            min(time_s - start, end - time_s) for start, end in self.in_view_s
        ]  # negative: out of view
        if not self.has_times:
            return None
        if max(inside_s) > ROUNDED_S:
            return True
        return False if max(inside_s) < -ROUNDED_S else None


def read_umcd_metadata(path: Path) -> UmcdMetadata:
    """One video's metadata file; raises InputError for one that describes no object."""
    video = _parsed(path)
    if not video.objects:
        raise InputError(
            f"{path}: describes no object as {FORM}'s metadata does (Type:, Shape:, Dimension:, ...)"
        )
    return UmcdMetadata(
        video.fps,
        tuple((each.from_s, each.until_s) for each in video.objects),
        frozenset(frame for each in video.objects for frame in each.boxes),
        tuple(each.name for each in video.objects),
    )


def looks_like_umcd(path: Path) -> bool:
    """Whether a text file names an object's type and has at least two of the fields of this form."""
    fields = [_field(line) for line in read_text(path).splitlines()]
    keys = {key for key, value in fields if value} & _KNOWN
    return len(keys) >= 2 and (
        "type" in keys or any(key == "object" and value for key, value in fields)
    )


def _labelled_frames(
    name: str, video: _Video, frames: Mapping[int, Path]
) -> Iterator[ParsedPicture]:
    for number, picture in sorted(frames.items()):
        boxes = []
        for each in video.objects:
            if number in each.boxes:
                left, top, width, height = each.boxes[number]
                boxes.append(ParsedBox(each.name, left, top, left + width, top + height))
        unplaced = any(
            _is_in_view(each, number, video.fps)
            for each in video.objects
            if number not in each.boxes
        )
        yield ParsedPicture(picture, tuple(boxes), None, name, is_ignored=unplaced)


def _field(line: str) -> tuple[str, str]:
    """A line's key in lower case and its value, such as ("type", "Person"); the key is empty where there is none.

    "Object 1: Person" has the key "object".
    """
    bare = line.strip().strip("-*; ")
    if begun := _OBJECT.match(bare):
        return "object", bare[begun.end() :]
    key, mark, value = (
        bare.replace("=", ":", 1).partition(":") if ":" not in bare else bare.partition(":")
    )
    return (key.strip().lower(), value.strip()) if mark else ("", bare)


def _parsed(path: Path) -> _Video:
    """A file's objects: what comes before the first one is about the video, a second type begins another one."""
    video = _Video()
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        key, value = _field(line)
        numbers = [float(each) for each in _NUMBER.findall(value)]
        last = video.objects[-1] if video.objects else None
        understood = bool(key)
        if key == "object" or (key == "type" and (last is None or last.has_type)):
            video.objects.append(_Object(value, has_type=key == "type"))
        elif key in ("fps", "frequency"):
            video.fps = next(iter(numbers), 0.0)
        elif last is None:
            understood = bool(key) and key not in _KNOWN and key != "box"
        elif key == "type":
            last.name, last.has_type = value or last.name, True
        elif key == "appearance":
            understood = len(numbers) == 2 and numbers[0] <= numbers[1]
            if understood:
                last.from_s, last.until_s = numbers
        elif key == "box":
            understood = len(numbers) == 5
            if understood:
                last.boxes[int(numbers[0])] = tuple(numbers[1:])
        if line.strip() and not understood:
            video.malformed.append(LabelFinding("malformed_labels", f"{path.name}, line {number}"))
    video.objects = [each for each in video.objects if each.name]
    return video


def _is_in_view(each: _Object, frame: int, fps: float) -> bool:
    if each.from_s == -inf:
        return True
    return each.from_s - ROUNDED_S <= frame / fps <= each.until_s + ROUNDED_S
