"""Flights that earlier searches measured, put together with one that goes on: their frames looked at, not searched."""

import json
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Self

from sorvolo.build import build
from sorvolo.geometry.arrays import PointsM
from sorvolo.missions.flight.request import software
from sorvolo.missions.search.measure import (
    FlightLooks,
    MeasuredFlight,
    SearchedPlants,
    SearchFrame,
    planted_classes,
    sun_at,
)
from sorvolo.missions.search.prepare import (
    PreparedSearch,
    flights_to_search,
    marked_heights,
    search_frames,
)
from sorvolo.missions.search.settings import PLANTS, SearchOutputs, SearchSettings
from sorvolo.search.cells import Cells, cells_of
from sorvolo.search.conditions import AboveGround
from sorvolo.search.plant_places import PlantPlace
from sorvolo.store.atomic import atomic_write_bytes
from sorvolo.store.exports.plain import feature_collection, geojson_bytes
from sorvolo.store.exports.pod_files import point_features
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.journal import content_sha256
from sorvolo.survey.flight import Site
from sorvolo.tracking.laying import pose_of

_FORMAT = 1


@dataclass(frozen=True)
class Basis:
    """By what the plants of a flight were measured.

    `program` (with the libraries that it runs on), `model`, `frames` (their cameras and places), `heights`, `area` and
    `cut_outs` are hashes, "" for none.
    """

    program: str
    model: str
    frames: str
    heights: str
    sun_deg: tuple[float, float] | None
    classes: tuple[str, ...]
    plants: int
    seed: int
    area: str
    cut_outs: str

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
        kept = [
            (each.m_per_px, each.texture.shape, each.texture.tobytes().hex())
            for each in prepared.cut_outs
        ]
        places = [(each.placed.camera, pose_of(each.placed)) for each in frames]
        return cls(
            content_sha256(build(), software()),
            content_sha256(prepared.detector.info),
            content_sha256(places),
            heights,
            settings.sun_deg,
            planted_classes(prepared.detector, settings),
            settings.plants,
            settings.seed,
            area,
            content_sha256(kept) if kept else "",
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


class EarlierFlights:
    """The flights of a site but one, as far as earlier searches into the same folder measured them on the same basis.

    `look` takes one frame at a time, so that it can be called between others' work; a flight counts once all its frames
    were looked at.
    """

    def __init__(
        self,
        archive: Archive,
        but: str,
        prepared: PreparedSearch,
        settings: SearchSettings,
        outputs: SearchOutputs,
    ) -> None:
        site, before = archive.site(), read_plants(outputs.folder)
        self._left: deque[_Flight] = deque()
        self._measured: list[tuple[Cells, MeasuredFlight]] = []
        self.frames: dict[str, tuple[SearchFrame, ...]] = {}
        """Of the flights that count, by their names."""
        self.unplaced: list[str] = []
        self._outlines_m: dict[str, list[PointsM]] = {}
        for name in flights_to_search(archive, ()):
            if name == but:
                continue
            if not (frames := search_frames(archive, name)):
                self.unplaced.append(name)
                continue
            self._outlines_m[name] = [each.placed.outline_m for each in frames]
            above, mark = marked_heights(archive, name)
            basis = Basis.of(frames, prepared, settings, heights=mark)
            known, searched = before.get(name, (None, None))
            if known is not None and searched is not None and known.serves(basis):
                self._left.append(
                    _Flight(name, frames, site, basis.classes, searched, above, settings)
                )

    @property
    def uncounted_m(self) -> list[PointsM]:
        """The ground of each frame of the flights that do not count yet, or never will, (4, 2) site metres."""
        return [
            each
            for name, own in self._outlines_m.items()
            if name not in self.frames
            for each in own
        ]

    def look(self) -> bool:
        """Look at one more frame; whether there was one."""
        if not self._left:
            return False
        flight = self._left.popleft()  # and left out where one of its pictures cannot be read
        flight.look()
        if flight.is_whole:
            self._measured.append((flight.cells, flight.measured()))
            self.frames[flight.name] = tuple(flight.frames)
        else:
            self._left.appendleft(flight)
        return True

    def on(self, cells: Cells) -> list[MeasuredFlight]:
        """The flights that count by now, over other cells of the site: each cell has what theirs has at its middle."""
        moved = []
        for own, flight in self._measured:
            rows = own.rows_at(cells.centres_m)
            classes = [
                replace(each, seen=each.seen.at(rows), chances=each.chances.at(rows))
                for each in flight.classes
            ]
            moved.append(replace(flight, classes=tuple(classes)))
        return moved


class _Flight:
    """One flight while its frames are looked at."""

    def __init__(
        self,
        name: str,
        frames: Sequence[SearchFrame],
        site: Site,
        labels: Sequence[str],
        searched: SearchedPlants,
        above: AboveGround | None,
        settings: SearchSettings,
    ) -> None:
        self.name, self.frames, self._labels = name, frames, labels
        self._searched = searched
        self.cells = cells_of([each.placed.outline_m for each in frames], site, None)
        self._sun = sun_at(frames[len(frames) // 2], site, settings)
        self._looks = FlightLooks(above)

    @property
    def is_whole(self) -> bool:
        """Whether all frames were looked at."""
        return len(self._looks.frames) == len(self.frames)

    def look(self) -> None:
        self._looks.add(self.frames[len(self._looks.frames)], self._sun)

    def measured(self) -> MeasuredFlight:
        """Return what its plants state of its own cells."""
        seen = self._looks.of_cells(self.cells, self._labels)
        return self._looks.measured(self.name, seen, self._searched, is_earlier=True)
