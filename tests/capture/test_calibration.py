"""Camera files in every dialect, broken ones, presets, EXIF and the honest guess."""

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from PIL import Image

from real_data import real_data
from sorvolo.capture.calibration import camera_from_option, camera_xml, guess_camera, read_camera
from sorvolo.capture.camera_presets import _SOLD_AS, CAMERA_PRESETS, find_presets
from sorvolo.errors import InputError
from sorvolo.geometry.camera import Camera

LENS = np.array([-0.2, 0.1, 0.001, -0.002, -0.03])  # k1 k2 p1 p2 k3
CAMERA = Camera(1920, 1080, 1500.0, 1501.5, 955.25, 541.0, LENS)


SIZE = "<image_width>1920</image_width><image_height>1080</image_height>"


def xml(
    matrix="1500 0 955.25 0 1501.5 541 0 0 1",
    distortion="-0.2 0.1 0.001 -0.002 -0.03",
    extra="",
    name="distortion_coefficients",
    size=SIZE,
):
    count = len(distortion.split())
    return (
        f'<?xml version="1.0"?><opencv_storage>{size}<camera_matrix type_id="opencv-matrix"><rows>3</rows>'
        f"<cols>3</cols><dt>d</dt><data>{matrix}</data></camera_matrix>{extra}"
        f'<{name} type_id="opencv-matrix"><rows>{count}</rows><cols>1</cols><dt>d</dt>'
        f"<data>{distortion}</data></{name}></opencv_storage>"
    )


@pytest.fixture
def read(tmp_path):
    def read_text(text, width_px=1920, height_px=1080, name="camera.xml"):
        path = tmp_path / name
        path.write_text(text)
        return read_camera(path, width_px, height_px)

    return read_text


def assert_same(camera, expected):
    np.testing.assert_allclose(camera.matrix, expected.matrix)
    np.testing.assert_allclose(camera.distortion, expected.distortion)
    assert (camera.width_px, camera.height_px) == (expected.width_px, expected.height_px)


def test_our_own_file_is_opencvs_too(tmp_path):
    path = tmp_path / "camera.xml"
    path.write_text(camera_xml(CAMERA, reprojection_error_px=0.21, views=17, focal_sigma=0.0021))
    model = read_camera(path, 1920, 1080)
    assert_same(model.camera, CAMERA)
    assert model.focal_sigma == pytest.approx(0.0021)
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    np.testing.assert_array_equal(storage.getNode("camera_matrix").mat(), CAMERA.matrix)
    np.testing.assert_array_equal(storage.getNode("distortion_coefficients").mat().ravel(), LENS)
    assert storage.getNode("image_width").real() == 1920
    assert storage.getNode("distortion_order").string() == "k1 k2 p1 p2 k3"
    assert storage.getNode("avg_reprojection_error").real() == pytest.approx(0.21)


@pytest.mark.parametrize("ending", ["xml", "yaml"])
@pytest.mark.parametrize(
    "names",
    [
        ("camera_matrix", "distortion_coefficients", "image_width", "image_height"),
        ("Camera_Matrix", "Distortion_Coefficients", "image_Width", "image_Height"),
        ("cameraMatrix", "distCoeffs", "imageWidth", "imageHeight"),
        ("K", "D", "width", "height"),
        ("M1", "D1", "img_width", "img_height"),
    ],
)
def test_opencvs_own_files(tmp_path, ending, names):
    path = tmp_path / f"camera.{ending}"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in zip(names, (CAMERA.matrix, LENS.reshape(1, 5), 1920, 1080)):
        storage.write(name, value)
    storage.write("calibration_time", "Mon 05 Oct 2015")
    storage.release()
    model = read_camera(path, 1920, 1080)
    assert_same(model.camera, CAMERA)
    assert "k1 k2 p1 p2 k3" in model.origin


def test_ros_yaml(read):
    text = """image_width: 1920
image_height: 1080
camera_name: belly
camera_matrix:
  rows: 3
  cols: 3
  data: [1500.0, 0.0, 955.25, 0.0, 1501.5, 541.0,
         0.0, 0.0, 1.0]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.2, 0.1, 0.001, -0.002, -0.03]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
"""
    assert_same(read(text, name="camera.yaml").camera, CAMERA)


