"""Before the first frame: clocks tied, telemetry in the site frame, the site itself, what can be known beforehand."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from sorvolo.capture.source import LiveSource, Source
from sorvolo.capture.sync import Clock, Track, shifted, site_origin, tie_clocks, track_from_telemetry
from sorvolo.errors import InputError, SettingsError
from sorvolo.geometry.arrays import Floats, PointsM
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.geodesy import Geodetic, LocalFrame, utm_epsg
from sorvolo.geometry.homography import apply_homography
from sorvolo.missions.flight.settings import MapSettings
from sorvolo.mosaic.selection import interval_s
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.files import CATALOGUE
from sorvolo.survey.area import Area
from sorvolo.survey.flight import CameraPrior, Frame, Notice, PosedFrame, Site, Telemetry, no_telemetry

_ANOTHER_PLACE_M = 2_000.0  # from known ground: a map's files hold all between, which takes minutes where it is far
_PLACES_ASKED = 200  # of a flight
_UNTIMED_STEP_S = 0.2  # candidates of a video without telemetry, or live: five a second, the pictures decide
_LIVE_SPEED_M_S = 5.0  # a flight that has just begun does not show yet how fast it will be


@dataclass(eq=False)
class FlightSetup:
    """All that is known of a flight before its first frame is read; `track` is None without telemetry.

    Of a live flight more becomes known while it goes on: `renew` takes it in, and changes what is told of telemetry.
    """

    source: Source
    frame: LocalFrame
    clock: Clock | None
    track: Track | None
    step_s: float
    keyframe_s: float
    smooth_s: float
    expected_keyframes: int
    site: Site | None
    notices: tuple[Notice, ...]
    offset_s: float = 0.0
    ground_elevation_m: float | None = None
    telemetry: Telemetry = field(default_factory=no_telemetry)  # the one that `track` was made of
    telemetry_version: int = 0

    def prior(self, frame: Frame, *, first: bool) -> CameraPrior:
        """What telemetry says of a frame's camera; without telemetry, only that it looks down."""
        self.renew(frame.time_ns)
        if self.track is None:
            return _local_prior(self.source.camera.camera, first)
        return self.track.prior(self.seconds(frame), smooth_s=self.smooth_s)

    def renew(self, time_ns: int) -> None:
        """Take in what a live flight's telemetry says by now, once the fix after `time_ns` came or is late.

        The zero of heights stays where it was, so that all frames are counted from the same.
        """
        if self.track is None or not isinstance(self.source, LiveSource):
            return
        self.source.wait_for_telemetry(time_ns)
        if self.source.telemetry_version == self.telemetry_version:
            return
        self.telemetry_version = self.source.telemetry_version
        self.telemetry = self.source.telemetry
        self.clock = _live_clock(self.source, self.telemetry)
        found, _ = track_from_telemetry(
            self.telemetry, self.clock, self.frame, ground_elevation_m=self.ground_elevation_m
        )
        self.track = _continued(self.track, shifted(found, self.offset_s))

    def seconds(self, frame: Frame) -> float:
        """Seconds of the frame on the frames' clock."""
        return (frame.time_ns - self.source.start_ns) / 1e9

    def utc_ns(self, time_ns: int) -> int:
        """A frame's UTC by telemetry's clock, where the source ties the two."""
        if self.clock is None or self.source.kind == "photos":
            return time_ns
        return time_ns - self.source.start_ns + self.clock.first_frame_utc_ns

    def inside(self, area: Area | None) -> Callable[[PosedFrame], bool]:
        """Whether a frame was taken within the area of interest; frames of unknown place count as inside."""
        if area is None or self.track is None:
            return lambda _: True

        def check(posed: PosedFrame) -> bool:
            if not posed.prior.knows_place:
                return True
            latitude, longitude, _ = self.frame.wgs84_from_site(posed.prior.position_m[None])
            return bool(area.contains(np.column_stack([longitude, latitude]))[0])

        return check


