"""What stands on a finished map: the sightings of all its frames fused, so that each object is there once.

Tracking follows objects through time with the telemetry of each frame. Here all frames have their final places,
which fit each other far better than telemetry does, so sightings are put together by place alone, whatever the order in
which the drone came by; only what moves is followed through time (`walking`).
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from sorvolo.geometry.arrays import Floats, Rows
from sorvolo.geometry.box_overlap import iou_matrix, nesting_matrix
from sorvolo.survey.mosaic import PlacedFrame
from sorvolo.survey.objects import TYPICAL_SIZE_M
from sorvolo.tracking.association import least_cost
from sorvolo.tracking.followed import WITHIN
from sorvolo.tracking.laying import LaidSighting, shows, usual_height_m
from sorvolo.tracking.sizes import size_log_odds
from sorvolo.tracking.view_evidence import score_from_views

_TURNS = np.radians(np.arange(0.0, 180.0, 5.0))

_GATE = 9.2  # squared distance in sigmas, two axes: 99 in 100 sightings of one object lie nearer
# added for a sighting of another class: rather another object, yet classes are mistaken
_OTHER_CLASS = 4.0
_DRIFT_M = 0.12  # by which frames of one map lie beside each other where they were not linked
_SAME_BOX = 0.55  # overlap of two boxes of one frame from which they show one object, whatever their classes
# of the fewer views: what is seen twice in more frames than these is two objects
_SHARED_FRAMES = 0.25

_TOP = 0.85  # of a body's height: where the top of its box is projected
_HEIGHT_SIGMA = 0.3  # people stand, sit and lie
_SIZE_SIGMA = 0.3  # of length and width

_LEAST_SCORE = 0.3  # from which on a class is reported for which none is given
_LIKELY = 0.5  # from which all views together report what one of them does
_STANDING_SHARE = 0.3  # of the frames that show a place: what so many saw there is no part of a way
# by which the map's lengths may be off, relative: that of GPS heights over a flight
_SCALE_SIGMA = 0.1

# What moves while frames are seconds apart: sightings at changing places that one walker or car explains.
_MOST_M_S = {"person": 4.0, "car": 20.0}  # a runner; a car in town; what is neither walks
_OTHER_M_S = 4.0  # of a class of a user's own model, as a person's

_LEAST_M_S = 0.25  # slower is a place badly known
_LONGEST_GAP_S = 6.0  # between two sightings of a way
# two sightings lie on a straight line whatever they are: these must be whole and ...
_LEAST_VIEWS = 3
_SURE_SCORE = 0.5  # ... of this score
_AGAIN_S = 60.0  # what walks on as it did is known again after so long ...
_SWERVE = 0.35  # ... within so much of the way that it goes meanwhile
_MOST_OFF = 3.0  # sigmas, rms, from even motion along a line
_WOBBLE_M_S2 = 0.4  # how much walkers turn and change their pace


@dataclass(frozen=True, eq=False)
class Standing:
    """One object; `members` are the indices of its sightings, in order of time, `best` that of its clearest.

    `score` counts all frames that could show it (`view_evidence`); for moving objects it is the mean over frames that show them.
    `position_m` (2,) is its foot, where it was last seen if it moves, with `sigma_m`, per axis, against other objects
    of the same map. `size_m` (2,) are the longer and the shorter side, NaN of what the picture's edge always cut.
    `velocity_m_s` (2,) is zero unless it moves. `possible_views` counts the frames that show its middle, and its own.
    """

    members: tuple[int, ...]
    best: int
    label: str
    score: float
    class_scores: dict[str, float]
    position_m: Floats
    sigma_m: float
    size_m: Floats
    possible_views: int
    velocity_m_s: Floats = field(default_factory=lambda: np.zeros(2))

    @property
    def moves(self) -> bool:
        """Whether it moved while it was seen."""
        return bool(np.any(self.velocity_m_s))


@dataclass(frozen=True)
class Fused:
    """All objects, and how many sightings that are reported belong to none, by the frames that show their place."""

    objects: tuple[Standing, ...]
    dropped: int


def fuse(
    laid: Sequence[LaidSighting],
    frames: Sequence[PlacedFrame],
    least: Mapping[str, float] | None = None,
) -> Fused:
    """The objects that the sightings of these frames show, each once, the surest first.

    `least` is the score from which on a frame reports each class, else 0.3. Weaker sightings count as evidence: what all
    frames that show its place leave below it, or below 0.5, is dropped, unless several sightings of that score lie on the way of
    something that walks or drives: that is reported once, as moving. So is what seems to stand by one whole view of its
    place, where at least half of the frames that show it do not see it there.
    """
    if not laid:
        return Fused((), 0)
    thresholds = defaultdict(lambda: _LEAST_SCORE, least or {})
    strong = np.array(
        [each.sighting.score >= thresholds[each.sighting.label] for each in laid], bool
    )
    # only groups of which a frame alone would report at least one sighting
    groups = [group for group in _merged(_gathered(laid), laid) if strong[group].any()]
    standing: list[Standing] = []
    left: list[int] = []
    doubted: set[int] = set()
    for group, possible in zip(groups, _possible_views(groups, laid, frames)):
        label, score = _score(group, possible, laid)
        is_reported = score >= min(thresholds[label], _LIKELY)
        views = len(_frames_of([k for k in group if not (is_reported and laid[k].is_cut)], laid))
        if is_reported:
            standing.append(_standing(group, laid, possible, score))
        unseen = possible - len(_frames_of(group, laid))
        is_seldom = views < max(2.0, _STANDING_SHARE * (views + unseen))
        if is_seldom and (not is_reported or 2 * views <= possible):
            # a frame's twins are one step of a way
            surest_last = sorted(group, key=lambda k: laid[k].sighting.score)
            own = {laid[k].sighting.frame_index: k for k in surest_last if strong[k]}.values()
            left += own
            doubted |= set(own) if is_reported else set()
    walks = [[left[k] for k in walk] for walk in _walks([laid[k] for k in left])]
    # two places alone may be those of two things that stand
    walks = [each for each in walks if len(each) >= _LEAST_VIEWS or doubted.isdisjoint(each)]
    walked = set().union(*walks) & doubted
    whole = {k for k, each in enumerate(laid) if strong[k] and not each.is_cut}
    # one that was seen there beside the walk stands
    objects = [
        each
        for each in standing
        if walked.isdisjoint(each.members)
        or _frames_of([*whole.intersection(each.members)], laid)
        - _frames_of([*walked.intersection(each.members)], laid)
    ]
    objects += [_moving(each, laid) for each in walks]
    used = set[int]().union(*(each.members for each in objects))
    dropped = int(strong.sum()) - int(strong[list(used)].sum())
    return Fused(tuple(sorted(objects, key=lambda each: -each.score)), dropped)


def fitted_size_m(
    laid: Sequence[LaidSighting],
    label: str,
    height_m: float,
) -> Floats:
    """(2,) the longer and the shorter side of a box on the ground that has the sightings' sides.

    A body of length l, width w, turned by a, spans |l cos a| + |w sin a| along an axis, and its height times the lean
    along it. Classes that Sorvolo knows are held near their usual sides; of others the sides' medians are taken.
    """
    whole = [each for each in laid if not each.is_cut] or list(laid)
    sides_m = np.array([each.sides_m for each in whole])
    if label not in TYPICAL_SIZE_M:
        return np.sort(np.median(np.sort(sides_m, axis=1), axis=0))[::-1]
    usual_m = np.array(TYPICAL_SIZE_M[label][:2])
    axes = np.array([each.axes for each in whole]).reshape(-1, 2)
    leans = np.repeat(np.array([each.lean for each in whole]), 2, axis=0)
    spans_m = np.maximum(
        sides_m.ravel() - _TOP * height_m * np.abs((axes * leans).sum(axis=1)), 0.05
    )
    angle = np.arctan2(axes[:, 1], axes[:, 0])
    weight = 1.0 / (0.05 + 0.08 * spans_m)
    prior = 1.0 / (_SIZE_SIGMA * usual_m)
    best, best_cost = usual_m, np.inf
    for turn in _TURNS:
        matrix = np.abs(np.column_stack([np.cos(angle - turn), np.sin(angle - turn)]))
        rows = np.vstack([matrix * weight[:, None], np.diag(prior)])
        right = np.concatenate([spans_m * weight, usual_m * prior])
        sides, _, _, _ = np.linalg.lstsq(rows, right, rcond=None)
        cost = float(((rows @ sides - right) ** 2).sum())
        if cost < best_cost:
            best, best_cost = sides, cost
    return np.sort(np.maximum(best, 0.05))[::-1]


@dataclass(eq=False)
class _Gathering:
    """An object while its sightings come together: information (2, 2), and information times place (2,).

    They are those of whole views where there are any: what the picture's edge cuts is off to the same side in frame
    after frame. `beyond_m2` (2, 2) is what the best of them leaves open of where the middle lies beyond that edge.
    """

    members: list[int]
    information: Floats
    weighted_m: Floats
    label_scores: dict[str, float]
    beyond_m2: Floats

    @property
    def covariance(self) -> Floats:
        return np.asarray(np.linalg.inv(self.information) + self.beyond_m2, np.float64)

    @property
    def place_m(self) -> Floats:
        return np.asarray(np.linalg.solve(self.information, self.weighted_m), np.float64)

    @property
    def is_cut(self) -> bool:
        return bool(np.any(self.beyond_m2))

    @property
    def label(self) -> str:
        return max(self.label_scores, key=self.label_scores.__getitem__)

    def take(self, other: "_Gathering") -> None:
        self.members += other.members
        if self.is_cut == other.is_cut:
            self.information = self.information + other.information
            self.weighted_m = self.weighted_m + other.weighted_m
            self.beyond_m2 = min(self.beyond_m2, other.beyond_m2, key=np.trace)
        elif self.is_cut:
            self.information, self.weighted_m, self.beyond_m2 = (
                other.information,
                other.weighted_m,
                other.beyond_m2,
            )
        for name, score in other.label_scores.items():
            self.label_scores[name] = self.label_scores.get(name, 0.0) + score


def _gathered(laid: Sequence[LaidSighting]) -> list[_Gathering]:
    """Sightings frame by frame, each to the nearest object so far, no two of a frame to the same."""
    by_frame: dict[int, list[int]] = defaultdict(list)
    for k, each in enumerate(laid):
        by_frame[each.sighting.frame_index].append(k)
    objects: list[_Gathering] = []
    places_m = np.zeros((0, 2))
    for inside in sorted(by_frame.values(), key=lambda rows: laid[rows[0]].sighting.time_ns):
        new = [_begin(group, laid) for group in _without_twins(inside, laid)]
        # squared distances in sigmas, at most the gate
        costs = np.full((len(new), len(objects)), _GATE)
        for row, begun in enumerate(new):
            apart_m = np.hypot(*(places_m - begun.place_m).T)
            for column in np.flatnonzero(apart_m < _reach_m(begun, laid)):
                costs[row, column] = min(_GATE, _distance(begun, objects[int(column)]))
        rows, columns = least_cost(costs)
        matched = {row: column for row, column in zip(rows, columns) if costs[row, column] < _GATE}
        for row, begun in enumerate(new):
            if row in matched:
                objects[matched[row]].take(begun)
            else:
                objects.append(begun)
        places_m = np.array([each.place_m for each in objects])
    return objects


def _without_twins(inside: Sequence[int], laid: Sequence[LaidSighting]) -> list[list[int]]:
    """The sightings of one frame, those together that are one object, the surest first.

    They are boxes of several classes on one place, or of one class, one within the other.
    """
    sightings = [laid[k].sighting for k in inside]
    boxes = np.array([each.box_px for each in sightings], np.float64).reshape(-1, 4)
    overlap, nesting = iou_matrix(boxes, boxes), nesting_matrix(boxes, boxes)
    groups: list[list[int]] = []
    for row in sorted(range(len(inside)), key=lambda row: -sightings[row].score):
        for group in groups:
            first = group[0]
            is_alike = sightings[first].label == sightings[row].label
            if nesting[first, row] > WITHIN if is_alike else overlap[first, row] > _SAME_BOX:
                group.append(row)
                break
        else:
            groups.append([row])
    return [[inside[row] for row in group] for group in groups]


def _begin(members: list[int], laid: Sequence[LaidSighting]) -> _Gathering:
    """An object of one frame's sightings of it; the surest gives its place."""
    first = laid[members[0]].sighting
    information = np.asarray(np.linalg.inv(first.covariance_m2), np.float64)
    scores: dict[str, float] = {}
    for k in members:
        each = laid[k].sighting
        scores[each.label] = scores.get(each.label, 0.0) + each.score
    return _Gathering(
        members, information, information @ first.position_m, scores, laid[members[0]].beyond_m2
    )


