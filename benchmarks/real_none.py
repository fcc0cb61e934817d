"""Nothing changed: real photo flights, one strip mapped, the next strip over the same ground compared with it.

python benchmarks/real_none.py DATA --keep FOLDER [--flights caliterra] [--pictures FOLDER]

Two strips look at the same ground from other places, most of a minute apart, so that trees and walls lean elsewhere;
photos of one strip would hardly differ. An event is false, or moved between two strips: a car on its way, a person.
Each event is listed, and with --pictures its crops are put side by side for looking at; what was seen to be real is
given with --moved FLIGHT/STRIPS/ID.

brighton_beach and caliterra are development data. fixed_wing, whose camera sees near infrared, is held out. Events
whose centre lies within a crown outlined by hand (real_crowns.json) are counted apart.

Each run is appended to results/real_none.json.
"""

import argparse
import json
import shutil
import time
from collections import Counter, deque
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from provenance import commit, machine, note_scoring
from sorvolo.errors import InputError
from sorvolo.geometry.geodesy import LocalFrame, Projection
from sorvolo.geometry.polygons import points_inside
from sorvolo.lab.evaluation.change_metrics import ComparedGround, compared_ground
from sorvolo.lab.evaluation.frame_rows import map_frames
from sorvolo.missions.compare.flights import compare_flights
from sorvolo.missions.flight.settings import CompareSettings, MapSettings
from sorvolo.missions.map.flights import map_flights
from sorvolo.store.site.archive import Archive

HERE = Path(__file__).parent
RESULTS = HERE / "results" / "real_none.json"
_UNKNOWN_GROUND = ("not-aligned", "outside", "lost", "rejected")


@dataclass(frozen=True)
class RealFlight:
    """A flight's strips, as the first and last number in their photos' names, and which of them are compared."""

    strips: tuple[tuple[int, int], ...]
    pairs: tuple[tuple[int, int], ...]
    is_held_out: bool


# fmt: off
FLIGHTS = {
    "brighton_beach": RealFlight(((18, 23), (24, 29), (30, 35)), ((0, 1), (1, 2)), False),
    "caliterra": RealFlight(
        ((9364, 9370), (9374, 9379), (9384, 9389), (9394, 9399), (9403, 9409), (9413, 9417), (9423, 9430)),
        ((0, 1), (2, 3), (4, 5), (4, 6)), False,
    ),
    "fixed_wing": RealFlight(
        ((552, 557), (558, 564), (565, 573), (574, 578), (579, 583)), ((0, 1), (1, 2), (2, 3), (3, 4)), True,
    ),
}
# fmt: on


def main() -> None:
    """Compare strips of each flight."""
    layout = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=layout)
    parser.add_argument("data", type=Path, help="folder with flights/")
    parser.add_argument("--keep", type=Path, required=True, help="folder for the maps")
    parser.add_argument("--flights", nargs="+", choices=tuple(FLIGHTS), default=tuple(FLIGHTS))
    parser.add_argument(
        "--moved",
        nargs="*",
        default=[],
        metavar="FLIGHT/STRIPS/ID",
        help="events of the latest run that pictures showed to be real: only counted, in RESULTS",
    )
    parser.add_argument(
        "--pictures", type=Path, help="folder for a picture of each event: before, after"
    )
    parser.add_argument("--output", type=Path, default=RESULTS)
    options = parser.parse_args()
    if options.moved:
        mark_moved(options.output, options.moved)
        return
    for name in options.flights:
        scoring = note_scoring(f"real_none, {name}, planted no")
        pairs = [measured(name, pair, options) for pair in FLIGHTS[name].pairs]
        run = {
            "flight": name,
            "is_development_data": not FLIGHTS[name].is_held_out,
            **scoring,
            "summary": pooled(pairs),
            "pairs": pairs,
        }
        append(options.output, run)
        print(name, json.dumps(run["summary"], indent=1), flush=True)


def append(output: Path, run: dict[str, Any]) -> None:
    """Add a run to the results, with its date, commit and machine."""
    document = (
        json.loads(output.read_text())
        if output.is_file()
        else {"benchmark": "real_none", "runs": []}
    )
    stamp = {
        "date": f"{datetime.now(UTC):%Y-%m-%d %H:%M}",
        "commit": commit(),
        "machine": machine(),
    }
    document["runs"].append(stamp | run)
    output.write_text(json.dumps(document, indent=1) + "\n")


def mark_moved(output: Path, moved: list[str]) -> None:
    """Note in the latest runs which events were seen to be real, and count the false ones again."""
    document = json.loads(output.read_text())
    for name in {each.split("/")[0] for each in moved}:
        run = next(run for run in reversed(document["runs"]) if run["flight"] == name)
        for pair in run["pairs"]:
            for event in pair["events"]:
                event["moved"] = f"{name}/{pair['strips']}/{event['id']}" in moved
        run["summary"] = pooled(run["pairs"])
    output.write_text(json.dumps(document, indent=1) + "\n")


