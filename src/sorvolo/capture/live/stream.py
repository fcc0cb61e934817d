"""A stream, a webcam or a growing video as a flight that is still going on."""

import hashlib
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from enum import IntEnum
from math import isfinite, nan
from pathlib import Path
from statistics import median
from typing import Any

import av
import numpy as np

from sorvolo.capture.decoding import is_same_shape, other_size
from sorvolo.capture.live.addresses import StreamAddress
from sorvolo.capture.live.growing import GrowingFile
from sorvolo.capture.live.klv import LocalSet
from sorvolo.capture.live.klv_telemetry import (
    FORMAT,
    camera_of,
    columns_of,
    ground_elevation_m,
    klv_notices,
)
from sorvolo.capture.live.links import TelemetryLink, link_format
from sorvolo.capture.live.reader import StreamFacts, StreamReader
from sorvolo.capture.live.reconnect import LiveSettings, Outages
from sorvolo.capture.live.segments import FlightSoFar, segment_notices
from sorvolo.capture.live.telemetry_log import TelemetryLog
from sorvolo.capture.sync import DATED_NS
from sorvolo.capture.telemetry.cleaning import notice
from sorvolo.capture.telemetry.nmea import Epoch
from sorvolo.errors import InputError
from sorvolo.geometry.arrays import Floats, ImageGray, TimesNs
from sorvolo.geometry.units import SECOND_NS
from sorvolo.survey.flight import CameraModel, Frame, LostFrame, Notice, Telemetry

_WINDOW_NS = 15 * SECOND_NS
_SLEW = 0.005  # seconds of correction a second of stream: a clock's drift is 1000 times slower
_JUMP_NS = 2 * SECOND_NS  # a tie that is further off than this was set anew
_YOUNG_NS = 2 * SECOND_NS  # the first frames come in a burst: until then the offset follows at once
_STATED_KEPT = 9  # of a stream's newest statements of UTC: their median counts


BEGUN_LATE = "begun_late"
"""The notice that a growing file was not read from its beginning."""


class ClockTie(IntEnum):
    """The source of a frame's time, the better the higher."""

    ARRIVAL = 0
    SENDER_REPORT = 1
    METADATA = 2

    @property
    def words(self) -> str:
        """Where the times come from, for people."""
        return {
            ClockTie.ARRIVAL: "when the first frame arrived, by this computer's clock (the link's delay is in it)",
            ClockTie.SENDER_REPORT: "the sender's RTCP reports",
            ClockTie.METADATA: "the precision time stamps in the stream's metadata (ST 0601 tag 2)",
        }[self]


