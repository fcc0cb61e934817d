"""Where a figure comes from: the machine, the commit, seeds drawn from that commit, and how often a set was scored.

A held-out set that is scored again and again guides the work, whatever is intended, and is then held out no longer.
So seeds of published tables are drawn from the commit's hash: nobody has seen them before. Sets that cannot be
drawn anew (real photos, labelled pictures) carry the number of times they were scored, kept in results/scored.json.
"""

import hashlib
import json
import os
import platform
import re
import subprocess
from collections.abc import Sequence
from pathlib import Path

import cv2

SCORED = Path(__file__).parent / "results" / "scored.json"
_FIRST_DRAWN = 1_000_000  # below lie the seeds of development and of training
_DRAWN_RANGE = 1_000_000_000


def machine() -> dict[str, str | int]:
    """The processor and its cores, and nothing that identifies the machine."""
    model = platform.processor()
    if Path("/proc/cpuinfo").is_file():
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                model = line.partition(":")[2].strip()
                break
    return {
        "cpu": model,
        "cores": os.cpu_count() or 0,
        "python": platform.python_version(),
        "opencv": cv2.__version__,
    }


def commit(repository: Path = Path(__file__).parents[1]) -> str:
    """The commit that was measured, its first seven digits or more; "-dirty" follows where the code differs from it.

    Result files do not count: a benchmark writes them. Empty where there is no repository.
    """
    head = _git(repository, "rev-parse", "--short", "HEAD")
    changed = _git(
        repository,
        "status",
        "--porcelain",
        "--untracked-files=no",
        "--",
        ".",
        ":!benchmarks/results",
    )
    return f"{head}-dirty" if head and changed else head


def drawn_seeds(benchmark: str, count: int, hash_of_commit: str | None = None) -> list[int]:
    """Seeds for a benchmark, drawn from the hash of the commit that it measures: the same for the same commit.

    `hash_of_commit` is for drawing those of another commit again; without it, the one checked out.
    """
    drawn_from = (hash_of_commit or commit()).removesuffix("-dirty")
    return [
        _FIRST_DRAWN
        + int.from_bytes(hashlib.sha256(f"{drawn_from} {benchmark} {number}".encode()).digest()[:8])
        % _DRAWN_RANGE
        for number in range(count)
    ]


def fresh_seeds(
    benchmark: str, count: int, hash_of_commit: str | None = None, ledger: Path = SCORED
) -> list[int]:
    """As `drawn_seeds`, but never one that the ledger has: a commit that is measured again gets others."""
    scored = {
        int(seed)
        for held_out in _known(ledger)
        if held_out.startswith(f"{benchmark}, seeds ")
        for seed in re.findall(r"\d+", held_out.removeprefix(benchmark))
    }
    drawn = drawn_seeds(benchmark, count + len(scored), hash_of_commit)
    return [seed for seed in drawn if seed not in scored][:count]


def seeds_or_drawn(benchmark: str, seeds: Sequence[int], count: int) -> list[int]:
    """The seeds given, else `count` fresh ones."""
    return list(seeds) or fresh_seeds(benchmark, count)


def note_scoring(held_out: str, ledger: Path = SCORED) -> dict[str, str | int]:
    """Count one more scoring of a held-out set; what a result file holds of it: `held_out` and `times_scored`."""
    known = _known(ledger)
    known[held_out] = known.get(held_out, 0) + 1
    ledger.parent.mkdir(exist_ok=True)
    ledger.write_text(json.dumps(dict(sorted(known.items())), indent=1) + "\n", encoding="utf-8")
    return {"held_out": held_out, "times_scored": known[held_out]}


def _known(ledger: Path) -> dict[str, int]:
    return json.loads(ledger.read_text(encoding="utf-8")) if ledger.is_file() else {}


def _git(repository: Path, *words: str) -> str:
    done = subprocess.run(
        ["git", *words], cwd=repository, capture_output=True, text=True, check=False
    )
    return done.stdout.strip() if done.returncode == 0 else ""
