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
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

from sorvolo.errors import SettingsError

if TYPE_CHECKING:  # torch is an extra, and slow to import: only this command needs it
    from sorvolo.missions.train.detector import TrainingUpdate


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


def train(
    context: typer.Context,
    data: Annotated[list[Path] | None, typer.Argument(help="Labelled sets: folders, or their label files.")] = None,
    out: Annotated[Path, typer.Option(help="Folder for the model, the report and the checkpoints.")] = Path("model"),
    preset: Annotated[
        Preset, typer.Option(help="fast: laptops. accurate: GPUs. thesis: ResNet-50 with the nine modules.")
    ] = Preset.FAST,
    rpn: Annotated[Rpn | None, typer.Option(help="Else extended for thesis, extended-residual.")] = None,
    schedule: Annotated[
        Schedule, typer.Option(help="joint: all at once. four-steps: the thesis's.")
    ] = Schedule.JOINT,
    val: Annotated[
        str, typer.Option(help="A labelled set, or the share of the pictures held out, by video.")
    ] = "0.15",
    weights: Annotated[
        str, typer.Option(help="ImageNet's (auto, or a file), none, or a model to tune: its name or .onnx file."),
    ] = "auto",
    steps: Annotated[int, typer.Option(help="Batches to learn from.")] = 8000,
    batch: Annotated[int, typer.Option(help="Samples a step.")] = 4,
    side: Annotated[int, typer.Option(help="Side of the samples cut from the pictures, px.")] = 416,
    seed: Annotated[int, typer.Option(help="Everything random follows from this number.")] = 1,
    synthetic: Annotated[float, typer.Option(help="Share of simulated samples, 0 to 1.")] = 0.0,
    patience: Annotated[
        int, typer.Option(help="Checks without a better AP50 before it stops; 0: never. A run has 20.")
    ] = 8,
    device: Annotated[str, typer.Option(help="auto, cpu or cuda.")] = "auto",
    resume: Annotated[bool, typer.Option("--resume", help="Go on with the run in --out.")] = False,
    form: Annotated[str | None, typer.Option(help="The labels' form, if it is not told from the files.")] = None,
    classes: Annotated[
        str, typer.Option(help="Which names of the labels stand for which class: Pedestrian=person,Van=car.")
    ] = "",
    ignore: Annotated[str, typer.Option(help="Names whose boxes teach nothing: Bicycle,DontCare.")] = "",
    unlabelled: Annotated[
        str, typer.Option(help="Classes that may be in the pictures without a label: person.")
    ] = "",
    group_pattern: Annotated[
        str | None, typer.Option(help="Regular expression; its one group is the video's name in a picture's path.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object a step.")] = False,
) -> None:
    """A detector from labelled pictures (COCO, YOLO, VOC, VisDrone, Okutama-Action, UMCD).

    Example: sorvolo train my-labels --out my-model

    Example, the packaged model tuned to one's own pictures: sorvolo train my-labels --out tuned --weights default

    Example: sorvolo train a b --preset accurate --val c --synthetic 0.2 --device cuda

    Example: sorvolo train my-labels --out my-model --resume
    """
    from sorvolo.missions.train.settings import TrainSettings
    from sorvolo.store.exports.plain import plain_json

    chosen = rpn or (Rpn.EXTENDED if preset == Preset.THESIS else Rpn.RESIDUAL)
    settings = TrainSettings(
        preset.value, chosen.value, schedule.value, weights, steps, batch, side, seed, synthetic, patience
    )
    try:
        from sorvolo.missions.train.detector import CHECKPOINT, train_detector
        from sorvolo.missions.train.sets import DataOptions
    except ModuleNotFoundError as error:
        raise SettingsError(
            f"training needs packages that are not here ({error.name}); install them: pip install 'sorvolo[training]'"
        ) from error
    options = DataOptions(val, form, _mapping(classes), _names(ignore), _names(unlabelled), group_pattern)
    updates = train_detector(data or [], out, settings, options, device=device, resume=resume)
    with _stopped_between_steps() as wish:
        if as_json:
            for update in updates:
                typer.echo(json.dumps(plain_json(asdict(update))))
                if wish.is_there:
                    break
        else:
            _show(updates, wish)
        if wish.is_there:
            cast(Generator[Any], updates).close()  # leaves a checkpoint, once it has learnt at all
            if (out / CHECKPOINT).is_file():
                context.obj.stop_words = f"stopped; the same command with --resume goes on where {out} is now"
            raise KeyboardInterrupt
    if not as_json:
        typer.echo(f"{out / 'training.html'} tells how it went; sorvolo evaluate detector measures the model on more")


def _show(updates: "Iterator[TrainingUpdate]", wish: "_Wish") -> None:
    """A line that lives, and one that stays for each check."""
    console = Console()
    columns = (TextColumn("{task.description}"), BarColumn(bar_width=20), MofNCompleteColumn(),
               TextColumn("{task.fields[told]}"))
    with Progress(*columns, console=console) as progress:
        task = progress.add_task("opening", total=None, told="")
        for update in updates:
            for notice in update.notices:
                progress.console.print(f"note: {escape(notice)}")
            progress.update(
                task, description=escape(update.words), total=update.steps, completed=update.step,
                told=_losses(update) if update.losses is not None else "",
            )
            if update.check is not None:
                each = ", ".join(f"{escape(name)} {_number(ap50)}" for name, ap50 in update.check.classes.items())
                at = "step" if update.losses is not None else "the model as written, of step"
                progress.console.print(
                    f"{at} {update.check.step}: AP50 {_number(update.check.ap50)} ({each}), "
                    f"AP {_number(update.check.ap)}"
                )
            if wish.is_there:
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


class _Wish:
    """Whether somebody asked to stop."""

    def __init__(self) -> None:
        self.is_there = False


@contextmanager
def _stopped_between_steps() -> Iterator[_Wish]:
    """The first Ctrl-C waits for the step to end, so that a checkpoint can be left; the second does not."""
    wish = _Wish()
    before = signal.getsignal(signal.SIGINT)

    def on_interrupt(_signal: int, _frame: Any) -> None:
        wish.is_there = True
        typer.echo("stopping after this step; Ctrl-C again stops at once", err=True)
        signal.signal(signal.SIGINT, before)

    try:
        signal.signal(signal.SIGINT, on_interrupt)
    except ValueError:  # not in the main thread: there is no Ctrl-C to wait for
        yield wish
        return
    try:
        yield wish
    finally:
        signal.signal(signal.SIGINT, before)


def _names(text: str) -> tuple[str, ...]:
    return tuple(each.strip() for each in text.split(",") if each.strip())


def _mapping(text: str) -> dict[str, str] | None:
    """ "Van=car,person" as {"Van": "car", "person": "person"}; None of nothing."""
    pairs = [each.partition("=") for each in _names(text)]
    if not all(name.strip() and (target.strip() or not equals) for name, equals, target in pairs):
        raise SettingsError(f"--classes takes names as THEIRS=OURS, separated by commas; got {text!r}")
    return {name.strip(): target.strip() or name.strip() for name, _, target in pairs} or None
