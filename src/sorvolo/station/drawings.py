"""What people draw on a site's map for all to see: areas of interest, zones that raise an alert, waypoints."""

import hashlib
import json
import threading
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Depends
from pydantic import BaseModel, ConfigDict, Field

from sorvolo.station.events import EventLog, NewEvent
from sorvolo.station.problems import Problem
from sorvolo.station.security import needs
from sorvolo.station.settings import StationSettings
from sorvolo.station.sites import SiteShelf
from sorvolo.station.state import compact_json
from sorvolo.station.tokens import Role
from sorvolo.store.atomic import atomic_write_bytes, writing

_MOST_DRAWINGS, _MOST_CORNERS = 500, 500
_FOLDER = "drawings"

Longitude = Annotated[float, Field(ge=-180, le=180)]
Latitude = Annotated[float, Field(ge=-90, le=90)]
Place = tuple[Longitude, Latitude]


class _Point(BaseModel):
    type: Literal["Point"]
    coordinates: Place


class _Polygon(BaseModel):
    type: Literal["Polygon"]
    coordinates: Annotated[
        list[Annotated[list[Place], Field(min_length=4, max_length=_MOST_CORNERS)]],
        Field(min_length=1, max_length=1),
    ]


class _Properties(BaseModel):
    model_config = ConfigDict(extra="forbid")

    purpose: Literal["interest", "alert", "waypoint"]
    name: str = Field("", max_length=80)
    planned: bool = False


class Drawing(BaseModel):
    """One drawing as a GeoJSON feature in WGS84."""

    type: Literal["Feature"]
    id: str = Field(min_length=1, max_length=80)
    geometry: Annotated[_Point | _Polygon, Field(discriminator="type")]
    properties: _Properties


class DrawingsWish(BaseModel):
    """All drawings of a site as they shall be; `revision` is that of those they were made from, 0 for none."""

    revision: int = Field(ge=0, le=2**53)
    features: Annotated[list[Drawing], Field(max_length=_MOST_DRAWINGS)]


class Drawings:
    """The drawings of all sites, a small file each. `put` and `forget` change them; threads may share it."""

    def __init__(self, settings: StationSettings, shelf: SiteShelf, events: EventLog) -> None:
        self._folder, self._shelf, self._events = settings.state_folder / _FOLDER, shelf, events
        self._lock = threading.Lock()

    def get(self, site_id: str) -> dict[str, Any]:
        """The drawings of a site with their revision. Raises Problem (404)."""
        kept = self._kept(site_id, self._shelf.open(site_id).created_utc)
        return {
            "type": "FeatureCollection",
            "revision": kept.get("revision", 0),
            "features": kept.get("features", []),
        }

    def put(self, site_id: str, wish: DrawingsWish) -> dict[str, Any]:
        """Keep a site's drawings. Raises Problem (404; 409 where somebody drew meanwhile), StoreError."""
        with self._lock:
            made_utc = self._shelf.open(site_id).created_utc
            now = self._kept(site_id, made_utc).get("revision", 0)
            if wish.revision != now:
                raise Problem(
                    409,
                    "somebody drew meanwhile; load the drawings again and add yours",
                    revision=now,
                )
            kept = {"revision": now + 1, "features": [each.model_dump() for each in wish.features]}
            path = self._path(site_id)
            with writing(path):
                path.parent.mkdir(parents=True, exist_ok=True)
            atomic_write_bytes(path, compact_json({**kept, "made_utc": made_utc}).encode())
        self._events.append(NewEvent("drawings.changed", {"revision": kept["revision"]}, site_id))
        return {"type": "FeatureCollection", **kept}

    def forget(self, site_id: str) -> None:
        """Drop the drawings of a site that was deleted."""
        with self._lock:
            self._path(site_id).unlink(missing_ok=True)

    def _kept(self, site_id: str, made_utc: str) -> dict[str, Any]:
        """What is kept for the site that was made then; nothing of a deleted one that had its name.

        Files of earlier stations do not name the site's time: they are of one that was there when they were written.
        """
        path = self._path(site_id)
        try:
            kept: dict[str, Any] = json.loads(path.read_bytes())
            at_utc = datetime.fromtimestamp(path.stat().st_mtime, UTC).isoformat()
        except (FileNotFoundError, ValueError):
            return {}
        of_utc = kept.get("made_utc")
        is_ours = (
            at_utc >= made_utc if of_utc is None else of_utc in ("", made_utc)
        )  # "": before its first map
        return kept if is_ours else {}

    def _path(self, site_id: str) -> Path:
        return self._folder / f"{hashlib.sha256(site_id.encode()).hexdigest()[:32]}.json"


def drawing_routes(drawings: Drawings) -> APIRouter:
    """Drawings read and kept."""
    router = APIRouter(prefix="/api/sites/{site}/drawings", tags=["drawings"])

    @router.get("", dependencies=[Depends(needs(Role.VIEW))])
    def get(site: str) -> dict[str, Any]:
        """Areas of interest, alert zones and waypoints of a site."""
        return drawings.get(site)

    @router.put("", dependencies=[Depends(needs(Role.REVIEW))])
    def put(site: str, wish: DrawingsWish) -> dict[str, Any]:
        """Put all drawings of a site; 409 where they changed since they were read."""
        return drawings.put(site, wish)

    return router
