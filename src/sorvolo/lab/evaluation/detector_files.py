"""Detections of a whole data set as one JSON file, and pictures of mistakes."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from sorvolo.errors import InputError
from sorvolo.geometry.arrays import BoxesPx, ImageRGB
from sorvolo.store.atomic import atomic_write_bytes
from sorvolo.survey.objects import Detections

_MADE_BY = "sorvolo evaluate detector"
_FORMAT = 2
_CROP_PX = 220  # side of a picture on a page
_LABEL_COLOUR, _FOUND_COLOUR = (40, 220, 90), (255, 150, 30)


@dataclass(frozen=True, eq=False)
class FoundSet:
    """What a model found in one set: its pictures' file names, one Detections a picture, and from which score on each
    class is reported there; a model may have other thresholds for thermal frames."""

    files: tuple[str, ...]
    detections: tuple[Detections, ...]
    thresholds: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class FoundSets:
    """What one model found, by the sets' names.

    `seconds_per_picture` is NaN where it was not measured; `notices` are the detector's own notices.
    """

    name: str
    classes: tuple[str, ...]
    sets: Mapping[str, FoundSet]
    seconds_per_picture: float = float("nan")
    notices: tuple[str, ...] = ()


def write_found(path: Path, found: FoundSets) -> None:
    """Write detections.json (docs/formats.md): boxes to 0.01 px, scores to 1e-5. Raises StoreError on a full disk."""
    content = {
        "made_by": _MADE_BY,
        "format": _FORMAT,
        "model": found.name,
        "classes": list(found.classes),
        "sets": {
            name: {
                "thresholds": dict(one.thresholds),
                "pictures": [
                    {
                        "file": file,
                        "boxes_px": np.round(each.boxes_px.astype(float), 2).tolist(),
                        "scores": np.round(each.scores, 5).tolist(),
                        "labels": each.labels.tolist(),
                    }
                    for file, each in zip(one.files, one.detections)
                ],
            }
            for name, one in found.sets.items()
        },
    }
    atomic_write_bytes(path, (json.dumps(content, separators=(",", ":")) + "\n").encode())


def read_found(path: Path) -> FoundSets:
    """Read what `write_found` wrote. Raises InputError for any other file."""
    try:
        content = json.loads(path.read_bytes())
        if content["format"] != _FORMAT:
            raise ValueError(f"format {content['format']!r}, not {_FORMAT}")
        classes = tuple(str(name) for name in content["classes"])
        sets = {
            str(name): FoundSet(
                tuple(str(row["file"]) for row in one["pictures"]),
                tuple(_detections(row, classes) for row in one["pictures"]),
                {each: float(one["thresholds"][each]) for each in classes},
            )
            for name, one in content["sets"].items()
        }
        return FoundSets(str(content["model"]), classes, sets)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(
            f"{path}: not detections.json of `sorvolo evaluate detector --out` ({error}); give that file, or a model"
        ) from error


def mistake_picture(
    image: ImageRGB, box_px: Sequence[float], labels_px: BoxesPx, found_px: BoxesPx
) -> ImageRGB:
    """A square crop around a box, enlarged, with the labels in it (green) and what was reported (orange)."""
    left, top, right, bottom = box_px
    side = max(3.0 * max(right - left, bottom - top), 48.0)
    x0, y0 = (left + right - side) / 2, (top + bottom - side) / 2
    scale = _CROP_PX / side
    matrix = np.array(
        [[scale, 0, -scale * x0 + (scale - 1) / 2], [0, scale, -scale * y0 + (scale - 1) / 2]]
    )
    crop = cv2.warpAffine(
        image, matrix, (_CROP_PX, _CROP_PX), flags=cv2.INTER_LINEAR, borderValue=(60, 60, 60)
    )
    for boxes, colour in ((labels_px, _LABEL_COLOUR), (found_px, _FOUND_COLOUR)):
        for edges in boxes:
            low, high = (
                np.round((edges[k : k + 2] - [x0, y0]) * scale).astype(int).tolist() for k in (0, 2)
            )
            cv2.rectangle(crop, low, high, colour, 2, cv2.LINE_AA)
    return np.asarray(crop, np.uint8)


def _detections(row: Mapping[str, Any], classes: tuple[str, ...]) -> Detections:
    boxes = np.array(row["boxes_px"], np.float32).reshape(-1, 4)
    return Detections(
        boxes, np.array(row["scores"], float), np.array(row["labels"], np.int64), classes
    )
