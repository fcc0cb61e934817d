"""Freed memory given back to the system between the stages of a run."""

import ctypes
import sys


def give_back() -> None:
    """Return what was freed to the system.

    glibc keeps it between pieces that are in use: after the many large arrays of a stage some hundred megabytes, which
    the next stage, asking for other sizes, takes anew. Elsewhere nothing is done.
    """
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # musl has none
        if trim is not None:
            trim(0)
