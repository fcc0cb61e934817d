"""Labelled pictures of every form: boxes where they were drawn, classes and groups as meant, what is wrong counted."""

import json
import os
from collections import Counter
from pathlib import Path

import labelled_folders as put
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from real_data import real_data
from sorvolo.errors import InputError, SettingsError, SorvoloError
from sorvolo.lab.datasets import READERS, read_dataset, read_datasets
from sorvolo.lab.datasets.checking import turned
from sorvolo.lab.datasets.splits import group_of
from sorvolo.lab.datasets.yolo import names_in_yaml

FUZZ = settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


def notices(labelled):
    return {each.code: each.count for each in labelled.notices}


def yolo_folder(folder, text, names="person\ncar\n"):
    put.put_picture(folder / "images" / "a_1.jpg")
    put.put_text(folder / "labels" / "a_1.txt", text)
    if names:
        put.put_text(folder / "classes.txt", names)
    return folder


# YOLO


def test_yolo_boxes_are_shares_of_the_picture(tmp_path):
    labelled = read_dataset(yolo_folder(tmp_path, "1 0.5 0.5 0.1 0.2\n0 0.25 0.75 0.05 0.1 0.93\n"))
    (picture,) = labelled.pictures
    assert labelled.classes == ("person", "car")
    assert put.edges(picture.boxes_px) == [[90, 40, 110, 60], [45, 70, 55, 80]]
    assert [labelled.classes[label] for label in picture.labels] == ["car", "person"]
    assert (picture.width_px, picture.height_px, picture.group) == (200, 100, "a")
    assert labelled.notices == ()


def test_yolo_segments_and_turned_boxes_give_the_box_around_them(tmp_path):
    labelled = read_dataset(
        yolo_folder(tmp_path, "0 0.1 0.2 0.3 0.1 0.2 0.6\n0 0.5 0.5 0.6 0.5 0.6 0.7 0.5 0.7")
    )
    assert put.edges(labelled.pictures[0].boxes_px) == [[20, 10, 60, 60], [100, 50, 120, 70]]


@pytest.mark.parametrize(
    "picture, label",
    [
        ("images/train/v_1.png", "labels/train/v_1.txt"),
        ("train/images/v_1.png", "train/labels/v_1.txt"),
        ("v_1.png", "v_1.txt"),
        ("obj_train_data/v_1.png", "obj_train_data/v_1.txt"),
    ],
)
@pytest.mark.parametrize(
    "names",
    [
        ("data.yaml", "nc: 2\nnames: ['Boat', 'Car']\n"),
        ("data.yaml", "names:\n- boat\n- car # the second\ntrain: x\n"),
        ("data.yaml", "names:\n  0: boat\n  1: 'Car'\nnc: 2"),
        ("obj.names", "boat\ncar\n"),
        ("classes.txt", "boat\ncar"),
        ("data.yaml", "names: [\n  'boat',\n  'car',\n]\n"),
    ],
)
def test_yolo_folders_and_names_as_tools_lay_them(tmp_path, picture, label, names):
    put.put_picture(tmp_path / picture)
    put.put_text(tmp_path / label, "1 0.5 0.5 0.1 0.2\n0 0.5 0.5 0.1 0.2\n")
    put.put_text(tmp_path / names[0], names[1])
    labelled = read_dataset(tmp_path)
    assert labelled.classes == ("car",) and len(labelled.pictures[0].labels) == 1
    assert notices(labelled) == {"unmapped_classes": 1}
    assert labelled.pictures[0].group == "v"


def test_look_alikes_that_are_ignored_are_counted(tmp_path):
    boxes = "2 0.5 0.5 0.1 0.2\n2 0.2 0.5 0.1 0.2\n3 0.8 0.5 0.1 0.2\n"
    folder = yolo_folder(tmp_path, boxes, "person\ncar\nTruck\nothers\n")
    labelled = read_dataset(folder)
    assert len(labelled.pictures[0].ignored_px) == 3 and not len(labelled.pictures[0].labels)
    assert notices(labelled) == {"look_alikes_ignored": 2}, (
        "what a set ignores itself is not counted"
    )
    assert "Truck (2)" in labelled.notices[0].text and "--classes" in labelled.notices[0].text
    assert notices(read_dataset(folder, classes={"car": "car", "truck": "car"})) == {
        "unmapped_classes": 1
    }


