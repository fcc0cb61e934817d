"""What stands on a finished map: the sightings of all its frames fused, so that each object is there once.

Tracking follows objects through time with the telemetry of each frame. Here all frames have their final places,
which fit each other far better than telemetry does, so sightings are put together by place alone, whatever the order in
which the drone came by; only what moves is followed through time (`walking`).
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from sorvolo.geometry.arrays import Floats, Mask, PointsM
from sorvolo.geometry.box_overlap import iou_matrix, nesting_matrix
from sorvolo.survey.mosaic import PlacedFrame
from sorvolo.survey.objects import TYPICAL_SIZE_M
from sorvolo.tracking.association import least_cost
from sorvolo.tracking.doubles import WITHIN
from sorvolo.tracking.laying import LaidSighting, shows, usual_height_m
from sorvolo.tracking.plausible import length_log_odds, usual_length_m
from sorvolo.tracking.view_evidence import EvidenceSettings, score_from_views
from sorvolo.tracking.walking import Walk, WalkSettings, walks

_TURNS = np.radians(np.arange(0.0, 180.0, 5.0))


@dataclass(frozen=True)
class MatchSettings:
    """Which sightings of several frames are one object that stands."""

    gate: float = (
        9.2  # squared distance in sigmas, two axes: 99 in 100 sightings of one object lie nearer
    )
    other_class: float = 4.0  # added for a sighting of another class: rather another object, yet classes are mistaken
    drift_m: float = (
        0.12  # by which frames of one map lie beside each other where they were not linked
    )
    same_box: float = 0.55  # overlap of two boxes of one frame from which they show one object, whatever their classes
    shared_frames: float = (
        0.25  # of the fewer views: what is seen twice in more frames than these is two objects
    )


@dataclass(frozen=True)
class BodySettings:
    """What is known of a class's bodies beside their usual sizes, in shares of these."""

    top: float = 0.85  # of a body's height: tops are narrower than feet
    height_sigma: float = 0.3  # people stand, sit and lie
    size_sigma: float = 0.3  # of length and width


@dataclass(frozen=True)
class StandingSettings:
    """When an object stands where frames saw it, and which sightings are of it."""

    least_score: float = 0.3  # from which on a class is reported for which none is given
    standing_share: float = (
        0.3  # of the frames that show a place: what so many saw there is no part of a way
    )
    evidence: EvidenceSettings = field(default_factory=EvidenceSettings)
    scale_sigma: float = (
        0.1  # by which the map's lengths may be off, relative: that of GPS heights over a flight
    )
    matches: MatchSettings = field(default_factory=MatchSettings)
    bodies: BodySettings = field(default_factory=BodySettings)
    walks: WalkSettings = field(default_factory=WalkSettings)


