"""The simulated site: its ground, what stands on it on each day, and each day's light."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import cv2
import numpy as np
from numpy.random import Generator

from sorvolo.errors import SettingsError
from sorvolo.geometry.arrays import Floats, Floats32, PointsM, Vector3, square
from sorvolo.geometry.sun import direction_from_angles, sun_direction
from sorvolo.geometry.units import DAY_NS
from sorvolo.lab.simulation.ground import GroundKind, GroundLayout, PaintedGround, paint_ground
from sorvolo.lab.simulation.ground_painting import GroundArea, GroundRaster
from sorvolo.lab.simulation.settings import (
    DEFAULT_ORIGIN,
    LaterSettings,
    SceneSettings,
    SimulationSettings,
    WeatherSettings,
)
from sorvolo.search.drawing.bodies import build_body
from sorvolo.search.drawing.noise import fractal
from sorvolo.search.drawing.objects import (
    SHADOW_TINT,
    SMALL_KINDS,
    Body,
    Light,
    Thing,
    ThingLabel,
    cast_shadow,
    new_kind,
    new_size,
    own_shadow,
)
from sorvolo.search.drawing.view import DrawnPatch, DrawnView, blend, map_view, sample_patches

# 2026-04-02 12:44 UTC at the default origin; elsewhere at the same solar time
_FIRST_NS = 1_775_133_840 * 10**9
_YEAR_DAYS = 365  # so long after a flight, at the same hour, the sun stands where it stood within 0.1 degrees
_STEP_NS = 60 * 10**9  # the minute in which a flight begins is drawn


# later flights in another light
_APART_DAYS, _DRAWN_DAYS = 84.0, 70.0  # between them, of which so many are drawn by the seed
_SUN_DEG = 28.0, 62.0  # the sun's height, least and most, where the day has them
_LEAST_SUN_DEG = 10.0  # in a polar night: shadows of a lower sun leave the ground that is drawn


@cache  # each frame asks, and the sun of a whole day is found minute by minute
def start_ns(settings: SimulationSettings, flight: int) -> int:
    """UTC of the first frame of a flight, counted from 1: later ones in another light begin weeks later at a drawn
    hour, those in the same light years later at the same hour."""
    origin = settings.scene.origin
    first_ns = _FIRST_NS - (
        round((origin.longitude_deg - DEFAULT_ORIGIN.longitude_deg) / 360 * DAY_NS / _STEP_NS)
        * _STEP_NS
    )
    if flight == 1:
        return first_ns
    if not settings.later.weather.has_other_light:
        return first_ns + (flight - 1) * _YEAR_DAYS * DAY_NS
    rng = np.random.default_rng([settings.seed, 11, flight])
    days = math.floor(_APART_DAYS * (flight - 1) - _DRAWN_DAYS * rng.random())
    times_ns = first_ns + days * DAY_NS + np.arange(-DAY_NS // 2, DAY_NS // 2, _STEP_NS)
    heights_deg = np.array(
        [math.degrees(math.asin(_sun(int(each), settings)[2])) for each in times_ns]
    )
    low_deg, high_deg = _SUN_DEG
    (possible,) = np.nonzero((heights_deg >= low_deg) & (heights_deg <= high_deg))
    return int(times_ns[rng.choice(possible) if len(possible) else heights_deg.argmax()])


def sun_of_flight(settings: SimulationSettings, flight: int) -> Vector3:
    """(3,) the unit vector to the sun, east, north and up, when a flight begins; never lower than 10 degrees."""
    sun = _sun(start_ns(settings, flight), settings)
    if sun[2] >= math.sin(math.radians(_LEAST_SUN_DEG)):
        return sun
    return direction_from_angles(math.degrees(math.atan2(sun[0], sun[1])), _LEAST_SUN_DEG)


def _sun(time_ns: int, settings: SimulationSettings) -> Vector3:
    origin = settings.scene.origin
    return sun_direction(time_ns, origin.latitude_deg, origin.longitude_deg)


_WAVES = 5  # that are summed to hills
# lengths of the waves, in heights of the flight: hills that a survey flies over
_SHORTEST = 2.5
_LONGEST = 5.0
_COARSE_PX = 4  # the hills are smooth: rays are followed on a coarse grid of the picture
_MOST_STEPS = 200  # of following a ray down
_NEAR_M = 1e-4  # to the ground: the ray has arrived


@dataclass(frozen=True, eq=False)
class Relief:
    """The ground's height: `middle_m` and K waves of `turns_m` (K, 2) radians a metre, `phases` and `heights_m` (K,).

    No waves: level ground.
    """

    turns_m: Floats
    phases: Floats
    heights_m: Floats
    middle_m: float = 0.0

    @classmethod
    def hills(cls, relief_m: float, flight_m: float, area: GroundArea, rng: Generator) -> "Relief":
        """Hills of `relief_m` from the lowest to the highest ground of an area, half of it above height 0."""
        if not relief_m:
            return LEVEL
        count = _WAVES
        lengths = flight_m * rng.uniform(_SHORTEST, _LONGEST, count)
        heading = rng.uniform(0, np.pi, count)
        turns = 2 * np.pi / lengths[:, None] * np.column_stack([np.cos(heading), np.sin(heading)])
        raw = cls(turns, rng.uniform(0, 2 * np.pi, count), rng.uniform(0.5, 1.0, count))
        east = np.linspace(area.west_m, area.east_m, 64)
        north = np.linspace(area.south_m, area.north_m, 64)
        up = raw.up_m(np.dstack(np.meshgrid(east, north)))
        scale = relief_m / np.ptp(up)
        return cls(
            turns, raw.phases, scale * raw.heights_m, -scale * float(up.min() + up.max()) / 2
        )

    @property
    def is_level(self) -> bool:
        """Whether the ground has no hills."""
        return not len(self.heights_m)

    @property
    def most_m(self) -> float:
        """No ground is higher than this."""
        return float(self.middle_m + self.heights_m.sum())

    @property
    def most_slope(self) -> float:
        """No ground is steeper, as height over way."""
        return float((self.heights_m * np.linalg.norm(self.turns_m, axis=1)).sum())

    def up_m(self, places_m: Floats) -> Floats:
        """(...,) heights of the ground at places (..., 2), east and north."""
        up = np.full(places_m.shape[:-1], self.middle_m)
        for turn, phase, height_m in zip(self.turns_m, self.phases, self.heights_m):
            up += height_m * np.sin(places_m @ turn + phase)
        return up

    def met(self, eye_m: Floats, rays_m: Floats) -> PointsM:
        """(..., 3) where rays from an eye, (3,), in directions (..., 3) first meet the ground; NaN above the horizon.

        Each step is as long as no slope could cross, so that a hill in front hides what lies behind it (Hart 1996).
        """
        with np.errstate(divide="ignore", invalid="ignore"):
            way = (self.most_m - eye_m[2]) / rays_m[..., 2]
        way[~((rays_m[..., 2] < 0) & (way >= 0))] = np.nan
        closing = self.most_slope * np.linalg.norm(rays_m[..., :2], axis=-1) - rays_m[..., 2]
        for _ in range(_MOST_STEPS if not self.is_level else 0):
            point = eye_m + rays_m * way[..., None]
            above_m = point[..., 2] - self.up_m(point[..., :2])
            way += above_m / closing
            if np.nanmax(np.abs(above_m), initial=0.0) < _NEAR_M:
                break
        return eye_m + rays_m * way[..., None]

    def seen(self, view: DrawnView) -> Floats32:
        """(height, width, 2) east and north of the ground at each pixel of a camera's view, far off at the horizon."""
        height, width = view.camera.height_px, view.camera.width_px
        columns, rows = (
            np.append(np.arange(0, side - 1, _COARSE_PX), side - 1) for side in (width, height)
        )
        rays = view.rays_in((0, 0, width, height))[np.ix_(rows, columns)]
        rays = (
            np.dstack([rays, np.ones(rays.shape[:2])]) @ np.linalg.inv(view.ray_from_site[:, :3]).T
        )
        met_m = np.nan_to_num(self.met(view.eye_m[:3], rays)[..., :2], nan=1e6).astype(np.float32)
        x, y = (
            np.interp(np.arange(side), at, np.arange(len(at))).astype(np.float32)
            for side, at in ((width, columns), (height, rows))
        )
        across, down = np.meshgrid(x, y)
        return cv2.remap(met_m, across, down, cv2.INTER_LINEAR)  # type: ignore[return-value]


