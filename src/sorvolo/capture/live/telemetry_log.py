"""Telemetry that grows while a flight goes on."""

import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from sorvolo.capture.telemetry.cleaning import clean, notice
from sorvolo.errors import InputError
from sorvolo.geometry.arrays import Floats, TimesNs
from sorvolo.survey.flight import TELEMETRY_COLUMNS, Notice, Telemetry, no_telemetry

_FIRST_ROWS = 1024  # some minutes at 5 Hz; then it doubles
_PLACE = TELEMETRY_COLUMNS.index("latitude_deg")


class TelemetryLog:
    """Samples in the order in which they came, on the frames' clock. `add` changes it, from any thread.

    Threads that need the next sample wait for it; whoever asks gets all that is known so far, cleaned as a file's is.
    """

    def __init__(self, reader: str, name: str) -> None:
        self._reader, self._name = reader, name
        self._times_ns = np.empty(_FIRST_ROWS, np.int64)
        self._rows: Floats = np.empty((_FIRST_ROWS, len(TELEMETRY_COLUMNS)))
        self._count = self._fixes = self._late = 0
        self._newest_ns = -(2**62)
        self._changed = threading.Condition()
        self._known = no_telemetry()
        self._known_rows = (0, 0)  # of which it was made: from, to

    def add(self, time_ns: int, columns: Mapping[str, float]) -> None:
        """One more sample (UTC on the frames' clock); one that is not newer than the last is counted and left out."""
        with self._changed:
            if time_ns <= self._newest_ns:
                self._late += 1
                return
            if self._count == len(self._times_ns):
                self._hold(self._times_ns, self._rows)
            self._times_ns[self._count] = self._newest_ns = time_ns
            self._rows[self._count] = np.nan
            for name, value in columns.items():
                self._rows[self._count, TELEMETRY_COLUMNS.index(name)] = value
            self._fixes += bool(np.isfinite(self._rows[self._count, _PLACE]))
            self._count += 1
            self._changed.notify_all()

    def precede(self, times_ns: TimesNs, samples: Floats) -> None:
        """Put samples (N, columns of `TELEMETRY_COLUMNS`) of an earlier process before those there are; of these, the
        ones that are not newer are left out."""
        if not len(times_ns):
            return
        with self._changed:
            newer = self._times_ns[: self._count] > times_ns[-1]
            times_ns = np.concatenate([times_ns, self._times_ns[: self._count][newer]])
            samples = np.concatenate([samples, self._rows[: self._count][newer]])
            self._hold(times_ns, samples)
            self._newest_ns = int(times_ns[-1])
            self._fixes, self._known_rows = int(np.isfinite(samples[:, _PLACE]).sum()), (0, -1)
            self._changed.notify_all()

    def samples(self, since: int) -> tuple[TimesNs, Floats]:
        """The times (N,) and samples (N, columns of `TELEMETRY_COLUMNS`) after the first this many."""
        with self._changed:
            return self._times_ns[since : self._count].copy(), self._rows[
                since : self._count
            ].copy()

    @property
    def version(self) -> int:
        """How many samples there are: it grows with every one."""
        return self._count

    def telemetry(self, notices: Sequence[Notice] = (), newest: int | None = None) -> Telemetry:
        """What is known so far, with the notices of whoever read it; `no_telemetry()` while nothing is.

        With `newest` only of so many samples: all of a long flight take 10 to 20 ms, and the more memory the longer.
        """
        with self._changed:
            chosen = (0 if newest is None else max(0, self._count - newest), self._count)
            if chosen == self._known_rows:
                return self._known
            times_ns = self._times_ns[slice(*chosen)].copy()
            rows = self._rows[slice(*chosen)].copy()
            late = notice(
                "backward_time", self._late, "{} samples came out of order and are not used"
            )
        try:
            columns = {name: rows[:, place] for place, name in enumerate(TELEMETRY_COLUMNS)}
            found = clean(self._reader, self._name, times_ns, columns, notices=[*notices, *late])
        except InputError:  # nothing usable yet
            found = replace(no_telemetry(), notices=tuple(notices))
        self._known, self._known_rows = found, chosen
        return found

    def wait_for_fixes(self, count: int, until_s: float) -> bool:
        """Wait for so many samples with a place, until that moment (monotonic clock) at most; whether they came."""
        with self._changed:
            return self._changed.wait_for(
                lambda: self._fixes >= count, max(0.0, until_s - time.monotonic())
            )

    def wait_past(self, time_ns: int, until_s: float) -> bool:
        """Wait for a sample at or after a time (UTC), at most until that moment; whether there is one."""
        with self._changed:
            return self._changed.wait_for(
                lambda: self._newest_ns >= time_ns, max(0.0, until_s - time.monotonic())
            )

    def _hold(self, times_ns: TimesNs, samples: Floats) -> None:
        """Keep these, with room for as many more."""
        self._count = len(times_ns)
        room = max(_FIRST_ROWS, 2 * self._count)
        self._times_ns = np.empty(room, np.int64)
        self._rows = np.empty((room, len(TELEMETRY_COLUMNS)))
        self._times_ns[: self._count], self._rows[: self._count] = times_ns, samples