def test_linked_folders_count_and_rings_of_links_end(tmp_path):
    put.put_picture(tmp_path / "elsewhere" / "a_1.jpg")
    put.put_text(tmp_path / "set" / "labels" / "a_1.txt", "0 0.5 0.5 0.1 0.2\n")
    put.put_text(tmp_path / "set" / "classes.txt", "car")
    (tmp_path / "set" / "images").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "elsewhere" / "back").symlink_to(tmp_path / "set")
    labelled = read_dataset(tmp_path / "set")
    assert [len(each.labels) for each in labelled.pictures] == [1] and labelled.notices == ()


def test_one_part_of_a_yolo_folder_finds_labels_and_names_above_it(tmp_path):
    for part in ("train", "val"):
        put.put_picture(tmp_path / "images" / part / f"{part}_1.jpg")
        put.put_text(tmp_path / "labels" / part / f"{part}_1.txt", "0 0.5 0.5 0.1 0.2\n")
    put.put_text(tmp_path / "data.yaml", "names: [car]\n")
    part = read_dataset(tmp_path / "images" / "val")
    assert len(part) == 1 and part.classes == ("car",)
    assert len(read_dataset(tmp_path / "data.yaml")) == 2


def test_unnamed_classes_are_their_numbers_and_a_single_one_is_the_one_looked_for(tmp_path):
    folder = yolo_folder(tmp_path, "0 0.5 0.5 0.1 0.2\n", names=None)
    assert read_dataset(folder, classes={"0": "car"}).classes == ("car",)
    assert read_dataset(folder, classes={"person": "person"}).classes == ("person",)
    with pytest.raises(InputError, match="classes 0=person"):
        read_dataset(folder)
    with pytest.raises(InputError, match=r"0 \(1 boxes\)"):
        read_dataset(folder, classes={"person": "person", "auto": "car"})


def test_a_yolo_folder_may_hold_pictures_of_nothing_only(tmp_path):
    labelled = read_dataset(yolo_folder(tmp_path, ""))
    assert labelled.classes == ("person", "car") and len(labelled.pictures[0].labels) == 0


def test_pixels_in_yolo_files_are_refused_and_one_slip_is_not(tmp_path):
    with pytest.raises(InputError, match="shares"):
        read_dataset(yolo_folder(tmp_path / "pixels", "0 90 40 20 20\n"), form="yolo")
    labelled = read_dataset(
        yolo_folder(tmp_path / "slip", "0 0.5 0.5 0.1 0.1\n0 0.5 0.6 0.1 0.1\n0 5 5 1 1\n")
    )
    assert len(labelled.pictures[0].labels) == 2 and notices(labelled) == {"outside_boxes": 1}


# COCO


def test_coco_boxes_crowds_groups_and_sampling_distance(tmp_path):
    put.put_picture(tmp_path / "images" / "x.jpg")
    path = put.put_coco(
        tmp_path / "boxes.json",
        ["x.jpg"],
        [(0, 7, 10, 20, 30, 40, 0), (0, 1, 0, 0, 50, 50, 1), (0, 8, 1, 1, 5, 5, 0)],
        video_id=12,
        m_per_px=0.05,
    )
    for place in (path, tmp_path):
        labelled = read_dataset(place, unlabelled=("small object",))
        (picture,) = labelled.pictures
        assert labelled.classes == ("person", "car") and labelled.unlabelled == {"small object"}
        assert put.edges(picture.boxes_px) == [[10, 20, 40, 60]] and picture.labels.tolist() == [1]
        assert put.edges(picture.ignored_px) == [[0, 0, 50, 50]]
        assert picture.group == "12" and picture.m_per_px == 0.05
        assert notices(labelled) == {"unmapped_classes": 1}


@pytest.mark.parametrize(
    "labels, picture",
    [
        ("annotations/instances_train.json", "train/p.jpg"),
        ("annotations/val.json", "images/val/p.jpg"),
        ("train/_annotations.coco.json", "train/p.jpg"),
        ("boxes.json", "somewhere/deep/p.jpg"),
        ("truth/flight2/boxes.json", "flight2/photos/p.jpg"),
        ("labels.json", "p.jpg"),
    ],
)
def test_coco_pictures_are_found_where_tools_put_them(tmp_path, labels, picture):
    put.put_picture(tmp_path / picture)
    path = put.put_coco(tmp_path / labels, ["p.jpg"], [(0, 1, 1, 2, 3, 4, 0)])
    for place in (path, tmp_path):
        (found,) = read_dataset(place).pictures
        assert Path(found.path).samefile(tmp_path / picture)


