"""Who may ask what: host names, origins, tokens, sizes, and the headers that keep a page to its own."""

import asyncio
import ipaddress
import re
import socket
import time
from collections import Counter
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import quote, urlsplit

from fastapi import Depends
from starlette.exceptions import HTTPException
from starlette.requests import HTTPConnection
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from sorvolo.station.problems import Problem, problem_answer
from sorvolo.station.settings import StationSettings, is_loopback
from sorvolo.station.state import StationState
from sorvolo.station.tokens import Guesses, Holder, Role, has_tokens, holder_of, known_id_of

COOKIE = "sorvolo_session"
_MOST_BODY_BYTES = 1_000_000  # of a request; an area of 10,000 corners has half of it
_ANYBODY = re.compile(r"/(page/.*|api/session|favicon\.ico)?")
LOOK_AGAIN_S = 10.0  # at the token of a live channel
_EVENTS = "/api/events"
_SAFE_METHODS = frozenset({"GET", "HEAD", "OPTIONS"})
_HEADERS = {
    "content-security-policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; font-src 'self'; "
        "connect-src 'self'; worker-src 'self' blob:; media-src 'self' blob:; manifest-src 'self'; base-uri 'none'; "
        "form-action 'self'; frame-ancestors 'none'"
    ),
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "permissions-policy": "camera=(), microphone=(), geolocation=(self)",
}


class Doorkeeper:
    """ASGI middleware before everything else: checks host, origin, token and size of every request and WebSocket.

    What passes carries a `Holder` in its state. Takes `upload_path`, a prefix whose bodies have limits of their own.
    """

    def __init__(
        self, app: ASGIApp, settings: StationSettings, state: StationState, upload_path: str
    ) -> None:
        self._app = app
        self._settings = settings
        self._state = state
        self._upload_path = upload_path
        self._guesses = Guesses()
        self._live: Counter[str] = Counter()  # channels that are open, by address

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Let a request through, or answer it with a problem."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        sending = _with_headers(send, self._settings) if scope["type"] == "http" else send
        connection = HTTPConnection(scope)
        try:
            check_host(connection.headers.get("host", ""), self._settings)
            check_origin(
                connection, self._settings.public_origin, is_websocket=scope["type"] == "websocket"
            )
            holder = await self._holder(connection)
            scope["state"] = {**scope.get("state", {}), "holder": holder, "doorkeeper": self}
            if scope["type"] == "websocket" or scope["path"] == _EVENTS:
                await self._keep_live(connection, receive, sending)
                return
            if not scope["path"].startswith(self._upload_path):
                receive = _limited(connection, receive)
            await self._app(scope, receive, sending)
        except Problem as problem:
            await problem_answer(problem)(scope, receive, sending)

    async def _keep_live(self, connection: HTTPConnection, receive: Receive, send: Send) -> None:
        """Pass on a WebSocket, or the events as text: counted while open, ended once its token is void.

        Raises Problem (429) for one too many of an address.
        """
        address = address_group(connection.client.host if connection.client else "")
        most = self._settings.limits.most_live_per_address
        if self._live[address] >= most:
            raise Problem(
                429, f"{address} keeps {most} live channels open already; close some of its pages"
            )
        looked_s, has_ended = time.monotonic(), False

        async def sending(message: Message) -> None:
            nonlocal looked_s, has_ended
            if time.monotonic() - looked_s >= LOOK_AGAIN_S and not has_ended:
                looked_s = time.monotonic()
                try:
                    await self._holder(connection)
                except Problem:
                    has_ended = True
                    is_socket = connection.scope["type"] == "websocket"
                    await send({"type": "websocket.close" if is_socket else "http.response.body"})
            if not has_ended:
                await send(message)

        self._live[address] += 1
        try:
            await self._app(connection.scope, receive, sending)
        finally:
            self._live[address] -= 1
            if not self._live[address]:
                del self._live[address]

    async def _holder(self, connection: HTTPConnection) -> Holder:
        """Who asks. Raises Problem (401, 429) where nobody who may."""
        if not await asyncio.to_thread(has_tokens, self._state):
            if self._settings.is_private:
                return Holder("this machine", Role.OPERATE)
            raise Problem(
                401, "this station needs tokens and has none; make one with `sorvolo token`"
            )
        # not looked at: an old cookie must not keep its owner out
        if _ANYBODY.fullmatch(connection.scope["path"]):
            return Holder("", Role.VIEW)
        token = sent_token(connection)
        if not token:
            raise Problem(
                401,
                "a token is needed: send it as `Authorization: Bearer TOKEN`, or log in on the page",
                headers={"WWW-Authenticate": "Bearer"},
            )
        return await self.look_at(token, connection)

    async def look_at(self, token: str, connection: HTTPConnection) -> Holder:
        """Whose token it is. Raises Problem (401; 429 where the address sent too many wrong ones).

        Guesses at a token that there is count for its id alone, so that nobody behind the same address can keep the
        holders of other tokens out: ids are random, and only a token's holder knows its own.
        """
        address = connection.client.host if connection.client else ""
        known_id = await asyncio.to_thread(known_id_of, self._state, token)
        source = f"{address_group(address)} {known_id}"
        if (wait_s := self._guesses.wait_s(source)) > 0:
            raise Problem(
                429,
                f"too many wrong tokens came from {address}; wait {wait_s:.0f} s and try again",
                headers={"Retry-After": str(int(wait_s) + 1)},
            )
        holder = await asyncio.to_thread(holder_of, self._state, token)
        self._guesses.note(source, right=holder is not None)
        if holder is None:
            raise Problem(
                401,
                "this token is not known here, or has expired; ask who runs the station for another",
                headers={"WWW-Authenticate": "Bearer"},
            )
        return holder


