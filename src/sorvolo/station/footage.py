"""An input as a stream's messages: pictures as they are, never decoded, with their telemetry."""

import threading
import time
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from math import atan, degrees, isfinite
from pathlib import Path
from typing import Any, Protocol

import av

from sorvolo.capture.flight_telemetry import tied_clock
from sorvolo.capture.live.addresses import (
    FollowedPath,
    StreamAddress,
    is_live_address,
    live_address,
)
from sorvolo.capture.live.klv import LocalSet, local_sets
from sorvolo.capture.live.klv_telemetry import columns_of, klv_streams
from sorvolo.capture.live.links import LINK_FORMS, TelemetryLink, is_link
from sorvolo.capture.live.reader import REFUSALS, open_stream
from sorvolo.capture.live.reconnect import Backoff, LiveSettings, Outages
from sorvolo.capture.source import Source, open_sources, safe_name
from sorvolo.capture.telemetry.nmea import Epoch
from sorvolo.capture.video_stream import ONE_FILE
from sorvolo.errors import InputError
from sorvolo.geometry.camera import Camera
from sorvolo.station.messages import (
    CODECS,
    Kind,
    MessageSample,
    has_picture,
    parameter_sets,
    with_parameter_sets,
)
from sorvolo.survey.flight import CameraModel

_JUMP_US = 10_000_000  # a clock that leaps so far was set anew
_TIME_EVERY_US = 1_000_000  # where there is no telemetry, the time alone is stated so often
_KNOWN_LENS = 0.04  # a focal length that is known so well is worth stating
_DRIFT = 5e-4  # of a camera's clock: 30 ms a minute
_LATE_NS = 5_000_000_000  # more than a connection holds back: the clock begins anew; by choice
_STEP_US = 33_333  # between pictures where a clock began anew


@dataclass(frozen=True)
class Format:
    """What the pictures are. `fps` is 0 where unknown."""

    codec: str
    width: int
    height: int
    fps: float


@dataclass(frozen=True)
class FootagePiece:
    """One access unit or one moment of telemetry, on the flight's clock."""

    kind: Kind
    pts_us: int
    payload: bytes
    is_key: bool = False
    dts_us: int = 0

    def shifted(self, shift_us: int) -> "FootagePiece":
        """The same at another time."""
        return replace(self, pts_us=self.pts_us + shift_us, dts_us=self.dts_us + shift_us)


class UnsendableInput(InputError):
    """A video whose pictures a stream does not carry as they are."""


class Footage(Protocol):
    """What a client sends."""

    @property
    def name(self) -> str:
        """The flight's name, safe as a file's."""

    @property
    def is_live(self) -> bool:
        """Whether it comes when it comes, rather than as fast as it is asked for."""

    @property
    def format(self) -> Format:
        """What its pictures are."""

    def pieces(self, begin_us: int, stop: threading.Event) -> Iterator[FootagePiece]:
        """Everything in order of time; a live flight's clock goes on from `begin_us`."""

    def notices(self) -> Sequence[str]:
        """What was found so far and survived, in words."""


def open_footage(
    text: str, telemetry: str | None, camera: str | None, live: LiveSettings, stop: threading.Event
) -> Footage:
    """The recording or the live source that an input names, as `sorvolo watch` takes them.

    Raises InputError for what cannot be read, UnsendableInput where its pictures are neither H.264 nor H.265.
    """
    if is_live_address(text):
        address = live_address(text)
        if isinstance(address, FollowedPath):
            raise InputError(
                f"{text}: stream takes the camera's address, or a recording; map and watch follow files"
            )
        if telemetry is not None and not is_link(telemetry):
            raise InputError(
                f"--telemetry {telemetry}: a live source's comes from a receiver; give {LINK_FORMS}"
            )
        return LiveFootage(address, telemetry, live, stop)
    sources = open_sources([text], telemetry, camera)
    if len(sources) != 1 or sources[0].kind != "video":
        raise InputError(f"{text}: stream sends one video; photos go to a station as an upload")
    path = Path(text)
    if path.is_dir():
        path = next(each for each in path.iterdir() if each.name == sources[0].inputs[0])
    return Recording(path, sources[0])


