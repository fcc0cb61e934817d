"""The register as features on Earth: what missions of a site and its watches found, each thing once."""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from datetime import datetime

import numpy as np

from sorvolo.findings.importance import ordered
from sorvolo.findings.register import (
    GroundFinding,
    KnownBy,
    MissionSighting,
    associate,
    id_by,
    untold,
)
from sorvolo.geometry.geodesy import Geodetic
from sorvolo.paths import Json
from sorvolo.store.exports.change_files import finding_feature, objects_geojson
from sorvolo.store.exports.plain import rounded
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.change_records import StoredChange, StoredObject
from sorvolo.survey.flight import Site
from sorvolo.survey.objects import PERSON

Feature = Json
Track = Json
_DATED_NS = 365 * 86_400 * 10**9  # times before are those of a clock without a date
_UNKNOWN_SIGMA_M = 2.0  # of tracks of watches that state none


def on_earth(site: Site) -> Site:
    """The site with places in degrees: a local one's lie around its origin, as the station shows them."""
    return replace(site, is_local=False)


def found_features(
    archive: Archive | None, tracks: Sequence[Track], marks: Sequence[Track]
) -> list[Feature]:
    """All findings, what a person wants first in front; `tracks` of a site's watches belong to the flights whose time
    is theirs, people's `marks` to the newest flight before them. Without a site there are the watches' alone."""
    if archive is None:
        longitude_deg, latitude_deg = tracks[0]["lonlat"][:2] if tracks else (0.0, 0.0)
        site = Site("watched", Geodetic(latitude_deg, longitude_deg, 0.0), "", 1.0)
        register = associate(_sightings_of(tracks, site, []))
        stored: list[StoredObject] = []
    else:
        site = on_earth(archive.site())
        flown = archive.flown()
        register = archive.register(
            [*_sightings_of(tracks, site, flown), *_marked(marks, site, flown)]
        )
        stored = archive.objects()
    objects = {each.thing.id: each for each in stored}
    watched = {each["id"]: each for each in tracks}
    features = [_feature(each, site, objects, watched) for each in ordered(register.findings)]
    if archive is not None:
        properties = {each["id"]: each["properties"] for each in features}
        changes = defaultdict[str, list[StoredChange]](list)
        for change in archive.changes():
            changes[change.flight_id].append(change)
        before = set[str]()
        for flight in dict.fromkeys(each.flight_id for each in archive.versions()):
            for kind, each in untold(register, changes[flight], before, flight):
                properties[each.id]["untold"][flight] = kind
            before.add(flight)
    return features


def _sightings_of(
    tracks: Sequence[Track], site: Site, flown: Sequence[tuple[str, int, int, int]]
) -> list[MissionSighting]:
    """Tracks as sightings; `flown` has each flight's name, rank, and times of its first and last frame."""
    spans: dict[str, tuple[int, int]] = {}
    times = {each["id"]: (_ns(each["first_seen"]), _ns(each["last_seen"])) for each in tracks}
    for each in tracks:
        first_ns, last_ns = times[each["id"]]
        known = spans.get(each["run"], (first_ns, last_ns))
        spans[each["run"]] = min(known[0], first_ns), max(known[1], last_ns)
    dates = {run: _date_of(run, span, flown) for run, span in spans.items()}
    places_m = site.frame.ground_from_lonlat(
        [tuple(each["lonlat"][:2]) for each in tracks] or [(0, 0)]
    )
    return [
        MissionSighting(
            *dates[each["run"]],
            each["run"],
            each["id"],
            KnownBy.DETECTED,
            each["class"],
            each["score"],
            place_m[:2],
            each.get("sigma_m") or _UNKNOWN_SIGMA_M,
            (each.get("size_m") or [np.nan])[0],
            *times[each["id"]],
            bool(each.get("moving")),
            tuple(each.get("velocity_m_s") or (0.0, 0.0)),
            each["class_scores"],
        )
        for each, place_m in zip(tracks, np.asarray(places_m))
    ]


def _marked(
    marks: Sequence[Track], site: Site, flown: Sequence[tuple[str, int, int, int]]
) -> Iterator[MissionSighting]:
    for each in marks:
        at_ns = _ns(each["at"])
        before = [(name, float(rank)) for name, rank, first_ns, _ in flown if first_ns <= at_ns]
        date, rank = before[-1] if before else (str(each["id"]), -0.5)
        (place_m,) = np.asarray(site.frame.ground_from_lonlat([tuple(each["lonlat"][:2])]))
        yield MissionSighting(
            date,
            rank,
            f"marked by {each['by']}",
            each["id"],
            KnownBy.MARKED,
            each["label"] or PERSON,
            1.0,
            place_m[:2],
            _UNKNOWN_SIGMA_M,
            np.nan,
            at_ns,
            at_ns,
        )


def _date_of(
    run: str, span: tuple[int, int], flown: Sequence[tuple[str, int, int, int]]
) -> tuple[str, float]:
    """The flight that a watch was of, with its rank: the one whose time it shares most; else a date of its own."""
    shared = {
        (name, float(rank)): min(last_ns, span[1]) - max(first_ns, span[0])
        for name, rank, first_ns, last_ns in flown
        if first_ns > _DATED_NS
    }
    best = max(shared, key=lambda each: shared[each], default=("", 0.0))
    if shared.get(best, -1) >= 0:
        return best
    earlier = [rank for _, rank, first_ns, _ in flown if first_ns <= span[0]]
    return run, max(earlier, default=-1) + 0.5


def _feature(
    found: GroundFinding,
    site: Site,
    objects: Mapping[str, StoredObject],
    watched: Mapping[str, Track],
) -> Feature:
    """A finding with what the mission states that saw it best: a map, else a watch, else a comparison.

    Votes are kept under `voted_as`, and found again by `known_as`: another sighting may come to be the first, and a
    watch's flight be mapped.
    """
    ids = [each.id for each in reversed(found.sightings)]
    of_map = next((objects[each] for each in ids if each in objects), None)
    of_watch = next((watched[each] for each in ids if each in watched), None)
    shown = finding_feature(found, site)
    changed = [each.id for each in found.sightings if each.origin is KnownBy.CHANGED]
    crop = ("change", changed[-1]) if changed else None
    own: Json = {}
    if of_map is not None:
        (object_,) = objects_geojson([replace(of_map, finding=found)], site, crops_from_site=True)[
            "features"
        ]
        own = object_["properties"]
        if of_map.thing.id not in changed:
            crop = ("object", of_map.thing.id)
    elif of_watch is not None:
        own = {name: each for name, each in of_watch.items() if name != "lonlat"}
        crop = ("finding", of_watch["id"]) if of_watch.get("crop") else None
    known, begun = shown["properties"], found.sightings[0].id
    shown["properties"] = {
        **own,
        **known,
        **{name: own.get(name, known[name]) for name in ("score", "length_m")},
        "class_scores": {name: rounded(share, 4) for name, share in found.class_scores.items()},
        **dict(zip(("longitude", "latitude"), shown["geometry"]["coordinates"], strict=True)),
        "flight": found.newest.date,
        "missions": sorted({each.mission for each in found.sightings}),
        "sightings": list(dict.fromkeys(ids)),
        "voted_as": begun if begun in watched else found.id,
        "known_as": [id_by(each) for each in found.sightings],
        "datetime": known["first_seen"],
        "end_datetime": known["last_seen"],
        "review_kind": "object",
        "crop_of": crop,
        "untold": {},
    }
    return shown


def _ns(time: str) -> int:
    moment = datetime.fromisoformat(time)
    return round(moment.timestamp() * 1e6) * 1000
