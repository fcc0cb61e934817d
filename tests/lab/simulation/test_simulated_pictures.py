"""Single simulated pictures: the truth fits what is drawn, everything follows from the seed, folders are whole."""

import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from sorvolo.errors import SettingsError
from sorvolo.lab.simulation.pictures import (
    SMALLEST_PX,
    PictureSettings,
    simulate_picture,
    simulate_pictures,
)

SETTINGS = PictureSettings(
    seed=11, empty_share=0.0, m_per_px=(0.04, 0.1), height_m=(15.0, 60.0), ground="sand"
)


def test_a_picture_follows_from_seed_and_index_alone():
    one, again, other = (simulate_picture(SETTINGS, index) for index in (3, 3, 4))
    assert np.array_equal(one.image, again.image) and one.boxes == again.boxes
    fewer = simulate_picture(replace(SETTINGS, pictures=7), 3)
    assert np.array_equal(one.image, fewer.image)
    assert one.image.shape != other.image.shape or not np.array_equal(one.image, other.image)


def test_boxes_lie_in_the_picture_and_cars_have_a_car_s_size():
    cars_m = []
    for index in range(4):
        picture = simulate_picture(replace(SETTINGS, tilt_deg=0.0), index)
        height, width = picture.image.shape[:2]
        for box in picture.boxes:
            x, y, w, h = box["bbox"]
            assert x >= 0 and y >= 0 and x + w <= width and y + h <= height
            assert box["iscrowd"] == (max(w, h) < SMALLEST_PX or box["visibility"] < 0.3)
            inside = x > 0 and y > 0 and x + w < width and y + h < height
            if box["category_id"] == 2 and inside and box["visibility"] == 1:
                cars_m.append(max(w, h) * picture.m_per_px)
    assert len(cars_m) >= 2
    assert (
        min(cars_m) > 2.6 and max(cars_m) < 6.8
    )  # 4.0 to 5.2 m long, seen at any heading, some from the side


@pytest.mark.long
def test_heights_and_ground_sampling_distances_keep_their_bounds():
    for index in range(6):
        picture = simulate_picture(SETTINGS, index)
        assert 0.04 <= picture.m_per_px <= 0.1 * 1.01
        assert 15 <= picture.site_from_camera.translation_m[2] <= 60


@pytest.mark.long
def test_people_stand_out_in_thermal_pictures_which_are_grey():
    settings = replace(SETTINGS, thermal_share=1.0)
    found = 0
    for index in range(8):
        picture = simulate_picture(settings, index)
        assert picture.is_thermal
        assert np.array_equal(picture.image[..., 0], picture.image[..., 2])
        grey = picture.image[..., 0].astype(float)
        for box in picture.boxes:
            x, y, w, h = box["bbox"]
            if box["category_id"] == 1 and box["visibility"] == 1 and min(w, h) >= 6:
                inside = np.median(grey[y + h // 3 : y + h - h // 3, x + w // 3 : x + w - w // 3])
                found += abs(inside - np.median(grey)) > 1.5 * grey.std()
    assert found >= 4


def test_the_folder_is_coco_and_only_a_simulation_is_replaced(tmp_path):
    folder = tmp_path / "labelled"
    steps = list(simulate_pictures(folder, replace(SETTINGS, pictures=2)))
    assert [step.pictures_done for step in steps] == [1, 2]
    truth = json.loads((folder / "boxes.json").read_text())
    assert [path.suffix for path in folder.iterdir() if path.is_file()] == [".json"]
    assert len({image["flight"] for image in truth["images"]}) == 2
    ids = [row["id"] for row in truth["annotations"]]
    assert ids == list(range(1, len(ids) + 1))
    assert {row["image_id"] for row in truth["annotations"]} <= {
        image["id"] for image in truth["images"]
    }
    assert steps[-1].boxes == sum(1 - row["iscrowd"] for row in truth["annotations"])
    for image in truth["images"]:
        assert Image.open(folder / image["file_name"]).size == (image["width"], image["height"])
    list(simulate_pictures(folder, replace(SETTINGS, pictures=1)))
    assert len(list((folder / "images").iterdir())) == 1
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "holiday.jpg").write_bytes(b"x")
    with pytest.raises(SettingsError, match="no earlier simulation"):
        list(simulate_pictures(tmp_path / "mine", SETTINGS))


def test_settings_out_of_bounds_are_named():
    with pytest.raises(SettingsError, match="thermal_share"):
        PictureSettings(thermal_share=2.0)
    with pytest.raises(SettingsError, match="unknown ground 'moon'"):
        PictureSettings(ground="moon")
