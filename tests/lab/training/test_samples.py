"""Samples: crops of labelled pictures, with their boxes where the crop shows what they are of."""

import numpy as np

from sorvolo.lab.training.samples import Augmentation, Share, cut_sample
from sorvolo.survey.labels import LabelledPicture, LabelledSet

CLASSES = ("person", "car")
PLAIN = Augmentation(side_px=96, blur=0, haze=0, grey=0, noise=0)


def _share() -> tuple[np.ndarray, Share]:
    """A picture that grows lighter downwards, with one bright box."""
    rows = np.linspace(20, 120, 160)[:, None, None]
    image = np.broadcast_to(rows, (160, 200, 3)).astype(np.uint8).copy()
    box = np.array([[80, 60, 110, 75]], np.float32)
    image[60:75, 80:110] = 250
    picture = LabelledPicture("a", 200, 160, "v", box, np.array([1]), np.zeros((0, 4), np.float32))
    return image, Share(LabelledSet("a", CLASSES, (picture,)), 1.0, (0.8, 1.2))


def test_the_box_lies_on_what_it_is_of() -> None:
    image, share = _share()
    rng = np.random.default_rng(2)
    for _ in range(40):
        sample = cut_sample(image, share.labelled.pictures[0], share, CLASSES, PLAIN, rng)
        for x0, y0, x1, y1 in sample.boxes:
            y, x = int((y0 + y1) / 2), int((x0 + x1) / 2)
            assert sample.image[y, x, 0] == sample.image[..., 0].max()
