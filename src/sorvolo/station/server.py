"""The station's process: opened, announced, served until somebody ends it."""

import asyncio
import logging
import socket
from collections.abc import Callable

import uvicorn
from fastapi import FastAPI

from sorvolo.errors import SettingsError
from sorvolo.station.app import Station, station_app
from sorvolo.station.logs import log_as_json
from sorvolo.station.outward import OutwardSettings
from sorvolo.station.settings import StationSettings, check_exposure
from sorvolo.station.tokens import has_tokens

_MOST_MESSAGE_BYTES = 16_000_000  # of one WebSocket message: a key frame of 4K video takes a tenth


def run_station(
    settings: StationSettings,
    announce: Callable[[], None],
    receivers: OutwardSettings = OutwardSettings(),
    *,
    logs_json: bool = False,
) -> None:
    """Serve until Ctrl-C or SIGTERM; `announce` is called once it listens.

    Raises SettingsError where others could reach it unprotected or the port is taken, StoreError as `Station.open`.
    """
    if logs_json:
        log_as_json()
    app = station_app(settings, receivers)
    station: Station = app.state.station
    try:
        check_exposure(settings, has_tokens=has_tokens(station.state))
        listening = _listening(settings)
        server = _Announcing(server_config(app, settings), announce)
        logging.getLogger("uvicorn.error").setLevel(logging.ERROR)
        with listening:
            asyncio.run(server.serve([listening]))
    finally:
        station.close()


def server_config(app: FastAPI, settings: StationSettings) -> uvicorn.Config:
    """How the application is served. Who asked is taken from a proxy's word only where the settings name one."""
    return uvicorn.Config(
        app,
        settings.host,
        settings.port,
        log_level="warning",
        access_log=False,
        server_header=False,
        log_config=None,
        ws="websockets-sansio",
        ws_max_size=_MOST_MESSAGE_BYTES,
        proxy_headers=bool(settings.public_url),
        forwarded_allow_ips=["127.0.0.1", "::1"],
        limit_concurrency=settings.limits.most_connections,
        timeout_graceful_shutdown=2,
        ssl_certfile=settings.tls_cert,
        ssl_keyfile=settings.tls_key,
        h11_max_incomplete_event_size=64_000,
    )


def _listening(settings: StationSettings) -> socket.socket:
    """The socket to listen at. Raises SettingsError where it cannot be had."""
    family = socket.AF_INET6 if ":" in settings.host else socket.AF_INET
    # the protocol is named: asyncio sends small answers at once (TCP_NODELAY) only where it is
    listening = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    try:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listening.bind((settings.host, settings.port))
        listening.listen(256)
        return listening
    except OSError as error:
        listening.close()
        raise SettingsError(
            f"cannot listen at {settings.host}:{settings.port} ({error.strerror}): another program does, or the "
            "address is not this machine's; choose another --port or --host"
        ) from error


class _Announcing(uvicorn.Server):
    """A server that announces that it listens."""

    def __init__(self, config: uvicorn.Config, announce: Callable[[], None]) -> None:
        super().__init__(config)
        self._announce = announce

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Listen, then announce it."""
        await super().startup(sockets)
        if self.started:
            self._announce()
