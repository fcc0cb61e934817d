"""Records as a journal's entries hold them: frozen dataclasses to plain values and arrays, and back by their types."""

import types
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from enum import Enum
from functools import cache
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

_MOST_CELLS = 64_000_000  # of a packed mask: a picture's pixels
_T = TypeVar("_T")


class RecordPacker:
    """Takes records apart. `arrays` are those of all records packed so far, for the entry that holds them.

    Only `compresses` packs masks and pictures of one byte small: photographs gain nothing by it.
    """

    def __init__(self, *, compresses: bool = True) -> None:
        self.arrays: dict[str, NDArray[Any]] = {}
        self._compresses = compresses

    def packed(self, value: Any) -> Any:
        """Return the value as JSON holds it.

        Raises TypeError for what is neither a record, an array, bytes, a sequence, a mapping by text nor a plain value.
        """
        if isinstance(value, bytes):
            value = np.frombuffer(value, np.uint8)
        if isinstance(value, np.ndarray):
            return self._array(value)
        if isinstance(value, Mapping):
            return {str(name): self.packed(part) for name, part in value.items()}
        if is_dataclass(value) and not isinstance(value, type):
            return [self.packed(getattr(value, each.name)) for each in fields(value)]
        if isinstance(value, list | tuple):
            return [self.packed(each) for each in value]
        return _plain(value)

    def _array(self, array: NDArray[Any]) -> Any:
        name = f"a{len(self.arrays)}"
        is_small = self._compresses and array.ndim == 2 and array.dtype.itemsize == 1
        if not is_small:
            self.arrays[name] = array
            return name
        data = np.packbits(array) if array.dtype == bool else np.ascontiguousarray(array)
        self.arrays[name] = np.frombuffer(zlib.compress(data.tobytes(), 1), np.uint8)
        return [name, array.dtype.str, *array.shape]


def unpacked(kind: type[_T], value: Any, arrays: Mapping[str, NDArray[Any]]) -> _T:
    """A record of this class from what `RecordPacker.packed` made of it.

    Raises KeyError, TypeError or ValueError, or what the record itself raises, for anything else.
    """
    return _read(kind, value, arrays)


def _plain(value: Any) -> Any:
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, Enum):
        return value.value
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise TypeError(f"a journal holds no {type(value).__name__}")


def _read(hint: Any, value: Any, arrays: Mapping[str, NDArray[Any]]) -> Any:
    origin = get_origin(hint)
    if origin is types.UnionType:
        kind = next(each for each in get_args(hint) if each is not types.NoneType)
        return None if value is None else _read(kind, value, arrays)
    if origin is np.ndarray:
        return _read_array(value, arrays)
    if hint is bytes:
        return arrays[value].tobytes()
    if origin is Mapping:
        return {name: _read(get_args(hint)[1], part, arrays) for name, part in value.items()}
    if origin in (tuple, Sequence):
        return _read_sequence(get_args(hint), value, arrays)
    if is_dataclass(hint):
        return _read_record(hint, value, arrays)  # type: ignore[arg-type]
    return _read_plain(hint, value)


def _read_record(kind: type, value: Any, arrays: Mapping[str, NDArray[Any]]) -> Any:
    hints = _hints(kind)
    if not isinstance(value, list) or len(value) != len(hints):
        raise ValueError(f"a {kind.__name__} has {len(hints)} values")
    return kind(
        **{name: _read(each, part, arrays) for (name, each), part in zip(hints.items(), value)}
    )


def _read_plain(kind: Any, value: Any) -> Any:
    if issubclass(kind, Enum):
        return kind(value)
    if kind is float and type(value) is int:
        return float(value)
    if type(value) is not kind:
        raise TypeError(f"{kind.__name__} was needed, not {type(value).__name__}")
    return value


def _read_sequence(
    parts: tuple[Any, ...], value: Any, arrays: Mapping[str, NDArray[Any]]
) -> tuple[Any, ...]:
    if not isinstance(value, list):
        raise TypeError("a sequence was needed")
    each = (
        parts
        if parts[-1:] != (Ellipsis,) and len(parts) == len(value)
        else (parts[0],) * len(value)
    )
    return tuple(_read(hint, item, arrays) for hint, item in zip(each, value))


def _read_array(value: Any, arrays: Mapping[str, NDArray[Any]]) -> NDArray[Any]:
    if isinstance(value, str):
        return arrays[value]
    name, kind, rows, columns = value
    if not (
        type(rows) is int
        and type(columns) is int
        and min(rows, columns) >= 0
        and rows * columns <= _MOST_CELLS
    ):
        raise ValueError("no mask is so large")
    is_mask = kind == "|b1"
    size = (rows * columns + 7) // 8 if is_mask else rows * columns
    data = zlib.decompressobj().decompress(arrays[name].tobytes(), max(1, size))
    if len(data) != size:
        raise ValueError("a mask is cut off")
    cells = np.frombuffer(data, np.uint8)
    flat = np.unpackbits(cells, count=rows * columns).view(bool) if is_mask else cells
    return flat.reshape(rows, columns)


@cache
def _hints(kind: type) -> dict[str, Any]:
    hints = get_type_hints(kind)
    return {each.name: hints[each.name] for each in fields(kind)}
