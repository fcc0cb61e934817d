"""How a public function takes files, as text or as any path, one or several; and what JSON gives."""

import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Protocol, TypeAlias, overload

AnyPath: TypeAlias = str | os.PathLike[str]

Json: TypeAlias = dict[str, Any]
"""A JSON object, such as a report or a feature's properties."""

JsonView: TypeAlias = Mapping[str, Any]
"""One that is only read."""


class GivenFlight(Protocol):
    """A flight that is an object already, such as `sorvolo.frames` makes."""

    @property
    def fingerprint(self) -> str:
        """The same for the same flight."""


Inputs: TypeAlias = AnyPath | GivenFlight | Iterable[AnyPath | GivenFlight]
"""One input or several; a text is one input, never a row of letters."""


def listed(given: Any) -> list[Any]:
    """One or several: files, folders, or addresses of live sources as texts, and all else as it is."""
    several = [given] if isinstance(given, str) or not isinstance(given, Iterable) else given
    return [os.fspath(each) if isinstance(each, str | os.PathLike) else each for each in several]


def take_one_or_several(record: object, *names: str) -> None:
    """Let these fields of a frozen record, while it is made, be one thing or several: a text is one thing."""
    for name in names:
        object.__setattr__(record, name, tuple(listed(getattr(record, name))))


@overload
def as_path(given: AnyPath) -> Path: ...
@overload
def as_path(given: AnyPath | None) -> Path | None: ...
def as_path(given: AnyPath | None) -> Path | None:
    """A file or folder; None stays None."""
    return None if given is None else Path(given)


def as_text(given: AnyPath | None) -> str | None:
    """What may be a file, a name or an address; None stays None."""
    return None if given is None else os.fspath(given)
