"""`sorvolo review`: the changes that flights found, and what a person says of them."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from sorvolo.cli.compare import unit_of
from sorvolo.errors import SettingsError

if TYPE_CHECKING:
    from sorvolo.store.site.change_records import StoredChange

_COLOURS = {"confirmed": "green", "rejected": "red"}


def review(
    site: Annotated[Path, typer.Argument(help="The site folder.")],
    ids: Annotated[
        list[str] | None, typer.Argument(help="Changes: ids, or numbers with --flight; none: list them.")
    ] = None,
    confirm: Annotated[bool, typer.Option("--confirm", help="They are real.")] = False,
    reject: Annotated[
        bool, typer.Option("--reject", help="They are not; they do not come back in later flights.")
    ] = False,
    note: Annotated[str, typer.Option(help="Why, in words.")] = "",
    flight: Annotated[str | None, typer.Option(help="Of this flight only.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
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
        raise SettingsError("what is to be said of them? give --confirm or --reject")
    if not ids and (confirm or reject or note):
        raise SettingsError("of which changes? give the ids that `sorvolo review SITE` lists")
    if ids:
        verdict = Verdict.CONFIRMED if confirm else Verdict.REJECTED
        changes = review_changes(site, ids, verdict, note, flight=flight)
    else:
        changes = list_changes(site, flight)
    if as_json:
        typer.echo(json.dumps({"site": str(site), "changes": [_plain(each) for each in changes]}, indent=1))
    else:
        _show(changes, unit_of(site), Console())


def _show(changes: Sequence["StoredChange"], unit: str, console: Console) -> None:
    from sorvolo.store.exports.plain import time_words

    if not changes:
        console.print("no changes were found, or no flight was compared yet")
        return
    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for name in ("id", "kind", "score", f"size {unit}", "views", "first seen (UTC)", "verdict"):
        table.add_column(name, no_wrap=name != "verdict", overflow="fold")
    for each in changes:
        verdict = ""
        if each.verdict is not None:
            colour = _COLOURS[each.verdict]
            verdict = f"[{colour}]{each.verdict.value}[/{colour}]" + (f": {escape(each.note)}" if each.note else "")
        table.add_row(
            escape(each.id), each.kind.value, f"{each.score:.2f}", f"{each.length_m:.2f}", str(each.views),
            time_words(each.first_seen_ns), verdict,
        )
    console.print(table)


def _plain(change: "StoredChange") -> dict[str, Any]:
    from sorvolo.store.exports.plain import utc_text

    return {
        "id": change.id, "flight": change.flight_id, "number": change.number, "kind": change.kind.value,
        "score": change.score, "first_seen": utc_text(change.first_seen_ns), "last_seen": utc_text(change.last_seen_ns),
        "views": change.views, "east_m": float(change.centre_m[0]), "north_m": float(change.centre_m[1]),
        "review": None if change.verdict is None else change.verdict.value, "note": change.note,
    }
