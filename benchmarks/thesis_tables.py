"""The thesis's chapter 4 on simulated videos of its three environments, with seeds that nobody has seen before.

python benchmarks/thesis_tables.py [SEED...] [--length 24] [--videos 1] [--train-steps 150] [--work DIR] [--output FILE]

What `sorvolo reproduce --simulated` does, with the provenance of a benchmark. Each seed simulates a dataset in UMCD's
layout, `--videos` paths of each environment with telemetry and one without, cut to `--length` metres. `--work` keeps
datasets, maps and pages; a run that was stopped goes on there with the same seeds, which the commit's hash else draws.
"""

import argparse
import json
import os
import tempfile
from dataclasses import asdict
from pathlib import Path

from rich.console import Console

from provenance import commit, machine, note_scoring, seeds_or_drawn
from sorvolo.lab.thesis.report import write_reproduction
from sorvolo.lab.thesis.rows import Row
from sorvolo.lab.thesis.run import reproduce
from sorvolo.lab.thesis.settings import ReproductionSettings, SimulatedSize
from sorvolo.lab.thesis.sheets import reproduction_sheets
from sorvolo.lab.thesis.simulated import simulated_dataset
from sorvolo.lab.thesis.tables import tables_of
from sorvolo.lab.training.settings import TrainSettings
from sorvolo.store.exports.plain import plain_json

RESULTS = Path(__file__).parent / "results" / "thesis_tables.json"


def main() -> None:
    """Simulate, reproduce, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("seeds", type=int, nargs="*", help="else one drawn from the commit's hash")
    parser.add_argument("--length", type=float, default=24.0, help="of a path, m")
    parser.add_argument(
        "--videos", type=int, default=1, help="paths with telemetry, of each environment"
    )
    parser.add_argument("--train-steps", type=int, default=150, help="of each network of Table 4.6")
    parser.add_argument("--work", type=Path, help="folder that stays, with a page for each seed")
    parser.add_argument("--output", type=Path, default=RESULTS)
    options = parser.parse_args()
    seeds = seeds_or_drawn("thesis_tables", options.seeds, 1)
    size, steps = SimulatedSize(options.length), options.train_steps
    training = TrainSettings("thesis", steps=steps, batch=4, patience=0) if steps else None
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as scratch:
        work = options.work or Path(scratch)
        for seed in seeds:
            settings = ReproductionSettings(options.videos, seed=seed, training=training)
            rows += reproduced(work / str(seed), settings, size)
    tables = plain_json(tables_of(rows))
    result = {
        "benchmark": "thesis_tables",
        "machine": machine(),
        "load_1_min": os.getloadavg()[0],
        "commit": commit(),
        **note_scoring(f"thesis_tables, seeds {' '.join(map(str, seeds))}"),
        "seeds": seeds,
        "simulated": asdict(size),
        "videos": options.videos,
        "tables": tables,
        "missing": [{"id": row.id, "reason": row.missing} for row in rows if row.missing],
    }
    options.output.write_text(json.dumps(result, indent=1) + "\n")
    for sheet in reproduction_sheets(tables):
        Console().print(sheet.markdown, markup=False, soft_wrap=True, highlight=False)


def reproduced(folder: Path, settings: ReproductionSettings, size: SimulatedSize) -> list[Row]:
    """The rows of one simulated dataset; tables and page are left in the folder."""
    place = folder / "dataset"
    for name, step in simulated_dataset(place, size, settings):
        if step.stage == "truth":
            print(f"simulated {name}, {step.flight}", flush=True)
    rows = []
    for update in reproduce(place, folder, settings, is_whole=False):
        rows.append(update.row)
        print(f"{update.done} of {update.total}: {update.row.id} {update.row.missing}", flush=True)
    write_reproduction(folder, rows, place, settings, size)
    return rows


if __name__ == "__main__":
    main()
