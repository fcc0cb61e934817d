"""How long it takes to lay a frame over the map, and how well it lies: first lock by features, and followed.

python benchmarks/alignment_speed.py [--seeds 301 302]

Two simulated flights of 1280x720 (a short `compare`); processor time of one thread a frame, the map's features found
before. Errors are those of the frame's corners against the truth, the map's own shift taken out. Written to
results/alignment_speed.json.
"""

import argparse
import json
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from provenance import commit, machine
from sorvolo.capture.source import open_sources
from sorvolo.change.alignment import Aligned, Aligner
from sorvolo.change.reference import ReferenceMap
from sorvolo.geometry.homography import apply_homography, fit_similarity
from sorvolo.lab.simulate.site import simulate_site
from sorvolo.lab.simulation.presets import preset
from sorvolo.missions.flight.settings import MapSettings
from sorvolo.missions.flight.setup import prepare
from sorvolo.missions.map.flights import map_flights
from sorvolo.mosaic.selection import every
from sorvolo.registration.lens import Undistorter
from sorvolo.store.site.archive import Archive
from sorvolo.survey.flight import Frame

RESULTS = Path(__file__).parent / "results" / "alignment_speed.json"


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[301, 302])
    options = parser.parse_args()
    cv2.setNumThreads(1)
    runs = {}
    for seed in options.seeds:
        with tempfile.TemporaryDirectory() as folder:
            runs[seed] = measured(Path(folder), seed)
        print(seed, runs[seed], flush=True)
    RESULTS.write_text(
        json.dumps(
            {
                "benchmark": "alignment_speed",
                "machine": machine(),
                "commit": commit(),
                "seeds": options.seeds,
                "runs": runs,
            },
            indent=1,
        )
        + "\n"
    )


def measured(folder: Path, seed: int) -> dict[str, float]:
    """The figures of one pair of flights."""
    settings = preset("compare")
    settings = replace(settings, seed=seed, path=replace(settings.path, length_m=40, strips=1))
    for _ in simulate_site(
        folder / "flown", replace(settings, imaging=replace(settings.imaging, fps=10.0))
    ):
        pass
    camera = folder / "flown" / "camera.xml"
    for _ in map_flights(
        [folder / "flown" / "flight1"], folder / "site", MapSettings(model="none"), camera=camera
    ):
        pass
    source = open_sources([folder / "flown" / "flight2"], None, camera)[0]
    truth = {
        each["properties"]["frame"]: np.array(each["geometry"]["coordinates"][0][:4])
        for each in json.loads((folder / "flown" / "truth" / "frames.geojson").read_text())[
            "features"
        ]
        if each["properties"]["flight"] == "flight2"
    }
    with Archive.open(folder / "site", write=False) as archive:
        setup = prepare(source, MapSettings(), archive.site(), telemetry_named=False)
        grid, frame = archive.site_grid(), archive.site().frame
        reference = ReferenceMap(archive.tiles(), grid.grid)
        lens, follower = Undistorter(source.camera.camera), Aligner(reference, grid)
        followed_ms, first_ms, found_m, true_m, frames = [], [], [], [], 0
        corners = source.camera.camera.undistort_points(source.camera.camera.corners_px)
        for each in source.frames(every(0.2)):
            if not isinstance(each, Frame):
                continue
            frames += 1
            image, prior = lens.undistort(each.image), setup.prior(each, first=False)
            Aligner(reference, grid).align(
                image, lens.camera, prior, each.time_ns
            )  # finds the map's features there
            started = time.thread_time()
            first = Aligner(reference, grid).align(image, lens.camera, prior, each.time_ns)
            first_ms.append(1e3 * (time.thread_time() - started))
            started = time.thread_time()
            fit = follower.align(image, lens.camera, prior, each.time_ns)
            if isinstance(fit, Aligned) and fit.followed:
                followed_ms.append(1e3 * (time.thread_time() - started))
            if isinstance(fit, Aligned) and isinstance(first, Aligned):
                longitudes, latitudes = truth[each.index].T
                height_m = np.full(4, frame.origin.height_m)
                true_m.append(frame.site_from_wgs84(latitudes, longitudes, height_m)[:, :2])
                found_m.append(apply_homography(fit.site_from_image, corners))
    found, true = np.concatenate(found_m), np.concatenate(true_m)
    rest_m = np.linalg.norm(apply_homography(fit_similarity(true, found), found) - true, axis=1)
    return {
        "frames": frames,
        "aligned": len(found_m),
        "followed": len(followed_ms),
        "first_lock_cpu_ms_median": round(float(np.median(first_ms)), 1),
        "followed_cpu_ms_median": round(float(np.median(followed_ms)), 1),
        "followed_cpu_ms_p95": round(float(np.percentile(followed_ms, 95)), 1),
        "corner_error_rms_m": round(float(np.sqrt(np.mean(rest_m**2))), 4),
    }


if __name__ == "__main__":
    main()
