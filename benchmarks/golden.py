"""The gate of a refactoring: whole runs of the commands, and a hash of every file they write.

    python benchmarks/golden.py record build/golden.json            # before
    python benchmarks/golden.py check build/golden.json             # after: names each file that differs
    python benchmarks/golden.py check build/golden.json --kill      # each run killed three times, and resumed
    python benchmarks/golden.py check build/golden.json small photos

Byte-equal holds on one machine only (NumPy and OpenCV choose their code by processor), so no manifest is kept in the
repository. Inputs are simulated once into --work and reused; runs need the shared data (--data) where a case names it.
"""

import argparse
import hashlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

SORVOLO = [sys.executable, "-P", "-m", "sorvolo"]
KILL_AT = (0.3, 0.55, 0.8)  # of the first run's time

# Inputs: the options of `sorvolo simulate`. {data} is the shared data's folder.
INPUTS = {
    "small": "--preset demo --length 30 --strips 2 --seed 5",
    "photos": "--preset compare-photos --length 40 --strips 2 --seed 6",
    "none": "--preset compare-none --length 30 --strips 2 --seed 7 --telemetry none",
    "relief": "--preset survey --relief 6 --photos --length 60 --strips 3 --seed 8",
    "site-a": "--preset compare --ground {data}/flights/building_site/2024-02-24.jpg --ground-gsd 0.146"
    " --length 60 --strips 2 --flights 1 --seed 9",
    "site-b": "--preset compare --ground {data}/flights/building_site/2024-03-01.jpg --ground-gsd 0.146"
    " --length 60 --strips 2 --flights 1 --seed 9",
}

# Cases: commands in order. {out} is the case's folder, {in} the inputs' folder.
SMALL = "{in}/small/flight{n}/flight{n}.mp4 --camera {in}/small/camera.xml"
ONE, TWO = SMALL.replace("{n}", "1"), SMALL.replace("{n}", "2")
CASES = {
    "small": [
        f"map {ONE} --site {{out}}/site",
        f"compare {TWO} --site {{out}}/site",
        "telemetry {out}/site --flight flight1 --out {out}/telemetry",
        "history {out}/site",
    ],
    "watch": [f"watch {TWO} --out {{out}}/watch"],
    "search": [
        f"map {ONE} --site {{out}}/site --model none",
        "search {out}/site --plants 12 --out {out}/search",
    ],
    "thesis": [
        f"map {ONE} --site {{out}}/site --method thesis --model none",
        f"compare {TWO} --site {{out}}/site --method thesis --model none",
    ],
    "coarse": [
        f"map {ONE} --site {{out}}/site --gsd 0.12 --model none",
        f"compare {TWO} --site {{out}}/site --model none",
    ],
    "photos": [
        "map {in}/photos/flight1/photos --site {out}/site --camera {in}/photos/camera.xml --model none",
        "compare {in}/photos/flight2/photos --site {out}/site --camera {in}/photos/camera.xml --model none",
    ],
    "none": [
        "map {in}/none/flight1/flight1.mp4 --site {out}/site --camera {in}/none/camera.xml --model none"
    ],
    "relief": [
        "map {in}/relief/flight1/photos --site {out}/site --camera {in}/relief/camera.xml --model none",
        "heights {out}/site",
    ],
    "dates": [
        "map {in}/site-a/flight1/flight1.mp4 --site {out}/site --camera {in}/site-a/camera.xml --model none",
        "compare {in}/site-b/flight1/flight1.mp4 --site {out}/site --camera {in}/site-b/camera.xml --model none",
    ],
    "brighton": ["map {data}/flights/brighton_beach --site {out}/site --gsd 0.04 --model none"],
    "fixed-wing": ["map {data}/flights/fixed_wing --site {out}/site --model none"],
    "caliterra": ["map {data}/flights/caliterra --site {out}/site --gsd 0.08 --model none"],
    "thermal": ["watch {data}/flights/thermal_field --out {out}/watch --model thermal"],
}
_VARIES = re.compile(
    r"second|duration|_mb$|memory|version|commit|written|created|started|machine|processor|cpu|date_time_run|path|folder|time_s$|per_s$|settings"
)
_LEFT_OUT = re.compile(r"site\.(db|lock)|\.html$|journal|\.lock$|live\.")


