"""Pictures as bytes and back: JPEG for keyframes, PNG for tiles and previews, RGB(A) order on our side."""

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

import cv2
import numpy as np
from cv2.typing import MatLike

from sorvolo.errors import StoreError
from sorvolo.geometry.arrays import Floats32, ImageRGB, ImageRGBA, Mask, frozen, shrunk, size_within

Key = TypeVar("Key", bound=Hashable)
Kept = TypeVar("Kept")

MOST_KEYFRAME_PX = 160_000_000
"""Of a stored keyframe: the largest cameras that fly have 150 million pixels."""
MOST_TILE_PX = 4096 * 4096
"""Of a tile or a crop."""

_PAPER = 236  # the grey under what is transparent
_FLOAT_PX = 1 << 20  # of a picture, as floats at a time
# 4:4:4 and 92: features found again on the stored keyframe sit where they sat; 4:2:0 shifts coloured edges.
_JPEG = [
    cv2.IMWRITE_JPEG_QUALITY,
    92,
    cv2.IMWRITE_JPEG_SAMPLING_FACTOR,
    cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444,
]
_JPEG_STEPS = {
    1: cv2.IMREAD_COLOR,
    2: cv2.IMREAD_REDUCED_COLOR_2,
    4: cv2.IMREAD_REDUCED_COLOR_4,
    8: cv2.IMREAD_REDUCED_COLOR_8,
}
# one filter for all rows: trying all of them on each row, as level 1 alone does here, takes twice as long
_PNG_FAST = [
    cv2.IMWRITE_PNG_COMPRESSION,
    1,
    cv2.IMWRITE_PNG_STRATEGY,
    cv2.IMWRITE_PNG_STRATEGY_RLE,
    cv2.IMWRITE_PNG_FILTER,
    cv2.IMWRITE_PNG_FILTER_AVG,
]
# rows that repeat the one above, as of a growing map's enlarged copies: a third of the time, and a fifth of the bytes
_PNG_REPEATED = [
    cv2.IMWRITE_PNG_COMPRESSION,
    1,
    cv2.IMWRITE_PNG_STRATEGY,
    cv2.IMWRITE_PNG_STRATEGY_DEFAULT,
    cv2.IMWRITE_PNG_FILTER,
    cv2.IMWRITE_PNG_FILTER_UP,
]


def jpeg_from_image(image: ImageRGB, most_px: int | None = None) -> bytes:
    """Encode an image as JPEG, quality 92, colour at full resolution; its longer side made `most_px` where longer."""
    if most_px is not None:
        image = shrunk(image, size_within(image, most_px))
    _, data = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), _JPEG)
    return data.tobytes()


def jpeg_from_rgba(rgba: ImageRGBA, most_px: int) -> bytes:
    """Encode a picture as `jpeg_from_image` does, what is transparent in it in a grey."""
    alpha = rgba[..., 3:].astype(np.float32) / 255
    flat = np.round(rgba[..., :3] * alpha + _PAPER * (1 - alpha))
    return jpeg_from_image(flat.astype(np.uint8), most_px)


def image_from_jpeg(data: bytes, name: str, step: int = 1) -> ImageRGB:
    """Decode a JPEG, at a `step`-th (1, 2, 4, 8) of its size, rounded up.

    Raises StoreError, naming `name`, when it is damaged or has more pixels than any camera.
    """
    image = _decoded(data, _jpeg_pixels, _JPEG_STEPS[step], name, MOST_KEYFRAME_PX)
    if image is None:
        raise StoreError(
            f"{name} is damaged: no JPEG in its {len(data)} bytes; map its flight again"
        )
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def png_from_rgba(rgba: ImageRGBA) -> bytes:
    """Encode as PNG at zlib level 1; colours under transparent pixels are kept."""
    repeats = len(rgba) % 2 == 0 and np.array_equal(rgba[0::2], rgba[1::2])
    _, data = cv2.imencode(
        ".png", cv2.cvtColor(rgba, cv2.COLOR_RGBA2BGRA), _PNG_REPEATED if repeats else _PNG_FAST
    )
    return data.tobytes()


def rgba_from_png(data: bytes, name: str) -> ImageRGBA:
    """Decode an RGBA PNG; raises StoreError, naming `name`, when it is damaged, too large, or has no alpha."""
    image = _decoded(data, _png_pixels, cv2.IMREAD_UNCHANGED, name, MOST_TILE_PX)
    if image is None or image.ndim != 3 or image.shape[2] != 4:
        raise StoreError(
            f"{name} is damaged: no RGBA PNG in its {len(data)} bytes; map its flight again"
        )
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGRA2RGBA), dtype=np.uint8)


def _decoded(
    data: bytes, size_of: Callable[[bytes], int], flags: int, name: str, most_px: int
) -> MatLike | None:
    """The picture as OpenCV gives it; None for bytes of another form. The size in its header is looked at first."""
    pixels = size_of(data)
    if pixels > most_px:
        raise StoreError(
            f"{name} has {pixels / 1e6:.0f} million pixels, at most {most_px / 1e6:.0f} were expected"
        )
    return cv2.imdecode(np.frombuffer(data, np.uint8), flags) if pixels else None


def _png_pixels(data: bytes) -> int:
    """How many pixels the header of a PNG announces; 0 for anything else."""
    if data[:8] != b"\x89PNG\r\n\x1a\n" or data[12:16] != b"IHDR" or len(data) < 24:
        return 0
    return int.from_bytes(data[16:20], "big") * int.from_bytes(data[20:24], "big")