def test_the_datasets_order_when_the_file_names_it(read):
    order = "<distortion_order>k1 k2 k3 p1 p2</distortion_order>"
    model = read(xml(distortion="-0.2 0.1 -0.03 0.001 -0.002", extra=order))
    assert_same(model.camera, CAMERA)
    assert "as the file states" in model.origin


def test_the_datasets_order_is_seen_from_the_numbers(read):
    model = read(xml(distortion="-0.2 0.1 -0.03 0.001 -0.002"))
    assert_same(model.camera, CAMERA)
    assert "k1 k2 k3 p1 p2" in model.origin
    assert "can only be k3" in model.origin


def test_an_order_that_numbers_do_not_show_is_opencvs_and_is_named(read):
    model = read(xml(distortion="-0.2 0.1 0.001 -0.002 0.003"))
    np.testing.assert_allclose(model.camera.distortion, [-0.2, 0.1, 0.001, -0.002, 0.003])
    assert "assumed" in model.origin


def test_single_nodes_need_no_order(read):
    nodes = "<k1>-0.2</k1><k2>0.1</k2><k3>-0.03</k3><p1>0.001</p1><p2>-0.002</p2>"
    assert_same(read(xml(extra=nodes, name="other")).camera, CAMERA)


def test_four_coefficients_have_no_k3(read):
    np.testing.assert_allclose(
        read(xml(distortion="-0.2 0.1 0.001 -0.002")).camera.distortion,
        [-0.2, 0.1, 0.001, -0.002, 0],
    )


def test_more_coefficients_are_fine_if_they_are_zero(read):
    assert_same(read(xml(distortion="-0.2 0.1 0.001 -0.002 -0.03 0 0 0")).camera, CAMERA)


def test_another_size_of_the_same_shape_is_resized_and_named(read):
    model = read(xml(), 1280, 720)
    assert_same(model.camera, CAMERA.resized(1280, 720))
    assert "resized from 1920x1080" in model.origin
    assert model.focal_sigma > read(xml()).focal_sigma


def test_another_shape_is_refused_with_both_sizes(read):
    with pytest.raises(InputError, match=r"1920x1080.*4000x3000"):
        read(xml(), 4000, 3000)


def test_a_file_without_size_is_judged_by_its_optical_centre(read):
    assert_same(read(xml(size="")).camera, CAMERA)
    assert "no image size in it" in read(xml(size="")).origin
    with pytest.raises(InputError, match="add image_width"):
        read(xml(size=""), 3840, 2160)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "empty"),
        ("   \n", "empty"),
        ("hello world", "not a camera file"),
        ("<opencv_storage><camera_matrix>", "broken XML"),
        ("<a><b>1</b></a>", "no camera matrix"),
        ("fx: 100\nfy: 100", "no camera matrix"),
        ('{"fx": 100, "fy": 100}', "neither XML nor YAML"),
        (xml(matrix="1500 0 955 0 1500 541"), "6"),
        (xml(matrix="nan 0 955 0 1500 541 0 0 1"), "no number"),
        (xml(matrix=".Nan 0 955 0 1500 541 0 0 1"), "no number"),
        (xml(matrix="0 0 955 0 1500 541 0 0 1"), "positive"),
        (xml(matrix="-1500 0 955 0 1500 541 0 0 1"), "positive"),
        (xml(matrix="1500 0 0 0 1500 0 955 541 1"), "transposed"),
        (xml(matrix="1500 0 955 0 1500 541 0 0 0"), "transposed"),
        (xml(matrix="1500 200 955 0 1500 541 0 0 1"), "skew"),
        (xml(matrix="1500 0 9550 0 1500 541 0 0 1"), "far outside"),
        (xml(matrix="a b c d e f g h i"), "has 0"),
        (xml().replace("<dt>d</dt>", "<dt>u</dt>"), "type 'u'"),
        (xml().replace("<dt>d</dt>", "<dt>2d</dt>"), "type '2d'"),
        (xml().replace("<cols>3</cols>", "<cols>-3</cols>"), "should hold"),
        (xml(distortion="-0.2 0.1 0.001 -0.002 -0.03 0.1 0.2 0.3"), "8 distortion coefficients"),
        (xml(distortion="-0.2 0.1 0.001"), "3 distortion coefficients"),
        (xml(distortion="-0.2 nan 0.001 0 0"), "no number"),
        (xml(distortion="-3 0 0 0 0"), "fold"),
        (xml(extra="<fisheye_model>1</fisheye_model>"), "fisheye"),
        (xml(extra="<distortion_model>equidistant</distortion_model>"), "equidistant"),
        (xml(extra="<distortion_order>k1 k2 k3 k4 k5</distortion_order>"), "does not name"),
        ('<!DOCTYPE a [<!ENTITY b "c">]><a><camera_matrix>&b;</camera_matrix></a>', "broken XML"),
    ],
)
def test_broken_files_state_what_is_wrong(read, text, message):
    with pytest.raises(InputError, match=message):
        read(text)


