"""Objects counted once, on simulated patrols and on cases made by hand."""

from dataclasses import replace

import numpy as np
import pytest
from patrol import Patrol, fly, things

from sorvolo.errors import GeometryError, SettingsError
from sorvolo.survey.objects import Sighting
from sorvolo.tracking.tracker import Tracker, TrackerSettings

ASIDE_M = np.array([500.0, 0.0])
AROUND_M = np.array([[-40.0, -40.0], [40.0, -40.0], [40.0, 40.0], [-40.0, 40.0]])


def sighting(frame, place_m, label="person", score=0.8, own_m=0.2, shared_m=1.5):
    place_m = np.asarray(place_m, float)
    middle = place_m * 16 + 640
    return Sighting(
        frame,
        str(frame),
        int(frame * 2e8),
        label,
        score,
        np.concatenate([middle - 5, middle + 5]),
        place_m,
        np.eye(2) * (own_m**2 + shared_m**2),
        np.array([0.6, 0.5]),
        shared_m,
    )


def follow(tracker, frames, **more):
    """Frames five a second, each a list of places."""
    updates = []
    for frame, places in enumerate(frames):
        seen = [sighting(frame, place) for place in places]
        updates.append(tracker.update(seen, time_ns=int(frame * 2e8), footprint_m=AROUND_M, **more))
    return updates


def test_what_stands_is_one_track_at_its_mean():
    random = np.random.default_rng(1)
    tracker = Tracker()
    places = np.array([3.0, 4.0]) + random.normal(0, 0.2, (20, 2))
    updates = follow(tracker, [[each] for each in places])
    (track,) = tracker.finish()
    assert {update.track_ids for update in updates} == {(track.id,)}
    assert [update.new for update in updates if update.new] == [(track.id,)]
    assert not track.moving and track.views == 20 and track.passes == 1
    assert track.position_m == pytest.approx(places.mean(axis=0), abs=0.06)
    # twenty views within four seconds share their GPS error: its 1.5 m stay
    assert 1.4 < track.sigma_m < 1.55


def test_the_picture_of_a_track_is_its_largest_of_like_score_and_its_surest_of_like_size():
    tracker, middle = Tracker(), np.array([640.0, 640.0])
    for frame, (half_px, score) in enumerate([(5, 0.8), (20, 0.8), (10, 0.8), (20, 0.7)]):
        seen = sighting(frame, [0.0, 0.0], score=score)
        box_px = np.concatenate([middle - half_px, middle + half_px])
        tracker.update([replace(seen, box_px=box_px)], time_ns=seen.time_ns, footprint_m=AROUND_M)
    (track,) = tracker.finish()
    assert track.best.frame_index == 1


def test_the_shared_error_is_averaged_only_as_fast_as_it_forgets_itself():
    tracker = Tracker()
    for frame in range(5):
        seen = [sighting(300 * frame, [0.0, 0.0])]
        tracker.update(seen, time_ns=seen[0].time_ns, footprint_m=AROUND_M)
    (track,) = tracker.finish()  # five views, a minute apart
    plain_mean_m = 1.5 * np.sqrt(sum(np.exp(-abs(i - j)) for i in range(5) for j in range(5)) / 25)
    assert (
        0.95 * plain_mean_m < track.sigma_m < 1.3
    )  # more than a plain mean's: it may have stirred in between


def test_a_walker_moves_and_keeps_its_id():
    tracker = Tracker()
    follow(tracker, [[[0.28 * frame, 5.0], [-10.0, 3.0], [8.0, -20.0]] for frame in range(30)])
    tracks = sorted(tracker.finish(), key=lambda track: -np.linalg.norm(track.velocity_m_s))
    assert [track.moving for track in tracks] == [True, False, False]
    assert tracks[0].velocity_m_s == pytest.approx([1.4, 0.0], abs=0.1)
    assert tracks[0].path_m[-1][0] - tracks[0].path_m[0][0] > 7.0


