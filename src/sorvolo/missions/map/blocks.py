"""A block of a divided flight, mapped apart: its photos, registered with those around them, noted for the joining."""

import hashlib
import shutil
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass
from heapq import merge
from pathlib import Path

import sorvolo
from sorvolo.capture.photos import PhotoSource
from sorvolo.capture.source import Source, opened_sources
from sorvolo.errors import SettingsError
from sorvolo.geometry.arrays import PointsM
from sorvolo.geometry.level_ground import footprint
from sorvolo.geometry.pose import Pose
from sorvolo.missions.flight.frames_ahead import read_ahead
from sorvolo.missions.flight.map_objects import FrameDetections, ObjectFinder, open_detector
from sorvolo.missions.flight.memory import memory_budget_bytes
from sorvolo.missions.flight.sample_frames import refuse_without_texture
from sorvolo.missions.flight.settings import MapSettings
from sorvolo.missions.flight.setup import FlightSetup, prepare
from sorvolo.missions.map.journal import MapJournal, Step, StoredPicture, Taken
from sorvolo.missions.map.planar_run import HORIZON
from sorvolo.mosaic.division import Block, divide
from sorvolo.mosaic.graph_settings import PoseGraphSettings
from sorvolo.mosaic.keyframes import Keyframes
from sorvolo.mosaic.placing import sees_horizon
from sorvolo.mosaic.planar import PlanarMapper
from sorvolo.mosaic.selection import Selected, SelectionSettings, select_keyframes
from sorvolo.registration.lens import Undistorter
from sorvolo.store.atomic import atomic_write_bytes
from sorvolo.store.images import jpeg_from_image
from sorvolo.store.site.journal import RunJournal, content_sha256
from sorvolo.store.site.spill import SpillFile
from sorvolo.survey.flight import LostFrame, PosedFrame

LEAST_PHOTOS = 8
"""Of a block: with fewer its margin is larger than itself."""


@dataclass(frozen=True)
class Division:
    """A flight divided into `count` blocks, whose files lie in `folder`; `key` is what is asked for of it."""

    folder: Path
    key: str
    count: int

    def is_done(self, number: int) -> bool:
        """Whether the block of this number is whole."""
        try:
            return self._done(number).read_text() == self.key_of(number)
        except OSError:
            return False

    def note_done(self, number: int) -> None:
        """Note that the block is whole."""
        atomic_write_bytes(self._done(number), self.key_of(number).encode())

    def journal(self, number: int) -> MapJournal:
        """What a block notes of its photos, in the flight's order."""
        path = self.folder / f"block-{number:04d}.journal"
        return MapJournal(RunJournal(path, self.key_of(number), 0, sorvolo.__version__))

    def picture(self, index: int) -> Path:
        """The file of a photo as the map needs it: undistorted, JPEG."""
        return self.folder / "pictures" / f"{index:06d}.jpg"

    def earlier(self) -> Iterator[Step | FrameDetections]:
        """What all blocks noted, steps in the flight's order."""
        return merge(*(self.journal(each).earlier() for each in range(self.count)), key=lambda each: each.index)

    def remove(self) -> None:
        """Remove all files of the blocks."""
        shutil.rmtree(self.folder, ignore_errors=True)

    def key_of(self, number: int) -> str:
        """The same for the same block only."""
        return content_sha256(self.key, self.count, number)

    def _done(self, number: int) -> Path:
        return self.folder / f"block-{number:04d}.done"


def map_block(
    source: Path, camera: Path | str | None, settings: MapSettings, division: Division, number: int,
    alive: Callable[[], None] = lambda: None,
) -> int:
    """Register the photos of one block, noted in the division's folder; how many they are.

    Nothing else is written: no site is needed. Raises InputError or SettingsError for a flight that cannot be divided,
    StoreError when the disk is full.
    """
    with opened_sources([source], None, camera) as sources:
        setup = prepare_divided(sources[0], settings)
        if number == 0:
            refuse_without_texture(sources[0])
        block = divide(_outlines(setup), division.count)[number]
        division.picture(0).parent.mkdir(parents=True, exist_ok=True)
        detector = open_detector(settings.model)
        finder = None if detector is None else ObjectFinder(detector, setup.source.camera.camera, settings.classes)
        spill = SpillFile(division.folder)
        run = _BlockRun(setup, settings, division, number, block, finder, spill)
        try:
            for each in _selected(setup, settings, block):
                run.take(each)
                alive()
            run.end()
        finally:
            spill.close()
            run.close()
    return len(block.home)


