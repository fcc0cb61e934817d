"""Votes on objects and changes: each kept with who gave it and when; none is lost to another's."""

import hashlib
import json
import sqlite3
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Annotated, Literal
from urllib.parse import quote

from fastapi import APIRouter, Query
from pydantic import Field, Strict

from sorvolo.errors import SorvoloError, StoreError
from sorvolo.missions.site.review import review_changes
from sorvolo.paths import Json
from sorvolo.station.collections import FINDINGS, SiteCollections
from sorvolo.station.events import EventLog, NewEvent
from sorvolo.station.found import Feature
from sorvolo.station.orders import Wish
from sorvolo.station.problems import Problem
from sorvolo.station.security import FOR_VIEWERS, needs
from sorvolo.station.settings import StationSettings
from sorvolo.station.sites import SiteShelf
from sorvolo.station.state import StationState, compact_json, utc_after, utc_now
from sorvolo.station.tokens import Holder, Role
from sorvolo.store.atomic import atomic_write_bytes, make_folder
from sorvolo.survey.findings import Verdict

NO_VERDICT = "none"
_JUDGED = {"objects": "object", "changes": "change", "findings": "object"}
_OF_WATCHES = "watches"  # in place of when the site was made, where there is none yet
_ELSEWHERE = "sorvolo review"  # who votes by the command line
_COLUMNS = "kind, id, revision, verdict, label, note, who, at"


class ReviewWish(Wish):
    """A person's vote on an object or a change; "none" withdraws one's own, without any it stays, for a note. `label` is
    the class that it is held for."""

    kind: Literal["object", "change"]
    id: str = Field(min_length=1, max_length=400)
    verdict: Literal["confirmed", "rejected", "unsure", "none"] | None = None
    label: str = Field("", max_length=100)
    note: str = Field("", max_length=2000)


@dataclass(frozen=True)
class Review:
    """A vote on one thing, the next revision each; or how all votes stand, with who voted last. Times are RFC 3339 UTC.

    `state` is "single", "agreed" or "disputed"; a disputed verdict is "disputed".
    """

    kind: str
    id: str
    revision: int
    verdict: str
    label: str
    note: str
    who: str
    at: str
    state: str = "single"


