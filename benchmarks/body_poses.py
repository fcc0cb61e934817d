"""How people stand, walk, sit, crouch and lie: directions of bones, drawn at random.

Directions are (left, up, forward); left and right limbs mirror each other. Frames: `BodyModel.posed`.
"""

import numpy as np

from sorvolo.geometry.arrays import Floats

Directions = dict[str, Floats]
_SIDES = (("l", 1.0), ("r", -1.0))


def drawn_pose(rng: np.random.Generator) -> tuple[Directions, Floats]:
    """Bones' directions and how the whole body is turned (3, 3)."""
    kinds = (_standing, _walking, _sitting, _on_the_ground, _crouching, _kneeling, _bending, _lying)
    kind = kinds[int(rng.choice(len(kinds), p=[0.3, 0.26, 0.1, 0.08, 0.06, 0.04, 0.06, 0.1]))]
    directions, lean = kind(rng)
    return {name: each + rng.normal(0, 0.06, 3) for name, each in directions.items()}, lean


def _standing(rng: np.random.Generator) -> tuple[Directions, Floats]:
    wide = rng.uniform(0.0, 0.25)
    calf = (wide, -1, -0.05)
    legs = _legs(
        (wide, -1, rng.uniform(-0.08, 0.1)), calf, (wide, -1, rng.uniform(-0.1, 0.08)), calf
    )
    return legs | _upright(rng) | _arms(rng), np.eye(3)


def _walking(rng: np.random.Generator) -> tuple[Directions, Floats]:
    step = float(rng.uniform(-1, 1)) * rng.uniform(0.3, 0.75)
    left, right = step, -step
    legs = {}
    for (side, sign), swing in zip(_SIDES, (left, right)):
        legs[f"thigh_{side}"] = np.array([0.05 * sign, -1, swing * (0.9 if swing > 0 else 0.6)])
        legs[f"calf_{side}"] = np.array([0.04 * sign, -1, swing * (0.5 if swing > 0 else 1.6)])
    arms = _arms(rng)
    if rng.random() < 0.75:
        for (side, sign), swing in zip(_SIDES, (right, left)):
            arms[f"upperarm_{side}"] = np.array([0.25 * sign, -1, swing * 0.8])
            arms[f"lowerarm_{side}"] = np.array(
                [0.1 * sign, -1, swing * 0.8 + rng.uniform(0.2, 0.8)]
            )
    return legs | _upright(rng, forward=rng.uniform(0, 0.25)) | arms, np.eye(3)


def _sitting(rng: np.random.Generator) -> tuple[Directions, Floats]:
    wide = rng.uniform(0.05, 0.4)
    legs = _legs((wide, -0.15, 1), (wide / 2, -1, rng.uniform(-0.3, 0.5)))
    return legs | _upright(rng, forward=rng.uniform(-0.3, 0.5)) | _arms(rng), np.eye(3)


def _on_the_ground(rng: np.random.Generator) -> tuple[Directions, Floats]:
    wide = rng.uniform(0.05, 0.5)
    stretched = ((wide, 0.1, 1), (wide, -0.15, 1))
    bent = ((wide, rng.uniform(0.4, 1), 1), (wide / 2, -1, rng.uniform(0, 0.8)))
    crossed = ((0.9, 0.1, 0.8), (-0.9, -0.2, 0.3))
    options = (stretched, bent, crossed)
    left, right = rng.integers(3, size=2)
    if rng.random() < 0.7:
        right = left
    trunk = _upright(rng, forward=rng.uniform(-0.5, 0.6))
    return _legs(*options[left], *options[right]) | trunk | _arms(rng), np.eye(3)


def _crouching(rng: np.random.Generator) -> tuple[Directions, Floats]:
    wide = rng.uniform(0.1, 0.6)
    legs = _legs((wide, rng.uniform(-0.1, 0.4), 1), (wide / 2, -1, -0.7))
    return legs | _upright(rng, forward=rng.uniform(0.2, 1.0)) | _arms(rng, reaching=True), np.eye(
        3
    )


def _kneeling(rng: np.random.Generator) -> tuple[Directions, Floats]:
    legs = _legs((0.15, -1, rng.uniform(-0.1, 0.4)), (0.1, -0.12, -1))
    if rng.random() < 0.4:
        legs |= {"thigh_l": np.array([0.2, -0.1, 1]), "calf_l": np.array([0.1, -1, 0])}
    return legs | _upright(rng, forward=rng.uniform(0, 1.6)) | _arms(rng, reaching=True), np.eye(3)


