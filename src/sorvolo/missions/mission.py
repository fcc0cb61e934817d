"""A mission as an object that one holds: its updates, its result, its end."""

import logging
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from typing import Any, Generic, ParamSpec, Self, TypeVar

from sorvolo.errors import SettingsError

_LOG = logging.getLogger("sorvolo.missions")
P = ParamSpec("P")
U = TypeVar("U")
R = TypeVar("R")


class Mission(Iterator[U], Generic[U, R]):
    """A mission at work: each step gives an update, and work goes on when the next is asked for.

    A context manager, which cancels it where it is left early.
    """

    def __init__(self, work: Generator[U, None, R]) -> None:
        self._work = work
        self._is_cancelled = False
        self._made: list[R] = []

    def __next__(self) -> U:
        try:
            update = next(self._work)
        except StopIteration as end:
            if end.value is not None:  # it came to its end; what failed or was closed gives None
                self._made.append(end.value)
                _LOG.info("done")
            raise
        if self._is_cancelled:
            self._work.close()
            raise StopIteration
        return update

    def result(self) -> R:
        """What it made, when all updates that are left are over. Raises SettingsError where it was cancelled or
        had failed before."""
        for _ in self:
            pass
        if not self._made:
            raise SettingsError(
                "the mission was cancelled or failed and made nothing; start it again"
            )
        return self._made[0]

    def cancel(self) -> None:
        """End it now, or where another thread asks for updates after the next one.

        The flight at work is left out of a site; a watch writes what it has found.
        """
        self._is_cancelled = True
        with suppress(ValueError):  # a step runs in another thread, which ends it
            self._work.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.cancel()


def mission(work: Callable[P, Generator[U, None, R]]) -> Callable[P, Mission[U, R]]:
    """Make a function that gives a `Mission` of one that yields updates and returns a result."""

    @wraps(work)
    def begin(*args: P.args, **kwargs: P.kwargs) -> Mission[U, R]:
        _LOG.info("%s begins", work.__name__)  # without addresses, which hold passwords
        return Mission(work(*args, **kwargs))

    return begin


@dataclass(frozen=True)
class FlightOutcome:
    """What a mission made of one flight.

    `trusted` is False where the `headline` asks to check the result before use. `frames` counts them by how they ended,
    `residual_px` is the median distance of matched points (NaN where none were). `paths` are the files by name.
    `done_utc`, ISO 8601, is when the site got a flight that it had already as it was asked for, else "".
    """

    flight: str
    folder: Path
    headline: str
    trusted: bool
    frames: Mapping[str, int]
    residual_px: float
    warnings: tuple[str, ...]
    paths: Mapping[str, Path]
    done_utc: str = ""


def flight_outcome(
    folder: Path, report: Mapping[str, Any], more: Iterable[Path] = (), done_utc: str = ""
) -> FlightOutcome:
    """The outcome that a flight's report.json states, with `more` files than its folder's."""
    own = report.get("comparison") or report
    headline = own.get("headline") or {}
    counts = own.get("views") or report.get("frames") or {}
    median = (own.get("residual_px") or {}).get("median")
    return FlightOutcome(
        str(report.get("flight") or folder.name),
        folder,
        str(headline.get("text") or ""),
        is_good(headline),
        {name: count for name, count in counts.items() if isinstance(count, int)},
        float("nan") if median is None else median,
        tuple(report.get("warnings") or ()),
        {path.name: path for path in (*more, *folder.glob("*")) if path.is_file()},
        done_utc,
    )


def is_good(headline: Mapping[str, Any]) -> bool:
    """Whether a result needs no check, by its headline: exit code 0, else 3."""
    return headline.get("quality", "map") in ("map", "compared") and bool(
        headline.get("complete", "quality" in headline)
    )
