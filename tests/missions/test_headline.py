"""The first line of a mapped flight: no map, a map to check, or a map; the exit code agrees."""

import json
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from PIL import Image

from sorvolo.capture.clock_offset import OffsetEstimate
from sorvolo.cli.main import main
from sorvolo.errors import InputError
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.ground import footprint
from sorvolo.geometry.homography import site_from_image_homography
from sorvolo.geometry.pose import Pose, site_from_gimbal_rotation
from sorvolo.lab.simulation.flight_files import video_writer
from sorvolo.missions.compare.report import views_notices
from sorvolo.missions.flight.headline import (
    MapQuality,
    _angle_warnings,
    clock_doubts,
    clock_remarks,
    map_headline,
    unlevelled,
)
from sorvolo.missions.map.flights import _refuse_view_aside
from sorvolo.mosaic.consistency import Consistency
from sorvolo.mosaic.flight_figures import flight_figures
from sorvolo.mosaic.graph_report import GraphReport
from sorvolo.survey.mosaic import PlacedFrame, Status

_CAMERA = Camera.from_angle_of_view(640, 480, 60)


def placed(
    east_m: float,
    status: Status = Status.VISION,
    pitch_deg: float = -90.0,
    residual_px: float = 0.3,
    off_m: float = 0.4,
) -> PlacedFrame:
    pose = Pose(site_from_gimbal_rotation(0, pitch_deg, 0), np.array([east_m, 0.0, 30.0]))
    return PlacedFrame(
        str(east_m),
        int(east_m),
        0,
        status,
        "",
        _CAMERA,
        pose,
        site_from_image_homography(_CAMERA, pose),
        footprint(_CAMERA, pose),
        residual_px,
        0.5,
        gps_residual_m=np.array([off_m, 0.0, 0.0]),
    )


def quality_of(frames: list[PlacedFrame], *, is_video: bool = True) -> MapQuality:
    return map_headline(frames, flight_figures(frames, _CAMERA.fx_px), is_video=is_video).quality


def test_a_clock_that_the_pictures_contradict_is_never_silent() -> None:
    setup = SimpleNamespace(clock=SimpleNamespace(tie="both carry UTC", sigma_s=2.0))
    alike = OffsetEstimate(0.1, 0.05, 0.5, 0.5, rivals_s=(26.0, -26.0))
    (text,) = clock_doubts(setup, alike, None)
    assert (
        "alike as with its clock (both carry UTC) with other clock offsets (+26.0, -26.0 s)" in text
    )
    assert clock_doubts(setup, alike, 0.0) == []  # the user has chosen
    (kept,) = clock_doubts(setup, OffsetEstimate(14.0, 0.1, 40.0, 0.5), 7.0)
    assert "+14.0 s from --offset 7" in kept and "try --offset 21.00" in kept
    (far,) = clock_doubts(setup, OffsetEstimate(0.0, np.inf, 10.0, 0.5), None)
    assert "far from where its clock puts them" in far
    assert clock_doubts(setup, OffsetEstimate(0.3, 0.1, 1.0, 0.9), None) == []
    frames = [placed(10.0 * k) for k in range(8)]
    doubted = map_headline(
        frames, flight_figures(frames, _CAMERA.fx_px), is_video=True, others=[text]
    )
    assert doubted.quality is MapQuality.DOUBTFUL


def test_a_clock_without_a_witness_is_said_to_be_unchecked() -> None:
    """A straight flight fits any offset: nan is left over at its clock's own."""
    setup = SimpleNamespace(clock=SimpleNamespace(tie="both carry UTC", sigma_s=2.0))
    for sigma_s in (np.inf, 5.0):
        unseen = OffsetEstimate(0.0, sigma_s, np.nan, np.nan)
        assert clock_doubts(setup, unseen, None) == []
        (remark,) = clock_remarks(setup, unseen)
        assert "could not be checked (both carry UTC)" in remark and "includes 2 s" in remark
    assert clock_remarks(setup, OffsetEstimate(0.1, 0.2, 0.5, 0.5)) == []
    setup.clock.sigma_s = 0.35  # each photo's own fix
    assert clock_remarks(setup, OffsetEstimate(0.0, np.inf, np.nan, np.nan)) == []


