"""Verdicts on objects, changes and findings: each kept with who gave it and when; none is lost to another's."""

import hashlib
import json
import sqlite3
import threading
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Query
from pydantic import BaseModel, ConfigDict, Field

from sorvolo.errors import SorvoloError, StoreError
from sorvolo.missions.site.review import review_changes, withdraw_reviews
from sorvolo.station.collections import Findings
from sorvolo.station.events import EventLog, NewEvent
from sorvolo.station.problems import Problem
from sorvolo.station.security import needs
from sorvolo.station.settings import StationSettings
from sorvolo.station.sites import SiteShelf
from sorvolo.station.state import StationState, compact_json, utc_now
from sorvolo.station.tokens import Holder, Role
from sorvolo.store.atomic import atomic_write_bytes, writing
from sorvolo.survey.findings import Verdict

NO_VERDICT = "none"
_OF_WATCHES = "watches"  # in place of when the site was made
_ELSEWHERE = "sorvolo review"  # who gave a verdict by the command line


class ReviewWish(BaseModel):
    """A verdict on an object, a change or a finding; `revision` is that of the verdict it was made upon, 0 for none."""

    kind: Literal["object", "change", "finding"]
    id: str = Field(min_length=1, max_length=400)
    verdict: Literal["confirmed", "rejected", "none"]
    note: str = Field("", max_length=2000)
    revision: int = Field(ge=0, le=2**62)


@dataclass(frozen=True)
class Review:
    """A person's verdict on one thing; each has the next revision. Times are RFC 3339 UTC."""

    kind: str
    id: str
    revision: int
    verdict: str
    note: str
    who: str
    at: str


class Reviews:
    """The verdicts on all sites' objects and changes. Threads may share it.

    Those on changes also go into the site, where missions look: at once, or when the mission that is writing into it is
    done (`settle`).
    """

    def __init__(
        self, state: StationState, shelf: SiteShelf, events: EventLog, findings: Findings
    ) -> None:
        self._state, self._shelf, self._events, self._findings = state, shelf, events, findings
        self._settling = threading.Lock()
        self._unsettled: set[str] = set()
        self._known: set[tuple[str, str]] = set()

    def current(self, site_id: str, kind: str) -> dict[str, Review]:
        """The newest verdict on each thing of a kind, by id; those given by the command line included."""
        rows = self._state.rows(
            "SELECT kind, id, MAX(revision) AS revision, verdict, note, who, at FROM reviews "
            "WHERE site = ? AND made_utc = ? AND kind = ? GROUP BY id",
            (*self._key(site_id, kind), kind),
        )
        found = {row["id"]: Review(**dict(row)) for row in rows}
        if kind == "change":
            found |= self._from_site(site_id, found)
        return found

    def history(self, site_id: str, kind: str = "", thing_id: str = "") -> list[Review]:
        """All verdicts of a site, newest first; of one thing."""
        rows = self._state.rows(
            "SELECT kind, id, revision, verdict, note, who, at FROM reviews "
            "WHERE site = ? AND made_utc IN (?, ?) AND (? = '' OR kind = ?) AND (? = '' OR id = ?) "
            "ORDER BY number DESC LIMIT 5000",
            (*self._key(site_id, kind), _OF_WATCHES, kind, kind, thing_id, thing_id),
        )
        return [Review(**dict(row)) for row in rows]

    def give(self, site_id: str, wish: ReviewWish, who: str) -> Review:
        """Keep a verdict. Raises Problem: 404 for an unknown thing, 409 where somebody judged it since."""
        self._demand_thing(site_id, wish.kind, wish.id)
        now = self.current(site_id, wish.kind).get(wish.id)
        revision = now.revision if now is not None else 0
        if wish.revision != revision:
            raise self._conflict(wish, now)
        made = Review(wish.kind, wish.id, revision + 1, wish.verdict, wish.note, who, utc_now())
        event, key = (
            NewEvent("review.changed", asdict(made), site_id),
            self._key(site_id, wish.kind),
        )
        try:
            with self._events.appending([event]) as connection:
                if now is not None and now.who == _ELSEWHERE:
                    _keep(connection, key, now)
                _keep(connection, key, made)
        except sqlite3.IntegrityError as error:  # another request was quicker
            raise self._conflict(wish, self.current(site_id, wish.kind).get(wish.id)) from error
        if wish.kind == "change":
            self.settle(site_id)
        return made

    def forget(self, site_id: str) -> None:
        """Drop all verdicts of a site that was deleted."""
        with self._state.changing() as connection:
            connection.execute("DELETE FROM reviews WHERE site = ?", (site_id,))
        self._unsettled.discard(site_id)

    def settle(self, site_id: str) -> bool:
        """Write the verdicts on changes that the site does not have yet into it; whether all are in it now."""
        with self._settling:
            archive = self._shelf.open(site_id)
            inside = {each.id: (each.verdict, each.note) for each in archive.changes()}
            waiting = [
                each
                for each in self.current(site_id, "change").values()
                if each.id in inside and inside[each.id] != (_as_stored(each), _stored_note(each))
            ]
            try:
                for each in waiting:
                    verdict = _as_stored(each)
                    if verdict is None:
                        withdraw_reviews(archive.folder, [each.id])
                    else:
                        review_changes(archive.folder, [each.id], verdict, each.note)
            except StoreError:  # a mission is writing into the site: when it ends they are settled
                self._unsettled.add(site_id)
                return False
            self._unsettled.discard(site_id)
            return True

    def settle_waiting(self) -> None:
        """Settle the sites whose verdicts had to wait, such as for a mission that then failed."""
        for site_id in list(self._unsettled):
            try:
                self.settle(site_id)
            except (Problem, SorvoloError):  # gone meanwhile, or damaged
                self._unsettled.discard(site_id)

    def _key(self, site_id: str, kind: str) -> tuple[str, str]:
        """Which site a verdict is of: a new site may have the name, and the ids, of one that was deleted.

        Findings have the ids of their runs, which no others have, and a watch needs no site.
        Verdicts of a station of format 1 become those of the site that was there when they were given.
        """
        if kind == "finding":
            return site_id, _OF_WATCHES
        made_utc = self._shelf.open(site_id).created_utc
        if made_utc and (site_id, made_utc) not in self._known:
            with self._state.changing() as connection:
                connection.execute(
                    "UPDATE reviews SET made_utc = ? WHERE site = ? AND made_utc = '' AND at >= ?",
                    (made_utc, site_id, made_utc),
                )
            self._known.add((site_id, made_utc))
        return site_id, made_utc

    def _from_site(self, site_id: str, known: Mapping[str, Review]) -> dict[str, Review]:
        """Verdicts that the command line gave after ours."""
        found = {}
        archive = self._shelf.open(site_id)
        at_utc = {each.change_id: each.at_utc for each in archive.reviews()}
        for change in archive.changes():
            if change.verdict is None:
                continue
            ours, at = known.get(change.id), at_utc.get(change.id, "")
            if ours is None or (
                at > ours.at and (change.verdict, change.note) != (_as_stored(ours), ours.note)
            ):
                revision = 1 if ours is None else ours.revision + 1
                found[change.id] = Review(
                    "change", change.id, revision, change.verdict.value, change.note, _ELSEWHERE, at
                )
        return found

    def _demand_thing(self, site_id: str, kind: str, thing_id: str) -> None:
        if thing_id not in self._ids(site_id, kind):
            raise Problem(404, f"the site has no {kind} {thing_id[:80]!r}; load the list again")

    def _ids(self, site_id: str, kind: str) -> list[str]:
        if kind == "finding":
            return [str(each["id"]) for each in self._findings.of_site(site_id)]
        archive = self._shelf.open(site_id)
        if kind == "change":
            return [each.id for each in archive.changes()]
        return [each.thing.id for each in archive.objects()]

    @staticmethod
    def _conflict(wish: ReviewWish, now: Review | None) -> Problem:
        newer = (
            f"{now.who} gave the verdict {now.verdict}"
            if now is not None
            else "the verdict was withdrawn"
        )
        return Problem(
            409,
            f"{newer} meanwhile; look at it, and give your verdict upon revision {now.revision if now else 0}",
            current=None if now is None else asdict(now),
        )


