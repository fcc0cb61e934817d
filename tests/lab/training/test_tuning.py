"""`sorvolo train --weights MODEL`: a model is tuned to other pictures; what does not fit is reported."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import onnx
import pytest

torch = pytest.importorskip("torch")

from square_pictures import labelled_squares

from sorvolo.cli.main import main
from sorvolo.detection.detector import Detector
from sorvolo.detection.fusing import in_own_scale
from sorvolo.detection.models import find_model
from sorvolo.detection.session import read_info
from sorvolo.lab.training.settings import TrainSettings
from sorvolo.lab.training.single_stage import SingleStage
from sorvolo.lab.training.start import kept_on_request, kept_thermal_by, load_start

_BRIEFLY = ("--batch", "2", "--side", "64", "--val", "0.25")


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
    command = ["train", str(data), "--out", str(out), "--weights", str(learnt), "--steps", "3"]
    assert main([*command, *_BRIEFLY]) == 0
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
    learnt_ap50, tuned_ap50 = _held_out_ap50(learnt.parent), _held_out_ap50(tuned)
    assert 2 * _held_out_ap50(new) < learnt_ap50 and 0.5 * learnt_ap50 < tuned_ap50

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


def test_a_training_begins_from_the_packaged_model(tmp_path: Path) -> None:
    start = load_start(TrainSettings())
    named = load_start(TrainSettings(weights="default"))
    assert start is not None and named is not None and start.info is not None
    assert (start.identity, start.origin) == (named.identity, "the model default")
    assert load_start(TrainSettings(weights="none")) is None
    network = SingleStage(2)
    network.carry_on(start.layers, start.info.classes, ("boat", "car"))
    weight, theirs = (
        each["head.fine_output.weight"] for each in (network.state_dict(), start.layers)
    )
    assert torch.equal(weight[1], theirs[start.info.classes.index("car")])


@pytest.mark.long
def test_new_classes_are_learnt_from_the_beginning_and_reported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = labelled_squares(tmp_path / "both", 2, 3, names=("car", "boat"))
    out = tmp_path / "out"
    command = ["train", str(data), "--out", str(out), "--weights", "default", "--steps", "1"]
    assert main([*command, *_BRIEFLY, "--classes", "car,boat"]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "note the model default does not know boat: learnt from the beginning" in printed
    assert "note the model default knows person, small object, which nothing here labels" in printed
    notices = json.loads((out / "training.json").read_text())["notices"]
    assert any("does not know boat" in each for each in notices)
    assert any("too few objects" in each and "car kept those" in each for each in notices)
    info, before = Detector.load(out / "model.onnx").info, read_info(find_model("default"))
    assert info.classes == ("car", "boat")
    assert in_own_scale(info)["car"] == pytest.approx(in_own_scale(before)["car"])
    assert info.best_px["car"] == before.best_px["car"]


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
    before = replace(
        read_info(find_model("default")), on_request=("small object",), thermal_by="thermal"
    )
    classes = ("person", "small object")
    assert kept_on_request(before, classes, classes) == ("small object",)
    assert (
        kept_on_request(before, classes, ("person",)) == ()
    )  # enough held-out ones chose its score
    assert kept_on_request(before, ("person",), ("person",)) == ()
    assert (
        kept_on_request(before, ("small object",), ("small object",)) == ()
    )  # it was made for nothing else
    assert kept_thermal_by(before, classes, thermal=False) == "thermal"
    assert kept_thermal_by(before, classes, thermal=True) == ""
    assert (
        kept_thermal_by(before, ("boat",), thermal=False) == ""
    )  # any other that knows boats may look


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

    model = onnx.load(learnt)
    for each in model.graph.initializer:
        for node in model.graph.node:
            node.input[:] = [f"old.{name}" if name == each.name else name for name in node.input]
        each.name = f"old.{each.name}"
    onnx.save(model, tmp_path / "other.onnx")
    printed = words("--weights", str(tmp_path / "other.onnx"))
    assert "cannot be learnt on from: it holds another network than the preset fast" in printed
    assert "is missing; give a model that this version" in printed
    assert "for the preset thesis --weights takes auto, none" in words(
        "--weights", str(learnt), "--preset", "thesis", "--steps", "4"
    )
    assert "there is no model file" in words("--weights", "gone.onnx")
    assert "there is no model 'nobody'" in words("--weights", "nobody")
    (tmp_path / "junk.onnx").write_bytes(b"junk")
    assert "damaged or no ONNX file" in words("--weights", str(tmp_path / "junk.onnx"))
