"""A benchmark's own script run again in a process of its own, so that its time and memory are its alone."""

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path


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