def _without_times(value: object) -> object:
    if isinstance(value, dict):
        return {
            key: str(part).partition("+")[0] if key == "sorvolo" else _without_times(part)
            for key, part in value.items()
            if not _VARIES.search(key.lower())
        }
    return [_without_times(part) for part in value] if isinstance(value, list) else value


def manifest(folder: Path) -> dict[str, str]:
    """Return a SHA-256 for each file below a folder that two equal runs write alike."""
    hashes = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if not path.is_file() or _LEFT_OUT.search(name):
            continue
        data = path.read_bytes()
        if path.suffix == ".json":
            text = json.dumps(_without_times(json.loads(data)), sort_keys=True)
            data = text.replace(str(folder), "").encode()
        hashes[name] = hashlib.sha256(data).hexdigest()
    return hashes


def _command(words: str, places: dict[str, str]) -> list[str]:
    for name, place in places.items():
        words = words.replace("{" + name + "}", place)
    return [*SORVOLO, *words.split()]


def _run(command: list[str], kill_after_s: float | None = None) -> None:
    process = subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, start_new_session=True
    )
    try:
        _, errors = process.communicate(timeout=kill_after_s)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        return
    if process.returncode not in (0, 3):
        raise SystemExit(
            f"{' '.join(command)} ended with {process.returncode}:\n{errors.decode()[-2000:]}"
        )


def make_inputs(work: Path, data: Path) -> None:
    """Simulate the inputs that are not there yet."""
    for name, options in INPUTS.items():
        folder = work / "inputs" / name
        if folder.exists() or ("{data}" in options and not data.exists()):
            continue
        _run([*SORVOLO, "simulate", str(folder) + ".part", *options.format(data=data).split()])
        folder.with_name(name + ".part").rename(folder)


def run_case(
    name: str, work: Path, data: Path, seconds: dict[str, float] | None
) -> tuple[dict[str, str], float]:
    """Run a case's commands, each killed thrice where `seconds` names its time; return hashes and its seconds."""
    out = work / "runs" / name
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    places = {"in": str((work / "inputs").resolve()), "out": str(out), "data": str(data)}
    started_s = time.monotonic()
    for number, words in enumerate(CASES[name]):
        command = _command(words, places)
        begun_s = time.monotonic()
        if seconds is not None and words.split()[0] in ("map", "compare", "watch"):
            for share in KILL_AT:
                _run(command, share * seconds[f"{name} {number}"])
        _run(command)
        if seconds is None:
            TIMES[f"{name} {number}"] = round(time.monotonic() - begun_s, 1)
    return manifest(out), time.monotonic() - started_s


TIMES: dict[str, float] = {}


def main() -> int:
    """Record a manifest, or check against one; returns 1 where a file differs."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("act", choices=("record", "check"))
    parser.add_argument("manifest", type=Path)
    parser.add_argument("cases", nargs="*", choices=[*CASES, []])
    parser.add_argument("--kill", action="store_true")
    parser.add_argument("--work", type=Path, default=Path("build/golden"))
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    wish = parser.parse_args()
    wish.work, wish.data = wish.work.resolve(), wish.data.resolve()
    make_inputs(wish.work, wish.data)
    known = (
        json.loads(wish.manifest.read_text())
        if wish.manifest.exists()
        else {"files": {}, "seconds": {}}
    )
    is_different = False
    for name in wish.cases or CASES:
        if (
            any("{data}" in words or "/site-a/" in words for words in CASES[name])
            and not wish.data.exists()
        ):
            print(f"{name}: skipped, it needs the shared data")
            continue
        files, took_s = run_case(
            name, wish.work, wish.data, known["seconds"] if wish.kill else None
        )
        if wish.act == "record":
            known["files"][name] = files
            known["seconds"].update(TIMES)
            wish.manifest.write_text(json.dumps(known, indent=1))
            print(f"{name}: {len(files)} files in {took_s:.0f} s", flush=True)
            continue
        expected = known["files"][name]
        differing = sorted(
            path for path in {*files, *expected} if files.get(path) != expected.get(path)
        )
        is_different |= bool(differing)
        print(f"{name}: {differing or 'equal'} ({took_s:.0f} s)", flush=True)
    return int(is_different)


if __name__ == "__main__":
    sys.exit(main())
