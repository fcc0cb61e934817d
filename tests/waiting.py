"""Waiting for the thing itself: a test that waits for time fails on a machine that is slower, or busy."""

import time
from collections.abc import Callable


def wait_for(is_there: Callable[[], object], limit_s: float = 60.0) -> None:
    """Wait until something is there. What does not come in so long a time never comes: the test fails."""
    end_s = time.monotonic() + limit_s
    while not is_there():
        assert time.monotonic() < end_s, f"not there after {limit_s:g} s"
        time.sleep(0.02)
