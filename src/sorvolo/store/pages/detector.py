"""How good a detector is, as one page of HTML that needs no other file, no network and no script."""

import math
from collections.abc import Callable, Mapping, Sequence
from html import escape
from typing import Any

import numpy as np

from sorvolo.geometry.arrays import Anything, ImageRGB
from sorvolo.store.pages.plots import Scale
from sorvolo.store.pages.report_style import STYLE
from sorvolo.store.pages.words import bullet_list, escaped, page_of, picture_uri, table_of

_STYLE = """
.crops{display:grid;grid-template-columns:repeat(auto-fill,minmax(150px,1fr));gap:12px}
.crops figure{margin:0}.crops img{display:block;width:100%;border-radius:8px}
.crops figcaption{margin:2px 0 0;font-size:.78rem;overflow-wrap:anywhere}
.hit{background:color-mix(in srgb,var(--vision) 22%,transparent)}
.key.c0{background:var(--east)}.key.c1{background:var(--gps)}.key.c2{background:var(--vision)}
.key.c3{background:var(--north)}
svg .c0{stroke:var(--east)}svg .c1{stroke:var(--gps)}svg .c2{stroke:var(--vision)}svg .c3{stroke:var(--north)}
.within{display:block;color:var(--soft);font-size:.82rem;white-space:nowrap}
"""
_COLOURS = 4
_KIND_WORDS = {
    "false alarm": "The surest false alarms", "miss": "The largest misses", "confusion": "The surest confusions",
}
_SIDE_PX, _MARGIN_PX = 420.0, 44.0


def detector_page(
    model: str,
    sets: Sequence[Any],
    comparisons: Sequence[Any],
    worst: Mapping[str, Sequence[tuple[Any, str, ImageRGB]]],
    description: Mapping[str, Any],
) -> str:
    """detector.html: `sets` and `comparisons` have the fields of detection.scores.SetScores and SetComparison.

    `worst` holds each set's mistakes (fields of detection.metrics.Mistake), the picture's name and a crop. All text is
    escaped.
    """
    parts = [_header(model, sets), _overview(sets)]
    parts += [_comparison(each) for each in comparisons]
    for scores in sets:
        parts += [_classes(scores), _curves(scores), _sizes(scores), _confusion(scores)]
        parts.append(_mistakes(scores, worst.get(scores.name, ())))
    parts.append(_how(description))
    return page_of(f"{escaped(model)} - detector", STYLE + _STYLE, parts)


def _header(model: str, sets: Sequence[Any]) -> str:
    told = "; ".join(f"{escape(each.name)}: AP50 {_class_words(each.classes)}" for each in sets)
    return (
        f'<header><p class="over">Detector <b>{escaped(model)}</b></p><h1>{told}</h1>'
        f"<p>Measured on {sum(each.pictures for each in sets)} labelled pictures of {_videos(sets)}. All shares are in "
        "per cent.</p></header>"
    )


def _videos(sets: Sequence[Any]) -> str:
    count = sum(each.groups for each in sets)
    return "one video or flight" if count == 1 else f"{count} videos or flights"


def _class_words(classes: Sequence[Any]) -> str:
    return ", ".join(f"{escape(row.label)} {_share(row.coco.ap50)}" for row in classes if row.labels) or "unknown"


def _overview(sets: Sequence[Any]) -> str:
    names = ("set", "pictures", "videos", "AP", "AP50", "AP75", "AP small", "medium", "large", "thesis mAP")
    rows = []
    for each in sets:
        known = each.intervals
        coco = each.coco
        rows.append([
            escape(each.name), str(each.pictures), str(each.groups),
            *(_with_interval(known[name]) for name in ("AP", "AP50", "AP75")),
            *(_share(value) for value in (coco.ap_small, coco.ap_medium, coco.ap_large)),
            _with_interval(known["thesis_map"]),
        ])
    remarks = [f"{escape(each.name)}: {escape(text)}" for each in sets for text in each.remarks]
    remarks += [
        f"{escape(each.name)}: {escape(', '.join(each.left_out))} not labelled there, so not judged"
        for each in sets if each.left_out
    ]
    return (
        f"<section><h2>Average precision</h2>{table_of(rows, names)}"
        '<p class="note">COCO\'s AP is the mean over IoU 0.50 to 0.95; small is below 32\u00b2 px, large above '
        "96\u00b2. Below a value the interval that holds it with 95 %, by drawing whole videos. The thesis's mAP "
        "(eqs 4.3, 4.4) is the mean precision at the reporting thresholds: it says nothing of what was missed.</p>"
        + (bullet_list(remarks) if remarks else "") + "</section>"
    )


