import os

STUDENT, RECIPES, DATA, MODELS = (
    os.environ.get(k, "") for k in ("STUDENT", "RECIPES", "DATA", "MODELS")
)
"""clutter.py OUT COUNT SEED: scenes of things alone that detectors take for cars or people: no person among them"""
import sys
from pathlib import Path
import numpy as np

sys.path.insert(0, RECIPES)
from drawn_meshes import Mesh, joined, looking, sprite_of
from rendered_things import shell, tube, leaves, any_colour, any_thing, _boulder, _earthy
from rendered_people import Scene, drawn_light, write_scene


def V(*a):
    return np.array(a, float)


def box(c, half, col, p=0.12):
    return shell(np.asarray(c, float), np.asarray(half, float), col, power=p)


def grey(rng):
    return rng.uniform(0.08, 0.7) * np.array([1.02, 1, 0.95]) * rng.uniform(0.92, 1.08, 3)


def wood(rng):
    return rng.uniform(0.3, 1.3) * np.array([0.35, 0.23, 0.13]) * rng.uniform(0.85, 1.15, 3)


def block(rng):
    h = np.exp(rng.uniform(np.log([0.3, 0.2, 0.15]), np.log([3.0, 1.1, 0.7])))
    m = [box((0, 0, h[2]), h, grey(rng), rng.uniform(0.08, 0.3))]
    if rng.random() < 0.3:
        m.append(box((0, 0, 2 * h[2]), h * [0.5, 0.5, 0.15], grey(rng)))
    if rng.random() < 0.3:
        m.append(
            box(V(2.2 * h[0], rng.normal(0, 0.2), h[2]), h * rng.uniform(0.6, 1.1, 3), grey(rng))
        )
    return joined(*m)


def container(rng):
    h = V(rng.choice([1.5, 3.0]), 1.2, 1.25) * rng.uniform(0.8, 1.1)
    c = any_colour(rng)
    m = [box((0, 0, h[2]), h, c, 0.06)]
    for k in range(int(rng.integers(0, 14))):
        m.append(
            box(
                (h[0] * (-0.9 + 0.14 * k), 0, 2 * h[2]),
                (0.03, h[1] * 0.97, 0.04),
                c * rng.uniform(0.6, 0.9),
            )
        )
    return joined(*m)


def skip(rng):
    h = V(rng.uniform(0.8, 2), rng.uniform(0.6, 1), rng.uniform(0.4, 0.8))
    c = any_colour(rng)
    m = [
        box((0, 0, h[2]), h, c),
        box((0, 0, 2 * h[2] + 0.01), h * [0.93, 0.9, 0.02], any_colour(rng) * 0.6),
    ]
    for _ in range(int(rng.integers(0, 7))):
        m.append(
            shell(
                V(*rng.uniform(-0.7, 0.7, 2) * h[:2], 2 * h[2]),
                rng.uniform(0.1, 0.5, 3) * [1, 1, 0.5],
                any_colour(rng),
                power=rng.uniform(0.2, 1),
            )
        )
    return joined(*m)


def bench(rng):
    L, c = rng.uniform(0.6, 1.4), (wood(rng) if rng.random() < 0.6 else grey(rng))
    m = []
    n = int(rng.integers(2, 6))
    w = rng.uniform(0.2, 0.35)
    for k in range(n):
        m.append(
            box(
                ((-1 + (2 * k + 1) / n) * w, 0, 0.45),
                (w / n * 0.85, L, 0.025),
                c * rng.uniform(0.85, 1.1),
            )
        )
    if rng.random() < 0.6:
        for k in range(2):
            m.append(box((-w - 0.05, 0, 0.6 + 0.18 * k), (0.02, L, 0.06), c))
    for y in (-0.8, 0.8):
        m.append(box((0, y * L, 0.22), (w * 0.9, 0.06, 0.2), grey(rng)))
    return joined(*m)


def picnic(rng):
    L, c = rng.uniform(0.7, 1.3), wood(rng) if rng.random() < 0.7 else grey(rng)
    m = [box((0, 0, 0.75), (0.38, L, 0.03), c)]
    for s in (-1, 1):
        m.append(box((s * 0.75, 0, 0.45), (0.14, L, 0.03), c * rng.uniform(0.8, 1.1)))
    for y in (-0.7, 0.7):
        m.append(box((0, y * L, 0.4), (0.7, 0.05, 0.05), c * 0.7))
        m.append(box((0, y * L, 0.3), (0.08, 0.05, 0.35), c * 0.7))
    if rng.random() < 0.3:
        r = rng.uniform(1, 1.8)
        m.append(shell(V(0, 0, 2.3), V(r, r, 0.3), any_colour(rng)))
    return joined(*m)


