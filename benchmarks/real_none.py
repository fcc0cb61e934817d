"""Nothing changed, or things that were planted: real photo flights, one strip mapped, the next strip over the same
ground compared with it.

python benchmarks/real_none.py DATA --keep FOLDER [--flights caliterra] [--planted no yes] [--pictures FOLDER]

Two strips look at the same ground from other places, most of a minute apart, so that trees and walls lean elsewhere;
photos that lie between each other in one strip would hardly differ. What is compared without anything planted is
false, or moved between two strips: a car on its way, a person. Each event is listed, and with --pictures its crops are
put side by side for looking at; what was seen to be real is given with --moved FLIGHT/STRIPS/ID.

With `--planted yes`, things are planted at places that two or more photos of the strip show: cars, people and small
things (bicycles, dogs), cut from labelled pictures of another data set while this runs (photo_cutouts.py), at true
size, in the light of each photo, with their shadow. Half of them appear (planted into the later strip's photos), half
disappear (planted into the earlier strip's); a quarter has low contrast (10 to 25 grey levels from the ground around,
else 25 or more). A thing is found when an event touches it and is at most ten times as large as it and its shadow;
further events on it are counted as reported twice; events that touch neither things nor shadows are false. Where
things stand is known from one map of all photos of the flight; the map of the earlier strip is laid on it by the
photos that both hold.

brighton_beach and caliterra are development data: they were looked at while decisions 0014 to 0019 were made, by
alternate photos, and seeds of planting do not change that. fixed_wing was never compared before this benchmark; its
camera sees near infrared, so that cut-outs are planted in grey there. Crowns were outlined by hand on the maps, about a
metre generously: events whose centre lies within one are counted apart, and nothing is planted there.

Seeds are drawn from the commit, never the same twice. Each run is appended to results/real_none.json.
"""

import argparse
import json
import shutil
import time
from collections import Counter, deque
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import Image
from shapely.geometry import Point, Polygon

from photo_cutouts import KINDS, Cutout, Planted, contrast, cutouts, in_light_of
from provenance import commit, fresh_seeds, machine, note_scoring
from real_strips import FLIGHTS, crown_area_m2, crowns_m, photos_of, within
from sorvolo.errors import InputError
from sorvolo.geometry.arrays import Floats, PointsM
from sorvolo.geometry.geodesy import LocalFrame
from sorvolo.geometry.homography import apply_homography, fit_similarity
from sorvolo.lab.evaluation.change_metrics import ComparedGround, compared_ground
from sorvolo.lab.evaluation.frame_rows import map_frames
from sorvolo.missions.compare.flights import compare_flights
from sorvolo.missions.flight.settings import CompareSettings, MapSettings
from sorvolo.missions.map.flights import map_flights
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.catalogue import StoredKeyframe
from sorvolo.survey.frame_rows import FrameRow

RESULTS = Path(__file__).parent / "results" / "real_none.json"
LEAST_VIEWS = 2
FATES = ("appeared", "disappeared")
_UNKNOWN_GROUND = ("not-aligned", "outside", "lost", "rejected")
_APART_M, _RIM_M, _TRIES = 5.0, 3.0, 60
_LOW, _HIGH = (10.0, 25.0), (25.0, 255.0)
_MOST_TIMES = 10.0


