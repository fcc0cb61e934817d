"""From a set's own class names to ours: which become classes, which are ignored, which are left out."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from sorvolo.errors import InputError
from sorvolo.survey.objects import CLASSES

PERSON, CAR, SMALL = CLASSES

DEFAULT_CLASSES: Mapping[str, str] = {
    **dict.fromkeys(
        (
            "person",
            "persons",
            "people",
            "pedestrian",
            "pedestrians",
            "human",
            "humans",
            "man",
            "woman",
            "child",
            "swimmer",
            "victim",
            "mannequin",
        ),
        PERSON,
    ),
    **dict.fromkeys(
        (
            "car",
            "cars",
            "vehicle",
            "vehicles",
            "van",
            "minivan",
            "minibus",
            "suv",
            "taxi",
            "pickup",
            "automobile",
        ),
        CAR,
    ),
    **dict.fromkeys(
        (
            "small object",
            "small objects",
            "box",
            "small box",
            "big box",
            "suitcase",
            "metal suitcase",
            "bag",
            "backpack",
            "handbag",
            "luggage",
            "tire",
            "tyre",
            "gas bottle",
        ),
        SMALL,
    ),
}
"""Common names and the class they stand for unless the user maps them; compared as `plain` writes them."""

LOOK_ALIKES = frozenset(
    {
        "truck",
        "lorry",
        "bus",
        "othervehicle",
        "other vehicle",
        "biker",
        "bicyclist",
        "cyclist",
        "rider",
        "motorcyclist",
        "skater",
        "bicycle",
        "bike",
        "motor",
        "motorcycle",
        "motorbike",
        "scooter",
        "tricycle",
        "awning tricycle",
        "cart",
    }
)
"""Names of what looks like a class of ours but is none: calling a truck a car, or a cyclist a person, is neither right
nor wrong."""

DEFAULT_IGNORED = LOOK_ALIKES | {
    "ignored regions",
    "ignored",
    "ignore",
    "dontcare",
    "dont care",
    "others",
    "crowd",
}
"""Names that become regions where nothing counts: look-alikes, and what a set ignores itself."""


def plain(name: str) -> str:
    """A name for comparison: lower case, single spaces for any of space, underscore and hyphen."""
    return " ".join(name.lower().replace("_", " ").replace("-", " ").replace("'", "").split())


@dataclass(frozen=True)
class Naming:
    """`targets` gives our class of a plain name, `ignored` holds the plain names that become ignored regions."""

    targets: Mapping[str, str]
    ignored: frozenset[str]

    def classes(self, names: Iterable[str]) -> tuple[str, ...]:
        """Our classes that these names of the set stand for: the usual ones first, in the order of `CLASSES`."""
        found = {self.targets[plain(name)] for name in names if self.is_target(name)}
        usual = [each for each in CLASSES if each in found]
        return (*usual, *sorted(found - set(CLASSES)))

    def is_target(self, name: str) -> bool:
        """Whether a name of the set becomes a class."""
        return plain(name) in self.targets and not self.is_ignored(name)

    def target(self, name: str) -> str:
        """Our class of a name that becomes one."""
        return self.targets[plain(name)]

    def is_ignored(self, name: str) -> bool:
        """Whether a name of the set becomes an ignored region."""
        return plain(name) in self.ignored


def of_one_unnamed(names: Naming) -> Naming:
    """The naming of a set whose one class has the number 0 and no name, where the user looks for one class only."""
    targets = set(names.targets.values())
    return (
        Naming({**names.targets, "0": targets.pop()}, names.ignored) if len(targets) == 1 else names
    )


def naming(classes: Mapping[str, str] | None, ignore: Iterable[str]) -> Naming:
    """What the user asked for; without `classes` the usual names are known and their look-alikes ignored."""
    asked = frozenset(plain(name) for name in ignore)
    if classes is None:
        return Naming(DEFAULT_CLASSES, asked | DEFAULT_IGNORED)
    return Naming({plain(name): target for name, target in classes.items()}, asked)


def nothing_maps(place: str, counts: Mapping[str, int], known: Iterable[str]) -> InputError:
    """The error for a set none of whose names becomes a class."""
    found = ", ".join(f"{name} ({count} boxes)" for name, count in counts.items()) or "none"
    return InputError(
        f"{place}: none of its class names ({found}) is one of those looked for ({', '.join(sorted(known))}); state "
        f"which stand for which class, such as --classes {next(iter(counts), 'name')}=person"
    )
