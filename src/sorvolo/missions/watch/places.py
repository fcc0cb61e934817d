"""Where what a watch sees lies and which object it is: on the ground if telemetry allows it, else in the picture."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from sorvolo.geometry.arrays import Floats
from sorvolo.geometry.level_ground import footprint
from sorvolo.geometry.pose import Pose, rotation_from_vector, site_from_gimbal_rotation
from sorvolo.missions.flight.setup import FlightSetup, new_site
from sorvolo.survey.flight import CameraPrior, Frame, Notice, Site
from sorvolo.survey.objects import Detections, Sighting, Track
from sorvolo.tracking.heading import CompassError, HeadingFromMotion
from sorvolo.tracking.image_motion import ImageMotion
from sorvolo.tracking.locate import TOO_SHORT, GroundHeight, LocateSettings, locate
from sorvolo.tracking.tracker import IN_PICTURES, Tracker, TrackerSettings, TrackUpdate

_MOST_DRONE_PLACES = 200_000
_GIMBAL_TILT_SIGMA_DEG = 1.0  # a mapping doubts gimbals more, since the pictures tell it better; here nothing else does
_COMPASS_TOLD_DEG = 2.0
_OVER_MODEL = LocateSettings(ground_sigma_m=1.0)  # of a height model, where it stands on its own
_OF_MAPS = ("no_telemetry", "ground_unknown", "height_unknown")  # notices that say what a mapping does about it


@dataclass(frozen=True, eq=False)
class Taken:
    """What became of a frame's detections, each with its sighting, if it has a place, and its track (0: none).

    `merged` are ids of tracks that turned out to be objects seen before. `segment` counts the stretches of a flight
    that is followed in the picture, from 1, each with places in the pixels of its own first frame; 0 on the ground.
    """

    sightings: Sequence[Sighting | None]
    track_ids: Sequence[int]
    new_ids: frozenset[int]
    merged: frozenset[int]
    segment: int = 0


class Places(Protocol):
    """Detections placed and followed, frame by frame."""

    @property
    def site(self) -> Site:
        """What places are counted in; a local one's metres are pixels of a segment's first frame."""

    def m_per_px(self, frame: Frame) -> float | None:
        """The ground's sampling distance in the frame; None where unknown."""

    @property
    def set_aside(self) -> int:
        """Detections so far that are far too short for their class: they have a place, but are no such thing."""

    def take(self, frame: Frame, time_ns: int, found: Detections) -> Taken:
        """Place a frame's detections and give them to their tracks."""

    def tracks(self) -> Sequence[Track]:
        """All tracks as they are known now."""

    def finish(self) -> Sequence[Track]:
        """All tracks when nothing more comes."""

    def notices(self) -> tuple[Notice, ...]:
        """How frames were placed, and what could not be."""

    def path_m(self) -> Floats:
        """(N, 2) where the camera was, in site metres; none where nothing says so."""


def places_of(setup: FlightSetup, least_score: float, ground: GroundHeight | None = None) -> Places:
    """The way to place a flight's detections that its telemetry allows; all of them score `least_score` or more.

    `ground` gives the ground's height over the flight's zero; None: it is level.
    """
    why_not = _why_not_on_ground(setup)
    sure_score = min(TrackerSettings.sure_score, least_score)  # lower ones would never begin a track
    return GroundPlaces(setup, sure_score, ground) if why_not is None else ImagePlaces(setup, sure_score, why_not)


