"""From a calibration file's named numbers to a checked camera of the frames' size; nothing is read here."""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TypeAlias
from xml.etree.ElementTree import Element

import numpy as np
from defusedxml import ElementTree
from defusedxml.common import DefusedXmlException

from sorvolo.capture.small_files import read_small_file, text_of
from sorvolo.errors import GeometryError, InputError
from sorvolo.geometry.arrays import Floats, Matrix3
from sorvolo.geometry.camera import Camera
from sorvolo.survey.flight import CameraModel

Node: TypeAlias = float | str | Floats

_NUMBER = re.compile(
    r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?|[-+]?\.?(?:inf|nan)", re.IGNORECASE
)


def read_nodes(path: Path) -> Mapping[str, Node]:
    """The nodes of a camera file, recognised by its first character.

    Raises InputError for a file that is missing, empty, far too large, or no XML or YAML.
    """
    raw = read_small_file(path, "camera file")
    text = text_of(path, raw, "camera file", "XML or YAML with named values")
    if text.startswith("<"):
        try:
            root = ElementTree.fromstring(text)
        except (ElementTree.ParseError, DefusedXmlException, ValueError) as error:
            raise InputError(f"{path}: broken XML: {error}") from error
        nodes: dict[str, Node] = {}
        for element in _named_elements(root):
            children = {child.tag: (child.text or "") for child in element}
            if "data" in children:
                value: Node = _camera_nodes_matrix(path, element.tag, children)
            else:
                value = _scalar_or_array(element.text or "")
            nodes.setdefault(_key(element.tag), value)
    else:
        nodes = _from_yaml(path, text)
    if not nodes:
        raise InputError(
            f"{path}: not a camera file: neither XML nor YAML with named values was found"
        )
    return nodes


def _named_elements(parent: Element) -> Iterator[Element]:
    """The leaves and the matrices under `parent`, a matrix as one."""
    for child in parent:
        if len(child) == 0 or child.find("data") is not None:
            yield child
        else:
            yield from _named_elements(child)


def _from_yaml(path: Path, text: str) -> dict[str, Node]:
    """OpenCV's and ROS's YAML: top-level keys, each with a scalar, a [list], or rows, cols, dt and data."""
    nodes: dict[str, Node] = {}
    blocks = re.split(r"^(?=[A-Za-z_]\w*\s*:)", text, flags=re.MULTILINE)
    for block in blocks:
        named = re.match(r"([A-Za-z_]\w*)\s*:(.*)", block, flags=re.DOTALL)
        if named is None:
            continue
        name, body = named.groups()
        fields = dict(re.findall(r"^\s+(rows|cols|dt)\s*:\s*(\S+)", body, flags=re.MULTILINE))
        data = re.search(r"\bdata\s*:\s*\[(.*?)\]", body, flags=re.DOTALL)
        if data is not None:
            nodes.setdefault(
                _key(name), _camera_nodes_matrix(path, name, {**fields, "data": data.group(1)})
            )
        else:
            nodes.setdefault(_key(name), _scalar_or_array(body.strip().strip("[]")))
    return nodes


def _camera_nodes_matrix(path: Path, name: str, children: Mapping[str, str]) -> Floats:
    """An OpenCV matrix as (rows, cols); raises InputError when its data do not fill it."""
    kind = children.get("dt", "d").strip().strip('"')
    if kind not in ("d", "f", "i"):
        raise InputError(
            f"{path}: {name} holds values of type {kind!r}; numbers (d, f or i) are needed"
        )
    numbers = np.array([_number(each) for each in _NUMBER.findall(children["data"])])
    rows = children.get("rows", "1").strip()
    columns = children.get("cols", str(len(numbers))).strip()
    is_shape = all(re.fullmatch(r"[0-9]{1,6}", each) for each in (rows, columns))
    if not (is_shape and int(rows) * int(columns) == len(numbers)):
        raise InputError(
            f"{path}: {name} should hold {rows[:20]} x {columns[:20]} numbers but has {len(numbers)}"
        )
    return numbers.reshape(int(rows), int(columns))


