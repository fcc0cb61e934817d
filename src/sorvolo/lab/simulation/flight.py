"""One simulated flight: frames, telemetry and the truth, from memory; a source of frames like any other."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from sorvolo.errors import SettingsError
from sorvolo.geometry.arrays import Floats, ImageRGB, TimesNs
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.geodesy import LocalFrame
from sorvolo.geometry.homography import apply_homography, site_from_image_homography
from sorvolo.geometry.pose import Pose
from sorvolo.lab.simulation.ground import PaintedGround
from sorvolo.lab.simulation.path import (
    LEAD_S,
    FlownPath,
    Observation,
    fly,
    observe,
    path_of_flight,
    planned_waypoints,
)
from sorvolo.lab.simulation.rendering import render
from sorvolo.lab.simulation.settings import TELEMETRY_FORMATS, SimulationSettings
from sorvolo.lab.simulation.world import Day, World, build_day, build_world, start_ns
from sorvolo.search.drawing.bodies import build_body
from sorvolo.search.drawing.noise import SmoothSeries, layer, smooth_series
from sorvolo.search.drawing.objects import Body, Thing
from sorvolo.search.drawing.view import DrawnView, RaysF32, camera_view, ray_grid, remapped
from sorvolo.survey.flight import Frame, Telemetry, no_telemetry

_CLOUD_CELL_M = 7.0  # of ground for a cell of the clouds' shade
_CLOUD_STEP_PX = 16  # clouds are soft: their shade is computed on a coarse grid of the picture


@dataclass(frozen=True, eq=False)
class _Imaging:
    """What the camera does to pictures during this flight."""

    rays: RaysF32
    vignette: NDArray[np.float32]
    noise: NDArray[np.float32]
    exposure: SmoothSeries
    white_balance: tuple[SmoothSeries, SmoothSeries]
    clouds: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class SimulatedFlight:
    """A flight over a world whose every pose is known; `number` counts from 1, `settings` have its own camera.

    With `settings.output.photos` its frames are photos at the wanted overlap, else a video's at the
    wanted rate.
    """

    settings: SimulationSettings
    number: int
    world: World
    day: Day
    path: FlownPath
    imaging: _Imaging
    observations: dict[str, Observation]

    @property
    def name(self) -> str:
        """flight1, flight2 ..."""
        return f"flight{self.number}"

    @property
    def camera(self) -> Camera:
        """The true camera."""
        return self.settings.imaging.camera

    @property
    def site(self) -> LocalFrame:
        """WGS84 to the site's metres and back; up = 0 is the ground."""
        return LocalFrame(self.settings.scene.origin)

    @cached_property
    def started_ns(self) -> int:
        """UTC time of the first frame."""
        return start_ns(self.settings, self.number)

    @cached_property
    def frame_times_s(self) -> Floats:
        """(N,) exact times of the frames since the first one."""
        return _frame_times_s(self.settings, self.path)

    @property
    def frame_times_ns(self) -> TimesNs:
        """(N,) the frames' UTC times."""
        return self.started_ns + np.round(self.frame_times_s * 1e9).astype(np.int64)

    def __len__(self) -> int:
        return len(self.frame_times_s)

    @cached_property
    def true_poses(self) -> tuple[Pose, ...]:
        """site_from_camera of every frame."""
        return tuple(self.path.pose(float(time_s)) for time_s in self.frame_times_s)

    @property
    def from_middle_s(self) -> Floats:
        """(N,) the frames' times since the middle of the flight: moving things are where they started there."""
        return self.frame_times_s - self.path.duration_s / 2

    def frame_name(self, index: int) -> str:
        """The photo's file name, or the frame's index in the video as text."""
        return f"IMG_{index + 1:04d}.jpg" if self.settings.output.photos else str(index)

    def view(self, index: int) -> DrawnView:
        """How the camera sees the site at this frame."""
        return camera_view(self.camera, self.true_poses[index], self.imaging.rays)

    def frame(self, index: int) -> Frame:
        """One frame; the same one whenever and in whatever order it is asked for."""
        image = render(
            self.day, self.view(index), self.true_poses[index], float(self.from_middle_s[index])
        )
        image = self._as_recorded(image, index)
        return Frame(index, self.frame_name(index), int(self.frame_times_ns[index]), image)

    def frames(self, every: int = 1) -> Iterator[Frame]:
        """The frames in order of time, or each `every`-th of them."""
        for index in range(0, len(self), every):
            yield self.frame(index)

    def telemetry(self, format_name: str | None = None) -> Telemetry:
        """What was recorded, in the format's own columns; by default that of the photos or the primary format."""
        observation = self.observation(format_name)
        return no_telemetry() if observation is None else observation.telemetry

    def observation(self, format_name: str | None = None) -> Observation | None:
        """The telemetry with what is known of its faults; None for a flight without.

        Raises SettingsError for a format that this flight did not record.
        """
        if format_name is None:
            return next(iter(self.observations.values()), None)
        if format_name not in self.observations:
            recorded = ", ".join(self.observations) or "none"
            raise SettingsError(
                f"{self.name} recorded no {format_name} telemetry; it recorded {recorded}"
            )
        return self.observations[format_name]

    @cached_property
    def before(self) -> tuple[tuple[Thing, ...], dict[int, Body]]:
        """The things of the first flight and their bodies, as they would look on this flight's day."""
        today = {thing.id: thing for thing in self.day.things}
        m_per_px = self.path.height_m / self.camera.fx_px
        first = tuple(
            today[thing.id] if not has_changed(thing, today.get(thing.id)) else thing
            for thing in self.world.days[0]
        )
        bodies = {
            thing.id: (
                self.day.bodies[thing.id]
                if today.get(thing.id) is thing
                else build_body(thing, self.day.light, m_per_px)
            )
            for thing in first
        }
        return first, bodies

    def _as_recorded(self, image: ImageRGB, index: int) -> ImageRGB:
        settings, imaging = self.settings.imaging, self.imaging
        image = self._blurred(image, index)
        time_s = float(self.frame_times_s[index])
        brightness = np.exp(float(imaging.exposure(time_s))) * self.day.gains
        balance = np.exp(
            [float(imaging.white_balance[0](time_s)), 0.0, float(imaging.white_balance[1](time_s))]
        )
        shade = (
            imaging.vignette
            if self.day.cloud_shade == 0
            else imaging.vignette * self._cloud_light(index)
        )
        gains = cv2.merge([shade * np.float32(gain) for gain in brightness * balance])
        exposed = cv2.multiply(image, gains, dtype=cv2.CV_32F)
        if settings.noise == 0:
            return np.clip(np.round(exposed), 0, 255).astype(np.uint8)
        rng = np.random.default_rng([self.settings.seed, 6, self.number, index])
        height, width = image.shape[:2]
        y = rng.integers(0, imaging.noise.shape[0] - height + 1)
        x = rng.integers(0, imaging.noise.shape[1] - width + 1)
        noisy = cv2.add(exposed, imaging.noise[y : y + height, x : x + width], dtype=cv2.CV_8U)
        return np.asarray(noisy, np.uint8)

    def _blurred(self, image: ImageRGB, index: int) -> ImageRGB:
        """Motion blur about the middle of the exposure, which is the frame's time."""
        exposure_s = self.settings.imaging.exposure_s
        if exposure_s == 0:
            return image
        time_s, camera = float(self.frame_times_s[index]), self.camera
        middle = np.array([[camera.cx_px, camera.cy_px]])
        ground = apply_homography(
            site_from_image_homography(camera, self.true_poses[index]), middle
        )
        point = np.column_stack([ground, [0.0]])
        begun, ended = (self.path.pose(time_s + side * exposure_s / 2) for side in (-1, 1))
        start, end = (
            camera.pixels_from_points(each.inverse().apply(point))[0] for each in (begun, ended)
        )
        moved = end - start
        if np.hypot(*moved) < 0.3:
            return image
        return np.asarray(cv2.filter2D(image, -1, line_kernel(moved)), np.uint8)

    def _cloud_light(self, index: int) -> NDArray[np.float32]:
        """(height, width) how much light clouds leave on the ground at each pixel."""
        camera, pose = self.camera, self.true_poses[index]
        rays = np.ascontiguousarray(self.imaging.rays[::_CLOUD_STEP_PX, ::_CLOUD_STEP_PX])
        rays = np.dstack([rays, np.ones(rays.shape[:2], np.float32)]) @ pose.rotation.T.astype(
            np.float32
        )
        ground = pose.translation_m[:2] - rays[..., :2] / rays[..., 2:] * pose.translation_m[2]
        drift = np.array([2.2, 1.1]) * float(self.from_middle_s[index])
        cells = ((ground - drift) / _CLOUD_CELL_M + np.array(self.imaging.clouds.shape) / 2).astype(
            np.float32
        )
        thickness = remapped(self.imaging.clouds, cells, cv2.BORDER_WRAP)
        light = 1 - np.float32(self.day.cloud_shade) * np.clip(1.1 * thickness - 0.1, 0, 1)
        grown = cv2.resize(
            light, (camera.width_px, camera.height_px), interpolation=cv2.INTER_LINEAR
        )
        return np.asarray(grown, np.float32)


