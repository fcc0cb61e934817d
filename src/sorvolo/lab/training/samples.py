"""What the network learns from: crops of labelled pictures, turned, scaled, lit and blurred as the air does it."""

from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np

from sorvolo.errors import InputError, SettingsError
from sorvolo.geometry.arrays import Floats, ImageRGB, Labels, Matrix3
from sorvolo.geometry.homography import shifted
from sorvolo.survey.labels import LabelledPicture, LabelledSet

_LEAST_SEEN = 0.4  # of an object cut by the crop's edge; less of one teaches nothing
_LEAST_PX = 3.0  # longer side of an object; smaller ones are ignored
_TURNED = 0.35  # how often a crop is turned by any angle, else by quarters
_GREY, _HAZE, _BLUR, _NOISE = (
    0.15,
    0.1,
    0.2,
    0.2,
)  # how often each; blur is motion of up to 9 px, or out of focus


@dataclass(frozen=True)
class Share:
    """A labelled set, and how often it is drawn from; `scale` the range of magnifications; `thermal`: its
    polarity may turn."""

    labelled: LabelledSet
    weight: float
    scale: tuple[float, float] = (0.6, 1.6)
    thermal: bool = False


@dataclass(frozen=True, eq=False)
class TrainingSample:
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
    side: int,
    rng: np.random.Generator,
) -> TrainingSample:
    """One random crop of a picture (H, W, 3), `side` px wide and high, with what is labelled in it."""
    own = share.labelled.classes
    rename = np.array([classes.index(name) if name in classes else -1 for name in own], np.int64)
    labels = rename[picture.labels] if len(picture.labels) else np.zeros(0, np.int64)
    boxes = np.asarray(picture.boxes_px, float)[labels >= 0]
    labels = labels[labels >= 0]
    # (3, 3) crop_from_picture: where the crop lies, around an object three times of four
    height, width = image.shape[:2]
    scale = float(np.exp(rng.uniform(*np.log(share.scale))))
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
    angle = rng.uniform(0, 2 * np.pi) if rng.random() < _TURNED else rng.integers(4) * np.pi / 2
    mirror = 1.0 if rng.random() < 0.5 else -1.0
    c, s = scale * np.cos(angle), scale * np.sin(angle)
    turn = np.array([[c * mirror, -s], [s * mirror, c]])
    crop_from_picture = np.eye(3)
    crop_from_picture[:2, :2], crop_from_picture[:2, 2] = turn, side / 2 - turn @ centre
    out = _warped(image, crop_from_picture, side)
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
    return TrainingSample(out, boxes, labels, ignored, known)


def _warped(image: ImageRGB, crop_from_picture: Matrix3, side: int) -> ImageRGB:
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
    # edges to pixel centres and back
    matrix = shifted(-0.5, -0.5) @ crop_from_picture @ np.linalg.inv(to_source) @ shifted(0.5, 0.5)
    out = cv2.warpAffine(
        source,
        matrix[:2],
        (side, side),
        flags=cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=(114, 114, 114),
    )
    return np.asarray(out, np.uint8)


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


def _weathered(image: ImageRGB, rng: np.random.Generator, *, thermal: bool) -> ImageRGB:
    """Light, colour, polarity, blur, haze and noise."""
    x = image.astype(np.float32)
    if thermal:
        if rng.random() < 0.2:
            x = 255 - x  # black hot
    else:
        x *= rng.uniform(0.85, 1.18, 3).astype(np.float32) ** (rng.random() < 0.5)
        if rng.random() < _GREY:
            x[:] = x.mean(2, keepdims=True)
    x = (x - x.mean()) * rng.uniform(0.6, 1.35) + x.mean() + rng.uniform(-35, 35)
    if rng.random() < _HAZE:
        share = rng.uniform(0.1, 0.5)
        x = x * (1 - share) + share * rng.uniform(160, 240)
    if rng.random() < _BLUR:
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
    if rng.random() < _NOISE:
        x = x + rng.normal(0, rng.uniform(2, 10), x.shape).astype(np.float32)
    return np.clip(x, 0, 255).astype(np.uint8)


class Draw(NamedTuple):
    """Sample `number` (from 0) is cut from picture `picture` of share `share`."""

    number: int
    share: int
    picture: int


def draws(shares: Sequence[Share], seed: int, start: int = 0) -> Iterator[Draw]:
    """Endless draws from number `start` on: shares by their weights, of each all pictures in turn, shuffled anew.

    The draws do not depend on where they start. Raises SettingsError where no share has pictures and weight.
    """
    weights = np.array([share.weight if len(share.labelled) else 0.0 for share in shares], float)
    if not weights.sum() > 0:
        raise SettingsError("there is no picture to learn from: every set is empty or has weight 0")
    bounds = np.cumsum(weights / weights.sum())
    rng = np.random.default_rng((seed, 0))
    left: list[list[int]] = [[] for _ in shares]
    number = 0
    while True:
        share = min(int(np.searchsorted(bounds, rng.random(), side="right")), len(shares) - 1)
        if not left[share]:
            left[share] = [int(each) for each in rng.permutation(len(shares[share].labelled))]
        picture = left[share].pop()
        if number >= start:
            yield Draw(number, share, picture)
        number += 1


def batches_from(
    shares: Sequence[Share],
    classes: Sequence[str],
    read: Callable[[str], ImageRGB],
    *,
    side: int,
    seed: int,
    batch: int,
    start: int,
    threads: int,
) -> Generator[list[TrainingSample], None, None]:
    """Endless batches from number `start` on, the next ones cut on other threads meanwhile.

    Batch k is the same whatever `start` and `threads` are. `read` gives a picture by its path; where it raises
    InputError the set's next picture is taken instead, and where none can be read, that comes through.
    """
    numbered = draws(shares, seed, start * batch)

    def cut(draw: Draw) -> TrainingSample:
        share = shares[draw.share]
        picture, image = _readable(share, draw.picture, read)
        rng = np.random.default_rng((seed, 1, draw.number))
        sample = cut_sample(image, picture, share, classes, side, rng)
        return replace(sample, image=_weathered(sample.image, rng, thermal=share.thermal))

    executor = ThreadPoolExecutor(threads)
    waiting: deque[Future[TrainingSample]] = deque()
    try:
        while True:
            while len(waiting) < batch * 2 + threads:
                waiting.append(executor.submit(cut, next(numbered)))
            yield [waiting.popleft().result() for _ in range(batch)]
    finally:
        executor.shutdown(cancel_futures=True)


def _readable(
    share: Share, first: int, read: Callable[[str], ImageRGB]
) -> tuple[LabelledPicture, ImageRGB]:
    """The first picture from `first` on, round and round, that is not damaged."""
    pictures = share.labelled.pictures
    for picture in (*pictures[first:], *pictures[:first]):
        try:
            return picture, read(picture.path)
        except InputError as error:
            reason = error
    raise reason
