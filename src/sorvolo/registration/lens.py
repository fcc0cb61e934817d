"""Pictures remade: without their lens's distortion, and smaller; and OpenCV's own threads."""

from collections.abc import Iterator
from contextlib import contextmanager

import cv2
import numpy as np
from cv2.typing import MatLike

from sorvolo.geometry.arrays import Floats, Floats32, ImageRGB, Mask, PointsPx
from sorvolo.geometry.camera import Camera

_VISIBLE_PX = 0.5  # at a corner: what moves no pixel by more is left as it is
_RADII = 4096  # of the table of distortion, from the middle to the corner

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
        corners = np.array(
            [[x, y] for x in (0, camera.width_px - 1) for y in (0, camera.height_px - 1)]
        )
        if (
            np.abs(_seen_pixels(corners, camera, radial) - corners).max() < _VISIBLE_PX
        ):  # it moves them most
            return None
        x = (np.arange(camera.width_px, dtype=np.float32) - np.float32(camera.cx_px)) / np.float32(
            camera.fx_px
        )
        y = (np.arange(camera.height_px, dtype=np.float32) - np.float32(camera.cy_px)) / np.float32(
            camera.fy_px
        )
        made = cls(camera.undistorted())
        made._maps = _maps_of_left_over(x, y, camera, radial)
        return made

    def undistort(self, image: ImageRGB) -> ImageRGB:
        """The picture, (H, W, 3), of the perfect lens; its edge repeated where it would see beyond the real one."""
        if self._averages:
            image = cv2.blur(image, (2, 2))  # type: ignore[assignment]
        elif image.shape[1::-1] != self._size:
            image = cv2.resize(image, self._size, interpolation=cv2.INTER_AREA)  # type: ignore[assignment]
        if self._maps is None:
            return image
        return cv2.remap(image, *self._maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)  # type: ignore[return-value]

    def valid(self, width_px: int, height_px: int) -> Mask | None:
        """Which pixels of the perfect picture, resampled to this size, exist; None = all."""
        if self._maps is None:
            return None
        white = np.full(self._mapped_size[::-1], 255, np.uint8)
        seen = cv2.remap(white, *self._maps, cv2.INTER_LINEAR)
        seen = cv2.erode(seen, np.ones((3, 3), np.uint8), borderType=cv2.BORDER_REPLICATE)
        mask = cv2.resize(seen, (width_px, height_px), interpolation=cv2.INTER_AREA) == 255
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


def _maps_of_left_over(
    x: Floats32, y: Floats32, camera: Camera, radial: float
) -> tuple[MatLike, MatLike]:
    """Where each pixel of the perfect picture, in focal lengths x (W,) and y (H,), lies in the one taken.

    How much nearer to the middle depends on the radius alone, so it is found for some radii, to a millionth of a pixel.
    """
    radii = np.linspace(0, np.hypot(np.abs(x).max(), np.abs(y).max()), _RADII)
    nearer = _seen_from_ideal(np.column_stack([radii, np.zeros(_RADII)]), radial)[
        :, 0
    ] / np.maximum(radii, 1e-12)
    nearer[0] = 1.0
    factor = np.interp(np.hypot(x, y[:, None]), radii, nearer).astype(np.float32)
    across = factor * x * np.float32(camera.fx_px) + np.float32(camera.cx_px)
    down = factor * y[:, None] * np.float32(camera.fy_px) + np.float32(camera.cy_px)
    return cv2.convertMaps(across, down, cv2.CV_16SC2)


def _seen_pixels(pixels: PointsPx, camera: Camera, radial: float) -> PointsPx:
    """Where pixels (N, 2) of the perfect picture lie in the one that the camera took."""
    focal, middle = np.array([camera.fx_px, camera.fy_px]), np.array([camera.cx_px, camera.cy_px])
    return _seen_from_ideal((pixels - middle) / focal, radial) * focal + middle


def _seen_from_ideal(ideal: Floats, radial: float) -> Floats:
    """Invert ideal = seen (1 + k r^2) by Newton's method on the radius."""
    radius = np.linalg.norm(ideal, axis=1, keepdims=True)
    seen = radius.copy()
    for _ in range(10):
        seen -= (seen + radial * seen**3 - radius) / np.maximum(1 + 3 * radial * seen**2, 0.1)
    return ideal * np.where(radius > 1e-12, seen / np.maximum(radius, 1e-12), 1.0)


def at_size(image: ImageRGB, width_px: int, height_px: int) -> ImageRGB:
    """The picture, (H, W, 3), at this size; the very same where it has it."""
    if image.shape[1::-1] == (width_px, height_px):
        return image
    return np.asarray(
        cv2.resize(image, (width_px, height_px), interpolation=cv2.INTER_AREA), np.uint8
    )


def at_most(image: ImageRGB, longest_px: int) -> ImageRGB:
    """The picture, (H, W, 3), with a longer side of this many pixels at most."""
    height_px, width_px = image.shape[:2]
    longest = max(height_px, width_px)
    if longest <= longest_px:
        return image
    return at_size(
        image, *(max(1, round(side * longest_px / longest)) for side in (width_px, height_px))
    )


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
