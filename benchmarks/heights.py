"""Heights and true orthophotos: how right they are on simulated sites with houses, and what a real flight costs.

python benchmarks/heights.py [--seeds 301] [--flight DATA/flights/brighton_beach]
python benchmarks/heights.py --relief 8 --output benchmarks/results/heights_relief.json

Simulated: three strips of photos over a site with houses and trees, GPS noise 0.3 m; mapped, then heights. What all GPS
fixes err in common is taken out: in height by the median, on the ground by the median shift of patches of bare ground
against the simulator's own picture from above (phase correlation). Then: error of bare ground and of roofs (away from
edges), also with the tilt out that GPS fixes leave, and of the ground that two photos see past what stands on it, also
up to the edges; the share of cells within 2 sigma; and how far roofs lie from their place in the flat map and in the
true orthophoto. In pixels of the map. With --relief the site lies on hills so many
metres high.
Real: seconds of the processor and memory of `sorvolo map` and `sorvolo heights`, each a process of its own.
Written to results/heights.json.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rasterio

from provenance import commit, machine, note_scoring, seeds_or_drawn
from sorvolo.heights.field import HeightField
from sorvolo.lab.simulation.flight import SimulatedFlight, simulate_flights
from sorvolo.lab.simulation.settings import (
    ImagingSettings,
    OutputSettings,
    PathSettings,
    SceneSettings,
    SensorSettings,
    SimulationSettings,
)
from sorvolo.lab.simulation.site import simulate_site
from sorvolo.lab.simulation.world import Relief, orthophoto
from sorvolo.missions.flight.settings import MapSettings
from sorvolo.missions.heights.measure import read_field
from sorvolo.missions.heights.run import make_heights
from sorvolo.missions.map.flights import map_flights
from sorvolo.search.drawing.objects import ThingLabel
from sorvolo.search.drawing.view import map_view
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.files import HeightFile

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "lab" / "simulation"))
from true_heights import ground_heights, surface_heights

RESULTS = Path(__file__).parent / "results" / "heights.json"
_M_PER_PX = 0.05  # of the truth
_CLEAR_M, _STEP_M = (
    0.1,
    0.1,
)  # above a place from where on, and in which steps, its line to a camera is followed
_LEAST_PHOTOS = 2  # that see a place: one gives no height
_SURVEY = SimulationSettings(
    flights=1,
    scene=SceneSettings(ground="urban", people=0, cars=3, small_objects=3),
    path=PathSettings(height_m=30, speed_m_s=5, length_m=40, strips=3, strip_spacing_m=10),
    imaging=ImagingSettings(width_px=800, height_px=600, fps=6),
    sensor=SensorSettings(noise_m=(0.3, 0.3, 0.3)),
    output=OutputSettings(photos=True, photo_overlap=0.75),
)


def main() -> None:
    """Measure and write the figures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--seeds", type=int, nargs="*", default=[], help="without: two that nobody has scored"
    )
    parser.add_argument("--relief", type=float, default=0.0, help="of hills under the sites, m")
    parser.add_argument("--flight", type=Path, nargs="*", default=[])
    parser.add_argument("--output", type=Path, default=RESULTS)
    options = parser.parse_args()
    result: dict[str, Any] = {"benchmark": "heights", "machine": machine(), "commit": commit()}
    seeds = seeds_or_drawn("heights", options.seeds, 2)
    if not options.seeds:
        result |= note_scoring(f"heights, seeds {seeds}")
    result["relief_m"] = options.relief
    result["simulated"] = {str(seed): simulated(seed, options.relief) for seed in seeds}
    result["real"] = {folder.name: real(folder) for folder in options.flight}
    options.output.parent.mkdir(exist_ok=True)
    options.output.write_text(json.dumps(result, indent=1) + "\n")
    print(json.dumps(result, indent=1))


