"""Labels written as other tools read them: COCO's JSON, YOLO's text files. `store.datasets` reads both back."""

import os
from collections.abc import Iterable, Sequence
from math import isfinite
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from sorvolo.errors import InputError
from sorvolo.geometry.arrays import BoxesPx, Floats, Labels
from sorvolo.store.atomic import atomic_write_bytes, writing
from sorvolo.store.exports.plain import json_bytes
from sorvolo.survey.labels import LabelledPicture, LabelledSet
from sorvolo.survey.objects import Detections


def picture_of_detections(
    path: str,
    width_px: int,
    height_px: int,
    group: str,
    detections: Detections,
    m_per_px: float = float("nan"),
) -> LabelledPicture:
    """What a detector saw in a picture, as labels to correct and to learn from; scores are not kept."""
    no_regions = np.zeros((0, 4), np.float32)
    return LabelledPicture(
        path,
        width_px,
        height_px,
        group,
        detections.boxes_px,
        np.asarray(detections.labels, np.int64),
        no_regions,
        m_per_px,
    )


def coco_document(
    labelled: LabelledSet, folder: Path, scores: Sequence[Floats] | None = None
) -> dict[str, Any]:
    """The set as a COCO document for a file in `folder`, to which file names are relative.

    Ids count from 1, categories in the order of the classes. A picture's group is its `flight`, `m_per_px` is added
    where known. An ignored region is a crowd (`iscrowd` 1) of every class. `scores`, an array for each picture, makes
    each box's `score`.
    """
    images: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    for index, picture in enumerate(labelled.pictures):
        images.append(_image_row(picture, index + 1, folder))
        for row, (box, label) in enumerate(zip(picture.boxes_px, picture.labels)):
            annotation = _annotation(box, int(label), index + 1, 0)
            if scores is not None:
                annotation["score"] = round(float(scores[index][row]), 4)
            annotations.append(annotation)
        for label in range(len(labelled.classes)):
            annotations += [_annotation(box, label, index + 1, 1) for box in picture.ignored_px]
    return {
        "info": {"description": labelled.name},
        "categories": [
            {"id": number, "name": name} for number, name in enumerate(labelled.classes, start=1)
        ],
        "images": images,
        "annotations": [{"id": number, **row} for number, row in enumerate(annotations, start=1)],
    }


def write_coco(path: Path, labelled: LabelledSet, scores: Sequence[Floats] | None = None) -> None:
    """Write `coco_document` to the file `path`, whole or not at all. Raises StoreError on a full disk."""
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
    atomic_write_bytes(path, json_bytes(coco_document(labelled, path.parent, scores)))


def write_yolo(folder: Path, labelled: LabelledSet) -> int:
    """Write `labels/*.txt`, `classes.txt` and `data.yaml` to `folder`; the number of ignored regions, which YOLO
    cannot express and which are left out.

    Pictures are expected in `folder/images`, where those that lie there already keep their sub-folders; others are
    to be copied there under their own names. A picture without boxes gets an empty file. Raises InputError when two
    pictures would have the same label file, StoreError on a full disk.
    """
    texts: dict[PurePath, str] = {}
    for picture in labelled.pictures:
        place = _place_in_images(picture, folder).with_suffix(".txt")
        if place in texts:
            raise InputError(
                f"two pictures are named {place.stem}, as YOLO's label files cannot be; rename one: {picture.path}"
            )
        texts[place] = yolo_text(
            picture.boxes_px, picture.labels, picture.width_px, picture.height_px
        )
    for place, text in texts.items():
        write_yolo_text(folder / "labels" / place, text)
    write_yolo_names(folder, labelled.classes)
    return sum(len(picture.ignored_px) for picture in labelled.pictures)


def yolo_text(boxes_px: BoxesPx, labels: Labels, width_px: int, height_px: int) -> str:
    """A line for each box, (N, 4): class number, centre x and y, width and height as shares of the picture's."""
    edges = np.asarray(boxes_px, np.float64).reshape(-1, 4) / np.array([width_px, height_px] * 2)
    centres, sides = (edges[:, :2] + edges[:, 2:]) / 2, edges[:, 2:] - edges[:, :2]
    return "".join(
        f"{int(label)} {x:.7f} {y:.7f} {width:.7f} {height:.7f}\n"
        for label, (x, y), (width, height) in zip(labels, centres, sides)
    )


def write_yolo_text(path: Path, text: str) -> None:
    """Write one label file and the folders above it. Raises StoreError on a full disk."""
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
    atomic_write_bytes(path, text.encode(), durable=False)


def write_yolo_names(folder: Path, classes: Iterable[str]) -> None:
    """Write `classes.txt` and `data.yaml`, the two places where tools look for YOLO's class names."""
    names = list(classes)
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
    atomic_write_bytes(
        folder / "classes.txt", "".join(f"{name}\n" for name in names).encode(), durable=False
    )
    numbered = [f"  {number}: {_quoted(name)}" for number, name in enumerate(names)]
    lines = ["path: .", "train: images", "val: images", "names:", *numbered]
    atomic_write_bytes(folder / "data.yaml", ("\n".join(lines) + "\n").encode(), durable=False)


def _image_row(picture: LabelledPicture, image_id: int, folder: Path) -> dict[str, Any]:
    row: dict[str, Any] = {
        "id": image_id,
        "file_name": _relative(picture.path, folder),
        "width": picture.width_px,
        "height": picture.height_px,
        "flight": picture.group,
    }
    return row | ({"m_per_px": round(picture.m_per_px, 6)} if isfinite(picture.m_per_px) else {})


def _annotation(
    box_px: Iterable[float], label: int, image_id: int, is_crowd: int
) -> dict[str, Any]:
    left, top, right, bottom = (float(edge) for edge in box_px)
    width, height = right - left, bottom - top
    return {
        "image_id": image_id,
        "category_id": label + 1,
        "area": round(width * height, 2),
        "iscrowd": is_crowd,
        "bbox": [round(left, 3), round(top, 3), round(width, 3), round(height, 3)],
    }


def _relative(path: str, folder: Path) -> str:
    """The picture's path from the folder, with "/" between; a relative path is taken as from there already."""
    if not Path(path).is_absolute():
        return Path(path).as_posix()
    try:
        return Path(os.path.relpath(path, folder.resolve())).as_posix()
    except ValueError:  # another drive
        return Path(path).as_posix()


def _place_in_images(picture: LabelledPicture, folder: Path) -> PurePath:
    path = Path(picture.path)
    for images in (folder / "images", (folder / "images").resolve(), Path("images")):
        if path.is_relative_to(images):
            return path.relative_to(images)
    return PurePath(path.name)


def _quoted(name: str) -> str:
    """A name as a YAML scalar in single quotes."""
    return "'" + name.replace("'", "''") + "'"
