"""Real photo flights beside other programs: pictures used, where their centres lie, time and memory, in one run.

python benchmarks/peers.py DATA [--flights brighton_beach caliterra] [--peer-bin DIR] [--three-d]

Peers: OpenCV's Stitcher (mode SCANS, photos of about one megapixel) and PyPI's pyOrthomosaic (MIT), whose programs
`orthomosaic` and, with --three-d, `orthomosaic-3d` lie in DIR, a virtual environment's bin that has pycolmap too.
Reference: COLMAP's cameras by pycolmap, on the same photos, scaled and turned onto the GPS fixes. A picture's centre on
the ground is where its optical axis meets the plane through COLMAP's points; each program's centres are laid over those
by the best similarity, so the figure judges the shape of the map and not its datum. The reference errs itself where
there are no points. Two cores; processor time and peak memory are the operating system's account of each process.
Written to results/peers.json. These flights are development data: this is a comparison, not a held-out score.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pyproj import Transformer

from provenance import commit, machine
from sorvolo.geometry.homography import apply_homography, fit_similarity

RESULTS = Path(__file__).parent / "results" / "peers.json"
_PHOTOS = (".jpg", ".jpeg")
_LIMIT_S = 1800

_STITCHER = """
import sys, cv2, json
pictures = []
for path in sys.argv[2:]:
    picture = cv2.imread(path)
    scale = min(1.0, (1e6 / (picture.shape[0] * picture.shape[1])) ** 0.5)
    pictures.append(cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA))
stitcher = cv2.Stitcher.create(cv2.Stitcher_SCANS)
status, _ = stitcher.stitch(pictures)
used = len(stitcher.component()) if status == cv2.Stitcher_OK else 0
json.dump({"status": int(status), "used": used}, open(sys.argv[1], "w"))
"""

_COLMAP = """
import sys, json, pathlib, numpy as np, pycolmap
out, photos = pathlib.Path(sys.argv[1]), pathlib.Path(sys.argv[2])
work = out.parent / "colmap"
work.mkdir()
options = pycolmap.FeatureExtractionOptions()
options.max_image_size, options.num_threads = 2000, 2
pycolmap.extract_features(work / "db", photos, camera_mode=pycolmap.CameraMode.SINGLE, extraction_options=options)
pycolmap.match_exhaustive(work / "db")
maps = pycolmap.incremental_mapping(work / "db", photos, work)
best = max(maps.values(), key=lambda each: each.num_reg_images())
points = np.array([p.xyz for p in best.points3D.values()])
rows = {}
for image in best.images.values():
    if image.has_pose:
        pose = image.cam_from_world()
        rotation = pose.rotation.matrix()
        rows[image.name] = {"centre": (-rotation.T @ pose.translation).tolist(), "axis": rotation[2].tolist()}
