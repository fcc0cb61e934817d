"""What a watch has detected, and whom it has notified of what, in its journal: a killed watch goes on where it was."""

import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import sorvolo
from sorvolo.errors import SorvoloError, SorvoloWarning
from sorvolo.missions.flight.detects import Detects
from sorvolo.missions.flight.replay import Replay
from sorvolo.missions.flight.request import request_of
from sorvolo.missions.flight.setup import FlightSetup
from sorvolo.missions.watch.settings import WatchOutputs, WatchSettings
from sorvolo.store.exports.detection_files import JOURNAL
from sorvolo.store.site.journal import Entry, RunJournal, content_sha256
from sorvolo.store.site.journal_records import RecordPacker, unpacked
from sorvolo.survey.objects import Detections

_SENT, _FRAME = "sent", "frame"


@dataclass(frozen=True, eq=False)
class SearchedFrame:
    """What was detected in a frame: in all of it, and by each look at an enlarged part that showed its scale."""

    index: int
    found: Detections
    looks: tuple[Detections, ...]


@dataclass(frozen=True)
class Sent:
    """A receiver has the message about a track. `receiver` is the one's code in notices."""

    receiver: str
    track_id: int


class WatchJournal:
    """A watch's frames and what was sent, in a journal of its folder; `sent` is what a killed watch had sent."""

    def __init__(self, journal: RunJournal) -> None:
        self.file = journal
        self.sent = frozenset(each for each in self._read() if isinstance(each, Sent))
        self._frames = Replay(_frame(each) for each in journal.taken() if each.kind == _FRAME)

    def keep_frame(self, frame: SearchedFrame) -> None:
        """Note a searched frame. Raises StoreError when the disk is full."""
        packer = RecordPacker()
        self.file.append(Entry(_FRAME, {"frame": packer.packed(frame)}, packer.arrays))

    def keep_sent(self, receiver: str, track_id: int) -> None:
        """Note what a receiver has got; from any thread. Raises StoreError when the disk is full."""
        self.file.append(Entry(_SENT, {"receiver": receiver, "track": track_id}))

    def next_frame(self, index: int) -> SearchedFrame | None:
        """The next frame that a killed watch searched, if it is the one of this index."""
        return self._frames.take(index)

    def _read(self) -> Iterator[SearchedFrame | Sent]:
        """What a killed watch noted, in order; it ends where an entry is not as one was written."""
        for entry in self.file.entries():
            try:
                read = _sent(entry) if entry.kind == _SENT else _frame(entry)
            except (KeyError, TypeError, ValueError, IndexError, SorvoloError):
                return  # a damaged entry: what comes after it is done again
            yield read


def begun_journal(
    setup: FlightSetup, settings: WatchSettings, outputs: WatchOutputs, detector: Detects, folder: Path
) -> RunJournal:
    """The journal of a watch in its folder, with what a killed one left that did the very same work.

    Warns where there is one of another watch, which is of no use.
    """
    heights = Path(settings.height_model)
    stamp = (heights.stat().st_size, heights.stat().st_mtime_ns) if settings.height_model else ()
    key = content_sha256(request_of(setup, settings, None, detector, outputs, stamp))
    journal = RunJournal(folder / JOURNAL, key, 0, sorvolo.__version__)
    if why_not := journal.why_not:
        text = f"{folder}: a watch that was stopped cannot go on, since {why_not}; it begins anew"
        warnings.warn(text, SorvoloWarning, stacklevel=2)
    return journal


def _frame(entry: Entry) -> SearchedFrame:
    value: Any = entry.values["frame"]
    return unpacked(SearchedFrame, value, entry.arrays)


def _sent(entry: Entry) -> Sent:
    return Sent(str(entry.values["receiver"]), int(entry.values["track"]))
