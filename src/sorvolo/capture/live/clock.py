"""The UTC of a live stream's frames: by the metadata in it, by its sender's reports, or by when they came."""

from collections import deque
from enum import IntEnum

from sorvolo.geometry.units import SECOND_NS

_WINDOW_NS = 15 * SECOND_NS
_SLEW = 0.005  # seconds of correction a second of stream: a clock's drift is 1000 times slower
_JUMP_NS = 2 * SECOND_NS  # a tie that is further off than this was set anew
_YOUNG_NS = 2 * SECOND_NS  # the first frames come in a burst: until then the offset follows at once
_STATED_KEPT = 9  # of a stream's newest statements of UTC: their median counts


class Tie(IntEnum):
    """The source of a frame's time, the better the higher."""

    ARRIVAL = 0
    SENDER_REPORT = 1
    METADATA = 2

    @property
    def words(self) -> str:
        """Where the times come from, for people."""
        return {
            Tie.ARRIVAL: "when the first frame arrived, by this computer's clock (the link's delay is in it)",
            Tie.SENDER_REPORT: "the sender's RTCP reports",
            Tie.METADATA: "the precision time stamps in the stream's metadata (ST 0601 tag 2)",
        }[self]


class StreamClock:
    """UTC from a stream's own time stamps. `arrived`, `stated` and `restart` change it.

    `settle` decides once which tie is used. The offset then follows slowly, so that a camera's clock that drifts does
    not run away from the receiver's, and times stay strictly increasing. Arrivals: the least delayed one of the last
    15 s counts, as a link only ever delays.
    """

    def __init__(self) -> None:
        self.tie: Tie | None = None
        self._arrivals: deque[tuple[int, int]] = deque()  # stamp, UTC - stamp; the offsets increase
        self._stated: dict[Tie, deque[int]] = {}
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

    def stated(self, tie: Tie, stamp_ns: int, utc_ns: int) -> None:
        """The stream states this UTC for this time stamp."""
        self._stated.setdefault(tie, deque(maxlen=_STATED_KEPT)).append(utc_ns - stamp_ns)

    def settle(self) -> Tie:
        """Use the best tie that there is by now, for good; it is given back."""
        if self.tie is None:
            self.tie = max(self._stated, default=Tie.ARRIVAL)
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