class Remains:
    """What an earlier run left in its spool: nothing new is taken."""

    is_live = False

    def __init__(self, name: str, form: Format) -> None:
        self.name, self.format = name, form

    def pieces(self, begin_us: int, stop: threading.Event) -> Iterator[FootagePiece]:
        """See `Footage`."""
        return iter(())

    def notices(self) -> Sequence[str]:
        """See `Footage`."""
        return ()


class Recording:
    """A recorded flight; the same pieces whenever it is read."""

    is_live = False

    def __init__(self, path: Path, source: Source) -> None:
        self._path, self._source = path, source
        self.name = source.name
        self._units = _Units()
        with self._opened() as container:
            self.format = _format_of(container.streams.video[0], path.name)
        self._restarts = 0

    def pieces(self, begin_us: int, stop: threading.Event) -> Iterator[FootagePiece]:
        """See `Footage`. Raises InputError where the file becomes unreadable."""
        samples: deque[FootagePiece] | None = None
        timeline = Timeline(0)
        try:
            with self._opened() as container:
                for unit in self._units.of(container, container.streams.video[0]):
                    if stop.is_set():
                        return
                    if samples is None:  # telemetry counts from the first picture
                        samples = deque(self._samples(unit.pts_us - unit.dts_us))
                    placed = unit.shifted(timeline.shift(unit.dts_us, 0))
                    yield from _until(samples, placed.dts_us)
                    yield placed
        except av.FFmpegError as error:
            raise InputError(f"{self._path.name} is damaged: {error.strerror or error}") from error
        finally:
            self._restarts = timeline.restarts
        yield from _until(samples or deque(), timeline.last_us + _TIME_EVERY_US)

    def notices(self) -> Sequence[str]:
        """See `Footage`."""
        found = [each.text for each in (*self._source.telemetry.notices, *self._source.notices())]
        if self._restarts:
            found.append(f"the video's clock began anew, and was joined: {self._restarts}")
        return [*found, *self._units.notices()]

    def _opened(self) -> Any:
        return av.open(f"file:{self._path}", options=ONE_FILE)

    def _samples(self, first_us: int) -> list[FootagePiece]:
        """The telemetry, or the time alone, on the flight's clock, whose first picture is shown at `first_us`."""
        source = self._source
        lens = _lens_of(source.camera)
        telemetry = source.telemetry
        duration_s = source.frame_count / source.frame_rate_hz if source.frame_rate_hz > 0 else 0.0
        if not len(telemetry):
            start_ns = source.start_ns or time.time_ns()
            times_us = range(0, round(duration_s * 1e6) + 1, _TIME_EVERY_US)
            return [
                _piece(first_us + each, MessageSample(start_ns + each * 1000, {}, lens))
                for each in times_us
            ]
        clock = tied_clock(source, telemetry)
        found = []
        for row, second in enumerate(clock.sample_s):
            if -1.0 <= second <= duration_s + 1.0:
                columns = {name: float(column[row]) for name, column in telemetry.columns.items()}
                stated = lens | _ground(source.ground_elevation_m, columns)
                time_ns = clock.first_frame_utc_ns + round(float(second) * 1e9)
                found.append(
                    _piece(
                        max(0, first_us + round(float(second) * 1e6)),
                        MessageSample(time_ns, columns, stated),
                    )
                )
        return found