def _scalar_or_array(text: str) -> Node:
    plain = text.strip().strip('"')
    words = plain.replace(",", " ").split()
    if not words or not all(_NUMBER.fullmatch(word) for word in words):
        return plain
    numbers = [_number(word) for word in words]
    return numbers[0] if len(numbers) == 1 else np.array(numbers)


def _number(text: str) -> float:
    """YAML writes .nan and .inf where Python reads nan and inf."""
    return float(re.sub(r"\.(?=[a-zA-Z])", "", text))


def _key(name: str) -> str:
    return re.sub(r"[^a-z0-9]", "", name.lower())


OPENCV_ORDER = ("k1", "k2", "p1", "p2", "k3")
"""Also what `Camera.distortion` holds."""

THESIS_ORDER = ("k1", "k2", "k3", "p1", "p2")
"""How section 2.3 of the thesis lists them, and the UMCD dataset's file with it."""

_MATRIX_KEYS = (
    "cameramatrix",
    "intrinsicmatrix",
    "intrinsics",
    "intrinsic",
    "mtx",
    "k",
    "m1",
    "cm",
)
_DISTORTION_KEYS = (
    "distortioncoefficients",
    "distortioncoeffs",
    "distcoeffs",
    "distcoeff",
    "distcoefs",
    "distortion",
    "dist",
    "d",
    "d1",
)
_WIDTH_KEYS = ("imagewidth", "imgwidth", "framewidth", "widthpx", "width")
_HEIGHT_KEYS = ("imageheight", "imgheight", "frameheight", "heightpx", "height")
_SIZE_KEYS = ("imagesize", "imgsize", "framesize", "size", "resolution")
_LARGEST_TANGENTIAL = 0.02
"""Lenses are centred well enough that |p1| and |p2| stay below this; a third coefficient above it is a k3."""

# relative, of a calibrated focal length, where the file states none; by choice
_CALIBRATED_SIGMA = 0.003
_RESIZED_SIGMA = 0.01
"""A video mode may use a part of the sensor of the same shape, which no file states."""


def camera_from_nodes(
    file_name: str, nodes: Mapping[str, Node], width_px: int, height_px: int
) -> CameraModel:
    """The camera for frames of this size. Raises InputError, naming the file, for what describes none.

    A calibration of another size serves when the shape is the same; `origin` states it.
    """
    model = nodes.get("distortionmodel", nodes.get("cameramodel", "pinhole"))
    fisheye = nodes.get("fisheyemodel", nodes.get("fisheye", 0.0))
    is_other = isinstance(model, str) and any(
        word in model.lower() for word in ("fisheye", "equidistant", "rational", "omni", "double")
    )
    if is_other or fisheye not in (0.0, "false", "False", ""):
        raise InputError(
            f"{file_name}: a {model if is_other else 'fisheye'} lens model; the five-coefficient one (k1 "
            "k2 p1 p2 k3) "
            "is needed: calibrate again without the fisheye or rational option"
        )
    matrix = _matrix(file_name, nodes)
    distortion, order_words = _distortion(file_name, nodes)
    words = f"calibration {file_name}, {order_words}"
    size = _size(nodes)
    if size is None:
        # the optical centre lies near the middle of the picture
        size = width_px, height_px
        if (np.abs((2 * matrix[:2, 2] + 1) / size - 1) > 0.2).any():
            raise InputError(
                f"{file_name}: no image size, and its optical centre ({matrix[0, 2]:.1f}, {matrix[1, 2]:.1f}) "
                f"is not that of {width_px}x{height_px} pictures; add image_width and image_height"
            )
        words += ", no image size in it, taken as that of the pictures"
    if abs(size[0] * height_px / (size[1] * width_px) - 1) > 0.01:
        raise InputError(
            f"{file_name}: made for {size[0]}x{size[1]} pictures, but these are {width_px}x{height_px}, "
            "another "
            "shape; calibrate in the mode that the flight used"
        )
    try:
        camera = Camera(*size, matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], distortion)
    except GeometryError as error:
        raise InputError(f"{file_name}: {error}") from error
    check_lens(file_name, camera)
    stated = nodes.get("focalsigma")
    sigma = (
        float(stated) if isinstance(stated, float) and 1e-4 < stated <= 0.5 else _CALIBRATED_SIGMA
    )
    if size != (width_px, height_px):
        words += f", resized from {size[0]}x{size[1]}"
        camera, sigma = camera.resized(width_px, height_px), max(sigma, _RESIZED_SIGMA)
    return CameraModel(camera, words, sigma)


