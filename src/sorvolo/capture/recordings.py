"""Which videos are one recording: chapters that a camera cut are joined, and copies of a recording are left out."""

import hashlib
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np

from sorvolo.capture.sync import DATED_NS
from sorvolo.capture.video import VIDEO_SUFFIXES, VideoInfo, VideoSource, read_video_info
from sorvolo.capture.video_spans import SparseReading
from sorvolo.capture.video_stream import opened_video
from sorvolo.errors import InputError
from sorvolo.geometry.arrays import Floats, ImageGray, TimesNs
from sorvolo.geometry.units import SECOND_NS
from sorvolo.survey.flight import (
    TELEMETRY_COLUMNS,
    Frame,
    LostFrame,
    Notice,
    Telemetry,
)

_SMALL_COPIES = frozenset({".lrv", ".lrf"})  # GoPro's, Insta360's and DJI's previews
_END_BYTES = 1 << 20  # of a file's begin and end, by which a copy is known
_ALIKE = 0.02  # of a duration: so much two copies of one recording may differ
_SAME_PICTURE = 0.95  # correlation of the first pictures of two copies; by choice
_CUT_S = 2.0  # between the end of a chapter and the start of the next, as clocks state them
_CUT_BYTES = 3_500_000_000  # at least, of a chapter on a card whose files end at 4 GB
_GOPRO = re.compile(r"G[HXLS](\d\d)(\d{4})|GP(\d\d)(\d{4})|(GOPR)(\d{4})", re.IGNORECASE)
_NUMBERED = re.compile(r"(.*?)(?:\d{14}_)?(\d{3,7})(_[A-Z])?", re.IGNORECASE)
_MAKER_PREFIX = re.compile(r"^(G[HXLS](?=\d{6}$)|LRV_|VID_|PRO_)")
_LENS = re.compile(r"_([01])\d_(\d{3})$")


@dataclass(frozen=True)
class RecordedVideo:
    """One recording: its video, or the chapters of it in order, and the copies beside it that are no flights."""

    chapters: tuple[Path, ...]
    copies: tuple[Path, ...] = ()

    @property
    def notices(self) -> tuple[Notice, ...]:
        """What was joined and what was left out."""
        found = []
        if len(self.chapters) > 1:
            names = ", ".join(path.name for path in self.chapters)
            text = f"{len(self.chapters)} chapters of one recording were joined: {names}"
            found.append(Notice("joined_chapters", len(self.chapters), text))
        if self.copies:
            names = ", ".join(path.name for path in self.copies)
            text = f"{names}: a copy of {self.chapters[0].name}, left out"
            found.append(Notice("left_out_copy", len(self.copies), text))
        if self.start_doubt:
            text = (
                f"{self.chapters[0].name} is a later chapter: the times in it are the first one's"
            )
            found.append(Notice("later_chapter", 1, text))
        return tuple(found)

    @property
    def start_doubt(self) -> str:
        """Why its clock states another time than that of its first frame; "" where nothing speaks against it."""
        chapter = _gopro_chapter(self.chapters[0])
        if chapter is None or chapter[1] == 1:
            return ""
        return (
            f"{self.chapters[0].name} is chapter {chapter[1]} of a recording, and its clock states when chapter 1 began: "
            "a log cannot be tied to it. Give the chapters before it as well, or --offset SECONDS by which the log is "
            "ahead of its clock"
        )


def recordings(films: Sequence[Path], *, with_siblings: bool = False) -> list[RecordedVideo]:
    """The recordings among videos, in their order. A copy whose original is not among them is a recording itself.

    `with_siblings`: chapters that follow the last one given are taken from its folder.
    """
    header = cache(_header)
    films = list(dict.fromkeys(films))
    original: dict[Path, Path] = {}
    for film in films:
        others = [each for each in films if each != film and each not in original]
        if (found := _original(film, others, header)) is not None:
            original[film] = found
    for film in original:  # a copy of a copy
        while original[film] in original:
            original[film] = original[original[film]]
    whole = [film for film in films if film not in original]
    chains: list[list[Path]] = []
    for film in sorted(whole, key=_order):
        before = next((each for each in chains if _follows(film, each[-1], header)), None)
        if before is None:
            chains.append([film])
        else:
            before.append(film)
    for chain in chains if with_siblings else ():
        beside = [each for each in sorted(chain[-1].parent.iterdir()) if each not in films]
        while later := next((each for each in beside if _follows(each, chain[-1], header)), None):
            chain.append(later)
    chains.sort(key=lambda each: films.index(each[0]))
    return [
        RecordedVideo(tuple(each), tuple(film for film in original if original[film] in each))
        for each in chains
    ]


def _header(path: Path) -> VideoInfo | None:
    try:
        return read_video_info(path)
    except InputError:  # whoever opens it states what is wrong
        return None


