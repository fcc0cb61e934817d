"""Tracks that were announced while a flight was live, found again as the whole flight is searched in order of time."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from sorvolo.survey.objects import Sighting, Track
from sorvolo.tracking.following import Taken

SightingKey = tuple[int, bytes]


def sighting_key(sighting: Sighting) -> SightingKey:
    """What tells a sighting from all others of a flight: its frame and its box."""
    return sighting.frame_index, sighting.box_px.tobytes()


class Announced:
    """Gives the tracks of a flight that is searched again the ids under which they were announced.

    A track is the announced one with which it shares a sighting, or (`by_place`) that stands where it does; any other
    has an id that no announced one has. Only `see` changes it.
    """

    def __init__(
        self, tracks: Sequence[Track], seen: Mapping[SightingKey, int], *, by_place: bool
    ) -> None:
        self._known = {each.id: each for each in tracks if each.confirmed}
        self._seen, self._by_place = seen, by_place
        self._first_free = max(self._known, default=0)
        self._names: dict[int, int] = {}  # ids of this time to announced ones
        self._told: set[int] = set(self._known)

    def see(self, taken: Taken, tracks: Sequence[Track]) -> tuple[Taken, list[Track]]:
        """A frame's outcome and all tracks, under announced ids; `new_ids` are those that were not announced yet.

        `merged` has the ids that were announced and turned out to be others.
        """
        merged = {self._id(each) for each in taken.merged} - self._known.keys()
        for each in taken.merged:
            self._names.pop(each, None)
        for sighting, track_id in zip(taken.sightings, taken.track_ids):
            if sighting is not None and track_id:
                self._name(track_id, self._seen.get(sighting_key(sighting), 0))
        seen_ids = set(taken.track_ids)
        for track in tracks if self._by_place else ():
            if track.id in seen_ids and track.confirmed and track.id not in self._names:
                self._name(track.id, self._standing_at(track))
        named = [replace(each, id=self._id(each.id)) for each in tracks]
        own = {self._first_free + each for each in self._names}
        merged |= own & self._told
        fresh = {self._id(each) for each in taken.new_ids} - self._told
        self._told = (self._told | fresh) - merged
        ids = [self._id(each) for each in taken.track_ids]
        return replace(
            taken, track_ids=ids, new_ids=frozenset(fresh), merged=frozenset(merged)
        ), named

    def named(self, tracks: Iterable[Track]) -> list[Track]:
        """Tracks under announced ids."""
        return [replace(each, id=self._id(each.id)) for each in tracks]

    def left(self) -> list[Track]:
        """The announced tracks that were not found again so far."""
        found = set(self._names.values())
        return [each for each in self._known.values() if each.id not in found]

    def _id(self, track_id: int) -> int:
        if not track_id:
            return 0
        return self._names.get(track_id, self._first_free + track_id)

    def _name(self, track_id: int, announced_id: int) -> None:
        """A track is the announced one, where there is one that is none other yet."""
        is_free = announced_id in self._known and announced_id not in self._names.values()
        if is_free and track_id not in self._names:
            self._names[track_id] = announced_id

    def _standing_at(self, track: Track) -> int:
        """The id of the announced track that stands where this one does; 0 where none does."""
        for each in self.left():
            sigma_m = np.hypot(each.apart_sigma_m, track.apart_sigma_m)
            reach_m = 3 * sigma_m + track.size_m[0] / 2
            stands = each.label == track.label and not (each.moving or track.moving)
            if stands and np.linalg.norm(each.position_m - track.position_m) <= reach_m:
                return each.id
        return 0