def test_a_frame_that_lies_aside_takes_no_object_for_its_neighbour():
    """GPS jumps by the distance of two people: the pattern shows who is who."""
    row = np.array([[0.0, 0.0], [2.0, 0.0], [4.0, 0.0], [6.0, 0.0], [0.0, 9.0], [7.0, -8.0]])
    tracker, aside_m = Tracker(), np.array([1.9, 0.3])
    updates = follow(tracker, [row] * 8 + [row + aside_m] * 8)
    assert updates[-1].track_ids == updates[7].track_ids
    assert len(tracker.finish()) == 6


def test_two_neighbours_stay_two_when_a_frame_sees_both():
    random = np.random.default_rng(2)
    both = np.array([[0.0, 0.0], [1.5, 0.0]])
    frames = [both[random.random(2) > 0.3] + random.normal(0, 0.2, 2) for _ in range(60)]
    tracker = Tracker()
    follow(tracker, frames)
    assert len(tracker.finish()) == 2


def test_tracks_that_never_stand_together_become_one():
    tracker = Tracker()
    tracker.update([sighting(0, [0.0, 0.0])], time_ns=0, footprint_m=AROUND_M)
    tracker.update([sighting(1, [0.0, 0.0])], time_ns=int(2e8), footprint_m=AROUND_M)
    merged = {}
    for frame in range(
        2, 30
    ):  # the box slips to another place of the same object, too far for the gate
        seen = [sighting(frame, [2.8, 0.0], shared_m=0.1)]
        merged |= tracker.update(seen, time_ns=seen[0].time_ns, footprint_m=AROUND_M).merged
    (track,) = tracker.finish()
    assert track.id == 1
    assert set(merged.values()) <= {1}


def car(frame, place_m, own_m=0.2):
    return replace(
        sighting(frame, place_m, "car", own_m=own_m, shared_m=0.3),
        size_m=np.array([4.4, 1.9]),
    )


@pytest.mark.parametrize(("apart_m", "count"), [(1.6, 1), (2.6, 2)])
def test_two_cars_have_no_room_on_one_place(apart_m, count):
    """A second track beside a car, seen in turns with it three times, is that car; beside a parking bay it is not."""
    tracker = Tracker()
    for frame in range(10):
        tracker.update([car(frame, [0.0, 0.0])], time_ns=int(frame * 2e8), footprint_m=AROUND_M)
    for frame in range(10, 13):
        tracker.update([car(frame, [0.0, apart_m])], time_ns=int(frame * 2e8), footprint_m=AROUND_M)
    assert len(tracker.finish()) == count


def test_a_glimpse_at_the_edge_is_the_car_that_then_drives_on():
    """Three sightings that hardly show where it is, a second without it, and then it moves from there."""
    tracker = Tracker()
    for frame in [0, 1, 2, *range(8, 20)]:
        seen = [
            car(frame, [0.8 * frame if frame > 2 else 0.0, 0.0], own_m=1.5 if frame < 3 else 0.3)
        ]
        tracker.update(seen, time_ns=seen[0].time_ns, footprint_m=AROUND_M)
    (track,) = tracker.finish()
    assert track.moving and track.velocity_m_s == pytest.approx([4.0, 0.0], abs=0.5)
    assert track.first_seen_ns == 0


def test_two_boxes_of_one_object_are_one_and_the_scores_choose_its_class():
    tracker = Tracker()
    for frame in range(6):
        seen = [
            sighting(frame, [1.0, 1.0], "person", 0.8),
            sighting(frame, [1.01, 1.0], "small object", 0.5),
        ]
        update = tracker.update(seen, time_ns=seen[0].time_ns, footprint_m=AROUND_M)
        assert len(set(update.track_ids)) == 1
    (track,) = tracker.finish()
    assert track.label == "person" and track.views == 6
    assert track.class_scores == pytest.approx({"person": 0.8 / 1.3, "small object": 0.5 / 1.3})


