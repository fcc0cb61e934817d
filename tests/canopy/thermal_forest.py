"""A made-up thermal forest: warm bodies on a floor, below crowns of leafy discs at their own heights."""

from dataclasses import dataclass, replace

import cv2
import numpy as np

from sorvolo.geometry.arrays import Floats, Floats32, ImageGray, PointsM
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.pose import NADIR_CAMERA_NORTH_UP, Pose, rotation_from_vector
from sorvolo.heights.views import View

_GROUND_M_PER_PX = 0.05
CAMERA = Camera.from_angle_of_view(512, 512, 50)


@dataclass(frozen=True, eq=False)
class Forest:
    """`ground` is the floor's picture around (0, 0), `leaves` (N, 5) their east, north, up, radius and warmth."""

    side_m: float
    floor_m: float
    ground: Floats32
    leaves: Floats
    people_m: PointsM


def make_forest(
    seed: int, side_m: float, leaves_per_m2: float, people_m: PointsM, floor_m: float = 0.0
) -> Forest:
    """A forest around (0, 0); 3 leaves a square metre hide about half of the floor, 6 two thirds."""
    draw = np.random.default_rng(seed)
    px = int(side_m / _GROUND_M_PER_PX)
    ground = np.full((px, px), 90.0, np.float32)
    for size_m, warmth in ((0.2, 2.0), (0.8, 2.0), (4.0, 4.0)):
        few = max(8, int(side_m / size_m))
        noise = draw.normal(0, warmth, (few, few)).astype(np.float32)
        ground += cv2.resize(noise, (px, px), interpolation=cv2.INTER_CUBIC)
    for east, north in people_m:
        at = np.array([east + side_m / 2, side_m / 2 - north]) / _GROUND_M_PER_PX
        turn = draw.uniform(0, 180)
        size = (1.3 / _GROUND_M_PER_PX, 0.4 / _GROUND_M_PER_PX)
        cv2.ellipse(ground, ((at[0], at[1]), size, turn), 150.0, -1)
    trees = int(side_m**2 / 25)
    count = int(leaves_per_m2 * side_m**2)
    stems = draw.uniform(-side_m / 2 - 10, side_m / 2 + 10, (trees, 2))
    tops = draw.uniform(15, 24, trees)
    tree = draw.integers(0, trees, count)
    depth = draw.uniform(0, 1, count)
    reach = (0.5 + 2.5 * depth)[:, None]
    leaves = np.column_stack(
        [
            stems[tree] + draw.normal(0, 0.8, (count, 2)) * reach,
            floor_m + tops[tree] - 8 * depth,
            draw.uniform(0.2, 0.7, count),
            draw.normal(105, 10, count) + 60 * (draw.uniform(size=count) < 0.02),
        ]
    )
    return Forest(side_m, floor_m, ground, leaves[np.argsort(leaves[:, 2])], people_m)


def fly(
    forest: Forest,
    strips_m: Floats,
    steps_m: Floats,
    height_m: float = 45.0,
    seed: int = 1,
    camera: Camera = CAMERA,
) -> list[View]:
    """Cameras along strips from south to north, at a height above the floor."""
    draw = np.random.default_rng(seed)
    views: list[View] = []
    for east in strips_m:
        for north in steps_m:
            lean = rotation_from_vector(draw.normal(0, 0.02, 3))
            place = np.array([east, north, forest.floor_m + height_m]) + draw.normal(0, 0.3, 3)
            pose = Pose(NADIR_CAMERA_NORTH_UP @ lean, place)
            views.append(View(f"{len(views):03d}.jpg", camera, pose, np.full(3, np.nan)))
    return views


def photograph(forest: Forest, view: View) -> ImageGray:
    """(H, W) uint8 what a thermal camera shows of the forest."""
    half = forest.side_m / 2
    corners = half * np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]], float)
    seen = view.pixels_from_site(np.column_stack([corners, np.full(4, forest.floor_m)]))
    end = len(forest.ground) - 1
    laid = np.array([[0, 0], [end, 0], [end, end], [0, end]], np.float32)
    lay = cv2.getPerspectiveTransform(laid, seen.astype(np.float32))
    size = (view.camera.width_px, view.camera.height_px)
    picture = cv2.warpPerspective(forest.ground, lay, size, flags=cv2.INTER_AREA, borderValue=90)
    centre = view.pixels_from_site(forest.leaves[:, :3])
    away = view.site_from_camera.translation_m[2] - forest.leaves[:, 2]
    radius = forest.leaves[:, 3] * view.camera.fx_px / away
    shown = (np.abs(centre - size[0] / 2) < size[0] / 2 + 20).all(axis=1)
    for (x, y), wide, warmth in zip(centre[shown], radius[shown], forest.leaves[shown, 4]):
        cv2.circle(picture, (round(x), round(y)), max(1, round(wide)), float(warmth), -1)
    grain = np.random.default_rng(int(view.name[:3])).normal(0, 2, picture.shape)
    return np.clip(picture + grain, 0, 255).astype(np.uint8)


def hidden_share(forest: Forest, view: View) -> float:
    """The share of the floor that crowns hide in a view."""
    leaves = forest.leaves.copy()
    leaves[:, 4] = 255
    return float(
        (photograph(replace(forest, ground=forest.ground * 0, leaves=leaves), view) > 128).mean()
    )
