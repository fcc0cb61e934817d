"""Label files read whole, within bounds, whatever their encoding."""

from pathlib import Path

from sorvolo.errors import InputError

_NOT_LABELS = frozenset(
    {
        "classes.txt",
        "predefined_classes.txt",
        "train.txt",
        "val.txt",
        "valid.txt",
        "test.txt",
        "readme.txt",
        "license.txt",
        "requirements.txt",
        "readme.dataset.txt",
        "readme.roboflow.txt",
    }
)
_MOST_BYTES = 2_000_000_000  # COCO's own train2017 is half a gigabyte


def read_text(path: Path) -> str:
    """The file's text: UTF-8 with or without mark, UTF-16 with one; what is neither is replaced, not refused.

    Raises InputError when it cannot be read or is too large for any label file.
    """
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise InputError(
                f"{path} has {path.stat().st_size / 1e9:.1f} GB; no label file is that large"
            )
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror})") from error
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        return data.decode("utf-16", "replace")
    return data.decode("utf-8-sig", "replace")


def is_label_file(path: Path) -> bool:
    """Whether a text file may hold labels: names of classes, lists of pictures and notes do not."""
    return path.name.lower() not in _NOT_LABELS
