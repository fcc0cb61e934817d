"""The one door to labelled pictures of any form: `read_dataset`, `read_datasets`. Each form has a file of its own."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TypedDict, Unpack

from sorvolo.errors import InputError, SettingsError
from sorvolo.lab.datasets.checking import labelled_set, naming, plain
from sorvolo.lab.datasets.coco import coco_files, read_coco
from sorvolo.lab.datasets.okutama import looks_like_okutama, read_okutama
from sorvolo.lab.datasets.parsed import ParsedSet, Reader, files_below, first_line, is_label_file
from sorvolo.lab.datasets.splits import compiled
from sorvolo.lab.datasets.umcd import looks_like_umcd, read_umcd
from sorvolo.lab.datasets.visdrone import looks_like_visdrone, read_visdrone
from sorvolo.lab.datasets.voc import looks_like_voc, read_voc
from sorvolo.lab.datasets.yolo import looks_like_yolo, read_yolo
from sorvolo.paths import AnyPath
from sorvolo.survey.labels import LabelledSet
from sorvolo.survey.objects import CLASSES

READERS: Mapping[str, Reader] = {
    "coco": read_coco,
    "yolo": read_yolo,
    "voc": read_voc,
    "visdrone": read_visdrone,
    "okutama": read_okutama,
    "umcd": read_umcd,
}
"""Every form by the name that a user gives it."""

_MOST_LOOKED_AT = 200  # files; the first ones may be empty, of pictures of nothing
_PARTS = frozenset({"images", "train", "val", "valid", "test"})


class LabelOptions(TypedDict, total=False):
    """How labels are read. `form` is one of `READERS`; without it the files show the form. `classes` maps the set's
    names to ours, such as {"Pedestrian": "person"}, letters' case aside; without it common names are known. Boxes of
    names in `ignore` become ignored regions; those of any other name are left out and counted in a notice. `unlabelled`
    names classes of ours that may be in the pictures without a label. `group_pattern` is a regular expression whose one
    group is the video's name within the picture's path."""

    form: str | None
    classes: Mapping[str, str] | None
    ignore: Sequence[str]
    unlabelled: Sequence[str]
    group_pattern: str | None


def read_dataset(place: AnyPath, **options: Unpack[LabelOptions]) -> LabelledSet:
    """Labelled pictures from a file or folder, in our classes (docs/datasets.md).

    Raises InputError when there is nothing to read, none of the names stands for a class, or labels and pictures do not
    belong together; SettingsError for an unknown form or a broken pattern.
    """
    return _read(Path(place), **options)[0]


def read_datasets(
    places: Sequence[Path | str], *, known: Iterable[str] = (), **options: Unpack[LabelOptions]
) -> tuple[LabelledSet, ...]:
    """Several sets, read alike, each as `read_dataset` reads it; a slip in a name is no silent one here.

    Raises InputError and SettingsError as that does, and SettingsError where a name in `ignore` is none of any set's,
    or one in `unlabelled` no class: of ours, of `classes`, of a set, or of those that are `known` besides.
    """
    read = [_read(Path(place), **options) for place in places]
    if read:
        names = dict.fromkeys(name for _, own in read for name in own)
        _refuse_unknown("ignore", options.get("ignore", ()), names, "name in the labels")
        found = (name for labelled, _ in read for name in labelled.classes)
        classes = options.get("classes") or {}
        ours = dict.fromkeys([*CLASSES, *classes.values(), *found, *known])
        _refuse_unknown("unlabelled", options.get("unlabelled", ()), ours, "class", exact=True)
    return tuple(labelled for labelled, _ in read)


def _refuse_unknown(
    option: str, asked: Iterable[str], known: Iterable[str], kind: str, *, exact: bool = False
) -> None:
    compared = set(known) if exact else {plain(name) for name in known}
    unknown = [name for name in asked if (name if exact else plain(name)) not in compared]
    if unknown:
        there = ", ".join(known) or "none"
        raise SettingsError(
            f"{option}: {', '.join(map(repr, unknown))} is no {kind}; there are: {there}"
        )


def _read(
    place: Path,
    form: str | None = None,
    classes: Mapping[str, str] | None = None,
    ignore: Sequence[str] = (),
    unlabelled: Sequence[str] = (),
    group_pattern: str | None = None,
) -> tuple[LabelledSet, tuple[str, ...]]:
    """The set, and all names that its own labels have."""
    if form is not None and form not in READERS:
        raise SettingsError(f"unknown form {form!r} of labels; choose one of {', '.join(READERS)}")
    pattern = None if group_pattern is None else compiled(group_pattern)
    if not place.exists():
        raise InputError(
            f"{place} does not exist; give a folder of labelled pictures, or its label file"
        )
    parsed = _parsed(place, form)
    labelled = labelled_set(parsed, place, naming(classes, ignore), unlabelled, pattern)
    return labelled, parsed.names


def _parsed(place: Path, form: str | None) -> ParsedSet:
    """What the form's reader finds; an error of a form that was asked for adds what it looks like instead."""
    if form is None:
        known = ", ".join(READERS)
        recognised = _form_of(place)
        if recognised is not None:
            return READERS[recognised](place)
        if place.is_file():
            raise InputError(
                f"{place} is no label file of a known form ({known}); give the folder, or its labels"
            )
        try:
            return read_yolo(place)  # the one form in which every label file may be empty
        except InputError as error:
            raise InputError(
                f"{error} (labels of no known form were recognised: {known})"
            ) from error
    try:
        return READERS[form](place)
    except InputError as error:
        recognised = _form_of(place)
        if recognised in (None, form):
            raise
        raise InputError(
            f"{error}; it looks like {recognised}: read it as that, or leave the form out"
        ) from error


def _form_of(place: Path) -> str | None:
    """The form's name among READERS; None for what is of none of them."""
    if place.is_file():
        ending = place.suffix.lower()
        known = {".json": "coco", ".yaml": "yolo", ".yml": "yolo", ".xml": "voc"}
        return known.get(ending) or (_form_of_text(place) if ending == ".txt" else None)
    if coco_files(place):
        return "coco"
    if any(looks_like_voc(path) for path in files_below(place, ".xml")[:_MOST_LOOKED_AT]):
        return "voc"
    found = (_form_of_text(path) for path in _label_texts(place)[:_MOST_LOOKED_AT])
    return next((form for form in found if form), None)


def _label_texts(folder: Path) -> list[Path]:
    """The folder's text files of labels; of one part of a set without any, those beside the part."""
    texts = [path for path in files_below(folder, ".txt") if is_label_file(path)]
    if not texts and folder.name.lower() in _PARTS:
        texts = [path for path in files_below(folder.parent, ".txt") if is_label_file(path)]
    return texts


def _form_of_text(path: Path) -> str | None:
    line = first_line(path)
    for form, looks_like in (
        ("visdrone", looks_like_visdrone),
        ("okutama", looks_like_okutama),
        ("yolo", looks_like_yolo),
    ):
        if looks_like(line):
            return form
    return "umcd" if looks_like_umcd(path) else None