LEVEL = Relief(np.zeros((0, 2)), np.zeros(0), np.zeros(0))
"""Ground without hills."""


_SPARE_M = 4.0  # of ground around what is seen
_LARGEST_GROUND_PX = 26e6  # pixels of painted ground, which bounds the memory


@dataclass(frozen=True, eq=False)
class World:
    """The site through all flights: its ground without shadows, its hills, and the things of each flight, in order."""

    ground: GroundRaster
    days: tuple[tuple[Thing, ...], ...]
    relief: Relief = LEVEL


@dataclass(frozen=True, eq=False)
class Day:
    """The site on the day of one flight: the ground with its static shadows, and all bodies ready to be seen.

    `gains` (3,) is the light's colour and strength; `cloud_shade` (0 = clear) is how dark clouds'
    shadows are. `shadows` holds the shadow patches of what moves, by object id.
    """

    ground: GroundRaster
    things: tuple[Thing, ...]
    bodies: dict[int, Body]
    shadows: dict[int, DrawnPatch]
    light: Light
    gains: Floats
    cloud_shade: float
    relief: Relief = LEVEL


def needed_area(settings: SimulationSettings, waypoints_m: Floats) -> GroundArea:
    """The ground that can come into sight from these waypoints, (N, 2), all flights' height and tilt included."""
    farthest_m = max(_reach_m(settings.of_flight(flight), flight) for flight in (1, 2))
    reach_m = _SPARE_M + 4 * settings.motion.drift_rms_m + farthest_m
    return GroundArea.around(waypoints_m, reach_m)