def _reach_m(each: _Gathering, laid: Sequence[LaidSighting]) -> float:
    """Beyond this nothing is asked whether it is the same."""
    return max(
        3.0,
        2.0 * float(laid[each.members[0]].sighting.size_m[0]),
        6.0 * laid[each.members[0]].own_sigma_m,
    )


def _distance(one: _Gathering, other: _Gathering) -> float:
    """Squared, in sigmas; more between classes."""
    apart_m = one.place_m - other.place_m
    spread = one.covariance + other.covariance + _DRIFT_M**2 * np.eye(2)
    penalty = 0.0 if one.label == other.label else _OTHER_CLASS
    return float(apart_m @ np.linalg.solve(spread, apart_m)) + penalty


def _merged(objects: list[_Gathering], laid: Sequence[LaidSighting]) -> list[list[int]]:
    """What is near enough to be one object and was never, or hardly, seen beside itself, or lies within half its class's
    width: the nearest pairs first."""
    alive = dict(enumerate(objects))
    frames = {k: _frames_of(each.members, laid) for k, each in alive.items()}
    while True:
        keys = list(alive)
        places_m = np.array([alive[key].place_m for key in keys])
        pairs = []
        for row, one in enumerate(keys):
            apart_m = np.hypot(*(places_m[row + 1 :] - places_m[row]).T)
            half_m = TYPICAL_SIZE_M.get(alive[one].label, (0.0, 0.0))[1] / 2
            for k in np.flatnonzero(apart_m < _reach_m(alive[one], laid)).tolist():
                other = keys[row + 1 + k]
                distance = _distance(alive[one], alive[other])
                fewer = min(len(frames[one]), len(frames[other]))
                is_apart = len(frames[one] & frames[other]) <= _SHARED_FRAMES * fewer
                is_body = apart_m[k] < half_m and alive[one].label == alive[other].label
                if is_body or (is_apart and distance < _GATE):
                    pairs.append((distance, one, other))
        if not pairs:
            return [
                sorted(each.members, key=lambda k: laid[k].sighting.time_ns)
                for each in alive.values()
            ]
        taken: set[int] = set()
        for _, one, other in sorted(pairs):
            if not {one, other} & taken:
                taken |= {one, other}
                alive[one].take(alive.pop(other))
                frames[one] |= frames[other]


