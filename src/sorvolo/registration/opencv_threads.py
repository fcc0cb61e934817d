"""OpenCV's own threads: the one place that sets how many there are, which holds for the whole process."""

from collections.abc import Iterator
from contextlib import contextmanager

import cv2


@contextmanager
def single_threaded_opencv() -> Iterator[None]:
    """One thread in each call of OpenCV within the block: where frames are worked on in threads of our own, OpenCV's
    would only wait for each other."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:  # also when Ctrl-C strikes again meanwhile
        cv2.setNumThreads(before)
