"""Flight plans for other programs: GeoJSON, KML, QGroundControl's .plan, and DJI's .kmz.

Heights are above the take-off point in all of them. The .plan works for PX4 and ArduPilot multicopters: take-off,
speed, the gimbal straight down, every pass with the camera triggered by distance flown, return to launch.
"""

import io
import json
import zipfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias
from xml.etree.ElementTree import register_namespace

from sorvolo.errors import SettingsError
from sorvolo.geometry.geodesy import LocalFrame
from sorvolo.geometry.planning import FlightPlan
from sorvolo.store.atomic import atomic_write_bytes
from sorvolo.store.exports.places import kml_bytes
from sorvolo.store.exports.plain import feature
from sorvolo.store.pages.words import xml_of

_SAFE_HEIGHT_M = 20.0  # at least so high before the way to the first waypoint begins
_ZIP_TIME = (1980, 1, 1, 0, 0, 0)  # the same plan makes the same bytes


class DjiDrone(NamedTuple):
    """DJI's numbers of a drone and its camera; `payload` None where the app needs none."""

    drone: int
    sub_type: int
    payload: int | None
    photo: str  # which of its lenses' pictures are kept


DJI_DRONES = {
    "fly": DjiDrone(
        68, 0, None, "visible"
    ),  # what DJI Fly writes itself, for Mini, Air and Mavic drones
    "m300": DjiDrone(60, 0, 42, "wide"),
    "m350": DjiDrone(89, 0, 42, "wide"),
    "m30": DjiDrone(67, 0, 52, "wide"),
    "m30t": DjiDrone(67, 1, 53, "wide"),
    "m3e": DjiDrone(77, 0, 66, "visible"),
    "m3t": DjiDrone(77, 1, 67, "wide"),
    "m3m": DjiDrone(77, 2, 68, "visible"),
    "m3d": DjiDrone(91, 0, 80, "wide"),
    "m3td": DjiDrone(91, 1, 81, "wide"),
}
"""Drones by the name to give; the numbers are those of DJI's table of supported products."""


def check_drone(drone: str) -> None:
    """Raise SettingsError for a drone that is none of `DJI_DRONES`."""
    if drone not in DJI_DRONES:
        raise SettingsError(f"--dji-drone {drone}: choose one of {', '.join(DJI_DRONES)}")


def wpml_kmz(plan: FlightPlan, lonlat: Sequence[Sequence[float]], drone: str) -> bytes:
    """The .kmz of a plan for a drone of `DJI_DRONES`; `lonlat` are its waypoints, [longitude_deg, latitude_deg] each.

    Raises SettingsError for another drone's name.
    """
    check_drone(drone)
    register_namespace("", "http://www.opengis.net/kml/2.2")
    register_namespace("wpml", "http://www.dji.com/wpmz/1.0.2")
    height_m = round(plan.height_m, 2)
    values: dict[str, Any] = {
        "package": "sorvolo.store.exports",
        "drone": DJI_DRONES[drone],
        "lonlat": lonlat,
        "speed": f"{plan.speed_m_s:g}",
        "height": f"{height_m:g}",
        "safe_height": f"{max(height_m, _SAFE_HEIGHT_M):g}",
        "photo_spacing": f"{round(plan.photo_spacing_m, 2):g}",
    }
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in ("template.kml", "waylines.wpml"):
            info = zipfile.ZipInfo(f"wpmz/{name}", _ZIP_TIME)
            info.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(info, xml_of(name, declaration=True, **values))
    return made.getvalue()


_TAKEOFF, _WAYPOINT, _RETURN, _CHANGE_SPEED, _MOUNT_CONTROL, _TRIGGER_DISTANCE = (
    22,
    16,
    20,
    178,
    205,
    206,
)  # MAV_CMD
_MOUNT_BY_MAVLINK = 2  # MAV_MOUNT_MODE: to the angles given
_FRAME_RELATIVE_HEIGHT, _FRAME_MISSION = 3, 2  # MAV_FRAME
_HEIGHT_RELATIVE = 1  # QGroundControl's AltitudeMode
_AUTOPILOT_PX4, _VEHICLE_QUADROTOR = 12, 2  # MAV_AUTOPILOT, MAV_TYPE

_ENDINGS = (".plan", ".kmz", ".geojson", ".json", ".kml")

_Item: TypeAlias = dict[str, Any]
_LonLat: TypeAlias = list[list[float]]


def write_waypoints(
    path: Path, plan: FlightPlan, frame: LocalFrame, name: str = "survey", *, dji_drone: str = "fly"
) -> None:
    """Write the plan, whose metres are those of `frame`, in the format that the path's ending names.

    `dji_drone`, one of `DJI_DRONES`, is what a .kmz is for. Raises SettingsError as `check_waypoint_file` does,
    StoreError when the file cannot be written.
    """
    check_waypoint_file(path, dji_drone)
    writers: Mapping[str, Callable[[FlightPlan, _LonLat, str], str | bytes]] = {
        ".plan": _qgroundcontrol,
        ".kmz": lambda plan, lonlat, _: wpml_kmz(plan, lonlat, dji_drone),
        ".geojson": _geojson,
        ".json": _geojson,
        ".kml": _kml,
    }
    writer = writers[path.suffix.lower()]
    latitude_deg, longitude_deg, _ = frame.wgs84_from_site(plan.waypoints_m)
    lonlat = [
        [round(float(lon), 9), round(float(lat), 9)]
        for lon, lat in zip(longitude_deg, latitude_deg)
    ]
    content = writer(plan, lonlat, name)
    atomic_write_bytes(path, content.encode() if isinstance(content, str) else content)


