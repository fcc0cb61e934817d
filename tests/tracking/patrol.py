"""Patrols over objects of known places: their sightings with the errors that real ones have, without any picture."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from sorvolo.survey.objects import CLASSES, TYPICAL_SIZE_M, Sighting

HEIGHT_M, FOCAL_PX, WIDTH_PX, DEPTH_PX = 60.0, 1066.0, 1280, 720


@dataclass(frozen=True)
class Patrol:
    """What is flown over what. Shares are of all objects; `kind` is "lawnmower" or "there and back"."""

    seed: int = 0
    kind: str = "lawnmower"
    per_ha: float = 10.0
    size_m: tuple[float, float] = (220.0, 140.0)
    speed_m_s: float = 10.0
    fps: float = 5.0
    overlap: float = 0.3
    gps_m: float = 1.5
    gps_s: float = 60.0
    jitter_m: float = 0.2  # per frame, of the whole frame: gimbal and fixes
    heading_deg: float = 0.0  # by which the compass is wrong
    own_m: float = 0.25
    misses: float = 0.2
    false_alarms: float = 0.2  # per frame
    wrong_class: float = 0.04
    neighbours: float = 0.15  # of the objects have another one 1.5 m beside them


@dataclass(frozen=True)
class Things:
    """The true objects: (N, 2) place at second 0, (N, 2) velocity, class by index."""

    start_m: np.ndarray
    velocity_m_s: np.ndarray
    labels: np.ndarray

    def at(self, time_s: float) -> np.ndarray:
        return self.start_m + self.velocity_m_s * time_s


@dataclass(frozen=True)
class SeenFrame:
    """One frame's sightings, whose they are (-1: of nothing), and the ground it shows."""

    time_s: float
    sightings: list[Sighting]
    owners: np.ndarray
    inside: np.ndarray
    footprint_m: np.ndarray


def waypoints(patrol: Patrol) -> np.ndarray:
    east_m, north_m = patrol.size_m
    wide_m = WIDTH_PX / FOCAL_PX * HEIGHT_M
    if patrol.kind == "there and back":
        return np.array([[0.0, north_m / 2], [east_m, north_m / 2], [0.0, north_m / 2]])
    step_m = wide_m * (1 - patrol.overlap)
    rows = np.arange(max(1, int(np.ceil((north_m - wide_m) / step_m)) + 1)) * step_m + wide_m / 2
    ends = [
        [(0.0, row), (east_m, row)][:: 1 if number % 2 == 0 else -1]
        for number, row in enumerate(rows)
    ]
    return np.array([point for pair in ends for point in pair])


def things(patrol: Patrol) -> Things:
    random = np.random.default_rng([patrol.seed, 1])
    count = max(1, round(patrol.per_ha * patrol.size_m[0] * patrol.size_m[1] / 1e4))
    places = random.uniform(0, 1, (count, 2)) * patrol.size_m
    labels = random.choice(3, count, p=[0.6, 0.25, 0.15])
    velocity = np.zeros((count, 2))
    angles = random.uniform(0, 2 * np.pi, count)
    heading = np.column_stack([np.cos(angles), np.sin(angles)])
    draw = random.random(count)
    velocity[(labels == 0) & (draw < 0.3)] = 1.4 * heading[(labels == 0) & (draw < 0.3)]
    velocity[(labels == 1) & (draw < 0.2)] = 8.0 * heading[(labels == 1) & (draw < 0.2)]
    beside = np.flatnonzero(random.random(count) < patrol.neighbours)
    for index in beside[labels[beside] == 0]:
        other = (index + 1) % count
        if labels[other] == 0 and other not in beside:
            places[other] = places[index] + 1.5 * heading[index][::-1]
            velocity[other] = velocity[index]
    # movers cross their start somewhere within the flight
    flown_s = np.linalg.norm(np.diff(waypoints(patrol), axis=0), axis=1).sum() / patrol.speed_m_s
    places -= velocity * (random.uniform(0, 1, count) * flown_s)[:, None] * (draw < 0.3)[:, None]
    return Things(places, velocity, labels)


