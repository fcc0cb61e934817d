"""What a search needs before it is measured: read, checked, and refused before it takes any time."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from sorvolo.capture.areas import read_area, read_segments
from sorvolo.errors import InputError, SettingsError
from sorvolo.geometry.arrays import Floats
from sorvolo.geometry.homography import pose_from_homography
from sorvolo.geometry.level_ground import footprint, is_on_ground
from sorvolo.heights.field import above_ground
from sorvolo.missions.flight.detector_protocol import FindsObjects, ObjectDetector
from sorvolo.missions.flight.map_objects import open_detector, why_not_searched
from sorvolo.missions.heights.measure import flight_with_heights, read_field
from sorvolo.missions.search.measure import SearchFrame, planted_classes
from sorvolo.missions.search.settings import RESULTS, SearchOutputs, SearchSettings
from sorvolo.search.conditions import AboveGround
from sorvolo.store.atomic import scratch_folder, writing
from sorvolo.store.exports.waypoints import check_waypoint_files
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.catalogue import StoredKeyframe
from sorvolo.store.site.catalogue_place import is_site
from sorvolo.store.site.files import HeightFile
from sorvolo.store.site.journal import content_sha256
from sorvolo.survey.area import Area
from sorvolo.survey.flight import Site
from sorvolo.survey.mosaic import PlacedFrame, Status


def flights_to_search(archive: Archive, wanted: Sequence[str]) -> list[str]:
    """The names of the site's mapped flights, or of those wanted. Raises InputError for one that the site has not."""
    known = _mapped(archive)
    if unknown := [name for name in wanted if name not in known]:
        raise InputError(
            f"the site {archive.folder} has no flight {unknown[0]!r}; it has {', '.join(known) or 'none'}"
        )
    return [name for name in known if not wanted or name in wanted]


def _mapped(archive: Archive) -> list[str]:
    complete = {each.flight_id for each in archive.versions()}
    return [each.id for each in archive.flights() if each.id in complete]


def search_frames(archive: Archive, flight_id: str) -> list[SearchFrame]:
    """The frames of a flight that have a place. Raises InputError where none has."""
    frames = [
        frame
        for stored in archive.sound_keyframes(flight_id)
        if (frame := search_frame(archive, stored)) is not None
    ]
    if not frames:
        raise InputError(
            f"no frame of the flight {flight_id} has a place on the ground; map it again"
        )
    return frames


def search_frame(archive: Archive, stored: StoredKeyframe) -> SearchFrame | None:
    """A stored frame as it is searched; None where it has no place on the ground."""
    placed = _placed(stored)
    return None if placed is None else SearchFrame(placed, partial(archive.image, stored))


def heights_for(archive: Archive, flight_id: str) -> AboveGround | None:
    """How high things stand on the ground of a flight: by its own heights, else by the newest of the site.

    None where the site has no heights of a present map that can be read.
    """
    return marked_heights(archive, flight_id)[0]


def marked_heights(archive: Archive, flight_id: str) -> tuple[AboveGround | None, str]:
    """As `heights_for`, and by what these heights are known from others, made before or after; "" where there are
    none."""
    for each in (flight_id, flight_with_heights(archive, "")):
        try:
            if (
                each is not None
                and (report := archive.height_path(each, HeightFile.REPORT)).exists()
            ):
                surface, ground = (
                    read_field(archive, each, file)
                    for file in (HeightFile.SURFACE, HeightFile.GROUND)
                )
                return partial(above_ground, surface, ground), content_sha256(report.read_text())
        except InputError:
            continue  # of an earlier map, or damaged: a search can do without
    return None, ""


def _placed(stored: StoredKeyframe) -> PlacedFrame | None:
    if stored.status is Status.REJECTED:
        return None
    pose = stored.site_from_camera or pose_from_homography(stored.site_from_image, stored.camera)
    if pose is None or not is_on_ground(outline_m := footprint(stored.camera, pose)):
        return None
    return PlacedFrame(
        stored.name,
        stored.index,
        stored.time_ns,
        stored.status,
        "",
        stored.camera,
        pose,
        stored.site_from_image,
        outline_m,
        stored.residual_px,
        stored.sigma_m,
        stored.gains,
    )


_FARTHEST_M = 20_000.0  # of an area from its site: no small drone flies so far


@dataclass(frozen=True, eq=False)
class PreparedSearch:
    """What a search needs beside a site, read and checked: the area, the segments with their probabilities, a
    detector."""

    area: Area | None
    segments: Sequence[tuple[str, Area, float]]
    detector: ObjectDetector


def check_area(area: Area | None, site: Site) -> None:
    """Raise InputError for an area with a polygon farther from the site than any small drone flies."""
    far_m = [] if area is None else area.distances_m(site.origin)
    if far_m and max(far_m) > _FARTHEST_M:
        which = (
            "the area" if len(far_m) == 1 else f"polygon {far_m.index(max(far_m)) + 1} of the area"
        )
        raise InputError(
            f"--area: {which} begins {max(far_m) / 1000:,.0f} km from the site, out of reach; is it "
            "the right file, and does it have longitude before latitude?"
        )


def check_area_of(site_folder: Path, area: Area | None) -> None:
    """As `check_area` for the site that the folder holds, before anything is mapped into it; a new one has no place."""
    if area is not None and is_site(site_folder):
        with Archive.open(site_folder, write=False) as archive:
            if not archive.site().is_local:
                check_area(area, archive.site())


def prepare_search(
    settings: SearchSettings,
    outputs: SearchOutputs,
    detector: FindsObjects | None = None,
    *,
    is_live: bool = False,
) -> PreparedSearch:
    """Read and check all that a search needs beside a site, before it takes any time.

    Beside an `is_live` flight's map the detector runs at low priority.
    Raises InputError for a broken area or file of segments and for a model that is not there, SettingsError for classes
    that cannot be measured, for a folder that is a file, and for a file of waypoints that cannot be one, StoreError for
    a folder that cannot be written.
    """
    if outputs.folder.exists() and not outputs.folder.is_dir():
        raise SettingsError(f"--out {outputs.folder} is a file, a folder was needed")
    _check_writable(outputs.folder)
    check_waypoint_files(outputs.refly, outputs.folder, outputs.dji_drone)
    _check_apart(outputs)
    area = None if outputs.area is None else read_area(outputs.area)
    segments = [] if outputs.poa is None else read_segments(outputs.poa)
    looks = open_detector(settings.model, detector, is_live=is_live)
    if looks is None:
        raise InputError(f"nothing to measure: {why_not_searched(settings.model)}")
    planted_classes(looks, settings)
    return PreparedSearch(area, segments, looks)


def _check_writable(folder: Path) -> None:
    """Raise StoreError where the folder, or those that it would lie in, cannot be written; nothing stays behind."""
    with writing(folder):
        there = next(each for each in (folder, *folder.absolute().parents) if each.exists())
        with scratch_folder(there):
            pass


def _check_apart(outputs: SearchOutputs) -> None:
    """Raise SettingsError for waypoints that would take the place of an input, or of another file of the search."""
    taken = {
        path.resolve(): name
        for name, path in (("--area", outputs.area), ("--poa", outputs.poa))
        if path
    }
    taken |= {(outputs.folder / name).resolve(): f"a result, {name}" for name in RESULTS}
    for path in outputs.refly:
        if (name := taken.get(path.resolve())) is not None:
            raise SettingsError(
                f"--refly {path} is the file of {name}; give the waypoints another name"
            )


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
