"""Which video or flight a picture belongs to, by its folder and its file's name."""

import re
from pathlib import Path, PurePath

from sorvolo.errors import SettingsError
from sorvolo.lab.datasets.splits import stem_of

_NUMBERED = re.compile(
    r"(?P<video>.*?)[ _.\-]*(?:(?<![a-z])(?:frames?|img|image|picture|[if]))?[ _.\-]*\(?\d+\)?[ _.\-]*",
    re.IGNORECASE,
)
_PLAIN_FOLDERS = frozenset(
    {
        "images",
        "image",
        "imgs",
        "img",
        "jpegimages",
        "pictures",
        "photos",
        "frames",
        "labels",
        "annotations",
        "data",
        "obj_train_data",
        "sequences",
        "train",
        "training",
        "val",
        "valid",
        "validation",
        "test",
        "testing",
    }
)


def compiled(pattern: str) -> re.Pattern[str]:
    """A user's pattern. Raises SettingsError when it is none, or has not exactly one group."""
    try:
        found = re.compile(pattern)
    except re.error as error:
        raise SettingsError(
            f"group pattern {pattern!r} is no regular expression: {error}"
        ) from error
    if found.groups != 1:
        raise SettingsError(
            f"group pattern {pattern!r} has {found.groups} groups; mark the video's name with exactly one (...)"
        )
    return found


def group_of(path: Path, place: Path, pattern: re.Pattern[str] | None = None) -> str:
    """The picture's video: the folders below `place` that name something, then the file's name up to its last number.

    "bb_V0014_I0003160_jpg.rf.1f.jpg" is of "bb_V0014"; "flight1/photos/DJI_0031.JPG" of "flight1/DJI"; a name without
    a number is a video of its own. A `pattern` is searched in the path below `place`, with "/" between folders, and
    its one group is the answer where it is found.
    """
    below = _below(path, place)
    if pattern is not None and (match := pattern.search(below.as_posix())) and match.group(1):
        return match.group(1)
    stem = stem_of(below.name)
    numbered = _NUMBERED.fullmatch(stem)
    folders = [
        part for part in below.parts[:-1] if part.lower() not in _PLAIN_FOLDERS and part != ".."
    ]
    video = numbered["video"] if numbered else stem
    return "/".join([*folders, video] if video else folders) or place.name


def _below(path: Path, place: Path) -> PurePath:
    folder = place if place.is_dir() else place.parent
    try:
        return path.relative_to(folder)
    except ValueError:  # pictures beside the labels' folder
        return PurePath(*path.parts[-3:])
