"""Which camera took the pictures: calibration files, presets, EXIF, or a guess, named as one.

A guess is never hidden: `CameraModel.origin` states where the numbers come from and how to do better.
"""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sorvolo.capture.camera_presets import CameraPreset, find_presets, preset_names
from sorvolo.capture.intrinsics import OPENCV_ORDER, camera_from_nodes, check_lens, read_nodes
from sorvolo.capture.photo_xmp import StatedLens
from sorvolo.errors import GeometryError, InputError
from sorvolo.geometry.arrays import Floats
from sorvolo.geometry.camera import Camera
from sorvolo.survey.flight import CameraModel

GUESSED_AOV_DEG = 70.0
"""Horizontal angle of view of a camera that nothing is known of: the middle of most drones' 62 to 84 deg."""

_FULL_FRAME_DIAGONAL_MM = 43.267  # of 36 x 24 mm, which focal lengths "in 35 mm" are of
_BETTER = "give --camera FILE, or make one with `sorvolo calibrate`"


def read_camera(path: Path, width_px: int, height_px: int) -> CameraModel:
    """The camera of a calibration file, for frames of this size.

    Reads OpenCV's XML and YAML (the UMCD dataset's too) and ROS camera_info YAML. The order of five bare distortion coefficients differs: OpenCV writes k1 k2 p1
    p2 k3, the dataset k1 k2 k3 p1 p2 (thesis section 2.3); `origin` states which was read and why. Raises
    InputError for a file that cannot be read, a broken matrix, a lens model with more coefficients, or
    another image shape.
    """
    return camera_from_nodes(path.name, read_nodes(path), width_px, height_px)


def camera_xml(
    camera: Camera, *, reprojection_error_px: float, views: int, focal_sigma: float = 0.003
) -> str:
    """The text of an OpenCV calibration file that `cv2.FileStorage` and `read_camera` read."""
    matrix = _xml_matrix("camera_matrix", 3, 3, camera.matrix.ravel())
    distortion = _xml_matrix("distortion_coefficients", 5, 1, camera.distortion)
    return (
        '<?xml version="1.0"?>\n<opencv_storage>\n'
        f"<image_width>{camera.width_px}</image_width>\n<image_height>{camera.height_px}</image_height>\n"
        f'{matrix}<distortion_order>"{" ".join(OPENCV_ORDER)}"</distortion_order>\n{distortion}'
        f"<avg_reprojection_error>{reprojection_error_px:.6g}</avg_reprojection_error>\n"
        f"<nr_of_frames>{views}</nr_of_frames>\n<focal_sigma>{focal_sigma:.6g}</focal_sigma>\n"
        "</opencv_storage>\n"
    )


def guess_camera(
    width_px: int,
    height_px: int,
    *,
    make: str = "",
    model: str = "",
    focal_length_mm: float = math.nan,
    focal_length_35mm: float = math.nan,
    focal_plane_px_per_mm: float = math.nan,
    full_width_px: int = 0,
) -> CameraModel:
    """The best distortion-free camera for frames of this size without a calibration.

    In this order: a preset of the model (2-10 %), EXIF focal length and focal plane resolution (5 %; the
    latter counts pixels of the photo as taken, `full_width_px` wide), EXIF 35 mm equivalent (5 %), else a
    guess (20 %). Numbers that describe no lens are passed over. Zero and NaN mean unknown.
    """
    make, model = _clean(make), _clean(model)
    label = (model if model.startswith(make) else f"{make} {model}").strip() or "camera"
    presets = [
        each
        for each in find_presets(model) or find_presets(label)
        if _fits(each, width_px, focal_length_mm)
    ]
    if presets:
        return _camera_of_preset(presets[0], width_px, height_px, focal_length_mm)
    focal_px = focal_length_mm * focal_plane_px_per_mm * width_px / (full_width_px or width_px)
    if _is_lens(focal_px, width_px):  # not where one is unknown: NaN or 0
        words = f"EXIF of the {label}: {focal_length_mm:g} mm at {focal_plane_px_per_mm:.1f} px/mm"
        return _plain_camera(width_px, height_px, focal_px, words, 0.05)
    focal_px = _focal_px(focal_length_35mm, width_px, height_px)
    if _is_lens(focal_px, width_px):
        words = f"EXIF of the {label}: equivalent to {focal_length_35mm:g} mm on 35 mm film"
        return _plain_camera(width_px, height_px, focal_px, words, 0.05)
    camera = Camera.from_angle_of_view(width_px, height_px, GUESSED_AOV_DEG)
    origin = f"a GUESS, {GUESSED_AOV_DEG:g} deg across, the lens of this {label} being unknown; {_BETTER}"
    return CameraModel(camera, origin, 0.2)


def stated_camera(lens: StatedLens, width_px: int, height_px: int) -> CameraModel | None:
    """The camera that a photo's own XMP states, for frames of this size; None where it states none that can be.

    A calibration of this very camera (DJI's DewarpData) is good to 0.5 %, the lens's design to 1 %.
    """
    scale = width_px / lens.width_px if lens.width_px else math.nan
    focal_px = lens.fx_px * scale
    if not (_known(focal_px) and _is_lens(focal_px, width_px)):
        return None
    cx_px, cy_px = (width_px - 1) / 2 + lens.cx_px * scale, (height_px - 1) / 2 + lens.cy_px * scale
    words = "the photo's own XMP: " + (
        "calibrated" if lens.is_calibrated else "as the lens was designed"
    )
    try:
        camera = Camera(
            width_px,
            height_px,
            focal_px,
            lens.fy_px * scale,
            cx_px,
            cy_px,
            np.array(lens.distortion),
        )
        check_lens("XMP", camera)
    except (GeometryError, InputError):
        return None
    return CameraModel(
        camera,
        f"{words} ({camera.angle_of_view_deg[0]:.1f} deg across)",
        0.005 if lens.is_calibrated else 0.01,
    )


