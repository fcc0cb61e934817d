"""Which program made a result: its version, and a hash of its code, which an update always changes."""

import hashlib
from functools import cache
from pathlib import Path

VERSION = "0.1.0"
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