def _frames_of(members: Sequence[int], laid: Sequence[LaidSighting]) -> set[int]:
    return {laid[k].sighting.frame_index for k in members}


def _possible_views(
    groups: Sequence[Sequence[int]], laid: Sequence[LaidSighting], frames: Sequence[PlacedFrame]
) -> list[int]:
    """How many frames saw each object, or show its middle wherever that lies beyond the edges that cut it.

    Of labelled cars that a window's edge cut in half 0.93 are found, of whole ones 0.99: half a view is one.
    """
    places_m = np.zeros((len(groups), 2))
    up_m, open_m = np.zeros((2, len(groups)))
    for row, group in enumerate(groups):
        chosen = [laid[k] for k in group]
        places_m[row] = np.median([each.sighting.position_m for each in chosen], axis=0)
        up_m[row] = np.median([each.ground_m + each.middle_up_m for each in chosen])
        open_m[row] = np.sqrt(min(np.trace(each.beyond_m2) for each in chosen) / 2)
    looked = [_frames_of(group, laid) for group in groups]
    for frame in frames:
        for row in np.flatnonzero(shows(frame, places_m, up_m, open_m)).tolist():
            looked[row].add(frame.index)
    return [len(each) for each in looked]


def _score(group: Sequence[int], possible: int, laid: Sequence[LaidSighting]) -> tuple[str, float]:
    """What these sightings show, and the score of its being there: each frame's best score of that class counts, and
    its size."""
    label, _, _ = _named(group, laid)
    best: dict[int, float] = {}
    for k in group:
        seen = laid[k].sighting
        if seen.label == label:
            best[seen.frame_index] = max(seen.score, best.get(seen.frame_index, 0.0))
    of_size = 0.0
    if any(laid[k].middle_up_m for k in group):  # a map with metres
        whole = [k for k in group if not laid[k].is_cut]
        sizes_m = [laid[k].sighting.size_m for k in whole or group]
        size_m = np.median(sizes_m, axis=0) if whole else max(sizes_m, key=np.prod)
        of_size = size_log_odds(label, size_m, _SCALE_SIGMA, is_cut=not whole)
    return label, score_from_views(list(best.values()), possible, label, of_size)