def _reach_m(settings: SimulationSettings, flight: int) -> float:
    """How far from the point below it the camera of a flight may see the ground."""
    camera = settings.imaging.camera
    height_factor = 1.0 if flight == 1 else settings.later.revisit.height_factor
    height_m = (
        settings.path.height_m * height_factor
        + 4 * settings.motion.height_rms_m
        + settings.scene.relief_m
    )
    across = 0.5 * camera.width_px / camera.fx_px, 0.5 * camera.height_px / camera.fy_px
    # barrel distortion shows more than the pinhole's angle: its rays are the truth
    corner = np.abs(camera.rays_from_pixels(camera.corners_px)[:, :2]).max(axis=0)
    half_angle = np.arctan(float(np.hypot(max(across[0], corner[0]), max(across[1], corner[1]))))
    tilt = np.radians(4.5 * settings.motion.tilt_rms_deg + settings.motion.camera_pitch_deg + 90)
    return height_m * float(np.tan(min(half_angle + tilt, np.radians(80))))


def build_world(
    settings: SimulationSettings, plans_m: Sequence[Floats], orthophoto: PaintedGround | None = None
) -> World:
    """The site that these flights need, from the settings' seed.

    `plans_m` are the flights' waypoints, (N, 2) each. Things are placed along the first, so that the first
    flight is the same however many follow. Raises SettingsError when a given orthophoto is missing, or too
    small for the flights.
    """
    area = needed_area(settings, np.concatenate(plans_m))
    if settings.scene.ground == "orthophoto":
        if orthophoto is None:
            raise SettingsError("the ground is an orthophoto, but none was given")
        painted = orthophoto
        given = painted.raster.area
        if (
            given.west_m > area.west_m
            or given.south_m > area.south_m
            or given.east_m < area.east_m
            or given.north_m < area.north_m
        ):
            have, need = given.size_m, area.size_m
            raise SettingsError(
                f"the orthophoto covers {have[0]:.0f} x {have[1]:.0f} m, but the flight sees up to"
                f" {need[0]:.0f} x {need[1]:.0f} m;"
                " fly lower or a shorter path, or give a larger orthophoto"
            )
    else:
        width_m, height_m = area.size_m
        # 2.5 cm, finer for finer pictures, and for coarse ones two thirds of what their days are drawn from
        picture_m, bound_m = settings.m_per_px, math.sqrt(width_m * height_m / _LARGEST_GROUND_PX)
        m_per_px = max(min(0.025, 0.72 * picture_m), 0.48 * picture_m, bound_m)
        painted = paint_ground(
            GroundKind(settings.scene.ground),
            area,
            m_per_px,
            np.random.default_rng([settings.seed, 1]),
        )
    relief = Relief.hills(
        settings.scene.relief_m,
        settings.path.height_m,
        area,
        np.random.default_rng([settings.seed, 10]),
    )
    # the things of the first flight: scenery first, then targets
    scene = settings.scene
    waypoints_m = plans_m[0]
    rng = np.random.default_rng([settings.seed, 2])
    things = list(scenery(scene.ground, painted.layout, rng)) if scene.has_scenery else []
    for label in _targets(scene):
        things.append(
            _place(label, len(things) + 1, things, painted.layout, waypoints_m, settings, rng)
        )
    days = [tuple(things)]
    for flight in range(2, settings.flights + 1):
        days.append(_next_day(days[0], painted.layout, plans_m[0], settings, flight))
    return World(
        painted.raster,
        tuple(tuple(_on_hills(thing, relief) for thing in day) for day in days),
        relief,
    )


