"""What a run computed for each frame, kept in its journal: the same run, started again, finds it there.

A restarted run is the same code with its answers known. Frames of a stream, which cannot be read again, are kept
themselves; its telemetry too, so that the stream goes on as another segment of the same flight.
"""

import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from sorvolo.build import build
from sorvolo.capture.live.segments import FlightBegun, FlightSoFar, joined_samples
from sorvolo.capture.source import LiveSource, Source
from sorvolo.errors import SorvoloError, SorvoloWarning
from sorvolo.geometry.arrays import Floats, TimesNs
from sorvolo.missions.flight.request import live_request
from sorvolo.missions.flight.setup import FlightSetup
from sorvolo.store.images import image_from_jpeg, jpeg_from_image
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.journal import Entry, RunJournal, content_sha256, packed, unpacked
from sorvolo.survey.flight import CameraPrior, Frame

_BEGUN, _SAMPLES, _FRAME, _CAME = "flight", "telemetry", "frame", "came"
_DAMAGED = (KeyError, TypeError, ValueError, IndexError, SorvoloError)

T = TypeVar("T")


class _OfFlight(Protocol):
    @property
    def index(self) -> int: ...

    @property
    def name(self) -> str: ...

    @property
    def time_ns(self) -> int: ...


@dataclass(frozen=True, eq=False)
class KeptFrame:
    """A frame of a stream; `reason` is empty, or why it cannot be used. Without `jpeg` its picture is gone."""

    index: int
    name: str
    time_ns: int
    size_px: tuple[int, int]  # height, width
    prior: CameraPrior | None
    reason: str
    jpeg: bytes

    @property
    def frame(self) -> Frame:
        if not self.jpeg:
            return Frame.unseen(self.index, self.name, self.time_ns, self.size_px)
        return Frame(self.index, self.name, self.time_ns, image_from_jpeg(self.jpeg, self.name))


class ResultCache:
    """A run's results by frame and stage, in its journal (None: nothing is kept). May be used by several threads.

    `source` is the run's, where its frames and telemetry may have to be kept as well.
    """

    def __init__(self, journal: RunJournal | None = None, source: Source | None = None) -> None:
        self.journal = journal
        self._live = source if isinstance(source, LiveSource) else None
        self._known: dict[tuple[int, str], int] = {}  # where entries of a killed run begin
        self._begun, self._samples = False, 0
        self.notes: list[Entry] = []
        """What a killed run noted that is of no frame."""
        for entry in () if journal is None else journal.entries():
            index = entry.values.get("index")
            if isinstance(index, int):
                self._known[index, entry.kind] = entry.at
            elif entry.kind == _SAMPLES:
                self._samples += len(entry.arrays.get("times_ns", ()))
            else:
                self.notes.append(entry)

    @property
    def is_of_stream(self) -> bool:
        """Whether frames cannot be read again."""
        return self._live is not None and not self._live.is_reread

    def of(self, frame: _OfFlight, stage: str, kind: type[T], make: Callable[[], T]) -> T:
        """Return a killed run's result; without one, make it and keep it. Raises StoreError when the disk is full."""
        result = self.known(frame.index, stage, kind)
        if result is None:
            result = make()
            self.keep(frame, stage, result)
        return result

    def has(self, index: int, stage: str) -> bool:
        """Return whether a killed run left this result."""
        return (index, stage) in self._known

    def known(self, index: int, stage: str, kind: type[T]) -> T | None:
        """Return a killed run's result; None without one, or where it is damaged."""
        at = self._known.get((index, stage))
        entry = None if at is None or self.journal is None else self.journal.entry(at)
        if entry is None:
            return None
        try:
            return unpacked(kind, entry.values["result"], entry.arrays)
        except _DAMAGED:
            return None

    def keep(self, frame: _OfFlight, stage: str, result: Any, *, compresses: bool = False) -> None:
        """Keep a result; `compresses` packs masks small. Raises StoreError when the disk is full."""
        if self.journal is None:
            return
        self._keep_source()
        arrays: dict[str, NDArray[Any]] = {}
        values = {
            "index": frame.index,
            "name": frame.name,
            "time_ns": frame.time_ns,
            "result": packed(result, arrays),
        }
        self.journal.append(Entry(stage, values, arrays, compresses=compresses))

    def note(self, kind: str, **values: Any) -> None:
        """Keep what is of no frame. Raises StoreError when the disk is full."""
        if self.journal is not None:
            self.journal.append(Entry(kind, values))

    def has_ended(self, index: int) -> bool:
        """Return whether a killed run was through with the frame of this index."""
        return self.has(index, _FRAME)

    def end_frame(
        self,
        frame: _OfFlight,
        prior: CameraPrior | None = None,
        reason: str = "",
        *,
        keeps_picture: bool = True,
    ) -> None:
        """Note that a frame's results are kept; of a stream with the frame itself. Raises StoreError on a full disk."""
        if self.journal is None or self.has_ended(frame.index):
            return
        if not self.is_of_stream:
            self.keep(frame, _FRAME, None)
            return
        image = frame.image if isinstance(frame, Frame) else np.zeros((0, 0, 0), np.uint8)
        jpeg = jpeg_from_image(image) if image.size and keeps_picture and not reason else b""
        size_px = (image.shape[0], image.shape[1])
        kept = KeptFrame(frame.index, frame.name, frame.time_ns, size_px, prior, reason, jpeg)
        self.keep(frame, _FRAME, kept)

    def kept_frames(self) -> Iterator[KeptFrame]:
        """Yield the frames of a stream that a killed run was through with, in order."""
        if self.is_of_stream:
            yield from self.kept(_FRAME, KeptFrame)

    def kept(self, stage: str, kind: type[T]) -> Iterator[T]:
        """Yield a killed run's results of a stage, in order of their frames."""
        for index, name in sorted(self._known):
            result = self.known(index, stage, kind) if name == stage else None
            if result is not None:
                yield result

    def note_came(self, frame: _OfFlight) -> None:
        """Note a live frame that waits to be searched. Raises StoreError when the disk is full."""
        self.keep(frame, _CAME, None)

    def waited_frames(self) -> Iterator[Frame]:
        """Yield the frames, without pictures, that still waited when a run was killed, in order."""
        for (index, stage), at in sorted(self._known.items()) if self.is_of_stream else ():
            entry = self.journal.entry(at) if stage == _CAME and self.journal is not None else None
            if entry is not None and not self.has_ended(index):
                name, time_ns = str(entry.values["name"]), int(entry.values["time_ns"])
                yield Frame.unseen(index, name, time_ns, (0, 0))

    def end(self, error: BaseException | None) -> None:
        """The run ended, with this error or none: remove the journal, unless the same command can go on with it."""
        if self.journal is not None:
            self.journal.end(error)

    def _keep_source(self) -> None:
        """Keep how a live flight began and its telemetry, as far as that was not kept."""
        source, journal = self._live, self.journal
        if source is None or journal is None:
            return
        if not self._begun:
            self._begun = True
            note_flight(journal, source)
        if source.is_reread:
            return
        times_ns, samples = source.samples(self._samples)
        if len(times_ns):
            self._samples += len(times_ns)
            journal.append(Entry(_SAMPLES, {}, {"times_ns": times_ns, "samples": samples}))