def test_coco_of_a_video_asks_for_its_frames(tmp_path):
    put.put_text(tmp_path / "flight1" / "flight1.mp4", "")
    path = put.put_coco(
        tmp_path / "truth" / "flight1" / "boxes.json",
        ["flight1_000003.png"],
        [(0, 1, 1, 2, 3, 4, 0)],
    )
    with pytest.raises(InputError, match=r"video \(flight1.mp4\).*extract"):
        read_dataset(path)


def test_coco_missing_pictures_are_counted_and_none_left_is_an_error(tmp_path):
    put.put_picture(tmp_path / "a.jpg")
    boxes = [(0, 1, 1, 2, 3, 4, 0), (1, 1, 1, 2, 3, 4, 0), (5, 1, 1, 2, 3, 4, 0)]
    labelled = read_dataset(put.put_coco(tmp_path / "some.json", ["a.jpg", "gone.jpg"], boxes))
    assert len(labelled) == 1 and notices(labelled) == {"labels_without_picture": 2}
    lonely = tmp_path / "lonely"
    with pytest.raises(InputError, match="none of its 1 pictures is there"):
        read_dataset(put.put_coco(lonely / "all.json", ["gone.jpg"], []))


@pytest.mark.parametrize(
    "name", ["../secret.jpg", "images/../../secret.jpg", "{}/secret.jpg", "C:/secret.jpg"]
)
def test_coco_names_that_lead_out_of_the_set_are_refused(tmp_path, name):
    put.put_picture(tmp_path / "secret.jpg")
    put.put_picture(tmp_path / "set" / "a.jpg")
    path = put.put_coco(
        tmp_path / "set" / "c.json", ["a.jpg", name.format(tmp_path)], [(0, 1, 1, 2, 3, 4, 0)]
    )
    with pytest.raises(InputError, match=r"leads out of the set; needed are names below"):
        read_dataset(path)


@pytest.mark.parametrize(
    ("share", "how"), [(0.35, "breaks off"), (0.8, "breaks off"), (1.0, "is damaged")]
)
def test_coco_that_breaks_off_is_reported_with_file_and_place(tmp_path, share, how):
    put.put_picture(tmp_path / "a.jpg")
    path = put.put_coco(tmp_path / "cut.json", ["a.jpg"], [(0, 1, 1, 2, 3, 4, 0)] * 9)
    text = path.read_text()
    path.write_text(text[: int(share * len(text))] if share < 1 else text.replace("[", "[,", 1))
    for place in (path, tmp_path):
        with pytest.raises(
            InputError,
            match=rf"cut\.json {how} at line 1, column \d+ \(character \d+ of \d+: .*again",
        ):
            read_dataset(place)


def test_names_that_nothing_has_are_refused_over_all_sets_together(tmp_path):
    one = yolo_folder(tmp_path / "one", "0 0.5 0.5 0.1 0.2\n")
    two = yolo_folder(tmp_path / "two", "0 0.5 0.5 0.1 0.2\n", names="person\nBicycle\n")
    read = read_datasets(
        [one, two], ignore=["bicycle", "CAR"], unlabelled=["small object", "boat"], known=["boat"]
    )
    assert [each.name for each in read] == ["one", "two"] and read[0].unlabelled == {
        "small object",
        "boat",
    }
    with pytest.raises(
        SettingsError, match="ignore: 'Bicycl' is no name in the labels; there are: person, car, Bi"
    ):
        read_datasets([one, two], ignore=["car", "Bicycl"])
    with pytest.raises(
        SettingsError,
        match="unlabelled: 'People' is no class; there are: person, car, small object",
    ):
        read_datasets([one, two], unlabelled=["car", "People"])


def test_coco_listed_twice_is_one_picture_and_two_files_are_too_many(tmp_path):
    put.put_picture(tmp_path / "a.jpg")
    put.put_coco(
        tmp_path / "one.json", ["a.jpg", "a.jpg"], [(0, 1, 1, 2, 3, 4, 0), (1, 7, 5, 5, 9, 9, 0)]
    )
    labelled = read_dataset(tmp_path)
    assert len(labelled) == 1 and len(labelled.pictures[0].labels) == 2
    put.put_coco(tmp_path / "two.json", ["a.jpg"], [])
    with pytest.raises(InputError, match=r"2 COCO files \(one.json, two.json\)"):
        read_dataset(tmp_path)


