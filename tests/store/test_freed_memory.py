"""Memory that was freed goes back to the system."""

import os
import platform
import subprocess
import sys
from pathlib import Path

import pytest

from sorvolo.store.freed_memory import give_back


def _resident_mb() -> float:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc keeps freed memory so")
def test_what_lies_between_pieces_in_use_is_returned() -> None:
    pieces = [bytes(100_000) for _ in range(800)]
    kept = pieces[::100]  # the last among them: the heap's end stays in use
    kept.append(pieces[-1])
    del pieces
    before_mb = _resident_mb()
    give_back()
    assert before_mb - _resident_mb() > 40
    assert len(kept) == 9


_THREADS_THAT_HOLD_MEMORY = """
import ctypes, threading
from sorvolo.store.freed_memory import share_arenas
if {shares}:
    share_arenas()
all_hold = threading.Barrier(7)
def hold():
    held = [bytearray(2000) for _ in range(200)]
    all_hold.wait()
    all_hold.wait()
    del held
threads = [threading.Thread(target=hold) for _ in range(6)]
for each in threads:
    each.start()
all_hold.wait()
libc = ctypes.CDLL(None)
libc.fdopen.restype = ctypes.c_void_p
out = ctypes.c_void_p(libc.fdopen(1, b"w"))
libc.malloc_info(0, out)
libc.fflush(out)
all_hold.wait()
"""


@pytest.mark.skipif(
    platform.libc_ver()[0] != "glibc", reason="only glibc has a pool of memory for each thread"
)
@pytest.mark.parametrize(("shares", "most"), [(True, 2), (False, 99)])
def test_threads_take_their_memory_from_two_pools(shares: bool, most: int) -> None:
    environment = {name: value for name, value in os.environ.items() if name != "MALLOC_ARENA_MAX"}
    found = subprocess.run(
        [sys.executable, "-c", _THREADS_THAT_HOLD_MEMORY.format(shares=shares)],
        env=environment,
        check=True,
        capture_output=True,
        text=True,
    )
    assert (1 if shares else 3) <= found.stdout.count("<heap nr=") <= most
