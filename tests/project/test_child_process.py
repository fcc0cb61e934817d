"""A stranger's folder holds files with any name: Sorvolo's own processes never run them."""

import re
import subprocess
from pathlib import Path

import pytest

from sorvolo.child_process import python_command

PACKAGE = Path(__file__).parents[2] / "src" / "sorvolo"
CHILDREN = sorted(
    ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts)
    for path in PACKAGE.rglob("*.py")
    if '__name__ == "__main__"' in path.read_text()
)


@pytest.mark.parametrize("module", CHILDREN)
def test_a_child_does_not_run_the_files_of_the_current_folder(module: str, tmp_path: Path) -> None:
    for name in ("numpy", "cv2", "json", "sorvolo", "struct", "secrets"):
        (tmp_path / f"{name}.py").write_text(f"open({str(tmp_path / 'poisoned')!r}, 'w').close()\n")
    subprocess.run(
        python_command(module, "no-such-folder"),
        cwd=tmp_path,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        timeout=120,
        check=False,
    )
    assert not (tmp_path / "poisoned").exists()


def test_every_child_is_started_by_the_one_helper() -> None:
    assert len(CHILDREN) >= 5
    others = [
        path.relative_to(PACKAGE).as_posix()
        for path in PACKAGE.rglob("*.py")
        if path.name != "child_process.py" and re.search(r'sys\.executable|"-m"', path.read_text())
    ]
    assert not others
