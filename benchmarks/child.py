"""A benchmark's own script run again in a process of its own, so that its time and memory are its alone."""

import json
import os
import resource
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any


def peak_mb() -> int:
    """This process's largest memory. ru_maxrss of a child begins with what its parent held when it was started."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmHWM:"):
            return round(int(line.split()[1]) / 1024)
    raise RuntimeError("/proc/self/status has no VmHWM")


def run_child(script: str, arguments: Sequence[str], limit_s: float) -> dict[str, float | str]:
    """What `script` prints as JSON on its last line; as "failure", why it did not."""
    try:
        done = subprocess.run(
            [sys.executable, script, *arguments],
            capture_output=True,
            text=True,
            check=False,
            timeout=limit_s,
        )
    except subprocess.TimeoutExpired:
        return {"failure": f"not done after {limit_s:.0f} s"}
    if done.returncode:
        last = done.stderr.strip().splitlines()[-1:] or [f"exit code {done.returncode}"]
        return {"failure": last[0]}
    return json.loads(done.stdout.splitlines()[-1])


def map_costs(flight: Path, site: Path, options: Sequence[str]) -> dict[str, Any]:
    """What `sorvolo map` of a flight into `site`, without a detector, takes in a process of its own.

    Ends the benchmark with the command's words where it fails.
    """
    command = [
        sys.executable,
        "-m",
        "sorvolo",
        "map",
        str(flight),
        "--site",
        str(site),
        "--model",
        "none",
        *options,
    ]
    load = os.getloadavg()[0]
    before, started_s = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    seconds, after = time.monotonic() - started_s, resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode not in (0, 3):
        sys.exit(done.stderr)
    return {
        "seconds": round(seconds, 1),
        "load_before": load,
        "cpu_s": round(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, 1),
        "peak_mb": round(after.ru_maxrss / 1024),
    }
