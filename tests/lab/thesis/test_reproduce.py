"""The thesis's experiments on a small simulated dataset in UMCD's layout; broken datasets cost their rows alone."""

import csv
import io
import shutil
from dataclasses import replace
from functools import reduce
from operator import xor
from pathlib import Path

import cv2
import numpy as np
import pytest

from sorvolo.capture.calibration import camera_from_option
from sorvolo.capture.source import open_sources
from sorvolo.cli.main import main
from sorvolo.errors import InputError, SettingsError
from sorvolo.lab.datasets import umcd
from sorvolo.lab.datasets.umcd import read_umcd_metadata
from sorvolo.lab.evaluation.change_metrics import Counts
from sorvolo.lab.evaluation.mask_folders import frames_against_times
from sorvolo.lab.simulation.flight_files import write_mask
from sorvolo.lab.thesis import umcd_writing
from sorvolo.lab.thesis.comparisons import TABLE, _judged, _times_of
from sorvolo.lab.thesis.detectors import okutama_labels
from sorvolo.lab.thesis.npu_folder import photos_of_sequence, read_npu_folder
from sorvolo.lab.thesis.published import APPEARANCES, TABLE_4_3
from sorvolo.lab.thesis.report import MARKDOWN, NUMBERS, PAGE, write_reproduction
from sorvolo.lab.thesis.rows import Row
from sorvolo.lab.thesis.run import ReproductionUpdate, _Work, reproduce
from sorvolo.lab.thesis.settings import (
    ReproductionSettings,
    SimulatedSize,
    quick,
)
from sorvolo.lab.thesis.sheets import reproduction_sheets
from sorvolo.lab.thesis.simulated import simulated_dataset
from sorvolo.lab.thesis.tables import tables_of
from sorvolo.lab.thesis.umcd_folder import (
    BENCHMARK,
    CHANGES,
    MOSAICKING,
    WITH,
    UmcdVideo,
    read_umcd_folder,
)
from sorvolo.lab.thesis.video_input import VideoInput, video_input
from sorvolo.store.exports.map_pictures import picture
from sorvolo.store.site.archive import Archive