def _bending(rng: np.random.Generator) -> tuple[Directions, Floats]:
    wide = rng.uniform(0.05, 0.3)
    legs = _legs((wide, -1, rng.uniform(0, 0.4)), (wide, -1, rng.uniform(-0.3, 0)))
    return legs | _upright(rng, forward=rng.uniform(0.6, 2.5)) | _arms(rng, reaching=True), np.eye(
        3
    )


def _lying(rng: np.random.Generator) -> tuple[Directions, Floats]:
    """On the back, on the belly or on a side, limbs anyhow."""
    legs = {}
    for side, sign in _SIDES:
        drawn_up, bent = (
            rng.uniform(-0.1, 0.9) * (rng.random() < 0.5),
            rng.uniform(0, 0.9) * (rng.random() < 0.5),
        )
        legs[f"thigh_{side}"] = np.array([sign * rng.uniform(-0.05, 0.5), -1, drawn_up])
        legs[f"calf_{side}"] = np.array([sign * rng.uniform(-0.2, 0.3), -1, -bent])
    roll = rng.choice([0.0, np.pi, np.pi / 2, -np.pi / 2]) + rng.normal(0, 0.15)
    about_y = np.array(
        [[np.cos(roll), 0, np.sin(roll)], [0, 1, 0], [-np.sin(roll), 0, np.cos(roll)]]
    )
    down = np.array(
        [[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]
    )  # the face, which looked forward, looks down or up
    pitch = down if rng.random() < 0.5 else down.T
    return legs | _upright(rng) | _arms(rng), pitch @ about_y


def _legs(
    thigh: tuple, calf: tuple, right_thigh: tuple | None = None, right_calf: tuple | None = None
) -> Directions:
    """Both legs; the right ones mirrored, and as the left ones where they are not given."""
    mirror = np.array([-1.0, 1, 1])
    return {
        "thigh_l": np.array(thigh, float),
        "calf_l": np.array(calf, float),
        "thigh_r": mirror * (right_thigh or thigh),
        "calf_r": mirror * (right_calf or calf),
    }


def _upright(rng: np.random.Generator, forward: float = 0.0) -> Directions:
    """The trunk, leaning forward by the tangent `forward` in all, and the head."""
    aside = rng.normal(0, 0.08)
    return {
        "spine_01": np.array([aside, 1, forward / 2]),
        "spine_02": np.array([aside, 1, forward / 3]),
        "spine_03": np.array([0, 1, forward / 4 + 0.05]),
        "neck_01": np.array([rng.normal(0, 0.1), 1, rng.uniform(0.1, 0.5)]),
        "head": np.array([rng.normal(0, 0.15), 1, rng.uniform(-0.2, 0.5)]),
    }


def _arms(rng: np.random.Generator, *, reaching: bool = False) -> Directions:
    """Each arm in a way of its own, or both alike; `reaching` ones go forward and down."""
    ways = (
        ((0.25, -1, 0), (0.1, -1, 0.25)),
        ((0.3, -1, -0.05), (-0.3, 0.1, 1)),
        ((0.3, -1, 0.2), (-0.5, 0.6, 0.9)),
        ((0.45, -1, -0.25), (-0.15, -0.8, 0.6)),
        ((0.2, -1, 0.2), (-1, 0.1, 0.5)),
        ((0.7, -0.8, -0.2), (-0.7, -0.5, 0.4)),
        ((0.1, -0.3, 1), (0, 0, 1)),
        ((1, 0.1, 0), (1, 0.2, 0.2)),
        ((0.5, 1, 0.1), (-0.1, 1, 0.1)),
        ((0.7, 0.4, 0.3), (-0.2, 1, 0)),
    )
    shares = np.array([5, 3, 2, 2, 1.5, 1.5, 1, 1, 1, 0.7])
    if reaching:
        ways = (
            ((0.1, -0.6, 1), (0, -0.8, 1)),
            ((0.2, 0, 1), (-0.2, -0.2, 1)),
            ((0.3, -1, 0.3), (-0.2, -0.5, 1)),
        )
        shares = np.ones(3)
    first, second = rng.choice(len(ways), 2, p=shares / shares.sum())
    if rng.random() < 0.5:
        second = first
    mirror = np.array([-1.0, 1, 1])
    return {
        "upperarm_l": np.array(ways[first][0], float),
        "lowerarm_l": np.array(ways[first][1], float),
        "upperarm_r": mirror * ways[second][0],
        "lowerarm_r": mirror * ways[second][1],
    }