@dataclass(frozen=True, eq=False)
class Standing:
    """One object; `members` are the indices of its sightings, in order of time, `best` that of its clearest.

    `score` counts all frames that could show it (`view_evidence`); of what moves it is the mean where it was seen.
    `position_m` (2,) is its foot, where it was last seen if it moves, with `sigma_m`, per axis, against other objects
    of the same map. `size_m` (2,) are the longer and the shorter side, NaN of what the picture's edge always cut.
    `velocity_m_s` (2,) is zero unless it moves. `possible_views` counts the frames that show its place and what stands
    there whole, at least its own.
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
    settings: StandingSettings = StandingSettings(),
) -> Fused:
    """The objects that the sightings of these frames show, each once, the surest first.

    `least` is the score from which on each class is reported, `settings.least_score` that of a class it lacks. Weaker
    sightings count as evidence: what all frames that show its place leave below it is dropped, unless several sightings
    of that score lie on the way of something that walks or drives: that is reported once, as moving.
    """
    if not laid:
        return Fused((), 0)
    least = least or {}
    strong = np.array(
        [
            each.sighting.score >= least.get(each.sighting.label, settings.least_score)
            for each in laid
        ]
    )
    groups = _reported(_merged(_gathered(laid, settings.matches), laid, settings.matches), strong)
    objects, unlikely = _standing_or_not(groups, laid, frames, least, settings)
    left = [k for k in unlikely if strong[k]]
    moving = walks([laid[k] for k in left], settings.walks)
    objects += [_moving([left[k] for k in walk.members], walk, laid) for walk in moving]
    used = sum(int(strong[list(each.members)].sum()) for each in objects)
    return Fused(tuple(sorted(objects, key=lambda each: -each.score)), int(strong.sum()) - used)


def without_twins(
    laid: Sequence[LaidSighting], settings: MatchSettings = MatchSettings()
) -> list[list[int]]:
    """The sightings of one frame, those together that are one object, the surest first.

    They are boxes of several classes on one place, or of one class, one within the other.
    """
    order = sorted(range(len(laid)), key=lambda k: -laid[k].sighting.score)
    boxes = np.array([each.sighting.box_px for each in laid], np.float64).reshape(-1, 4)
    overlap, nesting = iou_matrix(boxes, boxes), nesting_matrix(boxes, boxes)
    groups: list[list[int]] = []
    for k in order:
        for group in groups:
            first = group[0]
            if laid[first].sighting.label != laid[k].sighting.label:
                is_same = overlap[first, k] > settings.same_box
            else:
                is_same = nesting[first, k] > WITHIN
            if is_same:
                group.append(k)
                break
        else:
            groups.append([k])
    return groups


def fitted_size_m(
    laid: Sequence[LaidSighting],
    label: str,
    height_m: float,
    settings: BodySettings = BodySettings(),
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
        sides_m.ravel() - settings.top * height_m * np.abs((axes * leans).sum(axis=1)), 0.05
    )
    angle = np.arctan2(axes[:, 1], axes[:, 0])
    weight = 1.0 / (0.05 + 0.08 * spans_m)
    prior = 1.0 / (settings.size_sigma * usual_m)
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


# ---- inside ---------------------------------------------------------------------------------------------------


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


def _gathered(laid: Sequence[LaidSighting], settings: MatchSettings) -> list[_Gathering]:
    """Sightings frame by frame, each to the nearest object so far, no two of a frame to the same."""
    objects: list[_Gathering] = []
    places_m = np.zeros((0, 2))
    for inside in _by_frame(laid):
        groups = without_twins([laid[k] for k in inside], settings)
        new = [_begin([inside[k] for k in group], laid) for group in groups]
        costs = _costs(new, objects, places_m, laid, settings)
        rows, columns = least_cost(costs)
        matched = {
            row: column for row, column in zip(rows, columns) if costs[row, column] < settings.gate
        }
        for row, begun in enumerate(new):
            if row in matched:
                objects[matched[row]].take(begun)
            else:
                objects.append(begun)
        places_m = np.array([each.place_m for each in objects])
    return objects


def _costs(
    new: Sequence[_Gathering],
    objects: Sequence[_Gathering],
    places_m: PointsM,
    laid: Sequence[LaidSighting],
    settings: MatchSettings,
) -> Floats:
    """(new, objects) squared distances in sigmas, at most the gate; `places_m` (objects, 2) are the objects' places."""
    costs = np.full((len(new), len(objects)), settings.gate)
    for row, begun in enumerate(new):
        for column in np.flatnonzero(
            np.hypot(*(places_m - begun.place_m).T) < _reach_m(begun, laid)
        ):
            costs[row, column] = min(
                settings.gate, _distance(begun, objects[int(column)], settings)
            )
    return costs


def _by_frame(laid: Sequence[LaidSighting]) -> list[list[int]]:
    """The sightings of each frame, in order of time."""
    by_frame: dict[int, list[int]] = defaultdict(list)
    for k, each in enumerate(laid):
        by_frame[each.sighting.frame_index].append(k)
    return sorted(by_frame.values(), key=lambda inside: laid[inside[0]].sighting.time_ns)


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


def _distance(one: _Gathering, other: _Gathering, settings: MatchSettings) -> float:
    """Squared, in sigmas; more between classes."""
    apart_m = one.place_m - other.place_m
    spread = one.covariance + other.covariance + settings.drift_m**2 * np.eye(2)
    penalty = 0.0 if one.label == other.label else settings.other_class
    return float(apart_m @ np.linalg.solve(spread, apart_m)) + penalty


def _merged(
    objects: list[_Gathering], laid: Sequence[LaidSighting], settings: MatchSettings
) -> list[list[int]]:
    """What is near enough to be one object and was never, or hardly, seen beside itself; the nearest pairs first."""
    alive = dict(enumerate(objects))
    frames = {k: _frames_of(each.members, laid) for k, each in alive.items()}
    while True:
        pairs = _near_pairs(alive, frames, laid, settings)
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