class Reviews:
    """The votes on all sites' objects and changes: only ever added. Threads may share it.

    How those on changes stand also goes into the site, where missions look: at once, or when the mission that is
    writing into it is done (`settle`).
    """

    def __init__(
        self, state: StationState, shelf: SiteShelf, events: EventLog, collections: SiteCollections
    ) -> None:
        self._state, self._shelf, self._events = state, shelf, events
        self._collections = collections
        self._settling = threading.RLock()
        self._unsettled: set[str] = set()

    def current(self, site_id: str, kind: str) -> dict[str, Review]:
        """How the votes on each thing of a kind stand, by id; those of the command line included.

        An object is found under its finding's id and under those of the finding's sightings.
        """
        votes: dict[str, list[Review]] = {}
        ids = self._ids(site_id, kind) if kind == "object" else {}
        for row in reversed(self.history(site_id, kind)):
            votes.setdefault(row.id, []).append(row)
        found = {thing: _standing(thing, given) for thing, given in votes.items()}
        if kind == "change":
            elsewhere = self._from_site(site_id, found)
            return found | {
                thing: _standing(thing, [*votes.get(thing, []), vote])
                for thing, vote in elsewhere.items()
            }
        return found | {each: found[thing] for each, thing in ids.items() if thing in found}

    def shown(self, site_id: str, name: str, features: Sequence[Feature]) -> list[Feature]:
        """The features of a collection, with how the votes stand where it is one that people judge."""
        kind = _JUDGED.get(name)
        if kind is None:
            return list(features)
        current = self.current(site_id, kind)
        result = []
        for each in features:
            review = current.get(str(each["id"]))
            shown = each["properties"].get("crop_of", (kind, str(each["id"])))
            values = {
                **each["properties"],
                "review": review and review.verdict,
                "review_state": review and review.state,
                "revision": review.revision if review else 0,
                "note": review and review.note,
                "reviewer": review and review.who,
                "reviewed_at": review and review.at,
                # not every watch keeps pictures
                "crops": crop_addresses(site_id, *shown) if shown else [],
            }
            result.append({**each, "properties": values})
        return result

    def history(self, site_id: str, kind: str = "", thing_id: str = "") -> list[Review]:
        """All votes of a site, newest first; of one thing. Those on an object have its finding's id."""
        rows = self._state.rows(
            f"SELECT {_COLUMNS} FROM reviews WHERE site = ? AND made_utc IN (?, ?) AND (? = '' OR kind = ?) "
            "ORDER BY number DESC",
            (*self._key(site_id), _OF_WATCHES, kind, kind),
        )
        ids = {} if kind == "change" else self._ids(site_id, "object")
        votes = [Review(**dict(row)) for row in rows]
        votes = [
            replace(each, id=ids.get(each.id, each.id)) if each.kind == "object" else each
            for each in votes
        ]
        return [each for each in votes if thing_id in ("", each.id) or each.id == ids.get(thing_id)]

    def give(self, site_id: str, wish: ReviewWish, who: str) -> Review:
        """Add a vote, once where it is sent again; how all stand then. Raises Problem (404) for an unknown thing."""
        with self._settling:  # what another vote is settling is no command's
            thing = self._ids(site_id, wish.kind).get(wish.id)
            if thing is None:
                raise Problem(
                    404, f"the site has no {wish.kind} {wish.id[:80]!r}; load the list again"
                )
            votes = [each for each in self.history(site_id, wish.kind) if each.id == thing][::-1]
            if wish.kind == "change":
                votes += filter(
                    None,
                    [
                        self._from_site(
                            site_id, {votes[-1].id: _standing(votes[-1].id, votes)} if votes else {}
                        ).get(thing)
                    ],
                )
            made = Review(
                wish.kind,
                thing,
                max((each.revision for each in votes), default=0) + 1,
                wish.verdict or next((v.verdict for v in votes[::-1] if v.who == who), NO_VERDICT),
                wish.label,
                wish.note,
                who,
                utc_now(),
            )
            if votes and replace(made, revision=votes[-1].revision, at=votes[-1].at) == votes[-1]:
                return _standing(thing, votes)
            standing = _standing(thing, [*votes, made])
            # the id under which a vote is kept
            found = (
                self._collections.get(site_id, FINDINGS).features if made.kind == "object" else []
            )
            key = self._key(site_id)
            kept = next(
                (each["properties"]["voted_as"] for each in found if each["id"] == made.id),
                made.id,
            )
            event = NewEvent("review.changed", asdict(standing), site_id)
            try:
                with self._events.appending([event]) as connection:
                    for vote in (*votes[-1:], made):
                        if vote is made or vote.who == _ELSEWHERE:
                            _keep(connection, key, replace(vote, id=kept))
            except sqlite3.IntegrityError:  # another vote was quicker: this one is the next
                return self.give(site_id, wish, who)
            if wish.kind == "change":
                self.settle(site_id)
            return standing

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
                if each.id in inside
                and inside[each.id] != (_as_stored(each), each.note if _as_stored(each) else "")
            ]
            try:
                for each in waiting:
                    verdict = _as_stored(each)
                    note = each.note if verdict else ""
                    review_changes(archive.folder, [each.id], verdict, note)
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

    def _key(self, site_id: str) -> tuple[str, str]:
        """Which site a vote is of: a new site may have the name, and the ids, of one that was deleted. A watch needs no
        site."""
        try:
            return site_id, self._shelf.open(site_id).created_utc or _OF_WATCHES
        except Problem:
            self._collections.get(site_id, FINDINGS)  # raises where there is no watch either
            return site_id, _OF_WATCHES

    def _from_site(self, site_id: str, known: Mapping[str, Review]) -> dict[str, Review]:
        """Votes that the command line gave after ours."""
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
                word = change.verdict.value
                found[change.id] = Review(
                    "change", change.id, revision, word, "", change.note, _ELSEWHERE, at
                )
        return found

    def _ids(self, site_id: str, kind: str) -> dict[str, str]:
        """The ids under which things can be named, with the one that they have now."""
        if kind == "change":
            return {each.id: each.id for each in self._shelf.open(site_id).changes()}
        found = self._collections.get(site_id, FINDINGS).features
        aliases = {
            str(alias): str(each["id"])
            for each in found
            for name in ("sightings", "known_as")
            for alias in each["properties"][name]
        }
        return aliases | {str(each["id"]): str(each["id"]) for each in found}


