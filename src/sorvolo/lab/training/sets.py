"""What a training learns from and is checked on: labelled sets, split by video or flight."""

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from sorvolo.capture.photos import read_picture
from sorvolo.detection.light import is_thermal
from sorvolo.errors import InputError, SettingsError
from sorvolo.lab.datasets import read_datasets
from sorvolo.lab.datasets.splits import hold_out, shared_groups, shuffled
from sorvolo.lab.training.samples import Share
from sorvolo.survey.labels import LabelledPicture, LabelledSet
from sorvolo.survey.objects import CLASSES

_LOOKED_AT = 40  # pictures of a set that decide whether it is thermal
_SUBSTANTIAL = 0.1  # share of the samples from which on a light is learnt


@dataclass(frozen=True)
class DataOptions:
    """How data sets are read, as `store.datasets.read_datasets` takes it, and what they are checked on.

    `val` is a data set of its own, or the share of pictures that is held out ("0.15"); "0": nothing is checked.
    """

    val: str = "0.15"
    form: str | None = None
    classes: Mapping[str, str] | None = None
    ignore: tuple[str, ...] = ()
    unlabelled: tuple[str, ...] = ()
    group_pattern: str | None = None


@dataclass(frozen=True, eq=False)
class TrainingSets:
    """`shares` to learn from, `held_out` sets to be checked on, the model's `classes`, and what was remarked."""

    shares: tuple[Share, ...]
    held_out: tuple[LabelledSet, ...]
    classes: tuple[str, ...]
    notices: tuple[str, ...]

    @property
    def fingerprint(self) -> str:
        """Changes when pictures, their labels or their order do, wherever the folders lie."""
        digest = hashlib.sha256()
        for each in (*(share.labelled for share in self.shares), *self.held_out):
            digest.update(f"{each.name} {each.classes} {sorted(each.unlabelled)}".encode())
            for picture in each.pictures:
                digest.update(Path(picture.path).name.encode())
                for array in (picture.boxes_px, picture.labels, picture.ignored_px):
                    digest.update(array.tobytes())
        return digest.hexdigest()[:16]

    @property
    def lights(self) -> tuple[bool, bool]:
        """Whether enough thermal pictures are learnt from for a model to know them, and whether enough by day."""
        thermal = sum(share.weight for share in self.shares if share.thermal)
        by_day = sum(share.weight for share in self.shares if not share.thermal)
        least = _SUBSTANTIAL * (thermal + by_day)
        return thermal >= least, by_day >= least

    def described(self) -> list[dict[str, Any]]:
        """Each set for the report: its part, pictures, videos, boxes of each class."""
        parts: list[tuple[LabelledSet, str, bool | None]] = [
            (share.labelled, "learnt from", share.thermal) for share in self.shares
        ]
        parts += [(each, "checked on", None) for each in self.held_out]
        return [
            {
                "name": each.name,
                "part": part,
                "pictures": len(each),
                "videos": len({picture.group for picture in each.pictures}),
                "thermal": thermal,
                "boxes": {
                    name: int(sum((picture.labels == label).sum() for picture in each.pictures))
                    for label, name in enumerate(each.classes)
                },
                "unlabelled": sorted(each.unlabelled & set(self.classes)),
            }
            for each, part, thermal in parts
        ]


def training_sets(places: Sequence[Path], options: DataOptions, *, seed: int) -> TrainingSets:
    """Read and split all sets: what is learnt from and checked on.

    A class that a set does not name is unlabelled there. Raises InputError where a set cannot be read or none holds an
    object to learn, SettingsError where `val` is neither a data set nor a share.
    """
    share = _share_of(options.val)
    if not places:
        raise InputError("no data to learn from; give folders of labelled pictures")
    checked = [Path(options.val)] if share is None else []
    labels: Any = {name: value for name, value in vars(options).items() if name != "val"}
    read = read_datasets([*places, *checked], **labels)
    learnt, held_out = list(read[: len(places)]), list(read[len(places) :])
    notices = [f"{each.name}: {notice.text}" for each in read for notice in each.notices]
    if share is None:
        notices += [notice.text for each in learnt for notice in shared_groups(each, held_out[0])]
    else:
        parts = [hold_out(each, share, seed) for each in learnt]
        learnt = [part for part, _, _ in parts]
        held_out = [part for _, part, _ in parts if len(part)]
        notices += [text for _, _, texts in parts for text in texts]
    shares = [share for each in learnt for share in _by_light(each)]
    classes = _in_order(name for each in shares for name in each.labelled.classes)
    shares = [replace(each, labelled=_honest(each.labelled, classes)) for each in shares]
    counts = dict.fromkeys(classes, 0)
    for each in shares:
        for picture in each.labelled.pictures:
            for label in picture.labels:
                counts[each.labelled.classes[label]] += 1
    if not any(counts.values()):
        remarks = "; ".join(notices) or "all their label files are empty"
        raise InputError(
            f"none of the pictures to learn from has a labelled object that can be used ({remarks}); "
            "check the labels, their class names and what is held out with --val"
        )
    notices += [
        f"only {count} boxes of class {name} to learn from"
        for name, count in counts.items()
        if count < 50
    ]
    return TrainingSets(
        tuple(shares), tuple(_honest(each, classes) for each in held_out), classes, tuple(notices)
    )


def _share_of(val: str) -> float | None:
    """The share that `val` names; None where it names a data set."""
    if Path(val).exists():
        return None
    try:
        share = float(val)
    except ValueError as error:
        raise SettingsError(
            f"--val {val} is neither an existing data set nor a share such as 0.15"
        ) from error
    if not 0 <= share < 1:
        raise SettingsError(f"the share to check on (--val) must lie in 0 to below 1, got {val}")
    return share


def _honest(labelled: LabelledSet, classes: Sequence[str]) -> LabelledSet:
    """The set with all classes that it has no labels for declared unlabelled."""
    unknown = frozenset(classes) - frozenset(labelled.classes)
    return replace(labelled, unlabelled=labelled.unlabelled | unknown)


def _by_light(labelled: LabelledSet) -> list[Share]:
    """The set as one share, thermal or not by some of its pictures; as two where these are of both kinds."""
    rows = shuffled(len(labelled))[:_LOOKED_AT]  # not evenly: lights may take turns
    known = [each for row in rows if (each := _is_thermal(labelled.pictures[row])) is not None]
    ratio = sum(known) / max(1, len(known))
    if not _SUBSTANTIAL <= ratio <= 1 - _SUBSTANTIAL:
        return [Share(labelled, float(len(labelled)), thermal=ratio > 0.5)]
    are_thermal = [_is_thermal(picture) for picture in labelled.pictures]
    by_day, thermal = (
        labelled.only(
            [p for p, dark in zip(labelled.pictures, are_thermal) if bool(dark) == wanted]
        )
        for wanted in (False, True)
    )
    thermal = replace(thermal, name=f"{labelled.name}, thermal")
    return [Share(by_day, float(len(by_day))), Share(thermal, float(len(thermal)), thermal=True)]


def _is_thermal(picture: LabelledPicture) -> bool | None:
    """None for a damaged one."""
    try:
        return is_thermal(read_picture(Path(picture.path)))
    except (InputError, OSError):
        return None


def _in_order(names: Iterable[str]) -> tuple[str, ...]:
    """Each name once: Sorvolo's own first, in their order."""
    found = set(names)
    return (*(each for each in CLASSES if each in found), *sorted(found - set(CLASSES)))
