"""The notebooks of docs/notebooks run from their first cell to their last."""

import importlib.util
import json
import tempfile
from pathlib import Path

import pytest

NOTEBOOKS = Path(__file__).parents[2] / "docs" / "notebooks"
NEEDS = {"map_and_changes": ("geopandas", "matplotlib"), "tune_detector": ("torch",)}


def test_every_notebook_is_tried_and_kept_without_output() -> None:
    paths = sorted(NOTEBOOKS.glob("*.ipynb"))
    assert [path.stem for path in paths] == sorted(NEEDS)
    for path in paths:
        for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
            assert not cell.get("outputs") and cell.get("execution_count") is None


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        pytest.param("map_and_changes", marks=pytest.mark.long),  # so have `map` and `compare`
        pytest.param("tune_detector", marks=pytest.mark.long),  # `train` has tests of its own
    ],
)
def test_notebook_runs(
    name: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    missing = [each for each in NEEDS[name] if importlib.util.find_spec(each) is None]
    if missing:
        pytest.skip(f"the notebook {name} needs {', '.join(missing)}")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    notebook = json.loads((NOTEBOOKS / f"{name}.ipynb").read_text(encoding="utf-8"))
    variables: dict[str, object] = {"__name__": "__main__"}
    for number, cell in enumerate(notebook["cells"]):
        if cell["cell_type"] == "code":
            code = compile("".join(cell["source"]), f"{name}.ipynb, cell {number}", "exec")
            exec(code, variables)
    printed = capsys.readouterr().out
    if name == "map_and_changes":
        assert "frames matched" in printed and "m2 mapped" in printed and "found" in printed
        assert len(variables["changes"]) > 0  # type: ignore[arg-type]
        assert (Path(str(variables["folder"])) / "changes.png").stat().st_size > 10_000
    else:
        assert "12 pictures" not in printed and "8 pictures" in printed and "model.onnx" in printed
        assert "objects on an empty picture" in printed
