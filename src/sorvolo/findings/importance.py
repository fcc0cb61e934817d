"""What a person wants to see first, and a pair of dates in one sentence."""

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import TypeVar

import numpy as np
import shapely
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from sorvolo.findings.register import UNNAMED, GroundFinding, Register, begun_and_ended
from sorvolo.survey.findings import ChangeFacts, ChangeKind
from sorvolo.survey.objects import PERSON
from sorvolo.survey.wording import counted, plural

_HAS_BEFORE = (ChangeKind.DISAPPEARED, ChangeKind.REPLACED)
_NEAR = 0.5  # of the shorter of two things: nearer, one carries the other, or is its shadow
_IN_A_ROW = 1.5  # of the shorter of two like things: nearer, they are of one row
_LIKE_LENGTHS = 1.6  # times the other's, at most
_LARGE_M = 4.0  # a car
_LORRY_M = 8.0

VEHICLES = frozenset({"car", "truck", "bus", "van", "motorcycle", "bicycle", "boat", "tractor"})


def ordered(findings: Sequence[GroundFinding]) -> list[GroundFinding]:
    """People first, then vehicles, then the rest; in each group what is still there, then large, sure and new first."""

    def key(found: GroundFinding) -> tuple[object, ...]:
        newest, label = found.newest, found.label
        length_m = 0.0 if math.isnan(newest.length_m) else newest.length_m
        return _rank({label}), bool(found.gone), -length_m, -newest.score, -found.first_ns, found.id

    return sorted(findings, key=key)


def between(register: Register, before: str, after: str) -> str:
    """What came and left between two dates that were not compared, by class: "1 person came, 1 left; 12 cars left".
    Counts only what one date saw and the other looked for without finding it."""
    known = {each.date for each in register.looks if len(each.frames.outlines_m)}
    words = in_words(begun_and_ended(register, {before}, after))
    unsearched = [date for date in (before, after) if date not in known]
    if not words and unsearched:
        return f"no telling what came or left: no objects were searched for on {' and '.join(unsearched)}"
    return words or "nothing known came or left"


def in_words(came_or_left: Iterable[tuple[ChangeKind, GroundFinding]]) -> str:
    """What came and left, by class; "" for nothing."""
    kinds = {found: kind for kind, found in came_or_left}
    verbs = (
        (each.label or UNNAMED, "came" if kinds[each] is ChangeKind.APPEARED else "left")
        for each in ordered(list(kinds))
    )
    return "; ".join(_in_parts(Counter(verbs)))


Seen = TypeVar("Seen", bound=ChangeFacts)


