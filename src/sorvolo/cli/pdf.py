"""Reports on paper: a page as a PDF beside it, printed by the browser that is installed."""

import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated

from sorvolo.cli.options import option
from sorvolo.cli.printing import Console, show_path
from sorvolo.errors import SettingsError, StoreError
from sorvolo.store.atomic import atomic_path

# the names of Chromium and its kin; WeasyPrint draws the pages' SVG without their style: black shapes over every find
_BROWSERS = (
    *("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome"),
    *("microsoft-edge", "msedge"),
    "/Applications/Google Chrome.app/Contents/MacOS/Google Chrome",
)
_MOST_S = 120.0  # for one page; by choice


def _browser() -> str:
    found = next(filter(None, map(shutil.which, _BROWSERS)), None)
    if found is None:
        raise SettingsError(
            "--pdf prints with Chromium, Chrome or Edge, and none is installed; install one, or leave "
            "--pdf out and print the page from another browser"
        )
    return found


Pdf = Annotated[
    bool,
    option(
        "Print the pages as PDFs beside them.",
        "--pdf",
        callback=lambda wanted: wanted and bool(_browser()),  # refused before the work begins
    ),
]


def write_pdfs(pages: Iterable[Path], console: Console) -> None:
    """Print each page into a PDF of its name beside it, and show where it is.

    Raises SettingsError without a browser, StoreError where a page cannot be printed.
    """
    for page in pages:
        path = page.resolve().with_suffix(".pdf")
        with tempfile.TemporaryDirectory() as profile, atomic_path(path) as temporary:
            command = [
                _browser(),
                "--headless",
                "--no-pdf-header-footer",
                *(["--no-sandbox"] if os.geteuid() == 0 else []),  # Chromium has none for root
                f"--user-data-dir={profile}",
                f"--print-to-pdf={temporary}",
                page.resolve().as_uri(),
            ]
            try:
                subprocess.run(command, capture_output=True, check=True, timeout=_MOST_S)
                temporary.stat()  # it may end well without a file
            except (OSError, subprocess.SubprocessError) as error:
                raise StoreError(
                    f"{page} could not be printed by {command[0]} ({error}); open it in a browser and print it there"
                ) from error
        show_path("PDF", path, console)
