"""The errors a person must act on; every message states what was found, what was needed and what to do."""


class SorvoloError(Exception):
    """Root of all errors that Sorvolo raises on purpose."""


class InputError(SorvoloError):
    """A file, stream or folder given by the user cannot be used as it is."""


class GeometryError(SorvoloError):
    """Numbers that describe no possible camera, pose or place."""


class SettingsError(SorvoloError):
    """A setting or option is out of its range or contradicts another."""


class StoreError(SorvoloError):
    """The site folder cannot be read or written."""


class UnavailableError(StoreError):
    """A database or store cannot be reached, or somebody else writes: later the same may succeed."""


class SorvoloWarning(RuntimeWarning):
    """What works, but worse than it could; commands print it as one line."""
