"""Looking ahead: the next frames are decoded while the last one is being worked on."""

from collections import deque
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

_T = TypeVar("_T")
_END = object()


def read_ahead(items: Iterator[_T], depth: int = 2) -> Iterator[_T]:
    """The items, up to `depth` of them made beforehand on another thread; what making one raises is raised here.

    Closing this generator waits for the item that is being made and lets the others go.
    """
    with ThreadPoolExecutor(1) as executor:
        waiting = deque(executor.submit(next, items, _END) for _ in range(depth))
        try:
            while True:
                item = waiting.popleft().result()
                if item is _END:
                    return
                waiting.append(executor.submit(next, items, _END))
                yield item  # type: ignore[misc]
        finally:
            for each in waiting:
                each.cancel()
