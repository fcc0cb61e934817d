"""What 10,000 live streams and an archive of a petabyte need and cost, by measured unit costs and stated assumptions.

python benchmarks/scale.py [NAME=VALUE...]

Reads results/unit_costs.json and results/station.json, and prints the tables of docs/scale.md in Markdown. Every
assumption can be changed: `python benchmarks/scale.py core_hour_eur=0.04 streams=500`. Machines are counted by what
runs out first: cores, memory or network.
"""

import argparse
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import ceil
from pathlib import Path
from typing import Any

RESULTS = Path(__file__).parent / "results"
ASSUMPTIONS: dict[str, tuple[float, str]] = {
    "streams": (10_000, "drones that send at the same time"),
    "stream_fps": (30, "frames a second of each stream, all decoded"),
    "stream_mbit_s": (4, "of H.264 at 1080p and 30 frames a second"),
    "searched_hz": (2, "frames searched a second of each stream (`watch --fps 2`)"),
    "compared_hz": (5, "views compared a second of each stream (the default)"),
    "mapped_hz": (1, "key frames a second of each stream: 70 % overlap at 40 m and 10 m/s"),
    "archive_tb": (1_000, "of photos: one petabyte"),
    "photo_megapixels": (9, "of a photo: a size that was measured"),
    "photo_mb": (3.5, "of a photo of 9 megapixels"),
    "photos_per_flight": (400, "of a survey"),
    "years": (5, "that the archive is kept"),
    "machine_cores": (64, "of a server, as fast as the core that was measured"),
    "machine_gb": (256, "memory of a server"),
    "machine_gbit_s": (25, "network of a server"),
    "used_share": (0.7, "of a machine that is planned with"),
    "core_hour_eur": (0.02, "price of a core for an hour, its memory, power and room included"),
    "tb_month_eur": (5, "price of a terabyte in an object store for a month"),
    "put_million_eur": (5, "price of a million objects written into a store"),
    "gbit_month_eur": (300, "price of one Gbit/s of incoming network for a month"),
    "hours_a_month": (730, "a stream that never ends; a working fleet has a tenth"),
    "disk_gb_s": (1, "read from a store by one reader"),
}
"""By name: the value, and what it is. Prices are assumptions of 2026, not offers."""


@dataclass(frozen=True)
class Need:
    """What one kind of work needs: cores at once, memory, MB, incoming Mbit/s."""

    name: str
    cores: float
    memory_mb: float
    mbit_s: float = 0.0


