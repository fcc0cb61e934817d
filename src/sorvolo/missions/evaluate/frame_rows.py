"""The frames of flights, as a map's or a truth's frames.geojson tells them, in the site's metres."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from sorvolo.errors import InputError
from sorvolo.geometry.arrays import Floats, Matrix3
from sorvolo.geometry.geodesy import LocalFrame
from sorvolo.geometry.homography import apply_homography, fit_similarity
from sorvolo.store.site.files import CATALOGUE
from sorvolo.survey.flight import Site
from sorvolo.survey.mosaic import Status

_NOT_PLACED = {"not-aligned", "outside", "lost", Status.REJECTED.value}
_SAME_FLIGHT_NS = 60 * 10**9  # clocks differ, flights lie hours apart


@dataclass(frozen=True, eq=False)
class FrameRow:
    """One frame of a frames.geojson, map or truth, in site metres; NaN where the file says nothing."""

    name: str
    status: str
    outline_m: Floats  # (4, 2)
    camera_m: Floats  # (2,)
    camera_height_m: float
    fix_m: Floats  # (2,)
    time_ns: int  # UTC; 0 where the file says none


def map_frames(site: Path, described: Site) -> dict[str, list[FrameRow]]:
    """The frames of every flight in a site folder; raises InputError for a site without any."""
    files = sorted((site / "flights").glob("*/frames.geojson"))
    if not files:
        raise InputError(f"{site}: no flights/*/frames.geojson; map a flight into it first")
    return {
        path.parent.name: [frame_row(each, described.frame, path) for each in read_features(path)] for path in files
    }


def refuse_simulation(site: Path) -> None:
    """Raise InputError for the folder of a simulation: the likely slip is that site and truth are swapped."""
    if not (site / CATALOGUE).is_file() and (site / "truth" / "frames.geojson").is_file():
        raise InputError(f"{site}: a simulation's folder, no site; give the site first, and --truth {site}")


def truth_file(truth: Path) -> Path:
    """frames.geojson of a simulation: in its folder, in the truth folder, or the file itself."""
    for path in (truth / "truth" / "frames.geojson", truth / "frames.geojson", truth):
        if path.is_file():
            return path
    raise InputError(f"{truth}: no truth/frames.geojson in it; give the folder that `sorvolo simulate` made")


def read_features(path: Path) -> list[dict[str, Any]]:
    """A GeoJSON file's features; raises InputError for one that cannot be read."""
    try:
        features = json.loads(path.read_text(encoding="utf-8"))["features"]
    except (OSError, UnicodeDecodeError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: cannot be read as GeoJSON ({error}); make it anew") from error
    if not isinstance(features, list):
        raise InputError(f"{path}: its features are no list; make it anew")
    return features


def frame_row(feature: Mapping[str, Any], frame: LocalFrame, path: Path) -> FrameRow:
    """One feature as a row; raises InputError, naming `path`, where it is not as docs/formats.md says."""
    try:
        properties, geometry = feature["properties"], feature["geometry"]
        outline = np.full((4, 2), np.nan)
        if geometry is not None:
            outline = site_points(frame, np.array(geometry["coordinates"][0][:4], dtype=np.float64)[:, :2])
        camera, fix = (
            site_points(frame, np.array([[_number(properties, f"{kind}_longitude_deg"),
                                           _number(properties, f"{kind}_latitude_deg")]]))[0]
            for kind in ("camera", "fix")
        )
        return FrameRow(
            str(properties["frame"]), str(properties.get("status", "")), outline, camera,
            _number(properties, "camera_height_m"), fix, time_ns_of(str(properties.get("time") or "")),
        )
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise InputError(f"{path}: a feature is not as docs/formats.md says ({error!r})") from error


def true_names(
    frames: Mapping[str, Sequence[FrameRow]], true_frames: Mapping[str, Mapping[str, FrameRow]]
) -> dict[str, str]:
    """Flights of a map -> the same flights in the truth, by their names, else by frames of one name and one minute.

    Photos are mapped under their folder's name, which the truth does not know. Flights without a partner are left out.
    """
    named = {name: name for name in frames if name in true_frames}
    for name in frames.keys() - named.keys():
        alike = {
            true: sum(
                row.name in rows and abs(row.time_ns - rows[row.name].time_ns) < _SAME_FLIGHT_NS for row in frames[name]
            )
            for true, rows in true_frames.items() if true not in named.values()
        }
        best = max(alike, key=alike.__getitem__, default="")
        if best and alike[best]:
            named[name] = best
    return named


@dataclass(frozen=True, eq=False)
class PairedFlights:
    """The frames of the site's flights and of the truth's, and which are the same."""

    mine: Mapping[str, Sequence[FrameRow]]
    true: Mapping[str, Mapping[str, FrameRow]]
    names: Mapping[str, str]

    @classmethod
    def read(cls, site: Path, frames_file: Path, described: Site) -> "PairedFlights":
        """The frames of a site folder and of a truth's frames.geojson; raises InputError where one cannot be read."""
        true: dict[str, dict[str, FrameRow]] = {}
        for feature in read_features(frames_file):
            row = frame_row(feature, described.frame, frames_file)
            true.setdefault(str(feature["properties"].get("flight", "")), {})[row.name] = row
        mine = map_frames(site, described)
        return cls(mine, true, true_names(mine, true))

    def true_name(self, name: str) -> str:
        """The truth's name of one of the site's flights; "" where the truth does not know it."""
        return self.names.get(name, "")

    def placed(self, names: Sequence[str]) -> list[tuple[str, FrameRow]]:
        """The frames of these flights that lie somewhere, with their flights."""
        return [
            (name, row) for name in names for row in self.mine.get(name, ())
            if row.status not in _NOT_PLACED and np.isfinite(row.outline_m).all()
        ]

    def clock(self, name: str) -> tuple[int, int]:
        """When the flight ended by its own clock, and how far that is behind the truth's: logs may tell no date."""
        true = self.true[self.names[name]]
        behind_ns = [true[row.name].time_ns - row.time_ns for row in self.mine[name] if row.name in true]
        return max((row.time_ns for row in self.mine[name]), default=0), int(np.median(behind_ns)) if behind_ns else 0

    def map_from_truth(self, names: Sequence[str]) -> tuple[Matrix3, float]:
        """The similarity that takes true places to where these flights lie; the rms of what it moves, NaN if none."""
        pairs = [
            (row.outline_m, self.true[self.names[name]][row.name].outline_m)
            for name, row in self.placed(names) if name in self.names and row.name in self.true[self.names[name]]
        ]
        pairs = [pair for pair in pairs if np.isfinite(pair).all()]
        if not pairs:
            return np.eye(3), math.nan
        mine_m, true_m = (np.concatenate(side) for side in zip(*pairs))
        matrix = fit_similarity(mine_m, true_m)
        moved_m = apply_homography(matrix, true_m) - true_m
        return matrix, float(np.sqrt((moved_m**2).sum(axis=1).mean()))


def time_ns_of(text: str) -> int:
    """Nanoseconds since 1970 of an ISO 8601 time with its zone, to the microsecond; 0 of nothing.

    Raises ValueError for other text.
    """
    if not text:
        return 0
    since = datetime.fromisoformat(text) - datetime(1970, 1, 1, tzinfo=UTC)
    return (since.days * 86400 + since.seconds) * 10**9 + since.microseconds * 1000


def _number(properties: Mapping[str, Any], name: str) -> float:
    value = properties.get(name)
    return float("nan") if value is None else float(value)


def site_points(frame: LocalFrame, lonlat_deg: Floats) -> Floats:
    """(N, 2) east, north of longitude, latitude, shape (N, 2), on the site's ground."""
    height_m = np.full(len(lonlat_deg), frame.origin.height_m)
    return frame.site_from_wgs84(lonlat_deg[:, 1], lonlat_deg[:, 0], height_m)[:, :2]
