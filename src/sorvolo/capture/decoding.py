"""Pictures' pixels from their bytes: JPEG, TIFF, PNG, and by extras HEIC and DNG, within a bound of memory."""

import struct
import warnings
from io import BytesIO
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np
from PIL import Image, UnidentifiedImageError

from sorvolo.errors import InputError
from sorvolo.geometry.arrays import ImageRGB, ImageRGBA

PHOTO_SUFFIXES = frozenset(
    {".jpg", ".jpeg", ".jpe", ".tif", ".tiff", ".png", ".heic", ".heif", ".hif", ".dng"}
)

LARGEST_PHOTO_PX = 160_000_000
"""A larger picture is refused by its header: kilobytes can claim gigabytes. Survey cameras make 151 megapixels."""

LARGEST_FRAME_PX = 64_000_000
"""Photos above this are used at half or a quarter of their size, which JPEG can be decoded at; others are refused.
A mission holds three frames at once, 0.2 GB each at this size; drones' own cameras make up to 61 megapixels."""

# Pillow's own guard stands at 89 megapixels and is a global by design.
Image.MAX_IMAGE_PIXELS = LARGEST_PHOTO_PX

BROKEN_PICTURE = (
    OSError,
    SyntaxError,
    ValueError,
    TypeError,
    KeyError,
    IndexError,
    AttributeError,
    OverflowError,
    ZeroDivisionError,
    EOFError,
    RuntimeError,
    MemoryError,
    struct.error,
    Image.DecompressionBombError,
)
"""What Pillow raises, by accident or on purpose, on damaged files."""

_JPEG_START = b"\xff\xd8\xff"
_HEIF_BRANDS = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"mif1", b"msf1", b"avif")
# the reduced kinds exist with blue first only
_JPEG_FLAGS = {
    1: cv2.IMREAD_COLOR_RGB,
    2: cv2.IMREAD_REDUCED_COLOR_2,
    4: cv2.IMREAD_REDUCED_COLOR_4,
}


def is_heif(head: bytes) -> bool:
    """Whether a file that starts with these bytes, twelve at least, is a HEIC or HEIF picture."""
    return head[4:8] == b"ftyp" and head[8:12] in _HEIF_BRANDS


def is_dng(path: Path) -> bool:
    """Whether the name is that of a raw picture of the kind that drones write."""
    return path.suffix.lower() == ".dng"


def check_size(name: str, width_px: int, height_px: int, *, is_jpeg: bool) -> None:
    """Raise InputError for a picture that no mission can use because of its size, before its pixels are decoded."""
    most_px = LARGEST_PHOTO_PX if is_jpeg else LARGEST_FRAME_PX
    if width_px * height_px > most_px:
        raise InputError(
            f"{name} states {width_px}x{height_px} pixels; at most {most_px // 1_000_000} megapixels are read"
            + ("" if is_jpeg else f" (as JPEG {LARGEST_PHOTO_PX // 1_000_000}); convert it")
        )


def reduction_of(width_px: int, height_px: int) -> int:
    """By which divisor, 1, 2 or 4, a photo of this size is used."""
    return next(
        step
        for step in (1, 2, 4)
        if width_px * height_px <= LARGEST_FRAME_PX * step**2 or step == 4
    )


