"""Work beside a live flight's map that may wait: it takes the processor where nothing else of the mission wants it."""

import os
import sys
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

T = TypeVar("T")

_NICE = 10  # a tenth of the share that a thread of usual priority has, where both want a core


def lower_priority() -> None:
    """Have this thread, and those that it starts, run after the others; on Linux, where a thread has its own."""
    if sys.platform == "linux":
        own = threading.get_native_id()
        os.setpriority(os.PRIO_PROCESS, own, max(_NICE, os.getpriority(os.PRIO_PROCESS, own)))


def made_at_low_priority(make: Callable[[], T]) -> T:
    """What `make` makes in a thread of low priority: threads that it starts, a network's for example, keep it."""
    with ThreadPoolExecutor(1, initializer=lower_priority) as thread:
        return thread.submit(make).result()
