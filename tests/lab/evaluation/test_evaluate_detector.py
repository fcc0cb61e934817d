"""A detector measured on labelled pictures: by itself, beside others, and what is written of it."""

import json
from dataclasses import replace
from itertools import cycle
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from toy_models import rectangle_model

from sorvolo.cli.main import main
from sorvolo.detection.detector import Detector
from sorvolo.errors import InputError, SettingsError
from sorvolo.lab.datasets.splits import hold_out
from sorvolo.lab.evaluation.detector import (
    NUMBERS,
    PAGE,
    EvaluationSettings,
    evaluate_detector,
    read_sets,
    write_evaluation,
)
from sorvolo.survey.labels import LabelledPicture, LabelledSet
from sorvolo.survey.objects import CLASSES, Detections

QUICK = EvaluationSettings(tiles=None, draws=50)


@pytest.fixture(scope="session")
def toy(tmp_path_factory):
    """A real model that finds bright rectangles: red is the score, green the class."""
    return rectangle_model(tmp_path_factory.mktemp("models") / "toy.onnx")


def paint(path, rectangles):
    """A dark picture of 96x64 with a rectangle (box, class, score of 255) each."""
    image = np.full((64, 96, 3), 20, np.uint8)
    for (left, top, right, bottom), label, score in rectangles:
        image[top:bottom, left:right] = (score, 100 * label, 60)
    Image.fromarray(image).save(path)


@pytest.fixture(scope="session")
def labelled(tmp_path_factory):
    """Four pictures of two videos: all is found but a person called a car, a missed car and an invented person."""
    folder = tmp_path_factory.mktemp("set")
    person, car = ((8, 8, 16, 20), 0, 200), ((30, 30, 60, 50), 1, 220)
    painted = [[person, car], [person], [((8, 8, 16, 20), 1, 240)], [((70, 10, 80, 20), 0, 250)]]
    truth = [[person, car], [person, ((70, 40, 90, 50), 1, 0)], [person], []]
    pictures = []
    for index, (shown, true) in enumerate(zip(painted, truth)):
        path = folder / f"{index}.png"
        paint(path, shown)
        pictures.append(
            LabelledPicture(
                str(path),
                96,
                64,
                f"video{index // 2}",
                np.array([row[0] for row in true], float).reshape(-1, 4),
                np.array([row[1] for row in true], int),
                np.zeros((0, 4)),
                0.1,
            )
        )
    return LabelledSet("painted", CLASSES, tuple(pictures), frozenset({"small object"}))


def test_a_detector_of_ones_own_is_measured_beside_a_model(toy, labelled):
    """Loaded, or with `detect` alone; one detector and one set need no lists."""

    class Bright:
        classes = CLASSES

        def detect(self, image):
            return Detector.load(str(toy)).detect(image)

    beside = evaluate_detector([Bright(), str(toy)], labelled, QUICK)
    assert [arm.name for arm in beside.comparisons[0].arms] == ["Bright", "toy"]
    (model,) = evaluate_detector(str(toy), labelled, QUICK).sets
    assert beside.sets[0].coco.ap50 == model.coco.ap50 > 0.3
    (loaded,) = evaluate_detector(Detector.load(str(toy)), [labelled], QUICK).sets
    assert loaded.coco.ap50 == model.coco.ap50
    for arms, sets in (([], labelled), ([[]], labelled), (str(toy), [])):
        with pytest.raises(InputError, match="nothing to measure"):
            evaluate_detector(arms, sets, QUICK)


