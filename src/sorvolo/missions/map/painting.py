"""A flight's keyframes painted into the site's map: coarsely while they still move, and once when they stand."""

import time
from collections.abc import Collection
from dataclasses import dataclass

from sorvolo.geometry.arrays import ImageRGB, Mask, Matrix3
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.grid import SiteGrid, TileIndex
from sorvolo.geometry.homography import site_from_image_homography
from sorvolo.missions.flight.log import FlightLog, Stage
from sorvolo.missions.map.journal import StoredPicture
from sorvolo.missions.map.known_keyframes import KnownKeyframes
from sorvolo.mosaic.canvas import Canvas, CoarseTiles, coarse_grid, coarseness
from sorvolo.mosaic.canvas_frame import CanvasFrame
from sorvolo.mosaic.exposure import Exposure
from sorvolo.mosaic.placing import canvas_frame
from sorvolo.mosaic.planar import PlanarMapper
from sorvolo.registration.lens import Undistorter
from sorvolo.registration.sizes import at_size
from sorvolo.store.exports.map_pictures import LivePreview
from sorvolo.store.images import ImageCache
from sorvolo.store.site.archive import Archive, FlightWriter


@dataclass(frozen=True)
class PaintSettings:
    """How much of a map is painted while it grows; what is painted in the end does not depend on it."""

    every: int = 8  # keyframes painted together: tiles that several touch are rendered once; not where somebody waits
    at_once: int = 24  # at most, the newest first: a solve may move a hundred
    live: int = 3  # of those moved, beside the newest, while somebody waits for that
    rest: float = 4.0  # times as long as a painting took: showing a map that still moves must not hold up the flight
    coarse_map: float = (
        0.77  # times the pictures' own pixels: a coarser map does not need every pixel of them
    )
    cache_bytes: int = (
        128 * 1024 * 1024
    )  # of earlier flights' pictures; an eighth of it of the flight's own, small


@dataclass(frozen=True, eq=False)
class _Fineness:
    """The map at a `step`-th of its pixels: its grid, and the camera of pictures so large."""

    step: int
    site_grid: SiteGrid
    camera: Camera


