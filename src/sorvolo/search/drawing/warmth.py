"""Bodies as a thermal camera sees them: warmth in grey levels in place of colour."""

from dataclasses import replace

import numpy as np

from sorvolo.geometry.arrays import Floats, ImageRGBA
from sorvolo.search.drawing.objects import Body, Label, Part, Thing
from sorvolo.search.drawing.view import Patch, cut_out

GROUND_LEVEL = 90.0
"""The ground's level of warmth in the pictures that are rendered."""

_UP_SIDES = np.zeros(3)
# how much warmer than the ground, in grey levels of the span that `GROUND_LEVEL` leaves; people always stand out
_WARMTH = {
    Label.PERSON: (35.0, 140.0),
    Label.CAR: (-45.0, 55.0),
    Label.SMALL: (-35.0, 40.0),
    Label.TREE: (-15.0, 25.0),
    Label.HOUSE: (-30.0, 45.0),
}
_LEAST_CONTRAST = 12.0  # of targets: what is as warm as the ground cannot be seen, nor be asked for


def warm_body(thing: Thing, body: Body, rng: np.random.Generator) -> Body:
    """The body with warmth for colour, in levels around `GROUND_LEVEL`: how warm it is drawn from its class's range."""
    low, high = _WARMTH[thing.label]
    warmth = float(rng.uniform(low, high))
    if thing.label.is_target and abs(warmth) < _LEAST_CONTRAST:
        warmth = float(np.copysign(_LEAST_CONTRAST, warmth))
    detail = float(rng.uniform(0.3, 0.8) if thing.label is Label.TREE else rng.uniform(0.05, 0.25))
    mean = _mean_grey([part.texture for part in body.parts])
    parts: list[Part] = [
        replace(part, texture=_warmed(part.texture, GROUND_LEVEL + warmth, detail, mean))
        for part in body.parts
    ]
    if thing.label is Label.PERSON and len(parts) > 2:  # feet and clothes are cooler than the head
        for index, share in ((0, 0.6), (-1, 1.2)):
            texture = _warmed(
                body.parts[index].texture, GROUND_LEVEL + share * warmth, detail, mean
            )
            parts[index] = replace(parts[index], texture=texture)
    if thing.label is Label.CAR and rng.uniform() < 0.65:
        parts.insert(
            5, _engine(thing, GROUND_LEVEL + float(rng.uniform(30, 140)))
        )  # above the bonnet, below the cabin
    return Body(tuple(parts))


def _engine(thing: Thing, warmth: float) -> Patch:
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
    return Patch.spanned(corners, texture, _UP_SIDES)


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
