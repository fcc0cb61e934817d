"""What the network learns from: crops of labelled pictures, turned, scaled, lit and blurred as the air does it."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sorvolo.geometry.arrays import Floats, ImageRGB, Labels, Matrix3
from sorvolo.lab.training.sprites import paste_small_objects
from sorvolo.survey.labels import LabelledPicture, LabelledSet

_LEAST_SEEN = 0.4  # of an object cut by the crop's edge; less of one teaches nothing
_LEAST_PX = 3.0  # longer side of an object; smaller ones are ignored


@dataclass(frozen=True)
class Share:
    """A labelled set, and how often it is drawn from; `scale` the range of magnifications; `pastes` the class name
    under which small objects are composed onto its ground, "" for none; `thermal`: its polarity may turn; `aslant`: its
    pictures were not taken straight down, what is up in them stays up."""

    labelled: LabelledSet
    weight: float
    scale: tuple[float, float] = (0.6, 1.6)
    pastes: str = ""
    thermal: bool = False
    aslant: bool = False


@dataclass(frozen=True)
class Augmentation:
    """How far samples may differ from their pictures."""

    side_px: int = 416
    turns: bool = True  # by any angle; else only mirrored
    blur: float = 0.2  # how often: motion of up to 9 px, or out of focus
    haze: float = 0.1
    grey: float = 0.15  # how often colours are taken away
    noise: float = 0.2
    tone: float = 0.0  # how often: another tone curve and uneven warmth, as thermal cameras' gain control makes them


@dataclass(frozen=True, eq=False)
class Sample:
    """A training picture (side, side, 3) with boxes (N, 4) px, labels (N,), ignored regions (M, 4), known (C,) bool."""

    image: ImageRGB
    boxes: Floats
    labels: Labels
    ignored: Floats
    known: Floats


def cut_sample(
    image: ImageRGB,
    picture: LabelledPicture,
    share: Share,
    classes: Sequence[str],
    augmentation: Augmentation,
    rng: np.random.Generator,
) -> Sample:
    """One random crop of a picture (H, W, 3) with what is labelled in it."""
    side = augmentation.side_px
    own = share.labelled.classes
    rename = np.array([classes.index(name) if name in classes else -1 for name in own], np.int64)
    labels = rename[picture.labels] if len(picture.labels) else np.zeros(0, np.int64)
    boxes = np.asarray(picture.boxes_px, float)[labels >= 0]
    labels = labels[labels >= 0]
    turns = augmentation.turns and not share.aslant
    crop_from_picture = _placement(image.shape[:2], boxes, share.scale, side, turns, rng)
    out, crop_from_picture = _warped(image, crop_from_picture, side)
    boxes, seen = boxes_in_crop(boxes, crop_from_picture, side)
    ignored, in_sight = boxes_in_crop(
        np.asarray(picture.ignored_px, float), crop_from_picture, side
    )
    small = np.max(boxes[:, 2:] - boxes[:, :2], axis=1, initial=0) < _LEAST_PX
    keep = (seen >= _LEAST_SEEN) & ~small
    spoilt = boxes[~keep & (seen > 0.02)]
    ignored = np.vstack([ignored[in_sight > 0], spoilt])
    boxes, labels = boxes[keep], labels[keep]
    known = np.array([name not in share.labelled.unlabelled for name in classes])
    if share.pastes and rng.random() < 0.6:
        out, pasted = paste_small_objects(out, np.vstack([boxes, ignored]), rng)
        label = list(classes).index(share.pastes)
        boxes = np.vstack([boxes, pasted])
        labels = np.append(labels, np.full(len(pasted), label, np.int64))
        known = known | (np.arange(len(classes)) == label)
    out = _weathered(out, augmentation, rng, thermal=share.thermal)
    return Sample(out, boxes, labels, ignored, known)


def _placement(
    size: tuple[int, int],
    boxes: Floats,
    scales: tuple[float, float],
    side: int,
    turns: bool,
    rng: np.random.Generator,
) -> Matrix3:
    """(3, 3) crop_from_picture: where the crop lies, around an object three times of four."""
    height, width = size
    scale = float(np.exp(rng.uniform(*np.log(scales))))
    scale = max(scale, 0.5 * side / max(height, width))
    if len(boxes) and rng.random() < 0.75:
        box = boxes[rng.integers(len(boxes))]
        scale = min(scale, 0.8 * side / max(float(np.max(box[2:] - box[:2])), 1.0))
        centre = (box[:2] + box[2:]) / 2 + rng.uniform(-0.4, 0.4, 2) * side / scale
    else:
        centre = rng.uniform(0, 1, 2) * (width, height)
    reach = side / scale / 2
    for axis, length in enumerate((width, height)):
        centre[axis] = np.clip(
            centre[axis], min(reach, length / 2), max(length - reach, length / 2)
        )
    angle = 0.0
    if turns:
        angle = rng.uniform(0, 2 * np.pi) if rng.random() < 0.35 else rng.integers(4) * np.pi / 2
    mirror = 1.0 if rng.random() < 0.5 else -1.0
    c, s = scale * np.cos(angle), scale * np.sin(angle)
    turn = np.array([[c * mirror, -s], [s * mirror, c]])
    matrix = np.eye(3)
    matrix[:2, :2], matrix[:2, 2] = turn, side / 2 - turn @ centre
    return matrix


def _warped(image: ImageRGB, crop_from_picture: Matrix3, side: int) -> tuple[ImageRGB, Matrix3]:
    scale = float(np.sqrt(abs(np.linalg.det(crop_from_picture[:2, :2]))))
    source, to_source = image, np.eye(3)
    if scale < 0.7:  # made smaller by areas first, or edges would break up
        factor = max(scale * 1.2, 0.05)
        source = np.asarray(
            cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA), np.uint8
        )
        to_source = np.diag(
            [source.shape[1] / image.shape[1], source.shape[0] / image.shape[0], 1.0]
        )
    corner = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1.0]])  # edges to pixel centres and back
    matrix = np.linalg.inv(corner) @ crop_from_picture @ np.linalg.inv(to_source) @ corner
    out = cv2.warpAffine(
        source,
        matrix[:2],
        (side, side),
        flags=cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=(114, 114, 114),
    )
    return np.asarray(out, np.uint8), crop_from_picture


def boxes_in_crop(boxes: Floats, crop_from_picture: Matrix3, side: int) -> tuple[Floats, Floats]:
    """(N, 4) boxes in the crop, cut at its edges, and the share of each that it shows, (N,)."""
    if not len(boxes):
        return np.zeros((0, 4)), np.zeros(0)
    turn = crop_from_picture[:2, :2]
    centre = (boxes[:, :2] + boxes[:, 2:]) / 2 @ turn.T + crop_from_picture[:2, 2]
    # the box around a turned ellipse: objects fill their boxes' corners no better than that
    half = np.sqrt(((boxes[:, 2:] - boxes[:, :2]) / 2) ** 2 @ (turn**2).T)
    whole = np.hstack([centre - half, centre + half])
    cut = np.clip(whole, 0, side)
    sides = np.clip(cut[:, 2:] - cut[:, :2], 0, None)
    return cut, sides.prod(1) / np.maximum((2 * half).prod(1), 1e-6)


def _weathered(
    image: ImageRGB, how: Augmentation, rng: np.random.Generator, *, thermal: bool
) -> ImageRGB:
    """Light, colour, polarity, blur, haze and noise."""
    x = image.astype(np.float32)
    if thermal:
        if rng.random() < 0.2:
            x = 255 - x  # black hot
    else:
        x *= rng.uniform(0.85, 1.18, 3).astype(np.float32) ** (rng.random() < 0.5)
        if rng.random() < how.grey:
            x[:] = x.mean(2, keepdims=True)
    if how.tone and rng.random() < how.tone:
        x = _toned(x, rng)
    x = (x - x.mean()) * rng.uniform(0.6, 1.35) + x.mean() + rng.uniform(-35, 35)
    if rng.random() < how.haze:
        share = rng.uniform(0.1, 0.5)
        x = x * (1 - share) + share * rng.uniform(160, 240)
    if rng.random() < how.blur:
        if rng.random() < 0.5:
            length = int(rng.integers(3, 10))
            kernel = np.zeros((length, length), np.float32)
            kernel[length // 2] = 1 / length
            turn = cv2.getRotationMatrix2D(
                ((length - 1) / 2, (length - 1) / 2), rng.uniform(0, 180), 1
            )
            kernel = np.asarray(cv2.warpAffine(kernel, turn, (length, length)), np.float32)
            x = np.asarray(cv2.filter2D(x, -1, kernel / max(float(kernel.sum()), 1e-3)), np.float32)
        else:
            x = np.asarray(cv2.GaussianBlur(x, (0, 0), rng.uniform(0.4, 1.3)), np.float32)
    if rng.random() < how.noise:
        x = x + rng.normal(0, rng.uniform(2, 10), x.shape).astype(np.float32)
    return np.clip(x, 0, 255).astype(np.uint8)


def _toned(x: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.float32]:
    """(H, W, 3) 0 to 255 through a power of the grey values, brighter here and darker there by up to a quarter."""
    curved = 255 * (np.clip(x, 0, 255) / 255) ** np.exp(rng.uniform(-0.7, 0.7))
    coarse = rng.normal(0, rng.uniform(0, 25), (3, 3)).astype(np.float32)
    uneven = cv2.resize(coarse, x.shape[1::-1], interpolation=cv2.INTER_CUBIC)
    return np.asarray(curved + uneven[:, :, None], np.float32)
