"""A site's flights as they are searched: their kept frames on their final places, and the heights of the ground."""

from collections.abc import Sequence
from functools import partial

from sorvolo.errors import InputError
from sorvolo.geometry.homography import pose_from_homography
from sorvolo.geometry.level_ground import footprint, is_on_ground
from sorvolo.heights.field import above_ground
from sorvolo.missions.heights.measure import flight_with_heights, read_field
from sorvolo.missions.search.measure import SearchFrame
from sorvolo.search.conditions import AboveGround
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.catalogue import StoredKeyframe
from sorvolo.store.site.files import HeightFile
from sorvolo.store.site.journal import content_sha256
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
    complete = {each.flight_id for each in archive.versions() if each.complete}
    return [each.id for each in archive.flights() if each.id in complete]


def search_frames(archive: Archive, flight_id: str) -> list[SearchFrame]:
    """The frames of a flight that have a place. Raises InputError where none has."""
    frames = [
        frame
        for stored in archive.keyframes(flight_id)
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
