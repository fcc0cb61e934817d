"""How long a web tile of a large map takes a station, at each zoom, asked for the first time.

    python benchmarks/tile_latency.py [--side 32768] [--compress deflate|jpeg] [--tiles 60]

The map is a square of noise, `--side` pixels wide (32,768: 1.07 gigapixels), made of 256 different tiles. Its GeoTIFF
is what `sorvolo map` writes. At each zoom tiles are chosen at random and asked for once each, one after the other,
with what neighbours left in the caches: as a page does that is looked at for the first time. The site's rows are read
before (the first tile is asked for apart). Milliseconds by the clock and of processor time, without the network.
"""

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from starlette.testclient import TestClient

import provenance
from sorvolo.geometry.arrays import ImageRGBA
from sorvolo.geometry.geodesy import Geodetic
from sorvolo.station.app import station_app
from sorvolo.station.settings import StationSettings
from sorvolo.store.site.archive import Archive
from sorvolo.survey.flight import Site

RESULTS = Path(__file__).parent / "results" / "tile_latency.json"
_LATITUDE, _LONGITUDE, _M_PER_PX = 46.0, 13.0, 0.03
_KINDS = 16  # of tiles, along each side


def noise(side_px: int) -> ImageRGBA:
    """Ground-like noise: octaves that weigh less the finer they are. Opaque, (side_px, side_px, 4)."""
    chance = np.random.default_rng(4)
    total = np.zeros((side_px, side_px, 3), np.float32)
    cells = 4
    while cells <= side_px:
        octave = chance.normal(0, 60 * cells**-0.4, (cells, cells, 3)).astype(np.float32)
        total += cv2.resize(octave, (side_px, side_px), interpolation=cv2.INTER_LINEAR)
        cells *= 2
    rgb = np.clip(110 + total, 0, 255).astype(np.uint8)
    return np.dstack([rgb, np.full((side_px, side_px), 255, np.uint8)])


def make_site(folder: Path, side_px: int, compress: str) -> dict[str, Any]:
    """A site with one version of so large a map."""
    started_s = time.process_time()
    with Archive.open(folder, write=True) as archive:
        archive.create_site(Site("large", Geodetic(_LATITUDE, _LONGITUDE), "EPSG:32633", _M_PER_PX))
        tile_px = archive.site_grid().grid.tile_px
        ground = noise(_KINDS * tile_px)
        half = side_px // tile_px // 2
        with archive.begin_flight("noise", "noise", {"compress": compress}) as writer:
            for column in range(-half, half):
                for row in range(-half, half):
                    x, y = (column % _KINDS) * tile_px, (row % _KINDS) * tile_px
                    writer.tiles[column, row] = np.ascontiguousarray(
                        ground[y : y + tile_px, x : x + tile_px]
                    )
            writer.commit([], {}, {}, "")
    return {
        "pixels": (2 * half * tile_px) ** 2,
        "tile_px": tile_px,
        "geotiff_megabytes": round((folder / "mosaic.tif").stat().st_size / 1e6, 1),
        "made_cpu_s": round(time.process_time() - started_s, 1),
    }


def asked(client: TestClient, side_m: float, count: int) -> list[dict[str, Any]]:
    """For each zoom what a tile took."""
    corner_deg = side_m / 2 / 111_320.0
    finest = int(np.round(np.log2(40_075_016.7 * np.cos(np.radians(_LATITUDE)) / 256 / _M_PER_PX)))
    client.get(
        f"/api/sites/large/tiles/1/{finest}/{column_of(_LONGITUDE, finest)}/{row_of(_LATITUDE, finest)}.webp"
    )
    chance, rows = np.random.default_rng(7), []
    for zoom in range(finest, finest - 8, -1):
        low_x, high_x = (column_of(_LONGITUDE + sign * 1.3 * corner_deg, zoom) for sign in (-1, 1))
        low_y, high_y = (row_of(_LATITUDE + sign * 0.9 * corner_deg, zoom) for sign in (1, -1))
        every = [(x, y) for x in range(low_x, high_x + 1) for y in range(low_y, high_y + 1)]
        chosen = [every[each] for each in chance.permutation(len(every))[:count]]
        wall_ms, cpu_ms, found = [], [], 0
        for x, y in chosen:
            begun_s, begun_cpu_s = time.perf_counter(), time.process_time()
            answer = client.get(f"/api/sites/large/tiles/1/{zoom}/{x}/{y}.webp")
            wall_ms.append(1000 * (time.perf_counter() - begun_s))
            cpu_ms.append(1000 * (time.process_time() - begun_cpu_s))
            found += answer.status_code == 200 and len(answer.content) > 0
        rows.append(
            {
                "zoom": zoom,
                "tiles": len(chosen),
                "found": found,
                **{
                    f"{name}_{part}": round(float(np.percentile(values, share)), 1)
                    for name, values in (("wall_ms", wall_ms), ("cpu_ms", cpu_ms))
                    for part, share in (("median", 50), ("p95", 95))
                },
            }
        )
        print(rows[-1], file=sys.stderr, flush=True)
    return rows


def column_of(longitude: float, zoom: int) -> int:
    """The column of the web tile at a longitude."""
    return int((longitude + 180.0) / 360.0 * 2**zoom)


def row_of(latitude: float, zoom: int) -> int:
    """The row of the web tile at a latitude."""
    return int((1 - np.arcsinh(np.tan(np.radians(latitude))) / np.pi) / 2 * 2**zoom)


def main() -> int:
    """Make the map, ask for tiles, print and write the figures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--side", type=int, default=32_768)
    parser.add_argument("--compress", default="deflate", choices=("deflate", "jpeg"))
    parser.add_argument("--tiles", type=int, default=60)
    parser.add_argument("--root", type=Path, help="where the map is kept, or was made before")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        root = options.root or Path(scratch)
        made = (
            {}
            if (root / "large").is_dir()
            else make_site(root / "large", options.side, options.compress)
        )
        app = station_app(StationSettings(root))
        with TestClient(app, base_url="http://127.0.0.1:8750", client=("127.0.0.1", 1)) as client:
            zooms = asked(client, options.side * _M_PER_PX, options.tiles)
    figures = {"side_px": options.side, "compress": options.compress, **made, "zooms": zooms}
    known = json.loads(RESULTS.read_text()) if RESULTS.is_file() else {"runs": {}}
    known["runs"][options.compress] = {
        "machine": provenance.machine(),
        "commit": provenance.commit(),
        **figures,
    }
    RESULTS.write_text(json.dumps(known, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
