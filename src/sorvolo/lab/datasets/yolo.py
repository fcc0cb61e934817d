"""YOLO: a text file for each picture, a line for each box: class number, then centre and size as shares."""

import re
from collections.abc import Iterator
from math import isfinite
from pathlib import Path

from sorvolo.errors import InputError
from sorvolo.lab.datasets.parsed import (
    PICTURE_ENDINGS,
    SHARES,
    LabelFinding,
    ParsedBox,
    ParsedPicture,
    ParsedSet,
    files_below,
    findings_in,
    first_line,
    is_label_file,
    pictures_below,
    read_lines,
    read_text,
)

FORM = "YOLO"
_NAME_FILES = (
    "data.yaml",
    "dataset.yaml",
    "data.yml",
    "classes.txt",
    "obj.names",
    "_darknet.labels",
)
_PARTS = frozenset({"images", "labels", "train", "training", "val", "valid", "validation", "test"})
_FARTHEST_SHARE = 2.0  # an edge farther out is no slip of a labelling tool: the file holds pixels


def read_yolo(place: Path) -> ParsedSet:
    """A folder with `images/` and `labels/`, with both mixed, or with such folders for each part; or its data.yaml.

    Lines with a class and at least three corners (segments, turned boxes) give the box around them. Class names come
    from data.yaml, classes.txt or *.names there or above a part; else the class numbers are the names. Raises
    InputError when there are no pictures, no label files, or the numbers are no shares of the picture.
    """
    folder = place if place.is_dir() else place.parent
    names = _names(place, folder)
    pictures = pictures_below(folder)
    labels = {path: found for path in pictures if (found := _label_file(path)) is not None}
    if not pictures:
        endings = ", ".join(sorted(PICTURE_ENDINGS))
        raise InputError(f"{folder} holds no pictures ({endings}); YOLO needs images/ and labels/")
    if not labels:
        raise InputError(
            f"{folder}: none of its {len(pictures)} pictures has a label file of the same name, beside it or in a "
            f"folder labels/ beside images/ (such as labels/{pictures[0].stem}.txt)"
        )
    read: dict[Path, tuple[list[ParsedBox], list[LabelFinding]]] = {
        path: read_lines(labels[path], lambda line: _box(line, names))
        if path in labels
        else ([], [])
        for path in pictures
    }
    malformed = findings_in(read.values())
    boxes = [box for boxes, _ in read.values() for box in boxes]
    far = sum(max(abs(edge) for edge in box[1:5]) > _FARTHEST_SHARE for box in boxes)
    if far > len(boxes) / 2:
        raise InputError(
            f"{folder}: {far} of {len(boxes)} boxes have numbers beyond 1, as pixels would; YOLO labels are shares of "
            "the picture's width and height: centre x, centre y, width, height"
        )
    if not boxes and malformed:
        raise InputError(
            f"{folder}: no line of its label files is YOLO (class, centre x, centre y, width, height; first failure in "
            f"{malformed[0].place}); if it is another form, name it"
        )
    result = tuple(ParsedPicture(path, tuple(boxes), SHARES) for path, (boxes, _) in read.items())
    return ParsedSet(FORM, result, tuple(names), (*_lonely(folder, pictures, labels), *malformed))


def looks_like_yolo(line: str) -> bool:
    """Whether a line is a class number and at least four numbers with spaces between, none of them far beyond 1."""
    numbers = _numbers(line)
    return (
        len(numbers) >= 5
        and numbers[0] == int(numbers[0]) >= 0
        and max(map(abs, numbers[1:5])) <= _FARTHEST_SHARE
    )


