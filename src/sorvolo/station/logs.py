"""What the station logs: a line for each request and for what goes wrong, as text or as JSON."""

import json
import logging
import sys
import time
from collections.abc import Callable
from datetime import UTC, datetime
from typing import Any

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from sorvolo.station.tokens import Holder

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
        at = (
            datetime.fromtimestamp(record.created, UTC)
            .isoformat(timespec="milliseconds")
            .replace("+00:00", "Z")
        )
        line: dict[str, Any] = {
            "time": at,
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
            method = (
                method if method in _METHODS else "other"
            )  # a client may invent as many as it likes
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
