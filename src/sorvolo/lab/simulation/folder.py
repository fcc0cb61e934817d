"""The folder of a simulation: it appears whole or not at all, and takes the place of an earlier one only."""

import os
import platform
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

from sorvolo import __version__
from sorvolo.errors import SettingsError
from sorvolo.lab.simulation.flight_files import write_json
from sorvolo.store.atomic import writing

MARK = "simulation.json"
"""The file that marks a folder that holds simulated flights, and may be replaced by another simulation."""

PICTURES_MARK = "boxes.json"
"""The same of simulated pictures: their COCO file, so that it is the one JSON file of its folder."""

_MADE_BY = "sorvolo simulate"


@contextmanager
def simulation_folder(folder: Path, mark: str, description: Mapping[str, Any]) -> Iterator[Path]:
    """A hidden folder beside `folder`, holding the file `mark` with the description; renamed when the block ends well.

    Raises SettingsError for a folder that holds anything but an earlier simulation, StoreError for a full disk.
    """
    folder = folder.resolve()
    _demand_free(folder)
    partial = folder.with_name(f".{folder.name}.partial")
    with writing(folder):
        _remove_ours(partial)
        partial.mkdir(parents=True)
    write_json(partial / mark, description)
    yield partial
    _put_in_place(partial, folder)


def simulation_description(settings: Mapping[str, Any]) -> dict[str, Any]:
    """What made the simulation: settings, seed and versions, by which it can be made again."""
    return {
        "made_by": _MADE_BY,
        "versions": {
            "sorvolo": __version__,
            "python": platform.python_version(),
            "numpy": version("numpy"),
            "opencv": version("opencv-contrib-python-headless"),
            "av": version("av"),
        },
        "settings": settings,
    }


def _is_ours(folder: Path) -> bool:
    return any(
        f'"made_by":"{_MADE_BY}"' in _start_of(folder / mark) for mark in (MARK, PICTURES_MARK)
    )


def _start_of(path: Path) -> str:
    try:
        with path.open("rb") as file:
            return file.read(4096).decode("utf-8", "replace")
    except OSError:
        return ""


def _demand_free(folder: Path) -> None:
    if folder.exists() and not folder.is_dir():
        raise SettingsError(f"{folder} is a file; choose a folder for the simulation")
    if folder.is_dir() and any(folder.iterdir()) and not _is_ours(folder):
        raise SettingsError(
            f"{folder} is not empty and holds no earlier simulation; choose another folder, or empty it"
        )


def _remove_ours(folder: Path) -> None:
    """Delete what a killed simulation left; it wrote its mark first."""
    if folder.is_dir() and (_is_ours(folder) or not any(folder.iterdir())):
        shutil.rmtree(folder)


def _put_in_place(partial: Path, folder: Path) -> None:
    """Rename the finished folder to its place; an earlier simulation steps aside first and goes last."""
    old = folder.with_name(f".{folder.name}.old")
    with writing(folder):
        _remove_ours(old)
        if folder.exists():
            os.replace(folder, old)
        os.replace(partial, folder)
        shutil.rmtree(old, ignore_errors=True)
