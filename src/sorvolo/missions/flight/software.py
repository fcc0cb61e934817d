"""The versions of what computes a map: part of what is asked for of a flight, and of its report."""

import platform
from importlib.metadata import version

_LIBRARIES = ("numpy", "scipy", "opencv-contrib-python-headless", "av", "rasterio")


def software() -> dict[str, str]:
    """The versions of what computes a map, by name."""
    return {"python": platform.python_version(), **{name: version(name) for name in _LIBRARIES}}
