"""Where what a watch sees lies and which object it is: on the ground if telemetry allows it, else in the picture."""

import math
from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping
from copy import copy
from dataclasses import replace
from itertools import islice
from pathlib import Path
from statistics import median

from sorvolo.capture.source import LiveSource
from sorvolo.capture.sync import UNSURE_CLOCK_S, HeightKind
from sorvolo.detection.fusing import is_from_above
from sorvolo.errors import InputError
from sorvolo.geometry.arrays import Floats, PointsM
from sorvolo.geometry.pose import Pose
from sorvolo.geometry.track import corners_around, known_points
from sorvolo.missions.flight.sample_frames import pictures_move
from sorvolo.missions.flight.settings import MapSettings
from sorvolo.missions.flight.setup import FlightSetup, new_site
from sorvolo.mosaic.selection import every
from sorvolo.store.rasters.height_model import read_height_model
from sorvolo.survey.flight import CameraPrior, Frame, Notice, Site
from sorvolo.survey.mosaic import FrameView
from sorvolo.survey.objects import Detections
from sorvolo.survey.wording import counted
from sorvolo.tracking.following import (
    GroundFollower,
    Located,
    PictureFollower,
    Taken,
    watched_prior,
)
from sorvolo.tracking.headings import PhotoHeadings
from sorvolo.tracking.laying import IMPOSSIBLE_SIZE, GroundHeight
from sorvolo.tracking.tracker import TrackerSettings

_AROUND_M = 2000.0  # of the flight's fixes, so far the model is read


def over_heights(
    prepare: Callable[[MapSettings], FlightSetup], mapping: MapSettings, model: Path
) -> tuple[FlightSetup, GroundHeight]:
    """The flight with its heights counted from the ground below its first fix, and the ground's from there.

    Heights above take-off are taken to begin there already; others are held against the model's, which must be in the
    same reference. Raises InputError for a model that cannot be read, does not show that ground, or states another
    reference, and for a flight without fixes.
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
    if setup.track.height_kind is not HeightKind.ABOVE_TAKEOFF:
        is_ellipsoidal = setup.track.height_kind is HeightKind.ELLIPSOIDAL
        if heights.datum and ("ellips" in heights.datum.lower()) is not is_ellipsoidal:
            raise InputError(
                f"{model} counts its heights from {heights.datum}, and the telemetry's are {setup.track.height_kind}: "
                "the two differ by up to 100 m; give a model in the telemetry's reference, or --ground-elevation"
            )
        setup = prepare(replace(mapping, ground_elevation_m=zero_m))

    def ground_m(places_m: PointsM) -> Floats:
        latitudes, longitudes, _ = setup.frame.wgs84_from_site(places_m)
        return heights.at(longitudes, latitudes) - zero_m

    return setup, ground_m


_COMPASS_REPORTED_DEG = 5.0  # by which headings are off: less is not worth a notice; by choice
_HEIGHT_REPORTED = 0.05  # the same of heights above the ground; by choice
_TILT_REPORTED_DEG = 3.0  # the same of where the camera looks; by choice
_AHEAD_STEP_S = 0.2  # between frames that are looked at before the watch
CONTRADICTED = "telemetry_contradicted"
_OF_MAPS = (
    "no_telemetry",
    "ground_unknown",
    "height_unknown",
)  # notices about what a mapping does about it


class Places:
    """Detections placed and followed, frame by frame; `follower` keeps their tracks.

    Places are counted in `site`; a local one's metres are pixels of a segment's first frame.
    """

    site: Site
    follower: GroundFollower | PictureFollower

    def m_per_px(self, frame: Frame) -> float | None:
        """Return the ground's sampling distance along the optical axis; None where it is not known."""
        return None

    def is_from_above(self, frame: Frame) -> bool:
        """Return whether the frame is a photo taken about straight down: a video's frames need no second look."""
        return False

    def view(self, frame: Frame) -> FrameView | None:
        """Return what ground the frame shows by telemetry, taken as level; None where that is not known."""
        return None

    @abstractmethod
    def take(
        self, frame: Frame, time_ns: int, found: Detections, located: Located | None = None
    ) -> Taken:
        """Place a frame's detections and give them to their tracks; `located` is where a killed run placed them."""

    @abstractmethod
    def notices(self) -> tuple[Notice, ...]:
        """Return how frames were placed, and what could not be."""


