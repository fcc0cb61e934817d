"""What a search needs before it is measured: read, checked, and refused before it takes any time."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from sorvolo.capture.areas import read_area, read_segments
from sorvolo.capture.decoding import PHOTO_SUFFIXES, cut_out_picture
from sorvolo.capture.source import Source, open_sources
from sorvolo.errors import InputError, SettingsError
from sorvolo.geometry.arrays import Floats
from sorvolo.geometry.ground import footprint, is_on_ground
from sorvolo.geometry.homography import pose_from_homography
from sorvolo.heights.field import above_ground
from sorvolo.missions.flight.detector_protocol import FindsObjects, ObjectDetector
from sorvolo.missions.flight.map_objects import open_detector, why_not_searched
from sorvolo.missions.flight.settings import MapSettings
from sorvolo.missions.flight.setup import prepare
from sorvolo.missions.heights.measure import flight_with_heights, read_field
from sorvolo.missions.search.measure import SearchFrame, planted_classes
from sorvolo.missions.search.settings import RESULTS, SearchOutputs, SearchSettings
from sorvolo.mosaic.selection import evenly
from sorvolo.registration.lens import at_most
from sorvolo.search.conditions import AboveGround
from sorvolo.search.drawing.cut_outs import FEWEST_PICTURES, CutOut, alphas_by_difference
from sorvolo.search.drawing.planted import frame_light
from sorvolo.store.atomic import scratch_folder, writing
from sorvolo.store.exports.waypoints import check_waypoint_files
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.catalogue import StoredKeyframe
from sorvolo.store.site.catalogue_place import is_site
from sorvolo.store.site.files import HeightFile
from sorvolo.store.site.journal import content_sha256
from sorvolo.survey.area import Area
from sorvolo.survey.flight import Frame, Site
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
    """The frames of a flight that have a place."""
    return [
        frame
        for stored in archive.sound_keyframes(flight_id)
        if (frame := search_frame(archive, stored)) is not None
    ]


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


_SERIES = 9  # pictures of a person to be cut out by difference: by choice
_FINEST_M = 0.005  # of a cut-out's pixel: frames of a search are coarser
_FARTHEST_M = 20_000.0  # of an area from its site: no small drone flies so far


@dataclass(frozen=True, eq=False)
class PreparedSearch:
    """What a search needs beside a site, read and checked: the area, the segments with their probabilities, a
    detector, people to be planted."""

    area: Area | None
    segments: Sequence[tuple[str, Area, float]]
    detector: ObjectDetector
    cut_outs: tuple[CutOut, ...] = ()


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
    Raises InputError for a broken area or file of segments, for pictures out of which nobody can be cut, and for a model
    that is not there, SettingsError for classes
    that cannot be measured, for a folder that is a file, and for a file of waypoints that cannot be one, StoreError for
    a folder that cannot be written.
    """
    if outputs.folder.exists() and not outputs.folder.is_dir():
        raise SettingsError(f"--out {outputs.folder} is a file, a folder was needed")
    with writing(outputs.folder):
        there = next(
            each for each in (outputs.folder, *outputs.folder.absolute().parents) if each.exists()
        )
        with scratch_folder(there):
            pass
    check_waypoint_files(outputs.refly, outputs.folder, outputs.dji_drone)
    # waypoints must not take the place of an input, or of another file of the search
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
    area = None if outputs.area is None else read_area(outputs.area)
    segments = [] if outputs.poa is None else read_segments(outputs.poa)
    looks = open_detector(settings.model, detector, is_live=is_live)
    if looks is None:
        raise InputError(f"nothing to measure: {why_not_searched(settings.model)}")
    planted_classes(looks, settings)
    cut_outs = tuple(each for path in outputs.plant for each in _cut_outs(path, outputs.plant_cm))
    return PreparedSearch(area, segments, looks, cut_outs)


def _cut_outs(path: Path, given_cm: float | None) -> Iterator[CutOut]:
    """The people that pictures show from straight above: by their transparency, else by what differs from picture to
    picture. Raises InputError where there are none, or nothing states their scale."""
    if not path.exists():
        raise InputError(f"--plant {path}: there is no such file or folder")
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    masked = [
        (each, rgba)
        for each in files
        if each.suffix.lower() in PHOTO_SUFFIXES and (rgba := cut_out_picture(each)) is not None
    ]
    found: list[CutOut | None] = []
    how = "the person has to be opaque, all else transparent"
    m_per_px = None if given_cm is None else given_cm / 100
    for file, rgba in masked:
        if m_per_px is None:
            raise InputError(
                f"--plant {file}: a picture with transparency states no scale; give --plant-cm, the centimetres of "
                "ground that a pixel covers"
            )
        found.append(CutOut.of(file.name, rgba[..., :3], rgba[..., 3] / 255, m_per_px, None))
    if not masked:
        how = (
            "an uncovered ground has to be seen in most pictures: hover, look straight down, let the person lie down in "
            f"{FEWEST_PICTURES} places or more"
        )
        for source in open_sources([path]):
            found += _by_difference(source, m_per_px)
    people = [each for each in found if each is not None and each.is_of_a_size]
    if not people:
        sizes = ", ".join(f"{max(each.size_m):.1f} m" for each in found if each is not None)
        raise InputError(
            f"--plant {path}: nobody could be cut out of it{f' (what there is is {sizes} long)' * bool(sizes)}; {how}"
        )
    yield from people


def _by_difference(source: Source, m_per_px: float | None) -> list[CutOut | None]:
    if m_per_px is None:
        height_m = prepare(source, MapSettings(), None, telemetry_named=False).usual_height_m
        m_per_px = height_m / source.camera.camera.fx_px
    if not np.isfinite(m_per_px):
        raise InputError(
            f"--plant: nothing states how high {source.name} was taken; give --plant-cm, the centimetres of ground that "
            "a pixel covers"
        )
    chosen = set(evenly(source.frame_count, _SERIES))
    wanted = source.frames(lambda index, _: index in chosen)
    frames = [each for each in wanted if isinstance(each, Frame)]
    times = max(1.0, _FINEST_M / m_per_px)
    images = [at_most(each.image, round(max(each.image.shape) / times)) for each in frames]
    lights = [frame_light(each) for each in images]
    alphas = alphas_by_difference(images, m_per_px * times)
    return [
        CutOut.of(frame.name, image, alpha, m_per_px * times, light)
        for frame, image, alpha, light in zip(frames, images, alphas, lights)
    ]


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