def review_routes(reviews: Reviews, shelf: SiteShelf) -> APIRouter:
    """Verdicts listed and given."""
    router = APIRouter(prefix="/api/sites/{site}/reviews", tags=["reviews"])

    @router.get("", dependencies=[needs(Role.VIEW)])
    def history(
        site: str,
        kind: Literal["", "object", "change", "finding"] = "",
        id: str = Query("", max_length=400),
    ) -> list[dict[str, Any]]:
        """Every verdict of the site with who gave it and when, newest first."""
        return [asdict(each) for each in reviews.history(site, kind, id)]

    @router.post("", status_code=201)
    def give(site: str, wish: ReviewWish, holder: Holder = needs(Role.REVIEW)) -> dict[str, Any]:
        """Confirm or reject an object, a change or a finding, or withdraw a verdict. 409 where another came first."""
        return asdict(reviews.give(site, wish, holder.name))

    return router


def _keep(connection: sqlite3.Connection, key: tuple[str, str], review: Review) -> None:
    connection.execute(
        "INSERT INTO reviews (site, made_utc, kind, id, revision, verdict, note, who, at) "
        "VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)",
        (
            *key,
            review.kind,
            review.id,
            review.revision,
            review.verdict,
            review.note,
            review.who,
            review.at,
        ),
    )


def _as_stored(review: Review) -> Verdict | None:
    return None if review.verdict == NO_VERDICT else Verdict(review.verdict)


def _stored_note(review: Review) -> str:
    return "" if review.verdict == NO_VERDICT else review.note


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

    @router.get("", dependencies=[needs(Role.VIEW)])
    def get(site: str) -> dict[str, Any]:
        """Areas of interest, alert zones and waypoints of a site."""
        return drawings.get(site)

    @router.put("", dependencies=[needs(Role.REVIEW)])
    def put(site: str, wish: DrawingsWish) -> dict[str, Any]:
        """Put all drawings of a site; 409 where they changed since they were read."""
        return drawings.put(site, wish)

    return router