def measured(name: str, pair: tuple[int, int], options: argparse.Namespace) -> dict[str, Any]:
    """Map the earlier strip, compare the later one, and list what was reported."""
    strips = f"{pair[0] + 1}-{pair[1] + 1}"
    folder = options.keep / name / strips
    shutil.rmtree(folder, ignore_errors=True)
    photos = []
    for part, number in zip(("earlier", "later"), pair):
        (folder / part).mkdir(parents=True)
        paths = photos_of(options.data / "flights" / name, FLIGHTS[name].strips[number])
        for path in paths:
            (folder / part / path.name).symlink_to(path.resolve())
        photos.append(len(paths))
    started = time.process_time()
    settings = CompareSettings(model="none")
    try:
        deque(map_flights([folder / "earlier"], folder / "site", MapSettings(model="none")), 0)
        deque(compare_flights([folder / "later"], folder / "site", settings), 0)
    except InputError as error:
        return {"strips": strips, "failure": str(error)}
    spent_s = round(time.process_time() - started, 1)
    result = {"strips": strips, "photos": photos, "cpu_s": spent_s, **scored(name, folder)}
    if options.pictures is not None:
        for event in result["events"]:
            crops = folder / "site" / "flights" / "later" / "changes"
            side_by_side(crops, event["id"], options.pictures / f"{name}-{strips}")
    return result


def scored(name: str, folder: Path) -> dict[str, Any]:
    """The events, and the ground that was compared outside crowns and within."""
    site = folder / "site"
    with Archive.open(site, write=False) as archive:
        described = archive.site()
    rows = map_frames(site, described)
    outlines = {
        part: [
            row.outline_m
            for row in rows[part]
            if row.status not in _UNKNOWN_GROUND and np.isfinite(row.outline_m).all()
        ]
        for part in rows
    }
    ground = compared_ground(outlines["later"], outlines["earlier"])
    crowns = crowns_m(name, described.frame)
    crown_m2 = crown_area_m2(ground, crowns)
    events = []
    features = json.loads((site / "flights" / "later" / "changes.geojson").read_text())["features"]
    keys = ("id", "kind", "score", "views", "area_m2", "length_m", "sigma_m")
    for feature in features:
        ring = described.frame.ground_from_lonlat(
            np.array(feature["geometry"]["coordinates"][0])[:-1, :2]
        )
        in_crown = bool(within(crowns, ring.mean(axis=0)[None])[0])
        shown = {key: feature["properties"][key] for key in keys}
        events.append({**shown, "moved": False, "in_crown": in_crown})
    report = json.loads((site / "flights" / "later" / "report.json").read_text())["comparison"]
    return {
        "views": report["views"],
        "reasons": report["reasons"],
        "outside_m2": round(ground.area_m2 - crown_m2),
        "crowns_m2": round(crown_m2),
        "events": events,
    }


def pooled(pairs: list[dict[str, Any]]) -> dict[str, Any]:
    """False events a hectare, outside and within crowns."""
    good = [pair for pair in pairs if "failure" not in pair]
    ends = Counter(
        "moved" if event["moved"] else "in_crowns" if event["in_crown"] else "outside"
        for pair in good
        for event in pair["events"]
    )
    outside_m2, crowns_m2 = (sum(pair[key] for pair in good) for key in ("outside_m2", "crowns_m2"))
    return {
        "pairs": len(pairs),
        "failed": len(pairs) - len(good),
        "hectares_outside_crowns": round(outside_m2 / 1e4, 3),
        "false_outside_crowns": ends["outside"],
        "false_a_hectare": round(1e4 * ends["outside"] / outside_m2, 2) if outside_m2 else None,
        "hectares_in_crowns": round(crowns_m2 / 1e4, 3),
        "false_in_crowns": ends["in_crowns"],
        "moved": ends["moved"],
    }


def photos_of(folder: Path, strip: tuple[int, int]) -> list[Path]:
    """The photos of a strip, by the number in their names."""
    files = sorted(path for path in folder.iterdir() if path.suffix.lower() in (".jpg", ".jpeg"))
    return [path for path in files if strip[0] <= int(path.stem.split("_")[1]) <= strip[1]]


def crowns_m(name: str, frame: LocalFrame) -> list[np.ndarray]:
    """The crowns of a flight's ground in the site's metres."""
    crowns = json.loads((HERE / "real_crowns.json").read_text()).get(name)
    if crowns is None:
        return []
    outlines = []
    for ring in crowns["outlines_m"]:
        latitude, longitude = Projection(crowns["crs"]).wgs84_from_projected(
            np.array(ring, float) + np.array(crowns["offset_m"])
        )
        outlines.append(frame.ground_from_lonlat(np.column_stack([longitude, latitude])))
    return outlines


def within(crowns: list[np.ndarray], points_m: np.ndarray) -> np.ndarray:
    """(N,) whether points lie in any crown."""
    return np.any(
        [points_inside([ring], points_m) for ring in crowns] or [np.zeros(len(points_m), bool)],
        axis=0,
    )


def crown_area_m2(ground: ComparedGround, crowns: list[np.ndarray]) -> float:
    """Compared ground under crowns, counted on every fifth cell each way."""
    rows, columns = np.nonzero(ground.cells[::5, ::5])
    if not len(rows):
        return 0.0
    step_m = 5 * ground.cell_m
    points = np.column_stack([ground.west_m + columns * step_m, ground.north_m - rows * step_m])
    return float(within(crowns, points).mean()) * ground.area_m2


def side_by_side(crops: Path, change_id: str, folder: Path) -> None:
    """One picture of a change: before, after."""
    folder.mkdir(parents=True, exist_ok=True)
    pair = [
        cv2.imread(str(crops / f"{change_id}-{when}.png"), cv2.IMREAD_COLOR)
        for when in ("before", "after")
    ]
    if all(picture is not None for picture in pair):
        scale = max(1, 320 // max(pair[0].shape[:2]))
        pair = [
            cv2.resize(each, None, fx=scale, fy=scale, interpolation=cv2.INTER_NEAREST)
            for each in pair
        ]
        cv2.imwrite(str(folder / f"{change_id}.png"), np.hstack(pair))


if __name__ == "__main__":
    main()
