"""The memory of a place: every flight and second that saw it, in order, with pictures and what was found there."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any
from urllib.parse import quote

import numpy as np
from fastapi import APIRouter, Depends, Query
from shapely import Point

from sorvolo.geometry.arrays import PointsM
from sorvolo.station.collections import Collection, Feature, SiteCollections
from sorvolo.station.flight_videos import FlightVideos
from sorvolo.station.reviews import Review, Reviews
from sorvolo.station.security import needs
from sorvolo.station.sites import SiteShelf
from sorvolo.station.tokens import Role
from sorvolo.store.site.archive import Archive

_NEAR_M = 1.5  # from the tapped place to what was found there
_M_PER_DEG = 111_320.0
_DAY_S = 86_400.0


def place_routes(
    shelf: SiteShelf, collections: SiteCollections, reviews: Reviews, videos: FlightVideos
) -> APIRouter:
    """What is remembered of a place."""
    router = APIRouter(prefix="/api/sites/{site}", tags=["memory"], dependencies=[Depends(needs(Role.VIEW))])

    @router.get("/place")
    def place(
        site: str, lon: float = Query(ge=-360, le=360), lat: float = Query(ge=-90, le=90),
        most_per_flight: int = Query(12, ge=1, le=200),
    ) -> list[dict[str, Any]]:
        """Every frame that shows the place, in order of time, at most so many a flight: those that see it best.

        `crop_url` is a picture of the ground around it, north up; null where nothing was kept to cut it from.
        """
        archive = shelf.open(site)
        frames = collections.get(site, "frames")
        found = _near(site, Point(lon, lat), collections, reviews)
        place_m = archive.site().frame.ground_from_lonlat([(lon, lat)])[0] if archive.has_site else np.zeros(2)
        seen = frames.within([lon, lat, lon, lat])
        kept = {(each.flight_id, each.index) for each in archive.keyframes()}
        chosen = [
            each for flight in dict.fromkeys(frames.features[each]["properties"]["flight"] for each in seen)
            for each in _best(frames, seen, flight, Point(lon, lat), kept)[:most_per_flight]
        ]
        flights = dict.fromkeys(str(each["properties"]["flight"]) for each in chosen)
        films = {flight: _film(archive, flight, videos) for flight in flights}
        base = f"/api/sites/{quote(site, safe=':')}"
        rows = [_row(base, each, place_m, kept, films[each["properties"]["flight"]], found) for each in chosen]
        return sorted(rows, key=lambda each: (str(each["time"]), each["frame_id"]))

    return router


def _near(
    site_id: str, place: Point, collections: SiteCollections, reviews: Reviews
) -> Mapping[str, list[dict[str, Any]]]:
    """What was found within reach of a place: changes and objects by flight, with the verdicts on them."""
    reach_deg = _NEAR_M / _M_PER_DEG / max(0.01, float(np.cos(np.radians(place.y))))
    ring = place.buffer(reach_deg)
    result: dict[str, list[dict[str, Any]]] = {}
    for name, kind in (("changes", "change"), ("objects", "object")):
        collection, said = collections.get(site_id, name), reviews.current(site_id, kind)
        for each in _touching(collection, ring):
            values = each["properties"]
            result.setdefault(values["flight"], []).append({
                "type": kind, "id": each["id"], "class": values["class"], "kind": values.get("kind"),
                "score": values.get("score"), "first_seen": values["datetime"], "last_seen": values["end_datetime"],
                "review": _review(said.get(str(each["id"]))),
            })
    return result


def _touching(collection: Collection, ring: Any) -> list[Feature]:
    return [collection.features[int(each)] for each in sorted(collection.tree.query(ring, predicate="intersects"))]


def _review(review: Review | None) -> dict[str, Any] | None:
    if review is None:
        return None
    return {"verdict": review.verdict, "note": review.note, "who": review.who, "at": review.at}


def _best(
    frames: Collection, seen: Sequence[int], flight: str, place: Point, kept: set[tuple[str, int]]
) -> list[Feature]:
    """The frames of a flight that see a place, best first: those whose picture was kept, and farthest from its edge."""

    def rank(number: int) -> tuple[bool, float]:
        is_kept = (flight, frames.features[number]["properties"].get("frame")) in kept
        return not is_kept, -float(frames.shapes[number].boundary.distance(place))

    own = [each for each in seen if frames.features[each]["properties"]["flight"] == flight]
    return [frames.features[each] for each in sorted(own, key=rank)]


@dataclass(frozen=True)
class _Film:
    """Whether a flight's video is there, and when it began as the flight's report has it."""

    is_there: bool
    began: Any


def _film(archive: Archive, flight: str, videos: FlightVideos) -> _Film:
    is_there = videos.find(archive, flight) is not None
    return _Film(is_there, archive.report(flight).get("flown") if is_there else None)


def _row(
    base: str, frame: Feature, place_m: PointsM, kept: set[tuple[str, int]], film: _Film,
    found: Mapping[str, list[dict[str, Any]]],
) -> dict[str, Any]:
    """A frame that shows the place; `base` is the site's address."""
    values = frame["properties"]
    flight, name = values["flight"], values.get("frame")
    seconds = _seconds(values.get("time"), film.began) if film.is_there else None
    here, named = found.get(flight, []), quote(flight, safe="")
    source = "frame" if (flight, name) in kept else "video" if seconds is not None and isinstance(name, int) else ""
    east_mm, north_mm = (round(1000 * float(each)) for each in place_m)
    crop = f"{base}/crops/{source}/{named}/{name}/{east_mm}/{north_mm}.jpg" if source else None
    return {
        "flight": flight, "time": values.get("time"), "frame_id": frame["id"], "crop_url": crop, "video_s": seconds,
        "video_url": f"{base}/flights/{named}/video" if film.is_there else None,
        "height_m": values.get("height_above_ground_m"), "sigma_m": values.get("sigma_m"),
        **_found_here(here),
    }


def _found_here(found: Sequence[dict[str, Any]]) -> dict[str, list[dict[str, Any]]]:
    """What a flight found at the place, by kind, and the verdicts on it."""
    return {
        "changes": [each for each in found if each["type"] == "change"],
        "objects": [each for each in found if each["type"] == "object"],
        "reviews": [each["review"] | {"id": each["id"]} for each in found if each["review"] is not None],
    }


def _seconds(time: Any, flown: Any) -> float | None:
    """How far into its video a frame is, s; None where the two times have nothing in common."""
    try:
        start = datetime.fromisoformat(str(flown))
        seconds = (datetime.fromisoformat(str(time)) - start).total_seconds()
    except (ValueError, TypeError):
        return None
    return round(seconds, 3) if 0 <= seconds < _DAY_S else None
