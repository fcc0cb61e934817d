"""What a first, smaller look at a frame would show of what the whole search finds, and what both take.

python benchmarks/first_look.py [--heights 30 40 60] [--model default-int8] [--seeds N N N]

For boxes beside live video (docs/station.md): a smaller copy is searched in a fraction of the time. Simulated flights
straight down, 1920 x 1080, a frame a second, seeds drawn from the commit. Found: a box with an IoU of 0.3 or more, of
objects that are whole in the frame; false: one that meets no object of its class. Processor time, one thread.
"""

import argparse
import json
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import av
import numpy as np

from provenance import commit, drawn_seeds, machine
from sorvolo.capture.source import open_sources
from sorvolo.detection.calibration import in_own_scale
from sorvolo.detection.detector import Detector
from sorvolo.detection.session import Seen
from sorvolo.detection.tiling import whole_m_per_px
from sorvolo.geometry.arrays import BoxesPx, ImageRGB
from sorvolo.geometry.box_overlap import iou_matrix
from sorvolo.lab.simulate.site import simulate_site
from sorvolo.lab.simulation.settings import (
    ImagingSettings,
    OutputSettings,
    PathSettings,
    SceneSettings,
    SimulationSettings,
)

RESULTS = Path(__file__).parent / "results" / "first_look.json"
_CLASSES = ("person", "car")
_FRAMES, _SIZE = 30, (1920, 1080)
_FOUND_IOU, _MET_IOU = 0.3, 0.1

Boxes = dict[str, BoxesPx]


def main() -> None:
    """Search each flight in each way and write the figures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--heights", type=float, nargs="+", default=[30.0, 40.0, 60.0])
    parser.add_argument("--model", default="default-int8")
    parser.add_argument(
        "--seeds", type=int, nargs="+", default=[], help="one for each height; drawn without it"
    )
    parser.add_argument("--output", type=Path, default=RESULTS)
    options = parser.parse_args()
    seeds = options.seeds or drawn_seeds("first_look", len(options.heights))
    detector = Detector.load(options.model, threads=1)
    flights = {}
    with tempfile.TemporaryDirectory() as scratch:
        for seed, height_m in zip(seeds, options.heights, strict=True):
            folder = flown(Path(scratch) / f"{height_m:g}", seed, height_m)
            flights[f"{height_m:g} m"] = compared(folder, height_m, detector)
    result = {
        "benchmark": "first_look",
        "machine": machine(),
        "commit": commit(),
        "model": options.model,
        "seeds": seeds,
        "frames": _FRAMES,
        "size": _SIZE,
        "flights": flights,
    }
    options.output.write_text(json.dumps(result, indent=1) + "\n")
    print(json.dumps(result, indent=1))


def flown(folder: Path, seed: int, height_m: float) -> Path:
    """A simulated strip with people and cars, its boxes known in every frame."""
    settings = SimulationSettings(
        seed=seed,
        flights=1,
        scene=SceneSettings(people=40, cars=20, small_objects=0),
        path=PathSettings(height_m=height_m, speed_m_s=8, length_m=8 * _FRAMES, strips=1),
        imaging=ImagingSettings(width_px=_SIZE[0], height_px=_SIZE[1], fps=1.0),
        output=OutputSettings(truth_step=1),
    )
    for _ in simulate_site(folder, settings):
        pass
    return folder


def compared(folder: Path, height_m: float, detector: Detector) -> dict[str, Any]:
    """By way of searching: found, missed and false by class, and the processor time of a frame, s."""
    video = folder / "flight1" / "flight1.mp4"
    camera = open_sources([str(video)], None, str(folder / "camera.xml"))[0].camera.camera
    m_per_px = height_m / camera.fx_px
    ways: dict[str, Callable[[ImageRGB], Boxes]] = {
        "whole search": partial(searched, detector, m_per_px),
        "half size": partial(glanced, detector, again=False),
        "half size, reports looked at again": partial(glanced, detector, again=True),
    }
    counts = {name: Counter[str]() for name in ways}
    for image, truth in frames(video, folder / "truth" / "flight1" / "boxes.json"):
        for name, way in ways.items():
            began_s = time.process_time()
            found = way(image)
            counts[name]["cpu_ms"] += round(1000 * (time.process_time() - began_s))
            for each in _CLASSES:
                counts[name].update(judged(each, truth[each], found[each]))
            counts[name]["frames"] += 1
    return {"cm_per_px": round(100 * m_per_px, 2)} | {
        name: {"cpu_s_a_frame": round(count["cpu_ms"] / 1000 / count["frames"], 3)}
        | {
            each: {what: count[f"{each} {what}"] for what in ("objects", "found", "false")}
            for each in _CLASSES
        }
        for name, count in counts.items()
    }


def searched(detector: Detector, m_per_px: float, image: ImageRGB) -> Boxes:
    """What a watch of this flight reports."""
    scale = whole_m_per_px(detector.info, _CLASSES, m_per_px, image.shape[:2])
    found = detector.detect(image, tiles="auto", m_per_px=scale, classes=_CLASSES)
    return {name: found.boxes_px[[each == name for each in found.names]] for name in _CLASSES}


def glanced(detector: Detector, image: ImageRGB, *, again: bool) -> Boxes:
    """What a copy of half the size shows, by the same thresholds; `again`: reports are looked at a second time."""
    session, info = (
        detector._session,
        detector.info,
    )  # the look that nothing offers, as it was not worth it
    seen: Seen = session.see(image, 0.5)
    if again:
        seen = detector._seen_again(session, image, seen, _CLASSES)
    own = in_own_scale(info)
    least = np.array([own[each] for each in info.classes])
    kept = seen.scores >= least[seen.labels]
    return {
        name: seen.boxes_px[kept & (seen.labels == info.classes.index(name))] for name in _CLASSES
    }


def frames(video: Path, truth: Path) -> Iterator[tuple[ImageRGB, Boxes]]:
    """Each frame with the boxes in it."""
    known = json.loads(truth.read_text())
    names = {each["id"]: each["name"] for each in known["categories"]}
    with av.open(str(video)) as container:
        for number, frame in enumerate(container.decode(video=0)):
            image = next((each["id"] for each in known["images"] if each["frame"] == number), None)
            boxes: dict[str, list[list[float]]] = {name: [] for name in _CLASSES}
            for each in known["annotations"]:
                left, top, width, height = each["bbox"]
                if (
                    each["image_id"] == image
                    and names[each["category_id"]] in boxes
                    and width * height > 0
                ):
                    boxes[names[each["category_id"]]].append(
                        [left, top, left + width, top + height]
                    )
            arrays = {
                name: np.array(rows, np.float32).reshape(-1, 4) for name, rows in boxes.items()
            }
            yield frame.to_ndarray(format="rgb24"), arrays


def judged(name: str, truth: BoxesPx, found: BoxesPx) -> Counter[str]:
    """How many objects of a class a frame shows whole, how many were found, how many reports are false."""
    whole = (truth[:, :2] > 2).all(axis=1) & (truth[:, 2:] < np.array(_SIZE) - 2).all(axis=1)
    overlap = (
        iou_matrix(truth, found)
        if len(truth) and len(found)
        else np.zeros((len(truth), len(found)))
    )
    hit = (overlap >= _FOUND_IOU).any(axis=1) & whole
    false = len(found) - int((overlap >= _MET_IOU).any(axis=0).sum())
    return Counter(
        {
            f"{name} objects": int(whole.sum()),
            f"{name} found": int(hit.sum()),
            f"{name} false": false,
        }
    )


if __name__ == "__main__":
    main()
