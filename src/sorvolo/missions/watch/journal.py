"""A watch's detections and sent notices, in its journal: a killed watch continues where it was."""

import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import sorvolo
from sorvolo.capture.source import LiveSource
from sorvolo.errors import SorvoloError, SorvoloWarning
from sorvolo.missions.flight.detector_protocol import ObjectDetector
from sorvolo.missions.flight.live_journal import BEGUN, SAMPLES, SourceNotes, go_on
from sorvolo.missions.flight.request import live_request, request_of
from sorvolo.missions.flight.resumed_frames import ResumedFrames
from sorvolo.missions.flight.setup import FlightSetup
from sorvolo.missions.watch.settings import WatchOutputs, WatchSettings
from sorvolo.store.exports.detection_files import JOURNAL
from sorvolo.store.site.journal import Entry, RunJournal, content_sha256
from sorvolo.store.site.journal_records import RecordPacker, unpacked
from sorvolo.survey.objects import Detections
from sorvolo.tracking.following import Located

_SENT, _FRAME, _MODEL = "sent", "frame", "model"


@dataclass(frozen=True, eq=False)
class SearchedFrame:
    """What was detected in a frame: in all of it, and by each look at an enlarged part that showed its scale.

    Of a live stream, which nobody can read again, also where that lies (`located`), and the frame's height and width.
    """

    index: int
    name: str
    time_ns: int
    found: Detections
    looks: tuple[Detections, ...]
    located: Located | None
    size_px: tuple[int, int]


@dataclass(frozen=True)
class Sent:
    """A receiver got the message about a track. `receiver` is its code in notices."""

    receiver: str
    track_id: int


@dataclass(frozen=True)
class LookedModel:
    """What the report states of a model that looked at pictures besides the one that was asked for."""

    facts: Mapping[str, Any]


class WatchJournal:
    """A watch's frames and what was sent, in a journal of its folder; `sent` is what a killed watch had sent.

    `models` are those that had looked, in their order. `notes` are those of a live source.
    """

    def __init__(self, journal: RunJournal, notes: SourceNotes | None = None) -> None:
        self.file = journal
        self._notes = notes
        read = [each for each in self._read() if not isinstance(each, SearchedFrame)]
        self.sent = frozenset(each for each in read if isinstance(each, Sent))
        self.models = tuple(each for each in read if isinstance(each, LookedModel))
        self._replay = ResumedFrames(self.frames())

    @property
    def is_live(self) -> bool:
        """Whether it is of a live source, whose frames cannot be read again."""
        return self._notes is not None

    def frames(self) -> Iterator[SearchedFrame]:
        """The frames that a killed watch searched, in order."""
        return (_frame(each) for each in self.file.taken() if each.kind == _FRAME)

    def keep_frame(self, frame: SearchedFrame) -> None:
        """Note a searched frame. Raises StoreError when the disk is full."""
        if self._notes is not None:
            self._notes.keep()
        packer = RecordPacker()
        values = {
            "index": frame.index,
            "name": frame.name,
            "time_ns": frame.time_ns,
            "frame": packer.packed(frame),
        }
        self.file.append(Entry(_FRAME, values, packer.arrays))

    def keep_sent(self, receiver: str, track_id: int) -> None:
        """Note what a receiver has got; from any thread. Raises StoreError when the disk is full."""
        self.file.append(Entry(_SENT, {"receiver": receiver, "track": track_id}))

    def keep_model(self, model: LookedModel) -> None:
        """Note a model that looked for the first time. Raises StoreError when the disk is full."""
        self.file.append(Entry(_MODEL, model.facts))

    def next_frame(self, index: int) -> SearchedFrame | None:
        """The next frame that a killed watch searched, if it is the one of this index."""
        return None if self.is_live else self._replay.take(index)

    def _read(self) -> Iterator[SearchedFrame | Sent | LookedModel]:
        """What a killed watch noted, in order; it ends where an entry is not as one was written."""
        for entry in self.file.entries():
            if entry.kind in (BEGUN, SAMPLES):
                continue
            try:
                read = _noted(entry)
            except (KeyError, TypeError, ValueError, IndexError, SorvoloError):
                return  # a damaged entry: what comes after it is done again
            yield read


@dataclass(frozen=True)
class StoppedWatch:
    """A live watch that was killed and goes on: its folder, how many samples of telemetry it had noted, and the index
    of the first frame that it had not searched."""

    folder: Path
    samples: int
    next_index: int


@dataclass(frozen=True, eq=False)
class WatchOrder:
    """What is asked for of a watch, beside its source."""

    settings: WatchSettings
    outputs: WatchOutputs
    detector: ObjectDetector

    def journal(self, setup: FlightSetup, folder: Path) -> RunJournal:
        """The journal of a watch in its folder, with what a killed watch of the same work left.

        Warns where there is one of another watch, which is of no use.
        """
        journal = self._at(
            folder, request_of(setup, self.settings, None, self.detector, *self._more)
        )
        if why_not := journal.why_not:
            text = f"{folder}: a watch that was stopped cannot continue: {why_not}"
            warnings.warn(text, SorvoloWarning, stacklevel=2)
        return journal

    def go_on_live(self, source: LiveSource, most_gap_s: float) -> StoppedWatch | None:
        """Have a live source go on with the flight of a watch that was killed; None where no such watch was asked for
        the same."""
        request = live_request(source, self.settings, None, self.detector, *self._more)
        named, below = self.outputs.folder, self.outputs.below
        names = Path().glob(f"*-watch/{JOURNAL}") if below is None else below.glob(f"*/{JOURNAL}")
        found = sorted(each.parent for each in names)
        for folder in found if named is None else [named]:
            journal = self._at(folder, request)
            so_far = go_on(source, journal, most_gap_s) if journal.is_begun else None
            if so_far is not None:
                return StoppedWatch(folder, len(so_far.times_ns), so_far.next_index)
        return None

    @property
    def _more(self) -> tuple[Any, ...]:
        heights = Path(self.settings.height_model)
        stamp = (
            (heights.stat().st_size, heights.stat().st_mtime_ns)
            if self.settings.height_model
            else ()
        )
        return replace(self.outputs, folder=None, below=None), stamp

    def _at(self, folder: Path, request: str) -> RunJournal:
        return RunJournal(folder / JOURNAL, content_sha256(request), 0, sorvolo.__version__)


def _noted(entry: Entry) -> SearchedFrame | Sent | LookedModel:
    if entry.kind == _MODEL:
        return LookedModel(entry.values)
    return _sent(entry) if entry.kind == _SENT else _frame(entry)


def _frame(entry: Entry) -> SearchedFrame:
    value: Any = entry.values["frame"]
    return unpacked(SearchedFrame, value, entry.arrays)


def _sent(entry: Entry) -> Sent:
    return Sent(str(entry.values["receiver"]), int(entry.values["track"]))
