"""Boxes in tensors, and the network that finds them: overlap and suppression, alike in training and exported graph."""

import numpy as np
import torch
from torch import Tensor, nn

from sorvolo.geometry.arrays import Floats, Rows

_MOST_FOUND = 300  # detections of one picture


class Finder(nn.Module):
    """A network that takes one picture (1, 3, H, W), RGB 0 to 255, whose sides are multiples of `stride`.

    It gives boxes (K, 4) px, scores (K,) from `least_score` on and labels (K,), best first.
    """

    stride = 32
    least_score = 0.01


def iou_matrix(a: Tensor, b: Tensor) -> Tensor:
    """(N, M) intersection over union of boxes (N, 4) and (M, 4)."""
    shared = shared_area(a, b)
    union = (area(a)[:, None] + area(b)[None]).sub_(shared).clamp_(min=1e-9)
    return shared.div_(union)


def shared_area(a: Tensor, b: Tensor) -> Tensor:
    """(N, M) area that boxes (N, 4) and (M, 4) share."""
    return area(common(a.detach()[:, None], b.detach()[None]))


def common(a: Tensor, b: Tensor) -> Tensor:
    """(..., 4) the box that two boxes share; its sides are the wrong way round where they share none."""
    low, high = torch.maximum(a[..., :2], b[..., :2]), torch.minimum(a[..., 2:], b[..., 2:])
    return torch.cat([low, high], -1)


def cell_centres(features: Tensor, stride: int) -> tuple[Tensor, Tensor]:
    """x and y, (H, W) px, of the middles of the pixels that each of the features (N, C, H, W) stands for."""
    y, x = (
        (torch.arange(side, device=features.device) + 0.5) * stride for side in features.shape[2:]
    )
    return x[None] + 0 * y[:, None], y[:, None] + 0 * x


def area(boxes: Tensor) -> Tensor:
    """(...,) of boxes (..., 4)."""
    return (boxes[..., 2:] - boxes[..., :2]).clamp(min=0).prod(-1)


def clipped(boxes: Tensor, height_px: Tensor | int, width_px: Tensor | int) -> Tensor:
    """The boxes (N, 4) cut at the picture's edges."""
    x = boxes[:, 0::2].clamp(min=0)
    y = boxes[:, 1::2].clamp(min=0)
    x, y = torch.clamp(x, max=width_px), torch.clamp(y, max=height_px)
    return torch.stack([x[:, 0], y[:, 0], x[:, 1], y[:, 1]], 1)


def _suppressed(boxes: Floats, scores: Floats, most: int, iou: float, least_score: float) -> Rows:
    """(K, 3) rows of 0, class, index."""
    rows = []
    x1, y1, x2, y2 = boxes.T
    areas = np.maximum(x2 - x1, 0) * np.maximum(y2 - y1, 0)
    for label, own in enumerate(scores):
        left = np.argsort(-own, kind="stable")
        left = left[own[left] > least_score]
        kept = 0
        while len(left) and kept < most:
            best, left = left[0], left[1:]
            rows.append((0, label, best))
            kept += 1
            wide = np.minimum(x2[best], x2[left]) - np.maximum(x1[best], x1[left])
            high = np.minimum(y2[best], y2[left]) - np.maximum(y1[best], y1[left])
            shared = np.maximum(wide, 0) * np.maximum(high, 0)
            left = left[shared <= iou * np.maximum(areas[best] + areas[left] - shared, 1e-9)]
    return np.array(rows, np.int64).reshape(-1, 3)


class _Suppress(torch.autograd.Function):
    """Greedy suppression as ONNX's NonMaxSuppression does it."""

    @staticmethod
    def forward(
        ctx: object, boxes: Tensor, scores: Tensor, most: int, iou: float, least_score: float
    ) -> Tensor:
        """(K, 3) rows of 0, class, index for boxes (N, 4), scores (C, N); by class, then best first."""
        # in NumPy, so that an export records one node and none of this
        own, theirs = boxes.detach().cpu().numpy(), scores.detach().cpu().numpy()
        kept = _suppressed(own, theirs, most, iou, least_score)
        return torch.from_numpy(kept).to(boxes.device)

    @staticmethod
    def symbolic(g, boxes, scores, most: int, iou: float, least_score: float):  # type: ignore[no-untyped-def]
        """The same as a node of the exported graph."""
        lead = g.op("Constant", value_t=torch.tensor([0]))
        return g.op(
            "NonMaxSuppression",
            g.op("Unsqueeze", boxes, lead),
            g.op("Unsqueeze", scores, lead),
            g.op("Constant", value_t=torch.tensor([most])),
            g.op("Constant", value_t=torch.tensor([iou])),
            g.op("Constant", value_t=torch.tensor([least_score])),
            center_point_box_i=0,
        )


def suppress(boxes: Tensor, scores: Tensor, most: int, iou: float, least_score: float) -> Tensor:
    """(K, 2) class and index of what is kept of boxes (N, 4) with scores (C, N), class by class."""
    return _Suppress.apply(boxes, scores, most, iou, least_score)[:, 1:]  # type: ignore[no-untyped-call]


def best_boxes(
    boxes: Tensor, scores: Tensor, iou: float, least_score: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Boxes (K, 4), scores (K,) and labels (K,), best first, of boxes (N, 4) with scores (C, N).

    Of two boxes of a class that overlap by more than `iou` the better one stays.
    """
    kept = suppress(boxes, scores.contiguous(), _MOST_FOUND, iou, least_score)
    labels, rows = kept[:, 0], kept[:, 1]
    found = scores[labels, rows]
    best, order = torch.topk(found, at_most(_MOST_FOUND, found))
    return boxes[rows][order], best, labels[order]


def at_most(most: int, values: Tensor) -> int:
    """`most`, or how many values there are if fewer: for a topk that the exported graph can do with any picture."""
    if torch.onnx.is_in_onnx_export():
        # stays a tensor, so that the graph counts anew for every picture
        return torch.minimum(torch.tensor(most), torch._shape_as_tensor(values)[0])  # type: ignore[return-value]
    return min(most, len(values))
