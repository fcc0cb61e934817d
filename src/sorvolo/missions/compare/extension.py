"""A later flight's frames over new ground: they go on to be mapped, as a first flight's would."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

from sorvolo.change.map_update import grown_m2
from sorvolo.change.views import ViewMaker, ViewOutcome
from sorvolo.missions.flight.result_cache import ResultCache
from sorvolo.missions.flight.settings import CompareSettings
from sorvolo.missions.flight.setup import FlightSetup
from sorvolo.missions.map.ground import MapGround
from sorvolo.missions.map.planar_run import PlanarRun
from sorvolo.mosaic.selection import StretchSelection
from sorvolo.store.site.archive import Archive, FlightWriter
from sorvolo.survey.findings import ViewStatus
from sorvolo.survey.flight import PosedFrame
from sorvolo.survey.mosaic import PlacedFrame, Status

NIGHT = 0.25
"""Times the map's brightness: less hides most changes (at 0.22, 3 of 14 were found), and would paint new ground
black."""

_NEW_GROUND = 0.05  # share of a frame beyond the map: with less it is not worth a place in it
_OVERLAP = 0.7  # of consecutive frames, as a first flight's map is made with


class MapExtension:
    """The part of a comparison that extends the map: `add` takes frames as they come, `complete` places them."""

    def __init__(
        self,
        setup: FlightSetup,
        archive: Archive,
        settings: CompareSettings,
        writer: FlightWriter,
        views: ViewMaker,
        memo: ResultCache,
    ) -> None:
        self._memo = memo
        self._setup, self._archive, self._settings, self._writer = setup, archive, settings, writer
        self._views = views
        self._selection = StretchSelection(_OVERLAP, keep_all=setup.source.kind != "video")
        self._run: PlanarRun | None = None
        self._last = -1
        self._shown_by: dict[
            int, int
        ] = {}  # frames that show new ground as another, which extends the map, shows it
        self._frames: tuple[PlacedFrame, ...] = ()

    @property
    def images(self) -> Mapping[int, str]:
        """Where the pictures of the frames that extend the map are stored, by frame index."""
        return {} if self._run is None else self._run.images

    @property
    def frames(self) -> Sequence[PlacedFrame]:
        """The frames that extend the map, once that is complete."""
        return self._frames

    def add(self, posed: PosedFrame, outcome: ViewOutcome) -> None:
        """Take a frame that shows new ground; those that do not, or that show what the last one did, are left."""
        if not self._is_wanted(posed, outcome):
            return
        if not self._selection.take(self._views.pixels.ground_m(posed, outcome.site_from_image)):
            self._shown_by[posed.frame.index] = self._last
            return
        self._last = posed.frame.index
        if self._run is None:
            self._run = PlanarRun(
                self._setup,
                self._archive,
                replace(self._settings.mapping, heights=self._views.surface is not None),
                writer=self._writer,
                memo=self._memo,
            )
        self._run.add(self._views.turned_as_found(posed, outcome))
        if outcome.site_from_image is not None:
            self._run.note_found(posed.frame.index, outcome.site_from_image, outcome.residual_px)

    def _is_wanted(self, posed: PosedFrame, outcome: ViewOutcome) -> bool:
        """Whether a frame shows new ground, in a light that the map may have."""
        is_new = outcome.view is not None and outcome.known < 1 - _NEW_GROUND
        if not (is_new or outcome.status is ViewStatus.OUTSIDE):
            return False
        if not self._settings.updates_map or self._setup.track is None:
            return False
        return self._views.brightness_beside_map(posed, outcome) >= NIGHT

    def complete(self, placed: Mapping[int, PlacedFrame]) -> Sequence[PlacedFrame]:
        """Place the frames for good and paint them; those that extend the map. `placed` are all as they were compared:
        over a map with heights their cameras stand in space, and hold these there."""
        if self._run is not None and self._settings.updates_map:
            stands = {
                each.name: (each.camera, each.site_from_camera)
                for each in placed.values()
                if each.site_from_camera is not None
            }
            frames = self._run.complete(MapGround(self._views.surface, stands))
            self._frames = tuple(each for each in frames if each.status is not Status.REJECTED)
        return self._frames

    def shown_as_well(self, placed: Mapping[int, PlacedFrame]) -> list[int]:
        """Rejected frames, by index, whose ground a frame that extends the map shows: not needed there, they are no
        selected frames, as in a first flight."""
        extend = {each.index for each in self._frames}
        return [
            index
            for index, by in self._shown_by.items()
            if by in extend and placed[index].status is Status.REJECTED
        ]

    def grown_m2(self, base_version: int) -> float:
        """Ground under the frames that the map shows now and did not show in that version."""
        return grown_m2(
            (each.outline_m for each in self._frames),
            self._archive.tiles(base_version),
            self._writer.tiles,
            self._archive.site_grid(),
        )
