"""A station's side of streaming alone, over a real socket: what `sorvolo serve` joins into its application."""

import asyncio
import ssl
import threading
from http import HTTPStatus
from pathlib import Path
from typing import Any

from websockets.asyncio.server import ServerConnection, serve

from sorvolo.station.ingest import Ingest, IngestLimits
from sorvolo.station.stream_routes import SocketLink

TOKEN = "a-secret"
_LIMITS = IngestLimits(sync_s=0.02)


class SlowLink(SocketLink):
    """Each message takes `pause_s`."""

    def __init__(self, connection: ServerConnection, pause_s: float) -> None:
        super().__init__(connection)
        self._pause_s = pause_s

    async def receive(self) -> bytes:
        await asyncio.sleep(self._pause_s)
        return await super().receive()


class StreamServer:
    """Runs in a thread; `kill` cuts all links as a crash does, and `start` begins anew at the same port."""

    def __init__(
        self,
        folder: Path,
        *,
        limits: IngestLimits = _LIMITS,
        pause_s: float = 0.0,
        tls: ssl.SSLContext | None = None,
    ) -> None:
        self.folder, self._limits, self._pause_s, self._tls = folder, limits, pause_s, tls
        self.port = 0
        self.states: list[Any] = []

    def start(self) -> "StreamServer":
        self._loop = asyncio.new_event_loop()
        ready = threading.Event()
        self._thread = threading.Thread(target=self._run, args=(ready,), daemon=True)
        self._thread.start()
        assert ready.wait(60)
        return self

    def kill(self) -> None:
        self._loop.call_soon_threadsafe(self._cut)
        self._thread.join(5)

    def __enter__(self) -> "StreamServer":
        return self.start()

    def __exit__(self, *_: Any) -> None:
        if self._thread.is_alive():
            self.kill()

    @property
    def url(self) -> str:
        return f"{'http' if self._tls is None else 'https'}://127.0.0.1:{self.port}"

    def _run(self, ready: threading.Event) -> None:
        asyncio.set_event_loop(self._loop)
        self._loop.create_task(self._serve(ready))
        self._loop.run_forever()
        for task in asyncio.all_tasks(self._loop):
            task.cancel()
        self._loop.run_until_complete(asyncio.sleep(0.05))
        self._loop.close()

    async def _serve(self, ready: threading.Event) -> None:
        self.ingest = Ingest(
            self.folder, self._limits, lambda stream, state: self.states.append((stream, state))
        )

        async def talk(socket: Any) -> None:
            self._sockets.add(socket)
            stream = socket.request.path.rpartition("/")[2]
            await self.ingest.serve(stream, SlowLink(socket, self._pause_s))

        def check(socket: Any, request: Any) -> Any:
            if request.headers.get("Authorization") != f"Bearer {TOKEN}":
                return socket.respond(HTTPStatus.UNAUTHORIZED, "no")
            return None

        self._sockets: set[Any] = set()
        self._server = await serve(
            talk, "127.0.0.1", self.port, process_request=check, max_size=20_000_000, ssl=self._tls
        )
        self.port = next(iter(self._server.sockets)).getsockname()[1]
        ready.set()

    def _cut(self) -> None:
        for socket in self._sockets:
            socket.transport.abort()
        self._server.close()
        self._loop.call_later(0.1, self._loop.stop)
