"""The systemd units that docs/cluster.md shows are ones that systemd takes."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest

PAGE = Path(__file__).parents[2] / "docs" / "cluster.md"


@pytest.mark.skipif(
    shutil.which("systemd-analyze") is None, reason="systemd-analyze is not installed"
)
def test_units_are_verified_by_systemd(tmp_path: Path) -> None:
    text = PAGE.read_text()
    units = re.findall(
        r"`/etc/systemd/system/([\w-]+\.service)`:\n\n```ini\n(.*?)```", text, re.DOTALL
    )
    assert [name for name, _ in units] == [
        "sorvolo-head.service",
        "sorvolo-worker.service",
        "sorvolo-batch.service",
    ]
    for program in ("ray", "sorvolo"):
        (tmp_path / program).write_text("#!/bin/sh\n")
        (tmp_path / program).chmod(0o755)
    for name, unit in units:
        (tmp_path / name).write_text(unit.replace("/opt/sorvolo/bin", str(tmp_path)))
        done = subprocess.run(
            ["systemd-analyze", "verify", str(tmp_path / name)],
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0 and name not in done.stderr, done.stderr