def test_coco_scaled_labels_are_scaled_and_those_of_another_shape_left_out(tmp_path):
    put.put_picture(tmp_path / "half.jpg", 100, 50)
    put.put_picture(tmp_path / "square.jpg", 100, 100)
    path = put.put_coco(
        tmp_path / "c.json", ["half.jpg", "square.jpg"], [(0, 1, 20, 20, 40, 60, 0)]
    )
    labelled = read_dataset(path)
    assert put.edges(labelled.pictures[0].boxes_px) == [[10, 10, 30, 40]]
    assert notices(labelled) == {"scaled_labels": 1, "other_size": 1}


def test_simulated_pictures_read_as_they_were_written(tmp_path):
    from sorvolo.lab.simulation.pictures import PictureSettings, simulate_pictures

    wanted = PictureSettings(pictures=2, seed=4, ground="sand", empty_share=0, m_per_px=(0.08, 0.1))
    *_, last = simulate_pictures(tmp_path / "sim", wanted)
    labelled = read_dataset(tmp_path / "sim")
    assert labelled.classes == ("person", "car", "small object") and labelled.notices == ()
    assert sum(len(each.labels) for each in labelled.pictures) == last.boxes > 0
    assert len({each.group for each in labelled.pictures}) == 2


# VOC


def test_voc_counts_pixels_from_one_and_ignores_what_is_difficult(tmp_path):
    put.put_picture(tmp_path / "JPEGImages" / "v_001.jpg")
    put.put_picture(tmp_path / "JPEGImages" / "v_002.jpg")
    objects = [
        {"name": "Person", "box": (1, 1, 10, 20)},
        {"name": "car", "box": (31, 41, 60, 50), "difficult": 1},
    ]
    put.put_voc(tmp_path / "Annotations" / "v_001.xml", objects)
    for place in (tmp_path, tmp_path / "Annotations"):
        labelled = read_dataset(place)
        first, second = labelled.pictures
        assert put.edges(first.boxes_px) == [[0, 0, 10, 20]] and put.edges(first.ignored_px) == [
            [30, 40, 60, 50]
        ]
        assert len(second.labels) == 0 and notices(labelled) == {"pictures_without_labels": 1}


def test_voc_files_that_count_from_zero_are_read_so(tmp_path):
    for name, box in (("a_1", (0, 5, 10, 20)), ("a_2", (30, 40, 50, 60))):
        put.put_picture(tmp_path / f"{name}.jpg")
        put.put_voc(tmp_path / f"{name}.xml", [{"name": "car", "box": box}])
    labelled = read_dataset(tmp_path)
    assert [put.edges(each.boxes_px) for each in labelled.pictures] == [
        [[0, 5, 10, 20]],
        [[30, 40, 50, 60]],
    ]
    assert "counted_from_zero" in notices(labelled)


def test_voc_bombs_and_broken_files_are_counted(tmp_path):
    put.put_picture(tmp_path / "a_1.jpg")
    put.put_voc(
        tmp_path / "a_1.xml",
        [{"name": "car", "box": (2, 2, 9, 9)}, {"name": "car", "box": (2, 2, 9, "x")}],
    )
    put.put_text(tmp_path / "a_2.xml", "<annotation><object>")
    bomb = '<!DOCTYPE x [<!ENTITY a "aaa"><!ENTITY b "&a;&a;">]><annotation>&b;</annotation>'
    put.put_text(tmp_path / "a_3.xml", bomb)
    labelled = read_dataset(tmp_path)
    assert notices(labelled) == {"malformed_labels": 3} and len(labelled.pictures[0].labels) == 1


# VisDrone


def test_visdrone_pictures(tmp_path):
    put.put_picture(tmp_path / "images" / "0000002_00005_d_0000014.jpg")
    put.put_text(
        tmp_path / "annotations" / "0000002_00005_d_0000014.txt",
        "10,20,5,8,1,1,0,0\n30,20,4,8,1,2,0,2\n60,20,40,20,1,4,1,0,\n0,0,50,10,0,0,0,0\n90,60,9,9,1,11,0,0\n"
        "100,60,20,20,1,9,0,0\n150,60,20,20,1,6,0,0\n",
    )
    labelled = read_dataset(
        tmp_path, classes={"pedestrian": "person", "people": "person", "car": "car", "bus": "car"}
    )
    (picture,) = labelled.pictures
    assert put.edges(picture.boxes_px) == [
        [10, 20, 15, 28],
        [30, 20, 34, 28],
        [60, 20, 100, 40],
        [100, 60, 120, 80],
    ]
    assert picture.labels.tolist() == [0, 0, 1, 1]
    assert put.edges(picture.ignored_px) == [[0, 0, 50, 10], [90, 60, 99, 69]]
    assert picture.group == "0000002" and notices(labelled) == {"unmapped_classes": 1}


