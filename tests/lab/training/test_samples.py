"""Samples: crops of labelled pictures, with their boxes where the crop shows what they are of."""

from dataclasses import replace

import numpy as np
import pytest

from sorvolo.geometry.arrays import Floats
from sorvolo.lab.training.samples import Augmentation, Share, cut_sample
from sorvolo.survey.labels import LabelledPicture, LabelledSet

CLASSES = ("person", "car")
PLAIN = Augmentation(side_px=96, blur=0, haze=0, grey=0, noise=0)


def _share(*, aslant: bool) -> tuple[np.ndarray, Share]:
    """A picture that grows lighter downwards, with one bright box."""
    rows = np.linspace(20, 120, 160)[:, None, None]
    image = np.broadcast_to(rows, (160, 200, 3)).astype(np.uint8).copy()
    box = np.array([[80, 60, 110, 75]], np.float32)
    image[60:75, 80:110] = 250
    picture = LabelledPicture("a", 200, 160, "v", box, np.array([1]), np.zeros((0, 4), np.float32))
    return image, Share(LabelledSet("a", CLASSES, (picture,)), 1.0, (0.8, 1.2), aslant=aslant)


def _downwards(image: Floats) -> float:
    """By how much a row is lighter than the one above; what is beyond the picture or in the box left out."""
    gray = image[..., 0].astype(float)
    rows, columns = np.nonzero((gray != 114) & (gray < 0.6 * gray.max()))
    return float(np.polyfit(rows, gray[rows, columns], 1)[0])


@pytest.mark.parametrize("aslant", [True, False])
def test_what_is_up_stays_up_in_pictures_from_aslant(aslant: bool) -> None:
    image, share = _share(aslant=aslant)
    rng = np.random.default_rng(1)
    found = [
        _downwards(cut_sample(image, share.labelled.pictures[0], share, CLASSES, PLAIN, rng).image)
        for _ in range(40)
    ]
    assert (min(found) > 0) is aslant


@pytest.mark.parametrize("aslant", [True, False])
def test_the_box_lies_on_what_it_is_of(aslant: bool) -> None:
    image, share = _share(aslant=aslant)
    rng = np.random.default_rng(2)
    for _ in range(40):
        sample = cut_sample(image, share.labelled.pictures[0], share, CLASSES, PLAIN, rng)
        for x0, y0, x1, y1 in sample.boxes:
            y, x = int((y0 + y1) / 2), int((x0 + x1) / 2)
            assert sample.image[y, x, 0] == sample.image[..., 0].max()


def test_another_tone_curve_changes_the_light_and_no_place() -> None:
    image, share = _share(aslant=True)
    picture = share.labelled.pictures[0]
    samples = [
        cut_sample(
            image, picture, share, CLASSES, replace(PLAIN, tone=often), np.random.default_rng(5)
        )
        for often in (0.0, 1.0)
    ]
    np.testing.assert_array_equal(samples[0].boxes, samples[1].boxes)
    assert not np.array_equal(samples[0].image, samples[1].image)
