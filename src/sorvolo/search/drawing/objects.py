"""The things that stand on a simulated site: their sizes, and where they stand.

Every object is built in its own frame: x forward, y left, z up, metres, the origin on the ground under
its middle.
"""

from dataclasses import dataclass, replace
from enum import StrEnum

import cv2
import numpy as np

from sorvolo.geometry.arrays import Floats, ImageGray, ImageRGBA, Matrix3, PointsM, Vector3
from sorvolo.search.drawing.view import DrawnPatch, DrawnView, cut_out, map_view, sample_patches

_BOTH_SIDES = np.zeros(3)
_UP = np.array([0.0, 0.0, 1.0])


class ThingLabel(StrEnum):
    """What an object is to a detector; scenery is what stays and causes parallax."""

    PERSON = "person"
    CAR = "car"
    SMALL = "small object"
    TREE = "tree"
    HOUSE = "house"

    @property
    def is_target(self) -> bool:
        """Whether detectors look for it."""
        return self in (ThingLabel.PERSON, ThingLabel.CAR, ThingLabel.SMALL)


SMALL_KINDS = ("box", "big box", "suitcase", "metal suitcase", "bag", "tyre", "gas bottle")
"""The small objects of the thesis's Table 2.4."""

POSES = {
    "standing": (0.25, 0.4, 1.0),
    "walking": (0.5, 0.4, 1.0),
    "waving": (0.3, 0.5, 1.25),
    "crouching": (0.55, 0.4, 0.6),
    "sitting": (0.7, 0.5, 0.55),
    "lying": (1.1, 0.7, 0.16),
}
"""The kinds of people, each dressed in an own way: about how long, wide and high they are, as shares of their stature."""

_SMALL_SIZES_M = {  # length, width, height
    "box": (0.45, 0.35, 0.32),
    "big box": (0.95, 0.75, 0.7),
    "suitcase": (0.72, 0.48, 0.28),
    "metal suitcase": (0.55, 0.4, 0.2),
    "bag": (0.6, 0.36, 0.3),
    "tyre": (0.66, 0.66, 0.2),
    "gas bottle": (0.32, 0.32, 0.62),
}
_CAR_SIZES_M = {"hatchback": (4.0, 1.75, 1.48), "saloon": (4.6, 1.82, 1.45), "van": (5.2, 2.0, 2.3)}


@dataclass(frozen=True)
class Thing:
    """One object of the site: what it is and where it stands.

    `seed` draws its colours and textures; `velocity_m_s` (east, north) moves it through `east_m`,
    `north_m`, where it is at the middle of a flight; `sway_m` is how far the wind has pushed a crown. `up_m` is the
    ground's height there, which what moves keeps to by `climb_m_s`, the slope there.
    """

    id: int
    label: ThingLabel
    kind: str
    east_m: float
    north_m: float
    yaw_deg: float  # counter-clockwise from east
    size_m: tuple[float, float, float]  # length, width, height
    seed: int
    velocity_m_s: tuple[float, float] = (0.0, 0.0)
    sway_m: tuple[float, float] = (0.0, 0.0)
    up_m: float = 0.0
    climb_m_s: float = 0.0

    @property
    def is_moving(self) -> bool:
        """Whether it moves during a flight."""
        return self.velocity_m_s != (0.0, 0.0)

    @property
    def turn(self) -> Matrix3:
        """site_from_object rotation."""
        c, s = np.cos(np.radians(self.yaw_deg)), np.sin(np.radians(self.yaw_deg))
        return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])

    @property
    def reach_m(self) -> float:
        """Radius of the circle on the ground that it stands in."""
        return 0.5 * float(np.hypot(self.size_m[0], self.size_m[1]))

    def place_m(self, from_middle_s: float) -> Vector3:
        """Where it stands this long after the middle of the flight, (3,) in the site frame."""
        return np.array(
            [
                self.east_m + self.velocity_m_s[0] * from_middle_s,
                self.north_m + self.velocity_m_s[1] * from_middle_s,
                self.up_m + self.climb_m_s * from_middle_s,
            ]
        )

    def footprint_m(self, from_middle_s: float = 0.0) -> PointsM:
        """(N, 2) the outline of its base on the ground, counter-clockwise."""
        length, width, _ = self.size_m
        if self.label in (ThingLabel.PERSON, ThingLabel.TREE) or self.kind in (
            "tyre",
            "gas bottle",
        ):
            angle = np.linspace(0, 2 * np.pi, 16, endpoint=False)
            base = np.column_stack(
                [np.cos(angle) * length / 2, np.sin(angle) * width / 2, np.zeros(16)]
            )
        else:
            base = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * [
                length / 2,
                width / 2,
                0,
            ]
        return (base @ self.turn.T + self.place_m(from_middle_s))[:, :2]


