"""Photos of ground whose height is known everywhere: hills, a house with a flat roof, a shed; each ray followed."""

from collections.abc import Callable

import cv2
import numpy as np

from sorvolo.geometry.camera import Camera
from sorvolo.geometry.pose import NADIR_CAMERA_NORTH_UP, Pose, rotation_from_vector
from sorvolo.heights.views import View

HOUSE = (-4.0, 3.0, 2.0, 9.0, 5.0)  # west, south, east, north, height, m
SHED = (8.0, -8.0, 12.0, -4.0, 2.5)


def hills(x, y):
    """Heights of the bare ground, m: 1.5 m of relief."""
    return 0.8 * np.sin(x / 7.0) * np.cos(y / 9.0) + 0.02 * x


def hills_with_houses(x, y):
    """The hills with a house and a shed on them."""
    up = hills(x, y)
    for west, south, east, north, tall in (HOUSE, SHED):
        floor = hills(np.array((west + east) / 2), np.array((south + north) / 2))
        inside = (x > west) & (x < east) & (y > south) & (y < north)
        up = np.where(inside, floor + tall, up)
    return up


def texture(seed: int = 5, m_per_px: float = 0.04, side_m: float = 80.0):
    """A picture of the ground seen from above, and the way to look colours up in it."""
    rng = np.random.default_rng(seed)
    side = int(side_m / m_per_px)
    picture = np.zeros((side, side, 3), np.float32)
    for cells in (side // 3, side // 9, side // 40):
        noise = rng.uniform(-1, 1, (cells, cells, 3)).astype(np.float32)
        picture += cv2.resize(noise, (side, side), interpolation=cv2.INTER_CUBIC)
    picture = np.clip(128 + 40 * picture, 1, 255)

    def look(x, y):
        return cv2.remap(
            picture,
            (x / m_per_px + side / 2).astype(np.float32),
            (side / 2 - y / m_per_px).astype(np.float32),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REFLECT,
        )

    return look


def photo(
    view: View, heights: Callable, look: Callable, highest_m: float = 8.0, lowest_m: float = -3.0
):
    """(H, W, 3) uint8 what the view sees of ground of these heights: each ray followed down to where it meets it."""
    camera = view.camera
    x, y = np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px))
    rays = (
        camera.rays_from_pixels(np.column_stack([x.ravel(), y.ravel()]))
        @ view.site_from_camera.rotation.T
    )
    rays = rays / -rays[:, 2:]
    eye = view.site_from_camera.translation_m
    up, step_m = np.full(len(rays), highest_m), 0.2

    def met_at(up):
        at = eye + rays * (eye[2] - up)[:, None]
        return heights(at[:, 0], at[:, 1]) >= up

    while not (met := met_at(up) | (up <= lowest_m)).all():  # down in steps
        up = np.where(met, up, np.maximum(up - step_m, lowest_m))
    low, high = up, np.minimum(up + step_m, highest_m)
    for _ in range(2):  # then to 5 cm within the step that met the ground
        up = (low + high) / 2
        met = met_at(up)
        low, high = np.where(met, up, low), np.where(met, high, up)
    at = eye + rays * (eye[2] - low)[:, None]
    colours = look(at[:, 0].reshape(x.shape), at[:, 1].reshape(x.shape))
    return np.clip(colours, 0, 255).astype(np.uint8)


def survey_views(
    strips: int = 3, photos: int = 5, height_m: float = 30.0, seed: int = 3, side_px: int = 400
):
    """Views of a survey over the origin: strips 8 m apart, a photo every 6 m, a little tilt; their fixes are exact."""
    rng = np.random.default_rng(seed)
    camera = Camera.from_angle_of_view(side_px, side_px * 3 // 4, 62.0)
    views = []
    for strip in range(strips):
        for number in range(photos):
            turn = rotation_from_vector(rng.normal(0, np.radians(2.0), (1, 3)))[0]
            centre = np.array(
                [
                    6.0 * (number - (photos - 1) / 2),
                    8.0 * (strip - (strips - 1) / 2),
                    height_m,
                ]
            ) + rng.normal(0, 0.3, 3)
            pose = Pose(turn @ NADIR_CAMERA_NORTH_UP, centre)
            views.append(View(f"{strip}-{number}", camera, pose, centre))
    return views
