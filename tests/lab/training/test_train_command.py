"""`sorvolo train`: a tiny network learns, is stopped, goes on, and is written; bad input is reported."""

import json
import os
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

torch = pytest.importorskip("torch")

from square_pictures import labelled_squares

from sorvolo.cli.main import main
from sorvolo.detection.detector import Detector
from sorvolo.errors import InputError, SettingsError
from sorvolo.lab.simulation.pictures import PictureSettings, simulate_pictures
from sorvolo.lab.training.detector import TrainingUpdate, train_detector
from sorvolo.lab.training.page import training_page
from sorvolo.lab.training.progress import read_checkpoint
from sorvolo.lab.training.sets import (
    DataOptions,
    TrainingSets,
    training_sets,
)
from sorvolo.lab.training.settings import TrainSettings


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return labelled_squares(tmp_path_factory.mktemp("data") / "squares", 4, 5)


def _settings(**changes: object) -> TrainSettings:
    return TrainSettings(**({"weights": "none", "steps": 6, "batch": 2, "side_px": 64} | changes))  # type: ignore[arg-type]


def _train(
    data: Path, out: Path, settings: TrainSettings, *, resume: bool = False
) -> Iterator[TrainingUpdate]:
    return train_detector(
        [data], out, settings, DataOptions(val="0.25"), device="cpu", resume=resume
    )


def _counts_smallest_numbers() -> bool:
    """Whether numbers smaller than a normal one are not yet nothing, as before a training."""
    return (torch.tensor(1e-40) * torch.tensor(0.5)).item() > 0


def test_the_process_counts_as_before_when_a_training_was_left(data: Path, tmp_path: Path) -> None:
    updates = _train(data, tmp_path / "run", _settings(steps=2))
    for update in updates:
        if update.losses is not None:
            break
    updates.close()  # type: ignore[attr-defined]
    assert _counts_smallest_numbers()


def test_the_command_learns_and_writes_a_model_that_runs(data: Path, tmp_path: Path) -> None:
    out = tmp_path / "my-model"
    options = [
        "--weights",
        "none",
        "--steps",
        "24",
        "--batch",
        "2",
        "--side",
        "64",
        "--val",
        "0.25",
    ]
    assert main(["train", str(data), "--out", str(out), *options, "--json"]) == 0

    report = json.loads((out / "training.json").read_text())
    assert report["held_out"]["ap50"] > 0.2  # chance finds nothing
    first, last = (
        [row["losses"]["score"] for row in report["losses"][part]]
        for part in (slice(5), slice(-5, None))
    )
    assert sum(last) < 0.5 * sum(first)
    assert report["export"]["good"] and report["export"]["detections"] > 0
    assert [(each["part"], each["pictures"], each["videos"]) for each in report["sets"]] == [
        ("learnt from", 15, 3),
        ("checked on", 5, 1),
    ]
    assert (out / "training.html").read_text().count("<svg") == 1

    detector = Detector.load(out / "model.onnx")
    assert (detector.classes, detector.info.preset, detector.info.thermal) == (
        ("car",),
        "fast",
        False,
    )
    low, high = detector.info.best_px["car"]
    assert 20 <= low < high <= 34
    picture = cv2.cvtColor(cv2.imread(str(data / "images" / "flight0_0000.png")), cv2.COLOR_BGR2RGB)
    assert len(detector.detect(picture, least_score=0.02))


@pytest.mark.long  # the same of a checkpoint alone is tested beside it
def test_a_run_that_was_stopped_ends_as_one_that_was_not(data: Path, tmp_path: Path) -> None:
    settings = _settings()
    whole = [each for each in _train(data, tmp_path / "whole", settings) if each.losses is not None]
    stopped = _train(data, tmp_path / "stopped", settings)
    for update in stopped:
        if update.step == 4:
            stopped.close()  # type: ignore[attr-defined]
    assert not (tmp_path / "stopped" / "model.onnx").exists()
    rest = [
        each
        for each in _train(data, tmp_path / "stopped", settings, resume=True)
        if each.losses is not None
    ]
    assert [each.step for each in rest] == [5, 6]
    assert [each.losses.loss for each in rest] == [each.losses.loss for each in whole[4:]]  # type: ignore[union-attr]
    reports = [
        json.loads((tmp_path / name / "training.json").read_text()) for name in ("whole", "stopped")
    ]
    for report in reports:
        for row in report["losses"]:
            row.pop("seconds")
    assert reports[0]["losses"] == reports[1]["losses"] and len(reports[0]["losses"]) == 6
    assert reports[0]["held_out"] == reports[1]["held_out"]


