"""`sorvolo evaluate`: how good a result is, in numbers."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.table import Table

from sorvolo import __version__
from sorvolo.cli.options import (
    AsJson,
    GroupPattern,
    IgnoredClasses,
    LabelClasses,
    OnlyFlight,
    ResultsFolder,
    SiteArgument,
    Truth,
    UnlabelledClasses,
    argument,
    class_names,
    names,
    option,
)
from sorvolo.cli.printing import Console, new_table, print_json
from sorvolo.cli.progress import ProgressReport
from sorvolo.cli.sites import opened_site
from sorvolo.survey.wording import counted

if TYPE_CHECKING:
    from sorvolo.lab.evaluation.change_metrics import EventScores
    from sorvolo.lab.evaluation.detection_scores import (
        Interval,
        ScoreDifference,
        SetComparison,
    )
    from sorvolo.lab.evaluation.map_quality import Spread
    from sorvolo.lab.evaluation.mask_folders import MaskScores
    from sorvolo.lab.evaluation.mosaic import MosaicEvaluation

evaluate_app = typer.Typer(no_args_is_help=True)

ComparedModels = Annotated[
    list[str] | None,
    option("Another model to compare on the same pictures. Can be repeated."),
]
FromAbove = Annotated[
    bool,
    option("The pictures look straight down: models that want it look twice.", "--from-above"),
]


@evaluate_app.callback()
def evaluate() -> None:
    """Measure results against truth, references, or themselves."""


@evaluate_app.command()
def detector(
    model: Annotated[
        str,
        argument("A model's name or file; several seeds separated by commas."),
    ],
    data: Annotated[list[Path], argument("Labelled pictures: folders or label files.")],
    compare: ComparedModels = None,
    classes: LabelClasses = None,
    ignore: IgnoredClasses = "",
    unlabelled: UnlabelledClasses = "",
    group_pattern: GroupPattern = None,
    from_above: FromAbove = False,
    out: ResultsFolder = None,
    as_json: AsJson = False,
) -> None:
    """Measure detectors on labelled pictures: COCO AP, the thesis's mAP, recall by size, confusions, worst errors.

    Example: sorvolo evaluate detector default labelled --out measured

    Example: sorvolo evaluate detector ours.onnx hituav --classes Person=person,Car=car --ignore DontCare,Bicycle

    Example: sorvolo evaluate detector a1.onnx,a2.onnx data --compare b1.onnx,b2.onnx --out side-by-side
    """
    from sorvolo.lab.evaluation.detector import (
        PAGE,
        EvaluationSettings,
        evaluate_detector,
        evaluation_numbers,
        known_classes,
        read_sets,
        write_evaluation,
    )

    settings = EvaluationSettings(from_above=from_above)
    arms = [list(names(arm)) for arm in (model, *(compare or ()))]
    labelled = read_sets(
        data,
        classes=class_names(classes),
        ignore=names(ignore),
        unlabelled=names(unlabelled),
        group_pattern=group_pattern,
        known=known_classes(arms),
    )
    with ProgressReport(Console(stderr=True)) as progress:
        measured = evaluate_detector(
            arms,
            labelled,
            settings,
            lambda step: progress.show(
                f"{step.model} on {step.set_name}, picture", step.pictures_done, step.pictures_total
            ),
        )
    notices = [*(note.text for part in labelled for note in part.notices), *measured.notices]
    description = {
        "sorvolo": __version__,
        "data": ", ".join(map(str, data)),
        "arms": "; ".join(", ".join(arm) for arm in arms),
        "from_above": from_above,
        "notices": "; ".join(notices),
    }
    if out is not None:
        write_evaluation(measured, out, description)
    if as_json:
        print_json(evaluation_numbers(measured, description))
        return
    console = Console()
    for notice in notices:
        console.print(f"note: {notice}", markup=False)
    for scores in measured.sets:
        numbers = "labels", "AP", "AP50", "precision", "recall", "from"
        table = new_table(
            "class", *numbers, whole=("class", *numbers), right=numbers, title=scores.name
        )
        for row in scores.classes:
            table.add_row(
                row.label,
                str(row.labels),
                _between(scores.intervals[f"AP {row.label}"]),
                _between(scores.intervals[f"AP50 {row.label}"]),
                _share(row.reported.precision),
                _share(row.reported.recall),
                f"{row.reported.score:.2f}",
            )
        table.add_section()
        table.add_row(
            "mean",
            "",
            _between(scores.intervals["AP"]),
            _between(scores.intervals["AP50"]),
            _share(scores.intervals["thesis_map"].value),
        )
        console.print(table)
        if scores.groups > 1:
            console.print(
                f"{scores.pictures:,} pictures of {scores.groups} videos or flights; 95 % intervals over these",
            )
        for remark in scores.remarks:
            console.print(f"{scores.name}: {remark}")
    for side_by_side in measured.comparisons:
        _show_comparison(console, side_by_side)
    if out is not None:
        console.print(f"the whole report: {out / PAGE}")


@evaluate_app.command()
def mosaic(
    site: SiteArgument,
    truth: Truth = None,
    reference: Annotated[
        Path | None, option("A reference map: a GeoTIFF of the same ground.")
    ] = None,
    positions: Annotated[
        Path | None,
        option("CSV of camera positions: frame,longitude_deg,latitude_deg[,height_m]."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Measure the accuracy of a map, and how much it deviates from its own frames.

    Example: sorvolo evaluate mosaic demo-map --truth demo-site

    Example: sorvolo evaluate mosaic field-map --reference orthophoto.tif --json
    """
    from sorvolo.lab.evaluation.mosaic import evaluate_mosaic

    with opened_site(site) as place:
        measured = evaluate_mosaic(
            place.folder, truth=truth, reference=reference, positions=positions
        )
    if as_json:
        print_json(measured)
    else:
        _show(measured)


