"""Where what a watch sees lies and which object it is: on the ground if telemetry allows it, else in the picture."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from statistics import median
from typing import Protocol

from sorvolo.capture.source import LiveSource
from sorvolo.detection.fusing import is_from_above
from sorvolo.geometry.arrays import Floats
from sorvolo.geometry.pose import Pose
from sorvolo.missions.flight.setup import FlightSetup, new_site
from sorvolo.survey.flight import CameraPrior, Frame, Notice, Site
from sorvolo.survey.mosaic import FrameView
from sorvolo.survey.objects import Detections, Track
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

_COMPASS_REPORTED_DEG = 2.0  # by which a compass is off: less is not worth a notice; by choice
_OF_MAPS = (
    "no_telemetry",
    "ground_unknown",
    "height_unknown",
)  # notices about what a mapping does about it


class Places(Protocol):
    """Detections placed and followed, frame by frame."""

    @property
    def site(self) -> Site:
        """What places are counted in; a local one's metres are pixels of a segment's first frame."""

    def m_per_px(self, frame: Frame) -> float | None:
        """The ground's sampling distance in the frame; None where unknown."""

    def is_from_above(self, frame: Frame) -> bool:
        """Whether the frame is a photo taken about straight down."""

    @property
    def set_aside(self) -> int:
        """Detections so far of a size that their class cannot have: they have a place, but are no such thing."""

    def view(self, frame: Frame) -> FrameView | None:
        """What ground the frame shows by telemetry; None where that is not known."""

    def take(
        self, frame: Frame, time_ns: int, found: Detections, located: Located | None = None
    ) -> Taken:
        """Place a frame's detections and give them to their tracks; `located` is where a killed run placed them."""

    def tracks(self) -> Sequence[Track]:
        """All tracks as they are known now."""

    def finish(self) -> Sequence[Track]:
        """All tracks when nothing more comes."""

    def notices(self) -> tuple[Notice, ...]:
        """How frames were placed, and what could not be."""

    def path_m(self) -> Floats:
        """(N, 2) where the camera was, in site metres; none where it is not known."""


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


class GroundPlaces:
    """Detections on the ground of a flight with telemetry, tracked in metres."""

    def __init__(
        self, setup: FlightSetup, settings: TrackerSettings, ground: GroundHeight | None
    ) -> None:
        self._setup, self._over_model = setup, ground is not None
        is_video = setup.source.kind != "photos"
        self._headings = None if is_video else PhotoHeadings(setup.source.camera.camera)
        self._taken: tuple[int, CameraPrior] | None = None  # the last frame taken, and its prior
        knows_heading = setup.track is None or setup.track.attitude != "none"
        self._follower = GroundFollower(
            setup.source.camera, settings, ground, knows_heading=knows_heading, is_video=is_video
        )
        self._site = new_site(setup, setup.source.name, 1.0, 0.0)
        if self._over_model:  # one height would stand for all objects
            self._site = replace(self._site, height_reference="above ground")

    @property
    def site(self) -> Site:
        """The flight's own frame of metres."""
        return self._site

    def m_per_px(self, frame: Frame) -> float | None:
        """Along the optical axis; None where the camera looks at the horizon or its height is not known."""
        return self._follower.m_per_px(self._prior(frame))

    def is_from_above(self, frame: Frame) -> bool:
        """By telemetry. A video shows the same ground in many frames, which need no second look."""
        return self._setup.source.kind == "photos" and is_from_above(self._prior(frame).rotation)

    @property
    def set_aside(self) -> int:
        """See `Places.set_aside`."""
        return self._follower.impossible_size

    def view(self, frame: Frame) -> FrameView | None:
        """What ground the frame shows, taken as level."""
        taken = self._taken
        prior = taken[1] if taken is not None and taken[0] == frame.index else self._prior(frame)
        pose = Pose(prior.rotation, prior.position_m) if prior.knows_place else None
        return self._setup.view(frame.time_ns, self._setup.source.camera.camera, pose)

    def take(
        self, frame: Frame, time_ns: int, found: Detections, located: Located | None = None
    ) -> Taken:
        """See `Places.take`."""
        if located is not None:
            return self._follower.recall(located)
        prior = self._prior(frame)
        if self._headings is not None:
            if self._taken is None and not isinstance(self._setup.source, LiveSource):
                self._see_next(frame, self._headings)
            prior = self._headings.take(frame.image, prior)
        self._taken = frame.index, prior
        return self._follower.take(frame, time_ns, found, prior)

    def tracks(self) -> Sequence[Track]:
        """All tracks as they are known now."""
        return self._follower.tracks()

    def finish(self) -> Sequence[Track]:
        """All tracks when nothing more comes."""
        return self._follower.finish()

    def notices(self) -> tuple[Notice, ...]:
        """How frames were placed, and what could not be."""
        track = self._setup.track
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
        return (
            *self._setup.notices,
            Notice("placed_by", 1, text),
            *self._heading_notices(),
            *self._compass_notices(),
            *(
                Notice(
                    "not_placed",
                    count,
                    f"{counted(count, 'detection')} without a place on the ground: {reason}",
                )
                for reason, count in self._follower.unlocated.most_common()
                if reason != IMPOSSIBLE_SIZE
            ),
            *self._size_notices(),
        )

    def path_m(self) -> Floats:
        """(N, 2) where the camera was."""
        return self._follower.path_m()

    def _see_next(self, first: Frame, headings: PhotoHeadings) -> None:
        """Hold the first photo's heading against the photo after it."""
        for frame in self._setup.source.frames(lambda index, _: index == first.index + 1):
            if isinstance(frame, Frame):
                headings.see(frame.image, self._prior(frame))
            return

    def _heading_notices(self) -> tuple[Notice, ...]:
        turns_deg = self._follower.turns_deg if self._headings is None else self._headings.turns_deg
        if not turns_deg:
            return ()
        shown_by = (
            "their motion shows" if self._headings is None else "the ground shows that photos share"
        )
        what = counted(len(turns_deg), "frame" if self._headings is None else "photo")
        text = f"headings about {median(map(abs, turns_deg)):.0f} degrees off, as {shown_by}: corrected in {what}"
        return (Notice("headings_wrong", len(turns_deg), text),)

    def _compass_notices(self) -> tuple[Notice, ...]:
        clockwise_deg = self._follower.compass_clockwise_deg
        if abs(clockwise_deg) <= _COMPASS_REPORTED_DEG:
            return ()
        side = "clockwise" if clockwise_deg > 0 else "counter-clockwise"
        off = f"the compass reads about {abs(clockwise_deg):.0f} degrees too far {side}: corrected by what stands"
        return (Notice("compass_off", 1, off),)

    def _size_notices(self) -> tuple[Notice, ...]:
        if not self.set_aside:
            return ()
        text = f"{counted(self.set_aside, 'detection')} left out: {IMPOSSIBLE_SIZE}"
        return (Notice("too_short", self.set_aside, text),)

    def _prior(self, frame: Frame) -> CameraPrior:
        prior, track = self._setup.prior(frame, first=False), self._setup.track
        if track is None:
            return prior
        return watched_prior(
            prior, track.altitude_offset_sigma_m, has_gimbal=track.attitude == "gimbal"
        )


