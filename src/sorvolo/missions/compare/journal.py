"""What a comparison has found out about each frame so far, in its journal: a killed run goes on after the last one."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from sorvolo.change.views import ViewRecord
from sorvolo.errors import SorvoloError
from sorvolo.missions.flight.map_objects import FrameDetections
from sorvolo.missions.flight.replay import Replay
from sorvolo.missions.map.journal import MapJournal, Taken, detections_in, put_taken, taken_in
from sorvolo.store.site.journal import Entry, RunJournal
from sorvolo.store.site.journal_records import RecordPacker, unpacked


@dataclass(frozen=True, eq=False)
class ComparedFrame:
    """A frame as it was compared; `taken` as it was registered to extend the map, None where it was not."""

    index: int
    record: ViewRecord
    taken: Taken | None


class CompareJournal(MapJournal):
    """A comparison's frames and detections, in a journal of the site; `detections` are a killed run's."""

    def __init__(self, journal: RunJournal) -> None:
        super().__init__(journal)
        self.detections = tuple(each for each in self._read() if isinstance(each, FrameDetections))
        self._frames = Replay(_frame(each) for each in journal.taken() if each.kind == "view")

    def keep_frame(self, frame: ComparedFrame) -> None:
        """Note a compared frame. Raises StoreError when the disk is full."""
        packer = RecordPacker()
        values: dict[str, Any] = {"index": frame.index, "record": packer.packed(frame.record)}
        if frame.taken is not None:
            put_taken(frame.taken, values, packer.arrays)
        self.file.append(Entry("view", values, packer.arrays))

    def next_frame(self, index: int) -> ComparedFrame | None:
        """The next frame that a killed run compared, if it is the one of this index, which is asked for once."""
        return self._frames.take(index)

    def _read(self) -> Iterator[ComparedFrame | FrameDetections]:
        """What a killed run noted, in order; it ends where an entry is not as one was written."""
        for entry in self.file.entries():
            try:
                read = detections_in(entry) if entry.kind == "seen" else _frame(entry)
            except (KeyError, TypeError, ValueError, IndexError, SorvoloError):
                return  # a damaged entry: what comes after it is done again
            yield read


def _frame(entry: Entry) -> ComparedFrame:
    record = unpacked(ViewRecord, entry.values["record"], entry.arrays)
    if record.outcome.traces is None:
        raise ValueError("a comparison leaves traces")
    return ComparedFrame(int(entry.values["index"]), record, taken_in(entry))
