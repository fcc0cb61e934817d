"""Patrols counted by the packaged detector: which people and cars are counted once, twice, missed or made up?

python benchmarks/watch_counts_detector.py [--seeds 1 2] [--patrols 3] [--returns] [--data FOLDER]

`watch_counts.py` feeds the watch with the truth, so that its figures are the tracker's; here the detector's count, too.
Each simulated patrol flies three strips that overlap, over open ground, some people walking and some cars driving;
every third over ground with trees and houses, between which hardly a car finds room to drive. It is watched with its
telemetry, and once more as the video alone. Seeds are drawn from the commit.
--data is the folder of labelled sets: of HIT-UAV's held-out frames three runs are whole videos (their numbers order
frames as text does: 0, 1, 10, 11, ..., 2, 20, ..., which is undone here), thermal, without telemetry. Their labels are
linked to objects by what each moves against the ground; at which rate they were taken is not known, and one frame a
second is assumed.

An object counts as seen when enough frames show more than half of it (five of a patrol, three of a real video); one
that fewer showed is neither right nor wrong. A track is of an object of its class where half of its boxes lie on
labelled ones (IoU 0.2 or more); else it is `false`. Tracks and objects are paired so that most boxes agree, a quarter
of a track's at least: in a crowd a track may change from one person to the next, and the count is right all the same.
Tracks of objects that are left without a partner count one again (`twice`).
Without telemetry nothing states where on the ground a thing lies, so that one that comes into view again on the next
strip is likely to count again: `appearances` is how often the objects came into view.
"""

import argparse
import json
import re
import shutil
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.optimize import linear_sum_assignment

from detection_data import hituav
from provenance import commit, machine, note_scoring, seeds_or_drawn
from sorvolo.detection.detector import Detector
from sorvolo.lab.simulation.settings import LaterSettings, PathSettings
from sorvolo.missions.compare.flights import compare_flights
from sorvolo.missions.map.flights import map_flights
from sorvolo.missions.watch.flights import watch
from sorvolo.missions.watch.settings import WatchOutputs, WatchSettings
from sorvolo.store.site.archive import Archive
from sorvolo.survey.labels import LabelledPicture
from sorvolo.survey.objects import CLASSES
from watch_counts import fly

RESULTS = Path(__file__).parent / "results" / "watch_counts_detector.json"
COUNTED = CLASSES[:2]  # small objects are reported on demand only
REAL = {  # the number of the first picture, the frames' numbers in the video, and from which on none is left out
    "night, 60 m, 60 deg": (484, (*range(6), *range(10, 60)), 10),
    "night, 60 m, 70 deg": (540, (*range(7), *range(10, 63)), 10),
    "night, 130 m, 50 deg": (3889, (*range(42),), 0),
}
_FLIGHT = "flight2"  # in which people walk and cars drive
_IOU = 0.2
_GAP = 10  # frames of a patrol out of view, after which an object comes into view again
_STEP_PX = 70.0  # that a person goes in a real video from frame to frame, at most
_REAL_FPS = 1.0


@dataclass(frozen=True, eq=False)
class Truth:
    """The objects of a video: of each its class, whether it moves, and its box (4,) px in each frame that shows it.

    `clear` are the frames that show more than half of each. `ignored` are boxes of each frame that nothing is asked of.
    """

    labels: Mapping[int, str]
    moving: Mapping[int, bool]
    boxes: Mapping[int, Mapping[int, np.ndarray]]
    clear: Mapping[int, Sequence[int]]
    ignored: Mapping[int, np.ndarray]
    least: int  # frames in which a seen object is clear