def note_flight(journal: RunJournal, source: LiveSource) -> None:
    """Note how a live flight began."""
    arrays: dict[str, NDArray[Any]] = {}
    begun = FlightBegun(
        source.name,
        source.fingerprint,
        source.start_ns,
        source.start_origin,
        source.camera,
        source.gaps_s,
    )
    journal.append(Entry(_BEGUN, {"begun": packed(begun, arrays)}, arrays))


def flight_so_far(journal: RunJournal) -> FlightSoFar | None:
    """Return the live flight that a killed run noted; None where it noted no frame of one, or is damaged."""
    begun, index, last_ns, names = None, -1, 0, set[str]()
    parts: list[tuple[TimesNs, Floats]] = []
    try:
        for entry in journal.entries():
            if entry.kind == _BEGUN:
                begun = unpacked(FlightBegun, entry.values["begun"], entry.arrays)
            elif entry.kind == _SAMPLES:
                parts.append((entry.arrays["times_ns"], entry.arrays["samples"]))
            elif "time_ns" in entry.values:
                index = max(index, int(entry.values["index"]))
                last_ns = max(last_ns, int(entry.values["time_ns"]))
                # a photo that the run was not through with is taken again, as another frame
                if entry.kind == _FRAME:
                    names.add(str(entry.values["name"]))
        times_ns, samples = joined_samples(parts)
    except _DAMAGED:
        return None
    if begun is None or index < 0:
        return None
    return FlightSoFar(
        **vars(begun),
        next_index=index + 1,
        last_ns=last_ns,
        names=frozenset(names),
        times_ns=times_ns,
        samples=samples,
    )


def go_on(source: LiveSource, journal: RunJournal, most_gap_s: float) -> bool:
    """Have a source go on with the flight that a killed run noted; whether it does.

    Warns where the stream came back too late.
    """
    so_far = flight_so_far(journal)
    if so_far is None:
        return False
    gap_s = (source.start_ns - so_far.last_ns) / 1e9
    if source.is_stream and gap_s > most_gap_s:
        text = (
            f"{so_far.name}: a run of this stream was stopped {gap_s:.0f} s ago, more than {most_gap_s:.0f} s: the "
            "stream is another flight now"
        )
        warnings.warn(text, SorvoloWarning, stacklevel=2)
        return False
    source.continue_from(so_far)
    return True


def cache_of_run(setup: FlightSetup, archive: Archive, request: str, *, anew: bool) -> ResultCache:
    """Return a mission's cache, with what a killed run of the same request left; `anew` discards that."""
    if isinstance(setup.source, LiveSource):
        key = _live_key(archive, request)
    else:
        site = archive.site() if archive.has_site else None
        versions = [(each.id, each.run_id, each.flight_id) for each in archive.versions()]
        key = content_sha256(request, setup.plan, setup.frame.origin, site, versions)
    journal = archive.journal(setup.source.name, key, build(), anew=anew)
    return ResultCache(journal, setup.source)


def go_on_live(source: Source, archive: Archive, asked: tuple[Any, ...], most_gap_s: float) -> None:
    """Have a live source go on with the flight of a killed run, if one was `asked` for the same (what follows the
    source in `live_request`)."""
    if isinstance(source, LiveSource):
        key = _live_key(archive, live_request(source, *asked))
        journal = archive.stopped_run(key, build())
        if journal is not None:
            go_on(source, journal, most_gap_s)


def _live_key(archive: Archive, request: str) -> str:
    """Return a key that is known before anything is known of the flight."""
    versions = [(each.id, each.run_id) for each in archive.versions()]
    return content_sha256(request, versions)
