"""Two real dates of one building site: which views of the later date are placed right, which changes are found.

python benchmarks/real_dates.py DATA [--pairs 2024-03-01/2024-03-12 ...] [--attitude none known] [--taken video]
  [--model default] --keep FOLDER

DATA holds building_site/: five orthophotos of one site, 0.146 m a pixel. A camera is simulated over the earlier one and
its photos are mapped (telemetry with attitude); another is simulated over the later one (about 45 photos of 960x540
from 117 m, or a video of a shorter way, 5 frames/s; tilt of 2 degrees rms, GPS good to 1 m rms, with attitude or
without) and compared with that map. What
changed is real; the pictures hold no relief, for orthophotos are flat. Photos state the date, and the hour at which
the sun stands at the simulated place where the orthophoto's shadows have it (by the edges of an office's shadow, to
about 5 degrees; 2024-03-12 was overcast, its hour is a guess). Earlier runs stated other times, by which
the sun moved 2 degrees from date to date.

**Views.** Where each later photo is on the earlier orthophoto is known: from the simulated camera to the later
orthophoto, from there by the pair's transform in real_dates.json. That was estimated once: 300 to 6,500 learned
features matched over both whole orthophotos, a similarity, and on it the mean displacement around each of 9 x 9 places
(weights of 150 px, outliers weighed down), looked at in red and cyan. The features scatter 3 px (0.45 m) around it: the
orthophotos differ locally. A view is right when it is placed and its corners lie within 2 m (the median of the four) of
where they are, what the map of the earlier date is off by as a whole taken out. Pairs without a transform of their own
(four to six months apart) are judged by those from date to date, one after the other.

**Changes** (2024-02-24/2024-03-01, and three other pairs under `others`): polygons in
pixels of the earlier orthophoto, drawn by hand with the later one laid over the earlier beside it, 1.6 to 2 times as
large, before anything was scored. On the second pair they are boxes mostly, and not all that changed was drawn. On the
third all soil was driven over and most sunlight comes from another side: tracks, shadows and leaves were not drawn;
what a later photo shows less than half of was left out. The fourth pair, 2023-10-14/2024-02-24, is held out (for
changes; its views were looked at during development): 582
changes, drawn by someone who saw the pictures alone and no report; a building rose in these four
months, and small goods were drawn one by one, so that most of the ground is changed and shares are lower. A thing is
found when an event overlaps it by at least a quarter of the smaller of the two areas and is at most ten times as
large. An area (over 100 m2) is found when one event covers at least 40 % of it; the share that all events together
cover is given as well. An event is false when at least half of it lies on ground drawn as unchanged. Events that touch
neither are counted as elsewhere: not all that changed is drawn.

Each run is appended to results/real_dates.json.
"""

import argparse
import itertools
import json
import shutil
import time
from collections import Counter, deque
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from provenance import commit, machine, note_scoring
from sorvolo.geometry.geodesy import LocalFrame
from sorvolo.geometry.ground import footprint
from sorvolo.geometry.homography import apply_homography, fit_similarity
from sorvolo.lab.evaluation.frame_rows import map_frames
from sorvolo.lab.simulation.flight import SimulatedFlight, simulate_flight
from sorvolo.lab.simulation.flight_files import (
    video_writer,
    write_camera,
    write_photo,
    write_telemetry,
)
from sorvolo.lab.simulation.ground import orthophoto_ground
from sorvolo.lab.simulation.settings import (
    ImagingSettings,
    MotionSettings,
    OutputSettings,
    PathSettings,
    SceneSettings,
    SensorSettings,
    SimulationSettings,
)
from sorvolo.missions.compare.flights import compare_flights
from sorvolo.missions.flight.settings import CompareSettings, MapSettings
from sorvolo.missions.map.flights import map_flights
from sorvolo.store.site.archive import Archive
from sorvolo.survey.mosaic import FrameRow

