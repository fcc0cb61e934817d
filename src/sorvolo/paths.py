"""How a public function takes files: as text or as any path, one or several."""

import os
from collections.abc import Iterable
from pathlib import Path
from typing import TypeAlias, overload

AnyPath: TypeAlias = str | os.PathLike[str]
Inputs: TypeAlias = AnyPath | Iterable[AnyPath]
"""One input or several; a text is one input, never a row of letters."""


def listed(given: Inputs) -> list[str]:
    """The inputs as texts: files, folders, or addresses of live sources."""
    if isinstance(given, str | os.PathLike):
        return [os.fspath(given)]
    return [os.fspath(each) for each in given]


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
