"""Changes collected over views of a world whose things are known: each reported once, ghosts and noise not at all."""

from dataclasses import replace

import numpy as np
import pytest
from blob_world import (
    CAMERA_HEIGHT_M,
    HEIGHT,
    M_PER_PX,
    START_NS,
    WIDTH,
    Thing,
    flight,
    picture,
    site_from_image,
    view_of,
)
from hypothesis import given, settings
from hypothesis import strategies as st

import sorvolo.change.candidate as candidates
from sorvolo.change.announcing import Objection
from sorvolo.change.candidate import Candidate, KeptView
from sorvolo.change.earlier_pictures import EarlierPicture, EarlierPictures, with_known_pixels
from sorvolo.change.evidence import EvidenceMap, EvidenceSettings
from sorvolo.change.ground import CellWindow, LaidView
from sorvolo.change.outlines import Measures, area_sigma_m, thing_sigma_m
from sorvolo.change.reconcile import reported
from sorvolo.errors import SettingsError
from sorvolo.geometry.camera import Camera
from sorvolo.survey.findings import Change, ChangeKind

FOCAL_PX = CAMERA_HEIGHT_M / M_PER_PX
CAMERA = Camera(WIDTH, HEIGHT, FOCAL_PX, FOCAL_PX, (WIDTH - 1) / 2, (HEIGHT - 1) / 2)


def earlier_pictures(eyes, things):
    """The pictures of an earlier flight, taken from places (east, north)."""
    cameras_m = [(*each, CAMERA_HEIGHT_M) for each in eyes]
    shown = [each for each in things if each.on_map]
    return EarlierPictures(
        [EarlierPicture(CAMERA, site_from_image(each), None) for each in cameras_m],
        lambda index: with_known_pixels(picture(cameras_m[index], shown, 0.0)),
    )


def collect(views, **how) -> tuple[EvidenceMap, list[tuple[int, Change]]]:
    evidence = EvidenceMap(M_PER_PX, EvidenceSettings(**how), "f")
    return evidence, [(view.index, change) for view in views for change in evidence.add(view)]


def centre(change: Change) -> np.ndarray:
    return (change.outline_m.min(axis=0) + change.outline_m.max(axis=0)) / 2


def test_what_came_and_what_left_is_announced_once_with_its_place_size_and_time():
    came, left = (
        Thing(0, 0),
        Thing(3, 2, (1.4, 0.8), colour=(40, 40, 200), on_map=True, in_flight=False),
    )
    stays = Thing(-2, -2, on_map=True)
    evidence, reported = collect(flight([came, left, stays]))
    assert [each.id for _, each in reported] == ["f-1", "f-2"]
    final = evidence.conclude()
    assert [each.kind for each in final] == [ChangeKind.APPEARED, ChangeKind.DISAPPEARED]
    for change, thing in zip(final, (came, left)):
        assert np.hypot(*(centre(change) - [thing.east_m, thing.north_m])) < 0.15
        assert change.area_m2 == pytest.approx(thing.size_m[0] * thing.size_m[1], rel=0.2)
        assert change.length_m == pytest.approx(max(thing.size_m), abs=0.15)
        assert change.score > 0.8 and change.views > 15
        assert 0.02 < change.sigma_m < 0.15
        assert not change.velocity_m_s.any()
        assert change.patch.changed.any() and (change.patch.after[..., 3] == 255).all()
    assert evidence.conclude() is not None and len(evidence.conclude()) == 2  # again: the same


def test_it_is_announced_within_a_second_of_being_in_view_whatever_the_frame_rate():
    for fps in (5.0, 15.0):
        _, reported = collect(flight([Thing(2, 0)], fps=fps))
        ((index, change),) = reported
        whole_in_view_s = (
            2 + 0.5 + 8 - 8
        ) / 3  # the view reaches 8 m ahead of a drone that starts at -8 m
        assert index / fps < whole_in_view_s + 1.0
        assert change.announced_ns == START_NS + round(index / fps * 1e9)