def camera_from_option(option: str, width_px: int, height_px: int) -> CameraModel:
    """The camera that `--camera` names, for frames of this size.

    A calibration file; else a preset's name or EXIF code; else `aov=78.8` (horizontal, deg),
    `focal_px=1234` (at this frame size) or `focal_35mm=24`. Raises InputError listing the presets for
    anything else.
    """
    path = Path(option)
    if path.is_file():
        return read_camera(path, width_px, height_px)
    if presets := find_presets(option):
        return _camera_of_preset(_nearest_in_size(presets, width_px), width_px, height_px, math.nan)
    key, equals, text = option.partition("=")
    if equals:
        key = key.strip().lower()
        try:
            number = float(text)
        except ValueError as error:
            raise InputError(f"--camera {key}={text}: {text!r} is not a number") from error
        sigma = 0.03
        if key == "aov":
            focal_px = (
                0.5 * width_px / math.tan(math.radians(number) / 2)
                if 0 < number < 180
                else math.nan
            )
        elif key == "focal_px":
            focal_px = number
        elif key == "focal_35mm":
            focal_px, sigma = _focal_px(number, width_px, height_px), 0.05
        else:
            raise InputError(f"--camera {key}={text}: the key must be aov, focal_px or focal_35mm")
        if not _is_lens(focal_px, width_px):
            raise InputError(f"--camera {key}={text}: no lens for pictures {width_px} px wide")
        return _plain_camera(width_px, height_px, focal_px, f"given as {key}={number:g}", sigma)
    if path.suffix.lower() in (".xml", ".yml", ".yaml", ".json") or "/" in option:
        raise InputError(f"{option}: no such camera file")
    raise InputError(
        f"--camera {option!r} is neither a file, nor aov=DEG, focal_px=PX or focal_35mm=MM, nor one of: "
        f"{preset_names()}"
    )


def _camera_of_preset(
    preset: CameraPreset, width_px: int, height_px: int, focal_length_mm: float
) -> CameraModel:
    focal_mm = (
        focal_length_mm if preset.changes_lens and _known(focal_length_mm) else preset.focal_mm
    )
    # a picture of another shape is taken as the largest cut of that shape from the sensor
    focal_px = max(
        focal_mm / preset.sensor_width_mm * width_px,
        focal_mm / preset.sensor_height_mm * height_px,
    )
    words = f"preset {preset.name}: {focal_mm:g} mm lens, sensor {preset.sensor_width_mm:g} mm wide"
    if preset.changes_lens and not _known(focal_length_mm):
        return _plain_camera(
            width_px, height_px, focal_px, f"{words}; the lens is a GUESS, {_BETTER}", 0.2
        )
    if width_px == preset.width_px:
        return _plain_camera(width_px, height_px, focal_px, words, preset.focal_sigma)
    words += f"; not a full photo of {preset.width_px} px, and video may use less of the sensor"
    return _plain_camera(width_px, height_px, focal_px, words, max(0.05, preset.focal_sigma))


def _focal_px(focal_35mm: float, width_px: int, height_px: int) -> float:
    # The equivalent compares diagonals of whole photos. A 16:9 picture is nearly always cut from a 4:3 sensor.
    diagonal_px = width_px * 1.25 if width_px / height_px > 1.6 else math.hypot(width_px, height_px)
    return focal_35mm / _FULL_FRAME_DIAGONAL_MM * diagonal_px


def _plain_camera(
    width_px: int, height_px: int, focal_px: float, words: str, sigma: float
) -> CameraModel:
    camera = Camera(
        width_px, height_px, focal_px, focal_px, (width_px - 1) / 2, (height_px - 1) / 2
    )
    aov_deg = camera.angle_of_view_deg[0]
    return CameraModel(
        camera, f"{words} ({aov_deg:.1f} deg across, lens distortion unknown)", sigma
    )


def _fits(preset: CameraPreset, width_px: int, focal_length_mm: float) -> bool:
    """Whether EXIF's focal length is the preset's, or, without one, the pictures are of its size.

    A second camera may carry the same model name. Videos and resized photos of colour cameras have other sizes.
    """
    if _known(focal_length_mm):
        return preset.changes_lens or abs(focal_length_mm / preset.focal_mm - 1) < 0.1
    return preset == _nearest_in_size(
        find_presets(preset.codes[0] if preset.codes else preset.name), width_px
    )


def _nearest_in_size(presets: Sequence[CameraPreset], width_px: int) -> CameraPreset:
    """Of several cameras with one name that whose pictures are this wide, else the first."""
    return next((each for each in presets if each.width_px == width_px), presets[0])


def _known(number: float) -> bool:
    return math.isfinite(number) and number > 0


def _is_lens(focal_px: float, width_px: int) -> bool:
    """Whether this focal length belongs to a lens of 3 to 150 deg across."""
    return _known(focal_px) and 0.134 < focal_px / width_px < 19.1


def _clean(text: str) -> str:
    """EXIF text, which cameras pad with zero bytes and blanks."""
    return "".join(letter for letter in text if letter.isprintable()).strip()


def _xml_matrix(name: str, rows: int, columns: int, numbers: Floats) -> str:
    data = " ".join(f"{number:.17g}" for number in numbers)
    return (
        f'<{name} type_id="opencv-matrix">\n  <rows>{rows}</rows>\n  <cols>{columns}</cols>\n  <dt>d</dt>\n'
        f"  <data>{data}</data>\n</{name}>\n"
    )