@dataclass(frozen=True, eq=False)
class StandingPart:
    """An upright silhouette that always turns its face to the eye, as a trunk does."""

    foot_m: float  # height of its lower edge
    size_m: tuple[float, float]  # width, height
    texture: ImageRGBA

    def facing(self, place_m: Vector3, eye_m: Floats) -> DrawnPatch:
        """The patch as seen from `eye_m`, (4,) homogeneous."""
        away = eye_m[:2] - eye_m[3] * place_m[:2]
        length = float(np.hypot(away[0], away[1]))
        side = (
            np.array([-away[1], away[0], 0.0]) / length
            if length > 1e-6
            else np.array([1.0, 0.0, 0.0])
        )
        half = side * self.size_m[0] / 2
        foot = place_m + _UP * self.foot_m
        top = foot + _UP * self.size_m[1]
        corners = np.array([top - half, top + half, foot + half, foot - half])
        return DrawnPatch.spanned(corners, self.texture, _BOTH_SIDES)


@dataclass(frozen=True, eq=False)
class Limb:
    """A round part between two points of the object's frame, (2, 3), whose outline is the same from all around."""

    ends_m: PointsM
    width_m: float
    texture: ImageRGBA  # its top at the first end

    def facing(self, turn: Matrix3, place_m: Vector3, eye_m: Floats) -> DrawnPatch:
        """The patch as seen from `eye_m`, (4,) homogeneous: as long as the limb looks from there, and round ends."""
        start, end = self.ends_m @ turn.T + place_m
        sight = eye_m[:3] - eye_m[3] * (start + end) / 2
        sight = sight / np.linalg.norm(sight)
        along = (end - start) - sight * float((end - start) @ sight)
        length = float(np.linalg.norm(along))
        if length < 1e-6:  # seen along its axis: a disc
            along, length = (
                np.cross(sight, _UP if abs(sight[2]) < 0.9 else np.array([1.0, 0.0, 0.0])),
                0.0,
            )
        along = along / np.linalg.norm(along)
        half = np.cross(along, sight) * self.width_m / 2
        middle, reach = (start + end) / 2, along * (length + self.width_m) / 2
        top, bottom = middle - reach, middle + reach
        corners = np.array([top - half, top + half, bottom + half, bottom - half])
        return DrawnPatch.spanned(corners, self.texture, _BOTH_SIDES)


Part = DrawnPatch | StandingPart | Limb


@dataclass(frozen=True, eq=False)
class Body:
    """An object's parts in the order in which they are painted, in its own frame."""

    parts: tuple[Part, ...]

    def placed(self, turn: Matrix3, place_m: Vector3, eye_m: Floats) -> list[DrawnPatch]:
        """The patches where the object stands, for an eye at `eye_m`, (4,) homogeneous."""
        patches = []
        for part in self.parts:
            if isinstance(part, StandingPart):
                patches.append(part.facing(place_m, eye_m))
            elif isinstance(part, Limb):
                patches.append(part.facing(turn, place_m, eye_m))
            else:
                patches.append(part.moved(turn, place_m))
        return patches


