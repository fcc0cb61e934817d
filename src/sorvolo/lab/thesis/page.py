"""The thesis's chapter 4 beside ours, as one page of HTML that needs no other file, no network and no script."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from sorvolo.geometry.arrays import Floats
from sorvolo.lab.thesis.sheets import Sheet
from sorvolo.store.pages.plots import (
    Axes,
    Bar,
    Line,
    PlotLabel,
    Scale,
    bar_plot,
    colour_class,
    line_plot,
    round_length,
)
from sorvolo.store.pages.words import jpeg_uri, render

_WIDE_PX, _LOW_PX, _MARGIN_PX = 720.0, 260.0, 46.0
_RATES = ("precision", "recall", "f1")
_RATE_WORDS = {"precision": "precision", "recall": "recall", "f1": "F1"}
_GRAY_LEVELS = 256
_SHOWN = 6  # pictures of a figure

Picture = Callable[[str], bytes]
"""A row's picture by its file's name, as a JPEG."""


def reproduction_page(
    document: Mapping[str, Any], sheets: Sequence[Sheet], picture: Picture
) -> str:
    """reproduction.html of reproduction.json's content and its sheets. All text is escaped."""
    by_name = {each.name: each for each in sheets}
    tables, rows = document["tables"], document["rows"]
    page = render(
        "reproduction.html",
        package=__package__,
        title="The thesis's chapter 4",
        dataset=document["dataset"],
        size=document["size"],
        headline=_headline(document),
        missing=[(each["id"], each["reason"]) for each in document["missing"]],
        facts_rows=[(name, str(value)) for name, value in document["made"].items()],
        sheets=by_name,
        figures=document["figures"],
        plots={
            "transforms": _outlines(tables["figure_3_12"]["ours"]),
            "histogram": _histogram(rows),
            "frames": _rates(
                "Frames: printed and here",
                _printed(tables["tables_4_3_and_4_4"]["published"]),
                tables["tables_4_3_and_4_4"]["ours"],
            ),
            "pixels": _rates(
                "Pixels: printed and here",
                _printed(tables["table_4_5"]["published"][-1]),
                tables["table_4_5"]["ours"],
            ),
        },
        pictures=_pictures(rows, picture),
    )
    return str(page)


def _headline(document: Mapping[str, Any]) -> str:
    made, missing = len(document["rows"]), len(document["missing"])
    lost = f"; {missing} could not be made" if missing else ""
    return f"{made} rows of the thesis's tables and figures{lost}"


def _printed(published: Mapping[str, Any]) -> dict[str, Any]:
    return {"method": "thesis, printed", **{name: published[name] for name in _RATES}}


def _rates(
    title: str, printed: Mapping[str, Any], ours: Sequence[Mapping[str, Any]]
) -> dict[str, Any]:
    """Bars of precision, recall and F1 by method, the printed ones first."""
    methods = [printed, *({**each, "method": f"{each['method']}, here"} for each in ours)]
    groups = [
        (
            _RATE_WORDS[name],
            [
                Bar(colour_class(place), each[name], f"{each['method']}: {100 * each[name]:.1f} %")
                for place, each in enumerate(methods)
                if each[name] is not None
            ],
        )
        for name in _RATES
    ]
    return {
        "drawing": bar_plot(title, groups, _WIDE_PX, _LOW_PX),
        "keys": [(colour_class(place), each["method"]) for place, each in enumerate(methods)],
    }


def _histogram(rows: Iterable[Mapping[str, Any]]) -> dict[str, Any] | None:
    """The mean histogram of the deviation of frames and maps, by method (section 4.1.1)."""
    found: dict[str, list[Floats]] = {}
    for row in rows:
        if row["kind"] == "mosaic" and row["values"]["deviation"] is not None:
            found.setdefault(row["values"]["method"], []).append(
                np.array(row["values"]["histogram"], np.float64)
            )
    if not found:
        return None
    return _histogram_plot(
        {method: np.mean(histograms, axis=0) for method, histograms in found.items()}
    )


def _histogram_plot(means: Mapping[str, Floats]) -> dict[str, Any]:
    highest = 1.05 * max(float(each.max()) for each in means.values())
    x, y = Scale(0, _GRAY_LEVELS, _MARGIN_PX, _WIDE_PX - 12), Scale(0, highest, _LOW_PX - 34, 18)
    width = _GRAY_LEVELS / len(next(iter(means.values())))
    lines = [
        Line(
            colour_class(place), [(x((k + 0.5) * width), y(share)) for k, share in enumerate(mean)]
        )
        for place, mean in enumerate(means.values())
    ]
    ticks = list(y.ticks(4))
    labels = [PlotLabel(_MARGIN_PX - 6, y(tick) + 4, f"{100 * tick:g}", "end") for tick in ticks]
    labels += [PlotLabel(x(tick), _LOW_PX - 16, f"{tick:g}") for tick in x.ticks(6)]
    labels += [
        PlotLabel(8, 12, "% of pixels", "start"),
        PlotLabel(_WIDE_PX - 8, _LOW_PX - 2, "difference, gray levels", "end"),
    ]
    across = tuple(("grid", y(tick)) for tick in ticks)
    axes = Axes(_MARGIN_PX, _WIDE_PX - 8, 18, _LOW_PX - 34, across, (), tuple(labels))
    return {
        "drawing": line_plot("Differences of map and frames", lines, axes, _WIDE_PX, _LOW_PX),
        "keys": [(colour_class(place), f"{method}, here") for place, method in enumerate(means)],
    }


