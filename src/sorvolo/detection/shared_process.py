"""A process that holds the models for several others of its machine; it ends when nobody holds its input."""

import os
import socket
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np

from sorvolo.detection.batching import Batcher
from sorvolo.detection.confined import about_engine
from sorvolo.detection.engine import OUTPUTS, Engine
from sorvolo.detection.process_messages import read_message, write_message, write_outputs
from sorvolo.detection.session import opened_engine
from sorvolo.detection.sharing import READY
from sorvolo.errors import InputError, SettingsError


class Models:
    """The models of the process, each opened when it is first asked for. `batcher` changes it, in any thread."""

    def __init__(self, opened: Callable[[Path], Engine]) -> None:
        self._opened = opened
        self._batchers: dict[str, tuple[Engine, Batcher]] = {}
        self._lock = threading.Lock()

    def batcher(self, path: Path) -> tuple[Engine, Batcher]:
        """The model of a file. Raises as `opened` does."""
        with self._lock:
            if str(path) not in self._batchers:
                engine = self._opened(path)
                self._batchers[str(path)] = engine, Batcher(engine)
            return self._batchers[str(path)]


def serve(listening: socket.socket, models: Models) -> None:
    """Answer whoever connects, each in a thread of its own, until the socket is closed."""
    while True:
        try:
            connection, _ = listening.accept()
        except OSError:  # it is closed
            return
        threading.Thread(target=_answer, args=(connection, models), daemon=True).start()


def _answer(connection: socket.socket, models: Models) -> None:
    """Answer one asker until it has ended."""
    with connection, connection.makefile("rwb") as stream, suppress(OSError, EOFError):
        head, _ = read_message(stream)
        if "model" not in head:  # whether anybody is here
            write_message(stream, {})
            return
        try:
            engine, batcher = models.batcher(Path(str(head["model"])))
            write_message(stream, about_engine(engine))
            while True:
                head, data = read_message(stream)
                planes = np.frombuffer(data, np.uint8).reshape(head["shape"])
                write_outputs(stream, OUTPUTS, batcher.ask(planes))
        except (InputError, SettingsError) as error:
            write_message(stream, {"error": type(error).__name__, "text": str(error)})


def main(address: str) -> int:
    """Hold models for those who connect to the socket `address`, until nobody holds this process's input."""
    ready = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # what libraries print is no answer
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(address)
        listening.listen()
        ready.write(READY)
        ready.flush()
        threading.Thread(target=serve, args=(listening, Models(opened_engine)), daemon=True).start()
        while os.read(sys.stdin.fileno(), 4096):
            pass
    os._exit(0)  # askers whose pictures still run are gone, too


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
