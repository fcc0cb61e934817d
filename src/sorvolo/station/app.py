"""The station as one web application: its parts joined, its routes, the page."""

import asyncio
import logging
import shutil
import socket
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import uvicorn
from fastapi import APIRouter, Body, FastAPI, Query, Request, Response
from fastapi.responses import FileResponse, JSONResponse
from starlette.middleware.gzip import GZipMiddleware
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol

from sorvolo import __version__
from sorvolo.errors import SettingsError
from sorvolo.paths import Json
from sorvolo.station.collections import Findings, SiteCollections
from sorvolo.station.crops import FlightVideos, crop_routes, video_routes
from sorvolo.station.events import EventLog, event_routes
from sorvolo.station.exports import answer_raster_errors, cog_routes, export_routes
from sorvolo.station.ingest import Ingest, IngestLimits
from sorvolo.station.inputs import Inputs
from sorvolo.station.map_watch import MapWatch
from sorvolo.station.metrics import (
    Observer,
    StationMetrics,
    log_as_json,
    memory_bytes,
    metrics_routes,
)
from sorvolo.station.ogc_features import feature_routes, landing_links, stac_routes
from sorvolo.station.outward import Outward, OutwardSettings
from sorvolo.station.place import PlaceIndex, place_routes
from sorvolo.station.problems import PROBLEM_ANSWERS, Problem, answer_problems
from sorvolo.station.reviews import Drawings, Reviews, drawing_routes, review_routes
from sorvolo.station.runs import Runs, run_routes
from sorvolo.station.security import COOKIE, FOR_VIEWERS, Doorkeeper, holder_in
from sorvolo.station.settings import (
    DELETED_FOLDER,
    RUNS_FOLDER,
    STREAMS_FOLDER,
    StationSettings,
    check_exposure,
)
from sorvolo.station.site_deletion import SiteDeletion, site_deletion_routes
from sorvolo.station.sites import SiteShelf, readable, site_detail
from sorvolo.station.state import RootLock, StationState
from sorvolo.station.stream_routes import CameraDoor, announcing, stream_routes
from sorvolo.station.tiles import FloorTiles, WebTiles, wmts_routes
from sorvolo.station.tokens import has_tokens
from sorvolo.station.uploads import Uploads, upload_routes

PAGE_FOLDER = Path(__file__).parent / "page"
_PRESENT_S = 25.0  # after a page asked: it does every ten seconds
_FOR_EVER = "public, max-age=31536000, immutable"
_UPLOADS = "/api/uploads"
_BASE_MAP = "/api/base-map.pmtiles"


@dataclass(frozen=True)
class Station:
    """What all routes share."""

    settings: StationSettings
    state: StationState
    shelf: SiteShelf
    tiles: WebTiles
    floor_tiles: FloorTiles
    events: EventLog
    collections: SiteCollections
    reviews: Reviews
    drawings: Drawings
    ingest: Ingest
    uploads: Uploads
    inputs: Inputs
    runs: Runs
    map_watch: MapWatch
    videos: FlightVideos
    place_index: PlaceIndex
    findings: Findings
    lock: RootLock

    @classmethod
    def open(cls, settings: StationSettings) -> "Station":
        """Open the station's own files. Raises StoreError where they cannot be used, or another station uses them."""
        lock = RootLock(settings.state_folder)
        try:
            return cls._opened(settings, lock)
        except BaseException:
            lock.close()
            raise

    @classmethod
    def _opened(cls, settings: StationSettings, lock: RootLock) -> "Station":
        state, shelf = StationState.open(settings.state_folder), SiteShelf(settings.root)
        events, tiles = EventLog(state), WebTiles(shelf)
        uploads = Uploads(settings, events)
        findings = Findings(state, settings.state_folder / RUNS_FOLDER)
        drawings = Drawings(settings, shelf, events)
        collections = SiteCollections(shelf, findings, drawings.found)
        reviews = Reviews(state, shelf, events, collections)
        limits = IngestLimits(
            streams=settings.limits.most_streams, free_bytes=round(settings.free_floor_gb * 1e9)
        )
        ingest = Ingest(settings.root / STREAMS_FOLDER, limits, announcing(events))
        inputs = Inputs(settings, uploads, ingest.newest)
        return cls(
            settings,
            state,
            shelf,
            tiles,
            FloorTiles(shelf),
            events,
            collections,
            reviews,
            drawings,
            ingest,
            uploads,
            inputs,
            Runs(settings, state, shelf, events, inputs, ingest.show),
            MapWatch(shelf, tiles, reviews, events),
            FlightVideos(inputs),
            PlaceIndex(shelf),
            findings,
            lock,
        )

    def close(self) -> None:
        """Close every file."""
        self.map_watch.close()
        self.runs.close()
        self.uploads.close()
        self.place_index.close()
        self.shelf.close()
        self.state.close()
        self.lock.close()


