"""Settings as a person writes them, NAME=VALUE: found by name in any case, and read by the name's own reader."""

import re
from collections.abc import Callable, Mapping, Sequence

from sorvolo.errors import SettingsError


def named_values(
    written: Sequence[str], names: Mapping[str, tuple[str, Callable[[str], object]]], owner: str
) -> dict[str, object]:
    """Field and value of each NAME=VALUE; `names` gives each name's field and its reader of text.

    A reader raises ValueError naming what it takes. Raises SettingsError for an unknown name, listing those of `owner`,
    and for a value that cannot be read.
    """
    known = {every.lower(): every for every in names}
    chosen: dict[str, object] = {}
    for each in written:
        name, _, value = (part.strip() for part in each.partition("="))
        if not value or name.lower() not in known:
            raise SettingsError(
                f"{each!r} is no setting of {owner}; write NAME=VALUE with {', '.join(names)}"
            )
        field, read = names[known[name.lower()]]
        try:
            chosen[field] = read(value)
        except ValueError as error:
            raise SettingsError(
                f"{each!r} cannot be read; {known[name.lower()]} takes {error}"
            ) from error
    return chosen


def whole_number(written: str) -> int:
    """A whole number of up to six digits; raises ValueError."""
    if not re.fullmatch(r"\d{1,6}", written):
        raise ValueError("a whole number")
    return int(written)


def positive_number(written: str) -> float:
    """A decimal number such as 0.8 or 8e-5; raises ValueError."""
    if not re.fullmatch(r"\d{1,6}(\.\d{1,12})?([eE]-?\d{1,2})?", written):
        raise ValueError("a number such as 0.8 or 8e-5")
    return float(written)