def test_files_that_are_none(tmp_path):
    with pytest.raises(InputError, match="cannot be read"):
        read_camera(tmp_path / "missing.xml", 640, 480)
    with pytest.raises(InputError, match="cannot be read"):
        read_camera(tmp_path, 640, 480)
    (tmp_path / "binary.xml").write_bytes(bytes(range(256)) * 10)
    with pytest.raises(InputError, match="not text"):
        read_camera(tmp_path / "binary.xml", 640, 480)
    (tmp_path / "huge.yml").write_bytes(b"a: 1\n" * 5_000_000)
    with pytest.raises(InputError, match="larger than"):
        read_camera(tmp_path / "huge.yml", 640, 480)


def test_fisheye_zero_is_opencvs_way_of_none(read):
    assert_same(read(xml(extra="<fisheye_model>0</fisheye_model>")).camera, CAMERA)


@settings(max_examples=120, deadline=None)
@given(st.data())
def test_damaged_files_are_read_or_refused_never_worse(tmp_path_factory, data):
    good = data.draw(
        st.sampled_from(
            [
                xml(),
                camera_xml(CAMERA, reprojection_error_px=0.2, views=9),
                "%YAML:1.0\n---\nK: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n"
                "   data: [ 1500., 0., 955., 0., 1500., 541., 0., 0., 1. ]\nimage_width: 1920\nimage_height: 1080\n",
            ]
        )
    ).encode()
    start = data.draw(st.integers(0, len(good)))
    end = data.draw(st.integers(start, min(len(good), start + 40)))
    damaged = good[:start] + data.draw(st.binary(max_size=12)) + good[end:]
    path = tmp_path_factory.getbasetemp() / "damaged.xml"
    path.write_bytes(damaged)
    try:
        camera = read_camera(path, 1920, 1080).camera
    except InputError:
        return
    assert (camera.width_px, camera.height_px) == (1920, 1080)
    assert np.isfinite(camera.rays_from_pixels(camera.corners_px)).all()


@given(st.text())
@example("[" * 2000)
@example('{"a":' * 2000)
def test_any_text_is_read_or_refused(tmp_path_factory, text):
    path = tmp_path_factory.getbasetemp() / "any.txt"
    path.write_text(text, errors="ignore")
    with pytest.raises(InputError):
        read_camera(path, 1920, 1080)


def test_full_names_of_drones_name_presets_that_there_are():
    for sold, preset in _SOLD_AS.items():
        assert find_presets(f"DJI {sold}") == find_presets(preset) != []


@pytest.mark.parametrize(
    "model",
    ["FC300S", "FC300S\0\0\0", "DJI FC300S", "fc300s", "DJI Phantom 3 Advanced"],
)
def test_presets_are_found_however_they_are_written(model):
    found = guess_camera(4000, 3000, make="DJI\0\0", model=model)
    assert "Phantom 3" in found.origin
    assert found.focal_sigma == 0.02
    assert found.camera.fx_px == pytest.approx(3.61 / 6.2 * 4000)


def test_a_wide_cut_uses_the_whole_width_of_the_sensor():
    photo = guess_camera(4000, 3000, model="FC300S").camera
    wide = guess_camera(4000, 2250, model="FC300S").camera
    assert wide.fx_px == wide.fy_px == photo.fx_px
    video = guess_camera(1920, 1080, model="FC300S")
    assert video.camera.fx_px == pytest.approx(photo.fx_px * 1920 / 4000)
    assert video.focal_sigma > 0.02
    assert "video" in video.origin
    # a square cut uses the whole height
    assert guess_camera(3000, 3000, model="FC300S").camera.fx_px == pytest.approx(
        3.61 / 4.65 * 3000
    )


