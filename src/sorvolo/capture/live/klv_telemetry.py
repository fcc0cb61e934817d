"""MISB ST 0601 as Sorvolo's records: telemetry columns, the camera's angles, the ground's height, the lens."""

from collections import Counter, deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from math import cos, isfinite, isnan, nan, radians, sin, tan
from pathlib import Path
from statistics import median
from typing import Any, TypeAlias

import av
import numpy as np

from sorvolo.capture.live.klv import LocalSet, VmtiTarget, encode, local_sets, vmti_set
from sorvolo.capture.telemetry.cleaning import clean, notice
from sorvolo.capture.video_stream import ONE_FILE
from sorvolo.errors import InputError
from sorvolo.geometry.arrays import Matrix3
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.geodesy import Geodetic, LocalFrame
from sorvolo.geometry.pose import gimbal_angles_from_rotation, site_from_gimbal_rotation
from sorvolo.survey.corrected import CorrectedFrame
from sorvolo.survey.flight import TELEMETRY_COLUMNS, CameraModel, Notice, Telemetry

FORMAT = "klv"
"""The name that `Telemetry.format` carries."""

OWN_TAGS = (
    "height_above_takeoff_m",
    "horizontal_sigma_m",
    "vertical_sigma_m",
    "tilt_sigma_deg",
    "heading_sigma_deg",
    "course_deg",
    "speed_m_s",
)
"""Tags of ours that are named as their columns."""

# of a focal length from the field of view: operators round it, and zooms lag behind it
_FOV_SIGMA = 0.03
_LEAST_DOWN = radians(5)  # of a view whose middle is on the ground; flatter ones meet it far away
_LEVEL_FROM_CAMERA = site_from_gimbal_rotation(0.0, 0.0, 0.0)


def columns_of(stated: LocalSet) -> dict[str, float]:
    """A local set's numbers as telemetry columns (survey.flight.TELEMETRY_COLUMNS); only those that it states.

    Tag 15 is above mean sea level (orthometric), tags 75 and 104 above the ellipsoid. The camera's angles come from
    the platform's (5, 6 or 90, 7 or 91) and the sensor's relative to it (18-20); without tag 18 or 19 the aircraft's
    alone are given. A relative roll that is not stated is taken as 0.
    """
    full_m = stated["sensor_ellipsoid_height_extended_m"]
    columns = {
        "latitude_deg": stated["sensor_latitude_deg"],
        "longitude_deg": stated["sensor_longitude_deg"],
        "orthometric_height_m": stated["sensor_true_altitude_m"],
        "ellipsoidal_height_m": full_m if isfinite(full_m) else stated["sensor_ellipsoid_height_m"],
        **{name: stated[name] for name in OWN_TAGS},
    }
    heading = stated["platform_heading_deg"]
    pitch = _first_known(stated["platform_pitch_full_deg"], stated["platform_pitch_deg"])
    roll = _first_known(stated["platform_roll_full_deg"], stated["platform_roll_deg"])
    columns |= {"body_yaw_deg": heading, "body_pitch_deg": pitch, "body_roll_deg": roll}
    relative = stated["sensor_relative_azimuth_deg"], stated["sensor_relative_elevation_deg"]
    if all(map(isfinite, (heading, pitch, roll, *relative))):
        own_roll = stated["sensor_relative_roll_deg"]
        rotation = site_from_sensor_rotation(
            (heading, pitch, roll), (*relative, own_roll if isfinite(own_roll) else 0.0)
        )
        columns |= zip(
            ("camera_yaw_deg", "camera_pitch_deg", "camera_roll_deg"),
            gimbal_angles_from_rotation(rotation),
        )
    return {name: value for name, value in columns.items() if isfinite(value)}


def site_from_sensor_rotation(
    platform_deg: tuple[float, float, float], relative_deg: tuple[float, float, float]
) -> Matrix3:
    """site_from_camera rotation from heading, pitch, roll of the platform and azimuth, elevation, roll relative to it.

    ST 0601, tags 5-7 and 18-20: each triple turns about z, y, x in that order, and the second starts from the
    platform's axes. With level = site_from_camera of a camera that looks level to the north,
    site_from_platform = turn(platform) level^-1 and the whole is turn(platform) level^-1 turn(relative).
    """
    return (
        site_from_gimbal_rotation(*platform_deg)
        @ _LEVEL_FROM_CAMERA.T
        @ site_from_gimbal_rotation(*relative_deg)
    )