def _named(
    members: Sequence[int], laid: Sequence[LaidSighting]
) -> tuple[str, float, dict[str, float]]:
    """Class by summed scores, that class's mean score, and each class's share."""
    scores: dict[str, list[float]] = defaultdict(list)
    for k in members:
        scores[laid[k].sighting.label].append(laid[k].sighting.score)
    sums = {name: sum(each) for name, each in scores.items()}
    label = max(sums, key=sums.__getitem__)
    total = max(sum(sums.values()), 1e-9)
    shares = {
        name: value / total for name, value in sorted(sums.items(), key=lambda item: -item[1])
    }
    return label, float(np.mean(scores[label])), shares


def _standing(
    members: Sequence[int], laid: Sequence[LaidSighting], possible: int, score: float
) -> Standing:
    """One object that stands, from all its sightings."""
    label, _, shares = _named(members, laid)
    chosen = [laid[k] for k in members]
    whole = [each for each in chosen if not each.is_cut] or chosen
    has_metres = any(each.middle_up_m for each in chosen)
    usual_up_m = usual_height_m(label) / 2 if has_metres else 0.0
    # least squares: what was seen from several sides shows how far above the usual height its middle lies
    rows, right = [], []
    for each in whole:
        place_m = each.sighting.position_m + each.lean * (usual_up_m - each.middle_up_m)
        weight = 1.0 / float(np.hypot(each.own_sigma_m, _DRIFT_M))
        rows.append(np.column_stack([np.eye(2), -each.lean]) * weight)
        right.append(place_m * weight)
    rows.append(np.array([[0.0, 0.0, 1.0 / max(_HEIGHT_SIGMA * usual_up_m, 1e-3)]]))
    right.append(np.zeros(1))
    normal = (matrix := np.concatenate(rows)).T @ matrix
    answer = np.asarray(np.linalg.solve(normal, matrix.T @ np.concatenate(right)), np.float64)
    beyond_m2 = min((each.beyond_m2 for each in whole), key=np.trace)
    covariance = np.linalg.inv(normal)[:2, :2] + beyond_m2
    if all(each.is_cut for each in whole):  # no frame shows it whole: nobody saw how long it is
        size_m = np.full(2, np.nan)
    elif has_metres:
        size_m = fitted_size_m(chosen, label, 2 * max(usual_up_m + float(answer[2]), 0.0))
    else:
        size_m = np.median([each.sighting.size_m for each in chosen], axis=0)
    return Standing(
        tuple(members),
        _best(members, laid, label),
        label,
        score,
        shares,
        answer[:2],
        float(np.sqrt(np.trace(covariance) / 2)),
        size_m,
        possible,
    )


