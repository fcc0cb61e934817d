"""Shadows that drawn bodies cast on the ground."""

from dataclasses import replace

import cv2
import numpy as np

from sorvolo.geometry.arrays import ImageGray
from sorvolo.search.drawing.objects import Body, Light, Thing
from sorvolo.search.drawing.view import Patch, View, map_view, sample_patches

SHADOW_TINT = np.array([0.40, 0.44, 0.52], np.float32)
"""What the blue sky alone still lights."""


def own_shadow(thing: Thing, body: Body, light: Light, m_per_px: float) -> Patch:
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
    return Patch.spanned(corners, texture, np.zeros(3))


def cast_shadow(patches: list[Patch], sun_view: View, depth: ImageGray) -> None:
    """Darken `depth`, in place, where the patches stop the sun; a face's back stops it as its front does."""
    two_sided = [replace(patch, normal=np.zeros(3)) for patch in patches]
    for (x0, y0, x1, y1), sample in sample_patches(sun_view, two_sided):
        np.maximum(depth[y0:y1, x0:x1], sample[..., 3], out=depth[y0:y1, x0:x1])
