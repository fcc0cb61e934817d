"""Tiny folders of labelled pictures, made for the tests of `store.datasets`."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image


def put_picture(
    path: Path, width: int = 200, height: int = 100, *, mode: str = "RGB", orientation: int = 1
) -> Path:
    """Write a picture of one colour, of any Pillow mode, with an EXIF orientation."""
    path.parent.mkdir(parents=True, exist_ok=True)
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.new(mode, (width, height)).save(path, **({} if orientation == 1 else {"exif": exif}))
    return path


def put_text(path: Path, text: str) -> Path:
    """Write a text file and the folders above it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    return path


def put_coco(
    path: Path, names: Sequence[str], boxes: Sequence[Sequence[Any]], **image: Any
) -> Path:
    """A COCO file: boxes are (index of the picture, category, left, top, width, height, iscrowd)."""
    whole = {
        "categories": [
            {"id": 1, "name": "person"},
            {"id": 7, "name": "car"},
            {"id": 8, "name": "boat"},
        ],
        "images": [
            {"id": index, "file_name": name, "width": 200, "height": 100, **image}
            for index, name in enumerate(names)
        ],
        "annotations": [
            {
                "id": n,
                "image_id": index,
                "category_id": category,
                "bbox": list(box[:4]),
                "iscrowd": int(box[4]),
            }
            for n, (index, category, *box) in enumerate(boxes)
        ],
    }
    return put_text(path, json.dumps(whole))


def put_voc(
    path: Path, objects: Sequence[Mapping[str, Any]], width: int = 200, height: int = 100
) -> Path:
    """A VOC file of objects with `name`, `box` and `difficult`."""
    rows = "".join(
        "<object><name>{name}</name><difficult>{difficult}</difficult><bndbox><xmin>{}</xmin><ymin>{}</ymin>"
        "<xmax>{}</xmax><ymax>{}</ymax></bndbox></object>".format(
            *each["box"], name=each["name"], difficult=each.get("difficult", 0)
        )
        for each in objects
    )
    size = f"<size><width>{width}</width><height>{height}</height><depth>3</depth></size>"
    return put_text(
        path, f"<annotation><filename>{path.stem}.jpg</filename>{size}{rows}</annotation>"
    )


def edges(boxes_px: Any) -> list[list[float]]:
    """Boxes as lists, rounded for comparison."""
    return [[round(float(edge), 3) for edge in box] for box in np.asarray(boxes_px)]
