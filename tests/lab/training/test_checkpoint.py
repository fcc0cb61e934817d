"""Training goes on after a kill as if nothing had happened, and refuses what does not belong."""

from collections.abc import Iterator
from itertools import islice

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from sorvolo.errors import InputError, SettingsError
from sorvolo.geometry.arrays import ImageRGB
from sorvolo.lab.training.learning import SingleStageTraining
from sorvolo.lab.training.progress import (
    Check,
    History,
    Progress,
    checkpoint_bytes,
    read_checkpoint,
    restore,
    seconds_left,
)
from sorvolo.lab.training.samples import Share, TrainingSample, batches_from, draws
from sorvolo.lab.training.settings import TrainSettings
from sorvolo.lab.training.single_stage import SingleStage
from sorvolo.survey.labels import LabelledPicture, LabelledSet

_CLASSES = ("person", "car")
_SETTINGS = {"preset": "fast", "steps": 8, "seed": 3}


def _picture(index: int) -> ImageRGB:
    rng = np.random.default_rng(index)
    image = rng.integers(60, 100, (80, 96, 3)).astype(np.uint8)
    image[20:36, 10 + index : 30 + index] = (200, 60, 60)
    return image


def _shares(count: int = 5) -> list[Share]:
    pictures = [
        LabelledPicture(
            str(index),
            96,
            80,
            "",
            np.array([[10 + index, 20, 30 + index, 36]], np.float32),
            np.array([1]),
            np.zeros((0, 4), np.float32),
        )
        for index in range(count)
    ]
    labelled = LabelledSet("squares", _CLASSES, tuple(pictures))
    return [Share(labelled, 2.0, (0.9, 1.2)), Share(labelled.only(pictures[:2]), 1.0, (0.9, 1.2))]


def _batches(start: int = 0, threads: int = 1) -> Iterator[list[TrainingSample]]:
    return batches_from(
        _shares(),
        _CLASSES,
        lambda path: _picture(int(path)),
        side=64,
        seed=3,
        batch=2,
        start=start,
        threads=threads,
    )


def _learner(classes: int = 2) -> SingleStageTraining:
    torch.manual_seed(0)
    return SingleStageTraining(SingleStage(classes), 6, "cpu", is_tuned=False)


def test_a_resumed_run_ends_as_one_that_was_not_stopped() -> None:
    whole = _learner()
    wanted = [whole.learn(batch).losses for batch in islice(_batches(), 6)]

    first = _learner()
    for batch in islice(_batches(), 4):
        first.learn(batch)
    saved = checkpoint_bytes(first, _SETTINGS, History())
    del first
    second = _learner()
    restore(second, read_checkpoint(saved, "checkpoint"), _SETTINGS)
    assert second.step == 4
    assert [second.learn(batch).losses for batch in islice(_batches(4), 2)] == wanted[4:]
    for name, value in second.average.state_dict().items():
        assert torch.equal(value, whole.average.state_dict()[name]), name


def test_other_settings_are_refused_by_name() -> None:
    saved = read_checkpoint(checkpoint_bytes(_learner(), _SETTINGS, History()), "checkpoint")
    with pytest.raises(
        SettingsError, match=r"seed was 3, is 4; steps was 8, is 9; give the earlier ones"
    ):
        restore(_learner(), saved, _SETTINGS | {"seed": 4, "steps": 9})
    with pytest.raises(InputError, match="does not fit this network"):
        restore(_learner(classes=1), saved, _SETTINGS)


@pytest.mark.parametrize("data", [b"", b"not a checkpoint", b"\x80\x04N.", b"junk"])
def test_damaged_checkpoints_are_refused(data: bytes) -> None:
    with pytest.raises(
        InputError, match=r"run/checkpoint\.pt is no checkpoint of sorvolo, or damaged"
    ):
        read_checkpoint(data, "run/checkpoint.pt")


def test_a_cut_checkpoint_is_refused() -> None:
    saved = checkpoint_bytes(_learner(), _SETTINGS, History())
    with pytest.raises(InputError, match="damaged"):
        read_checkpoint(saved[: len(saved) // 2], "checkpoint")


def test_too_few_steps_for_four() -> None:
    with pytest.raises(SettingsError, match="at least 4 steps"):
        TrainSettings("thesis", steps=3)


def test_draws_do_not_depend_on_where_they_start_and_take_all_pictures_in_turn() -> None:
    whole = list(islice(draws(_shares(), 7), 60))
    assert list(islice(draws(_shares(), 7, start=25), 35)) == whole[25:]
    first = [each.picture for each in whole if each.share == 0]
    for start in range(0, len(first) - 4, 5):
        assert sorted(first[start : start + 5]) == [0, 1, 2, 3, 4]
    assert 25 < len(first) < 55  # twice the weight of the other
    assert list(islice(draws(_shares(), 8), 60)) != whole


def test_batches_do_not_depend_on_threads() -> None:
    one, many = list(islice(_batches(), 4)), list(islice(_batches(2, threads=3), 2))
    for a, b in zip(one[2:], many):
        for x, y in zip(a, b):
            assert np.array_equal(x.image, y.image) and np.array_equal(x.boxes, y.boxes)


def test_nothing_to_learn_from() -> None:
    empty = Share(LabelledSet("none", _CLASSES, ()), 1.0)
    with pytest.raises(SettingsError, match="no picture to learn from"):
        next(draws([empty], 1))


def test_history_means_rows_and_survives_json() -> None:
    history = History()
    for step in range(1, 8):
        history = history.after(
            Progress(step, {"score": step, "box": 3}, 0.0, 7), seconds=0.5 * step, every=3
        )
    assert [(row.step, row.losses["score"], row.loss) for row in history.rows] == [
        (3, 2, 5),
        (6, 5, 8),
        (7, 7, 10),
    ]
    assert history.seconds == 3.5 and not history.pending
    history = history.checked(Check(3, 0.4, 0.2, {"car": 0.4})).checked(
        Check(6, 0.3, 0.2, {"car": 0.3})
    )
    assert history.best == history.checks[0]
    assert (
        history.is_worth_going_on(2)
        and not history.is_worth_going_on(1)
        and history.is_worth_going_on(0)
    )
    assert History.from_plain(history.plain()) == history
    assert seconds_left(10, 30, 5, 2.0) == 8.0 and np.isnan(seconds_left(0, 30, 0, 0.0))
