"""The objects on the map, as a section of the flight's report."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from markupsafe import Markup

from sorvolo.store.exports.places import SYSTEMS, place_words
from sorvolo.store.pages.render import render
from sorvolo.store.pages.words import (
    at,
    finite_or_none,
    jpeg_uri,
    known,
    number_at,
    plural,
    seconds_words,
)
from sorvolo.survey.flight import Site
from sorvolo.survey.wording import counted_list

_MOST_CROP_BYTES = 250_000  # of all pictures together: the page stays one that can be mailed
_MOST_ROWS = 200  # more belong into a table of their own: the page names the file


def objects_section(
    report: Mapping[str, Any], crops: Mapping[str, bytes], site: Site | None = None
) -> Markup:
    """The section on a flight's objects: `report` as in report.json, `crops` JPEG pictures by id.

    `site` gives the places their coordinates; without it they are metres east and north of the site's origin. Empty
    for a report without objects.
    """
    search = at(report, "objects")
    if not isinstance(search, Mapping):
        return Markup("")
    why_not = known(search.get("why_not")) if search.get("model") is None else None
    rows = at(search, "list") or []
    is_local = site.is_local if site is not None else not report.get("georeferenced", True)
    return render(
        "objects.html",
        why_not=why_not,
        words=_words(search),
        rows=_rows(rows[:_MOST_ROWS], crops, site),
        more=max(0, len(rows) - _MOST_ROWS),
        has_metres=not is_local,
        how=_how(search, is_local),
        systems=() if site is None or is_local else tuple(SYSTEMS.items()),
        file="objects.json" if is_local else "objects.geojson",
    )


def _words(search: Mapping[str, Any]) -> str:
    counts = at(search, "classes") or {}
    if not any(counts.values()):
        return f"No {' and no '.join(map(str, at(search, 'looked_for') or ['object']))} was found."
    moving = int(number_at(search, "moving") or 0)
    return (
        f"Objects found: {counted_list(counts)}"
        + (f"; {moving} of them moved" if moving else "")
        + "."
    )


def _how(search: Mapping[str, Any], is_local: bool) -> str:
    files = "objects.json" if is_local else "objects.geojson, objects.kml, objects.gpx"
    return (
        f"The model {known(search.get('model'))} searched {known(search.get('frames'))} frames and made "
        f"{plural(number_at(search, 'sightings') or 0, 'detection')}. {known(search.get('dropped'))} of them are left "
        "out: too few of the frames that show the place confirm them. The search took "
        f"{seconds_words(number_at(search, 'seconds'))}, beside the mapping. Files: {files}, and the pictures in "
        "objects/."
    )


def _rows(
    rows: list[Mapping[str, Any]], crops: Mapping[str, bytes], site: Site | None
) -> list[dict[str, Any]]:
    left, listed = _MOST_CROP_BYTES, []
    for row in rows:
        crop = crops.get(str(row.get("id")), b"")
        left -= len(crop)
        score, sigma_m = finite_or_none(row.get("score")), finite_or_none(row.get("sigma_m"))
        listed.append(
            {
                "crop": jpeg_uri(crop) if crop and left > 0 else "",
                "id": known(row.get("id")),
                "name": known(row.get("class")) + (", moving" if row.get("moving") else ""),
                "place": _place(row, site),
                "accuracy": "" if sigma_m is None else f"{sigma_m:.1f} m",
                "size": _size(row),
                "frames": f"{known(row.get('views'))} of {known(row.get('possible_views'))}",
                "score": "" if score is None else f"{score:.2f}",
            }
        )
    return listed


def _place(row: Mapping[str, Any], site: Site | None) -> list[tuple[str, str]]:
    east, north = finite_or_none(row.get("east_m")), finite_or_none(row.get("north_m"))
    if east is None or north is None:
        return []
    if site is None:
        return [("site", f"{east:+.1f}, {north:+.1f}")]
    return list(place_words(np.array([east, north]), site).items())


def _size(row: Mapping[str, Any]) -> str:
    length, width = finite_or_none(row.get("length_m")), finite_or_none(row.get("width_m"))
    return "" if length is None or width is None else f"{length:.1f} x {width:.1f} m"
