"""What a search needs before it is measured: read, checked, and refused before it takes any time."""

from collections.abc import Sequence
from dataclasses import dataclass

from sorvolo.capture.areas import read_area, read_segments
from sorvolo.errors import InputError, SettingsError
from sorvolo.geometry.arrays import Floats
from sorvolo.missions.flight.detector_protocol import ObjectDetector
from sorvolo.missions.flight.map_objects import open_detector, why_not_searched
from sorvolo.missions.search.measure import planted_classes
from sorvolo.missions.search.settings import SearchOutputs, SearchSettings
from sorvolo.store.exports.waypoints import check_waypoint_files
from sorvolo.store.site.archive import Archive
from sorvolo.survey.area import Area
from sorvolo.survey.flight import Site


@dataclass(frozen=True, eq=False)
class PreparedSearch:
    """What a search needs beside a site, read and checked: the area, the segments with their probabilities, a
    detector."""

    area: Area | None
    segments: Sequence[tuple[str, Area, float]]
    detector: ObjectDetector


def prepare_search(
    settings: SearchSettings, outputs: SearchOutputs, detector: ObjectDetector | None = None, *, is_live: bool = False
) -> PreparedSearch:
    """Read and check all that a search needs beside a site, before it takes any time.

    Beside an `is_live` flight's map the detector runs at low priority.
    Raises InputError for a broken area or file of segments and for a model that is not there, SettingsError for classes
    that cannot be measured, and for a folder or a file of waypoints that cannot be written.
    """
    if outputs.folder.exists() and not outputs.folder.is_dir():
        raise SettingsError(f"--out {outputs.folder} is a file, a folder was needed")
    check_waypoint_files(outputs.refly, outputs.folder, outputs.dji_drone)
    area = None if outputs.area is None else read_area(outputs.area)
    segments = [] if outputs.poa is None else read_segments(outputs.poa)
    looks = open_detector(settings.model, is_live=is_live) if detector is None else detector
    if looks is None:
        raise InputError(f"nothing to measure: {why_not_searched(settings.model)}")
    planted_classes(looks, settings)
    return PreparedSearch(area, segments, looks)


def site_with_metres(archive: Archive) -> Site:
    """The site. Raises InputError for one that has no metres, in which nobody can be planted to scale."""
    site = archive.site()
    if site.is_local:
        raise InputError(
            f"{archive.folder} was mapped without GPS: its map has no metres, so nobody can be planted to scale; map "
            "the flight with telemetry"
        )
    return site


def known_places(archive: Archive) -> list[Floats]:
    """Where something stands by the maps, (2,) site metres each."""
    return [each.thing.position_m for each in archive.newest_objects()]