def _near_pairs(
    alive: dict[int, _Gathering],
    frames: dict[int, set[int]],
    laid: Sequence[LaidSighting],
    settings: MatchSettings,
) -> list[tuple[float, int, int]]:
    keys = list(alive)
    places_m = np.array([alive[key].place_m for key in keys])
    pairs = []
    for row, one in enumerate(keys):
        near = np.flatnonzero(
            np.hypot(*(places_m[row + 1 :] - places_m[row]).T) < _reach_m(alive[one], laid)
        )
        for other in (keys[row + 1 + int(k)] for k in near):
            shared = len(frames[one] & frames[other])
            distance = _distance(alive[one], alive[other], settings)
            most = settings.shared_frames * min(len(frames[one]), len(frames[other]))
            if distance < settings.gate and shared <= most:
                pairs.append((distance, one, other))
    return pairs


def _frames_of(members: Sequence[int], laid: Sequence[LaidSighting]) -> set[int]:
    return {laid[k].sighting.frame_index for k in members}


def _possible_views(
    groups: Sequence[Sequence[int]], laid: Sequence[LaidSighting], frames: Sequence[PlacedFrame]
) -> list[int]:
    """How many frames show each object's place, and it whole; at least those that saw it.

    What all of them cut is seen by none that shows it whole: there both are counted, the latter where it is sure of
    showing it, wherever it lies beyond the others' edges.
    """
    firsts = [[laid[k] for k in group] for group in groups]
    places_m, up_m, reach_m = _usual_bodies(firsts)
    open_m = np.array([_open_m(group) for group in firsts])
    usual_m = np.array([usual_length_m(group[0].sighting.label) for group in firsts])
    reach_m = np.where(open_m > 0, np.maximum(reach_m, usual_m / 2) + 2 * open_m, reach_m)
    counts = np.zeros(len(groups), int)
    for frame in frames:
        counts += shows(frame, places_m, up_m, reach_m).astype(int)
    seen = [len(_frames_of(group, laid)) for group in groups]
    return [
        int(n + views) if is_open else max(int(n), views)
        for n, views, is_open in zip(counts, seen, open_m > 0)
    ]


def _usual_bodies(groups: Sequence[Sequence[LaidSighting]]) -> tuple[PointsM, Floats, Floats]:
    """The medians of each group's places (N, 2), heights of their middles (N,) and half lengths (N,)."""
    places_m = np.array(
        [np.median([each.sighting.position_m for each in group], axis=0) for group in groups]
    )
    up_m = np.array([np.median([each.middle_up_m for each in group]) for group in groups])
    reach_m = (
        np.array([np.median([each.sighting.size_m[0] for each in group]) for group in groups]) / 2
    )
    return places_m, up_m, reach_m


def _open_m(group: Sequence[LaidSighting]) -> float:
    """How far the middle of what the picture's edge always cut may lie beyond; 0 where a frame shows it whole."""
    return float(np.sqrt(min(np.trace(each.beyond_m2) for each in group) / 2))


def _reported(groups: Sequence[list[int]], strong: Mask) -> list[list[int]]:
    """The groups of which a frame alone would report at least one sighting."""
    return [group for group in groups if strong[group].any()]


def _standing_or_not(
    groups: Sequence[Sequence[int]],
    laid: Sequence[LaidSighting],
    frames: Sequence[PlacedFrame],
    least: Mapping[str, float],
    settings: StandingSettings,
) -> tuple[list[Standing], list[int]]:
    """The objects that stand, and the sightings of other groups that may be on the way of something that moves."""
    if not groups:
        return [], []
    objects: list[Standing] = []
    unlikely: list[int] = []
    for group, possible in zip(groups, _possible_views(groups, laid, frames)):
        label, score = _score(group, possible, laid, settings)
        if score >= least.get(label, settings.least_score):
            objects.append(_standing(group, laid, possible, score, settings))
        elif len(_frames_of(group, laid)) < max(2.0, settings.standing_share * possible):
            unlikely += group
    return objects, unlikely


