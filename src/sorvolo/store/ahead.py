"""What is read or made ahead by other threads, and given in order."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

K = TypeVar("K")
T = TypeVar("T")


def in_order(make: Callable[[K], T], each_of: Iterable[K], *, threads: int) -> Iterator[T]:
    """`make` of each, in order; two for each thread are begun ahead.

    What it raises is raised here and ends it: nothing more is begun.
    """
    waiting: deque[Future[T]] = deque()
    executor = ThreadPoolExecutor(threads)
    try:
        for each in each_of:
            waiting.append(executor.submit(make, each))
            if len(waiting) > 2 * threads:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        executor.shutdown(cancel_futures=True)
