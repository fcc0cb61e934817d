"""Whether a batch loses or doubles anything while its workers, and the batch itself, are killed at random.

    python benchmarks/batch_faults.py --flights 40 --kills 2 --seed 1
    python benchmarks/batch_faults.py --outages 30 --stall 90 --out benchmarks/results/batch_outages.json
    python benchmarks/batch_faults.py --ray --stall 20 --model default --out benchmarks/results/batch_node_faults.json

Small simulated photo flights, some of them poisoned (their worker is killed at every try), one broken, one there twice.
Other workers are killed (SIGKILL), crashed (SIGSEGV) or stopped (SIGSTOP) at random moments, each flight's at most
twice; the batch's own process is killed `--kills` times and started again. In the end each map is compared, byte by
byte, with one that `map_flights` makes undisturbed, but for what states when it was made and how long it took.

With `--outages S` the sites' catalogues lie in PostgreSQL, each site is copied to an object store as well, and both are
killed, cut off or stalled at random, for up to S seconds. The copies are then verified, too. With `--ray` the flights
run on a Ray cluster of two machines, with a shared detector on each, and what `node_faults.py` names is struck instead.
"""

import argparse
import json
import multiprocessing
import os
import random
import shutil
import signal
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from unittest import mock

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "cluster"))

from batch_flights import another, content

from ended_work import ended
from node_faults import node_faults
from outages import PLACE, outages
from provenance import commit, machine
from sorvolo.cluster.batch import BatchSettings, run_batch
from sorvolo.cluster.cost import Cost
from sorvolo.cluster.executor import Executor
from sorvolo.cluster.local_executor import LocalExecutor
from sorvolo.cluster.orders import Ending, FlightWish, Order
from sorvolo.cluster.ray_executor import ray_executor
from sorvolo.cluster.shared_detector import SharingSettings
from sorvolo.cluster.table import BatchTable, State
from sorvolo.lab.simulate.site import simulate_site
from sorvolo.lab.simulation.presets import preset
from sorvolo.missions.flight.settings import MapSettings
from sorvolo.missions.map.flights import map_flights
from sorvolo.missions.site.copy import verify_copy
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.catalogue_place import POINTER, VARIABLE

FAULTS = (signal.SIGKILL, signal.SIGSEGV, signal.SIGSTOP)
MOST_FAULTS = 2  # of a flight that is not poisoned: three would set it aside


class Disturbed(LocalExecutor):
    """A local executor whose workers are struck at random moments."""

    def __init__(self, options: argparse.Namespace, lock: int, faults: Path) -> None:
        super().__init__(options.workers, options.stall, lock)
        self._options, self._faults = options, faults
        self._draw = random.Random(f"{options.seed} {time.time()}")

    def next_ended(self, timeout_s: float | None = None) -> tuple[tuple[str, str], Ending] | None:
        """Note how each try ends."""
        ended = super().next_ended(timeout_s)
        if ended is not None:
            with self._faults.with_name("endings.txt").open("a") as file:
                file.write(f"{ended[1].outcome.value}\n")
        return ended

    def start(self, key: tuple[str, str], order: Order, cost: Cost) -> None:
        """Begin a try, and perhaps strike its worker later."""
        super().start(key, order, cost)
        name, worker = Path(order.source).name, self._running[key][0]
        before = self._faults.read_text().splitlines() if self._faults.exists() else []
        poisoned = name.startswith("poisoned")
        struck = sum(line.split()[0] == name for line in before)
        if not poisoned and (struck >= MOST_FAULTS or self._draw.random() > self._options.share):
            return
        fault, wait_s = self._draw.choice(FAULTS), self._draw.random() * self._options.within
        if poisoned:
            fault, wait_s = signal.SIGKILL, self._draw.random()
        threading.Thread(
            target=self._strike, args=(name, worker, fault, wait_s), daemon=True
        ).start()

    def _strike(self, name: str, worker: object, fault: signal.Signals, wait_s: float) -> None:
        time.sleep(wait_s)
        with self._faults.open("a") as file:
            file.write(f"{name} {fault.name}\n")
        try:
            os.kill(worker.pid, fault)  # type: ignore[attr-defined]
        except ProcessLookupError:  # it was done before
            pass


