"""What a reader of one form hands over: pictures with boxes as in their files, before names and edges are checked."""

import os
import warnings
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple, TypeAlias, TypeVar

from PIL import ExifTags, Image

from sorvolo.errors import InputError
from sorvolo.lab.datasets.splits import frame_number, group_of
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


class LabelFinding(NamedTuple):
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


def findings_in(read: Iterable[tuple[Any, Iterable[LabelFinding]]]) -> list[LabelFinding]:
    """The findings of what was read piece by piece, each as what it gave and what was wrong there."""
    return [each for _, findings in read for each in findings]


def notices_of(findings: Iterable[LabelFinding]) -> tuple[Notice, ...]:
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
    findings: tuple[LabelFinding, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Every class name: those of its list, then those that only boxes have."""
        return tuple(
            dict.fromkeys(
                [*self.declared, *(box.name for each in self.pictures for box in each.boxes)]
            )
        )


_Label = TypeVar("_Label")

Reader: TypeAlias = Callable[[Path], ParsedSet]
"""Reads one form from a file or folder; raises InputError when it is not of that form."""


def joined(
    pictures: Iterable[ParsedPicture],
) -> tuple[tuple[ParsedPicture, ...], list[LabelFinding]]:
    """Each file once: of one that is listed twice the boxes are joined."""
    by_path: dict[Path, ParsedPicture] = {}
    findings = []
    for each in pictures:
        earlier = by_path.get(each.path)
        if earlier is not None:
            findings.append(LabelFinding("duplicate_pictures", each.path.name))
            boxes = tuple(dict.fromkeys(earlier.boxes + each.boxes))
            each = replace(earlier, boxes=boxes)
        by_path[each.path] = each
    return tuple(by_path.values()), findings


_NOT_LABELS = frozenset(
    [
        "classes.txt",
        "predefined_classes.txt",
        "train.txt",
        "val.txt",
        "valid.txt",
        "test.txt",
        "readme.txt",
        "license.txt",
        "requirements.txt",
        "readme.dataset.txt",
        "readme.roboflow.txt",
    ]
)
_MOST_BYTES = 2_000_000_000  # COCO's own train2017 is half a gigabyte


def read_text(path: Path) -> str:
    """The file's text: UTF-8 with or without mark, UTF-16 with one; what is neither is replaced, not refused.

    Raises InputError when it cannot be read or is too large for any label file.
    """
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise InputError(
                f"{path} has {path.stat().st_size / 1e9:.1f} GB; no label file is that large"
            )
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror})") from error
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        return data.decode("utf-16", "replace")
    return data.decode("utf-8-sig", "replace")


def first_line(path: Path) -> str:
    """The first line that is not blank; empty where there is none."""
    return next((line for line in read_text(path).splitlines() if line.strip()), "")


def read_lines(
    path: Path, parse: Callable[[str], _Label | None]
) -> tuple[list[_Label], list[LabelFinding]]:
    """What `parse` makes of a file's lines; those of which it makes None are no labels, unless they are blank."""
    found, findings = [], []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        if (label := parse(line)) is not None:
            found.append(label)
        elif line.strip():
            findings.append(LabelFinding("malformed_labels", f"{path.name}, line {number}"))
    return found, findings


def label_files(
    place: Path, is_one: Callable[[Path], bool] = lambda _: True, ending: str = ".txt"
) -> list[Path]:
    """The file itself, or all files below a folder that end so and that `is_one` takes."""
    if place.is_file():
        return [place]
    return [path for path in files_below(place, ending) if is_one(path)]


def is_label_file(path: Path) -> bool:
    """Whether a text file may hold labels: names of classes, lists of pictures and notes do not."""
    return path.name.lower() not in _NOT_LABELS


PICTURE_ENDINGS = frozenset([".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp"])

_BROKEN = (
    OSError,
    SyntaxError,
    ValueError,
    TypeError,
    KeyError,
    IndexError,
    OverflowError,
    Image.DecompressionBombError,
)


def pictures_below(folder: Path) -> list[Path]:
    """All pictures of the folder and its sub-folders, hidden ones left out, sorted by path."""
    return files_below(folder, *PICTURE_ENDINGS)


def files_below(folder: Path, *endings: str) -> list[Path]:
    """All files of the folder and its sub-folders (with one of the endings), hidden ones left out, sorted.

    Linked folders count, as large sets are often kept elsewhere; each folder once, so that links may form a ring.
    """
    found: list[Path] = []
    seen: set[str] = set()
    for parent, folders, files in os.walk(folder, followlinks=True):
        real = os.path.realpath(parent)
        if real in seen:
            folders.clear()
            continue
        seen.add(real)
        folders[:] = sorted(name for name in folders if not _is_hidden(name))
        names = (name for name in files if not _is_hidden(name))
        found += [
            Path(parent, name)
            for name in names
            if not endings or Path(name).suffix.lower() in endings
        ]
    return sorted(found)


def shown_size_px(path: Path) -> tuple[int, int, int]:
    """A picture's width and height as its EXIF orientation wants it shown, and that orientation, 1 to 8.

    Raises InputError for what is no readable picture. Any mode and depth is fine; pixels are not read.
    """
    try:
        with warnings.catch_warnings():
            # a survey's orthophoto is large, not an attack: pixels are not read here
            warnings.simplefilter("ignore")
            with Image.open(path) as picture:
                width, height = picture.size
                orientation = _orientation(picture)
    except _BROKEN as error:
        raise InputError(f"{path} is no picture that can be opened ({error})") from error
    if min(width, height) < 1:
        raise InputError(f"{path} has no pixels ({width}x{height})")
    return (height, width, orientation) if orientation >= 5 else (width, height, orientation)


def _orientation(picture: Image.Image) -> int:
    try:
        # a PNG's own method decodes its pixels where no EXIF stands before them
        value = int(Image.Image.getexif(picture).get(ExifTags.Base.Orientation, 1))
    except _BROKEN:
        return 1  # damaged EXIF: viewers show the picture as stored
    return value if 1 <= value <= 8 else 1


def _is_hidden(name: str) -> bool:
    return name.startswith(".") or name == "__MACOSX"


_PICTURE_FOLDERS = frozenset({"images", "jpegimages", "sequences", "pictures", "frames", "photos"})


def pictures_around(place: Path, form: str) -> list[Path]:
    """Pictures below a folder; of one with label files only, below the folder for pictures beside it.

    Raises InputError when there are none.
    """
    folder = place if place.is_dir() else place.parent
    found = pictures_below(folder)
    if not found:
        beside = [
            each
            for each in sorted(folder.parent.iterdir())
            if each.name.lower() in _PICTURE_FOLDERS
        ]
        found = [path for each in beside for path in pictures_below(each)]
    if not found:
        endings = ", ".join(sorted(PICTURE_ENDINGS))
        raise InputError(
            f"{place}: no pictures ({endings}) in it nor beside it; {form} labels need theirs"
        )
    return found


def paired(
    pictures: Sequence[Path], labels: Collection[Path], place: Path, form: str
) -> tuple[dict[Path, Path], list[LabelFinding]]:
    """The label file of each picture that has one; files and pictures that are left over.

    A file belongs to the picture of the same stem, of several to that with most folders in common. Raises InputError
    when no picture has one.
    """
    by_stem: dict[str, list[Path]] = {}
    for path in labels:
        by_stem.setdefault(path.stem, []).append(path)
    label_of = {
        picture: max(
            by_stem[picture.stem],
            key=lambda path: (Counter(path.parts[:-1]) & Counter(picture.parts[:-1])).total(),
        )
        for picture in pictures
        if picture.stem in by_stem
    }
    if not label_of:
        raise InputError(
            f"{place}: none of its {len(labels)} {form} files has a picture of the same name"
        )
    lonely = sorted(set(labels) - set(label_of.values()))
    return label_of, [
        *(LabelFinding("labels_without_picture", path.name) for path in lonely),
        *(
            LabelFinding("pictures_without_labels", path.name)
            for path in pictures
            if path not in label_of
        ),
    ]


def frames_by_video(
    place: Path, form: str, videos: Iterable[str]
) -> Mapping[str, Mapping[int, Path]]:
    """The pictures of each video by frame number: in a folder of its name, or with its name before the number.

    Raises InputError where no frame of any video lies there as a picture.
    """
    frames: dict[str, dict[int, Path]] = {video: {} for video in videos}
    for path in pictures_around(place, form):
        number = frame_number(path.name)
        if number is None:
            continue
        named = next((part for part in reversed(path.parts[:-1]) if part in frames), None)
        video = named or group_of(path, path.parent)
        if video in frames:
            frames[video].setdefault(number, path)
    if not any(frames.values()):
        raise InputError(
            f"{place}: {form} labels of videos, but none of their frames is there; extract them as pictures into a folder "
            f"of the video's name, numbered as in the labels (such as {next(iter(frames))}/000123.jpg)"
        )
    return frames


def labelled_frames(
    place: Path,
    form: str,
    labelled: Mapping[str, Mapping[int, Sequence[ParsedBox]]],
    sizes: Mapping[str, tuple[float, float]] = MappingProxyType({}),
) -> tuple[tuple[ParsedPicture, ...], list[LabelFinding]]:
    """All frames of videos with their boxes, and the labels whose frame is not there.

    `labelled` has the boxes by video and frame, `sizes` the labelled sizes by video. Raises InputError as
    `frames_by_video`.
    """
    frames = frames_by_video(place, form, labelled)
    result, findings = [], []
    for video, by_frame in labelled.items():
        lonely = set(by_frame) - set(frames[video])
        where = f"{video}, frame {min(lonely, default=0)}"
        findings.append(LabelFinding("labels_without_picture", where, len(lonely)))
        result += [
            ParsedPicture(path, tuple(by_frame.get(number, ())), sizes.get(video), video)
            for number, path in sorted(frames[video].items())
        ]
    return tuple(result), findings
