"""Pictures and detections between processes: lengths, JSON and the bytes of arrays, nothing that could be run."""

import json
import struct
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from sorvolo.geometry.arrays import Numbers

_MOST_TEXT_BYTES = 1 << 28  # settings and boxes as JSON, far more than any; by choice
_MOST_DATA_BYTES = 3 << 29  # of pictures, 1.6 GB: a batch of the largest that a mission takes
_MOST_ROWS = 100_000  # boxes of a batch; by choice
_TYPES = {"boxes": np.float32, "scores": np.float32, "labels": np.int64, "pictures": np.int64}


class Stream(Protocol):
    """What messages are sent to and read from: a pipe's end, or a socket's file."""

    def write(self, data: bytes | memoryview, /) -> int:
        """Send bytes."""

    def read(self, size: int, /) -> bytes:
        """So many bytes; fewer where the other side has ended."""

    def flush(self) -> None:
        """Send what waits."""


def write_message(stream: Stream, head: Mapping[str, Any], data: bytes | memoryview = b"") -> None:
    """Send one message. Raises OSError where the other side has ended."""
    text = json.dumps(head).encode()
    stream.write(struct.pack("<II", len(text), len(data)) + text)
    stream.write(data)
    stream.flush()


def read_message(stream: Stream) -> tuple[dict[str, Any], bytes]:
    """Head and data of one message. Raises EOFError where the other side has ended or sends what is no message."""
    lengths = stream.read(8)
    if len(lengths) < 8:
        raise EOFError
    text_bytes, data_bytes = struct.unpack("<II", lengths)
    if text_bytes > _MOST_TEXT_BYTES or data_bytes > _MOST_DATA_BYTES:
        raise EOFError
    text, data = stream.read(text_bytes), stream.read(data_bytes)
    if len(text) < text_bytes or len(data) < data_bytes:
        raise EOFError
    try:
        head = json.loads(text)
    except ValueError as error:
        raise EOFError from error
    return (head, data) if isinstance(head, dict) else ({}, data)


def write_outputs(stream: Stream, names: Sequence[str], outputs: Sequence[Numbers]) -> None:
    """Send a model's outputs, by name: boxes, scores, labels, perhaps pictures."""
    arrays = [np.ascontiguousarray(each, _TYPES[name]) for name, each in zip(names, outputs)]
    shapes = {name: list(each.shape) for name, each in zip(names, arrays)}
    write_message(stream, {"shapes": shapes}, b"".join(each.tobytes() for each in arrays))


def outputs_from(head: Mapping[str, Any], data: bytes, names: Sequence[str]) -> tuple[Numbers, ...]:
    """A model's outputs from their shapes and bytes. Raises KeyError, TypeError or ValueError where they do not fit."""
    out, start = [], 0
    for name in names:
        shape = [int(each) for each in head["shapes"][name]]
        if len(shape) > 2 or min(shape, default=0) < 0 or max(shape, default=0) > _MOST_ROWS:
            raise ValueError(f"{name} of shape {shape}")
        kind = np.dtype(_TYPES[name])
        count = int(np.prod(shape, dtype=np.int64))
        out.append(np.frombuffer(data, kind, count, start).reshape(shape))
        start += count * kind.itemsize
    return tuple(out)