@evaluate_app.command()
def changes(
    found: Annotated[
        str,
        argument("Folder of a map that was compared, or s3://BUCKET/NAME; or a folder of masks."),
    ],
    truth: Truth,
    flight: OnlyFlight = None,
    as_json: AsJson = False,
) -> None:
    """Measure changes against the truth: by pixel and frame (the thesis's Tables 4.3 to 4.5), and by event.

    Example: sorvolo evaluate changes field-map --truth simulated-field

    Example: sorvolo evaluate changes my-masks --truth dataset/masks --json
    """
    from sorvolo.lab.evaluation.changes import as_json as measures_as_json
    from sorvolo.lab.evaluation.changes import evaluate_changes

    assert truth is not None  # typer demands it
    with opened_site(found) as place:
        measured = evaluate_changes(place.folder, truth, flight=flight)
    if as_json:
        print_json(measures_as_json(measured))
        return
    console = Console()
    for each in measured:
        # the tables of one flight's changes
        if each.masks is not None:
            _show_masks(console, each.flight, each.masks)
        if each.events is not None:
            _show_events(console, each.flight, each.events, each.map_shift_m)
        if each.classes is not None:
            classes = each.classes
            console.print(
                f"{each.flight}: class before and after, of the events of the right kind: {classes.right} right, "
                f"{classes.wrong} wrong, {classes.unnamed} without a class",
            )
        for remark in each.remarks:
            console.print(f"{each.flight}: {remark}")


def _show_masks(console: Console, flight: str, masks: "MaskScores") -> None:
    table = Table("per", "pixel", "frame")
    both = masks.pixels, masks.frames
    for name in ("tp", "fp", "fn", "tn", "unknown"):
        table.add_row(
            name.upper() if len(name) < 3 else name, *(f"{getattr(each, name):,}" for each in both)
        )
    for name in ("precision", "recall", "accuracy", "f1"):
        table.add_row(
            "F1" if name == "f1" else name, *(_share(getattr(each, name), 2) for each in both)
        )
    console.print(table)
    console.print(
        f"{flight}: {counted(masks.compared, 'mask')} compared; without truth: {masks.only_found}; true "
        f"masks without a found one: {masks.only_true}; a frame is positive from "
        f"{counted(masks.least_px, 'changed pixel')} on",
    )