class GroundPlaces:
    """Detections on the ground of a flight with telemetry, tracked in metres."""

    def __init__(self, setup: FlightSetup, sure_score: float, ground: GroundHeight | None) -> None:
        self._setup, self._ground = setup, ground
        self._tracker = Tracker(TrackerSettings(sure_score=sure_score))
        self._unlocated: Counter[str] = Counter()
        knows_heading = setup.track is None or setup.track.attitude != "none"
        self._turning = None if knows_heading else _Turning()
        self._compass = CompassError()
        self._path: list[Floats] = []
        self._site = new_site(setup, setup.source.name, 1.0, 0.0)
        if ground is not None:  # one height would be told for all objects
            self._site = replace(self._site, height_reference="above ground")

    @property
    def site(self) -> Site:
        """The flight's own frame of metres."""
        return self._site

    def m_per_px(self, frame: Frame) -> float | None:
        """Along the optical axis; None where the camera looks at the horizon or its height is not known."""
        prior = self._prior(frame)
        down = -float(prior.rotation[2, 2])
        height_m = float(prior.position_m[2]) - self._below_m(prior)
        if down < 0.1 or height_m <= 0:
            return None
        return height_m / down / self._setup.source.camera.camera.fx_px

    @property
    def set_aside(self) -> int:
        """See `Places.set_aside`."""
        return self._unlocated[TOO_SHORT]

    def take(self, frame: Frame, time_ns: int, found: Detections) -> Taken:
        """Place a frame's detections on the ground and give them to their tracks."""
        prior = self._prior(frame)
        if self._turning is not None:
            prior = self._turning.take(frame, time_ns, found, prior)
        else:
            site_from_read = rotation_from_vector(np.array([0.0, 0.0, np.radians(self._compass.clockwise_deg)]))
            prior = replace(prior, rotation=site_from_read @ prior.rotation)
        camera = self._setup.source.camera
        sightings, unlocated = locate(
            found, frame.index, frame.name, time_ns, camera.camera, prior, focal_sigma=camera.focal_sigma,
            ground_height_m=self._ground or 0.0, settings=LocateSettings() if self._ground is None else _OVER_MODEL,
        )
        self._unlocated.update(unlocated)
        outline_m = footprint(camera.camera, Pose(prior.rotation, prior.position_m), self._below_m(prior))
        known = [each for each in sightings if each is not None]
        update = self._tracker.update(
            known, time_ns=time_ns, footprint_m=outline_m if np.isfinite(outline_m).all() else None
        )
        if prior.knows_place and self._turning is None:
            self._compass.add(time_ns / 1e9, prior.position_m[:2], self._tracker.shift_m)
        if prior.knows_place and len(self._path) < _MOST_DRONE_PLACES:
            self._path.append(prior.position_m[:2])
        return _taken(sightings, update)

    def tracks(self) -> Sequence[Track]:
        """All tracks as they are known now."""
        return self._tracker.tracks()

    def finish(self) -> Sequence[Track]:
        """All tracks when nothing more comes."""
        return self._tracker.finish()

    def notices(self) -> tuple[Notice, ...]:
        """How frames were placed, and what could not be."""
        track = self._setup.track
        words = {"gimbal": "its gimbal's angles", "body": "the aircraft's angles, the camera taken as fixed downwards"}
        nadir = "no angles: the camera taken as looking straight down, its heading found from the pictures' motion"
        how = words.get(track.attitude, nadir) if track else ""
        compass_deg = self._compass.clockwise_deg
        side = "clockwise" if compass_deg > 0 else "counter-clockwise"
        off = f"the compass reads about {abs(compass_deg):.0f} degrees too far {side}, by what stands: taken off"
        compass = (Notice("compass_off", 1, off),) if abs(compass_deg) > _COMPASS_TOLD_DEG else ()
        height = track.height_words if track else ""
        if self._ground is not None:
            height = f"{height.split(',')[0]}, over the height model's ground"
        short = f"set aside, as maps leave them out: {self.set_aside} detections far too short for their class"
        text = f"places come from the telemetry's position, height ({height}) and {how}"
        return (
            *self._setup.notices, Notice("placed_by", 1, text), *compass,
            *(Notice("not_placed", count, f"{count} detections have no place on the ground: {reason}")
              for reason, count in self._unlocated.most_common() if reason != TOO_SHORT),
            *((Notice("too_short", self.set_aside, short),) if self.set_aside else ()),
        )

    def path_m(self) -> Floats:
        """(N, 2) where the camera was."""
        return np.array(self._path).reshape(-1, 2)

    def _below_m(self, prior: CameraPrior) -> float:
        """The ground's height below the camera; 0 where nothing says."""
        if self._ground is None or not prior.knows_place:
            return 0.0
        below_m = float(self._ground(prior.position_m[None, :2])[0])
        return below_m if np.isfinite(below_m) else 0.0

    def _prior(self, frame: Frame) -> CameraPrior:
        """Telemetry's word, its height's sigma with that of the ground in it."""
        prior = self._setup.prior(frame, first=False)
        track = self._setup.track
        if track is None:
            return prior
        sigma = prior.position_sigma_m.copy()
        sigma[2] = np.hypot(sigma[2], track.altitude_offset_sigma_m)
        attitude = prior.attitude_sigma_deg.copy()
        if track.attitude == "gimbal":
            attitude[:2] = np.minimum(attitude[:2], _GIMBAL_TILT_SIGMA_DEG)
        return replace(prior, position_sigma_m=sigma, attitude_sigma_deg=attitude)