def crop_addresses(site_id: str, kind: str, feature_id: str) -> list[str]:
    """Where the pictures of an object, or of a change before and after, are found."""
    base = f"/api/sites/{quote(site_id, safe=':')}/crops/{kind}/{quote(feature_id, safe='')}"
    return [f"{base}/{n}.jpg" for n in range(2 if kind == "change" else 1)]


def _standing(thing: str, votes: Sequence[Review]) -> Review:
    """How votes, the oldest first, stand: each person's last one counts."""
    last = votes[-1]
    of_each = {each.who: each.verdict for each in votes}
    counted = [each for each in of_each.values() if each != NO_VERDICT]
    verdict = counted[0] if len(set(counted)) == 1 else "disputed" if counted else NO_VERDICT
    state = "disputed" if verdict == "disputed" else "agreed" if len(counted) > 1 else "single"
    return replace(last, id=thing, verdict=verdict, state=state)


def review_routes(reviews: Reviews, shelf: SiteShelf) -> APIRouter:
    """Verdicts listed and given."""
    router = APIRouter(prefix="/api/sites/{site}/reviews", tags=["reviews"])

    @router.get("", dependencies=FOR_VIEWERS)
    def history(
        site: str,
        kind: Literal["", "object", "change"] = "",
        id: str = Query("", max_length=400),
    ) -> list[Json]:
        """Every vote of the site with who gave it and when, newest first."""
        return [asdict(each) for each in reviews.history(site, kind, id)[:5000]]

    @router.post("", status_code=201)
    def give(site: str, wish: ReviewWish, holder: Holder = needs(Role.REVIEW)) -> Json:
        """Vote on an object or a change, or withdraw one's own vote; how all votes stand then. None is overwritten."""
        return asdict(reviews.give(site, wish, holder.name))

    return router


def _keep(connection: sqlite3.Connection, key: tuple[str, str], vote: Review) -> None:
    values = asdict(vote)
    del values["state"]
    connection.execute(
        f"INSERT INTO reviews (site, made_utc, {_COLUMNS}) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
        (*key, *values.values()),
    )


def _as_stored(review: Review) -> Verdict | None:
    """The verdict that missions take: none while people disagree, or are unsure."""
    return Verdict(review.verdict) if review.verdict in set(Verdict) else None


_MOST_DRAWINGS, _MOST_CORNERS = 500, 500
_FOLDER = "drawings"
_LONGEST_WAIT_S = (
    30 * 86_400.0
)  # of a drawing in a browser without the station: else its clock is wrong

Longitude = Annotated[float, Field(ge=-180, le=180)]
Latitude = Annotated[float, Field(ge=-90, le=90)]
Place = Annotated[tuple[Longitude, Latitude], Strict(False)]  # JSON knows lists alone


class _Point(Wish):
    type: Literal["Point"]
    coordinates: Place


class _Line(Wish):
    type: Literal["LineString"]
    coordinates: Annotated[list[Place], Field(min_length=2, max_length=_MOST_CORNERS)]


class _Polygon(Wish):
    type: Literal["Polygon"]
    coordinates: Annotated[
        list[Annotated[list[Place], Field(min_length=4, max_length=_MOST_CORNERS)]],
        Field(min_length=1, max_length=1),
    ]


class _Properties(Wish, extra="forbid"):
    purpose: Literal["interest", "alert", "waypoint", "measure", "found"]
    name: str = Field("", max_length=80)
    planned: bool = False
    label: str = Field("", max_length=100)  # of what was found; "" is a person
    by: str = Field("", max_length=200)  # who drew it first, as the station knows it
    at: str = Field("", max_length=40)  # and when, as the page states


class Drawing(Wish):
    """One drawing as a GeoJSON feature in WGS84."""

    type: Literal["Feature"]
    id: str = Field(min_length=1, max_length=80)
    geometry: Annotated[_Point | _Line | _Polygon, Field(discriminator="type")]
    properties: _Properties


