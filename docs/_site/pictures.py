"""Make the pictures of the tutorial: python docs/_site/pictures.py DEMO (the folder that `sorvolo demo` made).

Runs the tutorial's commands on the demo's flights in a temporary folder, keeps what they print as SVG and the pages as
JPEG, taken by Chromium (`chromium` on the PATH). Only simulated flights are shown.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image
from rich.console import Console
from rich.text import Text

IMAGES = Path(__file__).parents[1] / "images"
COLUMNS = 104
FLIGHT = "demo-site/simulation/flight{0}/flight{0}.mp4"
COMMANDS = {
    "inspect": ["inspect", FLIGHT.format(1)],
    "plan": [
        "plan",
        "--camera",
        "Mavic 2 Pro",
        "--area",
        "area.geojson",
        "--out",
        "field.plan",
        "--out",
        "field.kmz",
    ],
    "map": ["map", FLIGHT.format(1), "--site", "field"],
    "compare": ["compare", FLIGHT.format(2), "--site", "field"],
    "watch": ["watch", FLIGHT.format(2), "--out", "search"],
    "review": ["review", "field"],
    "search": ["search", "field", "--out", "found"],
    "labelled": ["simulate", "labelled", "--pictures", "60", "--seed", "7"],
    "detector": ["evaluate", "detector", "default", "labelled", "--out", "measured"],
    "reproduce": ["reproduce", "--simulated", "--quick", "--train-steps", "0", "--out", "chapter4"],
}
MAKES = {  # the folder that a command makes
    "map": "field",
    "watch": "search",
    "search": "found",
    "labelled": "labelled",
    "detector": "measured",
    "reproduce": "chapter4",
}
PRINTED = ("inspect", "plan", "map", "compare", "review")  # of these also what they print
PAGES = {  # name: page, width and height of the window, px
    "report": ("field/flights/flight1/report.html", 1100, 1500),
    "changes": ("field/flights/flight2/changes.html", 1100, 1500),
    "watch": ("search/report.html", 1100, 1500),
    "search": ("found/search.html", 1100, 1100),
    "detector": ("measured/detector.html", 1100, 900),
    "reproduce": ("chapter4/reproduction.html", 1100, 1100),
}
PAGE_OF = {
    "report": "map",
    "changes": "compare",
}  # the command that makes a page, where it is named otherwise
AREA = """{"type": "Feature", "properties": {}, "geometry": {"type": "Polygon", "coordinates": [[[12.6030, 41.8920],
[12.6050, 41.8920], [12.6050, 41.8932], [12.6030, 41.8932], [12.6030, 41.8920]]]}}"""


def main() -> None:
    """Run the commands, picture what they print and the pages that they write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("demo", type=Path)
    parser.add_argument(
        "--keep", type=Path, help="folder to run in, and to use again, instead of a temporary one"
    )
    parser.add_argument(
        "--only",
        nargs="+",
        choices=COMMANDS,
        default=list(COMMANDS),
        help="these alone, in a folder kept from a whole run",
    )
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = options.keep or Path(scratch)
        folder.mkdir(exist_ok=True)
        if not (folder / "demo-site").exists():
            (folder / "demo-site").symlink_to(options.demo.resolve())
        (folder / "area.geojson").write_text(AREA)
        for name in options.only:
            if name in MAKES:
                shutil.rmtree(folder / MAKES[name], ignore_errors=True)
            printed(name, COMMANDS[name], folder)
        for name, (page, width, height) in PAGES.items():
            if PAGE_OF.get(name, name) in options.only:
                pictured(name, folder / page, width, height)


def printed(name: str, words: list[str], folder: Path) -> None:
    """What a command prints, as SVG without fonts from elsewhere."""
    environment = {
        **os.environ,
        "COLUMNS": str(COLUMNS),
        "FORCE_COLOR": "1",
        "TERM": "xterm-256color",
    }
    done = subprocess.run(
        [sys.executable, "-m", "sorvolo", *words],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode not in (0, 3):  # 3: done, and to be checked
        raise SystemExit(f"sorvolo {' '.join(words)}: {done.stderr}")
    if name not in PRINTED:
        return
    console = Console(record=True, width=COLUMNS, file=open(os.devnull, "w"), force_terminal=True)  # noqa: SIM115
    shown = " ".join(f'"{word}"' if " " in word else word for word in words)
    console.print(f"$ sorvolo {shown}", style="bold", highlight=False, markup=False)
    console.print(Text.from_ansi(done.stdout.rstrip()))
    drawn = console.export_svg(title=f"sorvolo {words[0]}")
    while "@font-face" in drawn:
        begin = drawn.index("@font-face")
        drawn = drawn[:begin] + drawn[drawn.index("}", begin) + 1 :]
    (IMAGES / f"{name}.svg").write_text(
        drawn.replace("Fira Code", "DejaVu Sans Mono"), encoding="utf-8"
    )


def pictured(name: str, page: Path, width: int, height: int) -> None:
    """The top of a page as a browser shows it."""
    with tempfile.TemporaryDirectory() as scratch:
        shot = Path(scratch) / "page.png"
        command = ["chromium", "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars"]
        command += [
            f"--window-size={width},{height}",
            f"--screenshot={shot}",
            page.resolve().as_uri(),
        ]
        subprocess.run(command, check=True, capture_output=True, timeout=120)
        Image.open(shot).convert("RGB").save(
            IMAGES / f"{name}.jpg", quality=72, optimize=True, progressive=True
        )


if __name__ == "__main__":
    main()
