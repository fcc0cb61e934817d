"""What a batch costs beside plain `sorvolo map` in a loop: time and processor time, with 1 and 2 workers, and with Ray.

    python benchmarks/batch_speed.py --flights 6 --width 640

Small simulated photo flights, each mapped into a site of its own, without a detector. Every way begins with empty
folders, `--rounds` times in turn; the medians are kept. Processor time is that of the whole tree of processes (of Ray's
workers, what each flight's process took, as Ray's own are not children); the overhead is against the loop.
"""

import argparse
import json
import os
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "cluster"))

from batch_flights import another

from provenance import commit, machine
from sorvolo.lab.simulate.site import simulate_site
from sorvolo.lab.simulation.presets import preset

WAYS = ("loop", "local 1", "local 2", "ray 1", "ray 2")


def flown(folder: Path, options: argparse.Namespace) -> None:
    """The flights: one simulated, the others with its pictures."""
    demo = preset("demo")
    height_px = options.width * 9 // 16
    settings = replace(
        demo,
        flights=1,
        scene=replace(demo.scene, has_scenery=False),
        output=replace(demo.output, photos=True),
        path=replace(
            demo.path,
            height_m=20,
            speed_m_s=5,
            length_m=options.length,
            strips=2,
            strip_spacing_m=8,
        ),
        imaging=replace(demo.imaging, width_px=options.width, height_px=height_px),
    )
    for _ in simulate_site(folder / "flown", settings):
        pass
    for number in range(options.flights):
        another(folder / "flown", folder / "in" / f"flight-{number}")


def once(way: str, folder: Path) -> dict[str, float]:
    """All flights in one way, from nothing: seconds, and processor time of all processes that took part."""
    shutil.rmtree(folder / "maps", ignore_errors=True)
    sorvolo = [sys.executable, "-m", "sorvolo"]
    shared = ["--camera", str(folder / "flown" / "camera.xml"), "--model", "none", "--json"]
    executor, _, workers = way.partition(" ")
    commands = [
        [
            *sorvolo,
            "batch",
            str(folder / "in"),
            "--root",
            str(folder / "maps"),
            "--executor",
            executor,
            "--workers",
            workers,
            *shared,
        ]
    ]
    if way == "loop":
        commands = [
            [*sorvolo, "map", str(flight), "--site", str(folder / "maps" / flight.name), *shared]
            for flight in sorted((folder / "in").iterdir())
        ]
    before, started_s = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    for command in commands:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode not in (0, 3):
            raise SystemExit(done.stderr)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    if executor == "ray":  # whose workers are nobody's children here
        cpu_s += json.loads(done.stdout)["cpu_s"]
    return {"seconds": time.monotonic() - started_s, "cpu_s": cpu_s}


def main() -> None:
    """Write results/batch_speed.json."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--flights", type=int, default=6)
    parser.add_argument("--width", type=int, default=640)
    parser.add_argument("--length", type=float, default=60.0, help="of a strip, m")
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--ways", default=",".join(WAYS))
    parser.add_argument(
        "--out", type=Path, default=Path(__file__).parent / "results" / "batch_speed.json"
    )
    options = parser.parse_args()
    rows: dict[str, list[dict[str, float]]] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        flown(folder, options)
        pictures = len(list((folder / "in" / "flight-0").iterdir()))
        for _ in range(options.rounds):
            for way in options.ways.split(","):
                rows.setdefault(way, []).append(once(way, folder))
                print(way, rows[way][-1], f"load {os.getloadavg()[0]:.1f}", flush=True)
    medians = {
        way: {
            name: round(statistics.median(each[name] for each in found), 2)
            for name in ("seconds", "cpu_s")
        }
        for way, found in rows.items()
    }
    base = medians["loop"]
    for found in medians.values():
        found["overhead_cpu"] = round(found["cpu_s"] / base["cpu_s"] - 1, 3)
        found["speed_up"] = round(base["seconds"] / found["seconds"], 2)
    result = {
        "flights": options.flights,
        "pictures": pictures,
        "width_px": options.width,
        "rounds": options.rounds,
        "load": round(os.getloadavg()[0], 1),
        "ways": medians,
    }
    options.out.write_text(
        json.dumps({"machine": machine(), "commit": commit(), **result}, indent=1) + "\n"
    )
    print(json.dumps(result))


if __name__ == "__main__":
    main()