SETTINGS, SIZE = quick(
    ReproductionSettings(views_per_second=2.5),
    SimulatedSize(bare_videos=0),
)
SMALL = replace(SIZE, length_m=8.0, size_px=(320, 180))


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One path of the countryside, flown twice."""
    place = tmp_path_factory.mktemp("umcd") / "dataset"
    for _ in simulated_dataset(place, SMALL, SETTINGS):
        pass
    return place


@pytest.fixture(scope="module")
def reproduced(
    dataset: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, list[ReproductionUpdate]]:
    """All rows, by a run that was stopped after its fourth row, and another one."""
    out = tmp_path_factory.mktemp("chapter4")
    first = reproduce(dataset, out, SETTINGS, is_whole=False)
    for _ in range(4):
        next(first)
    del first
    return out, list(reproduce(dataset, out, SETTINGS, is_whole=False))


def copied(dataset: Path, to: Path) -> Path:
    """The dataset anew, to be broken."""
    shutil.copytree(dataset, to)
    return to


def log_of_another_year() -> str:
    """An NMEA log, a fix a second."""
    bodies = [
        f"GPRMC,1200{second:02d}.00,A,4153.5387,N,01236.2125,E,9.7,90.0,010109,,,A"
        for second in range(9)
    ]
    return "".join(f"${body}*{reduce(xor, body.encode()):02X}\r\n" for body in bodies)


def test_simulated_dataset_has_the_layout_of_chapter_2(dataset: Path) -> None:
    folder = read_umcd_folder(dataset)
    (first,), (later,) = folder.mosaicking, folder.change_detection
    assert (first.environment, first.name, folder.camera is not None) == (
        "Countryside",
        "path1",
        True,
    )
    assert (
        first.texts[0]
        .read_text()
        .startswith("Tick#,offsetTime,flightTime(msec),Longitude,Latitude")
    )
    assert folder.mosaic_of(later) == first
    assert later.masks is not None and later.metadata is not None
    stated = read_umcd_metadata(later.metadata)
    assert (
        stated.fps == 25 and len(stated.in_view_s) == 2 and stated.boxed
    )  # Table 2.4: a suitcase, a person


def test_all_rows_are_made_and_those_of_a_stopped_run_are_kept(
    reproduced: tuple[Path, list[ReproductionUpdate]],
) -> None:
    out, updates = reproduced
    assert [each.row.missing for each in updates] == [""] * len(updates)
    assert [each.is_known for each in updates] == [True] * 4 + [False] * (len(updates) - 4)
    kinds = [each.row.kind for each in updates]
    assert {kind: kinds.count(kind) for kind in kinds} == {
        "mosaic": 2,
        "correlation": 1,
        "transform": 2,
        "example": 1,
        "comparison": 4,
        "seconds": 1,
        "detector": 1,
    }
    rows = {each.row.id: each.row for each in updates}
    rigid, bent = (
        rows[f"transform/countryside/path1/{name}"].values for name in ("similarity", "homography")
    )
    assert rigid["sides"] < 1.002 < bent["sides"]
    for each in rows.values():
        assert all((out / "pictures" / file).is_file() for file in each.pictures.values())


def test_tables_have_the_printed_figures_beside_ours(
    dataset: Path,
    reproduced: tuple[Path, list[ReproductionUpdate]],
) -> None:
    out, updates = reproduced
    document = write_reproduction(out, [each.row for each in updates], dataset, SETTINGS, SMALL)
    table = document["tables"]["tables_4_3_and_4_4"]
    assert {name: table["published"][name] for name in TABLE_4_3} == TABLE_4_3
    for each in table["ours"]:
        assert each["tp"] + each["fp"] + each["fn"] + each["tn"] == each["compared"]
    page = (out / PAGE).read_text()
    assert (
        "3167" in page
        and "Figure 4.5" in page
        and page.count("<svg") >= 3
        and "<script" not in page
    )
    assert "78.2" in (out / MARKDOWN).read_text() and (out / NUMBERS).is_file()
    rows = list(csv.reader(io.StringIO((out / "tables" / "table_4_5.csv").read_text())))
    assert rows[3][0] == "thesis, printed" and len(rows) == 8
    assert not document["missing"]


def test_npus_flights_are_mapped_and_compared_with_the_published_mosaics(
    dataset: Path, reproduced: tuple[Path, list[ReproductionUpdate]], tmp_path: Path
) -> None:
    folder = read_umcd_folder(dataset)
    (flown,) = folder.mosaicking
    own = tmp_path / "npu" / "phantom3-npu"
    own.mkdir(parents=True)
    for each in (flown.video, *flown.texts):
        shutil.copy(each, own / f"DJI_0007{each.suffix}")
    shutil.copy(
        reproduced[0] / "sites" / "countryside-path1" / "planar" / "mosaic.tif",
        own / "bu-et-al.tif",
    )
    (tmp_path / "npu" / "phantom3-village.mp4").write_bytes(b"no video")
    work = _Work(folder, tmp_path / "out", replace(SETTINGS, videos=None))
    rows = {row.id: row for row, _ in map(work.done, work.npu_tasks(tmp_path / "npu"))}
    assert len(rows) == 8
    made = [
        rows[f"mosaic/with/npu/phantom3-npu/{method}"].values for method in ("thesis", "planar")
    ]
    assert [(each["sequence"], each["camera"]) for each in made] == [
        ("npu/phantom3-npu", "guessed")
    ] * 2
    assert rows["published/npu/phantom3-npu/planar"].values["correlation_after_shift"] > 0.5
    assert "no mosaic of Bu et al." in rows["published/npu/phantom3-village/planar"].missing
    assert "phantom3-village.mp4" in rows["mosaic/without/npu/phantom3-village/planar"].missing
    tables = tables_of([each.row for each in reproduced[1]] + list(rows.values()))
    assert {each["sequence"] for each in tables["table_4_1"]["ours"]} == {
        "countryside/path1",
        "npu/phantom3-npu",
    }
    assert [(each["videos"], each["published"]) for each in tables["section_4_1_1"]["ours"]] == [
        (1, 1),
        (1, 1),
    ]
    sheets = {each.name: each for each in reproduction_sheets(tables)}
    assert "planar here, with the mosaics of [17]" in {
        row[0] for row in sheets["section_4_1_1"].rows
    }
    assert list(work.npu_tasks(None)) == []
    with pytest.raises(InputError, match="no videos; give the folder of the NPU Drone-Map dataset"):
        list(
            work.npu_tasks(
                own.parent.parent / "out" / "sites" / "npu-phantom3-npu" / "planar" / "flights"
            )
        )


def test_the_benchmark_mosaic_of_a_video_is_found_and_correlated(
    dataset: Path, reproduced: tuple[Path, list[ReproductionUpdate]], tmp_path: Path
) -> None:
    """A picture without coordinates, turned and of another size, as the thesis's own mosaics are."""
    place = copied(dataset, tmp_path / "umcd")
    own = place / BENCHMARK / "Videos With Telemetry" / "Mosaicking" / "Countryside" / "path1.png"
    own.parent.mkdir(parents=True)
    with Archive.open(
        reproduced[0] / "sites" / "countryside-path1" / "planar", write=False
    ) as site:
        rgba = picture(site.tiles(), 2048).rgba
    turned = cv2.rotate(rgba, cv2.ROTATE_90_CLOCKWISE)
    turned[turned[..., 3] == 0] = 0
    shown = cv2.resize(turned[..., :3], None, fx=0.8, fy=0.8, interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(own), shown[..., ::-1])
    shutil.copytree(reproduced[0], tmp_path / "out")
    work = _Work(read_umcd_folder(place), tmp_path / "out", SETTINGS)
    rows = [work.done(task)[0] for task in work.mosaic_tasks() if task.kind == "benchmark"]
    assert [row.id for row in rows] == [
        f"benchmark/with/countryside/path1/{method}" for method in ("thesis", "planar")
    ]
    assert all(row.values["correlation"] > 0.7 for row in rows), [row.missing for row in rows]
    tables = tables_of([each.row for each in reproduced[1]] + rows)
    assert [each["benchmarks"] for each in tables["section_4_1_1"]["ours"]] == [1, 1]


