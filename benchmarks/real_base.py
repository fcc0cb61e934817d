"""Two real dates of one building site: how well `map --base` ties a flight of the later date to a map of the earlier.

python benchmarks/real_base.py DATA --keep FOLDER [--pairs 2024-02-24/2024-03-01 ...]

Flights, maps and the pairs' transforms are those of real_dates.py, which describes them. The later photos have no
attitude; their GPS is good to 1 m rms, or left out as well (`gps: none`). A frame's error is the median distance of its
four corners from where the pair's transform has them, in metres; it is compared with the accuracy that the map states.
The transform itself is a mean over learned features that scatter 0.45 m, so it cannot judge below some 0.1 m.
Written to results/real_base.json.
"""

import argparse
import json
import shutil
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

import real_dates
from provenance import commit, machine
from sorvolo.errors import InputError
from sorvolo.geometry.homography import apply_homography
from sorvolo.lab.evaluation.frame_rows import map_frames
from sorvolo.missions.flight.settings import MapSettings
from sorvolo.missions.map.flights import map_flights
from sorvolo.store.site.archive import Archive

RESULTS = Path(__file__).parent / "results" / "real_base.json"
_SEED = 1


def main() -> None:
    """Tie the later flight of every pair to the earlier map, with and without GPS."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", type=Path)
    parser.add_argument(
        "--keep",
        type=Path,
        required=True,
        help="folder for photos and maps, used again when run again",
    )
    parser.add_argument(
        "--pairs", nargs="+", default=[*real_dates.HELD_OUT, *real_dates.DEVELOPMENT]
    )
    options = parser.parse_args()
    truth = json.loads((real_dates.HERE / "real_dates.json").read_text())
    runs = []
    for name in options.pairs:
        pair = real_dates.Pair.of(name, truth["pairs"])
        for gps in ("1 m", "none"):
            runs.append({"pair": name, "gps": gps, **tied(pair, gps, options.data, options.keep)})
            print(json.dumps(runs[-1]))
    result = {
        "benchmark": "real_base",
        "commit": commit(),
        "machine": machine(),
        "seed": _SEED,
        "runs": runs,
    }
    RESULTS.write_text(json.dumps(result, indent=1) + "\n")


def tied(pair: real_dates.Pair, gps: str, data: Path, keep: Path) -> dict[str, Any]:
    """Map the earlier date, tie the later one to it, and measure where its frames lie."""
    earlier, later = pair.name.split("/")
    first, size_px = real_dates.fly(data, earlier, 2 * _SEED)
    second, _ = real_dates.fly(data, later, 2 * _SEED + 1)
    mapped, flown = (
        keep / f"photos_{earlier}_{2 * _SEED}_known",
        keep / f"photos_{later}_{2 * _SEED + 1}_none",
    )
    shown = real_dates.write_photos(first, mapped, size_px, "known", real_dates.begins_ns(earlier))
    seen = real_dates.write_photos(second, flown, size_px, "none", real_dates.begins_ns(later))
    base, site = keep / f"map_{earlier}_{2 * _SEED}", keep / "tied"
    if not (base / "mosaic.tif").is_file():
        shutil.rmtree(base, ignore_errors=True)
        deque(map_flights([mapped], base, MapSettings(model="none"), camera=keep / "camera.xml"), 0)
    if gps == "none":
        flown = without_telemetry(flown)
    shutil.rmtree(site, ignore_errors=True)
    tying = map_flights(
        [flown], site, MapSettings(model="none"), camera=keep / "camera.xml", base=base
    )
    try:
        deque(tying, 0)
    except InputError as error:
        return {"frames": len(seen), "refused": str(error).replace(str(base), "MAP")}
    with Archive.open(base, write=False) as archive:
        frame = archive.site().frame
        map_from_true = real_dates.map_error(
            first, shown, map_frames(base, archive.site())[mapped.name], frame
        )
    with Archive.open(site, write=False) as archive:
        theirs, rows = archive.site().frame, map_frames(site, archive.site())[flown.name]
        report = archive.report(flown.name)
    errors_m = []
    for row in rows:
        if row.status == "vision":
            true_px = real_dates.pixels(
                real_dates.footprint(second.camera, second.true_poses[seen[row.name]]), size_px
            )
            on_a_m = real_dates.metres(pair.a_from_b(true_px, size_px), size_px)
            expected_m = apply_homography(
                map_from_true, real_dates.moved_frame(on_a_m, second.site, frame)
            )
            there_m = real_dates.moved_frame(row.outline_m, theirs, frame)
            errors_m.append(float(np.median(np.linalg.norm(there_m - expected_m, axis=1))))
    return {
        "frames": len(seen),
        "matched": len(errors_m),
        "found_on_base": report["base"]["found"],
        "error_median_m": round(float(np.median(errors_m)), 3),
        "error_most_m": round(max(errors_m), 3),
    }


def without_telemetry(folder: Path) -> Path:
    """The same photos with nothing but their pixels, in a folder beside."""
    bare = folder.with_name(f"{folder.name}_bare")
    bare.mkdir(exist_ok=True)
    for path in sorted(folder.iterdir()):
        with Image.open(path) as picture:
            picture.save(bare / path.name, quality=95, exif=b"")
    return bare


if __name__ == "__main__":
    main()
