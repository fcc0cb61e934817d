"""Labels written as COCO and YOLO are read back the same, and by other tools too."""

import contextlib
import io
from pathlib import Path

import labelled_folders as put
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sorvolo.errors import InputError
from sorvolo.lab.datasets import read_dataset
from sorvolo.store.exports.detection_files import (
    coco_document,
    picture_of_detections,
    write_coco,
    write_yolo,
    yolo_text,
)
from sorvolo.survey.labels import LabelledPicture, LabelledSet
from sorvolo.survey.objects import CLASSES, Detections

BOX = st.tuples(st.floats(0, 190), st.floats(0, 90), st.floats(1, 10), st.floats(1, 10)).map(
    lambda each: (each[0], each[1], each[0] + each[2], each[1] + each[3])
)
FEW = settings(
    max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


def picture_at(path, boxes, labels, ignored=(), group="flight 1"):
    return LabelledPicture(
        str(path),
        200,
        100,
        group,
        np.array(boxes, np.float32),
        np.array(labels),
        np.array(ignored, np.float32),
        0.031,
    )


@FEW
@given(boxes=st.lists(BOX, max_size=4), ignored=st.lists(BOX, max_size=2), data=st.data())
def test_coco_comes_back_as_it_was_written(tmp_path, boxes, ignored, data):
    labels = [data.draw(st.integers(0, 2)) for _ in boxes]
    path = put.put_picture(tmp_path / "images" / "deep" / "a_1.png")
    labelled = LabelledSet("a set", CLASSES, (picture_at(path, boxes, labels, ignored),))
    write_coco(tmp_path / "labels" / "coco.json", labelled)
    again = read_dataset(tmp_path / "labels" / "coco.json")
    assert again.classes == CLASSES and again.notices == ()
    (one,) = again.pictures
    assert one.labels.tolist() == labels and one.group == "flight 1" and one.m_per_px == 0.031
    assert np.allclose(one.boxes_px, labelled.pictures[0].boxes_px, atol=2e-3)
    wanted = list(dict.fromkeys(map(tuple, labelled.pictures[0].ignored_px.tolist())))
    assert np.allclose(one.ignored_px, np.reshape(wanted, (-1, 4)), atol=2e-3)


@FEW
@given(boxes=st.lists(BOX, max_size=4), data=st.data())
def test_yolo_comes_back_as_it_was_written(tmp_path, boxes, data):
    labels = [data.draw(st.integers(0, 2)) for _ in boxes]
    path = put.put_picture(tmp_path / "images" / "deep" / "a_1.png")
    labelled = LabelledSet("a set", CLASSES, (picture_at(path, boxes, labels),))
    assert write_yolo(tmp_path, labelled) == 0
    again = read_dataset(tmp_path, form="yolo")
    assert again.classes == CLASSES and again.notices == ()
    assert again.pictures[0].labels.tolist() == labels
    assert np.allclose(again.pictures[0].boxes_px, labelled.pictures[0].boxes_px, atol=1e-3)


def test_coco_s_own_tool_reads_what_is_written(tmp_path):
    from pycocotools.coco import COCO

    pictures = (
        picture_at("images/a.jpg", [(10, 20, 30, 60)], [1], [(0, 0, 5, 5)]),
        picture_at("images/b.jpg", [], []),
    )
    labelled = LabelledSet("s", ("person", "car"), pictures)
    write_coco(tmp_path / "boxes.json", labelled, [np.array([0.87654]), np.zeros(0)])
    with contextlib.redirect_stdout(io.StringIO()):
        coco = COCO(str(tmp_path / "boxes.json"))
    (box,) = coco.loadAnns(coco.getAnnIds(imgIds=[1], iscrowd=False))
    assert box["bbox"] == [10, 20, 20, 40] and box["area"] == 800 and box["score"] == 0.8765
    assert coco.loadCats([box["category_id"]])[0]["name"] == "car"
    assert len(coco.getAnnIds(imgIds=[1], iscrowd=True)) == 2  # of each class
    assert [row["file_name"] for row in coco.loadImgs([1, 2])] == ["images/a.jpg", "images/b.jpg"]


def test_file_names_are_relative_to_the_label_file(tmp_path):
    labelled = LabelledSet("s", CLASSES, (picture_at(tmp_path / "photos" / "a.jpg", [], []),))
    document = coco_document(labelled, tmp_path / "labels")
    assert document["images"][0]["file_name"] == "../photos/a.jpg"


def test_yolo_numbers_are_shares_and_ignored_regions_are_counted(tmp_path):
    text = yolo_text(np.array([[90, 40, 110, 60]], np.float32), [2], 200, 100)
    assert text == "2 0.5000000 0.5000000 0.1000000 0.2000000\n"
    inside = picture_at("images/sub/a.jpg", [], [], [(0, 0, 5, 5)])
    outside = picture_at("elsewhere/b.jpg", [(1, 2, 3, 4)], [0])
    assert write_yolo(tmp_path, LabelledSet("s", ("it's",), (inside, outside))) == 1
    assert (tmp_path / "labels" / "sub" / "a.txt").read_text() == ""
    assert (tmp_path / "labels" / "b.txt").read_text().startswith("0 0.0100000")
    assert "  0: 'it''s'\n" in (tmp_path / "data.yaml").read_text()


def test_two_pictures_of_one_name_are_refused_before_anything_is_written(tmp_path):
    pictures = (picture_at("x/a.jpg", [], []), picture_at("y/a.jpg", [], []))
    with pytest.raises(InputError, match=r"named a.*y/a\.jpg"):
        write_yolo(tmp_path, LabelledSet("s", CLASSES, pictures))
    assert not (tmp_path / "labels").exists()


def test_what_a_detector_saw_becomes_labels():
    seen = Detections(np.array([[1, 2, 3, 4]]), np.array([0.5]), np.array([1]), CLASSES)
    picture = picture_of_detections("images/a.jpg", 200, 100, "flight 2", seen)
    document = coco_document(LabelledSet("s", CLASSES, (picture,)), Path("."))
    (box,) = document["annotations"]
    assert (box["category_id"], box["bbox"]) == (2, [1, 2, 2, 2]) and "m_per_px" not in document[
        "images"
    ][0]
