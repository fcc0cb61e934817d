"""`sorvolo history` and `sorvolo review`: a map's versions, and people's verdicts on its changes."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape

from sorvolo.cli.options import (
    AsJson,
    OnlyFlight,
    PlaceFormat,
    PlaceFormatOption,
    SiteArgument,
    argument,
    option,
)
from sorvolo.cli.printing import Console, new_table, place_heading, place_words, print_json, site_of
from sorvolo.cli.sites import opened_site
from sorvolo.errors import SettingsError
from sorvolo.survey.wording import counted

if TYPE_CHECKING:
    from sorvolo.missions.site.history import HistoryEntry
    from sorvolo.store.site.change_records import StoredChange
    from sorvolo.survey.flight import Site

_COLOURS = {"confirmed": "green", "rejected": "red"}


def history(
    site: SiteArgument,
    at: Annotated[
        str | None,
        option("Version number, or a date or time (UTC): the newest version by then."),
    ] = None,
    export: Annotated[
        Path | None,
        option(
            "Write the map as it was: FILE.tif, .png, .kmz, .mbtiles or .pdf; or its heights: .laz."
        ),
    ] = None,
    coordinates: PlaceFormatOption = "latlon",
    as_json: AsJson = False,
) -> None:
    """List the versions of a map, or write the map as it was at one of them.

    Example: sorvolo history field

    Example: sorvolo history field --at 2026-05-31 --export may.tif
    """
    from sorvolo.geometry.coordinates import Coordinates, place_text
    from sorvolo.missions.site.history import came_and_left, export_version, site_history

    if at is not None and export is None:
        raise SettingsError(
            "--at chooses the map to write: give --export FILE.tif (or .png, .kmz, .mbtiles, .pdf, .laz) as well"
        )
    with opened_site(site) as place:
        folder = str(place.folder)
        entries = site_history(place.folder)
        if export is not None:
            version = export_version(place.folder, at, export)
            entry = next(entry for entry in entries if entry.version == version.id)
            words = (
                f"{export}: version {version.id}, flight {version.flight_id}, {version.created_utc}"
            )
            plain = {"site": folder, "file": str(export), "version": entry}
            print_json(plain) if as_json else typer.echo(words)
            return
        if as_json:
            print_json({"site": folder, "versions": entries})
            return
        console = Console()
        _show_versions(entries, console)
        if words := came_and_left(place.folder):
            console.print(words, soft_wrap=True)
        if entries and not (of_map := site_of(place.folder)).is_local:
            origin = of_map.origin
            written = place_text(
                origin.latitude_deg, origin.longitude_deg, Coordinates(coordinates)
            )
            console.print(f"the map's origin lies at {written}")


def _show_versions(entries: Sequence["HistoryEntry"], console: Console) -> None:
    if not entries:
        console.print("no map yet: sorvolo map makes one")
        return
    # 80 letters hold it; folded between words, never within: "2 disappeared", "2026-11-22"
    table = new_table(
        *("no", "flown", "complete (UTC)", "flight", "by", "tiles", "MB", "changes", "reviewed"),
        whole=("no", "flown", "tiles", "MB"),
        widths={"complete (UTC)": 10, "changes": 13, "reviewed": 11, "by": 7},
        is_tight=True,
    )
    for entry in entries:
        table.add_row(*_cells(entry))
    console.print(table)
    console.print("tiles: new or changed, of all; MB: written for this version", style="dim")


def _cells(entry: "HistoryEntry") -> tuple[str, ...]:
    """One version's row of the list."""
    removed = f" (-{entry.tiles_removed})" if entry.tiles_removed else ""
    changes = "\n".join(f"{count} {kind}" for kind, count in entry.changes.items())
    verdicts = ("confirmed", entry.confirmed), ("rejected", entry.rejected)
    again = " (repeated later)" if entry.is_replaced else ""
    return (
        str(entry.version),
        entry.flown_utc[:10] or "-",
        entry.date_utc[:16].replace("T", " "),
        escape(entry.flight) + again,
        entry.kind,
        f"{entry.tiles_changed}/{entry.tiles}{removed}",
        f"{entry.bytes_changed / 1e6:.1f}",
        changes or ("none" if entry.kind == "compare" else ""),
        "\n".join(f"{count} {word}" for word, count in verdicts if count),
    )