def main() -> None:
    """Compare strips with nothing planted, with things planted, or both."""
    layout = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=layout)
    parser.add_argument("data", type=Path, help="folder with flights/ and detection/")
    parser.add_argument(
        "--keep", type=Path, required=True, help="folder for maps, used again when run again"
    )
    parser.add_argument("--flights", nargs="+", choices=tuple(FLIGHTS), default=tuple(FLIGHTS))
    parser.add_argument("--planted", nargs="+", choices=("no", "yes"), default=("no", "yes"))
    parser.add_argument("--things", type=int, default=12, help="planted on each pair of strips")
    parser.add_argument(
        "--seed", type=int, help="of what is planted where; else drawn from the commit, and new"
    )
    parser.add_argument(
        "--moved",
        nargs="*",
        default=[],
        metavar="FLIGHT/STRIPS/ID",
        help="events of an unplanted run that pictures showed to be real: only counted, in RESULTS",
    )
    parser.add_argument(
        "--pictures", type=Path, help="folder for a picture of each false event: before, after"
    )
    parser.add_argument("--output", type=Path, default=RESULTS)
    options = parser.parse_args()
    if options.moved:
        mark_moved(options.output, options.moved)
        return
    seed = fresh_seeds("real_none", 1)[0] if options.seed is None else options.seed
    note_scoring(f"real_none, seeds {seed}")
    for name in options.flights:
        whole = map_of(options.data / "flights" / name, options.keep / name / "whole")
        for planted in options.planted:
            scoring = note_scoring(f"real_none, {name}, planted {planted}")
            pairs = [
                measured(name, pair, whole, seed if planted == "yes" else None, options)
                for pair in FLIGHTS[name].pairs
            ]
            run = {
                "flight": name,
                "is_development_data": not FLIGHTS[name].is_held_out,
                "planted": planted,
                "seed": seed if planted == "yes" else None,
                **scoring,
                "summary": pooled(pairs),
                "pairs": pairs,
            }
            append(options.output, run)
            print(name, "planted:", planted, json.dumps(run["summary"], indent=1), flush=True)


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
    """Note in the latest unplanted runs which events were seen to be real, and count the false ones again."""
    document = json.loads(output.read_text())
    for name in {each.split("/")[0] for each in moved}:
        run = next(
            each
            for each in reversed(document["runs"])
            if each["flight"] == name and each["planted"] == "no"
        )
        for pair in run["pairs"]:
            for event in pair["events"]:
                event["moved"] = f"{name}/{pair['strips']}/{event['id']}" in moved
        run["summary"] = pooled(run["pairs"])
    output.write_text(json.dumps(document, indent=1) + "\n")


# ---- one pair of strips ---------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class WholeMap:
    """One map of all photos of a flight: where each photo lies."""

    frame: LocalFrame
    keyframes: dict[str, StoredKeyframe]
    m_per_px: float

    def image_from_site(self, name: str, size: tuple[int, int]) -> Floats:
        """(3, 3) into a photo of this size; its lens's distortion, a pixel or two at the rim, is left out."""
        each = self.keyframes[name]
        scale = np.diag([size[0] / each.camera.width_px, size[1] / each.camera.height_px, 1.0])
        return np.asarray(scale @ np.linalg.inv(each.site_from_image))

    def outline_m(self, name: str) -> PointsM:
        """(4, 2) a photo's corners on the ground."""
        each = self.keyframes[name]
        return apply_homography(each.site_from_image, each.camera.corners_px)


def map_of(photos: Path, site: Path) -> WholeMap:
    """The map of all photos of a flight."""
    if not (site / "mosaic.tif").is_file():
        deque(map_flights([photos], site, MapSettings(model="none")), 0)
    with Archive.open(site, write=False) as archive:
        described = archive.site()
        keyframes = {each.name: each for each in archive.keyframes()}
    return WholeMap(described.frame, keyframes, described.m_per_px)


def measured(
    name: str, pair: tuple[int, int], whole: WholeMap, seed: int | None, options: argparse.Namespace
) -> dict[str, Any]:
    """Map the earlier strip, compare the later one, and match what was reported with what was planted."""
    strips = f"{pair[0] + 1}-{pair[1] + 1}"
    folder = options.keep / name / f"{strips}-{seed or 'none'}"
    shutil.rmtree(folder, ignore_errors=True)
    things, photos = write_photos(name, pair, whole, seed, folder, options)
    started = time.process_time()
    try:
        deque(map_flights([folder / "earlier"], folder / "site", MapSettings(model="none")), 0)
        deque(
            compare_flights([folder / "later"], folder / "site", CompareSettings(model="none")), 0
        )
    except InputError as error:
        return {"strips": strips, "failure": str(error)}
    spent_s = round(time.process_time() - started, 1)
    result = {
        "strips": strips,
        "photos": photos,
        "cpu_s": spent_s,
        **scored(name, folder, whole, things),
    }
    if options.pictures is not None:
        for event in result["events"]:
            crops = folder / "site" / "flights" / "later" / "changes"
            side_by_side(crops, event["id"], options.pictures / f"{name}-{strips}-{seed or 'none'}")
    return result