HERE = Path(__file__).parent
RESULTS = HERE / "results" / "real_dates.json"
HELD_OUT = ("2023-10-14/2024-02-24",)
DEVELOPMENT = (
    "2024-02-24/2024-03-01",
    "2024-03-01/2024-03-12",
    "2023-09-26/2023-10-14",
    "2024-02-24/2024-03-12",
)
DATES = ("2023-09-26", "2023-10-14", "2024-02-24", "2024-03-01", "2024-03-12")
PAIRS = tuple(f"{earlier}/{later}" for earlier, later in itertools.combinations(DATES, 2))
M_PER_PX = 0.146
HEIGHT_M = 116.6  # 960 px of 62 degrees then see 0.146 m each
RIGHT_M = 2.0
_APRON_PX = 700  # grey around the orthophoto: photos that show any of it are left out
_EDGE_M = 4.0  # nor do photos show the orthophoto's rim
TAKEN = {
    "2023-09-26": "2023-09-26T14:08",
    "2023-10-14": "2023-10-14T10:09",
    "2024-02-24": "2024-02-24T11:36",
    "2024-03-01": "2024-03-01T11:43",
    "2024-03-12": "2024-03-12T11:43",
}
_LEAST_OVERLAP, _MOST_TIMES, _LEAST_COVERED, _FALSE_SHARE = 0.25, 10.0, 0.4, 0.5
_CELL_M = 0.25  # overlaps are counted in cells of this side


@dataclass(frozen=True)
class Step:
    """How a pixel of a later orthophoto lies on an earlier one."""

    b_to_a: np.ndarray  # (2, 3)
    moved_px: np.ndarray  # (9, 9, 2) what is added, at 9 x 9 places over the later one

    def a_from_b(self, points_px: np.ndarray, size_px: tuple[int, int]) -> np.ndarray:
        """(N, 2) pixels of the earlier orthophoto of those of the later one, (N, 2)."""
        at = (points_px / (np.array(size_px) - 1) * 8).clip(0, 8).astype(np.float32)
        moved = cv2.remap(
            self.moved_px.astype(np.float32), at[:, None, 0], at[:, None, 1], cv2.INTER_LINEAR
        )[:, 0]
        return points_px @ self.b_to_a[:, :2].T + self.b_to_a[:, 2] + moved


@dataclass(frozen=True, eq=False)
class Pair:
    """Two dates, and how a pixel of the later orthophoto lies on the earlier one, by way of those between."""

    name: str
    steps: tuple[Step, ...]

    @classmethod
    def of(cls, name: str, stored: dict[str, Any]) -> "Pair":
        """That pair, by the transforms of real_dates.json: its own, or those from date to date."""
        earlier, later = name.split("/")
        dates = DATES[DATES.index(earlier) : DATES.index(later) + 1]
        names = (
            [name]
            if name in stored
            else [f"{one}/{other}" for one, other in itertools.pairwise(dates)]
        )
        return cls(
            name,
            tuple(
                Step(np.array(stored[each]["b_to_a"]), np.array(stored[each]["moved_px"]))
                for each in names
            ),
        )

    def a_from_b(self, points_px: np.ndarray, size_px: tuple[int, int]) -> np.ndarray:
        """(N, 2) pixels of the earlier orthophoto of those of the later one, (N, 2)."""
        for step in reversed(self.steps):
            points_px = step.a_from_b(points_px, size_px)
        return points_px