def _outlines(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """The frames' outlines by transform, all at one scale, north up (Figure 3.12)."""
    shown = [(row, np.array(row["outlines_m"], np.float64)) for row in rows if row["outlines_m"]]
    if not shown:
        return []
    spans = np.array([np.ptp(each.reshape(-1, 2), axis=0) for _, each in shown]).max(axis=0)
    px = min((_WIDE_PX - 2 * _MARGIN_PX) / spans[0], 420.0 / spans[1])
    return [_outline_plot(row, each, px) for row, each in shown]


def _outline_plot(row: Mapping[str, Any], outlines_m: Floats, px: float) -> dict[str, Any]:
    low, high = outlines_m.reshape(-1, 2).min(axis=0), outlines_m.reshape(-1, 2).max(axis=0)
    height = float((high[1] - low[1]) * px) + 2 * _MARGIN_PX
    east, north = (outlines_m[..., axis] for axis in (0, 1))
    x, y = (east - low[0]) * px + _MARGIN_PX, (high[1] - north) * px + _MARGIN_PX / 2
    lines = [
        Line(
            f"outline {colour_class(0)}",
            [(float(a), float(b)) for a, b in zip([*xs, xs[0]], [*ys, ys[0]])],
        )
        for xs, ys in zip(x, y)
    ]
    centres = [(float(a), float(b)) for a, b in zip(x.mean(axis=1), y.mean(axis=1))]
    lines.append(Line(colour_class(1), centres, centres, "middle of a frame"))
    bar_m = round_length(float(high[0] - low[0]) / 4)
    foot = height - 14
    lines.append(Line("ink", [(_MARGIN_PX, foot), (_MARGIN_PX + bar_m * px, foot)]))
    axes = Axes(
        0,
        0,
        0,
        0,
        labels=(PlotLabel(_MARGIN_PX + bar_m * px + 8, foot + 4, f"{bar_m:g} m", "start"),),
    )
    title = "Rigid transform" if row["transform"] == "similarity" else "Homography"
    return {
        "title": title,
        "drawing": line_plot(f"{title}: outlines of the frames", lines, axes, _WIDE_PX, height),
    }


def _pictures(
    rows: Sequence[Mapping[str, Any]], picture: Picture
) -> dict[str, list[tuple[str, str]]]:
    """The pictures of each figure: words and address."""
    found: dict[str, list[tuple[str, str]]] = {
        name: []
        for name in ("transforms", "example", "maps", "flat", "urban", "false", "found", "detected")
    }
    for row in rows:
        for name, words, file in _shown_of(row):
            if len(found[name]) < _SHOWN:
                found[name].append((words, jpeg_uri(picture(file))))
    return found


def _shown_of(row: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Which figure each of a row's pictures belongs to, with its words."""
    figures = _FIGURES_OF.get(row["kind"])
    if figures is None:
        return []
    values = row["values"]
    return [
        (figure, words, file)
        for name, file in row["pictures"].items()
        for figure, words in figures(name, values)
    ]


def _of_transform(_: str, values: Mapping[str, Any]) -> list[tuple[str, str]]:
    return [
        ("transforms", "rigid transform" if values["transform"] == "similarity" else "homography")
    ]


def _of_mosaic(_: str, values: Mapping[str, Any]) -> list[tuple[str, str]]:
    words = f"{values['sequence']}, {values['method']}"
    if values["method"] != "thesis":
        return [("maps", words)]
    return [
        ("maps", words),
        ("urban" if values["environment"].lower() == "urban" else "flat", words),
    ]


def _of_comparison(name: str, values: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The thesis's own method and ours; the other variants are figures of nothing."""
    if values["method"] not in _SHOWN_METHODS:
        return []
    figure, _, side = name.partition("-")
    return [(figure, f"{values['sequence']}, {values['method']}: {side}")]


_SHOWN_METHODS = ("thesis", "robust")
_FIGURES_OF: Mapping[str, Callable[[str, Mapping[str, Any]], list[tuple[str, str]]]] = {
    "transform": _of_transform,
    "mosaic": _of_mosaic,
    "comparison": _of_comparison,
    "example": lambda name, _: [("example", name)],
    "detector": lambda _, values: [("detected", f"{values['dataset']}, {values['model']}")],
}
