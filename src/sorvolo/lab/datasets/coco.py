"""COCO: one JSON file with pictures, categories and boxes; the simulator's own truth is of this form."""

import json
import os
from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial
from math import isfinite
from pathlib import Path, PureWindowsPath
from typing import Any

from sorvolo.capture.small_files import as_number
from sorvolo.errors import InputError
from sorvolo.lab.datasets.parsed import (
    PICTURE_ENDINGS,
    LabelFinding,
    ParsedBox,
    ParsedPicture,
    ParsedSet,
    joined,
    pictures_below,
    read_text,
)
from sorvolo.paths import Json, JsonView

FORM = "COCO"
_VIDEO_FIELDS = ("video_id", "video", "flight", "sequence", "seq_id", "clip")
_VIDEO_ENDINGS = frozenset({".mp4", ".mov", ".avi", ".mkv", ".ts"})


def read_coco(place: Path) -> ParsedSet:
    """The JSON file, or a folder (or its `annotations/`) with exactly one of this form.

    `iscrowd` and `ignore` make a box a region to ignore. Pictures are looked for beside the file, in `images/`,
    in a folder named like the file, and for a simulated flight's truth in the flight's folder. Raises InputError when
    it is no COCO file, or none of its pictures is there.
    """
    path = coco_file(place)
    whole = _loaded(path)
    categories = {
        row.get("id"): str(row.get("name", row.get("id")))
        for row in _rows(whole, "categories", path)
    }
    images = {}
    for row in _rows(whole, "images", path):
        if row.get("id") is None or row["id"] in images:
            raise InputError(
                f"{path}: an image has no id, or that of another ({row.get('id')}); each needs its own"
            )
        images[row["id"]] = row
    # the boxes of each image, by its id; what was wrong with the others
    rows = _rows(whole, "annotations", path)
    boxes: dict[Any, list[ParsedBox]] = {}
    wrong = []
    for row in rows:
        box = _box(row, categories)
        if box is None:
            wrong.append(LabelFinding("malformed_labels", f"annotation {row.get('id')}"))
        elif row.get("image_id") not in images:
            wrong.append(LabelFinding("labels_without_picture", f"annotation {row.get('id')}"))
        else:
            boxes.setdefault(row["image_id"], []).append(box)
    # the images whose picture is there, and those that have none
    pictures, missing = [], []
    folders = _folders(path)
    # for pictures that are not where the file has them
    by_name = cache(partial(_by_name, path.parent))
    for image_id, row in images.items():
        name = _inside(path, str(row.get("file_name", "")).replace("\\", "/"))
        found = _found(name, folders, by_name) if name else None
        if found is None:
            missing.append(
                LabelFinding(
                    "labels_without_picture", name or f"image {image_id} without file_name"
                )
            )
            continue
        size = _finite([row.get("width"), row.get("height")])
        pictures.append(
            ParsedPicture(
                found,
                tuple(boxes.get(image_id, ())),
                (size[0], size[1]) if size and min(size) > 0 else None,
                _video(row),
                next(iter(_finite([row.get("m_per_px")])), float("nan")),
            )
        )
    if not pictures:
        raise _no_picture(path, images)
    each_once, twice = joined(pictures)
    return ParsedSet(
        FORM, each_once, tuple(dict.fromkeys(categories.values())), (*wrong, *missing, *twice)
    )


def coco_file(place: Path) -> Path:
    """The folder's one COCO file, or the file itself. Raises InputError for none and for several."""
    if place.is_file():
        return place
    found = coco_files(place)
    if not found:
        raise InputError(
            f"{place} holds no COCO file (JSON with images, annotations and categories)"
        )
    if len(found) > 1:
        names = ", ".join(str(path.relative_to(place)) for path in found[:5])
        raise InputError(f"{place} holds {len(found)} COCO files ({names}); name the one to read")
    return found[0]


def coco_files(folder: Path) -> list[Path]:
    """COCO files in the folder, else in its `annotations/`, else one folder below, else a simulation's truth."""
    for pattern in ("*.json", "annotations/*.json", "*/*.json", "truth/*/boxes.json"):
        found = [
            path
            for path in sorted(folder.glob(pattern))
            if path.is_file() and _looks_like_coco(path)
        ]
        if found:
            return found
    return []


def _looks_like_coco(path: Path) -> bool:
    text = read_text(path)  # only searched: a large one takes seconds to parse
    there = ['"images"' in text, '"annotations"' in text]
    return all(there) or (any(there) and _is_cut(text))


def _is_cut(text: str) -> bool:
    """Whether it cannot be a whole JSON object."""
    return not text.rstrip().endswith("}")


