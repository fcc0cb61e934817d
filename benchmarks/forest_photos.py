"""What a survey of a forest by large photos costs to map: processor time, peak memory, painting a photo.

    python benchmarks/forest_photos.py make FOLDER [--seed 11] [--height 70]
    python benchmarks/forest_photos.py map FOLDER [--output results/forest_photos.json] [-- options of sorvolo map]

`make` draws 28 photos of 4608 x 3456 px: four strips 70 m above the ground over closed autumn crowns of 6 to 18 m, with
70 % overlap along and 60 % across, so that no plane fits them and crowns hide each other differently in each photo.
From higher up (`--height 110`) the same places overlap by 81 and 74 %. It stands for a real flight of as many photos as
large, which is not among the data that are kept. `map` maps them without a detector in a process of its own; `--width`
draws smaller photos of the same ground, for a trial. `--output` adds the run to the file's others.
"""

import argparse
import json
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np

from child import map_costs
from long_video import FRAME
from provenance import commit, machine
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.pose import Pose, site_from_gimbal_rotation
from sorvolo.store.exports.flight_files import write_photo
from sorvolo.survey.flight import Frame

WIDTH_PX, ANGLE_DEG, HEIGHT_M = 4608, 62.0, 70.0
STRIPS, PHOTOS_A_STRIP, ALONG_M, ACROSS_M = 4, 7, 19.0, 34.0
CROWN_TOP_M, CROWN_RADIUS_M, M2_A_CROWN = (6.0, 18.0), (1.5, 4.0), 9.0
SURFACE_M_PER_PX, TEXTURE_M_PER_PX, MARGIN_M = 0.1, 0.025, 60.0
MARCH_M = 0.5  # between the heights at which a ray is compared with the crowns
COARSE = 4  # pixels a ray that is followed
FIX_SIGMA_M, HEIGHT_SIGMA_M = 1.5, 0.5
START_NS, PHOTO_EVERY_S = 1_790_000_000_000_000_000, 4
AUTUMN_RGB = (
    (176, 116, 44),
    (150, 74, 38),
    (196, 160, 62),
    (92, 104, 48),
    (120, 128, 60),
    (70, 84, 44),
)


