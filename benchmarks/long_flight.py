"""How memory and the time of the next key frame grow with a flight of thousands of small pictures, drawn as it goes.

python benchmarks/long_flight.py [--keyframes 5000] [--seed 11] [--memory 64] [--minutes 60]

The whole of `sorvolo map` but for decoding: registration, the pose graph, the growing map, the store, the final solve
and painting, without exports. The drone flies strips over ground that never repeats; each picture, 320 x 240 px, is
drawn when it is asked for, and its drawing is not counted. Processor time of the next key frame is that of the hundred
around it. Everything is written to results/long_flight.json.
"""

import argparse
import json
import resource
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np

from provenance import commit, machine
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.geodesy import Geodetic, LocalFrame
from sorvolo.geometry.homography import apply_homography, fit_similarity, site_from_image_homography
from sorvolo.geometry.level_ground import footprint
from sorvolo.geometry.pose import Pose, site_from_gimbal_rotation
from sorvolo.missions.flight.settings import MapSettings
from sorvolo.missions.flight.setup import prepare
from sorvolo.missions.map.planar_run import PlanarRun
from sorvolo.store.freed_memory import share_arenas
from sorvolo.store.site.archive import Archive
from sorvolo.survey.flight import CameraModel, Frame, LostFrame, Notice, PosedFrame, Telemetry
from sorvolo.survey.mosaic import Status

RESULTS = Path(__file__).parent / "results" / "long_flight.json"
MARKS = (100, 500, 1000, 2000, 5000)
CAMERA = Camera.from_angle_of_view(320, 240, 62)
HEIGHT_M, STEP_M, SPACING_M, STRIP = (
    27.0,
    7.2,
    13.0,
    70,
)  # keyframes of a strip; 70 % and 60 % overlap
GROUND_M_PER_PX = 0.08
FIX_SIGMA_M = 0.8


