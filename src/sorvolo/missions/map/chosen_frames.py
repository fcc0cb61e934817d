"""Which frames of a video its map is made of: chosen once, in order, before the video is divided into blocks."""

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import asdict, astuple, dataclass
from heapq import merge
from pathlib import Path
from typing import Self

from sorvolo.capture.video import Reading, VideoSource
from sorvolo.capture.video_spans import SparseReading
from sorvolo.errors import InputError
from sorvolo.missions.flight.frames_ahead import read_ahead
from sorvolo.missions.flight.settings import MapSettings
from sorvolo.missions.flight.setup import FlightSetup
from sorvolo.missions.map.journal import Earlier
from sorvolo.missions.map.reader import FrameReader
from sorvolo.mosaic.selection import Selected, SelectionMemory, SelectionSettings, select_keyframes
from sorvolo.store.atomic import atomic_write_bytes
from sorvolo.survey.flight import Frame, LostFrame, Notice, PosedFrame


@dataclass(frozen=True)
class ChosenFrame:
    """A frame of the video; `reason` is empty, or why it cannot be used."""

    index: int
    name: str
    time_ns: int
    reason: str


@dataclass(frozen=True)
class ChosenFrames:
    """The chosen frames in order, how the video was read for that, and what was found in it."""

    frames: tuple[ChosenFrame, ...]
    reading: Reading
    notices: tuple[Notice, ...]

    @classmethod
    def at(cls, path: Path, key: str) -> Self | None:
        """Those written under this key; None where there are none that are whole."""
        try:
            kept = json.loads(path.read_bytes())
        except (OSError, ValueError):
            return None
        if not isinstance(kept, dict) or kept.get("key") != key:
            return None
        return cls(
            tuple(ChosenFrame(*each) for each in kept["frames"]),
            Reading(**kept["reading"]),
            tuple(Notice(**each) for each in kept["notices"]),
        )

    def write(self, path: Path, key: str) -> None:
        """Replace the file. Raises StoreError when the disk is full."""
        kept = {
            "key": key,
            "frames": [astuple(each) for each in self.frames],
            "reading": asdict(self.reading),
            "notices": [asdict(each) for each in self.notices],
        }
        atomic_write_bytes(path, json.dumps(kept).encode())


def choose_frames(
    setup: FlightSetup, settings: MapSettings, alive: Callable[[], None]
) -> ChosenFrames:
    """Read a video as its map is made, and note the frames that are selected."""
    source = setup.source
    assert isinstance(source, VideoSource)
    selection = SelectionSettings(
        overlap=settings.overlap, least_overlap=min(0.5, settings.overlap)
    )
    reader = FrameReader(setup, Earlier(), selection)

    def posed() -> Iterator[PosedFrame | LostFrame]:
        for each in reader.posed(lambda _: None):
            alive()
            yield each

    chosen = []
    for each in select_keyframes(
        posed(), selection, keep_all=False, inside=setup.inside(None), small=reader.small
    ):
        frame = each if isinstance(each, LostFrame) else each.posed.frame
        chosen.append(ChosenFrame(frame.index, frame.name, frame.time_ns, each.reason))
    return ChosenFrames(tuple(chosen), source.reading, source.notices())


def frames_again(
    setup: FlightSetup, chosen: Sequence[ChosenFrame]
) -> Iterator[Selected | LostFrame]:
    """These of a video's chosen frames, in order; only they are decoded, and what they need of those before them.

    Raises InputError where the video does not give the same frames again.
    """
    lost = (
        LostFrame(each.index, each.name, each.time_ns, each.reason)
        for each in chosen
        if each.reason
    )
    usable = [each for each in chosen if not each.reason]
    return merge(lost, _decoded(setup, usable), key=_index)


def _index(each: Selected | LostFrame) -> int:
    return each.index if isinstance(each, LostFrame) else each.posed.frame.index


def _decoded(setup: FlightSetup, chosen: Sequence[ChosenFrame]) -> Iterator[Selected]:
    source = setup.source
    assert isinstance(source, VideoSource)
    if not chosen:
        return
    wanted = {each.index for each in chosen}

    def is_wanted(index: int, _time_ns: int) -> bool:
        return index in wanted

    # what was chosen between two key frames was so because they were not enough
    sparse = SparseReading(setup.plan.step_s, is_wanted, lambda *_: False)
    waiting = iter(chosen)
    with closing(read_ahead(source.frames(is_wanted, sparse), 1)) as frames:
        for expected, each in zip(waiting, frames, strict=False):
            if not isinstance(each, Frame) or (each.index, each.time_ns) != (
                expected.index,
                expected.time_ns,
            ):
                break
            yield Selected(
                PosedFrame(each, setup.prior(each, first=each.index == 0)), "", SelectionMemory()
            )
            if expected is chosen[-1]:
                return
    raise InputError(
        f"{source.name} does not give the same frames twice: it is damaged or was changed meanwhile; run the batch "
        "again without --blocks"
    )
