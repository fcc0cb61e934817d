"""Photos that are not found on the map by themselves, placed there with all others of their flight."""

from collections.abc import Mapping
from typing import Self

from sorvolo.change.alignment import FlightPlace
from sorvolo.change.flight_on_map import FlightFit, FlightOnMap, PhotoFeatures
from sorvolo.change.views import ViewMaker
from sorvolo.geometry.pose import Pose
from sorvolo.missions.flight.setup import FlightSetup
from sorvolo.mosaic.graph_settings import PoseGraphSettings
from sorvolo.mosaic.placing import sees_horizon
from sorvolo.mosaic.planar import PlanarMapper
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.spill import SpillFile
from sorvolo.survey.flight import PosedFrame
from sorvolo.survey.mosaic import Status

# When a recorded flight is looked for as a whole, and by which of its frames; by choice, none
# measured alone.
OVERLAP = 0.8  # of a video's frames that are laid on each other, as a first flight's are
# share of these that is not found by itself, from which on the whole flight is looked for
MANY = 0.3
_MOST_SOUGHT = 150  # photos that are looked for on the map, evenly spread over the flight


class WholeFlight:
    """A flight's photos laid on each other, as a first flight's are; `places` finds them on the map as one.

    A context manager: leaving it removes the file beside the site in which photos wait.
    """

    def __init__(
        self,
        setup: FlightSetup,
        archive: Archive,
        views: ViewMaker,
        on_map: FlightOnMap,
        count: int,
    ) -> None:
        """`count` photos will be added."""
        model, track = setup.source.camera, setup.track
        self._views, self._on_map = views, on_map
        self._spill = SpillFile(archive.folder)
        offset_sigma_m = None if track is None else track.altitude_offset_sigma_m
        graph = PoseGraphSettings.of_flight(model.focal_sigma, offset_sigma_m, joins_map=False)
        self._mapper = PlanarMapper(graph, shelf=self._spill)
        self._step, self._added = max(1, -(-count // _MOST_SOUGHT)), 0
        self._sought: dict[int, PhotoFeatures] = {}
        self.fit: FlightFit | None = None
        """Where the flight lies on the map, once `places` found it."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._spill.close()

    def add(self, posed: PosedFrame) -> None:
        """Lay the next photo on those before it."""
        index, camera = posed.frame.index, self._views.undistorted_camera
        if sees_horizon(camera, posed.prior):
            return
        image = self._views.undistorted(posed)
        outcome = self._mapper.add(index, camera, image, posed.prior)
        if outcome.status is not Status.REJECTED and self._added % self._step == 0:
            self._sought[index] = self._on_map.features(image, camera)
        self._added += 1

    def sought(self) -> tuple[Mapping[int, PhotoFeatures], Mapping[int, Pose]]:
        """The photos that are looked for on the map, and where the cameras of all that others of the flight overlap
        are beside each other; by index."""
        self._mapper.settle()
        tied = [
            each for each in self._mapper.placed() if self._mapper.ending(each)[0] is Status.VISION
        ]
        poses = {each: self._mapper.pose(each) for each in tied}
        return {index: photo for index, photo in self._sought.items() if index in poses}, poses

    def places(self) -> Mapping[int, FlightPlace]:
        """Where the photos lie that others of the flight overlap, by index: none where it is not found on the map."""
        photos, poses = self.sought()
        fit = self.fit = self._on_map.find(photos, poses)
        if fit is None:
            return {}
        camera = self._views.undistorted_camera
        return {
            each: FlightPlace(
                fit.map_from_flight @ self._mapper.site_from_image(each, camera), fit.residual_m
            )
            for each in poses
            if each not in fit.elsewhere
        }