def test_a_model_is_measured_and_its_report_stands_alone(toy, labelled, tmp_path):
    steps = []
    evaluation = evaluate_detector([[str(toy)]], [labelled], QUICK, steps.append)
    assert [step.pictures_done for step in steps] == [1, 2, 3, 4]
    (scores,) = evaluation.sets
    person, car = scores.classes
    assert scores.left_out == ("small object",) and scores.groups == 2
    assert (person.labels, car.labels) == (3, 2)
    # persons by score: the invention, two right, one never: precision 1/2 at recall 1/3 and 2/3 at 2/3
    assert person.coco.ap50 == pytest.approx(67 * (2 / 3) / 101)
    # cars by score: the person called a car, one right, one missed: precision 1/2 at recall 1/2
    assert car.coco.ap50 == pytest.approx(51 * 0.5 / 101)
    thesis_map = scores.intervals["thesis_map"].value
    assert thesis_map == pytest.approx((2 / 3 + 1 / 2) / 2)
    assert scores.confusion.tolist() == [[2, 1, 0], [0, 1, 1], [1, 0, 0]]
    assert {row.kind for row in scores.mistakes} == {"false alarm", "miss", "confusion"}
    assert [(row.low, row.count) for row in scores.by_size_m["car"]] == [(2.0, 2)]
    write_evaluation(evaluation, tmp_path / "out", {"data": "painted"})
    page = (tmp_path / "out" / PAGE).read_text()
    assert page.count("data:image/jpeg;base64,") == 3 and "http" not in page.replace(
        "http://www.w3.org", ""
    )
    assert "person reported as car" in page and "car missed" in page
    numbers = json.loads((tmp_path / "out" / NUMBERS).read_text())
    assert numbers["sets"][0]["mistakes"] == {"false alarm": 1, "miss": 1, "confusion": 1}
    assert numbers["sets"][0]["intervals"]["thesis_map"]["value"] == pytest.approx(thesis_map)
    assert numbers["sets"][0]["classes"][0]["coco"]["ap_large"] is None


def test_each_set_is_reported_from_the_scores_of_the_model_that_looks_at_its_light(
    labelled, tmp_path, monkeypatch
):
    monkeypatch.setenv("SORVOLO_MODELS", str(tmp_path / "models"))
    (tmp_path / "models").mkdir()
    night_scores, day_scores = dict.fromkeys(CLASSES, 0.7), dict.fromkeys(CLASSES, 0.4)
    rectangle_model(
        tmp_path / "models" / "night.onnx", name="night", thermal=True, thresholds=night_scores
    )
    day = rectangle_model(
        tmp_path / "day.onnx", name="day", thermal=True, thermal_by="night", thresholds=day_scores
    )
    grey = tmp_path / "grey.png"
    Image.fromarray(np.array(Image.open(labelled.pictures[0].path).convert("L"))).save(grey)
    night = replace(
        labelled, name="night", pictures=(replace(labelled.pictures[0], path=str(grey)),)
    )
    evaluation = evaluate_detector([[str(day)]], [labelled, night], QUICK)
    assert [dict(each.thresholds) for each in evaluation.found.sets.values()] == [
        day_scores,
        night_scores,
    ]
    assert [each.classes[0].reported.score for each in evaluation.sets] == [0.4, 0.7]
    assert not any("another light" in text for text in evaluation.notices)
    both = replace(labelled, pictures=(*labelled.pictures, *night.pictures))
    evaluation = evaluate_detector([[str(day)]], [both], QUICK)
    assert evaluation.sets[0].classes[0].reported.score == 0.4
    assert any(
        "painted: 1 of 5 pictures are of another light" in text for text in evaluation.notices
    )


def test_no_other_model_is_measured_in_the_place_of_one_that_knows_daylight_alone(
    labelled, tmp_path, monkeypatch
):
    monkeypatch.setenv("SORVOLO_MODELS", str(tmp_path / "models"))
    (tmp_path / "models").mkdir()
    blind, seeing = dict.fromkeys(CLASSES, 0.99), dict.fromkeys(CLASSES, 0.4)
    rectangle_model(
        tmp_path / "models" / "night.onnx", name="night", thermal=True, thresholds=seeing
    )
    day = rectangle_model(tmp_path / "day.onnx", name="day", thermal=False, thresholds=blind)
    both = rectangle_model(tmp_path / "both.onnx", name="both", thermal=True)
    grey = tmp_path / "grey.png"
    Image.fromarray(np.array(Image.open(labelled.pictures[0].path).convert("L"))).save(grey)
    night = replace(labelled, pictures=(replace(labelled.pictures[0], path=str(grey)),))
    evaluation = evaluate_detector([[str(day)]], [night], QUICK)
    assert dict(evaluation.found.sets["painted"].thresholds) == blind
    (notice,) = evaluation.notices
    assert notice.startswith(
        "1 frames are thermal, but the model 'day' was trained on daylight alone"
    )
    rival = evaluate_detector([[str(both)], [str(day)]], [night], QUICK)
    assert dict(rival.comparisons[0].arms[1].mean) and rival.notices == (notice,)