def simulated(seed: int, relief_m: float = 0.0) -> dict[str, Any]:
    """One simulated site: errors of heights, and of roofs in both pictures."""
    settings = replace(_SURVEY, seed=seed, scene=replace(_SURVEY.scene, relief_m=relief_m))
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        for _ in simulate_site(folder / "made", settings):
            pass
        photos, site = folder / "made" / "flight1" / "photos", folder / "site"
        list(map_flights([photos], site, MapSettings(model="none", heights=False)))
        list(make_heights(site))
        flown = next(iter(simulate_flights(settings)))
        day = flown.day
        with Archive.open(folder / "site", write=False) as archive:
            flight = archive.flights()[0].id
            field = read_field(archive, flight, HeightFile.SURFACE)
            m_per_px = archive.site().m_per_px
            shift_m = _site_shift(archive, settings)
        report = json.loads((folder / "site" / "flights" / flight / "heights.json").read_text())
        ground = orthophoto(day)
        size = tuple(int(side / _M_PER_PX) for side in ground.area.size_m)
        view = map_view(ground.area.west_m, ground.area.north_m, (_M_PER_PX, _M_PER_PX), size)
        top = surface_heights(day.things, day.bodies, view, day.relief)
        true = top - ground_heights(view, day.relief)
        houses = [thing for thing in day.things if thing.label is ThingLabel.HOUSE]
        paths = {
            "flat": folder / "site" / "mosaic.tif",
            "true": folder / "site" / "flights" / flight / "orthophoto.tif",
        }
        pictures = _Pictures(paths, folder / "site", ground, m_per_px)
        bare = _bare_patches(field, true, view, shift_m)
        bare_px = {name: pictures.bare_px(name, bare, shift_m) for name in paths}
        common_px = {name: np.median(each, axis=0) for name, each in bare_px.items()}
        # phaseCorrelate's shift takes the map's picture to the true one
        moved_m = shift_m + common_px["true"] * m_per_px * [1, -1]
        return {
            "photos": report["cameras"]["views"],
            "m_per_px": m_per_px,
            "cell_m": report["cell_m"],
            "common_px": {name: each.tolist() for name, each in common_px.items()},
            **_height_errors(
                field, true, view, moved_m, m_per_px, day.relief, _PhotosOver(flown, top, view)
            ),
            "roofs": _roofs(pictures, houses, shift_m, bare, bare_px, field),
            "holes_share": report["surface"]["holes_share"],
            "seconds": report["seconds"],
        }


def _site_shift(archive: Archive, settings: SimulationSettings) -> np.ndarray:
    """(2,) what is added to the map's site metres to get the simulator's, whose origin is another."""
    origin = settings.scene.origin
    frame = archive.site().frame
    place = frame.site_from_wgs84(
        np.array([origin.latitude_deg]), np.array([origin.longitude_deg]), np.zeros(1)
    )
    return -place[0, :2]


@dataclass(frozen=True, eq=False)
class _PhotosOver:
    """The photos of a simulated flight over its true surface `top`, (H, W) heights in m, seen in a map view."""

    flown: SimulatedFlight
    top: Any
    view: Any

    def that_see(self, ground_m: Any) -> Any:
        """(N,) how many photos see each of these places on the ground, (N, 3) m: nothing stands between."""
        counts = np.zeros(len(ground_m), int)
        for index in range(len(self.flown)):
            width_px, height_px = self.flown.camera.width_px, self.flown.camera.height_px
            pixels = self.flown.view(index).project(ground_m)
            seen = np.flatnonzero(
                np.all((pixels > -0.5) & (pixels < [width_px - 0.5, height_px - 0.5]), axis=1)
            )
            clear = ~self._is_hidden(ground_m[seen], self.flown.true_poses[index].translation_m)
            counts[seen[clear]] += 1
        return counts

    def _is_hidden(self, ground_m: Any, eye_m: Any) -> Any:
        hidden = np.zeros(len(ground_m), bool)
        highest_m = float(self.top.max())
        for up_m in np.arange(_CLEAR_M, highest_m, _STEP_M):
            share = (up_m - ground_m[:, 2]) / (eye_m[2] - ground_m[:, 2])
            at = ground_m[:, :2] + share[:, None] * (eye_m[:2] - ground_m[:, :2])
            above = up_m > ground_m[:, 2] + _CLEAR_M
            hidden |= above & (np.nan_to_num(_true_at(self.top, self.view, at), nan=-np.inf) > up_m)
        return hidden


