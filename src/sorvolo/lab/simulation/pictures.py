"""Single pictures of many small sites, each seen once from its own height, angle and light, with the truth."""

import os
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.random import Generator

from sorvolo.errors import SettingsError
from sorvolo.geometry.arrays import Floats, ImageRGB
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.ground import footprint, ground_from_pixels
from sorvolo.geometry.polygons import polygon_area
from sorvolo.geometry.pose import Pose, site_from_body_nadir_rotation
from sorvolo.lab.simulation.flight import line_kernel
from sorvolo.lab.simulation.flight_files import (
    PICTURES_MARK,
    simulation_description,
    simulation_folder,
    write_json,
)
from sorvolo.lab.simulation.ground import (
    GroundKind,
    GroundLayout,
    paint_ground,
)
from sorvolo.lab.simulation.ground_painting import GroundArea, GroundRaster
from sorvolo.lab.simulation.rendering import render, render_labels
from sorvolo.lab.simulation.settings import LaterSettings, SimulationSettings, WeatherSettings
from sorvolo.lab.simulation.truth import box_rows, coco_categories
from sorvolo.lab.simulation.world import Day, World, build_day, is_free, scenery
from sorvolo.paths import AnyPath, Json
from sorvolo.search.drawing.noise import layer
from sorvolo.search.drawing.objects import (
    GROUND_LEVEL,
    POSES,
    Thing,
    ThingLabel,
    new_kind,
    new_size,
    warm_body,
)
from sorvolo.search.drawing.view import camera_view, ray_grid
from sorvolo.store.ahead import in_order
from sorvolo.store.atomic import atomic_write_bytes, writing
from sorvolo.store.images import jpeg_from_image


def photographed(image: ImageRGB, gains: Floats, rng: Generator) -> ImageRGB:
    """The rendered picture as a camera records it; `gains` (3,) is the light's colour and strength.

    In the dark the camera turns its own gain up, and its noise with it.
    """
    height, width = image.shape[:2]
    light = image.astype(np.float32) * gains.astype(np.float32)
    # clouds' shadows
    light *= 1 + 0.12 * np.clip(layer(rng, (height, width), 0.4 * width), -2, 2)[..., None]
    if rng.uniform() < 0.2:
        air = rng.uniform(170, 230) * np.array([0.96, 1.0, 1.05]) * gains
        haze = np.float32(rng.uniform(0.05, 0.4))
        light += haze * (air.astype(np.float32) - light)
    y, x = np.mgrid[0:height, 0:width].astype(np.float32)
    radius2 = ((x - width / 2) ** 2 + (y - height / 2) ** 2) / (width / 2) ** 2
    light /= (1 + np.float32(rng.uniform(0, 0.3)) * radius2)[..., None]
    camera_gain = float(np.clip(rng.uniform(60, 150) / max(light.mean(), 1.0), 0.6, 5.0))
    light *= np.float32(camera_gain if rng.uniform() < 0.7 else np.clip(camera_gain, 0.8, 1.25))
    balance = rng.normal(1, 0.05, 3).astype(np.float32)
    light = _blurred(light * balance, rng)
    noise = rng.uniform(0.5, 3.5) * max(1.0, camera_gain) ** 0.7
    light += np.float32(noise) * rng.standard_normal(light.shape, dtype=np.float32)
    bent = 255 * np.clip(light / 255, 0, 1) ** np.float32(rng.uniform(0.8, 1.25))
    return recompressed(np.round(bent).astype(np.uint8), rng)


def recompressed(image: ImageRGB, rng: Generator) -> ImageRGB:
    """The picture after lossy compression, colour at half its resolution as in videos."""
    quality = int(rng.integers(45, 96))
    _, data = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
    return np.ascontiguousarray(cv2.imdecode(data, cv2.IMREAD_COLOR)[..., ::-1])  # type: ignore[index]


