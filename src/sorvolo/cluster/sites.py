"""Which site each flight of a batch belongs to; one site has one writer, and its flights go in order of time."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from sorvolo.capture.source import safe_name
from sorvolo.cluster.orders import Scouted
from sorvolo.errors import StoreError
from sorvolo.geometry.units import M_PER_DEG_LATITUDE
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.catalogue_place import is_site

Box = tuple[float, float, float, float]
"""South, west, north and east of ground, degrees."""


class SiteBy(StrEnum):
    """What makes flights belong to one site."""

    FLIGHT = "flight"  # nothing: each has a site of its own
    PLACE = "place"  # their ground: those that come near each other


@dataclass(frozen=True)
class Placed:
    """A flight before it has a site: its files and what was seen of them."""

    path: Path
    scouted: Scouted


def sites_of(
    flights: Sequence[Placed],
    by: SiteBy,
    known: Mapping[str, str],
    ground: Mapping[str, Box],
    taken: Sequence[str] = (),
    near_m: float = 50.0,
    ending: str = "",
) -> dict[str, str]:
    """The site of each flight, by the flight's fingerprint.

    `known` are the sites of flights that have one, by fingerprint: they keep it. `ground` is where sites are that
    exist. `taken` are further names that no new site may have. By place, a flight in order of time joins the first site
    whose ground lies within `near_m` of its fixes, and the site's ground then reaches as far as the flight's; one that
    has no fixes, or lies near no site, founds a site named after it, with `ending` after the name.
    """
    found = dict(known)
    grounds = dict(ground)
    used = {*known.values(), *ground, *taken}
    for each in flights:  # where they already belong, their ground counts
        if (site := found.get(each.scouted.fingerprint)) is not None:
            _extend(grounds, site, each.scouted.box)
    for each in sorted(
        (each for each in flights if each.scouted.fingerprint not in found), key=_moment
    ):
        box = each.scouted.box
        near = _near(box, grounds, near_m) if by is SiteBy.PLACE and box is not None else ""
        site = near or _new_name(each.path, used, ending)
        used.add(site)
        _extend(grounds, site, box)
        found[each.scouted.fingerprint] = site
    return found


def _near(box: Box, grounds: Mapping[str, Box], near_m: float) -> str:
    """The first site by name whose ground lies near; "" for none."""
    return next(
        (name for name, other in sorted(grounds.items()) if _are_near(box, other, near_m)), ""
    )


def _moment(flight: Placed) -> tuple[int, str]:
    return flight.scouted.start_ns, str(flight.path)


@dataclass(frozen=True)
class ExistingSite:
    """A site that a folder holds: the fingerprints of its flights, and where its ground is, if that is known."""

    flights: frozenset[str]
    ground: Box | None


def existing_sites(root: Path, *, with_ground: bool) -> dict[str, ExistingSite]:
    """The sites in a folder by name; their ground only if it is asked for, which takes longer."""
    found = {
        path.name: existing_site(path, with_ground=with_ground) for path in sorted(root.iterdir())
    }
    return {name: site for name, site in found.items() if site is not None}


def existing_site(folder: Path, *, with_ground: bool = False) -> ExistingSite | None:
    """The site in a folder; None where there is none."""
    if not is_site(folder):
        return None
    try:
        with Archive.open(folder, write=False) as archive:
            flights = frozenset(each.fingerprint for each in archive.flights())
            return ExistingSite(flights, _ground(archive) if with_ground else None)
    except StoreError:  # the flights that go there will state why
        return ExistingSite(frozenset(), None)


def _ground(archive: Archive) -> Box | None:
    """Where a site's map is; None without a place on Earth, and without a map."""
    from sorvolo.missions.flight.setup import (
        known_ground_m,
    )  # only by place, as it takes long to import

    if not archive.has_site or (site := archive.site()).is_local:
        return None
    ground_m = known_ground_m(archive)
    if ground_m is None:
        return None
    latitudes, longitudes, _ = site.frame.wgs84_from_site(ground_m)
    return (
        float(latitudes.min()),
        float(longitudes.min()),
        float(latitudes.max()),
        float(longitudes.max()),
    )


def _are_near(one: Box, other: Box, near_m: float) -> bool:
    """Whether two boxes lie within `near_m` of each other, along each axis."""
    north = near_m / M_PER_DEG_LATITUDE
    east = north / max(0.01, math.cos(math.radians(one[0])))
    return (
        one[0] - north <= other[2]
        and other[0] - north <= one[2]
        and one[1] - east <= other[3]
        and other[1] - east <= one[3]
    )


def _extend(grounds: dict[str, Box], site: str, box: Box | None) -> None:
    """Have a site's ground reach over a box as well."""
    if box is not None:
        one = grounds.get(site, box)
        grounds[site] = (
            min(one[0], box[0]),
            min(one[1], box[1]),
            max(one[2], box[2]),
            max(one[3], box[3]),
        )


def _new_name(path: Path, used: set[str], ending: str) -> str:
    """The flight's own name; with its folder's before it, or a number after it, where another site has it."""
    own = path.name if path.is_dir() else path.stem
    name = safe_name(own)
    if f"{name}{ending}" in used:
        name = safe_name(f"{path.parent.name}_{own}")
    names = [f"{name}{ending}", *(f"{name}-{number}{ending}" for number in range(2, len(used) + 3))]
    return next(each for each in names if each not in used)
