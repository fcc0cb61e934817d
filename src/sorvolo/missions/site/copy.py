"""A site copied to another place, or compared with its copy there."""

import tempfile
import warnings
from collections.abc import Generator
from pathlib import Path
from urllib.parse import unquote, urlsplit

from sorvolo.errors import SettingsError, SorvoloWarning, StoreError
from sorvolo.store.copies.bucket import BucketEnd, Pruned, prune
from sorvolo.store.copies.folder import FolderEnd
from sorvolo.store.copies.object_store import open_objects
from sorvolo.store.copies.transfer import CopyOutcome, CopyUpdate, SiteEnd, copy, verify
from sorvolo.store.site.catalogue_place import Catalogues, chosen_catalogues

_MAY_BE_SHORT = 1.05  # times the need: other programs write to the disk as well


def copy_site(
    source: str, target: str, catalogue: str = ""
) -> Generator[CopyUpdate, None, CopyOutcome]:
    """Copy the site at one address to another, yielding progress; an interrupted copy continues.

    The catalogue of a new copy in a folder lies there, whatever the site's does, or at the address `catalogue`.

    An address is a folder, `file://` with one, or `s3://BUCKET/NAME`. Each file is checked by its SHA-256 while it is
    written. The copy is the site as of its last complete flight, even while another is being mapped into it. Raises
    SettingsError or StoreError with what to do: where there is no site, where the target holds another one or what the
    source lacks, where the disk is too full, where a store refuses or cannot be reached.
    """
    ends = _ends(source, target, catalogue)
    with tempfile.TemporaryDirectory(prefix="sorvolo-") as scratch:
        return (
            yield from copy(
                *ends, Path(scratch), room=lambda need, free: _check_room(target, need, free)
            )
        )


def verify_copy(source: str, target: str) -> Generator[CopyUpdate, None, CopyOutcome]:
    """Compare the copy at an address with its site, every file by its SHA-256; neither is written to."""
    ends = _ends(source, target)
    with tempfile.TemporaryDirectory(prefix="sorvolo-") as scratch:
        return (yield from verify(*ends, Path(scratch)))


def prune_site(address: str, keep_days: float, *, only_count: bool = False) -> Pruned:
    """Remove what a site in an object store no longer names and was stored more than `keep_days` days ago.

    Raises SettingsError for a folder, which keeps nothing like it, StoreError as stores do.
    """
    if folder_of(address) is not None:
        raise SettingsError(f"{address} is a folder, which needs no tidying; give s3://BUCKET/NAME")
    return prune(open_objects(address), keep_days * 86_400, only_count=only_count)


def _ends(source: str, target: str, catalogue: str = "") -> tuple[SiteEnd, SiteEnd]:
    catalogues = _catalogues(target, catalogue) if catalogue else None
    ends = open_end(source, catalogues), open_end(target, catalogues)
    if isinstance(ends[0], FolderEnd) and isinstance(ends[1], FolderEnd):
        one, other = ends[0].folder.resolve(), ends[1].folder.resolve()
        if one.is_relative_to(other) or other.is_relative_to(one):
            raise SettingsError(
                f"{target} and {source} are the same folder, or lie in each other; choose another one"
            )
    return ends


def _catalogues(target: str, catalogue: str) -> Catalogues:
    """Those with the catalogue of a new copy at an address."""
    folder = folder_of(target)
    if folder is None:
        raise SettingsError(
            f"{target} keeps its catalogue with its tiles; --catalogue is for folders"
        )
    return chosen_catalogues(folder, catalogue)


def open_end(address: str, catalogues: Catalogues | None = None) -> SiteEnd:
    """The place that an address names. Raises SettingsError for one that names none."""
    folder = folder_of(address)
    return BucketEnd(open_objects(address)) if folder is None else FolderEnd(folder, catalogues)


def folder_of(address: str) -> Path | None:
    """The folder that an address names; None for a place in an object store. Raises SettingsError for any other."""
    parts = urlsplit(address)
    if "://" not in address:
        return Path(address)
    if parts.scheme == "file" and parts.netloc in ("", "localhost") and parts.path:
        return Path(unquote(parts.path))
    if parts.scheme == "s3":
        return None
    raise SettingsError(
        f"{parts.scheme}:// is no place of sites; give a folder, file:///FOLDER or s3://BUCKET/NAME"
    )


def _check_room(target: str, need: int, free: int | None) -> None:
    if free is None or need == 0:
        return
    text = f"the disk of {target} has {free / 1e6:,.0f} MB free, and the copy needs {need / 1e6:,.0f} MB more"
    if free < need:
        raise StoreError(f"{text}: free some space, or choose another disk")
    if free < _MAY_BE_SHORT * need:
        warnings.warn(f"{text}: it may become full", SorvoloWarning, stacklevel=2)
