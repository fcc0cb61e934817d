"""How a training went, as one page of HTML that needs no other file, no network and no script."""

import math
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

from sorvolo.store.pages.plots import Scale
from sorvolo.store.pages.report_style import STYLE
from sorvolo.store.pages.words import at, bullet_list, escaped, page_of, seconds_words, table_of

_STYLE = """
.key.c0{background:var(--east)}.key.c1{background:var(--gps)}.key.c2{background:var(--vision)}
.key.c3{background:var(--north)}.key.c4{background:var(--up)}
svg .c0{stroke:var(--east)}svg .c1{stroke:var(--gps)}svg .c2{stroke:var(--vision)}svg .c3{stroke:var(--north)}
svg .c4{stroke:var(--up)}
"""
_COLOURS = 5
_WIDE_PX, _LOW_PX, _MARGIN_PX = 720.0, 250.0, 46.0
_LOSSES = {
    "proposal_score": "proposals: score", "proposal_box": "proposals: box",
    "region_score": "classifier: score", "region_box": "classifier: box",
}


def training_page(report: Mapping[str, Any]) -> str:
    """training.html of training.json's content. All text is escaped."""
    name = at(report, "model", "name")
    parts = [
        _header(report), _warnings(report), _losses(report), _checks(report), _reported(report), _sets(report),
        _how(report),
    ]
    return page_of(f"{escaped(name)} - training", STYLE + _STYLE, parts)


def _header(report: Mapping[str, Any]) -> str:
    ap50 = at(report, "held_out", "ap50")
    told = "How good it is was not measured: nothing was held out" if ap50 is None else f"AP50 {_number(ap50)}"
    early = ", then its checks no longer got better" if report["stopped_early"] else ""
    size_mb = report["export"]["bytes"] / 1e6
    return (
        f'<header><p class="over">Training of <b>{escaped(at(report, "model", "name"))}</b></p><h1>{told}</h1>'
        f"<p>{report['step']} of {report['steps']} steps in {seconds_words(report['seconds'])} on "
        f"{escaped(report['device'])}{early}. The model file has {size_mb:.1f} MB.</p></header>"
    )


def _warnings(report: Mapping[str, Any]) -> str:
    notices = report["notices"]
    return f'<section class="warn">{bullet_list(escape(each) for each in notices)}</section>' if notices else ""


def _losses(report: Mapping[str, Any]) -> str:
    rows = report["losses"]
    lines = {
        words: [(row["step"], row[key]) for row in rows] for key, words in _LOSSES.items()
    }
    plot = _plot("Losses over steps", lines, low=0.0)
    return f"<section><h2>Losses</h2>{plot}</section>" if plot else ""


def _checks(report: Mapping[str, Any]) -> str:
    checks = report["checks"]
    lines: dict[str, list[tuple[float, float]]] = {"all classes": [(row["step"], row["ap50"]) for row in checks]}
    for row in checks:
        for name, value in row["classes"].items():
            lines.setdefault(name, []).append((row["step"], value))
    if list(lines.values()).count(lines["all classes"]) == len(lines) == 2:  # the mean over one class is that class
        del lines["all classes"]
    plot = _plot("AP50 over steps", lines, low=0.0, high=1.0)
    if not plot:
        return ""
    kept = f"The weights of step {report['best_step']} were kept." if report["best_step"] is not None else ""
    return (
        f"<section><h2>AP50 on held-out pictures</h2>{plot}<p class=\"note\">COCO's average precision at IoU 0.5, of a "
        f"sample of them. {kept}</p></section>"
    )


def _reported(report: Mapping[str, Any]) -> str:
    classes = at(report, "held_out", "classes")
    if not classes:
        return ""
    rows = []
    for name, ap50 in classes.items():
        told = report["reported"][name]
        found_px = report["found_px"].get(name)
        rows.append([
            escape(name), _number(ap50), _number(told["score"]), _number(told["precision"]), _number(told["recall"]),
            f"{found_px[0]:g} to {found_px[1]:g} px" if found_px else "too few found",
        ])
    names = ("class", "AP50", "reported from score", "precision", "recall", "longer sides found")
    return (
        f"<section><h2>Held-out pictures, the model as written</h2>{table_of(rows, names)}<p class=\"note\">The score "
        "was chosen on these very pictures, which flatters it a little; <code>sorvolo evaluate detector</code> "
        "measures on others.</p></section>"
    )


