"""Table 4.2 by the thesis's own names: what a person writes as NAME=VALUE becomes settings."""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from sorvolo.change.pair.thesis import ThesisSettings
from sorvolo.errors import SettingsError
from sorvolo.survey.named_values import named_values, whole_number

LIGHT = "light"
_MOST_THREADS = 256  # a bound for typing errors, beyond any machine that this runs on


@dataclass(frozen=True)
class ThesisOptions:
    """How the thesis's method compares: Table 4.2, and the threads of its three slow steps (section 4.2.2)."""

    settings: ThesisSettings = field(default_factory=ThesisSettings)
    threads: int = 1

    def __post_init__(self) -> None:
        whole = isinstance(self.threads, int) and not isinstance(self.threads, bool)
        if not whole or not 1 <= self.threads <= _MOST_THREADS:
            raise SettingsError(
                f"threads is {self.threads!r}; give a whole number from 1 to {_MOST_THREADS}"
            )


def thesis_options(written: Sequence[str]) -> ThesisOptions:
    """Table 4.2's values, less those written otherwise, such as "T_gray=light" or "W_a=8x8".

    The names are those of `NAMES`, in any case. Raises SettingsError naming what was found and what is known.
    """
    chosen: dict[str, Any] = named_values(written, NAMES, "method thesis")
    threads = chosen.pop("threads", 1)
    return ThesisOptions(ThesisSettings(**chosen), threads)


def _window(written: str) -> tuple[int, int]:
    found = re.fullmatch(r"(\d{1,4})\s*x\s*(\d{1,4})", written)
    if not found:
        raise ValueError("width x height in px, such as 10x10")
    return int(found[1]), int(found[2])


def _level(written: str) -> int | None:
    if written == LIGHT:
        return None
    if not re.fullmatch(r"\d{1,3}", written):
        raise ValueError(f"gray levels from 0 to 255, or {LIGHT}")
    return int(written)


def _share(written: str) -> float:
    if not re.fullmatch(r"\d{0,3}\.?\d{0,12}", written) or written == ".":
        raise ValueError("a number from 0 to 1")
    return float(written)


def _share_or_light(written: str) -> float | None:
    if written == LIGHT:
        return None
    try:
        return _share(written)
    except ValueError as error:
        raise ValueError(f"{error}, or {LIGHT}") from None


def _reading(written: str) -> bool:
    if written not in ("printed", "corrected"):
        raise ValueError("printed or corrected, see docs/errata.md")
    return written == "printed"


NAMES: dict[str, tuple[str, Callable[[str], object]]] = {
    "W_a": ("averaging_px", _window),
    "W_l": ("pattern_px", _window),
    "T_gray": ("gray_threshold", _level),
    "T_H": ("hamming_share", _share_or_light),
    "W_i": ("isolation_px", _window),
    "T_iso": ("isolation_share", _share),
    "T_area": ("area_share", _share),
    "T_B": ("least_distance", _share),
    "eq3.21": ("isolation_as_printed", _reading),
    "threads": ("threads", whole_number),
}
"""The names of Table 4.2 (T_gray is section 3.2's T_diff), the reading of equation 3.21, and the threads."""