def station_app(
    settings: StationSettings, receivers: OutwardSettings = OutwardSettings()
) -> FastAPI:
    """The application that serves the sites below the settings' root, and passes events on to the receivers.

    Raises StoreError as `Station.open`, InputError as `Outward`.
    """
    station = Station.open(settings)
    outward = Outward(receivers, station.events, station.ingest, settings.state_folder)
    door = CameraDoor(settings.camera_door, station.ingest)
    deletion = SiteDeletion(
        station.shelf,
        station.runs,
        station.reviews,
        station.drawings,
        settings.state_folder / DELETED_FOLDER,
    )
    metrics = StationMetrics(
        settings, station.ingest, station.events, station.runs.counts, outward.figures
    )

    @asynccontextmanager
    async def while_it_runs(_: FastAPI) -> AsyncIterator[None]:
        await asyncio.to_thread(deletion.clear)
        await door.open()
        station.runs.begin()
        station.map_watch.start()
        outward.start()
        yield
        await asyncio.to_thread(outward.close)
        await door.close()
        await station.ingest.close()
        station.close()

    app = FastAPI(
        title="Sorvolo station",
        version=__version__,
        lifespan=while_it_runs,
        docs_url=None,
        redoc_url=None,
        responses=PROBLEM_ANSWERS,
        description="Maps from small drones while they fly, what changed, what was found.",
    )
    app.state.station = station
    answer_problems(app, settings.root)
    answer_raster_errors(app)
    for router in (
        _about_routes(station),
        _site_routes(station),
        event_routes(station.events),
        feature_routes(station.collections, station.reviews),
        review_routes(station.reviews, station.shelf),
        crop_routes(station.shelf, station.findings),
        stream_routes(station.ingest, station.runs),
        metrics_routes(metrics),
        upload_routes(station.uploads, station.runs.unused),
        run_routes(station.runs, station.inputs, station.ingest),
        place_routes(
            station.shelf, station.collections, station.reviews, station.videos, station.place_index
        ),
        video_routes(station.shelf, station.collections, station.videos),
        drawing_routes(station.drawings),
        site_deletion_routes(deletion),
        export_routes(station.shelf, station.collections, station.reviews),
        wmts_routes(station.shelf),
        stac_routes(station.shelf),
        *cog_routes(station.shelf),
    ):
        app.include_router(router)
    _serve_page(app)
    app.add_middleware(_answering_heads)
    app.add_middleware(Doorkeeper, settings=settings, state=station.state, upload_path=_UPLOADS)
    # outermost: what the doorkeeper refuses counts, too
    app.add_middleware(Observer, count=metrics.count)
    return app


_TILES: dict[int | str, Json] = {
    200: {"description": "The tile", "content": {"image/webp": {}, "image/png": {}}},
    204: {"description": "Nothing of the map"},
}
_FLOOR_TILES: dict[int | str, Json] = {
    200: {"description": "The tile", "content": {"image/webp": {}}},
    204: {"description": "Too few pictures show it"},
}


