"""How often a run that is killed at a random moment, and started again, ends with the bytes of one that was not.

    python benchmarks/resume_kills.py --kills 20 --seed 1 --mission map

Two small simulated flights; `map` makes the map of the first, `compare` compares the second with it, `watch` searches
the second, two frames a second, with the model that is installed, and runs a program for each object. Each round starts
the command in a process of its own, waits until it has noted its first frame (`run.journal` begins), kills it (SIGKILL)
after a share, drawn from 0 to 1, of the time that the undisturbed run took from there to its end, and runs the same
command again to its end. A run that was through before its kill counts for nothing, and another moment is drawn. A kill
before the first frame is noted only tests that a run begins. All files are compared with those of the undisturbed run,
byte by byte, but for the catalogue (`site.db`, which holds when a run was made) and what a report states of the time
and the memory that it took (docs/formats.md). Of a watch, each alert must have been sent once: one that was sent in the
moment of the kill, before that was noted, may come twice, and is counted.
"""

import argparse
import json
import random
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from provenance import commit, machine
from sorvolo.lab.simulate.site import simulate_site
from sorvolo.lab.simulation.presets import preset
from sorvolo.lab.simulation.settings import SimulationSettings

EFFORT = (
    "seconds",
    "cpu_s",
    "registration_cpu_s_per_keyframe",
    "peak_memory_mb",
    "reading",
    "latency_s",
    "frames_per_second",
)
"""Of report.json: what a run took."""
TIMED = {"report.html", "changes.html"}
"""Pages that show it."""
JOURNALS = ("flights/*/run.journal", "run.journal")
"""Of a site's flight, of a watch's folder."""
POLLED_S = 0.02


def simulated(width_px: int, length_m: float) -> SimulationSettings:
    """Two flights over one small site, the second with changes."""
    demo = preset("demo")
    imaging = replace(demo.imaging, width_px=width_px, height_px=width_px * 9 // 16, fps=6)
    return replace(
        demo,
        path=replace(demo.path, length_m=length_m, strips=2, strip_spacing_m=6),
        imaging=imaging,
    )


def content(site: Path) -> dict[str, bytes]:
    """The site's files by name, as they are to be compared."""
    found = {}
    for path in sorted(site.rglob("*")):
        if not path.is_file() or path.name.startswith("site.") or path.name in TIMED:
            continue
        data = path.read_bytes()
        if path.name == "report.json":
            report = json.loads(data)
            report.get("objects", {}).pop("seconds", None)
            data = json.dumps(
                {key: value for key, value in report.items() if key not in EFFORT}
            ).encode()
        found[str(path.relative_to(site))] = data
    return found


@dataclass(frozen=True)
class Ran:
    """A run: how long it took, when it had noted its first frame, what it printed, and whether it was killed."""

    seconds: float
    noted_s: float
    printed: str
    killed: bool


def run(command: list[str], place: Path, kill_s: float | None = None) -> Ran:
    """Run it over the files of `place`, or kill it so many seconds after it has noted its first frame there."""
    started_s, killed = time.monotonic(), False
    with (
        tempfile.TemporaryFile("w+") as printed,
        subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=printed) as process,
    ):
        while process.poll() is None and not any(any(place.glob(each)) for each in JOURNALS):
            time.sleep(POLLED_S)
        noted_s = time.monotonic() - started_s
        try:
            process.wait(kill_s)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
            killed = True
        printed.seek(0)
        words = printed.read()
    if not killed and process.returncode not in (0, 3):
        raise SystemExit(words)
    return Ran(time.monotonic() - started_s, noted_s, words, killed)