def _jpeg_pixels(data: bytes) -> int:
    """How many pixels the frame header of a JPEG announces (ITU T.81, B.2.2); 0 for anything else."""
    at = 2 if data[:2] == b"\xff\xd8" else len(data)
    while at + 9 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if (
            marker == 0xFF or marker == 0x01 or 0xD0 <= marker <= 0xD9
        ):  # a filling byte, or a marker without a length
            at += 1 if marker == 0xFF else 2
        elif 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            return int.from_bytes(data[at + 5 : at + 7], "big") * int.from_bytes(
                data[at + 7 : at + 9], "big"
            )
        else:
            at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return 0


def shrink(rgba: ImageRGBA, width: int, height: int) -> ImageRGBA:
    """The image averaged down to a smaller size; what is unseen does not darken the rim of what is seen."""
    if rgba.shape[:2] == (height, width):
        return rgba
    size = (width, height)
    if rgba[..., 3].min() == 255:
        return shrunk(rgba, size)
    times = rgba.shape[0] // height
    if rgba.shape[:2] != (height * times, width * times):
        return unweighted(shrunk(weighted(rgba), size))
    if not _is_partly_seen(rgba).any():
        return _shrunk_rim(rgba, times)
    rows = max(
        1, _FLOAT_PX // (times**2 * width)
    )  # at a time: as floats the whole may be hundreds of megabytes
    parts = [rgba[first * times : (first + rows) * times] for first in range(0, height, rows)]
    return np.concatenate(
        [unweighted(shrunk(weighted(each), (width, len(each) // times))) for each in parts]
    )


def _shrunk_rim(rgba: ImageRGBA, times: int) -> ImageRGBA:
    """The image `times` smaller a side, each pixel of it seen or not: only where both meet do colours need weights."""
    seen = cv2.copyTo(rgba, rgba[..., 3])
    small = np.asarray(
        cv2.resize(seen, None, fx=1 / times, fy=1 / times, interpolation=cv2.INTER_AREA), np.uint8
    )
    rows, columns = np.nonzero(_is_partly_seen(small))
    down, across = (each.ravel() for each in np.mgrid[:times, :times])
    sums = seen[rows[:, None] * times + down, columns[:, None] * times + across].sum(
        axis=1, dtype=np.float32
    )
    small[rows, columns, :3] = np.rint(sums[:, :3] * 255 / sums[:, 3:])
    return small


def _is_partly_seen(rgba: ImageRGBA) -> Mask:
    return (rgba[..., 3] != 0) & (rgba[..., 3] != 255)


def weighted(rgba: ImageRGBA) -> Floats32:
    """Float colours times alpha (and alpha as it is): in this form neighbouring pixels may be averaged."""
    if not _is_partly_seen(rgba).any():
        return cv2.copyTo(rgba, rgba[..., 3]).astype(np.float32)
    result = rgba.astype(np.float32)
    result[..., :3] *= result[..., 3:] / 255
    return result


def unweighted(image: MatLike) -> ImageRGBA:
    """The inverse of `weighted`, rounded."""
    alpha = image[..., 3:]
    colours = image[..., :3] * 255 / np.maximum(alpha, 1e-3)
    return np.clip(np.rint(np.dstack([colours, alpha])), 0, 255).astype(np.uint8)


class BytesCache(Generic[Key, Kept]):
    """What was made last, up to a number of bytes; each thing is made once even if many ask at once."""

    def __init__(self, most_bytes: int, size_of: Callable[[Kept], int]) -> None:
        self.most_bytes, self._size_of = most_bytes, size_of
        self._kept: OrderedDict[Key, Kept] = OrderedDict()
        self._making: dict[Key, threading.Event] = {}
        self._bytes = 0
        self._lock = threading.Lock()

    def get(self, key: Key, make: Callable[[], Kept]) -> Kept:
        """What has this key, made now unless it is kept or being made; what `make` raises comes through."""
        while True:
            with self._lock:
                if key in self._kept:
                    self._kept.move_to_end(key)
                    return self._kept[key]
                made_elsewhere = self._making.get(key)
                if made_elsewhere is None:
                    self._making[key] = threading.Event()
                    break
            made_elsewhere.wait()
        try:
            made = make()
            with self._lock:
                self._kept[key] = made
                self._bytes += self._size_of(made)
                while self._bytes > self.most_bytes and len(self._kept) > 1:
                    self._bytes -= self._size_of(self._kept.popitem(last=False)[1])
        finally:
            with self._lock:
                self._making.pop(key).set()
        return made

    def forget(self, key: Key) -> None:
        """Drop what has this key, if it is kept."""
        with self._lock:
            if key in self._kept:
                self._bytes -= self._size_of(self._kept.pop(key))

    def clear(self) -> None:
        """Drop everything."""
        with self._lock:
            self._kept.clear()
            self._bytes = 0


class ImageCache:
    """The images used last, bounded in bytes; `get` loads what is not there. Images come out read-only."""

    def __init__(self, load: Callable[[int], ImageRGB], limit_bytes: int) -> None:
        self._load = load
        self._kept = BytesCache[int, ImageRGB](limit_bytes, lambda image: image.nbytes)
        self.forget, self.clear = self._kept.forget, self._kept.clear

    def get(self, index: int) -> ImageRGB:
        """The image at `index`, from memory if it was used lately."""
        return self._kept.get(index, lambda: frozen(self._load(index), np.uint8))
