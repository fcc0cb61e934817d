"""Which program made a result: its version, a hash of its code, which an update always changes, and what is added."""

import hashlib
from collections.abc import Callable
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any

VERSION = "1.0.0"
"""The one place of the version: a release raises it here."""

_CODE = frozenset({".py", ".cpp"})  # not what is compiled: it differs between machines


@cache
def build() -> str:
    """The version with eight digits of the SHA-256 of the package's code, as "1.0.0+3f2a9c1d".

    Caches, journals and "already mapped" go by it: two builds never take up each other's half-done work.
    """
    package = Path(__file__).parent
    digest = hashlib.sha256()
    for path in sorted(each for each in package.rglob("*") if each.suffix in _CODE):
        digest.update(path.relative_to(package).as_posix().encode() + b"\0" + path.read_bytes())
    return f"{VERSION}+{digest.hexdigest()[:8]}"


@cache
def added(group: str) -> dict[str, Callable[[], Any]]:
    """What installed packages add in the group of entry points `sorvolo.<group>`, by name: what loads it.

    That raises ImportError for what cannot be loaded.
    """

    def loading(entry: EntryPoint) -> Callable[[], Any]:
        def loaded() -> Any:
            try:
                return entry.load()
            except Exception as error:
                raise ImportError(
                    f"{entry.value}, which an installed package adds to sorvolo.{group}, cannot be loaded: {error}; "
                    "mend or remove that package"
                ) from error

        return loaded

    return {each.name: loading(each) for each in entry_points(group=f"sorvolo.{group}")}