def _matrix(file_name: str, nodes: Mapping[str, Node]) -> Matrix3:
    found = _first(nodes, _MATRIX_KEYS)
    if found is None:
        numbers = [_first(nodes, (f"{name}px", name)) for name in ("fx", "fy", "cx", "cy")]
        if any(not isinstance(each, float) for each in numbers):
            raise InputError(
                f"{file_name}: no camera matrix; a node such as camera_matrix (3 x 3), or fx, fy, cx and "
                "cy, is needed"
            )
        fx, fy, cx, cy = (float(each) for each in numbers if isinstance(each, float))
        return _checked_matrix(file_name, np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]))
    matrix = np.asarray(found) if isinstance(found, np.ndarray) else np.zeros(0)
    if matrix.size != 9:
        raise InputError(f"{file_name}: the camera matrix must be 3 x 3, got shape {matrix.shape}")
    return _checked_matrix(file_name, matrix.reshape(3, 3))


def _checked_matrix(file_name: str, matrix: Matrix3) -> Matrix3:
    """The matrix (3, 3) as it is; raises InputError where it is no pinhole camera's without skew."""
    if not np.isfinite(matrix).all():
        raise InputError(f"{file_name}: the camera matrix holds a value that is no number")
    if not np.allclose(matrix[2], [0, 0, 1], atol=1e-6) or abs(matrix[1, 0]) > 1e-6:
        raise InputError(
            f"{file_name}: the camera matrix must be [fx 0 cx; 0 fy cy; 0 0 1], got {matrix.tolist()}; is it "
            "transposed?"
        )
    if abs(matrix[0, 1]) > 1e-3 * abs(matrix[0, 0]):
        raise InputError(
            f"{file_name}: the camera matrix has a skew of {matrix[0, 1]:g} px; 0 is needed"
        )
    return matrix


def _distortion(file_name: str, nodes: Mapping[str, Node]) -> tuple[Floats, str]:
    """The coefficients in OpenCV's order and, in words, the order that was read and why."""
    named = {name: nodes[name] for name in OPENCV_ORDER if isinstance(nodes.get(name), float)}
    if named:
        numbers = np.array([float(named.get(name, 0.0)) for name in OPENCV_ORDER])
        return _finite(file_name, numbers), "distortion coefficients by name"
    found = _first(nodes, _DISTORTION_KEYS)
    if found is None or isinstance(found, str):
        return np.zeros(5), "without distortion coefficients"
    numbers = _finite(file_name, np.atleast_1d(np.asarray(found, dtype=np.float64)).ravel())
    if len(numbers) > 5 and not numbers[5:].any():
        numbers = numbers[:5]
    if len(numbers) not in (4, 5):
        raise InputError(
            f"{file_name}: {len(numbers)} distortion coefficients; 4 (k1 k2 p1 p2) or 5 (k1 k2 p1 p2 k3) "
            "are needed: "
            "calibrate again without the rational, thin-prism or tilted option"
        )
    order, why = _order(file_name, nodes, numbers)
    by_name = dict(zip(order, numbers))
    reordered = np.array([by_name.get(name, 0.0) for name in OPENCV_ORDER])
    return reordered, f"distortion read as {' '.join(order)} ({why})"