def _sets(report: Mapping[str, Any]) -> str:
    rows = [
        [
            escape(each["name"]), escape(each["part"]), str(each["pictures"]), str(each["videos"]),
            escape(", ".join(f"{count} {name}" for name, count in each["boxes"].items())),
            escape(", ".join(each["unlabelled"])) or "-",
        ]
        for each in report["sets"]
    ]
    names = ("set", "", "pictures", "videos", "boxes", "unlabelled")
    return f"<section><h2>Pictures</h2>{table_of(rows, names)}</section>"


def _how(report: Mapping[str, Any]) -> str:
    export = report["export"]
    rows = [[escape(key), escaped(value)] for key, value in report["settings"].items()]
    rows.append(["began with", escaped(report["weights"])])
    undecided = f"; {export['undecided']} more hang on roundings" if export["undecided"] else ""
    rows.append([
        "exported model against torch",
        f"{export['box_px']:.3f} px, {export['score']:.5f} in score, over {export['detections']} detections{undecided}",
    ])
    return f"<section><h2>How</h2>{table_of(rows)}</section>"


def _plot(
    title: str, lines: Mapping[str, Sequence[tuple[float, float]]], *, low: float, high: float | None = None
) -> str:
    """Lines over steps with their key; "" unless two points of one are known."""
    known = {name: [point for point in line if _is_known(point[1])] for name, line in lines.items()}
    known = {name: line for name, line in known.items() if len(line) > 1}
    if not known:
        return ""
    last = max(line[-1][0] for line in known.values())
    top = high if high is not None else max(_typical_top(line) for line in known.values())
    x = Scale(0, last, _MARGIN_PX, _WIDE_PX - 14)
    y = Scale(low, max(top, low + 1e-6), _LOW_PX - 34, 14)
    parts = []
    for tick in y.ticks(5):
        parts.append(f'<path class="grid" d="M{_MARGIN_PX:.1f},{y(tick):.1f} H{_WIDE_PX - 8}"/>')
        parts.append(
            f'<text class="label" x="{_MARGIN_PX - 6}" y="{y(tick) + 4:.1f}" text-anchor="end">{tick:g}</text>'
        )
    for tick in (each for each in x.ticks(8) if each == round(each)):
        parts.append(
            f'<text class="label" x="{x(tick):.1f}" y="{_LOW_PX - 16}" text-anchor="middle">{tick:g}</text>'
        )
    parts.append(f'<text class="label" x="{_WIDE_PX - 8}" y="{_LOW_PX - 2}" text-anchor="end">step</text>')
    keys = []
    for place, (name, line) in enumerate(known.items()):
        colour = f"c{place % _COLOURS}"
        points = " ".join(f"{x(step):.1f},{y(min(value, top)):.1f}" for step, value in line)
        parts.append(f'<polyline class="line {colour}" points="{points}"/>')
        keys.append(f'<span class="key {colour}"></span>{escape(name)}')
    drawing = (
        f'<svg viewBox="0 0 {_WIDE_PX:.0f} {_LOW_PX:.0f}" role="img" style="max-width:{1.2 * _WIDE_PX:.0f}px">'
        f"<title>{escape(title)}</title>{''.join(parts)}</svg>"
    )
    return f"{drawing}<p>{' '.join(keys)}</p>"


def _typical_top(line: Sequence[tuple[float, float]]) -> float:
    """The height that shows all but a loss's first rows, which may be many times the rest."""
    values = sorted(value for _, value in line)
    return min(values[-1], 1.3 * values[int(0.95 * (len(values) - 1))])


def _is_known(value: Any) -> bool:
    return isinstance(value, int | float) and math.isfinite(value)


def _number(value: Any) -> str:
    return f"{value:.3f}" if _is_known(value) else "-"