def main() -> None:
    """Score the pairs that were asked for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", type=Path)
    parser.add_argument("--pairs", nargs="+", choices=PAIRS, default=HELD_OUT)
    parser.add_argument(
        "--attitude",
        nargs="+",
        choices=("none", "known", "wrong"),
        default=("none", "known"),
        help="of the later flight; wrong: the compass is 90 degrees off",
    )
    parser.add_argument(
        "--taken", choices=("photos", "video"), default="photos", help="the later flight"
    )
    parser.add_argument(
        "--model", default="none", help="that looks for objects on both dates; none unless given"
    )
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--keep",
        type=Path,
        required=True,
        help="folder for photos and maps, used again when run again",
    )
    parser.add_argument("--output", type=Path, default=RESULTS)
    options = parser.parse_args()
    truth = json.loads((HERE / "real_dates.json").read_text())
    for name in options.pairs:
        pair = Pair.of(name, truth["pairs"])
        for attitude in options.attitude:
            run = {
                "pair": name,
                "attitude": attitude,
                "taken": options.taken,
                "seed": options.seed,
                "model": options.model,
                **note_scoring(f"real_dates, {name}"),
                **score(pair, attitude, truth, options),
            }
            append(options.output, run)
            print(
                json.dumps(
                    {key: value for key, value in run.items() if not isinstance(value, list)},
                    indent=1,
                )
            )


def append(output: Path, run: dict[str, Any]) -> None:
    """Add a run to the results, with its date, commit and machine."""
    record = (
        json.loads(output.read_text())
        if output.is_file()
        else {"benchmark": "real_dates", "runs": []}
    )
    record = {**record, "held_out": HELD_OUT, "development": DEVELOPMENT, "right_m": RIGHT_M}
    stamp = {
        "date": f"{datetime.now(UTC):%Y-%m-%d %H:%M}",
        "commit": commit(),
        "machine": machine(),
    }
    record["runs"].append(stamp | run)
    output.write_text(json.dumps(record, indent=1) + "\n")


def score(
    pair: Pair, attitude: str, truth: dict[str, Any], options: argparse.Namespace
) -> dict[str, Any]:
    """Map the earlier date, compare the later one, and measure both."""
    earlier, later = pair.name.split("/")
    folder = options.keep / pair.name.replace("/", "_")
    first, size_px = fly(options.data, earlier, 2 * options.seed)
    second, _ = fly(options.data, later, 2 * options.seed + 1, options.taken)
    mapped = options.keep / f"photos_{earlier}_{2 * options.seed}_known"
    flown = options.keep / f"{options.taken}_{later}_{2 * options.seed + 1}_{attitude}"
    shown = write_photos(first, mapped, size_px, "known", begins_ns(earlier))
    if options.taken == "photos":
        seen = write_photos(second, flown, size_px, attitude, begins_ns(later))
    else:
        flown, seen = write_video(second, flown, size_px, attitude, begins_ns(later))
    base = options.keep / f"map_{earlier}_{2 * options.seed}_{options.model}"
    if not (base / "mosaic.tif").is_file():
        shutil.rmtree(base, ignore_errors=True)
        deque(
            map_flights(
                [mapped], base, MapSettings(model=options.model), camera=options.keep / "camera.xml"
            ),
            0,
        )
    site = folder / f"{attitude}_{options.model}_{options.taken}"
    shutil.rmtree(site, ignore_errors=True)
    shutil.copytree(base, site)
    started, cpu = time.monotonic(), time.process_time()
    settings = CompareSettings(model=options.model)
    updates = list(compare_flights([flown], site, settings, camera=options.keep / "camera.xml"))
    took = {
        "wall_s": round(time.monotonic() - started, 1),
        "cpu_s": round(time.process_time() - cpu, 1),
    }
    with Archive.open(site, write=False) as archive:
        frame = archive.site().frame
        rows = map_frames(site, archive.site())
    name = updates[0].flight
    map_from_true = map_error(first, shown, rows[mapped.name], frame)
    views = placed_right(pair, second, seen, rows[name], frame, map_from_true, size_px)
    report = json.loads((site / "flights" / name / "report.json").read_text())["comparison"]
    result = {
        **took,
        **views,
        "statuses": dict(Counter(each.status.value for each in updates if not each.comes_again)),
        "reasons": report["reasons"],
        "compared_m2": report["compared_area_m2"],
        "residual_px": report["residual_px"],
        "with_flight": report["with_flight"],
    }
    drawn_by_hand = drawn_of(truth, pair.name)
    if drawn_by_hand is not None:
        events = site / "flights" / name / "changes.geojson"
        result |= found(events, frame, map_from_true, drawn_by_hand, size_px)
    return result


def drawn_of(truth: dict[str, Any], name: str) -> dict[str, Any] | None:
    """The changes and the unchanged ground drawn on a pair; None where nothing was drawn."""
    return truth if name == truth["changes_of"] else truth["others"].get(name)


def fly(
    data: Path, date: str, seed: int, taken: str = "photos"
) -> tuple[SimulatedFlight, tuple[int, int]]:
    """A flight over one date's orthophoto, and the orthophoto's size; its middle is the site's origin. `taken` as
    "video", it keeps its heading and its turns lie over the orthophoto."""
    picture = cv2.imread(str(data / "building_site" / f"{date}.jpg"), cv2.IMREAD_COLOR)
    if picture is None:
        raise SystemExit(f"{data}/building_site/{date}.jpg is missing")
    apron = cv2.copyMakeBorder(
        picture, *[_APRON_PX] * 4, cv2.BORDER_CONSTANT, value=(128, 128, 128)
    )
    path, output = (228.0, 3, 72.0, 0.0), OutputSettings(photos=True, photo_overlap=0.82)
    if taken == "video":
        path, output = (180.0, 3, 66.0, 0.0, False), OutputSettings(telemetry="srt")
    settings = SimulationSettings(
        seed=seed,
        flights=1,
        scene=SceneSettings("orthophoto", 0, 0, 0, has_scenery=False),
        path=PathSettings(HEIGHT_M, 8.0, *path),
        motion=MotionSettings(tilt_rms_deg=2.0, height_rms_m=1.0, drift_rms_m=1.0),
        imaging=ImagingSettings(fps=5),
        sensor=SensorSettings(noise_m=(1.0, 1.0, 1.0)),
        output=output,
    )
    rgb = cv2.cvtColor(apron, cv2.COLOR_BGR2RGB)
    return simulate_flight(settings, orthophoto_ground(rgb, M_PER_PX)), (
        picture.shape[1],
        picture.shape[0],
    )


def begins_ns(date: str) -> int:
    """When the first photo of a date is taken."""
    return int(datetime.fromisoformat(TAKEN[date] + "+00:00").timestamp()) * 10**9


def write_photos(
    flight: SimulatedFlight, folder: Path, size_px: tuple[int, int], attitude: str, began_ns: int
) -> dict[str, int]:
    """Write the photos that show the orthophoto alone; their names and indices."""
    limit_m = np.array(size_px) * M_PER_PX / 2 - _EDGE_M
    chosen = {
        flight.frame_name(index): index
        for index in range(len(flight))
        if (np.abs(footprint(flight.camera, flight.true_poses[index])) < limit_m).all()
    }
    if folder.is_dir():
        return chosen
    partial = folder.with_suffix(".partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    write_camera(folder.parent / "camera.xml", flight.camera)
    columns = flight.observations["photos"].telemetry.columns
    for name, index in chosen.items():
        frame = flight.frame(index)
        row = {key: float(values[index]) for key, values in columns.items()}
        if attitude == "wrong":
            row["camera_yaw_deg"] = (row["camera_yaw_deg"] + 90) % 360
        time_ns = frame.time_ns - flight.started_ns + began_ns
        write_photo(partial / name, replace(frame, time_ns=time_ns), flight.camera, row)
        if attitude == "none":  # the same photo with the attitude under a name that nobody reads
            written = (partial / name).read_bytes()
            (partial / name).write_bytes(written.replace(b"drone-dji:Gimbal", b"drone-dji:Absent"))
    partial.rename(folder)
    return chosen


def write_video(
    flight: SimulatedFlight, folder: Path, size_px: tuple[int, int], attitude: str, began_ns: int
) -> tuple[Path, dict[str, int]]:
    """Write the flight as a video with DJI's subtitles, of the older kind without attitude where none is known; the
    file, and its frames' names and indices."""
    limit_m = np.array(size_px) * M_PER_PX / 2
    outlines_m = [footprint(flight.camera, pose) for pose in flight.true_poses]
    assert all((np.abs(each) < limit_m).all() for each in outlines_m)
    video, later_ns = folder / f"{folder.name}.mp4", began_ns - flight.started_ns
    if not video.is_file():
        folder.mkdir(parents=True, exist_ok=True)
        write_camera(folder.parent / "camera.xml", flight.camera)
        telemetry = flight.telemetry("srt")
        columns = dict(telemetry.columns)
        if attitude == "wrong":
            columns["camera_yaw_deg"] = (columns["camera_yaw_deg"] + 90) % 360
        dialect = "srt-gps" if attitude == "none" else "srt"
        stated = replace(
            telemetry, format=dialect, time_ns=telemetry.time_ns + later_ns, columns=columns
        )
        write_telemetry(video.with_suffix(".srt"), stated)
        size, fps = (flight.camera.width_px, flight.camera.height_px), flight.settings.imaging.fps
        with video_writer(video, size, fps, began_ns, flight.settings.output.crf) as write:
            for index in range(len(flight)):
                write(flight.frame(index).image)
    return video, {str(index): index for index in range(len(flight))}