def fly(patrol: Patrol, objects: Things) -> Iterator[SeenFrame]:
    random = np.random.default_rng([patrol.seed, 2])
    points = waypoints(patrol)
    legs = np.linalg.norm(np.diff(points, axis=0), axis=1)
    ends_s = np.concatenate([[0], np.cumsum(legs)]) / patrol.speed_m_s
    times = np.arange(0, ends_s[-1], 1 / patrol.fps)
    keeps = np.exp(-1 / patrol.fps / patrol.gps_s)
    drift = random.normal(0, patrol.gps_m, 2)
    half_m = np.array([DEPTH_PX, WIDTH_PX]) / FOCAL_PX * HEIGHT_M / 2  # along, across
    for number, time_s in enumerate(times):
        leg = min(int(np.searchsorted(ends_s, time_s, side="right")) - 1, len(legs) - 1)
        ahead = (points[leg + 1] - points[leg]) / max(legs[leg], 1e-9)
        drone = points[leg] + ahead * (time_s - ends_s[leg]) * patrol.speed_m_s
        axes = np.array([ahead, [ahead[1], -ahead[0]]])  # along, right
        drift = keeps * drift + np.sqrt(1 - keeps**2) * random.normal(0, patrol.gps_m, 2)
        shift = drift + random.normal(0, patrol.jitter_m, 2)
        where = objects.at(time_s)
        local = (where - drone) @ axes.T
        inside = (np.abs(local) < half_m).all(axis=1)
        seen = np.flatnonzero(inside & (random.random(len(where)) > patrol.misses))
        false = random.uniform(-half_m, half_m, (random.poisson(patrol.false_alarms), 2))
        owners = np.concatenate([seen, np.full(len(false), -1)])
        kinds = np.concatenate([objects.labels[seen], random.integers(0, 3, len(false))])
        confused = random.random(len(kinds)) < patrol.wrong_class
        labels = np.where(confused, random.integers(0, 3, len(kinds)), kinds)
        scores = np.concatenate(
            [random.beta(6, 2.5, len(seen)), random.uniform(0.25, 0.7, len(false))]
        )
        at = np.concatenate([local[seen], false]) + random.normal(0, patrol.own_m, (len(owners), 2))
        turn = np.radians(patrol.heading_deg)
        turned = at @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
        places = drone + shift + turned @ axes
        footprint = drone + shift + np.array([[1, -1], [1, 1], [-1, 1], [-1, -1]]) * half_m @ axes
        sightings = [
            _sighting(
                patrol,
                number,
                time_s,
                place,
                spot,
                CLASSES[label],
                TYPICAL_SIZE_M[CLASSES[kind]],
                score,
                random,
            )
            for place, spot, label, kind, score in zip(places, at, labels, kinds, scores)
        ]
        order = np.argsort([-each.score for each in sightings]) if sightings else np.zeros(0, int)
        yield SeenFrame(time_s, [sightings[row] for row in order], owners[order], inside, footprint)


def _sighting(patrol, number, time_s, place, spot, name, sides_m, score, random) -> Sighting:
    size_m = np.sort(np.array(sides_m[:2]) * np.exp(random.normal(0, 0.15, 2)))[::-1]
    middle_px = np.array([spot[1], -spot[0]]) / HEIGHT_M * FOCAL_PX + [WIDTH_PX / 2, DEPTH_PX / 2]
    half_px = size_m / HEIGHT_M * FOCAL_PX / 2
    turned = np.radians(patrol.heading_deg) * np.linalg.norm(spot)
    shared2 = patrol.gps_m**2 + patrol.jitter_m**2 + turned**2 / 2
    box_px = np.concatenate([middle_px - half_px, middle_px + half_px])
    return Sighting(
        number,
        str(number),
        int(time_s * 1e9),
        name,
        float(score),
        box_px,
        place,
        np.eye(2) * (patrol.own_m**2 + shared2),
        size_m,
        float(np.sqrt(shared2)),
    )
