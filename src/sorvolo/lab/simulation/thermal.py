"""A site as a thermal camera sees it: warmth in grey levels in place of colour, white hot or black hot."""

from dataclasses import replace

import cv2
import numpy as np

from sorvolo.geometry.arrays import ImageRGB
from sorvolo.lab.simulation.ground_painting import GroundRaster
from sorvolo.lab.simulation.photographed import recompressed
from sorvolo.lab.simulation.world import Day
from sorvolo.search.drawing.noise import layer
from sorvolo.search.drawing.warmth import GROUND_LEVEL, warm_body


def warm_day(day: Day, bare: GroundRaster, rng: np.random.Generator) -> Day:
    """The day with warmth for colour, the same in its three channels; `bare` is its ground without shadows.

    By day the sun's shadows are cool; by night they are gone. Two cars in three have a warm engine.
    """
    has_sun = rng.uniform() < 0.4
    raster = day.ground if has_sun else bare.resampled(day.ground.m_per_px[0])
    spread, turn = rng.uniform(0.1, 0.5), 1.0 if has_sun else rng.choice((-1.0, 1.0))
    grey = cv2.GaussianBlur(raster.rgb.mean(axis=2).astype(np.float32), (0, 0), 1.2)
    warmth = GROUND_LEVEL + np.float32(spread * turn) * (grey - grey.mean())
    warmth += np.float32(rng.uniform(2, 9)) * layer(rng, warmth.shape[:2], 4.0 / raster.m_per_px[0])
    ground = replace(raster, rgb=np.dstack([np.clip(warmth, 0, 255).astype(np.uint8)] * 3))
    bodies = {thing.id: warm_body(thing, day.bodies[thing.id], rng) for thing in day.things}
    return replace(day, ground=ground, bodies=bodies)


def heat_picture(image: ImageRGB, rng: np.random.Generator) -> ImageRGB:
    """The rendered warmth as a thermal camera shows it: soft, noisy, striped, stretched to its own range."""
    warmth = image[..., 0].astype(np.float32)
    warmth = np.asarray(cv2.GaussianBlur(warmth, (0, 0), rng.uniform(0.5, 1.3)), np.float32)
    warmth = warmth + np.float32(rng.uniform(0.5, 3.0)) * rng.standard_normal(
        warmth.shape, dtype=np.float32
    )
    stripes = rng.standard_normal(warmth.shape[1], dtype=np.float32)
    warmth += np.float32(rng.uniform(0, 1.5)) * stripes
    low, high = np.percentile(warmth, (0.5, 99.8))
    room = max(float(high - low), 40.0)
    shown = np.clip(
        (warmth - low + rng.uniform(0, 0.3) * room) / (room * rng.uniform(1.0, 1.5)), 0, 1
    )
    if rng.uniform() < 0.35:  # black hot
        shown = 1 - shown
    return recompressed(np.dstack([np.round(255 * shown).astype(np.uint8)] * 3), rng)