def metres(points_px: np.ndarray, size_px: tuple[int, int]) -> np.ndarray:
    """(N, 2) east, north of an orthophoto's pixels."""
    return (points_px + 0.5 - np.array(size_px) / 2) * M_PER_PX * [1, -1]


def pixels(points_m: np.ndarray, size_px: tuple[int, int]) -> np.ndarray:
    """(N, 2) an orthophoto's pixels of east, north."""
    return points_m / M_PER_PX * [1, -1] + np.array(size_px) / 2 - 0.5


def true_outline_m(flight: SimulatedFlight, index: int, frame: LocalFrame) -> np.ndarray:
    """(4, 2) a photo's corners on the ground, in the site's metres."""
    return moved_frame(footprint(flight.camera, flight.true_poses[index]), flight.site, frame)


def moved_frame(points_m: np.ndarray, theirs: LocalFrame, ours: LocalFrame) -> np.ndarray:
    """(N, 2) ground points of one local frame in another."""
    latitude, longitude, _ = theirs.wgs84_from_site(
        np.column_stack([points_m, np.zeros(len(points_m))])
    )
    return ours.ground_from_lonlat(np.column_stack([longitude, latitude]))


def map_error(
    flight: SimulatedFlight, shown: dict[str, int], rows: list[FrameRow], frame: LocalFrame
) -> np.ndarray:
    """The similarity, (3, 3), from true places to where the map has them."""
    pairs = [
        (row.outline_m, true_outline_m(flight, shown[row.name], frame))
        for row in rows
        if row.name in shown and np.isfinite(row.outline_m).all()
    ]
    return fit_similarity(
        np.concatenate([mine for mine, _ in pairs]), np.concatenate([true for _, true in pairs])
    )


