"""How far a command is: a bar on a terminal, a line every ten seconds elsewhere, as in a log file."""

import logging
import time
from collections.abc import Callable, Generator, Iterable
from contextvars import ContextVar
from typing import TYPE_CHECKING, Self, TypeVar

from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeRemainingColumn

from sorvolo.cli.printing import Console
from sorvolo.survey.wording import counted

if TYPE_CHECKING:
    from sorvolo.survey.mosaic import MosaicUpdate

_LOG = logging.getLogger("sorvolo.progress")
_LINE_EVERY_S = 10.0  # a log file of an hour stays one to read; by choice

T = TypeVar("T")
U = TypeVar("U")

IS_QUIET = ContextVar("IS_QUIET", default=False)
"""Whether the command that runs was asked to show no progress."""


class ProgressReport:
    """What runs, how much of it is done, and how it goes. A context manager.

    On a terminal it is a bar that is gone at the end unless it `stays`. Elsewhere it is a line at most every ten
    seconds, and none for what ends sooner. `clock` gives seconds that only go forward.
    """

    def __init__(
        self, console: Console, *, stays: bool = False, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.console, self._clock = console, clock
        self._is_quiet = IS_QUIET.get()
        self._is_live = console.is_interactive and not self._is_quiet
        self._last_s = clock()
        self._task = ""
        self._bar = Progress(
            SpinnerColumn(),
            TextColumn("{task.description}"),
            BarColumn(bar_width=30),
            TextColumn("{task.fields[words]}"),
            TimeRemainingColumn(),
            console=console,
            transient=not stays,
            disable=not self._is_live,  # rich itself ends bars that nobody sees with an empty line
        )

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def show(self, task: str, done: int = 0, total: int | None = None, words: str = "") -> None:
        """`done` of `total` of a task (None: total unknown), and more in `words`; a new task, a new bar."""
        so_far = f" {done:,} of {total:,}" if total else f" {done:,}" if done else ""
        line = f"{task}{so_far}{', ' + words if words else ''}"
        _LOG.info(line)
        if self._is_live:
            if task != self._task:
                for earlier in self._bar.task_ids:
                    self._bar.update(earlier, visible=False)
                self._bar.add_task(task, words="")
            # a total of None would stop the bar from ever filling; rich pulses until there is one
            self._bar.update(self._bar.task_ids[-1], completed=done, total=total, words=words)
        elif not self._is_quiet and self._clock() - self._last_s >= _LINE_EVERY_S:
            self._last_s = self._clock()
            self.console.print(line, markup=False, soft_wrap=True)
        self._task = task


def shown_work(work: Generator[U, None, T], show: Callable[[ProgressReport, U], None]) -> T:
    """Do all of the work, showing each update on stderr; what the work returns."""
    with ProgressReport(Console(stderr=True)) as progress:
        while True:
            try:
                update = next(work)
            except StopIteration as end:
                return end.value
            show(progress, update)


class Resumed:
    """Announces once that a run goes on after frames of one that was stopped.

    When the first new frame comes, or, where that one had taken all frames, at the `end`.
    """

    def __init__(self, console: Console) -> None:
        self._console = console
        self._count = 0

    def take(self, count: int, *, is_resumed: bool) -> None:
        """An update, and how many frames there are with it."""
        if is_resumed:
            self._count = count
        else:
            self._announce("continuing after")

    def end(self) -> None:
        """No more updates come."""
        self._announce("continued after all")

    def _announce(self, words: str) -> None:
        if self._count:
            self._console.print(f"{words} {counted(self._count, 'frame')} of a stopped run")
            self._count = 0


def show_progress(updates: Iterable["MosaicUpdate"], console: Console) -> int:
    """Take all updates of a mapping, showing each flight's progress; return how many there were."""
    count, flight, before = 0, 1, None
    resumed = Resumed(console)
    with ProgressReport(console) as progress:
        progress.show("opening")
        for update in updates:
            count += 1
            if before is not None and update.keyframes <= before.keyframes:
                flight += 1
            resumed.take(update.keyframes, is_resumed=update.is_resumed)
            before = update
            task = "mapping, frame" if flight == 1 else f"mapping flight {flight}, frame"
            expected = max(update.frames_expected, update.frames_read)
            progress.show(task, update.frames_read, expected, words_of(update))
        resumed.end()
    return count


def words_of(update: "MosaicUpdate") -> str:
    """How a mapping goes: "10.0 frames/s, 7 of 8 frames matched"."""
    matched = f"{update.by_vision:,} of {counted(update.keyframes, 'frame')} matched"
    return rate_words(update.frames_read, update.seconds) + matched


def rate_words(frames: int, seconds: float) -> str:
    """ "10.0 frames/s, " where some time has passed."""
    return f"{frames / seconds:.1f} frames/s, " if seconds > 0 else ""
