"""Bars on a terminal while something runs, and what they say of a mapping."""

from collections.abc import Iterable
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, SpinnerColumn, TextColumn, TimeRemainingColumn

if TYPE_CHECKING:
    from sorvolo.survey.mosaic import MosaicUpdate


def bars(*columns: ProgressColumn, console: Console, stay: bool = False) -> Progress:
    """Bars that are gone at the end unless they `stay`; nothing where no terminal shows them.

    rich itself ends bars that nobody sees with an empty line, which would stand before an error's.
    """
    return Progress(*columns, console=console, transient=not stay, disable=not console.is_interactive)


def show_progress(updates: Iterable["MosaicUpdate"], console: Console) -> int:
    """Take all updates, drawing a bar for each flight; return how many there were.

    The bar tells frames a second, frames placed by vision of those selected, and the time left.
    """
    columns = (
        SpinnerColumn(), TextColumn("{task.description}"), BarColumn(bar_width=30),
        TextColumn("{task.fields[told]}"), TimeRemainingColumn(),
    )
    count, before = 0, None
    with bars(*columns, console=console) as progress:
        task = progress.add_task("opening", total=None, told="")
        for update in updates:
            count += 1
            if before is not None and update.keyframes <= before.keyframes:
                progress.update(task, description="mapped", completed=before.frames_expected)
                task = progress.add_task("mapping", total=None, told="")
            before = update
            progress.update(
                task, description="mapping", told=words_of(update),
                total=max(update.frames_expected, update.frames_read), completed=update.frames_read,
            )
    return count


def words_of(update: "MosaicUpdate") -> str:
    """What the bar says of an update."""
    rate = f"{update.frames_read / update.seconds:.1f} frames/s, " if update.seconds > 0 else ""
    return f"{rate}{update.by_vision} of {update.keyframes} placed by vision"
