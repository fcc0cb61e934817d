"""How far a mapping is, told on the terminal while it runs."""

from collections.abc import Iterable

from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeRemainingColumn

from sorvolo.survey.mosaic import MosaicUpdate


def show_progress(updates: Iterable[MosaicUpdate], console: Console) -> int:
    """Take all updates, drawing a bar for each flight; return how many there were.

    The bar tells frames a second, frames placed by vision of those selected, and the time left.
    """
    columns = (
        SpinnerColumn(), TextColumn("{task.description}"), BarColumn(bar_width=30),
        TextColumn("{task.fields[told]}"), TimeRemainingColumn(),
    )
    count, before = 0, None
    with Progress(*columns, console=console, transient=True) as progress:
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


def words_of(update: MosaicUpdate) -> str:
    """What the bar says of an update."""
    rate = f"{update.frames_read / update.seconds:.1f} frames/s, " if update.seconds > 0 else ""
    return f"{rate}{update.by_vision} of {update.keyframes} placed by vision"