def main() -> None:
    """Draw the photos, or map them."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("make", "map"))
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seed", type=int, default=11)
    parser.add_argument(
        "--height", type=float, default=HEIGHT_M, help="of the flight above the ground, m"
    )
    parser.add_argument("--width", type=int, default=WIDTH_PX)
    parser.add_argument("--output", type=Path, help="a JSON file for the figures")
    parser.add_argument("options", nargs="*", help="after --, of `sorvolo map`")
    options = parser.parse_args()
    if options.what == "make":
        make(options.folder, options.seed, options.width, options.height)
        return
    run = {"commit": commit(), "machine": machine(), **measure(options)}
    if options.output is not None:
        found = (
            json.loads(options.output.read_text())
            if options.output.is_file()
            else {"benchmark": "forest_photos"}
        )
        found["runs"] = [*found.get("runs", ()), run]
        options.output.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    print(json.dumps(run, indent=1))


def make(folder: Path, seed: int, width_px: int, height_m: float) -> None:
    """Draw the photos into folder/photos; folder/truth.json has how."""
    cv2.setNumThreads(1)
    (folder / "photos").mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(seed)
    surface_m, texture = _forest(rng)
    camera = Camera.from_angle_of_view(width_px, width_px * 3 // 4, ANGLE_DEG)
    for index in range(STRIPS * PHOTOS_A_STRIP):
        pose = _pose(index, height_m, rng)
        image = _picture(surface_m, texture, camera, pose, rng)
        name = f"DJI_{index + 1:04d}.JPG"
        time_ns = START_NS + index * PHOTO_EVERY_S * 1_000_000_000
        write_photo(
            folder / "photos" / name,
            Frame(index, name, time_ns, image),
            camera,
            _telemetry(pose, rng),
        )
        print(name, file=sys.stderr, flush=True)
    (folder / "truth.json").write_text(
        json.dumps(
            {
                "photos": STRIPS * PHOTOS_A_STRIP,
                "width_px": camera.width_px,
                "height_px": camera.height_px,
                "seed": seed,
                "flight_height_m": height_m,
            }
        ),
        encoding="utf-8",
    )


def measure(options: argparse.Namespace) -> dict[str, object]:
    """Map the photos of a folder in a process of its own; the figures."""
    truth = json.loads((options.folder / "truth.json").read_text())
    with tempfile.TemporaryDirectory() as temporary:
        site = Path(temporary) / "site"
        costs = map_costs(options.folder / "photos", site, options.options)
        report = json.loads((site / "flights/photos/report.json").read_text())
    return {
        **truth,
        "options": options.options,
        **costs,
        "stages_cpu_s": report["cpu_s"],
        "paint_cpu_s_a_photo": round(report["cpu_s"]["paint"] / truth["photos"], 2),
        "frames_of_report": report["frames"],
        "verdict": report.get("headline"),
    }


# ---- the forest -----------------------------------------------------------------------------------------------


def _forest(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Heights of the crowns' surface, m, and its colours; both north up, from (-MARGIN_M, farthest north)."""
    size_m = np.array([(STRIPS - 1) * ACROSS_M, (PHOTOS_A_STRIP - 1) * ALONG_M]) + 2 * MARGIN_M
    width, height = (int(each / SURFACE_M_PER_PX) for each in size_m)
    surface_m, crown = np.zeros((height, width), np.float32), np.zeros((height, width), np.int32)
    count = int(size_m.prod() / M2_A_CROWN)
    for number in range(1, count + 1):
        top_m, radius_m = rng.uniform(*CROWN_TOP_M), rng.uniform(*CROWN_RADIUS_M)
        reach = int(radius_m / SURFACE_M_PER_PX)
        x, y = rng.integers(reach, width - reach), rng.integers(reach, height - reach)
        rows, columns = slice(y - reach, y + reach), slice(x - reach, x + reach)
        away = np.hypot(*np.mgrid[-reach:reach, -reach:reach]) / reach
        dome_m = np.where(away < 1, top_m - 0.7 * radius_m * away**2, 0).astype(np.float32)
        higher = dome_m > surface_m[rows, columns]
        surface_m[rows, columns][higher] = dome_m[higher]
        crown[rows, columns][higher] = number
    surface_m += _detail(height, width, 4, 0.25, rng) * (surface_m > 0)
    colours = np.array(
        [(58, 52, 40), *(AUTUMN_RGB[i] for i in rng.integers(0, len(AUTUMN_RGB), count))],
        np.float32,
    )
    colours *= rng.uniform(0.8, 1.2, (count + 1, 1))
    return surface_m, _coloured(surface_m, crown, colours.astype(np.float32), rng)


