"""A mission that one holds: updates, one result, an end from any thread."""

import math
import threading
from collections.abc import Generator
from pathlib import Path

import pytest

from sorvolo.errors import InputError, SettingsError
from sorvolo.missions.mission import flight_outcome, mission


class Counting:
    """What a mission of three updates did."""

    def __init__(self) -> None:
        self.events: list[str] = []

    @mission
    def count(self, gate: threading.Event | None = None) -> Generator[int, None, str]:
        """Yield numbers."""
        try:
            for number in range(3):
                yield number
                if gate is not None:
                    self.events.append("waits")
                    gate.wait(10)
            self.events.append("done")
        finally:
            self.events.append("left")
        return "three"


def test_a_result_takes_the_updates_that_are_left_once() -> None:
    work = Counting()
    counting = work.count()
    assert next(counting) == 0
    assert counting.result() == "three" == counting.result()
    assert list(counting) == [] and work.events == ["done", "left"]
    assert Counting.count.__doc__ == "Yield numbers."


def test_a_cancelled_mission_has_no_result() -> None:
    work = Counting()
    with work.count() as counting:
        next(counting)
    assert work.events == ["left"]
    with pytest.raises(SettingsError, match="was cancelled or failed and made nothing"):
        counting.result()


def test_a_mission_that_failed_has_no_result_either() -> None:
    @mission
    def failing() -> Generator[int, None, str]:
        yield from ()
        raise InputError("no film")

    work = failing()
    with pytest.raises(InputError, match="no film"):
        work.result()
    with pytest.raises(SettingsError, match="failed and made nothing"):
        work.result()


def test_a_mission_that_ends_in_the_step_in_which_it_is_cancelled_keeps_its_result() -> None:
    @mission
    def ending() -> Generator[int, None, str]:
        yield 0
        work.cancel()  # as from another thread: the step is at work
        return "in the site"

    work = ending()
    assert work.result() == "in the site"


def test_a_mission_is_cancelled_from_another_thread_after_its_step() -> None:
    work, gate, seen = Counting(), threading.Event(), []
    counting = work.count(gate)
    thread = threading.Thread(target=lambda: seen.extend(counting))
    thread.start()
    while not work.events:
        pass
    counting.cancel()
    gate.set()
    thread.join(10)
    assert seen == [0] and work.events == ["waits", "left"]


def test_a_flight_whose_folder_was_taken_away_is_not_trusted(tmp_path: Path) -> None:
    made = flight_outcome(tmp_path / "gone", {})
    assert not made.trusted and not made.paths and math.isnan(made.residual_px)
