"""No change, no alarm: real flights, mapped from every second photo, compared with the photos between.

python benchmarks/change_real.py DATA [--pictures FOLDER]    (DATA holds brighton_beach/ and caliterra/)

The photos of a flight are seconds apart, so every reported event is false, or something that really moved in those
seconds: a car on its way, a person. Nobody decides that here; each event is listed, and with --pictures its crops are
put side by side for looking at. Each flight is compared twice: the even photos with a map of the odd ones, and the
other way round. False events are given per hectare of compared ground outside and within tree crowns. Crowns were
outlined by hand on the maps, about a metre generously; an event lies within when its centre does. Written to
results/change_real.json.
"""

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from collections import deque
from pathlib import Path

import cv2
import numpy as np

from provenance import commit, machine, note_scoring
from sorvolo.change.metrics import ComparedGround, compared_ground
from sorvolo.geometry.geodesy import Projection
from sorvolo.geometry.polygons import points_inside
from sorvolo.missions.compare.flights import compare_flights
from sorvolo.missions.evaluate.frame_rows import map_frames
from sorvolo.missions.flight.settings import CompareSettings, MapSettings
from sorvolo.missions.map.flights import map_flights
from sorvolo.store.site.archive import Archive

RESULTS = Path(__file__).parent / "results" / "change_real.json"
METHODS = ("thesis", "robust")
_UNKNOWN_GROUND = ("not-aligned", "outside", "lost", "rejected")

# UTM metres less the offset (east, north), outlines of crowns and tall shrubs
CROWNS: dict[str, tuple[str, tuple[float, float], list[list[tuple[float, float]]]]] = {
    "brighton_beach": ("EPSG:32615", (576628.1, 5188243.3), [
        [(-12, -70), (15, -30), (25, -18), (60, 15), (80, -2), (88, -2), (108, -17), (102, -34), (95, -43),
         (89, -51), (86, -56), (77, -60), (72, -65), (68, -72), (62, -76), (55, -81), (50, -86), (49, -94),
         (44, -98), (37, -103)],
        [(97, -93), (103, -86), (112, -86), (114, -91), (118, -94), (125, -95), (128, -91), (137, -89),
         (133, -100), (127, -105), (126, -113), (120, -120), (114, -127), (107, -127), (100, -122), (99, -115),
         (98, -103)],
        [(112, -59), (120, -53), (128, -49), (137, -50), (144, -56), (137, -66), (133, -74), (124, -73),
         (112, -68)],
        [(100, -82), (108, -79), (116, -76), (121, -80), (114, -87), (103, -89)],
        [(104, -70), (114, -70), (114, -76), (104, -76)],
        [(69, -75), (74, -71), (81, -71), (87, -77), (84, -83), (77, -83), (71, -80)],
        [(76, -95), (84, -93), (86, -98), (81, -103), (76, -100)],
        [(89, -56), (97, -54), (98, -60), (91, -61)],
        [(100, -46), (109, -46), (113, -49), (109, -53), (100, -52)],
        [(102, -54), (109, -53), (110, -59), (103, -60)],
        [(83, -63), (96, -62), (96, -69), (83, -69)],
        [(66, -128), (68, -120), (76, -115), (86, -113), (91, -110), (97, -112), (98, -118), (90, -121),
         (80, -119), (77, -124), (70, -130), (65, -136), (59, -137), (59, -133)],
        [(133, -91), (136, -82), (141, -75), (151, -80), (146, -87), (139, -91)],
        [(71, -81), (77, -81), (77, -91), (71, -91)],
        [(83, -81), (88, -81), (89, -90), (83, -90)],
        [(40, -117), (43, -113), (49, -114), (50, -119), (46, -120)],
    ]),
    "caliterra": ("EPSG:32614", (587519.4, 3338227.7), [
        [(45, -35), (71, -45), (64, -68), (56, -84), (52, -111), (45, -128), (37, -137), (35, -145), (-10, -140),
         (5, -105), (20, -85), (30, -60)],
        [(117, -26), (128, -23), (141, -40), (138, -44), (123, -39)],
        [(104, -170), (108, -157), (120, -152), (132, -160), (133, -176), (121, -186), (108, -183)],
        [(152, -169), (160, -160), (172, -162), (176, -172), (170, -183), (158, -183)],
    ]),
}


