"""`sorvolo evaluate detector`: how good a detector is on labelled pictures, and which of several is better."""

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from sorvolo import __version__
from sorvolo.cli.options import GroupPattern, class_names, names
from sorvolo.cli.progress import ProgressReport
from sorvolo.errors import SettingsError

if TYPE_CHECKING:
    from sorvolo.lab.evaluation.detection_scores import (
        Difference,
        Interval,
        SetComparison,
        SetScores,
    )
    from sorvolo.lab.evaluation.detector import DetectorEvaluation, EvaluationSettings
    from sorvolo.survey.labels import LabelledSet

MeasuredModels = Annotated[
    str,
    typer.Argument(
        help="A model's name or file, or detections.json; several seeds separated by commas."
    ),
]
LabelledPictures = Annotated[
    list[Path], typer.Argument(help="Labelled pictures: folders or label files.")
]
ComparedModels = Annotated[
    list[str] | None,
    typer.Option(help="Another model to compare on the same pictures. Can be repeated."),
]
LabelFormat = Annotated[
    str | None, typer.Option(help="Label format: coco, yolo, voc ...", show_default="recognised")
]
ClassNames = Annotated[
    str | None,
    typer.Option(help="Class names of the set as ours, such as 'Pedestrian=person,Van=car'."),
]
IgnoredClasses = Annotated[str, typer.Option(help="Class names whose boxes are ignored.")]
UnlabelledClasses = Annotated[
    str, typer.Option(help="Our classes that may be there without a label.")
]
VideoPattern = Annotated[
    str, typer.Option(help="Regular expression: use only pictures of matching videos.")
]
HeldOutShare = Annotated[
    float,
    typer.Option(
        help="Use only the share that `sorvolo train --val SHARE` with the same seed holds out."
    ),
]
Tiles = Annotated[
    str,
    typer.Option(
        help="How pictures are shown: auto (as photos in watch), none (as they are), pixels of a tile."
    ),
]
FromAbove = Annotated[
    bool,
    typer.Option(
        "--from-above", help="The pictures look straight down: models that want it look twice."
    ),
]
ReportFolder = Annotated[
    Path | None, typer.Option(help="Folder for detector.html, detector.json, detections.json.")
]
BootstrapDraws = Annotated[
    int, typer.Option(min=20, help="Bootstrap draws for the confidence intervals.")
]
Seed = Annotated[int, typer.Option(help="Random seed of the bootstrap and of what is held out.")]
AsJsonReport = Annotated[bool, typer.Option("--json", help="Print detector.json.")]


def detector(
    model: MeasuredModels,
    data: LabelledPictures,
    compare: ComparedModels = None,
    form: LabelFormat = None,
    classes: ClassNames = None,
    ignore: IgnoredClasses = "",
    unlabelled: UnlabelledClasses = "",
    group_pattern: GroupPattern = None,
    videos: VideoPattern = "",
    held_out: HeldOutShare = 0.0,
    tiles: Tiles = "auto",
    from_above: FromAbove = False,
    out: ReportFolder = None,
    draws: BootstrapDraws = 1000,
    seed: Seed = 1,
    as_json: AsJsonReport = False,
) -> None:
    """Measure detectors on labelled pictures: COCO AP, the thesis's mAP, recall by size, confusions, worst errors.

    Example: sorvolo evaluate detector default labelled --out measured

    Example: sorvolo evaluate detector ours.onnx hituav --classes Person=person,Car=car --ignore DontCare,Bicycle

    Example: sorvolo evaluate detector a1.onnx,a2.onnx data --compare b1.onnx,b2.onnx --out side-by-side
    """
    from sorvolo.lab.evaluation.detector import (
        EvaluationSettings,
        evaluation_numbers,
        known_classes,
        read_sets,
        write_evaluation,
    )
    from sorvolo.store.exports.plain import plain_json

    settings = EvaluationSettings(_tiles(tiles), draws, seed, from_above)
    arms = [list(names(each)) for each in (model, *(compare or ()))]
    labelled = read_sets(
        data,
        form=form,
        classes=class_names(classes),
        ignore=names(ignore),
        unlabelled=names(unlabelled),
        group_pattern=group_pattern,
        videos=videos,
        held_out=held_out,
        seed=seed,
        known=known_classes(arms),
    )
    measured = _measured(arms, labelled, settings)
    notices = _notices(labelled, measured)
    description = {
        "sorvolo": __version__,
        "data": ", ".join(map(str, data)),
        "arms": "; ".join(", ".join(arm) for arm in arms),
        "videos": videos or "all",
        "held_out": held_out or "all",
        "tiles": tiles,
        "draws": draws,
        "seed": seed,
        "from_above": from_above,
        "notices": "; ".join(notices),
    }
    if out is not None:
        write_evaluation(measured, out, description)
    if as_json:
        typer.echo(json.dumps(plain_json(evaluation_numbers(measured, description)), indent=1))
    else:
        _show_all(measured, notices, out)


