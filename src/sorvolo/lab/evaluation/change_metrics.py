"""How good change detection is: counts of pixels and frames, events, ground."""

import math
from collections.abc import Sequence
from dataclasses import astuple, dataclass, field
from typing import TypeVar

import cv2
import numpy as np
import shapely

from sorvolo.errors import SettingsError
from sorvolo.geometry.arrays import Floats, Mask, PointsM, TimesNs, frozen
from sorvolo.geometry.polygons import gap, points_inside
from sorvolo.survey.findings import ChangeKind

VIDEO_VIEWS = 3
"""So many clear views of a video let an event be announced, and make it one that must be found."""

_TOLERANCE_M = 0.5  # between the centres of a report and of the true thing, or half its length where that is more
_LATE_S = 1.0  # later than this after the view that lets it be announced is late
_FINEST_CELL_M = 0.1  # of compared ground: finer than any outline is known
_MOST_CELLS = 4_000_000  # of compared ground, which bounds its memory


_Event = TypeVar("_Event")


@dataclass(frozen=True)
class Counts:
    """True and false positives and negatives (Table 4.3) of pixels or of frames; `unknown` ones are not judged.

    Rates are as in section 4.2.1. A rate whose denominator is zero is NaN: precision where nothing was found, recall
    where nothing was there, F1 where neither.
    """

    tp: int = 0
    fp: int = 0
    fn: int = 0
    tn: int = 0
    unknown: int = 0

    def __add__(self, other: "Counts") -> "Counts":
        return Counts(*(a + b for a, b in zip(astuple(self), astuple(other))))

    @property
    def precision(self) -> float:
        """Share of what was found that was there."""
        return _ratio(self.tp, self.tp + self.fp)

    @property
    def recall(self) -> float:
        """Share of what was there that was found."""
        return _ratio(self.tp, self.tp + self.fn)

    @property
    def accuracy(self) -> float:
        """Share of right answers."""
        return _ratio(self.tp + self.tn, self.tp + self.tn + self.fp + self.fn)

    @property
    def f1(self) -> float:
        """Harmonic mean of precision and recall."""
        return _ratio(2 * self.tp, 2 * self.tp + self.fp + self.fn)


def pixel_counts(found: Mask, truth: Mask, unknown: Mask | None = None) -> Counts:
    """The pixels of one frame, all (height, width) bool; `unknown` ones are counted apart."""
    known = ~unknown if unknown is not None else np.ones(truth.shape, bool)
    judged = int(np.count_nonzero(known))
    tp = int(np.count_nonzero(found & truth & known))
    positives, there = int(np.count_nonzero(found & known)), int(np.count_nonzero(truth & known))
    return Counts(
        tp, positives - tp, there - tp, judged - positives - there + tp, found.size - judged
    )


def frame_counts(
    found: Mask, truth: Mask, unknown: Mask | None = None, least_px: int = 1
) -> Counts:
    """One frame as a whole: positive when at least `least_px` of its known pixels are changed.

    A frame whose true change has some pixels, but fewer than `least_px`, and a frame of which nothing is known, are
    `unknown`. Raises SettingsError for `least_px` under 1.
    """
    if least_px < 1:
        raise SettingsError(
            f"a changed frame has at least 1 changed pixel, got a least of {least_px}"
        )
    known = ~unknown if unknown is not None else np.ones(truth.shape, bool)
    there = int(np.count_nonzero(truth & known))
    if 0 < there < least_px or not known.any():
        return Counts(unknown=1)
    is_reported = int(np.count_nonzero(found & known)) >= least_px
    if there:
        return Counts(tp=1) if is_reported else Counts(fn=1)
    return Counts(fp=1) if is_reported else Counts(tn=1)


@dataclass(frozen=True, eq=False)
class FoundEvent:
    """A change as it was reported: outline (N, 2) in metres; NaN and None where the report is silent.

    `sigma_m` is that of its place on the map, `world_sigma_m` that of its place in the world.
    """

    id: str
    kind: ChangeKind
    outline_m: PointsM
    sigma_m: float = math.nan
    announced_ns: int | None = None
    world_sigma_m: float = math.nan