class _Turning:
    """The heading of a camera of which telemetry tells none, from what its pictures show of its motion."""

    def __init__(self) -> None:
        self._motion, self._heading = ImageMotion(), HeadingFromMotion()
        self._segments = 1

    def take(self, frame: Frame, time_ns: int, found: Detections, prior: CameraPrior) -> CameraPrior:
        """The prior with the heading in it, where that is known by now."""
        _, outline_px = self._motion.locate(found, frame, time_ns)
        if self._motion.segments != self._segments:
            self._segments = self._motion.segments
            self._heading.lose()
        if not prior.knows_place:
            return prior
        heading = self._heading.add(time_ns / 1e9, outline_px, prior.position_m[:2])
        if not np.isfinite(heading.sigma_deg):
            return prior
        sigma_deg = np.array([*prior.attitude_sigma_deg[:2], heading.sigma_deg])
        rotation = site_from_gimbal_rotation(heading.heading_deg, -90.0, 0.0)
        return replace(prior, rotation=rotation, attitude_sigma_deg=sigma_deg)


class ImagePlaces:
    """Detections of a flight that nothing places, tracked in the first frame's pixels; after a cut all begins anew."""

    def __init__(self, setup: FlightSetup, sure_score: float, why_not: str) -> None:
        self._setup, self._why_not = setup, why_not
        self._settings = replace(IN_PICTURES, sure_score=sure_score)
        self._motion, self._tracker = ImageMotion(), Tracker(self._settings)
        self._segment, self._earlier = 1, list[Track]()
        self._site = Site(setup.source.name, setup.frame.origin, "", 1.0, is_local=True)

    @property
    def site(self) -> Site:
        """A frame without metres: pixels of the first picture of each segment."""
        return self._site

    def m_per_px(self, frame: Frame) -> float | None:
        """Unknown."""
        return None

    @property
    def set_aside(self) -> int:
        """None: without metres nothing is too short."""
        return 0

    def take(self, frame: Frame, time_ns: int, found: Detections) -> Taken:
        """Take the camera's motion out of a frame's detections and give them to their tracks."""
        sightings, outline = self._motion.locate(found, frame, time_ns)
        if self._motion.segments != self._segment:
            self._segment = self._motion.segments
            self._earlier += self._tracker.finish()
            self._tracker = Tracker(self._settings, first_id=self._tracker.next_id)
        update = self._tracker.update(sightings, time_ns=time_ns, footprint_m=outline)
        return replace(_taken(sightings, update), segment=self._segment)

    def tracks(self) -> Sequence[Track]:
        """All tracks as they are known now."""
        return [*self._earlier, *self._tracker.tracks()]

    def finish(self) -> Sequence[Track]:
        """All tracks when nothing more comes."""
        return [*self._earlier, *self._tracker.finish()]

    def notices(self) -> tuple[Notice, ...]:
        """Why nothing is placed on the ground."""
        text = f"{self._why_not}: nothing is placed on the ground, objects are followed in the picture"
        others = [each for each in self._setup.notices if each.code not in _OF_MAPS]
        if self._motion.guessed:
            words = f"frames that show no motion that fits, taken to go on as before: {self._motion.guessed}"
            others.append(Notice("motion_guessed", self._motion.guessed, words))
        if self._motion.segments > 1:
            cuts = self._motion.segments - 1
            times = "once" if cuts == 1 else f"{cuts} times"
            words = f"the picture changed all at once, {times}: objects are counted anew from there on"
            others.append(Notice("scene_cuts", cuts, words))
        return (*others, Notice("not_on_ground", 1, text))

    def path_m(self) -> Floats:
        """Nothing says where the camera was."""
        return np.zeros((0, 2))


def _why_not_on_ground(setup: FlightSetup) -> str | None:
    """What telemetry lacks for places on the ground; None where it has all that is needed."""
    track = setup.track
    if track is None:
        return "telemetry without a single fix" if len(setup.source.telemetry) else "no telemetry"
    if not np.isfinite(track.vertical_sigma_m):
        return "telemetry has no height"
    if not np.isfinite(track.altitude_offset_sigma_m):
        return f"heights are {track.height_words.split(',')[0]} and the ground's is unknown (give --ground-elevation)"
    return None


def _taken(sightings: Sequence[Sighting | None], update: TrackUpdate) -> Taken:
    ids = iter(update.track_ids)
    of_detections = [0 if each is None else next(ids) for each in sightings]
    return Taken(sightings, of_detections, frozenset(update.new), frozenset(update.merged))
