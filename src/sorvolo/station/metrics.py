"""What the station logs and counts of its requests, and its figures for Prometheus."""

import json
import logging
import os
import shutil
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from fastapi import APIRouter, Response
from prometheus_client import CollectorRegistry, Counter, Histogram, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.exposition import CONTENT_TYPE_LATEST
from prometheus_client.registry import Collector
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from sorvolo.station.events import EventLog
from sorvolo.station.ingest import Ingest
from sorvolo.station.relays import RelayFigures
from sorvolo.station.security import FOR_VIEWERS
from sorvolo.station.settings import StationSettings
from sorvolo.station.state import utc_now
from sorvolo.station.tokens import Holder

# upper limits of the counted times, about threefold each, around the targets of tiles and pages
_SECONDS = (0.005, 0.01, 0.03, 0.06, 0.1, 0.3, 1.0, 3.0, 10.0)

_OF_STREAM = (
    (GaugeMetricFamily, "stream_connected", "Whether the drone sends"),
    (CounterMetricFamily, "stream_frames", "Pictures taken from a drone"),
    (GaugeMetricFamily, "stream_frames_per_second", "Pictures a second"),
    (GaugeMetricFamily, "stream_kept_bytes", "What is kept of a stream"),
    (GaugeMetricFamily, "stream_viewers", "Browsers that watch"),
)
_OF_RECEIVER = (
    (CounterMetricFamily, "relay_delivered", "Events a receiver took"),
    (CounterMetricFamily, "relay_lost", "Events a receiver refused, or too old"),
    (GaugeMetricFamily, "relay_waiting", "Events not looked at yet"),
)


class StationMetrics(Collector):
    """The figures of one station, in a registry of its own. `count` adds a request; others are read when asked for.

    `runs`: how many missions there are in each state.
    """

    def __init__(
        self,
        settings: StationSettings,
        ingest: Ingest,
        events: EventLog,
        runs: Callable[[], Mapping[str, int]],
        relays: Callable[[], Sequence[RelayFigures]],
    ) -> None:
        self._settings, self._ingest, self._events = settings, ingest, events
        self._runs, self._relays = runs, relays
        self.registry = CollectorRegistry()
        self._requests = Counter(
            "sorvolo_http_requests",
            "Requests answered",
            ("route", "method", "status"),
            registry=self.registry,
        )
        self._seconds = Histogram(
            "sorvolo_http_request_seconds",
            "Time to answer a request",
            ("route",),
            registry=self.registry,
            buckets=_SECONDS,
        )
        self.registry.register(self)

    def count(self, route: str, method: str, status: int, seconds: float) -> None:
        """A request was answered; `route` is the route's pattern, so that ids make no new series."""
        self._requests.labels(route, method, str(status)).inc()
        self._seconds.labels(route).observe(seconds)

    def collect(self) -> Iterator[Metric]:
        """See `prometheus_client.registry.Collector`."""
        free = shutil.disk_usage(self._settings.root).free
        yield GaugeMetricFamily("sorvolo_disk_free_bytes", "Free disk space", free)
        yield GaugeMetricFamily(
            "sorvolo_disk_floor_bytes",
            "Free disk space below which nothing is taken in",
            self._settings.free_floor_gb * 1e9,
        )
        missions = GaugeMetricFamily(
            "sorvolo_missions", "Missions by how they stand or ended", labels=["state"]
        )
        for state, count in sorted(self._runs().items()):
            missions.add_metric([state], count)
        yield missions
        if (memory := memory_bytes()) is not None:
            yield GaugeMetricFamily(
                "sorvolo_memory_bytes", "Resident memory of the station's process", memory
            )
        yield CounterMetricFamily("sorvolo_events", "Events so far", self._events.last)
        ingest = self._ingest
        yield from _families(
            "stream",
            _OF_STREAM,
            {
                state["stream"]: (
                    state["is_connected"],
                    state.get("frames", 0),
                    (state["is_connected"] and state.get("frames_per_s")) or 0.0,
                    ingest.kept_bytes(state["stream"]),
                    ingest.viewers(state["stream"]),
                )
                for state in ingest.streams()
            },
        )
        relays = {each.name: (each.delivered, each.lost, each.waiting) for each in self._relays()}
        yield from _families("receiver", _OF_RECEIVER, relays)


