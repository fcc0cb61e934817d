"""The rows of the thesis's tables as they are made: each in a file of its own, so that a kill loses one at most."""

import json
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from sorvolo.store.atomic import atomic_write_bytes, make_folder
from sorvolo.store.exports.plain import json_bytes, plain_json


@dataclass(frozen=True)
class Row:
    """One row. `kind` names its table; `missing` is why it could not be made, then `values` and `pictures` are empty.

    `pictures` are files of the folder `pictures`, by what they show.
    """

    id: str
    kind: str
    values: Mapping[str, Any] = field(default_factory=dict)
    pictures: Mapping[str, str] = field(default_factory=dict)
    missing: str = ""


class RowStore:
    """The rows of one output folder that are done, each with a stamp of what it was made of."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def find(self, row_id: str, stamp: str) -> Row | None:
        """The row, if it was made of the very same inputs and settings and its pictures are there."""
        try:
            content = json.loads(self._path(row_id).read_text(encoding="utf-8"))
            row = Row(**content["row"])
        except (OSError, ValueError, KeyError, TypeError):
            return None
        is_whole = all(self.picture_path(each).is_file() for each in row.pictures.values())
        return row if is_whole and content.get("stamp") == stamp else None

    def put(self, row: Row, stamp: str) -> Row:
        """Keep a row; its values come back as JSON holds them. Raises StoreError on a full disk."""
        plain = Row(row.id, row.kind, plain_json(row.values), dict(row.pictures))
        make_folder(self._folder / "rows")
        atomic_write_bytes(self._path(row.id), json_bytes({"stamp": stamp, "row": asdict(plain)}))
        return plain

    def add_picture(self, name: str, jpeg: bytes) -> str:
        """Keep a picture under this name; what a row names it by. Raises StoreError on a full disk."""
        make_folder(self._folder / "pictures")
        file = f"{_plain_name(name)}.jpg"
        atomic_write_bytes(self.picture_path(file), jpeg, durable=False)
        return file

    def picture_path(self, file: str) -> Path:
        """Where a picture lies."""
        return self._folder / "pictures" / file

    def _path(self, row_id: str) -> Path:
        return self._folder / "rows" / f"{_plain_name(row_id)}.json"


def _plain_name(text: str) -> str:
    return re.sub(r"[^A-Za-z0-9.]+", "-", text).strip("-.") or "row"
