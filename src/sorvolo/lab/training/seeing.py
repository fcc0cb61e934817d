"""A network in training asked what it sees: as its exported file would, without ONNX Runtime."""

from collections.abc import Sequence

import cv2
import numpy as np
import torch

from sorvolo.geometry.arrays import ImageRGB
from sorvolo.lab.training.faster_rcnn import FasterRCNN
from sorvolo.survey.objects import Detections

_LONGEST_PX = 1280  # larger pictures are made smaller: they are looked at whole, without tiles
_FILL = 114  # grey, as around samples


@torch.no_grad()
def see(
    model: FasterRCNN, classes: Sequence[str], picture: ImageRGB, device: str = "cpu"
) -> Detections:
    """What the network finds in one picture (H, W, 3), padded to its stride; above 1280 px in a smaller copy."""
    model.eval()
    height, width = picture.shape[:2]
    scale = min(1.0, _LONGEST_PX / max(height, width))
    seen = picture
    if scale < 1:
        seen = np.asarray(
            cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8
        )
    down, right = (-side % model.stride for side in seen.shape[:2])
    padded = np.pad(seen, ((0, down), (0, right), (0, 0)), constant_values=_FILL)
    planes = torch.from_numpy(np.ascontiguousarray(padded.transpose(2, 0, 1))[None]).to(device)
    boxes, scores, labels = (each.cpu().numpy() for each in model(planes))
    boxes = np.clip(boxes / scale, 0, [width, height, width, height])
    kept = (boxes[:, 2:] > boxes[:, :2]).all(1)
    return Detections(boxes[kept], scores[kept], labels[kept], tuple(classes))


def padded_to(picture: ImageRGB, side_px: int) -> ImageRGB:
    """The picture, padded with gray where a side is shorter than `side_px`."""
    down, right = (max(0, side_px - side) for side in picture.shape[:2])
    return np.pad(picture, ((0, down), (0, right), (0, 0)), constant_values=114)