class RandomDetector:
    """Finds each label with this chance, and invents a box a picture; shown the set's pictures in their order."""

    classes = CLASSES

    def __init__(self, name, labelled, skill, seed):
        self.name, rng = name, np.random.default_rng(seed)
        found = []
        for picture in labelled.pictures:
            hit = rng.uniform(size=len(picture.labels)) < skill
            boxes = np.vstack(
                [picture.boxes_px[hit], rng.uniform(0, 20, (1, 4)) + np.array([0, 0, 30, 30])]
            )
            scores = np.append(rng.uniform(0.5, 1, hit.sum()), 0.4)
            found.append(Detections(boxes, scores, np.append(picture.labels[hit], 0), CLASSES))
        self._found = cycle(found)

    def detect(self, image):
        return next(self._found)


@pytest.fixture(scope="session")
def many(tmp_path_factory):
    """Sixty small pictures of twelve videos, their labels at random."""
    folder, rng = tmp_path_factory.mktemp("many"), np.random.default_rng(3)
    pictures = []
    for index in range(60):
        paint(folder / f"{index}.png", [])
        corners = rng.uniform(0, 40, (5, 2))
        boxes = np.hstack([corners, corners + rng.uniform(5, 20, (5, 2))])
        pictures.append(
            LabelledPicture(
                str(folder / f"{index}.png"),
                96,
                64,
                f"v{index % 12}",
                boxes,
                rng.integers(0, 2, 5),
                np.zeros((0, 4)),
            )
        )
    return LabelledSet("many", CLASSES, tuple(pictures), frozenset({"small object"}))


def test_arms_of_several_seeds_side_by_side(many, tmp_path):
    standard = [RandomDetector("standard", many, 0.5, seed) for seed in (1, 2, 3)]
    extended = [RandomDetector("extended", many, 0.8, seed) for seed in (1, 2, 3)]
    evaluation = evaluate_detector([standard, extended], [many], QUICK)
    (printed,) = evaluation.comparisons
    assert [arm.seeds for arm in printed.arms] == [3, 3] and printed.groups == 12
    assert (
        printed.arms[0].lowest["AP50"]
        < printed.arms[0].mean["AP50"]
        < printed.arms[0].highest["AP50"]
    )
    better = printed.differences[0]["AP50"]
    assert better.value == pytest.approx(
        printed.arms[1].mean["AP50"] - printed.arms[0].mean["AP50"]
    )
    assert better.is_clear and 0.1 < better.low < better.value < better.high
    write_evaluation(evaluation, tmp_path / "out", {})
    page = (tmp_path / "out" / PAGE).read_text()
    assert (
        "Side by side: many" in page
        and "extended and 2 more seeds less standard and 2 more seeds" in page
    )
    fewer = evaluate_detector([standard[:2], extended[:1]], [many], QUICK)
    assert [arm.name for arm in fewer.comparisons[0].arms] == [
        "standard and 1 more seed",
        "extended",
    ]


def test_sets_of_one_name_are_refused(toy, many):
    with pytest.raises(InputError, match="two data sets have one name"):
        evaluate_detector([[str(toy)]], [many, many], QUICK)


@pytest.fixture(scope="session")
def coco(labelled, tmp_path_factory):
    """The painted set as a COCO folder, in the set's own names."""
    folder = tmp_path_factory.mktemp("coco")
    images, annotations = [], []
    for index, picture in enumerate(labelled.pictures):
        name = Path(picture.path).name
        (folder / name).write_bytes(Path(picture.path).read_bytes())
        images.append(
            {
                "id": index,
                "file_name": name,
                "width": 96,
                "height": 64,
                "flight": picture.group,
                "m_per_px": 0.1,
            }
        )
        for box, label in zip(picture.boxes_px.tolist(), picture.labels.tolist()):
            annotations.append(
                {
                    "id": len(annotations) + 1,
                    "image_id": index,
                    "category_id": label + 1,
                    "iscrowd": 0,
                    "bbox": [box[0], box[1], box[2] - box[0], box[3] - box[1]],
                    "area": 1,
                }
            )
    (folder / "labels.json").write_text(
        json.dumps(
            {
                "images": images,
                "annotations": annotations,
                "categories": [{"id": 1, "name": "Walker"}, {"id": 2, "name": "Truck"}],
            }
        )
    )
    return folder