def main() -> None:
    """Fly and watch the patrols, watch the real videos, and write the figures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[], help="else by the commit")
    parser.add_argument("--patrols", type=int, default=3)
    parser.add_argument("--returns", action="store_true", help="map and compare, watch none")
    parser.add_argument("--height", type=float, default=25.0)
    parser.add_argument("--model", default="default")
    parser.add_argument("--data", type=Path, help="labelled sets; else no real video is watched")
    parser.add_argument("--output", type=Path, default=RESULTS)
    options = parser.parse_args()
    seeds, scoring = list[int](), dict[str, Any]()
    if options.patrols:
        seeds = seeds_or_drawn("watch_counts_detector", options.seeds, options.patrols)
        scoring = note_scoring(f"watch_counts_detector, seeds {' '.join(map(str, seeds))}")
    detector = Detector.load(options.model)
    result: dict[str, Any] = {
        "benchmark": "watch_counts_detector",
        "machine": machine(),
        "commit": commit(),
        "date": f"{datetime.now(UTC):%Y-%m-%d}",
        "model": f"{detector.info.name} {detector.info.version}",
        "height_m": options.height,
        **scoring,
        "seeds": seeds,
    }
    patrols = [
        row
        for number, seed in enumerate(() if options.returns else seeds, start=1)
        for row in patrol(seed, options.height, detector, has_scenery=number % 3 == 0)
    ]
    for way in ("with telemetry", "without telemetry"):
        if rows := [each for each in patrols if each["way"] == way]:
            result[f"simulated, {way}"] = _summed(rows)
    if options.returns:
        own = [returns(each, options.height, detector) for each in seeds]
        result["a map and two returns"] = {key: sum(each[key] for each in own) for key in own[0]}
    if options.data is not None:
        real = [real_video(options.data, name, detector) for name in REAL]
        result["real, without telemetry"] = _summed(real) | note_scoring(
            "watch_counts_detector, hituav test videos"
        )
        patrols += real
    result["videos"] = patrols
    options.output.parent.mkdir(exist_ok=True)
    options.output.write_text(json.dumps(result, indent=1) + "\n")
    print(json.dumps(result, indent=1))


def patrol(
    seed: int, height_m: float, detector: Detector, *, has_scenery: bool
) -> list[dict[str, Any]]:
    """One simulated patrol, watched with its telemetry and without."""
    path = PathSettings(height_m=height_m, speed_m_s=6, length_m=40)
    with tempfile.TemporaryDirectory() as scratch:
        simulated = fly(Path(scratch), seed, path, small_objects=0, has_scenery=has_scenery)
        truth = _simulated_truth(simulated)
        alone = Path(scratch) / "alone" / "patrol.mp4"
        alone.parent.mkdir()
        shutil.copy(simulated / _FLIGHT / f"{_FLIGHT}.mp4", alone)
        camera = simulated / "camera.xml"
        kind = "trees and houses" if has_scenery else "open ground"
        ways = {
            "with telemetry": simulated / _FLIGHT / f"{_FLIGHT}.mp4",
            "without telemetry": alone,
        }
        return [
            {
                "video": f"simulated, seed {seed}, {kind}",
                "way": way,
                **watched(video, truth, detector, camera),
            }
            for way, video in ways.items()
        ]


def returns(seed: int, height_m: float, detector: Detector) -> dict[str, int]:
    """A map and two comparisons: standing things `seen` on a date, those counted `twice`; `findings` of the site, those
    `merged` of two. A finding is of the nearest thing of its class within 2 m."""
    path, later = PathSettings(height_m=height_m, speed_m_s=6, length_m=40), LaterSettings(people=2)
    result, owners = Counter[str](), defaultdict[str, set[int]](set)
    with tempfile.TemporaryDirectory() as scratch:
        simulated, site = fly(Path(scratch), seed, path, later, flights=3), Path(scratch) / "site"
        for number, run in enumerate((map_flights, compare_flights, compare_flights), start=1):
            flight = simulated / f"flight{number}/flight{number}.mp4"
            run([flight], site, detector=detector).result()
        truth = json.loads((simulated / "truth/objects.geojson").read_text())["features"]
        with Archive.open(site, write=False) as archive:
            findings, frame = archive.register().findings, archive.site().frame
    rings = [each["geometry"]["coordinates"][0][:-1] for each in truth]
    places_m = [frame.ground_from_lonlat(each).mean(axis=0) for each in rings]
    things = [(each["properties"], place_m) for each, place_m in zip(truth, places_m)]
    standing = [each for each in findings if each.label in COUNTED and not each.newest.moving]
    off_m = np.array([each.position_m - place_m for each in standing for place_m in places_m])
    near = np.linalg.norm(off_m[:, None] - off_m, axis=2) < 1  # the map as a whole is off by GPS
    shift_m = off_m[near.sum(axis=1).argmax()]
    for number in (1, 2, 3):
        seen = Counter[int]()
        for found in standing:
            apart = {
                np.linalg.norm(place_m + shift_m - found.position_m): thing["id"]
                for thing, place_m in things
                if thing["class"] == found.label and not thing["moving"]
                if number in thing["flights"] and f"flight{number}" in found.dates
            }
            if min(apart, default=9.0) < 2:
                seen[apart[min(apart)]] += 1
                owners[found.id].add(apart[min(apart)])
        result.update(seen=len(seen), twice=seen.total() - len(seen))
    merged = sum(len(each) > 1 for each in owners.values())
    return {**result, "findings": len(owners), "merged": merged}


def real_video(data: Path, name: str, detector: Detector) -> dict[str, Any]:
    """One of the real videos, put together from its frames in their order in time."""
    pictures = real_pictures(data, name)
    with tempfile.TemporaryDirectory() as scratch:
        video = Path(scratch) / "real.avi"
        images = [cv2.imread(each.path) for each in pictures]
        codec, size = cv2.VideoWriter.fourcc(*"FFV1"), images[0].shape[1::-1]
        writer = cv2.VideoWriter(str(video), codec, _REAL_FPS, size)
        for image in images:
            writer.write(image)
        writer.release()
        row = watched(video, _linked(pictures, images), detector, None)
    return {"video": f"hituav, {name}", "way": "without telemetry", **row}


def real_pictures(data: Path, name: str) -> list[LabelledPicture]:
    """The frames of a real video in their order in time, none left out between them."""
    first, frames, start = REAL[name]
    by_number = {
        int(re.findall(r"\d+", Path(each.path).stem)[-1]): each
        for each in hituav(data)["test"].pictures
    }
    numbers = {
        frame: first + rank for rank, frame in enumerate(sorted(frames, key=str))
    }  # as the publisher has them
    return [by_number[numbers[frame]] for frame in frames if frame >= start]


def watched(video: Path, truth: Truth, detector: Detector, camera: Path | None) -> dict[str, Any]:
    """A watch of one video against its truth."""
    began_s = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "watch"
        settings = WatchSettings(classes=COUNTED)
        for _ in watch(video, settings, WatchOutputs(folder=out), camera=camera, detector=detector):
            pass
        kind = ".geojson" if (out / "tracks.geojson").is_file() else ".json"
        tracks, rows = (
            [
                each["properties"]
                for each in json.loads((out / f"{name}{kind}").read_text())["features"]
            ]
            for name in ("tracks", "detections")
        )
        report = json.loads((out / "report.json").read_text())
    searched = report["frames"]["detected"]
    figures = {
        "frames": searched,
        "most_views": max((each["views"] for each in tracks), default=0),
        "placed": kind == ".geojson",
        **compared(tracks, rows, truth),
        "processor_s": round(time.process_time() - began_s, 1),
    }
    print(video.name, figures, flush=True)
    return figures


def compared(
    tracks: Sequence[Mapping[str, Any]], rows: Sequence[Mapping[str, Any]], truth: Truth
) -> dict[str, Any]:
    """Of people, of cars, and of moving cars: how many there were, and what was counted."""
    boxes: dict[int, list[tuple[int, np.ndarray]]] = defaultdict(list)
    for row in rows:
        if row["track"] is not None:
            boxes[row["track"]].append((int(row["frame"]), np.array(row["box_px"])))
    seen = {each for each, frames in truth.clear.items() if len(frames) >= truth.least}
    votes_of: dict[int, Counter[int]] = {}
    false: Counter[str] = Counter()
    for track in tracks:
        views = boxes[track["id"]]
        votes = Counter(
            best
            for frame, box in views
            if (best := _object_at(frame, box, truth, track["class"])) is not None
        )
        ignored = sum(
            bool(np.any(_overlaps(truth.ignored.get(frame, np.zeros((0, 4))), box)))
            for frame, box in views
        )
        if votes and votes.total() >= len(views) / 2:
            votes_of[track["id"]] = votes
        elif ignored < len(views) / 2:
            false[track["class"]] += 1
    partners = _paired(votes_of, {each: len(boxes[each]) for each in votes_of})
    found = set(partners.values())
    again = [
        votes.most_common(1)[0][0] for track, votes in votes_of.items() if track not in partners
    ]
    groups = {name: [each for each in seen if truth.labels[each] == name] for name in COUNTED}
    groups["moving car"] = [each for each in groups["car"] if truth.moving[each]]
    figures = {
        name: {
            "true": len(members),
            "found": len(found.intersection(members)),
            "missed": len(set(members) - found),
            "twice": sum(each in members for each in again),
            "appearances": sum(_appearances(truth.clear[each]) for each in members),
            **({"false": false[name]} if name in COUNTED else {}),
        }
        for name, members in groups.items()
    }
    for name in COUNTED:
        figures[name]["counted"] = sum(figures[name][key] for key in ("found", "twice", "false"))
    return figures


def _paired(votes_of: Mapping[int, Counter[int]], views: Mapping[int, int]) -> dict[int, int]:
    """The object of each track that has one for itself: so that most boxes lie on their track's object."""
    tracks, objects = list(votes_of), sorted(set().union(*votes_of.values()))
    votes = np.array([[votes_of[track][each] for each in objects] for track in tracks]).reshape(
        -1, len(objects)
    )
    if not votes.size:
        return {}
    return {
        tracks[row]: objects[column]
        for row, column in zip(*linear_sum_assignment(votes, maximize=True))
        if votes[row, column] >= max(1, views[tracks[row]] / 4)
    }


