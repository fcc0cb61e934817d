"""Headings of photos that telemetry has wrong, found by the ground that neighbours share."""

from dataclasses import dataclass

import numpy as np

from sorvolo.geometry.arrays import ImageRGB, Matrix3, PointsM, PointsPx
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.homography import apply_homography
from sorvolo.geometry.level_ground import ground_from_pixels
from sorvolo.geometry.pose import Pose
from sorvolo.registration.shared_view import SmallView, second_from_first, small_view
from sorvolo.survey.flight import CameraPrior
from sorvolo.tracking.heading_check import HeadingTurn, is_checked, is_wrong, turned


@dataclass(frozen=True)
class PhotoHeadingSettings:
    """When the ground that two photos share shows a heading."""

    least_sigma_deg: float = (
        4.0  # of what is shown, however far apart the photos; as of `heading.HeadingSettings`
    )
    most_sigma_deg: float = 20.0  # a heading shown less well is not used; by choice
    alike_deg: float = 45.0  # a photo that shows nothing shares its predecessor's error if their headings are as alike


@dataclass(frozen=True, eq=False)
class _Last:
    """The photo before: what is kept of it, its prior as telemetry has it, and turned right, and by how much."""

    view: SmallView
    prior: CameraPrior
    right: CameraPrior
    turn: HeadingTurn | None = None


class PhotoHeadings:
    """The headings of photos, one after another, in order of time. `see` and `take` change it.

    The middle of the photo before lies on the ground where telemetry has it, almost straight below that camera,
    whatever its heading. Where the new photo shows that place, the direction to it from the new camera must be the
    same: the turn about the vertical by which it is not is the heading's error. (Angles of a gimbal that are wrong by
    half a turn, for a whole strip, occur in real flights.) The first photo is held against the one after it, which
    `see` is given before. `turns_deg` are the turns, clockwise, of the photos that were corrected.
    """

    def __init__(
        self, camera: Camera, settings: PhotoHeadingSettings = PhotoHeadingSettings()
    ) -> None:
        self._camera, self._settings = camera, settings
        self._last: _Last | None = None
        self.turns_deg: list[float] = []

    def see(self, image: ImageRGB, prior: CameraPrior) -> None:
        """Hold the next photo given to `take` against this one."""
        self._last = _Last(small_view(image), prior, prior) if is_checked(prior) else None

    def take(self, image: ImageRGB, prior: CameraPrior) -> CameraPrior:
        """A photo's prior, with the heading that its picture shows where telemetry's is wrong, else as it is."""
        if not is_checked(prior):
            self._last = None
            return prior
        view = small_view(image)
        turn = None if self._last is None else self._turn(view, prior, self._last)
        right = prior
        if turn is not None:
            self.turns_deg.append(turn.turn_deg)
            right = turned(prior, turn)
        self._last = _Last(view, prior, right, turn)
        return right

    def _turn(self, view: SmallView, prior: CameraPrior, before: _Last) -> HeadingTurn | None:
        """The turn of a photo that shows, or shares, a wrong heading; None where it stays as it is."""
        here_from_before = second_from_first(before.view, view)
        if here_from_before is None:
            return _carried(before, prior, self._settings.alike_deg)
        shown = self._shown(prior, before.right, before.view.size_px, here_from_before)
        if shown is None:
            return _carried(before, prior, self._settings.alike_deg)
        return shown if is_wrong(shown, prior) else None

    def _shown(
        self,
        prior: CameraPrior,
        other: CameraPrior,
        other_size_px: tuple[int, int],
        here_from_other: Matrix3,
    ) -> HeadingTurn | None:
        """What the middle of another photo shows of a photo's heading; None where that is known too badly."""
        middle_px = (np.array([other_size_px[::-1]], np.float64) - 1) / 2
        seen_m = (
            self._on_ground(apply_homography(here_from_other, middle_px), prior)
            - prior.position_m[:2]
        )
        true_m = self._on_ground(middle_px, other) - prior.position_m[:2]
        reach_m = min(float(np.linalg.norm(seen_m)), float(np.linalg.norm(true_m)))
        if not reach_m > 0:  # at the horizon there is none
            return None
        tilt_deg = max(each.attitude_sigma_deg[:2].max() for each in (prior, other))
        fix_m = max(each.position_sigma_m[:2].max() for each in (prior, other))
        miss_m = np.sqrt(2) * np.hypot(
            fix_m, prior.position_m[2] * np.radians(tilt_deg)
        )  # of both photos
        sigma_deg = float(np.hypot(np.degrees(miss_m / reach_m), self._settings.least_sigma_deg))
        turn_deg = _bearing_deg(true_m) - _bearing_deg(seen_m)
        return (
            HeadingTurn(turn_deg, sigma_deg) if sigma_deg <= self._settings.most_sigma_deg else None
        )

    def _on_ground(self, pixels: PointsPx, prior: CameraPrior) -> PointsM:
        """(2,) where a pixel, (1, 2), lies on the level ground."""
        return ground_from_pixels(self._camera, Pose(prior.rotation, prior.position_m), pixels)[0]


def _carried(before: _Last, prior: CameraPrior, alike_deg: float) -> HeadingTurn | None:
    """The turn of the photo before, for one with about the same heading by telemetry: it is wrong by the same."""
    if before.turn is None:
        return None
    cosine = (np.trace(before.prior.rotation.T @ prior.rotation) - 1) / 2
    if np.degrees(np.arccos(np.clip(cosine, -1, 1))) > alike_deg:
        return None
    return HeadingTurn(
        before.turn.turn_deg, float(np.hypot(before.turn.sigma_deg, prior.attitude_sigma_deg[2]))
    )


def _bearing_deg(east_north_m: PointsM) -> float:
    """Clockwise from north, of (2,)."""
    return float(np.degrees(np.arctan2(east_north_m[0], east_north_m[1])))
