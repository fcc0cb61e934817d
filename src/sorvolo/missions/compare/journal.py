"""What a comparison knows of each frame so far, in its journal: a killed run continues after the last one."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from sorvolo.change.views import ViewRecord
from sorvolo.errors import SorvoloError
from sorvolo.geometry.arrays import Encoded
from sorvolo.missions.flight.live_journal import BEGUN, SAMPLES, SourceNotes
from sorvolo.missions.flight.map_objects import FrameDetections
from sorvolo.missions.flight.resumed_frames import ResumedFrames
from sorvolo.missions.map.journal import MapJournal, Taken, detections_in, put_taken, taken_in
from sorvolo.store.site.journal import Entry, RunJournal
from sorvolo.store.site.journal_records import RecordPacker, unpacked
from sorvolo.survey.flight import CameraPrior


@dataclass(frozen=True, eq=False)
class KeptFrame:
    """A frame that cannot be read again; `jpeg` is its undistorted picture at the size at which it was compared."""

    name: str
    time_ns: int
    prior: CameraPrior
    jpeg: Encoded


@dataclass(frozen=True, eq=False)
class ComparedFrame:
    """A frame as it was compared; `taken` as it was registered to extend the map, None where it was not; `kept` where
    it cannot be read again."""

    index: int
    record: ViewRecord
    taken: Taken | None
    kept: KeptFrame | None = None

    @property
    def is_whole(self) -> bool:
        """Whether the frame itself is there."""
        return self.kept is None


class CompareJournal(MapJournal):
    """A comparison's frames and detections, in a journal of the site; `detections` are a killed run's.

    `notes` are those of a live source; `keeps_pictures`: its frames cannot be read again.
    """

    def __init__(
        self, journal: RunJournal, notes: SourceNotes | None = None, *, keeps_pictures: bool = False
    ) -> None:
        super().__init__(journal, notes)
        self.keeps_pictures = keeps_pictures
        self.detections = tuple(each for each in self._read() if isinstance(each, FrameDetections))
        self._frames = ResumedFrames(iter(()) if keeps_pictures else self._taken())

    def kept_frames(self) -> Iterator[ComparedFrame]:
        """The frames that a killed run compared and that cannot be read again."""
        return (each for each in self._taken() if each.kept is not None)

    def keep_frame(self, frame: ComparedFrame, name: str, time_ns: int) -> None:
        """Note a compared frame. Raises StoreError when the disk is full."""
        self.keep_source()
        packer = RecordPacker()
        values: dict[str, Any] = {
            "index": frame.index,
            "name": name,
            "time_ns": time_ns,
            "record": packer.packed(frame.record),
            "kept": packer.packed(frame.kept),
        }
        if frame.taken is not None:
            put_taken(frame.taken, values, packer.arrays)
        self.file.append(Entry("view", values, packer.arrays))

    def next_frame(self, index: int) -> ComparedFrame | None:
        """The next frame that a killed run compared, if it is the one of this index, which is asked for once."""
        return self._frames.take(index)

    def _taken(self) -> Iterator[ComparedFrame]:
        return (_frame(each) for each in self.file.taken() if each.kind == "view")

    def _read(self) -> Iterator[ComparedFrame | FrameDetections]:
        """What a killed run noted, in order; it ends where an entry is not as one was written."""
        for entry in self.file.entries():
            if entry.kind in (BEGUN, SAMPLES):
                continue
            try:
                read = detections_in(entry) if entry.kind == "seen" else _frame(entry)
            except (KeyError, TypeError, ValueError, IndexError, SorvoloError):
                return  # a damaged entry: what comes after it is done again
            yield read


def _frame(entry: Entry) -> ComparedFrame:
    record = unpacked(ViewRecord, entry.values["record"], entry.arrays)
    if record.outcome.traces is None:
        raise ValueError("a comparison leaves traces")
    kept = entry.values["kept"]
    return ComparedFrame(
        int(entry.values["index"]),
        record,
        taken_in(entry),
        None if kept is None else unpacked(KeptFrame, kept, entry.arrays),
    )