def _comparison(each: Any) -> str:
    names = [name for name, value in each.arms[0].mean.items() if math.isfinite(value)]
    head = ["measure", *(escape(arm.name) for arm in each.arms)]
    head += [f"{escape(arm.name)} less {escape(each.arms[0].name)}" for arm in each.arms[1:]]
    rows = []
    for name in names:
        row = ["thesis mAP" if name == "thesis_map" else escape(name)]
        for arm in each.arms:
            spread = _within(arm.lowest[name], arm.highest[name], _share) if arm.seeds > 1 else ""
            row.append(_share(arm.mean[name]) + spread)
        for found in each.differences:
            told = found[name]
            words = _points(told.value) + _within(told.low, told.high, _points)
            row.append(f"<b>{words}</b>" if told.is_clear else words)
        rows.append(row)
    labels = ", ".join(f"{count} {escape(name)}" for name, count in each.labels.items())
    return (
        f"<section><h2>Side by side: {escape(each.name)}</h2>{table_of(rows, head)}"
        f'<p class="note">{each.pictures} pictures of {each.groups} videos, labels: {labels}. Differences in '
        "percentage points with their 95 % interval, on the same draws of videos (and of seeds, where an arm has "
        "several); bold where the interval leaves zero out.</p></section>"
    )


def _classes(scores: Any) -> str:
    names = (
        "class", "labels", "AP", "AP50", "AP75", "reported from", "precision", "recall", "F1", "thesis AP",
        "best F1", "from",
    )
    rows = [
        [
            escape(row.label), str(row.labels), _with_interval(scores.intervals[f"AP {row.label}"]),
            _with_interval(scores.intervals[f"AP50 {row.label}"]), _share(row.coco.ap75), _number(row.reported.score),
            *(_share(value) for value in (row.reported.precision, row.reported.recall, row.reported.f1)),
            _share(row.thesis_ap), _share(row.best.f1), _number(row.best.score),
        ]
        for row in scores.classes
    ]
    return (
        f"<section><h2>{escape(scores.name)}: classes</h2>{table_of(rows, names)}"
        '<p class="note">Precision, recall and F1 at IoU 0.5 of what the model reports; the best F1 is chosen on these '
        "very pictures and flatters a little.</p></section>"
    )


def _curves(scores: Any) -> str:
    shown = [row for row in scores.classes if len(row.curve) and row.labels]
    if not shown:
        return ""
    x = Scale(0, 1, _MARGIN_PX, _SIDE_PX - 12)
    y = Scale(0, 1, _SIDE_PX - _MARGIN_PX, 12)
    parts = []
    for tick in (0.0, 0.25, 0.5, 0.75, 1.0):
        parts.append(f'<path class="grid" d="M{x(tick):.1f},12 V{y(0):.1f} M{x(0):.1f},{y(tick):.1f} H{x(1):.1f}"/>')
        parts.append(f'<text class="label" x="{x(tick):.1f}" y="{y(0) + 16:.1f}" text-anchor="middle">{tick:g}</text>')
        parts.append(f'<text class="label" x="{x(0) - 6:.1f}" y="{y(tick) + 4:.1f}" text-anchor="end">{tick:g}</text>')
    parts.append(f'<text class="label" x="{x(1):.1f}" y="{_SIDE_PX - 8:.0f}" text-anchor="end">recall</text>')
    parts.append(f'<text class="label" x="6" y="{_SIDE_PX - 8:.0f}">precision upwards</text>')
    keys = []
    for place, row in enumerate(shown):
        colour = f"c{place % _COLOURS}"
        points = " ".join(f"{x(recall):.1f},{y(precision):.1f}" for _, precision, recall in row.curve)
        parts.append(f'<polyline class="line {colour}" points="{points}"/>')
        if math.isfinite(row.reported.precision) and math.isfinite(row.reported.recall):
            where = f'cx="{x(row.reported.recall):.1f}" cy="{y(row.reported.precision):.1f}"'
            parts.append(f'<circle class="line {colour}" {where} r="4.5"><title>reported</title></circle>')
        keys.append(f'<span class="key {colour}"></span>{escape(row.label)}')
    drawing = (
        f'<svg viewBox="0 0 {_SIDE_PX:.0f} {_SIDE_PX:.0f}" role="img" style="max-width:{_SIDE_PX:.0f}px">'
        f"<title>Precision over recall</title>{''.join(parts)}</svg>"
    )
    return (
        f"<section><h2>{escape(scores.name)}: precision over recall</h2>{drawing}<p>{' '.join(keys)}</p>"
        '<p class="note">At IoU 0.5; the circle is where the model reports.</p></section>'
    )