def _about_routes(station: Station) -> APIRouter:
    router = APIRouter(tags=["station"])
    looked_s: dict[tuple[str, str], float] = {}  # by site and name, on the monotonic clock

    @router.get("/api/status")
    def status(request: Request, site: Annotated[str, Query(max_length=200)] = "") -> Json:
        """The station at a glance; with the `site` that a page shows, also the names of all who look at it now."""
        free, memory = shutil.disk_usage(station.settings.root).free, memory_bytes()
        holder, now_s = holder_in(request), time.monotonic()
        if site:
            looked_s[site, holder.name] = now_s
        for key, at_s in list(looked_s.items()):
            if now_s - at_s > _PRESENT_S:
                looked_s.pop(key, None)
        return {
            "present": sorted(name for at, name in list(looked_s) if at == site),
            "version": __version__,
            "role": holder.role.word,
            "name": holder.name,
            "sites": len(station.shelf.folders()),
            "disk_free_gb": round(free / 1e9, 2),
            "memory_mb": None if memory is None else round(memory / 1e6, 1),
            "disk_floor_gb": station.settings.free_floor_gb,
            "last_event": station.events.last,
            "base_map_url": None if station.settings.base_map is None else _BASE_MAP,
        }

    @router.get(_BASE_MAP, dependencies=FOR_VIEWERS, response_class=FileResponse)
    def base_map() -> Response:
        """The base map as PMTiles, read in ranges; 404 where the station was given none."""
        path = station.settings.base_map
        if path is None or not path.is_file():
            raise Problem(
                404, "this station has no base map; start it with --base-map FILE.pmtiles"
            )
        return FileResponse(
            path,
            media_type="application/octet-stream",
            headers={"cache-control": "private, no-cache"},
        )

    @router.post("/api/session")
    async def log_in(
        request: Request, token: Annotated[str, Body(embed=True, max_length=200)]
    ) -> JSONResponse:
        """Exchange a token for a cookie that scripts cannot read."""
        doorkeeper: Doorkeeper = request.scope["state"]["doorkeeper"]
        holder = await doorkeeper.look_at(token, request)
        answer = JSONResponse({"name": holder.name, "role": holder.role.word})
        answer.set_cookie(
            COOKIE,
            token,
            httponly=True,
            samesite="strict",
            secure=station.settings.is_secure,
            path="/",
        )
        return answer

    @router.delete("/api/session", status_code=204)
    def log_out() -> Response:
        """Forget the cookie."""
        answer = Response(status_code=204)
        answer.delete_cookie(COOKIE, path="/")
        return answer

    return router


def _site_routes(station: Station) -> APIRouter:
    router = APIRouter(prefix="/api/sites", tags=["sites"], dependencies=FOR_VIEWERS)

    @router.get("")
    def sites() -> list[Json]:
        """Every site below the root."""
        return readable(station.shelf)

    @router.get("/{site}")
    def one_site(request: Request, site: str) -> Json:
        """A site with its versions and flights, and the revision of its live map."""
        detail = site_detail(site, station.shelf.open(site))
        revision = (
            station.tiles.live(site).revision
            if detail["versions"] or detail["bounds_wgs84"]
            else None
        )
        return {
            **detail,
            "live_revision": revision,
            "under_trees": station.floor_tiles.about(site),
            "links": landing_links(request, site),
        }

    @router.get(
        "/{site}/tiles/{version}/{z}/{x}/{y}.{kind}", response_class=Response, responses=_TILES
    )
    def tile(
        site: str, version: str, z: int, x: int, y: int, kind: Literal["webp", "png"]
    ) -> Response:
        """A Web Mercator tile, 256 px; `version` is a number, `live-REVISION` or `live`. 204 where the map is not."""
        answer = station.tiles.tile(site, version, z, x, y, f".{kind}")
        kept = _FOR_EVER.replace("public", "private") if answer.is_final else "no-cache"
        return Response(
            answer.data,
            200 if answer.data else 204,
            {"cache-control": kept},
            f"image/{kind}" if answer.data else None,
        )

    @router.get(
        "/{site}/under-trees/{run}/{up_m}/{z}/{x}/{y}.webp",
        response_class=Response,
        responses=_FLOOR_TILES,
    )
    def floor_tile(site: str, run: str, up_m: float, z: int, x: int, y: int) -> Response:
        """A tile of a look below crowns, its pictures put together `up_m` metres above the site's level. 204: too few."""
        data = station.floor_tiles.tile(site, run, up_m, z, x, y)
        kept = _FOR_EVER.replace("public", "private")
        status, kind = (200, "image/webp") if data else (204, None)
        return Response(data, status, {"cache-control": kept}, kind)

    return router


