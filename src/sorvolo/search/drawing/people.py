"""People limb by limb: how they stand, walk, wave, crouch, sit or lie, and what they wear.

The skeleton is built in the object's frame (x forward, y left, z up) for a person of 1.75 m and scaled; proportions are
those of adults as drawn from life. Angles are drawn per person, so that no two of a kind look alike.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from sorvolo.geometry.arrays import Floats, ImageRGBA, Matrix3
from sorvolo.geometry.pose import rotation_from_vector
from sorvolo.search.drawing.objects import POSES, Light, Limb, Part, Thing
from sorvolo.search.drawing.view import cut_out

_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, eq=False)
class _Clothes:
    """Colours (3,) of what each part of the body shows, grey levels in daylight."""

    shirt: Floats
    sleeve: Floats
    forearm: Floats
    thigh: Floats
    shin: Floats
    shoe: Floats
    hair: Floats
    skin: Floats
    hat: Floats | None
    backpack: Floats | None
    skirt_m: float  # how wide the legs' upper halves are dressed, 0 for trousers


def build_person(
    thing: Thing, light: Light, texel_m: float, rng: np.random.Generator
) -> list[Part]:
    """The limbs of a person of one of the POSES, lowest first, the light from above painted in.

    `thing.size_m` gives the stature: its height divided by the pose's share of it, or its length for one who lies.
    """
    lying = thing.kind == "lying"
    stature_m = (
        thing.size_m[0] / POSES[thing.kind][0] if lying else thing.size_m[2] / POSES[thing.kind][2]
    )
    worn = _dressed(rng)
    limbs = _skeleton(thing.kind, worn, rng)
    ends = np.array([limb[0] for limb in limbs]) * stature_m / 1.75
    widths = np.array([limb[1] for limb in limbs]) * stature_m / 1.75
    if lying:
        ends = ends @ _about_y(90.0 * float(rng.choice((-1, 1)))).T
        ends[..., 2] *= 0.35  # limbs rest on the ground, whichever way they were stretched
        ends[..., 0] -= ends[..., 0].mean()
    ends[..., 2] -= (ends[..., 2].min(axis=1) - widths / 2).min()
    order = np.argsort(ends[..., 2].mean(axis=1), kind="stable")
    highest = float(ends[..., 2].max())
    parts: list[Part] = []
    for index in order:
        up = ends[index, :, 2].mean() / max(highest, 1e-6)
        # what lies low is shaded by what is above it, and a steep limb catches less of the light from above
        shade = light.shade(_UP) * (0.72 + 0.28 * up) * float(rng.uniform(0.92, 1.06))
        texture = _sleeve(ends[index], float(widths[index]), limbs[index][2] * shade, texel_m, rng)
        parts.append(Limb(ends[index], max(float(widths[index]), 1.2 * texel_m), texture))
    return parts


def _skeleton(
    pose: str, worn: _Clothes, rng: np.random.Generator
) -> list[tuple[Floats, float, Floats]]:
    """Ends (2, 3) in metres, width in metres and colour (3,) of each part, the hips at the origin."""
    lean_deg = {
        "crouching": rng.uniform(10, 50),
        "sitting": rng.uniform(-20, 35),
        "walking": rng.uniform(0, 10),
    }.get(pose, rng.normal(0, 4))
    upper = _about_y(lean_deg)
    stride_deg = float(rng.uniform(12, 32)) if pose == "walking" else 0.0
    limbs: list[tuple[Floats, float, Floats]] = []
    for side in (-1.0, 1.0):
        forward = side * stride_deg  # the left leg and the right arm swing forward together
        limbs += _leg(pose, side, forward, worn, rng)
        limbs += _arm(pose, side, -forward, upper, worn, rng)
    chest, neck = upper @ np.array([0.0, 0.0, 0.48]), upper @ np.array([0.0, 0.0, 0.58])
    shoulders = np.array([upper @ np.array([0.0, y, 0.5]) for y in (-0.14, 0.14)])
    limbs += [
        (
            np.array([[0.0, 0.0, 0.0], chest * 0.85]),
            0.31 * float(rng.uniform(0.9, 1.3)),
            worn.shirt,
        ),
        (shoulders, 0.2, worn.shirt),
    ]
    nod = upper @ _about_y(float(rng.normal(8, 12)))
    head = np.array([neck, neck + nod @ np.array([0.02, 0.0, 0.13])])
    limbs += [
        (head, 0.15, worn.skin),
        (head + nod @ np.array([-0.02, 0.0, 0.035]), 0.17, worn.hair),
    ]
    if worn.hat is not None:
        brim = np.array([head[1] + nod @ np.array([x, 0.0, 0.06]) for x in (-0.03, 0.04)])
        limbs.append((brim, 0.22, worn.hat))
    if worn.backpack is not None:
        pack = np.array([upper @ np.array([-0.2, 0.0, z]) for z in (0.12, 0.42)])
        limbs.append((pack, 0.28, worn.backpack))
    return limbs


def _leg(
    pose: str, side: float, forward_deg: float, worn: _Clothes, rng: np.random.Generator
) -> list[tuple[Floats, float, Floats]]:
    splay_deg = side * float(
        rng.uniform(0, 28) if pose in ("sitting", "crouching", "lying") else rng.uniform(0, 7)
    )
    thigh_deg, knee_deg = {
        "walking": (forward_deg, rng.uniform(5, 40) if forward_deg < 0 else rng.uniform(0, 12)),
        "crouching": (rng.uniform(75, 115), rng.uniform(110, 145)),
        "sitting": (rng.uniform(75, 120), rng.uniform(0, 110)),
        "lying": (
            rng.choice((0.0, 1.0)) * rng.uniform(0, 50),
            rng.choice((0.0, 1.0)) * rng.uniform(0, 80),
        ),
    }.get(pose, (rng.normal(0, 5), rng.uniform(0, 8)))
    hip = np.array([0.0, 0.09 * side, 0.0])
    knee = hip + 0.44 * _swung(float(thigh_deg), splay_deg)
    ankle = knee + 0.42 * _swung(float(thigh_deg - knee_deg), splay_deg)
    toes = ankle + np.array([0.17, 0.03 * side, -0.02])
    thigh = max(0.165, worn.skirt_m)
    return [
        (np.array([ankle, toes]), 0.095, worn.shoe),
        (np.array([knee, ankle]), 0.115, worn.shin),
        (np.array([hip, knee]), thigh, worn.thigh),
    ]


def _arm(
    pose: str,
    side: float,
    forward_deg: float,
    upper: Matrix3,
    worn: _Clothes,
    rng: np.random.Generator,
) -> list[tuple[Floats, float, Floats]]:
    out_deg, bend_deg = side * float(rng.uniform(2, 22)), float(rng.uniform(0, 70))
    swing_deg = forward_deg + float(rng.normal(0, 10))
    if pose == "waving" and (side > 0 or rng.uniform() < 0.6):
        swing_deg, out_deg = float(rng.uniform(120, 190)), side * float(rng.uniform(5, 45))
        bend_deg = float(rng.uniform(0, 50))
    elif pose == "lying":
        swing_deg, out_deg = float(rng.uniform(-20, 60)), side * float(rng.uniform(5, 120))
    elif pose in ("sitting", "crouching"):
        swing_deg = float(rng.uniform(-30, 80))
    shoulder = np.array([0.0, 0.19 * side, 0.5])
    elbow = shoulder + 0.29 * _swung(swing_deg, out_deg)
    hand = elbow + 0.33 * _swung(swing_deg + float(bend_deg), out_deg * 0.6)
    joints = np.array([shoulder, elbow, hand]) @ upper.T
    wrist = joints[1] + 0.8 * (joints[2] - joints[1])
    return [
        (np.array([wrist, joints[2]]), 0.08, worn.skin),
        (np.array([joints[1], wrist]), 0.09, worn.forearm),
        (joints[:2], 0.115, worn.sleeve),
    ]


def _swung(forward_deg: float, left_deg: float) -> Floats:
    """The unit vector of a limb that hangs down, swung forward and then to the left."""
    a, b = np.radians(forward_deg), np.radians(left_deg)
    return np.array([np.sin(a) * np.cos(b), np.sin(b), -np.cos(a) * np.cos(b)])


def _about_y(forward_deg: float) -> Matrix3:
    """The rotation that leans what stands upright forward."""
    return rotation_from_vector(np.array([0.0, np.radians(forward_deg), 0.0]))


def _dressed(rng: np.random.Generator) -> _Clothes:
    skin = np.array([212.0, 168, 138]) * rng.uniform(0.35, 1.05)
    hair = np.array([[52.0, 42, 34], [30, 26, 24], [112, 82, 54], [172, 142, 92], [150, 148, 144]])[
        rng.choice(5, p=(0.35, 0.3, 0.17, 0.08, 0.1))
    ] * rng.uniform(0.8, 1.2)
    shirt, legs = _cloth(rng), _legwear(rng)
    length = rng.uniform()
    sleeve = skin if length < 0.08 else shirt
    forearm = shirt if length > 0.5 else skin
    below = rng.uniform()
    thigh, shin = (legs, legs) if below < 0.68 else (legs, skin) if below < 0.92 else (skin, skin)
    if rng.uniform() < 0.06:  # high-visibility vest
        shirt = np.array([[212.0, 236, 40], [246, 120, 30]])[rng.integers(2)]
    if rng.uniform() < 0.07:  # a dress or a long coat
        thigh = shirt
    return _Clothes(
        shirt,
        sleeve,
        forearm,
        thigh,
        shin,
        np.array([1.0, 1, 1]) * rng.choice((30.0, 60.0, 200.0)),
        hair,
        skin,
        _cloth(rng) if rng.uniform() < 0.25 else None,
        _cloth(rng) if rng.uniform() < 0.2 else None,
        float(rng.uniform(0.22, 0.34)) if rng.uniform() < 0.08 else 0.0,
    )


def _cloth(rng: np.random.Generator) -> Floats:
    """A colour that people wear: half of them grey, black or white, a fifth loud."""
    kind = rng.uniform()
    if kind < 0.5:
        grey = rng.choice((rng.uniform(18, 70), rng.uniform(70, 170), rng.uniform(190, 240)))
        return np.clip(grey + rng.normal(0, 5, 3), 5, 250)
    saturation, value = (
        (rng.uniform(0.12, 0.5), rng.uniform(0.2, 0.85))
        if kind < 0.8
        else (rng.uniform(0.6, 1.0), rng.uniform(0.4, 0.95))
    )
    hsv = np.array([[[rng.uniform(0, 360), saturation, value]]], np.float32)
    return 255.0 * cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)[0, 0].astype(np.float64)


def _legwear(rng: np.random.Generator) -> Floats:
    """Denim, black and grey mostly, then khaki, then anything."""
    kind = rng.uniform()
    if kind < 0.7:
        return rng.uniform(22, 95) * np.array([rng.uniform(0.75, 1.0), 0.95, rng.uniform(1.0, 1.5)])
    if kind < 0.86:
        return np.array([188.0, 170, 138]) * rng.uniform(0.55, 1.1)
    return _cloth(rng)


def _sleeve(
    ends_m: Floats, width_m: float, colour: Floats, texel_m: float, rng: np.random.Generator
) -> ImageRGBA:
    """A limb's texture, darker to its sides, with round ends and a little grain; faint if below a texel."""
    length_m = float(np.linalg.norm(ends_m[1] - ends_m[0])) + width_m
    drawn_m = max(width_m, 1.2 * texel_m)
    rows, columns = (int(np.clip(round(2 * size / texel_m), 5, 96)) for size in (length_m, drawn_m))
    y, x = np.mgrid[0:rows, 0:columns]
    x, y = np.abs((x + 0.5) / columns * 2 - 1), np.abs((y + 0.5) / rows * 2 - 1)
    round_share = min(
        1.0, drawn_m / max(length_m, drawn_m)
    )  # of the half length that the round end takes
    y = np.clip((y - (1 - round_share)) / round_share, 0, 1)
    radius = np.hypot(x, y)
    alpha = np.clip((1 - radius) * columns / 2 + 0.5, 0, 1) * min(1.0, width_m / drawn_m)
    lit = (
        colour
        * (1.06 - 0.24 * (x**2)[..., None])
        * (1 + 0.05 * rng.standard_normal((rows, columns, 1)))
    )
    return cut_out(np.clip(lit, 0, 255).astype(np.uint8), alpha.astype(np.float32))