def _show_events(console: Console, flight: str, scores: "EventScores", map_shift_m: float) -> None:
    table = Table("events", "to find", "found", "named right", "late", "reported twice", "false")
    rows: dict[str, Any] = {**scores.by_kind, "all": scores}
    for name, kind in rows.items():
        numbers = kind.must_find, kind.found, kind.named_right, kind.late, kind.twice, kind.false
        if kind is scores:
            table.add_section()
        if any(numbers) or kind is scores:
            table.add_row(name, *map(str, numbers))
    console.print(table)
    console.print(
        f"{flight}: found {_share(scores.found_share)}; {scores.false_per_hectare:.2f} false per hectare "
        f"({scores.compared_m2:,.0f} m2 compared); {scores.twice} reported twice; {scores.late} of "
        f"{scores.judged_late} late",
    )
    if math.isfinite(scores.error_median_m):
        shift = (
            f" (the map's own shift of {map_shift_m:.2f} m taken out)"
            if math.isfinite(map_shift_m)
            else ""
        )
        console.print(
            f"{flight}: position error {scores.error_median_m:.2f} m median, {scores.error_p95_m:.2f} m at "
            f"95 %{shift}; {_share(scores.within_two_sigma)} within twice the reported accuracy on the map (1 sigma, "
            f"median {scores.sigma_median_m:.2f} m), {_share(scores.world_within_two_sigma)} in the world (median "
            f"{scores.world_sigma_median_m:.2f} m)",
        )


def _share(value: float, decimals: int = 1) -> str:
    return f"{value:.{decimals}%}" if math.isfinite(value) else "-"


def _show(measured: "MosaicEvaluation") -> None:
    console = Console()
    frames = Table("flight", "selected", "matched", "by GPS alone", "left out", "without truth")
    for each in measured.flights:
        frames.add_row(
            each.flight,
            *map(str, (each.selected, each.vision, each.gps_only, each.rejected, each.unmatched)),
        )
    console.print(frames)
    errors = Table("against", "rms m", "p95 m", "max m", "rms px", "points")
    for truth in measured.truth:
        for name, spread in (
            ("corners", truth.corners.absolute),
            ("corners, shape only", truth.corners.shape),
            ("floor: error from GPS noise alone", truth.corners.floor),
            ("corners placed by GPS alone", truth.gps_only),
            ("cameras, horizontal", truth.cameras),
        ):
            _add(errors, f"{truth.flight}: {name}", spread)
    if measured.positions is not None:
        _add(errors, "camera positions", measured.positions.absolute)
        _add(errors, "camera positions, shape only", measured.positions.shape)
    if errors.row_count:
        console.print(errors)
    for truth in measured.truth:
        if math.isfinite(truth.corners.over_floor):
            console.print(
                f"{truth.flight}: absolute error is {truth.corners.over_floor:.2f} times its floor"
            )
    deviation = measured.deviation
    if deviation.frames:
        console.print(
            f"deviation from the frames ({deviation.frames} of them, thesis 4.1.1): mean {deviation.mean:.1%}, "
            f"median {deviation.median:.1%}, worst {deviation.worst:.1%}"
        )
    if measured.reference is not None:
        match = measured.reference
        console.print(
            f"correlation with the reference (eq. 4.1): {match.correlation:.3f} over {match.area_m2:.0f} m2 "
            f"at {match.m_per_px:.3f} m/px; the map lies {match.shift_east_m:+.2f} m east, "
            f"{match.shift_north_m:+.2f} m north of it (confidence {match.shift.response:.2f}); "
            f"{match.correlation_after_shift:.3f} without that"
        )


def _add(table: Table, name: str, spread: "Spread") -> None:
    if spread.count:
        table.add_row(
            name,
            f"{spread.rms_m:.3f}",
            f"{spread.p95_m:.3f}",
            f"{spread.max_m:.3f}",
            f"{spread.rms_px:.2f}",
            str(spread.count),
        )


def _show_comparison(console: Console, comparison: "SetComparison") -> None:
    first = comparison.arms[0].name
    head = [arm.name for arm in comparison.arms] + [
        f"{arm.name} less {first}" for arm in comparison.arms[1:]
    ]
    table = Table(
        "measure",
        *head,
        title=f"side by side: {comparison.name} (differences in percentage points)",
    )
    for name, value in comparison.arms[0].mean.items():
        if not math.isfinite(value):
            continue
        cells = [_share(arm.mean[name]) for arm in comparison.arms]
        cells += [_difference(found[name]) for found in comparison.differences]
        table.add_row(name, *cells)
    console.print(table)


def _difference(found: "ScoreDifference") -> str:
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
