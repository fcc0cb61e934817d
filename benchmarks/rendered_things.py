"""Things that lie and stand about, as meshes: what a detector of people must not take for one."""

from itertools import pairwise

import numpy as np

from drawn_meshes import Mesh, joined
from sorvolo.geometry.arrays import Floats

_ROUND = 12  # corners of a tube or an ellipsoid


def shell(
    centre: Floats,
    radii: Floats,
    colour: Floats,
    *,
    power: float = 1.0,
    rough: float = 0.0,
    rng: np.random.Generator | None = None,
    fine: int = 1,
) -> Mesh:
    """An ellipsoid; `power` below 1 makes it a rounded box (superellipsoid, Barr 1981); `rough` dents it."""
    along = np.linspace(-np.pi / 2, np.pi / 2, 8 * fine + 1)[:, None]
    around = np.linspace(0, 2 * np.pi, _ROUND * fine, endpoint=False)[None]

    def bent(values: Floats) -> Floats:
        return np.asarray(
            np.sign(values) * np.where(np.abs(values) < 1e-9, 0, np.abs(values)) ** power
        )

    unit = np.stack(
        np.broadcast_arrays(
            bent(np.cos(along)) * bent(np.cos(around)),
            bent(np.cos(along)) * bent(np.sin(around)),
            bent(np.sin(along)),
        ),
        -1,
    )
    if rough and rng is not None:
        for depth, length in ((rough, 2.2), (0.35 * rough, 7.0))[:fine]:
            waves = rng.normal(0, length, (4, 3))
            unit = unit * (
                1
                + depth * np.sin(unit @ waves.T + rng.uniform(0, 6.3, 4)).sum(-1, keepdims=True) / 2
            )
    return _grid(unit * radii + centre, colour)


def tube(start: Floats, end: Floats, radii_m: tuple[float, float], colour: Floats) -> Mesh:
    """A round bar from one point (3,) to another, closed at both ends."""
    axis = (end - start) / max(float(np.linalg.norm(end - start)), 1e-9)
    side = np.cross(axis, [0.0, 0.0, 1.0] if abs(axis[2]) < 0.9 else [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)
    angles = np.linspace(0, 2 * np.pi, _ROUND, endpoint=False)
    ring = np.cos(angles)[:, None] * side + np.sin(angles)[:, None] * np.cross(axis, side)
    rows = [
        start + 1e-4 * ring,
        start + radii_m[0] * ring,
        end + radii_m[1] * ring,
        end + 1e-4 * ring,
    ]
    return _grid(np.stack(rows), colour)


def _grid(points: Floats, colour: Floats) -> Mesh:
    """A closed surface from rows (R, C, 3) of points, each row a ring."""
    rows, columns = points.shape[:2]
    numbers = np.arange(rows * columns).reshape(rows, columns)
    next_ring = np.roll(numbers, -1, 1)
    faces = np.stack([numbers[:-1], next_ring[:-1], next_ring[1:], numbers[1:]], -1).reshape(-1, 4)
    return Mesh(
        points.reshape(-1, 3), faces, np.tile(colour, (len(faces), 1)), np.zeros(len(faces), bool)
    )


def leaves(
    centre: Floats,
    radii: Floats,
    colour: Floats,
    count: int,
    size_m: float,
    rng: np.random.Generator,
) -> Mesh:
    """A cloud of small sheets, each turned in some way."""
    middle = rng.normal(0, 1, (count, 3))
    middle *= (rng.random((count, 1)) ** 0.4) / np.linalg.norm(middle, axis=1, keepdims=True)
    spans = rng.normal(0, size_m / 2, (2, count, 3))
    corners = (
        np.stack([-spans[0], spans[1], spans[0], -spans[1]], 1) + (middle * radii + centre)[:, None]
    )
    colours = colour * rng.uniform(0.5, 1.4, (count, 1)) * rng.uniform(0.9, 1.1, (count, 3))
    return Mesh(
        corners.reshape(-1, 3), np.arange(count * 4).reshape(-1, 4), colours, np.ones(count, bool)
    )


def any_thing(rng: np.random.Generator) -> Mesh:
    """One thing of some kind, standing on z = 0 around the origin, turned at random."""
    stones = (_boulder,) * 4  # what detectors of people confuse most with them
    kinds = (*stones, _case, _post, _trunk, _table, _dog, _bush, _heap, _bicycle, _parasol, _tyre)
    made = kinds[int(rng.integers(len(kinds)))](rng)
    turn = rng.uniform(0, 2 * np.pi)
    cosine, sine = np.cos(turn), np.sin(turn)
    vertices = made.vertices @ np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]])
    colours = (made.colours * rng.normal(1, 0.05, (len(made.colours), 1))).clip(0.01, 0.95)
    lowest = vertices[made.faces.ravel(), 2].min()
    return Mesh(vertices - [0, 0, lowest], made.faces, colours, made.is_sheet)