def test_visdrone_videos(tmp_path):
    for number in (1, 2):
        put.put_picture(tmp_path / "sequences" / "uav7_v" / f"{number:07d}.jpg")
    put.put_text(
        tmp_path / "annotations" / "uav7_v.txt",
        "1,0,10,20,5,8,1,1,0,0\n1,1,50,20,5,8,1,4,0,0\n9,0,1,1,5,5,1,1,0,0\n",
    )
    labelled = read_dataset(tmp_path)
    assert [len(each.labels) for each in labelled.pictures] == [2, 0]
    assert {each.group for each in labelled.pictures} == {"uav7_v"}
    assert notices(labelled) == {"labels_without_picture": 1}


# Okutama-Action


def test_okutama_is_scaled_from_the_original_and_lost_people_are_left_out(tmp_path):
    for number in (0, 1, 2):
        put.put_picture(tmp_path / "Drone1" / "1.1.1" / f"{number}.jpg", 1280, 720)
    lines = (
        '0 1200 600 1260 720 0 0 0 0 "Person" "Walking"\n'
        '1 3000 300 3060 360 0 1 0 1 "Person"\n'
        '0 1203 600 1263 720 1 0 1 1 "Person" "Walking" "Carrying"\n'
        '0 1203 600 1263 720 77 0 0 1 "Person"\n'
    )
    for kind in ("MultiActionLabels", "SingleActionLabels"):
        put.put_text(tmp_path / "Labels" / kind / "3840x2160" / "1.1.1.txt", lines)
    labelled = read_dataset(tmp_path)
    assert [put.edges(each.boxes_px) for each in labelled.pictures] == [
        [[400, 200, 420, 240]],
        [[401, 200, 421, 240]],
        [],
    ]
    assert {each.group for each in labelled.pictures} == {"1.1.1"} and labelled.classes == (
        "person",
    )
    assert notices(labelled) == {"labels_without_picture": 1, "scaled_labels": 3}


def test_okutama_without_frames_shows_how_to_lay_them(tmp_path):
    put.put_text(tmp_path / "1.1.1.txt", '0 1200 600 1260 720 0 0 0 0 "Person"\n')
    put.put_picture(tmp_path / "other" / "0.jpg")
    with pytest.raises(InputError, match=r"1\.1\.1/000123\.jpg"):
        read_dataset(tmp_path)


# UMCD


UMCD = """Video: path1.mp4
Fps: 25

Object 1
Type: Tire
Shape: round
Dimension: 60 x 60 cm
Color: complementary range
Movement: static object
Appearance: 02 to 04
Box: 75 10 20 30 30

Object 2: Person
Dimension: 170
Movement: moving person
Appearance: 10 to 12
"""


def test_umcd_frames_without_objects_are_negatives_and_unplaced_ones_ignored(tmp_path):
    put.put_text(tmp_path / "path1.txt", UMCD)
    for number in (0, 75, 80, 200, 275):  # 0, 3, 3.2, 8 and 11 s
        put.put_picture(tmp_path / "path1" / f"{number:06d}.png")
    labelled = read_dataset(tmp_path)
    whole = [[0, 0, 200, 100]]
    assert labelled.classes == ("person", "small object")
    assert [put.edges(each.ignored_px) for each in labelled.pictures] == [[], [], whole, [], whole]
    assert put.edges(labelled.pictures[1].boxes_px) == [[10, 20, 40, 50]]
    assert labelled.classes[labelled.pictures[1].labels[0]] == "small object"
    assert notices(labelled) == {"no_boxes_for_frame": 2}


def test_umcd_without_places_or_frame_rate_is_of_no_use(tmp_path):
    put.put_picture(tmp_path / "path1_000075.png")
    put.put_text(tmp_path / "path1.txt", UMCD.replace("Box: 75 10 20 30 30\n", ""))
    with pytest.raises(InputError, match="not where"):
        read_dataset(tmp_path)
    put.put_text(tmp_path / "path1.txt", UMCD.replace("Fps: 25", ""))
    with pytest.raises(InputError, match="Fps: 25"):
        read_dataset(tmp_path)


# What goes wrong, whatever the form


