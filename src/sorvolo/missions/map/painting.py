"""A flight's keyframes painted into the site's map: coarsely while they still move, and once when they stand."""

import time
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from sorvolo.geometry.arrays import ImageRGB, ImageRGBA, Mask, Matrix3
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.grid import SiteGrid, TileIndex
from sorvolo.geometry.homography import pose_from_homography
from sorvolo.missions.flight.log import Ending, FlightLog, Stage
from sorvolo.missions.flight.result_cache import ResultCache
from sorvolo.mosaic.canvas import Canvas, CoarseTiles, coarse_grid, coarseness
from sorvolo.mosaic.canvas_frame import CanvasFrame
from sorvolo.mosaic.exposure import Exposure
from sorvolo.mosaic.placing import canvas_frame
from sorvolo.mosaic.planar import KnownKeyframe
from sorvolo.registration.lens import Undistorter, at_size
from sorvolo.store.exports.map_pictures import LivePreview
from sorvolo.store.images import ImageCache
from sorvolo.store.site.archive import Archive, FlightWriter
from sorvolo.store.site.catalogue import StoredKeyframe

REST = 4.0
"""Times as long as a painting took until the next one: showing a map that still moves must not hold up the flight."""

_EVERY = 8  # keyframes painted together: tiles that several touch are rendered once
_AT_ONCE = 24  # keyframes at most, the newest first: a solve may move a hundred
_AT_ONCE_LIVE = 3  # keyframes besides the newest while somebody waits for that
_COARSE_MAP = 0.77  # of the pictures' own pixels: a coarser map does not need every pixel of them
_CACHE_BYTES = 128 << 20  # of earlier flights' pictures; an eighth of it of the flight's own, small


@dataclass(frozen=True)
class StoredPicture:
    """A keyframe's picture in the site: its size (width, height) and its SHA-256."""

    size_px: tuple[int, int]
    sha256: str


class PlacedPictures(Protocol):
    """What knows where a flight's pictures lie, and how bright they are, by keyframe."""

    @property
    def radial(self) -> float:
        """Left-over radial distortion (see `PoseGraph.radial`)."""

    def site_from_image(self, keyframe_id: int, camera: Camera) -> Matrix3:
        """(3, 3) of an undistorted image of the size that `camera` has."""

    def exposure(self) -> Exposure:
        """Gains and vignette of all keyframes."""

    def recent_exposure(self) -> Exposure:
        """The same of the newest keyframes, while the flight goes on."""

    def release(self) -> None:
        """Put what is not needed for painting out of memory."""


class KnownKeyframes:
    """The keyframes of a site when a flight is mapped; their place in the list is their id.

    A flight's own ones of an earlier run are superseded; where that run made the newest map, its tiles are taken out
    anyway, and its keyframes are left out.
    """

    def __init__(self, archive: Archive, flight: str) -> None:
        self._archive = archive
        self.stored: list[StoredKeyframe] = []
        self._ranks: list[int] = []
        if archive.has_site:
            newest = next(reversed(archive.versions()), None)
            left_out = flight if newest is not None and newest.flight_id == flight else None
            self.stored = [each for each in archive.sound_keyframes() if each.flight_id != left_out]
            rank_of = {each.id: each.rank for each in archive.flights()}
            self._ranks = [rank_of[each.flight_id] for each in self.stored]
        self.superseded = [
            number for number, each in enumerate(self.stored) if each.flight_id == flight
        ]
        self.next_rank = 1 + max(self._ranks, default=-1)

    def __len__(self) -> int:
        return len(self.stored)

    def image(self, number: int) -> ImageRGB:
        return self._archive.image(self.stored[number])

    def for_graph(self) -> list[KnownKeyframe]:
        """Return them as the pose graph ties new ones to them."""
        return [self._for_graph(number) for number in range(len(self.stored))]

    def _for_graph(self, number: int) -> KnownKeyframe:
        stored = self.stored[number]
        # another method than planar may know a similarity only: of a camera looking straight down
        pose = stored.site_from_camera or pose_from_homography(
            stored.site_from_image, stored.camera
        )
        assert pose is not None
        return KnownKeyframe(
            number, stored.camera, pose, stored.sigma_m, lambda: self.image(number)
        )

    def canvas_frames(self, site_grid: SiteGrid) -> list[CanvasFrame]:
        """Return them as they were painted."""
        frames = [
            canvas_frame(
                number,
                self._ranks[number],
                stored.camera,
                stored.site_from_image,
                site_grid,
                stored.gains,
                stored.vignette,
                None,
            )
            for number, stored in enumerate(self.stored)
        ]
        return [frame for frame in frames if frame is not None]