class DrawingsWish(Wish):
    """All drawings of a site as they shall be; `revision` is that of those they were made from, 0 for none."""

    revision: int = Field(ge=0, le=2**53)
    features: Annotated[list[Drawing], Field(max_length=_MOST_DRAWINGS)]


def _drawn_utc(stated: str) -> str:
    """When a drawing was made that may have waited in a browser; now, where that does not say."""
    with suppress(ValueError):
        waited_s = time.time() - datetime.fromisoformat(stated).timestamp()
        if 0 <= waited_s < _LONGEST_WAIT_S:
            return utc_after(-waited_s)
    return utc_now()


class Drawings:
    """The drawings of all sites, a small file each. `put` and `forget` change them; threads may share it."""

    def __init__(self, settings: StationSettings, shelf: SiteShelf, events: EventLog) -> None:
        self._folder, self._shelf, self._events = settings.state_folder / _FOLDER, shelf, events
        self._lock = threading.Lock()

    def get(self, site_id: str) -> Json:
        """The drawings of a site with their revision. Raises Problem (404)."""
        kept = self._kept(site_id, self._shelf.open(site_id).created_utc)
        return {
            "type": "FeatureCollection",
            "revision": kept.get("revision", 0),
            "features": kept.get("features", []),
        }

    def found(self, site_id: str) -> list[Json]:
        """What people marked as found. Raises Problem (404)."""
        return [
            {"id": each["id"], "lonlat": each["geometry"]["coordinates"], **each["properties"]}
            for each in self.get(site_id)["features"]
            if each["properties"]["purpose"] == "found" and each["geometry"]["type"] == "Point"
        ]

    def put(self, site_id: str, wish: DrawingsWish, who: str) -> Json:
        """Keep a site's drawings; new ones as drawn by `who`. Raises Problem (404; 409 where somebody drew meanwhile), StoreError."""
        with self._lock:
            made_utc = self._shelf.open(site_id).created_utc
            there = self._kept(site_id, made_utc)
            now = there.get("revision", 0)
            if wish.revision != now:
                raise Problem(
                    409,
                    "somebody drew meanwhile; load the drawings again and add yours",
                    revision=now,
                )
            drawn = {each["id"]: each["properties"] for each in there.get("features", [])}
            for each in wish.features:
                first = drawn.get(each.id, {"by": who})
                each.properties.by = first.get("by", "")
                each.properties.at = first.get("at") or _drawn_utc(each.properties.at)
            kept = {"revision": now + 1, "features": [each.model_dump() for each in wish.features]}
            path = self._path(site_id)
            make_folder(path.parent)
            atomic_write_bytes(path, compact_json({**kept, "made_utc": made_utc}).encode())
        self._events.append(NewEvent("drawings.changed", {"revision": kept["revision"]}, site_id))
        return {"type": "FeatureCollection", **kept}

    def forget(self, site_id: str) -> None:
        """Drop the drawings of a site that was deleted."""
        with self._lock:
            self._path(site_id).unlink(missing_ok=True)

    def _kept(self, site_id: str, made_utc: str) -> Json:
        """What is kept for the site that was made then; nothing of a deleted one that had its name."""
        try:
            kept: Json = json.loads(self._path(site_id).read_bytes())
        except (FileNotFoundError, ValueError):
            return {}
        return kept if kept.get("made_utc") in ("", made_utc) else {}  # "": before its first map

    def _path(self, site_id: str) -> Path:
        return self._folder / f"{hashlib.sha256(site_id.encode()).hexdigest()[:32]}.json"


def drawing_routes(drawings: Drawings) -> APIRouter:
    """Drawings read and kept."""
    router = APIRouter(prefix="/api/sites/{site}/drawings", tags=["drawings"])

    @router.get("", dependencies=FOR_VIEWERS)
    def get(site: str) -> Json:
        """Areas of interest, alert zones, waypoints and measures of a site."""
        return drawings.get(site)

    @router.put("")
    def put(site: str, wish: DrawingsWish, holder: Holder = needs(Role.REVIEW)) -> Json:
        """Put all drawings of a site; 409 where they changed since they were read."""
        return drawings.put(site, wish, holder.name)

    return router