def ground_elevation_m(stated: LocalSet) -> float:
    """The ground's height at the frame's centre in the reference of the sensor's own height; NaN where unknown.

    Tag 25 (mean sea level) belongs to tag 15, tag 78 (ellipsoid) to tags 75 and 104.
    """
    if isfinite(stated["sensor_true_altitude_m"]):
        return stated["frame_center_elevation_m"]
    return stated["frame_center_ellipsoid_height_m"]


def camera_of(stated: LocalSet, width_px: int, height_px: int) -> CameraModel | None:
    """The camera by its field of view (tags 16 and 17), for frames of this size; None where it is not stated.

    A vertical angle that does not fit square pixels within 10 % is of another cut of the sensor and not used.
    """
    across_deg, down_deg = stated["sensor_horizontal_fov_deg"], stated["sensor_vertical_fov_deg"]
    if not 1 < across_deg < 150:
        return None
    camera = Camera.from_angle_of_view(width_px, height_px, across_deg)
    words = f"the stream's field of view (ST 0601 tag 16): {across_deg:.1f} deg across"
    if 1 < down_deg < 150:
        fy_px = 0.5 * height_px / tan(radians(down_deg) / 2)
        if abs(fy_px / camera.fx_px - 1) < 0.1:
            camera = Camera(width_px, height_px, camera.fx_px, fy_px, camera.cx_px, camera.cy_px)
    return CameraModel(camera, words, _FOV_SIGMA)


def klv_notices(counts: Mapping[str, int]) -> list[Notice]:
    """What was wrong with the local sets that `klv.local_sets` counted."""
    return [
        *notice(
            "bad_checksum",
            counts.get("bad_checksum", 0),
            "{} metadata packets dropped: bad or missing checksum",
        ),
        *notice(
            "unreadable_line",
            counts.get("damaged", 0),
            "{} metadata packets dropped: damaged or cut",
        ),
        *notice(
            "no_time", counts.get("no_time", 0), "{} metadata packets dropped: no time in them"
        ),
    ]


def klv_streams(container: Any) -> list[Any]:
    """The KLV streams of a PyAV container; private data of unknown kind counts as well."""
    data = (stream for stream in container.streams if stream.type == "data")
    return [
        stream
        for stream in data
        if str(getattr(stream, "name", "") or "") in ("klv", "bin_data", "")
    ]


@dataclass(frozen=True, eq=False)
class FileMetadata:
    """The metadata inside a video file; `lens` is a local set with the field of view, if any has it.

    `ground_elevation_m` is the median, in the reference of the sensor's own height; NaN where unknown.
    """

    telemetry: Telemetry
    lens: LocalSet | None
    ground_elevation_m: float


def read_klv_file(path: Path) -> FileMetadata | None:
    """The ST 0601 metadata inside a video file; None where it has none.

    `video_time_ns` counts from the video's first frame. Only the packets are read, nothing is decoded. Raises
    InputError when there is metadata but no usable sample in it.
    """
    counts: Counter[str] = Counter()
    sets = _sets_in(path, counts)
    return metadata_of(sets, counts, path.name) if sets or counts else None


def metadata_of(
    sets: Sequence[tuple[int, LocalSet]], counts: Counter[str], name: str
) -> FileMetadata:
    """What local sets state, each with its time in the video (ns; negative where the packet has none).

    `counts` are what `klv.local_sets` counted. Raises InputError, which calls the file `name`, without a usable sample.
    """
    dated = [(stamp_ns, each) for stamp_ns, each in sets if each.time_ns]
    counts["no_time"] += len(sets) - len(dated)
    timed, video_ns = [each for _, each in dated], [stamp_ns for stamp_ns, _ in dated]
    is_tied = min(video_ns, default=-1) >= 0  # for all samples or for none
    # Telemetry's columns over several sets, NaN where one states nothing.
    rows = [columns_of(each) for each in timed]
    telemetry = clean(
        FORMAT,
        name,
        [each.time_ns for each in timed],
        {column: [row.get(column, nan) for row in rows] for column in TELEMETRY_COLUMNS},
        video_ns if is_tied else None,
        notices=klv_notices(counts),
    )
    lens = next((each for each in timed if isfinite(each["sensor_horizontal_fov_deg"])), None)
    grounds_m = list(filter(isfinite, map(ground_elevation_m, timed)))
    return FileMetadata(telemetry, lens, median(grounds_m) if grounds_m else nan)


