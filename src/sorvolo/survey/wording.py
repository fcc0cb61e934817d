"""Counts in plain English: "1 person", "4 people, 3 cars"."""

from collections import Counter
from collections.abc import Iterable, Mapping

_PLURALS = {
    "person": "people",
    "bus": "buses",
    "is": "are",
    "was": "were",
    "shows": "show",
    "moves": "move",
}


def plural(noun: str, count: int) -> str:
    """The noun, or its last word's plural unless the count is 1."""
    if count == 1:
        return noun
    before, space, last = noun.rpartition(" ")
    if last in _PLURALS:
        return f"{before}{space}{_PLURALS[last]}"
    if last.endswith(("s", "x", "z", "ch", "sh")):
        return f"{noun}es"
    if last.endswith("y") and last[-2:-1] not in "aeiou":
        return f"{noun[:-1]}ies"
    return f"{noun}s"


def counted(count: int, noun: str) -> str:
    """How many of one thing: "1 car", "1,200 frames", "no changes" for none."""
    return f"{count:,} {plural(noun, count)}" if count else f"no {plural(noun, 0)}"


def counted_list(counts: Mapping[str, int], *, none: str = "nothing") -> str:
    """How many of each thing, in the mapping's order; `none` where all counts are 0."""
    return ", ".join(counted(count, name) for name, count in counts.items() if count) or none


def most_first(names: Iterable[str]) -> dict[str, int]:
    """How often each name occurs, the most frequent first, equals by name."""
    return dict(sorted(Counter(names).items(), key=lambda each: (-each[1], each[0])))


def span_words(seconds: float) -> str:
    """A time in whole seconds, zeros left out: "1 h 59 min 58 s", "3 d 2 h"."""
    left, parts = round(seconds), []
    for unit_s, unit in ((86_400, "d"), (3_600, "h"), (60, "min"), (1, "s")):
        count, left = divmod(left, unit_s)
        parts += [f"{count} {unit}"] if count else []
    return " ".join(parts) or "0 s"


def area_text(area_m2: float, *, is_local: bool = False) -> str:
    """Ground in square metres, hectares or square kilometres; in square units of a map without metres."""
    if is_local:
        return f"{area_m2:,.0f} square units"
    if area_m2 < 1_000:
        return f"{area_m2:,.0f} m2"
    amount, unit = (area_m2 / 1e4, "ha") if area_m2 < 1e6 else (area_m2 / 1e6, "km2")
    return f"{amount:.1f} {unit}" if amount < 10 else f"{amount:.0f} {unit}"
