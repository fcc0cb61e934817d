"""All sites of an archive as one table that is searched without a server."""

import os
from collections.abc import Callable, Generator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import quote

from sorvolo.errors import InputError, SettingsError, StoreError
from sorvolo.missions.archive.index import sites_below
from sorvolo.missions.site.working_copy import fetch_site
from sorvolo.store.copies.bucket import sites_at
from sorvolo.store.copies.object_store import open_objects
from sorvolo.store.copies.working import store_address
from sorvolo.store.index.stac_table import demand_pyarrow, site_items, stac_table
from sorvolo.store.site.archive import Archive


@dataclass
class ExportOutcome:
    """What was written: rows of each kind. `local` are sites without a place on Earth, `faults` what cannot be read."""

    rows: int = 0
    kinds: dict[str, int] = field(default_factory=dict)
    sites: int = 0
    local: list[str] = field(default_factory=list)
    faults: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class ExportUpdate:
    """A site was read."""

    site: str
    done: int
    sites: int


def export_archive(root: str, out: Path) -> Generator[ExportUpdate, None, ExportOutcome]:
    """Write all sites of an archive as stac-geoparquet, yielding each site; sites that cannot be read are named.

    `root` is the folder that the site folders lie in, or `s3://BUCKET/PREFIX`. Addresses of files are relative to the
    folder of `out`, or those in the bucket. Raises InputError, SettingsError or StoreError where nothing can be
    written.
    """
    demand_pyarrow()
    if out.suffix.lower() != ".parquet":
        raise SettingsError(
            f"{out.name}: the table is written as .parquet; give a file name with that ending"
        )
    if not out.resolve().parent.is_dir():
        raise InputError(f"no folder {out.resolve().parent} to write {out.name} to; make it first")
    names = _sites(root)
    outcome = ExportOutcome(sites=len(names))
    with stac_table(out) as table:
        for done, name in enumerate(names, start=1):
            items = yield from _site(root, name, out, outcome)
            table.add(items)
            for each in items:
                kind = str(each["sorvolo:kind"])
                outcome.kinds[kind] = outcome.kinds.get(kind, 0) + 1
            yield ExportUpdate(name, done, len(names))
        outcome.rows = table.rows
    return outcome


def _sites(root: str) -> list[str]:
    """The sites of an archive by name."""
    if root.startswith("s3://"):
        return sites_at(open_objects(root))
    if not Path(root).is_dir():
        raise InputError(f"no such folder: {root}; give the folder that holds the site folders")
    return sorted(sites_below(Path(root)))


def _site(
    root: str, name: str, out: Path, outcome: ExportOutcome
) -> Generator[ExportUpdate, None, list[dict[str, Any]]]:
    """The items of one site; none of one that is local or cannot be read, which the outcome names."""
    try:
        folder = yield from _folder(root, name)
        with Archive.open(folder, write=False) as archive:
            if archive.has_site and archive.site().is_local:
                outcome.local.append(name)
                return []
            return list(site_items(archive, name, _addresses(root, folder, out)))
    except StoreError as error:
        outcome.faults[name] = f"{error}"
        return []


def _folder(root: str, name: str) -> Generator[ExportUpdate, None, Path]:
    if not root.startswith("s3://"):
        return Path(root) / name
    fetching = fetch_site(f"{root.rstrip('/')}/{name}".rstrip("/."), writes=False)
    while True:
        try:
            next(fetching)
        except StopIteration as end:
            return end.value
        yield ExportUpdate(name, 0, 0)


def _addresses(root: str, folder: Path, out: Path) -> Callable[[str], str]:
    """How a file of a site is addressed, by its path in the site folder; "" for one that is not there."""
    if root.startswith("s3://"):
        return lambda path: store_address(folder, path)
    below = os.path.relpath(folder.resolve(), out.resolve().parent)

    def address(path: str) -> str:
        return quote(Path(below, path).as_posix()) if (folder / path).is_file() else ""

    return address