def simulate_flights(
    settings: SimulationSettings, orthophoto: PaintedGround | None = None
) -> Iterator[SimulatedFlight]:
    """The settings' flights over one site, built when they are asked for.

    Raises SettingsError when the ground is an orthophoto that is missing or too small.
    """
    plans = [
        path_of_flight(settings.path, settings.later, number)
        for number in range(1, settings.flights + 1)
    ]
    world = build_world(settings, [planned_waypoints(plan) for plan in plans], orthophoto)
    for number, plan in enumerate(plans, start=1):
        own = settings.of_flight(number)
        rng = np.random.default_rng([settings.seed, 5, number])
        path = fly(plan, settings.motion, rng)
        day = build_day(world, settings, number, plan.height_m / own.imaging.camera.fx_px)
        imaging = _set_up(own, path, rng)
        yield SimulatedFlight(
            own, number, world, day, path, imaging, _observe_all(own, path, number)
        )


def simulate_flight(
    settings: SimulationSettings, orthophoto: PaintedGround | None = None
) -> SimulatedFlight:
    """The first flight alone, for tests and benchmarks."""
    return next(simulate_flights(replace(settings, flights=1), orthophoto))


def has_changed(before: Thing, now: Thing | None) -> bool:
    """Whether a thing of the first flight is gone, stands elsewhere or moves now."""
    if now is None or now.is_moving or before.is_moving:
        return True
    return (before.east_m, before.north_m, before.yaw_deg) != (now.east_m, now.north_m, now.yaw_deg)


