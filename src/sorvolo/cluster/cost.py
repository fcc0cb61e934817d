"""What a try at a flight asks of a machine, by what flights took so far."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import ceil
from statistics import median

from sorvolo.capture.live.addresses import is_live_address
from sorvolo.cluster.table import Row, State


@dataclass(frozen=True)
class CostSettings:
    """What a try is given, and what of a machine all tries may have together."""

    unknown_mb: float = (
        1000.0  # before any flight was measured; 4,000 frames of 1080p peak at 634 MB
    )
    reserve: float = 1.2  # times the largest flight so far, and the cores of live ones
    least_live_cpus: float = (
        0.1  # of a live flight: one that waited for its drone took next to nothing
    )
    detector_mb: float = 1000.0  # of the detector that flights share, at least: what it adds to a map of 1080p frames
    settled_s: float = 60.0  # after which a live flight is budgeted what it has had, and a reserve
    machine_share: float = (
        0.8  # of a machine's memory: the rest is for the system, the batch and the files' cache
    )


@dataclass(frozen=True)
class Cost:
    """Cores and memory that one try is given."""

    cpus: float
    memory_mb: float


def cost_of(row: Row, rows: Iterable[Row], settings: CostSettings = CostSettings()) -> Cost:
    """The memory of the largest flight of the same mission so far and a fifth more, the cores of the median one.

    A recorded flight takes all of a core, or several; a live one as much of one as its pictures ask for, by the live
    ones so far and a fifth more. After each crash of this flight it is given twice the memory: want of it may have been
    the reason.
    """
    ended = [
        each
        for each in rows
        if each.mission == row.mission
        and each.state in (State.DONE, State.DOUBTFUL)
        and each.peak_memory_mb > 0
    ]
    memory_mb = (
        settings.reserve * max((each.peak_memory_mb for each in ended), default=0.0)
        or settings.unknown_mb
    )
    return Cost(_cpus(row, ended, settings), memory_mb * 2**row.crashes)


def _cpus(row: Row, ended: Sequence[Row], settings: CostSettings) -> float:
    """The cores of a flight, by those of its kind, recorded or live, that have ended; one before the first has."""
    is_live = is_live_address(row.source)
    shares = [
        each.cpu_s / each.seconds
        for each in ended
        if each.seconds > 0 and is_live_address(each.source) == is_live
    ]
    if not is_live or not shares:
        return max(1.0, round(median(shares or [1.0])))
    return max(
        settings.least_live_cpus, ceil(20 * settings.reserve * median(shares)) / 20
    )  # in twentieths of a core