json.dump({"cameras": rows, "points": points[:: max(1, len(points) // 20000)].tolist()}, open(out, "w"))
"""


def main() -> None:
    """Run every program on every flight and write the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", type=Path)
    parser.add_argument("--flights", nargs="+", default=["brighton_beach", "caliterra"])
    parser.add_argument("--peer-bin", type=Path)
    parser.add_argument("--three-d", action="store_true")
    parser.add_argument("--output", type=Path, default=RESULTS)
    options = parser.parse_args()
    flights = {
        name: compared(options.data / name, options.peer_bin, options.three_d)
        for name in options.flights
    }
    if options.output.is_file():
        keep_earlier(flights, json.loads(options.output.read_text()))
    result = {"benchmark": "peers", "machine": machine(), "commit": commit(), "flights": flights}
    options.output.write_text(json.dumps(result, indent=1) + "\n")
    print(json.dumps(result, indent=1))


def keep_earlier(flights: dict[str, Any], before: dict[str, Any]) -> None:
    """Flights and pyOrthomosaic's 3D that only an earlier run has are kept, with that run's commit."""
    for name, known in before["flights"].items():
        if name not in flights:
            flights[name] = {"commit": before["commit"]} | known
        elif "pyorthomosaic_3d" in known and "pyorthomosaic_3d" not in flights[name]:
            flights[name]["pyorthomosaic_3d"] = {"commit": before["commit"]} | known[
                "pyorthomosaic_3d"
            ]


def compared(folder: Path, peer_bin: Path | None, three_d: bool) -> dict[str, Any]:
    """One flight by every program."""
    photos = sorted(path for path in folder.iterdir() if path.suffix.lower() in _PHOTOS)
    with tempfile.TemporaryDirectory() as scratch:
        place = Path(scratch)
        runs: dict[str, Any] = {"photos": len(photos)}
        centres: dict[str, dict[str, Sequence[float]]] = {}
        site = place / "site"
        runs["sorvolo"] = measured(
            [sys.executable, "-m", "sorvolo", "map", folder, "--site", site, "--model", "none"]
        )
        centres["sorvolo"] = ours(site, runs["sorvolo"])
        found = place / "stitcher.json"
        runs["opencv_stitcher"] = measured([sys.executable, "-c", _STITCHER, found, *photos])
        runs["opencv_stitcher"]["used"] = (
            json.loads(found.read_text())["used"] if found.exists() else 0
        )
        if peer_bin is not None:
            runs["pyorthomosaic_2d"] = measured(
                [
                    peer_bin / "orthomosaic",
                    folder,
                    "-o",
                    place / "po.tif",
                    "--workers",
                    "2",
                    "--no-preview",
                ]
            )
            centres["pyorthomosaic_2d"] = theirs(
                place / "po_report.json", photos[0], runs["pyorthomosaic_2d"]
            )
            if three_d:
                runs["pyorthomosaic_3d"] = measured(
                    [peer_bin / "orthomosaic-3d", folder, "-o", place / "po3d", "--workers", "2"]
                )
            reference = colmap_centres(peer_bin, folder, place, runs)
            for name, each in centres.items():
                runs[name]["shape_rms_m"] = shape_rms_m(each, reference)
    return runs


def measured(command: Sequence[Path | str]) -> dict[str, Any]:
    """Exit code, wall and processor seconds and peak memory of a program, killed after half an hour."""
    started_s = time.monotonic()
    environment = {**os.environ, "OMP_NUM_THREADS": "2"}
    child = subprocess.Popen(
        ["timeout", str(_LIMIT_S), *map(str, command)],
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    _, status, usage = os.wait4(child.pid, 0)
    return {
        "exit": os.waitstatus_to_exitcode(status),
        "wall_s": round(time.monotonic() - started_s, 1),
        "cpu_s": round(usage.ru_utime + usage.ru_stime, 1),
        "peak_memory_mb": round(usage.ru_maxrss / 1024),
    }


def ours(site: Path, run: dict[str, Any]) -> dict[str, Sequence[float]]:
    """Where the middle of each frame's outline lies, in metres of the site's UTM zone."""
    frames = json.loads(next(site.glob("flights/*/frames.geojson")).read_text())["features"]
    placed = [each for each in frames if each["properties"]["status"] == "vision"]
    run["used"] = len(placed)
    corners = {
        each["properties"]["frame"]: np.array(each["geometry"]["coordinates"][0][:4])
        for each in placed
    }
    longitude, latitude = next(iter(corners.values()))[0]
    zone = 32600 + int((longitude + 180) // 6) + 1 + (100 if latitude < 0 else 0)
    to_utm = Transformer.from_crs(4326, zone, always_xy=True)
    return {
        name: _crossing(np.column_stack(to_utm.transform(*points.T)))
        for name, points in corners.items()
    }


def _crossing(corners_m: np.ndarray) -> Sequence[float]:
    """Where the diagonals of an outline cross: the picture's centre, under any homography."""
    a, b, c, d = corners_m
    share = np.linalg.solve(np.column_stack([c - a, b - d]), b - a)[0]
    return (a + share * (c - a)).tolist()


def theirs(report: Path, photo: Path, run: dict[str, Any]) -> dict[str, Sequence[float]]:
    """pyOrthomosaic's picture centres, from the affine maps of its report (pixels of the full photo to UTM metres)."""
    from PIL import Image

    record = (
        json.loads(report.read_text()) if report.exists() else {"images_used": 0, "cameras": {}}
    )
    run["used"] = record["images_used"]
    with Image.open(photo) as picture:
        middle = np.array([(picture.width - 1) / 2, (picture.height - 1) / 2, 1.0])
    return {
        name: (np.array(each["affine"]) @ middle).tolist()
        for name, each in record["cameras"].items()
    }


def colmap_centres(
    peer_bin: Path, folder: Path, place: Path, runs: dict[str, Any]
) -> dict[str, Sequence[float]]:
    """Where COLMAP's optical axes meet the plane through its points, in that plane's own coordinates."""
    found = place / "colmap.json"
    runs["colmap"] = measured([peer_bin / "python", "-c", _COLMAP, found, folder])
    if not found.exists():
        return {}
    record = json.loads(found.read_text())
    runs["colmap"]["used"] = len(record["cameras"])
    points = np.array(record["points"])
    middle = np.median(points, axis=0)
    near = points[
        np.linalg.norm(points - middle, axis=1)
        < 5 * np.median(np.linalg.norm(points - middle, axis=1))
    ]
    for _ in range(
        5
    ):  # trees stand on one side of the ground only: the plane is fitted to what lies close to it
        middle = near.mean(axis=0)
        axes = np.linalg.svd(near - middle, full_matrices=False)[2]
        off = np.abs((near - middle) @ axes[2])
        near = near[off <= 2 * np.median(off) + 1e-12]
    result = {}
    for name, each in record["cameras"].items():
        centre, axis = np.array(each["centre"]) - middle, np.array(each["axis"])
        hit = centre - axis * (centre @ axes[2]) / (axis @ axes[2])
        result[name] = [float(hit @ axes[0]), float(hit @ axes[1])]
    return result


def shape_rms_m(
    found_m: dict[str, Sequence[float]], reference: dict[str, Sequence[float]]
) -> float | None:
    """Rms distance after the best similarity (mirrored or not) of the reference onto what was found, m."""
    names = sorted(set(found_m) & set(reference))
    if len(names) < 4:
        return None
    here, there = (
        np.array([found_m[each] for each in names]),
        np.array([reference[each] for each in names]),
    )
    misses = []
    for mirror in (1.0, -1.0):
        moved = apply_homography(fit_similarity(here, there * [1.0, mirror]), there * [1.0, mirror])
        misses.append(float(np.sqrt(((moved - here) ** 2).sum(axis=1).mean())))
    return min(misses)


if __name__ == "__main__":
    main()
