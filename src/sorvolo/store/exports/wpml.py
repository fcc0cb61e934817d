"""Flight plans for DJI's apps: a .kmz with wpmz/template.kml and wpmz/waylines.wpml, in DJI WPML 1.0.2.

Elements and their order follow DJI's Cloud API documentation, "DJI WPML". Heights are above the take-off point. The
gimbal points straight down from the first waypoint on; on each pass the camera takes a photo every so many metres.
"""

import io
import zipfile
from collections.abc import Mapping, Sequence
from typing import NamedTuple
from xml.etree.ElementTree import Element, SubElement, register_namespace, tostring

from sorvolo.errors import SettingsError
from sorvolo.geometry.planning import FlightPlan

_KML, _WPML = "http://www.opengis.net/kml/2.2", "http://www.dji.com/wpmz/1.0.2"
_SAFE_HEIGHT_M = 20.0  # at least so high before the way to the first waypoint begins
_ZIP_TIME = (1980, 1, 1, 0, 0, 0)  # the same plan makes the same bytes
_Texts = Mapping[str, str | int | float]


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
    register_namespace("", _KML)
    register_namespace("wpml", _WPML)
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, document in (
            ("template.kml", _template(plan, lonlat, DJI_DRONES[drone])),
            ("waylines.wpml", _waylines(plan, lonlat, DJI_DRONES[drone])),
        ):
            info = zipfile.ZipInfo(f"wpmz/{name}", _ZIP_TIME)
            info.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(info, tostring(document, encoding="utf-8", xml_declaration=True))
    return made.getvalue()


def _template(plan: FlightPlan, lonlat: Sequence[Sequence[float]], drone: DjiDrone) -> Element:
    """What DJI Pilot 2 shows and edits."""
    kml, folder = _document(plan, drone, author="sorvolo")
    _add(folder, {"templateType": "waypoint", "templateId": 0})
    _add(
        _sub(folder, "waylineCoordinateSysParam"),
        {"coordinateMode": "WGS84", "heightMode": "relativeToStartPoint"},
    )
    _add(
        folder,
        {
            "autoFlightSpeed": plan.speed_m_s,
            "gimbalPitchMode": "usePointSetting",
            "globalHeight": _height(plan),
        },
    )
    _add(_sub(folder, "globalWaypointHeadingParam"), _HEADING)
    _add(folder, {"globalWaypointTurnMode": _TURN_MODE})
    _add(_sub(folder, "payloadParam"), {"payloadPositionIndex": 0, "imageFormat": drone.photo})
    for index, place in enumerate(lonlat):
        placemark = _placemark(folder, index, place)
        _add(
            placemark,
            {
                "ellipsoidHeight": _height(plan),
                "height": _height(plan),
                "useGlobalHeight": 1,
                "useGlobalSpeed": 1,
                "useGlobalHeadingParam": 1,
                "useGlobalTurnParam": 1,
                "gimbalPitchAngle": -90,
            },
        )
        _add_actions(placemark, plan, index)
    return kml


def _waylines(plan: FlightPlan, lonlat: Sequence[Sequence[float]], drone: DjiDrone) -> Element:
    """What the drone flies."""
    kml, folder = _document(plan, drone, author="")
    _add(
        folder,
        {
            "templateId": 0,
            "executeHeightMode": "relativeToStartPoint",
            "waylineId": 0,
            "autoFlightSpeed": plan.speed_m_s,
        },
    )
    for index, place in enumerate(lonlat):
        placemark = _placemark(folder, index, place)
        _add(placemark, {"executeHeight": _height(plan), "waypointSpeed": plan.speed_m_s})
        _add(_sub(placemark, "waypointHeadingParam"), _HEADING)
        _add(
            _sub(placemark, "waypointTurnParam"),
            {"waypointTurnMode": _TURN_MODE, "waypointTurnDampingDist": 0},
        )
        _add(placemark, {"useStraightLine": 1})
        _add_actions(placemark, plan, index)
    return kml


_HEADING: _Texts = {
    "waypointHeadingMode": "followWayline",
    "waypointHeadingPathMode": "followBadArc",
}
_TURN_MODE = (
    "toPointAndStopWithDiscontinuityCurvature"  # straight to each end of a pass, and a stop there
)


