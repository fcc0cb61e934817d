"""A block of a divided flight, mapped apart: its pictures, registered with those around them, noted for the joining."""

import hashlib
import shutil
from collections.abc import Callable, Iterator, Sequence, Set
from contextlib import closing
from dataclasses import dataclass
from heapq import merge
from pathlib import Path

import sorvolo
from sorvolo.capture.photos import PhotoSource
from sorvolo.capture.source import Source, opened_sources
from sorvolo.capture.video import VideoSource
from sorvolo.errors import SettingsError, StoreError
from sorvolo.geometry.arrays import PointsM
from sorvolo.geometry.level_ground import footprint
from sorvolo.geometry.pose import Pose
from sorvolo.missions.flight.frames_ahead import read_ahead
from sorvolo.missions.flight.map_objects import FrameDetections, ObjectFinder, open_detector
from sorvolo.missions.flight.memory import memory_budget_bytes
from sorvolo.missions.flight.sample_frames import refuse_without_texture
from sorvolo.missions.flight.settings import MapSettings
from sorvolo.missions.flight.setup import FlightSetup, prepare
from sorvolo.missions.map.chosen_frames import ChosenFrames, choose_frames, frames_again
from sorvolo.missions.map.journal import MapJournal, Step, StoredPicture, Taken
from sorvolo.missions.map.planar_run import HORIZON
from sorvolo.mosaic.division import Block, divide
from sorvolo.mosaic.graph_settings import PoseGraphSettings
from sorvolo.mosaic.placing import sees_horizon
from sorvolo.mosaic.planar import PlanarMapper
from sorvolo.mosaic.selection import Selected, SelectionSettings, select_keyframes
from sorvolo.registration.lens import Undistorter
from sorvolo.store.atomic import atomic_write_bytes
from sorvolo.store.images import jpeg_from_image
from sorvolo.store.site.journal import RunJournal, content_sha256
from sorvolo.store.site.spill import SpillFile
from sorvolo.survey.flight import LostFrame, PosedFrame

LEAST_PICTURES = 8
"""Of a block: with fewer its margin is larger than itself."""


@dataclass(frozen=True)
class Division:
    """A flight divided into `count` blocks, whose files lie in `folder`; `key` is what is asked for of it.

    Of a video (`is_video`) the frames that its map is made of are chosen before.
    """

    folder: Path
    key: str
    count: int
    is_video: bool = False

    def chosen(self) -> ChosenFrames | None:
        """The chosen frames of a video; None before they are chosen."""
        return ChosenFrames.at(*self._chosen)

    def keep_chosen(self, frames: ChosenFrames) -> None:
        """Note the chosen frames of a video."""
        frames.write(*self._chosen)

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
        """What a block notes of its pictures, in the flight's order."""
        path = self.folder / f"block-{number:04d}.journal"
        return MapJournal(RunJournal(path, self.key_of(number), 0, sorvolo.__version__))

    def picture(self, index: int) -> Path:
        """The file of a picture as the map needs it: undistorted, JPEG."""
        return self.folder / "pictures" / f"{index:06d}.jpg"

    def earlier(self) -> Iterator[Step | FrameDetections]:
        """What all blocks noted, steps in the flight's order."""
        return merge(
            *(self.journal(each).earlier() for each in range(self.count)),
            key=lambda each: each.index,
        )

    def remove(self) -> None:
        """Remove all files of the blocks."""
        shutil.rmtree(self.folder, ignore_errors=True)

    def key_of(self, number: int) -> str:
        """The same for the same block only."""
        return content_sha256(self.key, self.count, number)

    @property
    def _chosen(self) -> tuple[Path, str]:
        """The file of the chosen frames, and its key: the same for any number of blocks."""
        return self.folder / "chosen.json", content_sha256(self.key)

    def _done(self, number: int) -> Path:
        return self.folder / f"block-{number:04d}.done"


def map_block(
    source: Path,
    camera: Path | str | None,
    settings: MapSettings,
    division: Division,
    number: int,
    alive: Callable[[], None] = lambda: None,
) -> int:
    """Register the pictures of one block, noted in the division's folder; how many they are.

    Nothing else is written: no site is needed. Raises InputError or SettingsError for a flight that cannot be divided,
    StoreError when the disk is full or where the frames of a video are not chosen.
    """
    with opened_sources([source], None, camera) as sources:
        setup = prepare_divided(sources[0], settings)
        if number == 0 and not isinstance(sources[0], VideoSource):
            refuse_without_texture(sources[0])
        pictures = _Pictures.of(setup, division)
        block = pictures.block(division.count, number)
        division.picture(0).parent.mkdir(parents=True, exist_ok=True)
        detector = open_detector(settings.model)
        finder = (
            None
            if detector is None
            else ObjectFinder(detector, setup.source.camera.camera, settings.classes)
        )
        spill = SpillFile(division.folder)
        run = _BlockRun(setup, settings, division, number, block, finder, spill)
        try:
            for each in pictures.selected(settings, block):
                run.take(each)
                alive()
            run.end()
        finally:
            spill.close()
            run.close()
    return len(block.home)


