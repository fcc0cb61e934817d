"""The frames of flights, as a map's or a truth's frames.geojson has them, in the site's metres."""

import json
from datetime import UTC, datetime
from pathlib import Path

from sorvolo.errors import InputError
from sorvolo.geometry.geodesy import LocalFrame
from sorvolo.mosaic.paired_flights import PairedFlights, true_names
from sorvolo.paths import Json, JsonView
from sorvolo.store.site.catalogue_place import is_site
from sorvolo.survey.flight import Site
from sorvolo.survey.mosaic import FrameRow

_NO_OUTLINE = [[float("nan"), float("nan")]] * 4


def paired_flights(site: Path, frames_file: Path, described: Site) -> PairedFlights:
    """The frames of a site folder and of a truth's frames.geojson; raises InputError where one cannot be read."""
    true = true_frames(frames_file, described.frame)
    mine = map_frames(site, described)
    return PairedFlights(mine, true, true_names(mine, true))


def true_frames(frames_file: Path, frame: LocalFrame) -> dict[str, dict[str, FrameRow]]:
    """The frames of a truth's frames.geojson by flight and name; raises InputError where it cannot be read."""
    true: dict[str, dict[str, FrameRow]] = {}
    for feature in read_features(frames_file):
        row = frame_row(feature, frame, frames_file)
        true.setdefault(str(feature["properties"].get("flight", "")), {})[row.name] = row
    return true


def map_frames(site: Path, described: Site) -> dict[str, list[FrameRow]]:
    """The frames of every flight in a site folder; raises InputError for a site without any."""
    files = sorted((site / "flights").glob("*/frames.*json"))
    if not files:
        raise InputError(f"{site}: no flights/*/frames.geojson; map a flight into it first")
    return {
        path.parent.name: [frame_row(each, described.frame, path) for each in read_features(path)]
        for path in files
    }


def refuse_simulation(site: Path) -> None:
    """Raise InputError for the folder of a simulation: the likely slip is that site and truth are swapped."""
    if not is_site(site) and (site / "truth" / "frames.geojson").is_file():
        raise InputError(
            f"{site}: a simulation's folder, no site; give the site first, and --truth {site}"
        )


def truth_file(truth: Path) -> Path:
    """frames.geojson of a simulation: in its folder, in the truth folder, or the file itself."""
    for path in (truth / "truth" / "frames.geojson", truth / "frames.geojson", truth):
        if path.is_file():
            return path
    raise InputError(
        f"{truth}: no truth/frames.geojson in it; give the folder that `sorvolo simulate` made"
    )


def read_features(path: Path) -> list[Json]:
    """A GeoJSON file's features; raises InputError for one that cannot be read."""
    try:
        features = json.loads(path.read_text(encoding="utf-8"))["features"]
    except (OSError, UnicodeDecodeError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: cannot be read as GeoJSON ({error}); make it anew") from error
    if not isinstance(features, list):
        raise InputError(f"{path}: its features are no list; make it anew")
    return features


def frame_row(feature: JsonView, frame: LocalFrame, path: Path) -> FrameRow:
    """One feature as a row; raises InputError, naming `path`, where it is not as docs/formats.md has it."""
    try:
        properties, geometry = feature["properties"], feature["geometry"]
        corners = _NO_OUTLINE if geometry is None else geometry["coordinates"][0][:4]
        camera, fix = (
            [
                _number(properties, f"{kind}_longitude_deg"),
                _number(properties, f"{kind}_latitude_deg"),
            ]
            for kind in ("camera", "fix")
        )
        return FrameRow(
            str(properties["frame"]),
            str(properties.get("status", "")),
            frame.ground_from_lonlat(corners),
            frame.ground_from_lonlat([camera])[0],
            _number(properties, "camera_height_m"),
            frame.ground_from_lonlat([fix])[0],
            time_ns_of(str(properties.get("time") or "")),
        )
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise InputError(
            f"{path}: a feature is not as docs/formats.md has it ({error!r})"
        ) from error


def time_ns_of(text: str) -> int:
    """Nanoseconds since 1970 of an ISO 8601 time with its zone, to the microsecond; 0 of nothing.

    Raises ValueError for other text.
    """
    if not text:
        return 0
    since = datetime.fromisoformat(text) - datetime(1970, 1, 1, tzinfo=UTC)
    return (since.days * 86400 + since.seconds) * 10**9 + since.microseconds * 1000


def _number(properties: JsonView, name: str) -> float:
    value = properties.get(name)
    return float("nan") if value is None else float(value)
