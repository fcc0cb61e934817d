"""What people from the air are learnt from: drawn things and their shadows, laid on pictures; cells that mean them."""

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture(scope="module", autouse=True)
def _benchmarks() -> Iterator[None]:
    sys.path.insert(0, str(BENCHMARKS))
    yield
    sys.path.remove(str(BENCHMARKS))


def _post(height_m: float, half_m: float, sky: float, tilt: float = 0.0):
    """A white post under a sun in the east, 45 degrees high, at 100 px a metre."""
    from drawn_meshes import Light, looking, sprite_of
    from rendered_things import shell

    half = np.array([half_m, half_m, height_m / 2])
    post = shell(np.array([0, 0, height_m / 2]), half, np.full(3, 0.8), power=0.05)
    view, at = looking(tilt, 50.0, np.zeros(2), 100.0)
    sun = np.array([1.0, 0, 1]) / np.sqrt(2)
    return sprite_of(post.moved(at), Light(sun, sky), view)


def test_a_post_from_straight_above_has_its_size_and_throws_its_shadow_from_the_sun() -> None:
    post = _post(1.0, 0.2, 0.3)
    left, top, right, bottom = post.box
    assert right - left == pytest.approx(41, abs=2) and bottom - top == pytest.approx(41, abs=2)
    middle = int(left + right) // 2
    (rows,) = np.nonzero((post.shade[:, middle] > 127) & (post.rgba[:, middle, 3] == 0))
    # east, where the sun stands, is up in the picture; the shadow of 1 m falls to the west
    assert rows.min() >= bottom - 1 and rows.max() == pytest.approx(bottom + 100, abs=4)
    covered = post.rgba[..., :3][post.rgba[..., 3] == 255]
    assert np.median(covered) > 200
    assert _post(1.0, 0.2, 1.0).shade.shape[0] < post.shade.shape[0]  # none under a grey sky


def test_a_post_seen_aslant_shows_its_side() -> None:
    post = _post(1.0, 0.1, 1.0, tilt=np.pi / 4)
    assert post.box[3] - post.box[1] == pytest.approx(100 * (1 + 0.2) / np.sqrt(2), abs=6)


def test_who_is_laid_on_a_picture_is_boxed_and_who_is_hidden_is_ignored() -> None:
    from drawn_meshes import Sprite
    from people_samples import Shown, pasted
    from rendered_people import Scene

    rgba = np.full((60, 40, 4), 255, np.uint8)
    person = Sprite(rgba, np.zeros((60, 40), np.uint8), np.array([0, 0, 40, 60.0]))
    scene = Scene((person,) * 9, (True,) * 8 + (False,), 60.0, False, 0.0)
    below = Shown(np.full((200, 200, 3), 80, np.uint8), np.zeros((0, 4)), np.zeros((0, 4)))
    boxes = hidden = 0
    for seed in range(12):
        made = pasted(below, scene, np.random.default_rng(seed))
        for left, top, right, bottom in made.boxes.astype(int):
            assert made.image[top:bottom, left:right].mean() > 110
            assert max(right - left, bottom - top) >= 11 and right <= 200 and bottom <= 200
        boxes, hidden = boxes + len(made.boxes), hidden + len(made.ignored)
    assert boxes > 12 and hidden > 3
    taken = Shown(below.image, np.array([[0.0, 0, 200, 200]]), below.ignored)
    assert (
        len(pasted(taken, scene, np.random.default_rng(1)).boxes) == 1
    )  # nobody is laid over a real person


def test_cells_stand_for_the_person_whose_box_they_lie_in() -> None:
    from dense_loss import Wanted, assigned, dense_loss
    from sorvolo.lab.training.nanodet import BINS, cells

    outputs = [torch.zeros(1, 1 + 4 * BINS, 96 // stride, 96 // stride) for stride in (8, 16, 32)]
    _, _, places = cells(outputs, (8, 16, 32), 1)
    boxes = torch.tensor([[10.0, 10, 50, 50], [70, 70, 73, 74]])
    wanted = Wanted(boxes, torch.tensor([[60.0, 0, 96, 30]]))
    row = assigned(places, wanted)
    first = places[row == 0]
    assert len(first) >= 3 and bool(((first[:, :2] > 10) & (first[:, :2] < 50)).all())
    assert int((row == 1).sum()) == 1  # smaller than any cell, and learnt all the same
    ignored = places[row == -2]
    assert len(ignored) >= 8 and bool((ignored[:, 0] > 60).all() and (ignored[:, 1] < 30).all())
    silent = dense_loss(outputs, (8, 16, 32), [wanted])
    for output in outputs:
        output[:, 0] = -6.0
    for place in first:
        level = (8, 16, 32).index(int(place[2]))
        column, line = (int(each) // int(place[2]) for each in place[:2])
        outputs[level][0, 0, line, column] = 2.0
    assert float(dense_loss(outputs, (8, 16, 32), [wanted])) < float(silent)


def test_things_are_learnt_by_class_and_unlabelled_classes_teach_nothing() -> None:
    from dense_loss import Wanted, assigned, dense_loss
    from sorvolo.lab.training.nanodet import BINS, cells

    def outputs(of_class: int) -> list[torch.Tensor]:
        made = [
            torch.full((1, 2 + 4 * BINS, 96 // stride, 96 // stride), 0.0) for stride in (8, 16, 32)
        ]
        _, _, places = cells(made, (8, 16, 32), 2)
        for each in made:
            each[:, :2] = -6.0
        for place in places[assigned(places, wanted) == 0]:
            level = (8, 16, 32).index(int(place[2]))
            column, line = (int(each) // int(place[2]) for each in place[:2])
            made[level][0, of_class, line, column] = 2.0
        return made

    none = torch.zeros(0, 4)
    wanted = Wanted(torch.tensor([[10.0, 10, 50, 50]]), none, torch.tensor([1]))
    right, wrong = (float(dense_loss(outputs(each), (8, 16, 32), [wanted], 2)) for each in (1, 0))
    assert right < wrong
    empty = Wanted(none, none, torch.zeros(0, dtype=torch.int64), torch.tensor([False, True]))
    assert float(dense_loss(outputs(0), (8, 16, 32), [empty], 2)) < 1e-3
    assert float(dense_loss(outputs(1), (8, 16, 32), [empty], 2)) > 0.1