def candidate(number: int, shown: int, missed: int) -> Candidate:
    """One cell that some views show and others do not."""
    cell = CellWindow(0, 0, 1, 1)
    result = Candidate(number, cell, START_NS)
    one, no = np.ones((1, 1), bool), np.zeros((1, 1), bool)
    for each in range(shown + missed):
        flagged = one if each < shown else no
        laid = LaidView(
            cell.grown(2),
            np.pad(flagged, 2),
            np.ones((5, 5), bool),
            np.full((5, 5), 230, np.uint8),
            np.zeros((5, 5), bool),
            np.zeros((5, 5), np.int32),
        )
        view = view_of(each, each, (each, 0.0, CAMERA_HEIGHT_M), [])
        assert result.see(KeptView(view, laid, True), one) == flagged.any()
    return result


def test_of_two_candidates_that_join_one_record_and_both_times_count():
    flickers, stands = candidate(1, 3, 12), candidate(2, 12, 0)
    before = stands.tally
    joined = stands.joined(flickers, 1)
    assert joined.number == 1 and (joined.tally.views, joined.tally.asked) == (12, 12)
    assert (
        joined.tally.score_sum == before.score_sum
        and joined.tally.last_seen_ns == before.last_seen_ns
    )


def test_the_patch_shows_both_dates_north_up():
    evidence, _ = collect(flight([Thing(0, 0, (1, 1), colour=(220, 30, 30))]))
    patch = evidence.conclude()[0].patch
    inside = patch.changed
    assert (
        np.median(patch.after[inside][:, 0]) > 200 and np.median(patch.before[inside][:, 0]) < 170
    )
    rows, columns = np.nonzero(inside)
    middle = patch.site_from_patch @ [columns.mean(), rows.mean(), 1]
    assert np.hypot(*middle[:2]) < 0.1
    assert patch.m_per_px == M_PER_PX and max(inside.shape) <= 512


def test_things_apart_stay_two_and_pieces_that_nearly_touch_are_one():
    evidence, _ = collect(flight([Thing(0, 0), Thing(2.0, 0)]))
    assert len(evidence.conclude()) == 2
    evidence, reported = collect(flight([Thing(0, 0), Thing(1.2, 0)]))
    assert len(reported) == 1
    (change,) = evidence.conclude()
    assert change.length_m == pytest.approx(2.2, abs=0.2)


def test_changes_that_grow_together_keep_the_older_id():
    left, right, bridge = Thing(0, 0), Thing(3, 0), Thing(1.5, 0, (2.2, 1.0))
    views = list(flight([left, right], seconds=2.8))
    last_m = float(views[-1].camera_m[0])
    more = [
        view_of(
            14 + i, 2.8 + i / 5, (last_m + 0.6 * (i + 1), 0, CAMERA_HEIGHT_M), [left, right, bridge]
        )
        for i in range(12)
    ]
    evidence, reported = collect(views + more)
    assert [each.id for _, each in reported] == ["f-1", "f-2"]
    assert [each.id for each in evidence.changes()] == ["f-1"]


@pytest.mark.parametrize(
    "first, last, count", [(2, 7, 22), (0, 6, 22), (14, 20, 26), (17, 22, 22), (15, 20, 22)]
)
def test_what_leans_over_a_thing_for_some_views_is_no_part_of_it(first, last, count):
    thing, lean = Thing(0, 0, (0.6, 0.6)), Thing(1.9, 0, (3.0, 2.4))
    views = [
        view_of(
            i,
            i / 5,
            (-6 + 0.6 * i, 0, CAMERA_HEIGHT_M),
            [thing, lean] if first <= i < last else [thing],
        )
        for i in range(count)
    ]
    evidence, _ = collect(views)
    (change,) = evidence.conclude()
    assert 0.9 * count <= change.views <= count
    assert change.score > 0.85
    assert change.length_m == pytest.approx(0.6, abs=0.1)
    assert np.abs(change.outline_m.mean(axis=0)).max() < 0.1


@pytest.mark.parametrize("score", [0.55, 0.95])
@pytest.mark.parametrize("colour", [(60, 60, 60), (200, 60, 60)])
def test_a_small_dark_thing_is_announced_as_a_bright_one_is(colour, score):
    """Specks of shade have no rule of their own."""
    views = [
        view_of(
            i,
            i / 5,
            (-6 + 0.6 * i, 0, CAMERA_HEIGHT_M),
            [Thing(0, 0, (0.4, 0.4), colour=colour)],
            score=score,
        )
        for i in range(20)
    ]
    assert len(collect(views)[0].conclude()) == 1


