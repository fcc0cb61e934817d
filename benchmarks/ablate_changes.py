"""Switch the rules of change detection off, one at a time or together, on flights that nobody has met.

    python benchmarks/ablate_changes.py --work build/ablation --out benchmarks/results/ablate_changes.json

Each pair of flights is simulated with a seed drawn from the commit's hash, mapped and compared once. Its compared views
stay in memory; the evidence is gathered again under each rule. `found` of those that `must` be found, `false` and
`twice` are those of `sorvolo evaluate changes`.
"""

import argparse
import hashlib
import json
import subprocess
from contextlib import ExitStack
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from sorvolo.lab.evaluation import changes as evaluation
from sorvolo.lab.evaluation.change_metrics import FoundEvent, match_events, score_events
from sorvolo.lab.simulation.presets import preset
from sorvolo.lab.simulation.site import simulate_site
from sorvolo.missions.compare import run
from sorvolo.missions.compare.flights import compare_flights
from sorvolo.missions.flight.settings import CompareSettings, MapSettings
from sorvolo.missions.map.flights import map_flights

# preset, metres of strip, m per pixel of the map (None: as fine as the flight)
FLIGHTS = (("compare-urban", 25, None), ("compare-dirt", 25, None), ("compare-photos", 40, 0.12))


def _no(*_: Any) -> bool:
    return False


# what switches a rule off: module:name in sorvolo.change, and what stands in for it
RULES: dict[str, dict[str, Any]] = {
    "one view alone": {"gathered:GatheredThings.shows_once": _no},
    "shadows that moved": {"gathered:GatheredThings.is_moved_shadow": _no},
    "things parted": {"candidate:things_of": lambda _, kind, changed: [(changed, kind)]},
    "what passes by": {
        "evidence:_is_passing": _no,
        "evidence:_passing_cells": lambda _, own: np.zeros_like(own),
    },
    "movers take views back": {
        "announcing:Tally.less": lambda tally, _: tally,
        "evidence:EvidenceMap._named": lambda evidence, _: (evidence._next_number(), None),
    },
    "rigid blobs": {"motion:is_rigid": _no},
    "floating blobs": {"motion:floats": _no},
    "what may move must stand": {"evidence:EvidenceMap._stands": lambda *_: True},
    "restless ground": {"announcing:_RESTLESS_HALF": np.inf},
    "from one place": {"announcing:_ONE_PLACE": 0.0},
    "large must be sure": {"announcing:_LARGE_SCORE": 0.0},
}


class Recorder(run.FlightChanges):
    """The changes of a flight, with what they are made of."""

    arguments: tuple[Any, ...] = ()
    views: tuple[Any, ...] = ()

    def __init__(self, *arguments: Any) -> None:
        Recorder.arguments, Recorder.views = arguments, ()
        super().__init__(*arguments)

    def add(self, view: Any, leans: Any) -> Any:
        """Keep the view, and take it in."""
        Recorder.views += ((view, leans),)
        return super().add(view, leans)


def compare(folder: Path, name: str, length_m: int, m_per_px: float | None, seed: int) -> list[Any]:
    """Simulate, map and compare a pair of flights: its true events, and m2 compared."""
    settings = replace(preset(name), seed=seed)
    settings = replace(
        settings,
        path=replace(settings.path, length_m=float(length_m)),
        imaging=replace(settings.imaging, fps=5.0),
        output=replace(settings.output, truth_step=1),
    )
    simulation, site = folder / "simulation", folder / "site"
    list(simulate_site(simulation, settings))
    flights = [
        next(path.glob("*.mp4"), path / "photos") for path in sorted(simulation.glob("flight*"))
    ]
    camera, mapping = simulation / "camera.xml", MapSettings(model="none", m_per_px=m_per_px)
    list(map_flights(flights[:1], site, mapping, camera=camera))
    with mock.patch.object(run, "FlightChanges", Recorder):
        list(compare_flights(flights[1:], site, CompareSettings(model="none"), camera=camera))
    with (
        mock.patch.object(evaluation, "match_events", side_effect=match_events) as matched,
        mock.patch.object(evaluation, "score_events", side_effect=score_events) as scored,
    ):
        evaluation.evaluate_changes(site, simulation)
    return [matched.call_args.args[1], scored.call_args.args[1]]


def counted(true: Any, area_m2: float, switches: dict[str, Any]) -> dict[str, int]:
    """Gather the recorded views again with a rule switched off, and match the changes with the truth."""
    with ExitStack() as stack:
        for place, value in switches.items():
            module, _, name = place.partition(":")
            target: Any = import_module(f"sorvolo.change.{module}")
            *path, last = name.split(".")
            for part in path:
                target = getattr(target, part)
            stack.enter_context(mock.patch.object(target, last, value))
        changes = run.FlightChanges(*Recorder.arguments)
        for view, leans in Recorder.views:
            changes.add(view, leans)
        found = run.reported(changes.conclude(), 0.0, [])
    events = [FoundEvent(each.id, each.kind, each.outline_m, each.sigma_m) for each in found]
    scores = score_events(match_events(events, true), area_m2)
    counts = {"found": scores.found, "must": scores.must_find, "false": scores.false}
    return counts | {"twice": scores.twice, "events": len(events)}


def main() -> None:
    """Print and write what each rule changes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--rules", nargs="*", default=list(RULES), help="switched off singly")
    parser.add_argument("--together", nargs="*", default=[], help="switched off at once")
    options = parser.parse_args()
    head = subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True, check=True)
    commit = head.stdout.strip()
    rules: dict[str, list[str]] = {"all rules": []} | {name: [name] for name in options.rules}
    if options.together:
        rules["without " + ", ".join(options.together)] = options.together
    rows: dict[str, dict[str, Any]] = {name: {} for name in rules}
    for name, length_m, m_per_px in FLIGHTS:
        seed = int(hashlib.sha256(f"{commit} {name}".encode()).hexdigest()[:6], 16)
        truth = compare(options.work / name, name, length_m, m_per_px, seed)
        for rule, off in rules.items():
            switches = {place: value for each in off for place, value in RULES[each].items()}
            rows[rule][name] = counted(*truth, switches)
            print(name, rule, rows[rule][name], flush=True)
            options.out.write_text(json.dumps({"seeds_from": commit, "rows": rows}, indent=1))


if __name__ == "__main__":
    main()