def test_the_command_reads_labels_prints_numbers_and_writes_the_report(
    toy, coco, tmp_path, capsys, monkeypatch
):
    detect = Detector.detect
    whole = {"tiles": None}  # the toy knows things of one size in pixels
    monkeypatch.setattr(
        Detector, "detect", lambda self, image, **how: detect(self, image, **how | whole)
    )
    printed = [
        "--classes",
        "Walker=person,Truck=car",
        "--unlabelled",
        "small object",
    ]
    assert (
        main(
            [
                "evaluate",
                "detector",
                str(toy),
                str(coco),
                *printed,
                "--out",
                str(tmp_path / "out"),
                "--json",
            ]
        )
        == 0
    )
    numbers = json.loads(capsys.readouterr().out)
    assert numbers["sets"][0]["confusion"] == [[2, 1, 0], [0, 1, 1], [1, 0, 0]]
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == sorted([PAGE, NUMBERS])
    rival = ["--compare", str(toy)]
    assert main(["evaluate", "detector", str(toy), str(coco), *printed, *rival]) == 0
    shown = capsys.readouterr().out
    assert "side by side" in shown and "thesis_map" in shown
    assert main(["evaluate", "detector", str(toy), str(coco), "--classes", "=person"]) == 1
    assert "THEIRS=OURS" in capsys.readouterr().err
    assert main(["evaluate", "detector", "no-such-model", str(coco), *printed]) == 1


def test_pictures_are_shown_as_to_watch(toy, coco, monkeypatch):
    shown = []
    detect = Detector.detect

    def noted(self, image, **how):
        shown.append(how["tiles"])
        return detect(self, image, **how)

    monkeypatch.setattr(Detector, "detect", noted)
    command = [
        "evaluate",
        "detector",
        str(toy),
        str(coco),
        "--classes",
        "Walker=person,Truck=car",
    ]
    assert main(command) == 0 and set(shown) == {"auto"}


@pytest.mark.long
def test_a_damaged_picture_is_left_out_for_all_models_and_named(toy, coco, tmp_path, capsys):
    folder = tmp_path / "coco"
    folder.mkdir()
    for path in coco.iterdir():
        (folder / path.name).write_bytes(path.read_bytes())
    names = [
        "--classes",
        "Walker=person,Truck=car",
        "--unlabelled",
        "small object",
    ]
    command = ["evaluate", "detector", str(toy), str(folder), *names]
    data = (folder / "1.png").read_bytes()
    (folder / "1.png").write_bytes(data[: len(data) // 2])
    capsys.readouterr()
    assert main([*command, "--compare", str(toy), "--out", str(tmp_path / "cut")]) == 0
    printed = capsys.readouterr().out.replace("\n", "")
    assert f"note: 1 picture left out that cannot be read: {folder / '1.png'}" in printed
    numbers = json.loads((tmp_path / "cut" / NUMBERS).read_text())
    assert (
        numbers["sets"][0]["pictures"] == 3
        and "1 picture left out that cannot be read" in numbers["notices"]
    )
    assert (
        numbers["comparisons"][0]["arms"][0]["mean"] == numbers["comparisons"][0]["arms"][1]["mean"]
    )
    for path in folder.glob("*.png"):
        path.write_bytes(path.read_bytes()[:60])
    capsys.readouterr()
    assert main(command) == 1
    assert "none of the 4 pictures of coco can be read" in " ".join(capsys.readouterr().err.split())


def test_names_that_nothing_has_are_reported(toy, coco, capsys):
    command = ["evaluate", "detector", str(toy), str(coco), "--classes", "Walker=person,Truck=car"]
    assert main([*command, "--ignore", "Lory"]) == 1
    assert (
        "ignore: 'Lory' is no name in the labels; there are: Walker, Truck"
        in capsys.readouterr().err
    )
    assert main([*command, "--unlabelled", "Car"]) == 1
    assert (
        "unlabelled: 'Car' is no class; there are: person, car, small object"
        in capsys.readouterr().err
    )


def test_what_a_training_held_out_can_be_measured_alone(many):
    learnt, kept, remarks = hold_out(many, 0.25, 3)
    assert {each.group for each in learnt.pictures}.isdisjoint(each.group for each in kept.pictures)
    assert len(learnt) + len(kept) == 60 and len(kept) == 15 and not remarks
    one_video = many.only([replace(each, group="v") for each in many.pictures])
    learnt, kept, remarks = hold_out(one_video, 0.25, 3)
    assert 5 <= len(kept) <= 20 and "too few videos" in remarks[0]
    with pytest.raises(SettingsError, match="share to hold out"):
        hold_out(many, 1.0, 3)


def test_the_command_s_held_out_share(coco):
    names = {"Walker": "person", "Truck": "car"}
    (kept,) = read_sets([coco], classes=names, held_out=0.5, seed=1)
    assert len(kept) == 2 and len({each.group for each in kept.pictures}) == 1