def placed_right(
    pair: Pair,
    flight: SimulatedFlight,
    seen: dict[str, int],
    rows: list[FrameRow],
    frame: LocalFrame,
    map_from_true: np.ndarray,
    size_px: tuple[int, int],
) -> dict[str, Any]:
    """How many views were placed, and how many of them right."""
    errors_m, by_view = [], []
    for row in rows:
        if (
            row.status in ("rejected", "not-aligned", "outside", "lost")
            or not np.isfinite(row.outline_m).all()
        ):
            by_view.append([row.name, None])
            continue
        true_px = pixels(footprint(flight.camera, flight.true_poses[seen[row.name]]), size_px)
        on_a_m = metres(pair.a_from_b(true_px, size_px), size_px)
        expected_m = apply_homography(map_from_true, moved_frame(on_a_m, flight.site, frame))
        errors_m.append(float(np.median(np.linalg.norm(row.outline_m - expected_m, axis=1))))
        by_view.append([row.name, round(errors_m[-1], 2)])
    return {
        "views": len(by_view),
        "placed": len(errors_m),
        "right": sum(error < RIGHT_M for error in errors_m),
        "error_median_m": round(float(np.median(errors_m)), 2) if errors_m else None,
        "error_m": by_view,
    }


def found(
    events: Path,
    frame: LocalFrame,
    map_from_true: np.ndarray,
    truth: dict[str, Any],
    size_px: tuple[int, int],
) -> dict[str, Any]:
    """The events of a file against the polygons."""
    rings_m = {
        feature["properties"]["id"]: frame.ground_from_lonlat(
            np.array(feature["geometry"]["coordinates"][0])[:, :2]
        )
        for feature in json.loads(events.read_text())["features"]
    }
    return found_among(rings_m, frame, map_from_true, truth, size_px)