def test_every_preset_is_a_camera_near_its_makers_angle_of_view():
    for preset in CAMERA_PRESETS:
        aspect = preset.sensor_width_mm / preset.sensor_height_mm
        assert aspect == pytest.approx(preset.width_px / preset.height_px, abs=0.03)
        camera = camera_from_option(preset.name, preset.width_px, preset.height_px).camera
        is_narrow = preset.name.endswith((" tele", " thermal"))
        assert (25 if is_narrow else 40) < camera.angle_of_view_deg[0] < (60 if is_narrow else 100)
        for code in preset.codes:
            assert preset in find_presets(code)


def test_every_preset_has_its_source_in_the_docs():
    page = (
        (Path(__file__).parents[2] / "docs" / "calibrate.md")
        .read_text()
        .partition("## Camera presets")[2]
    )
    words = " ".join(page.split())
    assert not [each.name for each in CAMERA_PRESETS if each.name not in words]


def test_skydios_cameras_are_as_skydio_calibrated_them():
    assert guess_camera(
        4056, 3040, make="Skydio", model="2", focal_length_mm=3.7
    ).camera.fx_px == pytest.approx(2376.6, rel=0.002)
    narrow = guess_camera(4624, 3472, make="Skydio", model="VT300-Z_50", focal_length_mm=9.88)
    assert (
        narrow.camera.fx_px == pytest.approx(6334.2, rel=0.002)
        and "Skydio X10 narrow" in narrow.origin
    )


def test_a_second_camera_under_the_same_name_is_not_taken_for_the_preset():
    zoom = guess_camera(
        4056, 3040, make="DJI", model="ZH20T", focal_length_mm=25.0, focal_length_35mm=120.0
    )
    assert "35 mm film" in zoom.origin


def test_a_lens_that_changes_is_taken_from_exif():
    long = guess_camera(8192, 5460, model="ZenmuseP1", focal_length_mm=50.0)
    assert long.camera.fx_px == pytest.approx(50 / 35.9 * 8192)
    unknown = guess_camera(8192, 5460, model="ZenmuseP1")
    assert "GUESS" in unknown.origin
    assert unknown.focal_sigma == 0.2


def test_exif_focal_plane_counts_pixels_of_the_photo_as_taken():
    found = guess_camera(
        2000,
        1500,
        make="Canon",
        model="Canon PowerShot SX260 HS",
        focal_length_mm=4.5,
        focal_plane_px_per_mm=16393.4426 / 25.4,
        full_width_px=4000,
    )
    assert found.camera.fx_px == pytest.approx(4.5 * 645.41 / 2, rel=1e-4)
    assert found.focal_sigma == 0.05
    assert "EXIF of the Canon PowerShot" in found.origin


def test_35_mm_equivalents_minding_the_wide_cut():
    photo = guess_camera(4000, 3000, focal_length_35mm=20.0).camera
    wide = guess_camera(4000, 2250, focal_length_35mm=20.0).camera
    assert photo.fx_px == pytest.approx(20 / 43.267 * 5000)
    assert wide.fx_px == pytest.approx(photo.fx_px)


def test_nothing_known_is_a_guess_that_states_what_to_do():
    found = guess_camera(640, 360)
    assert found.camera.angle_of_view_deg[0] == pytest.approx(70)
    assert found.focal_sigma == 0.2
    assert "GUESS" in found.origin
    assert "--camera" in found.origin
    assert "sorvolo calibrate" in found.origin


@given(*[st.one_of(st.just(math.nan), st.floats())] * 3, st.integers(-5, 9000))
def test_any_exif_gives_a_camera(focal, focal_35, plane, full_width):
    found = guess_camera(
        4000,
        3000,
        make="X",
        model="Y",
        focal_length_mm=focal,
        focal_length_35mm=focal_35,
        focal_plane_px_per_mm=plane,
        full_width_px=max(0, full_width),
    )
    assert 2.9 < found.camera.angle_of_view_deg[0] < 151


