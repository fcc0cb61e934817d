"""The register in the catalogue: what changes one flight's sightings costs what can differ by it, and no more."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sqlalchemy import Connection, create_engine, delete, insert, select

from sorvolo.findings.register import associate
from sorvolo.store.exports.plain import plain_json
from sorvolo.store.site import register, schema
from sorvolo.store.site.register import load_findings, register_flights

DAY_NS = 86_400 * 10**9
LOOK_M = np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]])


@contextmanager
def catalogue() -> Iterator[Connection]:
    with create_engine("sqlite://").begin() as connection:
        schema.make_tables(connection)
        yield connection


def fly(connection: Connection, day: int, at_m: float, seen: list[tuple[float, str]]) -> None:
    """A flight that looks at 60 m from `at_m` on, and sees objects and changes there: east, kind ("" an object)."""
    flight, start_ns = f"flight{day}", (day + 1) * DAY_NS
    ranks = {"id": flight, "rank": day}
    if not connection.execute(select(schema.flights).where(schema.flights.c.rank == day)).all():
        connection.execute(insert(schema.flights).values(ranks))
    connection.execute(delete(schema.runs).where(schema.runs.c.flight_id == flight))
    for name in ("objects", "changes", "searches"):  # no foreign keys here
        table = schema.metadata.tables[name]
        connection.execute(delete(table).where(table.c.run_id == day))
    texts = dict.fromkeys(("fingerprint", "started_utc", "finished_utc", "method"), "")
    plain = {"id": day, "status": "complete", "settings": {}, "frames": {}, "notes": []}
    connection.execute(
        insert(schema.runs).values(flight_id=flight, files_written=True, **plain, **texts)
    )
    outlines_m = (LOOK_M * 30 + [at_m + 30, 0]) + np.zeros((2, 1, 1))
    row = {"run_id": day, "model": "m", "outlines_m": outlines_m.tolist(), "searched_for": None}
    schema.add_rows(connection, schema.searches, [row])
    for number, (east_m, kind) in enumerate(seen, 1):
        place_m = np.array([at_m + east_m, 0.0])
        times = {"first_seen_ns": start_ns, "last_seen_ns": start_ns + 10**9, "views": 3}
        sizes = {"length_m": 4.4, "sigma_m": 0.3, "score": 0.8, "velocity_m_s": [0.0, 0.0]}
        facts: dict[str, Any] = {**times, **sizes}
        if kind:
            table, own = schema.changes, {"kind": kind}
            facts |= {"outline_m": place_m + LOOK_M, "area_m2": 4.0, "sigma_in_map_m": 0.1}
            facts |= {"class_before": "car", "class_after": "car", "announced_ns": start_ns}
            facts |= {"height_change": None}
            facts["crop"] = dict.fromkeys(("west_m", "north_m", "m_per_px"), 1.0)
            facts["crop"] |= {"width_px": 1, "height_px": 1}
        else:
            table, own = schema.objects, {}
            facts |= {"label": "car", "position_m": place_m, "width_m": 1.8, "possible_views": 3}
        row = {"run_id": day, "number": number, "id": f"{flight}-{kind and 'c'}{number}", **own}
        schema.add_rows(connection, table, [{**row, "properties": plain_json(facts)}])


def reject(connection: Connection, change_id: str) -> None:
    (row,) = connection.execute(select(schema.changes).where(schema.changes.c.id == change_id))
    row = {
        "change_id": change_id,
        "flight_id": change_id.split("-")[0],
        "verdict": "rejected",
        "at_utc": "",
        "note": "",
        "kind": row.kind,
        "outline_m": row.properties["outline_m"],
    }
    schema.add_rows(connection, schema.reviews, [row])


def rows(findings: Any) -> list[Any]:
    return sorted((register._row_of(each) for each in findings), key=lambda row: str(row["id"]))


PLACES = st.lists(
    st.tuples(
        st.integers(0, 20).map(lambda each: 3.0 * each) | st.floats(0, 60),
        st.sampled_from(["", "", "", "appeared", "disappeared", "replaced"]),
    ),
    max_size=6,
)
FLIGHTS = st.lists(
    st.tuples(st.sampled_from([0.0, 0.4, 45.0, 200.0]), PLACES), min_size=2, max_size=7
)


@settings(max_examples=40, deadline=None)
@given(FLIGHTS, st.data())
def test_votes_and_flights_run_again_come_to_what_all_anew_come_to(
    flights: list[tuple[float, list[tuple[float, str]]]], data: st.DataObject
) -> None:
    with catalogue() as connection:
        for day, (at_m, seen) in enumerate(flights):
            fly(connection, day, at_m, seen)
            register_flights(connection, {f"flight{day}"})
        assert rows(load_findings(connection)) == rows(
            associate(*register._seen(connection)).findings
        )
        ids = list(connection.execute(select(schema.changes.c.id)).scalars())
        for change_id in data.draw(st.lists(st.sampled_from(ids), unique=True)) if ids else ():
            reject(connection, change_id)
            register_flights(connection, {change_id.split("-")[0]})
            whole = associate(*register._seen(connection)).findings
            assert rows(load_findings(connection)) == rows(whole)
        day = data.draw(st.integers(0, len(flights) - 1))
        fly(connection, day, *data.draw(st.tuples(st.sampled_from([0.0, 60.0]), PLACES)))
        register_flights(connection, {f"flight{day}"})
        assert rows(load_findings(connection)) == rows(
            associate(*register._seen(connection)).findings
        )


def test_a_vote_reads_no_flight_that_cannot_differ_by_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of forty flights, those that were elsewhere, came earlier, or came when the thing was gone."""
    with catalogue() as connection:
        for day in range(40):
            seen = [(10.0, ""), (20.0, "")] if day < 30 else [(10.0, "")]
            seen += [(40.0, "appeared")] if day == 24 else []
            fly(connection, day, 500.0 * (day % 4), seen)
            register_flights(connection, {f"flight{day}"})
        read: list[str] = []
        seen_by = register._seen

        def counted(connection: Connection, flights: set[str], *others: Any) -> Any:
            read.extend(flights)
            return seen_by(connection, flights, *others)

        monkeypatch.setattr(register, "_seen", counted)
        reject(connection, "flight24-c3")
        register_flights(connection, {"flight24"})
        assert read == ["flight24", "flight25", "flight28"]
