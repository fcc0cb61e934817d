"""What a person wants to see first, and a pair of dates in one sentence."""

import math
from collections import Counter
from collections.abc import Sequence

from sorvolo.findings.register import GroundFinding, Register, begun_and_ended
from sorvolo.survey.findings import ChangeKind
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
    known = {each.date for each in register.looks}
    changed = begun_and_ended(register, {before}, after)
    counts = Counter((found.label, kind) for kind, found in changed)
    parts = []
    for label in dict.fromkeys(each.label for each in ordered(register.findings)):
        came, left = (counts[label, kind] for kind in (ChangeKind.APPEARED, ChangeKind.DISAPPEARED))
        words = [counted(came, label) + " came"] if came else []
        if left:
            words.append(f"{left} left" if words else counted(left, label) + " left")
        parts += [", ".join(words)] if words else []
    unsearched = [date for date in (before, after) if date not in known]
    if not parts and unsearched:
        return f"no telling what came or left: no objects were searched for on {' and '.join(unsearched)}"
    return "; ".join(parts) or "nothing known came or left"