def _blurred(
    image: np.ndarray[tuple[int, ...], np.dtype[np.float32]], rng: Generator
) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
    """Out of focus a little, and in a third of the pictures moved during the exposure."""
    sigma_px = rng.uniform(0.0, 1.1)
    if sigma_px > 0.3:
        image = np.asarray(cv2.GaussianBlur(image, (0, 0), sigma_px), np.float32)
    if rng.uniform() < 0.33:
        length_px, angle = rng.uniform(1, 7), rng.uniform(0, np.pi)
        kernel = line_kernel(length_px * np.array([np.cos(angle), np.sin(angle)]))
        image = np.asarray(cv2.filter2D(image, -1, kernel), np.float32)
    return image


def warm_day(day: Day, bare: GroundRaster, rng: Generator) -> Day:
    """The day with warmth for colour, the same in its three channels; `bare` is its ground without shadows.

    By day the sun's shadows are cool; by night they are gone. Two cars in three have a warm engine.
    """
    has_sun = rng.uniform() < 0.4
    raster = day.ground if has_sun else bare.resampled(day.ground.m_per_px[0])
    spread, turn = rng.uniform(0.1, 0.5), 1.0 if has_sun else rng.choice((-1.0, 1.0))
    grey = cv2.GaussianBlur(raster.rgb.mean(axis=2).astype(np.float32), (0, 0), 1.2)
    warmth = GROUND_LEVEL + np.float32(spread * turn) * (grey - grey.mean())
    warmth += np.float32(rng.uniform(2, 9)) * layer(rng, warmth.shape[:2], 4.0 / raster.m_per_px[0])
    ground = replace(raster, rgb=np.dstack([np.clip(warmth, 0, 255).astype(np.uint8)] * 3))
    bodies = {thing.id: warm_body(thing, day.bodies[thing.id], rng) for thing in day.things}
    return replace(day, ground=ground, bodies=bodies)


def heat_picture(image: ImageRGB, rng: Generator) -> ImageRGB:
    """The rendered warmth as a thermal camera shows it: soft, noisy, striped, stretched to its own range."""
    warmth = image[..., 0].astype(np.float32)
    warmth = np.asarray(cv2.GaussianBlur(warmth, (0, 0), rng.uniform(0.5, 1.3)), np.float32)
    warmth = warmth + np.float32(rng.uniform(0.5, 3.0)) * rng.standard_normal(
        warmth.shape, dtype=np.float32
    )
    stripes = rng.standard_normal(warmth.shape[1], dtype=np.float32)
    warmth += np.float32(rng.uniform(0, 1.5)) * stripes
    low, high = np.percentile(warmth, (0.5, 99.8))
    room = max(float(high - low), 40.0)
    shown = np.clip(
        (warmth - low + rng.uniform(0, 0.3) * room) / (room * rng.uniform(1.0, 1.5)), 0, 1
    )
    if rng.uniform() < 0.35:  # black hot
        shown = 1 - shown
    return recompressed(np.dstack([np.round(255 * shown).astype(np.uint8)] * 3), rng)


SMALLEST_PX = 4
"""An object whose box has no side this long, or of which less than `LEAST_VISIBLE` shows, is a region to ignore."""

LEAST_VISIBLE = 0.3  # share of an object; less is not to be recognised; by choice

_SIZES_PX = ((640, 640), (960, 540), (832, 624), (768, 768))
_THERMAL_SIZE_PX = (640, 512)  # of the common sensors
_MARGIN_M = 5.0  # things and shadows just outside the picture reach into it
_LARGEST_GROUND_PX = 4e6  # pixels of painted ground, which bounds the memory
_STEEPEST_DEG = 72.0  # no ray is nearer to the horizon: there is no ground painted


