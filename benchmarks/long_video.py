"""What a long 1080p flight costs to map, and how well it fits the truth: time, processor time, memory, shape.

    python benchmarks/long_video.py make FOLDER [--frames 20000] [--seed 11] [--keyint 50]
    python benchmarks/long_video.py map FOLDER [--output results/long_video.json] [-- options of sorvolo map]

`make` draws a video of 50 frames a second (H.264, 1920 x 1080 px, a key frame of the stream each `--keyint` frames),
its telemetry and the truth: strips of 300 m at 40 m and 4.65 m/s, so that 400 s need some 230 key frames. `map` maps it
in a process of its own and prints the figures beside those of decoding it alone (all frames; key frames of the stream).
"""

import argparse
import csv
import json
import sys
import tempfile
import time
from pathlib import Path

import av
import cv2
import numpy as np

from child import map_costs
from long_flight import rms
from provenance import commit, machine
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.geodesy import Geodetic, LocalFrame
from sorvolo.geometry.homography import apply_homography, fit_similarity, site_from_image_homography
from sorvolo.geometry.level_ground import footprint
from sorvolo.geometry.pose import Pose, site_from_gimbal_rotation
from sorvolo.store.site.archive import Archive
from sorvolo.survey.mosaic import Status

CAMERA = Camera.from_angle_of_view(1920, 1080, 62)
FRAME = LocalFrame(Geodetic(41.89, 12.6, 0.0))
RATE_HZ, FIX_RATE_HZ, FIX_SIGMA_M = 50, 5, 0.8
HEIGHT_M, SPEED_M_S, STRIP_M, SPACING_M = 40.0, 4.65, 300.0, 20.0
GROUND_M_PER_PX, MARGIN_M = 0.03, 60.0


def main() -> None:
    """Make a flight, or map one."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("make", "map"))
    parser.add_argument("folder", type=Path)
    parser.add_argument("--frames", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=11)
    parser.add_argument(
        "--keyint", type=int, default=RATE_HZ, help="frames between key frames of the stream"
    )
    parser.add_argument("--output", type=Path, help="a JSON file for the figures")
    parser.add_argument("options", nargs="*", help="after --, of `sorvolo map`")
    options = parser.parse_args()
    if options.what == "make":
        make(options.folder, options.frames, options.seed, options.keyint)
        return
    found = {
        "benchmark": "long_video",
        "commit": commit(),
        "machine": machine(),
        **measure(options),
    }
    if options.output is not None:
        options.output.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    print(json.dumps(found, indent=1))


def place_m(time_s: float) -> np.ndarray:
    """(3,) where the camera is: strips northward and back, and the way from each to the next."""
    lap_m = STRIP_M + SPACING_M
    strip, along_m = divmod(SPEED_M_S * time_s, lap_m)
    beside_m = max(0.0, along_m - STRIP_M)
    north_m = min(along_m, STRIP_M)
    return np.array(
        [strip * SPACING_M + beside_m, north_m if strip % 2 == 0 else STRIP_M - north_m, HEIGHT_M]
    )


def pose_at(time_s: float) -> Pose:
    """The true pose: north up all the flight, swaying by a degree and some decimetres."""
    sway = [np.sin(time_s * rate + rate * 7) for rate in (0.9, 1.3, 0.7, 1.1)]
    rotation = site_from_gimbal_rotation(1.5 * sway[0], -90 + 1.0 * sway[1], 1.0 * sway[2])
    return Pose(rotation, place_m(time_s) + np.array([0.2 * sway[2], 0.2 * sway[0], 0.4 * sway[3]]))


def make(folder: Path, frames: int, seed: int, keyint: int) -> None:
    """Draw the flight into the folder: flight.mp4, flight.csv, truth.json."""
    folder.mkdir(parents=True, exist_ok=True)
    cv2.setNumThreads(1)
    rng = np.random.default_rng(seed)
    ground = _ground(frames / RATE_HZ, rng)
    noise = [rng.normal(0, 2, (1080, 1920)).astype(np.float32) for _ in range(3)]
    with av.open(str(folder / "flight.mp4"), "w") as container:
        container.metadata["creation_time"] = "2026-05-01T10:00:00.000000Z"
        stream = container.add_stream("libx264", rate=RATE_HZ)
        stream.width, stream.height, stream.pix_fmt = CAMERA.width_px, CAMERA.height_px, "yuv420p"
        stream.codec_context.thread_count = 1
        stream.options = {
            "crf": "23",
            "preset": "ultrafast",
            "x264-params": f"keyint={keyint}:min-keyint={keyint}:scenecut=0:bframes=2",
        }
        for index in range(frames):
            container.mux(
                stream.encode(_picture(ground, pose_at(index / RATE_HZ), noise[index % len(noise)]))
            )
            if index % 1000 == 0:
                print(index, file=sys.stderr, flush=True)
        container.mux(stream.encode())
    _write_telemetry(folder / "flight.csv", frames / RATE_HZ, rng)
    (folder / "truth.json").write_text(
        json.dumps({"frames": frames, "seed": seed, "keyint": keyint}), encoding="utf-8"
    )


def measure(options: argparse.Namespace) -> dict[str, object]:
    """Map the flight of a folder in a process of its own; the figures."""
    flight = options.folder / "flight.mp4"
    decoding = {
        "every_frame_cpu_s": decode_s(flight, "DEFAULT"),
        "key_frames_cpu_s": decode_s(flight, "NONKEY"),
    }
    with tempfile.TemporaryDirectory() as temporary:
        site = Path(temporary) / "site"
        costs = map_costs(flight, site, ["--camera", "aov=62", *options.options])
        report = json.loads((site / "flights/flight/report.json").read_text())
        return {
            **json.loads((options.folder / "truth.json").read_text()),
            "options": options.options,
            **costs,
            "decoding": decoding,
            "stages_cpu_s": report["cpu_s"],
            "frames_of_report": report["frames"],
            "reading": report.get("reading"),
            **fit(site),
        }


def fit(site: Path) -> dict[str, float]:
    """How far the key frames' outlines lie from the truth, rms: where they are, and after the best similarity."""
    with Archive.open(site, write=False) as archive:
        frame = archive.site().frame
        placed = [each for each in archive.keyframes() if each.status is Status.VISION]
    true = np.concatenate([footprint(CAMERA, pose_at(each.index / RATE_HZ)) for each in placed])
    found = np.concatenate([footprint(each.camera, each.site_from_camera) for each in placed])
    latitude_deg, longitude_deg, _ = frame.wgs84_from_site(found)
    found = FRAME.ground_from_lonlat(np.column_stack([longitude_deg, latitude_deg]))
    laid = apply_homography(fit_similarity(true, found), found)
    return {"by_vision": len(placed), "shape_m": rms(laid - true), "absolute_m": rms(found - true)}