def _on_hills(thing: Thing, relief: Relief) -> Thing:
    if relief.is_level:
        return thing
    places = np.array([thing.place_m(-1.0), thing.place_m(0.0), thing.place_m(1.0)])[:, :2]
    before_m, here_m, after_m = relief.up_m(places)
    return replace(thing, up_m=float(here_m), climb_m_s=float(after_m - before_m) / 2)


def build_day(world: World, settings: SimulationSettings, flight: int, m_per_px: float) -> Day:
    """The site as one flight, counted from 1, finds it, fine enough for pictures of `m_per_px` on the ground."""
    rng = np.random.default_rng([settings.seed, 3, flight])
    weather = settings.later.weather if flight > 1 else WeatherSettings(False, False, 0.0)
    light, gains = Light(sun_of_flight(settings, flight)), _gains(weather, rng)
    things = world.days[flight - 1]
    ground = world.ground.resampled(0.72 * m_per_px)
    if weather.snow:
        ground = _snowed_in(ground, weather.snow, np.random.default_rng([settings.seed, 9, flight]))
    if weather.wind_m:
        ground = _blown(ground, weather.wind_m, rng)
        # The things, trees moved by the wind
        things = tuple(
            replace(thing, sway_m=tuple(rng.normal(0, 2.0 * weather.wind_m, 2)))
            if thing.label is ThingLabel.TREE
            else thing
            for thing in things
        )
    bodies = {thing.id: build_body(thing, light, m_per_px) for thing in things}
    ground = _with_shadows(
        ground, [thing for thing in things if not thing.is_moving], bodies, light
    )
    shadows = {
        thing.id: own_shadow(thing, bodies[thing.id], light, m_per_px)
        for thing in things
        if thing.is_moving
    }
    cloud_shade = 0.38 if weather.has_clouds else 0.0
    return Day(ground, things, bodies, shadows, light, gains, cloud_shade, world.relief)


def _gains(weather: WeatherSettings, rng: Generator) -> Floats:
    """The camera's gains, (3,), on a day."""
    is_other = weather.has_other_light
    warmth = rng.uniform(-0.06, 0.06) if is_other else 0.0
    gains = np.array([1 + warmth, 1.0, 1 - warmth]) * (rng.uniform(0.82, 1.12) if is_other else 1.0)
    return gains * weather.brightness


def scenery(ground: str, layout: GroundLayout, rng: Generator) -> tuple[Thing, ...]:
    """The houses, trees and bushes of a layout, ids from 1; towns have flat roofs."""
    roof = "flat roof" if ground == GroundKind.URBAN else "gable roof"
    things: list[Thing] = []
    for kind, label, places in (
        (roof, ThingLabel.HOUSE, layout.houses),
        ("tree", ThingLabel.TREE, layout.trees),
        ("bush", ThingLabel.TREE, layout.bushes),
    ):
        for east, north, yaw in places:
            size = new_size(label, kind, rng)
            seed = int(rng.integers(2**31))
            place = float(east), float(north), float(yaw)
            things.append(Thing(len(things) + 1, label, kind, *place, size, seed))
    return tuple(things)


def is_free(thing: Thing, others: Sequence[Thing]) -> bool:
    """Whether a thing can stand where it is beside the others, a little air between them."""
    return all(
        np.hypot(thing.east_m - other.east_m, thing.north_m - other.north_m)
        > thing.reach_m * 0.8
        + other.reach_m * (0.9 if other.label is not ThingLabel.HOUSE else 1.05)
        + 0.6
        for other in others
    )