def test_boxes_beyond_the_picture_are_clipped_dropped_and_counted(tmp_path):
    put.put_picture(tmp_path / "a.jpg")
    boxes = [
        (0, 1, -10, 20, 30, 40, 0),
        (0, 1, 199, 10, 40, 10, 0),
        (0, 1, 300, 300, 5, 5, 0),
        (0, 1, 5, 5, 0, 9, 0),
        (0, 1, 50, 50, -5, 9, 0),
        (0, 1, 100, 50, 10, 50.4, 0),
    ]
    labelled = read_dataset(put.put_coco(tmp_path / "c.json", ["a.jpg"], boxes))
    assert put.edges(labelled.pictures[0].boxes_px) == [[0, 20, 20, 60], [100, 50, 110, 100]]
    assert notices(labelled) == {"clipped_boxes": 1, "outside_boxes": 2, "empty_boxes": 2}


def test_ignored_names_become_regions_whatever_their_case(tmp_path):
    boxes = "0 0.5 0.5 0.1 0.2\n1 0.2 0.2 0.1 0.2\n2 0.8 0.8 0.1 0.2\n"
    folder = yolo_folder(tmp_path, boxes, "Person\nDONT_CARE\nvan\n")
    labelled = read_dataset(folder, classes={"PERSON": "person"}, ignore=("dont care",))
    assert put.edges(labelled.pictures[0].ignored_px) == [
        [30, 10, 50, 30]
    ] and labelled.classes == ("person",)
    assert notices(labelled) == {"unmapped_classes": 1}
    usual = read_dataset(folder, ignore=("van",))
    assert usual.classes == ("person",) and len(usual.pictures[0].ignored_px) == 2


def test_names_of_nothing_known_are_an_error_that_lists_them(tmp_path):
    with pytest.raises(InputError, match=r"boat \(1 boxes\), buoy \(0 boxes\)"):
        read_dataset(yolo_folder(tmp_path, "0 0.5 0.5 0.1 0.2\n", "boat\nbuoy\n"))


def test_pictures_without_labels_and_labels_without_pictures_are_counted(tmp_path):
    yolo_folder(tmp_path, "0 0.5 0.5 0.1 0.2\nnonsense\n0 nan 1 1 1\n")
    put.put_picture(tmp_path / "images" / "a_2.jpg")
    put.put_text(tmp_path / "labels" / "a_9.txt", "0 0.5 0.5 0.1 0.2\n")
    put.put_text(tmp_path / "images" / "a_3.jpg", "no picture")
    put.put_text(tmp_path / "labels" / "a_3.txt", "")
    labelled = read_dataset(tmp_path)
    assert [len(each.labels) for each in labelled.pictures] == [1, 0]
    assert notices(labelled) == {
        "malformed_labels": 2,
        "pictures_without_labels": 1,
        "labels_without_picture": 1,
        "unreadable_pictures": 1,
    }


@pytest.mark.parametrize("mode", ["L", "I;16", "RGBA", "1", "CMYK"])
def test_any_kind_of_picture_will_do(tmp_path, mode):
    ending = "tif" if mode == "CMYK" else "png"
    yolo_folder(tmp_path, "0 0.5 0.5 0.1 0.2\n")
    put.put_picture(tmp_path / "images" / f"b_2.{ending}", 64, 32, mode=mode)
    assert [each.width_px for each in read_dataset(tmp_path).pictures] == [200, 64]


def test_sizes_and_boxes_are_those_of_the_picture_as_shown(tmp_path):
    put.put_picture(
        tmp_path / "a.jpg", orientation=6
    )  # stored 200x100, shown 100x200 after a clockwise turn
    path = put.put_coco(tmp_path / "c.json", ["a.jpg"], [(0, 1, 10, 20, 30, 40, 0)])
    (picture,) = read_dataset(path).pictures
    assert (picture.width_px, picture.height_px) == (100, 200)
    assert put.edges(picture.boxes_px) == [[40, 10, 80, 40]]


@pytest.mark.parametrize("orientation", [5, 6, 7, 8])
def test_a_turned_box_is_where_the_turned_picture_shows_it(orientation):
    import numpy as np
    from PIL import Image, ImageOps

    mask = np.zeros((10, 20), np.uint8)
    mask[2:5, 3:9] = 255
    picture = Image.fromarray(mask)
    picture.getexif()[0x0112] = orientation
    y, x = np.nonzero(np.asarray(ImageOps.exif_transpose(picture)))
    box = turned(np.array([[3.0, 2, 9, 5]]), (20.0, 10.0), orientation)[0]
    assert box.tolist() == [x.min(), y.min(), x.max() + 1, y.max() + 1]