def _height_errors(
    field: HeightField,
    true: Any,
    view: Any,
    shift_m: Any,
    m_per_px: float,
    relief: Relief,
    photos: _PhotosOver,
) -> dict[str, float]:
    points = field.lattice.points_m().reshape(-1, 2)
    at = _true_at(true, view, points + shift_m).reshape(field.up_m.shape)
    bare = np.isfinite(field.up_m) & (at == 0)
    off = field.up_m - at - relief.up_m(points + shift_m).reshape(at.shape)
    off -= np.median(off[bare])
    level = _without_tilt(points.reshape(*bare.shape, 2), off, bare)
    known = np.isfinite(off)
    around = np.ones((9, 9), np.uint8)
    edges = cv2.dilate(np.nan_to_num(at), around) - cv2.erode(np.nan_to_num(at), around) > 0.3
    grounds, roofs = known & (at == 0) & ~edges, known & (at > 3) & ~edges
    inside = np.abs(off) < 2 * field.sigma_m
    seen_by = np.zeros(off.shape, int)
    all_ground = known & (at == 0)
    places_m = points[all_ground.ravel()] + shift_m
    seen_by[all_ground] = photos.that_see(np.column_stack([places_m, relief.up_m(places_m)]))
    visible = grounds & (seen_by >= _LEAST_PHOTOS)
    with_edges = all_ground & (seen_by >= _LEAST_PHOTOS)
    return {
        "visible_ground_rms_px": _rms(off[visible]) / m_per_px,
        "visible_ground_rms_px_tilt_out": _rms(level[visible]) / m_per_px,
        "visible_ground_with_edges_rms_px_tilt_out": _rms(level[with_edges]) / m_per_px,
        "visible_ground_with_edges_worse_than_half_a_metre": float(
            (np.abs(off[with_edges]) > 0.5).mean()
        ),
        "visible_ground_worse_than_half_a_metre": float((np.abs(off[visible]) > 0.5).mean()),
        "ground_not_visible_but_with_heights": 1 - float(visible.sum() / grounds.sum()),
        "ground_rms_px": _rms(off[grounds]) / m_per_px,
        "ground_median_px": _median(off[grounds]) / m_per_px,
        "ground_worse_than_half_a_metre": float((np.abs(off[grounds]) > 0.5).mean()),
        "ground_rms_px_tilt_out": _rms(level[grounds]) / m_per_px,
        "ground_median_px_tilt_out": _median(level[grounds]) / m_per_px,
        "roof_rms_px": _rms(off[roofs]) / m_per_px,
        "roof_median_px": _median(off[roofs]) / m_per_px,
        "ground_within_2_sigma": float(inside[grounds].mean()),
        "all_within_2_sigma": float(inside[known].mean()),
    }


def _without_tilt(points: Any, off: Any, bare: Any) -> Any:
    """Errors less the plane through those of bare ground (GPS errs in it), outliers beyond half a metre left out."""
    terms = np.dstack([points, np.ones(off.shape)])
    some = bare.copy()
    for limit_m in (1.0, 0.5, 0.5):
        some &= np.abs(off) < 1.0
        plane = np.linalg.lstsq(terms[some], off[some], rcond=None)[0]
        some = bare & (np.abs(off - terms @ plane) < limit_m)
    return off - terms @ plane


