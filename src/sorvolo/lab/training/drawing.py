"""Which picture each sample is cut from: it follows from the seed and the sample's number, so that a run can go on."""

from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from sorvolo.errors import InputError, SettingsError
from sorvolo.geometry.arrays import ImageRGB
from sorvolo.lab.training.samples import Augmentation, Sample, Share, cut_sample
from sorvolo.survey.labels import LabelledPicture


@dataclass(frozen=True)
class Draw:
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
    augmentation: Augmentation,
    *,
    seed: int,
    batch: int,
    start: int = 0,
    threads: int = 1,
) -> Generator[list[Sample], None, None]:
    """Endless batches from number `start` on, the next ones cut on other threads meanwhile.

    Batch k is the same whatever `start` and `threads` are. `read` gives a picture by its path; where it raises
    InputError the set's next picture is taken instead, and where none can be read, that comes through.
    """
    numbered = draws(shares, seed, start * batch)

    def cut(draw: Draw) -> Sample:
        share = shares[draw.share]
        picture, image = _readable(share, draw.picture, read)
        rng = np.random.default_rng((seed, 1, draw.number))
        return cut_sample(image, picture, share, classes, augmentation, rng)

    executor = ThreadPoolExecutor(threads)
    waiting: deque[Future[Sample]] = deque()
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
