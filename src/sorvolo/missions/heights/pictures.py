"""A flight's pictures as heights need them: without distortion, their exposure even, in a few sizes, within bounds."""

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass

from sorvolo.geometry.arrays import ImageGray, ImageRGB
from sorvolo.heights.views import View, pixels_wide
from sorvolo.mosaic.exposure import corrected
from sorvolo.registration.features import gray_from_rgb
from sorvolo.registration.lens import Undistorter, at_size, refined_camera
from sorvolo.store.images import ImageCache
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.catalogue import StoredKeyframe


@dataclass(frozen=True)
class PictureSettings:
    """How many decoded pictures are kept."""

    large_bytes: int = 288 * 1024 * 1024  # as stored, for the orthophoto: ten of 9 megapixels
    small_bytes: int = (
        128 * 1024 * 1024
    )  # gray, for the sweep: about a hundred of 4000 pixels at the usual cells


class FlightPictures:
    """Loads and corrects pictures, and keeps those last asked for by `colour`; numbers count the keyframes given."""

    def __init__(
        self,
        archive: Archive,
        keyframes: Sequence[StoredKeyframe],
        radial: tuple[float, float] = (0.0, 0.0),
        settings: PictureSettings = PictureSettings(),
    ) -> None:
        self._archive, self._keyframes = archive, keyframes
        self._lens = (
            Undistorter(refined_camera(keyframes[0].camera, 1.0, *radial)) if any(radial) else None
        )
        self._large = ImageCache(self._load, settings.large_bytes)

    def colour(self, number: int) -> ImageRGB:
        """A picture as it is stored, corrected."""
        return self._large.get(number)

    def gray(self, number: int) -> ImageGray:
        """A picture in gray, as it is stored; it is not kept."""
        return gray_from_rgb(self._load(number))

    def grays(self, number: int, widths: Sequence[int]) -> dict[int, ImageGray]:
        """A picture in gray, so many pixels wide each; decoded once, and not kept."""
        image, camera = self._load(number), self._keyframes[number].camera
        return {
            width: gray_from_rgb(
                at_size(image, width, round(width * camera.height_px / camera.width_px))
            )
            for width in widths
        }

    def _load(self, number: int) -> ImageRGB:
        keyframe = self._keyframes[number]
        image = corrected(self._archive.image(keyframe), keyframe.gains, keyframe.vignette)
        return image if self._lens is None else self._lens.undistort(image)


class SmallPictures:
    """The pictures of a flight in gray, their pixels covering about each of `sizes_m` of ground; those used last stay.

    A picture that is coarser than a size comes as it is. All its sizes are made when it is decoded, for a sweep needs
    one after the other.
    """

    def __init__(
        self,
        pictures: FlightPictures,
        views: Sequence[View],
        sizes_m: Sequence[float],
        settings: PictureSettings = PictureSettings(),
    ) -> None:
        self._pictures, self._views, self._sizes_m = pictures, views, sizes_m
        self._limit_bytes, self._bytes = settings.small_bytes, 0
        self._kept: OrderedDict[int, dict[int, ImageGray]] = OrderedDict()

    def gray(self, number: int, size_m: float) -> ImageGray:
        """View `number`'s picture, its pixels covering `size_m`, one of the sizes."""
        if number not in self._kept:
            widths = sorted({pixels_wide(self._views[number], each) for each in self._sizes_m})
            self._kept[number] = self._pictures.grays(number, widths)
            self._bytes += _bytes(self._kept[number])
            while self._bytes > self._limit_bytes and len(self._kept) > 1:
                self._bytes -= _bytes(self._kept.popitem(last=False)[1])
        self._kept.move_to_end(number)
        return self._kept[number][pixels_wide(self._views[number], size_m)]


def _bytes(pictures: dict[int, ImageGray]) -> int:
    return sum(each.nbytes for each in pictures.values())
