"""An S3 server that may be killed at any moment and comes back with all that it had answered for: moto's, with a log.

moto keeps objects in memory. Here each change is written into a log before it is answered, and done again, from the
log's beginning, before the server listens again: as a store on a disk, it forgets only what was acknowledged to nobody.
"""

import io
import os
import pickle
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from fake_bucket import BUCKET

_READING = ("GET", "HEAD", "OPTIONS")
_LENGTHS = struct.Struct("<QQ")  # of a request's variables and of its body
_UP_WITHIN_S = 60.0


class KilledBucket:
    """The server, a process at a port of its own that stays the same, with the bucket. A context manager."""

    def __init__(self) -> None:
        pytest.importorskip(
            "moto.server", reason="needs moto's S3 server: pip install 'moto[server]'"
        )
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.endpoint = f"http://127.0.0.1:{self.port}"
        self._folder = tempfile.TemporaryDirectory(prefix="sorvolo-bucket-")
        self._process: subprocess.Popen[bytes] | None = None
        self.start()
        urllib.request.urlopen(urllib.request.Request(f"{self.endpoint}/{BUCKET}", method="PUT"))

    def __enter__(self) -> "KilledBucket":
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()
        self._folder.cleanup()

    def start(self, dies_after: int = 0) -> None:
        """Listen again. With `dies_after` it kills itself once it has made so many changes, the last one unanswered."""
        self._process = subprocess.Popen(
            [
                sys.executable,
                __file__,
                str(self.port),
                str(Path(self._folder.name, "log")),
                str(dies_after),
            ],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        end_s = time.monotonic() + _UP_WITHIN_S
        while True:
            with suppress(OSError):
                socket.create_connection(("127.0.0.1", self.port), timeout=5.0).close()
                return
            assert self._process.poll() is None and time.monotonic() < end_s, (
                "the S3 server does not start"
            )
            time.sleep(0.05)

    def stop(self) -> None:
        """Kill it: whoever waits for an answer gets none."""
        assert self._process is not None
        self._process.kill()
        self._process.wait()

    def wait_for_its_end(self) -> int:
        """Wait until it has killed itself; the signal."""
        assert self._process is not None
        return -self._process.wait(timeout=120.0)


class _Logged:
    """A WSGI application whose changes are in a log before they are answered."""

    def __init__(self, app: Callable[..., Iterable[bytes]], log: Path, dies_after: int) -> None:
        self._app, self._left = app, dies_after
        self._one_at_a_time = threading.Lock()  # the log has the order in which they were made
        log.touch()
        whole = 0
        for environ, body, end in _entries(log):
            self._answered(environ, body)
            whole = end
        os.truncate(log, whole)  # the last entry may be torn
        self._log = log.open("ab", buffering=0)

    def __call__(
        self, environ: dict[str, Any], start_response: Callable[..., Any]
    ) -> Iterable[bytes]:
        if environ["REQUEST_METHOD"] in _READING:
            return self._app(environ, start_response)
        body = environ["wsgi.input"].read(int(environ.get("CONTENT_LENGTH") or 0))
        plain = {name: each for name, each in environ.items() if isinstance(each, str)}
        with self._one_at_a_time:
            status, headers, answer = self._answered(plain, body)
            if status.startswith("2"):
                head = pickle.dumps(plain)
                self._log.write(_LENGTHS.pack(len(head), len(body)) + head + body)
                self._left -= 1
                if self._left == 0:
                    os.kill(os.getpid(), signal.SIGKILL)
        start_response(status, headers)
        return [answer]

    def _answered(
        self, environ: dict[str, str], body: bytes
    ) -> tuple[str, list[tuple[str, str]], bytes]:
        from werkzeug.test import run_wsgi_app

        served: dict[str, Any] = {
            **environ,
            "wsgi.input": io.BytesIO(body),
            "wsgi.errors": sys.stderr,
            "wsgi.version": (1, 0),
            "wsgi.multithread": True,
            "wsgi.multiprocess": False,
            "wsgi.run_once": False,
        }
        answer, status, headers = run_wsgi_app(self._app, served, buffered=True)
        return status, list(headers), b"".join(answer)


def _entries(log: Path) -> Iterator[tuple[dict[str, str], bytes, int]]:
    """The whole entries of a log: the request's variables, its body, and where the entry ends."""
    with log.open("rb") as file:
        while len(lengths := file.read(_LENGTHS.size)) == _LENGTHS.size:
            head_bytes, body_bytes = _LENGTHS.unpack(lengths)
            head, body = file.read(head_bytes), file.read(body_bytes)
            if len(head) < head_bytes or len(body) < body_bytes:
                return
            yield pickle.loads(head), body, file.tell()


def main(port: int, log: Path, dies_after: int) -> None:
    """Serve."""
    from moto.moto_server.werkzeug_app import (
        DomainDispatcherApplication,
        MotoRequestHandler,
        create_backend_app,
    )
    from werkzeug.serving import make_server

    app = _Logged(DomainDispatcherApplication(create_backend_app), log, dies_after)
    make_server("127.0.0.1", port, app, True, request_handler=MotoRequestHandler).serve_forever()


if __name__ == "__main__":
    main(int(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]))