def test_noise_that_does_not_come_back_at_its_place_is_nothing():
    rng = np.random.default_rng(3)
    views = []
    for view in flight([]):
        things = [Thing(*rng.uniform([-12, -4], [8, 4]), (0.4, 0.4)) for _ in range(3)]
        views.append(view_of(view.index, view.index / 5, view.camera_m, things))
    evidence, reported = collect(views)
    assert reported == []
    assert [each for each in evidence.conclude() if each.kind != ChangeKind.MOVING] == []


def test_the_moving_ghost_of_something_tall_is_no_event():
    # stands on both dates: the map shows it from one side, each view from another; only its foot stays in place
    pole = Thing(0, 0, (0.3, 0.3), height_m=5, on_map=True)
    evidence, reported = collect(flight([pole], map_eye_m=(0.5, 0.3, CAMERA_HEIGHT_M)))
    # near its foot both its ends are seen, the map's and the flight's: one thing took the other's place
    assert [each.kind for _, each in reported] == [ChangeKind.REPLACED]
    assert all(np.abs(centre(each)).max() < 1.1 for _, each in reported)
    final = evidence.conclude()
    assert [each.kind for each in final] == [ChangeKind.REPLACED]
    assert all(np.abs(centre(each)).max() < 0.5 for each in final)


def test_a_drone_that_hovers_announces_a_ghost_only_with_half_the_score_and_withdraws_it_when_it_flies_on():
    pole = Thing(0, -1, (0.5, 0.5), height_m=4, on_map=True)
    hover = [view_of(i, i / 5, (-5, 0, CAMERA_HEIGHT_M), [pole]) for i in range(10)]
    evidence, reported = collect(hover)
    assert reported and all(each.score <= 0.5 for _, each in reported)
    ghosts = len(evidence.changes())
    for i in range(10, 40):
        camera_m = (-5 + 0.5 * (i - 10), 0, CAMERA_HEIGHT_M)
        evidence.add(
            view_of(i, i / 5, camera_m, [pole], map_eye_m=camera_m)
        )  # from here it looks as in the map
    assert ghosts > 0 and evidence.conclude() == ()


def test_a_view_given_twice_counts_once():
    views = list(flight([Thing(0, 0)], seconds=5))
    once, told_once = collect(views)
    twice, told_twice = collect([each for view in views for each in (view, view)])
    assert [each.id for _, each in told_once] == [each.id for _, each in told_twice]
    assert once.conclude()[0].views == twice.conclude()[0].views


def test_the_same_views_give_the_same_changes():
    first, _ = collect(flight([Thing(0, 0), Thing(3, 2)]))
    second, _ = collect(flight([Thing(0, 0), Thing(3, 2)]))
    for a, b in zip(first.conclude(), second.conclude()):
        assert a.id == b.id and a.score == b.score and np.array_equal(a.outline_m, b.outline_m)


def test_views_with_gaps_between_them_still_add_up():
    evidence, reported = collect(flight([Thing(0, 0)], fps=1.0))
    assert len(reported) == 1
    assert len(evidence.conclude()) == 1


def test_unknown_ground_shows_nothing():
    # the map has a hole over half of the thing, then over all of it
    half = (0.0, -2.0, 3.0, 2.0)
    evidence, _ = collect(flight([Thing(0, 0)], hole_m=half))
    (change,) = evidence.conclude()
    assert change.outline_m[:, 0].max() < 0.2
    evidence, _ = collect(flight([Thing(0, 0)], hole_m=(-2.0, -2.0, 3.0, 2.0)))
    assert evidence.conclude() == ()


def test_a_hole_does_not_wipe_out_what_was_seen():
    views = list(flight([Thing(0, 0)]))
    blind = [
        view_of(v.index, v.index / 5, v.camera_m, [Thing(0, 0)], hole_m=(-3, -3, 3, 3))
        for v in views
    ]
    mixed = [blind[i] if i % 2 else views[i] for i in range(len(views))]
    evidence, reported = collect(mixed)
    assert len(reported) == 1
    assert evidence.conclude()[0].score > 0.7


def test_snow_is_one_event_in_bounded_time_and_memory():
    evidence, reported = collect(flight([Thing(0, 0)], all_changed=True))
    assert len(reported) == 1
    (change,) = evidence.conclude()
    assert change.area_m2 > 150
    assert max(change.patch.changed.shape) <= 512