def test_a_box_within_or_around_one_of_its_class_is_no_second_object():
    bag, loose = (
        [100.0, 100.0, 140.0, 145.0],
        [95.0, 95.0, 150.0, 170.0],
    )  # they overlap by less than half
    for boxes, labels, count in (
        ((bag, loose), ("small object", "small object"), 1),
        ((loose, bag), ("small object", "small object"), 1),
        ((loose, bag), ("car", "person"), 2),
        ((loose, [96.0, 97.0, 140.0, 163.0]), ("person", "small object"), 1),
        ((bag, [135.0, 100.0, 175.0, 145.0]), ("person", "person"), 2),
    ):
        tracker = Tracker()
        for frame in range(8):
            seen = [
                replace(
                    sighting(frame, [0.5 * row, 0.0], label, 0.9 - 0.1 * row), box_px=np.array(box)
                )
                for row, (box, label) in enumerate(zip(boxes, labels))
            ]
            tracker.update(seen, time_ns=seen[0].time_ns, footprint_m=AROUND_M)
        assert len(tracker.finish()) == count, (boxes, labels)


def test_what_is_taken_now_for_this_and_now_for_that_is_one():
    tracker = Tracker()
    for frame in range(24):
        label = "person" if frame % 3 else "small object"
        seen = [
            sighting(
                frame,
                [0.1 if frame % 3 else 0.0, 0.0],
                label,
                0.9 if frame % 3 else 0.6,
                own_m=0.05,
            )
        ]
        tracker.update(seen, time_ns=seen[0].time_ns, footprint_m=AROUND_M)
    (track,) = tracker.finish()
    assert track.label == "person"


@pytest.mark.parametrize("which", [0, 1])
def test_size_shows_which_of_two_neighbours_a_sighting_is(which):
    """A bicycle and a lorry 2 m apart; then one of them alone is seen halfway between their places."""
    sizes_m = np.array([[1.8, 0.6], [9.0, 2.5]])
    places_m = np.array([[0.0, 0.0], [2.0, 0.0]])
    tracker = Tracker()
    for frame in range(10):
        seen = [
            replace(sighting(frame, place), size_m=size) for place, size in zip(places_m, sizes_m)
        ]
        update = tracker.update(seen, time_ns=int(frame * 2e8), footprint_m=AROUND_M)
    between = replace(sighting(10, [1.0, 0.0]), size_m=sizes_m[which])
    last = tracker.update([between], time_ns=int(2e9), footprint_m=AROUND_M)
    assert last.track_ids == (update.track_ids[which],)


def test_what_is_not_seen_where_it_should_be_ends_and_what_is_out_of_view_does_not():
    tracker = Tracker()
    follow(tracker, [[[0.0, 0.0]]] * 5)
    elsewhere = AROUND_M + ASIDE_M
    for frame in range(5, 60):
        assert not tracker.update([], time_ns=int(frame * 2e8), footprint_m=elsewhere).ended
    ended = [
        tracker.update([], time_ns=int(frame * 2e8), footprint_m=AROUND_M).ended
        for frame in range(60, 90)
    ]
    assert [each for each in ended if each] == [(1,)]
    assert len(tracker.finish()) == 1  # it was there


def test_a_glimpse_is_no_object():
    tracker = Tracker()
    follow(tracker, [[[0.0, 0.0]]] + [[]] * 10)
    assert tracker.tracks() == [] and tracker.finish() == []


ALONE = TrackerSettings(alone={"person": 0.7})
"""For photos, where one that alone shows a place is enough."""


@pytest.mark.parametrize(
    ("score", "then_m", "is_reported"),
    [
        (0.8, ASIDE_M, True),
        (0.6, ASIDE_M, False),  # the next photo shows other ground
        (0.8, np.zeros(2), False),  # it shows the place, and nothing there
    ],
)
def test_what_one_photo_alone_shows_is_reported_when_it_goes_out_of_view(
    score, then_m, is_reported
):
    tracker = Tracker(ALONE)
    assert not tracker.update(
        [sighting(0, [3.0, 4.0], score=score)], time_ns=0, footprint_m=AROUND_M
    ).new
    update = tracker.update([], time_ns=int(5e9), footprint_m=AROUND_M + then_m)
    assert len(update.new) == len(tracker.finish()) == is_reported


def test_what_the_last_photo_alone_shows_is_reported_at_the_end():
    tracker = Tracker(ALONE)
    tracker.update([], time_ns=0, footprint_m=AROUND_M + ASIDE_M)
    tracker.update([sighting(1, [3.0, 4.0])], time_ns=int(2e8), footprint_m=AROUND_M)
    (track,) = tracker.finish()
    assert track.confirmed and track.views == 1