@dataclass(frozen=True)
class PictureSettings:
    """What single pictures show. The same settings and seed give the same pictures, each whatever their number.

    `ground` is a GroundKind's name, or empty for all kinds in turn. `m_per_px` and `height_m` are the
    lowest and the highest ground sampling distance (drawn evenly in its logarithm) and height above ground;
    `tilt_deg` is how far the camera may look away from straight down.
    """

    pictures: int = 100
    seed: int = 1
    ground: str = ""
    thermal_share: float = 0.0
    empty_share: float = 0.06  # of pictures without any person, car or small object
    m_per_px: tuple[float, float] = (0.015, 0.12)
    height_m: tuple[float, float] = (10.0, 120.0)
    tilt_deg: float = 45.0

    def __post_init__(self) -> None:
        if self.ground not in ("", *GroundKind):
            raise SettingsError(f"unknown ground {self.ground!r}; choose {', '.join(GroundKind)}")
        for name, value, low, high in (
            ("pictures", self.pictures, 1, 10**6),
            ("seed", self.seed, 0, 2**62),
            ("thermal_share", self.thermal_share, 0, 1),
            ("empty_share", self.empty_share, 0, 1),
            ("m_per_px", self.m_per_px[0], 0.004, self.m_per_px[1]),
            ("m_per_px", self.m_per_px[1], 0.004, 0.5),
            ("height_m", self.height_m[0], 4, self.height_m[1]),
            ("height_m", self.height_m[1], 4, 500),
            ("tilt_deg", self.tilt_deg, 0, 45),
        ):
            if not low <= value <= high:
                raise SettingsError(f"{name} must lie in [{low}, {high}], got {value}")


@dataclass(frozen=True, eq=False)
class SimulatedPicture:
    """One picture and what is in it; `boxes` are COCO annotations, those to be ignored with `iscrowd` 1.

    `m_per_px` is the ground sampling distance in the middle of the picture, across the line of sight.
    """

    index: int
    image: ImageRGB
    camera: Camera
    site_from_camera: Pose
    m_per_px: float
    ground: str
    is_thermal: bool
    boxes: tuple[Json, ...]


def simulate_picture(settings: PictureSettings, index: int) -> SimulatedPicture:
    """The picture of this index, counted from 0; its boxes' ids count from 1."""
    rng = np.random.default_rng([settings.seed, 20, index])
    is_thermal = bool(rng.uniform() < settings.thermal_share)
    camera, pose = _new_shot(settings, is_thermal, rng)
    middle = ground_from_pixels(camera, pose, np.array([[camera.cx_px, camera.cy_px]]))[0]
    m_per_px = float(np.linalg.norm(pose.translation_m - [*middle, 0.0])) / camera.fx_px
    area = GroundArea.around(footprint(camera, pose), _MARGIN_M)
    ground = settings.ground or str(rng.choice(list(GroundKind), p=(0.25, 0.35, 0.3, 0.1)))
    width_m, height_m = area.size_m
    fine_m = max(0.72 * m_per_px, float(np.sqrt(width_m * height_m / _LARGEST_GROUND_PX)))
    painted = paint_ground(GroundKind(ground), area, fine_m, rng)
    things = scenery(ground, painted.layout, rng)
    if rng.uniform() >= settings.empty_share:
        things += _targets(things, painted.layout, camera, pose, rng)
    # The site under a light of its own: mostly day, sometimes dusk, street lamps or snow
    sky = rng.uniform()
    weather = WeatherSettings(
        has_clouds=False,
        wind_m=0.0,
        brightness=float(
            rng.uniform(0.05, 0.12) if sky < 0.05 else rng.uniform(0.2, 0.6) if sky < 0.15 else 1.0
        ),
        snow=float(rng.uniform(0.3, 1.0)) if rng.uniform() < 0.05 else 0.0,
    )
    lit = SimulationSettings(seed=int(rng.integers(2**31)), later=LaterSettings(weather=weather))
    day = build_day(World(painted.raster, (things, things)), lit, 2, m_per_px)
    view = camera_view(camera, pose, ray_grid(camera))
    if is_thermal:
        image = heat_picture(render(warm_day(day, painted.raster, rng), view, pose, 0.0), rng)
    else:
        image = photographed(render(day, view, pose, 0.0), day.gains, rng)
    labels, totals = render_labels(things, day.bodies, view, pose, 0.0)
    boxes = tuple(_judged(row) for row in box_rows(things, labels, totals, index + 1, 1))
    return SimulatedPicture(index, image, camera, pose, m_per_px, ground, is_thermal, boxes)


