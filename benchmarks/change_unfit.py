"""What `compare` reports where two dates cannot be compared, or hardly: python benchmarks/change_unfit.py [--seeds ...]

Simulated photos of one site, flown again two weeks later (things come, leave and move), under each of:

- **plain**: nothing else; what the others are to be read beside.
- **night**: the later photos have 0.06 of the light.
- **snow later**, **snow on both**: closed snow on the later date, or on both.
- **flood**: half of the ground under water on the later date, with other waves on each photo.
- **other place**: the map is of another site with the same coordinates.
- **broken map**: the earlier photos carry each other's positions.

Given is how the comparison ended (the line of a refusal, or its headline), its exit code as the command has it (1
refused, 3 not to be relied on, 0), what it warned of, and how many true changes are among those reported, how many
reported ones are false, by `sorvolo evaluate changes`. Snow, water and their shores are no changes of the truth: an
`area` over them is counted apart, as `areas`. Written to results/change_unfit.json.
"""

import argparse
import json
import random
import tempfile
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import Image

from provenance import commit, machine, note_scoring, seeds_or_drawn
from sorvolo.errors import SorvoloError
from sorvolo.geometry.homography import apply_homography, site_from_image_homography
from sorvolo.lab.evaluation.changes import as_json, evaluate_changes
from sorvolo.lab.simulate.site import simulate_site
from sorvolo.lab.simulation.flight import SimulatedFlight, simulate_flights
from sorvolo.lab.simulation.presets import preset
from sorvolo.lab.simulation.settings import SimulationSettings, WeatherSettings
from sorvolo.missions.compare.flights import compare_flights
from sorvolo.missions.flight.settings import CompareSettings, MapSettings
from sorvolo.missions.map.flights import map_flights

RESULTS = Path(__file__).parent / "results" / "change_unfit.json"
CASES = ("plain", "night", "snow later", "snow on both", "flood", "other place", "broken map")
SNOW = WeatherSettings(has_clouds=False, snow=1.0)
NIGHT = WeatherSettings(has_clouds=False, brightness=0.06)


