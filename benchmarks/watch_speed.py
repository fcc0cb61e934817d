"""How fast a watch is from the video's file to the last line written, with a model that runs, and what takes the time.

python benchmarks/watch_speed.py [--model default] [--frames 200] [--save none] [--output FILE]

A simulated flight is watched at 640x640 and at 1280x720: every frame decoded, searched, placed, tracked and written.
The median of three runs, and their spread.
"""

import argparse
import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from provenance import commit, machine
from sorvolo.detection.detector import Detector
from sorvolo.lab.simulate.site import simulate_site
from sorvolo.lab.simulation.settings import (
    ImagingSettings,
    OutputSettings,
    PathSettings,
    SceneSettings,
    SimulationSettings,
)
from sorvolo.missions.watch.flights import watch
from sorvolo.missions.watch.settings import WatchOutputs, WatchSettings

RESULTS = Path(__file__).parent / "results" / "watch_speed.json"
_SIZES = ((640, 640), (1280, 720))
_RUNS = 3


def main() -> None:
    """Watch both flights and write the figures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--model", default="default")
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--save", choices=("none", "video", "pictures"), default="none")
    parser.add_argument("--output", type=Path, default=RESULTS)
    options = parser.parse_args()
    detector = Detector.load(options.model)
    result: dict[str, Any] = {
        "benchmark": "watch_speed",
        "machine": machine(),
        "commit": commit(),
        "model": detector.info.name,
        "model_version": detector.info.version,
        "runs_on": detector.provider,
        "save": options.save,
        "sizes": {
            f"{width}x{height}": measured(width, height, detector, options.frames, options.save)
            for width, height in _SIZES
        },
    }
    options.output.parent.mkdir(exist_ok=True)
    options.output.write_text(json.dumps(result, indent=1) + "\n")
    print(json.dumps(result, indent=1))


def measured(width: int, height: int, detector: Detector, frames: int, save: Any) -> dict[str, Any]:
    """Frames a second over all, and the last run's stages."""
    fps = 25.0
    settings = SimulationSettings(
        seed=5,
        flights=1,
        scene=SceneSettings(people=6, cars=4, small_objects=4),
        path=PathSettings(height_m=30, speed_m_s=6, length_m=6 * frames / fps, strips=1),
        imaging=ImagingSettings(width_px=width, height_px=height, fps=fps),
        output=OutputSettings(truth_step=1_000_000),
    )
    with tempfile.TemporaryDirectory() as scratch:
        simulated = Path(scratch) / "simulated"
        for _ in simulate_site(simulated, settings):
            pass
        rates, report = [], {}
        for _ in range(_RUNS):
            folder = Path(scratch) / "watch"
            watching = watch(
                simulated / "flight1" / "flight1.mp4",
                WatchSettings(every=1),
                WatchOutputs(folder=folder, save=save),
                camera=simulated / "camera.xml",
                detector=detector,
            )
            for _ in watching:
                pass
            report = json.loads((folder / "report.json").read_text())
            rates.append(report["frames_per_second"])
    return {
        "frames": report["frames"]["detected"],
        "frames_per_second": float(np.median(rates)),
        "spread": [min(rates), max(rates)],
        "latency_s": report["latency_s"],
        "seconds": report["seconds"],
        "peak_memory_mb": report["peak_memory_mb"],
        "objects": report["objects"]["by_class"],
    }


if __name__ == "__main__":
    main()
