"""Networks of other makers: what they take, and how their numbers become boxes (docs/model-file.md)."""

import ast
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import cv2
import numpy as np

from sorvolo.detection.contract import FORMAT, METADATA_KEY
from sorvolo.errors import InputError
from sorvolo.geometry.arrays import Floats, Numbers

Size: TypeAlias = tuple[int, int]
"""Height and width of a network's input, px."""

Decoded: TypeAlias = tuple[Floats, Floats]
"""Boxes (N, 4), left, top, right, bottom in px of the input, and scores (N, columns) of the network's classes."""

AUTO = "auto"
WISH_KEY = "sorvolo-import"
"""The key in a foreign file's metadata under which what is wished of its import lies: layout, classes and name."""

_LEAST_SCORE = 0.02  # weaker boxes are no evidence; networks give thousands of them
_MOST_BOXES = 300
_SUPPRESS_IOU = 0.6  # of two boxes of a class that overlap more, the better one stays
_STRIDES = (8, 16, 32)
_DISTANCES = 8  # bins of each side's distance in NanoDet (Li et al. 2020, generalized focal loss)
_USUAL_SIDE_PX = 640  # of an input whose size is free
_REPORTED_FROM = 0.4  # score of each class until `sorvolo evaluate detector` shows a better one
_FOUND_FROM_PX, _FOUND_TO = (
    12,
    0.8,
)  # longer sides that are found well: px; share of the input's side

_IMAGENET = (123.675, 116.28, 103.53), (58.395, 57.12, 57.375)
_UNIT = (0.0, 0.0, 0.0), (255.0, 255.0, 255.0)
_RAW = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)

_OURS = {
    "pedestrian": "person", "people": "person", "human": "person", "persons": "person",
    "cars": "car", "vehicle": "car", "van": "car", "bike": "bicycle", "motorbike": "motorcycle",
    "motor": "motorcycle",
}  # fmt: skip
_USUAL = ("person", "car", "truck", "bus", "bicycle", "motorcycle", "boat")
"""Classes of a network of many that are reported without being asked for: what stands on ground that is searched."""

_COCO_NAMES = (
    "person bicycle car motorcycle airplane bus train truck boat traffic_light fire_hydrant stop_sign parking_meter "
    "bench bird cat dog horse sheep cow elephant bear zebra giraffe backpack umbrella handbag tie suitcase frisbee skis "
    "snowboard sports_ball kite baseball_bat baseball_glove skateboard surfboard tennis_racket bottle wine_glass cup "
    "fork knife spoon bowl banana apple sandwich orange broccoli carrot hot_dog pizza donut cake chair couch "
    "potted_plant bed dining_table toilet tv laptop mouse remote keyboard cell_phone microwave oven toaster sink "
    "refrigerator book clock vase scissors teddy_bear hair_drier toothbrush"
)
COCO = tuple(_COCO_NAMES.split())
_COCO_UNUSED = (0, 12, 26, 29, 30, 45, 66, 68, 69, 71, 83)  # ids of COCO's 91 that name nothing


def _centred(rows: Numbers) -> Floats:
    """Boxes of centre and size as left, top, right, bottom."""
    middle, half = rows[:, :2], rows[:, 2:4] / 2
    return np.asarray(np.concatenate([middle - half, middle + half], axis=1), np.float64)