def _sizes(scores: Any) -> str:
    tables = []
    for rows_of, unit, words in (
        (scores.by_size_px, "px", "in the picture"), (scores.by_size_m, "m", "on the ground"),
    ):
        rows = [
            [
                escape(label), f'<span class="whole">{_range(row.low, row.high, unit)}</span>', str(row.count),
                f'{_share(row.recall)}<div class="bar" style="width:{100 * row.recall:.0f}%"></div>',
                _share(row.candidates / row.count),
            ]
            for label, found in rows_of.items() for row in found
        ]
        if rows:
            names = ("class", "longer side", "labels", "recall as reported", "with any candidate")
            tables.append(f"<div><h3>Size {words}</h3>{table_of(rows, names)}</div>")
    if not tables:
        return ""
    both = f'<div class="pair">{"".join(tables)}</div>'
    return f"<section><h2>{escape(scores.name)}: recall by size</h2>{both}</section>"


def _confusion(scores: Any) -> str:
    labels = [row.label for row in scores.classes]
    head = ["label", *(f"reported as {escape(name)}" for name in labels), "missed"]
    rows = []
    for k, name in enumerate([*labels, "nothing there"]):
        cells = [
            f'<span class="hit">{int(value)}</span>' if k == c else str(int(value))
            for c, value in enumerate(scores.confusion[k])
        ]
        rows.append([escape(name), *cells[:-1], cells[-1] if k < len(labels) else ""])
    return f"<section><h2>{escape(scores.name)}: what is taken for what</h2>{table_of(rows, head)}</section>"


def _mistakes(scores: Any, worst: Sequence[tuple[Any, str, ImageRGB]]) -> str:
    blocks = []
    for kind, words in _KIND_WORDS.items():
        figures = [_figure(mistake, name, crop) for mistake, name, crop in worst if mistake.kind == kind]
        if figures:
            total = sum(each.kind == kind for each in scores.mistakes)
            blocks.append(f'<h3>{words} ({len(figures)} of {total})</h3><div class="crops">{"".join(figures)}</div>')
    if not blocks:
        return ""
    return (
        f"<section><h2>{escape(scores.name)}: worst mistakes</h2>{''.join(blocks)}"
        '<p class="note">Labels are green, what was reported is orange.</p></section>'
    )


def _figure(mistake: Any, name: str, crop: ImageRGB) -> str:
    if mistake.kind == "miss":
        words = f"{mistake.true_label} missed" + (f", best candidate {mistake.score:.2f}" if mistake.score else "")
    elif mistake.kind == "confusion":
        words = f"{mistake.true_label} reported as {mistake.label}, {mistake.score:.2f}"
    else:
        placed = f", overlaps a label by {mistake.overlap:.2f}" if mistake.overlap >= 0.1 else ""
        words = f"{mistake.label}, {mistake.score:.2f}{placed}"
    rgba = _opaque(crop)
    return (
        f'<figure><img src="{picture_uri(rgba, 24_000)}" alt="{escape(words)}">'
        f"<figcaption>{escape(words)}<br>{escape(name)}</figcaption></figure>"
    )


def _how(description: Mapping[str, Any]) -> str:
    rows = [[escaped(key), escaped(value)] for key, value in description.items()]
    return f"<section><h2>How it was measured</h2>{table_of(rows)}</section>"


def _opaque(rgb: ImageRGB) -> Anything:
    return np.dstack([rgb, np.full(rgb.shape[:2], 255, np.uint8)])


def _range(low: float, high: float, unit: str) -> str:
    if math.isinf(high):
        return f"from {low:g} {unit}"
    return f"below {high:g} {unit}" if not low else f"{low:g} to {high:g} {unit}"


def _share(value: float) -> str:
    return f"{100 * value:.1f}" if math.isfinite(value) else "-"


def _points(value: float) -> str:
    return f"{100 * value:+.1f}" if math.isfinite(value) else "-"


def _number(value: float) -> str:
    return f"{value:.2f}" if math.isfinite(value) else "-"


def _with_interval(told: Any) -> str:
    return _share(told.value) + _within(told.low, told.high, _share)


def _within(low: float, high: float, words: Callable[[float], str]) -> str:
    """The bounds on a line of their own; "" where they are not known."""
    return f'<span class="within">{words(low)} to {words(high)}</span>' if math.isfinite(low) else ""
