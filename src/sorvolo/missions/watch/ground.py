"""The ground under a watch where a height model tells it, in the heights of the flight's own telemetry."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from sorvolo.errors import InputError
from sorvolo.geometry.arrays import Floats, PointsM
from sorvolo.missions.flight.settings import MapSettings
from sorvolo.missions.flight.setup import FlightSetup
from sorvolo.store.rasters.height_model import read_height_model
from sorvolo.tracking.locate import GroundHeight

_AROUND_M = 2000.0  # of the flight's fixes, so far the model is read


def over_heights(
    prepare: Callable[[MapSettings], FlightSetup], mapping: MapSettings, model: Path
) -> tuple[FlightSetup, GroundHeight]:
    """The flight with its heights counted from the ground below its first fix, and the ground's from there.

    Heights above take-off are taken to begin there already; others are held against the model's, which must be in the
    same reference. Raises InputError for a model that cannot be read or does not show that ground, and for a flight
    without fixes.
    """
    setup = prepare(mapping)
    if setup.track is None:
        raise InputError(f"{setup.source.name} has no fixes, so {model} cannot say what ground lies below it")
    fixes_m = setup.track.east_north_m[np.isfinite(setup.track.east_north_m[:, 0])]
    corners_m = np.array([fixes_m.min(axis=0) - _AROUND_M, fixes_m.max(axis=0) + _AROUND_M])
    (south, north), (west, east), _ = setup.frame.wgs84_from_site(corners_m)
    heights = read_height_model(model, (float(west), float(south), float(east), float(north)))
    latitudes, longitudes, _ = setup.frame.wgs84_from_site(fixes_m[:1])
    zero_m = float(heights.at(longitudes, latitudes)[0])
    if not np.isfinite(zero_m):
        raise InputError(
            f"{model} knows no height at {latitudes[0]:.5f}, {longitudes[0]:.5f}, where the telemetry begins; give one "
            "without a hole there, or --ground-elevation"
        )
    if not setup.track.counts_from_takeoff:
        setup = prepare(replace(mapping, ground_elevation_m=zero_m))

    def ground_m(places_m: PointsM) -> Floats:
        latitudes, longitudes, _ = setup.frame.wgs84_from_site(places_m)
        return heights.at(longitudes, latitudes) - zero_m

    return setup, ground_m
