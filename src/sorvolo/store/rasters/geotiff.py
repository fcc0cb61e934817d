"""GeoTIFF out and in: the map as a Cloud Optimized GeoTIFF, and reference maps read back as arrays.

The one place of the half-pixel shift: our pixel (0, 0) has its centre at the grid's origin, GDAL's transform
starts at that pixel's outer corner.
"""

import math
import re
import shutil
import sqlite3
import warnings
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from xml.sax.saxutils import escape
from zlib import crc32

import cv2
import numpy as np
import rasterio
import rasterio.shutil
from numpy.typing import NDArray
from rasterio._err import CPLE_BaseError
from rasterio.crs import CRS
from rasterio.enums import ColorInterp, Resampling
from rasterio.errors import CRSError, NotGeoreferencedWarning, RasterioError, RasterioIOError
from rasterio.transform import Affine
from rasterio.warp import calculate_default_transform, reproject
from rasterio.windows import Window

from sorvolo.errors import GeometryError, InputError, SettingsError, StoreError
from sorvolo.geometry.arrays import ImageRGBA
from sorvolo.geometry.crs import transformer
from sorvolo.geometry.grid import Grid, SiteGrid, TileIndex
from sorvolo.store.ahead import in_order
from sorvolo.store.atomic import atomic_path, scratch_folder, writing
from sorvolo.store.images import shrink

# a small cache keeps memory flat; no directory listing keeps GDAL from opening neighbours of a user's file; a curl name
# that nothing has keeps /vsicurl/ and its kin from fetching anything
_ENVIRONMENT = {
    "GDAL_CACHEMAX": 64,
    "GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR",
    "GDAL_PAM_ENABLED": "NO",
    "CPL_VSIL_CURL_ALLOWED_FILENAME": "/none",
    "CPL_VSIL_CURL_ALLOWED_EXTENSIONS": ".none",
    "GDAL_HTTP_MAX_RETRY": 0,
    "GDAL_HTTP_CONNECTTIMEOUT": 1,
}


def quiet_gdal() -> rasterio.Env:
    """The settings under which every file is opened."""
    return rasterio.Env(**_ENVIRONMENT)


@contextmanager
def open_raster(
    path: Path, what: str, drivers: Sequence[str] = ("GTiff",)
) -> Iterator[rasterio.DatasetReader]:
    """Open a user's GeoTIFF, with these drivers alone: a VRT renamed .tif could name any file or address.

    Raises InputError, naming `what` as needed, for anything but a file on the disk, so that none of GDAL's
    virtual paths (/vsicurl/, /vsizip/) and none of rasterio's (https:, zip:) is followed.
    """
    try:
        whole = Path(path).resolve()
        is_file = whole.is_file()
    except (OSError, ValueError, RuntimeError):
        is_file = False
    if not is_file:
        raise InputError(f"no such file: {path}; {what} was needed")
    if str(whole).startswith("/vsi"):
        raise InputError(
            f"{path}: GDAL would take this for one of its virtual files; move it to another folder"
        )
    with quiet_gdal(), _opened(whole, drivers) as source:
        if not math.isfinite(sum(source.transform)) or source.transform.is_degenerate:
            raise InputError(f"{path}: its transform places no pixel ({source.transform[:6]})")
        yield source


def transform_on_grid(grid: Grid, column: int, row: int) -> Affine:
    """The transform of a raster whose top-left pixel is this column and row of the grid.

    GDAL counts from a pixel's outer corner, our grids from its centre: half a pixel lies between them.
    """
    outer_m = grid.projected_from_grid(np.array([[column - 0.5, row - 0.5]]))[0]
    return Affine(grid.m_per_px, 0, outer_m[0], 0, -grid.m_per_px, outer_m[1])


