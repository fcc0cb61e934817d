"""Samples: crops of labelled pictures, with their boxes where the crop shows what they are of."""

import numpy as np

from sorvolo.lab.training.samples import Share, cut_sample
from sorvolo.survey.labels import LabelledPicture, LabelledSet

CLASSES = ("person", "car")


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
        sample = cut_sample(image, share.labelled.pictures[0], share, CLASSES, 96, rng)
        for x0, y0, x1, y1 in sample.boxes:
            y, x = int((y0 + y1) / 2), int((x0 + x1) / 2)
            assert sample.image[y, x, 0] == sample.image[..., 0].max()


def test_crops_carry_their_boxes_along() -> None:
    """A bright ellipse on black is where its box lies, however the crop lies."""
    rows, columns = np.mgrid[:300, :400]
    image = np.zeros((300, 400, 3), np.uint8)
    image[((rows - 114.5) / 15) ** 2 + ((columns - 224.5) / 25) ** 2 < 1] = 255
    picture = LabelledPicture(
        "p", 400, 300, "g", np.array([[200, 100, 250, 130]]), np.array([0]), np.zeros((0, 4))
    )
    share = Share(LabelledSet("s", ("car",), (picture,)), 1.0)
    rng = np.random.default_rng(8)
    seen = 0
    for _ in range(20):
        made = cut_sample(image, picture, share, CLASSES, 160, rng)
        for box, label in zip(made.boxes, made.labels):
            assert label == 1
            gray = made.image.mean(2)
            rows, columns = np.nonzero(gray > (gray.min() + gray.max()) / 2)
            bright = (columns.min(), rows.min(), columns.max() + 1, rows.max() + 1)
            assert np.abs(np.array(bright) - box).max() < 2.0
            seen += 1
    assert seen > 8
