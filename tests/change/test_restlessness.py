"""Ground on which differences come and go makes what is found in it less sure; calm ground does not."""

from dataclasses import replace

import numpy as np
from blob_world import CAMERA_HEIGHT_M, M_PER_PX, Thing, view_of

from sorvolo.change.announcing import Tally, sureness
from sorvolo.change.evidence import EvidenceMap, EvidenceSettings, restlessness
from sorvolo.change.ground import CellWindow, EvidenceGrid, LaidView

CELL_M = 0.1
GROUND = CellWindow(-100, -100, 100, 100)
THING = CellWindow(-5, -5, 5, 5)


def laid(flagged: np.ndarray, seen: np.ndarray | None = None) -> LaidView:
    seen = np.ones(GROUND.shape, bool) if seen is None else seen
    score, legs = np.full(GROUND.shape, 255, np.uint8), np.zeros(GROUND.shape, np.int32)
    nothing = np.zeros(GROUND.shape, bool)
    return LaidView(GROUND, flagged & seen, seen, score, nothing, legs)


def grid_after(views: list[LaidView]) -> EvidenceGrid:
    grid = EvidenceGrid(5)
    for each in views:
        grid.record(each, True)
    return grid


def thing_alone() -> np.ndarray:
    flagged = np.zeros(GROUND.shape, bool)
    flagged[THING.within(GROUND)] = True
    return flagged


def measured(views: list[LaidView]) -> float:
    return restlessness(grid_after(views), THING, np.ones(THING.shape, bool), CELL_M)


def test_it_is_the_share_of_views_that_flag_what_most_others_do_not():
    rng = np.random.default_rng(5)
    for share in (0.0, 0.05, 0.15):
        views = [laid(thing_alone() | (rng.random(GROUND.shape) < share)) for _ in range(12)]
        assert abs(measured(views) - share) < 0.02


def test_neighbours_that_changed_themselves_and_the_own_rim_are_calm():
    neighbour = thing_alone()
    neighbour[GROUND.shape[0] // 2 + 20 : GROUND.shape[0] // 2 + 40, 90:110] = True
    rims = [np.roll(thing_alone(), (shift, -shift), axis=(0, 1)) for shift in (-3, 0, 3)]
    assert measured([laid(neighbour) for _ in range(6)]) == 0
    assert measured([laid(each) for each in rims * 2]) == 0


def test_where_nothing_else_was_seen_twice_nothing_is_known():
    seen = thing_alone()
    assert measured([laid(thing_alone(), seen) for _ in range(3)]) == 0
    assert measured([laid(np.random.default_rng(1).random(GROUND.shape) < 0.5)]) == 0


def test_calm_ground_leaves_a_score_as_it_is_and_restless_ground_hardly_anything():
    def score(restless: float) -> float:
        far_apart = {"camera_low_m": (0, 0, 10), "camera_high_m": (20, 0, 10)}
        tally = Tally(0, 0, views=4, asked=8, score_sum=2.8, whole=4, **far_apart)
        return sureness(replace(tally, restless=restless))

    assert score(0.01) > 0.9 * score(0.0)
    assert score(0.15) < 0.2 * score(0.0)


def photos_among(ghosts: int, photos: int = 3, **how: object) -> EvidenceMap:
    """Photos of a thing that came, each with so many other small differences, elsewhere in each."""
    rng = np.random.default_rng(2)
    evidence = EvidenceMap(M_PER_PX, EvidenceSettings(), "f")
    for i in range(photos):
        places = rng.uniform([-7, -4], [7, 4], (2 * ghosts, 2))
        places = places[np.hypot(*places.T) > 1.5][:ghosts]
        around = [Thing(*place, (0.4, 0.4), colour=(40, 40, 200)) for place in places]
        evidence.add(
            view_of(i, 1.4 * i, (-1 + i, 0, CAMERA_HEIGHT_M), [Thing(0, 0), *around], **how)
        )
    return evidence


def test_three_photos_that_agree_announce_on_calm_ground_and_not_where_much_else_differs_in_each():
    calm, restless = (photos_among(ghosts).conclude() for ghosts in (0, 130))
    assert len(calm) == 1 and calm[0].score > 0.4
    assert [each for each in restless if np.hypot(*each.outline_m.mean(axis=0)) < 0.5] == []


def test_what_all_of_many_views_show_surely_is_announced_on_restless_ground():
    announced = photos_among(130, photos=10, score=0.99).conclude()
    assert any(np.hypot(*each.outline_m.mean(axis=0)) < 0.5 for each in announced)