def _order(path: Path) -> tuple[str, str, int]:
    """Chapters of one recording one after another."""
    chapter = _gopro_chapter(path)
    name = path.stem.upper() if chapter is None else chapter[0]
    return str(path.parent), name, 0 if chapter is None else chapter[1]


def _gopro_chapter(path: Path) -> tuple[str, int] | None:
    """The recording of a GoPro's file, and which chapter of it it is, from 1; None for other names."""
    found = _GOPRO.fullmatch(path.stem)
    if found is None:
        return None
    chapter, number, older, older_number, _, first = found.groups()
    if chapter:
        return number, int(chapter)
    return (older_number, int(older) + 1) if older else (first, 1)


def _original(
    film: Path, others: Sequence[Path], header: Callable[[Path], VideoInfo | None]
) -> Path | None:
    """The video that this one is a copy of; None for a recording of its own."""
    stem = film.stem.upper()
    for other in others:
        theirs = other.stem.upper()
        if film.suffix.lower() in _SMALL_COPIES:
            if other.suffix.lower() not in _SMALL_COPIES and _base(stem) == _base(theirs):
                return other
            continue
        if other.suffix.lower() in _SMALL_COPIES:
            continue
        is_lens = film.suffix.lower() == other.suffix.lower() == ".insv"
        if is_lens and _LENS.sub("", stem) == _LENS.sub("", theirs):
            lens, their_lens = _LENS.search(stem), _LENS.search(theirs)
            if lens and their_lens and lens[1] == "1" and their_lens[1] == "0":
                return other  # the other lens of a camera that looks all around
        is_named_alike = stem.startswith(theirs) or theirs.startswith(stem)
        is_named_alike |= _base(stem) == _base(theirs)
        if _is_smaller_twin(film, other, header, is_named_alike=is_named_alike):
            return other
        is_as_large = film.stat().st_size == other.stat().st_size
        if str(other) < str(film) and is_as_large and _ends(film) == _ends(other):
            return other  # byte by byte the same
    return None


def _base(stem: str) -> str:
    return _LENS.sub("", _MAKER_PREFIX.sub("", stem))


def _is_smaller_twin(
    film: Path,
    other: Path,
    header: Callable[[Path], VideoInfo | None],
    *,
    is_named_alike: bool,
) -> bool:
    """Whether two videos with like names, or the same start, are as long and begin with the same picture, and this has
    fewer pixels, or fewer bytes."""
    mine, theirs = header(film), header(other)
    if mine is None or theirs is None or min(mine.duration_s, theirs.duration_s) <= 0:
        return False
    if not (is_named_alike or (mine.start_ns and mine.start_ns == theirs.start_ns)):
        return False
    if abs(mine.duration_s - theirs.duration_s) > _ALIKE * theirs.duration_s:
        return False
    sizes = [
        (info.width_px * info.height_px, path.stat().st_size)
        for info, path in ((mine, film), (theirs, other))
    ]
    if sizes[0] >= sizes[1]:
        return False
    pictures = np.array([_small_first_picture(path).ravel() for path in (film, other)], float)
    if np.ptp(pictures, axis=1).min() < 1:
        return False
    return bool(np.corrcoef(pictures)[0, 1] > _SAME_PICTURE)


def _small_first_picture(path: Path) -> ImageGray:
    with opened_video(path) as container:
        frame = next(container.decode(video=0))
        return np.asarray(frame.to_ndarray(format="gray", width=64, height=36), np.uint8)


def _ends(path: Path) -> bytes:
    with path.open("rb") as file:
        begin = file.read(_END_BYTES)
        file.seek(max(0, path.stat().st_size - _END_BYTES))
        return hashlib.sha256(begin + file.read()).digest()


def _is_next(film: Path, before: Path) -> bool:
    """Whether a video's name counts on from another one's."""
    mine, theirs = _gopro_chapter(film), _gopro_chapter(before)
    if mine is not None or theirs is not None:
        return mine is not None and theirs is not None and mine == (theirs[0], theirs[1] + 1)
    own, last = (_NUMBERED.fullmatch(each.stem) for each in (film, before))
    if own is None or last is None or (own[1], own[3]) != (last[1], last[3]):
        return False
    return int(own[2]) == int(last[2]) + 1


def _follows(film: Path, before: Path, header: Callable[[Path], VideoInfo | None]) -> bool:
    """Whether a video goes on where another one was cut: by GoPro's names, or by the next number and the clock.

    Its clock states the end of the other one, or, where a file of 4 GB was cut, the same start: no camera records twice
    at once.
    """
    if film.parent != before.parent or film.suffix.lower() != before.suffix.lower():
        return False
    if film.suffix.lower() not in VIDEO_SUFFIXES or not _is_next(film, before):
        return False
    here, there = header(film), header(before)
    if here is None or there is None:
        return False
    if (here.codec, here.width_px, here.height_px) != (
        there.codec,
        there.width_px,
        there.height_px,
    ):
        return False
    if _gopro_chapter(film) is not None:
        return True
    if not here.start_ns or not there.start_ns:
        return False
    later_s = (here.start_ns - there.start_ns) / SECOND_NS
    is_same_start = abs(later_s) <= _CUT_S and before.stat().st_size >= _CUT_BYTES
    return is_same_start or abs(later_s - there.duration_s) <= _CUT_S


