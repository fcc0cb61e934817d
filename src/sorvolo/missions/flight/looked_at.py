"""What a detector looked at of what a flight showed: counted in pictures and on the ground, said in every headline."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from sorvolo.detection.contract import ModelInfo
from sorvolo.detection.tiling import coarsest_m_per_px
from sorvolo.errors import SettingsError
from sorvolo.search.looked_ground import ClassGround, GroundState, LookedGround
from sorvolo.store.exports.detection_files import SEARCHED
from sorvolo.store.exports.plain import feature_collection, geojson_bytes
from sorvolo.store.exports.pod_files import CellGrid, region_features, regions_of
from sorvolo.survey.flight import Site
from sorvolo.survey.wording import counted

ENOUGH_LOOKED_AT = 0.9
"""The share of the ground, else of the pictures, without which a mission ends with exit code 3; by choice."""

_ALL = 0.995  # a share that rounds to 100 %: cells at the edges of frames


def check_enough(share: float) -> None:
    """Raise SettingsError for a share that is none."""
    if not 0 <= share <= 1:
        raise SettingsError(f"--enough-looked-at must lie in 0 to 1, got {share}")


def ground_for(site: Site, info: ModelInfo, classes: Sequence[str]) -> LookedGround:
    """An account of a site's ground for these classes, as finely as a model needs to see each."""
    return LookedGround(site, {name: coarsest_m_per_px(name, info) for name in classes})


@dataclass(frozen=True)
class LookedAt:
    """Pictures that were searched of those that a flight gave, and its ground by class; no ground without places."""

    searched: int
    seen: int
    enough: float = ENOUGH_LOOKED_AT
    ground: Mapping[str, ClassGround] = field(default_factory=dict)
    flown_m2: float = 0.0
    excuses: bool = False  # pixels too coarse for a class: nobody asked for it

    def share_of(self, name: str) -> float:
        """The share, 0 to 1, that was looked at for a class: of the ground, else of the pictures."""
        if self.flown_m2 and name in self.ground:
            return self.ground[name].share
        return self.searched / self.seen if self.seen else 0.0

    @property
    def share(self) -> float:
        """The least share of any class."""
        return min((self.share_of(each) for each in self.ground or ("",)), default=0.0)

    @property
    def is_enough(self) -> bool:
        """Whether as much was looked at as was asked for."""
        least = min(self.enough, _ALL)
        if not self.ground:
            return self.share >= least
        return all(
            own.share >= least
            or (
                self.excuses
                and own.coarse_m2 > own.looked_m2
                and own.skipped_m2 <= (1 - least) * self.flown_m2
            )
            for own in self.ground.values()
        )

    def words(self) -> str:
        """In pictures and shares of the ground."""
        pictures = f"{self.searched:,} of {counted(self.seen, 'picture')}"
        if not self.flown_m2:
            return f"{pictures} looked at"
        shares = {name: _percent(self.share_of(name)) for name in self.ground}
        if len(set(shares.values())) == 1:
            ground = f"{shares.popitem()[1]} of the ground looked at"
        else:
            listed = ", ".join(f"{share} for {name}" for name, share in shares.items())
            ground = f"ground looked at: {listed}"
        coarse = [name for name, own in self.ground.items() if own.coarse_m2 > 0.1 * self.flown_m2]
        return f"{pictures}, {ground}" + (
            f" (pixels too coarse for {' and '.join(coarse)})" if coarse else ""
        )

    def headline(self, counts: Mapping[str, int], looked_for: Sequence[str]) -> dict[str, Any]:
        """One line: what was found, what is not there, and how much was looked at; `complete`: enough of it.

        That there is none of a class is stated only where all of the ground was looked at for it.
        """
        found = [counted(count, name) for name, count in counts.items() if count]
        found += [
            f"no {name}"
            for name in looked_for
            if not counts.get(name) and self.share_of(name) >= _ALL
        ]
        what = ", ".join(found) or "not enough looked at to say what is there"
        return {"text": f"{what}; {self.words()}", "complete": self.is_enough}

    def facts(self) -> dict[str, Any]:
        """For a report (docs/formats.md)."""
        return {
            "pictures": self.searched,
            "pictures_seen": self.seen,
            "flown_m2": round(self.flown_m2, 1),
            "share": round(self.share, 4),
            "enough": self.enough,
            "classes": {
                name: {key: round(value, 1) for key, value in asdict(own).items()}
                | {"share": round(own.share, 4)}
                for name, own in self.ground.items()
            },
        }


def looked_at(
    ground: LookedGround | None,
    searched: int,
    seen: int,
    enough: float = ENOUGH_LOOKED_AT,
    *,
    excuses: bool = False,
) -> LookedAt:
    """The account of so many pictures, on this ground (None: nothing places the flight). `excuses`: what is looked for
    unasked needs no finer pixels than there are."""
    if ground is None or not ground.flown_m2:
        return LookedAt(searched, seen, enough)
    return LookedAt(searched, seen, enough, ground.of_classes(), ground.flown_m2, excuses)


def searched_document(ground: LookedGround | None, site: Site) -> dict[str, bytes]:
    """`searched.geojson` by its name, where the flight has a place; else nothing."""
    if ground is None or not ground.flown_m2:
        return {}
    # the flown ground as polygons: `state` looked at, too coarse or skipped, for its `classes`
    cells, features = ground.cells(), list[dict[str, Any]]()
    if cells is not None:
        grid = CellGrid(cells.outer_corner_m(), cells.cell_m, site.crs, site.origin.longitude_deg)
        alike: dict[bytes, list[str]] = defaultdict(list)  # classes of equal ground, once
        for name in ground.of_classes():
            alike[ground.states(name).tobytes()].append(name)
        for names in alike.values():
            regions = regions_of(cells.as_grid(ground.states(names[0])), grid)
            properties = [
                {"state": GroundState(each.number).words, "classes": names} for each in regions
            ]
            features += region_features(regions, properties)
    return {SEARCHED: geojson_bytes(feature_collection("searched", features, is_local=False))}


def _percent(share: float) -> str:
    """A share that is not the whole never reads 100 %."""
    return "100 %" if share >= _ALL else f"{int(100 * share)} %"