@dataclass(frozen=True, eq=False)
class TrueEvent:
    """What really happened: the thing's outline on the ground, (N, 2) metres, and `length_m`, its longer side.

    `clear_ns` (V,) are the times of the views that show it well, `path_m` (V, 2) where it was then, if it moves. An
    event that need not be found (`must_find` False) is neither missed nor false. All places are those on the map, which
    lies `map_off_m` (2,) off there: what was taken out of them.
    """

    id: str
    kind: ChangeKind
    outline_m: PointsM
    length_m: float
    clear_ns: TimesNs | Sequence[int]
    path_m: PointsM = field(default_factory=lambda: np.zeros((0, 2)))
    must_find: bool = True
    map_off_m: Floats = field(default_factory=lambda: np.zeros(2))

    def __post_init__(self) -> None:
        object.__setattr__(self, "map_off_m", frozen(self.map_off_m))
        object.__setattr__(self, "clear_ns", frozen(self.clear_ns, np.int64))
        object.__setattr__(self, "path_m", frozen(self.path_m).reshape(-1, 2))

    def is_shown(self, ground: "ComparedGround", views: int, moving_views: int) -> bool:
        """Whether compared ground shows it well enough to have to be found: all of its outline in `views` clear views,
        or, if it moves, `moving_views` of the places of its path."""
        if self.kind is ChangeKind.MOVING:
            return int(np.count_nonzero(ground.holds(self.path_m))) >= moving_views
        return len(self.clear_ns) >= views and bool(ground.holds(self.outline_m).all())


@dataclass(frozen=True, eq=False)
class EventPair:
    """A true event and the report of it: `offset_m` (2,) is the report's centre less the true one, east and north.

    `delay_s` is from the view after which it could be announced to when it was; NaN where that is not known.
    """

    true: TrueEvent
    found: FoundEvent
    offset_m: Floats
    delay_s: float

    @property
    def error_m(self) -> float:
        """Distance of the two centres."""
        return float(np.hypot(*self.offset_m))


@dataclass(frozen=True, eq=False)
class EventMatch:
    """Every event, true or found, in exactly one place.

    `pairs` were found; `missed` had to be and were not; `skipped` need not have been. Of the other reports, `twice`
    lie on a true event that was found already, `false` on none, `optional` on one that need not be found.
    """

    pairs: tuple[EventPair, ...]
    missed: tuple[TrueEvent, ...]
    skipped: tuple[TrueEvent, ...]
    twice: tuple[FoundEvent, ...]
    false: tuple[FoundEvent, ...]
    optional: tuple[FoundEvent, ...]


@dataclass(frozen=True)
class KindScore:
    """The events of one true kind; `false` and `twice` count reports of that kind."""

    must_find: int
    found: int
    named_right: int
    late: int
    twice: int
    false: int


@dataclass(frozen=True)
class EventScores:
    """What a list of reported events is worth.

    `late` of `judged_late` found events were announced late. Errors are of things that stand still; `within_two_sigma`
    is the share of their single-axis errors on the map that are under twice the stated sigma (0.954 if it is honest and
    errors are normal), `world_within_two_sigma` the same of errors in the world and the sigma stated for that: of one
    flight, whose changes share the map's shift, it is all or nothing. Rates without a denominator are NaN.
    """

    must_find: int
    found: int
    judged_late: int
    late: int
    twice: int
    false: int
    optional: int
    named_right: int
    compared_m2: float
    error_median_m: float
    error_p95_m: float
    sigma_median_m: float
    within_two_sigma: float
    by_kind: dict[str, KindScore]
    world_sigma_median_m: float = math.nan
    world_within_two_sigma: float = math.nan

    @property
    def found_share(self) -> float:
        """Share of the events that had to be found."""
        return _ratio(self.found, self.must_find)

    @property
    def false_per_hectare(self) -> float:
        """False events per hectare of compared ground."""
        return _ratio(self.false, self.compared_m2 / 1e4)


