"""What the memory of a place costs a station over many flights, with the index of the sites and without.

    python benchmarks/station_place.py [--flights 1000] [--sites 20]

Sites are real folders with catalogues and frames, without pictures and tiles. Flights are surveys of one ground each
site, spread over the sites as visits are (see archive_place.py). The most visited site is asked: by a station that was
just started, by one that has answered before, and after a flight came. Processor time is that of the station's process.
"""

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from starlette.testclient import TestClient

import provenance
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.geodesy import Geodetic
from sorvolo.geometry.homography import site_from_image_homography
from sorvolo.geometry.level_ground import footprint
from sorvolo.geometry.pose import Pose, site_from_gimbal_rotation
from sorvolo.missions.archive.index import index_archive
from sorvolo.station import place
from sorvolo.station.app import station_app
from sorvolo.station.settings import StationSettings
from sorvolo.store.site.archive import Archive
from sorvolo.survey.flight import Site
from sorvolo.survey.mosaic import PlacedFrame, Status

RESULTS = Path(__file__).parent / "results" / "station_place.json"
_CAMERA = Camera(1920, 1080, 1600.0, 1600.0, 959.5, 539.5)
_FRAMES = 60
_AGAIN = 20  # times the same question is asked


def visits(flights: int, sites: int) -> list[int]:
    """How many flights each site has."""
    shares = np.arange(1, sites + 1) ** -0.8
    counts = np.maximum(1, np.floor(shares / shares.sum() * flights).astype(int))
    counts[0] += flights - counts.sum()
    return counts.tolist()


def fly(archive: Archive, number: int) -> None:
    """One survey of four strips."""
    chance = np.random.default_rng(number)
    moved_m = chance.normal(0, 5, 2)
    placed = []
    for index in range(_FRAMES):
        at_m = np.array([7.0 * (index % 15) + moved_m[0], 7.0 * (index // 15) + moved_m[1], 20.0])
        pose = Pose(site_from_gimbal_rotation(float(chance.normal(0, 3)), -90.0, 0.0), at_m)
        placed.append(
            PlacedFrame(
                str(index),
                index,
                (1_600_000_000 + 86_400 * number + index) * 10**9,
                Status.VISION,
                "",
                _CAMERA,
                pose,
                site_from_image_homography(_CAMERA, pose),
                footprint(_CAMERA, pose),
                0.4,
                0.05,
            )
        )
    with archive.begin_flight(f"flight-{number:04d}", f"print-{number}", {}) as writer:
        writer.commit(placed, {}, {}, "")


def asked(client: TestClient, times: int) -> tuple[float, int]:
    """Processor milliseconds of the station for one question, and how many frames it found."""
    begun, found = time.process_time(), 0
    for _ in range(times):
        answer = client.get(
            "/api/sites/site-000/place",
            params={"lon": 13.0005, "lat": 46.0001, "most_per_flight": 3},
        )
        found = len(answer.json())
    return 1000 * (time.process_time() - begun) / times, found


def measured(root: Path, number: int) -> dict[str, Any]:
    """A station that is started anew: its first question, the next ones, and the one after a flight."""
    rows: dict[str, Any] = {}
    app = station_app(StationSettings(root))
    with TestClient(app, base_url="http://127.0.0.1:8750", client=("127.0.0.1", 1)) as client:
        client.get("/api/status")
        time.sleep(3.0)  # it looks at all sites once
        rows["first_ms"], rows["found"] = asked(client, 1)
        rows["next_ms"], _ = asked(client, _AGAIN)
        with Archive.open(root / "site-000", write=True) as archive:
            fly(archive, number)
        time.sleep(1.0)
        rows["after_a_flight_ms"], _ = asked(client, 1)
    return {name: round(each, 1) for name, each in rows.items()}


def main() -> int:
    """Make the sites, ask, print and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--flights", type=int, default=1000)
    parser.add_argument("--sites", type=int, default=20)
    options = parser.parse_args()
    counts = visits(options.flights, options.sites)
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "sites"
        for site, count in enumerate(counts):
            with Archive.open(root / f"site-{site:03d}", write=True) as archive:
                archive.create_site(
                    Site(f"site {site}", Geodetic(46.0 + 0.01 * site, 13.0), "EPSG:32633", 0.05)
                )
                for number in range(count):
                    fly(archive, number)
        print(f"{sum(counts)} flights", file=sys.stderr, flush=True)
        index_of = place.PlaceIndex.of_site
        place.PlaceIndex.of_site = lambda *_: None  # type: ignore[method-assign,assignment]
        without = measured(root, 9001)
        place.PlaceIndex.of_site = index_of  # type: ignore[method-assign]
        begun = time.process_time()
        for _ in index_archive(root):
            pass
        indexed_s = time.process_time() - begun
        figures = {
            "flights": sum(counts),
            "sites": len(counts),
            "flights_of_the_site": counts[0],
            "frames_a_flight": _FRAMES,
            "index_cpu_s": round(indexed_s, 1),
            "processor_ms": {
                "without": without,
                "with_index": measured(root, 9002),
            },
        }
    print(json.dumps(figures, indent=1))
    made_by = {"machine": provenance.machine(), "commit": provenance.commit()}
    RESULTS.write_text(json.dumps({**made_by, **figures}, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
