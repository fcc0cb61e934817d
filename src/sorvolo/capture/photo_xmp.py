"""What drones' makers write into a photo's XMP: time, place, heights by their reference, attitude, stated errors.

DJI, Parrot, Skydio, Autel, senseFly and Pix4D's "Camera" namespace are known. Sources: DJI's user manuals ("XMP data
list"), Parrot's "Embedded Photo Metadata", Skydio's "camera and metadata overview", Pix4D's "Specifications for the
EXIF and XMP tags", and real files of senseFly's (docs/formats-in.md).
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from math import atan2, degrees, hypot, isfinite, nan
from xml.etree.ElementTree import Element

from defusedxml import ElementTree

from sorvolo.geometry.pose import gimbal_angles_from_rotation, site_from_body_nadir_rotation

_DECLARATION = re.compile(rb"""xmlns:([\w.-]+)\s*=\s*["']([^"']+)["']""")
_MAKER_OF_PREFIX = {
    "drone-dji": "dji",
    "drone-parrot": "parrot",
    "drone-skydio": "skydio",
    "drone": "autel",
    "sensefly": "sensefly",
    "camera": "camera",
}
# programs that rewrite XMP choose prefixes of their own
_MAKER_OF_ADDRESS = (
    ("drone-dji", "dji"),
    ("dji.com", "dji"),
    ("parrot.com/drone", "parrot"),
    ("drone-skydio", "skydio"),
    ("sensefly.com/camera", "camera"),
    ("sensefly.com", "sensefly"),
    ("pix4d.com/camera", "camera"),
)
_RTK_FLAGS = range(17, 51)  # 16 is a single receiver's fix, 17 to 50 are corrected ones
_GIMBAL = {
    axis: (
        f"dji:Gimbal{axis}Degree",
        f"autel:Gimbal{axis}Degree",
        f"parrot:Camera{axis}Degree",
        f"skydio:CameraOrientationNED.{axis}",
    )
    for axis in ("Yaw", "Pitch", "Roll")
}
_BODY = {
    axis: (
        f"dji:Flight{axis}Degree",
        f"autel:Flight{axis}Degree",
        f"parrot:Drone{axis}Degree",
        f"skydio:VehicleOrientationNED.{axis}",
        "sensefly:Heading" if axis == "Yaw" else f"sensefly:{axis}Angle",
    )
    for axis in ("Yaw", "Pitch", "Roll")
}
_ABOVE_TAKEOFF = (
    "dji:RelativeAltitude",
    "autel:RelativeAltitude",
    "skydio:RelativeAltitude",
    "sensefly:Height",
    "camera:AboveGroundAltitude",
)
_ABOVE_SEA = ("sensefly:AltitudeAMSL", "skydio:AbsoluteAltitude")


@dataclass(frozen=True)
class StatedLens:
    """The lens that a photo's XMP states, in pixels of a photo `width_px` wide; NaN where it states none.

    `cx_px` and `cy_px` count from the photo's centre; `distortion` is k1 k2 p1 p2 k3, zeros where the maker has taken
    it out or does not state it. `is_calibrated`: measured on this very camera, not the design.
    """

    width_px: int = 0
    fx_px: float = nan
    fy_px: float = nan
    cx_px: float = 0.0
    cy_px: float = 0.0
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    is_calibrated: bool = False


def is_thermal(properties: Mapping[str, str]) -> bool:
    """Whether DJI's ImageSource names the thermal camera of several."""
    source = properties.get("dji:ImageSource", "").lower()
    return "infrared" in source or "thermal" in source


