"""The errors a person must act on; every message states what was found, what was needed and what to do."""

import errno
import re
from enum import EnumMeta
from typing import get_args, get_type_hints

_ARGUMENT_OF = {  # options whose argument in Python is not called the same
    "at": "places", "cell": "cell_m", "check": "checks", "fps": "frames_per_second", "gcp": "control",
    "gcp-accuracy": "control_sigma_m", "ground-elevation": "ground_elevation_m", "gsd": "m_per_px",
    "height": "height_m", "interval": "interval_m", "masks": "writes_masks", "max-height": "max_height_m", "out": "folder",
    "offset": "offset_s", "trust-map": "trusts_map", "no-update": "updates_map=False",
}  # fmt: skip
_OPTION = re.compile(r"(?:sorvolo [a-z]|ray start|pip install)[^,;`]*|(?<![\w-])--([a-z][a-z-]*)")


class SorvoloError(Exception):
    """Root of all errors that Sorvolo raises on purpose. As `str` it names arguments of functions, formatted (as
    commands print it, and within another's words) options of commands."""

    def __str__(self) -> str:
        return _OPTION.sub(
            lambda found: (
                _ARGUMENT_OF.get(found[1], found[1].replace("-", "_")) if found[1] else found[0]
            ),
            super().__str__(),
        )

    def __format__(self, spec: str) -> str:
        return format(super().__str__(), spec)


class InputError(SorvoloError):
    """A file, stream or folder given by the user cannot be used as it is."""


class GeometryError(SorvoloError):
    """Numbers that describe no possible camera, pose or place."""


class SettingsError(SorvoloError):
    """A setting or option is out of its range or contradicts another."""


def check_choices(record: object) -> None:
    """Raise SettingsError for a record, while it is made, with a field that is none of its Literal's or enum's words."""
    for name, kind in get_type_hints(type(record)).items():
        known = list(kind) if isinstance(kind, EnumMeta) else get_args(kind)
        texts = [each for each in known if isinstance(each, str)]
        value = getattr(record, name)
        if texts and len(texts) == len(known) and value not in texts:
            raise SettingsError(f"{name} must be one of {', '.join(texts)}, got {value!r}")


class StoreError(SorvoloError):
    """The site folder cannot be read or written."""


class UnavailableError(StoreError):
    """A database or store cannot be reached, or somebody else writes: later the same may succeed."""


class NotFoundError(StoreError):
    """The site, or the version of its map, is not there."""


class NoHeightsError(InputError):
    """A flight has no heights of its present map."""


class DiskFullError(StoreError):
    """A disk has no room for what was to be written: with room, the same will succeed."""


FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""Numbers of the operating system's errors where a disk, or what a user may take of it, is full."""


def goes_on(error: BaseException | None) -> bool:
    """Whether a run that ended so is left as a killed one, for the same command to go on with."""
    is_full = isinstance(error, OSError) and error.errno in FULL
    return is_full or isinstance(error, DiskFullError | UnavailableError)


class SorvoloWarning(RuntimeWarning):
    """What works, but worse than it could; commands print it as one line."""
