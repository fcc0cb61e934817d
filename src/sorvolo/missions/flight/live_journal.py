"""Live flights in a run's journal: how they began and their telemetry, so that a run that was killed goes on with the
stream as another segment of the same flight."""

import warnings
from dataclasses import dataclass

from sorvolo.capture.live.segments import FlightSoFar, joined_samples
from sorvolo.capture.source import LiveSource
from sorvolo.errors import SorvoloError, SorvoloWarning
from sorvolo.geometry.arrays import Floats, TimesNs
from sorvolo.store.site.journal import Entry, RunJournal
from sorvolo.store.site.journal_records import RecordPacker, unpacked
from sorvolo.survey.flight import CameraModel

BEGUN, SAMPLES = "flight", "telemetry"
"""Kinds of entries. Those of frames have their `index`, `name` and `time_ns` among the values."""


@dataclass(frozen=True, eq=False)
class FlightBegun:
    """How a live flight began, and the pauses between its segments so far."""

    name: str
    fingerprint: str
    start_ns: int
    start_origin: str
    camera: CameraModel
    gaps_s: tuple[float, ...]


class SourceNotes:
    """Notes a live source in a run's journal while its frames are worked on. Only `keep` changes it."""

    def __init__(self, journal: RunJournal, source: LiveSource, known_samples: int) -> None:
        self._journal, self._source = journal, source
        self._samples, self._is_begun = known_samples, False

    def keep(self) -> None:
        """Note what is known by now and was not noted. Raises StoreError when the disk is full."""
        source = self._source
        if not self._is_begun:
            self._is_begun = True
            packer = RecordPacker()
            begun = FlightBegun(
                source.name,
                source.fingerprint,
                source.start_ns,
                source.start_origin,
                source.camera,
                source.gaps_s,
            )
            self._journal.append(Entry(BEGUN, {"begun": packer.packed(begun)}, packer.arrays))
        if source.is_reread:
            return
        times_ns, samples = source.samples(self._samples)
        if len(times_ns):
            self._samples += len(times_ns)
            self._journal.append(Entry(SAMPLES, {}, {"times_ns": times_ns, "samples": samples}))


def flight_so_far(journal: RunJournal) -> FlightSoFar | None:
    """The live flight that a killed run noted; None where it noted no frame of one."""
    begun, index, last_ns, names = None, -1, 0, set[str]()
    parts: list[tuple[TimesNs, Floats]] = []
    try:
        for entry in journal.entries():
            if entry.kind == BEGUN:
                begun = unpacked(FlightBegun, entry.values["begun"], entry.arrays)
            elif entry.kind == SAMPLES:
                parts.append((entry.arrays["times_ns"], entry.arrays["samples"]))
            elif "time_ns" in entry.values:
                index, last_ns = (
                    max(index, int(entry.values["index"])),
                    max(last_ns, int(entry.values["time_ns"])),
                )
                names.add(str(entry.values["name"]))
        times_ns, samples = joined_samples(parts)
    except (KeyError, TypeError, ValueError, IndexError, SorvoloError):
        return None  # damaged: the flight begins anew
    if begun is None or index < 0:
        return None
    return FlightSoFar(
        begun.name,
        begun.fingerprint,
        begun.start_ns,
        begun.start_origin,
        begun.camera,
        index + 1,
        last_ns,
        frozenset(names),
        times_ns,
        samples,
        begun.gaps_s,
    )


def go_on(source: LiveSource, journal: RunJournal, most_gap_s: float) -> FlightSoFar | None:
    """Have a source go on with the flight that a killed run noted; None where it does not, with a warning where the
    stream came back too late."""
    so_far = flight_so_far(journal)
    if so_far is None:
        return None
    gap_s = (source.start_ns - so_far.last_ns) / 1e9
    if source.is_stream and gap_s > most_gap_s:
        text = (
            f"{so_far.name}: a run of this stream was stopped {gap_s:.0f} s ago, more than {most_gap_s:.0f} s: the "
            "stream is another flight now"
        )
        warnings.warn(text, SorvoloWarning, stacklevel=2)
        return None
    source.continue_from(so_far)
    return so_far
