"""How far boxes that follow the picture lie from what they show, beside boxes that stay where they were seen.

python benchmarks/carried_boxes.py [--model default-int8] [--seeds N N]

For boxes over live video (docs/station.md): a look of the detector takes 0.7 s, and its boxes come when the picture has
moved on. Simulated flights with people and cars of which some move, 40 m up at 8 m/s, straight down and 40 degrees
forward, seeds drawn from the commit (provenance.py). The page's own code carries the boxes, in Chromium. Looks come
0.7 s apart, each known 0.9 s after its frame; how the picture moves is known 0.25 s or 0.5 s late (as `station.py`
measures them).

For each frame: the newest look known by then; each of its boxes that lies on an object (IoU 0.3), as far as the frame
shows that object whole; the distance of the middles. Processor time of a step between two frames, its small picture
included, one thread.
"""

import argparse
import json
import tempfile
import time
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
from playwright.sync_api import sync_playwright

from provenance import commit, machine, note_scoring, seeds_or_drawn
from sorvolo.detection.detector import Detector
from sorvolo.geometry.box_overlap import iou_matrix
from sorvolo.lab.simulate.site import simulate_site
from sorvolo.lab.simulation.settings import (
    ImagingSettings,
    MotionSettings,
    OutputSettings,
    PathSettings,
    SceneSettings,
    SimulationSettings,
)
from sorvolo.missions.watch.flights import watch
from sorvolo.missions.watch.run import WatchUpdate
from sorvolo.missions.watch.settings import WatchOutputs, WatchSettings
from sorvolo.tracking.image_motion import SMALL_WIDTH_PX, PictureStep, PictureSteps

RESULTS = Path(__file__).parent / "results" / "carried_boxes.json"
PAGE = Path(__file__).parents[1] / "src" / "sorvolo" / "station" / "page" / "picture_motion.js"
_FPS, _SECONDS, _SIZE = 10, 12, (1920, 1080)
_LOOK_FRAMES, _LOOK_LATE_S, _STEPS_LATE_S = 7, 0.9, (0.25, 0.5)
_SEEN_IOU = 0.3
cv2.setNumThreads(1)
_CARRY = """async ({ code, steps, asked }) => {
  const { PictureMotion } = await import(URL.createObjectURL(new Blob([code], { type: 'text/javascript' })));
  return asked.map(({ look, to_us, known_us }) => {
    const motion = new PictureMotion();
    for (const step of steps) if (step.pts_us <= known_us) motion.take(step);
    return motion.carried(look, to_us)?.map(box => [box.number, box.xywh_px]) ?? null;
  });
}"""

Truth = dict[
    int, tuple[str, np.ndarray[Any, Any]]
]  # by object: its class, and its box as left, top, right, bottom


@dataclass(frozen=True)
class Flown:
    """A simulated flight: its video, its telemetry, the boxes in each frame."""

    folder: Path
    truth: list[Truth]

    @property
    def video(self) -> Path:
        """Of the second flight: there things move."""
        return self.folder / "flight2" / "flight2.mp4"