def review(
    site: SiteArgument,
    ids: Annotated[
        list[str] | None,
        argument(
            "Changes to judge: their ids, or numbers with --flight.",
            show_default="list all changes",
        ),
    ] = None,
    confirm: Annotated[bool, option("These changes are real.", "--confirm")] = False,
    reject: Annotated[
        bool,
        option("These are no changes; later flights will not report them again.", "--reject"),
    ] = False,
    note: Annotated[str, option("Why, in your own words.")] = "",
    flight: OnlyFlight = None,
    coordinates: PlaceFormatOption = "latlon",
    as_json: AsJson = False,
) -> None:
    """List the changes that flights found, or confirm or reject some.

    Example: sorvolo review field

    Example: sorvolo review field DJI_0043-3 DJI_0043-7 --reject --note "shadows"
    """
    from sorvolo.missions.site.review import list_changes, review_changes
    from sorvolo.survey.findings import Verdict

    if confirm and reject:
        raise SettingsError("--confirm and --reject contradict each other; give one of them")
    if ids and not (confirm or reject):
        raise SettingsError("changes were named, but no verdict: give --confirm or --reject")
    if not ids and (confirm or reject or note):
        raise SettingsError("which changes? give the ids that `sorvolo review SITE` lists")
    with opened_site(site, writes=bool(ids)) as place:
        if ids:
            verdict = Verdict.CONFIRMED if confirm else Verdict.REJECTED
            changes = review_changes(place.folder, ids, verdict, note, flight=flight)
        else:
            changes = list_changes(place.folder, flight)
        place_of = site_of(place.folder)
        if as_json:
            rows = [_plain(change, place_of) for change in changes]
            print_json({"site": str(place.folder), "changes": rows})
        else:
            _show_changes(changes, place_of, coordinates, Console())


def _show_changes(
    changes: Sequence["StoredChange"], site: "Site", form: PlaceFormat, console: Console
) -> None:
    from sorvolo.store.exports.plain import time_words

    if not changes:
        console.print(
            "no changes: none were found, or no flight was compared yet (sorvolo compare)"
        )
        return
    # 80 letters hold the table, no word is cut
    place, place_name = place_words(site, form), place_heading(site.is_local, form)
    length = f"length {'units' if site.is_local else 'm'}"
    table = new_table(
        *("id", "kind", place_name, length, "score", "first seen (UTC)", "verdict"),
        whole=("id", "kind", place_name),
        widths={"first seen (UTC)": 10, "verdict": 9},
        is_tight=True,
    )
    for change in changes:
        verdict = ""
        if change.verdict is not None:
            colour = _COLOURS[change.verdict]
            verdict = f"[{colour}]{change.verdict.value}[/{colour}]" + (
                f": {escape(change.note)}" if change.note else ""
            )
        table.add_row(
            escape(change.id),
            change.kind.value,
            place(change.centre_m),
            f"{change.length_m:.2f}",
            f"{change.score:.2f}",
            time_words(change.first_seen_ns),
            verdict,
        )
    console.print(table)
    judged = sum(change.verdict is not None for change in changes)
    console.print(
        f"{counted(len(changes), 'change')}, {judged} reviewed; score: 0 to 1, how sure",
        style="dim",
    )


def _plain(change: "StoredChange", site: "Site") -> dict[str, Any]:
    """A change as its flight's changes.geojson has it, but for its rank, with flight and place."""
    from sorvolo.store.exports.change_files import changes_geojson
    from sorvolo.store.exports.places import place_deg

    (shown,) = changes_geojson([change], site)["features"]
    longitude, latitude = (None, None) if site.is_local else place_deg(change.centre_m, site)
    place = {"flight": change.flight_id, "latitude": latitude, "longitude": longitude}
    known = shown["properties"]
    return place | {name: known[name] for name in known if name not in ("rank", "group")}
