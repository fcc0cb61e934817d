"""How good a detector is, as one page of HTML that needs no other file, no network and no script."""

import math
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
from markupsafe import Markup

from sorvolo.geometry.arrays import ImageRGB
from sorvolo.paths import Json, JsonView
from sorvolo.store.pages.plots import (
    SIDE_PX,
    Line,
    colour_class,
    line_plot,
    stated_and_found,
    unit_axes,
)
from sorvolo.store.pages.words import cell, known, picture_uri, render

_KIND_WORDS = {
    "false alarm": "The most certain false alarms",
    "miss": "The largest misses",
    "confusion": "The most certain confusions",
}
_SET_NAMES = (
    "set",
    "pictures",
    "videos",
    "AP",
    "AP50",
    "AP75",
    "AP small",
    "medium",
    "large",
    "thesis mAP",
)
_CLASS_NAMES = (
    "class",
    "labels",
    "AP",
    "AP50",
    "AP75",
    "reported from",
    "precision",
    "recall",
    "F1",
    "best F1",
    "from",
)
_SCORE_NAMES = ("class", "score", "candidates", "right", "90 % interval")
_SIZE_NAMES = ("class", "longer side", "labels", "recall as reported", "with any candidate")


def detector_page(measured: Any, description: JsonView) -> str:
    """detector.html: `measured` has the fields of detector.DetectorEvaluation. All text is escaped."""
    model, sets = measured.found.name, measured.sets
    pictures = sum(each.pictures for each in sets)
    remarks = [f"{each.name}: {text}" for each in sets for text in each.remarks]
    page = render(
        "detector.html",
        package=__package__,
        title=f"{model} - detector",
        model=known(model),
        headline="; ".join(f"{each.name}: AP50 {_class_words(each.classes)}" for each in sets),
        summary=f"Measured on {pictures} labelled pictures of {_videos(sets)}. All shares are in per cent.",
        overview_names=_SET_NAMES,
        overview=[
            [
                each.name,
                each.pictures,
                each.groups,
                *(_with_interval(each.intervals[name]) for name in ("AP", "AP50", "AP75")),
                *(
                    _share(value)
                    for value in (each.coco.ap_small, each.coco.ap_medium, each.coco.ap_large)
                ),
                _with_interval(each.intervals["thesis_map"]),
            ]
            for each in sets
        ],
        remarks=remarks
        + [
            f"{each.name}: {', '.join(each.left_out)} not labelled there, so not judged"
            for each in sets
            if each.left_out
        ],
        comparisons=[_comparison(each) for each in measured.comparisons],
        class_names=_CLASS_NAMES,
        size_names=_SIZE_NAMES,
        score_names=_SCORE_NAMES,
        sets=[_set(each, measured.worst.get(each.name, ())) for each in sets],
        description=[(str(key), known(value)) for key, value in description.items()],
    )
    return str(page)


def _set(scores: Any, worst: Sequence[tuple[Any, str, ImageRGB]]) -> Json:
    labels = [row.label for row in scores.classes]
    tables = []
    for found_by_label, unit, words in (
        (scores.by_size_px, "px", "in the picture"),
        (scores.by_size_m, "m", "on the ground"),
    ):
        rows = [
            [
                label,
                _range(row.low, row.high, unit),
                row.count,
                cell("share", _share(row.recall), row.recall),
                _share(row.candidates / row.count),
            ]
            for label, found in found_by_label.items()
            for row in found
        ]
        if rows:
            tables.append((f"Size {words}", rows))
    rows = []
    for k, name in enumerate([*labels, "nothing there"]):
        counts = [int(value) for value in scores.confusion[k]]
        cells: list[Any] = [
            cell("hit", count) if k == c else count for c, count in enumerate(counts)
        ]
        rows.append([name, *cells[:-1], cells[-1] if k < len(labels) else ""])
    blocks = []
    for kind, words in _KIND_WORDS.items():
        figures = [
            {
                "words": _mistake_words(mistake),
                "picture": name,
                "address": picture_uri(
                    np.pad(crop, ((0, 0), (0, 0), (0, 1)), constant_values=255), 24_000
                ),
            }
            for mistake, name, crop in worst
            if mistake.kind == kind
        ]
        if figures:
            total = sum(each.kind == kind for each in scores.mistakes)
            blocks.append((f"{words} ({len(figures)} of {total})", figures))
    return {
        "name": scores.name,
        "classes": [
            [
                row.label,
                row.labels,
                _with_interval(scores.intervals[f"AP {row.label}"]),
                _with_interval(scores.intervals[f"AP50 {row.label}"]),
                _share(row.coco.ap75),
                _number(row.reported.score),
                *(
                    _share(value)
                    for value in (row.reported.precision, row.reported.recall, row.reported.f1)
                ),
                _share(row.best.f1),
                _number(row.best.score),
            ]
            for row in scores.classes
        ],
        "curves": _curves(scores),
        "by_score": _by_score(scores),
        "sizes": tables,
        "confusion_names": ["label", *(f"reported as {name}" for name in labels), "missed"],
        "confusion": rows,
        "mistakes": blocks,
    }