def _frame_times_s(settings: SimulationSettings, path: FlownPath) -> Floats:
    if settings.output.photos:
        camera = settings.imaging.camera
        step_m = (
            (1 - settings.output.photo_overlap) * camera.height_px / camera.fy_px * path.height_m
        )
        step_s = step_m / settings.path.speed_m_s
    else:
        step_s = 1 / settings.imaging.fps
    return np.arange(int(np.floor(path.duration_s / step_s + 1e-9)) + 1, dtype=np.float64) * step_s


def _observe_all(
    settings: SimulationSettings, path: FlownPath, number: int
) -> dict[str, Observation]:
    site = LocalFrame(settings.scene.origin)
    started_ns = start_ns(settings, number)
    observations: dict[str, Observation] = {}
    if settings.output.photos and settings.output.telemetry != "none":
        rng = np.random.default_rng([settings.seed, 8, number, 99])
        times_s = _frame_times_s(settings, path)
        observations["photos"] = observe(
            path, site, started_ns, settings.sensor, "photos", rng, times_s
        )
    for format_name in settings.output.formats:
        rng = np.random.default_rng(
            [settings.seed, 8, number, TELEMETRY_FORMATS.index(format_name)]
        )
        observations[format_name] = observe(
            path, site, started_ns, settings.sensor, format_name, rng
        )
    return observations


def _set_up(settings: SimulationSettings, path: FlownPath, rng: np.random.Generator) -> _Imaging:
    imaging, camera = settings.imaging, settings.imaging.camera
    span = (-LEAD_S, path.duration_s + LEAD_S)
    rays = ray_grid(camera)
    vignette = 1 / (1 + 0.22 * (rays**2).sum(axis=2))
    spare = 96  # each frame takes another window of one large noise picture
    noise = rng.standard_normal(
        (camera.height_px + spare, camera.width_px + spare, 3), dtype=np.float32
    )
    exposure = smooth_series(rng, *span, 6.0, imaging.exposure_drift)
    balance = (
        smooth_series(rng, *span, 12.0, imaging.white_balance_drift),
        smooth_series(rng, *span, 12.0, imaging.white_balance_drift),
    )
    clouds = layer(rng, (256, 256), 4.0) + 0.35 * layer(rng, (256, 256), 1.6)
    return _Imaging(
        rays,
        vignette.astype(np.float32),
        noise * np.float32(imaging.noise),
        exposure,
        balance,
        clouds,
    )


def line_kernel(moved_px: Floats) -> NDArray[np.float32]:
    """The blur of a point that moves evenly along `moved_px`, (2,), symmetric about its middle."""
    steps = max(8, int(8 * np.hypot(*moved_px)))
    half = int(np.ceil(np.abs(moved_px).max() / 2)) + 1
    kernel = np.zeros((2 * half + 1, 2 * half + 1), np.float32)
    for share in (np.arange(steps) + 0.5) / steps - 0.5:
        x, y = moved_px * share + half
        column, row = int(np.floor(x)), int(np.floor(y))
        right, down = x - column, y - row
        kernel[row, column] += (1 - right) * (1 - down)
        kernel[row, column + 1] += right * (1 - down)
        kernel[row + 1, column] += (1 - right) * down
        kernel[row + 1, column + 1] += right * down
    return kernel / kernel.sum()
