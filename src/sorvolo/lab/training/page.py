"""How a training went, as one page of HTML that needs no other file, no network and no script."""

from collections.abc import Mapping, Sequence
from typing import Any

from sorvolo.store.pages.plots import Axes, Line, PlotLabel, Scale, colour_class, line_plot
from sorvolo.store.pages.words import at, finite_or_none, known, render, seconds_words, with_unit

_WIDE_PX, _LOW_PX, _MARGIN_PX = 720.0, 250.0, 46.0
_Lines = Mapping[str, Sequence[tuple[float, float]]]


def training_page(report: Mapping[str, Any]) -> str:
    """training.html of training.json's content. All text is escaped."""
    ap50 = at(report, "held_out", "ap50")
    best = report["best_step"]
    checks = report["checks"]
    every = [(row["step"], row["ap50"]) for row in checks]
    lines = _lines(checks, "classes")
    if [*lines.values()] != [every]:  # the mean over one class is that class
        lines = {"all classes": every, **lines}
    early = ", then its checks no longer got better" if report["stopped_early"] else ""
    page = render(
        "training.html",
        package=__package__,
        title=f"{at(report, 'model', 'name')} - training",
        name=known(at(report, "model", "name")),
        headline="Accuracy not measured: no pictures were held out"
        if ap50 is None
        else f"AP50 {_number(ap50)}",
        summary=(
            f"{report['step']} of {report['steps']} steps in {seconds_words(report['seconds'])} on "
            f"{known(report['device'])}{early}. The model file has {report['export']['bytes'] / 1e6:.1f} MB."
        ),
        notices=report["notices"],
        losses=_plot("Losses over steps", _lines(report["losses"], "losses")),
        checks=_plot("AP50 over steps", lines, high=1.0),
        kept=f"The weights of step {best} were kept." if best is not None else "",
        classes=_classes(report),
        sets=[
            [
                each["name"],
                each["part"],
                str(each["pictures"]),
                str(each["videos"]),
                ", ".join(f"{count} {name}" for name, count in each["boxes"].items()),
                ", ".join(each["unlabelled"]) or "-",
            ]
            for each in report["sets"]
        ],
        settings=_settings(report),
    )
    return str(page)


def _lines(rows: Sequence[Mapping[str, Any]], key: str) -> dict[str, list[tuple[float, float]]]:
    """The values of rows by name, over their steps."""
    lines: dict[str, list[tuple[float, float]]] = {}
    for row in rows:
        for name, value in row[key].items():
            lines.setdefault(name, []).append((row["step"], value))
    return lines


def _classes(report: Mapping[str, Any]) -> list[list[str]]:
    rows = []
    for name, ap50 in (at(report, "held_out", "classes") or {}).items():
        reported, found_px = report["reported"][name], report["found_px"].get(name)
        rows.append(
            [
                name,
                *map(_number, (ap50, reported["score"], reported["precision"], reported["recall"])),
                f"{found_px[0]:g} to {found_px[1]:g} px" if found_px else "too few found",
            ]
        )
    return rows


def _settings(report: Mapping[str, Any]) -> list[tuple[str, str]]:
    export = report["export"]
    undecided = f"; {export['undecided']} more depend on rounding" if export["undecided"] else ""
    rows = [(str(key), known(value)) for key, value in report["settings"].items()]
    rows.append(("began with", known(report["weights"])))
    rows.append(
        (
            "exported model against torch",
            f"{export['box_px']:.3f} px, {export['score']:.5f} in score, over {export['detections']} detections{undecided}",
        )
    )
    return rows


def _plot(title: str, lines: _Lines, high: float | None = None) -> dict[str, Any] | None:
    """Lines over steps and their key; None unless two points of one are known."""
    # The known points of each line; lines of fewer than two are left out
    known = {
        name: [point for point in line if finite_or_none(point[1]) is not None]
        for name, line in lines.items()
    }
    certain = {name: line for name, line in known.items() if len(line) > 1}
    if not certain:
        return None
    last = max(line[-1][0] for line in certain.values())
    top = high if high is not None else max(_typical_top(line) for line in certain.values())
    x = Scale(0, last, _MARGIN_PX, _WIDE_PX - 14)
    y = Scale(0.0, max(top, 1e-6), _LOW_PX - 34, 14)
    drawn = [
        Line(colour_class(place), [(x(step), y(min(value, top))) for step, value in line])
        for place, line in enumerate(certain.values())
    ]
    keys = [(colour_class(place), name) for place, name in enumerate(certain)]
    labels = [PlotLabel(_MARGIN_PX - 6, y(tick) + 4, f"{tick:g}", "end") for tick in y.ticks(5)]
    labels += [
        PlotLabel(x(tick), _LOW_PX - 16, f"{tick:g}") for tick in x.ticks(8) if tick == round(tick)
    ]
    labels.append(PlotLabel(_WIDE_PX - 8, _LOW_PX - 2, "step", "end"))
    across = tuple(("grid", y(tick)) for tick in y.ticks(5))
    axes = Axes(_MARGIN_PX, _WIDE_PX - 8, 14, _LOW_PX - 34, across, (), tuple(labels))
    return {"drawing": line_plot(title, drawn, axes, _WIDE_PX, _LOW_PX), "legend": keys}


def _typical_top(line: Sequence[tuple[float, float]]) -> float:
    """The height that shows all but a loss's first rows, which may be many times the rest."""
    values = sorted(value for _, value in line)
    return min(values[-1], 1.3 * values[int(0.95 * (len(values) - 1))])


def _number(value: Any) -> str:
    return with_unit(value, "{:.3f}") or "-"
