"""The pictures of a flight as heights need them: without distortion, their exposure even, in a few sizes, in bounds."""

from collections.abc import Sequence

from sorvolo.geometry.arrays import ImageGray, ImageRGB
from sorvolo.heights.views import View, pixels_wide
from sorvolo.mosaic.exposure import corrected
from sorvolo.registration.features import gray_from_rgb
from sorvolo.registration.lens import Undistorter, refined_camera
from sorvolo.registration.sizes import at_size
from sorvolo.store.images import ImageCache
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.catalogue import StoredKeyframe

_LARGE_BYTES = 224 * 1024 * 1024  # of pictures as stored
_SMALL_BYTES = 128 * 1024 * 1024  # of gray ones for the sweep


class FlightPictures:
    """Loads, corrects and keeps the pictures used last; numbers count the keyframes given."""

    def __init__(
        self, archive: Archive, keyframes: Sequence[StoredKeyframe], radial: tuple[float, float] = (0.0, 0.0)
    ) -> None:
        self._archive, self._keyframes = archive, keyframes
        self._lens = Undistorter(refined_camera(keyframes[0].camera, 1.0, *radial)) if any(radial) else None
        self._large = ImageCache(self._load, _LARGE_BYTES)
        self._small: dict[int, ImageCache] = {}

    def colour(self, number: int) -> ImageRGB:
        """A picture as it is stored, corrected."""
        return self._large.get(number)

    def gray(self, number: int) -> ImageGray:
        """A picture in gray, as it is stored."""
        return gray_from_rgb(self._large.get(number))

    def gray_of_size(self, view: View, number: int, size_m: float) -> ImageGray:
        """A view's picture in gray, its pixels covering about `size_m` of ground, or as it is where it is coarser."""
        width = pixels_wide(view, size_m)
        if width not in self._small:
            self._small[width] = ImageCache(lambda each: self._shrunk(each, width), _SMALL_BYTES)
        return self._small[width].get(number)

    def forget_small(self) -> None:
        """Let go of the small pictures: the sweep is done."""
        self._small.clear()

    def _load(self, number: int) -> ImageRGB:
        keyframe = self._keyframes[number]
        image = corrected(self._archive.image(keyframe), keyframe.gains, keyframe.vignette)
        return image if self._lens is None else self._lens.undistort(image)

    def _shrunk(self, number: int, width: int) -> ImageGray:
        camera = self._keyframes[number].camera
        return gray_from_rgb(at_size(self._large.get(number), width, round(width * camera.height_px / camera.width_px)))
