"""Pictures rendered ahead on other cores, and given in order."""

import os
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

T = TypeVar("T")


def in_order(render: Callable[[int], T], count: int, *, most_threads: int) -> Iterator[T]:
    """`render` of 0 to `count` - 1, in order; two for each thread are begun ahead. What it raises is raised here."""
    threads = min(most_threads, os.cpu_count() or 1)
    waiting: deque[Future[T]] = deque()
    with ThreadPoolExecutor(threads) as executor:
        for index in range(count):
            waiting.append(executor.submit(render, index))
            if len(waiting) > 2 * threads:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