def _moving(members: Sequence[int], laid: Sequence[LaidSighting]) -> Standing:
    """One object that moves, from the sightings on its way in order of time."""
    label, score, shares = _named(members, laid)
    chosen = [laid[k] for k in members]
    times_s = _times_s(chosen)
    place_m, velocity_m_s, sigma_m = _line(range(len(chosen)), chosen, times_s, float(times_s[-1]))
    if chosen[-1].is_cut:
        sigma_m = max(sigma_m, chosen[-1].own_sigma_m)
    return Standing(
        tuple(members),
        _best(members, laid, label),
        label,
        score,
        shares,
        place_m,
        sigma_m,
        fitted_size_m(chosen, label, usual_height_m(label)),
        len(members),
        velocity_m_s,
    )


def _best(members: Sequence[int], laid: Sequence[LaidSighting], label: str) -> int:
    """The clearest sighting: sure, large in its picture, and not cut by its edge."""

    def clearness(k: int) -> float:
        each = laid[k]
        left, top, right, bottom = each.sighting.box_px
        doubt = (1.0 if each.sighting.label == label else 0.5) * (0.3 if each.is_cut else 1.0)
        return doubt * each.sighting.score * float((right - left) * (bottom - top)) ** 0.25

    return max(members, key=clearness)


def _walks(laid: Sequence[LaidSighting]) -> list[list[int]]:
    """The walks among these sightings, none of which stands, each the indices of its sightings in order of time.

    A walk needs three sightings of one class on an even way, or two sure ones, no faster than its class moves and fast
    enough to be seen. The longest, then the straightest, are taken first; a walk that goes on as another one ended is
    part of it. Each sighting is in one walk at most.
    """
    times_s = _times_s(laid)
    order: Rows = np.argsort(times_s, kind="stable")
    candidates = []
    for at, first in enumerate(order):
        for second in order[at + 1 :]:
            if times_s[second] - times_s[first] > _LONGEST_GAP_S:
                break
            way = _followed(int(first), int(second), laid, times_s, order)
            if way is not None:
                candidates.append(way)
    candidates.sort(key=lambda way: (-len(way[0]), way[1]))
    taken: set[int] = set()
    result: list[list[int]] = []
    for members, _ in candidates:
        if taken.isdisjoint(members):
            taken.update(members)
            result.append(members)
    return _joined(result, laid, times_s)


