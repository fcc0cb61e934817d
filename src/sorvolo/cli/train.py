"""`sorvolo train`: the detector on one's own labelled pictures."""

import json
import math
import signal
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer
from rich.console import Console
from rich.markup import escape

from sorvolo.cli.options import AsJsonSteps, GroupPattern, class_names, names
from sorvolo.cli.progress import ProgressReport
from sorvolo.errors import SettingsError

if TYPE_CHECKING:  # torch is an extra, and slow to import: only this command needs it
    from sorvolo.lab.train.detector import TrainingUpdate


class Preset(StrEnum):
    """The network's shape."""

    FAST = "fast"
    ACCURATE = "accurate"
    THESIS = "thesis"


class Rpn(StrEnum):
    """The proposal network."""

    STANDARD = "standard"
    EXTENDED = "extended"
    RESIDUAL = "extended-residual"


class Schedule(StrEnum):
    """What learns when."""

    JOINT = "joint"
    FOUR_STEPS = "four-steps"


LabelledSets = Annotated[
    list[Path] | None, typer.Argument(help="Labelled sets: folders, or their label files.")
]
RunFolder = Annotated[
    Path, typer.Option(help="Folder for the model, the report and the checkpoints.")
]
PresetOption = Annotated[
    Preset,
    typer.Option(help="fast: laptops. accurate: GPUs. thesis: ResNet-50 with the nine modules."),
]
RpnOption = Annotated[
    Rpn | None,
    typer.Option(help="Proposal network.", show_default="extended-residual; thesis: extended"),
]
ScheduleOption = Annotated[
    Schedule, typer.Option(help="joint: everything at once. four-steps: as the thesis does.")
]
CheckedOn = Annotated[
    str, typer.Option(help="A labelled set to check on, or the share of videos to hold out.")
]
StartingWeights = Annotated[
    str,
    typer.Option(
        help="Start from ImageNet (auto, or a file), nothing (none), or a model: name or .onnx."
    ),
]
StepCount = Annotated[int, typer.Option(help="Number of batches.")]
BatchSize = Annotated[int, typer.Option(help="Samples per batch.")]
SampleSide = Annotated[int, typer.Option(help="Side of the samples cut from the pictures, px.")]
Seed = Annotated[int, typer.Option(help="Random seed.")]
SyntheticShare = Annotated[float, typer.Option(help="Share of simulated samples, 0 to 1.")]
Patience = Annotated[
    int, typer.Option(help="Stop after this many of the 20 checks without a better AP50; 0: never.")
]
Device = Annotated[str, typer.Option(help="auto, cpu or cuda.")]
Resume = Annotated[bool, typer.Option("--resume", help="Continue the run in --out.")]
LabelFormat = Annotated[str | None, typer.Option(help="Label format.", show_default="recognised")]
ClassNames = Annotated[
    str | None, typer.Option(help="Class names of the labels as ours: Pedestrian=person,Van=car.")
]
IgnoredClasses = Annotated[
    str, typer.Option(help="Class names whose boxes are ignored: Bicycle,DontCare.")
]
UnlabelledClasses = Annotated[
    str, typer.Option(help="Classes that may be in the pictures without a label: person.")
]


