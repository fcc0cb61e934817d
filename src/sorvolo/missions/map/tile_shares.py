"""A map's tiles painted in shares by several processes: what each needs to know, and what it hands back."""

import json
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

import sorvolo
from sorvolo.errors import StoreError
from sorvolo.geometry.arrays import ImageRGB, Mask
from sorvolo.geometry.grid import Grid, TileIndex
from sorvolo.mosaic.canvas import Canvas
from sorvolo.mosaic.canvas_frame import CanvasFrame
from sorvolo.store.atomic import atomic_write_bytes
from sorvolo.store.images import ImageCache, image_from_jpeg
from sorvolo.store.site.journal import Entry, RunJournal
from sorvolo.store.site.journal_records import RecordPacker, unpacked
from sorvolo.store.site.tiles import GrowingTiles, TileBlobs

PaintsElsewhere = Callable[["PaintPlan"], Iterator[tuple[TileIndex, bytes]]]
"""What has a plan painted by others: its tiles, as PNG."""

_PLAN, _KIND, _TILES = "paint.plan", "plan", "tiles"


@dataclass(frozen=True, eq=False)
class PaintPlan:
    """All that the map's tiles are made of: frames, and the files of their pictures, in the same order.

    `valid` are the pixels that every picture has (None: all); the frames themselves hold no mask.
    """

    grid: Grid
    frames: tuple[CanvasFrame, ...]
    pictures: tuple[str, ...]
    valid: Mask | None

    def shares(self, count: int) -> list[frozenset[TileIndex]]:
        """The tiles in `count` parts, or fewer, of neighbours: rows of the map from north to south."""
        touched = set[TileIndex]().union(
            *(self.grid.tiles_touched(each.outline_px) for each in self.frames)
        )
        tiles = sorted(touched, key=lambda tile: (tile[1], tile[0]))
        size = max(1, -(-len(tiles) // count))
        return [frozenset(tiles[at : at + size]) for at in range(0, len(tiles), size)]


def write_plan(plan: PaintPlan, folder: Path) -> None:
    """Put a plan into a folder; an earlier one is replaced. Raises StoreError when the disk is full."""
    (folder / _PLAN).unlink(missing_ok=True)
    packer = RecordPacker()
    values = {"plan": packer.packed(plan)}
    with closing(_plan_file(folder)) as file:
        file.append(Entry(_KIND, values, packer.arrays))


def paint_share(
    folder: Path,
    number: int,
    count: int,
    memory_bytes: int,
    alive: Callable[[], None] = lambda: None,
) -> None:
    """Paint one of `count` shares of the tiles of a folder's plan; they lie in the folder then.

    Pictures that lie there or in the tiles around them are read, no others. Raises StoreError when the disk is full,
    or where the plan or a picture is missing.
    """
    plan = _read_plan(folder)
    tiles = plan.shares(count)[number]
    around = {
        (column + x, row + y) for column, row in tiles for x in (-1, 0, 1) for y in (-1, 0, 1)
    }
    near = [
        at
        for at, each in enumerate(plan.frames)
        if plan.grid.tiles_touched(each.outline_px) & around
    ]
    files = {plan.frames[at].id: Path(plan.pictures[at]) for at in near}

    def picture(frame_id: int) -> ImageRGB:
        alive()
        return image_from_jpeg(files[frame_id].read_bytes(), str(files[frame_id]))

    with closing(
        GrowingTiles(tile_blobs(folder), {}, plan.grid.tile_px, memory_bytes // 4)
    ) as painted:
        canvas = Canvas(
            plan.grid, painted, ImageCache(picture, memory_bytes // 2).get, within=tiles
        )
        canvas.paint([plan.frames[at] for at in near])
        saved = painted.save()
    rows = [[*tile, sha256] for tile, sha256 in sorted(saved.items()) if sha256 is not None]
    atomic_write_bytes(_share_path(folder, number), json.dumps(rows).encode())


def tiles_painted(folder: Path, number: int) -> dict[TileIndex, str]:
    """The tiles of a share that was painted, by their SHA-256."""
    return {
        (column, row): sha256
        for column, row, sha256 in json.loads(_share_path(folder, number).read_bytes())
    }


def tile_blobs(folder: Path) -> TileBlobs:
    """The tiles that shares painted into a folder."""
    return TileBlobs(folder / _TILES)


def _read_plan(folder: Path) -> PaintPlan:
    """The plan of a folder. Raises StoreError where there is none that is whole."""
    entry = next(_plan_file(folder).entries(), None)
    if entry is None:
        raise StoreError(f"{folder / _PLAN} is missing or damaged; give the same command again")
    plan: PaintPlan = unpacked(PaintPlan, entry.values["plan"], entry.arrays)
    return replace(plan, frames=tuple(replace(each, valid=plan.valid) for each in plan.frames))


def _share_path(folder: Path, number: int) -> Path:
    return folder / f"share-{number:04d}.json"


def _plan_file(folder: Path) -> RunJournal:
    return RunJournal(folder / _PLAN, _KIND, 0, sorvolo.__version__)
