"""How many frames a second a model looks at, from the frame's pixels to its detections, on two cores.

python benchmarks/detector_speed.py MODEL... [--threads 2] [--eager PRESET ...] [--frames 40]

Frames are those of a simulated flight over a town, 1280x720, and their middle 640x640. `--eager fast` times the same
shape of network in eager PyTorch beside them (untrained: it looks at as many regions), frame by frame in turn, so that
a busy machine slows all alike. "with_decoding" reads the same flight as a 1280x720 H.264 video and detects frame after
frame, without overlap. Written to results/detector_speed.json.
"""

import argparse
import json
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from mosaic_methods import commit, machine
from sorvolo.capture.source import open_sources
from sorvolo.detection.detector import Detector
from sorvolo.mosaic.selection import every
from sorvolo.simulation.flight import simulate_flight
from sorvolo.simulation.presets import preset
from sorvolo.store.flight_files import video_writer
from sorvolo.survey.flight import Frame
from sorvolo.survey.objects import CLASSES

RESULTS = Path(__file__).parent / "results" / "detector_speed.json"
SEED, WARM = 401, 3
SIZES_PX = ((640, 640), (1280, 720))


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", nargs="+", help="names or files")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--provider", default="auto")
    parser.add_argument("--eager", nargs="*", default=[], help="presets to time in eager PyTorch as well")
    parser.add_argument("--frames", type=int, default=40)
    options = parser.parse_args()
    cv2.setNumThreads(options.threads)
    frames = town(options.frames)
    detectors = {
        name: Detector.load(name, provider=options.provider, threads=options.threads) for name in options.models
    }
    looks: dict[str, Callable] = {Path(name).name: each.detect for name, each in detectors.items()}
    looks |= {f"eager {name}": eager(name, options.threads) for name in options.eager}
    runs = {}
    for width, height in SIZES_PX:
        pictures = [cropped(frame, width, height) for frame in frames]
        runs[f"{width}x{height}"] = timed(looks, pictures)
        print(f"{width}x{height}", runs[f"{width}x{height}"], flush=True)
    with tempfile.TemporaryDirectory() as folder:
        video = Path(folder) / "town.mp4"
        with video_writer(video, (1280, 720), 30.0, 0, 23) as write:
            for frame in frames:
                write(frame)
        decoded = {Path(name).name: with_decoding(each, video) for name, each in detectors.items()}
    print("with decoding", decoded, flush=True)
    RESULTS.write_text(json.dumps({
        "benchmark": "detector_speed", "machine": machine(), "commit": commit(), "seed": SEED,
        "threads": options.threads, "frames": len(frames),
        "providers": {Path(name).name: each.provider for name, each in detectors.items()},
        "sizes": runs, "with_decoding_1280x720": decoded,
    }, indent=1) + "\n")


def town(count: int) -> list[np.ndarray]:
    """So many frames of a flight over a town, evenly chosen."""
    settings = replace(preset("compare-urban"), seed=SEED)
    flight = simulate_flight(replace(settings, scene=replace(settings.scene, people=12, cars=10, small_objects=10)))
    return [flight.frame(int(index)).image for index in np.linspace(0, len(flight) - 1, count)]


def cropped(frame: np.ndarray, width: int, height: int) -> np.ndarray:
    """The middle of a frame."""
    top, left = (frame.shape[0] - height) // 2, (frame.shape[1] - width) // 2
    return np.ascontiguousarray(frame[top:top + height, left:left + width])


def timed(looks: dict[str, Callable], pictures: list[np.ndarray]) -> dict[str, dict[str, float]]:
    """Frame by frame, each of the rivals in turn; the first few are not counted."""
    seconds: dict[str, list[float]] = {name: [] for name in looks}
    for picture in [*pictures[:WARM], *pictures]:
        for name, look in looks.items():
            started = time.perf_counter()
            look(picture)
            seconds[name].append(time.perf_counter() - started)
    told = {}
    for name, each in seconds.items():
        counted = 1e3 * np.array(each[WARM:])
        low, middle, high = np.percentile(counted, (5, 50, 95))
        told[name] = {
            "median_ms": round(float(middle), 1), "p5_ms": round(float(low), 1), "p95_ms": round(float(high), 1),
            "frames_per_second": round(1e3 / float(middle), 1),
        }
    return told


def with_decoding(detector: Detector, video: Path) -> dict[str, float]:
    """Frames a second of decoding and detecting one after the other."""
    source = open_sources([video], None, None)[0]
    started, count = time.perf_counter(), 0
    for frame in source.frames(every(0.0)):
        if isinstance(frame, Frame):
            detector.detect(frame.image)
            count += 1
    return {"frames": count, "frames_per_second": round(count / (time.perf_counter() - started), 1)}


def eager(name: str, threads: int) -> Callable[[np.ndarray], object]:
    """The preset's network in eager PyTorch, untrained, as a function of a picture."""
    import torch

    from sorvolo.training.presets import build

    torch.set_num_threads(threads)
    rpn = "extended" if name == "thesis" else "extended-residual"
    model = build(name, CLASSES, rpn, None).eval()

    def look(picture: np.ndarray) -> object:
        height, width = (-(-side // model.stride) * model.stride for side in picture.shape[:2])
        padded = np.zeros((height, width, 3), np.uint8)
        padded[:picture.shape[0], :picture.shape[1]] = picture
        with torch.inference_mode():
            return model(torch.from_numpy(np.ascontiguousarray(padded.transpose(2, 0, 1)))[None])

    return look


if __name__ == "__main__":
    main()