def test_photos_announce_what_most_of_the_few_that_saw_it_show():
    thing = Thing(0, 0)
    photos = [view_of(i, 2.0 * i, (-3 + 6 * i, 0, CAMERA_HEIGHT_M), [thing]) for i in range(2)]
    evidence, reported = collect(photos)
    assert reported == []
    (change,) = evidence.conclude()
    assert change.views == 2 and change.announced_ns == -1
    assert change.kind == ChangeKind.APPEARED


def test_photos_announce_a_standing_thing_with_the_third_that_shows_it_and_are_as_sure_as_views_of_a_video():
    thing = Thing(0, 0)
    photos = [view_of(i, 1.4 * i, (-4 + 4 * i, 0, CAMERA_HEIGHT_M), [thing]) for i in range(3)]
    _, reported = collect(photos)
    assert [index for index, _ in reported] == [2]
    two = collect(photos[:2])[0].conclude()
    assert len(two) == 1 and two[0].score > 0.6


def test_two_photos_announce_all_of_many_things():
    things = [Thing(east, north, (0.6, 0.6)) for east in (-4, -2, 0, 2, 4) for north in (-2, 0, 2)]
    photos = [view_of(i, 1.4 * i, (-1 + 2 * i, 0, CAMERA_HEIGHT_M), things) for i in range(2)]
    assert len(collect(photos)[0].conclude()) == len(things)


def test_photos_of_the_same_second_taken_elsewhere_count():
    photos = [view_of(i, 0.0, (-3 + 3 * i, 0, CAMERA_HEIGHT_M), [Thing(0, 0)]) for i in range(3)]
    assert collect(photos)[0].conclude()[0].views == 3


def single(thing: Thing, score: float = 0.95) -> EvidenceMap:
    """The evidence of one view alone."""
    return collect([view_of(0, 0, (0, 0, CAMERA_HEIGHT_M), [thing], score=score)])[0]


def test_what_one_view_alone_shows_must_be_very_sure_and_confirmed_by_other_evidence():
    asked = []

    def confirms(outline_m):
        asked.append(outline_m)
        return True

    (change,) = single(Thing(0, 0)).conclude(confirms)
    assert change.views == 1 and change.score < 0.67  # two views that agree have 0.7
    assert np.hypot(*((asked[0].min(axis=0) + asked[0].max(axis=0)) / 2)) < 0.15
    assert single(Thing(0, 0), score=0.7).conclude(confirms) == ()
    assert single(Thing(0, 0)).conclude(lambda _: False) == ()
    assert (
        single(Thing(0, 0)).conclude() == ()
    )  # where nothing else was measured, one view announces nothing


def test_what_one_view_alone_shows_at_its_rim_is_not_announced():
    half_m = (view_of(0, 0, (0, 0, CAMERA_HEIGHT_M), []).changed.shape[1] / 2) * M_PER_PX
    assert single(Thing(half_m, 0)).conclude(lambda _: True) == ()


def test_low_scores_are_kept_but_not_announced():
    evidence, reported = collect(flight([Thing(0, 0)], score=0.1))
    assert reported == [] and evidence.conclude() == ()


@pytest.mark.parametrize(
    ("side_m", "score", "is_announced"), [(2.0, 0.45, False), (2.0, 0.7, True), (1.0, 0.45, True)]
)
def test_what_is_large_must_be_surer_than_what_is_small(side_m, score, is_announced):
    """Walls that lean into view are large and unsure."""
    evidence, _ = collect(flight([Thing(0, 0, (side_m, side_m))], score=score))
    assert len(evidence.conclude()) == is_announced


def test_what_became_of_the_candidates_is_counted():
    stays, goes = Thing(-3, 1), Thing(-4, -1)
    views = [
        view_of(i, i / 5, (-6 + 0.2 * i, 0, CAMERA_HEIGHT_M), [stays, goes] if i < 6 else [stays])
        for i in range(30)
    ]
    evidence, announced = collect(views)
    assert len(announced) == 2 and len(evidence.conclude()) == 1
    assert evidence.outcomes() == {
        "announced": {"still": 1, "moving": 0},
        "withdrawn": {Objection.UNSURE.value: 1},
        "never_announced": {},
    }


def test_something_seen_for_a_while_only_is_withdrawn():
    thing = Thing(-4, 0)
    views = [
        view_of(i, i / 5, (-6 + 0.2 * i, 0, CAMERA_HEIGHT_M), [thing] if i < 6 else [])
        for i in range(30)
    ]
    evidence, reported = collect(views)
    assert len(reported) == 1
    assert evidence.conclude() == ()


