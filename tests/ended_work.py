"""What missions return that yield how far they are."""

from collections.abc import Generator
from typing import TypeVar

T = TypeVar("T")


def ended(work: Generator[object, None, T]) -> T:
    """Do all of the work; what it returns."""
    while True:
        try:
            next(work)
        except StopIteration as end:
            return end.value
