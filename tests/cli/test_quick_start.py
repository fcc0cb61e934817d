"""What the command loads before it does anything, and what a shell gets to complete it."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from sorvolo.cli.main import app

_HEAVY = ("cv2", "rasterio", "onnxruntime", "scipy", "sqlalchemy", "av", "torch", "numpy")
_PROBE = f"""
import sys
from sorvolo.cli.main import main
code = main(sys.argv[1:])
loaded = [name for name in {_HEAVY} if name in sys.modules]
sys.exit(f"exit code {{code}}" if code else f"loaded: {{loaded}}" if loaded else 0)
"""


def _run(arguments: list[str], **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *arguments],
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


_NAMES = [each.name or "" for each in app.registered_commands]


@pytest.mark.parametrize("command", ["", *_NAMES, "evaluate detector", "models verify"])
def test_help_loads_nothing_heavy(command: str) -> None:
    run = _run(["-c", _PROBE, *command.split(), "--help"])
    assert run.returncode == 0, run.stderr


def test_the_probe_finds_what_is_loaded() -> None:
    run = _run(["-c", _PROBE.replace("main(sys.argv[1:])", "(__import__('cv2'), 0)[1]")])
    assert run.returncode != 0 and "cv2" in run.stderr  # the probe finds what it looks for


def test_completion_can_be_installed(tmp_path: Path) -> None:
    run = _run(
        ["-m", "sorvolo", "--install-completion", "bash"],
        HOME=str(tmp_path),
        _TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION="1",
    )
    assert run.returncode == 0, run.stderr
    script = tmp_path / ".bash_completions" / "sorvolo.sh"
    assert "sorvolo" in script.read_text() and "sorvolo.sh" in (tmp_path / ".bashrc").read_text()


def test_a_shell_is_given_the_commands() -> None:
    run = _run(
        ["-m", "sorvolo"],
        _SORVOLO_COMPLETE="complete_bash",
        COMP_WORDS="sorvolo pl",
        COMP_CWORD="1",
    )
    assert run.stdout.split() == ["plan"]
