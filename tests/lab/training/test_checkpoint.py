"""Training goes on after a kill as if nothing had happened, in both schedules; and refuses what does not belong."""

from collections.abc import Callable, Iterator
from itertools import islice

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from sorvolo.errors import InputError, SettingsError
from sorvolo.geometry.arrays import ImageRGB
from sorvolo.lab.thesis.four_steps import FourStepSettings, FourStepTraining
from sorvolo.lab.training.faster_rcnn import build
from sorvolo.lab.training.joint import JointSettings, JointTraining, Progress
from sorvolo.lab.training.progress import (
    Check,
    History,
    Learner,
    checkpoint_bytes,
    read_checkpoint,
    restore,
    seconds_left,
)
from sorvolo.lab.training.samples import Augmentation, Share, TrainingSample, batches_from, draws
from sorvolo.lab.training.settings import TrainSettings
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
        Augmentation(side_px=64),
        seed=3,
        batch=2,
        start=start,
        threads=threads,
    )


def _joint(steps: int = 8) -> Learner:
    torch.manual_seed(0)
    settings = JointSettings(steps=steps, batch=2, warm_steps=2, regions=16, mixed_precision=False)
    return JointTraining(build("fast", _CLASSES, "standard", None), settings, 3)


def _four_steps(steps: int = 8) -> Learner:
    torch.manual_seed(0)
    return FourStepTraining(
        build("fast", _CLASSES, "standard", None),
        FourStepSettings(steps=steps, rate=1e-2, regions=16, proposed=40),
        3,
    )


def _losses(progress: Progress) -> tuple[float, ...]:
    return (
        progress.proposal_score,
        progress.proposal_box,
        progress.region_score,
        progress.region_box,
    )


@pytest.mark.parametrize(
    ("make", "killed_after"), [(_joint, 3), (_four_steps, 1), (_four_steps, 3)]
)
def test_a_resumed_run_has_the_losses_of_one_that_was_not_stopped(
    make: Callable[[], Learner], killed_after: int
) -> None:
    whole = make()
    wanted = [_losses(whole.learn(batch)) for batch in islice(_batches(), 8)]

    first = make()
    for batch in islice(_batches(), killed_after):
        first.learn(batch)
    saved = checkpoint_bytes(first, _SETTINGS, History())
    del first
    second = make()
    restore(second, read_checkpoint(saved, "checkpoint"), _SETTINGS)
    assert second.step == killed_after
    found = [
        _losses(second.learn(batch)) for batch in islice(_batches(killed_after), 8 - killed_after)
    ]
    assert found == wanted[killed_after:]
    for name, value in second.average.state_dict().items():
        assert torch.equal(value, whole.average.state_dict()[name]), name


def test_other_settings_are_refused_by_name() -> None:
    saved = read_checkpoint(checkpoint_bytes(_joint(), _SETTINGS, History()), "checkpoint")
    with pytest.raises(
        SettingsError, match=r"seed was 3, is 4; steps was 8, is 9; give the earlier ones"
    ):
        restore(_joint(), saved, _SETTINGS | {"seed": 4, "steps": 9})
    other = JointTraining(build("fast", ("person",), "standard", None), JointSettings(steps=8), 3)
    with pytest.raises(InputError, match="does not fit this network"):
        restore(other, saved, _SETTINGS)


@pytest.mark.parametrize("data", [b"", b"not a checkpoint", b"\x80\x04N.", b"junk"])
def test_damaged_checkpoints_are_refused(data: bytes) -> None:
    with pytest.raises(
        InputError, match=r"run/checkpoint\.pt is no checkpoint of sorvolo, or damaged"
    ):
        read_checkpoint(data, "run/checkpoint.pt")


def test_a_cut_checkpoint_is_refused() -> None:
    saved = checkpoint_bytes(_joint(), _SETTINGS, History())
    with pytest.raises(InputError, match="damaged"):
        read_checkpoint(saved[: len(saved) // 2], "checkpoint")


def test_the_four_steps_train_what_they_should() -> None:
    learner = _four_steps()
    assert isinstance(learner, FourStepTraining)
    stream = _batches()
    start = _copies(learner)
    after = []
    for _ in range(4):
        progress = [learner.learn(next(stream)) for _ in range(2)]
        after.append((_copies(learner), learner.stage, progress[-1]))
    (one, two, three, four) = [each[0] for each in after]
    assert [each[1] for each in after] == [0, 1, 2, 3]
    moved = [
        {part for part in now if _differ(before[part], now[part])}
        for before, now in ((start, one), (one, two), (two, three), (three, four))
    ]
    # the second step begins again from the first weights, so its shared layers are neither
    assert moved == [
        {"backbone", "neck", "proposals"},
        {"backbone", "neck", "head"},
        {"proposals"},
        {"head"},
    ]
    assert [(_losses(each[2])[0] > 0, _losses(each[2])[2] > 0) for each in after] == [
        (True, False),
        (False, True),
        (True, False),
        (False, True),
    ]


def test_the_second_step_begins_from_the_first_weights_and_the_first_steps_proposals() -> None:
    learner = _four_steps()
    assert isinstance(learner, FourStepTraining)
    start = _copies(learner)
    stream = _batches()
    learner.learn(next(stream))
    learner.learn(next(stream))
    proposer = {name: value.clone() for name, value in learner.model.backbone.state_dict().items()}
    learner._enter(1)
    assert not _differ(start["backbone"], learner.model.backbone.state_dict())
    assert learner._proposer is not None
    assert not _differ(proposer, learner._proposer[0].state_dict())


def test_too_few_steps_for_four() -> None:
    with pytest.raises(SettingsError, match="at least 4 steps"):
        TrainSettings(schedule="four-steps", steps=3)


def _copies(learner: FourStepTraining) -> dict[str, dict[str, "torch.Tensor"]]:
    parts = {"backbone", "neck", "proposals", "head"}
    return {
        part: {
            name: value.clone() for name, value in getattr(learner.model, part).state_dict().items()
        }
        for part in parts
    }


def _differ(a: dict[str, "torch.Tensor"], b: dict[str, "torch.Tensor"]) -> bool:
    return any(not torch.equal(value, b[name]) for name, value in a.items())


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
        history = history.after(Progress(step, step, 0, 1, 2, 0.0, 7), seconds=0.5 * step, every=3)
    assert [(row.step, row.proposal_score, row.loss) for row in history.rows] == [
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
