"""A flight's corrected telemetry for other programs: ODM's geo.txt, GPX, CSV, Cursor on Target."""

import csv
import io
import math
import re
from collections.abc import Sequence
from dataclasses import asdict
from xml.etree.ElementTree import Element, SubElement, tostring

from sorvolo.geometry.pose import body_nadir_angles_from_rotation, site_from_gimbal_rotation
from sorvolo.geometry.units import DAY_NS
from sorvolo.store.exports.cursor_on_target import (
    DRONE_TYPE,
    UNKNOWN_M,
    begin_event,
    event_bytes,
)
from sorvolo.store.exports.places import wrapped_deg
from sorvolo.store.exports.plain import utc_text
from sorvolo.survey.corrected import CorrectedFrame

_STALE_S = 30.0  # after which TAK shows a drone as lost; by choice
_NADIR_DEG = -80.0  # pitch below which a camera hovering in wind may look to any side; by choice
_EARTH_M = 6_371_000.0  # mean radius, good enough for a speed


def is_dated(frames: Sequence[CorrectedFrame]) -> bool:
    """Whether the flight's date is known; else its times count from 1970."""
    return all(each.time_ns >= DAY_NS for each in frames)


def geo_txt(frames: Sequence[CorrectedFrame]) -> str:
    """OpenDroneMap's image geolocation file: name, longitude, latitude, height, yaw, pitch, roll, two accuracies.

    ODM's angles are those of a body, x to the top of the picture, y to its right, z along the view (compute_opk of its
    photo.py): a gimbal's pitch plus 90 is the same only where its roll is 0. Names are as `name_for_odm` has them.
    """
    rows = ["EPSG:4326"]
    for each in frames:
        sigma = "" if math.isnan(each.sigma_m) else f" {each.sigma_m:.3f} {1.5 * each.sigma_m:.3f}"
        yaw_deg, pitch_deg, roll_deg = _body_angles_deg(each)
        rows.append(
            f"{name_for_odm(each.name)} {each.longitude_deg:.9f} {each.latitude_deg:.9f} {each.height_m:.3f} "
            f"{yaw_deg:.3f} {pitch_deg:.3f} {roll_deg:.3f}{sigma}"
        )
    return "\n".join(rows) + "\n"


def name_for_odm(name: str) -> str:
    """A photo's name as geo.txt can hold it: a space would end its column, and becomes an underscore."""
    return re.sub(r"\s", "_", name)


def track_csv(frames: Sequence[CorrectedFrame], height_reference: str) -> str:
    """One line for each frame; the header names what heights count from. Without a date `utc` is empty."""
    text, has_dates = io.StringIO(), is_dated(frames)
    names = list(asdict(frames[0])) if frames else []
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*(name for name in names if name != "time_ns"), "utc", "height_reference"])
    for each in frames:
        row = {name: value for name, value in asdict(each).items() if name != "time_ns"}
        plain = [
            "" if isinstance(value, float) and math.isnan(value) else value
            for value in row.values()
        ]
        writer.writerow([*plain, utc_text(each.time_ns) if has_dates else "", height_reference])
    return text.getvalue()


def track_gpx(frames: Sequence[CorrectedFrame], name: str) -> bytes:
    """A GPX 1.1 track; each point's description has its sigma. Without a date no point has a time."""
    gpx = Element(
        "gpx",
        {"version": "1.1", "creator": "sorvolo", "xmlns": "http://www.topografix.com/GPX/1/1"},
    )
    track = SubElement(gpx, "trk")
    SubElement(track, "name").text = name
    segment, has_dates = SubElement(track, "trkseg"), is_dated(frames)
    for each in frames:
        point = SubElement(
            segment,
            "trkpt",
            {"lat": f"{each.latitude_deg:.9f}", "lon": f"{wrapped_deg(each.longitude_deg):.9f}"},
        )
        SubElement(point, "ele").text = f"{each.height_m:.3f}"
        if has_dates:
            SubElement(point, "time").text = utc_text(each.time_ns)
        SubElement(point, "name").text = each.name
        if not math.isnan(each.sigma_m):
            SubElement(point, "desc").text = f"position accuracy {each.sigma_m:.2f} m (1 sigma)"
    return (
        b'<?xml version="1.0" encoding="UTF-8"?>\n' + bytes(tostring(gpx, encoding="utf-8")) + b"\n"
    )


def cot_track(frames: Sequence[CorrectedFrame], name: str, *, is_ellipsoidal: bool) -> bytes:
    """A Cursor on Target event a line for each frame, which has a date: the drone, its course, and its camera's field
    of view.

    `<sensor>` has the azimuth of the view, its angles across (`fov`) and along (`vfov`), the elevation (-90 is down)
    and the distance to the ground along the axis, metres. Where the camera looks nearly straight down the azimuth is
    where the top of the picture points: the view's own swings all round with each tremor.
    """
    lines = []
    for number, each in enumerate(frames):
        event, detail = begin_event(
            f"sorvolo.{name}",
            DRONE_TYPE,
            each.longitude_deg,
            each.latitude_deg,
            now_ns=each.time_ns,
            stale_s=_STALE_S,
            height=f"{each.height_m:.1f}" if is_ellipsoidal else UNKNOWN_M,
            error_m=each.sigma_m,
        )
        SubElement(detail, "contact", {"callsign": name})
        down = math.sin(math.radians(-each.pitch_deg))
        azimuth_deg, roll_deg = each.yaw_deg, each.roll_deg
        if each.pitch_deg < _NADIR_DEG:
            azimuth_deg, roll_deg = _body_angles_deg(each)[0], 0.0
        SubElement(
            detail,
            "sensor",
            {
                "azimuth": f"{azimuth_deg % 360:.1f}",
                "elevation": f"{each.pitch_deg:.1f}",
                "roll": f"{roll_deg:.1f}",
                "fov": f"{each.horizontal_fov_deg:.1f}",
                "vfov": f"{each.vertical_fov_deg:.1f}",
                "range": f"{each.above_ground_m / down:.0f}" if down > 0.05 else "0",
                "model": "camera",
                "type": "r-e",
                "version": "0.6",
            },
        )
        if number:
            before = frames[number - 1]
            latitude = math.radians(each.latitude_deg)
            east_m = (
                math.radians(each.longitude_deg - before.longitude_deg)
                * _EARTH_M
                * math.cos(latitude)
            )
            north_m = (latitude - math.radians(before.latitude_deg)) * _EARTH_M
            passed_s = (each.time_ns - before.time_ns) / 1e9
            speed = math.hypot(east_m, north_m) / passed_s if passed_s > 0 else 0.0
            SubElement(
                detail,
                "track",
                {
                    "course": f"{math.degrees(math.atan2(east_m, north_m)) % 360:.1f}",
                    "speed": f"{speed:.2f}",
                },
            )
        SubElement(detail, "remarks").text = f"frame {each.name}, corrected by Sorvolo"
        lines.append(event_bytes(event))
    return b"\n".join(lines) + b"\n"


def _body_angles_deg(each: CorrectedFrame) -> tuple[float, float, float]:
    """Yaw, pitch and roll of a body that the camera looks straight down from, x to the top of the picture."""
    return body_nadir_angles_from_rotation(
        site_from_gimbal_rotation(each.yaw_deg, each.pitch_deg, each.roll_deg)
    )
