"""`sorvolo site copy`: what it prints, how it ends, and what it refuses before it begins."""

import json
import shutil
from collections import namedtuple
from pathlib import Path

import fake_flights
import pytest

from sorvolo.cli.main import main
from sorvolo.errors import SettingsError
from sorvolo.missions.site.copy import copy_site, open_end
from sorvolo.store.site.archive import Archive


@pytest.fixture
def site(tmp_path: Path) -> Path:
    with Archive.open(tmp_path / "site", write=True) as archive:
        archive.create_site(fake_flights.SITE)
        fake_flights.map_flight(archive, "flight-0", 50, count=1)
    return tmp_path / "site"


def test_the_command_copies_verifies_and_reports_it(
    site: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    target = tmp_path / "a copy"
    assert main(["site", "copy", str(site), target.as_uri(), "--json"]) == 0
    row = json.loads(capsys.readouterr().out)
    assert row["is_whole"] and row["copied"] == row["files"] > 5 and row["newest"] == 1
    assert main(["site", "copy", str(site), str(target)]) == 0
    assert "copied 0 of" in (shown := capsys.readouterr().out) and "the copy is complete" in shown
    (target / "preview.png").write_bytes(b"")
    assert main(["site", "copy", str(site), str(target), "--verify"]) == 1
    assert "preview.png: damaged" in capsys.readouterr().err
    assert main(["site", "copy", str(site), str(target)]) == 0
    assert main(["site", "copy", str(site), str(target), "--verify"]) == 0
    assert "every file matches" in capsys.readouterr().out


def test_a_disk_that_is_too_full_is_announced_before_the_work(
    site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage(10**9, 10**9, 1000))
    assert main(["site", "copy", str(site), str(tmp_path / "copy")]) == 1
    assert "has 0 MB free, and the copy needs" in capsys.readouterr().err
    assert not (tmp_path / "copy/site.db").exists()


def test_places_that_cannot_be_are_refused(site: Path, tmp_path: Path) -> None:
    for target in (site, site / "within", site.parent):
        with pytest.raises(SettingsError, match="same folder, or lie in each other"):
            list(copy_site(str(site), str(target)))
    with pytest.raises(SettingsError, match=r"ftp:// is no place of sites"):
        open_end("ftp://host/site")
    with pytest.raises(SettingsError, match="no place of sites"):
        open_end("file://elsewhere/site")