def _videos(sets: Sequence[Any]) -> str:
    count = sum(each.groups for each in sets)
    return "one video or flight" if count == 1 else f"{count} videos or flights"


def _class_words(classes: Sequence[Any]) -> str:
    return (
        ", ".join(f"{row.label} {_share(row.coco.ap50)}" for row in classes if row.labels)
        or "unknown"
    )


def _comparison(each: Any) -> Json:
    first = each.arms[0]
    names = [name for name, value in first.mean.items() if math.isfinite(value)]
    labels = ", ".join(f"{count} {name}" for name, count in each.labels.items())
    return {
        "name": each.name,
        "basis": f"{each.pictures} pictures of {each.groups} videos, labels: {labels}.",
        "head": [
            "measure",
            *(arm.name for arm in each.arms),
            *(f"{arm.name} less {first.name}" for arm in each.arms[1:]),
        ],
        "rows": [_comparison_row(each, name) for name in names],
    }


def _comparison_row(each: Any, name: str) -> list[Any]:
    row: list[Any] = ["thesis mAP" if name == "thesis_map" else name]
    for arm in each.arms:
        low, high = (arm.lowest[name], arm.highest[name]) if arm.seeds > 1 else (math.nan, math.nan)
        row.append(_interval(arm.mean[name], low, high))
    for found in each.differences:
        measured = found[name]
        words = _interval(measured.value, measured.low, measured.high, "+")
        row.append(cell("strong", words) if measured.is_clear else words)
    return row


def _curves(scores: Any) -> Json | None:
    shown = [row for row in scores.classes if len(row.curve) and row.labels]
    if not shown:
        return None
    x, y, frame = unit_axes("recall", "precision")
    lines = []
    for place, row in enumerate(shown):
        at = (row.reported.recall, row.reported.precision)
        dots = [(x(at[0]), y(at[1]))] if all(map(math.isfinite, at)) else []
        points = [(x(recall), y(precision)) for _, precision, recall in row.curve]
        lines.append(Line(colour_class(place), points, dots, "reported", 4.5))
    keys = [(colour_class(place), row.label) for place, row in enumerate(shown)]
    return {
        "drawing": line_plot("Precision over recall", lines, frame, SIDE_PX, SIDE_PX),
        "legend": keys,
    }


def _by_score(scores: Any) -> Json | None:
    """Which share of reports of each score is right: drawn, and as rows."""
    shown = [(row, each) for row in scores.classes if row.labels for each in row.by_score]
    if not shown:
        return None
    rows = [
        (row.label, each.stated, each.found, each.found_low, each.found_high, each.count)
        for row, each in shown
    ]
    names = list(dict.fromkeys(row.label for row, _ in shown))
    return {
        "drawing": stated_and_found(rows, across="score", upwards="right"),
        "legend": [(colour_class(place), name) for place, name in enumerate(names)],
        "rows": [
            [
                row.label,
                f"{each.low:.1f} to {each.high:.1f}",
                each.count,
                _share(each.found),
                f"{_share(each.found_low)} to {_share(each.found_high)}",
            ]
            for row, each in shown
        ],
    }


def _mistake_words(mistake: Any) -> str:
    if mistake.kind == "miss":
        return f"{mistake.true_label} missed" + (
            f", best candidate {mistake.score:.2f}" if mistake.score else ""
        )
    if mistake.kind == "confusion":
        return f"{mistake.true_label} reported as {mistake.label}, {mistake.score:.2f}"
    beside = f", overlaps a label by {mistake.overlap:.2f}" if mistake.overlap >= 0.1 else ""
    return f"{mistake.label}, {mistake.score:.2f}{beside}"


def _range(low: float, high: float, unit: str) -> str:
    if math.isinf(high):
        return f"from {low:g} {unit}"
    return f"below {high:g} {unit}" if not low else f"{low:g} to {high:g} {unit}"


def _words(value: float, pattern: str) -> str:
    return pattern.format(value) if math.isfinite(value) else "-"


def _share(value: float, sign: str = "") -> str:
    return _words(100 * value, "{:" + sign + ".1f}")


_number = partial(_words, pattern="{:.2f}")


def _with_interval(measured: Any) -> Markup:
    return _interval(measured.value, measured.low, measured.high)


def _interval(value: float, low: float, high: float, sign: str = "") -> Markup:
    """The value, and its bounds on a line of their own where they are known."""
    bounds = (low, high) if math.isfinite(low) else ()
    words = [_share(each, sign) for each in (value, *bounds)]
    return cell("interval", *words, *[""] * (3 - len(words)))
