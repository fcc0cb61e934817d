"""Where tests on real flights and pictures find them; what is not there is skipped by name."""

import os
from pathlib import Path

import pytest

_DATA = Path(
    os.environ.get("SORVOLO_DATA") or Path(__file__).resolve().parents[2] / "shared" / "data"
)


def real_data(name: str) -> Path:
    """The file or folder of this name in the data folder; skips the test where it is missing."""
    path = _DATA / name
    if not path.exists():
        pytest.skip(f"real data is not here: {name} in {_DATA}")
    return path
