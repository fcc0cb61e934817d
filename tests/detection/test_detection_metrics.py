"""The measures of detections: values worked by hand, COCO's own, and intervals that hold what they state."""

import importlib.util

import numpy as np
import pytest

from sorvolo.detection.contract import ScoreCalibration
from sorvolo.detection.fusing import platt_scaled
from sorvolo.errors import InputError
from sorvolo.lab.evaluation.change_metrics import Counts
from sorvolo.lab.evaluation.detection_metrics import (
    SIZES_PX,
    at_score,
    best_threshold,
    confusion,
    counts_at,
    judged_classes,
    match_pictures,
    precision_recall,
    recall_by_size,
    reporting_threshold,
    right_by_score,
)
from sorvolo.lab.evaluation.detection_scores import (
    differences,
    draw_groups,
    group_tables,
    intervals,
)
from sorvolo.lab.training.held_out import Checked, best_sizes_px
from sorvolo.survey.labels import LabelledPicture, LabelledSet
from sorvolo.survey.objects import Detections

CLASSES = ("person", "car")
HALF = {"person": 0.5, "car": 0.5}


def picture(boxes, labels, ignored=(), name="a.jpg", group="g", m_per_px=float("nan")):
    return LabelledPicture(
        name,
        100,
        100,
        group,
        np.array(boxes, float).reshape(-1, 4),
        np.array(labels, int),
        np.array(ignored, float).reshape(-1, 4),
        m_per_px,
    )


def seen(*rows):
    """Rows of (box, class, score)."""
    rows = sorted(rows, key=lambda row: -row[2])
    return Detections(
        np.array([row[0] for row in rows], float).reshape(-1, 4),
        np.array([row[2] for row in rows]),
        np.array([row[1] for row in rows], int),
        CLASSES,
    )


def thesis_map(matches):
    of_one_group = group_tables(matches, np.zeros(2, int), HALF)
    return of_one_group.measure(np.ones((1, 1)))["thesis_map"][0]


def square(x, y, side=10):
    return [x, y, x + side, y + side]


def test_a_reporting_threshold_does_not_hang_on_one_picture_s_chance():
    """Of 25 people 20 are found from 0.995 on, two from 0.6 on, with five alarms between: F1 is highest at 0.997."""
    people = [square(20 * index, 0) for index in range(25)]
    truth = LabelledSet("flat", CLASSES, (picture(people, [0] * 25),))
    sure = [(box, 0, 0.999 - 1e-4 * index) for index, box in enumerate(people[:20])]
    alarms = [(square(20 * index, 50), 0, 0.9 - 0.01 * index) for index in range(5)]
    late = [(box, 0, 0.6 - 0.01 * index) for index, box in enumerate(people[20:22])]
    (match, _), _, _ = match_pictures(truth, [seen(*sure, *alarms, *late)], CLASSES)
    best, reported = best_threshold(match), reporting_threshold(match)
    assert best.score > 0.99 and best.f1 > reported.f1 > best.f1 - 0.1
    assert reported.score == pytest.approx(0.59) and reported.recall == pytest.approx(22 / 25)


def test_what_a_score_means_worked_by_hand():
    """Of three reports around 0.55 two are right, a fourth lies in an ignored region; of two around 0.95 both are."""
    people = [square(20 * index, 0) for index in range(4)]
    truth = LabelledSet("flat", CLASSES, (picture(people, [0] * 4, ignored=[square(0, 60, 30)]),))
    doubtful = [
        (people[0], 0, 0.5),
        (people[1], 0, 0.55),
        (square(60, 60), 0, 0.59),
        (square(5, 65), 0, 0.57),
    ]
    sure = [(people[2], 0, 0.9), (people[3], 0, 1.0)]
    (match, _), _, _ = match_pictures(truth, [seen(*doubtful, *sure)], CLASSES)
    low, high = right_by_score(match)
    assert (low.low, low.high, low.count, low.found) == (0.5, 0.6, 3, pytest.approx(2 / 3))
    assert (
        low.stated == pytest.approx((0.5 + 0.55 + 0.59) / 3)
        and low.found_low < 2 / 3 < low.found_high
    )
    assert (high.low, high.count, high.found) == (0.9, 2, 1.0)