def _document(plan: FlightPlan, drone: DjiDrone, *, author: str) -> tuple[Element, Element]:
    """The root with its mission's settings, and the empty folder of waypoints."""
    kml = Element(f"{{{_KML}}}kml")
    document = SubElement(kml, f"{{{_KML}}}Document")
    if author:
        _add(document, {"author": author})
    mission = _sub(document, "missionConfig")
    _add(
        mission,
        {
            "flyToWaylineMode": "safely",
            "finishAction": "goHome",
            "exitOnRCLost": "executeLostAction",
            "executeRCLostAction": "goBack",
            "takeOffSecurityHeight": max(_height(plan), _SAFE_HEIGHT_M),
            "globalTransitionalSpeed": plan.speed_m_s,
            "globalRTHHeight": max(_height(plan), _SAFE_HEIGHT_M),
        },
    )
    _add(
        _sub(mission, "droneInfo"),
        {"droneEnumValue": drone.drone, "droneSubEnumValue": drone.sub_type},
    )
    if drone.payload is not None:
        _add(
            _sub(mission, "payloadInfo"),
            {
                "payloadEnumValue": drone.payload,
                "payloadSubEnumValue": 0,
                "payloadPositionIndex": 0,
            },
        )
    return kml, SubElement(document, f"{{{_KML}}}Folder")


def _placemark(folder: Element, index: int, place: Sequence[float]) -> Element:
    placemark = SubElement(folder, f"{{{_KML}}}Placemark")
    point = SubElement(placemark, f"{{{_KML}}}Point")
    SubElement(point, f"{{{_KML}}}coordinates").text = f"{place[0]:.9f},{place[1]:.9f}"
    _add(placemark, {"index": index})
    return placemark


def _add_actions(placemark: Element, plan: FlightPlan, index: int) -> None:
    """The gimbal turned down at the first waypoint, photos from each pass's start to its end."""
    if index == 0:
        _add_group(
            placemark,
            0,
            (0, 0),
            {"actionTriggerType": "reachPoint"},
            "gimbalRotate",
            {
                "gimbalHeadingYawBase": "north",
                "gimbalRotateMode": "absoluteAngle",
                "gimbalPitchRotateEnable": 1,
                "gimbalPitchRotateAngle": -90,
                "gimbalRollRotateEnable": 0,
                "gimbalRollRotateAngle": 0,
                "gimbalYawRotateEnable": 0,
                "gimbalYawRotateAngle": 0,
                "gimbalRotateTimeEnable": 0,
                "gimbalRotateTime": 0,
                "payloadPositionIndex": 0,
            },
        )
    if index % 2 == 0:
        _add_group(
            placemark,
            1 + index // 2,
            (index, index + 1),
            {
                "actionTriggerType": "multipleDistance",
                "actionTriggerParam": round(plan.photo_spacing_m, 2),
            },
            "takePhoto",
            {"payloadPositionIndex": 0, "fileSuffix": "map", "useGlobalPayloadLensIndex": 1},
        )


def _add_group(
    placemark: Element,
    number: int,
    waypoints: tuple[int, int],
    trigger: _Texts,
    action: str,
    settings: _Texts,
) -> None:
    group = _sub(placemark, "actionGroup")
    _add(
        group,
        {
            "actionGroupId": number,
            "actionGroupStartIndex": waypoints[0],
            "actionGroupEndIndex": waypoints[1],
            "actionGroupMode": "sequence",
        },
    )
    _add(_sub(group, "actionTrigger"), trigger)
    one = _sub(group, "action")
    _add(one, {"actionId": 0, "actionActuatorFunc": action})
    _add(_sub(one, "actionActuatorFuncParam"), settings)


def _height(plan: FlightPlan) -> float:
    return round(plan.height_m, 2)


def _sub(parent: Element, name: str) -> Element:
    return SubElement(parent, f"{{{_WPML}}}{name}")


def _add(parent: Element, texts: _Texts) -> None:
    for name, text in texts.items():
        _sub(parent, name).text = f"{text:g}" if isinstance(text, float) else str(text)
