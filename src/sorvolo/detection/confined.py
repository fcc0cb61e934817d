"""A model of unknown origin in a process of its own, with a limit on its memory: a kilobyte can ask for gigabytes."""

import json
import os
import struct
import subprocess
import sys
import weakref
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np

from sorvolo.child_process import python_command
from sorvolo.detection.contract import METADATA_KEY, info_from_metadata
from sorvolo.detection.engine import (
    CUDA,
    OUTPUTS,
    Engine,
    Planes,
    Provider,
    describe,
    open_engine,
)
from sorvolo.errors import InputError, SettingsError
from sorvolo.geometry.arrays import Numbers

MOST_BYTES = 6 << 30
"""Of memory that such a process may map on Linux: twice what the package's own models take for the largest tile."""

_PER_THREAD_BYTES = (
    160 << 20
)  # that a thread maps and hardly uses: its stack and its share of the heap
_MOST_TEXT_BYTES = 1 << 28  # settings and boxes as JSON, far more than any; by choice
_MOST_DATA_BYTES = 3 << 29  # of a picture or a model, 1.6 GB; by choice
_MOST_ROWS = 100_000  # boxes of a picture; by choice
_TYPES = {"boxes": np.float32, "scores": np.float32, "labels": np.int64}
# those that opening and running a model raise, as they are named between processes
_ERRORS = {"InputError": InputError, "SettingsError": SettingsError}


@dataclass(frozen=True)
class _Wish:
    """What the process is to do: describe the model, or run it."""

    where: str
    provider: Provider
    threads: int
    describes: bool


def confined_engine(model: bytes, where: str, provider: Provider, threads: int) -> Engine:
    """As `engine.open_engine`, in another process of at most `MOST_BYTES`.

    Raises what that raises, and InputError where the model asks for more memory or its process ends.
    """
    return _Process(model, _Wish(where, provider, threads, False)).engine()


def described_confined(model: bytes, where: str) -> Engine:
    """As `engine.describe`, in another process, which has ended when this returns: the engine cannot run."""
    process = _Process(model, _Wish(where, "cpu", 1, True))
    try:
        return process.engine()
    finally:
        process.end()


class _Process:
    """The other process, as seen from here. It ends with this object."""

    def __init__(self, model: bytes, wish: _Wish) -> None:
        self._wish = wish
        package = str(Path(__file__).parents[2])
        paths = [package, *filter(None, [os.environ.get("PYTHONPATH")])]
        self._child = subprocess.Popen(
            python_command(__name__),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)},
        )
        self.end = weakref.finalize(self, _end, self._child)
        self._send(wish.__dict__, model)

    def engine(self) -> Engine:
        """What runs the model there."""
        about, _ = self._receive()
        fixed = about["fixed_px"]
        return Engine(
            self._run,
            str(about["provider"]),
            str(about["metadata"]),
            info_from_metadata({METADATA_KEY: str(about["metadata"])}, self._wish.where),
            None if fixed is None else (int(fixed[0]), int(fixed[1])),
        )

    def _run(self, planes: Planes) -> tuple[Numbers, ...]:
        self._send({"shape": list(planes.shape)}, np.ascontiguousarray(planes, np.uint8).tobytes())
        head, data = self._receive()
        try:
            # A model's outputs from their shapes and bytes. Raises KeyError, TypeError or ValueError where they do not fit
            out, start = [], 0
            for name in OUTPUTS:
                shape = [int(each) for each in head["shapes"][name]]
                if (
                    len(shape) > 2
                    or min(shape, default=0) < 0
                    or max(shape, default=0) > _MOST_ROWS
                ):
                    raise ValueError(f"{name} of shape {shape}")
                kind = np.dtype(_TYPES[name])
                count = int(np.prod(shape, dtype=np.int64))
                out.append(np.frombuffer(data, kind, count, start).reshape(shape))
                start += count * kind.itemsize
            return tuple(out)
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(
                f"{self._wish.where} answers with no boxes, scores and labels ({error})"
            ) from error

    def _send(self, head: dict[str, Any], data: bytes) -> None:
        assert self._child.stdin is not None
        try:
            write_message(self._child.stdin, head, data)
        except (BrokenPipeError, OSError) as error:
            raise self._ended() from error

    def _receive(self) -> tuple[dict[str, Any], bytes]:
        assert self._child.stdout is not None
        try:
            head, data = read_message(self._child.stdout)
        except EOFError as error:
            raise self._ended() from error
        if (kind := head.get("error")) is not None:
            raise _ERRORS.get(kind, InputError)(str(head["text"]))
        return head, data

    def _ended(self) -> InputError:
        self.end()
        return InputError(
            f"{self._wish.where}: the process that ran this model ended; it asks for more than "
            f"{MOST_BYTES / (1 << 30):.0f} GB of memory or is damaged. Show it smaller tiles, or get another"
        )


def _end(child: "subprocess.Popen[bytes]") -> None:
    child.kill()
    for stream in (child.stdin, child.stdout):
        if stream is not None:
            try:
                stream.close()
            except OSError:
                pass  # what was still to be written goes nowhere
    child.wait()


def serve(source: IO[bytes], sink: IO[bytes]) -> None:
    """The other process: open the model that comes first, then answer pictures until there are no more."""
    head, model = read_message(source)
    wish = _Wish(**head)
    try:
        _limit(wish)
        engine = (
            describe(model, wish.where)
            if wish.describes
            else open_engine(model, wish.where, wish.provider, wish.threads)
        )
        about = {name: getattr(engine, name) for name in ("provider", "metadata", "fixed_px")}
        write_message(sink, about)
        while not wish.describes:
            head, data = read_message(source)
            found = engine.run(np.frombuffer(data, np.uint8).reshape(head["shape"]))
            arrays = [
                np.ascontiguousarray(each, _TYPES[name]) for name, each in zip(OUTPUTS, found)
            ]
            shapes = {name: list(each.shape) for name, each in zip(OUTPUTS, arrays)}
            write_message(sink, {"shapes": shapes}, b"".join(each.tobytes() for each in arrays))
    except (InputError, SettingsError) as error:
        write_message(sink, {"error": type(error).__name__, "text": f"{error}"})
    except EOFError:
        return  # nobody asks any more
    except Exception as error:
        reason = " ".join(str(error).split())[:200]
        text = (
            f"{wish.where}: the model cannot be run ({reason or type(error).__name__}); it may ask for more than "
            f"{MOST_BYTES / (1 << 30):.0f} GB of memory: show it smaller tiles, or get another"
        )
        write_message(sink, {"error": "InputError", "text": text})


def _limit(wish: _Wish) -> None:
    """Bound the memory that this process may map. Not where a GPU is used: its driver maps far more than it takes."""
    try:
        import resource
    except ImportError:  # Windows
        return
    import onnxruntime

    if wish.provider in ("auto", "cuda") and CUDA in onnxruntime.get_available_providers():
        return
    most = MOST_BYTES + wish.threads * _PER_THREAD_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (most, most))


def write_message(stream: IO[bytes], head: Mapping[str, Any], data: bytes = b"") -> None:
    """Send one message. Raises OSError where the other side has ended."""
    text = json.dumps(head).encode()
    stream.write(struct.pack("<II", len(text), len(data)) + text)
    stream.write(data)
    stream.flush()


def read_message(stream: IO[bytes]) -> tuple[dict[str, Any], bytes]:
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


if __name__ == "__main__":
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what libraries print is no answer
    serve(sys.stdin.buffer, answers)