def check_waypoint_file(path: Path, dji_drone: str = "fly") -> None:
    """Raise SettingsError for an ending other than .plan, .kmz, .geojson, .json or .kml, and for an unknown drone."""
    if path.suffix.lower() not in _ENDINGS:
        raise SettingsError(
            f"{path}: flight plans are written as {', '.join(_ENDINGS)}, not as {path.suffix!r}"
        )
    if path.suffix.lower() == ".kmz":
        check_drone(dji_drone)


def check_waypoint_files(paths: Sequence[Path], made: Path, dji_drone: str = "fly") -> None:
    """As `check_waypoint_file` for files to be written after long work; a folder that is not there is refused as well,
    but for the one that the work has `made` by then."""
    for path in paths:
        check_waypoint_file(path, dji_drone)
        if not path.parent.is_dir() and path.parent.resolve() != made.resolve():
            raise SettingsError(f"--refly {path}: there is no folder {path.parent}")


def _geojson(plan: FlightPlan, lonlat: _LonLat, name: str) -> str:
    """The path as a line with the plan's numbers, then every waypoint as a point."""
    path = _feature("LineString", lonlat, {"name": name, **_summary(plan)})
    points = [
        _feature("Point", place, {"waypoint": index, "camera": "on" if index % 2 == 0 else "off"})
        for index, place in enumerate(lonlat)
    ]
    return json.dumps({"type": "FeatureCollection", "features": [path, *points]}, indent=1)


def _feature(kind: str, coordinates: Any, properties: _Item) -> _Item:
    return feature({"type": kind, "coordinates": coordinates}, properties)


def _summary(plan: FlightPlan) -> _Item:
    return {
        "height_above_takeoff_m": round(plan.height_m, 3),
        "speed_m_s": plan.speed_m_s,
        "strip_bearing_deg": round(plan.strip_bearing_deg, 3),
        "strip_spacing_m": round(plan.strip_spacing_m, 3),
        "photo_spacing_m": round(plan.photo_spacing_m, 3),
        "photo_interval_s": round(plan.photo_interval_s, 3),
        "photos": plan.photo_count,
        "distance_m": round(plan.distance_m, 1),
        "duration_s": round(plan.duration_s, 1),
    }


def _kml(plan: FlightPlan, lonlat: _LonLat, name: str) -> str:
    words = json.dumps(_summary(plan), indent=1)
    return kml_bytes(name, line=lonlat, height_m=plan.height_m, description=words).decode()


def _qgroundcontrol(plan: FlightPlan, lonlat: _LonLat, _name: str) -> str:
    """QGroundControl's plan file, version 1; a plan has no name of its own there."""
    commands: list[tuple[int, int, list[float | None]]] = [
        (_TAKEOFF, _FRAME_RELATIVE_HEIGHT, [0, 0, 0, None, *_place(plan, lonlat[0])]),
        (_CHANGE_SPEED, _FRAME_MISSION, [1, plan.speed_m_s, -1, 0, 0, 0, 0]),
        (
            _MOUNT_CONTROL,
            _FRAME_MISSION,
            [-90, 0, 0, 0, 0, 0, _MOUNT_BY_MAVLINK],
        ),  # pitch, roll, yaw
    ]
    for index, place in enumerate(lonlat):
        starts_pass = index % 2 == 0
        commands.append((_WAYPOINT, _FRAME_RELATIVE_HEIGHT, [0, 0, 0, None, *_place(plan, place)]))
        spacing_m = round(plan.photo_spacing_m, 2) if starts_pass else 0
        commands.append(
            (_TRIGGER_DISTANCE, _FRAME_MISSION, [spacing_m, 0, int(starts_pass), 0, 0, 0, 0])
        )
    commands.append((_RETURN, _FRAME_MISSION, [0, 0, 0, 0, 0, 0, 0]))
    mission = {
        "version": 2,
        "firmwareType": _AUTOPILOT_PX4,
        "vehicleType": _VEHICLE_QUADROTOR,
        "cruiseSpeed": plan.speed_m_s,
        "hoverSpeed": plan.speed_m_s,
        "globalPlanAltitudeMode": _HEIGHT_RELATIVE,
        "plannedHomePosition": [lonlat[0][1], lonlat[0][0], 0],
        "items": [_item(plan, index, *command) for index, command in enumerate(commands, start=1)],
    }
    return json.dumps(
        {
            "fileType": "Plan",
            "version": 1,
            "groundStation": "QGroundControl",
            "geoFence": {"circles": [], "polygons": [], "version": 2},
            "rallyPoints": {"points": [], "version": 2},
            "mission": mission,
        },
        indent=1,
    )


def _place(plan: FlightPlan, lonlat: list[float]) -> list[float]:
    return [lonlat[1], lonlat[0], round(plan.height_m, 2)]


def _item(
    plan: FlightPlan, jump_id: int, command: int, frame: int, params: list[float | None]
) -> _Item:
    item: _Item = {
        "type": "SimpleItem",
        "autoContinue": True,
        "command": command,
        "doJumpId": jump_id,
        "frame": frame,
        "params": params,
    }
    if frame == _FRAME_RELATIVE_HEIGHT:
        item |= {
            "AMSLAltAboveTerrain": None,
            "Altitude": round(plan.height_m, 2),
            "AltitudeMode": _HEIGHT_RELATIVE,
        }
    return item
