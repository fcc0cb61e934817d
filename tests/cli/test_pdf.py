"""Reports on paper: pages printed as PDFs beside them, by the browser that is installed."""

import re
import shutil
from pathlib import Path

import pytest
from fake_changes import fake_change
from test_changes_page import page_of

from sorvolo.cli import main as cli
from sorvolo.cli.pdf import _BROWSERS, write_pdfs
from sorvolo.cli.printing import Console
from sorvolo.store.atomic import write_page
from sorvolo.survey.findings import ChangeKind


def test_a_page_is_printed_with_all_pictures_and_a_new_page_takes_its_print_away(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A browser loads pictures below its window late: none may be missing on paper."""
    if not any(map(shutil.which, _BROWSERS)):
        pytest.skip("no Chromium on this machine (Debian: apt-get install chromium)")
    changes = [
        fake_change(k + 1, kind=list(ChangeKind)[k % 5], east_m=k % 13 - 6, north_m=k % 9 - 4)
        for k in range(12)
    ]
    page, pdf = (tmp_path / f"50% [x] changes{ending}" for ending in (".html", ".pdf"))
    write_page(page, page_of(changes))
    write_pdfs([page], Console())
    printed = pdf.read_bytes()
    assert printed.startswith(b"%PDF-")
    assert len(re.findall(rb"/Type\s*/Page\b", printed)) <= 4
    assert printed.count(b"/Subtype /Image") >= 20
    assert str(pdf) in capsys.readouterr().out
    assert sorted(tmp_path.iterdir()) == [page, pdf]
    write_page(page, page_of(changes[:1]))
    assert not pdf.exists()


@pytest.mark.parametrize("command", ["map", "compare", "search"])
def test_without_a_browser_nothing_begins(
    command: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    if Path(_BROWSERS[-1]).exists():
        pytest.skip("Chrome stands at a place of its own")
    monkeypatch.setenv("PATH", "")
    assert cli.main([command, "no-such.mp4", "--site", "no-site", "--pdf"]) == 1
    assert "--pdf prints with Chromium, Chrome or Edge" in capsys.readouterr().err
