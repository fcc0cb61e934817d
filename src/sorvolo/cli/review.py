"""`sorvolo review`: the changes that flights found, and a person's verdicts on them."""

import json
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from sorvolo.cli.options import AsJson, PlaceFormat, PlaceFormatOption
from sorvolo.cli.places import place_heading, place_words
from sorvolo.cli.places_of_sites import SiteArgument, opened_site
from sorvolo.cli.shown import site_of, unit_of
from sorvolo.errors import SettingsError
from sorvolo.survey.wording import counted

if TYPE_CHECKING:
    from sorvolo.store.site.change_records import StoredChange
    from sorvolo.survey.flight import Site

_COLOURS = {"confirmed": "green", "rejected": "red"}


def review(
    site: SiteArgument,
    ids: Annotated[
        list[str] | None,
        typer.Argument(
            help="Changes to judge: their ids, or numbers with --flight.",
            show_default="list all changes",
        ),
    ] = None,
    confirm: Annotated[bool, typer.Option("--confirm", help="These changes are real.")] = False,
    reject: Annotated[
        bool,
        typer.Option(
            "--reject", help="These are no changes; later flights will not report them again."
        ),
    ] = False,
    note: Annotated[str, typer.Option(help="Why, in your own words.")] = "",
    flight: Annotated[str | None, typer.Option(help="Only changes of this flight.")] = None,
    coordinates: PlaceFormatOption = PlaceFormat.LATLON,
    as_json: AsJson = False,
) -> None:
    """List the changes that flights found, or confirm or reject some.

    Example: sorvolo review field

    Example: sorvolo review field DJI_0043-3 DJI_0043-7 --reject --note "shadows"
    """
    from sorvolo.missions.site.review import list_changes, review_changes
    from sorvolo.survey.findings import Verdict

    _demand_whole_verdict(ids, confirm, reject, note)
    with opened_site(site, writes=bool(ids)) as place:
        if ids:
            verdict = Verdict.CONFIRMED if confirm else Verdict.REJECTED
            changes = review_changes(place.folder, ids, verdict, note, flight=flight)
        else:
            changes = list_changes(place.folder, flight)
        place_of = site_of(place.folder)
        if as_json:
            rows = [_plain(each, place_of) for each in changes]
            typer.echo(json.dumps({"site": str(place.folder), "changes": rows}, indent=1))
        else:
            _show(changes, place_of, coordinates, Console())


def _demand_whole_verdict(ids: list[str] | None, confirm: bool, reject: bool, note: str) -> None:
    """Raises SettingsError where changes are named without one verdict, or a verdict without changes."""
    if confirm and reject:
        raise SettingsError("--confirm and --reject contradict each other; give one of them")
    if ids and not (confirm or reject):
        raise SettingsError("changes were named, but no verdict: give --confirm or --reject")
    if not ids and (confirm or reject or note):
        raise SettingsError("which changes? give the ids that `sorvolo review SITE` lists")


def _show(
    changes: Sequence["StoredChange"], site: "Site", form: PlaceFormat, console: Console
) -> None:
    from sorvolo.store.exports.plain import time_words

    if not changes:
        console.print(
            "no changes: none were found, or no flight was compared yet (sorvolo compare)"
        )
        return
    table, place = (
        Table(box=SIMPLE_HEAD, padding=0),
        place_words(site, form),
    )  # 80 letters hold it, no word cut
    place_name = place_heading(site.is_local, form)
    for name in (
        "id",
        "kind",
        place_name,
        f"length {unit_of(site)}",
        "score",
        "first seen (UTC)",
        "verdict",
    ):
        table.add_column(
            name,
            no_wrap=name in ("id", "kind", place_name),
            overflow="fold",
            min_width={"first seen (UTC)": 10, "verdict": 9}.get(name),
        )
    for each in changes:
        verdict = ""
        if each.verdict is not None:
            colour = _COLOURS[each.verdict]
            verdict = f"[{colour}]{each.verdict.value}[/{colour}]" + (
                f": {escape(each.note)}" if each.note else ""
            )
        table.add_row(
            escape(each.id),
            each.kind.value,
            place(each.centre_m),
            f"{each.length_m:.2f}",
            f"{each.score:.2f}",
            time_words(each.first_seen_ns),
            verdict,
        )
    console.print(table)
    judged = sum(each.verdict is not None for each in changes)
    console.print(
        f"{counted(len(changes), 'change')}, {judged} reviewed; score: 0 to 1, how sure",
        style="dim",
    )


def _plain(change: "StoredChange", site: "Site") -> dict[str, Any]:
    from sorvolo.store.exports.plain import utc_text

    latitude, longitude, _ = site.frame.wgs84_from_site(change.centre_m[None])
    on_earth = (
        {} if site.is_local else {"latitude": float(latitude[0]), "longitude": float(longitude[0])}
    )
    return {
        "id": change.id,
        "flight": change.flight_id,
        "number": change.number,
        "kind": change.kind.value,
        "score": change.score,
        "first_seen": utc_text(change.first_seen_ns),
        "last_seen": utc_text(change.last_seen_ns),
        "views": change.views,
        "east_m": float(change.centre_m[0]),
        "north_m": float(change.centre_m[1]),
        **on_earth,
        "review": None if change.verdict is None else change.verdict.value,
        "note": change.note,
    }
