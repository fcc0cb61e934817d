"""A source's frames read beside the work on those before them."""

import os
import queue
import sys
import threading
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from typing import TypeVar

from sorvolo.survey.flight import Frame, LostFrame

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


def read_ahead(frames: Iterator[Frame | LostFrame], most: int) -> Generator[Frame | LostFrame]:
    """The frames, read in a thread of their own, at most this many before they are asked for.

    What the reading raises is raised here.
    """
    # queue.Queue's lock may stay held where Ctrl-C meets its Python code, and the reading would wait for ever
    waiting: queue.SimpleQueue[Frame | LostFrame | BaseException | None] = queue.SimpleQueue()
    free: queue.SimpleQueue[None] = queue.SimpleQueue()
    for _ in range(most):
        free.put(None)
    is_over = threading.Event()
    # Python 3.11's join takes a thread for ended where Ctrl-C meets it; one that decodes then aborts the process's end
    has_ended = threading.Event()

    def put(item: Frame | LostFrame | BaseException | None) -> None:
        while not is_over.is_set():
            with suppress(queue.Empty):
                free.get(timeout=0.2)
                waiting.put(item)
                return

    def read() -> None:
        try:
            for each in frames:
                put(each)
                if is_over.is_set():
                    return
            put(None)
        except BaseException as error:  # raised anew where the frames are taken
            put(error)
        finally:
            has_ended.set()

    threading.Thread(target=read, name="decoding", daemon=True).start()
    try:
        while (item := waiting.get()) is not None:
            free.put(None)
            if isinstance(item, BaseException):
                raise item
            yield item
    finally:
        is_over.set()
        has_ended.wait()