def test_frames_that_fit_each_other_are_a_map() -> None:
    frames = [placed(10.0 * k) for k in range(8)]
    assert quality_of(frames) is MapQuality.MAP
    headline = map_headline(frames, flight_figures(frames, _CAMERA.fx_px), is_video=True)
    assert headline.text == "8 of 8 frames matched"


def test_a_map_that_nothing_levels_is_to_be_checked() -> None:
    """A video that looks to the side without telemetry: 4 frames that fit are no view from above. GPS levels them."""
    frames = [placed(10.0 * k) for k in range(4)]
    graph = GraphReport(1.0, 0.1, 0.0, 0.0, 3, 0, 0.0, 0.3, angles_contradicted=1)
    free, tied = SimpleNamespace(track=None), SimpleNamespace(track=object())
    assert unlevelled(frames, graph, tied) == []  # type: ignore[arg-type]
    (why,) = unlevelled(frames, graph, free)  # type: ignore[arg-type]
    headline = map_headline(
        frames, flight_figures(frames, _CAMERA.fx_px), is_video=True, others=[why]
    )
    assert headline.quality is MapQuality.DOUBTFUL and "looked to the side" in headline.text


@pytest.mark.parametrize(
    "frames, why",
    [
        ([placed(0.0)], "hovered"),
        ([placed(0.1 * k) for k in range(5)], "5 frames show one view"),
        ([placed(0.0, pitch_deg=-45.0)], "45 deg away from straight down"),
    ],
)
def test_a_video_of_one_view_is_no_map(frames: list[PlacedFrame], why: str) -> None:
    headline = map_headline(frames, flight_figures(frames, _CAMERA.fx_px), is_video=True)
    assert (
        headline.quality is MapQuality.ONE_VIEW
        and headline.text.startswith("no map:")
        and why in headline.text
    )
    assert quality_of(frames, is_video=False) is MapQuality.MAP, "each photo was meant"


@pytest.mark.parametrize(
    "frames, why",
    [
        (
            [placed(10.0 * k, Status.GPS_ONLY if k == 2 else Status.VISION) for k in range(8)],
            "1 frame is placed by GPS",
        ),
        ([placed(10.0 * k, residual_px=4.0) for k in range(8)], "badly"),
    ],
)
def test_steps_make_a_map_to_check(frames: list[PlacedFrame], why: str) -> None:
    headline = map_headline(frames, flight_figures(frames, _CAMERA.fx_px), is_video=True)
    assert headline.quality is MapQuality.DOUBTFUL and why in headline.text


def test_a_map_that_lost_most_of_its_frames_is_to_be_checked_and_names_one_cause() -> None:
    reasons = ["too few matching points"] * 5 + ["blurred"] * 3
    lost = [PlacedFrame.rejected(k, f"{k}", k, why, _CAMERA) for k, why in enumerate(reasons)]
    frames = [*(placed(10.0 * k, residual_px=4.0) for k in range(7)), *lost]
    headline = map_headline(frames, flight_figures(frames, _CAMERA.fx_px), is_video=False)
    assert headline.quality is MapQuality.DOUBTFUL
    assert "8 of 15 frames" in headline.text and "5 of them because: too few" in headline.text
    assert "blurred" not in headline.text and "badly" not in headline.text
    assert quality_of([placed(10.0 * k) for k in range(8)] + lost) is MapQuality.MAP


def test_a_map_with_faults_is_none_to_build_on() -> None:
    frames = [placed(10.0 * k, off_m=60.0) for k in range(8)]
    figures = flight_figures(frames, _CAMERA.fx_px)
    agreement = Consistency((), ("it is twice as large as its GPS track",), (), ())
    headline = map_headline(frames, figures, is_video=True, agreement=agreement)
    assert headline.quality is MapQuality.CONTRADICTORY and "twice as large" in headline.text