def main() -> None:
    """Run all comparisons, or one in the child process."""
    layout = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=layout)
    parser.add_argument("data", type=Path)
    parser.add_argument("--flights", nargs="+", choices=tuple(CROWNS), default=tuple(CROWNS))
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=("robust",))
    parser.add_argument("--pictures", type=Path, help="folder for a picture of each event: before, after")
    parser.add_argument("--keep", type=Path, help="folder for the maps, used again when run again")
    parser.add_argument("--output", type=Path, default=RESULTS)
    parser.add_argument("--run", nargs=3, metavar=("METHOD", "PHOTOS", "SITE"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.run:
        compare(options.run[0], Path(options.run[1]), Path(options.run[2]))
        return
    scoring = note_scoring("change_real, brighton_beach and caliterra")
    runs = []
    for name in options.flights:
        for parity in (0, 1):
            with tempfile.TemporaryDirectory() as scratch:
                folder = (options.keep or Path(scratch)) / f"{name}-{parity}"
                known, later = halves(options.data / name, folder, parity)
                base = folder / "base"
                if not (base / "mosaic.tif").is_file():
                    list(map_flights([known], base, MapSettings(model="none")))
                for method in options.methods:
                    print(f"{name}, map of photos {parity}::2: {method}", file=sys.stderr, flush=True)
                    site = folder / method
                    subprocess.run(["rm", "-rf", str(site)], check=True)
                    subprocess.run(["cp", "-r", str(base), str(site)], check=True)
                    runs.append({"flight": name, "mapped": f"{parity}::2", "method": method, **measured(
                        name, method, later, site, options.pictures
                    )})
    options.output.parent.mkdir(exist_ok=True)
    summary = {name: {method: pooled([run for run in runs if (run["flight"], run["method"]) == (name, method)])
                      for method in options.methods} for name in options.flights}
    summary["all"] = {method: pooled([run for run in runs if run["method"] == method]) for method in options.methods}
    options.output.write_text(json.dumps({
        "benchmark": "change_real", "machine": machine(), "commit": commit(), **scoring,
        "summary": summary, "runs": runs,
    }, indent=1) + "\n")
    print(json.dumps(summary, indent=1))


def halves(photos: Path, folder: Path, parity: int) -> tuple[Path, Path]:
    """Folders with links to every second photo, and to the others."""
    files = sorted(path for path in photos.iterdir() if path.suffix.lower() in (".jpg", ".jpeg"))
    places = folder / "mapped", folder / "later"
    for place, chosen in zip(places, (files[parity::2], files[1 - parity::2])):
        place.mkdir(parents=True, exist_ok=True)
        for path in chosen:
            link = place / path.name
            if not link.exists():
                link.symlink_to(path.resolve())
    return places


def compare(method: str, photos: Path, site: Path) -> None:
    """In the child: compare, then print the cost as JSON."""
    started = time.monotonic()
    (last,) = deque(compare_flights([photos], site, CompareSettings(method=method, model="none")), 1)
    used = resource.getrusage(resource.RUSAGE_SELF)
    print(json.dumps({
        "photos": last.frames_expected, "views": last.views, "compared": last.compared,
        "wall_s": round(time.monotonic() - started, 1), "cpu_s": round(used.ru_utime + used.ru_stime, 1),
        "peak_mb": round(used.ru_maxrss / 1024),
    }))


def measured(name: str, method: str, photos: Path, site: Path, pictures: Path | None) -> dict:
    """One comparison's events, outside and within crowns, per hectare of compared ground."""
    command = [sys.executable, __file__, "ignored", "--run", method, str(photos), str(site)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=3600)
    if done.returncode:
        return {"failure": (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1]}
    with Archive.open(site, write=False) as archive:
        described = archive.site()
    frames = map_frames(site, described)
    flight = photos.name
    outlines = {
        each: [row.outline_m for row in rows if row.status not in _UNKNOWN_GROUND and np.isfinite(row.outline_m).all()]
        for each, rows in frames.items()
    }
    known = [outline for other in frames if other != flight for outline in outlines[other]]
    ground = compared_ground(outlines[flight], known)
    crowns = crowns_m(name, described.frame)
    crown_m2 = crown_area_m2(ground, crowns)
    events = []
    for feature in json.loads((site / "flights" / flight / "changes.geojson").read_text())["features"]:
        properties = feature["properties"]
        ring = described.frame.ground_from_lonlat(feature["geometry"]["coordinates"][0][:-1])
        in_crown = bool(within(crowns, ring.mean(axis=0)[None])[0])
        keys = ("id", "kind", "score", "views", "area_m2", "length_m", "sigma_m")
        events.append({**{key: properties[key] for key in keys}, "in_crown": in_crown})
        if pictures is not None:
            crops = site / "flights" / flight / "changes"
            side_by_side(crops, properties["id"], pictures / f"{site.parent.name}-{method}")
    return {
        **json.loads(done.stdout.splitlines()[-1]), "outside_m2": round(ground.area_m2 - crown_m2),
        "crowns_m2": round(crown_m2), "outside": sum(not each["in_crown"] for each in events),
        "within": sum(each["in_crown"] for each in events), "events": events,
    }


def crowns_m(name: str, frame) -> list[np.ndarray]:
    """The crowns of a flight's ground in the site's metres."""
    crs, (east, north), rings = CROWNS[name]
    outlines = []
    for ring in rings:
        latitude, longitude = Projection(crs).wgs84_from_projected(np.array(ring, float) + np.array([east, north]))
        outlines.append(frame.ground_from_lonlat(np.column_stack([longitude, latitude])))
    return outlines


def within(crowns: list[np.ndarray], points_m: np.ndarray) -> np.ndarray:
    """(N,) whether points lie in any crown."""
    return np.any([points_inside([ring], points_m) for ring in crowns], axis=0)


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
    pair = [cv2.imread(str(crops / f"{change_id}-{when}.png"), cv2.IMREAD_COLOR) for when in ("before", "after")]
    if all(picture is not None for picture in pair):
        scale = max(1, 320 // max(pair[0].shape[:2]))
        pair = [cv2.resize(each, None, fx=scale, fy=scale, interpolation=cv2.INTER_NEAREST) for each in pair]
        cv2.imwrite(str(folder / f"{change_id}.png"), np.hstack(pair))


def pooled(runs: list[dict]) -> dict:
    """False events per hectare over several comparisons."""
    good = [run for run in runs if "failure" not in run]
    result = {"runs": len(runs), "failed": len(runs) - len(good)}
    for place, area in (("outside", "outside_m2"), ("within", "crowns_m2")):
        events, area_m2 = sum(run[place] for run in good), sum(run[area] for run in good)
        result[place] = {
            "events": events, "hectares": round(area_m2 / 1e4, 3),
            "per_hectare": round(1e4 * events / area_m2, 2) if area_m2 else None,
            "per_hectare_runs": [round(1e4 * run[place] / run[area], 2) for run in good if run[area]],
        }
    return result


if __name__ == "__main__":
    main()