def match_events(
    found: Sequence[FoundEvent],
    true: Sequence[TrueEvent],
) -> EventMatch:
    """Pair reports with true events, each used once: those of the same kind first, then the nearest.

    A report is of a true event when their outlines touch or their centres are within max(half a metre, half the
    thing's length); of something that moves, when it is that near to its path or one of its places lies within the
    report's outline.
    """
    offsets = [[_offset_m(each, truth) for truth in true] for each in found]
    near = np.array(
        [
            [_is_near(each, truth, offsets[i][j]) for j, truth in enumerate(true)]
            for i, each in enumerate(found)
        ],
        bool,
    ).reshape(len(found), len(true))
    # the true event of each found one, by rank
    of_found: dict[int, int] = {}
    for _, _, i, j in sorted(
        (found[i].kind != true[j].kind, float(np.hypot(*offsets[i][j])), i, j)
        for i, j in np.argwhere(near).tolist()
    ):
        if i not in of_found and j not in of_found.values():
            of_found[i] = j
    must_find = np.array([truth.must_find for truth in true], bool)
    is_matched, is_paired = np.zeros(len(true), bool), np.zeros(len(found), bool)
    is_matched[list(of_found.values())], is_paired[list(of_found)] = True, True
    is_twice = ~is_paired & (near & must_find).any(axis=1)
    is_false = ~is_paired & ~near.any(axis=1)
    needed = [each for each in sorted(of_found.items()) if must_find[each[1]]]
    is_found = np.zeros(len(found), bool)
    is_found[[i for i, _ in needed]] = True
    return EventMatch(
        tuple(
            EventPair(true[j], found[i], offsets[i][j], _delay_s(found[i], true[j]))
            for i, j in needed
        ),
        _chosen(true, must_find & ~is_matched),
        _chosen(true, ~must_find),
        _chosen(found, is_twice),
        _chosen(found, is_false),
        _chosen(found, ~(is_twice | is_false | is_found)),
    )


def _chosen(events: Sequence[_Event], which: Mask) -> tuple[_Event, ...]:
    return tuple(each for each, is_chosen in zip(events, which, strict=True) if is_chosen)


def score_events(match: EventMatch, compared_m2: float) -> EventScores:
    """The numbers of a match; `compared_m2` is the ground that was compared with the map."""
    still = [pair for pair in match.pairs if pair.true.kind != ChangeKind.MOVING]
    on_map = [(pair.offset_m, pair.found.sigma_m) for pair in still]
    in_world = [(pair.offset_m + pair.true.map_off_m, pair.found.world_sigma_m) for pair in still]
    delays_s = np.array([pair.delay_s for pair in match.pairs])
    errors_m = [pair.error_m for pair in still]
    return EventScores(
        must_find=len(match.pairs) + len(match.missed),
        found=len(match.pairs),
        judged_late=int(np.isfinite(delays_s).sum()),
        late=_late(match.pairs),
        twice=len(match.twice),
        false=len(match.false),
        optional=len(match.optional),
        named_right=_named_right(match.pairs),
        compared_m2=compared_m2,
        error_median_m=percentile(errors_m, 50),
        error_p95_m=percentile(errors_m, 95),
        sigma_median_m=sigma_median_m(on_map),
        within_two_sigma=within_two_sigma(on_map),
        world_sigma_median_m=sigma_median_m(in_world),
        world_within_two_sigma=within_two_sigma(in_world),
        by_kind={str(kind): _kind_score(match, kind) for kind in ChangeKind},
    )


def sigma_median_m(offsets: Sequence[tuple[Floats, float]]) -> float:
    """The median of the stated sigmas that are known, m."""
    return percentile([sigma_m for _, sigma_m in offsets if math.isfinite(sigma_m)], 50)


def within_two_sigma(offsets: Sequence[tuple[Floats, float]]) -> float:
    """The share of the axes of offsets, (2,) each, that are under twice the sigma stated with it."""
    within = [
        np.abs(offset_m) <= 2 * sigma_m for offset_m, sigma_m in offsets if math.isfinite(sigma_m)
    ]
    return float(np.mean(within)) if within else math.nan


def percentile(values: Sequence[float], share: float) -> float:
    """The percentile of the values; NaN without any."""
    return float(np.percentile(values, share)) if values else math.nan