@dataclass(frozen=True, eq=False)
class Light:
    """The day's light: `sun` is the unit vector towards it; `ambient` of the light comes from the sky."""

    sun: Vector3
    ambient: float = 0.42

    def shade(self, normal: Vector3) -> float:
        """Brightness of a face with this outward normal, where level ground has 1."""
        direct = (1 - self.ambient) * max(0.0, float(normal @ self.sun)) / float(self.sun[2])
        sky = self.ambient * (0.62 + 0.38 * max(0.0, float(normal[2])))
        return float(np.clip(sky + direct, 0.0, 1.35))


def new_size(label: ThingLabel, kind: str, rng: np.random.Generator) -> tuple[float, float, float]:
    """A likely length, width and height in metres."""
    if label is ThingLabel.PERSON:
        share = float(rng.uniform())  # one of ten is a child
        stature = 0.95 + 4.5 * share if share < 0.1 else 1.45 + 0.5 * share
        length, width, high = POSES[kind]
        return length * stature, width * stature, high * stature
    if label is ThingLabel.CAR:
        return _CAR_SIZES_M[kind]
    if label is ThingLabel.SMALL:
        return _SMALL_SIZES_M[kind]
    if label is ThingLabel.HOUSE:
        if kind == "flat roof":
            return float(rng.uniform(9, 15)), float(rng.uniform(7, 10)), float(rng.uniform(4, 8))
        return float(rng.uniform(8, 11)), float(rng.uniform(6, 7.5)), float(rng.uniform(4.6, 6.0))
    width = float(rng.uniform(2.4, 4.6)) if kind == "tree" else float(rng.uniform(0.8, 1.8))
    return width, width, width * float(rng.uniform(0.9, 1.5)) if kind == "tree" else width * 0.7


def new_kind(label: ThingLabel, rng: np.random.Generator) -> str:
    """A random kind of cars or small objects; people stand."""
    kinds = {ThingLabel.CAR: tuple(_CAR_SIZES_M), ThingLabel.SMALL: SMALL_KINDS}.get(
        label, ("standing",)
    )
    return kinds[int(rng.integers(len(kinds)))]


SHADOW_TINT = np.array([0.40, 0.44, 0.52], np.float32)
"""What the blue sky alone still lights."""


def own_shadow(thing: Thing, body: Body, light: Light, m_per_px: float) -> DrawnPatch:
    """The shadow of something that moves, as a dark patch on the ground around its place."""
    reach_m = thing.reach_m + thing.size_m[2] * float(np.hypot(*light.sun[:2]) / light.sun[2]) + 0.3
    side = max(8, int(np.ceil(2 * reach_m / m_per_px)))
    sun_view = map_view(
        -reach_m, reach_m, (2 * reach_m / side, 2 * reach_m / side), (side, side), light.sun
    )
    depth: ImageGray = np.zeros((side, side), np.uint8)
    cast_shadow(body.placed(thing.turn, np.zeros(3), sun_view.eye_m), sun_view, depth)
    depth[:] = cv2.GaussianBlur(depth, (0, 0), 0.7)
    texture = np.zeros((side, side, 4), np.uint8)
    texture[..., 3] = (depth * (1 - float(SHADOW_TINT.mean()))).astype(np.uint8)
    corners = np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]]) * reach_m
    return DrawnPatch.spanned(corners, texture, np.zeros(3))


def cast_shadow(patches: list[DrawnPatch], sun_view: DrawnView, depth: ImageGray) -> None:
    """Darken `depth`, in place, where the patches stop the sun; a face's back stops it as its front does."""
    two_sided = [replace(patch, normal=np.zeros(3)) for patch in patches]
    for (x0, y0, x1, y1), sample in sample_patches(sun_view, two_sided):
        np.maximum(depth[y0:y1, x0:x1], sample[..., 3], out=depth[y0:y1, x0:x1])