def _summed(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The figures of several videos together."""
    names = [
        name
        for name in (*COUNTED, "moving car")
        if any(row[name]["true"] or row[name].get("false") for row in rows)
    ]
    return {
        "videos": len(rows),
        "frames": sum(row["frames"] for row in rows),
        **{
            name: {key: sum(row[name][key] for row in rows) for key in rows[0][name]}
            for name in names
        },
    }


def _object_at(frame: int, box: np.ndarray, truth: Truth, label: str) -> int | None:
    """The object of a class that lies best under a box; None where none overlaps it by `_IOU`."""
    there = [each for each in truth.boxes.get(frame, {}) if truth.labels[each] == label]
    if not there:
        return None
    overlaps = _ious(np.array([truth.boxes[frame][each] for each in there]), box)
    best = int(np.argmax(overlaps))
    return there[best] if overlaps[best] >= _IOU else None


def _ious(boxes: np.ndarray, box: np.ndarray) -> np.ndarray:
    sides = np.minimum(boxes[:, 2:], box[2:]) - np.maximum(boxes[:, :2], box[:2])
    common = np.prod(np.maximum(sides, 0), axis=1)
    return common / (
        np.prod(boxes[:, 2:] - boxes[:, :2], axis=1) + np.prod(box[2:] - box[:2]) - common
    )


def _overlaps(boxes: np.ndarray, box: np.ndarray) -> np.ndarray:
    return _ious(boxes, box) > 0


def _appearances(frames: Sequence[int]) -> int:
    """How often an object came into view."""
    return 1 + int(np.sum(np.diff(sorted(frames)) > _GAP))


def _simulated_truth(simulated: Path) -> Truth:
    annotated = json.loads((simulated / "truth" / _FLIGHT / "boxes.json").read_text())
    about = {
        each["properties"]["id"]: each["properties"]
        for each in json.loads((simulated / "truth" / "objects.geojson").read_text())["features"]
        if 2 in each["properties"]["flights"]
    }
    boxes: dict[int, dict[int, np.ndarray]] = defaultdict(dict)
    clear: dict[int, list[int]] = defaultdict(list)
    for each in annotated["annotations"]:
        x, y, width, height = each["bbox"]
        boxes[each["image_id"]][each["object_id"]] = np.array([x, y, x + width, y + height])
        if each["visibility"] > 0.5:
            clear[each["object_id"]].append(each["image_id"])
    return Truth(
        {name: each["class"] for name, each in about.items()},
        {name: each["moving"] for name, each in about.items()},
        boxes,
        clear,
        {},
        least=5,
    )


def _linked(pictures: Sequence[LabelledPicture], images: Sequence[np.ndarray]) -> Truth:
    """The objects behind the labels of a video's frames: linked from frame to frame by the way each goes on the ground.

    An object may lack a label in two frames running. Its next place is where it would be if it went on as before.
    """
    # of each object that is followed: the frame of its last label, its class, its place and step in the newest frame
    live: dict[int, tuple[int, str, np.ndarray, np.ndarray]] = {}
    labels: dict[int, str] = {}
    boxes: dict[int, dict[int, np.ndarray]] = defaultdict(dict)
    clear: dict[int, list[int]] = defaultdict(list)
    for frame, picture in enumerate(pictures):
        motion = _motion(images[frame - 1], images[frame]) if frame else np.eye(2, 3)
        live = {
            each: (last, label, motion[:, :2] @ (place + step) + motion[:, 2], motion[:, :2] @ step)
            for each, (last, label, place, step) in live.items()
            if frame - last <= 3
        }
        found = [(CLASSES[label], box) for label, box in zip(picture.labels, picture.boxes_px)]
        middles = [(box[:2] + box[2:]) / 2 for _, box in found]
        known = list(live)
        cost = np.array(
            [
                [
                    np.linalg.norm(live[each][2] - middle) if live[each][1] == label else 1e6
                    for (label, _), middle in zip(found, middles)
                ]
                for each in known
            ]
        ).reshape(len(known), len(found))
        matched = {
            column: known[row]
            for row, column in zip(*linear_sum_assignment(cost))
            if cost[row, column] < _STEP_PX
        }
        for column, (label, box) in enumerate(found):
            each = matched.get(column, len(labels) + 1)
            if each in live:
                _, _, predicted, step = live[each]
                step = step + 0.5 * (middles[column] - predicted)
            else:
                step = np.zeros(2)
            labels[each], boxes[frame][each] = label, box
            live[each] = (frame, label, middles[column], step)
            clear[each].append(frame)
    ignored = {frame: np.asarray(each.ignored_px) for frame, each in enumerate(pictures)}
    return Truth(labels, dict.fromkeys(labels, True), boxes, clear, ignored, least=3)


def _motion(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """(2, 3) how the ground moved in the picture; no motion where too little is recognised."""
    features = cv2.ORB.create(1500)
    (points, theirs), (others, ours) = (
        features.detectAndCompute(each, None) for each in (before, after)
    )
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(theirs, ours)
    if len(pairs) < 20:
        return np.eye(2, 3)
    old = np.array([points[each.queryIdx].pt for each in pairs])
    new = np.array([others[each.trainIdx].pt for each in pairs])
    found, _ = cv2.estimateAffinePartial2D(old, new, ransacReprojThreshold=3.0)
    return np.eye(2, 3) if found is None else found


if __name__ == "__main__":
    main()