def _next_day(
    first: tuple[Thing, ...],
    layout: GroundLayout,
    waypoints_m: Floats,
    settings: SimulationSettings,
    flight: int,
) -> tuple[Thing, ...]:
    """The things of a later flight: some targets of the first are gone, some moved, some are new, some move."""
    rng = np.random.default_rng([settings.seed, 4, flight])
    # the first flight's things, some of its targets taken away, some moved
    targets = [thing for thing in first if thing.label.is_target]
    order = [targets[i].id for i in rng.permutation(len(targets))]
    removed = set(order[: settings.later.removed])
    shifted = set(order[settings.later.removed : settings.later.removed + settings.later.moved])
    today = [thing for thing in first if thing.id not in removed]
    for i, thing in enumerate(today):
        if thing.id in shifted:
            others = [other for other in today if other.id != thing.id]
            place = _place(thing.label, thing.id, others, layout, waypoints_m, settings, rng)
            today[i] = replace(
                thing, east_m=place.east_m, north_m=place.north_m, yaw_deg=place.yaw_deg
            )
    for thing_id, label in enumerate(_targets(settings.later), start=1000 * flight):
        today.append(_place(label, thing_id, today, layout, waypoints_m, settings, rng))
    return tuple(
        _set_off(thing, today, rng)
        if thing.label in (ThingLabel.PERSON, ThingLabel.CAR)
        and rng.uniform() < settings.scene.moving_share
        else thing
        for thing in today
    )


def _targets(wanted: SceneSettings | LaterSettings) -> list[ThingLabel]:
    """The people, cars and small objects that are asked for, one after another."""
    return (
        [ThingLabel.PERSON] * wanted.people
        + [ThingLabel.CAR] * wanted.cars
        + [ThingLabel.SMALL] * wanted.small_objects
    )


def _place(
    label: ThingLabel,
    thing_id: int,
    others: list[Thing],
    layout: GroundLayout,
    waypoints_m: Floats,
    settings: SimulationSettings,
    rng: Generator,
) -> Thing:
    """A new target near the flown path, free of what stands there already."""
    kind = (
        SMALL_KINDS[int(rng.integers(len(SMALL_KINDS)))]
        if label is ThingLabel.SMALL
        else new_kind(label, rng)
    )
    size = new_size(label, kind, rng)
    thing = Thing(thing_id, label, kind, 0.0, 0.0, 0.0, size, int(rng.integers(2**31)))
    half_strip_m = 0.4 * settings.imaging.height_px * settings.m_per_px
    near_path = [
        place
        for place in layout.parkings
        if _distance_to_path(place[:2], waypoints_m) < half_strip_m
    ]
    for attempt in range(400):
        if label is ThingLabel.CAR and len(near_path) and attempt < 100:
            east, north, yaw = near_path[int(rng.integers(len(near_path)))]
            yaw = yaw + 180 * rng.integers(2) + rng.normal(0, 1.5)
        else:
            leg = int(rng.integers(len(waypoints_m) - 1))
            along = waypoints_m[leg] + rng.uniform(0.03, 0.97) * (
                waypoints_m[leg + 1] - waypoints_m[leg]
            )
            east, north = along + rng.uniform(-half_strip_m, half_strip_m, 2)
            yaw = rng.uniform(0, 360)
        thing = replace(thing, east_m=float(east), north_m=float(north), yaw_deg=float(yaw))
        if is_free(thing, others):
            break
    return thing  # on a crowded site the last try stands: two boxes may touch


def _set_off(thing: Thing, others: list[Thing], rng: Generator) -> Thing:
    """The thing on its way: a person walks anywhere, a car drives straight on, where no scenery is in the way."""
    is_car = thing.label is ThingLabel.CAR
    speed = rng.uniform(2.0, 4.0) if is_car else rng.uniform(0.7, 1.5)
    for _ in range(30):
        yaw = thing.yaw_deg if is_car else rng.uniform(0, 360)
        direction = np.array([np.cos(np.radians(yaw)), np.sin(np.radians(yaw))])
        ahead = (
            np.array([[thing.east_m, thing.north_m]])
            + direction * np.linspace(-12, 12, 13)[:, None] * speed / 1.5
        )
        if all(
            np.hypot(ahead[:, 0] - other.east_m, ahead[:, 1] - other.north_m).min()
            > thing.reach_m + other.reach_m
            for other in others
            if not other.label.is_target
        ):
            velocity = (float(direction[0] * speed), float(direction[1] * speed))
            kind = thing.kind if is_car else "walking"
            return replace(thing, kind=kind, yaw_deg=float(yaw), velocity_m_s=velocity)
    return thing


