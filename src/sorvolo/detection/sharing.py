"""A model that runs in a process which several share (`shared_process`), asked through a Unix socket.

An asker has no model of its own. It has one picture at a time there, and waits for the answer: who brings pictures
faster than they can be searched is held back, as by a detector of its own.
"""

import socket
from pathlib import Path
from typing import Any

import numpy as np

from sorvolo.detection.confined import ERRORS, engine_from
from sorvolo.detection.engine import OUTPUTS, Engine, Planes
from sorvolo.detection.process_messages import outputs_from, read_message, write_message
from sorvolo.errors import InputError
from sorvolo.geometry.arrays import Numbers

READY = b"ready\n"
"""What the process writes when it listens."""


class SharedDetectorGone(ConnectionError):
    """The process that held the models has ended, or cannot be reached: the asker's work is to be tried again."""


def shared_engine(address: str, path: Path) -> Engine:
    """The model of this file, as the process at the socket `address` runs it.

    Raises what opening it raises there, and SharedDetectorGone; so does a picture that is shown to it later.
    """
    asker = _Asker(address)
    about = asker.asked({"model": str(path.resolve())})
    return engine_from(about[0], str(path), asker.run)


def answers(address: str, within_s: float) -> bool:
    """Whether the process at the socket `address` answers within so many seconds; no model is asked."""
    with socket.socket(socket.AF_UNIX) as asking:
        asking.settimeout(within_s)
        try:
            asking.connect(address)
            with asking.makefile("rwb") as stream:
                write_message(stream, {})
                read_message(stream)
        except (OSError, EOFError):
            return False
    return True


class _Asker:
    """One connection to the process. It ends with this object."""

    def __init__(self, address: str) -> None:
        self._address = address
        self._socket = socket.socket(socket.AF_UNIX)
        try:
            self._socket.connect(address)
        except OSError as error:
            raise self._gone(error) from error
        self._stream = self._socket.makefile("rwb")

    def asked(
        self, head: dict[str, Any], data: bytes | memoryview = b""
    ) -> tuple[dict[str, Any], bytes]:
        """The answer to a message."""
        try:
            write_message(self._stream, head, data)
            answer, found = read_message(self._stream)
        except (OSError, EOFError) as error:
            raise self._gone(error) from error
        if (kind := answer.get("error")) is not None:
            raise ERRORS.get(kind, InputError)(str(answer["text"]))
        return answer, found

    def run(self, planes: Planes) -> tuple[Numbers, ...]:
        """Boxes, scores and labels of one picture."""
        head, data = self.asked(
            {"shape": list(planes.shape)}, np.ascontiguousarray(planes).data.cast("B")
        )
        return outputs_from(head, data, OUTPUTS)

    def _gone(self, error: Exception) -> SharedDetectorGone:
        reason = str(error) or type(error).__name__
        return SharedDetectorGone(
            f"the detector that this flight shares with others has ended ({reason})"
        )
