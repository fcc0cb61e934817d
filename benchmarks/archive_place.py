"""How long the memory of a place takes over a large archive: a generated index, in SQLite and in PostGIS.

    python benchmarks/archive_place.py [--flights 10000] [--postgres postgresql://USER@HOST/DATABASE_WITH_POSTGIS]

Flights are spread over sites as visits are: the n-th most visited site has 1/n^0.8 of the first one's flights. Each
flight is a survey of 2 to 6 strips with 70 % overlap, moved and turned a little from the last one, with some objects
and changes. Questions are asked at places that were flown, a site as often as it was flown, a third of them with a span
of time and a third for a class.
"""

import argparse
import json
import os
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import shapely

import provenance
from sorvolo.store.index.archive_index import ArchiveIndex
from sorvolo.store.index.finding import Place
from sorvolo.store.index.site_rows import FlightRows, FrameRows, PlacedRows, SiteState
from sorvolo.store.site.catalogue_place import Catalogues

RESULTS = Path(__file__).parent / "results" / "archive_place.json"
_SITES = 150
_QUESTIONS = 400
_DAY_NS = 86_400 * 10**9
_START_NS = 1_600_000_000 * 10**9
_M_PER_DEG = 111_320.0
_FRAME_M = (24.0, 13.5)  # a frame's ground from 20 m
_LABELS = ("car", "person", "small-object")


def visits(flights: int) -> list[int]:
    """How many flights each site has."""
    shares = np.arange(1, _SITES + 1) ** -0.8
    counts = np.maximum(1, np.floor(shares / shares.sum() * flights).astype(int))
    counts[0] += flights - counts.sum()
    return counts.tolist()


def origin(site: int) -> tuple[float, float]:
    """Latitude and longitude of a site: a country's worth of them, some beside each other."""
    chance = np.random.default_rng(1000 + site)
    return float(chance.uniform(46, 48)), float(chance.uniform(11, 15))


def flight(site: int, number: int, chance: np.random.Generator) -> FlightRows:
    """One survey over a site."""
    latitude, longitude = origin(site)
    scale = np.array([_M_PER_DEG * np.cos(np.radians(latitude)), _M_PER_DEG])
    strips, steps = int(chance.integers(2, 7)), int(chance.integers(8, 21))
    turn = chance.normal(0, 0.1)
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    moved_m = chance.normal(0, 15, 2)
    grid = np.array(
        [
            [step * _FRAME_M[0] * 0.3, strip * _FRAME_M[1] * 0.5]
            for strip in range(strips)
            for step in range(steps)
        ]
    )
    corners = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]) * _FRAME_M
    outlines_m = (
        grid[:, None] + corners + chance.normal(0, 0.3, (len(grid), 4, 2))
    ) @ rotation.T + moved_m
    outlines = outlines_m / scale + [longitude, latitude]
    start_ns = _START_NS + number * _DAY_NS
    count = len(grid)
    frames = FrameRows(
        tuple(map(str, range(count))),
        outlines,
        start_ns + np.arange(count) * 10**9,
        chance.uniform(0, 1, count) < 0.9,
    )
    area_m = grid.max(axis=0)
    things = chance.uniform(0, 1, (int(chance.integers(0, 12)), 2)) * area_m @ rotation.T + moved_m
    changed = chance.uniform(0, 1, (int(chance.integers(0, 6)), 2)) * area_m @ rotation.T + moved_m
    span = {"score": 0.8, "first_ns": start_ns, "last_ns": start_ns + count * 10**9}
    return FlightRows(
        f"flight-{number}",
        "1",
        "compare" if number else "map",
        frames,
        PlacedRows(
            list(shapely.points(things / scale + [longitude, latitude])),
            [
                {"object_id": f"{number}-o{k}", "label": _LABELS[k % 3], "sigma_m": 0.5, **span}
                for k in range(len(things))
            ],
        ),
        PlacedRows(
            list(
                shapely.buffer(
                    shapely.points(changed / scale + [longitude, latitude]), 2e-5, quad_segs=2
                )
            ),
            [
                {
                    "change_id": f"{number}-{k}",
                    "kind": "appeared",
                    "label": _LABELS[k % 3],
                    "verdict": "",
                    **span,
                }
                for k in range(len(changed))
            ],
        ),
    )


def fill(index: ArchiveIndex, counts: list[int], seed: int) -> None:
    """All flights of all sites."""
    chance = np.random.default_rng(seed)
    for site, count in enumerate(counts):
        rows = (flight(site, number, chance) for number in range(count))
        index.put_site(f"site-{site:03d}", SiteState(f"site {site}", False, "1", {}, {}), (), rows)
    index.tidy()


