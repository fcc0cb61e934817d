"""Memory that was freed goes back to the system."""

import os
import platform
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