def _opened(path: Path, drivers: Sequence[str]) -> rasterio.DatasetReader:
    """The file, by the first of the drivers that can read it. One without a place is refused by who asked for it."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        for driver in drivers[:-1]:
            try:
                return rasterio.open(path, driver=driver, sharing=False)
            except RasterioIOError:
                continue
        return rasterio.open(path, driver=drivers[-1], sharing=False)


def why_no_place(crs: CRS | None) -> str:
    """Why coordinates are no places on Earth, in words: there is no CRS, a local one, as of a building site's plan, or
    one without a known datum; "" where they are."""
    if crs is None:
        return "no coordinate reference system"
    if not (crs.is_geographic or crs.is_projected):
        return "a local coordinate reference system, of no known place"
    try:
        transformer(crs.to_wkt())
    except GeometryError as error:
        return str(error)
    return ""


def crs_of_epsg(code: str) -> CRS:
    """The CRS of a code such as EPSG:32633. Raises SettingsError for all else: GDAL would fetch an address."""
    match = re.fullmatch(r"(?:EPSG|epsg):([1-9][0-9]{0,8})", code)
    if match is None:
        raise SettingsError(f"{code!r} is no EPSG code; give one such as EPSG:32633")
    try:
        return CRS.from_epsg(int(match[1]))
    except CRSError as error:
        raise SettingsError(
            f"unknown coordinate reference system {code!r}; try one as EPSG:32633"
        ) from error


_BLOCK_PX = 512  # GDAL's own for cloud-optimised GeoTIFFs
_VERIFIED_BLOCKS = (
    64  # spread over the map: enough to notice a disk that writes rubbish, at no cost
)
# zstd is the fastest to write and to read once; deflate is what every reader of the final file understands; its
# level 6 takes 1.7 times as long as 1, all steps together, for files 4 % smaller
_SCRATCH = {
    "driver": "GTiff",
    "tiled": True,
    "compress": "zstd",
    "zstd_level": 1,
    "sparse_ok": True,
    "interleave": "band",
}
_COG = {
    "driver": "COG",
    "blocksize": _BLOCK_PX,
    "compress": "DEFLATE",
    "level": 1,
    "predictor": "YES",
    "overviews": "FORCE_USE_EXISTING",
    "bigtiff": "IF_SAFER",
    "num_threads": "ALL_CPUS",
    "sparse_ok": True,
}


@dataclass(frozen=True, eq=False)
class Raster:
    """A north-up map: `rgba` (H, W, 4), the centre of pixel (0, 0) at `origin_m` in `crs` ("": none)."""

    rgba: ImageRGBA
    origin_m: tuple[float, float]
    m_per_px: float
    crs: str


def write_cog(
    tiles: Mapping[TileIndex, ImageRGBA],
    site_grid: SiteGrid,
    path: Path,
    *,
    crs: str | None = None,
    pass_by: Callable[[TileIndex, ImageRGBA], None] = lambda _index, _tile: None,
) -> None:
    """Write the map as a Cloud Optimized GeoTIFF with alpha and overviews, in place of what was at `path`.

    Tiles are read one at a time, a few ahead in a thread, and each is shown to `pass_by`. `crs` reprojects (bilinear);
    the site's own CRS is the default, a local site has none. The file is read back before it takes its place. Raises
    SettingsError for an unknown `crs`, and StoreError for an empty map, a full disk, or a file that reads back differently.
    """
    if not tiles:
        raise StoreError("the map has no tiles; there is nothing to write as GeoTIFF")
    grid = site_grid.grid
    target = None if crs is None or crs == grid.crs else parse_crs(crs, grid)
    with (
        scratch_folder(path.parent) as scratch,
        atomic_path(path) as temporary,
        writing_raster(path),
    ):
        plain = scratch / "plain.tif"
        _write_plain(tiles, grid, plain, pass_by)
        if target is not None:
            plain = _warped(plain, target)
        filled = None if target is not None else _filled_blocks(tiles, grid)
        with rasterio.open(_pyramid(plain, filled), driver="VRT") as source:
            rasterio.shutil.copy(source, temporary, **_COG)
        with rasterio.open(plain, driver="GTiff") as source:
            with rasterio.open(temporary, driver="GTiff") as written:
                if (written.width, written.height, written.count) != (
                    source.width,
                    source.height,
                    4,
                ):
                    raise StoreError(_differs(temporary))
                # the last block lies last in the file: a cut file cannot give it
                windows = [window for _, window in written.block_windows(1)]
                for window in _spread(windows, _VERIFIED_BLOCKS):
                    read, wanted = written.read(window=window), source.read(window=window)
                    if not np.array_equal(read, wanted):
                        raise StoreError(_differs(temporary))


def write_mbtiles_or_pdf(
    tiles: Mapping[TileIndex, ImageRGBA], site_grid: SiteGrid, name: str, path: Path
) -> None:
    """Write the map for the apps of a tablet: .mbtiles (web tiles in one file, from one tile on) or .pdf (GeoPDF).

    The site must have a CRS. Raises StoreError for an empty map or a full disk.
    """
    with scratch_folder(path.parent) as scratch, writing_raster(path):
        write_cog(tiles, site_grid, plain := scratch / "map.tif")
        with atomic_path(path) as temporary:
            if path.suffix.lower() == ".pdf":
                with rasterio.open(
                    plain, "r+", driver="GTiff", IGNORE_COG_LAYOUT_BREAK="YES"
                ) as map_:
                    map_.update_tags(TITLE=name)
                rasterio.shutil.copy(plain, temporary, driver="PDF")
                return
            rasterio.shutil.copy(plain, temporary, driver="MBTiles", tile_format="PNG")
            with rasterio.open(temporary, "r+", driver="MBTiles") as made:
                levels = range(1, max(1, max(made.shape) // 128).bit_length() + 1)
                made.build_overviews([2**each for each in levels], Resampling.average)
            with closing(sqlite3.connect(temporary)) as table, table:  # an option ends in capitals
                table.execute(
                    "UPDATE metadata SET value=? WHERE name IN ('name','description')", [name]
                )


def parse_crs(crs: str, grid: Grid) -> CRS:
    """The CRS to reproject a map to; raises SettingsError when unknown or when the map is not on Earth."""
    if not grid.crs:
        raise SettingsError(
            f"this site has no geo-reference, so its map cannot be in {crs}; leave it out"
        )
    return crs_of_epsg(crs)


def read_raster(path: Path, max_px: int) -> Raster:
    """Read a north-up GeoTIFF of 8-bit grey, RGB or RGBA, thinned so that neither side exceeds `max_px`.

    Only the GTiff driver opens it: a VRT renamed .tif could name any other file. Thinning averages whole
    blocks of pixels, so that the origin and the ground sampling distance stay exact. Raises InputError.
    """
    try:
        with open_raster(path, "a GeoTIFF") as source:
            _demand_readable(source, path)
            transform = source.transform
            step = -(-max(source.width, source.height) // max_px)
            width, height = source.width // step, source.height // step
            if not width or not height:
                raise InputError(
                    f"{path} is {source.width}x{source.height} px, too narrow to thin to {max_px} px"
                )
            window = Window(0, 0, width * step, height * step)
            bands = [1, 2, 3] if source.count >= 3 else [1, 1, 1]
            rgb = source.read(
                bands, window=window, out_shape=(3, height, width), resampling=Resampling.average
            )
            alpha = source.dataset_mask(
                window=window, out_shape=(height, width), resampling=Resampling.average
            )
            m_per_px = transform.a * step
            epsg = source.crs.to_epsg() if source.crs is not None else None
            return Raster(
                np.ascontiguousarray(np.moveaxis(np.concatenate([rgb, alpha[None]]), 0, 2)),
                (transform.c + m_per_px / 2, transform.f - m_per_px / 2),
                m_per_px,
                f"EPSG:{epsg}" if epsg else source.crs.to_wkt() if source.crs is not None else "",
            )
    except RasterioError as error:
        raise InputError(
            f"{path} is no readable GeoTIFF ({error}); export it as GeoTIFF again"
        ) from error


def _write_plain(
    tiles: Mapping[TileIndex, ImageRGBA],
    grid: Grid,
    path: Path,
    pass_by: Callable[[TileIndex, ImageRGBA], None],
) -> None:
    columns, rows = np.array(sorted(tiles)).T
    left, top = columns.min() * grid.tile_px, rows.min() * grid.tile_px
    width, height = (columns.max() + 1) * grid.tile_px - left, (rows.max() + 1) * grid.tile_px - top
    profile = _SCRATCH | {
        "width": width,
        "height": height,
        "count": 4,
        "dtype": "uint8",
        "photometric": "RGB",
        "alpha": "YES",
        "blockxsize": _BLOCK_PX,
        "blockysize": _BLOCK_PX,
        "bigtiff": "IF_SAFER",
        "crs": crs_of_epsg(grid.crs) if grid.crs else None,
        "transform": transform_on_grid(grid, left, top),
    }
    verified = dict.fromkeys(
        _spread(sorted(tiles), _VERIFIED_BLOCKS), 0
    )  # and the CRC-32 of their pixels
    with rasterio.open(path, "w", **profile) as sink:
        sink.colorinterp = [ColorInterp.red, ColorInterp.green, ColorInterp.blue, ColorInterp.alpha]
        by_row = sorted(tiles, key=lambda index: (index[1], index[0]))
        for index, tile in zip(by_row, in_order(tiles.__getitem__, by_row, threads=1)):
            x0, y0, _, _ = grid.tile_window(index)
            window = Window(x0 - left, y0 - top, grid.tile_px, grid.tile_px)
            sink.write(_bands(tile), window=window)
            pass_by(index, tile)
            if index in verified:
                verified[index] = crc32(tile.tobytes())
    # GDAL can lose blocks on a full disk and still close without a word
    with rasterio.open(path, driver="GTiff") as source:
        for index, written in verified.items():
            x0, y0, _, _ = grid.tile_window(index)
            read = source.read(window=Window(x0 - left, y0 - top, grid.tile_px, grid.tile_px))
            if crc32(np.moveaxis(read, 0, 2).tobytes()) != written:
                raise StoreError(_differs(path))


def _bands(rgba: ImageRGBA) -> NDArray[np.uint8]:
    """(4, H, W) the colours one after the other, as the scratch file has them."""
    return np.stack(cv2.split(rgba))


def _warped(plain: Path, target: CRS) -> Path:
    """Reproject the scratch file into another beside it; a warped VRT would be warped for each overview."""
    warped = plain.with_name("warped.tif")
    bands = [1, 2, 3, 4]
    with rasterio.open(plain, driver="GTiff") as source:
        transform, width, height = calculate_default_transform(
            source.crs, target, source.width, source.height, *source.bounds
        )
        profile = (
            source.profile
            | _SCRATCH
            | {
                "crs": target,
                "transform": transform,
                "width": width,
                "height": height,
                "photometric": "RGB",
                "alpha": "YES",
            }
        )
        with rasterio.open(warped, "w", **profile) as sink:
            sink.colorinterp = source.colorinterp
            reproject(
                rasterio.band(source, bands),
                rasterio.band(sink, bands),
                resampling=Resampling.bilinear,
                src_alpha=4,
                warp_mem_limit=64,
            )
    return warped


def _filled_blocks(tiles: Collection[TileIndex], grid: Grid) -> set[TileIndex]:
    """Which blocks, column and row, of the scratch file the tiles fill."""
    left, top = np.array(sorted(tiles)).min(axis=0) * grid.tile_px
    found = set()
    for index in tiles:
        x0, y0, x1, y1 = np.array(grid.tile_window(index)) - [left, top, left, top]
        columns, rows = (
            range(int(low) // _BLOCK_PX, -(-int(high) // _BLOCK_PX))
            for low, high in ((x0, x1), (y0, y1))
        )
        found |= {(column, row) for column in columns for row in rows}
    return found


def _pyramid(plain: Path, filled: set[TileIndex] | None) -> Path:
    """Halve the scratch file until it fits one block; return a VRT of it with the halves as its overviews.

    Of places far apart most blocks between them are empty: where it is known which are `filled` the others are left
    out. GDAL's own averaging under an alpha band takes twice as long as all the rest of the export.
    """
    levels = [plain]
    while True:
        filled = None if filled is None else {(column // 2, row // 2) for column, row in filled}
        halved = _halved(levels[-1], plain.with_name(f"half{len(levels)}.tif"), filled)
        if halved is None:
            break
        levels.append(halved)
    with rasterio.open(plain, driver="GTiff") as source:
        transform = ",".join(repr(number) for number in source.transform.to_gdal())
        place = f"<SRS>{escape(source.crs.to_wkt())}</SRS>" if source.crs else ""
        size = f'rasterXSize="{source.width}" rasterYSize="{source.height}"'
    bands = "".join(
        f'<VRTRasterBand dataType="Byte" band="{band}"><ColorInterp>{colour}</ColorInterp>'
        f"<SimpleSource>{_vrt_source(levels[0], band)}</SimpleSource>"
        + "".join(f"<Overview>{_vrt_source(level, band)}</Overview>" for level in levels[1:])
        + "</VRTRasterBand>"
        for band, colour in enumerate(("Red", "Green", "Blue", "Alpha"), start=1)
    )
    path = plain.with_suffix(".vrt")
    path.write_text(
        f"<VRTDataset {size}>{place}<GeoTransform>{transform}</GeoTransform>{bands}</VRTDataset>"
    )
    return path


def _vrt_source(level: Path, band: int) -> str:
    return f'<SourceFilename relativeToVRT="1">{level.name}</SourceFilename><SourceBand>{band}</SourceBand>'


def _halved(larger: Path, path: Path, filled: set[TileIndex] | None) -> Path | None:
    """The next overview of a scratch file, at `path`; None when that one fits a block already.

    Its blocks that are not `filled` are empty.
    """
    with rasterio.open(larger, driver="GTiff") as source:
        if max(source.width, source.height) <= _BLOCK_PX:
            return None
        profile = (
            source.profile
            | _SCRATCH
            | {
                "width": -(-source.width // 2),
                "height": -(-source.height // 2),
                "blockxsize": _BLOCK_PX,
                "blockysize": _BLOCK_PX,
                "photometric": "RGB",
                "alpha": "YES",
            }
        )
        whole = Window(0, 0, source.width, source.height)
        with rasterio.open(path, "w", **profile) as sink:
            sink.colorinterp = source.colorinterp
            for (row, column), small in sink.block_windows(1):
                if filled is not None and (column, row) not in filled:
                    continue
                large = Window(
                    2 * small.col_off, 2 * small.row_off, 2 * small.width, 2 * small.height
                )
                rgba = np.moveaxis(source.read(window=large.intersection(whole)), 0, 2)
                if not rgba[..., 3].any():
                    continue  # unwritten blocks stay sparse
                if rgba.shape[0] % 2 or rgba.shape[1] % 2:
                    rgba = np.pad(
                        rgba, [(0, rgba.shape[0] % 2), (0, rgba.shape[1] % 2), (0, 0)], mode="edge"
                    )
                halved = shrink(np.ascontiguousarray(rgba), small.width, small.height)
                sink.write(_bands(halved), window=small)
    return path


def _spread(items: list, count: int) -> Iterator:  # type: ignore[type-arg]
    """At most `count` items, evenly spread, the first and the last among them."""
    for position in np.unique(np.linspace(0, len(items) - 1, min(count, len(items))).astype(int)):
        yield items[position]


def _differs(path: Path) -> str:
    free_mb = shutil.disk_usage(path.parent).free / 1e6
    return (
        f"{path} reads back differently from what was written ({free_mb:.0f} MB free on its disk); "
        "free some space or check the disk, and run it again"
    )


@contextmanager
def writing_raster(path: Path) -> Iterator[None]:
    """Within it GDAL writes `path`. Raises StoreError, which states the free space, for every fault of GDAL."""
    try:
        with quiet_gdal(), writing(path):
            yield
    except (RasterioError, CPLE_BaseError) as error:  # rasterio.shutil.copy lets GDAL's own through
        free_mb = shutil.disk_usage(path.parent).free / 1e6
        raise StoreError(
            f"could not write {path}: {error} ({free_mb:.0f} MB free on its disk); "
            "free some space and run it again"
        ) from error


def _demand_readable(source: rasterio.DatasetReader, path: Path) -> None:
    """Raises InputError where it is no north-up map of 8-bit bands and square pixels in metres."""
    transform = source.transform
    if source.count == 2 or set(source.dtypes) != {"uint8"}:
        raise InputError(
            f"{path} has {source.count} bands of {'/'.join(sorted(set(source.dtypes)))}; "
            "8-bit grey, RGB or RGBA was needed: convert it with gdal_translate -ot Byte -scale"
        )
    if (
        transform.b
        or transform.d
        or transform.e >= 0
        or not np.isclose(transform.a, -transform.e, rtol=1e-6)
    ):
        raise InputError(
            f"{path} is not a north-up map with square pixels; warp it with gdalwarp first"
        )
    if source.crs is not None and not source.crs.is_projected:
        raise InputError(
            f"{path} is in degrees ({source.crs}); warp it to a CRS in metres, as its UTM zone"
        )