class StreamClock:
    """UTC from a stream's own time stamps. `arrived`, `stated` and `restart` change it.

    `settle` decides once which tie is used. The offset then follows slowly, so that a camera's clock that drifts does
    not run away from the receiver's, and times stay strictly increasing. Arrivals: the least delayed one of the last
    15 s counts, as a link only ever delays.
    """

    def __init__(self) -> None:
        self.tie: ClockTie | None = None
        self._arrivals: deque[tuple[int, int]] = deque()  # stamp, UTC - stamp; the offsets increase
        self._stated: dict[ClockTie, deque[int]] = {}
        self._offset_ns: int | None = None
        self._bias_ns = 0  # of the tie's clock against this computer's
        self._began_ns = self._slewed_to_ns = 0
        self._last_ns = -1

    def arrived(self, stamp_ns: int, utc_ns: int) -> None:
        """A frame with this time stamp came at this UTC."""
        offset_ns = utc_ns - stamp_ns
        while self._arrivals and self._arrivals[-1][1] >= offset_ns:
            self._arrivals.pop()
        self._arrivals.append((stamp_ns, offset_ns))
        while stamp_ns - self._arrivals[0][0] > _WINDOW_NS:
            self._arrivals.popleft()

    def stated(self, tie: ClockTie, stamp_ns: int, utc_ns: int) -> None:
        """The stream states this UTC for this time stamp."""
        self._stated.setdefault(tie, deque(maxlen=_STATED_KEPT)).append(utc_ns - stamp_ns)

    def settle(self) -> ClockTie:
        """Use the best tie that there is by now, for good; it is given back."""
        if self.tie is None:
            self.tie = max(self._stated, default=ClockTie.ARRIVAL)
        return self.tie

    def restart(self) -> None:
        """The stream was opened anew: its time stamps begin anew, too."""
        self._arrivals.clear()
        self._stated.clear()
        self._offset_ns = None

    def utc_ns(self, stamp_ns: int) -> int:
        """A time stamp's UTC, without any claim to be later than the last one's."""
        return stamp_ns + self._follow(stamp_ns)

    def frame_utc_ns(self, stamp_ns: int) -> int:
        """A frame's UTC: later than that of all frames before."""
        self._last_ns = max(self.utc_ns(stamp_ns), self._last_ns + 1)
        return self._last_ns

    def host_from_tie_ns(self) -> int:
        """This computer's clock minus the tie's, as far as frames show it (the link's least delay is in it)."""
        return -self._bias_ns

    def _follow(self, stamp_ns: int) -> int:
        """The offset for a time stamp, moved a little towards what is known now."""
        target_ns = self._target_ns()
        if target_ns is None:
            return self._offset_ns or 0
        if self._offset_ns is None:
            self._began_ns = stamp_ns
        is_young = stamp_ns - self._began_ns < _YOUNG_NS
        if self._offset_ns is None or is_young or abs(target_ns - self._offset_ns) > _JUMP_NS:
            self._offset_ns = target_ns
        else:
            most_ns = round(_SLEW * max(0, stamp_ns - self._slewed_to_ns))
            self._offset_ns += max(-most_ns, min(most_ns, target_ns - self._offset_ns))
        self._slewed_to_ns = stamp_ns
        return self._offset_ns

    def _target_ns(self) -> int | None:
        arrival_ns = self._arrivals[0][1] if self._arrivals else None
        stated = self._stated.get(self.settle())
        if stated:
            target_ns = sorted(stated)[len(stated) // 2]
            if arrival_ns is not None:
                self._bias_ns = target_ns - arrival_ns
            return target_ns
        return None if arrival_ns is None else arrival_ns + self._bias_ns


@dataclass(frozen=True, eq=False)
class Arrived:
    """A decoded frame with its number in the stream, its UTC, and when it was there (monotonic clock)."""

    index: int
    time_ns: int
    arrived_s: float
    decoded: av.VideoFrame

    @property
    def size_bytes(self) -> int:
        """What the frame takes in memory, about."""
        return self.decoded.width * self.decoded.height * 3 // 2


class FrameQueue:
    """A bounded queue. `put` and `take` change it, from one thread each; `skipped` counts what nobody looked at.

    Frames wait for their turn until `most_bytes` are held. Where `blocks` is set (a file that can wait), a full queue
    holds up the reader instead of dropping the oldest frame.
    """

    def __init__(self, *, most_bytes: int, blocks: bool) -> None:
        self._most_bytes, self._blocks = most_bytes, blocks
        self._waiting: deque[Arrived] = deque()
        self._held_bytes = 0
        self._changed = threading.Condition()
        self._is_over = False
        self.skipped = 0

    def put(self, arrived: Arrived) -> None:
        """Let a frame wait for its turn; frames that must give way for it are counted."""
        with self._changed:
            if self._blocks:
                self._changed.wait_for(lambda: self._is_over or self._fits(arrived))
            while self._waiting and not self._fits(arrived):
                self._held_bytes -= self._waiting.popleft().size_bytes
                self.skipped += 1
            self._waiting.append(arrived)
            self._held_bytes += arrived.size_bytes
            self._changed.notify_all()

    def take(self, timeout_s: float) -> Arrived | None:
        """The frame whose turn it is; None when none came in time, or none will come."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._is_over, timeout_s)
            if not self._waiting:
                return None
            arrived = self._waiting.popleft()
            self._held_bytes -= arrived.size_bytes
            self._changed.notify_all()
            return arrived

    def sift(self, wanted: Callable[[Arrived], bool]) -> None:
        """Leave out the frames in waiting that are not wanted; they do not count as skipped."""
        with self._changed:
            kept = [each for each in self._waiting if wanted(each)]
            self._waiting = deque(kept)
            self._held_bytes = sum(each.size_bytes for each in kept)
            self._changed.notify_all()

    def end(self) -> None:
        """No more frames come; those that wait can still be taken."""
        with self._changed:
            self._is_over = True
            self._changed.notify_all()

    @property
    def holds_any(self) -> bool:
        """Whether a frame waits for its turn."""
        with self._changed:
            return bool(self._waiting)

    @property
    def is_over(self) -> bool:
        """Whether nothing waits and nothing will come."""
        with self._changed:
            return self._is_over and not self._waiting

    def _fits(self, arrived: Arrived) -> bool:
        return not self._waiting or self._held_bytes + arrived.size_bytes <= self._most_bytes


_HOLD_S = 0.5  # the first frames of a connection come in a burst: only then is their delay known
_HOLD_FOR_METADATA_S = 2.0  # where the stream has some, it states the frames' time and lens
_FIRST_FIXES = 2  # enough for where a flight begins, and how fast
_FIRST_FIXES_S = 10.0  # waited for them; then the flight begins without
_CLOCKS_AGREE_NS = 5_000_000_000  # further apart, one of the two clocks was set wrong; by choice
# of the newest fixes, whose least delay ties the clocks: a minute at one a second
_DELAYS_KEPT = 60
# of telemetry, which place the frames that come: seven minutes at ten a second; by choice
_NEWEST_SAMPLES = 4096
_ZOOMED = 0.03  # relative change of the field of view: more than its rounding in the metadata
_POLL_S = 0.25  # how soon an end is noticed; by choice
# a frame so little before its turn is taken: the next one comes a whole frame later
_TIMELY_NS = 5_000_000


@dataclass(frozen=True, eq=False)
class _Held:
    """A decoded frame whose UTC is not known yet."""

    decoded: av.VideoFrame
    stamp_ns: int
    arrived_s: float


class _Glance:
    """Gives a small copy of a frame every so often. Only `show` changes it, in the reading thread."""

    def __init__(
        self, every_ns: int, width_px: int, take: Callable[[int, ImageGray], None]
    ) -> None:
        self._every_ns, self._width_px, self._take = every_ns, width_px, take
        self._next_ns = 0

    def show(self, time_ns: int, decoded: av.VideoFrame, size_px: tuple[int, int]) -> None:
        """A decoded frame, as the flight's frames of this width and height show it."""
        if self._next_ns - self._every_ns <= time_ns < self._next_ns:
            return
        self._next_ns = time_ns + self._every_ns - _TIMELY_NS
        width_px = min(self._width_px, size_px[0])
        height_px = max(1, round(width_px * size_px[1] / size_px[0]))
        try:
            gray = decoded.reformat(width_px, height_px, "gray", interpolation="AREA").to_ndarray()
        except (av.FFmpegError, ValueError, MemoryError):
            return  # a damaged frame, which is counted where it is asked for
        self._take(time_ns, np.ascontiguousarray(gray, np.uint8))


class LiveStream:
    """A flight that is going on; fulfils `capture.source.Source`, and its telemetry grows while it is read.

    A thread reads and decodes from the moment it is opened; what comes before `frames` is asked for waits where all
    frames are kept, and is passed over elsewhere (a growing file waits itself). Close it, or exhaust or
    close `frames`, to end it. `until`, when set from any thread, ends the frames as the end of the stream would. Made
    by `open_stream`.
    """

    kind = "video"
    is_live = True

    def __init__(
        self,
        address: StreamAddress,
        link: str | None,
        settings: LiveSettings,
        until: threading.Event,
        path: Path | None,
    ) -> None:
        self._settings, self._until, self._is_file = settings, until, path is not None
        self._closing = threading.Event()
        most_bytes = settings.most_bytes_of_file if self._is_file else settings.most_bytes
        self._queue = FrameQueue(most_bytes=most_bytes, blocks=self._is_file)
        self._clock = StreamClock()
        self._log = TelemetryLog(link_format(link) if link else FORMAT, link or address.shown)
        self._link = TelemetryLink(link, settings, self._fix) if link else None
        self._is_whole = False  # a file that is read from its beginning

        def opened(outages: Outages) -> GrowingFile:
            assert path is not None
            file = GrowingFile(path, settings, outages, self._closing)
            self._is_whole = file.is_whole
            return file

        self._reader = StreamReader(
            address, self, settings, self._closing, None if path is None else opened
        )
        self._facts: StreamFacts | None = None
        self._lock = threading.RLock()
        self._held: list[_Held] | None = []
        self._held_metadata: list[tuple[int, LocalSet]] = []
        self._held_since: tuple[float, int] | None = None  # the monotonic clock's and the stream's
        self._held_fixes: list[tuple[int, Epoch]] = []
        self._clocks_agree = False
        self._delays_ns: deque[int] = deque(maxlen=_DELAYS_KEPT)
        self._is_ready = threading.Event()
        self._wanted: Callable[[int, int], bool] | None = None
        self._is_asked = threading.Event()
        self._asking = threading.Lock()  # `wanted` is asked of one frame after the other
        self._glance: _Glance | None = None
        self._count = self._resized = self._lost = self._zooms = 0
        # when the frame was there that was given last, by the monotonic clock
        self.arrived_s = time.monotonic()
        self.size_px = (0, 0)  # of the frames as delivered: those of the first one
        # the first metadata packet that states the field of view
        self.lens: LocalSet | None = None
        self._grounds_m: deque[float] = deque(maxlen=1000)
        self.name = ""
        self.fingerprint = ""
        self.inputs = (address.shown, *([link] if link else []))
        self.start_ns, self.start_origin = 0, ""
        self.camera: CameraModel = None  # type: ignore[assignment]  # set by `open_stream` once the size is known
        self.gaps_s: tuple[float, ...] = ()
        self._first_index = self._later_ns = 0  # of this segment's frames, in the flight
        self._after_ns = -1  # frames of a file that an earlier process had read

    # ---- what a mission asks ----------------------------------------------------------------------------------

    @property
    def facts(self) -> StreamFacts:
        """The properties in the stream's header."""
        assert self._facts is not None  # known before the first frame
        return self._facts

    @property
    def frame_rate_hz(self) -> float:
        """Frames a second, as the stream states."""
        return self.facts.rate_hz

    @property
    def frame_count(self) -> int:
        """0 while the flight goes on, then how many frames came."""
        return self._first_index + self._count if self._reader.is_over.is_set() else 0

    @property
    def telemetry(self) -> Telemetry:
        """What is known so far, its times on the frames' clock."""
        return self._telemetry(None)

    @property
    def latest_telemetry(self) -> Telemetry:
        """What places the frames that come: the newest samples of a long flight."""
        return self._telemetry(_NEWEST_SAMPLES)

    @property
    def telemetry_version(self) -> int:
        """Grows with every sample: whether `telemetry` has more than before."""
        return self._log.version

    @property
    def telemetry_tie(self) -> str:
        """How telemetry's times came onto the frames' clock, in words."""
        if self._link is None:
            return "the metadata came with the frames"
        return "both carry UTC" if self._clocks_agree else "both are timed by when they came"

    @property
    def telemetry_sigma_s(self) -> float:
        """How far off that may be, s: a link's delay, or a metadata packet's in the aircraft."""
        return 0.5 if self._link is None else 1.0

    @property
    def ground_elevation_m(self) -> float:
        """The ground's height, as the metadata states it for the frames' centres; NaN where it does not."""
        with self._lock:
            return median(self._grounds_m) if self._grounds_m and not self._link else nan

    @property
    def silent_s(self) -> float:
        """How long nothing has come now; 0 while frames come."""
        return self._reader.outages.silent_s

    @property
    def is_behind(self) -> bool:
        """Whether the next frame is there already, for whoever looks at them is slower than they come."""
        return self._queue.holds_any

    @property
    def skipped(self) -> int:
        """Wanted frames that nobody took before memory ran out."""
        return self._queue.skipped

    def wait_for_first_fixes(self) -> None:
        """Wait for telemetry's first positions; not where none is to be expected, nor for ever."""
        if (self._link or self.facts.has_metadata) and not self._is_file:
            end_s = time.monotonic() + _FIRST_FIXES_S
            while not self._is_ended and time.monotonic() < end_s:
                if self._log.wait_for_fixes(_FIRST_FIXES, min(end_s, time.monotonic() + _POLL_S)):
                    return

    def wait_for_telemetry(self, time_ns: int) -> None:
        """Wait for the sample that follows a frame, at most `fix_wait_s` from when the frame came.

        Only where every frame is kept; elsewhere what is known so far has to do.
        """
        if self._settings.keeps_all and self._log.version:
            self._log.wait_past(
                time_ns - self._later_ns, self.arrived_s + self._settings.fix_wait_s
            )

    def samples(self, since: int) -> tuple[TimesNs, Floats]:
        """Telemetry after the first so many samples, as `FlightSoFar` has it."""
        return self._log.samples(since)

    @property
    def is_reread(self) -> bool:
        """Whether each process reads all frames from the first one: those of a file that grows, if all are kept."""
        return self._is_file and self._settings.keeps_all

    @property
    def is_stream(self) -> bool:
        """Whether what is not read when it comes is lost."""
        return not self._is_file

    def continue_from(self, so_far: FlightSoFar) -> None:
        """Go on with a flight that an earlier process read; before `frames` is asked for, and telemetry."""
        if self._is_whole and self._clock.tie is ClockTie.ARRIVAL:
            # each process has timed it by when it began to read
            self._later_ns = so_far.start_ns - self.start_ns
        if not self.is_reread:
            self._first_index = so_far.next_index
            began_ns = self.start_ns + self._later_ns
            self.gaps_s = (*so_far.gaps_s, max(0.0, (began_ns - so_far.last_ns) / 1e9))
            self._log.precede(so_far.times_ns, so_far.samples)
            self._after_ns = so_far.last_ns if self._is_file else -1
        self.name, self.fingerprint, self.camera = so_far.name, so_far.fingerprint, so_far.camera
        self.start_ns, self.start_origin = so_far.start_ns, so_far.start_origin

    def notices(self) -> tuple[Notice, ...]:
        """What was found so far and survived, outages with their lengths among it."""
        arrival = self._clock.tie is ClockTie.ARRIVAL and not self._is_file
        words = f"the stream states no time: frames are timed by {ClockTie.ARRIVAL.words}"
        return (
            *self._reader.notices(),
            *segment_notices(self.gaps_s),
            *notice(
                BEGUN_LATE,
                int(self._is_file and not (self._is_whole or self.gaps_s)),
                "the flight had begun; what was recorded before was not read: give the recording for all of it",
            ),
            *notice("arrival_times", int(arrival), words),
            *notice(
                "size_changed",
                self._resized,
                "frames of another size, brought to the first one's: {}",
            ),
            *notice("other_shape", self._lost, "frames of another shape, not used: {}"),
            *notice(
                "zoom",
                self._zooms,
                "metadata packets that state another field of view than the first: {}",
            ),
            *notice(
                "skipped_frame",
                self.skipped,
                "frames that came faster than they could be looked at: {}",
            ),
        )

    def frames(self, wanted: Callable[[int, int], bool]) -> Iterator[Frame | LostFrame]:
        """The wanted frames as they come, numbered from 0, until the stream ends for good; see `Source.frames`.

        `wanted` is asked in the reading thread. Frames that memory does not hold any more are counted as skipped.
        """
        for _, each in self.arrivals(wanted):
            yield each

    def arrivals(
        self, wanted: Callable[[int, int], bool]
    ) -> Iterator[tuple[float, Frame | LostFrame]]:
        """The same as `frames`, each with when it was there (monotonic clock)."""

        def is_wanted(index: int, time_ns: int) -> bool:
            index, time_ns = index + self._first_index, time_ns + self._later_ns
            return time_ns > self._after_ns and wanted(index, time_ns)

        with self._asking:
            self._queue.sift(lambda arrived: is_wanted(arrived.index, arrived.time_ns))
            self._wanted = is_wanted
        self._is_asked.set()
        try:
            while not self._is_ended:
                arrived = self._queue.take(_POLL_S)
                if arrived is not None:
                    self.arrived_s = arrived.arrived_s
                    yield arrived.arrived_s, self._converted(arrived)
                elif self._queue.is_over:
                    return
        finally:
            self.close()

    def glance(self, every_s: float, width_px: int, take: Callable[[int, ImageGray], None]) -> None:
        """From now on give a small gray copy of a frame so often, with its time, in the thread that reads the stream.

        Whether or not the frame itself is asked for: a mission knows how the picture moves while it looks at another.
        """
        self._glance = _Glance(round(every_s * 1e9), width_px, take)

    def close(self) -> None:
        """End the stream and let go of the link; harmless when done already."""
        self._closing.set()
        self._is_asked.set()
        self._queue.end()
        self._reader.join()
        if self._link is not None:
            self._link.close()

    # ---- opening ----------------------------------------------------------------------------------------------

    def begin(self) -> None:
        """Start to read and wait for the first frame, from which size, clock and lens are known.

        Raises InputError when none comes in `first_s`, or the other side refuses.
        """
        if self._link is not None:
            self._link.start()
        self._reader.start()
        shown = self.inputs[0]
        try:
            while not self._is_ready.wait(_POLL_S):
                if self._reader.refused:
                    raise InputError(
                        f"{shown}: {self._reader.refused}; check the address, the name and the password"
                    )
                if self._reader.is_over.is_set() and not self._is_ready.is_set():
                    why = self._reader.failure or "nothing came"
                    raise InputError(
                        f"{shown}: no picture within {self._settings.first_s:.0f} s ({why}); is the drone sending, to "
                        "this address and port, and does the network let it through?"
                    )
                if self._until.is_set():
                    raise InputError(f"{shown}: stopped before the first picture came")
        except BaseException:
            self.close()
            raise

    @property
    def _is_ended(self) -> bool:
        return self._until.is_set() or self._closing.is_set()

    # ---- called by the reader, in its thread ------------------------------------------------------------------

    def opened(self, facts: StreamFacts) -> None:
        """See `reader.StreamListener`."""
        self._facts = facts

    def restarted(self) -> None:
        """See `reader.StreamListener`: frames are held anew until their delay is known."""
        self._settle()  # the clock may restart before the first frames' own hold is over
        with self._lock:
            self._clock.restart()
            self._held, self._held_since = [], None

    def reported(self, stamp_ns: int, utc_ns: int) -> None:
        """See `reader.StreamListener`."""
        if utc_ns > DATED_NS:
            self._clock.stated(ClockTie.SENDER_REPORT, stamp_ns, utc_ns)

    def metadata(self, stated: LocalSet, stamp_ns: int) -> None:
        """See `reader.StreamListener`."""
        if stated.time_ns:
            self._clock.stated(ClockTie.METADATA, stamp_ns, stated.time_ns)
        across_deg = stated["sensor_horizontal_fov_deg"]
        if isfinite(across_deg):
            self.lens = self.lens or stated
            self._zooms += abs(across_deg / self.lens["sensor_horizontal_fov_deg"] - 1) > _ZOOMED
        with self._lock:
            if isfinite(ground_m := ground_elevation_m(stated)):
                self._grounds_m.append(ground_m)
            if self._held is not None:
                self._held_metadata.append((stamp_ns, stated))
            else:
                self._log_metadata(stamp_ns, stated)

    def frame(self, decoded: av.VideoFrame, stamp_ns: int, arrived_s: float) -> None:
        """See `reader.StreamListener`."""
        # a file is read faster than it was written
        if not self._is_file or self._held_since is None:
            self._clock.arrived(stamp_ns, time.time_ns())
        held = _Held(decoded, stamp_ns, arrived_s)
        if self._held is None:
            self._deliver(held)
            return
        self._held.append(held)
        if self._held_since is None:
            self._held_since = arrived_s, stamp_ns
        if self._has_held_enough(held):
            self._settle()

    def _has_held_enough(self, newest: _Held) -> bool:
        assert self._held is not None and self._held_since is not None
        since_s, since_ns = self._held_since
        stated = sum(bool(each.time_ns) for _, each in self._held_metadata)
        if self._is_file:  # its frames come at once: what counts is how much of the flight was read
            passed_s = (newest.stamp_ns - since_ns) / 1e9
            usual_s = 0.0
            is_stated = stated >= _FIRST_FIXES
        else:
            passed_s, usual_s, is_stated = newest.arrived_s - since_s, _HOLD_S, stated > 0
        held_bytes = len(self._held) * newest.decoded.width * newest.decoded.height * 3 // 2
        if held_bytes > self._settings.most_bytes // 2:
            return True
        return passed_s >= (
            _HOLD_FOR_METADATA_S if self.facts.has_metadata and not is_stated else usual_s
        )

    def _settle(self) -> None:
        """The frames held so far decide how the stream's clock is tied; from here on they are given on as they come."""
        with self._lock:
            if not self._held:
                return
            first = self._held[0]
            if not self._is_ready.is_set():
                self.size_px = first.decoded.width, first.decoded.height
                tie = self._clock.settle()
                self.start_ns = self._clock.utc_ns(first.stamp_ns)
                self.start_origin = (
                    tie.words
                    if not (self._is_file and tie is ClockTie.ARRIVAL)
                    else ("when reading began: the file states no time")
                )
            held, self._held = self._held, None
            stated, self._held_metadata = self._held_metadata, []
            for stamp_ns, each in stated:
                self._log_metadata(stamp_ns, each)
            fixes, self._held_fixes = self._held_fixes, []
            for arrived_ns, epoch in fixes:
                self._log_fix(arrived_ns, epoch)
            self._is_ready.set()
        for frame in held:
            self._deliver(frame)

    def _deliver(self, held: _Held) -> None:
        time_ns = self._clock.frame_utc_ns(held.stamp_ns)
        if self._is_file:
            self._is_asked.wait()
        if self._glance is not None:
            self._glance.show(time_ns + self._later_ns, held.decoded, self.size_px)
        with self._asking:
            is_passed_over = self._wanted is None and not self._settings.keeps_all
            if is_passed_over or self._closing.is_set():
                return  # a stream goes on whether or not it is looked at
            index, self._count = self._count, self._count + 1
            if self._wanted is None or self._wanted(index, time_ns):
                self._queue.put(Arrived(index, time_ns, held.arrived_s, held.decoded))

    def ended(self) -> None:
        """See `reader.StreamListener`."""
        self._settle()
        self._queue.end()

    # ---- telemetry on the frames' clock -----------------------------------------------------------------------

    def _telemetry(self, newest: int | None) -> Telemetry:
        found = self._link.notices() if self._link else klv_notices(self._reader.counts)
        known = self._log.telemetry(found, newest)
        return replace(known, time_ns=known.time_ns + self._later_ns) if self._later_ns else known

    def _log_metadata(self, stamp_ns: int, stated: LocalSet) -> None:
        if self._link is not None:
            return
        states_time = self._clock.tie is ClockTie.METADATA and stated.time_ns
        self._log.add(
            stated.time_ns if states_time else self._clock.utc_ns(stamp_ns), columns_of(stated)
        )

    def _fix(self, arrived_ns: int, epoch: Epoch) -> None:
        """A receiver's moment, in the link's thread."""
        with self._lock:
            if not self._is_ready.is_set():
                self._held_fixes.append((arrived_ns, epoch))
            else:
                self._log_fix(arrived_ns, epoch)

    def _log_fix(self, arrived_ns: int, epoch: Epoch) -> None:
        """Sentences state UTC; where the frames do not know theirs as well, both are tied by when they came."""
        self._delays_ns.append(arrived_ns - epoch.time_ns)
        least_ns = min(self._delays_ns)
        ahead_ns = self._clock.host_from_tie_ns()
        self._clocks_agree = (
            self._clock.tie is not ClockTie.ARRIVAL and abs(least_ns - ahead_ns) < _CLOCKS_AGREE_NS
        )
        self._log.add(
            epoch.time_ns + (0 if self._clocks_agree else least_ns - ahead_ns), epoch.values
        )

    # ---- pictures ---------------------------------------------------------------------------------------------

    def _converted(self, arrived: Arrived) -> Frame | LostFrame:
        index = arrived.index + self._first_index
        time_ns = arrived.time_ns + self._later_ns
        decoded = arrived.decoded
        name = str(index)
        width_px, height_px = self.size_px
        fitted: dict[str, Any] = {}
        own_px = decoded.width, decoded.height
        if own_px != self.size_px:
            # a sender that saves bandwidth shows the same in fewer pixels; another shape is another view
            if not is_same_shape(own_px, self.size_px):
                self._lost += 1
                return LostFrame(index, name, time_ns, other_size(own_px, self.size_px))
            self._resized += 1
            fitted = {"width": width_px, "height": height_px}
        try:
            image = decoded.to_ndarray(format="rgb24", **fitted)
        except (av.FFmpegError, ValueError, MemoryError) as error:
            return LostFrame(index, name, time_ns, f"corrupt: {error}")
        return Frame(index, name, time_ns, np.ascontiguousarray(image, dtype=np.uint8))


def open_stream(
    address: StreamAddress,
    link: str | None,
    camera: Callable[[int, int], CameraModel | None],
    guess: Callable[[int, int], CameraModel],
    settings: LiveSettings,
    until: threading.Event,
    path: Path | None = None,
) -> LiveStream:
    """The flight at an address, or in a video file that is being written (`path`), reading already.

    `link` is where a receiver's NMEA comes from. `camera(width, height)` is the camera that was asked for, None where
    none was: then the stream's own field of view is used, else `guess`. Raises InputError when no picture comes.
    """
    stream = LiveStream(address, link, settings, until, path)
    stream.begin()
    try:
        own = camera_of(stream.lens, *stream.size_px) if stream.lens is not None else None
        stream.camera = camera(*stream.size_px) or own or guess(*stream.size_px)
    except BaseException:
        stream.close()
        raise
    if path is not None:
        stream.name = path.stem
        with path.open("rb") as file:
            stream.fingerprint = hashlib.sha256(file.read(4096)).hexdigest()
    else:
        began = datetime.fromtimestamp(time.time(), UTC)
        stream.name = f"{address.shown.partition('://')[2] or address.shown}_{began:%Y%m%dT%H%M%SZ}"
        stream.fingerprint = hashlib.sha256(
            f"{address.shown} {stream.start_ns}".encode()
        ).hexdigest()
    return stream
