"""Whether `sorvolo search` states the right chances.

python benchmarks/search_pod.py [--flights 24] [--seeds ...] [--real DATA/detection/semantic_drone]

Simulated searches over fresh ground, by day and with a thermal camera, with people and cars hidden in them. Each flight
is measured as the command does it: plants of other seeds go into its frames, and each hidden thing gets the chance that
the plants give its place. Then the untouched frames are searched, and what is reported by the rule of maps counts as
found. Where the chance is 0.8, four of five should be found.

Hidden people are drawn as the plants are (other bodies, clothes and poses), so this judges what is made of the plants,
not how much real people look like them. --real does: into photos from straight above, whose people are labelled, as
many people are planted, as large as theirs, and one search of each photo tells how many of both it finds.

Poses of the frames are the true ones. What crowns hide by
the measure's own judgement is counted apart.

Writes results/search_pod.json, and with it the plot docs/images/search-stated-found.svg; --plot draws that alone, of
the results that are there.
"""

import argparse
import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path

import cv2
import numpy as np

from provenance import commit, machine, seeds_or_drawn
from sorvolo.detection.detector import Detector
from sorvolo.detection.fusing import is_from_above
from sorvolo.geometry.box_overlap import iou_matrix
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.geodesy import utm_epsg
from sorvolo.geometry.grid import SiteGrid
from sorvolo.geometry.ground import footprint
from sorvolo.geometry.homography import site_from_image_homography
from sorvolo.geometry.pose import Pose
from sorvolo.geometry.summary import calibration_bins
from sorvolo.geometry.sun import direction_from_angles
from sorvolo.lab.simulation.flight import SimulatedFlight, simulate_flight
from sorvolo.lab.simulation.pictures import heat_picture, warm_day
from sorvolo.lab.simulation.rendering import render, render_labels
from sorvolo.lab.simulation.settings import (
    ImagingSettings,
    MotionSettings,
    OutputSettings,
    PathSettings,
    SceneSettings,
    SimulationSettings,
)
from sorvolo.lab.simulation.world import build_day, is_free
from sorvolo.missions.search.measure import MeasuredFlight, SearchFrame, measure_flight, reach_m
from sorvolo.missions.search.settings import SearchSettings
from sorvolo.search.cells import cell_side_m, cells_over
from sorvolo.search.conditions import gather, look_at
from sorvolo.search.drawing.objects import Thing, new_size
from sorvolo.search.drawing.planted import frame_light, new_plant, plant
from sorvolo.store.pages.plots import stated_and_found
from sorvolo.survey.flight import Site
from sorvolo.survey.mosaic import PlacedFrame, Status
from sorvolo.tracking.laying import LaidSighting, lay_on_ground
from sorvolo.tracking.map_objects import reported_plants
from sorvolo.tracking.view_evidence import least_seen

RESULTS = Path(__file__).parent / "results" / "search_pod.json"
PLOT = Path(__file__).parents[1] / "docs" / "images" / "search-stated-found.svg"
COLOURS = ("#2660c9", "#b86e00", "#12805c", "#8c3fc4", "#6b7a76")  # c0 to c4 of the pages
STYLE = (
    "svg{background:#fff}.label{fill:#55635f;font:12px sans-serif}.grid{stroke:#dfe5e2}"
    ".line{fill:none;stroke-width:1.5}.median{stroke:#1d2624;stroke-dasharray:4 4}"
)
SUN_DEG = (215.0, 48.0)  # of every first day in the simulation
UPRIGHT = "standing", "walking"
UPRIGHT_M = 1.1  # longer side of an upright person's box from above, by plants of their own size
PEOPLE, CARS = 28, 12  # hidden in a flight
CLASSES = ("person", "car")
MOST = 60  # sightings of a frame, the surest, as a map takes them
GROUNDS = ("countryside", "dirt", "urban", "sand")
HEIGHTS_M = (25.0, 35.0, 45.0)