def _sets_in(path: Path, counts: Counter[str]) -> list[tuple[int, LocalSet]]:
    """The local sets of a file with their times since its first frame; -1 where a packet has none."""
    found: list[tuple[int, LocalSet]] = []
    firsts_ns: list[int] = []
    try:
        with av.open(f"file:{path}", options=ONE_FILE) as container:
            streams = klv_streams(container)
            if not streams or not container.streams.video:
                return []
            for packet in container.demux([container.streams.video[0], *streams]):
                # When a packet is shown, ns on its file's clock; -1 where it states nothing.
                stamp = packet.pts if packet.pts is not None else packet.dts
                stamp_ns = -1 if stamp is None else round(stamp * packet.time_base * 1_000_000_000)
                if packet.stream.type != "video":
                    found += [(stamp_ns, each) for each in local_sets(bytes(packet), counts)]
                elif stamp_ns >= 0:
                    firsts_ns.append(stamp_ns)
    except (av.FFmpegError, IndexError):
        pass  # a damaged place: what came before it is used, and the video's reader counts the damage
    first_ns = min(firsts_ns, default=0)
    return [(stamp_ns - first_ns if stamp_ns >= 0 else -1, each) for stamp_ns, each in found]


# ---- inside ---------------------------------------------------------------------------------------------------


def _first_known(*values: float) -> float:
    return next((value for value in values if isfinite(value)), nan)


_CLOCK = Fraction(1, 90_000)
_Sample: TypeAlias = tuple[float, bytes]  # seconds from the first frame, and the local set
_COPIED = ("h264", "hevc", "mpeg2video", "mpeg4", "av1")  # pictures that a transport stream holds


def mux_klv(
    video: Path,
    target: Path,
    samples: Sequence[CorrectedFrame],
    headings_deg: Sequence[float],
    height_reference: str,
    detections: Mapping[float, Sequence[VmtiTarget]],
) -> None:
    """Write `target`, an MPEG transport stream with the video's own packets and these samples as MISB ST 0601.

    Nothing is encoded anew; metadata streams of the video are left out. `samples` are in order of time, `video_s` from
    the first frame; `headings_deg` are the aircraft's at each of them, clockwise from north; `detections` are what the
    frame of a sample at this `video_s` shows (ST 0903). Raises InputError for a
    file that is no video, or whose pictures no transport stream holds.
    """
    try:
        with av.open(f"file:{video}", options=ONE_FILE) as source:
            if not source.streams.video:
                raise InputError(f"{video}: no pictures in it; KLV is written into videos")
            pictures = source.streams.video[0]
            size_px = pictures.codec_context.width, pictures.codec_context.height
            packets = []
            for sample, heading_deg in zip(samples, headings_deg, strict=True):
                seen = detections.get(sample.video_s, ())
                packet = packet_of(sample, heading_deg, height_reference, seen, size_px)
                packets.append((sample.video_s, packet))
            if pictures.codec_context.name not in _COPIED:
                raise InputError(
                    f"{video}: pictures in {pictures.codec_context.name} do not go into a transport stream as they are;"
                    f" {', '.join(_COPIED)} do"
                )
            _copy(source, pictures, target, packets)
    except av.FFmpegError as error:
        raise InputError(f"{video}: cannot be copied into a transport stream ({error})") from error