def pallets(rng):
    n = int(rng.integers(1, 8))
    c = wood(rng)
    m = []
    for k in range(n):
        a = V(rng.normal(0, 0.04), rng.normal(0, 0.04), 0.07 + 0.15 * k)
        if k == n - 1:
            for j in range(6):
                m.append(
                    box(
                        a + V((-1 + (2 * j + 1) / 6) * 0.6, 0, 0.05),
                        (0.07, 0.4, 0.015),
                        c * rng.uniform(0.8, 1.15),
                    )
                )
        else:
            m.append(box(a, (0.6, 0.4, 0.06), c * rng.uniform(0.6, 1)))
    if rng.random() < 0.5:
        m.append(
            box(
                V(0, 0, 0.15 * n + 0.3),
                (rng.uniform(0.3, 0.6), rng.uniform(0.25, 0.4), 0.3),
                any_colour(rng),
                rng.uniform(0.1, 0.5),
            )
        )
    return joined(*m)


def bins(rng):
    n = int(rng.integers(1, 5))
    c = any_colour(rng)
    m = []
    big = rng.random() < 0.5
    h = V(0.65, 0.5, 0.55) if big else V(0.28, 0.35, 0.5)
    for k in range(n):
        y = k * h[1] * 2.15
        m += [
            box((0, y, h[2]), h, c, 0.2),
            box(
                (0, y, 2 * h[2] + 0.04),
                h * [1.05, 1.03, 0.1],
                any_colour(rng) if k == 0 else c * 0.8,
                0.3,
            ),
        ]
    return joined(*m)


def stump(rng):
    r = rng.uniform(0.12, 0.6)
    h = rng.uniform(0.1, 0.7)
    c = wood(rng)
    m = [
        tube(V(0, 0, 0), V(0, 0, h), (r * 1.15, r), c * 0.6),
        tube(V(0, 0, h), V(0, 0, h + 0.01), (r * 0.9, r * 0.9), np.clip(c * 1.7, 0, 0.8)),
    ]
    for _ in range(int(rng.integers(0, 5))):
        a = rng.uniform(0, 6.3)
        m.append(
            tube(
                V(r * np.cos(a), r * np.sin(a), h * 0.4),
                V(2 * r * np.cos(a), 2 * r * np.sin(a), 0),
                (r * 0.3, r * 0.1),
                c * 0.6,
            )
        )
    return joined(*m)


def logs(rng):
    m = []
    L = rng.uniform(0.8, 4)
    c = wood(rng)
    for k in range(int(rng.integers(2, 9))):
        r = rng.uniform(0.06, 0.25)
        y = rng.normal(0, 0.5)
        z = r + rng.choice([0, 0, 0.3])
        m.append(
            tube(
                V(-L / 2 + rng.normal(0, 0.1), y, z),
                V(L / 2, y + rng.normal(0, 0.1), z),
                (r, r * 0.9),
                c * rng.uniform(0.6, 1.2),
            )
        )
    return joined(*m)


def pipes(rng):
    r = rng.uniform(0.1, 0.9)
    L = rng.uniform(1, 5)
    c = grey(rng)
    m = []
    for k in range(int(rng.integers(1, 5))):
        m.append(
            tube(
                V(-L / 2, 2.05 * r * k, r),
                V(L / 2, 2.05 * r * k, r),
                (r, r),
                c * rng.uniform(0.9, 1.1),
            )
        )
    return joined(*m)


def rocks(rng):
    m = []
    for _ in range(int(rng.integers(1, 6))):
        b = _boulder(rng)
        f = rng.uniform(0.7, 2.2)
        m.append(
            Mesh(b.vertices * f + V(*rng.normal(0, 0.9, 2), 0), b.faces, b.colours, b.is_sheet)
        )
    return joined(*m)


def hedge(rng):
    L = rng.uniform(0.6, 3)
    rad = V(L, rng.uniform(0.4, 1.2), rng.uniform(0.3, 1))
    green = V(0.09, 0.16, 0.04) * rng.uniform(0.4, 2) * rng.uniform(0.7, 1.3, 3)
    return joined(
        leaves(V(0, 0, rad[2]), rad, green, 700, rng.uniform(0.12, 0.35), rng),
        shell(V(0, 0, rad[2] * 0.8), rad * 0.8, green * 0.6, rough=0.2, rng=rng),
    )


def slab(rng):
    h = V(rng.uniform(0.5, 3), rng.uniform(0.4, 1.3), rng.uniform(0.02, 0.12))
    c = grey(rng) if rng.random() < 0.6 else any_colour(rng)
    m = [box((0, 0, h[2]), h, c, 0.08)]
    for _ in range(int(rng.integers(0, 4))):
        m.append(
            box(
                V(*rng.uniform(-0.7, 0.7, 2) * h[:2], 2 * h[2] + 0.05),
                rng.uniform(0.04, 0.4, 3) * [1, 1, 0.3],
                any_colour(rng),
            )
        )
    return joined(*m)