def prepare(
    source: Source, settings: MapSettings, site: Site | None, *, telemetry_named: bool, finds_itself: bool = False,
    ground_m: PointsM | None = None,
) -> FlightSetup:
    """Tie clocks, lay the flight into the site frame and foresee its keyframes.

    `ground_m` (N, 2) are places all over the ground that the site shows, see `known_ground_m`. `finds_itself`: the
    flight's frames are looked for in the site's map, so that they need no GPS. Raises InputError when the flight is of
    another place than the site, or the telemetry of another flight.
    """
    is_live = isinstance(source, LiveSource)
    if isinstance(source, LiveSource):
        source.wait_for_first_fixes()
    telemetry_version = source.telemetry_version if isinstance(source, LiveSource) else 0
    telemetry = source.telemetry
    duration_s = source.frame_count / source.frame_rate_hz if source.frame_rate_hz > 0 else 0.0
    if finds_itself and site is not None and (site.is_local or not telemetry.has_fixes):
        lack = "the site has no geo-reference" if site.is_local else "the flight has no telemetry with fixes"
        notice = Notice("no_telemetry", 1, f"{lack}: the frames are looked for in the whole map, by their looks alone")
        step_s = _UNTIMED_STEP_S if source.kind == "video" else 0.0
        return FlightSetup(
            source, site.frame, None, None, step_s, step_s, 0.0, max(2, source.frame_count), site, (notice,)
        )
    if not telemetry.has_fixes:
        if site is not None and not site.is_local:
            raise InputError(
                f"the site is geo-referenced, but the flight {source.name} has no GPS: give --telemetry, or map it "
                "into a site folder of its own"
            )
        if settings.offset_s is not None:
            raise SettingsError("--offset was given, but the flight has no telemetry with fixes")
        if settings.crs is not None:
            raise SettingsError(
                f"--crs {settings.crs} was given, but {source.name} has no GPS, so its map has no place on Earth; give "
                "--telemetry, or leave --crs out"
            )
        step_s = _UNTIMED_STEP_S if source.kind == "video" else 0.0
        lack = "telemetry without a single fix" if len(telemetry) else "no telemetry"
        lack += " in time" if is_live and telemetry_named else ""
        text = f"{lack}: the map is in a local frame of its own, without metres and north"
        return FlightSetup(
            source, LocalFrame(Geodetic(0.0, 0.0)), None, None, step_s, step_s, 0.0,
            source.frame_count if source.kind == "photos" else max(2, round(duration_s)), site,
            (Notice("no_telemetry", 1, text),),
        )
    if site is not None and site.is_local:
        raise InputError(
            f"the site {site.name} has no geo-reference, but the flight {source.name} has GPS: map it into a new site "
            "folder"
        )
    clock = _live_clock(source, telemetry) if isinstance(source, LiveSource) else tie_clocks(
        telemetry, kind=source.kind, start_ns=source.start_ns, duration_s=duration_s,
        offset_given=settings.offset_s is not None, strict=telemetry_named,
    )
    origin = site.origin if site is not None else site_origin(telemetry)
    assert origin is not None  # has_fixes
    frame = LocalFrame(origin)
    elevation_m = settings.ground_elevation_m
    if elevation_m is None and np.isfinite(source.ground_elevation_m):
        elevation_m = source.ground_elevation_m
    track, notices = track_from_telemetry(telemetry, clock, frame, ground_elevation_m=elevation_m)
    if site is not None:
        _check_place(site, track, source.name, np.zeros((1, 2)) if ground_m is None else ground_m)
    if settings.offset_s is not None:
        track = shifted(track, settings.offset_s)
    known = np.isfinite(track.east_north_m[:, 0])
    covered = (track.sample_s[known] >= -1.5 * track.interval_s - 0.5) & (
        track.sample_s[known] <= duration_s + 1.5 * track.interval_s + 0.5
    )
    if source.kind == "video" and not is_live and not covered.any():
        raise InputError(
            f"the telemetry ({telemetry.format}) has no fix during the {duration_s:.0f} s of {source.name}; give the "
            "telemetry of this flight, or another --offset"
        )
    camera = source.camera.camera
    height_m = max(float(np.median(track.up_m[known])), 2.0)
    path_s, path_m = track.sample_s[known], track.east_north_m[known]
    speed = max(_speed_m_s(path_s, path_m), _LIVE_SPEED_M_S if is_live else 0.0)
    keyframe_s = interval_s(camera, height_m, speed, settings.overlap)
    if source.kind == "photos":
        step_s, expected = 0.0, source.frame_count
    elif is_live:
        step_s, expected = _UNTIMED_STEP_S if settings.method == "planar" else min(keyframe_s, 2.0), 2
    else:
        # the thesis takes frames by eq. 3.17 alone; planar looks at three times as many and lets the pictures decide
        share = 1 if settings.method == "thesis" else 3
        step_s = float(np.clip(keyframe_s / share, 1 / max(source.frame_rate_hz, 1.0), 2.0 / share))
        expected = max(2, round(duration_s / keyframe_s))
    smooth_s = 0.5 * keyframe_s if source.kind == "video" and settings.method == "planar" else 0.0
    return FlightSetup(
        source, frame, clock, track, step_s, keyframe_s, smooth_s, expected, site, (*clock.notices, *notices),
        settings.offset_s or 0.0, elevation_m, telemetry, telemetry_version,
    )


