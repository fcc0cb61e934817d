"""kill -9 at any moment: the site stays whole and readable, and mapping again ends whole."""

import json
import subprocess
import sys
from pathlib import Path

import fake_flights
import pytest

from sorvolo.store.site.archive import Archive


@pytest.mark.parametrize(
    ("moments", "rounds", "kind"),
    [
        ("steps", 3, "sqlite"),
        pytest.param("random", 5, "sqlite", marks=pytest.mark.long),
        pytest.param("random", 3, "postgresql", marks=pytest.mark.long),
    ],
    indirect=["kind"],
)
def test_a_site_survives_being_killed(tmp_path: Path, moments: str, rounds: int, kind: str) -> None:
    folder = tmp_path / "site"
    program = [sys.executable, fake_flights.__file__, moments, str(folder), "1", str(rounds)]
    result = subprocess.run(program, capture_output=True, text=True, timeout=120)
    assert result.returncode == 0, result.stderr

    with Archive.open(folder, write=True) as archive:
        if not archive.has_site:
            archive.create_site(fake_flights.SITE)
        version = fake_flights.map_flight(archive, "flight-0", 77, compared=True)
        assert archive.versions()[-1].id == version
        assert not archive.is_growing
        named = {keyframe.image_path for keyframe in archive.keyframes()}
    fake_flights.check_whole(folder)
    assert {
        str(path.relative_to(folder)) for path in folder.glob("flights/*/keyframes/*/*")
    } == named
    assert not list(folder.rglob(".tmp-*"))
    assert not list(folder.glob("flights/*/staged"))
    for flight in folder.glob("flights/*"):
        features = json.loads((flight / "changes.geojson").read_text())["features"]
        ids = {feature["id"] for feature in features}
        assert {path.name for path in (flight / "changes").iterdir()} == {
            f"{change_id}-{when}.png" for change_id in ids for when in ("before", "after")
        }
        assert len(list((flight / "masks").glob("*.png"))) == len(ids)
        assert (flight / "changes.html").is_file()
    for name in ("mosaic.tif", "preview.png", "mosaic.kmz", "flights/flight-0/report.html"):
        assert (folder / name).is_file()
