"""Small text files that a person gives: read whole, within bounds, or refused in words."""

from pathlib import Path
from typing import Any

from sorvolo.errors import InputError

MOST_BYTES = 20_000_000  # a file of some hundred thousand lines; by choice


def read_small_file(path: Path, kind: str) -> bytes:
    """The bytes of a file, `kind` being what it is in words ("area file").

    Raises InputError for one that cannot be read or is larger than any of its kind.
    """
    try:
        with path.open("rb") as file:
            raw = file.read(MOST_BYTES + 1)
    except OSError as error:
        raise InputError(f"{path}: the {kind} cannot be read: {error.strerror or error}") from error
    if len(raw) > MOST_BYTES:
        raise InputError(f"{path}: larger than {MOST_BYTES // 1_000_000} MB, so no {kind}")
    return raw


def text_of(path: Path, raw: bytes, kind: str, needed: str) -> str:
    """Their text, UTF-8 or by its byte order mark UTF-16, without blanks around it.

    Raises InputError for bytes that are no text, and for none at all, naming what is `needed`.
    """
    try:
        is_utf16 = raw[:2] in (b"\xff\xfe", b"\xfe\xff")
        text = raw.decode("utf-16" if is_utf16 else "utf-8-sig").strip()
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not text, so no {kind}; {needed} is needed") from error
    if not text:
        raise InputError(f"{path}: the {kind} is empty; {needed} is needed")
    return text


def as_number(value: Any) -> float:
    """A number of a JSON file or message. Raises TypeError for true and false, which would count as 1 and 0."""
    if isinstance(value, bool):
        raise TypeError(f"a number was expected, got {str(value).lower()}")
    return float(value)
