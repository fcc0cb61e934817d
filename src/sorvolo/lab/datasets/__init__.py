"""The one door to labelled pictures of any form: `read_dataset`, `read_datasets`. Each form has a file of its own."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from sorvolo.errors import InputError, SettingsError
from sorvolo.lab.datasets.checking import labelled_set
from sorvolo.lab.datasets.coco import read_coco
from sorvolo.lab.datasets.groups import compiled
from sorvolo.lab.datasets.naming import naming, plain
from sorvolo.lab.datasets.parsed import ParsedSet, Reader
from sorvolo.lab.datasets.recognising import form_of
from sorvolo.lab.datasets.visdrone import read_visdrone
from sorvolo.lab.datasets.voc import read_voc
from sorvolo.lab.datasets.yolo import read_yolo
from sorvolo.paths import AnyPath
from sorvolo.survey.labels import LabelledSet
from sorvolo.survey.objects import CLASSES


def _read_okutama(place: Path) -> ParsedSet:
    from sorvolo.lab.thesis.okutama import read_okutama

    return read_okutama(place)


def _read_umcd(place: Path) -> ParsedSet:
    from sorvolo.lab.thesis.umcd import read_umcd

    return read_umcd(place)


READERS: Mapping[str, Reader] = {
    "coco": read_coco,
    "yolo": read_yolo,
    "voc": read_voc,
    "visdrone": read_visdrone,
    "okutama": _read_okutama,
    "umcd": _read_umcd,
}
"""Every form by the name that a user gives it."""


def read_dataset(
    place: AnyPath,
    *,
    form: str | None = None,
    classes: Mapping[str, str] | None = None,
    ignore: Iterable[str] = (),
    unlabelled: Iterable[str] = (),
    group_pattern: str | None = None,
) -> LabelledSet:
    """Labelled pictures from a file or folder, in our classes (docs/datasets.md).

    `form` is one of `READERS`; without it the files show the form. `classes` maps the set's names to ours,
    such as {"Pedestrian": "person"}, letters' case aside; without it common names are known. Boxes of names in
    `ignore` become ignored regions; those of any other name are left out and counted in a notice. `unlabelled` names
    classes of ours that may be in the pictures without a label. `group_pattern` is a regular expression whose one
    group is the video's name within the picture's path.

    Raises InputError when there is nothing to read, none of the names stands for a class, or labels and pictures do not
    belong together; SettingsError for an unknown form or a broken pattern.
    """
    place = Path(place)
    return _read(Path(place), form, classes, ignore, unlabelled, group_pattern)[0]


def read_datasets(
    places: Sequence[Path | str],
    *,
    form: str | None = None,
    classes: Mapping[str, str] | None = None,
    ignore: Iterable[str] = (),
    unlabelled: Iterable[str] = (),
    group_pattern: str | None = None,
    known: Iterable[str] = (),
) -> tuple[LabelledSet, ...]:
    """Several sets, read alike, each as `read_dataset` reads it; a slip in a name is no silent one here.

    Raises InputError and SettingsError as that does, and SettingsError where a name in `ignore` is none of any set's,
    or one in `unlabelled` no class: of ours, of `classes`, of a set, or of those that are `known` besides.
    """
    ignore, unlabelled = tuple(ignore), tuple(unlabelled)
    read = [
        _read(Path(place), form, classes, ignore, unlabelled, group_pattern) for place in places
    ]
    if read:
        names = dict.fromkeys(name for _, own in read for name in own)
        _refuse_unknown("ignore", ignore, names, "name in the labels")
        found = (name for labelled, _ in read for name in labelled.classes)
        ours = dict.fromkeys([*CLASSES, *(classes or {}).values(), *found, *known])
        _refuse_unknown("unlabelled", unlabelled, ours, "class", exact=True)
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
    form: str | None,
    classes: Mapping[str, str] | None,
    ignore: Iterable[str],
    unlabelled: Iterable[str],
    group_pattern: str | None,
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
        return _parsed_as_recognised(place)
    try:
        return READERS[form](place)
    except InputError as error:
        recognised = form_of(place)
        if recognised in (None, form):
            raise
        raise InputError(
            f"{error}; it looks like {recognised}: read it as that, or leave the form out"
        ) from error


def _parsed_as_recognised(place: Path) -> ParsedSet:
    known = ", ".join(READERS)
    recognised = form_of(place)
    if recognised is not None:
        return READERS[recognised](place)
    if place.is_file():
        raise InputError(
            f"{place} is no label file of a known form ({known}); give the folder, or its labels"
        )
    try:
        return read_yolo(place)  # the one form in which every label file may be empty
    except InputError as error:
        raise InputError(f"{error} (labels of no known form were recognised: {known})") from error
