"""How many frames a second a model looks at, from the frame's pixels to its detections, on two cores.

python benchmarks/detector_speed.py MODEL... [--threads 2] [--eager PRESET ...] [--frames 40]
python benchmarks/detector_speed.py --untrained thesis:100 [--sizes 640x640] [--out detector_speed_thesis.json]

Frames are those of a simulated flight over a town, 1280x720, and their middle 640x640. `--eager fast` times the same
shape of network in eager PyTorch beside them (untrained: it looks at as many regions), frame by frame in turn, so that
a busy machine slows all alike. "with_decoding" reads the same flight as a 1280x720 H.264 video and detects frame after
frame, without overlap. `--untrained thesis:100` exports that preset with random weights and 100 regions and times the
file in float32 and in int8 beside the same network in eager PyTorch. Beside the time by the clock stands the
processor's, which a busy machine hardly changes: with `--threads 1` it is what a frame costs. Written to results/.
"""

import argparse
import json
import os
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from mosaic_methods import commit, machine
from sorvolo.capture.source import open_sources
from sorvolo.detection.detector import Detector
from sorvolo.detection.quantise import quantise
from sorvolo.lab.simulation.flight import simulate_flight
from sorvolo.lab.simulation.presets import preset
from sorvolo.mosaic.selection import every
from sorvolo.store.exports.flight_files import video_writer
from sorvolo.survey.flight import Frame
from sorvolo.survey.objects import CLASSES

RESULTS = Path(__file__).parent / "results"
SEED = 401
CALIBRATION, CALIBRATION_PX = (
    8,
    256,
)  # how fast eight bits are does not depend on the pictures that scale them


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("models", nargs="*", help="names or files")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--provider", default="auto")
    parser.add_argument(
        "--eager", nargs="*", default=[], help="presets to time in eager PyTorch as well"
    )
    parser.add_argument(
        "--untrained",
        nargs="*",
        default=[],
        metavar="PRESET:REGIONS",
        help="random weights, exported",
    )
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--warm", type=int, default=3, help="frames first that are not counted")
    parser.add_argument("--sizes", nargs="+", default=["640x640", "1280x720"])
    parser.add_argument("--out", default="detector_speed.json")
    options = parser.parse_args()
    cv2.setNumThreads(options.threads)
    frames = town(options.frames)
    detectors = {
        name: Detector.load(name, provider=options.provider, threads=options.threads)
        for name in options.models
    }
    looks: dict[str, Callable] = {Path(name).name: each.detect for name, each in detectors.items()}
    looks |= {f"eager {name}": eager(untrained(name), options.threads) for name in options.eager}
    providers = {Path(name).name: each.provider for name, each in detectors.items()}
    for spec in options.untrained:
        own, where = exported(spec, options.provider, options.threads, frames)
        looks, providers = looks | own, providers | where
    runs = {}
    load = [os.getloadavg()[0]]
    for size in options.sizes:
        width, height = map(int, size.split("x"))
        runs[size] = timed(looks, [cropped(frame, width, height) for frame in frames], options.warm)
        print(size, json.dumps(runs[size], indent=1), flush=True)
    load.append(os.getloadavg()[0])
    decoded = {}
    if detectors:
        with tempfile.TemporaryDirectory() as folder:
            video = Path(folder) / "town.mp4"
            with video_writer(video, (1280, 720), 30.0, 0, 23) as write:
                for frame in frames:
                    write(frame)
            decoded = {
                Path(name).name: with_decoding(each, video) for name, each in detectors.items()
            }
        print("with decoding", decoded, flush=True)
    (RESULTS / options.out).write_text(
        json.dumps(
            {
                "benchmark": "detector_speed",
                "machine": machine(),
                "commit": commit(),
                "seed": SEED,
                "threads": options.threads,
                "frames": len(frames),
                "load_average_before_and_after": load,
                "providers": providers,
                "sizes": runs,
                "with_decoding_1280x720": decoded,
            },
            indent=1,
        )
        + "\n"
    )


def town(count: int) -> list[np.ndarray]:
    """So many frames of a flight over a town, evenly chosen."""
    settings = replace(preset("compare-urban"), seed=SEED)
    flight = simulate_flight(
        replace(settings, scene=replace(settings.scene, people=12, cars=10, small_objects=10))
    )
    return [flight.frame(int(index)).image for index in np.linspace(0, len(flight) - 1, count)]


def cropped(frame: np.ndarray, width: int, height: int) -> np.ndarray:
    """The middle of a frame."""
    top, left = (frame.shape[0] - height) // 2, (frame.shape[1] - width) // 2
    return np.ascontiguousarray(frame[top : top + height, left : left + width])


