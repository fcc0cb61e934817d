"""The thesis's method against a word-for-word version of section 3.2, and its laws."""

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import numpy_thesis as twins
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sorvolo import kernels
from sorvolo.errors import InputError, SettingsError
from sorvolo.lab.thesis.changes import (
    ThesisSettings,
    bhattacharyya_distances,
    compare_thesis,
    prepare_reference,
    thesis_steps,
)

SMALL = ThesisSettings(
    averaging_px=(4, 3), pattern_px=(5, 4), isolation_px=(6, 7), area_share=0.02, gray_threshold=30
)


def pair(seed: int, size: tuple[int, int]) -> tuple[Any, Any]:
    """A textured ground, and the same with other things on it, in other light."""
    rng = np.random.default_rng(seed)
    height, width = size
    ground = cv2.blur(rng.integers(0, 256, (height, width, 3), np.uint8), (3, 3)).reshape(
        height, width, 3
    )
    later = np.clip(ground * rng.uniform(0.6, 1.2) + rng.uniform(-20, 20), 0, 255).astype(np.uint8)
    for _ in range(rng.integers(0, 4)):
        x, y = rng.integers(0, width), rng.integers(0, height)
        thing = later[y : y + rng.integers(1, 30), x : x + rng.integers(1, 30)]
        thing[:] = (
            rng.integers(0, 256, thing.shape) if rng.random() < 0.5 else rng.integers(0, 256, 3)
        )
    return ground, later


def holes(seed: int, size: tuple[int, int]) -> Any:
    valid = np.ones(size, bool)
    rng = np.random.default_rng(seed)
    for _ in range(rng.integers(1, 3)):
        y, x = rng.integers(0, size[0]), rng.integers(0, size[1])
        valid[y : y + rng.integers(1, 25), x : x + rng.integers(1, 25)] = False
    return valid