def _grid(size: Size, strides: Sequence[int]) -> tuple[Floats, Floats]:
    """Column and row (N, 2) of each cell of all levels, level by level, and the level's stride (N, 1)."""
    cells, steps = [], []
    for stride in strides:
        rows, columns = (-(-side // stride) for side in size)
        y, x = np.mgrid[:rows, :columns]
        cells.append(np.column_stack([x.ravel(), y.ravel()]).astype(np.float64))
        steps.append(np.full((rows * columns, 1), float(stride)))
    return np.concatenate(cells), np.concatenate(steps)


def _yolov8(outputs: Mapping[str, Numbers], size: Size) -> Decoded:
    rows = np.asarray(next(iter(outputs.values()))[0], np.float64).T
    return _centred(rows), rows[:, 4:]


def _yolov5(outputs: Mapping[str, Numbers], size: Size) -> Decoded:
    rows = np.asarray(next(iter(outputs.values()))[0], np.float64)
    return _centred(rows), rows[:, 4:5] * rows[:, 5:]


def _yolox(outputs: Mapping[str, Numbers], size: Size) -> Decoded:
    """Ge et al. 2021: a cell's box by its offset in strides and the logarithm of its sides."""
    rows = np.asarray(next(iter(outputs.values()))[0], np.float64)
    cells, stride = _grid(size, _STRIDES)
    boxes = np.concatenate([(rows[:, :2] + cells) * stride, np.exp(rows[:, 2:4]) * stride], axis=1)
    return _centred(boxes), rows[:, 4:5] * rows[:, 5:]


def _nanodet(outputs: Mapping[str, Numbers], size: Size) -> Decoded:
    """NanoDet-Plus: a cell's box by its distances to four sides, each the mean of a distribution."""
    rows = np.asarray(next(iter(outputs.values()))[0], np.float64)
    four = _grid(size, (*_STRIDES, 64))
    cells, stride = four if len(four[0]) == len(rows) else _grid(size, _STRIDES)
    shares = np.exp(rows[:, -4 * _DISTANCES :].reshape(-1, 4, _DISTANCES))
    shares /= shares.sum(axis=2, keepdims=True)
    left_top_right_bottom = shares @ np.arange(_DISTANCES) * stride
    middles = cells * stride
    low, high = left_top_right_bottom[:, :2], left_top_right_bottom[:, 2:]
    return np.concatenate([middles - low, middles + high], axis=1), rows[:, : -4 * _DISTANCES]


def _detr(outputs: Mapping[str, Numbers], size: Size) -> Decoded:
    """Carion et al. 2020 and its kin: queries, each a box in shares of the picture and a score of each class.

    Three forms: one output (boxes and scores), two (boxes and logits), or three (labels, boxes in px, scores).
    """
    scale = np.array([size[1], size[0], size[1], size[0]], np.float64)
    if len(outputs) == 1:
        rows = np.asarray(next(iter(outputs.values()))[0], np.float64)
        return _centred(rows) * scale, rows[:, 4:]
    arrays = [np.asarray(each)[0] for each in outputs.values()]
    boxes = next(each for each in arrays if each.ndim == 2 and each.shape[1] == 4)
    if len(outputs) == 2:
        logits = next(each for each in arrays if each is not boxes)
        return _centred(boxes) * scale, np.asarray(
            1 / (1 + np.exp(-np.asarray(logits, np.float64))), np.float64
        )
    labels = next(each for each in arrays if each.ndim == 1 and each.dtype.kind in "iu")
    sure = next(each for each in arrays if each.ndim == 1 and each.dtype.kind == "f")
    scores = np.zeros((len(labels), int(labels.max(initial=0)) + 1))
    scores[np.arange(len(labels)), labels] = sure
    return np.asarray(boxes, np.float64), scores


def _ended(outputs: Mapping[str, Numbers], size: Size) -> Decoded:
    """Boxes that the network has suppressed itself: left, top, right, bottom, score, label."""
    rows = np.asarray(next(iter(outputs.values())), np.float64).reshape(-1, 6)
    labels = rows[:, 5].astype(np.int64)
    scores = np.zeros((len(rows), int(labels.max(initial=0)) + 1))
    scores[np.arange(len(rows)), labels] = rows[:, 4]
    return rows[:, :4], scores


@dataclass(frozen=True)
class NetworkLayout:
    """One maker's convention: how a picture is given, what comes back, whether its boxes must be suppressed."""

    decode: Callable[[Mapping[str, Numbers], Size], Decoded]
    colours: tuple[tuple[float, float, float], tuple[float, float, float]] = _UNIT  # mean, scale
    is_bgr: bool = False
    suppresses: bool = True


LAYOUTS: Mapping[str, NetworkLayout] = {
    "yolov8": NetworkLayout(_yolov8),
    "yolov5": NetworkLayout(_yolov5),
    "yolox": NetworkLayout(_yolox, _RAW, is_bgr=True),
    "nanodet": NetworkLayout(_nanodet, _IMAGENET, is_bgr=True),
    "rtdetr": NetworkLayout(_detr, suppresses=False),
    "dfine": NetworkLayout(_detr, suppresses=False),
    "rfdetr": NetworkLayout(_detr, _IMAGENET, suppresses=False),
    "yolov10": NetworkLayout(_ended, suppresses=False),
}
"""By name; yolov8 is also YOLO11's, yolov10 that of any network with NMS inside."""


@dataclass(frozen=True)
class Port:
    """One input or output of a network: its name, its type ("float", "float16", "int64" ...), its shape."""

    name: str
    kind: str
    shape: tuple[int | str | None, ...]


def picture_input(inputs: Sequence[Port], where: str) -> tuple[Port, Size | None]:
    """The input that takes the picture, (1 or free, 3, H, W), and its size; None where that is free.

    Raises InputError where there is none.
    """
    for port in inputs:
        shape = port.shape
        if len(shape) == 4 and shape[1] == 3 and (shape[0] == 1 or not isinstance(shape[0], int)):
            height, width = shape[2:]
            if isinstance(height, int) and isinstance(width, int):
                return port, (height, width)
            return port, None
    found = ", ".join(f"{port.name} {port.kind} {list(port.shape)}" for port in inputs)
    raise InputError(
        f"{where} takes {found}; needed is an input of shape (1, 3, H, W): export it for one colour picture"
    )


def runner(
    layout: str,
    columns: Sequence[str],
    classes: Sequence[str],
    inputs: Sequence[Port],
    call: Callable[[Mapping[str, Any]], Mapping[str, Numbers]],
    where: str,
) -> Callable[[Any], tuple[Numbers, ...]]:
    """What runs such a network as one of ours: planes (1, 3, H, W) to boxes, scores and labels of `classes`.

    `columns` names the class of each of the network's scores, "" for none; `call` runs the network.
    """
    port, _ = picture_input(inputs, where)
    chosen = LAYOUTS[layout]
    mean, scale = (np.array(each, np.float32).reshape(1, 3, 1, 1) for each in chosen.colours)
    of_class = [[k for k, name in enumerate(columns) if name == each] for each in classes]

    def run(planes: Any) -> tuple[Numbers, ...]:
        size = int(planes.shape[2]), int(planes.shape[3])
        decoded, scores = chosen.decode(call(feeds(planes)), size)
        if scores.shape[1] < len(columns):  # only some labels occur
            scores = np.pad(scores, ((0, 0), (0, len(columns) - scores.shape[1])))
        best = np.column_stack([scores[:, rows].max(axis=1) for rows in of_class])
        rows, labels = np.nonzero(best >= _LEAST_SCORE)
        boxes, sure = decoded[rows], best[rows, labels]
        if chosen.suppresses and len(rows):
            sides = np.column_stack([boxes[:, :2], boxes[:, 2:] - boxes[:, :2]])
            kept = np.asarray(
                cv2.dnn.NMSBoxesBatched(
                    sides.tolist(), sure.tolist(), labels.tolist(), _LEAST_SCORE, _SUPPRESS_IOU
                ),
                np.int64,
            ).ravel()
            boxes, sure, labels = boxes[kept], sure[kept], labels[kept]
        order = np.argsort(-sure, kind="stable")[:_MOST_BOXES]
        return boxes[order].astype(np.float32), sure[order].astype(np.float32), labels[order]

    def feeds(planes: Any) -> dict[str, Any]:
        given: dict[str, Any] = {}
        for each in inputs:
            if each is port:
                shown = planes if "uint8" in each.kind else (planes - mean) / scale
                shown = shown[:, ::-1] if chosen.is_bgr else shown
                given[each.name] = np.ascontiguousarray(shown, _type(each.kind))
            else:  # the picture's size, as RT-DETR's own export asks for it: width and height
                given[each.name] = np.array([planes.shape[3], planes.shape[2]], np.int64)[None]
        return given

    return run


def resolved(
    wish: Mapping[str, Any],
    metadata: Mapping[str, str],
    inputs: Sequence[Port],
    call: Callable[[Mapping[str, Any]], Mapping[str, Numbers]],
    where: str,
) -> dict[str, Any]:
    """The metadata of a foreign network, by what is wished (`layout`, `classes`, `name`), what its own metadata state,
    and what it answers to a grey picture.

    Raises InputError for a layout that it does not recognise and for classes without names.
    """
    port, fixed = picture_input(inputs, where)
    if METADATA_KEY in metadata:
        raise InputError(
            f"{where} is a model of Sorvolo already: give it to --model, or copy it to your models' folder"
        )
    size = fixed or (_USUAL_SIDE_PX, _USUAL_SIDE_PX)
    named = [str(each) for each in wish.get("classes") or _own_names(metadata)]
    probe = {
        each.name: np.full((1, 3, *size), 114, np.uint8).astype(_type(each.kind))
        if each is port
        else np.array([size[1], size[0]], np.int64)[None]
        for each in inputs
    }
    outputs = call(probe)
    layout = str(wish.get("layout") or AUTO)
    if layout == AUTO:
        layout = _recognised(outputs, size, len(named), where)
    if layout not in LAYOUTS:
        raise InputError(f"there is no layout {layout!r}; there are {', '.join(LAYOUTS)}")
    try:
        _, scores = LAYOUTS[layout].decode(outputs, size)
    except (ValueError, IndexError, StopIteration) as error:
        raise InputError(
            f"{where} answers with {_shapes(outputs)}, which is no {layout}; give another --layout"
        ) from error
    ends = layout == "yolov10" or len(outputs) == 3  # labels, not a column of each class
    columns = _columns(named, None if ends else scores.shape[1], where)
    classes = list(dict.fromkeys(name for name in columns if name))
    usual = [name for name in classes if name in _USUAL]
    side_px = max(size)
    return {
        "format": FORMAT,
        "name": str(wish.get("name") or "foreign"),
        "layout": layout,
        "columns": columns,
        "classes": classes,
        "on_request": [name for name in classes if usual and name not in usual],
        "thresholds": dict.fromkeys(classes, _REPORTED_FROM),
        "best_px": {name: [_FOUND_FROM_PX, _FOUND_TO * side_px] for name in classes},
        "stride": 32,
        "precision": "float16" if "16" in port.kind else "float32",
        "licence": str(metadata.get("license", "")),
    }


def with_metadata(model: bytes, fields: Mapping[str, Any], key: str = METADATA_KEY) -> bytes:
    """An ONNX file with one more entry of `metadata_props` (field 14), behind its last byte."""

    def part(tag: int, data: bytes) -> bytes:
        length, sizes = len(data), bytearray()
        while length > 127:
            sizes.append(length & 127 | 128)
            length >>= 7
        return bytes([tag, *sizes, length]) + data

    text = json.dumps(fields).encode()
    return model + part(14 << 3 | 2, part(10, key.encode()) + part(18, text))


def _type(kind: str) -> Any:
    return np.uint8 if "uint8" in kind else np.float16 if "16" in kind else np.float32


def _own_names(metadata: Mapping[str, str]) -> list[str]:
    """The classes that Ultralytics' export writes into a file, {0: 'person', ...}."""
    try:
        names = ast.literal_eval(metadata.get("names", "[]"))
    except (ValueError, SyntaxError):
        return []
    if isinstance(names, dict):
        return [str(names[key]) for key in sorted(names)]
    return [str(each) for each in names] if isinstance(names, list | tuple) else []


def _columns(named: Sequence[str], count: int | None, where: str) -> list[str]:
    """The name of each of a network's classes, in our words; COCO's where there are as many and none is given."""
    names = list(named)
    if not names and count in (len(COCO), 91, None):
        names = list(COCO)
        if count == 91:
            rest = iter(COCO)
            names = ["" if k in _COCO_UNUSED else next(rest) for k in range(91)]
    if not names or (count is not None and len(names) != count):
        stated = f"{len(names)} are named" if names else "it names none"
        raise InputError(
            f"{where} tells {count} classes apart and {stated}; name them in the network's order: --classes person,car,..."
        )
    tidy = [name.strip().replace("_", " ").lower() for name in names]
    return [_OURS.get(name, name) for name in tidy]


def _recognised(outputs: Mapping[str, Numbers], size: Size, named: int, where: str) -> str:
    """The layout that such outputs have; `named` is how many classes are known by name, 0 for unknown."""
    shapes = [each.shape for each in outputs.values()]
    if len(outputs) == 3 and any(each.dtype.kind in "iu" for each in outputs.values()):
        return "rtdetr"
    if len(outputs) == 2 and all(len(shape) == 3 for shape in shapes):
        return "rfdetr" if "dets" in outputs else "rtdetr"
    cells = len(_grid(size, _STRIDES)[0])
    more = len(_grid(size, (*_STRIDES, 64))[0])
    fits: dict[str, int] = {}  # how many classes it has if it is of that layout
    if len(outputs) == 1 and len(shapes[0]) in (2, 3):
        rows, width = shapes[0][-2:]
        fits = {
            "yolov8": rows - 4 if width == cells else 0,
            "yolov5": width - 5 if rows == 3 * cells else 0,
            "yolox": width - 5 if rows == cells else 0,
            "nanodet": width - 4 * _DISTANCES if rows in (cells, more) else 0,
            "rtdetr": width - 4 if width < rows < cells else 0,
            "yolov10": (named or 2) if width == 6 and rows < cells else 0,
        }
        fits = {name: n for name, n in fits.items() if n > 0 and named in (0, n)}
        if len(fits) > 1:
            fits = {name: n for name, n in fits.items() if n in (len(COCO), 91)}
    if len(fits) != 1:
        raise InputError(
            f"{where} answers with {_shapes(outputs)}, which fits no known layout, or several; name it with --layout "
            f"({', '.join(LAYOUTS)})"
        )
    return next(iter(fits))


def _shapes(outputs: Mapping[str, Numbers]) -> str:
    return ", ".join(f"{name} {list(each.shape)}" for name, each in outputs.items())