def found_among(
    rings_m: dict[str, np.ndarray],
    frame: LocalFrame,
    map_from_true: np.ndarray,
    truth: dict[str, Any],
    size_px: tuple[int, int],
) -> dict[str, Any]:
    """Events, the outlines (N, 2) in the site's metres by id, against the polygons."""
    reported = drawn_events(rings_m, frame, map_from_true, size_px)
    everywhere = np.any(
        [np.zeros(drawn_shape(size_px), bool), *(mask for _, mask in reported)], axis=0
    )
    cells = [np.nonzero(mask) for _, mask in reported]
    sizes = [len(rows) for rows, _ in cells]
    hits, covered, touching = {}, {}, set()
    for name, each in truth["changes"].items():
        mask = drawn(np.array(each["px"], float), size_px)
        overlaps = [int(np.count_nonzero(mask[other])) for other in cells]
        touching |= set(np.flatnonzero(overlaps).tolist())
        hits[name] = is_hit(each["kind"], int(mask.sum()), overlaps, sizes)
        if each["kind"] == "area":
            covered[name] = round(float((mask & everywhere).sum() / mask.sum()), 2)
    quiet = np.any(
        [drawn(np.array(ring, float), size_px) for ring in truth["unchanged"].values()], axis=0
    )
    false = [
        name for name, mask in reported if (mask & quiet).sum() >= _FALSE_SHARE * max(1, mask.sum())
    ]
    return {
        "found": sum(hits.values()),
        "drawn": len(hits),
        "by_kind": hits_by_kind(hits, truth),
        "false": len(false),
        "unchanged_m2": round(float(quiet.sum()) * _CELL_M**2),
        "events": len(reported),
        "elsewhere": len(reported) - len(touching) - len(false),
        "areas_covered": covered,
        "missed": [name for name, hit in hits.items() if not hit],
        "false_ids": false,
    }


def drawn_events(
    rings_m: dict[str, np.ndarray],
    frame: LocalFrame,
    map_from_true: np.ndarray,
    size_px: tuple[int, int],
) -> list[tuple[str, np.ndarray]]:
    """The cells of each event, by its id, on the ground of the drawn polygons."""
    true_from_map, found = np.linalg.inv(map_from_true), []
    for name, ring_m in rings_m.items():
        there_m = moved_frame(
            apply_homography(true_from_map, ring_m), frame, LocalFrame(simulation_origin())
        )
        found.append((name, drawn(pixels(there_m, size_px), size_px)))
    return found


def is_hit(kind: str, size: int, overlaps: list[int], sizes: list[int]) -> bool:
    """Whether one of the events, each with its overlap and size in cells, is a drawn change of `size` cells."""
    if kind == "area":
        return any(overlap >= _LEAST_COVERED * size for overlap in overlaps)
    return any(
        overlap >= _LEAST_OVERLAP * min(size, other) and overlap > 0 and other <= _MOST_TIMES * size
        for overlap, other in zip(overlaps, sizes)
    )


def hits_by_kind(hits: dict[str, bool], truth: dict[str, Any]) -> dict[str, str]:
    """How many of the drawn changes of each kind were found, such as `3 of 4`."""
    found = {}
    for kind in ("appeared", "disappeared", "replaced", "area"):
        names = [name for name, each in truth["changes"].items() if each["kind"] == kind]
        found[kind] = f"{sum(hits[name] for name in names)} of {len(names)}"
    return found


def simulation_origin() -> Any:
    """Where the simulated site is."""
    return SceneSettings().origin


def drawn_shape(size_px: tuple[int, int]) -> tuple[int, int]:
    """Rows and columns of the raster in which overlaps are counted."""
    scale = M_PER_PX / _CELL_M
    return round(size_px[1] * scale), round(size_px[0] * scale)


def drawn(ring_px: np.ndarray, size_px: tuple[int, int]) -> np.ndarray:
    """A polygon's cells."""
    mask = np.zeros(drawn_shape(size_px), np.uint8)
    cv2.fillPoly(mask, [np.rint((ring_px + 0.5) * (M_PER_PX / _CELL_M) - 0.5).astype(np.int32)], 1)
    return mask > 0


if __name__ == "__main__":
    main()
