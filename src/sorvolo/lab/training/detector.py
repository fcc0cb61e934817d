"""Train the detector: labelled pictures and weights in, checkpoints on the way, a model file and a report out."""

import math
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path
from typing import Any

from sorvolo import __version__
from sorvolo.capture.photos import read_picture
from sorvolo.detection.contract import CALIBRATED
from sorvolo.detection.fusing import in_own_scale, scaled_thresholds
from sorvolo.errors import InputError, SettingsError
from sorvolo.geometry.arrays import ImageRGB
from sorvolo.lab.training.boxes import Finder
from sorvolo.lab.training.held_out import (
    Checked,
    best_sizes_px,
    check_model,
    check_of,
    found_sizes_px,
    padded_to,
)
from sorvolo.lab.training.onnx_export import (
    ExportCheck,
    check_export,
    export_onnx,
    round_weights,
)
from sorvolo.lab.training.page import training_page
from sorvolo.lab.training.progress import (
    Check,
    History,
    Learner,
    Progress,
    checkpoint_bytes,
    load_weights_bytes,
    read_checkpoint,
    restore,
    seconds_left,
    weights_bytes,
)
from sorvolo.lab.training.samples import batches_from
from sorvolo.lab.training.sets import (
    DataOptions,
    TrainingSets,
    training_sets,
)
from sorvolo.lab.training.settings import TrainSettings
from sorvolo.lab.training.start import (
    Start,
    begin_notices,
    device_of,
    kept_notices,
    kept_on_request,
    kept_thermal_by,
    load_start,
    start_learner,
    without_denormals,
)
from sorvolo.paths import AnyPath, Inputs, listed
from sorvolo.store.atomic import atomic_write_bytes, remove_leftovers, writing
from sorvolo.store.exports.plain import json_bytes, plain_json
from sorvolo.survey.wording import counted

MODEL, REPORT, PAGE = "model.onnx", "training.json", "training.html"
CHECKPOINT, BEST = "checkpoint.pt", "best.safetensors"
"""What a run leaves in its folder."""

_CHECKS, _CHECK_STEPS = (
    20,
    50,
)  # a run is checked so often, evenly over its steps, but not after fewer of them
_MOST_CHECKED, _MOST_CHECKED_LAST = 150, 1000  # held-out pictures
_ROWS = 200  # of losses in the report
_SAVE_S = 60.0  # a kill costs no more than this and the time between two checks
_KEPT_PICTURES_BYTES = (
    2 << 30
)  # decoded pictures in memory: two gigabytes of a small computer's eight; by choice
_FINDS_NOTHING_AP50 = 0.05  # below which a model is of no use yet
_EXPORT_PICTURES, _EXPORT_PX = 4, 1280  # by which the model file is compared with torch


@dataclass(frozen=True)
class TrainingUpdate:
    """Where a run stands. Before its first step `step` is 0 and `words` names what is being done."""

    step: int
    steps: int
    words: str
    losses: Progress | None = None  # of the last step
    steps_per_s: float = float("nan")
    left_s: float = float("nan")
    check: Check | None = None  # the one made just now
    notices: tuple[str, ...] = ()  # what is to be known, each reported once


@dataclass(eq=False)
class _Run:
    """A run on its way: `learner` and `history` change with every step."""

    out: Path
    settings: TrainSettings
    sets: TrainingSets
    learner: Learner
    reader: "_Reader"
    device: str
    start: Start | None
    notices: tuple[str, ...]  # reported before the first step
    history: History = field(default_factory=History)

    @property
    def identity(self) -> dict[str, Any]:
        """What a run must share with the one that it goes on from."""
        settings = {key: value for key, value in asdict(self.settings).items() if key != "patience"}
        return {
            **settings,
            "weights": self.start.identity if self.start else "none",
            "classes": list(self.sets.classes),
            "data": self.sets.fingerprint,
        }


def train_detector(
    places: Inputs,
    out: AnyPath,
    settings: TrainSettings,
    options: DataOptions,
    *,
    device: str = "auto",
    resume: bool = False,
) -> Iterator[TrainingUpdate]:
    """Train on the sets at `places` and leave model.onnx, training.html, training.json and checkpoints in `out`.

    Closing the iterator early leaves a checkpoint, from which `resume` goes on. Raises InputError for data or weights
    that cannot be used, SettingsError for a device that is not there, for an `out` that holds another run, and for
    resuming with other settings or data; StoreError on a full disk.
    """
    folders = [Path(each) for each in listed(places)]
    out = Path(out)
    device = device_of(device)
    with _claimed(out, resume):
        start = load_start(settings)
        steps = settings.steps
        yield TrainingUpdate(0, steps, "reading the labels")
        sets = training_sets(folders, options, seed=settings.seed)
        notices = sets.notices
        if start is not None:
            notices += tuple(begin_notices(start, sets.classes))
        yield TrainingUpdate(
            0, steps, f"preparing the network ({settings.preset})", notices=notices
        )
        reader = _Reader(sets)
        with without_denormals():
            learner = start_learner(settings, sets.classes, start, device)
            run = _Run(out, settings, sets, learner, reader, device, start, notices)
            if resume:
                checkpoint = read_checkpoint((out / CHECKPOINT).read_bytes(), str(out / CHECKPOINT))
                restore(run.learner, checkpoint, run.identity)
                run.history = checkpoint.history
            yield from _learn(run)
            yield TrainingUpdate(run.learner.step, steps, "measuring and writing the model")
            check, closing_notices = _finish(run)
        yield TrainingUpdate(
            run.learner.step, steps, f"{out / MODEL} is ready", check=check, notices=closing_notices
        )


