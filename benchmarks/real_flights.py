"""Real photo flights: how many frames vision places, and how far off cameras lie whose own GPS fix was withheld.

python benchmarks/real_flights.py DATA [--flights fixed_wing]    (DATA: a folder with the flights, see CONTRIBUTING.md)

Each flight is mapped as it is; those that are not asked for keep their figures, each with the commit it is of.
brighton_beach is then mapped twice more with the GPS position taken out of every second photo (the odd ones, then the
even ones), and the cameras found are compared with the fixes taken out. Those fixes err themselves, by about half a
metre, so the figure is an upper bound. Written to results/real_flights.json.
"""

import argparse
import json
import tempfile
import time
from pathlib import Path

import numpy as np
from PIL import Image

from provenance import commit, machine
from sorvolo.capture.photo_metadata import read_photo_metadata
from sorvolo.geometry.geodesy import Geodetic, LocalFrame
from sorvolo.missions.flight.settings import MapSettings
from sorvolo.missions.map.flights import map_flights

RESULTS = Path(__file__).parent / "results" / "real_flights.json"
FLIGHTS = ("brighton_beach", "caliterra", "fixed_wing")
_GPS_IFD = 0x8825


def main() -> None:
    """Map the flights and write the figures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", type=Path)
    parser.add_argument("--output", type=Path, default=RESULTS)
    parser.add_argument("--flights", nargs="+", choices=FLIGHTS, default=FLIGHTS)
    options = parser.parse_args()
    result = json.loads(options.output.read_text()) if options.output.is_file() else {}
    flights = {
        name: each if "commit" in each else each | {"commit": result["commit"]}
        for name, each in result.get("flights", {}).items()
    }
    flights |= {
        name: mapped(options.data / name) | {"commit": commit()} for name in options.flights
    }
    result |= {
        "benchmark": "real_flights",
        "machine": machine(),
        "commit": commit(),
        "flights": flights,
    }
    if "brighton_beach" in options.flights:
        withheld = [withheld_rms_m(options.data / "brighton_beach", parity) for parity in (1, 0)]
        result["brighton_beach_withheld_rms_m"] = {
            "odd photos": withheld[0],
            "even photos": withheld[1],
        }
    options.output.parent.mkdir(exist_ok=True)
    options.output.write_text(json.dumps(result, indent=1) + "\n")
    print(json.dumps(result, indent=1))


def mapped(folder: Path) -> dict[str, object]:
    """Frames by how they ended, seconds and the report's figures of one flight."""
    with tempfile.TemporaryDirectory() as site:
        started_s, started_cpu_s = time.monotonic(), time.process_time()
        list(map_flights([folder], Path(site) / "site", MapSettings(model="none")))
        wall_s, cpu_s = time.monotonic() - started_s, time.process_time() - started_cpu_s
        report = json.loads(next(Path(site).glob("site/flights/*/report.json")).read_text())
    frames = {key: report["frames"][key] for key in ("selected", "vision", "gps-only", "rejected")}
    return {
        **frames,
        "wall_s": round(wall_s, 1),
        "cpu_s": round(cpu_s, 1),
        "peak_memory_mb": round(report["peak_memory_mb"]),
        "pieces": len(report["pieces"]),
        "gps_residual_median_m": report["gps_residual_m"]["median"],
        "gps_residual_rms_m": report["gps_residual_m"]["rms"],
        "height_above_ground_m": report["height_above_ground_m"],
        "quality": report["headline"]["quality"],
        "residual_median_px": report["residual_px"]["median"],
    }


def withheld_rms_m(folder: Path, parity: int) -> float:
    """Rms distance of cameras from their fixes, for the photos whose fixes were taken out before mapping."""
    with tempfile.TemporaryDirectory() as scratch:
        photos = Path(scratch) / "photos"
        photos.mkdir()
        taken_out = {}
        for number, path in enumerate(sorted(folder.glob("*.JPG"))):
            if number % 2 != parity:
                (photos / path.name).write_bytes(path.read_bytes())
                continue
            metadata = read_photo_metadata(path)
            taken_out[path.name] = (
                metadata.columns["latitude_deg"],
                metadata.columns["longitude_deg"],
            )
            with Image.open(path) as picture:
                exif = picture.getexif()
                del exif[_GPS_IFD]
                picture.save(
                    photos / path.name,
                    "JPEG",
                    exif=exif,
                    xmp=picture.info.get("xmp", b""),
                    quality=95,
                )
        list(map_flights([photos], Path(scratch) / "site", MapSettings(model="none")))
        found = json.loads(next(Path(scratch).glob("site/flights/*/frames.geojson")).read_text())
    frame = LocalFrame(Geodetic(*next(iter(taken_out.values()))))
    misses = []
    for feature in found["features"]:
        placed = feature["properties"]
        if placed["frame"] in taken_out:
            latitude, longitude = taken_out[placed["frame"]]
            places = frame.site_from_wgs84(
                np.array([latitude, placed["camera_latitude_deg"]]),
                np.array([longitude, placed["camera_longitude_deg"]]),
                np.zeros(2),
            )
            misses.append(float(np.linalg.norm((places[1] - places[0])[:2])))
    assert len(misses) == len(taken_out)
    return float(np.sqrt(np.mean(np.square(misses))))


if __name__ == "__main__":
    main()