def write_photos(
    name: str,
    pair: tuple[int, int],
    whole: WholeMap,
    seed: int | None,
    folder: Path,
    options: argparse.Namespace,
) -> tuple[list[tuple[Planted, str]], list[int]]:
    """Both strips' photos in their folders; what was planted on them with its fate, and how many photos each has."""
    strips = [
        photos_of(options.data / "flights" / name, FLIGHTS[name].strips[number]) for number in pair
    ]
    things = []
    if seed is not None:
        planting = Planting(
            name, whole, strips, np.random.default_rng([seed, *pair]), pool(options.data, seed)
        )
        things = planting.things(options.things)
    for part, shown, paths in zip(("earlier", "later"), FATES[::-1], strips):
        write_strip(folder / part, paths, [each for each, fate in things if fate == shown], whole)
    return things, [len(each) for each in strips]


class Planting:
    """Draws things for a pair of strips. Only `things` changes it: its random numbers go on."""

    def __init__(
        self,
        name: str,
        whole: WholeMap,
        strips: list[list[Path]],
        rng: np.random.Generator,
        sources: dict[str, list[Cutout]],
    ) -> None:
        self._flight, self._whole, self._rng = FLIGHTS[name], whole, rng
        self._photos = dict(
            zip(FATES, strips[::-1])
        )  # what appears is planted into the later strip
        self._shown = {
            fate: [shrunk(whole.outline_m(path.name), _RIM_M) for path in paths]
            for fate, paths in self._photos.items()
        }
        self._crowns = crowns_m(name, whole.frame)
        self._sources = sources
        shadow_deg = self._flight.shadow_deg
        self._shadow_deg = float(rng.uniform(0, 360)) if shadow_deg is None else shadow_deg
        self._darkness = 0.15 if shadow_deg is None else 0.5

    def things(self, count: int) -> list[tuple[Planted, str]]:
        """Up to `count` things, each with its fate; kinds and fates by turns."""
        planted: list[tuple[Planted, str]] = []
        for number in range(count):
            kind, fate = list(KINDS)[number % len(KINDS)], FATES[number % 2]
            for _ in range(_TRIES):
                thing = self._tried(kind, fate, number // 3 % 4 == 2)
                if thing is not None and all(
                    np.linalg.norm(each.place_m - thing.place_m) >= _APART_M for each, _ in planted
                ):
                    planted.append((thing, fate))
                    break
        return planted

    # ---- inside -----------------------------------------------------------------------------------------------

    def _tried(self, kind: str, fate: str, is_low: bool) -> Planted | None:
        """One thing somewhere; None where too few photos show the place, in a crown, or of the other contrast."""
        cutout = self._sources[kind][int(self._rng.integers(len(self._sources[kind])))]
        if self._flight.is_grey:
            cutout = replace(
                cutout, rgb=np.repeat(cutout.rgb.mean(axis=2, keepdims=True), 3, axis=2)
            )
        place = drawn_place(self._shown[fate], self._rng)
        seen = [
            path
            for path, outline in zip(self._photos[fate], self._shown[fate])
            if outline.contains(Point(place))
        ]
        other = self._shown[FATES[1 - FATES.index(fate)]]
        if len(seen) < LEAST_VIEWS or not any(each.contains(Point(place)) for each in other):
            return None
        if within(self._crowns, place[None])[0]:
            return None
        ground = ground_colour(seen[0], place, self._whole, cutout.length_m)
        lit = in_light_of(cutout, ground, is_low, self._rng)
        low, high = _LOW if is_low else _HIGH
        if not low <= contrast(lit, ground) < high:
            return None
        turn = float(self._rng.uniform(0, 360))
        return Planted(
            lit, place, turn, self._shadow_deg, 0.6 * cutout.height_m, self._darkness, is_low
        )


@lru_cache(maxsize=1)
def pool(data: Path, seed: int, most: int = 24) -> dict[str, list[Cutout]]:
    """Cut-outs of each kind, the same for all pairs of strips."""
    rng = np.random.default_rng([seed, 7])
    return {kind: list(islice(cutouts(data, kind, rng), most)) for kind in KINDS}


def drawn_place(outlines: list[Polygon], rng: np.random.Generator) -> Floats:
    """(2,) a place anywhere in one of the outlines' boxes."""
    west, south, east, north = outlines[int(rng.integers(len(outlines)))].bounds
    return np.array([rng.uniform(west, east), rng.uniform(south, north)])


def shrunk(outline_m: PointsM, by_m: float) -> Polygon:
    """An outline without its rim."""
    return Polygon(outline_m).buffer(0).buffer(-by_m)


def ground_colour(path: Path, place_m: Floats, whole: WholeMap, reach_m: float) -> Floats:
    """(3,) the mean RGB around a place in one photo."""
    photo = read(path)
    x, y = apply_homography(whole.image_from_site(path.name, photo.shape[1::-1]), place_m[None])[0]
    reach = max(
        4,
        round(
            0.7
            * reach_m
            / whole.m_per_px
            * photo.shape[1]
            / whole.keyframes[path.name].camera.width_px
        ),
    )
    x, y = (
        int(np.clip(round(each), 0, most - 1))
        for each, most in ((x, photo.shape[1]), (y, photo.shape[0]))
    )
    left, top = max(0, x - reach), max(0, y - reach)
    mean = photo[top : y + reach + 1, left : x + reach + 1].reshape(-1, 3).mean(axis=0)
    return np.asarray(mean)


@lru_cache(maxsize=32)
def read(path: Path) -> np.ndarray:
    """A photo, RGB uint8; a strip's stay in memory."""
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB"))


def write_strip(folder: Path, paths: list[Path], things: list[Planted], whole: WholeMap) -> None:
    """The strip's photos with the things on them; a photo that shows none is linked."""
    folder.mkdir(parents=True)
    first: dict[int, Floats] = {}
    for path in paths:
        outline = Polygon(whole.outline_m(path.name)).buffer(2.0)
        seen = [
            number for number, each in enumerate(things) if outline.contains(Point(each.place_m))
        ]
        if not seen:
            (folder / path.name).symlink_to(path.resolve())
            continue
        photo = read(path).astype(np.float32)
        to_image = whole.image_from_site(path.name, photo.shape[1::-1])
        for number in seen:
            thing = things[number]
            ground = ground_colour(path, thing.place_m, whole, thing.cutout.length_m)
            gain = float(np.clip(ground.mean() / first.setdefault(number, ground).mean(), 0.7, 1.4))
            thing.paint(photo, to_image, gain)
        with Image.open(path) as image:
            kept = {"exif": image.getexif()} | (
                {"xmp": image.info["xmp"]} if "xmp" in image.info else {}
            )
        Image.fromarray(np.clip(photo, 0, 255).astype(np.uint8)).save(
            folder / path.name, quality=95, **kept
        )


# ---- scoring --------------------------------------------------------------------------------------------------------


def scored(
    name: str, folder: Path, whole: WholeMap, things: list[tuple[Planted, str]]
) -> dict[str, Any]:
    """Events against what was planted, in the metres of the whole flight's map."""
    site = folder / "site"
    with Archive.open(site, write=False) as archive:
        described = archive.site()
    rows = map_frames(site, described)
    whole_from_site = laid_on(whole, rows["earlier"])
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
    for feature in features:
        ring = described.frame.ground_from_lonlat(
            np.array(feature["geometry"]["coordinates"][0])[:-1, :2]
        )
        keys = ("id", "kind", "score", "views", "area_m2", "length_m", "sigma_m")
        events.append(
            {
                **{key: feature["properties"][key] for key in keys},
                "moved": False,
                "in_crown": bool(within(crowns, ring.mean(axis=0)[None])[0]),
                "outline": Polygon(apply_homography(whole_from_site, ring)).buffer(0),
            }
        )
    report = json.loads((site / "flights" / "later" / "report.json").read_text())["comparison"]
    planted, events = matched(events, things, ground, np.linalg.inv(whole_from_site))
    return {
        "views": report["views"],
        "reasons": report["reasons"],
        "outside_m2": round(ground.area_m2 - crown_m2),
        "crowns_m2": round(crown_m2),
        "things": planted,
        "events": events,
    }


def laid_on(whole: WholeMap, rows: list[FrameRow]) -> Floats:
    """(3, 3) from metres of a strip's own map to those of the whole map, by the photos that both hold."""
    pairs = [
        (row.outline_m, whole.outline_m(row.name))
        for row in rows
        if np.isfinite(row.outline_m).all()
    ]
    return fit_similarity(
        np.concatenate([true for _, true in pairs]), np.concatenate([mine for mine, _ in pairs])
    )


def matched(
    events: list[dict[str, Any]],
    things: list[tuple[Planted, str]],
    ground: ComparedGround,
    site_from_whole: Floats,
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """How each thing fared, and the events that lie on none; those that lie on a thing are counted there."""
    planted, explained = [], set()
    for thing, fate in things:
        own = Polygon(thing.outline_m).buffer(0)
        shaded = own.union(Polygon(thing.shadow_outline_m).buffer(0)).convex_hull
        touching = {
            number
            for number, each in enumerate(events)
            if each["outline"].intersects(shaded.buffer(0.3))
        }
        explained |= touching
        place = apply_homography(site_from_whole, thing.place_m[None])
        planted.append(
            {
                "kind": thing.cutout.kind,
                "label": thing.cutout.label,
                "when": fate,
                "contrast": "low" if thing.is_low else "high",
                "compared": bool(ground.holds(place)[0]),
                "place_m": [round(float(value), 1) for value in thing.place_m],
                **fared([events[number] for number in sorted(touching)], own, shaded.area, fate),
            }
        )
    return planted, [listed(each) for number, each in enumerate(events) if number not in explained]


def listed(event: dict[str, Any]) -> dict[str, Any]:
    """An event as the results list it."""
    return {key: value for key, value in event.items() if key != "outline"}


def fared(
    touching: list[dict[str, Any]], own: Polygon, shaded_m2: float, fate: str
) -> dict[str, Any]:
    """Whether events touch a thing and are not far larger, how many do, and whether one names what became of it."""
    most_m2 = _MOST_TIMES * max(shaded_m2, 0.2)
    hits = [
        each["kind"]
        for each in touching
        if each["outline"].intersects(own) and each["outline"].area <= most_m2
    ]
    return {"found": bool(hits), "times": len(hits), "named_right": fate in hits}


def pooled(pairs: list[dict[str, Any]]) -> dict[str, Any]:
    """False events a hectare, outside and within crowns, and what was found by kind, fate and contrast."""
    good = [pair for pair in pairs if "failure" not in pair]
    ends = Counter(place_of(event) for pair in good for event in pair["events"])
    outside_m2, crowns_m2 = (sum(pair[key] for pair in good) for key in ("outside_m2", "crowns_m2"))
    return {
        "pairs": len(pairs),
        "failed": len(pairs) - len(good),
        "hectares_outside_crowns": round(outside_m2 / 1e4, 3),
        "false_outside_crowns": ends["outside"],
        "false_a_hectare": rate(ends["outside"], outside_m2),
        "hectares_in_crowns": round(crowns_m2 / 1e4, 3),
        "false_in_crowns": ends["in_crowns"],
        "moved": ends["moved"],
        **found_words([each for pair in good for each in pair["things"] if each["compared"]]),
    }


def place_of(event: dict[str, Any]) -> str:
    """Where an event that lies on no thing is counted."""
    return "moved" if event["moved"] else "in_crowns" if event["in_crown"] else "outside"


def found_words(things: list[dict[str, Any]]) -> dict[str, Any]:
    """How many things on compared ground were found, reported twice, and named right; nothing of none."""
    totals, hits = Counter[str](), Counter[str]()
    for each in things:
        for group in ("all", each["kind"], each["when"], f"{each['contrast']} contrast"):
            totals[group] += 1
            hits[group] += each["found"]
    found = {group: f"{hits[group]} of {count}" for group, count in totals.items()}
    named = f"{sum(each['named_right'] for each in things)} of {hits['all']}"
    return (
        {"found": found, "twice": sum(each["times"] > 1 for each in things), "named_right": named}
        if things
        else {}
    )


def rate(count: int, area_m2: float) -> float | None:
    """How many a hectare."""
    return round(1e4 * count / area_m2, 2) if area_m2 else None


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