def main() -> None:
    """Carry the boxes of each flight and write how far off they are."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--model", default="default-int8")
    parser.add_argument(
        "--seeds", type=int, nargs="+", default=[], help="one for each flight; drawn without it"
    )
    parser.add_argument("--chromium", default="/usr/bin/chromium")
    parser.add_argument("--flights", type=Path, help="simulated before, or where to keep them")
    parser.add_argument("--output", type=Path, default=RESULTS)
    options = parser.parse_args()
    views = {"straight down": -90.0, "40 degrees forward": -50.0}
    seeds = seeds_or_drawn("carried_boxes", options.seeds, len(views))
    detector = Detector.load(options.model, threads=1)
    flights = {}
    with tempfile.TemporaryDirectory() as scratch, sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=options.chromium, args=["--no-sandbox", "--disable-gpu"]
        )
        for seed, (name, pitch_deg) in zip(seeds, views.items(), strict=True):
            flown = simulated(
                (options.flights or Path(scratch)) / name.replace(" ", "_"), seed, pitch_deg
            )
            flights[name] = carried(
                browser.new_page(), flown, detector, Path(scratch) / f"watch-{seed}"
            )
        browser.close()
    result = {
        "benchmark": "carried_boxes",
        "machine": machine(),
        "commit": commit(),
        "model": options.model,
        "seeds": seeds,
        **note_scoring(f"carried_boxes, seeds {' '.join(map(str, seeds))}"),
        "size": _SIZE,
        "looks_s_apart": _LOOK_FRAMES / _FPS,
        "look_late_s": _LOOK_LATE_S,
        "steps_late_s": _STEPS_LATE_S,
        "flights": flights,
    }
    options.output.write_text(json.dumps(result, indent=1) + "\n")
    print(json.dumps(result, indent=1))


def simulated(folder: Path, seed: int, pitch_deg: float) -> Flown:
    """A strip with people and cars, the true boxes known in every frame."""
    if not folder.is_dir():
        settings = SimulationSettings(
            seed=seed,
            flights=2,
            scene=SceneSettings(people=14, cars=10, small_objects=0, moving_share=0.6),
            path=PathSettings(height_m=40, speed_m_s=8, length_m=8 * _SECONDS, strips=1),
            motion=MotionSettings(camera_pitch_deg=pitch_deg),
            imaging=ImagingSettings(width_px=_SIZE[0], height_px=_SIZE[1], fps=_FPS),
            output=OutputSettings(truth_step=1),
        )
        for _ in simulate_site(folder, settings):
            pass
    known = json.loads((folder / "truth" / "flight2" / "boxes.json").read_text())
    names = {each["id"]: each["name"] for each in known["categories"]}
    frames = {each["id"]: each["frame"] for each in known["images"]}
    truth: list[Truth] = [{} for _ in frames]
    for each in known["annotations"]:
        left, top, width, height = each["bbox"]
        box = np.array([left, top, left + width, top + height], float)
        truth[frames[each["image_id"]]][each["object_id"]] = names[each["category_id"]], box
    return Flown(folder, truth)


def carried(page: Any, flown: Flown, detector: Detector, scratch: Path) -> dict[str, Any]:
    """How far off boxes are, px: carried, and left where they were seen; and what a step took."""
    steps, step_ms = followed(flown.video)
    settings = WatchSettings(every=_LOOK_FRAMES)
    looks = list(
        watch(
            flown.video,
            settings,
            WatchOutputs(scratch),
            detector=detector,
            camera=flown.folder / "camera.xml",
        )
    )
    asked = []
    for number in range(len(flown.truth)):
        known = [
            each for each in looks if each.clip_ns / 1e9 + _LOOK_LATE_S <= number / _FPS + 1e-6
        ]
        if known:
            asked.append((number, known[-1]))
    answers = {
        late_s: page.evaluate(
            _CARRY,
            {
                "code": PAGE.read_text(),
                "steps": [
                    {
                        "from_us": each.from_ns // 1000,
                        "pts_us": each.to_ns // 1000,
                        "to_from": each.to_from.ravel().tolist(),
                    }
                    for each in steps
                ],
                "asked": [
                    {
                        "look": as_sent(look),
                        "to_us": round(1e6 * number / _FPS),
                        "known_us": round(1e6 * (number / _FPS - late_s)),
                    }
                    for number, look in asked
                ],
            },
        )
        for late_s in _STEPS_LATE_S
    }
    errors: dict[str, dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    moving = movers(flown)
    for at, (number, look) in enumerate(asked):
        for row, thing in matched(look, flown.truth[round(look.clip_ns / 1e9 * _FPS)]).items():
            if thing not in flown.truth[number] or not is_whole(flown.truth[number][thing][1]):
                continue
            kind = "moving" if thing in moving else "standing"
            middle = (flown.truth[number][thing][1][:2] + flown.truth[number][thing][1][2:]) / 2
            seen = look.detections.boxes_px[row]
            errors[kind]["left"].append(float(np.hypot(*((seen[:2] + seen[2:]) / 2 - middle))))
            for late_s, answer in answers.items():
                x, y, w, h = dict(answer[at] or []).get(row, (np.nan,) * 4)
                off_px = float(np.hypot(x + w / 2 - middle[0], y + h / 2 - middle[1]))
                errors[kind][f"carried_{late_s}_s_late"].append(off_px)
    counts = {"steps": len(steps), "frames": len(flown.truth), "looks": len(looks)}
    return (
        counts
        | {"cpu_ms_a_step": round(step_ms, 2)}
        | {
            kind: {"boxes": len(of["left"])}
            | {way: figures(np.array(each)) for way, each in of.items()}
            for kind, of in sorted(errors.items())
        }
    )


def figures(errors_px: np.ndarray[Any, Any]) -> dict[str, Any]:
    """Of those that were shown, and how many were not."""
    shown_px = errors_px[np.isfinite(errors_px)]
    median_px, p90_px = np.percentile(shown_px, [50, 90]).round(1).tolist()
    return {"median_px": median_px, "p90_px": p90_px, "not_shown": len(errors_px) - len(shown_px)}


def followed(video: Path) -> tuple[list[PictureStep], float]:
    """How the picture moves from frame to frame, as the thread that reads a stream measures it; and ms for each."""
    following, steps, taken_s = PictureSteps(), [], 0.0
    with av.open(str(video)) as container:
        for number, frame in enumerate(container.decode(video=0)):
            began_s = time.process_time()
            height_px = round(SMALL_WIDTH_PX * frame.height / frame.width)
            gray = frame.reformat(
                SMALL_WIDTH_PX, height_px, "gray", interpolation="AREA"
            ).to_ndarray()
            steps.append(following.add(round(1e9 * number / _FPS), gray, frame.width))
            taken_s += time.process_time() - began_s
    return [each for each in steps if each is not None], 1000 * taken_s / len(steps)


def as_sent(look: WatchUpdate) -> dict[str, Any]:
    """A look's boxes as the page gets them."""
    return {
        "pts_us": look.clip_ns // 1000,
        "frame_size_px": look.size_px,
        "boxes": [
            {"number": row, "xywh_px": [float(x0), float(y0), float(x1 - x0), float(y1 - y0)]}
            for row, (x0, y0, x1, y1) in enumerate(look.detections.boxes_px)
        ],
    }


def matched(look: WatchUpdate, truth: Truth) -> dict[int, int]:
    """Which object each box of a look lies on, of those that lie on one of their class."""
    found: dict[int, int] = {}
    things = list(truth)
    if not things or not len(look.detections):
        return found
    overlap = iou_matrix(
        look.detections.boxes_px, np.array([truth[each][1] for each in things], np.float32)
    )
    for row, name in enumerate(look.detections.names):
        best = int(np.argmax(overlap[row]))
        if (
            overlap[row, best] >= _SEEN_IOU
            and truth[things[best]][0] == name
            and is_whole(truth[things[best]][1])
        ):
            found[row] = things[best]
    return found


def is_whole(box: np.ndarray[Any, Any]) -> bool:
    """Whether a box touches no edge of the picture."""
    return bool((box[:2] > 2).all() and (box[2:] < np.array(_SIZE) - 2).all())


def movers(flown: Flown) -> set[int]:
    """The objects that move over the ground in the second flight."""
    features = json.loads((flown.folder / "truth" / "objects.geojson").read_text())["features"]
    facts = [each["properties"] for each in features]
    return {each["id"] for each in facts if 2 in each["flights"] and each["moving"]}


if __name__ == "__main__":
    main()