def main() -> None:
    """Map the flight and write the curve."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--keyframes", type=int, default=5000)
    parser.add_argument("--seed", type=int, default=11)
    parser.add_argument("--memory", type=float, default=64.0, help="of `sorvolo map --memory`, MB")
    parser.add_argument(
        "--minutes", type=float, default=float("inf"), help="then the flight ends where it is"
    )
    parser.add_argument("--output", type=Path, default=RESULTS)
    options = parser.parse_args()
    cv2.setNumThreads(1)
    share_arenas()  # as commands do
    measured = commit()  # before anything could change
    source = DrawnFlight(options.seed, options.keyframes)
    with tempfile.TemporaryDirectory() as folder:
        found = fly(
            source,
            Path(folder) / "site",
            MapSettings(model="none", memory_mb=options.memory),
            options.minutes,
        )
    found = {
        "benchmark": "long_flight",
        "commit": measured,
        "machine": machine(),
        "seed": options.seed,
        "picture_px": [CAMERA.width_px, CAMERA.height_px],
        "memory_mb": options.memory,
        **found,
    }
    options.output.write_text(json.dumps(found, indent=1) + "\n")
    for mark in found["marks"]:
        print(json.dumps(mark))
    print(json.dumps({key: value for key, value in found.items() if not isinstance(value, list)}))


def fly(
    source: "DrawnFlight", site: Path, settings: MapSettings, minutes: float
) -> dict[str, object]:
    """Map it, or as much as there are minutes for; the figures."""
    until_s = time.monotonic() + 60 * minutes
    add_s: list[float] = []
    resident_mb: list[float] = []
    with Archive.open(site, write=True) as archive:
        setup = prepare(source, settings, None, telemetry_named=False)
        with PlanarRun(setup, archive, settings) as run:
            for frame in source.frames(lambda *_: time.monotonic() < until_s):
                posed = PosedFrame(frame, setup.prior(frame, first=frame.index == 0))
                started_s = time.process_time()
                run.add(posed)
                add_s.append(time.process_time() - started_s)
                resident_mb.append(now_mb())
                if len(add_s) % 250 == 0:
                    print(
                        len(add_s),
                        f"{np.mean(add_s[-250:]) * 1e3:.1f} ms",
                        f"{now_mb():.0f} MB",
                        file=sys.stderr,
                    )
            marks = [mark_at(each, add_s, resident_mb) for each in MARKS if each <= len(add_s)]
            growing_mb, started_s = peak_mb(), time.process_time()
            placed = run.complete()
            finish_s = time.process_time() - started_s
    frames = [
        each
        for each in placed
        if each.status is Status.VISION and each.site_from_camera is not None
    ]
    true = np.concatenate([source.outline_m(each.index) for each in frames])
    found = np.concatenate([footprint(CAMERA, each.site_from_camera) for each in frames])
    laid = apply_homography(fit_similarity(true, found), found)
    return {
        "keyframes": len(add_s),
        "by_vision": len(frames),
        "marks": marks,
        "peak_growing_mb": growing_mb,
        "peak_mb": peak_mb(),
        "finish_cpu_s": finish_s,
        "add_cpu_s": float(np.sum(add_s)),
        "shape_m": rms(laid - true),
        "absolute_m": rms(found - true),
        "resident_mb_every_50": [round(each) for each in resident_mb[::50]],
        "add_ms_mean_of_50": [
            round(float(np.mean(each)) * 1e3, 1)
            for each in np.array_split(add_s, max(1, len(add_s) // 50))
        ],
    }


def mark_at(count: int, add_s: list[float], resident_mb: list[float]) -> dict[str, float]:
    """The figures around a key frame."""
    around = np.array(add_s[max(0, count - 50) : count + 50]) * 1e3
    return {
        "keyframe": count,
        "median_ms": float(np.median(around)),
        "mean_ms": float(np.mean(around)),
        "largest_ms": float(np.max(around)),
        "resident_mb": float(np.mean(resident_mb[max(0, count - 50) : count])),
    }


def rms(distances: np.ndarray) -> float:
    """Of (N, 2) vectors."""
    return float(np.sqrt((distances**2).sum(axis=1).mean()))


def peak_mb() -> float:
    """The most that this process has held in memory."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def now_mb() -> float:
    """What this process holds in memory."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / 2**20


class DrawnFlight:
    """A flight whose pictures are drawn when they are asked for; fulfils `capture.source.Source`."""

    name, kind, inputs, start_origin = "long", "photos", ("drawn",), "drawn"
    frame_rate_hz, ground_elevation_m = float("nan"), 0.0

    def __init__(self, seed: int, count: int) -> None:
        rng = np.random.default_rng(seed)
        self.frame_count, self.fingerprint = count, f"long {seed} {count}"
        self.start_ns = 1_700_000_000_000_000_000
        self.camera = CameraModel(CAMERA, "drawn", 0.002)
        self._poses = [_pose(number, rng) for number in range(count)]
        # two periods that have no multiple in common below 70 000 px: the ground never repeats
        self._layers = [_texture(side, rng) for side in (1021, 1153)]
        self.telemetry = self._telemetry(rng)

    def notices(self) -> tuple[Notice, ...]:
        """Nothing is wrong with what is drawn."""
        return ()

    def frames(self, wanted: Callable[[int, int], bool]) -> Iterator[Frame | LostFrame]:
        """All that are wanted."""
        for number, pose in enumerate(self._poses):
            time_ns = self.start_ns + number * 1_000_000_000
            if wanted(number, time_ns):
                yield Frame(number, f"{number:05d}.jpg", time_ns, self._picture(pose, number))

    def outline_m(self, number: int) -> np.ndarray:
        """(4, 2) where a picture truly lies."""
        return footprint(CAMERA, self._poses[number])

    def _picture(self, pose: Pose, number: int) -> np.ndarray:
        site_from_image = site_from_image_homography(CAMERA, pose)
        outline_px = footprint(CAMERA, pose) * [1, -1] / GROUND_M_PER_PX
        low, high = (
            np.floor(outline_px.min(axis=0)).astype(int) - 2,
            np.ceil(outline_px.max(axis=0)).astype(int) + 3,
        )
        ground = sum(
            layer[
                np.ix_(
                    np.arange(low[1], high[1]) % len(layer), np.arange(low[0], high[0]) % len(layer)
                )
            ]
            for layer in self._layers
        )
        corner = np.array([[1, 0, low[0]], [0, 1, low[1]], [0, 0, 1]])
        site_from_ground = np.diag([GROUND_M_PER_PX, -GROUND_M_PER_PX, 1.0]) @ corner
        seen = cv2.warpPerspective(
            ground,
            np.linalg.inv(site_from_image) @ site_from_ground,
            (CAMERA.width_px, CAMERA.height_px),
        )
        noise = np.random.default_rng(number).normal(0, 2, seen.shape).astype(np.float32)
        return np.clip(seen + noise, 0, 255).astype(np.uint8)

    def _telemetry(self, rng: np.random.Generator) -> Telemetry:
        places_m = np.array([pose.translation_m for pose in self._poses])
        fixes_m = places_m + rng.normal(0, FIX_SIGMA_M, places_m.shape)
        frame = LocalFrame(Geodetic(41.89, 12.6, 0.0))
        latitude_deg, longitude_deg, _ = frame.wgs84_from_site(fixes_m[:, :2])
        yaw_deg = [0.0 if (number // STRIP) % 2 == 0 else 180.0 for number in range(len(places_m))]
        level = np.zeros(len(places_m))
        return Telemetry(
            "drawn",
            self.start_ns + np.arange(len(places_m)) * 1_000_000_000,
            {
                "latitude_deg": latitude_deg,
                "longitude_deg": longitude_deg,
                "height_above_takeoff_m": fixes_m[:, 2],
                "camera_yaw_deg": np.array(yaw_deg),
                "camera_pitch_deg": level - 90,
                "camera_roll_deg": level,
            },
        )


def _pose(number: int, rng: np.random.Generator) -> Pose:
    strip, step = divmod(number, STRIP)
    along = step if strip % 2 == 0 else STRIP - 1 - step
    place_m = np.array([SPACING_M * strip, STEP_M * along, HEIGHT_M]) + rng.normal(0, 0.3, 3)
    yaw_deg = (0 if strip % 2 == 0 else 180) + rng.normal(0, 1.5)
    tilt_deg, roll_deg = rng.normal(0, 1.0, 2)
    return Pose(site_from_gimbal_rotation(yaw_deg, -90 + tilt_deg, roll_deg), place_m)


def _texture(side: int, rng: np.random.Generator) -> np.ndarray:
    """(side, side, 3) float32, detail at every scale, its left fitting its right; two added are a picture."""
    total = np.zeros((side, side, 3), np.float32)
    for octave in (2, 4, 8, 16, 32, 64):
        cells = -(-side // octave)
        small = rng.normal(0, 1, (cells, cells, 1 if octave < 16 else 3)).astype(np.float32)
        small = np.pad(small, ((2, 2), (2, 2), (0, 0)), mode="wrap")
        large = cv2.resize(
            small, None, fx=side / cells, fy=side / cells, interpolation=cv2.INTER_CUBIC
        )
        first = round(2 * side / cells)
        total += large.reshape(*large.shape[:2], -1)[first : first + side, first : first + side]
    return (64 + 9 * total).astype(np.float32)


if __name__ == "__main__":
    main()