def _distance_to_path(point_m: Floats, waypoints_m: Floats) -> float:
    start, along = waypoints_m[:-1], np.diff(waypoints_m, axis=0)
    share = np.clip(((point_m - start) * along).sum(axis=1) / (along**2).sum(axis=1), 0, 1)
    return float(np.hypot(*(start + share[:, None] * along - point_m).T).min())


def _blown(ground: GroundRaster, wind_m: float, rng: Generator) -> GroundRaster:
    """The ground after its plants have moved by about `wind_m`, each tuft its own way."""
    if not ground.vegetation.any():
        return ground
    shape = ground.rgb.shape[:2]
    rows, columns = shape
    # a kerb beside grass does not bend with it
    plants = cv2.erode(
        ground.vegetation,
        square(3),
        iterations=max(1, round(0.06 / ground.m_per_px[0])),
    )
    weight = cv2.GaussianBlur(plants, (0, 0), 1.5).astype(np.float32) / 255
    moved = np.empty_like(ground.rgb)
    push = [
        weight
        * fractal(rng, shape, ground.m_per_px[0], (0.4, 1.2), (0.8, 0.6))
        * np.float32(wind_m / ground.m_per_px[0])
        for _ in range(2)
    ]
    x = np.arange(columns, dtype=np.float32)[None, :]
    for top in range(0, rows, 512):  # a map of the whole raster would be needlessly large
        end = min(top + 512, rows)
        y = np.arange(top, end, dtype=np.float32)[:, None]
        moved[top:end] = cv2.remap(
            ground.rgb,
            x + push[0][top:end],
            y + push[1][top:end],
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
    return replace(ground, rgb=moved)


def _snowed_in(ground: GroundRaster, share: float, rng: Generator) -> GroundRaster:
    """The ground with snow on about this share of it, almost without texture; what stands on it stays bare."""
    shape = ground.rgb.shape[:2]
    drifts = fractal(rng, shape, ground.m_per_px[0], (0.5, 2.0, 6.0), (0.4, 0.8, 1.0))
    depth = (
        np.clip(0.5 + 2.0 * (drifts - np.float32(np.quantile(drifts, 1 - share))), 0, 1)
        if share < 1
        else 1.0
    )
    white = 226 + 5 * fractal(rng, shape, ground.m_per_px[0], (0.05, 0.3, 1.5), (0.6, 0.8, 1.0))
    cover = np.broadcast_to(np.float32(depth), shape)[..., None]
    rgb = ground.rgb * (1 - cover) + white[..., None] * cover
    return replace(ground, rgb=np.clip(rgb, 0, 255).astype(np.uint8))


def _with_shadows(
    ground: GroundRaster, things: list[Thing], bodies: dict[int, Body], light: Light
) -> GroundRaster:
    height, width = ground.rgb.shape[:2]
    depth = np.zeros((height, width), np.uint8)
    sun_view = map_view(ground.west_m, ground.north_m, ground.m_per_px, (width, height), light.sun)
    for thing in things:
        # the ground around is as high as it: its shadow begins there
        foot = np.append(thing.place_m(0.0)[:2], 0.0)
        cast_shadow(bodies[thing.id].placed(thing.turn, foot, sun_view.eye_m), sun_view, depth)
    if not depth.any():
        return ground
    # the sun is no point
    depth[:] = cv2.GaussianBlur(depth, (0, 0), max(0.6, 0.03 / ground.m_per_px[0]))
    rgb = ground.rgb.copy()
    for top in range(0, height, 512):
        part = slice(top, top + 512)
        share = depth[part, :, None].astype(np.float32) / 255
        rgb[part] = (rgb[part] * (1 - share * (1 - SHADOW_TINT))).astype(np.uint8)
    return replace(ground, rgb=rgb)


def orthophoto(day: Day) -> GroundRaster:
    """The day's ground seen straight from above, with everything that stands still on it."""
    rgb = day.ground.rgb.copy()
    height, width = rgb.shape[:2]
    view = map_view(day.ground.west_m, day.ground.north_m, day.ground.m_per_px, (width, height))
    for thing in sorted(day.things, key=lambda each: each.size_m[2]):
        if not thing.is_moving:
            patches = day.bodies[thing.id].placed(thing.turn, thing.place_m(0.0), view.eye_m)
            for window, sample in sample_patches(view, patches):
                blend(rgb, window, sample)
    return replace(day.ground, rgb=rgb)