def test_what_is_no_set_of_labelled_pictures_is_refused(tmp_path):
    with pytest.raises(InputError, match="does not exist"):
        read_dataset(tmp_path / "nowhere")
    with pytest.raises(InputError, match="holds no pictures"):
        read_dataset(tmp_path)
    picture = put.put_picture(tmp_path / "a.jpg")
    with pytest.raises(InputError, match="no label file of a known form"):
        read_dataset(picture)
    with pytest.raises(InputError, match="none of its 1 pictures has a label file"):
        read_dataset(tmp_path)
    with pytest.raises(SettingsError, match="choose one of coco, yolo"):
        read_dataset(tmp_path, form="yolov9")
    for pattern in ("(", "no group", "(two)(groups)"):
        with pytest.raises(SettingsError, match="group pattern"):
            read_dataset(tmp_path, group_pattern=pattern)


def test_the_wrong_form_names_the_right_one(tmp_path):
    put.put_picture(tmp_path / "images" / "a.jpg")
    put.put_text(tmp_path / "annotations" / "a.txt", "10,20,5,8,1,1,0,0\n")
    with pytest.raises(InputError, match="looks like visdrone"):
        read_dataset(tmp_path, form="voc")
    yolo = yolo_folder(tmp_path / "other", "0 0.5 0.5 0.1 0.2\n")
    for form in set(READERS) - {"yolo"}:
        with pytest.raises(InputError, match="looks like yolo"):
            read_dataset(yolo, form=form)


# Groups and names


@pytest.mark.parametrize(
    "path, group",
    [
        ("images/0_35.jpg", "0"),
        ("images/Drone2_(90).jpg", "Drone2"),
        ("1_130_40_0_03855.jpg", "1_130_40_0"),
        ("bb_V0014_I0003160_jpg.rf.0a6bf9c5d2.jpg", "bb_V0014"),
        ("flight1/photos/DJI_0031.JPG", "flight1/DJI"),
        ("sequences/uav1/0000001.jpg", "uav1"),
        ("clip7/frame_000031.png", "clip7"),
        ("lonely.jpg", "lonely"),
        ("train/0001.jpg", "set"),
        ("google_P000_aZk5uQM_jpg.rf.12ab.jpg", "google_P000_aZk5uQM"),
        ("baidu_timg-17-.jpg", "baidu_timg"),
        ("site5 (12).jpg", "site5"),
    ],
)
def test_a_picture_s_video_is_recognised_by_its_name(tmp_path, path, group):
    place = tmp_path / "set"
    put.put_picture(place / path)
    assert group_of(place / path, place) == group


def test_a_group_pattern_is_the_user_s_own_rule(tmp_path):
    put.put_picture(tmp_path / "day2" / "a_7.jpg")
    put.put_picture(tmp_path / "b_8.jpg")
    path = put.put_coco(
        tmp_path / "c.json", ["day2/a_7.jpg", "b_8.jpg"], [(0, 1, 1, 1, 5, 5, 0)], flight="f"
    )
    groups = [each.group for each in read_dataset(path, group_pattern="^(day[0-9]+)/").pictures]
    assert groups == ["day2", "b"]


# Damaged files never end in anything but a counted label or a clear error


@FUZZ
@given(data=st.binary(max_size=200), form=st.sampled_from(sorted(READERS)))
def test_any_bytes_give_labels_or_a_clear_error(tmp_path, data, form):
    endings = {"coco": "json", "voc": "xml"}
    put.put_picture(tmp_path / "a_1.png", 8, 8)
    path = tmp_path / f"a_1.{endings.get(form, 'txt')}"
    path.write_bytes(data)
    for place in (path, tmp_path):
        try:
            read_dataset(place, form=form, classes={"0": "car", "car": "car", "Person": "person"})
        except SorvoloError as error:
            assert len(str(error)) > 20
    path.unlink()


KEYS = st.sampled_from(
    [
        "id",
        "image_id",
        "category_id",
        "bbox",
        "segmentation",
        "file_name",
        "name",
        "width",
        "height",
    ]
)
JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=4),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(KEYS, inner, max_size=4),
    max_leaves=8,
)
NUMBERS = st.lists(st.integers(-9, 20) | st.floats(), min_size=4, max_size=4)
ROWS = st.dictionaries(
    KEYS, JSON | st.sampled_from([1, "a_1.png", "car", "x" * 300, "a\0b"]) | NUMBERS, max_size=5
)