def _order(
    file_name: str, nodes: Mapping[str, Node], numbers: Floats
) -> tuple[tuple[str, ...], str]:
    stated = nodes.get("distortionorder")
    if isinstance(stated, str) and stated.strip():
        order = tuple(stated.replace(",", " ").lower().split())
        if sorted(order) != sorted(OPENCV_ORDER[: len(numbers)]):
            raise InputError(
                f"{file_name}: distortion_order {stated!r} does not name its {len(numbers)} coefficients"
            )
        return order, "as the file states"
    if len(numbers) == 4:
        return OPENCV_ORDER[:4], "OpenCV's order"
    third, _, fifth = np.abs(numbers[2:])
    if third > _LARGEST_TANGENTIAL >= fifth:
        return (
            THESIS_ORDER,
            f"the UMCD dataset's order: a third coefficient of {numbers[2]:g} can only be k3",
        )
    if third > _LARGEST_TANGENTIAL:
        return OPENCV_ORDER, "OpenCV's order, though neither order looks plausible: check the file"
    if fifth > _LARGEST_TANGENTIAL:
        return OPENCV_ORDER, "OpenCV's order, the only plausible one"
    return (
        OPENCV_ORDER,
        "OpenCV's order assumed; name it in a node distortion_order if it is k1 k2 k3 p1 p2",
    )


def _finite(file_name: str, numbers: Floats) -> Floats:
    if not np.isfinite(numbers).all():
        raise InputError(f"{file_name}: a distortion coefficient is no number")
    return numbers


def _size(nodes: Mapping[str, Node]) -> tuple[int, int] | None:
    width, height = _first(nodes, _WIDTH_KEYS), _first(nodes, _HEIGHT_KEYS)
    both = _first(nodes, _SIZE_KEYS)
    if isinstance(both, np.ndarray) and both.size == 2:
        width, height = (float(each) for each in both.ravel())
    if (
        isinstance(width, float)
        and isinstance(height, float)
        and 1 <= width < 1e5
        and 1 <= height < 1e5
    ):
        return int(width), int(height)
    return None


def check_lens(file_name: str, camera: Camera) -> None:
    """Raise InputError if the distortion folds the picture onto itself: a pixel would have no single ray.

    On the way from the optical centre to any point of the border, the picture must only go outwards. A test
    of pixel -> ray -> pixel would not do: beyond the fold another ray, far outside, may hit the same pixel.
    """
    corners_px = camera.corners_px
    borders_px = np.vstack((corners_px, 0.5 * (corners_px + np.roll(corners_px, 1, axis=0))))
    centre_px = np.array([camera.cx_px, camera.cy_px])
    try:
        ideal = camera.rays_from_pixels(borders_px)[:, None, :2] * np.linspace(0, 1, 65)[1:, None]
        rays = np.dstack((ideal, np.ones(ideal.shape[:2]))).reshape(-1, 3)
        way_px = camera.pixels_from_points(rays).reshape(*ideal.shape) - centre_px
        reach_px = np.linalg.norm(way_px, axis=2)
        wanted_px = np.linalg.norm(borders_px - centre_px, axis=1)
        is_good = (np.diff(reach_px, axis=1) > 0).all() and (
            np.abs(reach_px[:, -1] - wanted_px) < 0.5
        ).all()
    except np.linalg.LinAlgError:
        is_good = False
    if not is_good:
        raise InputError(
            f"{file_name}: the distortion coefficients {camera.distortion.tolist()} (k1 k2 p1 p2 k3) fold "
            "the "
            "picture at its edge; calibrate again with views that reach the corners, or check the "
            "coefficients' "
            "order"
        )


def _first(nodes: Mapping[str, Node], keys: tuple[str, ...]) -> Node | None:
    return next((nodes[key] for key in keys if key in nodes), None)