class ImagePlaces:
    """Detections of a flight that nothing places, tracked in the first frame's pixels; after a cut all begins anew."""

    def __init__(self, setup: FlightSetup, settings: TrackerSettings, why_not: str) -> None:
        self._setup, self._why_not = setup, why_not
        self._follower = PictureFollower(settings)
        self._site = Site(setup.source.name, setup.frame.origin, "", 1.0, is_local=True)

    @property
    def site(self) -> Site:
        """A frame without metres: pixels of the first picture of each segment."""
        return self._site

    def m_per_px(self, frame: Frame) -> float | None:
        """Unknown."""
        return None

    def is_from_above(self, frame: Frame) -> bool:
        """Unknown, so that it is searched as it is."""
        return False

    @property
    def set_aside(self) -> int:
        """Those beside the scene's cars; none where too few cars show its scale."""
        return self._follower.impossible_size

    def view(self, frame: Frame) -> FrameView | None:
        """Nothing is known of the ground."""
        return None

    def take(
        self, frame: Frame, time_ns: int, found: Detections, located: Located | None = None
    ) -> Taken:
        """Take the camera's motion out of a frame's detections and give them to their tracks."""
        if located is not None:
            return self._follower.recall(located, found, frame.image.shape[:2])
        return self._follower.take(frame, time_ns, found)

    def tracks(self) -> Sequence[Track]:
        """All tracks as they are known now."""
        return self._follower.tracks()

    def finish(self) -> Sequence[Track]:
        """All tracks when nothing more comes."""
        return self._follower.finish()

    def notices(self) -> tuple[Notice, ...]:
        """Why nothing is placed on the ground."""
        text = f"{self._why_not}: no object is placed on the ground, objects are followed in the picture"
        others = [each for each in self._setup.notices if each.code not in _OF_MAPS]
        guessed, cuts = self._follower.guessed, self._follower.segment - 1
        if guessed:
            words = f"{counted(guessed, 'frame')} without a motion that fits: the last motion was continued"
            others.append(Notice("motion_guessed", guessed, words))
        if self.set_aside:
            words = f"{counted(self.set_aside, 'detection')} left out: {IMPOSSIBLE_SIZE}, beside the scene's cars"
            others.append(Notice("too_short", self.set_aside, words))
        if cuts:
            words = f"the picture changed all at once {counted(cuts, 'time')}: objects are counted anew after each cut"
            others.append(Notice("scene_cuts", cuts, words))
        return (*others, Notice("not_on_ground", 1, text))

    def path_m(self) -> Floats:
        """Nothing is known of where the camera was."""
        return self._follower.path_m()


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
    return None