def test_low_scores_prolong_and_do_not_begin():
    tracker = Tracker()
    weak = sighting(0, [0.0, 0.0], score=0.2)
    assert tracker.update([weak], time_ns=0, footprint_m=AROUND_M).track_ids == (0,)
    tracker.update([sighting(1, [0.0, 0.0])], time_ns=int(2e8), footprint_m=AROUND_M)
    assert tracker.update([sighting(2, [0.0, 0.0], score=0.2)], time_ns=int(4e8)).track_ids == (1,)


def test_appearance_shows_who_came_back():
    looks = np.eye(4)
    tracker = Tracker()
    for frame in range(6):
        seen = [sighting(frame, [0.0, 0.0]), sighting(frame, [3.0, 0.0])]
        tracker.update(seen, time_ns=seen[0].time_ns, footprint_m=AROUND_M, appearance=looks[:2])
    tracker.update([], time_ns=int(20e9), footprint_m=AROUND_M + ASIDE_M)
    back = [sighting(600, [1.5, 0.0])]  # GPS has wandered: half way between both
    assert tracker.update(
        back, time_ns=int(120e9), footprint_m=AROUND_M, appearance=looks[1:2]
    ).track_ids == (2,)


@pytest.mark.parametrize("kind", ["lawnmower", "there and back"])
def test_patrols_count_each_object_once(kind):
    """What is in view for a second or more counts; places of what stands are inside their own 95 % ellipse."""
    patrol = Patrol(seed=301, kind=kind, per_ha=8.0, size_m=(160.0, 120.0))
    objects, tracker = things(patrol), Tracker()
    in_view, owners = np.zeros(len(objects.labels), int), {}
    for frame in fly(patrol, objects):
        update = tracker.update(
            frame.sightings, time_ns=int(frame.time_s * 1e9), footprint_m=frame.footprint_m
        )
        owners |= {
            number: owner for number, owner in zip(update.track_ids, frame.owners) if owner >= 0
        }
        in_view += frame.inside
    tracks, there = tracker.finish(), int((in_view >= 5).sum())
    assert there >= 10
    assert abs(len(tracks) - there) <= 1
    standing = [track for track in tracks if not objects.velocity_m_s[owners[track.id]].any()]
    assert sum(track.moving for track in standing) <= 1
    errors_m = np.array(
        [track.position_m - objects.start_m[owners[track.id]] for track in standing]
    )
    sigmas = [
        error @ np.linalg.solve(track.covariance_m2, error)
        for error, track in zip(errors_m, standing)
    ]
    assert np.sqrt(np.mean(errors_m**2)) < 2.0
    assert np.mean(np.array(sigmas) < 5.991) >= 0.9


def test_the_same_frames_give_the_same_tracks():
    def ids():
        patrol = Patrol(seed=9, size_m=(80.0, 80.0))
        tracker = Tracker()
        return [
            tracker.update(
                frame.sightings, time_ns=int(frame.time_s * 1e9), footprint_m=frame.footprint_m
            )
            for frame in fly(patrol, things(patrol))
        ]

    assert ids() == ids()


def test_ids_go_on_where_an_earlier_tracker_ended():
    tracker = Tracker(first_id=7)
    follow(tracker, [[[0.0, 0.0], [9.0, 0.0]]] * 5)
    assert sorted(track.id for track in tracker.finish()) == [7, 8] and tracker.next_id == 9


def test_settings_and_columns_that_do_not_fit_are_refused():
    with pytest.raises(SettingsError):
        TrackerSettings(least_views=0)
    with pytest.raises(GeometryError, match="appearance"):
        Tracker().update([sighting(0, [0, 0])], time_ns=0, appearance=np.zeros((2, 3)))


def test_a_car_that_drove_out_of_the_picture_is_looked_for_where_it_went():
    """By clocks that count from 1970, as telemetry's do."""
    tracker = Tracker()
    for frame in (*range(12), 25):
        place_m = np.array([2.4 * frame, 0.0])
        seen = replace(car(frame, place_m), time_ns=17 * 10**17 + int(frame * 2e8))
        tracker.update([seen], time_ns=seen.time_ns, footprint_m=place_m + AROUND_M / 10)
    assert len(tracker.finish()) == 1