def any_colour(rng: np.random.Generator) -> Floats:
    """(3,) shares of light: mostly greys, browns and blues, as cloth and plastic have them, sometimes a loud one."""
    tone = float(np.exp(rng.uniform(np.log(0.02), np.log(0.8))))
    if rng.random() < 0.3:
        loud = rng.uniform(0.02, 0.25, 3)
        loud[rng.permutation(3)[: rng.integers(1, 3)]] = rng.uniform(0.3, 0.8)
        return np.asarray(loud)
    tints = np.array([[1, 1, 1], [0.7, 0.85, 1.3], [1.25, 1, 0.7], [1.1, 1, 0.9], [0.9, 1.05, 0.8]])
    return np.asarray(
        (tone * tints[int(rng.integers(len(tints)))] * rng.uniform(0.85, 1.15, 3)).clip(0.015, 0.85)
    )


def _earthy(rng: np.random.Generator) -> Floats:
    return np.asarray(
        rng.uniform(0.06, 0.5) * np.array([1.05, 1.0, 0.9]) * rng.uniform(0.85, 1.15, 3)
    )


def _boulder(rng: np.random.Generator) -> Mesh:
    """Lying or upright, half in the ground, mottled, sometimes with another beside it."""
    size = (
        np.exp(rng.uniform(np.log(0.15), np.log(0.9))) * rng.uniform(0.55, 1.4, 3) * [1.1, 0.8, 0.8]
    )
    colour = _earthy(rng)
    shape, dents = rng.uniform(0.45, 1), rng.uniform(0.1, 0.35)
    parts = [shell(np.zeros(3), size, colour, power=shape, rough=dents, rng=rng, fine=2)]
    if rng.random() < 0.3:
        aside = size * rng.uniform(-1, 1, 3)
        parts.append(
            shell(aside, size * rng.uniform(0.4, 0.9), _earthy(rng), rough=0.2, rng=rng, fine=2)
        )
    whole = joined(*parts)
    spots = np.sin(whole.middles @ rng.normal(0, 9, (3, 5)) + rng.uniform(0, 6.3, 5)).mean(1)
    mottled = np.exp(
        rng.uniform(0.2, 0.8) * spots + rng.normal(0, rng.uniform(0.05, 0.25), len(spots))
    )
    kept = whole.middles[:, 2] > -rng.uniform(0.1, 0.9) * size[2]
    return Mesh(
        whole.vertices,
        whole.faces[kept],
        whole.colours[kept] * mottled[kept, None],
        whole.is_sheet[kept],
    )


def _case(rng: np.random.Generator) -> Mesh:
    size = np.exp(rng.uniform(np.log(0.12), np.log(0.7), 3))
    body = shell(np.array([0, 0, size[2]]), size, any_colour(rng), power=0.15)
    lid = shell(np.array([0, 0, 2 * size[2]]), size * [0.9, 0.9, 0.06], any_colour(rng), power=0.2)
    return joined(body, lid)


def _post(rng: np.random.Generator) -> Mesh:
    height, radius = rng.uniform(0.4, 3.5), rng.uniform(0.03, 0.22)
    parts = [
        tube(
            np.zeros(3),
            np.array([0, 0, height]),
            (radius, radius * rng.uniform(0.3, 1)),
            any_colour(rng),
        )
    ]
    if rng.random() < 0.5:
        top = np.array([rng.uniform(0.1, 0.4), rng.uniform(0.1, 0.4), rng.uniform(0.05, 0.3)])
        parts.append(
            shell(np.array([0, 0, height]), top, any_colour(rng), power=rng.uniform(0.2, 1))
        )
    return joined(*parts)


def _trunk(rng: np.random.Generator) -> Mesh:
    length, radius, colour = rng.uniform(0.5, 3), rng.uniform(0.05, 0.3), _earthy(rng)
    end = np.array([length, rng.uniform(-0.2, 0.2), 0])
    parts = [tube(np.zeros(3), end, (radius, radius * rng.uniform(0.5, 1)), colour)]
    for _ in range(int(rng.integers(0, 4))):
        at = end * rng.random()
        parts.append(tube(at, at + rng.normal(0, 0.35, 3), (radius * 0.5, radius * 0.2), colour))
    return joined(*parts)


def _table(rng: np.random.Generator) -> Mesh:
    """A table, a bench or a chair."""
    half, height, colour = rng.uniform(0.2, 0.9, 2), rng.uniform(0.35, 0.8), any_colour(rng)
    parts = [shell(np.array([0, 0, height]), np.array([*half, 0.03]), colour, power=0.15)]
    for x, y in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
        foot = np.array([0.85 * x * half[0], 0.85 * y * half[1], 0])
        parts.append(tube(foot, foot + np.array([0, 0, height]), (0.03, 0.03), colour))
    if rng.random() < 0.5:
        back = np.array([-half[0], 0, height + 0.25])
        parts.append(shell(back, np.array([0.03, half[1], 0.25]), colour, power=0.2))
    return joined(*parts)


