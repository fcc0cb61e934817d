"""Two flights over one site: what changed on the ground."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sorvolo.change.compare import Comparison, compare_images

__all__ = ["Comparison", "compare_images"]


def __getattr__(name: str) -> Any:
    if name in __all__:
        return getattr(import_module("sorvolo.change.compare"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
