"""Sites in stores: what each flight added is sent before the next one goes on, however quick the flights are."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from sorvolo.cli import sites
from sorvolo.cli.sites import OpenedSite


@dataclass(frozen=True)
class Update:
    """One step of a mission, as far as sending looks at it; the seconds are since the flight was begun."""

    flight: str
    seconds: float


def test_a_flight_is_sent_when_the_next_one_begins_however_late(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The first frame of a flight may take longer than all of a short flight before it."""
    events: list[str] = []

    def send(address: str, *, is_over: bool) -> Iterator[None]:
        events.append(f"sent {address}, over: {is_over}")
        return iter(())

    def mission() -> Iterator[Update]:
        for flight, seconds in (("two", 0.1), ("two", 0.2), ("three", 0.5), ("three", 0.6)):
            yield Update(flight, seconds)
            events.append(f"{flight} {seconds}")

    monkeypatch.setattr("sorvolo.missions.site.working_copy.send_site", send)
    monkeypatch.setattr(sites, "show_copy", lambda work, task: list(work))
    for _ in OpenedSite(Path("copy"), "s3://archive/site").sent(mission()):
        pass
    assert events == [
        "two 0.1",
        "two 0.2",
        "sent s3://archive/site, over: False",
        "three 0.5",
        "three 0.6",
    ]