def decode_s(path: Path, skip: str) -> float:
    """Processor time of decoding the video alone, in this process."""
    started_s = time.process_time()
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        stream.thread_type, stream.codec_context.skip_frame = "AUTO", skip
        for _ in container.decode(stream):
            pass
    return round(time.process_time() - started_s, 1)


def _ground(seconds: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Luma (h, w) with detail at every scale under all of the flight, and chroma (h / 2, w / 2, 2)."""
    strips = int(SPEED_M_S * seconds // (STRIP_M + SPACING_M)) + 1
    length_m = min(SPEED_M_S * seconds, STRIP_M)
    height, width = (
        2 * int((each + 2 * MARGIN_M) / GROUND_M_PER_PX / 2)
        for each in (length_m, SPACING_M * strips)
    )
    luma = np.full((height, width), 110, np.float32)
    for octave in (2, 4, 8, 16, 32, 64, 256):
        luma += _detail(height, width, octave, 9 if octave < 256 else 20, rng)
    chroma = [128 + _detail(height // 2, width // 2, 40, 12, rng) for _ in range(2)]
    return luma.clip(16, 235).astype(np.uint8), np.dstack(chroma).astype(np.uint8)


def _detail(
    height: int, width: int, octave: int, levels: float, rng: np.random.Generator
) -> np.ndarray:
    cells = (
        rng.normal(0, levels, (-(-height // octave), -(-width // octave)))
        .clip(-60, 60)
        .astype(np.float32)
    )
    return cv2.resize(cells, (width, height), interpolation=cv2.INTER_LINEAR)


def _picture(ground: tuple[np.ndarray, np.ndarray], pose: Pose, noise: np.ndarray) -> av.VideoFrame:
    luma, chroma = ground
    north_m = len(luma) * GROUND_M_PER_PX - MARGIN_M
    site_from_ground = np.array(
        [[GROUND_M_PER_PX, 0, -MARGIN_M], [0, -GROUND_M_PER_PX, north_m], [0, 0, 1.0]]
    )
    ground_from_image = np.linalg.inv(site_from_ground) @ site_from_image_homography(CAMERA, pose)
    seen = cv2.add(_warped(luma, ground_from_image, 1), noise, dtype=cv2.CV_8U)
    colours = _warped(chroma, ground_from_image, 2)
    planes = np.concatenate([seen.ravel(), colours[:, :, 0].ravel(), colours[:, :, 1].ravel()])
    return av.VideoFrame.from_ndarray(planes.reshape(-1, CAMERA.width_px), format="yuv420p")


def _warped(ground: np.ndarray, ground_from_image: np.ndarray, step: int) -> np.ndarray:
    larger = np.array([[step, 0, (step - 1) / 2], [0, step, (step - 1) / 2], [0, 0, 1.0]])
    return cv2.warpPerspective(
        ground,
        np.linalg.inv(larger) @ ground_from_image @ larger,
        (CAMERA.width_px // step, CAMERA.height_px // step),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REFLECT,
    )


def _write_telemetry(path: Path, seconds: float, rng: np.random.Generator) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(
            [
                "offsetTime(s)",
                "latitude",
                "longitude",
                "relativeHeight(m)",
                "Gimbal:yaw",
                "Gimbal:pitch",
                "Gimbal:roll",
            ]
        )
        for time_s in np.arange(0, seconds, 1 / FIX_RATE_HZ):
            fix_m = place_m(time_s) + rng.normal(0, FIX_SIGMA_M, 3)
            latitude_deg, longitude_deg, _ = (
                float(each[0]) for each in FRAME.wgs84_from_site(fix_m[None, :2])
            )
            place = [f"{latitude_deg:.9f}", f"{longitude_deg:.9f}", f"{fix_m[2]:.3f}"]
            writer.writerow([f"{time_s:.3f}", *place, 0, -90, 0])


if __name__ == "__main__":
    main()
