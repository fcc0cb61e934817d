"""What is left undecoded of a stream that comes faster than it can be decoded, where only its newest frames count."""

from collections import deque
from dataclasses import dataclass

from sorvolo.geometry.units import SECOND_NS

STAMP_JUMP_NS = 10 * SECOND_NS
"""By which a stream's time stamps may step forward; further, its sender began anew or set its clock."""


@dataclass(frozen=True)
class BacklogSettings:
    """When decoding has fallen behind, and when nothing more waits to be read. By choice; none is fitted."""

    most_behind_s: float = 1.5  # so much more than lately: from there on packets are left out
    lately_s: float = 30.0  # the least delay of this time is what the stream itself takes
    looked_at_s: float = (
        0.5  # of packets that are left out: so long their stamps are held against the clock
    )
    live_rate: float = (
        1.5  # stamps that run no faster than that come from the sender, not from what waited
    )


class Backlog:
    """Whether each video packet of a stream is to be decoded; only `decodes` changes it.

    A packet's delay is the time at which it was read against its own stamp: it grows while decoding is slower than the
    stream. Once it has grown too far packets are left out, which takes no time, until nothing more waits to be read.
    Decoding goes on with the key frame after that, since the pictures before it depend on what was left out.
    """

    def __init__(self, settings: BacklogSettings = BacklogSettings()) -> None:
        self._settings = settings
        self._delays_s: deque[tuple[float, float]] = (
            deque()
        )  # when, and how much: ever more, so the first is the least
        self._stamp_ns: int | None = None
        self._leaves_out_since: tuple[float, float] | None = None  # the clock and the stamp
        self._has_caught_up = False

    def decodes(self, stamp_ns: int | None, *, is_key: bool, now_s: float) -> bool:
        """Whether a packet that was read at `now_s` is to be decoded; without a stamp it shares the last one's fate."""
        if stamp_ns is None:
            return self._leaves_out_since is None
        if self._stamp_ns is None or abs(stamp_ns - self._stamp_ns) >= STAMP_JUMP_NS:
            self._begin_anew()
        self._stamp_ns, stamp_s = stamp_ns, stamp_ns / SECOND_NS
        behind_s = self._behind_s(now_s, now_s - stamp_s)
        if self._leaves_out_since is None:
            if behind_s > self._settings.most_behind_s:
                self._leaves_out_since = now_s, stamp_s
        elif self._catches_up(now_s, stamp_s) and is_key:
            self._begin_anew()
        return self._leaves_out_since is None

    def _begin_anew(self) -> None:
        self._delays_s.clear()
        self._leaves_out_since, self._has_caught_up = None, False

    def _catches_up(self, now_s: float, stamp_s: float) -> bool:
        assert self._leaves_out_since is not None
        began_s, first_s = self._leaves_out_since
        if now_s - began_s >= self._settings.looked_at_s:
            self._has_caught_up |= stamp_s - first_s <= self._settings.live_rate * (now_s - began_s)
            self._leaves_out_since = now_s, stamp_s
        return self._has_caught_up

    def _behind_s(self, now_s: float, delay_s: float) -> float:
        """How much a delay exceeds the least one lately."""
        while self._delays_s and self._delays_s[-1][1] >= delay_s:
            self._delays_s.pop()
        self._delays_s.append((now_s, delay_s))
        while self._delays_s[0][0] < now_s - self._settings.lately_s:
            self._delays_s.popleft()
        return delay_s - self._delays_s[0][1]
