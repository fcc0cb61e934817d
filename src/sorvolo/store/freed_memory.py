"""Memory that was freed: shared by threads, and given back to the system between the stages of a run."""

import ctypes
import os
import sys

_M_ARENA_MAX = -8  # glibc's malloc.h
_ARENAS = 2  # the main one, and one for all threads beside it


def share_arenas() -> None:
    """Let all threads take their memory from two pools; to be called before the first of them begins.

    glibc gives each thread one of its own, up to eight a core, and what is free in one serves no other: on a map of
    20,000 frames some 20 MB. Elsewhere nothing is done, nor where `MALLOC_ARENA_MAX` has chosen.
    """
    if sys.platform == "linux" and "MALLOC_ARENA_MAX" not in os.environ:
        mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
        if mallopt is not None:
            mallopt(_M_ARENA_MAX, _ARENAS)


def give_back() -> None:
    """Return what was freed to the system.

    glibc keeps it between pieces that are in use: after the many large arrays of a stage some hundred megabytes, which
    the next stage, asking for other sizes, takes anew. Elsewhere nothing is done.
    """
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # musl has none
        if trim is not None:
            trim(0)