def test_npus_sequences_are_read_as_published(tmp_path: Path) -> None:
    """Key frames by place and calibration, and all frames with a log of fixes: one a second of them."""
    folder = tmp_path / "phantom3-npu-kfs"
    (folder / "rgb").mkdir(parents=True)
    (folder / "config.cfg").write_text(
        "Plane = 0 0 -100 0 0 0 1\nGPS.Origin = 108.9 34.2 400\n"
        "Camera.Paraments = [80 60 70 71 40 30 -0.1 0.01 0 0 0]\n"
    )
    (folder / "trajectory.txt").write_text("10.5 0 0 20 0 0 0 1\n12.75 30 0 20 0 0 0 1\n")
    unified = tmp_path / "phantom3-npu-unified"
    (unified / "rgb").mkdir(parents=True)
    (unified / "frames.txt").write_text("".join(f"{n / 10} rgb/{n}.jpg\n" for n in range(25)))
    (unified / "gps.txt").write_text("0 108.9 34.2 400 1\n2 108.9002 34.2 402 1\n")
    for shade, file in enumerate(
        [folder / "rgb" / f"{name}.jpg" for name in ("10.5", "12.75")]
        + [unified / "rgb" / f"{n}.jpg" for n in range(25)]
    ):
        cv2.imwrite(str(file), np.full((60, 80, 3), 9 * shade, np.uint8))
    sequences = read_npu_folder(tmp_path)
    assert [each.key for each in sequences] == [
        "npu/phantom3-npu-kfs",
        "npu/phantom3-npu-unified",
    ]
    kfs, all_frames = (video_input(each, None, tmp_path / each.name / "made") for each in sequences)
    assert kfs.camera is not None and camera_from_option(str(kfs.camera), 80, 60).camera.fx_px == 70
    (flight,) = open_sources([kfs.video])
    longitudes = flight.telemetry["longitude_deg"]
    assert longitudes[1] - longitudes[0] == pytest.approx(30 / 92_150, rel=0.01)
    (flight,) = open_sources([all_frames.video])
    assert flight.telemetry["longitude_deg"] == pytest.approx([108.9, 108.9001, 108.9002])
    (folder / "config.cfg").write_text("")
    with pytest.raises(InputError, match=r"no GPS\.Origin"):
        photos_of_sequence(folder, tmp_path / "again")