def places_of(
    setup: FlightSetup, least: Mapping[str, float], ground: GroundHeight | None = None
) -> Places:
    """The way to place a flight's detections that its telemetry allows; those of a class score `least` or more.

    What one photo alone shows is reported from there on; a video shows a place in many frames.
    `ground` gives the ground's height over the flight's zero; None: it is level.
    """
    why_not = _why_not_on_ground(setup)
    settings = TrackerSettings(
        sure_score=min(
            TrackerSettings.sure_score, *least.values()
        ),  # lower ones would never begin a track
        alone=least if setup.source.kind == "photos" else {},
    )
    return (
        GroundPlaces(setup, settings, ground)
        if why_not is None
        else ImagePlaces(setup, settings, why_not)
    )


class GroundPlaces(Places):
    """Detections on the ground of a flight with telemetry, tracked in metres."""

    def __init__(
        self, setup: FlightSetup, settings: TrackerSettings, ground: GroundHeight | None
    ) -> None:
        self._setup, self._over_model = setup, ground is not None
        is_video = setup.source.kind != "photos"
        self._headings = None if is_video else PhotoHeadings(setup.source.camera.camera)
        self._taken: tuple[int, CameraPrior] | None = None  # the last frame taken, and its prior
        knows_heading = setup.track is None or setup.track.attitude != "none"
        clock_s = 0.0 if setup.clock is None else setup.clock.sigma_s
        self.follower: GroundFollower = GroundFollower(
            setup.source.camera,
            settings,
            ground,
            knows_heading=knows_heading,
            is_video=is_video,
            clock_sigma_s=clock_s if clock_s >= UNSURE_CLOCK_S else 0.0,
        )
        self.site = new_site(setup, setup.source.name, 1.0, 0.0)
        if self._over_model:  # one height would stand for all objects
            self.site = replace(self.site, height_reference="above ground")

    def m_per_px(self, frame: Frame) -> float | None:
        return self.follower.m_per_px(self._prior(frame))

    def is_from_above(self, frame: Frame) -> bool:
        return self._setup.source.kind == "photos" and is_from_above(self._prior(frame).rotation)

    def view(self, frame: Frame) -> FrameView | None:
        taken = self._taken
        prior = taken[1] if taken is not None and taken[0] == frame.index else self._prior(frame)
        pose = Pose(prior.rotation, prior.position_m) if prior.knows_place else None
        return self._setup.view(frame.time_ns, self._setup.source.camera.camera, pose)

    def take(
        self, frame: Frame, time_ns: int, found: Detections, located: Located | None = None
    ) -> Taken:
        if located is not None:
            return self.follower.recall(located)
        prior = self._prior(frame)
        if self._taken is None and not isinstance(self._setup.source, LiveSource):
            if self._headings is None:
                self.follower.look_ahead(self._coming(frame))
            else:  # its heading is held against the photo after it
                for after, its_prior in islice(self._coming(frame), 1):
                    self._headings.see(after, its_prior)
        if self._headings is not None:
            prior = self._headings.take(frame, prior)
        self._taken = frame.index, prior
        return self.follower.take(frame, time_ns, found, prior)

    def _coming(self, frame: Frame) -> Iterator[tuple[Frame, CameraPrior]]:
        """What comes after a frame; it is read apart from what the watch reads."""
        chosen = every(_AHEAD_STEP_S)
        for each in copy(self._setup.source).frames(
            lambda index, time_ns: index > frame.index and chosen(index, time_ns)
        ):
            if isinstance(each, Frame):
                yield each, self._prior(each)

    def notices(self) -> tuple[Notice, ...]:
        track, follower, found = self._setup.track, self.follower, list[Notice]()
        words = {
            "gimbal": "the gimbal's angles",
            "body": "the aircraft's angles, the camera taken as fixed downwards",
        }
        nadir = "no angles: the camera is taken to look straight down, its heading estimated from the pictures' motion"
        how = words.get(track.attitude, nadir) if track else ""
        height = track.height_words if track else ""
        if self._over_model and track:
            height = f"{track.height_kind}, over the height model's ground"
        text = f"places come from the telemetry's position, height ({height}) and {how}"
        found.append(Notice("placed_by", 1, text))
        turns_deg = self._headings.error.turns_deg if self._headings else follower.turns_deg
        if turns_deg and (off_deg := median(map(abs, turns_deg))) > _COMPASS_REPORTED_DEG:
            text = (
                f"headings about {off_deg:.0f} degrees off, as the pictures show: corrected in "
                f"{counted(len(turns_deg), 'picture')}"
            )
            found.append(Notice("headings_wrong", len(turns_deg), text))
        if abs(follower.height_scale - 1) > _HEIGHT_REPORTED:
            text = (
                f"the height above the ground is {follower.height_scale:.2f} times the telemetry's, as the pictures "
                "show: corrected"
            )
            found.append(Notice("heights_wrong", 1, text))
        if follower.tilt_deg > _TILT_REPORTED_DEG:
            text = (
                f"the camera looks up to {follower.tilt_deg:.0f} degrees beside where the telemetry says, as the "
                "pictures show: corrected"
            )
            found.append(Notice("tilt_wrong", 1, text))
        clock = self._setup.clock
        if follower.is_uniform and clock is not None and clock.sigma_s >= UNSURE_CLOCK_S:
            text = (
                f"the clock could not be checked ({clock.tie}): the flight has no turn; the stated accuracy of places "
                f"includes {clock.sigma_s:g} s of flight along it"
            )
            found.append(Notice("clock_unchecked", 1, text))
        if why_not := follower.contradiction:
            text = f"the pictures' motion contradicts the telemetry: {why_not}"
            found.append(Notice(CONTRADICTED, 1, text))
        for reason, count in follower.unlocated.most_common():
            if reason != IMPOSSIBLE_SIZE:
                text = f"{counted(count, 'detection')} without a place on the ground: {reason}"
                found.append(Notice("not_placed", count, text))
        if follower.impossible_size:
            text = f"{counted(follower.impossible_size, 'detection')} left out: {IMPOSSIBLE_SIZE}"
            found.append(Notice("too_short", follower.impossible_size, text))
        return (*self._setup.notices, *found)

    def _prior(self, frame: Frame) -> CameraPrior:
        prior, track = self._setup.prior(frame, first=False), self._setup.track
        if track is None:
            return prior
        return watched_prior(
            prior, track.altitude_offset_sigma_m, has_gimbal=track.attitude == "gimbal"
        )


