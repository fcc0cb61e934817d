"""What stands on the map, as a section of the flight's report."""

import base64
from collections.abc import Mapping
from typing import Any

from sorvolo.store.pages.words import at, escaped, finite_or_none, number_at, seconds_words, table_of

_MOST_CROP_BYTES = 250_000  # of all pictures together: the page stays one that can be mailed
_MOST_ROWS = 200

OBJECTS_STYLE = """
.crop{display:block;width:72px;height:72px;object-fit:cover;border-radius:6px}
"""


def objects_section(report: Mapping[str, Any], crops: Mapping[str, bytes]) -> str:
    """The section on a flight's objects: `report` as in report.json, `crops` JPEG pictures by id.

    Empty for a report that says nothing of objects.
    """
    told = at(report, "objects")
    if not isinstance(told, Mapping):
        return ""
    if told.get("model") is None:
        return (
            "<section><h2>What stands here</h2>"
            f"<p>Nothing was looked for: {escaped(told.get('why_not'))}.</p></section>"
        )
    rows = at(told, "list") or []
    return (
        f"<section><h2>What stands here</h2><p>{_words(told)}</p>{_table(rows, crops)}"
        f"<p class='note'>{_how(told)}</p></section>"
    )


def _words(told: Mapping[str, Any]) -> str:
    counts = [f"{count} {escaped(name)}" for name, count in (at(told, "classes") or {}).items() if count]
    if not counts:
        return f"None of {escaped(', '.join(at(told, 'looked_for') or []))} was found."
    moving = int(number_at(told, "moving") or 0)
    return f"Found: {', '.join(counts)}" + (f"; {moving} of them moved" if moving else "") + "."


def _how(told: Mapping[str, Any]) -> str:
    return (
        f"The model {escaped(told.get('model'))} looked at {escaped(told.get('frames'))} frames and saw "
        f"{escaped(told.get('sightings'))} times something, {escaped(told.get('dropped'))} of them in too few of the "
        f"frames that show the place: these are left out. It took {seconds_words(number_at(told, 'seconds'))} beside "
        "the mapping. The list as a file: objects.geojson; the pictures: objects/."
    )


def _table(rows: list[Mapping[str, Any]], crops: Mapping[str, bytes]) -> str:
    if not rows:
        return ""
    left, cells = _MOST_CROP_BYTES, []
    for row in rows[:_MOST_ROWS]:
        crop = crops.get(str(row.get("id")), b"")
        left -= len(crop)
        cells.append((
            _picture(crop) if left > 0 else "", escaped(row.get("id")),
            escaped(row.get("class")) + (", moving" if row.get("moving") else ""), _share(row.get("score")),
            _place(row), _size(row), f"{escaped(row.get('views'))} of {escaped(row.get('possible_views'))}",
        ))
    more = f"<p>and {len(rows) - _MOST_ROWS} more in objects.geojson</p>" if len(rows) > _MOST_ROWS else ""
    return table_of(cells, ("", "id", "class", "score", "east, north", "size", "views")) + more


def _picture(crop: bytes) -> str:
    if not crop:
        return ""
    return f'<img class="crop" alt="" src="data:image/jpeg;base64,{base64.b64encode(crop).decode()}">'


def _share(value: Any) -> str:
    score = finite_or_none(value)
    return "" if score is None else f"{score:.2f}"


def _place(row: Mapping[str, Any]) -> str:
    east, north, sigma = (finite_or_none(row.get(name)) for name in ("east_m", "north_m", "sigma_m"))
    if east is None or north is None:
        return ""
    within = "" if sigma is None else f" \u00b1 {sigma:.1f}"
    return f'<span class="whole">{east:+.1f}, {north:+.1f}{within} m</span>'


def _size(row: Mapping[str, Any]) -> str:
    length, width = finite_or_none(row.get("length_m")), finite_or_none(row.get("width_m"))
    return "" if length is None or width is None else f'<span class="whole">{length:.1f} x {width:.1f} m</span>'