def test_ctrl_c_waits_for_the_step_and_leaves_a_checkpoint(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = signal.getsignal(signal.SIGINT)

    def interrupt() -> None:
        while signal.getsignal(signal.SIGINT) is before:
            time.sleep(0.05)
        time.sleep(1.0)
        os.kill(os.getpid(), signal.SIGINT)

    alarm = threading.Thread(target=interrupt, daemon=True)
    alarm.start()
    options = [
        "--weights",
        "none",
        "--steps",
        "100000",
        "--batch",
        "1",
        "--side",
        "64",
        "--val",
        "0",
        "--json",
    ]
    assert main(["train", str(data), "--out", str(tmp_path / "out"), *options]) == 130
    alarm.join()
    printed = capsys.readouterr()
    assert "stopping after this step" in printed.err
    assert "stopped; the same command with --resume continues the run" in printed.err
    assert "discarded" not in printed.err
    last = json.loads(printed.out.splitlines()[-1])["step"]
    content = (tmp_path / "out" / "checkpoint.pt").read_bytes()
    assert read_checkpoint(content, "checkpoint").state["step"] == last


def test_checkpoints_come_between_checks_too(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sorvolo.lab.training.detector._SAVE_S", 0.0)  # else a minute
    settings = _settings(steps=400)
    for update in (run := _train(data, tmp_path / "out", settings)):
        if update.step == 2:  # long before the first check
            break
    content = (tmp_path / "out" / "checkpoint.pt").read_bytes()
    assert read_checkpoint(content, "checkpoint").state["step"] == 2
    run.close()  # type: ignore[attr-defined]
    with pytest.raises(SettingsError, match="already holds a run; resume continues it"):
        next(_train(data, tmp_path / "out", settings))
    other = _settings(steps=400, seed=2)
    with pytest.raises(
        SettingsError, match=r"cannot continue with other settings: .*seed was 1, is 2"
    ):
        list(_train(data, tmp_path / "out", other, resume=True))


def test_other_labels_are_other_data(tmp_path: Path) -> None:
    place = labelled_squares(tmp_path / "squares", 2, 3)
    run = _train(place, tmp_path / "out", _settings())
    for update in run:
        if update.step == 1:
            run.close()  # type: ignore[attr-defined]
    (place / "labels" / "flight0_0000.txt").write_text("0 0.5 0.5 0.2 0.2")
    with pytest.raises(SettingsError, match="cannot continue with other settings: data was"):
        list(_train(place, tmp_path / "out", _settings(), resume=True))


def test_damaged_pictures_are_passed_over_and_reported(tmp_path: Path) -> None:
    place = labelled_squares(tmp_path / "squares", 2, 3)
    path = place / "images" / "flight0_0001.png"
    path.write_bytes(path.read_bytes()[:2000])
    options = DataOptions(val="0")
    list(train_detector([place], tmp_path / "out", _settings(steps=2), options, device="cpu"))
    assert _counts_smallest_numbers()
    report = json.loads((tmp_path / "out" / "training.json").read_text())
    assert any(
        f"1 picture left out that cannot be read (first: {path}" in each
        for each in report["notices"]
    )
    assert any("nothing was held out" in each for each in report["notices"])
    assert report["held_out"] is None and report["model"]["thresholds"] == {"car": 0.5}


def _sets(*places: Path, val: str = "0.25", **options: object) -> TrainingSets:
    return training_sets(places, DataOptions(val, **options), seed=1)  # type: ignore[arg-type]


def test_whole_videos_are_held_out(data: Path) -> None:
    sets = _sets(data)
    learnt = {each.group for share in sets.shares for each in share.labelled.pictures}
    held = {each.group for labelled in sets.held_out for each in labelled.pictures}
    assert len(learnt) == 3 and len(held) == 1 and not learnt & held


@pytest.mark.long
def test_what_was_remarked_is_reported_on_the_terminal_too(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = labelled_squares(tmp_path / "other", 2, 2, names=("car", "boat"))
    options = [
        "--weights",
        "none",
        "--steps",
        "1",
        "--batch",
        "1",
        "--side",
        "64",
    ]
    command = ["train", str(data), "--val", str(other), "--out", str(tmp_path / "out"), *options]
    assert main(command) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert (
        "note other: 4 boxes of classes that stand for none of ours left out: boat (4)" in printed
    )
    assert "lie in both" in printed and "flight0" in printed
    notices = json.loads((tmp_path / "out" / "training.json").read_text())["notices"]
    assert all(" ".join(each.split()) in printed for each in notices)


def _greyed(place: Path, count: int) -> Path:
    """The folder, so many of its pictures, spread over it, without their colours."""
    paths = sorted((place / "images").glob("*.png"))
    for path in paths[:: len(paths) // count][:count]:
        cv2.imwrite(str(path), cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))
    return place


@pytest.mark.parametrize(
    ("thermal", "lights"),
    [
        (0, (False, True)),
        (1, (False, True)),
        (6, (True, True)),
        (20, (True, True)),
        (40, (True, False)),
    ],
)
def test_a_light_is_known_of_which_a_tenth_of_the_pictures_are(
    tmp_path: Path, thermal: int, lights: tuple[bool, bool]
) -> None:
    place = labelled_squares(tmp_path / "squares", 4, 10)
    sets = _sets(_greyed(place, thermal) if thermal else place, val="0")
    assert sets.lights == lights
    assert sum(len(share.labelled) for share in sets.shares) == 40
    if all(lights):
        assert {
            share.labelled.name: (len(share.labelled), share.thermal) for share in sets.shares
        } == {"squares": (40 - thermal, False), "squares, thermal": (thermal, True)}


def test_one_video_is_split_by_blocks_and_the_score_called_too_good(tmp_path: Path) -> None:
    sets = _sets(labelled_squares(tmp_path / "one", 1, 40))
    assert 0 < len(sets.held_out[0]) < 20 < len(sets.shares[0].labelled)
    assert any(
        "frames of one video look alike, so the score will be too good" in each
        for each in sets.notices
    )


def test_a_video_in_both_parts_is_warned_of(data: Path, tmp_path: Path) -> None:
    other = labelled_squares(tmp_path / "other", 2, 2)
    sets = _sets(data, val=str(other))
    assert len(sets.shares[0].labelled) == 20 and len(sets.held_out[0]) == 4
    assert any("lie in both" in each and "flight0" in each for each in sets.notices)


def test_classes_that_a_set_knows_nothing_of_are_unlabelled_there(
    data: Path, tmp_path: Path
) -> None:
    people = labelled_squares(tmp_path / "people", 4, 2, names=("person", "car"))
    sets = _sets(data, people)
    assert sets.classes == ("person", "car")
    assert [sorted(share.labelled.unlabelled) for share in sets.shares] == [["person"], []]
    assert any(each == "only 6 boxes of class person to learn from" for each in sets.notices)
    assert _sets(people, classes={"car": "small object"}).classes == ("small object",)


def test_simulated_pictures_are_one_more_set(data: Path, tmp_path: Path) -> None:
    wanted = PictureSettings(pictures=5, seed=1, thermal_share=0.4)
    *_, _ = simulate_pictures(tmp_path / "simulated", wanted)
    sets = _sets(data, tmp_path / "simulated", val="0")
    assert sets.classes == ("person", "car", "small object")
    weights = {share.labelled.name: share.weight for share in sets.shares}
    assert weights.pop("squares") > 5 and sum(weights.values()) == 5
    assert all(name.startswith("simulated") for name in weights)


def test_bad_input_is_reported(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def words(*arguments: str) -> str:
        assert main(["train", *arguments, "--out", str(tmp_path / "new" / "out")]) == 1
        assert not (tmp_path / "new").exists()
        return " ".join(capsys.readouterr().err.split())

    place = str(data)
    assert "neither an existing data set nor a share" in words(place, "--val", "gone")
    assert "share to check on (--val) must lie in 0 to below 1" in words(place, "--val", "1.5")
    assert "no data to learn from" in words()
    assert "does not exist" in words(str(tmp_path / "gone"))
    assert "side_px must be a multiple of 32, got 100" in words(place, "--side", "100")
    assert "steps must lie in 1" in words(place, "--steps", "0")
    assert "holds no checkpoint.pt to go on from" in words(place, "--resume")
    assert "there is no model 'gone'" in words(place, "--weights", "gone")
    thesis = ("--preset", "thesis", "--weights", "gone.tgz")
    assert "no weights at gone.tgz" in words(place, *thesis)
    assert "THEIRS=OURS" in words(place, "--classes", "=car")
    assert "ignore: 'Bicycle' is no name in the labels; there are: car" in words(
        place, "--ignore", "Bicycle"
    )
    assert "unlabelled: 'persn' is no class; there are: person, car" in words(
        place, "--unlabelled", "persn"
    )
    assert "none of its class names" in (printed := words(place, "--classes", "Boat=boat"))
    assert "such as --classes " in printed and "=person" in printed
    devices = [("tpu", "device must be auto, cpu or cuda, got 'tpu'")]
    if not torch.cuda.is_available():
        devices.append(("cuda", "sees no GPU; use the device cpu"))
    for device, refused in devices:
        with pytest.raises(SettingsError, match=refused):
            list(
                train_detector([data], tmp_path / "new", _settings(), DataOptions(), device=device)
            )


def test_pictures_without_any_object_teach_nothing(tmp_path: Path) -> None:
    place = labelled_squares(tmp_path / "squares", 2, 2)
    for path in (place / "labels").glob("*.txt"):
        path.write_text("")
    with pytest.raises(
        InputError, match="none of the pictures to learn from has a labelled object"
    ):
        _sets(place)
    for path in (place / "labels").glob("*.txt"):
        path.write_text("0 1.5 1.5 0.1 0.1\n")
    with pytest.raises(InputError, match=r"has a labelled object that can be used .*outside"):
        _sets(place)
    (place / "classes.txt").write_text("car\ntruck")
    for path in (place / "labels").glob("*.txt"):
        path.write_text("1 0.5 0.5 0.1 0.1\n")
    with pytest.raises(InputError, match=r"that can be used .*look-alikes .*truck \(.*classes"):
        _sets(place)


def test_a_model_that_finds_nothing_is_warned_of(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = labelled_squares(tmp_path / "squares", 4, 5)
    for path in (data / "images").glob("*.png"):  # labels that do not fit their pictures
        cv2.imwrite(str(path), np.zeros((96, 128, 3), np.uint8))
    options = [
        "--weights",
        "none",
        "--steps",
        "1",
        "--batch",
        "1",
        "--side",
        "64",
        "--val",
        "0.25",
    ]
    assert main(["train", str(data), "--out", str(tmp_path / "out"), *options]) == 0
    words = "the model finds next to nothing: its AP50 on the held-out pictures is 0.0"
    assert words in " ".join(capsys.readouterr().out.split())
    report = json.loads((tmp_path / "out" / "training.json").read_text())
    assert any(words in each for each in report["notices"])
    assert (
        report["found_px"] == {} and report["model"]["best_px"]["car"][0] > 20
    )  # of those learnt from
    page = (tmp_path / "out" / "training.html").read_text()
    assert words in page and "too few found" in page


def test_names_in_the_report_are_text() -> None:
    report = {
        "model": {"name": "<b>"},
        "found_px": {"<i>": (1, 2)},
        "held_out": {"ap50": 0.5, "classes": {"<i>": 0.5}},
        "reported": {"<i>": {"score": 0.5, "precision": None, "recall": 0.25}},
        "stopped_early": True,
        "step": 2,
        "steps": 5,
        "seconds": 3.0,
        "device": "cpu",
        "notices": ["<script>"],
        "losses": [{"step": k, "losses": {"<i>": 1.0 / k}} for k in (1, 2)],
        "checks": [{"step": k, "ap50": 0.1 * k, "classes": {"<i>": None}} for k in (1, 2)],
        "best_step": 2,
        "sets": [
            {
                "name": "<s>",
                "part": "learnt from",
                "pictures": 1,
                "videos": 1,
                "boxes": {"<i>": 3},
                "unlabelled": [],
            }
        ],
        "settings": {"preset": "fast"},
        "weights": "none",
        "export": {
            "box_px": 0.0,
            "score": 0.0,
            "detections": 3,
            "undecided": 0,
            "bytes": 5_000_000,
        },
    }
    page = training_page(report)
    assert (
        "<i>" not in page and "<script>" not in page and "<s>" not in page and "&lt;i&gt;" in page
    )
    assert "then its checks no longer got better" in page and page.count("<polyline") == 2