def _serve_page(app: FastAPI) -> None:
    """The page at / and its files below /page/, whose addresses carry what they are made of."""

    @app.get("/", include_in_schema=False)
    def page() -> Response:
        return FileResponse(PAGE_FOLDER / "index.html", headers={"cache-control": "no-cache"})

    files = GZipMiddleware(_PageFiles(directory=PAGE_FOLDER), compresslevel=6)
    app.mount("/page", files, name="page")


def _answering_heads(app: ASGIApp) -> ASGIApp:
    """ASGI middleware: HEAD is answered as GET is, without the body."""

    async def answered(scope: Scope, receive: Receive, send: Send) -> None:
        async def sending(message: Message) -> None:
            if message["type"] == "http.response.start":
                await send(message)
                await send({"type": "http.response.body"})

        if scope.get("method") != "HEAD":
            await app(scope, receive, send)
            return
        # the extension keeps files from being read for a body that nobody gets
        asked = {**scope, "method": "GET", "extensions": {"http.response.pathsend": {}}}
        await app(asked, receive, sending)
        scope["route"] = asked.get("route")

    return answered


class _PageFiles(StaticFiles):
    """Files of the page: kept by browsers for ever where the address names the content (?v=HASH), else asked again."""

    def file_response(self, *args: Any, **kwargs: Any) -> Response:
        """The file, with how long it may be kept."""
        response = super().file_response(*args, **kwargs)
        scope = kwargs.get("scope") or args[2]
        is_named = scope.get("query_string", b"").startswith(b"v=")
        response.headers["cache-control"] = _FOR_EVER if is_named else "no-cache"
        response.headers["service-worker-allowed"] = "/"
        return response


_MOST_MESSAGE_BYTES = 16_000_000  # of one WebSocket message: a key frame of 4K video takes a tenth


def run_station(
    settings: StationSettings,
    announce: Callable[[], None],
    receivers: OutwardSettings,
    *,
    logs_json: bool,
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
        http=_Connection,
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


class _Connection(H11Protocol):
    """A connection that keeps nobody out: what asks nothing is closed, the longest silent first.

    A head that comes byte by byte is silence, and so is a body of which nothing comes.
    """

    _SILENT_S = 20.0
    _MOST_SILENT = 128  # browsers hold six, and close them after five seconds

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self._since_s = self.loop.time()
        self.loop.call_later(self._SILENT_S, self._look)
        own = (each for each in self.connections if isinstance(each, _Connection))
        silent = sorted((each for each in own if each._is_silent()), key=lambda each: each._since_s)
        for each in silent[: -self._MOST_SILENT]:
            each.transport.abort()

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        if self.cycle is not None and not self.cycle.response_complete:
            self._since_s = self.loop.time()

    def on_response_complete(self) -> None:
        self._since_s = self.loop.time()
        super().on_response_complete()

    def _is_silent(self) -> bool:
        """Whether a request is waited for, or more of one; not while its answer is on its way."""
        waits = self.cycle is None or self.cycle.response_complete or self.cycle.more_body
        return waits and not self.transport.get_write_buffer_size()

    def _look(self) -> None:
        if self not in self.connections:  # closed, or a WebSocket
            return
        left_s = self._since_s + self._SILENT_S - self.loop.time()
        if left_s <= 0 and self._is_silent():
            self.transport.abort()
        self.loop.call_later(max(left_s, 1.0), self._look)


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