def prepare_divided(source: Source, settings: MapSettings) -> FlightSetup:
    """A flight that is to be divided, laid as the first of its site. Raises SettingsError where it cannot be."""
    if not isinstance(source, PhotoSource):
        raise SettingsError(
            f"{source.name} is a video: which of its frames are mapped depends on those before, so it is not divided "
            "into blocks; run the batch again without --blocks: what is mapped stays, the video is mapped whole"
        )
    if not source.telemetry.has_fixes:
        raise SettingsError(
            f"the photos of {source.name} have no GPS, by which they would be divided into blocks; leave --blocks out"
        )
    return prepare(source, settings, None, telemetry_named=False)


def most_blocks(source: Source) -> int:
    """Into how many blocks a flight is divided at most."""
    return max(1, source.frame_count // LEAST_PHOTOS)


class _BlockRun:
    """One block on its way through the photos."""

    def __init__(
        self, setup: FlightSetup, settings: MapSettings, division: Division, number: int, block: Block,
        finder: ObjectFinder | None, spill: SpillFile,
    ) -> None:
        self._setup, self._division, self._number, self._block, self._finder = setup, division, number, block, finder
        self._journal = division.journal(number)
        self._journal.file.remove()
        self._journal = division.journal(number)
        model = setup.source.camera
        self._lens = Undistorter(model.camera)
        offset_sigma_m = None if setup.track is None else setup.track.altitude_offset_sigma_m
        self._mapper = PlanarMapper(
            PoseGraphSettings.of_flight(model.focal_sigma, offset_sigma_m, joins_map=False),
            keyframes=Keyframes(spill, memory_budget_bytes(settings.memory_mb) // 4),
        )

    def take(self, each: Selected | LostFrame) -> None:
        """Register the next photo; one of the block itself is noted, with its picture."""
        frame = each if isinstance(each, LostFrame) else each.posed.frame
        is_home = frame.index in self._block.home
        taken, reason = None, each.reason
        if isinstance(each, Selected) and not reason:
            if is_home and self._finder is not None:
                self._finder.look(each.posed)
            taken, reason = self._registered(each.posed, is_home=is_home)
        if not is_home:
            return
        memory = each.memory if isinstance(each, Selected) else None
        is_searched = self._finder is not None and isinstance(each, Selected) and not each.reason
        self._journal.keep(Step(frame.index, frame.name, frame.time_ns, reason, memory, taken, is_searched))
        self._keep_detections(waits=False)

    def end(self) -> None:
        """The last photo was taken: the block is whole."""
        self._keep_detections(waits=True)
        self._journal.file.close()
        self._division.note_done(self._number)

    def close(self) -> None:
        """Let go of the files, and end the detector's thread."""
        self._journal.file.close()
        if self._finder is not None:
            self._finder.close()

    def _registered(self, posed: PosedFrame, *, is_home: bool) -> tuple[Taken | None, str]:
        frame = posed.frame
        if sees_horizon(self._setup.source.camera.camera, posed.prior):
            return None, HORIZON
        image = self._lens.undistort(frame.image)
        registered = self._mapper.register(frame.index, self._lens.camera, image, posed.prior)
        self._mapper.place(registered)
        if not is_home:
            return None, ""
        data = jpeg_from_image(image)
        atomic_write_bytes(self._division.picture(frame.index), data, durable=False)
        size_px = image.shape[1], image.shape[0]
        return Taken(registered, StoredPicture(size_px, hashlib.sha256(data).hexdigest())), ""

    def _keep_detections(self, *, waits: bool) -> None:
        if self._finder is not None:
            for seen in self._finder.news(waits=waits):
                self._journal.keep_detections(seen)


def _outlines(setup: FlightSetup) -> list[PointsM]:
    """Where telemetry has each photo's outline on the ground, (4, 2) site metres; NaN beyond the horizon."""
    source, track = setup.source, setup.track
    assert isinstance(source, PhotoSource) and track is not None
    priors = [
        track.prior(setup.seconds(each.time_ns), smooth_s=setup.plan.smooth_s) for each in source.album.photos
    ]
    return [footprint(source.camera.camera, Pose(each.rotation, each.position_m)) for each in priors]


def _selected(setup: FlightSetup, settings: MapSettings, block: Block) -> Iterator[Selected | LostFrame]:
    """The photos of a block and around it, in the flight's order."""
    wanted = block.home | block.margin

    def posed() -> Iterator[PosedFrame | LostFrame]:
        with closing(read_ahead(setup.source.frames(lambda index, _: index in wanted), 1)) as frames:
            for each in frames:
                if isinstance(each, LostFrame):
                    yield each
                else:
                    yield PosedFrame(each, setup.prior(each, first=each.index == 0))

    selection = SelectionSettings(overlap=settings.overlap, least_overlap=min(0.5, settings.overlap))
    return select_keyframes(posed(), selection, keep_all=True, inside=setup.inside(None))