def timed(
    looks: dict[str, Callable], pictures: list[np.ndarray], warm: int
) -> dict[str, dict[str, float]]:
    """Frame by frame, each of the rivals in turn; the first few are not counted."""
    seconds: dict[str, list[tuple[float, float]]] = {name: [] for name in looks}
    for picture in [*pictures[:warm], *pictures]:
        for name, look in looks.items():
            started, spent = time.perf_counter(), time.process_time()
            look(picture)
            seconds[name].append((time.perf_counter() - started, time.process_time() - spent))
    measured = {}
    for name, each in seconds.items():
        (low, middle, high), processor = np.percentile(
            1e3 * np.array(each[warm:]), (5, 50, 95), axis=0
        ).T
        measured[name] = {
            "median_ms": round(float(middle), 1),
            "p5_ms": round(float(low), 1),
            "p95_ms": round(float(high), 1),
            "frames_per_second": round(1e3 / float(middle), 1),
        } | {
            f"processor_{key}_ms": round(float(value), 1)
            for key, value in zip(("p5", "median", "p95"), processor)
        }
    return measured


def with_decoding(detector: Detector, video: Path) -> dict[str, float]:
    """Frames a second of decoding and detecting one after the other."""
    source = open_sources([video], None, None)[0]
    started, count = time.perf_counter(), 0
    for frame in source.frames(every(0.0)):
        if isinstance(frame, Frame):
            detector.detect(frame.image)
            count += 1
    return {"frames": count, "frames_per_second": round(count / (time.perf_counter() - started), 1)}


def untrained(spec: str) -> Any:
    """The network of "preset" or "preset:regions" with random weights."""
    import torch

    from sorvolo.lab.training.presets import build

    name, _, regions = spec.partition(":")
    torch.manual_seed(SEED)
    model = build(
        name, CLASSES, "extended" if name == "thesis" else "extended-residual", None
    ).eval()
    if regions:
        model.reach = replace(model.reach, regions=int(regions))
    return model


def eager(model: Any, threads: int) -> Callable[[np.ndarray], object]:
    """A network in eager PyTorch as a function of a picture."""
    import torch

    def look(picture: np.ndarray) -> object:
        torch.set_num_threads(threads)
        height, width = (-(-side // model.stride) * model.stride for side in picture.shape[:2])
        padded = np.zeros((height, width, 3), np.uint8)
        padded[: picture.shape[0], : picture.shape[1]] = picture
        with torch.inference_mode():
            return model(torch.from_numpy(np.ascontiguousarray(padded.transpose(2, 0, 1)))[None])

    return look


def exported(
    spec: str, provider: str, threads: int, frames: list[np.ndarray]
) -> tuple[dict[str, Callable], dict[str, str]]:
    """An untrained network as a file of float32, one of int8, and in eager PyTorch, all on one thread and on `threads`.

    With where the files run.
    """
    import torch

    from sorvolo.lab.training.onnx_export import export_onnx

    model = untrained(spec)
    norms = [each for each in model.modules() if isinstance(each, torch.nn.BatchNorm2d)]
    # untrained scores are all alike, and few regions remain; norms that have seen a picture make them differ
    for norm in norms:
        norm.train()
        norm.momentum = None
    eager(model, threads)(cropped(frames[0], CALIBRATION_PX, CALIBRATION_PX))
    model.eval()
    info = {
        "name": spec,
        "classes": list(CLASSES),
        "thresholds": dict.fromkeys(CLASSES, 0.5),
        "best_px": dict.fromkeys(CLASSES, (8, 200)),
    }
    looks: dict[str, Callable] = {}
    providers = {}
    with tempfile.TemporaryDirectory() as folder:
        whole, small = (Path(folder) / f"{precision}.onnx" for precision in ("float32", "int8"))
        whole.write_bytes(export_onnx(model, info))
        chosen = np.linspace(0, len(frames) - 1, CALIBRATION).astype(int)
        pictures = (cropped(frames[index], CALIBRATION_PX, CALIBRATION_PX) for index in chosen)
        small.write_bytes(quantise(whole, pictures).model)
        for count in sorted({1, threads}):
            for path in (whole, small):
                name = f"{spec} {path.stem}, threads: {count}"
                detector = Detector.load(path, provider=provider, threads=count)
                looks[name], providers[name] = detector.detect, detector.provider
            looks[f"{spec} eager, threads: {count}"] = eager(model, count)
    return looks, providers


if __name__ == "__main__":
    main()
