"""Which names a catalogue may give to files: a stranger's site must not read, write or delete outside itself."""

import re
import unicodedata

from sorvolo.errors import StoreError

_PUNCTUATION = set(" -_.,+()[]{}@=#&'!~%^$;`")
_MOST_BYTES = 200  # file systems allow 255; endings and prefixes are added
_DOCUMENT = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_-]{0,80}(\.[A-Za-z0-9]{1,10}){1,2}")
_SHA256 = re.compile(r"[0-9a-f]{64}")
_EPSG = re.compile(r"EPSG:[1-9][0-9]{0,8}")


def is_plain_name(name: str) -> bool:
    """Whether this can name a file or a folder: letters, digits and usual punctuation, no leading dot or dash."""
    return (
        0 < len(name.encode("utf-8", "replace")) <= _MOST_BYTES
        and name[0] not in ".- "
        and all(
            letter in _PUNCTUATION or unicodedata.category(letter)[0] in "LMN" for letter in name
        )
    )


def is_epsg(crs: str) -> bool:
    """Whether the text is an EPSG code. Anything else may make GDAL or PROJ open a file or an address."""
    return _EPSG.fullmatch(crs) is not None


def checked_name(name: str, what: str) -> str:
    """The name of a flight, a change or an object; raises StoreError when it cannot name a file."""
    if not isinstance(name, str) or not is_plain_name(name):
        raise _refused(name, what, "letters, digits and usual punctuation were needed")
    return name


def checked_document(name: str) -> str:
    """The name of a text file in a flight's folder; raises StoreError for any other."""
    if not isinstance(name, str) or _DOCUMENT.fullmatch(name) is None:
        raise _refused(name, "document", "a plain file name with an ending was needed")
    return name


def is_sha256(name: str) -> bool:
    """Whether the name is 64 hexadecimal digits, as a tile's is."""
    return _SHA256.fullmatch(name) is not None


def checked_sha256(sha256: str) -> str:
    """The name of a tile's file; raises StoreError for anything but 64 hexadecimal digits."""
    if not isinstance(sha256, str) or not is_sha256(sha256):
        raise _refused(sha256, "tile", "a SHA-256 was needed")
    return sha256


def checked_image_path(path: str, flight_id: str) -> str:
    """A keyframe's path in the site folder; raises StoreError when it lies elsewhere than its flight's keyframes."""
    folder = f"flights/{checked_name(flight_id, 'flight')}/keyframes/"
    if (
        not isinstance(path, str)
        or re.fullmatch(re.escape(folder) + r"[0-9]{1,18}/[0-9]{6,18}\.jpg", path) is None
    ):
        raise _refused(path, "keyframe", f"a picture below {folder} was needed")
    return path


def checked_crs(crs: str) -> str:
    """An EPSG code, or "" for none; raises StoreError for anything else."""
    if crs and not (isinstance(crs, str) and is_epsg(crs)):
        raise _refused(
            crs, "coordinate reference system", "an EPSG code such as EPSG:32633 was needed"
        )
    return crs


def _refused(name: object, what: str, needed: str) -> StoreError:
    return StoreError(
        f"the site's catalogue names a {what} {str(name)[:80]!r}; {needed}. The site is damaged or was made to do "
        "harm: do not use it"
    )