def _measured(
    arms: list[list[str]], labelled: "Sequence[LabelledSet]", settings: "EvaluationSettings"
) -> "DetectorEvaluation":
    """The evaluation, with progress on stderr."""
    from sorvolo.lab.evaluation.detector import evaluate_detector

    with ProgressReport(Console(stderr=True)) as progress:
        return evaluate_detector(
            arms,
            labelled,
            settings,
            lambda step: progress.show(
                f"{step.model} on {step.set_name}, picture", step.pictures_done, step.pictures_total
            ),
        )


def _notices(labelled: "Sequence[LabelledSet]", measured: "DetectorEvaluation") -> tuple[str, ...]:
    return (*(note.text for each in labelled for note in each.notices), *measured.notices)


def _show_all(measured: "DetectorEvaluation", notices: Sequence[str], out: Path | None) -> None:
    from sorvolo.lab.evaluation.detector import PAGE

    console = Console()
    for notice in notices:
        console.print(f"note: {notice}", markup=False)
    for scores in measured.sets:
        _show(console, scores)
    for side_by_side in measured.comparisons:
        _show_comparison(console, side_by_side)
    if out is not None:
        console.print(f"the whole report: {out / PAGE}")


def _tiles(text: str) -> Literal["auto"] | int | None:
    if text.isdecimal():
        return int(text)
    if text == "auto":
        return "auto"
    if text == "none":
        return None
    raise SettingsError(f"--tiles {text!r}: choose none, auto, or a number of pixels a side")


def _show(console: Console, scores: "SetScores") -> None:
    table = Table(title=scores.name, box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for name in ("class", "labels", "AP", "AP50", "precision", "recall", "from", "thesis AP"):
        table.add_column(name, no_wrap=True, justify="left" if name == "class" else "right")
    for row in scores.classes:
        table.add_row(
            row.label,
            str(row.labels),
            _between(scores.intervals[f"AP {row.label}"]),
            _between(scores.intervals[f"AP50 {row.label}"]),
            _share(row.reported.precision),
            _share(row.reported.recall),
            f"{row.reported.score:.2f}",
            _share(row.thesis_ap),
        )
    table.add_section()
    table.add_row(
        "mean",
        "",
        _between(scores.intervals["AP"]),
        _between(scores.intervals["AP50"]),
        "",
        "",
        "",
        _share(scores.thesis_map),
    )
    console.print(table)
    if scores.groups > 1:
        console.print(
            f"{scores.pictures:,} pictures of {scores.groups} videos or flights; 95 % intervals over these",
            highlight=False,
        )
    for remark in scores.remarks:
        console.print(f"{scores.name}: {remark}")


def _show_comparison(console: Console, each: "SetComparison") -> None:
    first = each.arms[0].name
    head = [arm.name for arm in each.arms] + [f"{arm.name} less {first}" for arm in each.arms[1:]]
    table = Table(
        "measure", *head, title=f"side by side: {each.name} (differences in percentage points)"
    )
    for name, value in each.arms[0].mean.items():
        if not math.isfinite(value):
            continue
        cells = [_share(arm.mean[name]) for arm in each.arms]
        cells += [_difference(found[name]) for found in each.differences]
        table.add_row(name, *cells)
    console.print(table)


def _difference(found: "Difference") -> str:
    """In percentage points, with the bounds where there are any."""
    low, high = 100 * found.low, 100 * found.high
    bounds = f" ({low:+.1f} to {high:+.1f})" if math.isfinite(low) else ""
    return f"{100 * found.value:+.1f}{bounds}"


def _between(interval: "Interval") -> str:
    bounds = (
        f"\n{100 * interval.low:.1f}-{100 * interval.high:.1f}"
        if math.isfinite(interval.low)
        else ""
    )
    return _share(interval.value) + bounds


def _share(value: float) -> str:
    return f"{value:.1%}" if math.isfinite(value) else "-"
