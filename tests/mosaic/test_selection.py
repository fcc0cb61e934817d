"""Selection: enough overlap and no more, sharp frames rather than blurred ones, and only inside the area."""

import cv2
import numpy as np
import pytest

from sorvolo.errors import SettingsError
from sorvolo.geometry.camera import Camera
from sorvolo.mosaic.selection import (
    Selected,
    SelectionSettings,
    SmallCopies,
    StretchSelection,
    every,
    has_texture,
    interval_s,
    select_keyframes,
    small_gray,
)
from sorvolo.survey.flight import CameraPrior, Frame, LostFrame, PosedFrame

WIDTH, HEIGHT = 384, 256
EVERYWHERE = lambda posed: True  # noqa: E731


def ground(seed: int = 1) -> np.ndarray:
    rng = np.random.default_rng(seed)
    total = np.zeros((400, 3000), np.float32)
    for octave in (4, 12, 40):
        small = rng.normal(0, 1, (400 // octave + 2, 3000 // octave + 2)).astype(np.float32)
        total += cv2.resize(small, (3000, 400), interpolation=cv2.INTER_CUBIC)
    return np.clip(120 + 25 * total, 0, 255).astype(np.uint8)


GROUND = ground()


def posed(index: int, x: int, blur_px: float = 0.0) -> PosedFrame:
    view = GROUND[60 : 60 + HEIGHT, x : x + WIDTH]
    if blur_px:
        view = cv2.GaussianBlur(view, (0, 0), blur_px)
    noise = np.random.default_rng(index).normal(0, 1.0, view.shape)
    gray = np.clip(view + noise, 0, 255).astype(np.uint8)
    prior = CameraPrior(np.array([x, 0, 20.0]), np.ones(3), np.diag([1.0, -1, -1]), np.ones(3))
    return PosedFrame(
        Frame(index, str(index), index * 10**8, np.repeat(gray[..., None], 3, axis=2)), prior
    )


def chosen(frames, settings=None, *, keep_all=False, inside=EVERYWHERE):
    return list(
        select_keyframes(frames, settings or SelectionSettings(), keep_all=keep_all, inside=inside)
    )


def places(selected) -> np.ndarray:
    return np.array([each.posed.prior.position_m[0] for each in selected if not each.reason])


def test_small_copies_are_made_once_and_forgotten(monkeypatch):
    made = []
    monkeypatch.setattr(
        "sorvolo.mosaic.selection.small_gray", lambda image: made.append(1) or small_gray(image)
    )
    copies, frames = SmallCopies(), [posed(k, 16 * k) for k in range(40)]
    for each in frames:
        assert np.array_equal(copies.of(each.frame), small_gray(each.frame.image))
        assert copies.of(each.frame) is copies.of(each.frame)
    assert len(made) == 40
    with_copies = select_keyframes(
        frames, SelectionSettings(), keep_all=False, inside=EVERYWHERE, small=copies
    )
    assert np.array_equal(places(with_copies), places(chosen(frames)))
    assert len(copies._kept) < 40


@pytest.mark.parametrize("overlap", [0.6, 0.7, 0.85])
def test_successors_overlap_as_much_as_wanted(overlap):
    found = chosen((posed(k, 16 * k) for k in range(60)), SelectionSettings(overlap=overlap))
    shares = 1 - np.diff(places(found)) / WIDTH
    assert places(found)[0] == 0
    # the first frame beyond the wanted overlap is taken: at most one step of 16 px later
    assert (shares <= overlap + 0.01).all()
    assert (shares >= overlap - 16 / WIDTH - 0.01).all()


def test_a_hovering_drone_gives_one_keyframe():
    assert len(chosen(posed(k, 300) for k in range(20))) == 1


def test_a_blurred_frame_waits_for_a_better_one():
    step = 12
    due = places(chosen(posed(k, step * k) for k in range(40)))
    blurred = int(due[2]) // step
    found = chosen(posed(k, step * k, 2.0 if k == blurred else 0.0) for k in range(40))
    assert due[2] not in places(found)
    assert due[2] + step in places(found)
    assert not any(each.reason for each in found)


def test_a_useless_frame_is_rejected_with_a_reason():
    frames = [posed(k, 130 * k, 4.0 if k == 8 else 0.0) for k in range(16)]
    found = chosen(frames)
    rejected = [each for each in found if each.reason]
    assert [each.posed.frame.index for each in rejected] == [8]
    assert rejected[0].reason.startswith("blurred: ")
    assert len(found) == 16


def test_photos_are_all_kept():
    found = chosen((posed(k, 10 * k) for k in range(12)), keep_all=True)
    assert [each.posed.frame.index for each in found] == list(range(12))


def test_frames_outside_the_area_are_dropped():
    found = chosen(
        (posed(k, 150 * k) for k in range(12)),
        inside=lambda each: 300 <= each.prior.position_m[0] < 1200,
    )
    assert [each.posed.frame.index for each in found] == [2, 3, 4, 5, 6, 7]


def test_lost_frames_pass_through_in_order():
    lost = LostFrame(1, "IMG_2.jpg", 5, "the file is cut off")
    found = chosen([posed(0, 0), lost, posed(2, 200)])
    assert found[1] is lost
    assert isinstance(found[0], Selected) and isinstance(found[2], Selected)


def test_another_picture_size_and_water_are_taken():
    flat = PosedFrame(
        Frame(1, "1", 1, np.full((HEIGHT, WIDTH, 3), 90, np.uint8)), posed(0, 0).prior
    )
    other = PosedFrame(Frame(2, "2", 2, posed(0, 0).frame.image[:200]), posed(0, 0).prior)
    found = chosen([posed(0, 0), other, flat], keep_all=False)
    assert [each.posed.frame.index for each in found] == [0, 2, 1]


def test_the_small_copy_has_256_pixels_along_its_longer_side():
    assert small_gray(np.zeros((1080, 1920, 3), np.uint8)).shape == (144, 256)


def test_the_interval_is_that_of_the_thesis():
    # eq. 3.17: at 20 m a picture of 2 aov 36.87 deg shows 2/3 h = 13.3 m; 30 % of it at 4 m/s takes 1 s
    camera = Camera(900, 600, 900.0, 900.0, 450.0, 300.0)
    assert interval_s(camera, 20.0, 4.0, 0.7) == pytest.approx(20 * 600 / 900 * 0.3 / 4.0)
    assert interval_s(camera, 20.0, 0.0, 0.7) == 10.0


def test_every_keeps_its_rate_over_uneven_frames():
    wanted = every(0.5)
    times_s = np.cumsum(np.random.default_rng(1).uniform(0.03, 0.05, 500))
    taken = [t for k, t in enumerate(times_s) if wanted(k, round(t * 1e9))]
    assert taken[0] == times_s[0]
    assert len(taken) == pytest.approx((times_s[-1] - times_s[0]) / 0.5, abs=2)
    assert np.diff(taken).min() > 0.4


@pytest.mark.parametrize("overlap", [0.3, 1.0, 1.5])
def test_impossible_overlaps_are_refused(overlap):
    with pytest.raises(SettingsError, match="overlap"):
        SelectionSettings(overlap=overlap)


def test_of_frames_over_known_ground_those_that_show_enough_new_ground_are_taken():
    outline_m = np.array([[0.0, 10.0], [20.0, 10.0], [20.0, 0.0], [0.0, 0.0]])
    selection = StretchSelection(0.7, keep_all=False)
    taken = [selection.take(outline_m + np.array([east_m, 0.0])) for east_m in (0, 5, 7, 9, 14)]
    assert taken == [True, False, True, False, True]
    assert selection.take(None) and selection.take(outline_m), (
        "after one of unknown place the next is taken"
    )
    photos = StretchSelection(0.7, keep_all=True)
    assert [photos.take(outline_m) for _ in range(3)] == [True] * 3


@pytest.mark.parametrize("noise_levels", [0.0, 1.0, 3.0])
def test_one_gray_and_noise_alone_are_no_texture(noise_levels):
    noise = np.random.default_rng(0).normal(0, noise_levels, (480, 640, 1))
    bare = np.repeat(np.clip(128 + noise, 0, 255).astype(np.uint8), 3, axis=2)
    assert not has_texture(bare)
    seen = posed(0, 0).frame.image
    assert has_texture(seen)
    # a field in fog: a twentieth of its contrast
    assert has_texture(np.clip(128 + (seen.astype(float) - 128) / 20, 0, 255).astype(np.uint8))