class LiveFootage:
    """A camera's stream; opened anew whenever it breaks, until `give_up_s` passed without a picture."""

    is_live = True

    def __init__(
        self,
        address: StreamAddress,
        link: str | None,
        settings: LiveSettings,
        stop: threading.Event,
    ) -> None:
        self._address, self._settings, self._stop = address, settings, stop
        self.name = safe_name(address.shown.partition("://")[2] or address.shown)
        self.outages = Outages(address.shown)
        self._units = _Units()
        self._counts: Counter[str] = Counter()
        self._timeline = Timeline(0)
        self._clock = ArrivalClock()
        self._why = ""  # the last connection broke
        self._fixes: deque[tuple[int, Epoch]] = deque(maxlen=1000)
        self._link = (
            None
            if link is None
            else TelemetryLink(
                link, settings, lambda arrived_ns, epoch: self._fixes.append((arrived_ns, epoch))
            )
        )
        self._container: Any = self._first()
        self.format = _format_of(self._container.streams.video[0], address.shown)

    def pieces(self, begin_us: int, stop: threading.Event) -> Iterator[FootagePiece]:
        """See `Footage`. Raises InputError when the camera comes back with pictures of another kind."""
        self._timeline = Timeline(begin_us)
        if self._link is not None:
            self._link.start()
        backoff, container = Backoff(), self._container
        heard_s = time.monotonic()
        try:
            while not stop.is_set() and time.monotonic() - heard_s < self._settings.give_up_s:
                for piece in self._connected(container):
                    heard_s = time.monotonic()
                    backoff.reset()
                    self.outages.back()
                    yield piece
                    if stop.is_set():
                        return
                self.outages.lost(heard_s, self._why)
                container = None
                self._timeline.restart()
                if not self._address.waits:
                    stop.wait(backoff.next_s())
        finally:
            if self._link is not None:
                self._link.close()

    def notices(self) -> Sequence[str]:
        """See `Footage`."""
        found = [each.text for each in self.outages.notices()]
        found += [each.text for each in self._link.notices()] if self._link is not None else []
        if self._timeline.restarts:
            found.append(
                f"the camera's clock began anew, and was joined: {self._timeline.restarts}"
            )
        return [*found, *self._units.notices()]

    def _connected(self, container: Any) -> Iterator[FootagePiece]:
        """The pieces of one connection, the one given or a new one, until it breaks."""
        try:
            with closing(container or self._open(max(0.2, self._settings.give_up_s))) as opened:
                yield from self._read(opened)
            self._why = "the sender ended the stream"
        except (av.FFmpegError, OSError, ValueError, IndexError) as error:
            self._why = getattr(error, "strerror", None) or str(error)

    def _first(self) -> Any:
        """The first connection. Raises InputError when none comes in `first_s`, or the other side will not have us."""
        until_s = time.monotonic() + self._settings.first_s
        why, backoff = "nothing came", Backoff()
        while (left_s := until_s - time.monotonic()) > 0 and not self._stop.is_set():
            try:
                return self._open(left_s)
            except (av.FFmpegError, OSError, ValueError, IndexError) as error:
                why = getattr(error, "strerror", None) or str(error)
                if isinstance(error, REFUSALS):
                    raise InputError(
                        f"{self._address.shown}: {why}; check the address, the name and the password"
                    ) from error
                if not self._address.waits:
                    self._stop.wait(min(left_s, backoff.next_s()))
        raise InputError(
            f"{self._address.shown}: no picture within {self._settings.first_s:.0f} s ({why}); is the camera sending, "
            "to this address and port?"
        )

    def _open(self, left_s: float) -> Any:
        within_s = min(self._address.opens_s, left_s)
        container = open_stream(self._address, within_s, self._settings)
        video = container.streams.video
        if not video or getattr(video[0].codec_context, "width", None) == 0:
            container.close()  # a slow camera's size comes later
            raise ValueError("a stream without video, or without the size of its pictures")
        return container

    def _read(self, container: Any) -> Iterator[FootagePiece]:
        video = container.streams.video[0]
        found = _format_of(video, self._address.shown)
        if found.codec != self.format.codec:
            raise InputError(
                f"{self._address.shown}: the camera sent {self.format.codec} and now {found.codec}"
            )
        due_us, shift_us = -1, 0
        has_metadata = False
        for item in self._units.of(container, video, klv_streams(container)):
            if isinstance(item, _Data):
                pts_us = self._timeline.last_us if item.pts_us is None else item.pts_us + shift_us
                pieces = [
                    _piece(pts_us, _sample_of(each))
                    for each in local_sets(item.payload, self._counts)
                    if each.time_ns
                ]
                has_metadata |= bool(pieces)
                yield from pieces
                continue
            shift_us = self._timeline.shift(item.dts_us, time.monotonic_ns() // 1000)
            placed = item.shifted(shift_us)
            # the receiver's moments that came since the last picture
            while self._fixes:
                arrived_ns, epoch = self._fixes.popleft()
                age_us = max(0, (time.time_ns() - arrived_ns) // 1000)
                yield _piece(
                    max(0, placed.pts_us - age_us), MessageSample(arrived_ns, dict(epoch.values))
                )
            if not has_metadata and placed.dts_us >= due_us:
                due_us = placed.dts_us + _TIME_EVERY_US
                yield _piece(
                    placed.pts_us, MessageSample(self._clock.utc_ns(placed.pts_us, time.time_ns()))
                )
            yield placed


class Timeline:
    """One clock for a flight whose source's may begin anew: it never jumps back. `shift` and `restart` change it."""

    def __init__(self, begin_us: int) -> None:
        self.last_us = self._begin_us = begin_us
        self.restarts = 0
        self._shift_us: int | None = None
        self._heard_us = 0
        self._is_restarted = False

    def shift(self, dts_us: int, now_us: int) -> int:
        """What to add to the source's times for this picture, which came at `now_us` by a clock that only grows.

        Where the source's clock begins anew the flight goes on after as much time as passed since the last picture.
        """
        if self._shift_us is None:
            self._shift_us = self._begin_us - dts_us
        elif self._is_restarted or not -1 < dts_us + self._shift_us - self.last_us < _JUMP_US:
            self._shift_us = self.last_us + max(_STEP_US, now_us - self._heard_us) - dts_us
            self.restarts += 1
        self._is_restarted = False
        self._heard_us = now_us
        self.last_us = dts_us + self._shift_us
        return self._shift_us

    def restart(self) -> None:
        """The source was opened anew: what it states next is on a new clock."""
        self._is_restarted = self._shift_us is not None


class ArrivalClock:
    """The UTC of pictures whose source states none: what came with the least delay counts. Only `utc_ns` changes it."""

    def __init__(self) -> None:
        self._zero_ns: int | None = None
        self._at_ns = 0

    def utc_ns(self, pts_us: int, now_ns: int) -> int:
        """The UTC of a picture on the flight's clock that came now.

        The delays of single pictures do not move it; it follows a camera's clock that runs slow by up to `_DRIFT`, and
        begins anew where a picture is late by more than a connection holds back.
        """
        zero_ns = now_ns - pts_us * 1000
        grown_ns = (
            zero_ns
            if self._zero_ns is None
            else self._zero_ns + round(_DRIFT * max(0, now_ns - self._at_ns))
        )
        self._zero_ns = zero_ns if zero_ns - grown_ns > _LATE_NS else min(zero_ns, grown_ns)
        self._at_ns = now_ns
        return self._zero_ns + pts_us * 1000


# ---- inside ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Data:
    """A packet of metadata; None where it states no time."""

    pts_us: int | None
    payload: bytes


class _Units:
    """Access units with start codes from a container's packets. `of` changes what was counted."""

    def __init__(self) -> None:
        self._damaged = self._timeless = 0

    def of(self, container: Any, video: Any, metadata: Sequence[Any] = ()) -> Iterator[Any]:
        """The pictures as `FootagePiece`, the metadata as `_Data`, in the container's order and on its clock."""
        codec = video.codec_context.name
        filtering = av.BitStreamFilterContext(f"{codec}_mp4toannexb", video)
        sets = b""
        for packet in container.demux([video, *metadata]):
            if packet.stream.type != "video":
                yield _Data(
                    _us(packet.pts if packet.pts is not None else packet.dts, packet.time_base),
                    bytes(packet),
                )
                continue
            if not packet.size:
                continue
            for unit in filtering.filter(packet):
                data = bytes(unit)
                if unit.is_keyframe:
                    sets = (
                        parameter_sets(codec, data)
                        or sets
                        or parameter_sets(codec, video.codec_context.extradata or b"")
                    )
                    data = with_parameter_sets(codec, data, sets)
                if (piece := self._piece(codec, unit, data)) is not None:
                    yield piece

    def _piece(self, codec: str, unit: Any, data: bytes) -> FootagePiece | None:
        dts_us, pts_us = _us(unit.dts, unit.time_base), _us(unit.pts, unit.time_base)
        pts_us = dts_us if pts_us is None else pts_us
        if pts_us is None:
            self._timeless += 1
            return None
        if not has_picture(codec, data):
            self._damaged += 1
            return None
        return FootagePiece(
            Kind.VIDEO, pts_us, data, bool(unit.is_keyframe), pts_us if dts_us is None else dts_us
        )

    def notices(self) -> list[str]:
        """What was left out."""
        return [
            *([f"packets without a picture, not sent: {self._damaged}"] if self._damaged else []),
            *(
                [f"pictures without a time stamp, not sent: {self._timeless}"]
                if self._timeless
                else []
            ),
        ]


def _format_of(video: Any, name: str) -> Format:
    context = video.codec_context
    codec = "unknown" if context is None else context.name
    if codec not in CODECS:
        raise UnsendableInput(
            f"{name}: its pictures are {codec}; a station takes {' or '.join(CODECS)} as they are, so set the camera "
            "to one of them, or convert a recording: ffmpeg -i INPUT -c:v libx264 OUTPUT.mp4"
        )
    rate = video.average_rate or video.guessed_rate
    return Format(codec, context.width, context.height, float(rate) if rate else 0.0)


def _until(samples: deque[FootagePiece], time_us: int) -> Iterator[FootagePiece]:
    """Take the samples up to a moment."""
    while samples and samples[0].pts_us <= time_us:
        yield samples.popleft()


def _piece(pts_us: int, sample: MessageSample) -> FootagePiece:
    return FootagePiece(Kind.TELEMETRY, pts_us, sample.to_json().encode(), dts_us=pts_us)


def _sample_of(stated: LocalSet) -> MessageSample:
    kept = (
        "sensor_horizontal_fov_deg",
        "sensor_vertical_fov_deg",
        "frame_center_elevation_m",
        "frame_center_ellipsoid_height_m",
        "frame_center_latitude_deg",
        "frame_center_longitude_deg",
        "slant_range_m",
    )
    return MessageSample(
        stated.time_ns,
        columns_of(stated),
        {name: stated[name] for name in kept if isfinite(stated[name])},
    )


def _lens_of(model: CameraModel) -> dict[str, float]:
    camera: Camera = model.camera
    if model.focal_sigma > _KNOWN_LENS:
        return {}
    return {
        "sensor_horizontal_fov_deg": degrees(2 * atan(0.5 * camera.width_px / camera.fx_px)),
        "sensor_vertical_fov_deg": degrees(2 * atan(0.5 * camera.height_px / camera.fy_px)),
    }


def _ground(elevation_m: float, columns: dict[str, float]) -> dict[str, float]:
    """The ground's height in the reference of the camera's own."""
    if not isfinite(elevation_m):
        return {}
    is_orthometric = isfinite(columns.get("orthometric_height_m", float("nan")))
    return {
        "frame_center_elevation_m"
        if is_orthometric
        else "frame_center_ellipsoid_height_m": elevation_m
    }


def _us(stamp: int | None, time_base: Any) -> int | None:
    return None if stamp is None or not time_base else round(stamp * time_base * 1_000_000)
