"""`sorvolo train --weights MODEL`: a model is tuned to other pictures; what does not fit is reported."""

import json
import shutil
from pathlib import Path

import onnx
import pytest

torch = pytest.importorskip("torch")

from square_pictures import labelled_squares

from sorvolo.cli.main import main
from sorvolo.detection.detector import Detector
from sorvolo.detection.models import find_model
from sorvolo.errors import InputError
from sorvolo.lab.training.detector import train_detector
from sorvolo.lab.training.onnx_export import ExportedModel
from sorvolo.lab.training.sets import DataOptions
from sorvolo.lab.training.settings import TrainSettings
from sorvolo.lab.training.start import (
    begin_notices,
    kept_notices,
    kept_on_request,
    kept_thermal_by,
    load_start,
)

_BRIEFLY = ("--batch", "2", "--side", "64", "--val", "0.25")


def _settle_by_a_hundred(patch: pytest.MonkeyPatch) -> None:
    """So many of the pictures settle a model's norms: by a memory of 6 MP it would be 1500 of this size."""
    patch.setattr("sorvolo.lab.training.start._SETTLING_PX", 100 * 64 * 64)


@pytest.fixture(autouse=True)
def settled_by_a_hundred(monkeypatch: pytest.MonkeyPatch) -> None:
    _settle_by_a_hundred(monkeypatch)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return labelled_squares(tmp_path_factory.mktemp("data") / "squares", 4, 5)