def _loaded(path: Path) -> Json:
    text = read_text(path)
    try:
        whole = json.loads(text)
    except json.JSONDecodeError as error:
        how = "breaks off" if _is_cut(text) or error.pos >= len(text.rstrip()) else "is damaged"
        raise InputError(
            f"{path} {how} at line {error.lineno}, column {error.colno} (character {error.pos} of {len(text)}: "
            f"{error.msg}); COCO labels are one whole JSON file: copy or export it again"
        ) from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path} is no JSON ({error}); COCO labels are one JSON file") from error
    missing = (
        [key for key in ("images", "annotations", "categories") if key not in whole]
        if isinstance(whole, dict)
        else ["images", "annotations", "categories"]
    )
    if missing:
        raise InputError(f"{path} is no COCO file: it has no {', '.join(missing)}")
    return whole


def _rows(whole: JsonView, key: str, path: Path) -> list[Json]:
    rows = whole[key]
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise InputError(f"{path}: COCO's {key} must be a list of objects")
    if any(
        isinstance(row.get(field), (list, dict))
        for row in rows
        for field in ("id", "image_id", "category_id")
    ):
        raise InputError(
            f"{path}: an id in COCO's {key} is a list or an object; ids are numbers or texts"
        )
    return rows


def _box(row: JsonView, categories: Mapping[Any, str]) -> ParsedBox | None:
    """The annotation's box, else the one around its polygons; None when it has none."""
    edges = _edges(row)
    if edges is None:
        return None
    is_ignored = bool(row.get("iscrowd")) or bool(row.get("ignore"))
    category = row.get("category_id")
    return ParsedBox(categories.get(category, str(category)), *edges, is_ignored)


def _edges(row: JsonView) -> tuple[float, float, float, float] | None:
    """Left, top, right, bottom; None without a box and without polygons."""
    numbers = _finite(row.get("bbox"))
    if len(numbers) == 4:
        left, top, width, height = numbers
        return left, top, left + width, top + height
    points = row.get("segmentation")
    flat = [_finite(ring) for ring in points] if isinstance(points, list) else []
    xs = [x for ring in flat for x in ring[0::2]]
    ys = [y for ring in flat for y in ring[1::2]]
    if len(xs) < 2 or len(xs) != len(ys):
        return None
    return min(xs), min(ys), max(xs), max(ys)


def _finite(value: Any) -> list[float]:
    try:
        numbers = [as_number(number) for number in value]
    except (TypeError, ValueError, OverflowError):
        return []
    return numbers if all(isfinite(number) for number in numbers) else []


def _found(
    name: str, folders: Sequence[Path], by_name: Callable[[], Mapping[str, Sequence[Path]]]
) -> Path | None:
    """The picture in one of the folders, else the only one of its name."""
    found = next((folder / name for folder in folders if os.path.isfile(folder / name)), None)
    if found is None:
        same = by_name().get(Path(name).name, [])
        found = same[0] if len(same) == 1 else None
    return found


def _video(row: JsonView) -> str:
    """The name of the video that the picture is of; empty where the file names none."""
    return next(
        (str(row[field]) for field in _VIDEO_FIELDS if row.get(field) not in (None, "")), ""
    )


def _inside(path: Path, name: str) -> str:
    """The picture's name as given; raises InputError where it leads out of the set's folder."""
    place = Path(os.path.normpath(path.parent / name))
    folders = [path.parent, *(each for each in _folders(path) if each != path.parent.parent)]
    is_below = any(place.is_relative_to(os.path.normpath(each)) for each in folders)
    if (
        name.startswith("/")
        or PureWindowsPath(name).drive
        or (".." in name.split("/") and not is_below)
    ):
        raise InputError(
            f"{path}: its file_name {name!r} leads out of the set; needed are names below the label file's folder or "
            "in images/ beside it: put the label file beside its pictures and give their names alone"
        )
    return name


def _folders(path: Path) -> list[Path]:
    part = path.stem.removeprefix("instances_")
    flight = path.parent.parent.parent / path.parent.name  # a simulation's truth/flight1/boxes.json
    places = [path.parent / each for each in ("", "images", part, f"images/{part}")]
    places += [path.parent.parent / each for each in ("", "images", part, f"images/{part}")]
    places += [flight / "photos", flight]
    return [place for place in places if place.is_dir()]


def _by_name(folder: Path) -> dict[str, list[Path]]:
    found: dict[str, list[Path]] = {}
    for path in pictures_below(folder):
        found.setdefault(path.name, []).append(path)
    return found


def _no_picture(path: Path, images: Mapping[Any, JsonView]) -> InputError:
    names = [str(row.get("file_name", "")) for row in images.values()]
    for folder in _folders(path):
        videos = [
            each for each in sorted(folder.iterdir()) if each.suffix.lower() in _VIDEO_ENDINGS
        ]
        if videos:
            return InputError(
                f"{path} labels frames of a video ({videos[0].name}), not pictures; extract its frames first, as "
                f"{names[0] if names else 'its file_name has it'}, into images/ beside the labels"
            )
    if not names:
        return InputError(f"{path} lists no images")
    endings = ", ".join(sorted(PICTURE_ENDINGS))
    return InputError(
        f"{path}: none of its {len(names)} pictures is there (such as {names[0]}; {endings}); put them beside it or "
        "into images/"
    )
