"""The published tables that take minutes, all measured again at one commit: python benchmarks/quick_tables.py [NAME...]

    python benchmarks/quick_tables.py --data ../shared/data
    python benchmarks/quick_tables.py --list

Without a NAME all of them, one after another; seeds are fresh ones, drawn from the commit. A changed tree is refused:
commit first. Without --data, what needs real flights is left out by name. A table that fails does not keep the others from being made.
What each took in processor time is printed, and --list prints of every result file which commit it was measured at.
"""

import argparse
import json
import resource
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from provenance import SCORED, commit

HERE = Path(__file__).parent


@dataclass(frozen=True)
class QuickTable:
    """A benchmark's file and arguments; {data} is the folder given, {results} the folder of results. Minutes are processor time."""

    script: str
    arguments: str
    minutes: float


TABLES = {
    "mosaic_methods": QuickTable("mosaic_methods", "--count 1 --methods planar thesis", 2.0),
    "planar_survey": QuickTable(
        "mosaic_methods", "--methods planar --output {results}/planar_survey.json", 1.2
    ),
    "watch_counts": QuickTable("watch_counts", "", 7.2),
    "change_events": QuickTable("change_events", "--count 1 --methods robust", 8.5),
    "thesis_tables": QuickTable("thesis_tables", "", 8.5),
    "planar_sand": QuickTable(
        "mosaic_methods",
        "--count 1 --preset sand --methods planar --output {results}/planar_sand.json",
        0.3,
    ),
    "real_flights": QuickTable("real_flights", "{data}/flights", 3.0),
}


def main() -> None:
    """Run them in order, or list what there is."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "names", nargs="*", metavar="NAME", help=f"of {', '.join(TABLES)}; else all"
    )
    parser.add_argument("--data", type=Path, help="the folder of real data")
    parser.add_argument(
        "--list", action="store_true", help="only print the commit of each result file"
    )
    options = parser.parse_args()
    if unknown := [name for name in options.names if name not in TABLES]:
        parser.error(f"there is no table {', '.join(unknown)}; there are {', '.join(TABLES)}")
    if options.list:
        for name, commits in measured_at(HERE / "results"):
            print(f"{name:32} {', '.join(commits) or 'not stated'}")
        return
    if commit().endswith("-dirty") or not commit():
        sys.exit("the tree differs from its commit, so no figure could be made again: commit first")
    names = options.names or TABLES
    failed = [name for name in names if not make_table(name, TABLES[name], options.data)]
    if failed:
        sys.exit(f"not made: {', '.join(failed)}")


def make_table(name: str, table: QuickTable, data: Path | None) -> bool:
    """Run one benchmark; False where it failed. One that needs `data` is left out without it."""
    if data is None and "{data}" in table.arguments:
        print(f"{name}: left out, needs --data", flush=True)
        return True
    words = [word.format(data=data, results=HERE / "results") for word in table.arguments.split()]
    before_s = _children_s()
    done = subprocess.run(
        [sys.executable, HERE / f"{table.script}.py", *words],
        stdout=subprocess.DEVNULL,
        check=False,
    )
    minutes = (_children_s() - before_s) / 60
    print(
        f"{name}: exit {done.returncode}, {minutes:.1f} min of processor time (about {table.minutes:g})",
        flush=True,
    )
    return done.returncode == 0


def measured_at(folder: Path) -> Iterator[tuple[str, list[str]]]:
    """Each result file and the commits that it names, the file's own first."""
    for path in sorted(folder.glob("*.json")):
        if path == SCORED:
            continue
        yield path.name, list(dict.fromkeys(_commits(json.loads(path.read_text(encoding="utf-8")))))


def _commits(value: Any) -> Iterator[str]:
    if isinstance(value, dict):
        own = value.get("commit")
        yield from [own] if isinstance(own, str) else own or []
        for key, each in value.items():
            if key != "commit":
                yield from _commits(each)
    elif isinstance(value, list):
        for each in value:
            yield from _commits(each)


def _children_s() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


if __name__ == "__main__":
    main()
