"""How much memory a mission may take for what it could also read again."""

import os
from dataclasses import dataclass
from pathlib import Path

from sorvolo.errors import SettingsError

_CGROUP_LIMIT = Path("/sys/fs/cgroup/memory.max")


@dataclass(frozen=True)
class MemorySettings:
    """What a mission takes where nobody chose, and how it is divided."""

    share: float = 0.25  # of the machine's memory, or of the container's limit
    enough_mb: float = 512.0  # more saves no time
    least_mb: float = (
        64.0  # with less, a picture of 12 megapixels and the tiles below it do not fit
    )
    tiles_mb: int = 24  # at most, for tiles: each is painted once
    least_images_mb: int = 64  # at most for pictures that are small, and
    images_mb: int = 256  # for large ones: more gains nothing
    waiting_mb: int = 64  # for frames that wait for the detector, though one may always
    waiting_on_disk: int = 256  # frames of a live flight at most: 1.6 GB of 1080p
    pictures: int = (
        6  # as many of the flight's as are wanted at once, those beside each other in two strips
    )


def memory_budget_bytes(
    memory_mb: float | None, settings: MemorySettings = MemorySettings()
) -> int:
    """The budget in bytes: the given one (MB), else 512 MB, or a quarter of the machine's memory or of the
    container's limit where that is less.

    Raises SettingsError when it is too small to work with.
    """
    if memory_mb is None:
        return int(min(1e6 * settings.enough_mb, settings.share * available_bytes()))
    if not memory_mb >= settings.least_mb:
        raise SettingsError(
            f"memory_mb must be at least {settings.least_mb:g} MB, got {memory_mb:g}"
        )
    return int(memory_mb * 1e6)


def available_bytes() -> int:
    """The machine's memory, or the container's limit."""
    machine = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    try:
        limit = _CGROUP_LIMIT.read_text().strip()
    except OSError:
        return machine
    return min(machine, int(limit)) if limit.isdigit() else machine