def test_a_set_with_what_chapter_2_lists_and_no_more_fills_every_table(
    dataset: Path,
    reproduced: tuple[Path, list[ReproductionUpdate]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """No masks; metadata of type, shape, dimension, colour and movement; a benchmark mosaic; times of Table 2.4.

    The times are made up, and exact: the path is flown in two seconds.
    """
    place, out = copied(dataset, tmp_path / "umcd"), tmp_path / "out"
    shutil.copytree(reproduced[0], out)
    (later,) = read_umcd_folder(place).change_detection
    assert later.masks is not None and later.metadata is not None
    shutil.rmtree(later.masks)
    listed = [
        line
        for line in later.metadata.read_text().splitlines()
        if not line.startswith(("Fps", "Appearance", "Box"))
    ]
    later.metadata.write_text("\n".join(listed))
    length_s = video_input(later, None, tmp_path).length_s
    monkeypatch.setitem(APPEARANCES, later.key, (round(length_s), ((0.2, 0.6), (1.0, 1.4))))
    for module in (umcd, umcd_writing):
        monkeypatch.setattr(module, "ROUNDED_S", 0.1)
    mosaic = place / BENCHMARK / WITH / MOSAICKING / "Countryside" / "path1.tif"
    mosaic.parent.mkdir(parents=True)
    shutil.copy(out / "sites" / "countryside-path1" / "planar" / "mosaic.tif", mosaic)
    rows = [each.row for each in reproduce(place, out, SETTINGS, is_whole=False)]
    assert [each.missing for each in rows] == [""] * len(rows)
    tables = tables_of(rows)
    assert all(tables[name]["ours"] for name in tables)
    assert {each["judged_by"] for each in tables["tables_4_3_and_4_4"]["ours"]} == {TABLE}
    for each in tables["table_4_5"]["ours"]:
        assert each["tn"] > 0 and each["precision"] is None and each["accuracy"] is not None
    (detector,) = tables["table_4_6"]["ours"]
    assert "places by the comparison of both flights" in detector["split"]
    assert tables["section_4_1_1"]["ours"][1]["benchmarks"] == 1


def test_a_changed_pair_without_anything_to_judge_it_by_is_named(
    dataset: Path, reproduced: tuple[Path, list[ReproductionUpdate]], tmp_path: Path
) -> None:
    broken = copied(dataset, tmp_path / "umcd")
    later = read_umcd_folder(broken).change_detection[0]
    assert later.masks is not None and later.metadata is not None
    shutil.rmtree(later.masks)
    later.metadata.unlink()
    updates = list(reproduce(broken, reproduced[0], SETTINGS, is_whole=False))
    assert [each.is_known for each in updates[:6]] == [True] * 6  # a dataset may be moved
    reasons = {each.row.id: each.row.missing for each in updates if each.row.missing}
    assert (
        "neither a folder of change masks (path1_masks) nor"
        in reasons["comparison/countryside/path1/robust"]
    )
    assert "nor a comparison of two flights gives the places" in reasons["detector/UMCD/packaged"]
    assert len(reasons) == 5


@pytest.mark.parametrize(
    ("index", "counted"), [(0, "tn"), (1, "unknown"), (2, "tp"), (3, "fn"), (4, "fp")]
)
def test_times_of_appearance_judge_frames_where_there_are_no_masks(
    tmp_path: Path, index: int, counted: str
) -> None:
    metadata = tmp_path / "path1.txt"
    metadata.write_text("Fps: 1\nObject 1\nType: Tire\nShape: round\nAppearance: 09 to 18\n")
    stated = read_umcd_metadata(metadata)
    frame, changed = [(7, 0), (8, 255), (11, 255), (16, 0), (20, 255)][index]
    masks = tmp_path / "masks"
    masks.mkdir()
    write_mask(masks / f"{frame}.png", np.full((4, 6), changed, np.uint8))
    (judged,) = frames_against_times(masks, stated.shows_object)
    assert judged.frame == Counts(**{counted: 1})


def test_metadata_without_times_is_judged_by_table_2_4_where_the_video_is_its(
    tmp_path: Path,
) -> None:
    """The metadata has what chapter 2 lists, no more."""
    metadata = tmp_path / "path2.txt"
    metadata.write_text(
        "Object 1\nType: Suitcase\nShape: rectangular\nDimension: 50\nColor: same\n"
    )
    truth = UmcdVideo("Countryside", "path2", tmp_path / "path2.mp4", metadata=metadata)
    masks = tmp_path / "masks"
    masks.mkdir()
    write_mask(masks / "550.png", np.full((4, 6), 255, np.uint8))  # at 22 s: object 2
    write_mask(masks / "375.png", np.full((4, 6), 255, np.uint8))  # at 15 s: none
    own, another = (
        VideoInput(truth.video, None, None, 25.0, length_s) for length_s in (47.2, 60.0)
    )
    judged_by, judged = _judged(masks, truth, _times_of(truth, own), own.fps)
    assert (judged_by, sum((each.frame for each in judged), Counts())) == (
        TABLE,
        Counts(tp=1, fp=1),
    )
    with pytest.raises(InputError, match="states for no compared frame"):
        _judged(masks, truth, _times_of(truth, another), another.fps)
    frames = sum(each[0] for each in APPEARANCES.values())
    assert (len(APPEARANCES), frames) == (11, 585)


def test_okutama_is_split_by_its_own_folders_where_it_has_them(tmp_path: Path) -> None:
    assert okutama_labels(tmp_path).split == "20% held out"
    for name in ("TrainSetFrames", "TestSetFrames"):
        (tmp_path / name).mkdir()
    labels = okutama_labels(tmp_path)
    assert (labels.place.name, labels.split) == (
        "TrainSetFrames",
        "the publisher's test folder (TestSetFrames)",
    )


def test_missing_and_broken_files_cost_their_rows_alone(dataset: Path, tmp_path: Path) -> None:
    broken = copied(dataset, tmp_path / "umcd")
    part = broken / WITH / MOSAICKING / "Countryside"
    shutil.copy(part / "path1.mp4", part / "path2.mp4")
    shutil.copy(part / "path1.mp4", part / "path3.mp4")
    (part / "path3.log").write_text(log_of_another_year())
    (part / "path1.mp4").write_bytes(b"no video at all" * 99)
    (part / "path2.csv").write_text("Name,Value\n1,2\n")
    (
        broken / WITH / CHANGES / "Countryside" / "path1.txt"
    ).unlink()  # nothing for the detector to look at
    shutil.copy(part / "path1.csv", broken / WITH / CHANGES / "Countryside" / "path9.csv")
    shutil.copy(part / "path2.mp4", broken / WITH / CHANGES / "Countryside" / "path9.mp4")
    updates = reproduce(broken, tmp_path / "out", replace(SETTINGS, videos=None))
    reasons = {each.row.id: each.row.missing for each in updates if each.row.missing}
    assert "path1.mp4" in reasons["mosaic/with/countryside/path1/planar"]
    assert (
        "no telemetry beside it (found: path2.csv)"
        in reasons["mosaic/with/countryside/path2/thesis"]
    )
    assert "have no time in common" in reasons["mosaic/with/countryside/path3/planar"]
    assert (
        "the map of countryside/path1 could not be made"
        in reasons["comparison/countryside/path1/robust"]
    )
    assert "no mosaicking video of its path" in reasons["comparison/countryside/path9/robust"]
    assert "video/Videos With Telemetry/Mosaicking/Urban/path4.mp4" in reasons
    assert "video/Videos With Telemetry/Mosaicking/Countryside/path1.mp4" not in reasons
    assert "video/Videos Without Telemetry/Mosaicking/Dirt/path20.mp4" in reasons


def test_a_folder_that_is_no_dataset_is_refused(tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    with pytest.raises(InputError, match="not the UMCD dataset"):
        next(reproduce(tmp_path, tmp_path / "out", SETTINGS))
    with pytest.raises(InputError, match="no such folder"):
        next(reproduce(tmp_path / "nowhere", tmp_path / "out", SETTINGS))


def test_a_simulated_dataset_of_another_size_is_not_mixed_in(dataset: Path) -> None:
    with pytest.raises(SettingsError, match="another size or seed"):
        next(simulated_dataset(dataset, replace(SMALL, length_m=9.0), SETTINGS))
    assert list(simulated_dataset(dataset, SMALL, SETTINGS)) == []


def test_a_row_without_values_is_no_row_of_a_table(tmp_path: Path) -> None:
    rows = [Row("mosaic/with/urban/path1/thesis", "mosaic", missing="<b>cut</b> off")]
    document = write_reproduction(tmp_path, rows, Path("UMCD"), SETTINGS, None)
    assert document["tables"]["table_4_1"]["ours"] == []
    assert document["missing"] == [{"id": rows[0].id, "reason": "<b>cut</b> off"}]
    assert "&lt;b&gt;cut&lt;/b&gt; off" in (tmp_path / PAGE).read_text()


def test_command_names_what_is_missing_in_its_exit_code(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    place = tmp_path / "umcd"
    part = place / WITH / MOSAICKING / "Urban"
    part.mkdir(parents=True)
    (part / "path1.mp4").write_bytes(b"no video")
    out = str(tmp_path / "out")
    assert main(["reproduce", str(place), "--out", out, "--videos", "1", "--train-steps", "0"]) == 3
    assert "rows could not be made" in " ".join(capsys.readouterr().out.split())
    assert (tmp_path / "out" / PAGE).is_file()
    assert main(["reproduce", str(place), "--simulated", "--out", out]) == 1
    assert "one of both" in capsys.readouterr().err
    assert main(["reproduce", str(tmp_path / "nowhere"), "--out", out]) == 1