@pytest.fixture(scope="module")
def learnt(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The model file of a short training from nothing."""
    out = tmp_path_factory.mktemp("runs") / "squares"
    assert (
        main(
            ["train", str(data), "--out", str(out), "--weights", "none", "--steps", "24", *_BRIEFLY]
        )
        == 0
    )
    return out / "model.onnx"


@pytest.fixture(scope="module")
def tuned(learnt: Path, data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a short training that begins from that model."""
    out = tmp_path_factory.mktemp("tuned") / "model"
    with pytest.MonkeyPatch.context() as patch:
        _settle_by_a_hundred(patch)
        assert (
            main(
                [
                    "train",
                    str(data),
                    "--out",
                    str(out),
                    "--weights",
                    str(learnt),
                    "--steps",
                    "3",
                    *_BRIEFLY,
                ]
            )
            == 0
        )
    return out


def _held_out_ap50(folder: Path) -> float:
    return float(json.loads((folder / "training.json").read_text())["held_out"]["ap50"])


@pytest.mark.long
def test_a_tuned_model_knows_at_once_what_its_beginning_knew(
    learnt: Path, tuned: Path, data: Path, tmp_path: Path
) -> None:
    new = tmp_path / "new"
    assert (
        main(
            ["train", str(data), "--out", str(new), "--weights", "none", "--steps", "3", *_BRIEFLY]
        )
        == 0
    )
    assert _held_out_ap50(new) < 0.1 < 0.5 * _held_out_ap50(learnt.parent) < _held_out_ap50(tuned)

    info = Detector.load(tuned / "model.onnx").info
    assert info.trained_on == "squares; the model squares before: squares"
    assert info.licence.endswith("the model squares before: as the data that it was trained on")
    report = json.loads((tuned / "training.json").read_text())
    assert report["weights"] == "the model squares" and report["export"]["good"]


@pytest.mark.long
def test_a_tuned_run_goes_on_from_its_own_model_only(
    learnt: Path, tuned: Path, data: Path, tmp_path: Path
) -> None:
    out = shutil.copytree(tuned, tmp_path / "out")
    command = ["train", str(data), "--out", str(out), "--steps", "3", *_BRIEFLY]
    assert main([*command, "--weights", str(learnt), "--resume"]) == 0
    assert main([*command, "--weights", "none", "--resume"]) == 1


@pytest.mark.long
def test_new_classes_are_learnt_from_the_beginning_and_reported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = labelled_squares(tmp_path / "both", 2, 3, names=("car", "boat"))
    out = tmp_path / "out"
    command = [
        "train",
        str(data),
        "--out",
        str(out),
        "--weights",
        "default",
        "--steps",
        "1",
        *_BRIEFLY,
    ]
    assert main([*command, "--classes", "car,boat"]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "note the model default does not know boat: learnt from the beginning" in printed
    assert "note the model default knows person, small object, which nothing here labels" in printed
    notices = json.loads((out / "training.json").read_text())["notices"]
    assert any("does not know boat" in each for each in notices)
    info = Detector.load(out / "model.onnx").info
    assert info.classes == ("car", "boat")

    # the packaged model joins networks: what a training does not carry on, and from which scores its part reports
    card = json.loads(find_model("default").with_suffix(".json").read_text())
    assert (
        info.thresholds["car"]
        == card["aerial_alone"]["thresholds"]["car"]
        != card["thresholds"]["car"]
    )
    not_carried_on = "only the aerial network of the model default is learnt on from. Not carried on: NanoDet's network"
    assert not_carried_on in printed
    assert any(not_carried_on in each for each in notices)
    assert any("car kept those of the model's aerial network by itself" in each for each in notices)
    assert info.best_px["car"] == tuple(card["best_px"]["car"])
    assert any(
        "at which sizes they are found well: car kept those of the model default" in each
        for each in notices
    )
    assert "the judge of cars" in json.loads((out / "training.json").read_text())["not_carried_on"]


def test_a_model_of_several_networks_without_its_card_keeps_no_thresholds(tmp_path: Path) -> None:
    own = tmp_path / "own.onnx"
    shutil.copy(find_model("thermal"), own)
    start = load_start(str(own), "fast")
    assert isinstance(start, ExportedModel)
    assert not start.thresholds
    assert "NanoDet's network" in begin_notices(start, start.info.classes)[0]
    notice = kept_notices(start, ("car", "boat"), ())[0]
    assert "the scores from which car are reported are not calibrated" in notice
    packaged = load_start("thermal", "fast")
    assert isinstance(packaged, ExportedModel)
    assert set(packaged.thresholds) == set(packaged.info.classes)
    by_day = load_start("default", "fast")
    assert isinstance(by_day, ExportedModel)
    softening = (
        "the softening of sharp pictures"  # in front of the aerial network, since version 12
    )
    assert (
        softening in by_day.left
        and softening in begin_notices(by_day, by_day.info.classes)[0]
        and softening not in packaged.left
    )


@pytest.mark.long  # its rules have tests of their own below
def test_a_tuned_model_is_used_as_the_one_before_where_nothing_new_was_measured(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = labelled_squares(tmp_path / "both", 2, 3, names=("car", "small object"))
    command = ["train", str(data), "--steps", "1", *_BRIEFLY]
    assert main([*command, "--out", str(tmp_path / "first"), "--weights", "none"]) == 0
    before = onnx.load(tmp_path / "first" / "model.onnx")
    (entry,) = [each for each in before.metadata_props if each.key == "sorvolo"]
    entry.value = json.dumps(
        json.loads(entry.value) | {"on_request": ["small object"], "thermal_by": "thermal"}
    )
    onnx.save(before, tmp_path / "before.onnx")
    capsys.readouterr()

    assert (
        main(
            [*command, "--out", str(tmp_path / "tuned"), "--weights", str(tmp_path / "before.onnx")]
        )
        == 0
    )
    info = Detector.load(tmp_path / "tuned" / "model.onnx").info
    assert (info.classes, info.usual_classes, info.thermal_by) == (
        ("car", "small object"),
        ("car",),
        "thermal",
    )
    assert "small object: reported only where asked for (--classes)" in " ".join(
        capsys.readouterr().out.split()
    )


def test_what_of_the_use_of_a_model_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SORVOLO_MODELS", str(tmp_path))
    start = load_start("default", "fast")
    assert isinstance(start, ExportedModel)
    classes = ("person", "small object")
    assert kept_on_request(start, classes, classes) == ("small object",)
    assert (
        kept_on_request(start, classes, ("person",)) == ()
    )  # enough held-out ones chose its score
    assert kept_on_request(start, ("person",), ("person",)) == ()
    assert (
        kept_on_request(start, ("small object",), ("small object",)) == ()
    )  # it was made for nothing else
    assert kept_thermal_by(start, classes, thermal=False) == "thermal"
    assert kept_thermal_by(start, classes, thermal=True) == ""
    assert (
        kept_thermal_by(start, ("boat",), thermal=False) == ""
    )  # any other that knows boats may look


@pytest.mark.long
def test_the_four_steps_begin_from_a_model_too(learnt: Path, data: Path, tmp_path: Path) -> None:
    settings = TrainSettings(
        schedule="four-steps", weights=str(learnt), steps=4, batch=2, side_px=64
    )
    list(train_detector([data], tmp_path / "out", settings, DataOptions("0.25"), device="cpu"))
    assert json.loads((tmp_path / "out" / "training.json").read_text())["export"]["good"]


@pytest.mark.long
def test_models_that_do_not_fit_are_reported(
    learnt: Path, data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def words(*arguments: str) -> str:
        assert (
            main(
                [
                    "train",
                    str(data),
                    "--out",
                    str(tmp_path / "out"),
                    "--steps",
                    "1",
                    *_BRIEFLY,
                    *arguments,
                ]
            )
            == 1
        )
        return " ".join(capsys.readouterr().err.split())

    def told_as(**changes: object) -> str:
        """The learnt model with another description."""
        model = onnx.load(learnt)
        (entry,) = [each for each in model.metadata_props if each.key == "sorvolo"]
        entry.value = json.dumps(json.loads(entry.value) | changes)
        onnx.save(model, tmp_path / "described.onnx")
        return str(tmp_path / "described.onnx")

    assert "is of the preset fast, not thesis: train with --preset fast" in words(
        "--weights", str(learnt), "--preset", "thesis"
    )
    assert "is of the preset yolo, which cannot be trained; there are fast, thesis" in words(
        "--weights", told_as(preset="yolo")
    )
    assert "'second-opinion' only looks again at what other models report" in words(
        "--weights", "second-opinion"
    )
    thesis = told_as(preset="thesis")
    assert "cannot be learnt on from: a model file of the preset thesis lacks" in words(
        "--weights", thesis, "--preset", "thesis"
    )
    standard = TrainSettings(rpn="standard", weights=str(learnt), steps=1, batch=2, side_px=64)
    with pytest.raises(InputError, match=r"does not fit the network.* same preset, rpn"):
        list(train_detector([data], tmp_path / "out", standard, DataOptions("0.25"), device="cpu"))
    assert "is in int8 and cannot be learnt on from; give the float32 model" in words(
        "--weights", "default-int8"
    )
    assert "there is no model file" in words("--weights", "gone.onnx")
    assert "no weights at nobody" in (printed := words("--weights", "nobody"))
    assert "or a model to tune: a .onnx file, or a name that `sorvolo models list` shows" in printed
    (tmp_path / "junk.onnx").write_bytes(b"junk")
    assert "damaged or no ONNX file" in words("--weights", str(tmp_path / "junk.onnx"))
    assert find_model("default-int8").is_file()
