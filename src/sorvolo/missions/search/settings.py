"""What a person may choose for measuring a search, and where its results go."""

from dataclasses import dataclass
from pathlib import Path

from sorvolo.errors import SettingsError
from sorvolo.paths import as_path, listed, take_one_or_several

CUT_OUTS = "cut-outs.png"
"""The file of a search's folder that shows the people who were cut out and planted."""

FIGURES = ("search.html", "search.json", "pod.tif", "pod.geojson", CUT_OUTS)
"""The files of a search's folder that hold its figures."""

PLANTS = "plants.geojson"
"""The file of a search's folder that holds what was planted and found."""

RESULTS = (*FIGURES, PLANTS)
"""All files of a search's folder."""


@dataclass(frozen=True)
class SearchSettings:
    """How the probability of detection is measured (`sorvolo search`).

    `plants` of each class are planted in all; no `classes` means those that the model usually reports. Where less than
    `enough` would have been found the ground is a hole. `sun_deg` is its azimuth and elevation; None: by time and place.
    """

    plants: int = 80
    classes: tuple[str, ...] = ()
    model: str = "default"
    enough: float = 0.5
    sun_deg: tuple[float, float] | None = None
    seed: int = 1

    def __post_init__(self) -> None:
        take_one_or_several(self, "classes")
        if not 10 <= self.plants <= 5000:
            raise SettingsError(
                f"--plants must lie in 10 to 5000, got {self.plants}: fewer measure nothing"
            )
        if self.seed < 0:
            raise SettingsError(f"the seed must be 0 or more, got {self.seed}")
        if not 0 <= self.enough <= 1:
            raise SettingsError(f"--enough must lie in 0 to 1, got {self.enough}")
        if self.sun_deg is not None and not (
            0 <= self.sun_deg[0] <= 360 and -90 <= self.sun_deg[1] <= 90
        ):
            raise SettingsError(
                f"the sun: azimuth in 0 to 360 and elevation in -90 to 90 degrees, got {self.sun_deg}"
            )


@dataclass(frozen=True)
class SearchOutputs:
    """Where results go and what they are counted over.

    `area` is what was to be searched (None: what the frames show and enclose), `poa` a file of segments with the
    probability that the missing is in each, `flights` those that are measured (none: all of the site's), `refly` files
    for waypoints over the holes; a .kmz is for `dji_drone`. `plant` are pictures of people from straight above, who are
    planted in place of drawn ones (`search.drawing.cut_outs`); a pixel of them covers `plant_cm` (None: by their height).
    """

    folder: Path
    area: Path | None = None
    poa: Path | None = None
    flights: tuple[str, ...] = ()
    refly: tuple[Path, ...] = ()
    dji_drone: str = "fly"
    plant: tuple[Path, ...] = ()
    plant_cm: float | None = None

    def __post_init__(self) -> None:
        for name in ("folder", "area", "poa"):
            object.__setattr__(self, name, as_path(getattr(self, name)))
        take_one_or_several(self, "flights")
        for name in ("refly", "plant"):
            object.__setattr__(
                self, name, tuple(Path(each) for each in listed(getattr(self, name)))
            )
        if self.plant_cm is not None and not 0.02 <= self.plant_cm <= 20:
            raise SettingsError(
                f"--plant-cm must lie in 0.02 to 20 (a pixel of the cut-outs), got {self.plant_cm}"
            )