GROUND_LEVEL = 90.0
"""The ground's level of warmth in the pictures that are rendered."""

_UP_SIDES = np.zeros(3)
# how much warmer than the ground, in grey levels of the span that `GROUND_LEVEL` leaves; people always stand out
_WARMTH = {
    ThingLabel.PERSON: (35.0, 140.0),
    ThingLabel.CAR: (-45.0, 55.0),
    ThingLabel.SMALL: (-35.0, 40.0),
    ThingLabel.TREE: (-15.0, 25.0),
    ThingLabel.HOUSE: (-30.0, 45.0),
}
_LEAST_CONTRAST = 12.0  # of targets: what is as warm as the ground cannot be seen, nor be asked for


def warm_body(thing: Thing, body: Body, rng: np.random.Generator) -> Body:
    """The body with warmth for colour, in levels around `GROUND_LEVEL`: how warm it is drawn from its class's range."""
    low, high = _WARMTH[thing.label]
    warmth = float(rng.uniform(low, high))
    if thing.label.is_target and abs(warmth) < _LEAST_CONTRAST:
        warmth = float(np.copysign(_LEAST_CONTRAST, warmth))
    detail = float(
        rng.uniform(0.3, 0.8) if thing.label is ThingLabel.TREE else rng.uniform(0.05, 0.25)
    )
    mean = _mean_grey([part.texture for part in body.parts])
    parts: list[Part] = [
        replace(part, texture=_warmed(part.texture, GROUND_LEVEL + warmth, detail, mean))
        for part in body.parts
    ]
    if (
        thing.label is ThingLabel.PERSON and len(parts) > 2
    ):  # feet and clothes are cooler than the head
        for index, share in ((0, 0.6), (-1, 1.2)):
            texture = _warmed(
                body.parts[index].texture, GROUND_LEVEL + share * warmth, detail, mean
            )
            parts[index] = replace(parts[index], texture=texture)
    if thing.label is ThingLabel.CAR and rng.uniform() < 0.65:
        parts.insert(
            5, _engine(thing, GROUND_LEVEL + float(rng.uniform(30, 140)))
        )  # above the bonnet, below the cabin
    return Body(tuple(parts))


def _engine(thing: Thing, warmth: float) -> DrawnPatch:
    """A soft warm spot on the bonnet."""
    length, width, height = thing.size_m
    y, x = np.mgrid[-1:1:16j, -1:1:16j]
    alpha = np.clip(1.2 * (1 - np.hypot(x, y)), 0, 1).astype(np.float32)
    texture = cut_out(np.full((16, 16, 3), np.clip(warmth, 0, 255), np.uint8), alpha)
    z = 0.6 * height
    back, front, side = 0.16 * length, 0.48 * length, 0.42 * width
    corners: Floats = np.array(
        [[back, side, z], [front, side, z], [front, -side, z], [back, -side, z]]
    )
    return DrawnPatch.spanned(corners, texture, _UP_SIDES)


def _mean_grey(textures: list[ImageRGBA]) -> float:
    weight = sum(float(texture[..., 3].sum(dtype=np.int64)) for texture in textures) / 255
    return sum(float(texture[..., :3].sum(dtype=np.int64)) for texture in textures) / (
        3 * max(weight, 1.0)
    )


def _warmed(texture: ImageRGBA, warmth: float, detail: float, mean: float) -> ImageRGBA:
    """The texture at this warmth, what was brighter than `mean` a little warmer."""
    alpha = texture[..., 3].astype(np.float32) / 255
    grey = texture[..., :3].mean(axis=2)  # already multiplied by alpha
    value = np.clip((warmth - detail * mean) * alpha + detail * grey, 0, 255 * alpha)
    return np.dstack([value, value, value, texture[..., 3]]).round().astype(np.uint8)
