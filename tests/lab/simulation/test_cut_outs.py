"""Real people cut out of pictures: the right part of them, in their own size and colours, wherever they are planted."""

import cv2
import numpy as np
import pytest
from test_planted import CAMERA, FOCAL_PX, HEIGHT_M, POSE, _ground, _light

from sorvolo.geometry.sun import direction_from_angles
from sorvolo.search.drawing.cut_outs import CutOut, CutThing, alphas_by_difference
from sorvolo.search.drawing.objects import Thing, ThingLabel
from sorvolo.search.drawing.planted import FrameLight, frame_light, plant

M_PER_PX = HEIGHT_M / FOCAL_PX / 4  # pictures of the person from a quarter of the height


def _pictures(count: int, *, moves: bool = True) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """A drone that hovers, not quite still, over a person who lies down elsewhere for each picture; and the boxes."""
    rng, pictures, boxes = np.random.default_rng(4), [], []
    ground = np.clip(_ground() + rng.normal(0, 12, (480, 640, 1)), 0, 255).astype(np.uint8)
    ground = cv2.GaussianBlur(ground, (0, 0), 1.0)
    for number in range(count):
        east_m = -2.4 + 4.8 * number / (count - 1) if moves else 0.0
        person = Thing(number, ThingLabel.PERSON, "lying", east_m, 0.7, 40.0 * number * moves, (1.8, 0.6, 0.3), 5)  # fmt: skip
        low = POSE.__class__(POSE.rotation, np.array([0.0, 0.0, HEIGHT_M / 4]))
        sun = direction_from_angles(200, 45)
        planted = plant(ground, CAMERA, low, [person], _light(shadow=0.8), sun, number)
        turned = cv2.getRotationMatrix2D((320, 240), float(rng.normal(0, 1)), 1.0)
        turned[:, 2] += rng.normal(0, 3, 2)
        pictures.append(cv2.warpAffine(planted.image, turned, (640, 480), borderMode=cv2.BORDER_REFLECT))  # fmt: skip
        corners = planted.boxes_px[0].reshape(2, 2) @ turned[:, :2].T + turned[:, 2]
        boxes.append(np.concatenate([corners.min(axis=0), corners.max(axis=0)]))
    return pictures, boxes


def test_a_person_is_cut_out_of_what_the_pictures_share() -> None:
    pictures, boxes = _pictures(6)
    alphas = alphas_by_difference(pictures, M_PER_PX)
    for alpha, box in zip(alphas, boxes):
        rows, columns = np.nonzero(alpha > 0.5)
        found = np.array([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1])
        np.testing.assert_allclose(found, box, atol=14)  # 18 cm: hands and feet are thin


def test_a_person_who_never_moves_is_ground() -> None:
    pictures, _ = _pictures(5, moves=False)
    assert not any((alpha > 0.5).any() for alpha in alphas_by_difference(pictures, M_PER_PX))


def test_two_pictures_do_not_show_what_is_ground() -> None:
    assert not any(alpha.any() for alpha in alphas_by_difference(_pictures(2)[0], M_PER_PX))


def _red(light: FrameLight | None = None) -> CutOut:
    image = np.full((60, 200, 3), 90, np.uint8)
    alpha = np.zeros((60, 200))
    image[10:50, 10:190], alpha[10:50, 10:190] = (180, 40, 30), 1.0
    found = CutOut.of("red.png", image, alpha, 0.01, light)
    assert found is not None
    return found


def test_a_cut_out_stands_where_it_is_planted_in_its_size_and_colours() -> None:
    thing = CutThing.new(3, np.array([4.0, -3.0]), [_red()], 1)
    assert thing.size_m[:2] == pytest.approx((1.8, 0.4))
    planted = plant(_ground().astype(np.uint8), CAMERA, POSE, [thing], _light(), None, 1)
    box = planted.boxes_px[0]
    middle = (box[:2] + box[2:]) / 2
    assert np.hypot(*(middle - [319.5 + 4 * 20, 239.5 + 3 * 20])) < 2
    c, s = (abs(f(np.radians(thing.yaw_deg))) for f in (np.cos, np.sin))
    np.testing.assert_allclose(box[2:] - box[:2], 20 * np.array([1.8 * c + 0.4 * s, 1.8 * s + 0.4 * c]), atol=3)  # fmt: skip
    x, y = middle.astype(int)
    np.testing.assert_allclose(planted.image[y, x], (180, 40, 30), atol=6)


def test_the_light_of_its_own_picture_is_taken_off() -> None:
    dull = FrameLight(np.full(3, 0.5), np.full(3, 20.0), 0.1 * np.eye(2), 0.0, 0.0, False)
    np.testing.assert_allclose(
        _red(dull).texture[20, 90, :3], (255, 40, 20), atol=1
    )  # 320 is over the top
    assert frame_light(_ground().astype(np.uint8)).is_thermal is False and not _red().is_thermal


def test_what_no_person_can_be_is_told_by_its_size() -> None:
    image, alpha = np.zeros((400, 400, 3), np.uint8), np.ones((400, 400))
    sizes = {m_per_px: CutOut.of("x", image, alpha, m_per_px, None) for m_per_px in (0.0005, 0.004, 0.01)}  # fmt: skip
    assert [each is not None and each.is_of_a_size for each in sizes.values()] == [False, True, False]  # fmt: skip
