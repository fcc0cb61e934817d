"""A training that is killed outright goes on with the same command and --resume, and ends with a whole model."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("torch")

from square_pictures import labelled_squares

from sorvolo.detection.detector import Detector

_STEPS, _KILLED_AT = 60, 53  # its one checkpoint before the end is that of the check at step 50


def _command(data: Path, out: Path, *more: str) -> list[str]:
    return [
        sys.executable,
        "-m",
        "sorvolo",
        "train",
        str(data),
        "--out",
        str(out),
        "--weights",
        "none",
        "--steps",
        str(_STEPS),
        "--batch",
        "1",
        "--side",
        "64",
        "--val",
        "0.25",
        "--json",
        *more,
    ]


@pytest.mark.long
@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs a signal that cannot be caught")
def test_a_killed_training_goes_on_and_ends_with_a_whole_model(tmp_path: Path) -> None:
    data, out = labelled_squares(tmp_path / "squares", 4, 3), tmp_path / "out"
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    with subprocess.Popen(
        _command(data, out), stdout=subprocess.PIPE, text=True, env=environment
    ) as training:
        assert training.stdout is not None
        for line in training.stdout:
            if json.loads(line)["step"] >= _KILLED_AT:
                training.kill()
                break
    assert training.returncode == -signal.SIGKILL
    assert (out / "checkpoint.pt").is_file() and not (out / "model.onnx").exists()
    (out / ".tmp-1-0-checkpoint.pt").write_bytes(b"what a kill in the middle of writing leaves")

    rest = subprocess.run(
        _command(data, out, "--resume"),
        stdout=subprocess.PIPE,
        text=True,
        env=environment,
        check=True,
    )
    steps = [row["step"] for row in map(json.loads, rest.stdout.splitlines()) if row["losses"]]
    assert steps == list(range(51, _STEPS + 1))
    report = json.loads((out / "training.json").read_text())
    assert report["step"] == _STEPS and [row["step"] for row in report["losses"]] == list(
        range(1, _STEPS + 1)
    )
    assert Detector.load(out / "model.onnx").classes == ("car",)
    assert not list(out.glob(".tmp-*"))
