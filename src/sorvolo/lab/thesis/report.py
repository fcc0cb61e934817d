"""What a reproduction leaves behind: all rows and tables as JSON, each table as CSV and Markdown, and one page."""

import os
import platform
from collections.abc import Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from sorvolo import __version__
from sorvolo.lab.thesis.page import reproduction_page
from sorvolo.lab.thesis.published import FIGURES
from sorvolo.lab.thesis.rows import Row, RowStore
from sorvolo.lab.thesis.settings import ReproductionSettings, SimulatedSize
from sorvolo.lab.thesis.sheets import reproduction_sheets
from sorvolo.lab.thesis.tables import tables_of
from sorvolo.store.atomic import atomic_write_bytes, make_folder
from sorvolo.store.exports.plain import json_bytes, plain_json
from sorvolo.survey.wording import counted

NUMBERS, PAGE, MARKDOWN = "reproduction.json", "reproduction.html", "reproduction.md"


def write_reproduction(
    out: Path,
    rows: Sequence[Row],
    place: Path,
    settings: ReproductionSettings,
    size: SimulatedSize | None,
) -> dict[str, Any]:
    """Write reproduction.json, .html and .md and the tables' CSVs; what reproduction.json holds.

    `size` is that of a simulated dataset. Raises StoreError on a full disk.
    """
    made = [each for each in rows if not each.missing]
    document = plain_json(
        {
            "made_by": "sorvolo reproduce",
            "format": 1,
            "dataset": f"{place}" if size is None else "a simulated dataset in UMCD's layout",
            "size": _size_words(made, size),
            "made": {  # for people
                "program": f"sorvolo {__version__}",
                "made at": datetime.now(UTC).isoformat(timespec="seconds"),
                "computer": f"{platform.machine()}, {os.cpu_count() or 1} cores, {platform.system()}",
                "views compared": f"{settings.views_per_second:g} a second",
                "seed": str(settings.seed),
            },
            "settings": asdict(settings),
            "simulated": None if size is None else asdict(size),
            "tables": tables_of(rows),
            "figures": FIGURES,
            "rows": [asdict(each) for each in made],
            "missing": [{"id": each.id, "reason": each.missing} for each in rows if each.missing],
        }
    )
    sheets = reproduction_sheets(document["tables"])
    store = RowStore(out)
    page = reproduction_page(document, sheets, lambda file: store.picture_path(file).read_bytes())
    make_folder(out / "tables")
    for each in sheets:
        atomic_write_bytes(out / "tables" / f"{each.name}.csv", each.csv)
    text = "\n".join([document["size"], "", *(each.markdown for each in sheets)])
    atomic_write_bytes(out / MARKDOWN, text.encode())
    atomic_write_bytes(out / NUMBERS, json_bytes(document))
    atomic_write_bytes(out / PAGE, page.encode())
    return document


def _size_words(rows: Sequence[Row], size: SimulatedSize | None) -> str:
    mapped, compared = (
        {each.values["sequence"]: each.values for each in rows if each.kind == kind}
        for kind in ("mosaic", "comparison")
    )
    frames = sum(each["frames"] for each in mapped.values())
    views = sum(each["views"] for each in compared.values())
    words = (
        f"{counted(len(mapped), 'video')} mapped ({counted(frames, 'frame')}), {len(compared)} compared "
        f"({counted(views, 'view')})."
    )
    if size is None:
        return words
    return f"Simulated: paths of {size.length_m:g} m at {size.size_px[0]} x {size.size_px[1]} px; {words}"
