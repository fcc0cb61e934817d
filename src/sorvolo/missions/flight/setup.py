"""Before the first frame: clocks tied, telemetry in the site frame, the site itself, what can be known beforehand."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sorvolo.capture.flight_telemetry import (
    FlightTelemetry,
    TelemetryWishes,
    distance_m,
    duration_s,
    frame_times_s,
    local_prior,
)
from sorvolo.capture.source import LiveSource, Source
from sorvolo.capture.sync import DATED_NS, CameraTrack, Clock, site_origin
from sorvolo.errors import InputError, SettingsError
from sorvolo.geometry.arrays import PointsM, Vector3
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.geodesy import Geodetic, LocalFrame, utm_epsg
from sorvolo.geometry.ground import footprint, is_on_ground
from sorvolo.geometry.pose import Pose
from sorvolo.geometry.sun import sun_direction
from sorvolo.geometry.track import known_points
from sorvolo.missions.flight.base_map import FlightBase
from sorvolo.missions.flight.control import FlightControl
from sorvolo.missions.flight.settings import MapSettings
from sorvolo.mosaic.selection import FramePlan, live_plan, untimed_plan, video_plan
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.catalogue_place import Catalogues, is_site
from sorvolo.survey.area import Area
from sorvolo.survey.flight import CameraPrior, Frame, Notice, PosedFrame, Site
from sorvolo.survey.mosaic import FrameView

KnownGround = FlightControl | FlightBase
"""What places a map beside GPS, or without any."""

_OTHER_AREA_M = 20_000.0  # from a flight: no small drone flies so far
_ANOTHER_PLACE_M = 2_000.0  # from known ground: a map's files hold all between, which takes minutes where it is far


@dataclass(frozen=True, eq=False)
class FlightSetup:
    """All that is known of a flight before its first frame is read; `telemetry` is None where it places no frame."""

    source: Source
    frame: LocalFrame
    plan: FramePlan
    site: Site | None
    notices: tuple[Notice, ...]
    telemetry: FlightTelemetry | None = None
    known_ground: KnownGround | None = None

    @property
    def is_placed_late(self) -> bool:
        """Whether the flight has no GPS, and finds its place on Earth, its scale and north once all of it is seen."""
        return self.known_ground is not None and self.known_ground.is_datum

    @property
    def track(self) -> CameraTrack | None:
        """The flight's path by telemetry; of a live flight as it is known by now."""
        return None if self.telemetry is None else self.telemetry.track

    @property
    def clock(self) -> Clock | None:
        """How the frames' clock is tied to telemetry's."""
        return None if self.telemetry is None else self.telemetry.clock

    @property
    def usual_height_m(self) -> float:
        """The median of the camera's height above the ground at all samples, with or without a fix; NaN where telemetry
        does not give it."""
        return float(np.nan if self.telemetry is None else np.nanmedian(self.telemetry.track.up_m))

    @property
    def usual_tilt_deg(self) -> float:
        """How far the camera looks from straight down, the median frame by its stated angles; 0 without any."""
        if self.telemetry is None or self.telemetry.track.attitude == "none":
            return 0.0
        seconds = frame_times_s(self.source)
        some = seconds[:: 1 + len(seconds) // 200].tolist()
        up = [-each.rotation[2, 2] for each in self.telemetry.priors(some, 0.0, self.plan.smooth_s)]
        return float(np.degrees(np.arccos(np.clip(np.median(up), -1, 1)))) if up else 0.0

    def prior(self, frame: Frame, *, first: bool) -> CameraPrior:
        """What telemetry gives of a frame's camera; without telemetry, only that it looks down."""
        if self.telemetry is None:
            return local_prior(self.source.camera.camera, first=first)
        self.telemetry.renew(frame.time_ns)
        return self.telemetry.prior(self.seconds(frame.time_ns), self.plan.smooth_s)

    def seconds(self, time_ns: int) -> float:
        """Seconds of a frame's time on the frames' clock."""
        return (time_ns - self.source.start_ns) / 1e9

    def utc_ns(self, time_ns: int) -> int:
        """A frame's UTC by telemetry's clock, where the source ties the two."""
        if self.clock is None:
            return time_ns
        return time_ns - self.source.start_ns + self.clock.first_frame_utc_ns

    @property
    def flown_ns(self) -> int:
        """UTC of the first frame; 0 where neither the frames nor the telemetry are dated."""
        first_ns = self.utc_ns(self.source.start_ns)
        return first_ns if first_ns > DATED_NS else 0

    def view(self, time_ns: int, camera: Camera, site_from_camera: Pose | None) -> FrameView | None:
        """What a frame shows that was taken from this place; None where that is not known, or no ground at all."""
        if site_from_camera is None:
            return None
        outline_m = footprint(camera, site_from_camera)
        if not is_on_ground(outline_m):
            return None
        return FrameView(self.utc_ns(time_ns), self.frame, site_from_camera, outline_m)

    def inside(self, area: Area | None) -> Callable[[PosedFrame], bool]:
        """Whether a frame was taken within the area of interest; frames of unknown place count as inside."""
        if area is None or self.telemetry is None:
            return lambda _: True
        far_m = min(area.distances_m(self.frame.origin))
        if far_m > _OTHER_AREA_M:
            raise InputError(
                f"--area: it begins {far_m / 1000:,.0f} km from {self.source.name}; is it the right file, and does it have "
                "longitude before latitude?"
            )
        return lambda posed: (
            not posed.prior.knows_place or area.holds(self.frame, posed.prior.position_m)
        )


def prepare(
    source: Source,
    settings: MapSettings,
    site: Site | None,
    *,
    telemetry_named: bool,
    finds_itself: bool = False,
    ground_m: PointsM | None = None,
    known_ground: KnownGround | None = None,
    founds_site: bool = False,
) -> FlightSetup:
    """Tie clocks, lay the flight into the site frame and foresee its keyframes.

    `founds_site`: the site shows this flight alone, which is laid as if there were no site, to the last bit. `ground_m`
    (N, 2) are places all over the ground that the site shows, see `known_ground_m`. `finds_itself`: the
    flight's frames are looked for in the site's map, so that they need no GPS. `known_ground` are its control points or
    its base map, which place a flight without GPS. Raises InputError when the flight is of
    another place than the site, or where its pictures and its log have no time in common.
    """
    if isinstance(source, LiveSource):
        source.wait_for_first_fixes()
    is_video, has_fixes = source.kind == "video", source.telemetry.has_fixes
    if finds_itself and site is not None and (site.is_local or not has_fixes):
        lack = (
            "the site has no geo-reference"
            if site.is_local
            else "the flight has no telemetry with fixes"
        )
        text = f"{lack}: the frames are matched with the whole map, by their pictures alone"
        plan = untimed_plan(is_video=is_video, expected=max(2, source.frame_count))
        return FlightSetup(source, site.frame, plan, site, (Notice("no_telemetry", 1, text),))
    if not has_fixes:
        return _without_gps(source, settings, site, telemetry_named, known_ground)
    setup = _with_gps(source, settings, site, ground_m, founds_site=founds_site)
    if known_ground is None:
        return setup
    track, frame = setup.track, setup.frame
    assert track is not None
    if isinstance(known_ground, FlightControl):
        known_ground.check_place(
            lambda control: distance_m(
                track,
                frame.ground_from_lonlat(
                    [(point.longitude_deg, point.latitude_deg) for point in control.points]
                ),
            )
        )
    elif not isinstance(source, LiveSource):
        known_ground.check_place(known_points(track.east_north_m), frame)
    return replace(
        setup, known_ground=known_ground, notices=(*setup.notices, *known_ground.notices)
    )


def _without_gps(
    source: Source,
    settings: MapSettings,
    site: Site | None,
    telemetry_named: bool,
    known: KnownGround | None,
) -> FlightSetup:
    """A first flight in a frame of its own, or in that of its control points or its base map."""
    if known is not None and site is not None:
        raise InputError(
            f"the flight {source.name} has no GPS, and {known.words} alone cannot join it to a map that exists: map it "
            "into a site folder of its own"
        )
    if known is None and site is not None and not site.is_local:
        raise InputError(
            f"the site is geo-referenced, but the flight {source.name} has no GPS: give --telemetry, or map it "
            "into a site folder of its own"
        )
    if settings.offset_s is not None:
        raise SettingsError("--offset was given, but the flight has no telemetry with fixes")
    is_video = source.kind == "video"
    expected = max(2, round(duration_s(source))) if is_video else source.frame_count
    plan = untimed_plan(is_video=is_video, expected=expected)
    if known is not None:
        text = f"no GPS: {known.words} alone gives the map its place, scale and north"
        notices = (Notice("no_telemetry", 1, text), *known.notices)
        return FlightSetup(source, known.frame, plan, None, notices, known_ground=known)
    if settings.crs is not None:
        raise SettingsError(
            f"--crs {settings.crs} was given, but {source.name} has no GPS, so its map has no place on Earth; give "
            "--telemetry, or leave --crs out"
        )
    lack = "telemetry without a single fix" if len(source.telemetry) else "no telemetry"
    lack += " in time" if isinstance(source, LiveSource) and telemetry_named else ""
    text = f"{lack}: the map is in a local frame of its own, without metres and north"
    frame = LocalFrame(Geodetic(0.0, 0.0))
    return FlightSetup(source, frame, plan, site, (Notice("no_telemetry", 1, text),))


def _with_gps(
    source: Source,
    settings: MapSettings,
    site: Site | None,
    ground_m: PointsM | None,
    *,
    founds_site: bool,
) -> FlightSetup:
    """A flight in the site's frame; without a site, in one around its first fix.

    The flight that made the site was laid before the ground's height was known; the metres of a degree depend on it in
    the fifth digit, which is 0.1 mm between frames.
    """
    if site is not None and site.is_local:
        raise InputError(
            f"the site {site.name} has no geo-reference, but the flight {source.name} has GPS: map it into a new site "
            "folder"
        )
    samples = source.telemetry
    origin = site_origin(samples)
    assert origin is not None  # there are fixes
    if site is not None:
        place = (site.origin.latitude_deg, site.origin.longitude_deg)
        if not founds_site or (origin.latitude_deg, origin.longitude_deg) != place:
            origin = site.origin
    frame = LocalFrame(origin)
    wishes = TelemetryWishes(settings.offset_s, settings.ground_elevation_m)
    telemetry = FlightTelemetry(source, samples, frame, wishes)
    if site is not None:
        check_place(site, telemetry.track, source.name, ground_m)
    seconds, is_live = duration_s(source), isinstance(source, LiveSource)
    camera, by_pictures = source.camera.camera, settings.method is None
    moving = camera, telemetry.height_m, telemetry.speed_m_s, settings.overlap
    if source.kind == "photos":
        plan = untimed_plan(is_video=False, expected=source.frame_count)
    elif is_live:
        plan = live_plan(*moving, by_pictures=by_pictures)
    else:
        plan = video_plan(*moving, seconds, source.frame_rate_hz, by_pictures=by_pictures)
    return FlightSetup(source, frame, plan, site, telemetry.notices, telemetry)


def known_flights(site: Path, catalogues: Catalogues | None = None) -> dict[str, str]:
    """The fingerprint of each flight that the site folder has, by name; none where there is no site yet."""
    if not is_site(site):
        return {}
    with Archive.open(site, write=False, catalogues=catalogues) as archive:
        return {each.id: each.fingerprint for each in archive.flights()}


def new_site(setup: FlightSetup, name: str, m_per_px: float, ground_up_m: float) -> Site:
    """The site that this first flight makes.

    `ground_up_m` is the ground's height where telemetry's own zero is (0 where it takes the ground for that).
    """
    if setup.is_placed_late:
        place = setup.frame.origin
        return Site(
            name, place, f"EPSG:{utm_epsg(place.latitude_deg, place.longitude_deg)}", m_per_px
        )
    if setup.telemetry is None:
        return Site(name, Geodetic(0.0, 0.0), "", m_per_px, is_local=True)
    ground_m, reference = setup.telemetry.ground_height(ground_up_m)
    origin = Geodetic(
        setup.frame.origin.latitude_deg, setup.frame.origin.longitude_deg, round(ground_m, 3)
    )
    crs = f"EPSG:{utm_epsg(origin.latitude_deg, origin.longitude_deg)}"
    return Site(name, origin, crs, m_per_px, height_reference=reference)


def repeated(archive: Archive, setup: FlightSetup, done: str) -> tuple[Notice, ...]:
    """The notices of a flight that the site has already: its version is replaced, not painted over; under another
    name the same flight counts twice. And of one that was flown before others of the site."""
    if not archive.has_site:
        return ()
    source = setup.source
    versions = {each.flight_id: each.id for each in archive.versions()}
    later = [each for each in archive.versions() if 0 < setup.flown_ns < each.flown_ns]
    notices = [
        Notice(
            "same_flight",
            1,
            f"{source.name} begins with the same bytes as {each.id}, which is in this site already (version "
            f"{versions[each.id]}): it is the same flight under another name, and counts twice",
        )
        for each in archive.flights()
        if each.id in versions and each.id != source.name and each.fingerprint == source.fingerprint
    ]
    if later:
        text = f"{source.name} was flown before {later[-1].flight_id}: the newest version may show older ground"
        notices.append(Notice("earlier_flight", len(later), text))
    if (made := versions.get(source.name)) is not None:
        notices.append(
            Notice(
                "repeated",
                1,
                f"{source.name} is in this site already (version {made}): it was {done} again, and the new version "
                "replaces what it had made",
            )
        )
    return tuple(notices)


def founds_site(archive: Archive, flight: str) -> bool:
    """Whether the site shows this flight alone."""
    return {each.flight_id for each in archive.versions()} == {flight}


def known_ground_m(archive: Archive) -> PointsM | None:
    """(N, 2) places on the ground that a site shows, one for each tile of its map, site metres; None without any."""
    if not archive.has_site or not (tiles := archive.tiles()):
        return None
    return archive.site_grid().tile_centres_m(tiles)


def sun_over(site: Site, time_ns: int) -> Vector3 | None:
    """(3,) the unit vector to the sun, east, north and up, at a UTC time; None where the clock has no date, or the site
    no place on earth."""
    if site.is_local or time_ns <= DATED_NS:
        return None
    return sun_direction(time_ns, site.origin.latitude_deg, site.origin.longitude_deg)


def check_place(site: Site, track: CameraTrack, name: str, ground_m: PointsM | None) -> None:
    """Raise InputError for a flight far from all ground that the site shows (None: its origin)."""
    nearest_m = distance_m(track, ground_m)
    if nearest_m > _ANOTHER_PLACE_M:
        raise InputError(
            f"the flight {name} is {nearest_m / 1000:.0f} km from the site {site.name} at "
            f"{site.origin.latitude_deg:.5f}, {site.origin.longitude_deg:.5f}: map it into a site folder of its own"
        )
