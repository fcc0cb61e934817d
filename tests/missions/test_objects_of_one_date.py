"""Objects of one date alone, from two searched flights of photos over a coarse map to the changes that are reported."""

from dataclasses import replace
from pathlib import Path

import pytest
from truth_detector import Knowing

from small_flights import simulate_into, small_flight
from sorvolo.lab.evaluation.changes import evaluate_changes
from sorvolo.lab.simulation.settings import OutputSettings
from sorvolo.missions.compare.flight_changes import FlightChanges
from sorvolo.missions.compare.flights import compare_flights
from sorvolo.missions.flight.settings import CompareSettings
from sorvolo.missions.map.flights import map_flights
from sorvolo.store.site.archive import Archive
from sorvolo.survey.findings import ChangeKind


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two flights of photos, 11 cm a pixel, over cars of which some come and go."""
    settings = small_flight(
        11,
        speed_m_s=8,
        length_m=90,
        height_m=60,
        size_px=(640, 480),
        fps=1,
        cars=9,
        output=OutputSettings(photos=True),
    )
    return simulate_into(tmp_path_factory.mktemp("photos"), replace(settings, flights=2))


@pytest.mark.long
def test_objects_of_one_date_are_changes_where_the_ground_differs_as_well(
    simulated: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What the views decide is taken away: only the objects are left to report from."""
    monkeypatch.setattr(FlightChanges, "conclude", lambda _: ())
    seeing = {
        flight: Knowing(simulated, flight, misses=0.0, false_alarms=0.0)
        for flight in ("flight1", "flight2")
    }
    site = tmp_path / "site"
    for _ in map_flights([simulated / "flight1/photos"], site, detector=seeing["flight1"]):
        pass
    for _ in compare_flights([simulated / "flight2/photos"], site, detector=seeing["flight2"]):
        pass
    (judged,) = evaluate_changes(site, simulated)
    assert judged.match is not None and not judged.match.false and not judged.match.twice
    assert judged.classes is not None and judged.classes.wrong == 0
    with Archive.open(site, write=False) as archive:
        changes = archive.changes()
    assert {each.kind for each in changes} == {ChangeKind.APPEARED, ChangeKind.DISAPPEARED}
    assert all(each.class_before or each.class_after for each in changes)
    assert len({each.id for each in changes}) == len(changes) >= 4
    for _ in compare_flights(
        [simulated / "flight2/photos"], site, CompareSettings(model="none"), again=True
    ):
        pass
    with Archive.open(site, write=False) as archive:
        assert archive.changes() == [], "nobody searched the second flight"