def _coloured(
    surface_m: np.ndarray, crown: np.ndarray, colours: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """The texture, (h, w, 3): each crown's colour, lit from the south-west, with leaves and twigs."""
    finer = round(SURFACE_M_PER_PX / TEXTURE_M_PER_PX)
    height, width = (each * finer for each in surface_m.shape)
    slope = cv2.Sobel(surface_m, cv2.CV_32F, 0, 1) - cv2.Sobel(surface_m, cv2.CV_32F, 1, 0)
    light = cv2.resize(
        1 + 0.25 * np.clip(slope, -2, 2), (width, height), interpolation=cv2.INTER_LINEAR
    )
    for octave, sigma in ((1, 0.10), (2, 0.10), (4, 0.12), (10, 0.12), (30, 0.08)):
        light += _detail(height, width, octave, sigma, rng)
    # borders of crowns are ragged: each texel takes the crown of a place a little aside
    ragged = [_detail(height, width, 6, 0.8, rng) for _ in range(2)]
    rows, columns = np.mgrid[0:height, 0:width].astype(np.float32)
    own = cv2.remap(
        crown.astype(np.float32),
        columns / finer + ragged[0],
        rows / finer + ragged[1],
        cv2.INTER_NEAREST,
        borderMode=cv2.BORDER_REPLICATE,
    ).astype(np.int32)
    texture = np.empty((height, width, 3), np.uint8)
    for channel in range(3):
        texture[:, :, channel] = np.clip(colours[own, channel] * light, 0, 255)
    return texture


def _detail(
    height: int, width: int, octave: int, sigma: float, rng: np.random.Generator
) -> np.ndarray:
    cells = rng.standard_normal(
        (-(-height // octave), -(-width // octave)), np.float32
    ) * np.float32(sigma)
    return cv2.resize(cells, (width, height), interpolation=cv2.INTER_LINEAR)


# ---- the photos -----------------------------------------------------------------------------------------------


def _pose(index: int, height_m: float, rng: np.random.Generator) -> Pose:
    strip, along = divmod(index, PHOTOS_A_STRIP)
    along = along if strip % 2 == 0 else PHOTOS_A_STRIP - 1 - along
    rotation = site_from_gimbal_rotation(
        rng.normal(0, 1.5), -90 + rng.normal(0, 1.0), rng.normal(0, 1.0)
    )
    return Pose(
        rotation, np.array([strip * ACROSS_M, along * ALONG_M, height_m]) + rng.normal(0, 0.5, 3)
    )


def _telemetry(pose: Pose, rng: np.random.Generator) -> dict[str, float]:
    fix_m = pose.translation_m + rng.normal(0, (FIX_SIGMA_M, FIX_SIGMA_M, HEIGHT_SIGMA_M))
    latitude_deg, longitude_deg, _ = (
        float(each[0]) for each in FRAME.wgs84_from_site(fix_m[None, :2])
    )
    return {
        "latitude_deg": latitude_deg,
        "longitude_deg": longitude_deg,
        "orthometric_height_m": 35.0 + float(fix_m[2]),
        "height_above_takeoff_m": float(fix_m[2]),
        "camera_yaw_deg": 0.0,
        "camera_pitch_deg": -90.0,
        "camera_roll_deg": 0.0,
    }


def _picture(
    surface_m: np.ndarray, texture: np.ndarray, camera: Camera, pose: Pose, rng: np.random.Generator
) -> np.ndarray:
    """What the camera sees: each ray ends where it first meets the crowns."""
    east, north = _slopes(camera, pose, COARSE)
    met_m = np.zeros_like(east)
    for up_m in np.arange(
        0.0, CROWN_TOP_M[1] + 1, MARCH_M
    ):  # the highest that is met counts, so it comes last
        x, y = _places_px(east, north, np.float32(up_m), pose, SURFACE_M_PER_PX, len(surface_m))
        here_m = cv2.remap(surface_m, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        met_m[here_m >= up_m] = up_m
    met_m = cv2.resize(
        cv2.blur(met_m, (3, 3)), (camera.width_px, camera.height_px), interpolation=cv2.INTER_LINEAR
    )
    finer = round(SURFACE_M_PER_PX / TEXTURE_M_PER_PX)
    east, north = _slopes(camera, pose, 1)
    x, y = _places_px(east, north, met_m, pose, SURFACE_M_PER_PX / finer, len(texture))
    seen = cv2.remap(texture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    noise = rng.standard_normal(seen.shape[:2], np.float32) * 2
    return np.clip(seen + noise[:, :, None], 0, 255).astype(np.uint8)


def _slopes(camera: Camera, pose: Pose, step: int) -> tuple[np.ndarray, np.ndarray]:
    """Metres east and north that each `step`th pixel's ray goes for a metre down."""
    u = (
        (np.arange(camera.width_px // step, dtype=np.float32) + 0.5) * step - 0.5 - camera.cx_px
    ) / camera.fx_px
    v = (
        (np.arange(camera.height_px // step, dtype=np.float32) + 0.5) * step - 0.5 - camera.cy_px
    ) / camera.fy_px
    rotation = pose.rotation.astype(np.float32)
    along = [
        rotation[i, 0] * u[None, :] + rotation[i, 1] * v[:, None] + rotation[i, 2] for i in range(3)
    ]
    return -along[0] / along[2], -along[1] / along[2]


def _places_px(
    east: np.ndarray,
    north: np.ndarray,
    up_m: "np.ndarray | np.float32",
    pose: Pose,
    m_per_px: float,
    height: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Where rays at this height are on a raster of the forest."""
    x_m, y_m, z_m = (np.float32(each) for each in pose.translation_m)
    x = (x_m + east * (z_m - up_m) + np.float32(MARGIN_M)) / np.float32(m_per_px)
    y = height - (y_m + north * (z_m - up_m) + np.float32(MARGIN_M)) / np.float32(m_per_px)
    return x.astype(np.float32), y.astype(np.float32)


if __name__ == "__main__":
    main()