def batch(folder: Path, options: argparse.Namespace) -> None:
    """One disturbed batch over the folder's flights; prints what it does."""

    @contextmanager
    def executor(table: BatchTable) -> Iterator[Executor]:
        if options.ray:
            with ray_executor(
                "ray", None, options.stall, table.root, SharingSettings(options.model != "none")
            ) as made:
                yield made
            return
        with Disturbed(options, table.lock, folder / "faults.txt") as made:
            yield made

    wish = FlightWish(
        camera=str(folder / "flown-0" / "camera.xml"),
        model=options.model,
        copy_to=PLACE if options.outages else "",
    )
    settings = BatchSettings(wish, stall_s=options.stall)
    running = run_batch([folder / "in"], folder / "maps", settings, executor)
    while True:
        try:
            update = next(running)
        except StopIteration as end:
            (folder / "report.json").write_text(
                json.dumps({"seconds": end.value.seconds, **end.value.counts()})
            )
            return
        if update.row is not None:
            print(
                update.done, update.row.state, update.row.source, update.row.words[:160], flush=True
            )


def flown(folder: Path, options: argparse.Namespace) -> None:
    """The flights: `--bases` simulated ones, and as many more with the same pictures as are wanted."""
    demo = preset("demo")
    for base in range(options.bases):
        settings = replace(
            demo,
            seed=31 + base,
            flights=1,
            scene=replace(demo.scene, has_scenery=False),
            path=replace(demo.path, height_m=20, speed_m_s=5, length_m=28, strips=1),
            imaging=replace(demo.imaging, width_px=320, height_px=180, fps=2),
            output=replace(demo.output, photos=True),
        )
        for _ in simulate_site(folder / f"flown-{base}", settings):
            pass
    for number in range(options.flights):
        name = f"poisoned-{number}" if number < options.poisoned else f"flight-{number}"
        another(folder / f"flown-{number % options.bases}", folder / "in" / name)
    (folder / "in" / "broken.mp4").write_text("no video")
    shutil.copytree(
        folder / "in" / f"flight-{options.flights - 1}", folder / "in" / "twice" / "copy"
    )


def compared(folder: Path, options: argparse.Namespace) -> dict[str, object]:
    """The maps against undisturbed ones, flight by flight."""
    same, differing, doubled, faulty_copies = 0, [], [], []
    for flight in sorted((folder / "in").glob("flight-*")):
        site, wanted = folder / "maps" / flight.name, folder / "wanted" / flight.name
        with mock.patch.dict(os.environ, {VARIABLE: ""}):
            for _ in map_flights(
                [flight],
                wanted,
                MapSettings(model=options.model),
                camera=folder / "flown-0" / "camera.xml",
            ):
                pass
        wrong = other_files(site, wanted)
        same += not wrong
        if wrong:
            differing.append({"flight": flight.name, "files": wrong[:5]})
        with Archive.open(site, write=False) as archive:
            if len(archive.flights()) != 1 or len(archive.versions()) != 1:
                doubled.append(flight.name)
        if options.outages and ended(verify_copy(str(site), f"{PLACE}/{site.name}")).faults:
            faulty_copies.append(flight.name)
        shutil.rmtree(wanted)
    copies = {"faulty_copies": faulty_copies} if options.outages else {}
    return {"same_bytes": same, "differing": differing, "doubled": doubled, **copies}


def other_files(site: Path, wanted: Path) -> list[str]:
    """The files in which two sites differ, but for where their catalogues lie."""
    found, expected = content(site), content(wanted)
    found.pop(POINTER, None)
    return sorted(
        name for name in found.keys() | expected.keys() if found.get(name) != expected.get(name)
    )