@dataclass(frozen=True, eq=False)
class ComparedGround:
    """Cells of ground, rows from north to south; the outer corner of the first is at (`west_m`, `north_m`)."""

    cells: Mask  # (rows, columns)
    west_m: float
    north_m: float
    cell_m: float

    @property
    def area_m2(self) -> float:
        """The area of all compared cells."""
        return float(np.count_nonzero(self.cells)) * self.cell_m**2

    def holds(self, points_m: PointsM) -> Mask:
        """(N,) whether each site point, shape (N, 2), lies on compared ground."""
        columns = np.floor((points_m[:, 0] - self.west_m) / self.cell_m).astype(np.int64)
        rows = np.floor((self.north_m - points_m[:, 1]) / self.cell_m).astype(np.int64)
        height, width = self.cells.shape
        inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
        held = np.zeros(len(points_m), bool)
        held[inside] = self.cells[rows[inside], columns[inside]]
        return held


def compared_ground(views_m: Sequence[PointsM], known_m: Sequence[PointsM]) -> ComparedGround:
    """The ground within any of `views_m` and any of `known_m`, convex outlines of (N, 2) site metres each.

    Cells are 0.1 m wide, wider where that would be more than four million of them.
    """
    if not views_m or not known_m:
        return ComparedGround(np.zeros((1, 1), bool), 0.0, 0.0, _FINEST_CELL_M)
    corners = np.concatenate(list(views_m))
    low, high = corners.min(axis=0), corners.max(axis=0)
    size_m = np.maximum(high - low, _FINEST_CELL_M)
    cell_m = max(_FINEST_CELL_M, float(np.sqrt(size_m[0] * size_m[1] / _MOST_CELLS)))
    columns, rows = np.ceil(size_m / cell_m).astype(int) + 1
    west_m, north_m = float(low[0]), float(high[1])
    layers = []
    for outlines_m in (views_m, known_m):
        layer = np.zeros((rows, columns), np.uint8)
        for outline_m in outlines_m:
            pixels = (outline_m - [west_m, north_m]) * [1 / cell_m, -1 / cell_m] - 0.5
            cv2.fillConvexPoly(layer, np.rint(pixels * 16).astype(np.int32), 1, shift=4)
        layers.append(layer > 0)
    return ComparedGround(layers[0] & layers[1], west_m, north_m, cell_m)


def _kind_score(match: EventMatch, kind: ChangeKind) -> KindScore:
    pairs = [pair for pair in match.pairs if pair.true.kind == kind]
    return KindScore(
        len(pairs) + sum(truth.kind == kind for truth in match.missed),
        len(pairs),
        _named_right(pairs),
        _late(pairs),
        sum(each.kind == kind for each in match.twice),
        sum(each.kind == kind for each in match.false),
    )


def _named_right(pairs: Sequence[EventPair]) -> int:
    return sum(pair.true.kind == pair.found.kind for pair in pairs)


def _late(pairs: Sequence[EventPair]) -> int:
    return sum(pair.delay_s > _LATE_S for pair in pairs)


def _delay_s(found: FoundEvent, truth: TrueEvent) -> float:
    if found.announced_ns is None or len(truth.clear_ns) < VIDEO_VIEWS:
        return math.nan
    return (found.announced_ns - int(truth.clear_ns[VIDEO_VIEWS - 1])) / 1e9


def _offset_m(found: FoundEvent, truth: TrueEvent) -> Floats:
    """(2,) from the true place to the report's centre; for something that moves, from the nearest point of its path."""
    centre = shapely.Polygon(found.outline_m).centroid
    place = shapely.Polygon(truth.outline_m).centroid
    if len(truth.path_m):
        path = shapely.LineString([*truth.path_m, truth.path_m[-1]])
        place = path.interpolate(path.project(centre))
    return np.array([centre.x - place.x, centre.y - place.y])


def _is_near(found: FoundEvent, truth: TrueEvent, offset_m: Floats) -> bool:
    if np.hypot(*offset_m) <= max(_TOLERANCE_M, truth.length_m / 2):
        return True
    if len(truth.path_m):
        return bool(points_inside([found.outline_m], truth.path_m).any())
    return gap(found.outline_m, truth.outline_m) == 0


def _ratio(part: float, whole: float) -> float:
    return part / whole if whole else math.nan
