"""KLV put into a video: its pictures and sound copied as they are into a transport stream, the metadata beside them."""

from collections import deque
from collections.abc import Iterator, Sequence
from fractions import Fraction
from math import isnan, nan
from pathlib import Path
from typing import Any, TypeAlias

import av

from sorvolo.capture.live.klv import encode
from sorvolo.capture.live.klv_telemetry import klv_streams, relative_angles
from sorvolo.errors import InputError
from sorvolo.geometry.pose import site_from_gimbal_rotation
from sorvolo.survey.corrected import CorrectedFrame

_CLOCK = Fraction(1, 90_000)
_Sample: TypeAlias = tuple[float, bytes]  # seconds from the first frame, and the local set
_COPIED = ("h264", "hevc", "mpeg2video", "mpeg4", "av1")  # pictures that a transport stream holds


def mux_klv(
    video: Path,
    target: Path,
    samples: Sequence[CorrectedFrame],
    headings_deg: Sequence[float],
    height_reference: str,
) -> None:
    """Write `target`, an MPEG transport stream with the video's own packets and these samples as MISB ST 0601.

    Nothing is encoded anew; metadata streams of the video are left out. `samples` are in order of time, `video_s` from
    the first frame; `headings_deg` are the aircraft's at each of them, clockwise from north. Raises InputError for a
    file that is no video, or whose pictures no transport stream holds.
    """
    packets = [
        (sample.video_s, packet_of(sample, heading_deg, height_reference))
        for sample, heading_deg in zip(samples, headings_deg, strict=True)
    ]
    try:
        with av.open(f"file:{video}", options={"protocol_whitelist": "file"}) as source:
            if not source.streams.video:
                raise InputError(f"{video}: no pictures in it; KLV is written into videos")
            pictures = source.streams.video[0]
            if pictures.codec_context.name not in _COPIED:
                raise InputError(
                    f"{video}: pictures in {pictures.codec_context.name} do not go into a transport stream as they are;"
                    f" {', '.join(_COPIED)} do"
                )
            _copy(source, pictures, target, packets)
    except av.FFmpegError as error:
        raise InputError(f"{video}: cannot be copied into a transport stream ({error})") from error


def packet_of(sample: CorrectedFrame, heading_deg: float, height_reference: str) -> bytes:
    """The local set of one sample.

    The camera is given as a sensor on a level platform with the aircraft's heading: receivers find the camera's own
    angles from the two together, and show the aircraft by the heading.
    """
    platform_deg = (heading_deg % 360, 0.0, 0.0)
    azimuth_deg, elevation_deg, roll_deg = relative_angles(
        platform_deg, site_from_gimbal_rotation(sample.yaw_deg, sample.pitch_deg, sample.roll_deg)
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
    return encode(sample.time_ns, values)


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
        for packet in _packets(source, known):
            now_s = _seconds(packet)
            if packet.stream.index == pictures.index and isnan(first_s):
                first_s = now_s
            for sample in _due(waiting, now_s - first_s):
                _mux(output, data, sample, first_s)
            packet.stream = copies[packet.stream.index]
            output.mux(packet)
        for sample in waiting:
            _mux(output, data, sample, 0.0 if isnan(first_s) else first_s)


def _packets(source: av.container.InputContainer, streams: Sequence[Any]) -> Iterator[Any]:
    """The packets of some streams; one without a time only flushes its stream."""
    return (each for each in source.demux(streams) if each.dts is not None)


def _due(waiting: deque[_Sample], video_s: float) -> Iterator[_Sample]:
    """Take the samples up to a time of the video out of those that wait; none while that is not known (NaN)."""
    while waiting and waiting[0][0] <= video_s:
        yield waiting.popleft()


def _seconds(packet: Any) -> float:
    stamp = packet.pts if packet.pts is not None else packet.dts
    return float((stamp or 0) * (packet.time_base or _CLOCK))


def _mux(
    output: av.container.OutputContainer, stream: av.stream.Stream, sample: _Sample, first_s: float
) -> None:
    video_s, local_set = sample
    packet = av.Packet(local_set)
    stamp = max(0, round((first_s + video_s) / _CLOCK))
    packet.stream, packet.time_base, packet.pts, packet.dts = stream, _CLOCK, stamp, stamp
    output.mux(packet)