def address_group(address: str) -> str:
    """What counts as one address for guesses: an IPv6 network of 64 bits is one machine's, or one household's."""
    try:
        found = ipaddress.ip_address(address.partition("%")[0])
    except ValueError:
        return address
    return address if found.version == 4 else str(ipaddress.ip_network((found, 64), strict=False))


def sent_token(connection: HTTPConnection) -> str:
    """The token in a request's header or cookie; "" without any."""
    scheme, _, token = connection.headers.get("authorization", "").partition(" ")
    if scheme.lower() == "bearer":
        return token.strip()
    try:
        morsel = SimpleCookie(connection.headers.get("cookie", "")).get(COOKIE)
    except CookieError:
        return ""
    return morsel.value if morsel is not None else ""


def address(request: HTTPConnection, path: str) -> str:
    """The whole address of a path, under the name by which clients ask: QGIS and catalogues know no other."""
    base = request.app.state.station.settings.public_origin or str(request.base_url)
    return f"{base.rstrip('/')}{quote(path, safe='/:{}')}"


def holder_in(connection: HTTPConnection) -> Holder:
    """Who asks, as the doorkeeper found out."""
    holder = connection.scope.get("state", {}).get("holder")
    assert isinstance(holder, Holder)  # the doorkeeper stands before every route
    return holder


def needs(role: Role) -> Any:
    """A route's dependency: who asks, as a Holder, has at least this role. Raises Problem (403)."""

    async def demanded(
        connection: HTTPConnection,
    ) -> Holder:  # waits for nothing: a plain function costs a thread
        holder = holder_in(connection)
        if holder.role < role:
            raise Problem(
                403,
                f"the role {role.word} is needed, this token has {holder.role.word}; ask for another",
            )
        return holder

    return Depends(demanded)


FOR_VIEWERS = [needs(Role.VIEW)]
FOR_OPERATORS = [needs(Role.OPERATE)]
"""The dependencies of routes for whoever may look, and for whoever may start, stop and delete."""


def check_host(host: str, settings: StationSettings) -> None:
    """Raise Problem unless the Host header names this station.

    A page of another site may let its own name point to this address (DNS rebinding): names have to be known, while an
    address cannot be pointed anywhere. On loopback only loopback addresses are right.
    """
    name = (
        host[1:].partition("]")[0]
        if host.startswith("[")
        else host.rpartition(":")[0]
        if ":" in host
        else host
    )
    public = urlsplit(settings.public_url).hostname or "localhost"
    known = {each.lower() for each in ("localhost", public, settings.host, *settings.names)}
    if name.lower() in known:
        return
    if not settings.is_loopback and (
        _is_address(name) or name.lower() == socket.gethostname().lower()
    ):
        return
    if is_loopback(name):
        return
    raise Problem(
        421,
        f"this station is not {name[:100] or 'without a name'}; open it by its address, or start it "
        "with --name",
    )


def check_origin(connection: HTTPConnection, public_origin: str, *, is_websocket: bool) -> None:
    """Raise Problem where a page of another site asks for more than a navigation could.

    The station's own pages come from the address that was asked, or from `public_origin`, that of a proxy before it (""
    without one). Browsers name the page's origin with every WebSocket and every request that may change something; what
    sends none is no browser.
    """
    origin = connection.headers.get("origin")
    reads = not is_websocket and connection.scope.get("method") in _SAFE_METHODS
    if origin is None:
        if reads or connection.headers.get("sec-fetch-site", "none") in ("none", "same-origin"):
            return
        raise Problem(403, "a page of another site asked; open the station's own page")
    if connection.scope.get("method") in ("GET", "HEAD") and not is_websocket and origin != "null":
        # reading is kept from other origins by the browser: no answer allows them to read it
        return
    # the origin of pages that came from the address that was asked, lower case
    scheme = {"ws": "http", "wss": "https"}.get(
        connection.scope["scheme"], connection.scope["scheme"]
    )
    if (
        origin.lower()
        not in (public_origin, (f"{scheme}://{connection.headers.get('host', '').lower()}"))
        or not origin
    ):
        raise Problem(403, f"a page of {origin[:100]} asked; open the station's own page")


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def _with_headers(send: Send, settings: StationSettings) -> Send:
    added = [(name.encode(), text.encode()) for name, text in _HEADERS.items()]
    if settings.is_secure:
        added.append((b"strict-transport-security", b"max-age=31536000"))

    async def sending(message: Message) -> None:
        if message["type"] == "http.response.start":
            there = {name.lower() for name, _ in message.get("headers", [])}
            more = [(name, text) for name, text in added if name not in there]
            if b"cache-control" not in there:
                more.append((b"cache-control", b"no-store"))
            message = {**message, "headers": [*message.get("headers", []), *more]}
        await send(message)

    return sending


def _limited(connection: HTTPConnection, receive: Receive) -> Receive:
    """`receive` that refuses a body of more than a megabyte, announced or not. Raises Problem (413)."""
    too_large = Problem(
        413, f"at most {_MOST_BODY_BYTES // 1000} kB were expected; flights go to /api/uploads"
    )
    announced = connection.headers.get("content-length", "0")
    if not announced.isdecimal() or int(announced) > _MOST_BODY_BYTES:
        raise too_large
    taken = 0

    async def receiving() -> Message:
        nonlocal taken
        message = await receive()
        taken += len(message.get("body", b""))
        if taken > _MOST_BODY_BYTES:
            # what FastAPI passes on as it is while it reads a body
            raise HTTPException(413, too_large.detail)
        return message

    return receiving