def _followed(
    first: int,
    second: int,
    laid: Sequence[LaidSighting],
    times_s: Floats,
    order: Rows,
) -> tuple[list[int], float] | None:
    """The sightings on the way that two begin, and how far they lie off it, rms in sigmas; None where it is no way."""
    one, two = laid[first].sighting, laid[second].sighting
    gap_s = float(times_s[second] - times_s[first])
    fastest_m_s = _MOST_M_S.get(one.label, _OTHER_M_S)
    if one.label != two.label or gap_s <= 0:
        return None
    speed_m_s = float(np.hypot(*(two.position_m - one.position_m))) / gap_s
    if not _LEAST_M_S <= speed_m_s <= fastest_m_s:
        return None
    members = _prolonged([first, second], laid, times_s, order)
    if len(members) < _LEAST_VIEWS:
        is_sure = all(laid[k].sighting.score >= _SURE_SCORE and not laid[k].is_cut for k in members)
        return (members, 0.0) if is_sure else None
    _, velocity_m_s, _ = _line(members, laid, times_s, float(times_s[members[-1]]))
    off = _off(members, laid, times_s)
    if off > _MOST_OFF or not _LEAST_M_S <= np.hypot(*velocity_m_s) <= fastest_m_s:
        return None
    return members, off


def _prolonged(
    way: list[int],
    laid: Sequence[LaidSighting],
    times_s: Floats,
    order: Rows,
) -> list[int]:
    """A way with the later sightings of its class that lie on it."""
    members, label = list(way), laid[way[0]].sighting.label
    for k in order[np.searchsorted(times_s[order], times_s[way[-1]], side="right") :]:
        after_s = float(times_s[k] - times_s[members[-1]])
        if after_s > _LONGEST_GAP_S:
            break
        if after_s <= 0 or laid[k].sighting.label != label:
            continue
        expected_m, velocity_m_s, spread = _line(members, laid, times_s, float(times_s[k]))
        # whoever turns is no farther off than one who is known again by `_joined`
        farthest_m = 1.0 + _SWERVE * float(np.hypot(*velocity_m_s)) * after_s
        turned_m = min(0.5 * _WOBBLE_M_S2 * after_s**2, farthest_m / _MOST_OFF)
        sigma_m = np.hypot(np.hypot(spread, _sigma_m(laid[k])), turned_m)
        if np.hypot(*(laid[k].sighting.position_m - expected_m)) < _MOST_OFF * sigma_m:
            members.append(int(k))
    return members


