"""What was planted into each flight and found is kept beside a search's results, so that none is searched twice."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Self

from sorvolo import __version__
from sorvolo.missions.flight.software import software
from sorvolo.missions.search.measure import SearchedPlants, SearchFrame, planted_classes
from sorvolo.missions.search.prepare import PreparedSearch
from sorvolo.missions.search.settings import PLANTS, SearchSettings
from sorvolo.search.plant_places import PlantPlace
from sorvolo.store.atomic import atomic_write_bytes
from sorvolo.store.exports.plain import feature_collection, geojson_bytes
from sorvolo.store.exports.pod_files import point_features
from sorvolo.store.site.journal import content_sha256
from sorvolo.survey.flight import Site
from sorvolo.tracking.laying import pose_of

_FORMAT = 1


@dataclass(frozen=True)
class Basis:
    """By what the plants of a flight were measured.

    `program` (with the libraries that it runs on), `model`, `frames` (their cameras and places), `heights` and `area`
    are hashes, "" for no heights and no area.
    """

    program: str
    model: str
    frames: str
    heights: str
    through_crowns: float
    sun_deg: tuple[float, float] | None
    classes: tuple[str, ...]
    plants: int
    seed: int
    area: str

    @classmethod
    def of(
        cls,
        frames: Sequence[SearchFrame],
        prepared: PreparedSearch,
        settings: SearchSettings,
        *,
        heights: str,
    ) -> Self:
        """The basis of a search of these frames."""
        area = "" if prepared.area is None else content_sha256(prepared.area.polygons_lonlat)
        places = [(each.placed.camera, pose_of(each.placed)) for each in frames]
        return cls(
            content_sha256(__version__, software()),
            content_sha256(prepared.detector.info),
            content_sha256(places),
            heights,
            settings.through_crowns,
            settings.sun_deg,
            planted_classes(prepared.detector, settings),
            settings.plants,
            settings.seed,
            area,
        )

    @classmethod
    def from_json(cls, row: Mapping[str, Any]) -> Self:
        """The basis that `asdict` made plain. Raises KeyError, TypeError or ValueError for anything else."""
        values = {name: row[name] for name in cls.__dataclass_fields__}
        sun_deg = (
            None
            if values["sun_deg"] is None
            else (float(values["sun_deg"][0]), float(values["sun_deg"][1]))
        )
        return cls(**{**values, "sun_deg": sun_deg, "classes": tuple(values["classes"])})

    def serves(self, other: "Basis") -> bool:
        """Whether plants on this basis state as much for another search: of the same frames by the same model, under
        the same assumptions and of all its classes, however many there are and wherever in the frames they stand."""
        alike = replace(
            self, classes=other.classes, plants=other.plants, seed=other.seed, area=other.area
        )
        return alike == other and set(other.classes) <= set(self.classes)


def read_plants(folder: Path) -> dict[str, tuple[Basis, SearchedPlants]]:
    """What earlier searches into this folder planted, by the flights' names; nothing of a file that cannot be read."""
    try:
        content = json.loads((folder / PLANTS).read_bytes())
        if content["format"] != _FORMAT:
            return {}
        planted: dict[str, list[tuple[PlantPlace, bool]]] = {
            name: [] for name in content["flights"]
        }
        for each in content["features"]:
            row = each["properties"]
            planted[row["flight"]].append(
                (PlantPlace.at(row["class"], *row["site_m"]), bool(row["found"]))
            )
        return {
            name: (
                Basis.from_json(row["basis"]),
                SearchedPlants(row["looked"], row["rounds"], row["seconds"], tuple(planted[name])),
            )
            for name, row in content["flights"].items()
        }
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return {}


def write_plants(
    folder: Path, site: Site, flights: Mapping[str, tuple[Basis, SearchedPlants]]
) -> None:
    """Write what `read_plants` reads: a point for each plant, with its flight, class and whether it was found."""
    rows = [(name, place, hit) for name, (_, own) in flights.items() for place, hit in own.plants]
    properties = [
        {"flight": name, "class": place.label, "found": hit, "site_m": place.place_m.tolist()}
        for name, place, hit in rows
    ]
    features = point_features([place.place_m for _, place, _ in rows], site, properties)
    collection = feature_collection("plants", features, is_local=False)
    collection |= {
        "format": _FORMAT,
        "flights": {
            name: {
                "looked": own.looked,
                "rounds": own.rounds,
                "seconds": round(own.seconds, 1),
                "basis": asdict(basis),
            }
            for name, (basis, own) in flights.items()
        },
    }
    atomic_write_bytes(folder / PLANTS, geojson_bytes(collection))