def stated_lens(properties: Mapping[str, str], width_px: int, height_px: int) -> StatedLens:
    """DJI's DewarpData ("date;fx,fy,cx,cy,k1,k2,p1,p2,k3"), else a calibrated focal length, DJI's or Skydio's.

    The size is that of the photo as the camera wrote it, whose pixels the numbers count.
    """
    numbers = [
        finite(text) for text in properties.get("dji:DewarpData", "").rpartition(";")[2].split(",")
    ]
    if len(numbers) == 9 and all(map(isfinite, numbers)):
        fx_px, fy_px, cx_px, cy_px, k1, k2, p1, p2, k3 = numbers
        is_undistorted = number(properties, "dji:DewarpFlag") == 1
        distortion = (0.0, 0.0, 0.0, 0.0, 0.0) if is_undistorted else (k1, k2, p1, p2, k3)
        return StatedLens(width_px, fx_px, fy_px, cx_px, cy_px, distortion, True)
    fx_px = _first(properties, "dji:CalibratedFocalLength", "skydio:CalibratedFocalLength.X")
    fy_px = _first(properties, "skydio:CalibratedFocalLength.Y")
    centre_px = [
        _first(
            properties,
            f"dji:CalibratedOpticalCenter{axis}",
            f"skydio:CalibratedOpticalCenter.{axis}",
        )
        - 0.5 * size
        for axis, size in (("X", width_px), ("Y", height_px))
    ]
    is_near = all(isfinite(each) and abs(each) < 0.1 * width_px for each in centre_px)
    return StatedLens(
        width_px,
        fx_px,
        fy_px if isfinite(fy_px) else fx_px,
        *(centre_px if is_near else (0.0, 0.0)),
    )


def read_properties(packet: bytes) -> dict[str, str]:
    """Every known maker's properties of an XMP packet, attribute or element, as "maker:Name".

    Parts of a structure are "maker:Structure.Name". Raises ValueError or ParseError for damaged XML, and for entities,
    which no camera writes.
    """
    makers: dict[str, str] = {}
    for prefix, address in _DECLARATION.findall(packet):
        text = address.decode("utf-8", "replace")
        known = next((maker for part, maker in _MAKER_OF_ADDRESS if part in text.lower()), None)
        if maker := known or _MAKER_OF_PREFIX.get(prefix.decode("ascii", "replace").lower()):
            makers[text] = maker
    properties: dict[str, str] = {}
    _collect(ElementTree.fromstring(packet.strip(b"\0 \r\n\t")), "", makers, properties)
    return properties


def telemetry_columns(properties: Mapping[str, str]) -> dict[str, float]:
    """The telemetry columns (survey.flight.TELEMETRY_COLUMNS) that the properties state, NaN for the others."""
    north_m_s = _first(properties, "dji:FlightXSpeed", "autel:FlightXSpeed")
    east_m_s = _first(properties, "dji:FlightYSpeed", "autel:FlightYSpeed")
    speed_m_s = hypot(north_m_s, east_m_s)
    columns = {
        "height_above_takeoff_m": _first(properties, *_ABOVE_TAKEOFF),
        **{
            f"camera_{axis.lower()}_deg": _first(properties, *names)
            for axis, names in _GIMBAL.items()
        },
        **{f"body_{axis.lower()}_deg": _first(properties, *names) for axis, names in _BODY.items()},
        **{
            "speed_m_s": speed_m_s
            if isfinite(speed_m_s)
            else _first(properties, "sensefly:GroundSpeed"),
            "course_deg": degrees(atan2(east_m_s, north_m_s)) % 360
            if north_m_s or east_m_s
            else nan,
        },
        **_sigma_columns(properties),
    }
    if not isfinite(columns["camera_pitch_deg"]):
        columns |= _nadir_angles(properties)
    return columns


def place_columns(properties: Mapping[str, str]) -> dict[str, float]:
    """Latitude and longitude as XMP states them, for photos whose EXIF has none."""
    return {
        "latitude_deg": _first(
            properties,
            "dji:GpsLatitude",
            "sensefly:Latitude",
            "skydio:Latitude",
            "autel:GpsLatitude",
        ),
        # DJI's firmware spells it "GpsLongtitude" as often as not
        "longitude_deg": _first(
            properties,
            "dji:GpsLongitude",
            "dji:GpsLongtitude",
            "sensefly:Longitude",
            "skydio:Longitude",
            "autel:GpsLongitude",
            "autel:GpsLongtitude",
        ),
    }


def height_columns(
    properties: Mapping[str, str], exif_m: float, *, exif_is_ellipsoidal: bool
) -> dict[str, float]:
    """Heights above the sea and above the ellipsoid, from XMP and EXIF's altitude, NaN where not stated.

    EXIF's own reference is often wrong: RTK drones of DJI's and Autel's write ellipsoidal heights as heights above the
    sea, and so does senseFly. A property that names its reference goes before EXIF.
    """
    exif_m = (
        exif_m
        if isfinite(exif_m)
        else _first(properties, "dji:AbsoluteAltitude", "autel:AbsoluteAltitude")
    )
    above_sea_m = _first(properties, *_ABOVE_SEA)
    above_ellipsoid_m = _first(properties, "sensefly:AltitudeWGS84")
    if exif_is_ellipsoidal or _states_ellipsoid(properties):
        above_ellipsoid_m = above_ellipsoid_m if isfinite(above_ellipsoid_m) else exif_m
    elif not (isfinite(above_sea_m) or isfinite(above_ellipsoid_m)):
        above_sea_m = exif_m
    return {"orthometric_height_m": above_sea_m, "ellipsoidal_height_m": above_ellipsoid_m}