def main() -> None:
    """Fly, measure, search, count, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--flights", type=int, default=24)
    parser.add_argument("--seeds", type=int, nargs="*", default=[])
    parser.add_argument("--plants", type=int, default=60)
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--real", type=Path, help="Photos with labels: real people and plants.")
    parser.add_argument("--plot", action="store_true", help="Draw the results that are there.")
    wishes = parser.parse_args()
    before = json.loads(wishes.results.read_text()) if wishes.results.exists() else {}
    if wishes.plot:
        draw(before["groups"])
        return
    if wishes.real:
        before["real"] = real_and_planted(wishes.real)
        wishes.results.write_text(json.dumps(before, indent=1) + "\n")
        return
    detector = Detector.load("default", provider="cpu", threads=1)
    rows: list[dict] = []
    seeds = seeds_or_drawn("search_pod", wishes.seeds, wishes.flights)
    done = []
    for number, seed in enumerate(seeds):
        flight, images = flown(seed, number)
        rows += searched(flight, images, detector, wishes.plants, number)
        done.append(seed)
        document = {
            "benchmark": "search_pod",
            "machine": machine(),
            "commit": commit(),
            "date": time.strftime("%Y-%m-%d"),
            "seeds": done,
            "plants": wishes.plants,
            "model": detector.info.name,
            "groups": summarised(rows),
            **({"real": before["real"]} if "real" in before else {}),
        }
        wishes.results.write_text(json.dumps(document, indent=1) + "\n")
        print(
            number,
            seed,
            {name: each["bins"] for name, each in summarised(rows).items()},
            flush=True,
        )
    if wishes.results == RESULTS:
        draw(summarised(rows))


def draw(groups: dict) -> None:
    """Found over stated of each group, by fifths of what was stated, with what the colours are."""
    names = [name for name in groups if name != "these together" and groups[name]["bins"]]
    rows = [
        (name, each["stated"], each["found"], each["found_low"], each["found_high"], each["count"])
        for name in names
        for each in groups[name]["bins_whole"]
    ]
    style = STYLE + "".join(f".c{k}{{stroke:{colour}}}" for k, colour in enumerate(COLOURS))
    words = "".join(
        f'<text x="60" y="{32 + 16 * k}" style="font:12px sans-serif;fill:{COLOURS[k]}">{name}</text>'
        for k, name in enumerate(names)
    )
    drawn = str(stated_and_found(rows)).replace(
        "<svg ", '<svg xmlns="http://www.w3.org/2000/svg" ', 1
    )
    PLOT.write_text(
        drawn.replace("<title>", f"<style>{style}</style><title>", 1).replace(
            "</svg>", f"{words}</svg>"
        )
    )


def flown(seed: int, number: int) -> tuple[SimulatedFlight, list]:
    """A flight of photos over hidden people and cars, and its pictures; every third is thermal, some are blurred."""
    rng = np.random.default_rng([seed, 1])
    height_m = float(HEIGHTS_M[int(rng.integers(len(HEIGHTS_M)))] * rng.uniform(0.85, 1.15))
    is_thermal = number % 3 == 2
    length_m = 2.2 * height_m
    settings = SimulationSettings(
        seed=seed,
        flights=1,
        scene=SceneSettings(str(rng.choice(GROUNDS)), people=0, cars=CARS, small_objects=0),
        path=PathSettings(
            height_m=height_m,
            speed_m_s=8,
            length_m=length_m,
            strips=2,
            strip_spacing_m=0.5 * height_m,
        ),
        motion=MotionSettings(camera_pitch_deg=float(rng.choice([-90.0, -90.0, -65.0]))),
        imaging=ImagingSettings(
            640,
            480,
            fps=6,
            distortion=(0.0,) * 5,
            exposure_s=float(rng.choice([1 / 1000, 1 / 1000, 1 / 60])),
        ),
        output=OutputSettings(photos=True, photo_overlap=0.55),
    )
    flight = simulate_flight(settings)
    things = (*flight.day.things, *hidden_people(flight, rng))
    world = replace(flight.world, days=(things,))
    flight = replace(flight, world=world, day=build_day(world, settings, 1, settings.m_per_px))
    return flight, [taken(flight, index, is_thermal) for index in range(len(flight))]


def hidden_people(flight: SimulatedFlight, rng: np.random.Generator) -> Iterator[Thing]:
    """People as missing ones lie, sit and stand, where there is room for them on the flown ground."""
    outlines_m = np.concatenate([footprint(flight.camera, pose) for pose in flight.true_poses])
    low, high = np.percentile(outlines_m, (15, 85), axis=0)
    placed = list(flight.day.things)
    for number in range(PEOPLE):
        for _ in range(50):
            new = new_plant(
                5000 + number, "person", rng.uniform(low, high), int(rng.integers(2**31))
            )
            if is_free(new, placed):
                placed.append(new)
                yield new
                break


def taken(flight: SimulatedFlight, index: int, is_thermal: bool) -> np.ndarray:
    """A frame as recorded; by a thermal camera, the same noise in all frames of a flight."""
    if not is_thermal:
        return flight.frame(index).image
    day = warm_day(
        flight.day, flight.world.ground, np.random.default_rng([flight.settings.seed, 2])
    )
    picture = render(
        day, flight.view(index), flight.true_poses[index], float(flight.from_middle_s[index])
    )
    return heat_picture(picture, np.random.default_rng([flight.settings.seed, 3]))


def searched(
    flight: SimulatedFlight,
    images: Sequence[np.ndarray],
    detector: Detector,
    plants: int,
    number: int,
) -> list[dict]:
    """A row for each hidden thing that a frame shows: the chance it was given, and whether it was found."""
    frames = [
        SearchFrame(placed(flight, index), lambda image=image: image)
        for index, image in enumerate(images)
    ]
    origin = flight.settings.scene.origin
    crs = f"EPSG:{utm_epsg(origin.latitude_deg, origin.longitude_deg)}"
    outlines_m = [each.placed.outline_m for each in frames]
    cells = cells_over(outlines_m, SiteGrid.at(origin, cell_side_m(outlines_m), crs), None)
    targets = [thing for thing in flight.day.things if thing.label.is_target]
    settings = SearchSettings(
        plants=plants, classes=CLASSES, sun_deg=SUN_DEG, seed=flight.settings.seed + 1
    )
    measuring = measure_flight(
        flight.name,
        frames,
        cells,
        Site("search", origin, crs, 0.02, height_reference="ellipsoidal"),
        detector,
        settings,
        np.array([thing.place_m(0)[:2] for thing in targets]),
    )
    while True:
        try:
            next(measuring)
        except StopIteration as end:
            measured = end.value
            break
    return rows_of(flight, frames, images, detector, measured, targets, number)


def rows_of(
    flight: SimulatedFlight,
    frames: Sequence[SearchFrame],
    images: Sequence[np.ndarray],
    detector: Detector,
    measured: MeasuredFlight,
    targets: Sequence[Thing],
    number: int,
) -> list[dict]:
    """What was stated and what came true."""
    laid, boxes, least = seen_by_map(
        flight, [each.placed for each in frames], images, detector, targets
    )
    labels = [str(each.label) for each in targets]
    reported = reported_plants(laid, [each.placed for each in frames], boxes, labels, least)
    empty = without_targets(flight)
    bare = [taken(empty, index, measured.is_thermal) for index in range(len(images))]
    looks = [
        look_at(
            image,
            each.placed.camera,
            flight.true_poses[k],
            frame_light(image).blur_px,
            direction_from_angles(*SUN_DEG),
        )
        for k, (each, image) in enumerate(zip(frames, bare))
    ]
    rows = []
    for label in measured.classes:
        own = [(k, thing) for k, thing in enumerate(targets) if thing.label == label.label]
        seen = gather(
            looks, np.array([thing.place_m(0)[:2] for _, thing in own]), reach_m(label.label)
        )
        if label.recall is None:
            continue
        chances = label.recall.of(seen.columns)
        for row, (k, _) in enumerate(own):
            if seen.seen[row]:
                rows.append(
                    {
                        "flight": number,
                        "class": label.label,
                        "thermal": measured.is_thermal,
                        "chance": round(float(chances.mean[row]), 4),
                        "low": round(float(chances.low[row]), 4),
                        "high": round(float(chances.high[row]), 4),
                        "found": k in reported,
                        "trees": bool(seen.under_trees[row]),
                        "height_m": round(flight.path.height_m, 1),
                    }
                )
    return rows


def seen_by_map(
    flight: SimulatedFlight,
    frames: Sequence[PlacedFrame],
    images: Sequence[np.ndarray],
    detector: Detector,
    targets: Sequence[Thing],
) -> tuple[list[LaidSighting], dict[int, np.ndarray], dict[str, float]]:
    """What a map's search sees in the frames, each frame's boxes of the targets (NaN: out of sight), and from which
    score on each class is reported."""
    laid, boxes = [], {}
    least: dict[str, float] = {}
    for index, (frame, image) in enumerate(zip(frames, images)):
        pose = flight.true_poses[index]
        from_above = is_from_above(pose.rotation)
        own = detector.thresholds_for(image, from_above=from_above)
        least = {name: max(score, least.get(name, 0.0)) for name, score in own.items()}
        found = detector.detect(
            image,
            tiles="auto",
            m_per_px=float(pose.translation_m[2]) / flight.camera.fx_px,
            classes=CLASSES,
            from_above=from_above,
            least_score=least_seen(own),
        ).surest(MOST)
        laid += [one for one in lay_on_ground(found, frame) if one is not None]
        boxes[index] = boxes_px(flight, index, targets)
    return laid, boxes, least


def without_targets(flight: SimulatedFlight) -> SimulatedFlight:
    """The same ground bare: the conditions of a place are those of its ground, not of what is hidden there."""
    things = tuple(thing for thing in flight.day.things if not thing.label.is_target)
    world = replace(flight.world, days=(things,))
    return replace(
        flight, world=world, day=build_day(world, flight.settings, 1, flight.settings.m_per_px)
    )


def boxes_px(flight: SimulatedFlight, index: int, targets: Sequence[Thing]) -> np.ndarray:
    """(N, 4) what shows of each target; NaN for one that is out of sight or hidden."""
    labels, _ = render_labels(
        flight.day.things,
        flight.day.bodies,
        flight.view(index),
        flight.true_poses[index],
        float(flight.from_middle_s[index]),
    )
    boxes = np.full((len(targets), 4), np.nan, np.float32)
    for k, thing in enumerate(targets):
        mask = (labels == thing.id).astype(np.uint8)
        if mask.any():
            x, y, width, height = cv2.boundingRect(mask)
            boxes[k] = x, y, x + width, y + height
    return boxes


def placed(flight: SimulatedFlight, index: int) -> PlacedFrame:
    """A frame on its true place."""
    camera, pose = flight.camera, flight.true_poses[index]
    return PlacedFrame(
        flight.frame_name(index),
        index,
        int(flight.frame_times_ns[index]),
        Status.VISION,
        "",
        camera,
        pose,
        site_from_image_homography(camera, pose),
        footprint(camera, pose),
        0.5,
        0.3,
    )


def summarised(rows: Sequence[dict]) -> dict:
    """Stated and found by class and light, on open ground; and what trees hide."""
    groups = {
        "cars by day": lambda row: row["class"] == "car" and not row["thermal"],
        "people by day": lambda row: row["class"] == "person" and not row["thermal"],
        "people, thermal": lambda row: row["class"] == "person" and row["thermal"],
        "cars, thermal": lambda row: row["class"] == "car" and row["thermal"],
        "these together": lambda row: True,
    }
    result = {}
    for name, belongs in groups.items():
        own = [row for row in rows if belongs(row) and not row["trees"]]
        if not own:
            continue
        chances, found = (
            np.array([row["chance"] for row in own]),
            np.array([row["found"] for row in own], bool),
        )
        flights = sorted({row["flight"] for row in own})
        result[name] = {
            "things": len(own),
            "stated": round(float(chances.mean()), 4),
            "found": round(float(found.mean()), 4),
            "difference": round(float(found.mean() - chances.mean()), 4),
            "difference_90": bootstrapped(
                [[row for row in own if row["flight"] == flight] for flight in flights]
            ),
            "bins": [
                [round(each.stated, 3), round(each.found, 3), each.count]
                for each in calibration_bins(chances, found)
            ],
            "bins_whole": [asdict(each) for each in calibration_bins(chances, found)],
        }
    hidden = [row for row in rows if row["trees"]]
    if hidden:
        result["under trees"] = {
            "things": len(hidden),
            "stated": 0.0,
            "found": round(float(np.mean([row["found"] for row in hidden])), 4),
            "bins": [],
        }
    return result


def real_and_planted(folder: Path) -> dict:
    """How many of the whole people of photos from straight above are found, and how many of as many plants in them."""
    detector, rng = Detector.load("default", provider="cpu", threads=1), np.random.default_rng(11)
    names = (folder / "classes.txt").read_text().split()
    hits: dict[str, list[bool]] = {"real": [], "planted": []}
    sides: dict[str, list[float]] = {"real": [], "planted": []}
    for path in sorted(folder.glob("*.jpg")):
        image = cv2.imread(str(path))[..., ::-1]
        size = np.array(image.shape[1::-1])
        lines = path.with_suffix(".txt").read_text().split()
        rows = np.array(lines, float).reshape(-1, 5)
        boxes = np.hstack([rows[:, 1:3] - rows[:, 3:] / 2, rows[:, 1:3] + rows[:, 3:] / 2])
        boxes = boxes * np.tile(size, 2)
        is_person = rows[:, 0] == names.index("person")
        whole = (boxes[:, :2] > 2).all(axis=1) & (boxes[:, 2:] < size - 2).all(axis=1)
        in_a_car = iou_matrix(boxes, boxes[rows[:, 0] == names.index("car")]).any(axis=1)
        real = boxes[is_person & whole & ~in_a_car]
        if not len(real):
            continue
        side_px = float(np.median((real[:, 2:] - real[:, :2]).max(axis=1)))
        m_per_px, places = UPRIGHT_M / side_px, []
        for _ in range(60 * len(real)):
            spot = rng.uniform(side_px, size - side_px)
            own = np.array([[*(spot - side_px), *(spot + side_px)]])
            if len(places) < len(real) and not iou_matrix(own, np.array([*boxes, *places])).any():
                places.append(own[0])
        fx_px, middle = 0.8 * size[0], (size - 1) / 2
        camera = Camera(*map(int, size), fx_px, fx_px, *middle)
        things = []
        for k, own in enumerate(places):
            at_m = ((own[:2] + own[2:]) / 2 - middle) * (m_per_px, -m_per_px)
            new, kind = new_plant(k, "person", at_m, int(rng.integers(2**31))), UPRIGHT[k % 2]
            things.append(replace(new, kind=kind, size_m=new_size(new.label, kind, rng)))
        pose = Pose(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, fx_px * m_per_px]))
        light = frame_light(image)
        shown = plant(image, camera, pose, things, light, None, len(hits["real"]))
        found = detector.detect(shown.image, tiles="auto", m_per_px=m_per_px, classes=CLASSES)
        least = detector.thresholds_for(shown.image, from_above=True)["person"]
        people = [k for k, name in enumerate(found.names) if name == "person"]
        sure = found.only([k for k in people if found.scores[k] >= least]).boxes_px
        for kind, own in (("real", real), ("planted", shown.boxes_px)):
            own = own[np.isfinite(own).all(axis=1)]
            hits[kind] += list((iou_matrix(own, sure) > 0.3).any(axis=1))
            sides[kind] += list((own[:, 2:] - own[:, :2]).max(axis=1))
    return {
        kind: {
            "people": len(own),
            "found": round(float(np.mean(own)), 3),
            "side_px": round(float(np.median(sides[kind])), 1),
        }
        for kind, own in hits.items()
    } | {"commit": commit(), "model": detector.info.name}


def bootstrapped(groups: Sequence[Sequence[dict]]) -> list[float]:
    """The 90 % interval of found less stated, over flights drawn with replacement."""
    rng = np.random.default_rng(1)
    means = []
    for _ in range(1000):
        drawn = [row for k in rng.integers(len(groups), size=len(groups)) for row in groups[k]]
        means.append(np.mean([row["found"] - row["chance"] for row in drawn]))
    return [round(float(each), 4) for each in np.percentile(means, (5, 95))]


if __name__ == "__main__":
    main()