def test_average_precision_worked_by_hand():
    # four labels; right, wrong, right, right, wrong, and one label is never found: precision 1, 2/3, 3/4 at recall
    # 1/4, 1/2, 3/4. COCO's envelope: 26 recalls (0 to 0.25) at 1, 50 (0.26 to 0.75) at 3/4, the rest at 0.
    boxes = [square(0, 0), square(20, 0), square(40, 0), square(60, 0)]
    truth = LabelledSet("hand", CLASSES, (picture(boxes, [0] * 4),))
    found = seen(
        (square(0, 0), 0, 0.9),
        (square(0, 50), 0, 0.8),
        (square(20, 0), 0, 0.7),
        (square(40, 0), 0, 0.6),
        (square(50, 50), 0, 0.3),
    )
    (match, _), numbers, each = match_pictures(truth, [found], CLASSES)
    expected = (26 * 1.0 + 50 * 0.75) / 101
    assert numbers.ap50 == pytest.approx(expected) == pytest.approx(each["person"].ap)
    assert np.isnan(each["car"].ap) and np.isnan(numbers.ap_large)
    assert numbers.ap_small == pytest.approx(expected)
    assert counts_at(match, 0.5) == Counts(3, 1, 1)
    thesis_ap = [at_score(match, score).precision for score in (0.5, 0.65)]
    assert thesis_ap == pytest.approx([0.75, 2 / 3])
    best = best_threshold(match)
    assert (best.score, best.precision, best.recall) == pytest.approx((0.6, 0.75, 0.75))
    assert best.f1 == pytest.approx(0.75)
    scores, precision, recall = precision_recall(match)
    assert precision == pytest.approx([1, 1 / 2, 2 / 3, 3 / 4, 3 / 5])
    assert recall == pytest.approx([0.25, 0.25, 0.5, 0.75, 0.75])
    assert list(scores) == [0.9, 0.8, 0.7, 0.6, 0.3]


def test_a_box_that_fits_by_70_percent_is_right_up_to_that_overlap():
    truth = LabelledSet("fit", CLASSES, (picture([[0, 0, 100, 10]], [1]),))
    found = seen(([0, 0, 71, 10], 1, 0.9))  # IoU 0.71: right at 0.50, 0.55, 0.60, 0.65, 0.70
    _, numbers, _ = match_pictures(truth, [found], CLASSES)
    assert (numbers.ap, numbers.ap50, numbers.ap75) == pytest.approx((0.5, 1.0, 0.0))


def test_ignored_regions_and_unlabelled_classes_judge_nothing():
    labelled = LabelledSet(
        "cars",
        CLASSES,
        (picture([square(0, 0)], [1], ignored=[[50, 50, 100, 100]]),),
        frozenset({"person"}),
    )
    assert judged_classes(labelled, CLASSES) == ("car",)
    found = seen((square(0, 0), 1, 0.6), (square(60, 60), 1, 0.95), (square(20, 20), 0, 0.99))
    (match,), numbers, _ = match_pictures(labelled, [found], ("car",))
    assert numbers.ap == pytest.approx(
        1.0
    )  # neither the one in the ignored region nor the person is wrong
    assert counts_at(match, 0.5) == Counts(1, 0, 0)
    table, mistakes = confusion((match,), HALF)
    assert table.tolist() == [[1, 0], [0, 0]] and not mistakes
    foreign = LabelledSet("boats", ("boat",), labelled.pictures[:0])
    with pytest.raises(InputError, match="boats: labels boat, but the model finds person, car"):
        judged_classes(foreign, CLASSES)


