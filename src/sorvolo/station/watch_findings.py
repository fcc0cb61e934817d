"""What watches of a site found, which stands on no map: kept in the folders of their runs."""

import json
import threading
from pathlib import Path
from typing import Any

from sorvolo.station.problems import Problem
from sorvolo.station.state import StationState
from sorvolo.store.exports.detection_files import CROPS, TRACKS
from sorvolo.store.nofollow import read_below
from sorvolo.store.site.names import is_plain_name

_RESULTS = "results"
_MOST_BYTES = 64_000_000  # of a watch's tracks; by choice
_MOST_RUNS = 100  # of a site, the newest

Feature = dict[str, Any]


class Findings:
    """The findings of all sites' watches, while they run and afterwards. Threads may share it.

    A finding's id is its run's and its number there, with a colon. `folder` holds a folder for each run.
    """

    def __init__(self, state: StationState, folder: Path) -> None:
        self._state, self._folder = state, folder
        self._lock = threading.Lock()
        self._kept: dict[str, tuple[int, list[Feature]]] = {}  # by run, with the time of its file

    def of_site(self, site_id: str) -> list[Feature]:
        """What the watches of a site found that has a place on Earth, those of the newest watch first."""
        rows = self._state.rows(
            "SELECT id FROM runs WHERE site = ? AND mission = 'watch' ORDER BY made_at DESC LIMIT ?",
            (site_id, _MOST_RUNS),
        )
        return [each for row in rows for each in self._of_run(row["id"])]

    def crop(self, site_id: str, finding_id: str) -> bytes:
        """The picture of a finding, JPEG. Raises Problem (404)."""
        found = next((each for each in self.of_site(site_id) if each["id"] == finding_id), None)
        name = str((found or {"properties": {}})["properties"].get("crop") or "").removeprefix(
            f"{CROPS}/"
        )
        if found is None or not is_plain_name(name):
            raise Problem(
                404, "no such picture: of a finding that a watch of this site kept one of"
            )
        try:
            return read_below(
                self._folder / found["properties"]["run"] / _RESULTS, f"{CROPS}/{name}"
            )
        except FileNotFoundError as error:
            raise Problem(404, "this picture was not kept") from error

    def _of_run(self, run_id: str) -> list[Feature]:
        folder = self._folder / run_id / _RESULTS
        try:
            mark = (folder / f"{TRACKS}.geojson").stat().st_mtime_ns
            with self._lock:
                known = self._kept.get(run_id)
            if known is None or known[0] != mark:
                content = json.loads(read_below(folder, f"{TRACKS}.geojson", _MOST_BYTES))
                known = (
                    mark,
                    [
                        _finding(each, run_id)
                        for each in content["features"]
                        if each.get("geometry")
                    ],
                )
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            return []
        with self._lock:
            self._kept[run_id] = known
        return known[1]


def _finding(track: Feature, run_id: str) -> Feature:
    """A track as a feature of the site: without the path that it took."""
    values = {
        name: each
        for name, each in track["properties"].items()
        if name not in ("path", "class_scores")
    }
    finding_id = f"{run_id}:{values['id']}"
    values |= {
        "id": finding_id,
        "run": run_id,
        "watched": True,
        "review_kind": "finding",
        "flight": None,
        "datetime": values["first_seen"],
        "end_datetime": values["last_seen"],
    }
    return {
        "type": "Feature",
        "id": finding_id,
        "geometry": track["geometry"],
        "properties": values,
    }
