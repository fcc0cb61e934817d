"""A flat world of coloured things, photographed from straight above: masks come from the pictures, ghosts included."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from sorvolo.change.shade import shade_between
from sorvolo.survey.findings import ComparedView

M_PER_PX = 0.05
WIDTH, HEIGHT = 320, 180
CAMERA_HEIGHT_M = 15.0
START_NS = 1_700_000_000_000_000_000


@dataclass(frozen=True)
class Thing:
    """A box on the ground, `height_m` tall, there on the map's day and on the flight's day or not."""

    east_m: float
    north_m: float
    size_m: tuple[float, float] = (1.0, 1.0)
    height_m: float = 0.0
    colour: tuple[int, int, int] = (200, 40, 40)
    on_map: bool = False
    in_flight: bool = True
    velocity_m_s: tuple[float, float] = (0.0, 0.0)

    def outline_m(self, time_s: float = 0.0) -> np.ndarray:
        half = np.array(self.size_m) / 2
        middle = np.array([self.east_m, self.north_m]) + time_s * np.array(self.velocity_m_s)
        return middle + np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half


def ground(seed: int = 1) -> np.ndarray:
    """60 x 60 m of soft texture around the origin at 0.05 m."""
    rng = np.random.default_rng(seed)
    small = rng.normal(0, 1, (150, 150, 3)).astype(np.float32)
    return np.clip(
        110 + 18 * cv2.resize(small, (1200, 1200), interpolation=cv2.INTER_CUBIC), 0, 255
    ).astype(np.uint8)


GROUND = ground()
SITE_FROM_GROUND = np.array([[0.05, 0, -30.0], [0, -0.05, 30.0], [0, 0, 1]])


def site_from_image(camera_m: Sequence[float]) -> np.ndarray:
    s = M_PER_PX * camera_m[2] / CAMERA_HEIGHT_M
    return np.array(
        [
            [s, 0, camera_m[0] - s * (WIDTH - 1) / 2],
            [0, -s, camera_m[1] + s * (HEIGHT - 1) / 2],
            [0, 0, 1.0],
        ]
    )


def picture(
    camera_m: Sequence[float],
    things: Sequence[Thing],
    time_s: float,
    seen_from_m: Sequence[float] | None = None,
) -> np.ndarray:
    """What the camera sees; the things lean as seen from `seen_from_m` (default: the camera itself)."""
    image_from_site = np.linalg.inv(site_from_image(camera_m))
    image = cv2.warpPerspective(GROUND, image_from_site @ SITE_FROM_GROUND, (WIDTH, HEIGHT))
    eye = np.asarray(camera_m if seen_from_m is None else seen_from_m, float)
    for thing in things:
        base = thing.outline_m(time_s)
        lean = thing.height_m / (eye[2] - thing.height_m)
        top = base + (base - eye[:2]) * lean
        for outline, colour in ((base, thing.colour), (top, thing.colour)):
            hull = cv2.convexHull(np.vstack([base, outline]).astype(np.float32)).reshape(-1, 2)
            points = hull @ image_from_site[:2, :2].T + image_from_site[:2, 2]
            cv2.fillPoly(image, [np.round(points * 16).astype(np.int32)], colour, shift=4)
    return image


def view_of(
    index: int,
    time_s: float,
    camera_m: Sequence[float],
    things: Sequence[Thing],
    map_eye_m: Sequence[float] = (0, 4, CAMERA_HEIGHT_M),
    hole_m: tuple[float, float, float, float] | None = None,
    all_changed: bool = False,
    seed: int = 0,
    score: float = 0.95,
) -> ComparedView:
    """One compared view; `hole_m` is a box (west, south, east, north) of ground that the map does not know."""
    rng = np.random.default_rng([seed, index])
    now = [each for each in things if each.in_flight]
    then = [each for each in things if each.on_map]
    image = picture(camera_m, now, time_s)
    reference = picture(camera_m, then, 0.0, map_eye_m)
    if all_changed:
        image = np.clip(image.astype(int) // 4 + 180, 0, 255).astype(np.uint8)
    valid = np.ones((HEIGHT, WIDTH), bool)
    matrix = site_from_image(camera_m)
    if hole_m:
        corners = (
            np.array([[hole_m[0], hole_m[1], 1], [hole_m[2], hole_m[3], 1.0]])
            @ np.linalg.inv(matrix).T
        )
        (x0, x1), (y0, y1) = (
            np.clip(np.sort(corners[:, axis]), 0, 1e4).astype(int) for axis in (0, 1)
        )
        valid[y0:y1, x0:x1] = False
    difference = np.abs(image.astype(int) - reference).max(axis=2) > 25
    changed = cv2.morphologyEx(
        (difference & valid).astype(np.uint8) * 255, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)
    )
    count, _, stats, _ = cv2.connectedComponentsWithStats(changed, connectivity=8)
    noisy = np.clip(image + rng.normal(0, 2, image.shape), 0, 255).astype(np.uint8)
    return ComparedView(
        index,
        f"frame {index}",
        START_NS + round(time_s * 1e9),
        matrix,
        np.array(camera_m, float),
        noisy,
        reference,
        valid,
        changed,
        stats[1:, :4].astype(np.int64),
        np.full(count - 1, score),
        0.5,
        shade_between(reference, noisy),
    )


def flight(
    things: Sequence[Thing],
    seconds: float = 5.0,
    fps: float = 5.0,
    speed_m_s: float = 3.0,
    start_m: tuple[float, float] = (-8.0, 0.0),
    **how: object,
) -> Iterator[ComparedView]:
    """Views of a drone that flies east."""
    for index in range(round(seconds * fps)):
        time_s = index / fps
        camera_m = (start_m[0] + speed_m_s * time_s, start_m[1], CAMERA_HEIGHT_M)
        yield view_of(index, time_s, camera_m, things, **how)  # type: ignore[arg-type]