class ChapteredVideo(VideoSource):
    """The chapters of one recording as one video: each starts where the one before it ends."""

    def __init__(self, name: str, chapters: Sequence[VideoSource], *, has_own_logs: bool) -> None:
        """`has_own_logs`: each chapter's telemetry is its own, not one log that was named for all."""
        first = chapters[0]
        counts = [each.info.frame_count for each in chapters]
        info = replace(
            first.info,
            frame_count=sum(counts),
            duration_s=sum(each.info.duration_s for each in chapters),
            is_cut=False,
        )
        self._first_frames = np.cumsum([0, *counts]).tolist()
        lasting_s = np.cumsum([0.0, *(each.info.duration_s for each in chapters)])
        self._begins_ns = [round(each * SECOND_NS) for each in lasting_s]
        telemetry = first.telemetry
        if has_own_logs:
            telemetry = _joined([each.telemetry for each in chapters], self._begins_ns)
        super().__init__(name, first.fingerprint, info, first.camera, telemetry)
        self._chapters = tuple(chapters)
        self.inputs = tuple(each.info.path.name for each in chapters)
        self.files = tuple(each.info.path for each in chapters)

    def notices(self) -> tuple[Notice, ...]:
        """What was found so far, chapter by chapter; complete when `frames` is exhausted."""
        found = (notice for each in self._chapters for notice in each.notices())
        return tuple(dict.fromkeys(found))

    def frames(
        self, wanted: Callable[[int, int], bool], sparse: SparseReading | None = None
    ) -> Iterator[Frame | LostFrame]:
        """The wanted frames of all chapters in order; see `VideoSource.frames`."""
        for number, chapter in enumerate(self._chapters):
            first, count = self._first_frames[number], chapter.info.frame_count
            later_ns = self.start_ns + self._begins_ns[number] - chapter.start_ns

            reading = None
            if sparse is not None:
                reading = replace(sparse, wanted=_later(sparse.wanted, first, later_ns))
            for each in chapter.frames(_later(wanted, first, later_ns), reading):
                if each.index < count:  # more than its header states would be counted twice
                    index = first + each.index
                    yield replace(
                        each, index=index, name=str(index), time_ns=each.time_ns + later_ns
                    )
            self.reading = chapter.reading

    def sample_frames(self, count: int) -> list[Frame]:
        """A few frames spread over the chapters; see `VideoSource.sample_frames`."""
        shares = np.array_split(np.arange(count), len(self._chapters))
        return [
            replace(
                frame,
                index=first + frame.index,
                name=str(first + frame.index),
                time_ns=frame.time_ns - chapter.start_ns + self.start_ns + begins_ns,
            )
            for chapter, first, begins_ns, share in zip(
                self._chapters, self._first_frames, self._begins_ns, shares
            )
            for frame in chapter.sample_frames(len(share))
        ]


def _later(
    ask: Callable[[int, int], bool], first: int, later_ns: int
) -> Callable[[int, int], bool]:
    """A question about a recording's frames as one about those of a chapter that begins later in it."""

    def asked(index: int, time_ns: int) -> bool:
        return ask(first + index, time_ns + later_ns)

    return asked


def _joined(parts: Sequence[Telemetry], begins_ns: Sequence[int]) -> Telemetry:
    """The chapters' telemetry as one: what counts from its own chapter's start is moved there, and each log goes on
    where the one before it ends."""
    placed = [(part, begin_ns) for part, begin_ns in zip(parts, begins_ns) if part.has_fixes]
    if not placed:
        return parts[0]
    first = placed[0][0]
    is_of_video = bool((first.video_time_ns >= 0).all())
    times: list[TimesNs] = []
    videos: list[TimesNs] = []
    columns: list[dict[str, Floats]] = []
    for part, begin_ns in placed:
        if (part.video_time_ns >= 0).all() != is_of_video:
            continue
        is_undated = part.time_ns[0] < DATED_NS
        time_ns = part.time_ns + (begin_ns if is_undated and is_of_video else 0)
        keep = time_ns > (times[-1][-1] if times else -1)
        if not keep.any():
            continue  # the same log, found beside each chapter
        times.append(time_ns[keep])
        videos.append(part.video_time_ns[keep] + (begin_ns if is_of_video else 0))
        columns.append({name: part[name][keep] for name in TELEMETRY_COLUMNS})
    return replace(
        first,
        time_ns=np.concatenate(times),
        video_time_ns=np.concatenate(videos),
        columns={
            name: np.concatenate([each[name] for each in columns]) for name in TELEMETRY_COLUMNS
        },
    )