def main() -> None:
    """Measure every case on every seed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--seeds", type=int, nargs="*", default=[], help="without: two that nobody has scored"
    )
    parser.add_argument("--cases", nargs="+", choices=CASES, default=CASES)
    parser.add_argument("--output", type=Path, default=RESULTS)
    options = parser.parse_args()
    seeds = seeds_or_drawn("change_unfit", options.seeds, 2)
    result: dict[str, Any] = {
        "benchmark": "change_unfit",
        "machine": machine(),
        "commit": commit(),
        "seeds": seeds,
    }
    if not options.seeds:
        result |= note_scoring(f"change_unfit, seeds {seeds}")
    result["runs"] = []
    for seed in seeds:
        for case in options.cases:
            with tempfile.TemporaryDirectory() as scratch:
                run = {"seed": seed, "case": case} | measured(case, seed, Path(scratch))
            result["runs"].append(run)
            print(json.dumps(run), flush=True)
    options.output.write_text(json.dumps(result, indent=1) + "\n")


def measured(case: str, seed: int, scratch: Path) -> dict[str, Any]:
    """One case: a map, a later flight, and what became of their comparison."""
    settings = settings_of(case, seed)
    made, site = scratch / "made", scratch / "site"
    deque(simulate_site(made, settings), 0)
    first, later = (made / f"flight{settings.flights + step}" / "photos" for step in (-1, 0))
    if case == "other place":
        other = scratch / "other"
        deque(simulate_site(other, replace(settings, seed=seed + 1, flights=1)), 0)
        first = other / "flight1" / "photos"
    if case == "broken map":
        first = with_shuffled_fixes(first, scratch / "first")
    if case == "flood":
        later = flooded(later, tuple(simulate_flights(settings))[-1], scratch / "later")
    camera = made / "camera.xml"
    deque(map_flights([first], site, MapSettings(model="none"), camera=camera), 0)
    try:
        flight = deque(
            compare_flights([later], site, CompareSettings(model="none"), camera=camera), 1
        )[0].flight
    except SorvoloError as error:
        return {"exit_code": 1, "text": str(error).replace(str(scratch), "FOLDER")}
    report = json.loads((site / "flights" / flight / "report.json").read_text())
    comparison = report["comparison"]
    doubtful = comparison["headline"]["quality"] != "compared"
    row = {
        "exit_code": 3 if doubtful else 0,
        "text": comparison["headline"]["text"],
        "warnings": report["warnings"],
        "compared_m2": comparison["compared_area_m2"],
        "gaps_m2": comparison["coverage"]["gaps_m2"],
        "areas": comparison["changes"]["area"],
        "views": comparison["views"],
    }
    if case in ("other place", "snow on both"):  # the truth is another map's
        return row | {"reported": sum(comparison["changes"].values())}
    (evaluated,) = evaluate_changes(site, made, flight=flight)
    return row | {"events": as_json([evaluated])[0]["events"]}


def settings_of(case: str, seed: int) -> SimulationSettings:
    """The flights of a case: two strips of photos, 40 m long."""
    settings = preset("compare-photos")
    weather = {"night": NIGHT, "snow later": SNOW, "snow on both": SNOW}.get(
        case, settings.later.weather
    )
    return replace(
        settings,
        seed=seed,
        flights=3 if case == "snow on both" else 2,
        path=replace(settings.path, length_m=40.0, strips=2),
        imaging=replace(settings.imaging, width_px=1280, height_px=720),
        later=replace(settings.later, weather=weather),
    )


def rewritten(photos: Path, folder: Path, changed: Callable[[np.ndarray, int], np.ndarray]) -> Path:
    """Photos with other pixels and what they state of themselves."""
    folder.mkdir()
    for index, path in enumerate(sorted(photos.glob("*.jpg"))):
        with Image.open(path) as photo:
            image = Image.fromarray(changed(np.asarray(photo.convert("RGB")), index))
            image.save(
                folder / path.name, quality=93, exif=photo.info["exif"], xmp=photo.info["xmp"]
            )
    return folder


def flooded(photos: Path, flight: SimulatedFlight, folder: Path) -> Path:
    """Photos with water on the ground east of the flight's middle, which ripples from photo to photo."""
    middle_m = float(np.median([pose.translation_m[0] for pose in flight.true_poses]))
    camera = flight.camera.undistorted()

    def under_water(image: np.ndarray, index: int) -> np.ndarray:
        height, width = image.shape[:2]
        x, y = np.meshgrid(np.arange(width), np.arange(height))
        site_from_image = site_from_image_homography(camera, flight.true_poses[index])
        east_m = apply_homography(
            site_from_image, np.column_stack([x.ravel(), y.ravel()]).astype(float)
        )[:, 0]
        rng = np.random.default_rng(index)
        waves = cv2.resize(
            rng.normal(size=(height // 8, width // 14)),
            (width, height),
            interpolation=cv2.INTER_CUBIC,
        )
        water = np.array([60, 84, 92]) + 7 * waves[..., None] + rng.normal(0, 2, (height, width, 1))
        is_wet = (east_m > middle_m).reshape(height, width, 1)
        return np.clip(np.where(is_wet, water, image), 0, 255).astype(np.uint8)

    return rewritten(photos, folder, under_water)


def with_shuffled_fixes(photos: Path, folder: Path) -> Path:
    """The photos, each with the position of another one."""
    folder.mkdir()
    paths = sorted(photos.glob("*.jpg"))
    others = random.Random(3).sample(paths, len(paths))
    for path, other in zip(paths, others, strict=True):
        with Image.open(path) as photo, Image.open(other) as stated:
            photo.save(
                folder / path.name, quality=93, exif=stated.info["exif"], xmp=stated.info["xmp"]
            )
    return folder


if __name__ == "__main__":
    main()