def by_the_text(
    before: Any, after: Any, parameters: ThesisSettings
) -> tuple[Any, list[tuple[int, ...]]]:
    """Section 3.2 pixel by pixel, with nothing of ours but the equalisation's tables."""
    height, width = before.shape[:2]

    def around(image: Any, y: int, x: int, window: tuple[int, int]) -> Any:
        rows = range(y - window[1] // 2, y - window[1] // 2 + window[1])
        columns = range(x - window[0] // 2, x - window[0] // 2 + window[0])
        where = [
            [cv2.borderInterpolate(at, size, cv2.BORDER_REFLECT_101) for at in run]
            for run, size in ((rows, height), (columns, width))
        ]
        return image[np.ix_(*where)].astype(int)

    equalised, averaged = [], []
    for image in (before, after):
        tables = twins.equalising_tables(image, None, 1)
        equal = np.stack([tables[c][image[..., c]] for c in range(3)], axis=-1)
        mean = np.array(
            [
                [
                    (around(equal, y, x, parameters.averaging_px).mean(axis=(0, 1)) + 0.5).astype(
                        np.uint8
                    )
                    for x in range(width)
                ]
                for y in range(height)
            ]
        )
        equalised.append(equal)
        averaged.append(mean)
    grays = [cv2.cvtColor(each, cv2.COLOR_RGB2GRAY).astype(int) for each in averaged]
    difference = np.zeros((height, width), np.uint8)
    for y in range(height):
        for x in range(width):
            if abs(grays[0][y, x] - grays[1][y, x]) < parameters.gray_threshold:
                continue
            strings = [
                ~(around(each, y, x, parameters.pattern_px) < each[y, x]) for each in averaged
            ]
            if (strings[0] != strings[1]).sum() > parameters.hamming_share * strings[0].size:
                difference[y, x] = 255
    mask = np.zeros_like(difference)
    share = (
        parameters.isolation_share
        if parameters.isolation_as_printed
        else 1 - parameters.isolation_share
    )
    for y in range(height):
        for x in range(width):
            window = around(difference, y, x, parameters.isolation_px)
            mask[y, x] = 0 if (window == 0).sum() > share * window.size else 255
    _, _, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
    boxes = [tuple(int(value) for value in each[:4]) for each in stats[1:]]
    for x, y, w, h in [
        each for each in boxes if each[2] * each[3] / mask.size < parameters.area_share
    ]:
        mask[y : y + h, x : x + w] = 0
        boxes.remove((x, y, w, h))
    for x, y, w, h in list(boxes):
        counts = [
            np.bincount(
                cv2.cvtColor(each, cv2.COLOR_RGB2GRAY)[y : y + h, x : x + w].ravel(), minlength=256
            )
            for each in equalised
        ]
        means = [each.sum() / 256 for each in counts]
        root = np.sqrt(counts[0] * counts[1]).sum() / np.sqrt(means[0] * means[1] * 256**2)
        if np.sqrt(max(0.0, 1 - root)) < parameters.least_distance:
            mask[y : y + h, x : x + w] = 0
            boxes.remove((x, y, w, h))
    return mask, sorted(
        each
        for each in boxes
        if mask[each[1] : each[1] + each[3], each[0] : each[0] + each[2]].any()
    )


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.tuples(st.integers(1, 24), st.integers(1, 30)), st.booleans())
def test_every_pixel_is_as_the_text_has_it(seed: int, size: tuple[int, int], printed: bool) -> None:
    before, after = pair(seed, size)
    parameters = replace(SMALL, isolation_as_printed=printed)
    mask, boxes = by_the_text(before, after, parameters)
    found = compare_thesis(before, after, settings=parameters)
    np.testing.assert_array_equal(found.mask, mask)
    assert sorted(map(tuple, found.boxes)) == boxes


@settings(max_examples=40, deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.tuples(st.integers(1, 90), st.integers(1, 200)),
    st.booleans(),
    st.integers(1, 4),
)
def test_compiled_and_numpy_agree_to_the_last_pixel(
    seed: int, size: tuple[int, int], with_holes: bool, threads: int
) -> None:
    before, after = pair(seed, size)
    valid = holes(seed, size) if with_holes else None
    parameters = SMALL if seed % 2 else ThesisSettings()
    found = compare_thesis(before, after, valid, parameters, threads)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(kernels, "_native", twins)
        expected = compare_thesis(before, after, valid, parameters)
    np.testing.assert_array_equal(found.mask, expected.mask)
    np.testing.assert_array_equal(found.boxes, expected.boxes)


def scene() -> tuple[Any, Any]:
    """A field, and the same with a car of 60 x 30 px at (100, 60)."""
    rng = np.random.default_rng(8)
    field = cv2.GaussianBlur(rng.normal(110, 60, (180, 240, 3)), (0, 0), 2) * 1.5 - 50
    before = np.clip(field, 0, 255).astype(np.uint8)
    after = before.copy()
    after[60:90, 100:160] = (220, 30, 30)
    after[66:84, 115:145] = 240
    return before, after


def test_a_new_car_is_found_and_nothing_else() -> None:
    before, after = scene()
    mask, boxes = compare_thesis(before, after)
    assert (mask[60:90, 100:160] > 0).mean() > 0.8  # W_i rounds the corners off
    assert len(boxes) == 1
    x, y, width, height = boxes[0]
    assert (
        abs(x - 100) < 9
        and abs(y - 60) < 9
        and abs(x + width - 160) < 9
        and abs(y + height - 90) < 9
    )
    assert set(np.unique(mask)) == {0, 255} and mask.dtype == np.uint8 and boxes.dtype == np.int64
    assert not compare_thesis(before, before).mask.any()


def test_the_printed_reading_keeps_less() -> None:
    before, after = scene()
    workable = compare_thesis(before, after).mask
    printed = compare_thesis(before, after, settings=ThesisSettings(isolation_as_printed=True)).mask
    assert (printed > 0).sum() < 0.6 * (workable > 0).sum()


def test_the_unknown_is_never_changed() -> None:
    before, after = scene()
    valid = np.ones(before.shape[:2], bool)
    valid[40:110, 90:130] = False
    before[~valid] = 0
    mask, _ = compare_thesis(before, after, valid)
    assert not mask[~valid].any()
    assert (mask[60:90, 140:160] > 0).mean() > 0.5
    before, after = scene()[0], scene()[0]
    before[~valid] = 0
    assert not compare_thesis(before, after, valid).mask.any()
    assert compare_thesis(before, after).mask.any()
    assert not compare_thesis(before, after, np.zeros_like(valid)).mask.any()


def test_a_prepared_reference_gives_the_same() -> None:
    before, after = scene()
    valid = np.ones(before.shape[:2], bool)
    valid[:50, :50] = False
    expected = compare_thesis(before, after, valid)
    found = compare_thesis(prepare_reference(before, valid), after)
    np.testing.assert_array_equal(found.mask, expected.mask)
    with pytest.raises(SettingsError, match="prepare it with these settings"):
        compare_thesis(prepare_reference(before), after, settings=SMALL)
    with pytest.raises(InputError, match="give aligned pictures of the same size"):
        compare_thesis(prepare_reference(before), after[:-1])


def test_steps_are_those_of_the_figure() -> None:
    before, after = scene()
    steps = thesis_steps(before, after)
    pictures = steps.pictures()
    assert [name[0] for name in pictures] == list("abcdefgh")
    assert all(
        picture.dtype == np.uint8 and picture.shape[:2] == (180, 240)
        for picture in pictures.values()
    )
    np.testing.assert_array_equal(steps.changes, compare_thesis(before, after).mask)
    hist = np.bincount(steps.query_equalised[..., 1].ravel(), minlength=256)
    assert np.abs(np.cumsum(hist) / hist.sum() - (np.arange(256) + 1) / 256).max() < 0.1
    assert (steps.difference > 0).sum() > 0
    np.testing.assert_array_equal(steps.highlighted[steps.changes > 0], after[steps.changes > 0])


def test_distances_of_equation_3_22() -> None:
    one, other = np.array([[4, 0, 5, 0]]), np.array([[0, 3, 0, 6]])
    assert bhattacharyya_distances(one, one)[0] == pytest.approx(0, abs=1e-7)
    assert bhattacharyya_distances(one, other)[0] == 1
    assert bhattacharyya_distances(0 * one, other)[0] == 0
    third = np.array([[2, 2, 3, 2]])
    expected = cv2.compareHist(
        one[0].astype(np.float32), third[0].astype(np.float32), cv2.HISTCMP_BHATTACHARYYA
    )
    assert bhattacharyya_distances(one, third)[0] == pytest.approx(expected, abs=1e-6)


def test_settings_are_those_of_table_4_2_and_checked() -> None:
    assert ThesisSettings().most_differing_bits == 202
    assert ThesisSettings().most_black == 1026
    assert ThesisSettings(isolation_as_printed=True).most_black == 342
    for wrong in (
        {"averaging_px": (0, 10)},
        {"pattern_px": (15, 200)},
        {"isolation_px": 37},
        {"hamming_share": 1.5},
        {"least_distance": -0.1},
        {"gray_threshold": 300},
        {"area_share": float("nan")},
    ):
        with pytest.raises(SettingsError, match=next(iter(wrong))):
            ThesisSettings(**wrong)  # type: ignore[arg-type]