def _families(
    label: str, kinds: Sequence[tuple[Any, str, str]], items: Mapping[str, Sequence[float]]
) -> Iterator[Metric]:
    """A family of each kind, with the values of all items."""
    for column, (kind, name, words) in enumerate(kinds):
        family = kind(f"sorvolo_{name}", words, labels=[label])
        for item, values in items.items():
            family.add_metric([item], float(values[column]))
        yield family


def metrics_routes(metrics: StationMetrics) -> APIRouter:
    """`/metrics`, for whoever may view the station."""
    router = APIRouter(tags=["station"])

    @router.get("/metrics", dependencies=FOR_VIEWERS, response_class=Response)
    def show_metrics() -> Response:
        """All figures in Prometheus' text format."""
        return Response(generate_latest(metrics.registry), media_type=CONTENT_TYPE_LATEST)

    return router


def memory_bytes() -> int | None:
    """Resident memory of this process; None where the system does not report it."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError, IndexError):
        return None


_LOG = logging.getLogger("sorvolo.station.requests")
_KEPT = frozenset(vars(logging.makeLogRecord({}))) | {
    "message",
    "asctime",
    "taskName",
    "color_message",
}

_METHODS = frozenset({"GET", "HEAD", "OPTIONS", "POST", "PUT", "PATCH", "DELETE", "WS"})

Count = Callable[[str, str, int, float], None]
"""Called with a request's route, method, status and seconds."""


class JsonLines(logging.Formatter):
    """A record as one JSON object a line: time (RFC 3339, UTC), level, logger, message, and what else it carries."""

    def format(self, record: logging.LogRecord) -> str:
        """The line."""
        line: dict[str, Any] = {
            "time": utc_now(),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
        }
        line |= {
            name: value
            for name, value in vars(record).items()
            if name not in _KEPT and name not in line
        }
        if record.exc_info:
            line["traceback"] = self.formatException(record.exc_info)
        return json.dumps(line, ensure_ascii=False, default=str)


def log_as_json() -> None:
    """Let everything that the station and its libraries log go to stderr as JSON lines; requests too."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonLines())
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(logging.WARNING)
    for name in ("sorvolo", "uvicorn"):
        logger = logging.getLogger(name)
        logger.handlers.clear()
        logger.propagate = True
    logging.getLogger("sorvolo").setLevel(logging.INFO)


class Observer:
    """ASGI middleware around everything: counts and logs each request, also those that are refused.

    A query is never logged: it may hold places, or a secret. Neither are tokens; who asked is logged by name.
    """

    def __init__(self, app: ASGIApp, count: Count) -> None:
        self._app, self._count = app, count

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Let a request through and note how it went."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        status, began_s = 0, time.monotonic()

        async def sending(message: Message) -> None:
            nonlocal status
            if message["type"] in ("http.response.start", "websocket.http.response.start"):
                status = message["status"]
            elif message["type"] == "websocket.accept":
                status = 101
            await send(message)

        try:
            await self._app(scope, receive, sending)
        finally:
            seconds = time.monotonic() - began_s
            method = scope.get("method", "WS")
            # a client may invent as many as it likes
            method = method if method in _METHODS else "other"
            self._count(_pattern(scope, status), method, status, seconds)
            _log(scope, method, status, seconds)


def _log(scope: Scope, method: str, status: int, seconds: float) -> None:
    client = scope.get("client")
    holder = scope.get("state", {}).get("holder")
    _LOG.log(
        logging.WARNING if status >= 500 else logging.INFO,
        "%s %s %d",
        method,
        scope["path"],
        status,
        extra={
            "method": method,
            "path": scope["path"],
            "status": status,
            "ms": round(1000 * seconds, 1),
            "client": client[0] if client else None,
            "who": holder.name if isinstance(holder, Holder) else None,
        },
    )


def _pattern(scope: Scope, status: int) -> str:
    """The route's pattern, such as /api/sites/{site}; one word for all that none fits."""
    path = getattr(scope.get("route"), "path", "")
    if path:
        return str(path)
    return "refused" if status in (401, 403, 421, 429) else "other"