def known_flights(site: Path) -> dict[str, str]:
    """The fingerprint of each flight that the site folder has, by name; none where there is no site yet."""
    if not (site / CATALOGUE).is_file():
        return {}
    with Archive.open(site, write=False) as archive:
        return {each.id: each.fingerprint for each in archive.flights()}


def new_site(setup: FlightSetup, name: str, m_per_px: float, ground_up_m: float) -> Site:
    """The site that this first flight makes.

    `ground_up_m` is the ground's height where telemetry's own zero is (0 where it takes the ground for that).
    """
    if setup.track is None:
        return Site(name, Geodetic(0.0, 0.0), "", m_per_px, is_local=True)
    telemetry = setup.telemetry
    for column, stated in (("ellipsoidal_height_m", "ellipsoidal"), ("orthometric_height_m", "orthometric")):
        heights = telemetry[column]
        if np.isfinite(heights).mean() > 0.5:
            ground_m, reference = float(np.nanmedian(heights - setup.track.up_m)) + ground_up_m, stated
            break
    else:
        ground_m, reference = 0.0, "above ground"
    origin = Geodetic(setup.frame.origin.latitude_deg, setup.frame.origin.longitude_deg, round(ground_m, 3))
    crs = f"EPSG:{utm_epsg(origin.latitude_deg, origin.longitude_deg)}"
    return Site(name, origin, crs, m_per_px, height_reference=reference)


def known_ground_m(archive: Archive) -> PointsM | None:
    """(N, 2) places on the ground that a site shows, one for each tile of its map, site metres; None without any."""
    if not archive.has_site or not (tiles := archive.tiles()):
        return None
    site_grid = archive.site_grid()
    site_from_grid = np.linalg.inv(site_grid.grid_from_site_affine(np.zeros(2), 50.0))
    return apply_homography(site_from_grid, (np.array(sorted(tiles)) + 0.5) * site_grid.grid.tile_px)


def _check_place(site: Site, track: Track, name: str, ground_m: PointsM) -> None:
    known = track.east_north_m[np.isfinite(track.east_north_m[:, 0])]
    some = known[:: -(-len(known) // _PLACES_ASKED)]
    nearest_m = min(float(np.hypot(*(ground_m - place).T).min()) for place in some)
    if nearest_m > _ANOTHER_PLACE_M:
        raise InputError(
            f"the flight {name} is {nearest_m / 1000:.0f} km from the site {site.name} at "
            f"{site.origin.latitude_deg:.5f}, {site.origin.longitude_deg:.5f}: map it into a site folder of its own"
        )


def _speed_m_s(path_s: Floats, path_m: PointsM) -> float:
    """The speed that three quarters of the flight stay below, over steps of a second or more."""
    if len(path_s) < 2:
        return 1.0
    times = np.arange(path_s[0], path_s[-1], max(1.0, float(np.median(np.diff(path_s)))))
    if len(times) < 2:
        return 1.0
    steps = np.column_stack([np.interp(times, path_s, path_m[:, k]) for k in range(2)])
    return max(0.3, float(np.percentile(np.linalg.norm(np.diff(steps, axis=0), axis=1) / np.diff(times), 75)))


def _live_clock(source: LiveSource, telemetry: Telemetry) -> Clock:
    """A live source ties its telemetry to its frames itself."""
    return Clock(
        (telemetry.time_ns - source.start_ns) / 1e9, source.telemetry_tie, source.telemetry_sigma_s, source.start_ns
    )


def _continued(before: Track, now: Track) -> Track:
    """The track as it is known now, its heights counted from the same zero as before."""
    same_m = np.interp(before.sample_s, now.sample_s, now.up_m)
    return replace(
        now, up_m=now.up_m + np.median(before.up_m - same_m), height_words=before.height_words,
        vertical_sigma_m=before.vertical_sigma_m, altitude_offset_sigma_m=before.altitude_offset_sigma_m,
    )


def _local_prior(camera: Camera, first: bool) -> CameraPrior:
    """Without telemetry the first frame defines the frame: one unit is one of its pixels, its top is "north"."""
    rotation = np.diag([1.0, -1.0, -1.0])
    position_m = np.array([0.0, 0.0, camera.fx_px])
    sigma = np.full(3, 1e-3 * camera.fx_px) if first else np.full(3, np.inf)
    attitude = np.array([4.0, 4.0, 0.1]) if first else np.array([12.0, 12.0, np.inf])
    return CameraPrior(position_m, sigma, rotation, attitude, source="no telemetry")