def _score(
    group: Sequence[int], possible: int, laid: Sequence[LaidSighting], settings: StandingSettings
) -> tuple[str, float]:
    """What these sightings show, and the score of its being there: each frame's best score of that class counts, and
    how long it is."""
    label, _, _ = _named(group, laid)
    best: dict[int, float] = {}
    for k in group:
        seen = laid[k].sighting
        if seen.label == label:
            best[seen.frame_index] = max(seen.score, best.get(seen.frame_index, 0.0))
    of_length = length_log_odds(
        label, _seen_length_m([laid[k] for k in group]), settings.scale_sigma
    )
    return label, score_from_views(list(best.values()), possible, settings.evidence, of_length)


def _seen_length_m(chosen: Sequence[LaidSighting]) -> float:
    """The median of the boxes' longer sides; NaN where no frame shows it whole, or on a map without metres."""
    whole_m = [each.sighting.size_m[0] for each in chosen if not each.is_cut and each.middle_up_m]
    return float(np.median(whole_m)) if whole_m else float("nan")


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
    members: Sequence[int],
    laid: Sequence[LaidSighting],
    possible: int,
    score: float,
    settings: StandingSettings,
) -> Standing:
    """One object that stands, from all its sightings."""
    label, _, shares = _named(members, laid)
    chosen = [laid[k] for k in members]
    whole = [each for each in chosen if not each.is_cut] or chosen
    has_metres = any(each.middle_up_m for each in chosen)
    usual_up_m = usual_height_m(label) / 2 if has_metres else 0.0
    answer, covariance = _place_and_rise(whole, usual_up_m, settings)
    height_m = 2 * max(usual_up_m + float(answer[2]), 0.0)
    size_m = (
        fitted_size_m(chosen, label, height_m, settings.bodies)
        if has_metres
        else _median_sides(chosen)
    )
    if all(each.is_cut for each in whole):  # no frame shows it whole: how long it is nobody saw
        size_m = np.full(2, np.nan)
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


def _place_and_rise(
    whole: Sequence[LaidSighting], usual_up_m: float, settings: StandingSettings
) -> tuple[Floats, Floats]:
    """(3,) place and how far its middle lies above the usual height, by least squares, and the place's covariance.

    What was seen from several sides shows how high its middle lies.
    """
    rows, right = [], []
    for each in whole:
        place_m = each.sighting.position_m + each.lean * (usual_up_m - each.middle_up_m)
        weight = 1.0 / float(np.hypot(each.own_sigma_m, settings.matches.drift_m))
        rows.append(np.column_stack([np.eye(2), -each.lean]) * weight)
        right.append(place_m * weight)
    rows.append(np.array([[0.0, 0.0, 1.0 / max(settings.bodies.height_sigma * usual_up_m, 1e-3)]]))
    right.append(np.zeros(1))
    normal = (matrix := np.concatenate(rows)).T @ matrix
    answer = np.asarray(np.linalg.solve(normal, matrix.T @ np.concatenate(right)), np.float64)
    return answer, np.linalg.inv(normal)[:2, :2] + min(
        (each.beyond_m2 for each in whole), key=np.trace
    )


def _moving(members: Sequence[int], walk: Walk, laid: Sequence[LaidSighting]) -> Standing:
    label, score, shares = _named(members, laid)
    chosen = [laid[k] for k in members]
    size_m = fitted_size_m(chosen, label, usual_height_m(label))
    return Standing(
        tuple(members),
        _best(members, laid, label),
        label,
        score,
        shares,
        walk.position_m,
        walk.sigma_m,
        size_m,
        walk.possible_views,
        walk.velocity_m_s,
    )


def _median_sides(chosen: Sequence[LaidSighting]) -> Floats:
    return np.asarray(np.median([each.sighting.size_m for each in chosen], axis=0), np.float64)


def _best(members: Sequence[int], laid: Sequence[LaidSighting], label: str) -> int:
    """The clearest sighting: sure, large in its picture, and not cut by its edge."""

    def clearness(k: int) -> float:
        each = laid[k]
        left, top, right, bottom = each.sighting.box_px
        doubt = (1.0 if each.sighting.label == label else 0.5) * (0.3 if each.is_cut else 1.0)
        return doubt * each.sighting.score * float((right - left) * (bottom - top)) ** 0.25

    return max(members, key=clearness)