def _judged(row: Json) -> Json:
    is_seen = max(row["bbox"][2:]) >= SMALLEST_PX and row["visibility"] >= LEAST_VISIBLE
    return row | {"iscrowd": 0 if is_seen else 1}


def _new_shot(settings: PictureSettings, is_thermal: bool, rng: Generator) -> tuple[Camera, Pose]:
    """A camera without distortion somewhere above the site's origin."""
    for _ in range(2000):
        width_px, height_px = (
            _THERMAL_SIZE_PX if is_thermal else _SIZES_PX[rng.integers(len(_SIZES_PX))]
        )
        camera = Camera.from_angle_of_view(width_px, height_px, float(rng.uniform(30, 84)))
        m_per_px = float(np.exp(rng.uniform(*np.log(settings.m_per_px))))
        pitch_deg = float(
            abs(rng.normal(0, 5))
            if rng.uniform() < 0.55
            else rng.uniform(0.2, 1.0) * settings.tilt_deg
        )
        pitch_deg = min(pitch_deg, settings.tilt_deg)
        height_m = m_per_px * camera.fx_px * float(np.cos(np.radians(pitch_deg)))
        rotation = site_from_body_nadir_rotation(
            float(rng.uniform(0, 360)), pitch_deg, float(rng.normal(0, 2))
        )
        pose = Pose(rotation, np.array([0.0, 0.0, height_m]))
        down = -(camera.rays_from_pixels(camera.corners_px) @ rotation.T)[:, 2]
        lengths = np.linalg.norm(camera.rays_from_pixels(camera.corners_px), axis=1)
        if not settings.height_m[0] <= height_m <= settings.height_m[1]:
            continue
        if (down / lengths).min() >= np.cos(np.radians(_STEEPEST_DEG)):
            return camera, pose
    raise SettingsError(
        f"no camera sees the ground at {settings.m_per_px[0]:g} to {settings.m_per_px[1]:g} m per pixel from"
        f" {settings.height_m[0]:g} to {settings.height_m[1]:g} m; widen one of them"
    )


def _targets(
    others: tuple[Thing, ...],
    layout: GroundLayout,
    camera: Camera,
    pose: Pose,
    rng: Generator,
) -> tuple[Thing, ...]:
    """People, cars and small objects in sight, as many as a lonely field, a street or a crowd has."""
    ground_m2 = polygon_area([footprint(camera, pose)])
    counts = {
        label: int(min(rng.poisson(rng.choice(means)), ground_m2 / room_m2))
        for label, means, room_m2 in (
            (ThingLabel.PERSON, (0.5, 3.0, 9.0), 10.0),
            (ThingLabel.CAR, (0.2, 2.0, 8.0), 45.0),
            (ThingLabel.SMALL, (0.5, 2.0, 6.0), 6.0),
        )
    }
    placed: list[Thing] = []
    for label in (ThingLabel.CAR, ThingLabel.PERSON, ThingLabel.SMALL):
        for _ in range(counts[label]):
            kind = (
                str(rng.choice(list(POSES), p=(0.28, 0.34, 0.08, 0.08, 0.1, 0.12)))
                if label is ThingLabel.PERSON
                else new_kind(label, rng)
            )
            size_m = new_size(label, kind, rng)
            new = Thing(
                len(others) + len(placed) + 1,
                label,
                kind,
                0.0,
                0.0,
                0.0,
                size_m,
                int(rng.integers(2**31)),
            )
            for _ in range(20):
                east, north, yaw_deg = _place(label, placed, layout, camera, pose, rng)
                new = replace(new, east_m=east, north_m=north, yaw_deg=yaw_deg)
                if is_free(new, (*others, *placed)):
                    placed.append(new)
                    break
    return tuple(placed)


