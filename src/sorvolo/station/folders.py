"""The folders below a station's root, nearest first, without those of the station itself and the inside of sites."""

import os
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from sorvolo.station.settings import STATE_FOLDER, STREAMS_FOLDER
from sorvolo.store.site.catalogue_place import is_site


@dataclass(frozen=True)
class Folder:
    """A folder, this many levels below the root."""

    path: Path
    depth: int

    @property
    def is_site(self) -> bool:
        """Whether it is the folder of a site."""
        return is_site(self.path)

    @cached_property
    def entries(self) -> list[os.DirEntry[str]]:
        """What it holds, by name; nothing where it is unreadable, or was taken away meanwhile."""
        try:
            with os.scandir(self.path) as found:
                return sorted(found, key=lambda each: each.name)
        except OSError:
            return []

    def folders(self) -> "list[Folder]":
        """The folders in it that anybody may fill; links are not followed."""
        kept = (STATE_FOLDER, STREAMS_FOLDER) if self.depth == 0 else ()
        return [
            Folder(Path(each.path), self.depth + 1)
            for each in self.entries
            if each.is_dir(follow_symlinks=False)
            and not each.name.startswith(".")
            and each.name not in kept
        ]


def folders_below(root: Path, *, deepest: int, most: int) -> Iterator[Folder]:
    """The root and the folders below it: `most` of them, `deepest` levels down; the inside of sites is left out."""
    waiting = deque([Folder(root, 0)])
    for _ in range(most):
        if not waiting:
            return
        folder = waiting.popleft()
        yield folder
        if folder.depth < deepest and not folder.is_site:
            waiting += folder.folders()