class _CoarseMap:
    """The map while it grows: small copies of its pictures, enlarged. Cheap, however often the map moves."""

    def __init__(
        self, writer: FlightWriter, archive: Archive, stored: Camera, first_id: int, live_s: float
    ) -> None:
        self._writer, self._preview_path = writer, archive.live_preview_path
        self.step = step = coarseness(max(stored.width_px, stored.height_px))
        self.site_grid = coarse_grid(archive.site_grid(), step)
        self.camera = stored.resized(-(-stored.width_px // step), -(-stored.height_px // step))
        self._images = ImageCache(
            lambda each: writer.small_image(each - first_id, step), _CACHE_BYTES // 8
        )
        self._tiles = CoarseTiles(writer.tiles, archive.site_grid().grid, step)
        grid = self.site_grid.grid
        self.canvas = Canvas(grid, self._tiles, self._images.get, keeps_known_ground=True)
        self._preview = LivePreview(grid.tile_px)
        self.unshown: set[TileIndex] = set()
        self._live_s, self._again_s = live_s, time.monotonic() + live_s

    def save(self) -> None:
        """Let readers see what was painted."""
        self._tiles.save()
        self._writer.flush()

    def show(self) -> None:
        """Let readers see what was painted, and the whole map small; the larger the map, the less often."""
        started_s = time.monotonic()
        if started_s < self._again_s:
            return
        self.save()
        self._preview.write(self._tiles, self.unshown, self._preview_path)
        self.unshown.clear()
        self._again_s = time.monotonic() + max(self._live_s, REST * (time.monotonic() - started_s))

    def release(self) -> None:
        self._images.clear()
        self._tiles.release()


class FlightPainter:
    """Stores a flight's pictures and paints them into its site; ground that the map shows already stays as it is.

    While the flight goes on, `show` paints small copies of them; of a live flight (`is_live`) the newest at once, for
    somebody waits for it. `finish` paints the pictures themselves.

    `native_m_per_px` is the ground sampling distance of the flight's own pictures. Keyframes have ids from
    `len(known)` on, earlier flights' those before.
    """

    def __init__(
        self,
        writer: FlightWriter,
        archive: Archive,
        mapper: PlacedPictures,
        lens: Undistorter,
        known: KnownKeyframes,
        native_m_per_px: float,
        log: FlightLog,
        live_s: float,
        memo: ResultCache,
        *,
        is_live: bool,
    ) -> None:
        self._writer, self._archive, self._mapper = writer, archive, mapper
        self._known, self._log, self._memo = known, log, memo
        self._paint_every = _EVERY if live_s >= 1 else 1
        self._is_live = is_live
        self.shown_s = 0.0
        """When readers could see the newest key frame of a live flight, by the monotonic clock."""
        self.images: dict[int, str] = {}
        """Where each frame's picture is stored, by frame index: what `FlightWriter.commit` wants."""
        self.exposure = Exposure({})
        self._stored: Camera = lens.camera
        shrink = native_m_per_px / archive.site_grid().grid.m_per_px
        if shrink < _COARSE_MAP:
            full = lens.camera
            self._stored = full.resized(
                max(16, round(full.width_px * shrink)), max(16, round(full.height_px * shrink))
            )
        self._valid: Mask | None = lens.valid(self._stored.width_px, self._stored.height_px)
        self._coarse = _CoarseMap(writer, archive, self._stored, len(known), live_s)
        self._frames: set[int] = set()
        self._dirty: set[int] = set()
        self._painted_at = 0
        self._paint_again_s = 0.0

    def save(self, frame: Ending, image: Callable[[], ImageRGB]) -> None:
        """Store a frame's undistorted picture, no larger than the map needs it, unless a killed run left it there."""
        index, path = frame.index, None
        stored = self._memo.known(index, "picture", StoredPicture)
        if stored is not None:
            path = self._writer.take_over_image(index, stored.size_px, stored.sha256)
        if path is None:
            small = at_size(image(), self._stored.width_px, self._stored.height_px)
            path = self._writer.save_image(index, small)
            self._memo.keep(frame, "picture", StoredPicture(*self._writer.stored(index)))
        self.images[index] = path

    def mark(self, moved: Collection[int]) -> None:
        """These keyframes are new or moved: they are to be painted."""
        self._frames |= set(moved)
        self._dirty |= set(moved)

    def show(self, newest: int) -> int:
        """Paint small copies of what moved and let readers see it; how many tiles were painted.

        Of a live flight the newest key frame and a few others each time, else many now and then.
        """
        started_s, painted = time.monotonic(), 0
        if self._is_live:
            painted = self._paint_small([newest])
            with self._log.stage(Stage.STORE):
                self._coarse.save()
            self.shown_s = time.monotonic()
        if (
            len(self._frames) - self._painted_at < self._paint_every
            or started_s < self._paint_again_s
        ):
            return painted
        self._painted_at = len(self._frames)
        with self._log.stage(Stage.PAINT):
            self.exposure = self.exposure.updated(self._mapper.recent_exposure())
        painted += self._paint_small(
            sorted(self._dirty)[-(_AT_ONCE_LIVE if self._is_live else _AT_ONCE) :]
        )
        self._paint_again_s = time.monotonic() + REST * (time.monotonic() - started_s)
        with self._log.stage(Stage.STORE):
            self._coarse.show()
        return painted

    def settle(self) -> None:
        """Ready all pictures for the painting where they stand in the end.

        What was shown while they still moved is taken out first: when that was painted, which a clock decides, must not
        be seen in the map.
        """
        self.exposure = self._mapper.exposure()
        self._straighten()
        self._coarse.release()
        self._mapper.release()
        if self._painted_at or self._is_live:
            self._writer.take_back_tiles()
        self._writer.release_memory()

    def finish(
        self, ground: Iterable[tuple[TileIndex, ImageRGBA]] = (), shown: Collection[int] = ()
    ) -> None:
        """Paint all keyframes where they stand in the end.

        `ground` are tiles of a picture of the ground that is ready, which stands in for the keyframes `shown` in it.
        """
        with self._log.stage(Stage.PAINT):
            site_grid, known_images = (
                self._archive.site_grid(),
                ImageCache(self._known.image, _CACHE_BYTES),
            )

            def image(keyframe_id: int) -> ImageRGB:
                if keyframe_id < len(self._known):
                    return known_images.get(keyframe_id)
                return self._writer.image(keyframe_id - len(self._known))

            def canvas() -> Canvas:
                return Canvas(
                    site_grid.grid,
                    tiles,
                    image,
                    painted=self._known.canvas_frames(site_grid),
                    keeps_known_ground=True,
                )

            tiles = self._writer.tiles
            growing = canvas()
            if len(self._known):
                growing.paint([], forget=self._known.superseded)
            for index, rgba in ground:
                before = tiles.get(index)
                tiles[index] = (
                    rgba if before is None else np.where(before[..., 3:] == 255, before, rgba)
                )
            if shown:
                growing = canvas()
            self._paint(
                growing, self._frames.difference(shown), site_grid, self._stored, self._valid
            )

    def _paint_small(self, keyframe_ids: Collection[int]) -> int:
        coarse = self._coarse
        with self._log.stage(Stage.PAINT):
            valid = self._valid if coarse.step == 1 else None
            painted = self._paint(
                coarse.canvas, keyframe_ids, coarse.site_grid, coarse.camera, valid
            )
        self._dirty.difference_update(keyframe_ids)
        coarse.unshown |= painted
        return len(painted)

    def _straighten(self) -> None:
        """Where the flight showed a distortion that the calibration left over, take it out of the kept pictures."""
        lens = Undistorter.left_over(self._stored, self._mapper.radial)
        if lens is None:
            return
        for keyframe_id in sorted(self._frames):
            index = keyframe_id - len(self._known)
            self._writer.keep_original(index)
            self.images[index] = self._writer.save_image(
                index, lens.undistort(self._writer.image(index))
            )
        self._valid = lens.valid(self._stored.width_px, self._stored.height_px)

    def _paint(
        self,
        canvas: Canvas,
        keyframe_ids: Collection[int],
        site_grid: SiteGrid,
        camera: Camera,
        valid: Mask | None,
    ) -> frozenset[TileIndex]:
        """Paint keyframes where they stand, with pictures of the size that `camera` has; the tiles that this changed."""
        frames = {
            keyframe_id: canvas_frame(
                keyframe_id,
                self._known.next_rank,
                camera,
                self._mapper.site_from_image(keyframe_id, camera),
                site_grid,
                self.exposure.gains_of(keyframe_id),
                self.exposure.vignette,
                valid,
            )
            for keyframe_id in sorted(keyframe_ids)
        }
        return canvas.paint(
            [frame for frame in frames.values() if frame is not None],
            forget=[keyframe_id for keyframe_id, frame in frames.items() if frame is None],
        )