def test_the_camera_option(tmp_path):
    path = tmp_path / "my.xml"
    path.write_text(xml())
    assert_same(camera_from_option(str(path), 1920, 1080).camera, CAMERA)
    assert "Mavic 2 Pro" in camera_from_option("mavic 2 pro", 5472, 3648).origin
    assert camera_from_option("aov=78.8", 1920, 1080).camera.angle_of_view_deg[0] == pytest.approx(
        78.8
    )
    assert camera_from_option("focal_px=1234", 1920, 1080).camera.fx_px == 1234
    assert camera_from_option("focal_35mm=24", 4000, 3000).camera.fx_px == pytest.approx(
        24 / 43.267 * 5000
    )


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ("missing.xml", "no such camera file"),
        ("folder/thing", "no such camera file"),
        ("aov=0", "no lens"),
        ("aov=wide", "not a number"),
        ("focal_px=-3", "no lens"),
        ("focal_px=nan", "no lens"),
        ("focal_35mm=0", "no lens"),
        ("focal_35mm=inf", "no lens"),
        ("f=3", "key must be"),
        ("Concorde", "Mavic 2 Pro"),
        ("", "neither"),
    ],
)
def test_camera_options_that_mean_nothing(option, message):
    with pytest.raises(InputError, match=message):
        camera_from_option(option, 1920, 1080)


def test_a_real_phantom_3_photo_is_recognised():
    exif = Image.open(real_data("flights/brighton_beach/DJI_0018.JPG")).getexif()
    found = guess_camera(4000, 2250, make=exif[271], model=exif[272], focal_length_mm=3.61)
    assert "Phantom 3" in found.origin
    assert found.camera.fx_px == pytest.approx(2329, abs=1)


@pytest.mark.parametrize(
    ("model", "width_px", "height_px", "focal_mm", "name"),
    [
        ("M3T", 4000, 3000, 4.4, "Mavic 3T"),
        ("M3T", 640, 512, 9.1, "Mavic 3T thermal"),
        ("M3T", 640, 512, math.nan, "Mavic 3T thermal"),
        ("M3T", 1920, 1080, math.nan, "Mavic 3T"),
        ("M3M", 5280, 3956, 12.29, "Mavic 3E"),
        ("M3M", 2592, 1944, 4.34, "Mavic 3M multispectral"),
        ("XT709", 8000, 6000, 4.74, "Autel EVO II Dual 640T"),
        ("XT709", 640, 512, 13.0, "Autel EVO II Dual 640T thermal"),
        ("ANAFI Ai", 8000, 6000, 4.4, "Parrot ANAFI Ai"),
        ("ZH20T", 640, 512, 13.5, "Zenmuse H20T thermal"),
        ("M4T", 8064, 6048, 6.72, "Matrice 4T"),
    ],
)
def test_a_drones_cameras_are_distinguished(model, width_px, height_px, focal_mm, name):
    found = guess_camera(width_px, height_px, make="DJI", model=model, focal_length_mm=focal_mm)
    assert found.origin.startswith(f"preset {name}:")


@pytest.mark.parametrize(
    ("name", "fov_deg"),
    [
        # the fields of view across the diagonal that DJI's pages state; lenses that bend differ by some degrees
        ("Mavic 3T", 84),
        ("Mavic 3T thermal", 61),
        ("Matrice 30", 84),
        ("Zenmuse H30", 82.1),
        ("Air 3", 82),
        ("Air 3 tele", 35),
        ("Zenmuse H20T thermal", 40.6),
        ("Zenmuse H30T thermal", 45.2),
        ("Matrice 4E", 84),
        ("Mini 5 Pro", 84),
        ("Matrice 4T", 82),
        ("Matrice 4T thermal", 45),
        ("Mavic 3M multispectral", 73.9),
        # from memory, as the presets are: that they agree shows no more than that these have no slip of the pen
        ("Autel EVO II", 79),
        ("Autel EVO Nano", 84),
        ("Autel EVO Nano Plus", 85),
        ("Autel EVO Max 4T", 85),
        ("Autel EVO Max 4T thermal", 61),
    ],
)
def test_presets_see_as_much_as_their_makers_state(name, fov_deg):
    (preset,) = find_presets(name)
    across_mm = math.hypot(preset.sensor_width_mm, preset.sensor_height_mm)
    assert math.degrees(2 * math.atan(0.5 * across_mm / preset.focal_mm)) == pytest.approx(
        fov_deg, abs=4.5
    )