def _true_at(true: Any, view: Any, points: Any) -> Any:
    pixels = view.project(np.column_stack([points, np.zeros(len(points))])).astype(np.float32)
    side = 1000
    padded = np.full((-(-len(pixels) // side) * side, 2), -1e6, np.float32)
    padded[: len(pixels)] = pixels
    grid = padded.reshape(-1, side, 2)
    found = cv2.remap(true, grid[..., 0], grid[..., 1], cv2.INTER_NEAREST, borderValue=float("nan"))
    return found.ravel()[: len(pixels)]


@dataclass(frozen=True, eq=False)
class _Pictures:
    """Two pictures of one site and the true one from above; `shift_m` takes map metres to the simulator's."""

    paths: dict[str, Path]
    site: Path
    ground: Any
    m_per_px: float

    def shift_px(self, name: str, middle: Any, half_m: float, shift_m: Any) -> Any:
        """(2,) how far a square of the true picture lies from its place in one of them, pixels."""
        return _shift_px(
            self.paths[name], self.site, self.ground, middle, half_m, shift_m, self.m_per_px
        )

    def bare_px(self, name: str, bare: Any, shift_m: Any) -> Any:
        """(N, 2) the shifts of patches of bare ground, (N, 2) middles."""
        return np.array([self.shift_px(name, each, 2.5, shift_m) for each in bare])


def _bare_patches(field: HeightField, true: Any, view: Any, shift_m: Any) -> Any:
    """(25, 2) middles, map metres, of squares of 6 m with nothing on them, in the inner half of the model."""
    rng = np.random.default_rng(0)
    size_m = np.array([field.lattice.width, field.lattice.height]) * field.lattice.cell_m
    middle = field.lattice.points_m()[field.lattice.height // 2, field.lattice.width // 2]
    found = []
    for _ in range(2000):
        place = middle + rng.uniform(-0.25, 0.25, 2) * size_m
        steps = np.linspace(-3, 3, 13)
        around = np.column_stack([each.ravel() for each in np.meshgrid(steps, steps)])
        if (_true_at(true, view, place + around + shift_m) == 0).all():
            found.append(place)
        if len(found) == 25:
            break
    return np.array(found)


def _roofs(
    pictures: _Pictures,
    houses: Any,
    shift_m: Any,
    bare: Any,
    bare_px: dict[str, Any],
    field: HeightField,
) -> list[dict[str, float]]:
    """For each house seen: how far its roof lies off the bare ground nearest to it in both pictures, map pixels."""
    found = []
    for house in houses:
        middle = np.array([house.east_m, house.north_m]) - shift_m
        if not np.isfinite(field.at(middle[None])[0]).all():
            continue
        row = {"height_m": round(float(house.size_m[2]), 2)}
        nearest = np.argsort(np.linalg.norm(bare - middle, axis=1))[:5]
        for name, shifts in bare_px.items():
            common = np.median(shifts[nearest], axis=0)
            off = pictures.shift_px(name, middle, 0.45 * min(house.size_m[:2]), shift_m) - common
            row[f"{name}_px"] = round(float(np.hypot(*off)), 2)
        found.append(row)
    return found


def _shift_px(
    path: Path, site: Path, ground: Any, middle: Any, half_m: float, shift_m: Any, m_per_px: float
) -> Any:
    with Archive.open(site, write=False) as archive, rasterio.open(path) as source:
        count = int(2 * half_m / m_per_px)
        steps = (np.arange(count) - (count - 1) / 2) * m_per_px
        x, y = np.meshgrid(middle[0] + steps, middle[1] - steps)
        places = np.column_stack([x.ravel(), y.ravel()])
        crs_m = archive.site_grid().projected_from_site(places)
        columns, rows = ~source.transform * (crs_m[:, 0], crs_m[:, 1])
        picture = np.moveaxis(source.read([1, 2, 3]), 0, 2)
        across, down = (
            (each - 0.5).reshape(x.shape).astype(np.float32) for each in (columns, rows)
        )
        mine = cv2.remap(picture, across, down, cv2.INTER_LINEAR)
    matrix = ground.raster_from_site_matrix
    at = np.column_stack([places + shift_m, np.ones(len(places))]) @ matrix.T
    true = cv2.remap(
        ground.rgb,
        (at[:, 0] / at[:, 2]).reshape(x.shape).astype(np.float32),
        (at[:, 1] / at[:, 2]).reshape(x.shape).astype(np.float32),
        cv2.INTER_LINEAR,
    )
    grays = [cv2.cvtColor(each, cv2.COLOR_RGB2GRAY).astype(np.float32) for each in (mine, true)]
    shift, _ = cv2.phaseCorrelate(*grays, cv2.createHanningWindow((count, count), cv2.CV_32F))
    return np.array(shift)


def real(folder: Path) -> dict[str, Any]:
    """What mapping a flight and its heights cost."""
    with tempfile.TemporaryDirectory() as scratch:
        site = Path(scratch) / "site"
        mapping = ["map", str(folder), "--model", "none", "--site"]
        flat = _measured([*mapping, str(site), "--flat"])
        heights = _measured(["heights", str(site)])
        whole = _measured([*mapping, str(site.with_name("whole"))])
        report = json.loads(next(site.glob("flights/*/heights.json")).read_text())
        frames = json.loads(next(site.glob("flights/*/frames.geojson")).read_text())["features"]
        return {
            "photos": len(frames),
            **{"flat": flat, "heights": heights, "whole": whole},
            "residual_rms_px": report["cameras"]["residual_rms_px"],
            "surface": report["surface"],
        }


def _measured(arguments: list[str]) -> dict[str, float]:
    script = (
        "import sys, resource, json; from sorvolo.cli.main import main; code = main(sys.argv[1:]); "
        "used = resource.getrusage(resource.RUSAGE_SELF); "
        "print(json.dumps([code, used.ru_utime + used.ru_stime, used.ru_maxrss / 1024]))"
    )
    done = subprocess.run(
        [sys.executable, "-c", script, *arguments], capture_output=True, text=True, check=True
    )
    code, cpu_s, memory_mb = json.loads(done.stdout.splitlines()[-1])
    return {"exit_code": code, "cpu_s": round(cpu_s, 1), "peak_memory_mb": round(memory_mb)}


def _rms(values: Any) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else float("nan")


def _median(values: Any) -> float:
    return float(np.median(np.abs(values))) if len(values) else float("nan")


if __name__ == "__main__":
    main()