@settings(max_examples=4, deadline=None)
@given(st.integers(0, 10_000))
def test_every_well_seen_thing_is_found_once_and_nothing_else(seed):
    rng = np.random.default_rng(seed)
    spots = [np.array([x, y]) for x in (-4, 0, 4) for y in (-2.5, 2.5)]
    things = [
        Thing(
            *(spot + rng.uniform(-0.5, 0.5, 2)),
            tuple(rng.uniform(0.6, 1.8, 2)),
            colour=(230, 60, 40),
            on_map=bool(flip),
            in_flight=not flip,
        )
        for spot, flip in zip(spots, rng.integers(0, 2, 6))
        if rng.random() < 0.7
    ]
    evidence, reported = collect(flight(things, seconds=6))
    final = evidence.conclude()
    assert len(final) == len(things) == len({each.id for _, each in reported})
    for thing in things:
        distances = [
            float(np.hypot(*(centre(each) - [thing.east_m, thing.north_m]))) for each in final
        ]
        assert min(distances) < 0.3
        kind = final[int(np.argmin(distances))].kind
        assert kind == (ChangeKind.APPEARED if thing.in_flight else ChangeKind.DISAPPEARED)


@pytest.mark.parametrize("wrong", [{"k": 6}, {"k": 0}, {"n": 9}])
def test_settings_that_contradict_themselves_are_refused(wrong):
    with pytest.raises(SettingsError):
        EvidenceSettings(**wrong)


def test_a_view_without_any_known_ground_is_harmless():
    view = view_of(0, 0, (0, 0, CAMERA_HEIGHT_M), [])
    blind = replace(view, valid=np.zeros_like(view.valid), changed=np.zeros_like(view.changed))
    evidence, reported = collect([blind])
    assert reported == [] and evidence.conclude() == ()


def seldom(thing: Thing, others: int) -> list:
    """Two photos of a thing, then one of each of so many others."""
    places = [(0.0, 0.0), (4.0, 0.0), *((100.0 + 40 * number, 0.0) for number in range(others))]
    return [
        view_of(
            number, 2 * number, (*place, CAMERA_HEIGHT_M), [thing if number < 2 else Thing(*place)]
        )
        for number, place in enumerate(places)
    ]


def test_a_thing_that_two_early_photos_show_is_not_forgotten_for_many_uncertain_ones_after_it(
    monkeypatch,
):
    views = seldom(Thing(2, 0), 6)
    monkeypatch.setattr(candidates, "_MOST_SEEDS", 3)
    for most_px, ids in ((8_000_000, ["f-1"]), (0, [])):
        monkeypatch.setattr(candidates, "_MOST_SEEDS_PX", most_px)
        evidence, reported = collect(views)
        assert not reported and [each.id for each in evidence.conclude()] == ids


def test_sigma_knows_that_a_thing_seen_from_aside_leans():
    above, aside = Thing(0, 0), Thing(0, 3.4)
    first, second = (collect(flight([each]))[0].conclude()[0] for each in (above, aside))
    assert 0.04 < first.sigma_m < 0.08 < second.sigma_m < 0.3


def test_sigma_knows_that_a_thin_outline_holds_a_part_of_a_shadow():
    car, with_shadow = Measures(8.0, 4.5, (0.0, 0.0)), Measures(0.66, 1.9, (0.0, 0.0))
    assert thing_sigma_m(car) < 0.03 and 0.3 < thing_sigma_m(with_shadow) < 0.6
    assert area_sigma_m(Measures(1000.0, 200.0, (0.0, 0.0))) == pytest.approx(6.0)


def test_what_an_outline_errs_by_is_that_of_the_one_that_is_reported():
    """Not of a whole that it was parted from, nor of the one with its shadow."""
    for size_m, least_m, most_m in (((1.0, 1.0), 0.0, 0.02), ((0.3, 1.9), 0.3, 0.6)):
        (found,) = collect(flight([Thing(0, 0, size_m)]))[0].conclude()
        (change,) = reported([found], 0.5, [])
        assert found.sigma_m < 0.1 and change.sigma_m == pytest.approx(
            np.hypot(change.sigma_in_map_m, 0.5)
        )
        assert least_m <= np.sqrt(change.sigma_in_map_m**2 - found.sigma_m**2) < most_m
