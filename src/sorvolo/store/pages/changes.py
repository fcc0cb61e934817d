"""A flight's changes as one page of HTML: the map, a swipe between the two dates, and each change before and after.

The page needs no other file and no network; its one small script moves the swipe, without it both halves are shown.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np

from sorvolo.geometry.arrays import Floats, ImageRGBA, PointsPx
from sorvolo.geometry.grid import SiteGrid
from sorvolo.store.exports.map_pictures import Picture
from sorvolo.store.exports.places import longitude_latitude
from sorvolo.store.exports.plain import time_words
from sorvolo.store.images import shrink
from sorvolo.store.pages.changes_style import SCRIPT
from sorvolo.store.pages.changes_style import STYLE as CHANGES_STYLE
from sorvolo.store.pages.report_style import STYLE
from sorvolo.store.pages.words import (
    area_words,
    at,
    bullet_list,
    escaped,
    length_words,
    number_at,
    page_of,
    picture_uri,
    table_of,
    with_unit,
)
from sorvolo.store.site.change_records import StoredChange
from sorvolo.survey.findings import ChangeKind, Verdict, ViewStatus
from sorvolo.survey.flight import Site

_MANY = 40  # changes on one map: their numbers become small
_CROP_PX = 320
_CROPS_BYTES = 6_000_000  # of all crops in the page together
_RIM = 0.96  # of the map: where an outline reaches beyond, its number stands on the other side
_UNKNOWN_SHARE = 0.1  # of the ground: more is said first
_KIND_WORDS = {
    ChangeKind.APPEARED: "is there now and was not before",
    ChangeKind.DISAPPEARED: "was there before and is gone",
    ChangeKind.REPLACED: "something else stands in its place, or it looks different",
    ChangeKind.MOVING: "moved while it was seen: no change of the ground",
}
_VIEW_WORDS = {
    ViewStatus.COMPARED: "laid over the map and compared",
    ViewStatus.NOT_ALIGNED: "did not fit the map well enough: says nothing of its ground",
    ViewStatus.OUTSIDE: "shows ground that the map did not know: nothing to compare it with",
    ViewStatus.ALL_CHANGED: "nearly all of it differs (snow, flood, another place): a list of changes would mislead",
    ViewStatus.LOST: "could not be used: blurred, damaged or without a place",
}


def changes_page(
    report: Mapping[str, Any],
    changes: Sequence[StoredChange],
    before: Picture | None,
    after: Picture | None,
    site: Site,
    crops: Mapping[str, tuple[ImageRGBA | None, ImageRGBA | None]],
    *,
    before_words: str = "before",
    after_words: str = "after",
) -> str:
    """changes.html of one flight: `report` as in report.json with its "comparison" (docs/formats.md).

    `before` and `after` are the map's pictures on the same ground, None for a map without tiles; the words name their
    dates. `crops` are the changes' pictures before and after by id. What the report does not say is left out. All
    text is escaped.
    """
    body = [
        _header(report, changes),
        _warnings(report),
        _swipe(changes, before, after, site, before_words, after_words),
        _overview(changes, site),
        _pairs(changes, site, crops),
        _not_compared(report),
        _how(report),
    ]
    title = f"{escaped(report.get('flight'))} - changes"
    return page_of(title, STYLE + CHANGES_STYLE, body, SCRIPT)


def _header(report: Mapping[str, Any], changes: Sequence[StoredChange]) -> str:
    against = at(report, "comparison", "against_version")
    version = f", against version {escaped(against)} of its map" if against is not None else ""
    return (
        f'<header><p class="over">Flight <b>{escaped(report.get("flight"))}</b> over the site '
        f'<b>{escaped(report.get("site"))}</b>{version}</p>'
        f"<h1>{_headline(report, changes)}</h1><p>{_second_sentence(report, changes)}</p></header>"
    )


def _headline(report: Mapping[str, Any], changes: Sequence[StoredChange]) -> str:
    area_m2 = number_at(report, "comparison", "compared_area_m2")
    ground = f" on {area_words(area_m2)} of ground" if area_m2 is not None and report.get("georeferenced", True) else ""
    views = at(report, "comparison", "views")
    if views and not views.get(ViewStatus.COMPARED.value):
        return "No view could be compared with the map: this flight says nothing of changes."
    kinds: Counter[ChangeKind] = Counter(each.kind for each in changes if each.kind is not ChangeKind.MOVING)
    moving = sum(each.kind is ChangeKind.MOVING for each in changes)
    also = f"; {moving} moving {'thing' if moving == 1 else 'things'} besides" if moving else ""
    total = sum(kinds.values())
    is_dark = at(report, "comparison", "most_missed") is True
    if is_dark and not total:
        return f"Too dark to tell: most changes{ground} would be missed, and none was found{also}."
    if not total:
        return f"No change was found{ground}{also}."
    named = ", ".join(f"{kinds[kind]} {kind.value}" for kind in ChangeKind if kinds[kind])
    words = "1 change" if total == 1 else f"{total} changes"
    return f"{words}{ground}: {named}{also}{'; it was too dark to find most others' if is_dark else ''}."


def _second_sentence(report: Mapping[str, Any], changes: Sequence[StoredChange]) -> str:
    views = at(report, "comparison", "views") or {}
    votes, voters = at(report, "comparison", "votes"), at(report, "comparison", "voters")
    unknown = number_at(report, "comparison", "unknown_share")
    parts = []
    if views:
        seen = f"{views.get(ViewStatus.COMPARED.value, 0)} of {sum(views.values())} views were compared."
        parts.append(seen)
    if votes is not None and voters is not None:
        parts.append(f"A change counts when {escaped(votes)} of {escaped(voters)} views of its ground show it.")
    if unknown is not None:
        parts.append(f"{unknown:.1%} of the ground under these views was unknown on a date and is not judged.")
    grown_m2, extending = (number_at(report, "comparison", "extension", key) for key in ("area_m2", "frames"))
    if grown_m2 and extending:
        parts.append(f"The map grew by {area_words(grown_m2)}: {extending:.0f} of the frames showed ground beside it.")
    reviewed = Counter(each.verdict for each in changes if each.verdict is not None)
    if reviewed:
        said = " and ".join(f"{reviewed[verdict]} {verdict.value}" for verdict in Verdict if reviewed[verdict])
        parts.append(f"Of the changes, {said} by a person.")
    return " ".join(parts)


def _warnings(report: Mapping[str, Any]) -> str:
    warnings = [escaped(each) for each in at(report, "warnings") or []]
    views = at(report, "comparison", "views") or {}
    total = sum(views.values())
    for status in (ViewStatus.NOT_ALIGNED, ViewStatus.ALL_CHANGED):
        count = views.get(status.value, 0)
        if total and count > 0.1 * total:
            warnings.append(f"{count} of {total} views: {status.value}; each {_VIEW_WORDS[status]}.")
    unknown = number_at(report, "comparison", "unknown_share")
    if unknown is not None and unknown > _UNKNOWN_SHARE:
        warnings.append(f"{unknown:.0%} of the ground under the views was unknown: its changes are not in the list.")
    suppressed = number_at(report, "comparison", "suppressed")
    if suppressed:
        warnings.append(f"{suppressed:.0f} changes were left out: a person rejected them after an earlier flight.")
    if at(report, "comparison", "map_updated") is False:
        warnings.append("The map was not brought up to date: both halves of the picture are the map before.")
    if not warnings:
        return ""
    return f'<section class="warn"><h2>Look at this first</h2>{bullet_list(warnings)}</section>'


def _swipe(
    changes: Sequence[StoredChange], before: Picture | None, after: Picture | None, site: Site,
    before_words: str, after_words: str,
) -> str:
    if before is None or after is None or not after.rgba.size:
        return ""
    height_px, width_px = after.rgba.shape[:2]
    grid = SiteGrid.at(site.origin, site.m_per_px, site.crs)
    outlines, pins = [], []
    for each in changes:
        outline_px = _outline_px(each, grid, after)
        outlines.append(_polygons(outline_px, each))
        low, high = outline_px.min(axis=0), outline_px.max(axis=0)
        is_right, is_above = high[0] < _RIM * width_px, low[1] > (1 - _RIM) * height_px  # else the rim would cut it
        x, y = high[0] if is_right else low[0], low[1] if is_above else high[1]
        if 0 <= x <= width_px and 0 <= y <= height_px:
            beside = f"{'0' if is_right else '-100%'},{'-100%' if is_above else '0'}"
            pins.append(
                f'<a class="pin {_classes(each)}" data-kind="{each.kind.value}" href="#change-{each.number}" '
                f'title="{each.number}: {each.kind.value}" '
                f'style="left:{100 * x / width_px:.3f}%;top:{100 * y / height_px:.3f}%;'
                f'transform:translate({beside})">{each.number}</a>'
            )
    size = f'width="{width_px}" height="{height_px}"'
    many = " many" if len(changes) > _MANY else ""
    return (
        f'<figure class="swipe{many}" id="map">{_legend(changes)}<div class="scroll"><div class="stack">'
        f'<img src="{picture_uri(before.rgba)}" {size} alt="The map before" draggable="false">'
        f'<img class="after over-picture" src="{picture_uri(after.rgba)}" {size} alt="The map after" draggable="false">'
        f'<svg class="over-picture" viewBox="0 0 {width_px} {height_px}" preserveAspectRatio="none" aria-hidden="true">'
        f'{"".join(outlines)}</svg><div class="edge"></div>'
        f'<div class="date old">{escaped(before_words)}</div><div class="date new">{escaped(after_words)}</div>'
        f'{"".join(pins)}</div></div>'
        '<div class="slider"><span>before</span><input type="range" min="0" max="100" step="0.5" value="50" '
        'aria-label="Swipe between the map before and after"><span>after</span>'
        '<button type="button" value="wider" aria-label="Zoom out">&minus;</button>'
        '<button type="button" value="closer" aria-label="Zoom in">+</button></div>'
        "<figcaption>The map, left before and right after: drag the line, or use the slider and the arrow keys. "
        "Grey was never seen. A number leads to its change.</figcaption></figure>"
    )


def _legend(changes: Sequence[StoredChange]) -> str:
    kinds = Counter(each.kind for each in changes)
    boxes = [
        f'<label title="{_KIND_WORDS[kind]}"><input type="checkbox" id="show-{kind.value}" checked>'
        f'<span class="kind {kind.value}">{kind.value}</span> {kinds[kind]}</label>'
        for kind in ChangeKind if kinds[kind]
    ]
    rejected = sum(each.verdict is Verdict.REJECTED for each in changes)
    if rejected:
        boxes.append(f'<label><input type="checkbox" id="show-rejected" checked>rejected ones {rejected}</label>')
    return f'<div class="legend">{"".join(boxes)}</div>' if boxes else ""


def _overview(changes: Sequence[StoredChange], site: Site) -> str:
    if not changes:
        return ""
    unit = "" if site.is_local else " m"
    area = "" if site.is_local else " m²"
    measured = (f"size{unit}", f"area{area}", f"within{unit}")
    is_reviewed = any(each.verdict is not None for each in changes)
    names = ("", "kind", *(("verdict",) if is_reviewed else ()), "score", *measured, "views", "seen", "place", "id")
    rows = "".join(
        f'<tr class="{_classes(each)}" data-kind="{each.kind.value}">' + "".join(f"<td>{cell}</td>" for cell in (
            f'<a href="#change-{each.number}">{each.number}</a>', _kind(each),
            *((_verdict(each),) if is_reviewed else ()),
            f"{each.score:.2f}", _decimal(each.length_m), _decimal(each.area_m2), _decimal(each.sigma_m),
            str(each.views), time_words(each.first_seen_ns), _place(each, site), f"<code>{escaped(each.id)}</code>",
        )) + "</tr>"
        for each in changes
    )
    long = " long" if len(changes) > _MANY else ""
    head = "".join(f"<th>{name}</th>" for name in names)
    return (
        f'<section><h2>All changes</h2><div class="wide{long}"><table class="overview"><tr>{head}</tr>{rows}</table>'
        "</div>"
        '<p class="note">Size: the longer side. Within: one sigma of the place, per axis. Seen: the first time, UTC, '
        "or counted from the flight's start where no clock told the date. "
        "Files for other programs: changes.geojson, and the pictures in the folder changes.</p></section>"
    )


def _pairs(
    changes: Sequence[StoredChange], site: Site, crops: Mapping[str, tuple[ImageRGBA | None, ImageRGBA | None]]
) -> str:
    if not changes:
        return ""
    most_bytes = int(_CROPS_BYTES / (2 * len(changes)))
    items = "".join(_pair(each, site, crops.get(each.id, (None, None)), most_bytes) for each in changes)
    return f"<section><h2>Before and after</h2>{items}</section>"


def _pair(
    change: StoredChange, site: Site, crops: tuple[ImageRGBA | None, ImageRGBA | None], most_bytes: int
) -> str:
    pictures = "".join(
        f"<figure>{_crop(rgba, change, most_bytes)}<figcaption>{when}</figcaption></figure>"
        for when, rgba in zip(("before", "after"), crops)
    )
    facts = [
        ("score", f"{change.score:.2f}"), ("views", str(change.views)),
        ("size", _length(change.length_m, site)), ("area", _area(change.area_m2, site)),
        ("place known to", _length(change.sigma_m, site)), ("place", _place(change, site)),
        ("first seen", time_words(change.first_seen_ns)), ("last seen", time_words(change.last_seen_ns)),
    ]
    for name, class_name in (("was", change.class_before), ("is now", change.class_after)):
        if class_name:
            facts.append((name, escaped(class_name)))
    if change.kind is ChangeKind.MOVING:
        facts.append(("moves", _velocity(change.velocity_m_s, site)))
    if change.note:
        facts.append(("note", escaped(change.note)))
    listed = "".join(f"<div><dt>{name}</dt><dd>{value}</dd></div>" for name, value in facts)
    return (
        f'<article class="change {_classes(change)}" id="change-{change.number}" data-kind="{change.kind.value}">'
        f'<div class="crops">{pictures}</div><div><h3><a href="#map" title="to the map">{change.number}</a> '
        f'{_kind(change)}{_verdict(change)}</h3>'
        f'<dl class="facts">{listed}</dl></div></article>'
    )


def _crop(rgba: ImageRGBA | None, change: StoredChange, most_bytes: int) -> str:
    if rgba is None:
        return '<div class="gone">the picture is gone</div>'
    height_px, width_px = rgba.shape[:2]
    small = rgba
    if max(height_px, width_px) > _CROP_PX:
        scale = _CROP_PX / max(height_px, width_px)
        small = shrink(rgba, max(1, round(width_px * scale)), max(1, round(height_px * scale)))
    crop = change.crop
    outline_px = (change.outline_m - [crop.west_m, crop.north_m]) * [1, -1] / crop.m_per_px
    return (
        f'<img src="{picture_uri(small, most_bytes)}" alt="" loading="lazy">'
        f'<svg viewBox="0 0 {width_px} {height_px}" aria-hidden="true">{_polygons(outline_px, change)}</svg>'
    )


def _not_compared(report: Mapping[str, Any]) -> str:
    views = at(report, "comparison", "views") or {}
    reasons = at(report, "comparison", "reasons") or {}
    unknown = number_at(report, "comparison", "unknown_share")
    if not views and not reasons:
        return ""
    rows = [(status.value, escaped(views[status.value]), words) for status, words in _VIEW_WORDS.items()
            if views.get(status.value)]
    why = ""
    if reasons:
        listed = table_of([(escaped(count), escaped(reason)) for reason, count in reasons.items()], ("views", "why"))
        why = f"<h3>Reasons</h3>{listed}"
    share = "" if unknown is None else (
        f'<p class="note">On average {unknown:.1%} of a compared view was unknown: a hole in the map, its rim or the '
        "view's. Nothing is said of it, neither that it changed nor that it did not.</p>"
    )
    return (
        f"<section><h2>What was compared, and what could not be</h2>{table_of(rows, ('view', 'number', 'meaning'))}"
        f"{why}{share}{_not_reported(report)}</section>"
    )


def _not_reported(report: Mapping[str, Any]) -> str:
    """Candidates for changes that the views did not confirm, by reason."""
    rows = [
        (escaped(count), words, escaped(reason))
        for name, words in (("withdrawn", "withdrawn after being announced"), ("never_announced", "never announced"))
        for reason, count in (at(report, "comparison", "candidates", name) or {}).items()
    ]
    if not rows:
        return ""
    return f"<h3>Candidates that are not in the list</h3>{table_of(rows, ('number', 'what became of them', 'reason'))}"


def _how(report: Mapping[str, Any]) -> str:
    residual_px = number_at(report, "comparison", "residual_px", "median")
    rows = [
        ("method", escaped(at(report, "comparison", "method"))),
        ("misfit of views to the map", with_unit("{:.2f} px median", residual_px)),
        *((escaped(name), _plain(value)) for name, value in (at(report, "comparison", "chosen") or {}).items()),
    ]
    known = [(name, value) for name, value in rows if value and value != "unknown"]
    if not known:
        return ""
    return f"<section><h2>How it was compared</h2>{table_of(known)}</section>"


def _outline_px(change: StoredChange, grid: SiteGrid, shown: Picture) -> PointsPx:
    """(N, 2) the outline on the picture, counted from its outer corner."""
    pixels: Floats = (grid.grid_from_site(change.outline_m) - shown.corner_px) / shown.step_px
    return pixels


def _polygons(outline_px: PointsPx, change: StoredChange) -> str:
    simple = cv2.approxPolyDP(outline_px.astype(np.float32)[:, None], 0.3, True)[:, 0]
    points = " ".join(f"{x:.1f},{y:.1f}" for x, y in (simple if len(simple) > 2 else outline_px))
    kind = f'data-kind="{change.kind.value}"'
    return (
        f'<polygon class="halo" {kind} points="{points}"/>'
        f'<polygon class="{_classes(change)}" {kind} points="{points}"/>'
    )


def _classes(change: StoredChange) -> str:
    return change.kind.value + (" is-rejected" if change.verdict is Verdict.REJECTED else "")


def _kind(change: StoredChange) -> str:
    return f'<span class="kind {change.kind.value}">{change.kind.value}</span>'


def _verdict(change: StoredChange) -> str:
    verdict = change.verdict
    return "" if verdict is None else f'<span class="verdict {verdict.value}">{verdict.value}</span>'


def _plain(value: Any) -> str:
    """A setting as HTML text, numbers short."""
    if isinstance(value, Mapping):
        return ", ".join(f"{escaped(name)} {_plain(each)}" for name, each in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(_plain(each) for each in value)
    return f"{value:.4g}" if isinstance(value, float) else escaped(value)


def _place(change: StoredChange, site: Site) -> str:
    east_m, north_m = change.centre_m
    if site.is_local:
        return f"{east_m:.1f}, {north_m:.1f}"
    longitudes, latitudes = longitude_latitude(change.centre_m[None], site)
    return f"{latitudes[0]:.6f}, {longitudes[0]:.6f}"


def _velocity(velocity_m_s: Floats, site: Site) -> str:
    speed = float(np.hypot(*velocity_m_s))
    towards = ("north", "north-east", "east", "south-east", "south", "south-west", "west", "north-west")[
        round(float(np.arctan2(*velocity_m_s)) / (np.pi / 4)) % 8
    ]
    return f"{speed:.1f} {'units' if site.is_local else 'm'}/s to the {towards}"


def _length(value_m: float, site: Site) -> str:
    if not np.isfinite(value_m):
        return "unknown"
    return f"{value_m:.3g} units" if site.is_local else str(length_words(value_m))


def _area(value_m2: float, site: Site) -> str:
    if not np.isfinite(value_m2):
        return "unknown"
    if site.is_local:
        return f"{value_m2:.3g} units²"
    return f"{value_m2:.2g} m²" if value_m2 < 10 else area_words(value_m2)


def _decimal(value: float) -> str:
    return f"{value:.2f}" if np.isfinite(value) else "unknown"
