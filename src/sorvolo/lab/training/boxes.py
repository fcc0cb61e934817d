"""Boxes in tensors: overlap, offsets from anchors and back, suppression; alike in training and exported graph."""

import numpy as np
import torch
from torch import Tensor

from sorvolo.geometry.arrays import Floats, Rows

_MOST_GROWTH = 4.135  # log(1000 / 16): a box never grows more than 62 times from its anchor


def iou_matrix(a: Tensor, b: Tensor) -> Tensor:
    """(N, M) intersection over union of boxes (N, 4) and (M, 4)."""
    shared = _shared(a, b)
    union = (area(a)[:, None] + area(b)[None]).sub_(shared).clamp_(min=1e-9)
    return shared.div_(union)


def cover_matrix(a: Tensor, b: Tensor) -> Tensor:
    """(N, M) share of each box of `a`, (N, 4), that lies within each of `b`, (M, 4)."""
    return _shared(a, b) / area(a)[:, None].clamp(min=1e-9)


def _shared(a: Tensor, b: Tensor) -> Tensor:
    a, b = a.detach(), b.detach()
    far = [torch.minimum(a[:, None, axis], b[None, :, axis]) for axis in (2, 3)]
    sides = [
        side.sub_(torch.maximum(a[:, None, axis], b[None, :, axis]))
        for side, axis in zip(far, (0, 1))
    ]
    return sides[0].clamp_(min=0).mul_(sides[1].clamp_(min=0))


def area(boxes: Tensor) -> Tensor:
    """(N,) of boxes (N, 4)."""
    return (boxes[:, 2] - boxes[:, 0]).clamp(min=0) * (boxes[:, 3] - boxes[:, 1]).clamp(min=0)


def offsets_from_boxes(boxes: Tensor, anchors: Tensor) -> Tensor:
    """(N, 4) what to add to the anchors, in their own sizes and in logarithms (Faster R-CNN, eq. 2)."""
    size = anchors[:, 2:] - anchors[:, :2]
    wanted = (boxes[:, 2:] - boxes[:, :2]).clamp(min=1e-3)
    shift = ((boxes[:, :2] + boxes[:, 2:]) - (anchors[:, :2] + anchors[:, 2:])) / 2 / size
    return torch.cat([shift, torch.log(wanted / size)], 1)


def boxes_from_offsets(offsets: Tensor, anchors: Tensor) -> Tensor:
    """(N, 4) the inverse of `offsets_from_boxes`."""
    size = anchors[:, 2:] - anchors[:, :2]
    middle = (anchors[:, :2] + anchors[:, 2:]) / 2 + offsets[:, :2] * size
    half = torch.exp(offsets[:, 2:].clamp(max=_MOST_GROWTH)) * size / 2
    return torch.cat([middle - half, middle + half], 1)


def clipped(boxes: Tensor, height_px: Tensor | int, width_px: Tensor | int) -> Tensor:
    """The boxes (N, 4) cut at the picture's edges."""
    x = boxes[:, 0::2].clamp(min=0)
    y = boxes[:, 1::2].clamp(min=0)
    x, y = torch.clamp(x, max=width_px), torch.clamp(y, max=height_px)
    return torch.stack([x[:, 0], y[:, 0], x[:, 1], y[:, 1]], 1)


def giou_loss(boxes: Tensor, wanted: Tensor) -> Tensor:
    """(N,) one minus the generalised intersection over union of box pairs (Rezatofighi et al. 2019, eq. 5)."""
    corner, far = (
        torch.maximum(boxes[:, :2], wanted[:, :2]),
        torch.minimum(boxes[:, 2:], wanted[:, 2:]),
    )
    shared = (far - corner).clamp(min=0).prod(1)
    union = (area(boxes) + area(wanted) - shared).clamp(min=1e-6)
    hull = torch.maximum(boxes[:, 2:], wanted[:, 2:]) - torch.minimum(boxes[:, :2], wanted[:, :2])
    around = hull.clamp(min=0).prod(1).clamp(min=1e-6)
    return 1 - shared / union + (around - union) / around


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


def suppress_all_pairs(
    boxes: Tensor, scores: Tensor, most: int, iou: float, least_score: float
) -> Tensor:
    """(K, 3) rows of 0, class and index, as `suppress` keeps them, in few steps over all pairs of boxes (N, 4): for a
    GPU, where many small steps wait for each other. Scores are (C, N).

    Each round drops what a box that still stands outranks and overlaps; the first round that changes nothing has what
    greedy suppression keeps, since the best box always stands and so, rank by rank, each next one is settled.
    """
    parts = []
    for label, own in enumerate(scores):
        order = torch.argsort(own, descending=True, stable=True)
        order = order[own[order] > least_score]
        ranked = boxes[order]
        shared, areas = _shared(ranked, ranked), area(ranked)
        union = (areas[:, None] + areas[None] - shared).clamp(min=1e-9)
        outranks = torch.triu(shared > iou * union, diagonal=1)
        stands = torch.ones_like(order, dtype=torch.bool)
        while True:
            settled = ~(outranks & stands[:, None]).any(0)
            if torch.equal(settled, stands):
                break
            stands = settled
        rows = order[stands][:most]
        parts.append(torch.stack([torch.zeros_like(rows), torch.full_like(rows, label), rows], 1))
    return torch.cat(parts)


class _Suppress(torch.autograd.Function):
    """Greedy suppression as ONNX's NonMaxSuppression does it."""

    @staticmethod
    def forward(
        ctx: object, boxes: Tensor, scores: Tensor, most: int, iou: float, least_score: float
    ) -> Tensor:
        """(K, 3) rows of 0, class, index for boxes (N, 4), scores (C, N); by class, then best first."""
        if boxes.is_cuda:
            return suppress_all_pairs(boxes.detach(), scores.detach(), most, iou, least_score)
        # in NumPy, so that an export records one node and none of this
        return torch.from_numpy(
            _suppressed(boxes.detach().numpy(), scores.detach().numpy(), most, iou, least_score)
        )

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


def at_most(most: int, values: Tensor) -> int:
    """`most`, or how many values there are if fewer: for a topk that the exported graph can do with any picture."""
    if torch.onnx.is_in_onnx_export():
        # stays a tensor, so that the graph counts anew for every picture
        return torch.minimum(torch.tensor(most), torch._shape_as_tensor(values)[0])  # type: ignore[return-value]
    return min(most, len(values))