def questions(counts: list[int], seed: int) -> Iterator[tuple[str, Place]]:
    """Places that were flown, by how often."""
    chance = np.random.default_rng(seed + 1)
    sites = chance.choice(len(counts), _QUESTIONS, p=np.array(counts) / sum(counts))
    for k, site in enumerate(sites.tolist()):
        latitude, longitude = origin(site)
        east_m, north_m = chance.uniform(0, 60), chance.uniform(0, 20)
        at = (
            latitude + north_m / _M_PER_DEG,
            longitude + east_m / (_M_PER_DEG * np.cos(np.radians(latitude))),
        )
        if k % 3 == 0:
            yield "place", Place(*at)
        elif k % 3 == 1:
            first_ns = _START_NS + int(chance.integers(0, 200)) * _DAY_NS
            yield "place and time", Place(*at, first_ns=first_ns, last_ns=first_ns + 60 * _DAY_NS)
        else:
            yield "place and class", Place(*at, within_m=10.0, classes=frozenset({"car"}))


def server_process(index: ArchiveIndex) -> int:
    """The process of a PostgreSQL server on this machine that answers the index; 0 for SQLite."""
    with index.reading() as connection:
        if connection.dialect.name == "sqlite":
            return 0
        return int(connection.exec_driver_sql("SELECT pg_backend_pid()").scalar_one())


def server_busy_s(process: int) -> float:
    """Processor time of that process so far, s; 0 where it runs on another machine."""
    times = Path(f"/proc/{process}/schedstat")
    return int(times.read_text().split()[0]) / 1e9 if process and times.exists() else 0.0


def measure(
    index: ArchiveIndex, counts: list[int], seed: int
) -> tuple[dict[str, Any], list[object]]:
    """Milliseconds of each kind of question and of all; the answers, to hold those of two databases together."""
    index.find(Place(*origin(0)))  # opens the connection
    taken: dict[str, list[float]] = {}
    found: list[object] = []
    sizes = []
    server = server_process(index)
    for kind, place in questions(counts, seed):
        begun, busy, served = time.perf_counter(), time.process_time(), server_busy_s(server)
        answer = index.find(place)
        taken.setdefault(kind, []).append(1000 * (time.perf_counter() - begun))
        busy_s, served_s = time.process_time() - busy, server_busy_s(server) - served
        taken.setdefault("all, processor time of Sorvolo", []).append(1000 * busy_s)
        if server:
            taken.setdefault("all, processor time with the server's", []).append(
                1000 * (busy_s + served_s)
            )
        sizes.append(len(answer))
        found.append(
            [
                (each.site, each.flight, each.frames, [thing.id for thing in each.things])
                for each in answer
            ]
        )
    taken["all"] = [
        each for kind in list(taken) if kind.startswith("place") for each in taken[kind]
    ]
    rows = {
        kind: {
            "questions": len(times),
            **{f"p{p}_ms": round(float(np.percentile(times, p)), 2) for p in (50, 95, 99)},
            "max_ms": round(max(times), 2),
        }
        for kind, times in taken.items()
    }
    return {**rows, "flights_found": {"median": int(np.median(sizes)), "max": max(sizes)}}, found


def run(address: str, counts: list[int], seed: int) -> tuple[dict[str, Any], list[object]]:
    """One database filled and asked."""
    catalogues = Catalogues().choosing(address)
    with tempfile.TemporaryDirectory() as folder:
        with ArchiveIndex.open(
            Path(folder), write=True, address=address, catalogues=catalogues
        ) as index:
            begun = time.perf_counter()
            fill(index, counts, seed)
            filled_s = time.perf_counter() - begun
            holds = index.counts()
        print(f"filled in {filled_s:.0f} s, asking", file=sys.stderr, flush=True)
        with ArchiveIndex.open(Path(folder), write=False, catalogues=catalogues) as index:
            measured, found = measure(index, counts, seed)
        size = sum(each.stat().st_size for each in Path(folder).iterdir())
    figures = {"holds": holds, "filled_s": round(filled_s, 1), **measured}
    return ({**figures, "megabytes": round(size / 1e6, 1)} if not address else figures), found


def main() -> None:
    """Measure, compare the answers, write the results."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--flights", type=int, default=10_000)
    options.add_argument("--postgres", default="")
    options.add_argument("--out", type=Path, default=RESULTS)
    chosen = options.parse_args()
    (seed,) = provenance.drawn_seeds("archive_place", 1)
    counts = visits(chosen.flights)
    result: dict[str, Any] = {
        "machine": provenance.machine(),
        "commit": provenance.commit(),
        "seed": seed,
        "flights": chosen.flights,
        "sites": len(counts),
        "most_flights_of_a_site": max(counts),
        "load": round(os.getloadavg()[0], 1),
    }
    result["sqlite"], found = run("", counts, seed)
    if chosen.postgres:
        result["postgis"], again = run(chosen.postgres, counts, seed)
        result["same_answers"] = again == found
    chosen.out.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
