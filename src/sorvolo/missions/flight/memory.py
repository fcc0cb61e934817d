"""How much memory a mission may take for what it could also read again."""

import os
from pathlib import Path

from sorvolo.errors import SettingsError

_SHARE, _ENOUGH_BYTES = 0.25, 512_000_000  # of the machine, where nobody chose; more saves no time
_LEAST_MB = 64
_CGROUP_LIMIT = Path("/sys/fs/cgroup/memory.max")


def memory_budget_bytes(memory_mb: float | None) -> int:
    """The budget in bytes: the given one (MB), else 512 MB, or a quarter of the machine's memory or of the
    container's limit where that is less.

    Raises SettingsError when it is too small to work with.
    """
    if memory_mb is None:
        return min(_ENOUGH_BYTES, int(_SHARE * available_bytes()))
    if not memory_mb >= _LEAST_MB:
        raise SettingsError(f"--memory must be at least {_LEAST_MB} MB, got {memory_mb:g}")
    return int(memory_mb * 1e6)


def available_bytes() -> int:
    """The machine's memory, or the container's limit."""
    machine = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    try:
        limit = _CGROUP_LIMIT.read_text().strip()
    except OSError:
        return machine
    return min(machine, int(limit)) if limit.isdigit() else machine