def shed(rng):
    h = V(rng.uniform(0.8, 2.6), rng.uniform(0.7, 1.4), rng.uniform(0.5, 1.2))
    c = any_colour(rng)
    r = any_colour(rng)
    rise = rng.uniform(0, 0.6)
    v = np.array(
        [
            [-1.1 * h[0], -1.1 * h[1], 2 * h[2]],
            [1.1 * h[0], -1.1 * h[1], 2 * h[2]],
            [1.1 * h[0], 0, 2 * h[2] + rise],
            [-1.1 * h[0], 0, 2 * h[2] + rise],
            [1.1 * h[0], 1.1 * h[1], 2 * h[2]],
            [-1.1 * h[0], 1.1 * h[1], 2 * h[2]],
        ]
    )
    roof = Mesh(v, np.array([[0, 1, 2, 3], [3, 2, 4, 5]]), np.tile(r, (2, 1)), np.ones(2, bool))
    return joined(box((0, 0, h[2]), h, c, 0.06), roof)


def tarp(rng):
    s = V(rng.uniform(0.6, 2.4), rng.uniform(0.5, 1.1), rng.uniform(0.2, 0.7))
    return shell(
        V(0, 0, 0),
        s,
        any_colour(rng),
        power=rng.uniform(0.3, 0.9),
        rough=rng.uniform(0.05, 0.25),
        rng=rng,
        fine=2,
    )


def barrier(rng):
    L = rng.uniform(0.8, 2)
    c = any_colour(rng)
    m = []
    for k in range(int(rng.integers(1, 4))):
        m.append(
            box(
                (rng.normal(0, 0.05), 2.1 * L * k, 0.4),
                (0.12, L, 0.35),
                grey(rng) if rng.random() < 0.6 else c,
                0.3,
            )
        )
        m.append(box((0, 2.1 * L * k, 0.12), (0.3, L, 0.1), grey(rng), 0.3))
    return joined(*m)


def boat(rng):
    s = V(rng.uniform(1.2, 2.6), rng.uniform(0.5, 0.9), rng.uniform(0.3, 0.5))
    c = any_colour(rng)
    return joined(
        shell(V(0, 0, s[2]), s, c, power=0.8),
        shell(V(0, 0, 1.75 * s[2]), s * [0.8, 0.75, 0.3], any_colour(rng) * 0.7, power=0.8),
        box((0, 0, 2 * s[2]), (0.12, s[1] * 0.8, 0.03), wood(rng)),
    )


KIND = (
    block,
    block,
    block,
    container,
    skip,
    bench,
    bench,
    picnic,
    picnic,
    pallets,
    bins,
    stump,
    stump,
    logs,
    pipes,
    rocks,
    rocks,
    rocks,
    hedge,
    slab,
    slab,
    shed,
    tarp,
    barrier,
    boat,
)


def thing(rng):
    if rng.random() < 0.2:
        return any_thing(rng)
    made = KIND[int(rng.integers(len(KIND)))](rng)
    t = rng.uniform(0, 2 * np.pi)
    co, si = np.cos(t), np.sin(t)
    v = made.vertices @ np.array([[co, si, 0], [-si, co, 0], [0, 0, 1]])
    mid = (v[:, :2].max(0) + v[:, :2].min(0)) / 2
    v = v - [*mid, 0]
    c = (made.colours * rng.normal(1, rng.uniform(0.01, 0.08), (len(made.colours), 1))).clip(
        0.01, 0.95
    )
    used = made.faces.ravel()
    return Mesh(v - [0, 0, v[used, 2].min()], made.faces, c, made.is_sheet)


def scene(rng):
    steep = bool(rng.random() < 0.7)
    tilt = np.radians(abs(rng.normal(0, 9)) if steep else rng.uniform(25, 58))
    h = float(np.exp(rng.uniform(np.log(8), np.log(100))))
    ppm = float(np.exp(rng.uniform(np.log(35), np.log(75))))
    light = drawn_light(rng, 0.25)
    sp = []
    for _ in range(16):
        m = thing(rng)
        placed = None
        while placed is None:
            placed = looking(float(tilt), h, rng.uniform([-0.75, -0.6], [0.75, 0.6]), ppm)
        view, at = placed
        sp.append(sprite_of(m.moved(at), light, view, rng.normal(0, 0.12, (len(m.faces), 3))))
    return Scene(tuple(sp), (False,) * 16, ppm, steep, 1 - light.sky)


if __name__ == "__main__":
    out = Path(sys.argv[1])
    out.mkdir(exist_ok=True)
    for k in range(int(sys.argv[2])):
        p = out / f"scene-{k:04d}.npz"
        if not p.is_file():
            write_scene(p, scene(np.random.default_rng((int(sys.argv[3]), k))))
            print(p.name, flush=True)
