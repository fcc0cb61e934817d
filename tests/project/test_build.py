"""What names a build: an update of the code is another one, and takes up nothing of the one before."""

import shutil
import subprocess
import sys
from pathlib import Path

import sorvolo
from sorvolo.build import build


def test_a_line_of_code_makes_another_build(tmp_path: Path) -> None:
    package = Path(sorvolo.__file__).parent
    copy = tmp_path / "sorvolo"
    shutil.copytree(
        package,
        copy,
        ignore=lambda _, names: [n for n in names if n.endswith((".onnx", ".so", ".pyc"))],
    )
    command = [sys.executable, "-P", "-c", "from sorvolo.build import build; print(build())"]

    def of_copy() -> str:
        run = subprocess.run(
            command, env={"PYTHONPATH": str(tmp_path)}, capture_output=True, text=True, check=True
        )
        return run.stdout.strip()

    assert of_copy() == build()
    with (copy / "errors.py").open("a") as file:
        file.write("# another line\n")
    assert of_copy() != build()
    assert of_copy().partition("+")[0] == build().partition("+")[0] == sorvolo.__version__
