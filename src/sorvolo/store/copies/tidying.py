"""What a site in an object store no longer names is removed, without harm to concurrent readers and writers."""

import secrets
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

from sorvolo.errors import StoreError
from sorvolo.store.copies.bucket import MANIFEST, SHOWN, BucketEnd, Manifest, catalogue_key, key_of
from sorvolo.store.copies.object_store import ConflictError, Objects
from sorvolo.store.copies.site_state import SiteFile

_FOLDERS = ("tiles/", "files/", "catalogues/")
_AT_ONCE = 1000  # keys in a request


@dataclass(frozen=True)
class Pruned:
    """What was removed, or would be: objects and their bytes; and how many bytes stay."""

    objects: int
    bytes: int
    kept_bytes: int


def prune(objects: Objects, older_than_s: float, *, only_count: bool = False) -> Pruned:
    """Remove the objects that the site does not name and that were stored more than `older_than_s` ago.

    A concurrent writer could rely on such an object. So the manifest states that a prune runs, and writers that began
    before find that the manifest has changed. A prune that was killed is repeated. Raises StoreError where there is no
    site, or where another writer comes in between.
    """
    end = BucketEnd(objects)
    manifest, etag = end.find_manifest()
    if manifest is None:
        raise StoreError(f"no site at {objects.name}; there is nothing to tidy")
    used = _used(end, manifest)
    if not only_count:
        manifest = replace(manifest, tidying=datetime.now(UTC).isoformat(timespec="seconds"))
        _swap(objects, manifest, etag)
    stored = {key: about for key, about in objects.listing("").items() if key.startswith(_FOLDERS)}
    unused = {
        key: size
        for key, (size, age_s) in stored.items()
        if key not in used and age_s > older_than_s
    }
    if not only_count:
        _remove(objects, sorted(unused))
        _, etag = end.find_manifest()
        _swap(objects, replace(manifest, tidying="", tidied=secrets.token_hex(8)), etag)
    total = sum(size for size, _ in stored.values())
    return Pruned(len(unused), sum(unused.values()), total - sum(unused.values()))


def _remove(objects: Objects, keys: Sequence[str]) -> None:
    for start in range(0, len(keys), _AT_ONCE):
        objects.remove(keys[start : start + _AT_ONCE])


def _used(end: BucketEnd, manifest: Manifest) -> set[str]:
    """The keys that the site names."""
    with tempfile.TemporaryDirectory(prefix="sorvolo-") as scratch:
        files: dict[str, SiteFile] = dict(end.state_of(manifest, Path(scratch)).files)
    named = {key_of(each) for each in files.values() if each.sha256}
    return named | {catalogue_key(manifest.catalogue[1]), MANIFEST, *SHOWN}


def _swap(objects: Objects, manifest: Manifest, etag: str) -> None:
    try:
        objects.swap(MANIFEST, manifest.data(), etag)
    except ConflictError:
        raise StoreError(
            f"another writer has changed the site at {objects.name}; run the same command again"
        ) from None
