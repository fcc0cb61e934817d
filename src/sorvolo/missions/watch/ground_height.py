"""The ground under a watch from a height model, in the heights of the flight's own telemetry."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from sorvolo.errors import InputError
from sorvolo.geometry.arrays import Floats, PointsM
from sorvolo.geometry.track import corners_around, known_points
from sorvolo.missions.flight.settings import MapSettings
from sorvolo.missions.flight.setup import FlightSetup
from sorvolo.store.rasters.height_model import read_height_model
from sorvolo.tracking.laying import GroundHeight

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
        raise InputError(
            f"{setup.source.name} has no GPS fixes, so {model} cannot be used: leave out --height-model"
        )
    fixes_m = known_points(setup.track.east_north_m)
    (south, north), (west, east), _ = setup.frame.wgs84_from_site(
        corners_around(fixes_m, _AROUND_M)
    )
    heights = read_height_model(model, (float(west), float(south), float(east), float(north)))
    latitudes, longitudes, _ = setup.frame.wgs84_from_site(fixes_m[:1])
    zero_m = float(heights.at(longitudes, latitudes)[0])
    if not math.isfinite(zero_m):
        raise InputError(
            f"{model} has no height at {latitudes[0]:.5f}, {longitudes[0]:.5f}, where the telemetry begins; give one "
            "without a hole there, or --ground-elevation"
        )
    if not setup.track.counts_from_takeoff:
        setup = prepare(replace(mapping, ground_elevation_m=zero_m))

    def ground_m(places_m: PointsM) -> Floats:
        latitudes, longitudes, _ = setup.frame.wgs84_from_site(places_m)
        return heights.at(longitudes, latitudes) - zero_m

    return setup, ground_m