def test_a_map_of_fixes_that_are_another_flights_is_refused_and_nothing_is_compared_with_it(
    photographed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    photos, camera = (
        _with_shuffled_fixes(photographed, tmp_path / "photos"),
        str(photographed / "camera.xml"),
    )
    site = tmp_path / "site"
    common = ["--site", str(site), "--model", "none", "--camera", camera]
    assert main(["map", str(photos), *common]) == 3
    assert "a map that contradicts itself: " in capsys.readouterr().out
    report = json.loads((site / "flights" / "photos" / "report.json").read_text())
    assert report["headline"]["quality"] == "contradictory" and len(report["pieces"]) >= 1

    later = str(photographed / "flight1" / "photos")
    before = (site / "mosaic.tif").read_bytes()
    assert main(["compare", later, *common]) == 1
    error = capsys.readouterr().err
    assert "contradicts itself" in error and "--trust-map" in error
    assert (site / "mosaic.tif").read_bytes() == before


def _with_shuffled_fixes(photographed: Path, folder: Path) -> Path:
    """The photos, each with the place of another one."""
    folder.mkdir()
    paths = sorted((photographed / "flight1" / "photos").glob("*.jpg"))
    places = []
    for path in paths:
        with Image.open(path) as picture:
            places.append(picture.getexif().get_ifd(0x8825))
    for path, other in zip(paths, np.random.default_rng(3).permutation(len(paths)), strict=True):
        with Image.open(path) as picture:
            exif = picture.getexif()
            exif.get_ifd(0x8825).update({tag: places[other][tag] for tag in (1, 2, 3, 4)})
            picture.save(folder / path.name, "JPEG", exif=exif, quality=95)
    return folder


def test_a_video_from_one_place_ends_with_a_warning_and_its_own_exit_code(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(5)
    ground = cv2.resize(
        rng.integers(0, 255, (60, 80, 3), np.uint8), (320, 240), interpolation=cv2.INTER_CUBIC
    )
    with video_writer(tmp_path / "hover.mp4", (320, 240), 10.0, 1_780_000_000 * 10**9, 18) as write:
        for _ in range(30):
            write(ground)
    assert (
        main(
            [
                "map",
                str(tmp_path / "hover.mp4"),
                "--site",
                str(tmp_path / "site"),
                "--model",
                "none",
            ]
        )
        == 3
    )
    assert "no map:" in capsys.readouterr().out
    report = json.loads((tmp_path / "site/flights/hover/report.json").read_text())
    assert report["headline"]["quality"] == "one-view"


@pytest.mark.parametrize(
    ("has_angles", "words"),
    [
        (True, "the stated angles of 2 frames of 8 contradict"),
        (False, "no angles are stated, so the camera was taken"),
    ],
)
def test_angles_that_nobody_stated_are_not_called_stated(has_angles: bool, words: str) -> None:
    report = GraphReport(1.0, 0.1, 0.0, 0.0, 8, 0, 0.0, 0.4, angles_contradicted=2)
    (warning,) = _angle_warnings(
        [placed(10.0 * k) for k in range(8)], report, has_angles=has_angles
    )
    assert warning.startswith(words)


@pytest.mark.parametrize("tilt_deg", [20.0, 50.0])
def test_an_orbit_whose_pictures_do_not_fit_is_given_up_after_a_few(tilt_deg: float) -> None:
    setup = SimpleNamespace(source=SimpleNamespace(name="orbit"), usual_tilt_deg=tilt_deg)
    with nullcontext() if tilt_deg < 35 else pytest.raises(InputError, match="first 8 pictures 1"):
        _refuse_view_aside(setup, 1)  # type: ignore[arg-type]


@pytest.mark.parametrize(("apart_m", "views"), [(2.0, None), (9.0, None), (12.0, 1)])
def test_too_few_views_for_the_votes_are_named(apart_m: float, views: int | None) -> None:
    """Frames of 20 m: the middle of one is in its neighbours where these are less than 10 m apart."""
    camera = Camera.from_angle_of_view(640, 480, 60)
    square_m = np.array([[-10.0, 10], [10, 10], [10, -10], [-10, -10]])
    placed = [
        replace(
            PlacedFrame.rejected(n, str(n), 0, "", camera),
            outline_m=square_m + np.array([n * apart_m, 0]),
        )
        for n in range(20)
    ]
    found = views_notices(placed, votes=3)
    assert [each.count for each in found] == ([] if views is None else [views])