@contextmanager
def _claimed(out: Path, resume: bool) -> Iterator[None]:
    """Make the folder; raise SettingsError unless it is free, or holds what is to be gone on from.

    What was made is gone again when nothing came into it, as after an error before the first step.
    """
    held = (out / CHECKPOINT).is_file()
    if resume and not held:
        raise SettingsError(
            f"{out} holds no {CHECKPOINT} to go on from; leave --resume out to start there"
        )
    if held and not resume:
        raise SettingsError(
            f"{out} already holds a run; --resume continues it, another --out starts a new one"
        )
    made = [each for each in (out, *out.parents) if not each.exists()]
    with writing(out):
        out.mkdir(parents=True, exist_ok=True)
        remove_leftovers([out])
    try:
        yield
    finally:
        with suppress(OSError):  # a folder that holds something stays
            for each in made:
                each.rmdir()


class _Reader:
    """Reads pictures, keeping as many as a bounded part of the memory holds; `damaged` are those that cannot be."""

    def __init__(self, sets: TrainingSets) -> None:
        pictures = [picture for share in sets.shares for picture in share.labelled.pictures]
        size = sum(3 * each.width_px * each.height_px for each in pictures) / len(pictures)
        self.damaged: dict[str, str] = {}
        self._kept = lru_cache(maxsize=int(_KEPT_PICTURES_BYTES / size))(self._read)

    def __call__(self, path: str) -> ImageRGB:
        """The picture's pixels. Raises InputError when it is damaged or gone."""
        return self._kept(path)

    def _read(self, path: str) -> ImageRGB:
        try:
            return read_picture(Path(path))
        except (InputError, OSError) as error:
            self.damaged[path] = f"{error}"
            raise InputError(f"{path}: {error}") from error