def grouped(changes: Sequence[Seen]) -> list[list[Seen]]:
    """The changes of one flight as a person sees them: each in one group, what matters most first in and among them.

    A group is what lies in or against one thing or area, the largest first (a lorry, its load, its shadow), with the
    rows of like things that it touches. What has no class and stands in no changed area is in the last two groups: what
    is smaller than a lorry, and than a car. A person is alone: nothing hides one.
    """
    if not changes:
        return []
    shapes = np.array([shapely.Polygon(each.outline_m) for each in changes])
    shapes = shapely.make_valid(shapes)
    lengths_m = np.array([each.length_m for each in changes])
    is_area = np.array([each.kind is ChangeKind.AREA for each in changes])
    is_person = np.array([PERSON in (each.class_before, each.class_after) for each in changes])
    names = np.array([_name(each) for each in changes])
    tree = shapely.STRtree(shapes)
    one, other = tree.query(shapes, predicate="dwithin", distance=_IN_A_ROW * lengths_m)
    one, other = (each[~(is_person[one] | is_person[other])] for each in (one, other))
    apart_m = shapely.distance(shapes[one], shapes[other])
    shorter_m = np.minimum(lengths_m[one], lengths_m[other])
    is_like = np.maximum(lengths_m[one], lengths_m[other]) <= _LIKE_LENGTHS * shorter_m
    is_like &= (names[one] == names[other]) & ~is_area[one] & (apart_m <= _IN_A_ROW * shorter_m)
    size = (len(changes), len(changes))
    _, rows = connected_components(
        coo_array((is_like[is_like], (one[is_like], other[is_like])), size), directed=False
    )
    against = coo_array((apart_m <= _NEAR * shorter_m, (one, other)), size).tocsr()
    heads = np.full(len(changes), -1)
    for head in np.argsort(-lengths_m, kind="stable"):
        if heads[head] < 0:
            taken = np.append(np.flatnonzero(against[[head]].toarray()[0]), head)
            taken = taken[heads[taken] < 0]
            heads[taken] = head
            heads[(heads < 0) & np.isin(rows, rows[taken[~is_area[taken]]])] = head
    is_named = (names != [each.kind.value for each in changes]) | is_area
    sizes = len(changes) + np.digitize(lengths_m[heads], [_LORRY_M, _LARGE_M])
    is_one_of_many = (lengths_m[heads] < _LORRY_M) & ~np.isin(heads, heads[is_named])
    heads = np.where(is_one_of_many, sizes, heads)
    groups: dict[int, list[Seen]] = {}
    for head, each in sorted(zip(heads.tolist(), changes), key=lambda pair: _importance(pair[1])):
        groups.setdefault(head, []).append(each)
    last = [groups.pop(len(changes) + size, []) for size in (1, 2)]
    return [*groups.values(), *filter(None, last)]


def in_short(changes: Sequence[ChangeFacts], *, is_local: bool = False) -> str:
    """Changes in a sentence: "9 cars came, 12 left, 1 moves; changed ground in 3 places, up to 210 m long; 14 small
    things changed". Lengths are left out of a map without metres."""
    named: Counter[tuple[str, str]] = Counter()
    others: Counter[tuple[str, str]] = Counter()
    areas = [each.length_m for each in changes if each.kind is ChangeKind.AREA]
    for each in sorted(changes, key=_importance):
        if each.kind is ChangeKind.AREA:
            continue
        moves = each.kind is ChangeKind.MOVING
        if before := each.class_before if each.kind in _HAS_BEFORE else "":
            named[before, "left"] += 1
        if after := each.class_after if each.kind is not ChangeKind.DISAPPEARED else "":
            named[after, "moves" if moves else "came"] += 1
        if not before and not after:
            size = "" if is_local else "large " if each.length_m >= _LARGE_M else "small "
            others[f"{size}thing", "moves" if moves else "changed"] += 1
    parts = _in_parts(named)
    if areas:
        size = "" if is_local else f", {'up to ' if len(areas) > 1 else ''}{max(areas):.0f} m long"
        parts.append(f"changed ground in {counted(len(areas), 'place')}{size}")
    return "; ".join([*parts, *_in_parts(others)]) or "nothing changed"


def _in_parts(counts: Counter[tuple[str, str]]) -> list[str]:
    """How many of each class did what: "12 cars came, 9 left"."""
    parts = dict.fromkeys((label for label, _ in counts), "")
    for (label, verb), count in sorted(counts.items(), key=lambda each: each[0][1]):
        does = plural(verb, count) if verb == "moves" else verb
        first = f"{counted(count, label)} {does}"
        parts[label] += f", {count:,} {does}" if parts[label] else first
    return list(parts.values())


def _name(change: ChangeFacts) -> str:
    return change.class_after or change.class_before or change.kind.value


def _rank(labels: set[str]) -> int:
    return 0 if PERSON in labels else 1 if labels & VEHICLES else 2


def _importance(change: ChangeFacts) -> tuple[object, ...]:
    """For sorting: people, vehicles, the rest; the large and sure first."""
    labels = {change.class_before, change.class_after}
    return _rank(labels), -change.length_m * change.score, len(change.id), change.id
