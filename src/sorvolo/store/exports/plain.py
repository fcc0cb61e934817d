"""Records as plain JSON and GeoJSON text, and times as text."""

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, is_dataclass
from datetime import UTC, date, datetime, time
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np

from sorvolo.errors import SettingsError
from sorvolo.geometry.units import DAY_NS

NO_PLACE_FILES = "No GeoJSON, KML or GPX is written, since these hold places on Earth."
_OF_OWN_MAP = (
    "The flight has no GPS: coordinates are pixels of its own map, x to the right and y up, without metres and north. "
    + NO_PLACE_FILES
)


def plain_json(value: Any) -> Any:
    """The value as JSON can hold it: records as objects, arrays as lists, NaN and infinities as null.

    Raises TypeError for what has no such form.
    """
    if value is None or isinstance(value, bool | str | int):
        return value.value if isinstance(value, Enum) else value
    if isinstance(value, np.generic | np.ndarray):
        return plain_json(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): plain_json(item) for key, item in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [plain_json(item) for item in value]
    if is_dataclass(value) and not isinstance(value, type):
        return plain_json(asdict(value))
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"a {type(value).__name__} cannot be written as JSON")


def number_or_null(number: float) -> float | None:
    """The number as JSON and databases can hold it: None for NaN and infinities."""
    return float(number) if math.isfinite(number) else None


def json_bytes(value: Any) -> bytes:
    """The value as UTF-8 JSON text, laid out for people."""
    text = json.dumps(plain_json(value), indent=1, ensure_ascii=False, allow_nan=False)
    return text.encode() + b"\n"


def geojson_bytes(collection: Mapping[str, Any]) -> bytes:
    """A FeatureCollection as UTF-8 JSON text, one feature a line."""
    head = {key: value for key, value in collection.items() if key != "features"}
    features = ",\n".join(_line(feature) for feature in collection["features"])
    return (_line(head)[:-1] + ', "features": [\n' + features + "\n]}\n").encode()


def _line(value: Any) -> str:
    """JSON without line breaks; most values are plain already, and outlines of ten thousand corners among them."""
    try:
        return json.dumps(value, ensure_ascii=False, allow_nan=False)
    except (TypeError, ValueError):  # records, arrays; NaN
        return json.dumps(plain_json(value), ensure_ascii=False, allow_nan=False)


def feature_collection(
    name: str, features: Sequence[Mapping[str, Any]], *, is_local: bool, note: str = _OF_OWN_MAP
) -> dict[str, Any]:
    """Features with a geometry as a GeoJSON FeatureCollection; of a local site as plain JSON, which no map would open.

    A local site has no place on Earth: its coordinates are pixels, of its own map where `note` states nothing else.
    """
    if not is_local:
        return {"type": "FeatureCollection", "name": name, "features": list(features)}
    plain = [{key: value for key, value in each.items() if key != "type"} for each in features]
    return {"name": name, "crs": None, "note": note, "features": plain}


def feature(geometry: Any, properties: Any, **own: Any) -> dict[str, Any]:
    """One feature of GeoJSON; `own` are further members, such as its id."""
    return {"type": "Feature", **own, "geometry": geometry, "properties": properties}


_TIMES = {"time", "first_seen", "last_seen", "announced"}


class FeatureList(list[dict[str, Any]]):
    """Features of GeoJSON, which libraries that know `__geo_interface__` take as they are."""

    def __init__(self, features: Iterable[dict[str, Any]] = (), *, is_local: bool = False) -> None:
        super().__init__(features)
        self._crs = None if is_local else "EPSG:4326"

    @property
    def __geo_interface__(self) -> dict[str, Any]:
        """All of them as a FeatureCollection; pixels of its own map where the site is local."""
        return {"type": "FeatureCollection", "features": list(self)}

    def to_geodataframe(self) -> Any:
        """The same as `geopandas.GeoDataFrame` (pip install "sorvolo[notebooks]"), times as times.

        Raises SettingsError where GeoPandas is not installed.
        """
        try:
            import geopandas
            import pandas
        except ModuleNotFoundError as error:
            raise SettingsError(
                "a GeoDataFrame needs GeoPandas: pip install 'sorvolo[notebooks]'"
            ) from error
        if not self:
            return geopandas.GeoDataFrame(geometry=[], crs=self._crs)
        table = geopandas.GeoDataFrame.from_features(self, crs=self._crs)
        for name in _TIMES.intersection(table):
            table[name] = pandas.to_datetime(table[name], utc=True, format="ISO8601")
        return table


def features_name(name: str, *, is_local: bool) -> str:
    """The file name of a collection: GeoJSON, or plain JSON for a local site."""
    return f"{name}.json" if is_local else f"{name}.geojson"


def features_path(folder: Path, name: str) -> Path:
    """Where a collection lies in a folder, of whichever kind its site is."""
    local = folder / features_name(name, is_local=True)
    return local if local.is_file() else folder / features_name(name, is_local=False)


def utc_text(time_ns: int) -> str:
    """ISO 8601 UTC of nanoseconds since 1970, to the microsecond, or to the nanosecond where it matters."""
    seconds, rest_ns = divmod(time_ns, 1_000_000_000)
    day = datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%dT%H:%M:%S")
    return f"{day}.{rest_ns // 1000:06d}Z" if rest_ns % 1000 == 0 else f"{day}.{rest_ns:09d}Z"


def moment_of(text: str, of_day: time, wanted: str = "a date") -> datetime:
    """A moment of ISO 8601, UTC unless it names a zone; a date stands for this time of its day.

    Raises SettingsError, which says what was `wanted`, for any other text.
    """
    try:
        return datetime.combine(date.fromisoformat(text), of_day, UTC)
    except ValueError:
        pass
    try:
        moment = datetime.fromisoformat(text)
    except ValueError as error:
        raise SettingsError(
            f"{text!r} is not {wanted}; give 2026-05-31, or 2026-05-31T12:00"
        ) from error
    return moment if moment.tzinfo is not None else moment.replace(tzinfo=UTC)


def time_words(time_ns: int) -> str:
    """UTC to the second for people; the time into the flight where no clock knew the date."""
    if 0 <= time_ns < DAY_NS:
        return f"{time_ns // 60_000_000_000}:{time_ns // 1_000_000_000 % 60:02d} into the flight"
    return utc_text(time_ns)[:19].replace("T", " ")


def rounded(number: float, digits: int) -> float | None:
    """The number for JSON; None when it is not finite."""
    return round(float(number), digits) if np.isfinite(number) else None


def frame_number(name: str) -> int | str:
    """A frame as all files name it: a video's by its index, a photo by its file."""
    return int(name) if name.isdecimal() and str(int(name)) == name else name


def name_safe(name: str) -> str:
    """The name with everything but letters, digits, dash and underscore replaced by an underscore."""
    return "".join(letter if letter.isalnum() or letter in "-_" else "_" for letter in name)
