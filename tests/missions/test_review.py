"""Changes are listed, confirmed and rejected, by id or by a flight's numbers."""

import json
from pathlib import Path

import pytest
from fake_changes import fake_change
from fake_flights import LOCAL_SITE, SITE, frame, map_flight

from sorvolo.cli.main import main
from sorvolo.errors import InputError, NotFoundError, StoreError
from sorvolo.geometry.coordinates import Coordinates, place_text
from sorvolo.missions.site.review import list_changes, review_changes
from sorvolo.store.exports.change_files import changes_geojson
from sorvolo.store.site.archive import Archive
from sorvolo.survey.findings import Verdict
from sorvolo.survey.flight import Site


@pytest.fixture
def site(tmp_path: Path) -> Path:
    """Flight a mapped; b and c compared, with two changes each."""
    with Archive.open(tmp_path / "site", write=True) as archive:
        archive.create_site(SITE)
        map_flight(archive, "a", 20, count=1)
        for flight in ("b", "c"):
            with archive.begin_flight(flight, "", {}) as writer:
                changes = [fake_change(number, flight, east_m=5.0 * number) for number in (1, 2)]
                writer.commit([frame(0)], {}, {}, "<html></html>", changes=changes)
    return tmp_path / "site"


def verdicts(site: Path) -> dict[str, str]:
    return {each.id: each.verdict.value for each in list_changes(site) if each.verdict is not None}


def test_changes_are_listed_by_flight_and_number(site: Path) -> None:
    assert [each.id for each in list_changes(site)] == ["b-1", "b-2", "c-1", "c-2"]
    assert [each.id for each in list_changes(site, "c")] == ["c-1", "c-2"]
    assert list_changes(site, "a") == []
    with pytest.raises(StoreError, match="no flight 'd', only a, b, c"):
        list_changes(site, "d")


def test_ranks_are_a_flights_own_also_in_a_list_of_several(site: Path) -> None:
    """As in the flights' files."""
    review_changes(site, ["b-1"], Verdict.REJECTED)
    with Archive.open(site, write=False) as archive:
        listed = changes_geojson(archive.changes(), archive.site())["features"]
    for name in ("rank", "group"):
        files = [
            each["properties"][name]
            for flight in "bc"
            for each in json.loads((site / f"flights/{flight}/changes.geojson").read_text())[
                "features"
            ]
        ]
        assert [each["properties"][name] for each in listed] == files


def test_verdicts_are_kept_and_changed(site: Path) -> None:
    printed = review_changes(site, ["b-1", "c-2"], Verdict.REJECTED, "leaves")
    assert [(each.id, each.verdict, each.note) for each in printed] == [
        ("b-1", Verdict.REJECTED, "leaves"),
        ("c-2", Verdict.REJECTED, "leaves"),
    ]
    review_changes(site, ["2"], Verdict.CONFIRMED, flight="c")
    assert verdicts(site) == {"b-1": "rejected", "c-2": "confirmed"}
    features = json.loads((site / "flights/b/changes.geojson").read_text())["features"]
    assert [each["properties"]["review"] for each in features] == ["rejected", None]
    assert [each["properties"]["note"] for each in features] == ["leaves", None]


@pytest.mark.parametrize(
    ("ids", "flight", "words"),
    [
        (["b-1", "x-9"], None, "x-9"),
        (["1"], None, "no change 1"),
        (["3"], "b", "no change 3"),
        ([], None, "no change was"),
        (["1"], "z", "no flight 'z'"),
    ],
)
def test_an_unknown_change_is_named_and_nothing_is_changed(
    site: Path, ids: list[str], flight: str | None, words: str
) -> None:
    with pytest.raises((InputError, NotFoundError), match=words):
        review_changes(site, ids, Verdict.REJECTED, flight=flight)
    assert verdicts(site) == {}


@pytest.mark.parametrize(("place", "unit"), [(SITE, "m"), (LOCAL_SITE, "units")])
def test_sizes_are_listed_in_the_units_of_the_map(
    place: Site,
    unit: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("COLUMNS", "160")
    with Archive.open(tmp_path / "site", write=True) as archive:
        archive.create_site(place)
        map_flight(archive, "a", 20, count=1)
        with archive.begin_flight("b", "", {}) as writer:
            writer.commit([frame(0)], {}, {}, "<html></html>", changes=[fake_change(1)])
    assert main(["review", str(tmp_path / "site")]) == 0
    assert f" length {unit} " in capsys.readouterr().out


def test_a_changes_place_is_listed_as_asked_for(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with Archive.open(tmp_path / "site", write=True) as archive:
        archive.create_site(SITE)
        map_flight(archive, "a", 20, count=1)
        with archive.begin_flight("b", "", {}) as writer:
            writer.commit([frame(0)], {}, {}, "<html></html>", changes=[fake_change(1)])
    assert main(["review", str(tmp_path / "site"), "--json"]) == 0
    (change,) = json.loads(capsys.readouterr().out)["changes"]
    for form in Coordinates:
        place = place_text(change["latitude"], change["longitude"], form)
        assert main(["review", str(tmp_path / "site"), "--coordinates", form.value]) == 0
        shown = capsys.readouterr().out
        assert place in shown and form.heading.split(",")[0] in shown
        assert main(["history", str(tmp_path / "site"), "--coordinates", form.value]) == 0
        origin = SITE.origin
        assert place_text(origin.latitude_deg, origin.longitude_deg, form) in " ".join(
            capsys.readouterr().out.split()
        )


def test_a_folder_that_is_no_site_is_not_made_one(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="no site"):
        review_changes(tmp_path / "none", ["b-1"], Verdict.REJECTED)
    assert not (tmp_path / "none").exists()


def test_the_command_lists_and_gives_verdicts(
    site: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "160")
    assert main(["review", str(site), "b-2", "--reject", "--note", "[bold]grass"]) == 0
    assert "rejected: [bold]grass" in capsys.readouterr().out
    assert main(["review", str(site), "1", "--flight", "c", "--confirm", "--json"]) == 0
    (printed,) = json.loads(capsys.readouterr().out)["changes"]
    assert (printed["id"], printed["review"], printed["east_m"]) == ("c-1", "confirmed", 5.0)
    assert main(["review", str(site)]) == 0
    listed = capsys.readouterr().out
    assert all(name in listed for name in ("b-1", "b-2", "c-1", "c-2"))
    assert main(["review", str(site), "--flight", "a"]) == 0
    assert "no changes" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["b-1"], "--confirm or --reject"),
        (["b-1", "--confirm", "--reject"], "contradict"),
        (["--reject"], "which changes"),
        (["nope", "--reject"], "no change nope"),
        (["1", "--reject"], "give --flight as well"),
    ],
)
def test_the_command_states_what_is_wrong(
    site: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], words: str
) -> None:
    assert main(["review", str(site), *arguments]) == 1
    assert words in capsys.readouterr().err
    assert verdicts(site) == {}