def number(properties: Mapping[str, str], name: str) -> float:
    """The number of texts such as "+39.80" or "3980/100"; NaN otherwise."""
    numerator, slash, denominator = properties.get(name, "").strip().partition("/")
    value = finite(numerator)
    if not slash:
        return value
    divisor = finite(denominator)
    return value / divisor if divisor else nan


def _collect(
    element: Element, owner: str, makers: Mapping[str, str], properties: dict[str, str]
) -> None:
    """Add an element's properties and those below it; `owner` is the structure, "Name.", that it stands in."""
    maker, name = _qualified(element.tag, makers)
    content = " ".join("".join(element.itertext()).split())
    if maker and content:
        properties.setdefault(f"{maker}:{owner}{name}", content)
    parts = [(*_qualified(key, makers), str(value)) for key, value in element.attrib.items()]
    is_structure = maker and (len(element) or any(part_maker for part_maker, _, _ in parts))
    inside = f"{name}." if is_structure else owner
    for part_maker, part, value in parts:
        if part_maker and value:
            properties.setdefault(f"{part_maker}:{inside}{part}", value)
    for child in element:
        _collect(child, inside, makers, properties)


def _qualified(tag: object, makers: Mapping[str, str]) -> tuple[str, str]:
    address, _, name = str(tag).lstrip("{").rpartition("}")
    return makers.get(address, ""), name


def _states_ellipsoid(properties: Mapping[str, str]) -> bool:
    """Whether XMP states that EXIF's altitude is counted from the ellipsoid."""
    if "ellips" in properties.get("camera:VertCS", "").lower():
        return True
    if properties.get("dji:AltitudeType", "").lower() == "rtkalt":
        return True
    flag = number(properties, "autel:RtkFlag")
    return isfinite(flag) and int(flag) in _RTK_FLAGS


def _sigma_columns(properties: Mapping[str, str]) -> dict[str, float]:
    """Standard deviations where they are stated; zero and less is none."""
    horizontal_m = _first(properties, "camera:GPSXYAccuracy")
    vertical_m = _first(properties, "camera:GPSZAccuracy")
    for maker in ("dji", "autel"):
        east_m = number(properties, f"{maker}:RtkStdLon")
        north_m = number(properties, f"{maker}:RtkStdLat")
        if isfinite(east_m) and isfinite(north_m):
            horizontal_m = hypot(east_m, north_m) / 2**0.5
            vertical_m = number(properties, f"{maker}:RtkStdHgt")
    pitch_deg = number(properties, "camera:IMUPitchAccuracy")
    roll_deg = number(properties, "camera:IMURollAccuracy")
    columns = {
        "horizontal_sigma_m": horizontal_m,
        "vertical_sigma_m": vertical_m,
        "tilt_sigma_deg": hypot(pitch_deg, roll_deg) / 2**0.5,
        "heading_sigma_deg": number(properties, "camera:IMUYawAccuracy"),
    }
    return {name: value if value > 0 else nan for name, value in columns.items()}


def _nadir_angles(properties: Mapping[str, str]) -> dict[str, float]:
    """senseFly's and Pix4D's Camera:Yaw, Pitch, Roll, which are 0 when looking down, as a gimbal's angles."""
    angles = [number(properties, f"camera:{axis}") for axis in ("Yaw", "Pitch", "Roll")]
    if not all(map(isfinite, angles)):
        return {}
    found = gimbal_angles_from_rotation(site_from_body_nadir_rotation(*angles))
    return dict(zip(("camera_yaw_deg", "camera_pitch_deg", "camera_roll_deg"), found))


def _first(properties: Mapping[str, str], *names: str) -> float:
    return next((value for name in names if isfinite(value := number(properties, name))), nan)


def finite(text: str) -> float:
    """The number that a text is; NaN for any other text."""
    try:
        value = float(text)
    except ValueError:
        return nan
    return value if isfinite(value) else nan
