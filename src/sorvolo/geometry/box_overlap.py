"""How much boxes in a picture overlap; edges left, top, right, bottom, px (BoxesPx)."""

import numpy as np

from sorvolo.geometry.arrays import Floats, Numbers


def iou_matrix(a: Numbers, b: Numbers) -> Floats:
    """(N, M) intersection over union of boxes (N, 4) and (M, 4)."""
    shared = shared_areas(a, b)
    union = areas(a)[:, None] + areas(b)[None] - shared
    return shared / np.maximum(union, 1e-9)


def cover_matrix(a: Numbers, b: Numbers) -> Floats:
    """(N, M) share of each box of `a`, (N, 4), that lies within each of `b`, (M, 4)."""
    return shared_areas(a, b) / np.maximum(areas(a)[:, None], 1e-9)


def nesting_matrix(a: Numbers, b: Numbers) -> Floats:
    """(N, M) share of the smaller of two boxes, of `a`, (N, 4), and of `b`, (M, 4), that lies within the other."""
    smaller = np.minimum(areas(a)[:, None], areas(b)[None])
    return shared_areas(a, b) / np.maximum(smaller, 1e-9)


def shared_areas(a: Numbers, b: Numbers) -> Floats:
    """(N, M) px2 that boxes (N, 4) and (M, 4) have in common."""
    corner = np.maximum(a[:, None, :2], b[None, :, :2])
    far = np.minimum(a[:, None, 2:], b[None, :, 2:])
    return np.clip(far - corner, 0, None).prod(axis=2)


def areas(boxes: Numbers) -> Floats:
    """(N,) px2 of boxes (N, 4)."""
    return np.clip(boxes[:, 2:] - boxes[:, :2], 0, None).prod(axis=1)
