"""Sorvolo: geo-referenced maps from small drones while they fly, and what changed on the ground since.

What the commands do is here under the names in `__all__` (docs/python.md shows each); a name is loaded when
it is first used, so that `import sorvolo` alone is quick. `__init__.pyi` lists the names with their homes.
"""

import re
from importlib import import_module
from pathlib import Path
from typing import Any

from sorvolo.build import VERSION

__version__ = VERSION

_HOMES = {
    name: home
    for home, name in re.findall(
        r"^from (\S+) import \w+ as (\w+)$", Path(__file__).with_suffix(".pyi").read_text(), re.M
    )
}
__all__ = ["__version__", *sorted(_HOMES)]  # noqa: PLE0604


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        try:
            return getattr(import_module(_HOMES[name]), name)
        except ModuleNotFoundError as error:
            return _refuse(name, error)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def _refuse(name: str, lacking: ModuleNotFoundError) -> Any:
    """A function in place of one whose extra is not installed, so that all other names and their help are there."""

    def refuse(*_: object, **__: object) -> Any:
        raise ImportError(
            f"sorvolo.{name} needs {lacking.name}: pip install 'sorvolo[training]'"
        ) from lacking

    return refuse


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