class FlightPainter:
    """Stores a flight's pictures and paints them into its site; ground that the map shows already stays as it is.

    While the flight goes on, `show` paints small copies of them, enlarged: that is cheap, however often the map moves;
    of a live flight (`is_live`) the newest at once, for somebody waits for it. `finish` paints the pictures themselves.

    `native_m_per_px` is the ground sampling distance of the flight's own pictures. Keyframes have ids from
    `known.count` on, earlier flights' those before.
    """

    def __init__(
        self,
        writer: FlightWriter,
        archive: Archive,
        mapper: PlanarMapper,
        lens: Undistorter,
        known: KnownKeyframes,
        native_m_per_px: float,
        log: FlightLog,
        live_s: float,
        *,
        is_live: bool,
        settings: PaintSettings = PaintSettings(),
    ) -> None:
        self._settings = settings
        self._writer, self._archive, self._mapper, self._known, self._log = (
            writer,
            archive,
            mapper,
            known,
            log,
        )
        self._live_s, self._paint_every = live_s, settings.every if live_s >= 1 else 1
        self._is_live = is_live
        self.shown_s = 0.0
        """When readers could see the newest key frame of a live flight, by the monotonic clock."""
        self.images: dict[int, str] = {}
        """Where each frame's picture is stored, by frame index: what `FlightWriter.commit` wants."""
        self.exposure = Exposure({}, {}, 0.0)
        self._known_images = ImageCache(
            lambda each: archive.image(known[each].stored), settings.cache_bytes
        )
        self._stored: Camera = lens.camera
        shrink = native_m_per_px / archive.site_grid().grid.m_per_px
        if shrink < settings.coarse_map:
            full = lens.camera
            self._stored = full.resized(
                max(16, round(full.width_px * shrink)), max(16, round(full.height_px * shrink))
            )
        self._valid: Mask | None = lens.valid(self._stored.width_px, self._stored.height_px)
        step = coarseness(max(self._stored.width_px, self._stored.height_px))
        self._live = _Fineness(
            step,
            coarse_grid(archive.site_grid(), step),
            self._stored.resized(
                -(-self._stored.width_px // step), -(-self._stored.height_px // step)
            ),
        )
        self._live_images = ImageCache(
            lambda each: writer.small_image(each - known.count, step), settings.cache_bytes // 8
        )
        self._live_tiles = CoarseTiles(writer.tiles, archive.site_grid().grid, step)
        self._live_canvas = Canvas(
            self._live.site_grid.grid,
            self._live_tiles,
            self._live_images.get,
            keeps_known_ground=True,
        )
        self._preview, self._unshown = (
            LivePreview(self._live.site_grid.grid.tile_px),
            set[TileIndex](),
        )
        self._frames: set[int] = set()
        self._dirty: set[int] = set()
        self._painted_at = 0
        self._paint_again_s = 0.0
        self._show_again_s = time.monotonic() + live_s

    def save(self, keyframe_id: int, image: ImageRGB) -> None:
        """Store a keyframe's picture, no larger than the map needs it."""
        index = keyframe_id - self._known.count
        small = at_size(image, self._stored.width_px, self._stored.height_px)
        self.images[index] = self._writer.save_image(index, small)

    def take_over(self, keyframe_id: int, picture: StoredPicture) -> bool:
        """Take a keyframe's picture as stored that a killed run left; whether it is there as it was."""
        index = keyframe_id - self._known.count
        path = self._writer.take_over_image(index, picture.size_px, picture.sha256)
        if path is not None:
            self.images[index] = path
        return path is not None

    def mark(self, moved: Collection[int]) -> None:
        """These keyframes are new or moved: they are to be painted."""
        self._frames |= set(moved)
        self._dirty |= set(moved)

    def show(self, newest: int) -> int:
        """Paint small copies of what moved and let readers see it; how many tiles were painted.

        Of a live flight the newest key frame and a few others each time, else many now and then.
        """
        started_s = time.monotonic()
        painted = self._show_now(newest) if self._is_live else 0
        if (
            len(self._frames) - self._painted_at < self._paint_every
            or started_s < self._paint_again_s
        ):
            return painted
        self._painted_at = len(self._frames)
        self._adapt()
        most = self._settings.live if self._is_live else self._settings.at_once
        painted += self._paint_small(sorted(self._dirty)[-most:])
        self._paint_again_s = time.monotonic() + self._settings.rest * (
            time.monotonic() - started_s
        )
        self._flush()
        return painted

    def finish(self) -> None:
        """Paint all keyframes where they stand in the end.

        What was shown while they still moved is taken out first: when that was painted, which a clock decides, must not
        be seen in the map.
        """
        self.exposure = self._mapper.exposure()
        self._straighten()
        self._live_images.clear()
        self._live_tiles.release()
        self._mapper.release()
        if self._painted_at or self._is_live:
            self._writer.take_back_tiles()
        self._writer.release_memory()
        at = _Fineness(1, self._archive.site_grid(), self._stored)
        with self._log.stage(Stage.PAINT):
            self._paint(self._new_canvas(), self._frames, at)

    # ---- inside -----------------------------------------------------------------------------------------------

    def _show_now(self, newest: int) -> int:
        """Paint the newest key frame and let readers see it."""
        painted = self._paint_small([newest])
        with self._log.stage(Stage.STORE):
            self._live_tiles.save()
            self._writer.flush()
        self.shown_s = time.monotonic()
        return painted

    def _adapt(self) -> None:
        with self._log.stage(Stage.PAINT):
            self.exposure = self.exposure.updated(self._mapper.recent_exposure())

    def _paint_small(self, keyframe_ids: Collection[int]) -> int:
        with self._log.stage(Stage.PAINT):
            painted = self._paint(self._live_canvas, keyframe_ids, self._live)
        self._dirty.difference_update(keyframe_ids)
        self._unshown |= painted
        return len(painted)

    def _flush(self) -> None:
        """Let readers see what was painted, and the whole map small; the larger the map, the less often."""
        started_s = time.monotonic()
        if started_s < self._show_again_s:
            return
        with self._log.stage(Stage.STORE):
            self._live_tiles.save()
            self._writer.flush()
            self._preview.write(self._live_tiles, self._unshown, self._archive.live_preview_path)
            self._unshown.clear()
        self._show_again_s = time.monotonic() + max(
            self._live_s, self._settings.rest * (time.monotonic() - started_s)
        )

    def _new_canvas(self) -> Canvas:
        site_grid = self._archive.site_grid()
        canvas = Canvas(
            site_grid.grid,
            self._writer.tiles,
            self._image,
            painted=self._known.canvas_frames(site_grid),
            keeps_known_ground=True,
        )
        if self._known.count:
            canvas.paint([], forget=self._known.superseded)
        return canvas

    def _image(self, keyframe_id: int) -> ImageRGB:
        if keyframe_id < self._known.count:
            return self._known_images.get(keyframe_id)
        return self._writer.image(keyframe_id - self._known.count)

    def _straighten(self) -> None:
        """Where the flight showed a distortion that the calibration left over, take it out of the kept pictures."""
        lens = Undistorter.left_over(self._stored, self._mapper.radial)
        if lens is None:
            return
        for keyframe_id in sorted(self._frames):
            index = keyframe_id - self._known.count
            self._writer.keep_original(index)
            self.images[index] = self._writer.save_image(
                index, lens.undistort(self._writer.image(index))
            )
        self._valid = lens.valid(self._stored.width_px, self._stored.height_px)

    def _paint(
        self, canvas: Canvas, keyframe_ids: Collection[int], at: "_Fineness"
    ) -> frozenset[TileIndex]:
        """Paint keyframes where they stand; the tiles that this changed."""
        painted = {each: self._canvas_frame(each, at) for each in sorted(keyframe_ids)}
        return canvas.paint(
            [frame for frame in painted.values() if frame is not None],
            forget=[each for each, frame in painted.items() if frame is None],
        )

    def _canvas_frame(self, keyframe_id: int, at: "_Fineness") -> CanvasFrame | None:
        return canvas_frame(
            keyframe_id,
            self._known.next_rank,
            at.camera,
            site_from_image(self._mapper, keyframe_id, at.camera),
            at.site_grid,
            self.exposure.gains_of(keyframe_id),
            self.exposure.vignette_of(0),
            self._valid if at.step == 1 else None,
        )


def site_from_image(mapper: PlanarMapper, keyframe_id: int, camera: Camera) -> Matrix3:
    """(3, 3) of an undistorted image of the size that `camera` has: the stored one's or the frame's own."""
    refined = camera.with_focal_px(camera.fx_px * mapper.focal_scale)
    return site_from_image_homography(refined, mapper.pose(keyframe_id))
