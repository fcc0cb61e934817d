"""How much higher changed areas lie than before, where both flights have heights."""

from collections.abc import Sequence
from dataclasses import replace

from sorvolo.heights.volumes import height_changes
from sorvolo.missions.heights.measure import flight_with_heights, own_surface, read_field
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.files import HeightFile
from sorvolo.survey.findings import Change, ChangeKind
from sorvolo.survey.flight import Notice


def with_height_changes(
    archive: Archive, flight_id: str, changes: Sequence[Change]
) -> tuple[list[Change], list[Notice]]:
    """The changes of a flight, its areas with their height change: between the newest heights of another flight and
    the flight's own, which it has if it was mapped with heights before it was compared. A notice names areas that have
    none though both flights have heights."""
    areas = [each for each in changes if each.kind is ChangeKind.AREA]
    before = flight_with_heights(archive, but=flight_id)
    later = own_surface(archive, flight_id) if areas and before is not None else None
    if before is None or later is None:
        return list(changes), []
    earlier = read_field(archive, before, HeightFile.SURFACE)
    found = height_changes(
        earlier, later, [each.outline_m for each in areas], [each.outline_m for each in changes]
    )
    risen = dict(zip((each.id for each in areas), found))
    missing = sum(each is None for each in found)
    notices = (
        []
        if not missing
        else [
            Notice(
                "no_height_change",
                missing,
                f"{missing} of {len(found)} changed areas have no height change: half of their ground has no heights on one of "
                "the dates (water, smooth or dark ground), or too little ground beside them stayed to tie both flights",
            )
        ]
    )
    return [replace(each, height_change=risen.get(each.id)) for each in changes], notices