def _place(
    label: ThingLabel,
    placed: list[Thing],
    layout: GroundLayout,
    camera: Camera,
    pose: Pose,
    rng: Generator,
) -> tuple[float, float, float]:
    """East, north and yaw of a likely place: anywhere in the picture, on a parking lot, or beside another thing."""
    if label is ThingLabel.CAR and len(layout.parkings) and rng.uniform() < 0.6:
        east, north, yaw_deg = layout.parkings[rng.integers(len(layout.parkings))]
        return float(east), float(north), float(yaw_deg + 180 * rng.integers(2) + rng.normal(0, 2))
    if placed and rng.uniform() < 0.35:
        near = placed[int(rng.integers(len(placed)))]
        if label is ThingLabel.CAR and near.label is ThingLabel.CAR:  # parked side by side
            side_m = near.turn[:2, 1] * float(rng.choice((-1, 1)) * rng.uniform(3.2, 4.0))
            return (
                near.east_m + side_m[0],
                near.north_m + side_m[1],
                near.yaw_deg + float(rng.normal(0, 2)),
            )
        angle, reach_m = rng.uniform(0, 2 * np.pi), near.reach_m + rng.uniform(0.8, 3.0)
        east, north = near.east_m + reach_m * np.cos(angle), near.north_m + reach_m * np.sin(angle)
        return float(east), float(north), float(rng.uniform(0, 360))
    point_px: Floats = rng.uniform([0, 0], [camera.width_px, camera.height_px])[None]
    east, north = ground_from_pixels(camera, pose, point_px)[0]
    return float(east), float(north), float(rng.uniform(0, 360))


_THREADS = min(8, os.cpu_count() or 1)  # each holds a picture that is drawn, of tens of megabytes


@dataclass(frozen=True)
class PicturesProgress:
    """How far it is: pictures written, boxes in them (those to be ignored left out), seconds."""

    pictures_done: int
    pictures_total: int
    boxes: int
    seconds: float


def simulate_pictures(folder: AnyPath, settings: PictureSettings) -> Iterator[PicturesProgress]:
    """Write `images/*.jpg` and `boxes.json` (COCO) to `folder`, which appears whole or not at all.

    Each picture is a site of its own; its `flight` in the COCO file names it. Raises SettingsError for a folder that
    holds anything but an earlier simulation, and StoreError for a full disk.
    """
    folder = Path(folder)
    started = time.monotonic()
    info = simulation_description(asdict(settings))
    images: list[Json] = []
    annotations: list[Json] = []
    counted = 0
    with simulation_folder(folder, PICTURES_MARK, {"info": info}) as partial:
        with writing(folder):
            (partial / "images").mkdir()
        pictures = in_order(
            lambda index: simulate_picture(settings, index),
            range(settings.pictures),
            threads=_THREADS,
        )
        for picture in pictures:
            height_px, width_px = picture.image.shape[:2]
            name = f"site{settings.seed}-{picture.index + 1:06d}"
            row = {
                "id": picture.index + 1,
                "file_name": f"images/{name}.jpg",
                "width": width_px,
                "height": height_px,
                "flight": name,
                "m_per_px": round(picture.m_per_px, 5),
                "height_above_ground_m": round(float(picture.site_from_camera.translation_m[2]), 2),
                "ground": picture.ground,
                "thermal": picture.is_thermal,
            }
            atomic_write_bytes(
                partial / row["file_name"], jpeg_from_image(picture.image), durable=False
            )
            images.append(row)
            annotations += [box | {"id": len(annotations) + box["id"]} for box in picture.boxes]
            counted += sum(1 - box["iscrowd"] for box in picture.boxes)
            yield PicturesProgress(
                len(images), settings.pictures, counted, time.monotonic() - started
            )
        write_json(
            partial / PICTURES_MARK,
            {
                "info": info,
                "categories": coco_categories(),
                "images": images,
                "annotations": annotations,
            },
        )