def _dog(rng: np.random.Generator) -> Mesh:
    size, colour = rng.uniform(0.5, 1.2), any_colour(rng)
    body = shell(size * np.array([0, 0, 0.5]), size * np.array([0.42, 0.13, 0.15]), colour)
    head = shell(
        size * np.array([0.5, rng.uniform(-0.1, 0.1), 0.62]),
        size * np.array([0.16, 0.09, 0.1]),
        colour,
    )
    tip = np.array([-0.65, rng.uniform(-0.2, 0.2), 0.6])
    tail = tube(size * np.array([-0.4, 0, 0.55]), size * tip, (0.03, 0.01), colour)
    legs = [
        tube(
            size * np.array([x, y, 0.45]),
            size * np.array([x + rng.uniform(-0.1, 0.1), y, 0]),
            (0.05, 0.03),
            colour,
        )
        for x in (-0.3, 0.3)
        for y in (-0.09, 0.09)
    ]
    return joined(body, head, tail, *legs)


def _bush(rng: np.random.Generator) -> Mesh:
    radii = rng.uniform(0.2, 1.0, 3)
    green = np.array([0.09, 0.16, 0.04]) * rng.uniform(0.5, 1.8) * rng.uniform(0.8, 1.2, 3)
    return leaves(np.array([0, 0, radii[2]]), radii, green, 350, rng.uniform(0.08, 0.25), rng)


def _heap(rng: np.random.Generator) -> Mesh:
    """Clothes, bags or a tarpaulin on the ground."""
    parts = []
    for _ in range(int(rng.integers(1, 4))):
        size = rng.uniform(0.12, 0.6, 3) * [1, 1, 0.35]
        at = np.array([*rng.normal(0, 0.3, 2), size[2]])
        parts.append(
            shell(
                at,
                size,
                any_colour(rng),
                power=rng.uniform(0.4, 1),
                rough=rng.uniform(0.1, 0.35),
                rng=rng,
            )
        )
    return joined(*parts)


def _bicycle(rng: np.random.Generator) -> Mesh:
    """Standing, or lying on its side."""
    colour, dark = any_colour(rng), np.full(3, 0.03)
    angles = np.linspace(0, 2 * np.pi, 15)
    parts = []
    for middle in (-0.52, 0.52):
        rim = np.stack(
            [middle + 0.33 * np.cos(angles), 0 * angles, 0.33 + 0.33 * np.sin(angles)], 1
        )
        parts += [tube(a, b, (0.025, 0.025), dark) for a, b in pairwise(rim)]
    bars = [
        ((-0.52, 0, 0.33), (-0.05, 0, 0.3)),
        ((-0.05, 0, 0.3), (-0.2, 0, 0.85)),
        ((-0.2, 0, 0.8), (0.4, 0, 0.85)),
        ((-0.05, 0, 0.3), (0.38, 0, 0.75)),
        ((0.52, 0, 0.33), (0.38, 0, 1.0)),
        ((0.38, -0.3, 1.0), (0.38, 0.3, 1.0)),
    ]
    parts += [tube(np.array(a), np.array(b), (0.025, 0.025), colour) for a, b in bars]
    parts.append(shell(np.array([-0.22, 0, 0.92]), np.array([0.13, 0.07, 0.04]), dark))
    whole = joined(*parts)
    if rng.random() < 0.3:
        return Mesh(
            whole.vertices[:, [0, 2, 1]] * [1, -1, 1], whole.faces, whole.colours, whole.is_sheet
        )
    return whole


def _parasol(rng: np.random.Generator) -> Mesh:
    height, radius = rng.uniform(1.8, 2.6), rng.uniform(0.4, 1.6)
    roof = shell(np.array([0, 0, height]), np.array([radius, radius, 0.25]), any_colour(rng))
    return joined(roof, tube(np.zeros(3), np.array([0, 0, height]), (0.03, 0.03), any_colour(rng)))


def _tyre(rng: np.random.Generator) -> Mesh:
    """A tyre, a bucket or a drum."""
    radius, height = rng.uniform(0.15, 0.5), rng.uniform(0.1, 0.9)
    body = tube(
        np.zeros(3),
        np.array([0, 0, height]),
        (radius, radius * rng.uniform(0.8, 1.1)),
        any_colour(rng),
    )
    inside = tube(
        np.array([0, 0, height]),
        np.array([0, 0, height + 0.01]),
        (radius * 0.6,) * 2,
        any_colour(rng),
    )
    return joined(body, inside)
