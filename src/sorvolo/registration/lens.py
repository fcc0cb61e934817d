"""Pictures remade: without their lens's distortion, and smaller; and OpenCV's own threads."""

from collections.abc import Iterator
from contextlib import contextmanager

import cv2
import numpy as np
from cv2.typing import MatLike

from sorvolo.geometry.arrays import ImageRGB, Mask, shrunk, size_within, square
from sorvolo.geometry.camera import Camera

_VISIBLE_PX = 0.5  # at a corner: what moves no pixel by more is left as it is

# times as large at most: a mean of 2 x 2 pixels is enough for what is left out between
_AVERAGED = 2.0


class Undistorter:
    """Makes pictures of `camera` as a perfect lens would have; its maps are made once.

    With `taken` the pictures are that camera's, which differs in size alone: they are made smaller on the way.
    """

    def __init__(self, camera: Camera, taken: Camera | None = None) -> None:
        self.camera = camera.undistorted()
        taken = taken or camera
        self._size = camera.width_px, camera.height_px
        self._averages = camera.is_distorted and 1.0 < taken.width_px / camera.width_px < _AVERAGED
        self._mapped_size = (taken.width_px, taken.height_px) if self._averages else self._size
        self._maps: tuple[MatLike, MatLike] | None = None
        if self._averages:
            x, y = cv2.initUndistortRectifyMap(
                taken.matrix, taken.distortion, None, camera.matrix, self._size, cv2.CV_32FC1
            )
            self._maps = cv2.convertMaps(
                x + 0.5, y + 0.5, cv2.CV_16SC2
            )  # the mean lies half a pixel before its last
        elif camera.is_distorted:
            self._maps = cv2.initUndistortRectifyMap(
                camera.matrix, camera.distortion, None, camera.matrix, self._size, cv2.CV_16SC2
            )

    @classmethod
    def left_over(cls, camera: Camera, radial: float) -> "Undistorter | None":
        """For the distortion k that a flight found (ideal = seen (1 + k r^2)); None where it moves no pixel visibly."""
        perfect = camera.undistorted()
        seen = refined_camera(perfect, 1.0, radial)
        corners = np.array(
            [[x, y] for x in (0, camera.width_px - 1) for y in (0, camera.height_px - 1)]
        )
        moved = seen.pixels_from_points(perfect.rays_from_pixels(corners)) - corners
        return None if np.abs(moved).max() < _VISIBLE_PX else cls(seen)  # it moves them most

    def undistort(self, image: ImageRGB) -> ImageRGB:
        """The picture, (H, W, 3), of the perfect lens; its edge repeated where it would see beyond the real one."""
        if self._averages:
            image = cv2.blur(image, (2, 2))  # type: ignore[assignment]
        elif image.shape[1::-1] != self._size:
            image = shrunk(image, self._size)
        if self._maps is None:
            return image
        return cv2.remap(image, *self._maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)  # type: ignore[return-value]

    def valid(self, width_px: int, height_px: int) -> Mask | None:
        """Which pixels of the perfect picture, resampled to this size, exist; None = all."""
        if self._maps is None:
            return None
        white = np.full(self._mapped_size[::-1], 255, np.uint8)
        seen = cv2.remap(white, *self._maps, cv2.INTER_LINEAR)
        seen = cv2.erode(seen, square(3), borderType=cv2.BORDER_REPLICATE)
        mask = shrunk(seen, (width_px, height_px)) == 255
        return None if mask.all() else mask


def refined_camera(camera: Camera, focal_scale: float, radial: float, fifth: float = 0.0) -> Camera:
    """The camera with the focal length and the left-over radial distortion that a flight found.

    ideal = seen (1 + radial r^2 + fifth r^4) / focal_scale.
    The five coefficients are fitted so that every pixel's ray is the one that the flight's solution gives it.
    """
    result = camera.with_focal_px(camera.fx_px * focal_scale)
    if radial == fifth == 0.0 and (focal_scale == 1.0 or not camera.is_distorted):
        return result
    x, y = np.meshgrid(
        np.linspace(-0.5, camera.width_px - 0.5, 25), np.linspace(-0.5, camera.height_px - 0.5, 25)
    )
    pixels = np.column_stack([x.ravel(), y.ravel()])
    seen = camera.rays_from_pixels(pixels)[:, :2]
    square = (seen**2).sum(axis=1, keepdims=True)
    ray = seen * (1 + radial * square + fifth * square**2) / focal_scale
    distorted = (pixels - [result.cx_px, result.cy_px]) / [result.fx_px, result.fy_px]
    u, v = ray.T
    r2 = u * u + v * v
    columns_u = np.column_stack([u * r2, u * r2**2, 2 * u * v, r2 + 2 * u * u, u * r2**3])
    columns_v = np.column_stack([v * r2, v * r2**2, r2 + 2 * v * v, 2 * u * v, v * r2**3])
    coefficients, *_ = np.linalg.lstsq(
        np.concatenate([columns_u, columns_v]), (distorted - ray).T.ravel(), rcond=None
    )
    return Camera(
        result.width_px,
        result.height_px,
        result.fx_px,
        result.fy_px,
        result.cx_px,
        result.cy_px,
        coefficients,
    )


def at_size(image: ImageRGB, width_px: int, height_px: int) -> ImageRGB:
    """The picture, (H, W, 3), at this size; the very same where it has it."""
    if image.shape[1::-1] == (width_px, height_px):
        return image
    return shrunk(image, (width_px, height_px))


def at_most(image: ImageRGB, longest_px: int) -> ImageRGB:
    """The picture, (H, W, 3), with a longer side of this many pixels at most."""
    return at_size(image, *size_within(image, longest_px))


@contextmanager
def single_threaded_opencv() -> Iterator[None]:
    """One thread in each call of OpenCV within the block: where frames are worked on in threads of our own, OpenCV's
    would only wait for each other."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:  # also when Ctrl-C strikes again meanwhile
        cv2.setNumThreads(before)