class ImagePlaces(Places):
    """Detections of a flight that nothing places, tracked in the first frame's pixels; after a cut all begins anew."""

    def __init__(self, setup: FlightSetup, settings: TrackerSettings, why_not: str) -> None:
        self._setup, self._why_not = setup, why_not
        self.follower: PictureFollower = PictureFollower(settings)
        self.site = Site(setup.source.name, setup.frame.origin, "", 1.0, is_local=True)

    def take(
        self, frame: Frame, time_ns: int, found: Detections, located: Located | None = None
    ) -> Taken:
        if located is not None:
            return self.follower.recall(located, found, frame.image.shape[:2])
        return self.follower.take(frame, time_ns, found)

    def notices(self) -> tuple[Notice, ...]:
        text = f"{self._why_not}: no object is placed on the ground, objects are followed in the picture"
        others = [each for each in self._setup.notices if each.code not in _OF_MAPS]
        guessed, cuts = self.follower.guessed, self.follower.segment - 1
        if guessed:
            words = f"{counted(guessed, 'frame')} without a motion that fits: the last motion was continued"
            others.append(Notice("motion_guessed", guessed, words))
        if self.follower.impossible_size:
            words = f"{counted(self.follower.impossible_size, 'detection')} left out: {IMPOSSIBLE_SIZE}, beside the scene's cars"
            others.append(Notice("too_short", self.follower.impossible_size, words))
        if cuts:
            words = f"the picture changed all at once {counted(cuts, 'time')}: objects are counted anew after each cut"
            others.append(Notice("scene_cuts", cuts, words))
        return (*others, Notice("not_on_ground", 1, text))


def _why_not_on_ground(setup: FlightSetup) -> str | None:
    """What telemetry lacks for places on the ground; None where it has all that is needed."""
    track = setup.track
    if track is None:
        return "the telemetry has no position" if len(setup.source.telemetry) else "no telemetry"
    if not math.isfinite(track.vertical_sigma_m):
        return "the telemetry has no height"
    if not math.isfinite(track.altitude_offset_sigma_m):
        return (
            f"heights are {track.height_kind} and the ground's is unknown (give --ground-elevation)"
        )
    if track.is_still and pictures_move(setup.source):
        return "the telemetry's positions are all one place, and the pictures move"
    return None