@FUZZ
@given(rows=st.tuples(*[st.lists(ROWS, max_size=2)] * 3) | st.tuples(JSON, JSON, JSON))
def test_any_json_gives_labels_or_a_clear_error(tmp_path, rows):
    put.put_picture(tmp_path / "a_1.png", 8, 8)
    good = {
        "images": {"id": 0, "file_name": "a_1.png"},
        "annotations": {},
        "categories": {"id": 0, "name": "car"},
    }
    whole = {
        key: [value, *row] if isinstance(row, list) else row
        for (key, value), row in zip(good.items(), rows)
    }
    path = put.put_text(tmp_path / "c.json", json.dumps(whole))
    try:
        labelled = read_dataset(path)
    except SorvoloError as error:
        assert len(str(error)) > 20
    else:
        demand_within(labelled.pictures[0].boxes_px, 8)


def demand_within(boxes, side_px):
    assert (boxes >= 0).all() and (boxes <= side_px).all() and (boxes[:, 2:] >= boxes[:, :2]).all()


WORDS = st.sampled_from(
    [
        "0",
        "1",
        "-5",
        "3840",
        "1e400",
        "1e308",
        "9" * 320,
        "nan",
        '"Person"',
        "Person",
        ",",
        "0.5",
        "Type:",
        "Box:",
        "\n",
        " ",
        "0 0.5 0.5 0.2 0.3",
        "1,2,3,4,1,1,0,0",
        '0 1 2 3 4 1 0 0 0 "Person"',
        "1e308 1e308",
        "Appearance:",
    ]
)


@FUZZ
@given(
    words=st.lists(WORDS, max_size=40),
    form=st.sampled_from(["yolo", "visdrone", "okutama", "umcd"]),
)
def test_any_words_give_boxes_within_the_picture_or_a_clear_error(tmp_path, words, form):
    put.put_picture(tmp_path / "v_1.png", 8, 8)
    path = put.put_text(tmp_path / "v_1.txt", " ".join(words))
    video = put.put_text(tmp_path / "v.txt", " ".join(words))
    try:
        labelled = read_dataset(
            tmp_path, form=form, classes={"0": "car", "Person": "person", "pedestrian": "person"}
        )
    except SorvoloError as error:
        assert len(str(error)) > 20
    else:
        for boxes in (labelled.pictures[0].boxes_px, labelled.pictures[0].ignored_px):
            demand_within(boxes, 8)
    path.unlink()
    video.unlink()


@given(
    names=st.lists(
        st.text("abc XY-é", min_size=1, max_size=6).map(str.strip).filter(bool),
        min_size=1,
        max_size=5,
    )
)
def test_names_in_yaml_come_back_in_each_way_of_writing(names):
    quoted = [f"'{name}'" for name in names]
    for text in (
        f"path: x\nnames: [{', '.join(quoted)}]\nnc: 3\n",
        "names:\n" + "".join(f"- {name}\n" for name in quoted),
        "names:\n"
        + "".join(f"  {number}: {name}\n" for number, name in enumerate(quoted))
        + "nc: 2\n",
    ):
        assert names_in_yaml(text) == names


# Real sets


@pytest.mark.parametrize(
    "name, options, expected",
    [
        ("hituav", {}, {"person": 9349, "car": 6068}),
        (
            "aerial_cars",
            {"classes": {"car": "car", "truck": "car", "minibus": "car"}},
            {"car": 935},
        ),
        ("cats", {"classes": {"0": "car"}}, {"car": 1395}),
        ("mannequin", {"classes": {"0": "person"}}, {"person": 131}),
        ("tinyperson", {"classes": {"0": "person"}}, {"person": 9872}),
        ("sdd", {}, {"person": 89, "car": 1}),
    ],
)
def test_the_real_sets_have_the_boxes_that_their_files_list(name, options, expected):
    labelled = read_dataset(real_data(f"detection/{name}"), **options)
    found = Counter(labelled.classes[label] for each in labelled.pictures for label in each.labels)
    assert found == expected
    assert all(os.path.isfile(each.path) for each in labelled.pictures)


def test_a_line_with_a_control_character_is_no_label(tmp_path):
    put.put_picture(tmp_path / "images" / "a.jpg")
    lines = "1,2,9,9,1,1,0,0\n1,2,9,9,1,1\x1f,0,0\n"
    put.put_text(tmp_path / "annotations" / "a.txt", lines)
    labelled = read_dataset(tmp_path)
    assert notices(labelled)["malformed_labels"] == 1 and len(labelled.pictures[0].labels) == 1
