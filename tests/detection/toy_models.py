"""Small models by the contract, made from text: they find bright rectangles, exactly."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sorvolo.detection.contract import METADATA_KEY, ModelInfo, info_from_metadata

onnx = pytest.importorskip("onnx")  # comes with the extra "training"
pytest.importorskip("onnx.parser")
pytest.importorskip("onnx.reference")

CLASSES = ("person", "car", "small object")
METADATA: dict[str, Any] = {
    "format": 1,
    "name": "toy",
    "preset": "tiny",
    "version": "1",
    "classes": list(CLASSES),
    "stride": 32,
    "thresholds": {"person": 0.5, "car": 0.4, "small object": 0.6},
    "best_px": {"person": [8, 120], "car": [16, 200], "small object": [8, 80]},
    "licence": "Apache-2.0",
    "trained_on": "nothing",
    "thermal": True,
    "created": "2026-01-01",
}

# A corner is a bright pixel whose two neighbours on the outside are dark. A rectangle reaches from its top-left corner
# to the next top-right corner of its row and the next bottom-left corner of its column; where it ends at the border of
# what is shown, the border is its edge. Red is the score, green counts hundreds: the class.
_RECTANGLES = """
<ir_version: 8, opset_import: ["" : 17]>
rectangles (uint8[1, 3, {height}, {width}] image) => (float[K, 4] boxes, float[K] scores, int64[K] labels) {{
  zero = Constant <value_int = 0> ()
  one = Constant <value_int = 1> ()
  axis = Constant <value_ints = [0]> ()
  axis1 = Constant <value_ints = [1]> ()
  far = Constant <value_float = 1e9> ()
  dim = Constant <value_float = 120.0> ()
  hundred = Constant <value_float = 100.0> ()
  all = Constant <value_float = 255.0> ()
  picture = Cast <to = 1> (image)
  plane = Squeeze (picture, axis)
  red = Gather <axis = 0> (plane, zero)
  green = Gather <axis = 0> (plane, one)
  is_bright = Greater (red, dim)
  bright = Cast <to = 1> (is_bright)
  axes = Constant <value_ints = [0, 1]> ()
  map = Unsqueeze (bright, axes)
  left_w = Constant <value = float[1, 1, 3, 3] {{0, 0, 0, -1, 1, 0, 0, 0, 0}}> ()
  right_w = Constant <value = float[1, 1, 3, 3] {{0, 0, 0, 0, 1, -1, 0, 0, 0}}> ()
  top_w = Constant <value = float[1, 1, 3, 3] {{0, -1, 0, 0, 1, 0, 0, 0, 0}}> ()
  low_w = Constant <value = float[1, 1, 3, 3] {{0, 0, 0, 0, 1, 0, 0, -1, 0}}> ()
  left = Conv <pads = [1, 1, 1, 1]> (map, left_w)
  right = Conv <pads = [1, 1, 1, 1]> (map, right_w)
  top = Conv <pads = [1, 1, 1, 1]> (map, top_w)
  low = Conv <pads = [1, 1, 1, 1]> (map, low_w)
  left_edge = Relu (left)
  right_edge = Relu (right)
  top_edge = Relu (top)
  low_edge = Relu (low)
  tl_map = Mul (left_edge, top_edge)
  tr_map = Mul (right_edge, top_edge)
  bl_map = Mul (left_edge, low_edge)
  tl_plane = Squeeze (tl_map, axes)
  tr_plane = Squeeze (tr_map, axes)
  bl_plane = Squeeze (bl_map, axes)
  tl_int = NonZero (tl_plane)
  tr_int = NonZero (tr_plane)
  bl_int = NonZero (bl_plane)
  tl = Cast <to = 1> (tl_int)
  tr = Cast <to = 1> (tr_int)
  bl = Cast <to = 1> (bl_int)
  y0 = Gather <axis = 0> (tl, zero)
  x0 = Gather <axis = 0> (tl, one)
  tr_y = Gather <axis = 0> (tr, zero)
  tr_x = Gather <axis = 0> (tr, one)
  bl_y = Gather <axis = 0> (bl, zero)
  bl_x = Gather <axis = 0> (bl, one)
  y_column = Unsqueeze (y0, axis1)
  x_column = Unsqueeze (x0, axis1)
  width_all = Sub (tr_x, x_column)
  height_all = Sub (bl_y, y_column)
  same_row = Equal (tr_y, y_column)
  same_column = Equal (bl_x, x_column)
  nought = Constant <value_float = 0.0> ()
  ahead_x = GreaterOrEqual (width_all, nought)
  ahead_y = GreaterOrEqual (height_all, nought)
  fits_x = And (same_row, ahead_x)
  fits_y = And (same_column, ahead_y)
  width_fit = Where (fits_x, width_all, far)
  height_fit = Where (fits_y, height_all, far)
  width = ReduceMin <axes = [1], keepdims = 0> (width_fit)
  height = ReduceMin <axes = [1], keepdims = 0> (height_fit)
  unit = Constant <value_float = 1.0> ()
  x_last = Add (x0, width)
  y_last = Add (y0, height)
  x1 = Add (x_last, unit)
  y1 = Add (y_last, unit)
  x1_column = Unsqueeze (x1, axis1)
  y1_column = Unsqueeze (y1, axis1)
  boxes_all = Concat <axis = 1> (x_column, y_column, x1_column, y1_column)
  where = Transpose (tl_int)
  red_there = GatherND (red, where)
  green_there = GatherND (green, where)
  scores_all = Div (red_there, all)
  hundreds = Div (green_there, hundred)
  label_float = Floor (hundreds)
  labels_all = Cast <to = 7> (label_float)
  shape = Shape (scores_all)
  scores, order = TopK <axis = 0> (scores_all, shape)
  boxes = Gather <axis = 0> (boxes_all, order)
  labels = Gather <axis = 0> (labels_all, order)
}}
"""


def rectangle_model(path: Path, *, fixed: tuple[int, int] | None = None, **changed: Any) -> Path:
    """Write a model that finds rectangles brighter than 120 in red; `changed` changes its metadata."""
    height, width = fixed or ("H", "W")
    model = onnx.parser.parse_model(_RECTANGLES.format(height=height, width=width))
    return write_model(model, path, METADATA | changed)


def info_of(**changed: Any) -> ModelInfo:
    """What such a model states, without opening one: that takes a process of its own."""
    return info_from_metadata({METADATA_KEY: json.dumps(METADATA | changed)}, "toy.onnx")


def write_model(model: Any, path: Path, metadata: dict[str, Any] | None) -> Path:
    """Check a model and write it, with metadata where some is given."""
    onnx.checker.check_model(model)
    if metadata is not None:
        onnx.helper.set_model_props(model, {"sorvolo": json.dumps(metadata)})
    onnx.save(model, path)
    return path


def draw(
    size: tuple[int, int],
    boxes: list[tuple[int, int, int, int]],
    *,
    labels: list[int] | None = None,
    scores: list[int] | None = None,
) -> np.ndarray:
    """A dark picture (height, width) with a rectangle for each box (left, top, right, bottom); scores of 255."""
    picture = np.full((*size, 3), 20, np.uint8)
    for index, (left, top, right, bottom) in enumerate(boxes):
        label, score = labels[index] if labels else 0, scores[index] if scores else 230
        picture[top:bottom, left:right] = (score, 100 * label, 60)
    return picture


# Features of stride 4, their brightest places as squares of 16 px, suppressed; the score is the mean of the features
# within. Three convolutions, of which the last one of its branch gives the place: a Faster R-CNN in small.
_SQUARES = """
<ir_version: 8, opset_import: ["" : 17]>
squares (uint8[1, 3, H, W] image) => (float[K, 4] boxes, float[K] scores, int64[K] labels) {
  all = Constant <value_float = 255.0> ()
  four = Constant <value_float = 4.0> ()
  two = Constant <value_float = 2.0> ()
  eight = Constant <value_float = 8.0> ()
  zero = Constant <value_int = 0> ()
  one = Constant <value_int = 1> ()
  axis0 = Constant <value_ints = [0]> ()
  axis1 = Constant <value_ints = [1]> ()
  flat = Constant <value_ints = [-1]> ()
  line = Constant <value_ints = [1, 1, -1]> ()
  many = Constant <value_ints = [40]> ()
  most = Constant <value_int = 20> ()
  iou = Constant <value_float = 0.1> ()
  least = Constant <value_float = 0.3> ()
  whole = Cast <to = 1> (image)
  picture = Div (whole, all)
  near = Conv <pads = [1, 1, 1, 1]> (picture, near_w)
  near_on = Relu (near)
  far = Conv <kernel_shape = [4, 4], strides = [4, 4]> (near_on, far_w)
  features = Relu (far)
  heat = Conv <pads = [1, 1, 1, 1]> (features, heat_w)
  heat_line = Reshape (heat, flat)
  top, where = TopK <axis = 0> (heat_line, many)
  shape = Shape (heat)
  three = Constant <value_int = 3> ()
  across = Gather (shape, three)
  row = Div (where, across)
  column = Mod (where, across)
  row_float = Cast <to = 1> (row)
  column_float = Cast <to = 1> (column)
  row_px = Mul (row_float, four)
  column_px = Mul (column_float, four)
  y = Add (row_px, two)
  x = Add (column_px, two)
  left = Sub (x, eight)
  high = Sub (y, eight)
  right = Add (x, eight)
  low = Add (y, eight)
  left_c = Unsqueeze (left, axis1)
  high_c = Unsqueeze (high, axis1)
  right_c = Unsqueeze (right, axis1)
  low_c = Unsqueeze (low, axis1)
  all_boxes = Concat <axis = 1> (left_c, high_c, right_c, low_c)
  boxes_3 = Unsqueeze (all_boxes, axis0)
  scores_3 = Reshape (top, line)
  kept = NonMaxSuppression (boxes_3, scores_3, most, iou, least)
  kept_row = Gather <axis = 1> (kept, two_int)
  chosen = Gather <axis = 0> (all_boxes, kept_row)
  batch = Mul (kept_row, zero)
  regions = RoiAlign <output_height = 2, output_width = 2, sampling_ratio = 2, spatial_scale = 0.25>
    (features, chosen, batch)
  means = ReduceMean <axes = [1, 2, 3], keepdims = 0> (regions)
  count = Shape (means)
  scores, order = TopK <axis = 0> (means, count)
  boxes = Gather <axis = 0> (chosen, order)
  labels_none = Mul (order, zero)
  labels = Identity (labels_none)
}
"""


def square_model(path: Path, *, seed: int = 0) -> Path:
    """Write a model that finds bright squares of 16 px by convolutions with weights of its own."""
    rng = np.random.default_rng(seed)
    weights = {
        "near_w": rng.uniform(0.5, 1.5, (4, 3, 3, 3)) / 27,
        "far_w": rng.uniform(0.5, 1.5, (4, 4, 4, 4)) / 64,
        "heat_w": rng.uniform(0.9, 1.1, (1, 4, 3, 3)) / 36,
    }
    model = onnx.parser.parse_model(_SQUARES)
    for name, values in weights.items():
        model.graph.initializer.append(
            onnx.numpy_helper.from_array(values.astype(np.float32), name)
        )
    model.graph.initializer.append(onnx.numpy_helper.from_array(np.array(2), "two_int"))
    return write_model(model, path, METADATA | {"name": "squares"})
