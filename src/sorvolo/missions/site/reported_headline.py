"""The first line of what a site reports of a flight's map."""

from pathlib import Path

from sorvolo.store.site.archive import Archive


def reported_headline(site: Path, flight: str) -> tuple[str, bool]:
    """The first line of the report of a flight's map, and whether it is a map to use."""
    with Archive.open(site, write=False) as archive:
        head = archive.report(flight).get("headline") or {}
    return str(head.get("text", "")), head.get("quality") == "map"
