"""What a working copy was made of: a site in an object store, whose tiles and pictures are fetched when asked for."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Protocol

ORIGIN = "origin.json"
"""In the folder of a working copy: the store's address, and what the site consisted of there."""

UNSENT = "unsent"
"""In the folder of a working copy while it may hold what the store has not."""

TILE_SIZES = "origin-tiles.json"
_FOLDER_VARIABLE = "SORVOLO_CACHE"


class Origin(Protocol):
    """The site in the store."""

    def fetch(self, path: str) -> bool:
        """Put the file of this path into the folder, checked; whether the store has one. Raises StoreError."""
        ...

    def tile_sizes(self) -> Mapping[str, int]:
        """The bytes of each tile in the store, by its SHA-256."""
        ...


def cache_folder() -> Path:
    """Where working copies lie: $SORVOLO_CACHE, else sorvolo in the system's folder for caches."""
    if chosen := os.environ.get(_FOLDER_VARIABLE):
        return Path(chosen).expanduser()
    if cache := os.environ.get("XDG_CACHE_HOME") or os.environ.get("LOCALAPPDATA"):
        return Path(cache) / "sorvolo"
    return Path.home() / ".cache" / "sorvolo"


def find_origin(folder: Path) -> Origin | None:
    """The origin of a working copy; None for any other folder. One that lies elsewhere than working copies has none:
    a stranger's site makes this program ask nobody."""
    if not (folder / ORIGIN).is_file() or not folder.resolve().is_relative_to(
        cache_folder().resolve()
    ):
        return None
    from sorvolo.store.copies.working import StoreOrigin

    return StoreOrigin(folder)