def packet_of(
    sample: CorrectedFrame,
    heading_deg: float,
    height_reference: str,
    detections: Sequence[VmtiTarget] = (),
    size_px: tuple[int, int] = (0, 0),
) -> bytes:
    """The local set of one sample, with the detections of its frame of this width and height.

    The camera is given as a sensor on a level platform with the aircraft's heading: receivers find the camera's own
    angles from the two together, and show the aircraft by the heading.
    """
    platform_deg = (heading_deg % 360, 0.0, 0.0)
    # azimuth, elevation and roll relative to the platform, deg, of a camera that stands so:
    # the inverse of `site_from_sensor_rotation`
    site_from_camera_rotation = site_from_gimbal_rotation(
        sample.yaw_deg, sample.pitch_deg, sample.roll_deg
    )
    site_from_platform = site_from_gimbal_rotation(*platform_deg) @ _LEVEL_FROM_CAMERA.T
    azimuth_deg, elevation_deg, roll_deg = gimbal_angles_from_rotation(
        site_from_platform.T @ site_from_camera_rotation
    )
    values = {
        "platform_heading_deg": platform_deg[0],
        "platform_pitch_deg": 0.0,
        "platform_roll_deg": 0.0,
        "sensor_latitude_deg": sample.latitude_deg,
        "sensor_longitude_deg": (sample.longitude_deg + 180) % 360 - 180,
        "sensor_horizontal_fov_deg": sample.horizontal_fov_deg,
        "sensor_vertical_fov_deg": sample.vertical_fov_deg,
        "sensor_relative_azimuth_deg": azimuth_deg,
        "sensor_relative_elevation_deg": elevation_deg,
        "sensor_relative_roll_deg": roll_deg % 360,
    }
    ground_m = sample.height_m - sample.above_ground_m
    if height_reference == "ellipsoidal":
        values |= {
            "sensor_ellipsoid_height_m": sample.height_m,
            "sensor_ellipsoid_height_extended_m": sample.height_m,
            "frame_center_ellipsoid_height_m": ground_m,
        }
    elif height_reference == "orthometric":
        values |= {"sensor_true_altitude_m": sample.height_m, "frame_center_elevation_m": ground_m}
    down, yaw = radians(-sample.pitch_deg), radians(sample.yaw_deg)
    if down < _LEAST_DOWN:
        return encode(sample.time_ns, values)
    reach_m = sample.above_ground_m / tan(down)
    below = LocalFrame(Geodetic(sample.latitude_deg, sample.longitude_deg))
    found = below.wgs84_from_site(np.array([[reach_m * sin(yaw), reach_m * cos(yaw)]]))
    centre_deg = float(found[0][0]), float(found[1][0])
    values |= dict(zip(("frame_center_latitude_deg", "frame_center_longitude_deg"), centre_deg))
    vmti = vmti_set(detections, size_px, centre_deg) if detections else b""
    return encode(sample.time_ns, values, vmti=vmti)


def _copy(
    source: av.container.InputContainer,
    pictures: av.VideoStream,
    target: Path,
    samples: Sequence[_Sample],
) -> None:
    metadata = klv_streams(source)
    known = [stream for stream in (pictures, *source.streams.audio) if stream not in metadata]
    with av.open(str(target), "w", format="mpegts") as output:
        copies = {stream.index: output.add_stream_from_template(stream) for stream in known}
        data = output.add_data_stream("klv")
        waiting, first_s = deque(samples), nan
        # The packets of some streams; one without a time only flushes its stream.
        for packet in (each for each in source.demux(known) if each.dts is not None):
            stamp = packet.pts if packet.pts is not None else packet.dts
            now_s = float((stamp or 0) * (packet.time_base or _CLOCK))
            if packet.stream.index == pictures.index and isnan(first_s):
                first_s = now_s
            for sample in _due(waiting, now_s - first_s):
                _mux(output, data, sample, first_s)
            packet.stream = copies[packet.stream.index]
            output.mux(packet)
        for sample in waiting:
            _mux(output, data, sample, 0.0 if isnan(first_s) else first_s)


def _due(waiting: deque[_Sample], video_s: float) -> Iterator[_Sample]:
    """Take the samples up to a time of the video out of those that wait; none while that is not known (NaN)."""
    while waiting and waiting[0][0] <= video_s:
        yield waiting.popleft()


def _mux(
    output: av.container.OutputContainer, stream: av.stream.Stream, sample: _Sample, first_s: float
) -> None:
    video_s, local_set = sample
    packet = av.Packet(local_set)
    stamp = max(0, round((first_s + video_s) / _CLOCK))
    packet.stream, packet.time_base, packet.pts, packet.dts = stream, _CLOCK, stamp, stamp
    output.mux(packet)
