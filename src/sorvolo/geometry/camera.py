"""The camera: a pinhole with the five-coefficient lens distortion of the thesis (eqs 2.1-2.4) and OpenCV."""

from dataclasses import dataclass, replace

import numpy as np

from sorvolo.errors import GeometryError
from sorvolo.geometry.arrays import Floats, Matrix3, PointsM, PointsPx, frozen


@dataclass(frozen=True, eq=False)
class Camera:
    """Intrinsics of one camera at one image size.

    `distortion` is (k1, k2, p1, p2, k3), OpenCV's order. The thesis lists k1, k2, k3, p1, p2 (section 2.3);
    `capture.calibration` converts. Distortion acts on normalised coordinates (x / z, y / z): eq. 2.4 prints
    the radius in pixels from (cx, cy), which only holds for coordinates already divided by the focal length.
    """

    width_px: int
    height_px: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    distortion: Floats = None  # type: ignore[assignment]  # (5,); becomes zeros

    def __post_init__(self) -> None:
        distortion = frozen(np.zeros(5) if self.distortion is None else self.distortion)
        if distortion.shape != (5,):
            raise GeometryError(
                f"distortion needs 5 coefficients k1 k2 p1 p2 k3, got {distortion.shape}"
            )
        numbers = np.array([self.fx_px, self.fy_px, self.cx_px, self.cy_px, *distortion])
        if not np.isfinite(numbers).all():
            raise GeometryError("a camera number is not finite")
        if self.width_px < 1 or self.height_px < 1:
            raise GeometryError(
                f"image size must be positive, got {self.width_px}x{self.height_px}"
            )
        if self.fx_px <= 0 or self.fy_px <= 0:
            raise GeometryError(
                f"focal length must be positive, got fx={self.fx_px}, fy={self.fy_px}"
            )
        if not (
            -0.5 * self.width_px <= self.cx_px <= 1.5 * self.width_px
            and -0.5 * self.height_px <= self.cy_px <= 1.5 * self.height_px
        ):
            raise GeometryError(
                f"optical centre ({self.cx_px}, {self.cy_px}) lies far outside a {self.width_px}x{self.height_px} image"
            )
        object.__setattr__(self, "distortion", distortion)

    @classmethod
    def from_angle_of_view(
        cls, width_px: int, height_px: int, horizontal_aov_deg: float
    ) -> "Camera":
        """A distortion-free camera with square pixels and this horizontal angle of view (inverse of eq. 3.5)."""
        if not 0 < horizontal_aov_deg < 180:
            raise GeometryError(f"angle of view must lie in (0, 180) deg, got {horizontal_aov_deg}")
        f = 0.5 * width_px / np.tan(np.radians(horizontal_aov_deg) / 2)
        return cls(width_px, height_px, f, f, (width_px - 1) / 2, (height_px - 1) / 2)

    @property
    def matrix(self) -> Matrix3:
        """C_m of eq. 2.1."""
        return np.array([[self.fx_px, 0, self.cx_px], [0, self.fy_px, self.cy_px], [0, 0, 1.0]])

    @property
    def angle_of_view_deg(self) -> tuple[float, float]:
        """Horizontal and vertical angle of view without distortion (eqs 3.5-3.6)."""
        return (
            float(np.degrees(2 * np.arctan(self.width_px / (2 * self.fx_px)))),
            float(np.degrees(2 * np.arctan(self.height_px / (2 * self.fy_px)))),
        )

    @property
    def is_distorted(self) -> bool:
        """Whether any distortion coefficient is not zero."""
        return bool(np.any(self.distortion != 0))

    @property
    def corners_px(self) -> PointsPx:
        """(4, 2) the image's outer corners: top-left, top-right, bottom-right, bottom-left."""
        w, h = self.width_px - 0.5, self.height_px - 0.5
        return np.array([[-0.5, -0.5], [w, -0.5], [w, h], [-0.5, h]])

    def undistorted(self) -> "Camera":
        """The same camera with a perfect lens."""
        return replace(self, distortion=np.zeros(5))

    def with_focal_px(self, fx_px: float) -> "Camera":
        """The same camera with another focal length, the pixel's aspect kept."""
        return replace(self, fx_px=fx_px, fy_px=self.fy_px * fx_px / self.fx_px)

    def resized(self, width_px: int, height_px: int) -> "Camera":
        """The camera of the same images resampled to another size (pixel centres stay on pixel centres)."""
        sx, sy = width_px / self.width_px, height_px / self.height_px
        return Camera(
            width_px,
            height_px,
            self.fx_px * sx,
            self.fy_px * sy,
            (self.cx_px + 0.5) * sx - 0.5,
            (self.cy_px + 0.5) * sy - 0.5,
            self.distortion,
        )

    def rays_from_pixels(self, points_px: PointsPx) -> PointsM:
        """(N, 3) rays in the camera frame with z = 1 for distorted image points, shape (N, 2)."""
        points = np.asarray(points_px, dtype=np.float64).reshape(-1, 2)
        distorted = (points - [self.cx_px, self.cy_px]) / [self.fx_px, self.fy_px]
        ideal = distorted.copy()
        if self.is_distorted:
            # Newton's method: the plain fixed-point iteration diverges for strong barrel lenses at the corners.
            for _ in range(20):
                value, jacobian = self._distort_with_jacobian(ideal)
                step = np.linalg.solve(jacobian, (distorted - value)[..., None])[..., 0]
                ideal += step
                if np.abs(step).max(initial=0.0) < 1e-12:
                    break
        return np.column_stack([ideal, np.ones(len(ideal))])

    def pixels_from_points(self, points_camera_m: PointsM) -> PointsPx:
        """(N, 2) distorted image points of camera-frame points, shape (N, 3); NaN behind the camera."""
        points = np.asarray(points_camera_m, dtype=np.float64).reshape(-1, 3)
        with np.errstate(divide="ignore", invalid="ignore"):
            ideal = points[:, :2] / points[:, 2:]
        ideal[points[:, 2] <= 0] = np.nan
        return self._distort(ideal) * [self.fx_px, self.fy_px] + [self.cx_px, self.cy_px]

    def undistort_points(self, points_px: PointsPx) -> PointsPx:
        """Where distorted image points, shape (N, 2), lie in the image of `undistorted()`."""
        if not self.is_distorted:
            return np.asarray(points_px, dtype=np.float64)
        return self.rays_from_pixels(points_px)[:, :2] * [self.fx_px, self.fy_px] + [
            self.cx_px,
            self.cy_px,
        ]

    def _distort(self, ideal: Floats) -> Floats:
        k1, k2, p1, p2, k3 = self.distortion
        x, y = ideal[:, 0], ideal[:, 1]
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        return np.column_stack(
            [
                x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
                y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
            ]
        )

    def _distort_with_jacobian(self, ideal: Floats) -> tuple[Floats, Floats]:
        k1, k2, p1, p2, k3 = self.distortion
        x, y = ideal[:, 0], ideal[:, 1]
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = 2 * (k1 + r2 * (2 * k2 + r2 * 3 * k3))  # d radial / d(r2) * 2
        xy = x * y * slope + 2 * p1 * x + 2 * p2 * y
        xx = radial + x * x * slope + 2 * p1 * y + 6 * p2 * x
        yy = radial + y * y * slope + 6 * p1 * y + 2 * p2 * x
        return self._distort(ideal), np.stack([xx, xy, xy, yy], axis=-1).reshape(-1, 2, 2)