def names_in_yaml(text: str) -> list[str]:
    """The `names` of a data.yaml: a list in brackets or with hyphens, or numbers with names, each over one or more
    lines. Gaps in the numbers are filled with the numbers as text. Empty where there is no `names`.
    """
    match = re.search(r"^names[ \t]*:[ \t]*(.*(?:\n(?:[ \t\-\]}].*)?)*)", text, re.MULTILINE)
    if not match:
        return []
    body = re.sub(r"(^|\s)#.*", "", match.group(1)).strip()
    named: dict[int, str] = {}
    # The entries of a list or mapping, in brackets or one a line; empty ones are left out
    if body.startswith(("[", "{")):
        items = [item.strip() for item in body.strip("[]{} \n").replace("\n", " ").split(",")]
    else:
        items = [line.strip().removeprefix("- ").strip() for line in body.splitlines()]
    yaml_items = [item for item in items if item]
    for index, item in enumerate(yaml_items):
        numbered = re.fullmatch(r"['\"]?(\d{1,6})['\"]?\s*:\s*(.*)", item)
        number, name = (int(numbered[1]), numbered[2]) if numbered else (index, item)
        named[number] = name.strip().strip("'\"")
    if not named or max(named) > 100_000:
        return []
    return [named.get(number, str(number)) for number in range(max(named) + 1)]


def _names(place: Path, folder: Path) -> list[str]:
    """The class names: of the data.yaml that was given, else of the first file of names that has any."""
    if place.is_file() and _is_yaml(place):
        return names_in_yaml(read_text(place))
    return next((names for path in _name_files(folder) if (names := _names_in(path))), [])


def _name_files(folder: Path) -> Iterator[Path]:
    """Files that may list class names, in the folder and, where it is one part of a set, above it."""
    above = [folder]
    while above[-1].name.lower() in _PARTS and above[-1] != above[-1].parent:
        above.append(above[-1].parent)
    for each in above:
        candidates = [each / name for name in _NAME_FILES]
        candidates += (
            sorted(each.glob("*.names"))
            + sorted(each.glob("*.yaml"))
            + [each / "labels" / "classes.txt"]
        )
        yield from (path for path in candidates if path.is_file())


def _names_in(path: Path) -> list[str]:
    text = read_text(path)
    return (
        names_in_yaml(text)
        if _is_yaml(path)
        else [line.strip() for line in text.splitlines() if line.strip()]
    )


def _is_yaml(path: Path) -> bool:
    return path.suffix.lower() in (".yaml", ".yml")


def _label_file(picture: Path) -> Path | None:
    """The picture's text file: beside it, or in the `labels` folder that mirrors the last `images` one."""
    beside = picture.with_suffix(".txt")
    parts = list(picture.parts)
    for index in reversed(range(len(parts) - 1)):
        if parts[index].lower() in ("images", "jpegimages"):
            mirrored = Path(*parts[:index], "labels", *parts[index + 1 :]).with_suffix(".txt")
            if mirrored.is_file():
                return mirrored
            break
    return beside if beside.is_file() and is_label_file(beside) else None


def _lonely(folder: Path, pictures: list[Path], labels: dict[Path, Path]) -> Iterator[LabelFinding]:
    """Label files of no picture, and pictures without a label file."""
    used = set(labels.values())
    for path in files_below(folder, ".txt"):
        if path not in used and is_label_file(path) and _is_label_place(path, folder):
            yield LabelFinding("labels_without_picture", path.name)
    for path in pictures:
        if path not in labels:
            yield LabelFinding("pictures_without_labels", path.name)


def _is_label_place(path: Path, folder: Path) -> bool:
    inside = [part.lower() for part in path.relative_to(folder).parts[:-1]]
    return "labels" in inside or looks_like_yolo(first_line(path))


def _box(line: str, names: list[str]) -> ParsedBox | None:
    """The box of a line; None where it is no label."""
    numbers = _numbers(line)
    if len(numbers) < 5 or numbers[0] != int(numbers[0]) or numbers[0] < 0:
        return None
    label = int(numbers[0])
    name = names[label] if label < len(names) else str(label)
    if len(numbers) >= 7 and len(numbers) % 2:
        xs, ys = numbers[1::2], numbers[2::2]
        return ParsedBox(name, min(xs), min(ys), max(xs), max(ys))
    x, y, width, height = numbers[1:5]  # a sixth number is a score or a track
    return ParsedBox(name, x - width / 2, y - height / 2, x + width / 2, y + height / 2)


def _numbers(line: str) -> list[float]:
    """The line's numbers; none if anything in it is no finite number."""
    try:
        numbers = [float(word) for word in line.split()]
    except ValueError:
        return []
    return numbers if all(isfinite(number) for number in numbers) else []