def reduced_size_px(width_px: int, height_px: int) -> tuple[int, int]:
    """Width and height of a photo of this size as it is used: rounded up, as JPEG decoders round."""
    step = reduction_of(width_px, height_px)
    return -(-width_px // step), -(-height_px // step)


def decode_photo(data: bytes, name: str, reduction: int = 1) -> ImageRGB:
    """Pixels of a picture as stored (EXIF orientation not applied), 8 bits, RGB.

    Deeper, gray, CMYK and transparent ones are converted. `reduction` (1, 2, 4) divides the size of a JPEG, which is
    never decoded at its full one; other kinds come at full size. Raises InputError when the picture is damaged, cut,
    too large, or of a kind whose extra is not installed.
    """
    is_jpeg = data.startswith(_JPEG_START)
    if is_jpeg and (image := _decode_jpeg(data, reduction)) is not None:
        return image
    if Path(name).suffix.lower() == ".dng":
        return _decode_dng(data, name)
    try:
        with open_picture(BytesIO(data), name) as picture:
            check_size(name, *picture.size, is_jpeg=is_jpeg)
            if picture.mode in ("I", "F", "I;16", "I;16B", "I;16L"):
                gray = np.clip(np.asarray(picture).astype(np.float32) / 257, 0, 255).astype(
                    np.uint8
                )
                return np.repeat(gray[:, :, None], 3, axis=2)
            return np.array(picture.convert("RGB"))
    except BROKEN_PICTURE as error:
        raise InputError(
            f"{name} is damaged or cut ({reason_in_words(error)}); copy it again"
        ) from error


def cut_out_picture(path: Path) -> ImageRGBA | None:
    """A picture (H, W, 4) with transparency; None for one without. Raises InputError when it is damaged or too large."""
    try:
        with open_picture(path, path.name) as picture:
            if "A" not in picture.getbands() and "transparency" not in picture.info:
                return None
            check_size(path.name, *picture.size, is_jpeg=False)
            rgba = np.array(picture.convert("RGBA"))
            return rgba if (rgba[..., 3] < 255).any() else None
    except BROKEN_PICTURE as error:
        raise InputError(
            f"{path} is damaged or cut ({reason_in_words(error)}); copy it again"
        ) from error


def open_picture(file: Path | BytesIO, name: str) -> Image.Image:
    """The picture, its pixels not yet decoded, by Pillow, with HEIC where the extra is installed.

    Raises InputError for HEIC without the extra; and what Pillow raises, BROKEN_PICTURE.
    """
    if isinstance(file, Path):
        with file.open("rb") as stream:
            head = stream.read(12)
    else:
        head = file.getvalue()[:12]
    if is_heif(head):
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                import pillow_heif
        except ImportError as error:
            raise InputError(
                f"{name} is a HEIC picture, which needs an extra: pip install 'sorvolo[heic]'; or convert it to JPEG"
            ) from error
        module: ModuleType = pillow_heif
        module.register_heif_opener()
    return Image.open(file)


def dng_size_px(data: bytes, name: str) -> tuple[int, int]:
    """Width and height of a DNG's own picture, which its first directory, a thumbnail's, does not state."""
    raw = _open_dng(data, name)
    try:
        return int(raw.sizes.width), int(raw.sizes.height)
    finally:
        raw.close()


def reason_in_words(error: BaseException) -> str:
    """Why a picture cannot be read, for people: libraries name functions and memory addresses."""
    if isinstance(error, UnidentifiedImageError):
        return "it is no JPEG, TIFF, PNG, HEIC or DNG picture"
    if isinstance(error, Image.DecompressionBombError | MemoryError):
        return "it states more pixels than fit into memory"
    if isinstance(error, FileNotFoundError):
        return "there is no such file"
    if isinstance(error, PermissionError):
        return "it may not be read; check its permissions"
    text = str(error).lower()
    if "truncated" in text or "unexpected end" in text or isinstance(error, EOFError):
        return "the file ends before the picture does"
    return "its data are damaged"


def _decode_jpeg(data: bytes, reduction: int) -> ImageRGB | None:
    """By OpenCV, which needs half of Pillow's time and, since version 5, refuses cut files too; None for those."""
    try:
        image = cv2.imdecode(
            np.frombuffer(data, np.uint8), _JPEG_FLAGS[reduction] | cv2.IMREAD_IGNORE_ORIENTATION
        )
        if image is not None and reduction > 1:
            image = cv2.cvtColor(image, cv2.COLOR_BGR2RGB, dst=image)
    except cv2.error:
        return None
    return None if image is None else np.asarray(image, dtype=np.uint8)


def _decode_dng(data: bytes, name: str) -> ImageRGB:
    raw = _open_dng(data, name)
    try:
        check_size(name, int(raw.sizes.width), int(raw.sizes.height), is_jpeg=False)
        return np.asarray(
            raw.postprocess(use_camera_wb=True, user_flip=0, output_bps=8), dtype=np.uint8
        )
    except BROKEN_PICTURE as error:
        raise InputError(
            f"{name} is damaged or cut ({reason_in_words(error)}); copy it again"
        ) from error
    except Exception as error:  # LibRawError, whose class is known only where rawpy is installed
        raise InputError(
            f"{name} is damaged or cut (its raw data cannot be developed); copy it again"
        ) from error
    finally:
        raw.close()


def _open_dng(data: bytes, name: str) -> Any:
    try:
        import rawpy
    except ImportError as error:
        raise InputError(
            f"{name} is a raw picture (DNG), which needs an extra: pip install 'sorvolo[raw]'; or give the JPEG that "
            "the drone wrote beside it"
        ) from error
    try:
        return rawpy.imread(BytesIO(data))
    except Exception as error:
        # LibRawError has many children, and OSError for what is no raw picture
        raise InputError(
            f"{name} is damaged or no raw picture that is known; copy it again"
        ) from error


_SAME_ASPECT = 0.01  # relative, of pictures of another size than the flight's; by choice


def is_same_shape(size_px: tuple[int, int], flight_px: tuple[int, int]) -> bool:
    """Whether pictures of two sizes (width, height) show the same view, but for a hundredth of their aspect."""
    (width_px, height_px), (flight_width_px, flight_height_px) = size_px, flight_px
    return abs(width_px * flight_height_px / (height_px * flight_width_px) - 1) <= _SAME_ASPECT


def other_size(size_px: tuple[int, int], flight_px: tuple[int, int]) -> str:
    """Why a picture of another shape (width, height) is not used, in words."""
    return f"size {size_px[0]}x{size_px[1]} differs from the flight's {flight_px[0]}x{flight_px[1]}"
