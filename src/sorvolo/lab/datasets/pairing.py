"""Which label file belongs to which picture, and which picture to which frame of a video."""

from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path

from sorvolo.errors import InputError
from sorvolo.lab.datasets.groups import group_of
from sorvolo.lab.datasets.parsed import Finding
from sorvolo.lab.datasets.picture_files import PICTURE_ENDINGS, pictures_below
from sorvolo.lab.datasets.splits import frame_number

_PICTURE_FOLDERS = frozenset({"images", "jpegimages", "sequences", "pictures", "frames", "photos"})


def pictures_around(place: Path, form: str) -> list[Path]:
    """Pictures below a folder; of one with label files only, below the folder for pictures beside it.

    Raises InputError when there are none.
    """
    folder = place if place.is_dir() else place.parent
    found = pictures_below(folder)
    if not found:
        beside = [
            each
            for each in sorted(folder.parent.iterdir())
            if each.name.lower() in _PICTURE_FOLDERS
        ]
        found = [path for each in beside for path in pictures_below(each)]
    if not found:
        endings = ", ".join(sorted(PICTURE_ENDINGS))
        raise InputError(
            f"{place}: no pictures ({endings}) in it nor beside it; {form} labels need theirs"
        )
    return found


def paired(
    pictures: Sequence[Path], labels: Collection[Path], place: Path, form: str
) -> tuple[dict[Path, Path], list[Finding]]:
    """The label file of each picture that has one; files and pictures that are left over.

    A file belongs to the picture of the same stem, of several to that with most folders in common. Raises InputError
    when no picture has one.
    """
    label_of = _labels_of_pictures(pictures, labels)
    if not label_of:
        raise InputError(
            f"{place}: none of its {len(labels)} {form} files has a picture of the same name"
        )
    lonely = sorted(set(labels) - set(label_of.values()))
    return label_of, [
        *(Finding("labels_without_picture", path.name) for path in lonely),
        *(
            Finding("pictures_without_labels", path.name)
            for path in pictures
            if path not in label_of
        ),
    ]


def frames_by_video(
    pictures: Iterable[Path], videos: Iterable[str]
) -> Mapping[str, Mapping[int, Path]]:
    """The pictures of each video by frame number: in a folder of its name, or with its name before the number."""
    frames: dict[str, dict[int, Path]] = {video: {} for video in videos}
    for path in pictures:
        number = frame_number(path.name)
        if number is None:
            continue
        named = next((part for part in reversed(path.parts[:-1]) if part in frames), None)
        video = named or group_of(path, path.parent)
        if video in frames:
            frames[video].setdefault(number, path)
    return frames


def no_frames(place: Path, form: str, videos: Iterable[str]) -> InputError:
    """The error for labels of videos none of whose frames lies there as a picture."""
    first = next(iter(videos))
    return InputError(
        f"{place}: {form} labels of videos, but none of their frames is there; extract them as pictures into a folder "
        f"of the video's name, numbered as in the labels (such as {first}/000123.jpg)"
    )


def _labels_of_pictures(pictures: Iterable[Path], labels: Iterable[Path]) -> dict[Path, Path]:
    by_stem: dict[str, list[Path]] = {}
    for path in labels:
        by_stem.setdefault(path.stem, []).append(path)
    return {
        picture: max(by_stem[picture.stem], key=lambda path: _folders_in_common(path, picture))
        for picture in pictures
        if picture.stem in by_stem
    }


def _folders_in_common(path: Path, other: Path) -> int:
    return (Counter(path.parts[:-1]) & Counter(other.parts[:-1])).total()
