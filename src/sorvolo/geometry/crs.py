"""Coordinate reference systems that people and files name, and the one door from their coordinates to WGS84."""

import re
from functools import cache

from pyproj import CRS, Transformer
from pyproj.exceptions import CRSError, ProjError

from sorvolo.errors import GeometryError

WGS84 = "EPSG:4326"
_FORMS = "give EPSG:32632, EPSG:32632+5773, WGS84 UTM 32N, WGS84, or a proj string"
_SOUTHERN_BANDS = "CDEFGHJKLM"  # of latitude, as MGRS has them
_PROJ_KEYS = re.compile(
    "proj|zone|south|ellps|datum|units|to_meter|no_defs|type|lat_[012]|lon_0|lat_ts|k|k_0|x_0|y_0|a|b|rf|towgs84|axis|"
    "gamma|alpha|lonc"
)
"""Of a proj string: those of map projections. Grids and pipelines would read files."""


def crs_from_words(words: str) -> CRS:
    """The CRS that a line of a file names, whose places on WGS84 are known.

    Forms: EPSG:code, with a second code of heights where the file has them (EPSG:32633+5773), "WGS84 UTM 33N" (or
    33S, or the band's letter: 33T), WGS84, a proj string. Raises GeometryError for all else: it would read files.
    """
    named = _as_epsg(words)
    if named.startswith("+"):
        keys = [part.lstrip("+").partition("=")[0] for part in named.split()]
        if strange := [key for key in keys if not _PROJ_KEYS.fullmatch(key)]:
            raise GeometryError(f"+{strange[0]} is not read; give the CRS as EPSG:code")
    elif not re.fullmatch(r"EPSG:[1-9][0-9]{0,8}(\+[1-9][0-9]{0,8})?", named, re.IGNORECASE):
        raise GeometryError(f"{words[:60]!r} is no CRS; {_FORMS}")
    try:
        crs = CRS.from_user_input(named)
    except CRSError as error:
        raise GeometryError(f"unknown CRS {words[:60]!r}; give one as EPSG:32632") from error
    if not (crs.is_projected or crs.is_geographic):
        raise GeometryError(
            f"{words} ({crs.name}) is no CRS of a map; give a projected one as EPSG:32633"
        )
    transformer(crs.to_wkt())
    return crs


@cache
def transformer(source: str, target: str = WGS84) -> Transformer:
    """From one CRS's coordinates to another's, x or longitude first; heights stay as they are.

    A CRS is anything that PROJ reads. Raises GeometryError where PROJ does not know how their datums differ: it would
    take them as one, which is wrong by up to hundreds of metres.
    """
    try:
        start, end = (CRS.from_user_input(each).to_2d() for each in (source, target))
    except CRSError as error:
        raise GeometryError(f"unknown coordinate reference system: {error}") from error
    try:
        return Transformer.from_crs(start, end, always_xy=True, allow_ballpark=False)
    except ProjError as error:
        raise GeometryError(_no_way(end if source == WGS84 else start)) from error


def vertical_name(crs: CRS) -> str:
    """What the heights of a CRS count from, as "EGM96 height" or "ellipsoid"; "" where it does not say."""
    named = next((each.name for each in crs.sub_crs_list if each.is_vertical), "")
    is_3d = crs.is_geographic and len(crs.axis_info) == 3
    return named or ("ellipsoid" if is_3d else "")


def _no_way(crs: CRS) -> str:
    """Why there is no way from a CRS to WGS84, and what would open one."""
    ellipsoid = crs.ellipsoid.name if crs.ellipsoid else "unknown"
    datum = crs.datum.name if crs.datum else "unknown"
    is_named = not re.match("unknown|not specified", datum, re.IGNORECASE)
    found = (
        f"the datum {datum}, whose difference from WGS84 is not known"
        if is_named
        else f"an ellipsoid ({ellipsoid}) but no datum"
    )
    return (
        f"the coordinate reference system ({crs.name}) has {found}: places could be off by hundreds of metres. Name it "
        "by the EPSG code of your country's grid, or state its datum (+datum=WGS84, or +towgs84=x,y,z)"
    )


def _as_epsg(words: str) -> str:
    """ "WGS84 UTM 32N", "WGS 84 / UTM zone 33T" and "WGS84" as EPSG codes; other words as they are."""
    utm = re.fullmatch(
        r"WGS ?84[ ,/]+UTM(?: zone)? ?(\d{1,2}) ?([C-HJ-NP-X])", words, re.IGNORECASE
    )
    if utm and 1 <= int(utm[1]) <= 60:
        # S is both "south" and a band north of the equator: beside a zone it has always meant south
        is_south = utm[2].upper() in f"S{_SOUTHERN_BANDS}"
        return f"EPSG:{(32700 if is_south else 32600) + int(utm[1])}"
    return WGS84 if re.fullmatch(r"WGS ?84", words, re.IGNORECASE) else words