def test_more_than_a_hundred_objects_of_a_picture_are_all_judged():
    boxes = [square(12 * (k % 16), 12 * (k // 16)) for k in range(150)]
    crowd = LabelledPicture(
        "crowd.jpg", 200, 200, "g", np.array(boxes, float), np.zeros(150, int), np.zeros((0, 4))
    )
    found = seen(*((box, 0, 0.9) for box in boxes))
    (match, _), numbers, _ = match_pictures(
        LabelledSet("crowd", CLASSES, (crowd,)), [found], CLASSES
    )
    assert numbers.ap50 == pytest.approx(1.0) and counts_at(match, 0.5) == Counts(150, 0, 0)


def test_no_detection_and_no_label_are_answers():
    labelled = LabelledSet("few", CLASSES, (picture([square(0, 0)], [0]), picture([], [])))
    nothing = seen()
    matches, numbers, _ = match_pictures(labelled, [nothing, nothing], CLASSES)
    assert numbers.ap == 0.0 and thesis_map(matches) == 0.0
    assert np.isnan(best_threshold(matches[0]).score)
    with pytest.raises(InputError, match="2 pictures, but detections in 1"):
        match_pictures(labelled, [nothing], CLASSES)
    empty = LabelledSet("empty", CLASSES, (picture([], []),))
    matches, numbers, _ = match_pictures(empty, [seen((square(0, 0), 0, 0.9))], CLASSES)
    assert np.isnan(numbers.ap) and np.isnan(thesis_map(matches))


def test_thesis_map_is_the_mean_of_precisions():
    labelled = LabelledSet(
        "two", CLASSES, (picture([square(0, 0), square(20, 0), square(40, 0)], [0, 0, 1]),)
    )
    found = seen(
        (square(0, 0), 0, 0.9),
        (square(40, 0), 1, 0.8),
        (square(70, 70), 1, 0.7),
        (square(80, 0), 1, 0.1),
    )
    matches, _, _ = match_pictures(labelled, [found], CLASSES)
    assert thesis_map(matches) == pytest.approx(
        (1.0 + 0.5) / 2
    )  # the missed person does not count (eq. 4.3)


def test_confusions_false_alarms_and_misses():
    labelled = LabelledSet(
        "mixed",
        CLASSES,
        (
            picture([square(0, 0), square(20, 0), square(40, 0, 30)], [0, 0, 1]),
            picture([], []),
        ),
    )
    found = [
        seen(
            (square(0, 0), 0, 0.9),
            (square(20, 0), 1, 0.8),
            (square(44, 4, 14), 1, 0.7),
            (square(40, 0, 30), 1, 0.2),
        ),
        seen((square(5, 5), 0, 0.99)),
    ]
    matches, _, _ = match_pictures(labelled, found, CLASSES)
    table, mistakes = confusion(matches, HALF)
    # true person: one found, one called car; true car: missed at 0.5; background: a person and a badly placed car
    assert table.tolist() == [[1, 1, 0], [0, 0, 1], [1, 1, 0]]
    by_kind = {
        kind: [each for each in mistakes if each.kind == kind]
        for kind in ("false alarm", "miss", "confusion")
    }
    assert [each.score for each in by_kind["false alarm"]] == [0.99, 0.7]
    assert by_kind["false alarm"][0].picture == 1 and by_kind["false alarm"][0].overlap == 0
    assert by_kind["false alarm"][1].overlap == pytest.approx(14 * 14 / 900)
    (confused,), (missed,) = by_kind["confusion"], by_kind["miss"]
    assert (confused.label, confused.true_label) == ("car", "person")
    assert (
        missed.true_label == "car"
        and missed.box_px == (40, 0, 70, 30)
        and missed.score == pytest.approx(0.2)
    )


def test_recall_by_size_in_pixels_and_metres():
    labelled = LabelledSet(
        "sizes",
        CLASSES,
        (
            picture(
                [square(0, 0, 6), square(20, 0, 6), square(40, 0, 20)], [0, 0, 0], m_per_px=0.05
            ),
            picture([square(0, 0)], [0]),
        ),
    )
    found = [
        seen((square(0, 0, 6), 0, 0.9), (square(20, 0, 6), 0, 0.1), (square(40, 0, 20), 0, 0.8)),
        seen(),
    ]
    matches, _, _ = match_pictures(labelled, found, CLASSES)
    rows = recall_by_size(matches, HALF, np.ones(2), SIZES_PX)["person"]
    assert [(row.low, row.count, row.reported, row.candidates) for row in rows] == [
        (4, 2, 1, 2),
        (8, 1, 0, 0),
        (16, 1, 1, 1),
    ]
    assert rows[0].recall == 0.5
    metres = np.array([each.m_per_px for each in labelled.pictures])
    by_m = recall_by_size(matches, HALF, metres, (0, 0.5, 2))["person"]
    assert [(row.low, row.high, row.count) for row in by_m] == [(0, 0.5, 2), (0.5, 2, 1)]


def random_set(seed, pictures=24, groups=8, skill=0.7):
    """Labels and detections of random pictures: some labels found, some badly placed, some inventions."""
    rng, truth_rng = np.random.default_rng(seed), np.random.default_rng(5)
    labelled, found = [], []
    for index in range(pictures):
        corners, sides = truth_rng.uniform(0, 80, (6, 2)), truth_rng.uniform(4, 40, (6, 2))
        boxes, labels = np.hstack([corners, corners + sides]), truth_rng.integers(0, 2, 6)
        labelled.append(
            picture(
                boxes[:5],
                labels[:5],
                boxes[5:] if index % 3 == 0 else (),
                f"{index}.jpg",
                f"video{index % groups}",
            )
        )
        rows = []
        for box, label in zip(boxes, labels):
            if rng.uniform() < skill:
                rows.append((box + rng.normal(0, 1.5, 4), int(label), float(rng.uniform(0.2, 1))))
            if rng.uniform() < 0.4:
                corner = rng.uniform(0, 80, 2)
                rows.append(
                    (
                        np.hstack([corner, corner + 12]),
                        int(rng.integers(2)),
                        float(rng.uniform(0.02, 0.8)),
                    )
                )
        found.append(seen(*rows))
    return LabelledSet("random", CLASSES, tuple(labelled)), found


def group_index(labelled):
    return np.unique([each.group for each in labelled.pictures], return_inverse=True)[1]


def test_tables_measure_what_coco_measures_also_on_drawn_groups():
    labelled, found = random_set(1)
    matches, numbers, each = match_pictures(labelled, found, CLASSES)
    tables = group_tables(matches, group_index(labelled), HALF)
    exact = tables.measure(np.ones((1, 8)))
    assert exact["AP"][0] == pytest.approx(numbers.ap, abs=1e-9) and 0.1 < numbers.ap < 0.9
    assert exact["AP50"][0] == pytest.approx(numbers.ap50, abs=1e-9)
    assert exact["AP75"][0] == pytest.approx(numbers.ap75, abs=1e-9)
    assert exact["AP car"][0] == pytest.approx(each["car"].ap, abs=1e-9)
    # a draw is the set with its groups as often as drawn: build it and let COCO measure it
    weights = np.array([2.0, 0, 1, 0, 3, 0, 1, 1])
    chosen = [
        k
        for k, row in enumerate(labelled.pictures)
        for _ in range(int(weights[int(row.group[5:])]))
    ]
    again = labelled.only([labelled.pictures[k] for k in chosen])
    _, drawn, _ = match_pictures(again, [found[k] for k in chosen], CLASSES)
    measured = tables.measure(weights[None])
    assert measured["AP"][0] == pytest.approx(drawn.ap, abs=1e-9)
    assert measured["AP50"][0] == pytest.approx(drawn.ap50, abs=1e-9)


def test_intervals_hold_the_value_shrink_with_data_and_repeat():
    widths = {8: [], 64: []}
    for seed in (2, 12, 22, 32):
        for count, seen_widths in widths.items():
            labelled, found = random_set(seed, pictures=3 * count, groups=count)
            matches, numbers, _ = match_pictures(labelled, found, CLASSES)
            tables = group_tables(matches, group_index(labelled), HALF)
            stated = intervals(tables, draws=200)["AP"]
            assert (
                stated.value == pytest.approx(numbers.ap, abs=1e-9)
                and stated.low < stated.value < stated.high
            )
            assert intervals(tables, draws=200)["AP"] == stated
            seen_widths.append(stated.high - stated.low)
    assert np.mean(widths[64]) < 0.6 * np.mean(widths[8])
    assert np.array_equal(draw_groups(5, 3, 7), draw_groups(5, 3, 7))
    assert (draw_groups(5, 3, 7).sum(axis=1) == 5).all()
    one = group_tables(matches, np.zeros(len(labelled), int), HALF)
    assert np.isnan(intervals(one)["AP"].low)


def test_a_better_model_is_clearly_better_and_equal_ones_are_not():
    labelled, weak = random_set(3, pictures=48, skill=0.45)
    _, strong = random_set(4, pictures=48, skill=0.9)
    _, weak_too = random_set(6, pictures=48, skill=0.45)
    groups = group_index(labelled)
    arms = weak, strong, weak_too
    tables = [
        group_tables(match_pictures(labelled, each, CLASSES)[0], groups, HALF) for each in arms
    ]
    better = differences(tables[:1], tables[1:2], draws=200)["AP50"]
    assert better.is_clear and better.low > 0.1 and better.share_above == 1.0
    same = differences(tables[:1], tables[:1], draws=200)["AP50"]
    assert same.value == same.low == same.high == 0 and not same.is_clear
    seeds = differences([tables[0], tables[2]], tables[1:2], draws=200)["AP50"]
    means = [each.measure(np.ones((1, 8)))["AP50"][0] for each in tables]
    assert seeds.value == pytest.approx(means[1] - (means[0] + means[2]) / 2)
    assert not differences([tables[0]], [tables[2]], draws=200)["AP50"].is_clear


@pytest.mark.skipif(
    importlib.util.find_spec("faster_coco_eval") is None, reason="faster-coco-eval is not installed"
)
def test_another_implementation_agrees():
    from faster_coco_eval import COCO, COCOeval_faster

    labelled, found = random_set(8)
    _, numbers, _ = match_pictures(labelled, found, CLASSES)
    annotations, rows = [], []
    for index, (row, detections) in enumerate(zip(labelled.pictures, found)):
        for box, label in zip(row.boxes_px.tolist(), row.labels.tolist()):
            annotations.append(coco_row(len(annotations) + 1, index, label, box, 0))
        for box in row.ignored_px.tolist():
            annotations += [coco_row(len(annotations) + 1 + k, index, k, box, 1) for k in (0, 1)]
        for box, label, score in zip(
            detections.boxes_px.tolist(), detections.labels.tolist(), detections.scores
        ):
            rows.append(coco_row(len(rows) + 1, index, label, box, 0) | {"score": float(score)})
    truth = COCO(
        {
            "images": [{"id": k, "width": 100, "height": 100} for k in range(len(found))],
            "categories": [{"id": k, "name": name} for k, name in enumerate(CLASSES)],
            "annotations": annotations,
        }
    )
    judge = COCOeval_faster(truth, truth.loadRes(rows), "bbox", print_function=lambda *_: None)
    judge.run()
    ours = (numbers.ap, numbers.ap50, numbers.ap75, numbers.ap_small, numbers.ap_medium)
    assert ours == pytest.approx(tuple(judge.stats[:5]), abs=1e-6)


def coco_row(row_id, index, label, box, crowd):
    left, top, right, bottom = box
    return {
        "id": row_id,
        "image_id": index,
        "category_id": label,
        "iscrowd": crowd,
        "bbox": [left, top, right - left, bottom - top],
        "area": (right - left) * (bottom - top),
    }


@pytest.mark.parametrize(("people", "kept"), [(8, True), (40, True), (60, False)])
def test_few_held_out_labels_keep_threshold_and_sizes_of_the_model_before(
    people: int, kept: bool
) -> None:
    boxes = [square(20 * index, 0) for index in range(people)]
    truth = LabelledSet("held out", CLASSES, (picture(boxes, [0] * people),))
    found = [(box, 0, 0.99 - 0.8 * index / people) for index, box in enumerate(boxes)]
    matches, _, _ = match_pictures(truth, [seen(*found)], CLASSES)
    checked = Checked({each.label: (each,) for each in matches if each.label == "person"}, {})
    chosen = checked.thresholds(CLASSES, {"person": 0.55, "car": 0.4})
    assert (chosen["person"].score == 0.55) is kept
    if kept:
        assert chosen["person"].precision == 1.0 and 0.3 < chosen["person"].recall < 0.8
    assert chosen["car"].score == 0.4 and np.isnan(chosen["car"].recall)
    assert checked.thresholds(CLASSES)["car"].score == 0.5
    assert checked.too_few(CLASSES) == (("person", "car") if kept else ("car",))
    scores = {"person": 0.2, "car": 0.4, "small object": 0.4}
    before = {"person": (12.0, 130.0), "car": (40.0, 110.0)}
    sizes = best_sizes_px(checked, scores, (), CLASSES, before)
    assert sizes["car"] == before["car"] and (sizes["person"] == before["person"]) is kept
    assert best_sizes_px(checked, scores, (), CLASSES)["person"] != before["person"]


def test_what_held_out_scores_mean() -> None:
    """Of 60 people each is found by one of 60 reports, 20 reports of low scores are of nothing: those become shares.

    Of a class with too few labels the scale of the model before is kept, where it had one.
    """
    people = [square(20 * index, 0) for index in range(60)]
    truth = LabelledSet("held out", CLASSES, (picture(people, [0] * 60),))
    right = [(box, 0, 0.9 - 0.008 * index) for index, box in enumerate(people)]
    wrong = [(square(20 * index, 50), 0, 0.5 - 0.01 * index) for index in range(20)]
    matches, _, _ = match_pictures(truth, [seen(*right, *wrong)], CLASSES)
    checked = Checked({each.label: (each,) for each in matches if each.label == "person"}, {})
    before = {"person": ScoreCalibration(0.5, 0.0), "car": ScoreCalibration(2.0, -1.0)}
    found = checked.calibration(CLASSES, before)
    assert found["car"] == before["car"] and found["person"] != before["person"]
    sure, unsure = platt_scaled(np.array([0.85, 0.42]), found["person"])
    assert sure > 0.95 and 0.3 < unsure < 0.7
    assert set(checked.calibration(CLASSES)) == {"person"}
    perfect, _, _ = match_pictures(truth, [seen(*right)], CLASSES)
    assert not Checked({"person": (perfect[0],)}, {}).calibration(("person",))
