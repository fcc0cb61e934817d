"""Result files name what they measured: a dirty tree, seeds nobody has seen, how often a set was scored."""

import importlib.util
import json
import subprocess
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture(scope="module")
def provenance() -> ModuleType:
    spec = importlib.util.spec_from_file_location("provenance", BENCHMARKS / "provenance.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def repository(tmp_path: Path) -> Path:
    (tmp_path / "benchmarks" / "results").mkdir(parents=True)
    (tmp_path / "code.py").write_text("x = 1\n")
    (tmp_path / "benchmarks" / "results" / "one.json").write_text("{}\n")
    git(tmp_path, "init", "-q")
    git(tmp_path, "add", "-A")
    git(tmp_path, "-c", "user.name=a", "-c", "user.email=a@b", "commit", "-qm", "first")
    return tmp_path


def git(folder: Path, *words: str) -> None:
    subprocess.run(["git", *words], cwd=folder, check=True)


def test_a_tree_that_differs_from_its_commit_is_dirty(
    provenance: ModuleType, repository: Path
) -> None:
    clean = provenance.commit(repository)
    assert len(clean) >= 7 and "-" not in clean
    (repository / "benchmarks" / "results" / "one.json").write_text("[]\n")
    assert provenance.commit(repository) == clean  # results are what a benchmark writes
    (repository / "code.py").write_text("x = 2\n")
    assert provenance.commit(repository) == f"{clean}-dirty"


def test_seeds_follow_from_the_commit_and_the_benchmark(provenance: ModuleType) -> None:
    seeds = provenance.drawn_seeds("change_events", 3, "abc1234")
    assert seeds == provenance.drawn_seeds("change_events", 3, "abc1234-dirty")
    assert provenance.drawn_seeds("change_events", 5, "abc1234")[:3] == seeds
    assert len(set(seeds)) == 3 and min(seeds) >= 1_000_000
    assert not set(seeds) & set(provenance.drawn_seeds("change_events", 3, "abc1235"))
    assert not set(seeds) & set(provenance.drawn_seeds("watch_counts", 3, "abc1234"))
    assert provenance.seeds_or_drawn("change_events", [7], 3) == [7]


def test_seeds_that_were_scored_are_not_drawn_again(provenance: ModuleType, tmp_path: Path) -> None:
    ledger = tmp_path / "scored.json"
    first, second, third = provenance.drawn_seeds("change_events", 3, "abc1234")
    assert provenance.fresh_seeds("change_events", 2, "abc1234", ledger) == [first, second]
    provenance.note_scoring(f"change_events, seeds {first} {second}", ledger)
    provenance.note_scoring(f"watch_counts, seeds {third}", ledger)
    assert provenance.fresh_seeds("change_events", 1, "abc1234", ledger) == [third]


def test_each_scoring_of_a_held_out_set_counts(provenance: ModuleType, tmp_path: Path) -> None:
    ledger = tmp_path / "results" / "scored.json"
    assert provenance.note_scoring("a set", ledger) == {"held_out": "a set", "times_scored": 1}
    assert provenance.note_scoring("another", ledger)["times_scored"] == 1
    assert provenance.note_scoring("a set", ledger)["times_scored"] == 2
    assert json.loads(ledger.read_text()) == {"a set": 2, "another": 1}


@pytest.mark.parametrize("name", ["change_events", "watch_counts", "watch_counts_detector"])
def test_published_scores_state_how_often_their_set_was_scored(name: str) -> None:
    result = json.loads((BENCHMARKS / "results" / f"{name}.json").read_text())
    ledger = json.loads((BENCHMARKS / "results" / "scored.json").read_text())
    assert 1 <= result["times_scored"] <= ledger[result["held_out"]]


def test_each_result_states_what_was_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    """A commit; where the code differed from it, also what is known of the difference."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    commits = dict(importlib.import_module("quick_tables").measured_at(BENCHMARKS / "results"))
    unnamed = {name for name, found in commits.items() if not found}
    assert not unnamed
    for name, found in commits.items():
        if any(each.endswith("-dirty") for each in found):
            for part in _dirty_parts(json.loads((BENCHMARKS / "results" / name).read_text())):
                assert part.get("note") or part.get("remark"), (name, part["commit"])


def _dirty_parts(value: Any) -> Iterator[dict[str, Any]]:
    parts = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    if isinstance(value, dict) and str(value.get("commit")).endswith("-dirty"):
        yield value
    for each in parts:
        yield from _dirty_parts(each)
