"""The few loops that must be fast; numbers in, numbers out. This module is the only door.

Each kernel exists twice with one signature: compiled in `_native`, and in NumPy in `reference`, which says what it
computes. Both give the same numbers. Where nothing was compiled the slow ones are used, with one warning.
"""

import warnings
from types import ModuleType

from sorvolo.kernels import reference

_native: ModuleType | None
try:
    from sorvolo.kernels import _native
except ImportError:
    _native = None
    warnings.warn(
        "sorvolo's compiled kernels are missing, change detection will be some 100 times slower; "
        "install a C++17 compiler and reinstall sorvolo",
        RuntimeWarning,
        stacklevel=2,
    )

COMPILED = _native is not None
"""Whether the compiled kernels are in use."""