def measured(folder: Path, options: argparse.Namespace) -> dict[str, object]:
    """The batch through all its faults, and what came of it."""
    flown(folder, options)
    if options.ray:
        with node_faults(folder / "maps", options.seed) as strikes:
            result = struck(folder, options)
        return {**result, "faults": dict(strikes.counts), **compared(folder, options)}
    with outages(options.seed, options.outages) if options.outages else nullcontext() as striking:
        result = struck(folder, options)
        if striking is not None:
            striking.end()
            result |= {"outages": dict(striking.counts), "outage_s": round(striking.seconds, 1)}
        return {**result, **compared(folder, options)}


def struck(folder: Path, options: argparse.Namespace) -> dict[str, object]:
    """The batch, killed and started again, and its table."""
    draw, started_s, killed = random.Random(options.seed), time.monotonic(), 0
    context = multiprocessing.get_context("spawn")
    while True:
        process = context.Process(target=batch, args=(folder, options))
        process.start()
        process.join(
            draw.uniform(0.3, 1.0) * options.kill_within if killed < options.kills else None
        )
        if process.exitcode is not None:
            break
        process.kill()
        process.join()
        killed += 1
        print(f"the batch was killed ({killed})", flush=True)
    seconds = time.monotonic() - started_s
    if process.exitcode != 0:
        raise SystemExit(f"the batch ended with code {process.exitcode}")
    with BatchTable.open(folder / "maps") as table:
        rows = list(table)
    through = [row for row in rows if row.state in (State.DONE, State.DOUBTFUL)]
    faults = Counter(line.split()[1] for line in lines_of(folder / "faults.txt"))
    return {
        "flights": options.flights,
        "poisoned": options.poisoned,
        "workers": options.workers,
        "seed": options.seed,
        "batch_killed": killed,
        "faults": dict(faults),
        "seconds": round(seconds, 1),
        "endings": dict(Counter(lines_of(folder / "endings.txt"))),
        "states": dict(Counter(row.state.value for row in rows)),
        "tries": sum(row.tries for row in rows),
        "crashes": sum(row.crashes for row in rows),
        "cpu_s": round(sum(row.cpu_s for row in rows), 1),
        "set_aside": sorted(Path(row.source).name for row in rows if row.state is State.SET_ASIDE),
        "not_through": sorted(
            Path(row.source).name
            for row in rows
            if Path(row.source).name.startswith("flight-") and row not in through
        ),
    }


def lines_of(file: Path) -> list[str]:
    """The lines of a file that need not be there."""
    return file.read_text().splitlines() if file.exists() else []


def main() -> None:
    """Write results/batch_faults.json."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--flights", type=int, default=40)
    parser.add_argument("--poisoned", type=int, default=2)
    parser.add_argument("--bases", type=int, default=4)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--share", type=float, default=0.4, help="of tries that are struck")
    parser.add_argument("--within", type=float, default=12.0, help="of a try's start, s")
    parser.add_argument("--kills", type=int, default=2)
    parser.add_argument("--kill-within", type=float, default=120.0, help="of the batch's start, s")
    parser.add_argument(
        "--stall",
        type=float,
        default=8.0,
        help="after which a worker that does nothing is ended, s",
    )
    parser.add_argument(
        "--outages", type=float, default=0.0, help="of database and store, s at most; 0: none"
    )
    parser.add_argument("--ray", action="store_true", help="on a Ray cluster of two machines")
    parser.add_argument("--model", default="none", help="of the detector")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--out", type=Path, default=Path(__file__).parent / "results" / "batch_faults.json"
    )
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        result = measured(Path(folder), options)
    options.out.write_text(
        json.dumps({"machine": machine(), "commit": commit(), **result}, indent=1) + "\n"
    )
    print(json.dumps(result))


if __name__ == "__main__":
    main()
