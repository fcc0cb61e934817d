"""Hills under a simulated site: smooth ground, its height anywhere, and where a view's rays meet it."""

from dataclasses import dataclass

import cv2
import numpy as np

from sorvolo.geometry.arrays import Floats, Floats32, PointsM
from sorvolo.lab.simulation.ground_painting import Area
from sorvolo.search.drawing.view import View

_WAVES = 5  # that are summed to hills
_SHORTEST, _LONGEST = (
    2.5,
    5.0,
)  # lengths of the waves, in heights of the flight: hills that a survey flies over
_COARSE_PX = 4  # the hills are smooth: rays are followed on a coarse grid of the picture
_MOST_STEPS = 200  # of following a ray down
_NEAR_M = 1e-4  # to the ground: the ray has arrived


@dataclass(frozen=True, eq=False)
class Relief:
    """The ground's height: `middle_m` and K waves of `turns_m` (K, 2) radians a metre, `phases` and `heights_m` (K,).

    No waves: level ground.
    """

    turns_m: Floats
    phases: Floats
    heights_m: Floats
    middle_m: float = 0.0

    @classmethod
    def hills(
        cls, relief_m: float, flight_m: float, area: Area, rng: np.random.Generator
    ) -> "Relief":
        """Hills of `relief_m` from the lowest to the highest ground of an area, half of it above height 0."""
        if not relief_m:
            return LEVEL
        count = _WAVES
        lengths = flight_m * rng.uniform(_SHORTEST, _LONGEST, count)
        heading = rng.uniform(0, np.pi, count)
        turns = 2 * np.pi / lengths[:, None] * np.column_stack([np.cos(heading), np.sin(heading)])
        raw = cls(turns, rng.uniform(0, 2 * np.pi, count), rng.uniform(0.5, 1.0, count))
        east, north = (
            np.linspace(area.west_m, area.east_m, 64),
            np.linspace(area.south_m, area.north_m, 64),
        )
        up = raw.up_m(np.dstack(np.meshgrid(east, north)))
        scale = relief_m / np.ptp(up)
        return cls(
            turns, raw.phases, scale * raw.heights_m, -scale * float(up.min() + up.max()) / 2
        )

    @property
    def is_level(self) -> bool:
        """Whether the ground has no hills."""
        return not len(self.heights_m)

    @property
    def most_m(self) -> float:
        """No ground is higher than this."""
        return float(self.middle_m + self.heights_m.sum())

    @property
    def most_slope(self) -> float:
        """No ground is steeper, as height over way."""
        return float((self.heights_m * np.linalg.norm(self.turns_m, axis=1)).sum())

    def up_m(self, places_m: Floats) -> Floats:
        """(...,) heights of the ground at places (..., 2), east and north."""
        up = np.full(places_m.shape[:-1], self.middle_m)
        for turn, phase, height_m in zip(self.turns_m, self.phases, self.heights_m):
            up += height_m * np.sin(places_m @ turn + phase)
        return up

    def met(self, eye_m: Floats, rays_m: Floats) -> PointsM:
        """(..., 3) where rays from an eye, (3,), in directions (..., 3) first meet the ground; NaN above the horizon.

        Each step is as long as no slope could cross, so that a hill in front hides what lies behind it (Hart 1996).
        """
        with np.errstate(divide="ignore", invalid="ignore"):
            way = (self.most_m - eye_m[2]) / rays_m[..., 2]
        way[~((rays_m[..., 2] < 0) & (way >= 0))] = np.nan
        closing = self.most_slope * np.linalg.norm(rays_m[..., :2], axis=-1) - rays_m[..., 2]
        for _ in range(_MOST_STEPS if not self.is_level else 0):
            point = eye_m + rays_m * way[..., None]
            above_m = point[..., 2] - self.up_m(point[..., :2])
            way += above_m / closing
            if np.nanmax(np.abs(above_m), initial=0.0) < _NEAR_M:
                break
        return eye_m + rays_m * way[..., None]

    def seen(self, view: View) -> Floats32:
        """(height, width, 2) east and north of the ground at each pixel of a camera's view, far off at the horizon."""
        height, width = view.camera.height_px, view.camera.width_px
        columns, rows = (
            np.append(np.arange(0, side - 1, _COARSE_PX), side - 1) for side in (width, height)
        )
        rays = view.rays_in((0, 0, width, height))[np.ix_(rows, columns)]
        rays = (
            np.dstack([rays, np.ones(rays.shape[:2])]) @ np.linalg.inv(view.ray_from_site[:, :3]).T
        )
        met_m = np.nan_to_num(self.met(view.eye_m[:3], rays)[..., :2], nan=1e6).astype(np.float32)
        x, y = (
            np.interp(np.arange(side), at, np.arange(len(at))).astype(np.float32)
            for side, at in ((width, columns), (height, rows))
        )
        across, down = np.meshgrid(x, y)
        return cv2.remap(met_m, across, down, cv2.INTER_LINEAR)  # type: ignore[return-value]


LEVEL = Relief(np.zeros((0, 2)), np.zeros(0), np.zeros(0))
"""Ground without hills."""
