"""A TCP port of this machine that passes everything on to another, until it is cut or stalls: for tests of outages."""

import socket
import threading
from contextlib import suppress
from types import TracebackType
from typing import Self


class FaultyLink:
    """The link to a server at `port` of this machine, at a `port` of its own. A context manager: leaving cuts it."""

    def __init__(self, port: int) -> None:
        self._server = port
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        self._open: set[socket.socket] = set()
        self._passes = threading.Event()
        self._passes.set()
        self._start()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.cut()

    def cut(self) -> None:
        """End all connections and refuse new ones, as a server does that dies."""
        self._passes.set()
        for each in (self._listener, *self._open):
            with suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)
            each.close()
        self._open.clear()

    def stall(self) -> None:
        """Take connections, and pass nothing on."""
        self._passes.clear()

    def mend(self) -> None:
        """Pass on again, what waits first."""
        self._passes.set()
        if self._listener.fileno() == -1:
            self._listener = socket.create_server(("127.0.0.1", self.port))
            self._start()

    def _start(self) -> None:
        threading.Thread(target=self._accept, args=(self._listener,), daemon=True).start()

    def _accept(self, listener: socket.socket) -> None:
        while True:
            try:
                asker, _ = listener.accept()
            except OSError:  # it was cut
                return
            try:
                server = socket.create_connection(("127.0.0.1", self._server))
            except OSError:
                asker.close()
                continue
            self._open |= {asker, server}
            for pair in ((asker, server), (server, asker)):
                threading.Thread(target=self._pass_on, args=pair, daemon=True).start()

    def _pass_on(self, source: socket.socket, target: socket.socket) -> None:
        with suppress(OSError):
            while data := source.recv(65_536):
                self._passes.wait()
                target.sendall(data)
        for each in (
            source,
            target,
        ):  # one direction's end is the connection's: neither protocol half-closes
            with suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)
            each.close()
            self._open.discard(each)