def train(
    context: typer.Context,
    data: LabelledSets = None,
    out: RunFolder = Path("model"),
    preset: PresetOption = Preset.FAST,
    rpn: RpnOption = None,
    schedule: ScheduleOption = Schedule.JOINT,
    val: CheckedOn = "0.15",
    weights: StartingWeights = "auto",
    steps: StepCount = 8000,
    batch: BatchSize = 4,
    side: SampleSide = 416,
    seed: Seed = 1,
    synthetic: SyntheticShare = 0.0,
    patience: Patience = 8,
    device: Device = "auto",
    resume: Resume = False,
    form: LabelFormat = None,
    classes: ClassNames = None,
    ignore: IgnoredClasses = "",
    unlabelled: UnlabelledClasses = "",
    group_pattern: GroupPattern = None,
    as_json: AsJsonSteps = False,
) -> None:
    """Train a detector on labelled pictures (COCO, YOLO, VOC, VisDrone, Okutama-Action, UMCD).

    Example: sorvolo train my-labels --out my-model

    Example, the packaged model tuned to your own pictures: sorvolo train my-labels --out tuned --weights default

    Example: sorvolo train a b --preset accurate --val c --synthetic 0.2 --device cuda

    Example: sorvolo train my-labels --out my-model --resume
    """
    from sorvolo.lab.train.settings import TrainSettings

    chosen = rpn or (Rpn.EXTENDED if preset == Preset.THESIS else Rpn.RESIDUAL)
    settings = TrainSettings(
        preset.value,
        chosen.value,
        schedule.value,
        weights,
        steps,
        batch,
        side,
        seed,
        synthetic,
        patience,
    )
    try:
        from sorvolo.lab.train.detector import CHECKPOINT, train_detector
        from sorvolo.lab.train.sets import DataOptions
    except ModuleNotFoundError as error:
        raise SettingsError(
            f"training needs packages that are not installed ({error.name}): pip install 'sorvolo[training]'"
        ) from error
    options = DataOptions(
        val, form, class_names(classes), names(ignore), names(unlabelled), group_pattern
    )
    updates = train_detector(data or [], out, settings, options, device=device, resume=resume)
    with _stopped_between_steps() as stop:
        (_print_json if as_json else _show)(updates, stop)
        if stop.is_there:
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


def _print_json(updates: "Iterator[TrainingUpdate]", stop: "_StopRequest") -> None:
    """One JSON object per step."""
    from sorvolo.store.exports.plain import plain_json

    for update in updates:
        typer.echo(json.dumps(plain_json(asdict(update))))
        if stop.is_there:
            return


def _show(updates: "Iterator[TrainingUpdate]", stop: "_StopRequest") -> None:
    """Progress, and a line that stays for each check and notice."""
    console = Console()
    with ProgressReport(console, stays=True) as progress:
        for update in updates:
            for notice in update.notices:
                console.print(f"[blue]note[/blue]     {escape(notice)}", highlight=False)
            progress.show(
                f"{update.words}, step" if update.step else update.words,
                update.step,
                update.steps,
                _losses(update) if update.losses is not None else "",
            )
            if update.check is not None:
                each = ", ".join(
                    f"{escape(name)} {_number(ap50)}" for name, ap50 in update.check.classes.items()
                )
                at = "step" if update.losses is not None else "the model as written, from step"
                console.print(
                    f"{at} {update.check.step}: AP50 {_number(update.check.ap50)} ({each}), "
                    f"AP {_number(update.check.ap)}",
                    highlight=False,
                )
            if stop.is_there:
                return


def _losses(update: "TrainingUpdate") -> str:
    losses = update.losses
    assert losses is not None
    parts = (losses.proposal_score, losses.proposal_box, losses.region_score, losses.region_box)
    left = f", {_duration(update.left_s)} left" if math.isfinite(update.left_s) else ""
    return f"loss {losses.loss:.3f} ({' '.join(f'{part:.2f}' for part in parts)}), {update.steps_per_s:.2f} it/s{left}"


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes // 60}:{minutes % 60:02}:{rest:02}"


def _number(value: float) -> str:
    return f"{value:.3f}" if math.isfinite(value) else "-"


class _StopRequest:
    """Whether somebody asked to stop."""

    def __init__(self) -> None:
        self.is_there = False


@contextmanager
def _stopped_between_steps() -> Iterator[_StopRequest]:
    """The first Ctrl-C waits for the step to end, so that a checkpoint can be left; the second does not."""
    stop = _StopRequest()
    before = signal.getsignal(signal.SIGINT)

    def on_interrupt(_signal: int, _frame: Any) -> None:
        stop.is_there = True
        typer.echo("stopping after this step; press Ctrl-C again to stop at once", err=True)
        signal.signal(signal.SIGINT, before)

    try:
        signal.signal(signal.SIGINT, on_interrupt)
    except ValueError:  # not in the main thread: there is no Ctrl-C to wait for
        yield stop
        return
    try:
        yield stop
    finally:
        signal.signal(signal.SIGINT, before)