def _learn(run: _Run) -> Iterator[TrainingUpdate]:
    """All steps that are left, with checks and checkpoints; ends early where checks no longer get better."""
    settings, learner = run.settings, run.learner
    batches = batches_from(
        run.sets.shares,
        run.sets.classes,
        run.reader,
        side=settings.side_px,
        seed=settings.seed,
        batch=settings.batch,
        start=learner.step,
        threads=max(1, min(8, (os.cpu_count() or 1) - 1)),
    )
    first, before_s, started_s = learner.step, run.history.seconds, time.monotonic()
    saved_s = started_s
    try:
        while learner.step < settings.steps and run.history.is_worth_going_on(settings.patience):
            progress = learner.learn(next(batches))
            if not math.isfinite(progress.loss):
                raise SettingsError(
                    f"the loss of step {progress.step} is no number: learning has come apart. Take larger batches, "
                    f"--weights auto or another --seed; {run.out / CHECKPOINT} is from before"
                )
            here_s = time.monotonic() - started_s
            run.history = run.history.after(
                progress, before_s + here_s, every=max(1, settings.steps // _ROWS)
            )
            check = _check(run) if _is_check_due(run) else None
            if check is not None or time.monotonic() - saved_s > _SAVE_S:
                _save(run)
                saved_s = time.monotonic()
            yield TrainingUpdate(
                learner.step,
                settings.steps,
                learner.phase,
                progress,
                (learner.step - first) / here_s,
                seconds_left(learner.step, settings.steps, learner.step - first, here_s),
                check,
            )
    except GeneratorExit:
        _save(run)
        raise
    finally:
        batches.close()
    _save(run)


def _is_check_due(run: _Run) -> bool:
    """At even distances and in the end, once the network's parts fit together."""
    step, steps = run.learner.step, run.settings.steps
    if not run.sets.held_out or not run.learner.is_whole:
        return False
    return step % max(_CHECK_STEPS, steps // _CHECKS) == 0 or step == steps


def _check(run: _Run) -> Check:
    """Look at held-out pictures; the best weights so far are kept."""
    check = check_of(_look(run, run.learner.average, _MOST_CHECKED), run.learner.step)
    run.history = run.history.checked(check)
    if run.history.best is check:
        atomic_write_bytes(run.out / BEST, weights_bytes(run.learner.average))
    return check


def _save(run: _Run) -> None:
    atomic_write_bytes(
        run.out / CHECKPOINT, checkpoint_bytes(run.learner, run.identity, run.history)
    )


def _look(run: _Run, model: Finder, most: int) -> Checked:
    return check_model(
        model, run.sets.classes, run.sets.held_out, run.reader, device=run.device, most=most
    )


def _finish(run: _Run) -> tuple[Check | None, tuple[str, ...]]:
    """The best weights as a model file, checked against torch, with the report; its last check, and notices that
    are new."""
    model, classes, history = run.learner.average, run.sets.classes, run.history
    best, held_out = history.best, run.sets.held_out
    before = run.start.info if run.start else None
    if best is not None:
        load_weights_bytes(model, (run.out / BEST).read_bytes(), str(run.out / BEST))
    round_weights(model)
    checked = _look(run, model, _MOST_CHECKED_LAST) if held_out else Checked({}, {})
    thresholds = checked.thresholds(classes, in_own_scale(before) if before else {})
    scores = {name: each.score for name, each in thresholds.items()}
    calibration = checked.calibration(classes, before.calibration if before else {})
    scaled = scaled_thresholds(scores, calibration)
    # what the model file states of itself; of a tuned one also what the model before was
    learnt = [share.labelled for share in run.sets.shares]
    thermal, by_day = run.sets.lights
    licence = "as the data that it was trained on"
    trained_on = ", ".join(each.name for each in learnt)
    kept: dict[str, Any] = {}
    if before:
        licence += f"; the model {before.name} before: {before.licence or 'not stated'}"
        trained_on += f"; the model {before.name} before: {before.trained_on or 'not stated'}"
        kept = {
            "on_request": list(kept_on_request(before, classes, checked.too_few(classes))),
            "thermal_by": kept_thermal_by(before, classes, thermal=thermal),
        }
    info = {
        "format": CALIBRATED if calibration else 1,
        "name": run.out.resolve().name or "model",
        "preset": run.settings.preset,
        "version": __version__,
        "classes": list(classes),
        "thresholds": scaled,
        "calibration": {name: asdict(each) for name, each in calibration.items()},
        "best_px": best_sizes_px(
            checked, scores, learnt, classes, before.best_px if before else {}
        ),
        "licence": licence,
        "trained_on": trained_on,
        "thermal": thermal,
        "daylight": by_day,
        **kept,
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
    }
    exported = export_onnx(model, info)
    # compared on a few that can be read, held-out ones first, padded where a side is shorter than the network's stride
    shown: list[ImageRGB] = []
    for picture in (each for labelled in (*held_out, *learnt) for each in labelled.pictures):
        if len(shown) < _EXPORT_PICTURES:
            with suppress(InputError):
                part = run.reader(picture.path)[:_EXPORT_PX, :_EXPORT_PX]
                shown.append(padded_to(part, model.stride))
    agreement = check_export(model, exported, shown)
    atomic_write_bytes(run.out / MODEL, exported)
    at_step = run.learner.step if best is None else best.step
    check = check_of(checked, at_step) if held_out else None
    notices = _closing_notices(run, agreement, check)
    if before:
        notices += tuple(kept_notices(before, checked.too_few(classes), info["on_request"]))
    step, steps = run.learner.step, run.settings.steps
    report = {
        "made_by": "sorvolo train",
        "format": 1,
        "model": info,
        "settings": asdict(run.settings),
        "device": run.device,
        "weights": "none" if run.start is None else run.start.origin,
        "sets": run.sets.described(),
        "notices": [*run.notices, *notices],
        "step": step,
        "steps": steps,
        "stopped_early": step < steps,
        "seconds": history.seconds,
        "losses": [asdict(row) for row in history.rows],
        "checks": [asdict(each) for each in history.checks],
        "best_step": None if best is None else best.step,
        "held_out": None if check is None else asdict(check),
        "export": {**asdict(agreement), "good": agreement.is_good, "bytes": len(exported)},
        "reported": {
            name: asdict(replace(each, score=scaled[name])) for name, each in thresholds.items()
        },
        "found_px": found_sizes_px(checked, scores, classes),
    }
    atomic_write_bytes(run.out / REPORT, json_bytes(report))
    atomic_write_bytes(run.out / PAGE, training_page(plain_json(report)).encode())
    return check, notices


def _closing_notices(run: _Run, agreement: ExportCheck, check: Check | None) -> tuple[str, ...]:
    """What is only known in the end."""
    notices = []
    if check is not None and check.ap50 < _FINDS_NOTHING_AP50:
        notices.append(
            f"the model finds next to nothing: its AP50 on the held-out pictures is {check.ap50:.3f}; train longer "
            "(--steps), begin with --weights auto or a model, or check whether the labels fit the pictures"
        )
    if run.reader.damaged:
        count, (path, reason) = len(run.reader.damaged), next(iter(run.reader.damaged.items()))
        notices.append(
            f"{counted(count, 'picture')} left out that cannot be read (first: {path}: {reason})"
        )
    if not run.sets.held_out:
        notices.append(
            "nothing was held out: how good the model is, and from which score to report, is not known"
        )
    if not agreement.is_good:
        notices.append(
            f"the exported model differs from torch by {agreement.box_px:.2f} px, {agreement.score:.4f} in score, "
            f"{agreement.unmatched} of {agreement.detections} detections unmatched"
        )
    return tuple(notices)
