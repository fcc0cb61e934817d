"""What a person wants to see first, and a pair of dates in one sentence."""

import math
from collections import Counter
from collections.abc import Sequence

import numpy as np

from sorvolo.findings.register import GroundFinding, KnownBy, Presence, Register, SearchedDate
from sorvolo.survey.map_objects import looked_at
from sorvolo.survey.objects import PERSON
from sorvolo.survey.wording import counted

VEHICLES = frozenset({"car", "truck", "bus", "van", "motorcycle", "bicycle", "boat", "tractor"})


def ordered(findings: Sequence[GroundFinding]) -> list[GroundFinding]:
    """People first, then vehicles, then the rest; in each group what is still there, then large, sure and new first."""

    def key(found: GroundFinding) -> tuple[object, ...]:
        newest, label = found.newest, found.label
        group = 0 if label == PERSON else 1 if label in VEHICLES else 2
        length_m = 0.0 if math.isnan(newest.length_m) else newest.length_m
        return group, bool(found.gone), -length_m, -newest.score, -found.first_ns, found.id

    return sorted(findings, key=key)


def between(register: Register, before: str, after: str) -> str:
    """What came and left between two dates, by class: "1 person came, 1 left; 12 cars left". Counts only what one date
    saw and the other looked for without finding it; what moves is another's on each date."""
    came: Counter[str] = Counter()
    left: Counter[str] = Counter()
    known = {each.date: each for each in register.looks}
    for found in ordered(register.findings):
        if found.presence(before) is Presence.SEEN and found.presence(after) is Presence.GONE:
            left[found.label] += 1
        elif found.dates[0] == after and _was_looked_for(found, before, known):
            came[found.label] += 1
    parts = []
    for label in dict.fromkeys((*came, *left)):
        words = [counted(came[label], label) + " came"] if came[label] else []
        if left[label]:
            words.append(f"{left[label]} left" if words else counted(left[label], label) + " left")
        parts.append(", ".join(words))
    unsearched = [date for date in (before, after) if date not in known]
    if not parts and unsearched:
        return f"no telling what came or left: no objects were searched for on {' and '.join(unsearched)}"
    return "; ".join(parts) or "nothing known came or left"


def _was_looked_for(found: GroundFinding, date: str, looks: dict[str, SearchedDate]) -> bool:
    """Whether a thing's own comparison saw it come, or a date's frames were searched for its class where it is."""
    if any(each.origin is KnownBy.CHANGED and not each.gone for each in found.sightings):
        return True
    searched = [looks[date].frames] if date in looks else []
    return bool(looked_at(np.array([found.position_m]), [found.label], searched)[0])