def _joined(
    ways: list[list[int]], laid: Sequence[LaidSighting], times_s: Floats
) -> list[list[int]]:
    """The same walks, those in one that show one walker out of view for a while."""
    result: list[list[int]] = []
    for later in sorted(ways, key=lambda members: times_s[members[0]]):
        begins_s = float(times_s[later[0]])
        best, best_m = None, np.inf
        for earlier in result:
            gap_s = begins_s - float(times_s[earlier[-1]])
            one, other = laid[earlier[-1]].sighting, laid[later[0]].sighting
            if one.label != other.label or not 0 < gap_s <= _AGAIN_S:
                continue
            expected_m, before_m_s, spread = _line(earlier, laid, times_s, begins_s)
            _, after_m_s, _ = _line(later, laid, times_s, begins_s)
            speed_m_s = float(np.hypot(*before_m_s))
            apart_m = float(np.hypot(*(other.position_m - expected_m)))
            turned_m_s = float(np.hypot(*(after_m_s - before_m_s)))
            reach_m = 1.0 + min(2 * spread, 3.0) + _SWERVE * speed_m_s * gap_s
            if apart_m <= reach_m and turned_m_s <= max(speed_m_s, 0.5):
                best, best_m = (earlier, apart_m) if apart_m < best_m else (best, best_m)
        if best is None:
            result.append(later)
        else:
            best += later
    return result


def _line(
    members: Sequence[int], laid: Sequence[LaidSighting], times_s: Floats, at_s: float
) -> tuple[Floats, Floats, float]:
    """Even motion through the last sightings: the place at a time, the velocity, and the place's sigma per axis."""
    last = members[-4:]  # people turn: what is long ago shows little of where they go
    since_s = times_s[last] - at_s
    places_m = np.array([laid[k].sighting.position_m for k in last])
    weights = 1.0 / np.array([_sigma_m(laid[k]) for k in last])
    matrix = np.column_stack([np.ones(len(last)), since_s]) * weights[:, None]
    solution, _, _, _ = np.linalg.lstsq(matrix, places_m * weights[:, None], rcond=None)
    covariance = np.linalg.pinv(matrix.T @ matrix)
    return solution[0], solution[1], float(np.sqrt(max(covariance[0, 0], 0.0)))


def _off(members: Sequence[int], laid: Sequence[LaidSighting], times_s: Floats) -> float:
    """How far the sightings lie from even motion through their neighbours in time, rms in sigmas."""
    squares = []
    for before, k, after in zip(members, members[1:], members[2:]):
        share = (times_s[k] - times_s[before]) / (times_s[after] - times_s[before])
        expected_m = (1 - share) * laid[before].sighting.position_m + share * laid[
            after
        ].sighting.position_m
        wobble_m = 0.5 * _WOBBLE_M_S2 * (times_s[after] - times_s[before]) ** 2 / 4
        sigma_m = np.hypot(1.5 * _sigma_m(laid[k]), wobble_m)
        squares.append(
            float(((laid[k].sighting.position_m - expected_m) ** 2).sum()) / sigma_m**2 / 2
        )
    return float(np.sqrt(np.mean(squares)))


def _times_s(laid: Sequence[LaidSighting]) -> Floats:
    return np.array([each.sighting.time_ns for each in laid], np.int64) / 1e9


def _sigma_m(each: LaidSighting) -> float:
    return float(np.hypot(each.sighting.sigma_m, 0.1))