def main() -> None:
    """Read, compute, print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("values", nargs="*", help="assumptions as NAME=VALUE")
    options = parser.parse_args()
    given = {name: value for name, (value, _) in ASSUMPTIONS.items()} | changed(
        parser, options.values
    )
    costs = json.loads((RESULTS / "unit_costs.json").read_text())["rows"]
    if f"photo, {given['photo_megapixels']:g} MP: map" not in costs:
        parser.error(
            f"photos of {given['photo_megapixels']:g} megapixels were not measured: {', '.join(costs)} were"
        )
    station = json.loads((RESULTS / "station.json").read_text())
    print("### Assumptions\n")
    print(
        table(
            ("name", "value", "what"),
            ((name, f"{given[name]:g}", ASSUMPTIONS[name][1]) for name in ASSUMPTIONS),
        )
    )
    print("### Unit costs\n")
    print(
        table(
            ("mission", "processor s", "start, s", "peak memory, MB", "kept, kB", "files"),
            unit_rows(costs),
        )
    )
    print(f"### {given['streams']:,.0f} live streams\n")
    names = (
        "work on each stream",
        "cores a stream",
        "cores",
        "memory, TB",
        "network, Gbit/s",
        "machines",
        "runs out first",
        "EUR a month",
    )
    print(table(names, (stream_row(each, given) for each in stream_needs(costs, station, given))))
    print(f"### {given['archive_tb']:,.0f} TB of photos\n")
    print(table(("what", "figure"), archive_rows(costs, given)))


def changed(parser: argparse.ArgumentParser, values: Iterable[str]) -> dict[str, float]:
    """The assumptions that were given."""
    found = {}
    for text in values:
        name, _, value = text.partition("=")
        if name not in ASSUMPTIONS:
            parser.error(f"no assumption {name!r}; there are {', '.join(ASSUMPTIONS)}")
        found[name] = float(value)
    return found


def unit_rows(costs: Mapping[str, Any]) -> Iterable[Sequence[str]]:
    """The measured costs of a frame or a photo."""
    for name, row in costs.items():
        yield (
            name,
            f"{row['cpu_s']:.2f}",
            f"{max(0.0, row['start_cpu_s']):.0f}",
            f"{row['peak_mb']:,.0f}",
            f"{row['bytes'] / 1000:,.0f}",
            f"{row['files']:.1f}",
        )


def stream_needs(
    costs: Mapping[str, Any], station: Mapping[str, Any], given: Mapping[str, float]
) -> list[Need]:
    """What the station takes for a stream, and each mission beside it, in a process of its own."""
    cores = station["map"]["station_cpu_s"] / station["seconds"]
    taken = Need("taken in, kept, one viewer", cores, 0.0, given["stream_mbit_s"])
    missions = (
        ("watched", "video: watch", given["searched_hz"]),
        ("compared", "video: compare", given["compared_hz"]),
        ("mapped", "video: map", given["mapped_hz"]),
    )
    needs = [taken]
    decoded = given["stream_fps"] * costs["video: decode"]["cpu_s"]
    for words, name, rate_hz in missions:
        cores = taken.cores + decoded + rate_hz * costs[name]["cpu_s"]
        needs.append(Need(f"taken in and {words}", cores, costs[name]["peak_mb"], taken.mbit_s))
    return needs


def stream_row(need: Need, given: Mapping[str, float]) -> Sequence[str]:
    """One kind of work on all streams."""
    streams, used = given["streams"], given["used_share"]
    cores, memory_gb = streams * need.cores, streams * need.memory_mb / 1000
    gbit_s = streams * need.mbit_s / 1000
    machines = {
        "cores": cores / (used * given["machine_cores"]),
        "memory": memory_gb / (used * given["machine_gb"]),
        "network": gbit_s / (used * given["machine_gbit_s"]),
    }
    most = max(machines, key=lambda name: machines[name])
    count = ceil(machines[most])
    eur = count * given["machine_cores"] * given["core_hour_eur"] * given["hours_a_month"]
    eur += gbit_s * given["gbit_month_eur"]
    return (
        need.name,
        f"{need.cores:.2f}",
        f"{cores:,.0f}",
        f"{memory_gb / 1000:.1f}",
        f"{gbit_s:.0f}",
        f"{count:,}",
        most,
        f"{eur:,.0f}",
    )


def archive_rows(costs: Mapping[str, Any], given: Mapping[str, float]) -> Iterable[Sequence[str]]:
    """An archive's photos mapped once, and kept."""
    photos = given["archive_tb"] * 1e6 / given["photo_mb"]
    prefix = f"photo, {given['photo_megapixels']:g} MP"
    yield (
        "photos",
        f"{photos / 1e6:,.0f} million, {photos / given['photos_per_flight'] / 1e6:.2g} million flights",
    )
    for mission in ("map", "map with objects", "heights", "compare", "watch"):
        row = costs.get(f"{prefix}: {mission}")
        if row is not None:
            hours = photos * row["cpu_s"] / 3600
            machines = hours / (24 * 30 * given["machine_cores"] * given["used_share"])
            yield (
                f"{mission} once",
                f"{hours:,.0f} core hours: {ceil(machines):,} machines for 30 days, "
                f"{hours * given['core_hour_eur']:,.0f} EUR",
            )
    mapped = costs[f"{prefix}: map"]
    kept_tb, files_m = photos * mapped["bytes"] / 1e12, photos * mapped["files"] / 1e6
    months = 12 * given["years"]
    puts_eur = files_m * given["put_million_eur"]
    yield "maps beside the photos", f"{kept_tb:,.0f} TB in {files_m:,.0f} million files"
    yield "these files written into an object store", f"{puts_eur:,.0f} EUR"
    total_tb = given["archive_tb"] + kept_tb
    eur = total_tb * given["tb_month_eur"] * months
    yield "kept", f"{total_tb:,.0f} TB, {eur:,.0f} EUR in {given['years']:g} years"
    days = given["archive_tb"] * 1000 / given["disk_gb_s"] / 86_400
    yield "read once by one reader, as a verified copy does", f"{days:.1f} days"


def table(names: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table in Markdown."""
    lines = [names, ["---"] * len(names), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


if __name__ == "__main__":
    main()
