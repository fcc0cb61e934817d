"""What a training learns from and is checked on: labelled sets, split by video or flight, and simulated pictures."""

import hashlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from sorvolo.capture.photos import read_picture
from sorvolo.detection.light import is_thermal
from sorvolo.errors import InputError, SettingsError
from sorvolo.lab.datasets import read_dataset, read_datasets
from sorvolo.lab.datasets.splits import hold_out, shared_groups, shuffled
from sorvolo.lab.simulation.flight_files import PICTURES_MARK
from sorvolo.lab.simulation.pictures import PictureSettings, simulate_pictures
from sorvolo.lab.training.samples import Share
from sorvolo.survey.labels import LabelledPicture, LabelledSet
from sorvolo.survey.objects import CLASSES

_LOOKED_AT = 40  # pictures of a set that decide whether it is thermal
_SUBSTANTIAL = 0.1  # share of the samples from which on a light is learnt
_SYNTHETIC_PICTURES = (4, 1200)  # made at least and at most
_SYNTHETIC_THERMAL = 0.2  # share of simulated pictures, by choice


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
class ReadLabels:
    """Sets `learnt` from and `held_out`, and what was remarked of them."""

    learnt: tuple[LabelledSet, ...]
    held_out: tuple[LabelledSet, ...]
    notices: tuple[str, ...]


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


def read_labels(
    places: Sequence[Path], options: DataOptions, *, synthetic: float, seed: int
) -> ReadLabels:
    """Read and split all sets.

    Raises InputError where there is nothing to learn from or a set cannot be read, SettingsError where `val` is neither
    a data set nor a share.
    """
    share = _share_of(options.val)
    if not places and synthetic < 1:
        raise InputError(
            "no data to learn from; give folders of labelled pictures, or --synthetic 1"
        )
    checked = [Path(options.val)] if share is None else []
    labels: Any = {name: value for name, value in vars(options).items() if name != "val"}
    read = read_datasets([*places, *checked], **labels)
    whole, apart = list(read[: len(places)]), list(read[len(places) :])
    notices = [f"{each.name}: {notice.text}" for each in read for notice in each.notices]
    if share is not None:
        # The sets with a share of each held out; `notices` and what is to be known of that
        parts = [hold_out(each, share, seed) for each in whole]
        return ReadLabels(
            tuple(learnt for learnt, _, _ in parts),
            tuple(held_out for _, held_out, _ in parts if len(held_out)),
            (*notices, *(text for _, _, texts in parts for text in texts)),
        )
    notices += [notice.text for each in whole for notice in shared_groups(each, apart[0])]
    return ReadLabels(tuple(whole), tuple(apart), tuple(notices))


def training_sets(read: ReadLabels, *, synthetic: float, simulated: Path) -> TrainingSets:
    """What is learnt from and checked on; `simulated` is the folder of `simulate_samples`, from which `synthetic` of
    all samples come.

    A class that a set does not name is unlabelled there. Raises InputError where no set holds an object to learn.
    """
    notices = list(read.notices)
    shares = [share for each in read.learnt for share in _by_light(each)]
    if synthetic > 0:
        made = replace(read_dataset(simulated, form="coco"), name="simulated")
        shares = _mixed(shares, _parted(made), synthetic)
    classes = _in_order(name for each in shares for name in each.labelled.classes)
    shares = [replace(each, labelled=_honest(each.labelled, classes)) for each in shares]
    # Raise InputError where no picture has an object to learn, with what was remarked of the sets
    if not any(len(picture.labels) for each in shares for picture in each.labelled.pictures):
        remarks = "; ".join(notices) or "all their label files are empty"
        raise InputError(
            f"none of the pictures to learn from has a labelled object that can be used ({remarks}); "
            "check the labels, their class names and what is held out with --val"
        )
    counts = dict.fromkeys(classes, 0)
    for share in shares:
        for picture in share.labelled.pictures:
            for label in picture.labels:
                counts[share.labelled.classes[label]] += 1
    notices += [
        f"only {count} boxes of class {name} to learn from"
        for name, count in counts.items()
        if count < 50
    ]
    return TrainingSets(
        tuple(shares),
        tuple(_honest(each, classes) for each in read.held_out),
        classes,
        tuple(notices),
    )


def simulate_samples(folder: Path, samples: int, seed: int) -> Iterator[str]:
    """Make pictures for so many simulated samples, and report how far it is; a folder that has them already is kept."""
    low, high = _SYNTHETIC_PICTURES
    if not (folder / PICTURES_MARK).is_file():
        settings = PictureSettings(
            pictures=min(max(samples, low), high), seed=seed, thermal_share=_SYNTHETIC_THERMAL
        )
        for done in simulate_pictures(folder, settings):
            yield f"simulating pictures: {done.pictures_done} of {done.pictures_total}"


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
    by_day, thermal = _parted(labelled)
    return [Share(by_day, float(len(by_day))), Share(thermal, float(len(thermal)), thermal=True)]


def _parted(labelled: LabelledSet) -> tuple[LabelledSet, LabelledSet]:
    """The set's pictures by day, damaged ones among them, and its thermal ones."""
    are_thermal = [_is_thermal(picture) for picture in labelled.pictures]
    by_day = labelled.only(
        [picture for picture, dark in zip(labelled.pictures, are_thermal) if not dark]
    )
    thermal = labelled.only(
        [picture for picture, dark in zip(labelled.pictures, are_thermal) if dark]
    )
    return by_day, replace(thermal, name=f"{labelled.name}, thermal")


def _is_thermal(picture: LabelledPicture) -> bool | None:
    """None for a damaged one."""
    try:
        return is_thermal(read_picture(Path(picture.path)))
    except (InputError, OSError):
        return None


def _mixed(shares: Sequence[Share], made: Sequence[LabelledSet], ratio: float) -> list[Share]:
    """Weights such that `ratio` of all samples are simulated."""
    real = sum(share.weight for share in shares) or 1.0
    pictures = sum(len(each) for each in made)
    scaled = [replace(share, weight=share.weight / real * (1 - ratio)) for share in shares]
    return [share for share in scaled if share.weight > 0] + [
        Share(each, ratio * len(each) / pictures, thermal=index == 1)
        for index, each in enumerate(made)
        if len(each)
    ]


def _in_order(names: Iterable[str]) -> tuple[str, ...]:
    """Each name once: Sorvolo's own first, in their order."""
    found = set(names)
    return (*(each for each in CLASSES if each in found), *sorted(found - set(CLASSES)))
