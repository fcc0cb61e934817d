"""A mapped flight's keyframes as views: their cameras as the map has them, and their GPS fixes."""

import json
from collections.abc import Sequence

from sorvolo.errors import InputError
from sorvolo.heights.views import View, fix_from_residual
from sorvolo.store.exports.plain import features_name
from sorvolo.store.nofollow import read_below
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.catalogue import StoredKeyframe

_MOST_BYTES = 256_000_000  # of frames.geojson; 10,000 frames have some ten; by choice
_AXES = ("east", "north", "up")


def flight_views(
    archive: Archive, flight_id: str, keyframes: Sequence[StoredKeyframe]
) -> list[View]:
    """The views of a flight. Raises InputError for one that heights cannot be made of."""
    if not keyframes:
        known = ", ".join(each.id for each in archive.flights()) or "none"
        raise InputError(
            f"{archive.folder} has no cameras in space of a flight {flight_id!r} (its flights: {known}); "
            "heights need a flight mapped with --method planar"
        )
    if archive.site().is_local:
        raise InputError(
            f"{archive.folder} has no GPS and so no metres: heights need a flight with GPS positions"
        )
    residuals = _residuals_m(archive, flight_id)
    return [
        View(
            each.name,
            each.camera,
            each.site_from_camera,
            fix_from_residual(each.site_from_camera, residuals.get(each.name, (None, None, None))),
        )
        for each in keyframes
        if each.site_from_camera is not None
    ]


def run_of(keyframes: Sequence[StoredKeyframe]) -> str:
    """Which mapping run the keyframes are of: heights of another run do not fit the map any more."""
    return keyframes[0].image_path.rsplit("/", 2)[-2]


def _residuals_m(archive: Archive, flight_id: str) -> dict[str, tuple[float | None, ...]]:
    """Camera minus fix of each frame by name, None where there was no fix."""
    path = archive.flight_folder(flight_id) / features_name("frames", is_local=False)
    try:
        features = json.loads(read_below(path.parent, path.name, _MOST_BYTES))["features"]
        rows = [each["properties"] for each in features]
        return {
            str(row["frame"]): tuple(row[f"gps_residual_{axis}_m"] for axis in _AXES)
            for row in rows
        }
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(f"{path} is gone or damaged ({error!r}); map the flight again") from error