def choose_of_video(
    source: Path,
    camera: Path | str | None,
    settings: MapSettings,
    division: Division,
    alive: Callable[[], None] = lambda: None,
) -> None:
    """Choose the frames of a video that its map is made of, noted in the division's folder: what its blocks begin with.

    Raises as `map_block` does.
    """
    with opened_sources([source], None, camera) as sources:
        setup = prepare_divided(sources[0], settings)
        refuse_without_texture(sources[0])
        division.keep_chosen(choose_frames(setup, settings, alive))


def prepare_divided(source: Source, settings: MapSettings) -> FlightSetup:
    """A flight that is to be divided, laid as the first of its site. Raises SettingsError where it cannot be."""
    if not source.telemetry.has_fixes:
        pictures = (
            f"the photos of {source.name} have"
            if source.kind == "photos"
            else f"the video {source.name} has"
        )
        raise SettingsError(
            f"{pictures} no GPS, by which flights are divided into blocks; leave --blocks out"
        )
    return prepare(source, settings, None, telemetry_named=False)


def most_blocks(setup: FlightSetup) -> int:
    """Into how many blocks a flight is divided at most."""
    return max(1, setup.plan.expected // LEAST_PICTURES)


class _BlockRun:
    """One block on its way through its pictures."""

    def __init__(
        self,
        setup: FlightSetup,
        settings: MapSettings,
        division: Division,
        number: int,
        block: Block,
        finder: ObjectFinder | None,
        spill: SpillFile,
    ) -> None:
        self._setup, self._division, self._number, self._block, self._finder = (
            setup,
            division,
            number,
            block,
            finder,
        )
        self._journal = division.journal(number)
        self._journal.file.remove()
        self._journal = division.journal(number)
        model = setup.source.camera
        self._lens = Undistorter(model.camera)
        offset_sigma_m = None if setup.track is None else setup.track.altitude_offset_sigma_m
        self._mapper = PlanarMapper(
            PoseGraphSettings.of_flight(model.focal_sigma, offset_sigma_m, joins_map=False),
            shelf=spill,
            keyframe_bytes=memory_budget_bytes(settings.memory_mb) // 4,
        )

    def take(self, each: Selected | LostFrame) -> None:
        """Register the next picture; one of the block itself is noted, and stored."""
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
        self._journal.keep(
            Step(frame.index, frame.name, frame.time_ns, reason, memory, taken, is_searched)
        )
        self._keep_detections(waits=False)

    def end(self) -> None:
        """The last picture was taken: the block is whole."""
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


@dataclass(frozen=True, eq=False)
class _Pictures:
    """The pictures of a flight that is divided, by their numbers and times; `chosen` are those of a video."""

    setup: FlightSetup
    numbers: Sequence[int]
    times_ns: Sequence[int]
    chosen: ChosenFrames | None

    @classmethod
    def of(cls, setup: FlightSetup, division: Division) -> "_Pictures":
        """Those of a folder of photos, or those that were chosen of a video."""
        source = setup.source
        if isinstance(source, PhotoSource):
            return cls(
                setup,
                range(source.frame_count),
                [each.time_ns for each in source.album.photos],
                None,
            )
        if (chosen := division.chosen()) is None:
            raise StoreError(
                f"the frames of {source.name} are not chosen yet; give the same command again"
            )
        return cls(
            setup,
            [each.index for each in chosen.frames],
            [each.time_ns for each in chosen.frames],
            chosen,
        )

    def block(self, count: int, number: int) -> Block:
        """One of `count` blocks of them; empty where so few pictures make fewer blocks."""
        blocks = divide(self._outlines(), count)
        if number >= len(blocks):
            return Block(frozenset(), frozenset())
        home, margin = (
            frozenset(self.numbers[each] for each in part)
            for part in (blocks[number].home, blocks[number].margin)
        )
        return Block(home, margin)

    def selected(self, settings: MapSettings, block: Block) -> Iterator[Selected | LostFrame]:
        """The pictures of a block and around it, in the flight's order."""
        wanted = block.home | block.margin
        if self.chosen is None:
            return _photos(self.setup, settings, wanted)
        return frames_again(
            self.setup, [each for each in self.chosen.frames if each.index in wanted]
        )

    def _outlines(self) -> list[PointsM]:
        """Where telemetry has each picture's outline on the ground, (4, 2) site metres; NaN beyond the horizon."""
        setup = self.setup
        assert setup.track is not None
        priors = [
            setup.track.prior(setup.seconds(each), smooth_s=setup.plan.smooth_s)
            for each in self.times_ns
        ]
        return [
            footprint(setup.source.camera.camera, Pose(each.rotation, each.position_m))
            for each in priors
        ]


def _photos(
    setup: FlightSetup, settings: MapSettings, wanted: Set[int]
) -> Iterator[Selected | LostFrame]:
    """The photos of these numbers, in the flight's order."""

    def posed() -> Iterator[PosedFrame | LostFrame]:
        with closing(
            read_ahead(setup.source.frames(lambda index, _: index in wanted), 1)
        ) as frames:
            for each in frames:
                if isinstance(each, LostFrame):
                    yield each
                else:
                    yield PosedFrame(each, setup.prior(each, first=each.index == 0))

    selection = SelectionSettings(
        overlap=settings.overlap, least_overlap=min(0.5, settings.overlap)
    )
    return select_keyframes(posed(), selection, keep_all=True, inside=setup.inside(None))
