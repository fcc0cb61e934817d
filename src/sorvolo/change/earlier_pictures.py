"""Earlier pictures of the ground under a frame: taken from near the same place, they lean the same way."""

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import cv2
import numpy as np

from sorvolo.change.relief import OrthoSurface
from sorvolo.geometry.arrays import ImageBGR, ImageRGB, ImageRGBA, Mask, Matrix3, PointsM, Vector3
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.homography import apply_homography, pose_from_homography
from sorvolo.geometry.pose import Pose

_LEVEL_M = 0.01  # a camera that stands as near to where level ground has it was placed over that
_EDGE = 0.01  # of a stored picture: the lens's correction repeats pixels there


class EarlierPicture(NamedTuple):
    """Where a picture of an earlier flight lies; `site_from_camera` is None where its method has no pose."""

    camera: Camera
    site_from_image: Matrix3
    site_from_camera: Pose | None


class EarlierPictures:
    """The pictures of earlier flights, seen from where a later frame was taken.

    The map shows each piece of ground as one of them saw it, often from quite another side: a tree or a wall then leans
    another way, and looks changed. Over the `surface` of a true orthophoto the pictures of cameras in space are laid as
    the map was; what the earlier camera did not see is then not known. `load` gives a picture by its place in
    `pictures`, (h, w, 4), with its alpha as `with_known_pixels` sets it.
    """

    def __init__(
        self,
        pictures: Sequence[EarlierPicture],
        load: Callable[[int], ImageRGBA],
        surface: OrthoSurface | None = None,
    ) -> None:
        self._pictures, self._load, self.surface = pictures, load, surface
        places: list[Vector3] = []
        self._in_space: list[bool] = []
        for each in pictures:
            level = pose_from_homography(each.site_from_image, each.camera)
            pose = each.site_from_camera or level
            places.append(np.full(3, np.inf) if pose is None else pose.translation_m)
            off_m = 0.0 if level is None else np.abs(places[-1] - level.translation_m).max()
            self._in_space.append(each.site_from_camera is not None and off_m > _LEVEL_M)
        self._cameras_m = np.array(places).reshape(-1, 3)

    def seen_from(
        self, site_from_image: Matrix3, camera_m: Vector3, width_px: int, height_px: int, most: int
    ) -> Iterator[tuple[ImageBGR, Mask]]:
        """The `most` pictures taken nearest to `camera_m`, one from each side along the way, in an image's pixels:
        BGR (`height_px`, `width_px`, 3), and where they see."""
        for index in self._nearest(camera_m, most):
            found = self._as_coarse(index, site_from_image)
            if found is None:
                continue
            picture, site_from_picture = found
            seen = self._rendered(
                index, picture, site_from_picture, site_from_image, (width_px, height_px)
            )
            bgr = np.asarray(cv2.cvtColor(seen, cv2.COLOR_RGBA2BGR), np.uint8)
            yield bgr, cv2.extractChannel(seen, 3) == 255

    def _as_coarse(self, index: int, site_from_other: Matrix3) -> tuple[ImageRGBA, Matrix3] | None:
        """A picture, and its (3, 3) place, made so much smaller that resampling it for another raster skips no pixels;
        None where its middle is not in front of that."""
        keyframe = self._pictures[index]
        picture, site_from_picture = self._load(index), keyframe.site_from_image
        middle = keyframe.camera.cx_px, keyframe.camera.cy_px
        other_from_picture = np.linalg.inv(site_from_other) @ site_from_picture
        if (other_from_picture @ np.array([*middle, 1.0]))[2] == 0:
            return None
        # Pixels of a per pixel of b around a point of b.
        around = np.array([middle, (middle[0] + 8, middle[1]), (middle[0], middle[1] + 8)])
        moved: PointsM = apply_homography(other_from_picture, around)
        steps = (moved[1:] - moved[0]) / 8
        area = abs(float(steps[0, 0] * steps[1, 1] - steps[0, 1] * steps[1, 0]))
        scale = area**0.5 if np.isfinite(area) and area > 0 else 1.0
        while scale < 0.6:  # a mere interpolation would skip pixels
            picture = _known_inside(np.asarray(cv2.pyrDown(picture), np.uint8))
            site_from_picture = site_from_picture @ np.diag([2.0, 2.0, 1.0])
            scale *= 2
        return picture, site_from_picture

    def _rendered(
        self,
        index: int,
        picture: ImageRGBA,
        site_from_picture: Matrix3,
        site_from_image: Matrix3,
        size: tuple[int, int],
    ) -> ImageRGBA:
        """A picture in an image's pixels, (h, w, 4): over the map's heights where its camera stands in space."""
        camera, pose = self._pictures[index].camera, self._pictures[index].site_from_camera
        if self.surface is None or pose is None or not self._in_space[index]:
            image_from_picture = np.linalg.inv(site_from_image) @ site_from_picture
            return np.asarray(
                cv2.warpPerspective(picture, image_from_picture, size, flags=cv2.INTER_LINEAR),
                np.uint8,
            )
        x, y, sees = self.surface.lay(site_from_image, size, camera, pose)
        share = np.float32(picture.shape[1] / camera.width_px)
        seen = np.asarray(cv2.remap(picture, x * share, y * share, cv2.INTER_LINEAR), np.uint8)
        seen[~sees] = 0
        return seen

    def _nearest(self, camera_m: Vector3, most: int) -> list[int]:
        """The nearest picture and then the nearest ones that lie on the other sides of the camera."""
        if not len(self._cameras_m):
            return []
        apart_m = self._cameras_m[:, :2] - camera_m[:2]
        distance_m = np.hypot(*apart_m.T) + 0.3 * np.abs(self._cameras_m[:, 2] - camera_m[2])
        reach_m = 1.5 * max(float(camera_m[2]), 1.0)
        order = [int(each) for each in np.argsort(distance_m) if distance_m[each] < reach_m]
        chosen = order[:1]
        for each in order[1:]:
            if len(chosen) == most:
                break
            if all(float(apart_m[each] @ apart_m[other]) <= 0 for other in chosen):
                chosen.append(each)
        chosen += [each for each in order if each not in chosen][: most - len(chosen)]
        return chosen


def with_known_pixels(rgb: ImageRGB) -> ImageRGBA:
    """The picture, (h, w, 3), with alpha 0 at its edge and 255 elsewhere.

    In four bands OpenCV resamples it, and where it is known, in less time than in three and one.
    """
    return _known_inside(np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2RGBA), np.uint8))


def _known_inside(rgba: ImageRGBA) -> ImageRGBA:
    """The picture (h, w, 4) with alpha 0 at its edge and 255 elsewhere; it is written over."""
    edge = max(2, round(_EDGE * rgba.shape[1]))
    rgba[..., 3] = 0
    rgba[edge:-edge, edge:-edge, 3] = 255
    return rgba
