"""What is asked for of a flight, as one number: by it a site knows what it has, and a run what it goes on with."""

import platform
from importlib.metadata import version
from pathlib import Path
from typing import Any

from sorvolo.build import build
from sorvolo.capture.photos import PhotoSource
from sorvolo.capture.source import LiveSource
from sorvolo.capture.video import VideoSource
from sorvolo.missions.flight.control import FlightControl
from sorvolo.missions.flight.detector_protocol import ObjectDetector
from sorvolo.missions.flight.setup import FlightSetup
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.journal import content_sha256
from sorvolo.survey.area import Area

_LIBRARIES = ("numpy", "scipy", "opencv-contrib-python-headless", "av", "rasterio")


def software(*libraries: str) -> dict[str, str]:
    """Return the versions of Python and of these libraries, by name; without any, of those that compute a map."""
    return {
        "python": platform.python_version(),
        **{name: version(name) for name in libraries or _LIBRARIES},
    }


REQUEST = "request"
"""Of a run's settings in the catalogue: what was asked for."""


def request_of(
    setup: FlightSetup,
    settings: Any,
    area: Area | None,
    detector: ObjectDetector | None,
    *more: Any,
) -> str:
    """What is asked for: the same command over the same files by the same build of the program gives the same.

    `settings` is the mission's record, `more` what else the result depends on: records, arrays and plain values. Of a
    live flight: the same command, see `live_request`.
    """
    if isinstance(setup.source, LiveSource):
        return live_request(setup.source, settings, area, detector, *more)
    files = [(path.name, path.stat().st_size, path.stat().st_mtime_ns) for path in _files(setup)]
    return content_sha256(
        build(),
        software(),
        setup.source.fingerprint,
        files,
        setup.source.camera,
        setup.source.telemetry,
        settings,
        area,
        None if detector is None else detector.info,
        more,
    )


def live_request(
    source: LiveSource,
    settings: Any,
    area: Area | None,
    detector: ObjectDetector | None,
    *more: Any,
) -> str:
    """What is asked for of a live flight, which is known before the flight is: the same for the same address."""
    return content_sha256(
        build(),
        software(),
        source.inputs,
        source.kind,
        source.size_px,
        settings,
        area,
        None if detector is None else detector.info,
        more,
    )


def already_done(archive: Archive, setup: FlightSetup, request: str) -> str:
    """When the site got the flight as it is asked for, ISO 8601 UTC, else ""; a live flight is another each time."""
    if isinstance(setup.source, LiveSource):
        return ""
    return next(
        (
            each.finished_utc
            for each in archive.complete_flights
            if each.id == setup.source.name and each.settings.get(REQUEST) == request
        ),
        "",
    )


def _files(setup: FlightSetup) -> list[Path]:
    """The files that a recorded flight is made from."""
    source, ground = setup.source, setup.known_ground
    found: list[Path] = []
    if ground is not None:
        found.append(ground.file.path if isinstance(ground, FlightControl) else ground.base.path)
    if isinstance(source, PhotoSource):
        return [*found, *(each.path for each in source.album.photos)]
    return [*found, *source.files] if isinstance(source, VideoSource) else found
