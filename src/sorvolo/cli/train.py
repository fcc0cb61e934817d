"""`sorvolo train`: the detector on one's own labelled pictures."""

import json
import math
from collections.abc import Generator, Iterator
from dataclasses import asdict
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, cast

import typer
from rich.markup import escape

from sorvolo.cli.options import (
    AsJson,
    GroupPattern,
    IgnoredClasses,
    LabelClasses,
    OutFolder,
    Seed,
    UnlabelledClasses,
    argument,
    class_names,
    names,
    option,
)
from sorvolo.cli.printing import Console
from sorvolo.cli.progress import ProgressReport
from sorvolo.cli.sites import SignalStop
from sorvolo.errors import SettingsError

if TYPE_CHECKING:  # torch is an extra, and slow to import: only this command needs it
    from sorvolo.lab.training.detector import TrainingUpdate


PresetOption = Annotated[
    Literal["fast", "thesis"],
    option("fast: the packaged network. thesis: ResNet-50 with the nine modules."),
]
CheckedOn = Annotated[
    str, option("A labelled set to check on, or the share of videos to hold out.")
]
StartingWeights = Annotated[
    str,
    option(
        "Model to tune: its name or .onnx file. auto: the packaged one; none: nothing. thesis: ImageNet."
    ),
]


def train(
    context: typer.Context,
    data: Annotated[
        list[Path] | None, argument("Labelled sets: folders, or their label files.")
    ] = None,
    out: OutFolder = Path("model"),
    preset: PresetOption = "fast",
    val: CheckedOn = "0.15",
    weights: StartingWeights = "auto",
    steps: Annotated[int, option("Number of batches.")] = 8000,
    batch: Annotated[int, option("Samples per batch.")] = 8,
    side: Annotated[int, option("Side of the samples cut from the pictures, px.")] = 384,
    seed: Seed = 1,
    resume: Annotated[bool, option("Continue the run in --out.", "--resume")] = False,
    classes: LabelClasses = None,
    ignore: IgnoredClasses = "",
    unlabelled: UnlabelledClasses = "",
    group_pattern: GroupPattern = None,
    as_json: AsJson = False,
) -> None:
    """Train a detector on labelled pictures (COCO, YOLO, VOC, VisDrone, Okutama-Action, UMCD).

    A graphics card is used where there is one.

    Example: sorvolo train my-labels --out my-model

    Example, a thermal camera: sorvolo train my-labels --out tuned --weights thermal

    Example: sorvolo train a b --val c

    Example: sorvolo train my-labels --out my-model --resume
    """
    from sorvolo.lab.training.settings import TrainSettings

    settings = TrainSettings(
        preset,
        weights=weights,
        steps=steps,
        batch=batch,
        side_px=side,
        seed=1 if seed is None else seed,
    )
    try:
        from sorvolo.lab.training.detector import CHECKPOINT, train_detector
        from sorvolo.lab.training.sets import DataOptions
    except ModuleNotFoundError as error:
        raise SettingsError(
            f"training needs packages that are not installed ({error.name}): pip install 'sorvolo[training]'"
        ) from error
    options = DataOptions(
        val, None, class_names(classes), names(ignore), names(unlabelled), group_pattern
    )
    updates = train_detector(data or [], out, settings, options, resume=resume)
    stop = SignalStop(
        is_running=True, words="stopping after this step; press Ctrl-C again to stop at once"
    )
    with stop.on_signals():
        (_print_json if as_json else _show)(updates, stop)
        if stop.until.is_set():
            cast(Generator[Any], updates).close()  # leaves a checkpoint, once it has learnt at all
            if (out / CHECKPOINT).is_file():
                context.obj.stop_words = (
                    f"stopped; the same command with --resume continues the run in {out}"
                )
            raise KeyboardInterrupt
    if not as_json:
        typer.echo(
            f"report: {out / 'training.html'}; sorvolo evaluate detector measures the model on other pictures"
        )


def _print_json(updates: "Iterator[TrainingUpdate]", stop: SignalStop) -> None:
    """One JSON object per step."""
    from sorvolo.store.exports.plain import plain_json

    for update in updates:
        typer.echo(json.dumps(plain_json(asdict(update))))
        if stop.until.is_set():
            return


def _show(updates: "Iterator[TrainingUpdate]", stop: SignalStop) -> None:
    """Progress, and a line that stays for each check and notice."""
    console = Console()
    with ProgressReport(console, stays=True) as progress:
        for update in updates:
            for notice in update.notices:
                console.print(f"[blue]note[/blue]     {escape(notice)}")
            progress.show(
                f"{update.words}, step" if update.step else update.words,
                update.step,
                update.steps,
                _losses(update) if update.losses is not None else "",
            )
            if update.check is not None:
                by_class = ", ".join(
                    f"{escape(name)} {_number(ap50)}" for name, ap50 in update.check.classes.items()
                )
                at = "step" if update.losses is not None else "the model as written, from step"
                console.print(
                    f"{at} {update.check.step}: AP50 {_number(update.check.ap50)} ({by_class}), "
                    f"AP {_number(update.check.ap)}",
                )
            if stop.until.is_set():
                return


def _losses(update: "TrainingUpdate") -> str:
    losses = update.losses
    assert losses is not None
    parts = ", ".join(f"{name} {value:.2f}" for name, value in losses.losses.items())
    left = (
        f", {timedelta(seconds=round(update.left_s))} left" if math.isfinite(update.left_s) else ""
    )
    return f"loss {losses.loss:.3f} ({parts}), {update.steps_per_s:.2f} it/s{left}"


def _number(value: float) -> str:
    return f"{value:.3f}" if math.isfinite(value) else "-"