class Trial:
    """The command of one mission, its undisturbed result, and what it begins from."""

    def __init__(self, options: argparse.Namespace, folder: Path) -> None:
        self._options, self._folder = options, folder
        self._base = folder / "base" / "site"
        self._alerts = folder / "alerts"
        for _ in simulate_site(folder / "flown", simulated(options.width, options.length)):
            pass
        if options.mission == "compare":
            self._base.parent.mkdir()
            run(self._command("map", self._base), self._base)

    def begin(self, name: str) -> Path:
        """A folder of this name, the same each time, as it is before the mission."""
        place = self._folder / name / "site"
        shutil.rmtree(place.parent, ignore_errors=True)
        place.parent.mkdir()
        self._alerts.unlink(missing_ok=True)
        if self._base.is_dir():
            shutil.copytree(self._base, place)
        return place

    def run(self, place: Path, kill_s: float | None = None) -> Ran:
        """The mission, perhaps killed: see `run`."""
        return run(self._command(self._options.mission, place), place, kill_s)

    def alerts(self) -> Counter[str]:
        """How often each object was announced since `begin`."""
        return Counter(self._alerts.read_text().split()) if self._alerts.is_file() else Counter()

    def _command(self, mission: str, place: Path) -> list[str]:
        flown = self._folder / "flown"
        shared = ["--camera", str(flown / "camera.xml"), "--model", self._options.model]
        flight = str(flown / ("flight1" if mission == "map" else "flight2"))
        command = [sys.executable, "-m", "sorvolo", mission, flight]
        if mission != "watch":
            return [*command, "--site", str(place), *shared]
        alert = f"{sys.executable} -c \"open('{self._alerts}', 'a').write('{{id}} ')\""
        return [
            *command,
            "--out",
            str(place),
            *shared,
            "--save",
            "pictures",
            "--fps",
            "2",
            "--alert-command",
            alert,
        ]


def rounds(options: argparse.Namespace, folder: Path) -> Iterator[dict[str, object]]:
    """The result so far, after each killed run."""
    trial = Trial(options, folder)
    whole = trial.begin("undisturbed")
    undisturbed = trial.run(whole)
    wanted, announced = content(whole), trial.alerts()
    draw, rows = random.Random(options.seed), []
    while len(rows) < options.kills:
        place = trial.begin("killed")
        kill_s = draw.random() * (undisturbed.seconds - undisturbed.noted_s)
        stopped = trial.run(place, kill_s)
        if not stopped.killed:
            continue
        again = trial.run(place)
        found = content(place)
        differing = sorted(
            name for name in wanted.keys() | found.keys() if wanted.get(name) != found.get(name)
        )
        resumed = re.search(r"continu(?:ing|ed) after (?:all )?(\d+) frame", again.printed)
        rows.append(
            {
                "noted_s": round(stopped.noted_s, 2),
                "kill_s": round(stopped.seconds, 2),
                "again_s": round(again.seconds, 2),
                "same": not differing,
                "frames_taken_over": int(resumed[1]) if resumed else 0,
                "differing": differing[:10],
                "alerts_lost": len(announced - trial.alerts()),
                "alerts_twice": len(trial.alerts() - announced),
            }
        )
        print(len(rows), rows[-1], flush=True)
        yield {
            "mission": options.mission,
            "seed": options.seed,
            "width_px": options.width,
            "length_m": options.length,
            "model": options.model,
            "undisturbed_s": round(undisturbed.seconds, 2),
            "noted_s": round(undisturbed.noted_s, 2),
            "alerts": announced.total(),
            "kills": len(rows),
            "same": sum(bool(each["same"]) for each in rows),
            "resumed": sum(bool(each["frames_taken_over"]) for each in rows),
            "rounds": rows,
        }


def main() -> None:
    """Write results/resume_kills_MISSION.json."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--mission", choices=("map", "compare", "watch"), default="map")
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--width", type=int, default=480)
    parser.add_argument("--length", type=float, default=40.0, help="of a strip, m")
    parser.add_argument("--model", default="none")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    out = options.out or Path(__file__).parent / "results" / f"resume_kills_{options.mission}.json"
    with tempfile.TemporaryDirectory() as folder:
        for result in rounds(options, Path(folder)):
            out.write_text(
                json.dumps({"machine": machine(), "commit": commit(), **result}, indent=1) + "\n"
            )
    print(
        f"{result['same']} of {result['kills']} with the same bytes, {result['resumed']} went on; {out}"
    )


if __name__ == "__main__":
    main()
