"""Waiting for the thing itself: a test that waits for time fails on a machine that is slower, or busy."""

import time
from collections.abc import Callable


def wait_for(is_there: Callable[[], object], limit_s: float = 60.0) -> None:
    """Wait until something is there. What does not come in so long a time never comes: the test fails."""
    begun_s = time.monotonic()
    while not is_there():
        waited_s = time.monotonic() - begun_s
        assert waited_s < limit_s, f"not there after {limit_s:g} s"
        time.sleep(min(0.02 + waited_s / 20, 0.1))  # asking takes a processor's time too
