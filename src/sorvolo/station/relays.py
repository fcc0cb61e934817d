"""Events passed on to other people's systems, by webhook or MQTT: each gets every event, in order, across restarts."""

import hashlib
import hmac
import http.client
import json
import logging
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

from paho.mqtt.client import CONNACK_ACCEPTED, Client
from paho.mqtt.enums import CallbackAPIVersion

from sorvolo.capture.live.reconnect import Backoff
from sorvolo.errors import SettingsError, StoreError
from sorvolo.missions.watch.cot_sender import trusting
from sorvolo.paths import JsonView
from sorvolo.station.events import EventLog
from sorvolo.station.state import ThreadOwner
from sorvolo.store.atomic import atomic_write_bytes

PASSED_ON = frozenset(
    {
        "object.found",
        "person.found",
        "change.announced",
        "change.withdrawn",
        "review.changed",
        "run.started",
        "run.finished",
        "run.failed",
    }
)
"""The events that other systems get: what was found, what became of it, which missions ran."""

_LOG = logging.getLogger("sorvolo.station.relays")
_TURN_S = 0.2  # at what waits to be sent; by choice
_OLDEST_S = 86_400.0  # an event that could not be delivered for a day is given up


class NotTaken(Exception):
    """A receiver's answer that stays the same however often an event is sent to it."""


Send = Callable[[JsonView], None]
"""Sends one event. Raises NotTaken where the receiver will never have it, any other error where it may later."""


@dataclass(frozen=True)
class RelayFigures:
    """How a receiver is served: delivered, refused or given up, still waiting, and why not, in words."""

    name: str
    delivered: int
    lost: int
    waiting: int
    words: str


class Relay(ThreadOwner):
    """One receiver, served in a thread of its own. Its place in the events is kept in a file.

    An event is delivered at least once: a station that ends between sending and noting sends it again, with the same
    `seq`. `wanted` are the types of events; the first run begins with the events that come from then on.
    """

    def __init__(
        self,
        name: str,
        send: Send,
        events: EventLog,
        path: Path,
        *,
        wanted: frozenset[str] = PASSED_ON,
        pause_s: float = 0.5,
    ) -> None:
        self.name, self._send, self._events, self._path = name, send, events, path
        self._wanted, self._backoff = wanted, Backoff(first_s=pause_s, most_s=60.0)
        self._seq = _place_in(path, events.last)
        self._delivered = self._lost = 0
        self._words = ""
        super().__init__(f"relay {name}", self._run)

    def figures(self) -> RelayFigures:
        """How it goes."""
        waiting = self._events.last - self._seq
        return RelayFigures(self.name, self._delivered, self._lost, waiting, self._words)

    def _run(self) -> None:
        while not self._ending.is_set():
            events = self._events.after(self._seq) if self._events.last > self._seq else []
            for event in events:
                if event["type"] in self._wanted and not self._deliver(event):
                    return
                self._seq = event["seq"]
            if events:
                self._keep_place()
            else:
                self._ending.wait(_TURN_S)

    def _deliver(self, event: JsonView) -> bool:
        """Send until it is taken, refused or too old; False where the station ends meanwhile."""
        while not self._ending.is_set():
            try:
                self._send(event)
            except NotTaken as error:
                self._lose(event, str(error))
                return True
            except Exception as error:  # whatever a receiver does must not end the relay
                why = str(error) or type(error).__name__
                words = " ".join(why.split())[:200]
                if words != self._words:
                    _LOG.warning("%s cannot be reached: %s; trying again", self.name, words)
                self._words = words
                if _age_s(event) > _OLDEST_S:
                    self._lose(event, self._words)
                    return True
                self._keep_place()
                self._ending.wait(self._backoff.next_s())
            else:
                self._delivered += 1
                self._words = ""
                self._backoff.reset()
                return True
        return False

    def _lose(self, event: JsonView, why: str) -> None:
        self._lost += 1
        self._words = why
        _LOG.warning(
            "%s does not take event %s (%s): %s", self.name, event["seq"], event["type"], why
        )

    def _keep_place(self) -> None:
        try:
            atomic_write_bytes(
                self._path, json.dumps({"name": self.name, "seq": self._seq}).encode()
            )
        except (
            OSError,
            StoreError,
        ) as error:
            # a full disk costs events that are sent twice, not events
            _LOG.warning("cannot note what %s got: %s", self.name, error)


def features_of(event: JsonView) -> Iterator[JsonView]:
    """The GeoJSON features in an event's data."""
    data = event.get("data") or {}
    for each in (data.get("feature"), *(data.get("features") or ())):
        if isinstance(each, Mapping):
            yield each


def _place_in(path: Path, last: int) -> int:
    try:
        seq = int(json.loads(path.read_bytes())["seq"])
    except (OSError, ValueError, KeyError, TypeError):
        return last
    return min(seq, last)


def _age_s(event: JsonView) -> float:
    try:
        at = datetime.fromisoformat(str(event["at"]))
    except (KeyError, ValueError):
        return 0.0
    return time.time() - (at if at.tzinfo else at.replace(tzinfo=UTC)).timestamp()


SIGNATURE = "X-Sorvolo-Signature"
"""The header with `sha256=` and the HMAC of the body under the secret."""

_LIMIT_S = 10.0  # for a receiver's answer; by choice
_LATER = frozenset({408, 425, 429})  # besides 5xx: the receiver may take it another time


def webhook(url: str, secret: str = "") -> Send:
    """A function that posts one event to the URL. Raises SettingsError for anything but an http or https URL."""
    try:
        parts = urlsplit(url)
        is_wrong = (
            parts.scheme not in ("http", "https")
            or not parts.hostname
            or parts.username
            or parts.port == 0
        )
    except ValueError as error:
        raise SettingsError(f"--webhook: {error}; give one with http:// or https://") from error
    if is_wrong:
        raise SettingsError(
            f"--webhook {webhook_name(url)} is no web address; give one with http:// or https://"
        )
    opener = urllib.request.build_opener(_NoRedirect)

    def post(event: JsonView) -> None:
        body = json.dumps(event, separators=(",", ":")).encode()
        headers = {"Content-Type": "application/json", "User-Agent": "sorvolo"}
        if secret:
            headers[SIGNATURE] = (
                f"sha256={hmac.new(secret.encode(), body, hashlib.sha256).hexdigest()}"
            )
        try:
            opener.open(urllib.request.Request(url, body, headers), timeout=_LIMIT_S).close()
        except urllib.error.HTTPError as error:
            error.close()
            if error.code < 500 and error.code not in _LATER:
                raise NotTaken(f"HTTP {error.code}") from error
            raise
        except http.client.HTTPException as error:
            raise OSError(f"no web server answers there ({type(error).__name__})") from error

    return post


def webhook_name(url: str) -> str:
    """The address without what may be secret in it: only its host, and a mark that distinguishes two of one host.

    The paths of many receivers (Slack, Discord, Teams) are what lets a program post there.
    """
    parts = urlsplit(url)
    place = f"{parts.scheme}://{parts.hostname or ''}{f':{parts.port}' if parts.port else ''}"
    return f"{place}/#{hashlib.sha256(url.encode()).hexdigest()[:6]}"


class _NoRedirect(urllib.request.HTTPRedirectHandler):
    """A redirected POST would become a GET without the event: it is refused instead."""

    def redirect_request(
        self, req: Any, fp: Any, code: int, msg: str, headers: Any, newurl: str
    ) -> None:
        """Refuse. Raises NotTaken."""
        raise NotTaken(
            f"HTTP {code}: the receiver sends events elsewhere; give that address instead"
        )


_PORTS = {"mqtt": 1883, "mqtts": 8883}
_CONNECT_S, _PUBLISH_S, _KEEPALIVE_S = 5.0, 10.0, 30
_WANTED = "give mqtt://HOST[:PORT][/PREFIX] or mqtts://USER@HOST"


@dataclass(frozen=True)
class MqttPlace:
    """A broker, and the prefix of every topic there."""

    host: str
    port: int
    prefix: str
    user: str
    password: str
    is_secure: bool

    def __str__(self) -> str:
        """Without the password."""
        return f"{'mqtts' if self.is_secure else 'mqtt'}://{self.host}:{self.port}/{self.prefix}"


def mqtt_place(url: str, password: str = "") -> MqttPlace:
    """The broker that `mqtt://[USER@]HOST[:PORT][/PREFIX]` or `mqtts://...` names; the prefix is else sorvolo.

    Raises SettingsError for anything else, and for a password in the address: the list of processes would show it.
    """
    try:
        parts = urlsplit(url)
        port = parts.port
    except ValueError as error:
        raise SettingsError(f"--mqtt: {error}; {_WANTED}") from error
    host, is_pattern = parts.hostname, bool(set(url.rpartition("@")[2]) & set("+#?"))
    if parts.scheme not in _PORTS or not host or is_pattern:
        raise SettingsError(f"--mqtt {parts.scheme}://{host or ''} is no broker; {_WANTED}")
    prefix, user = parts.path.strip("/") or "sorvolo", unquote(parts.username or "")
    if parts.password is not None:
        raise SettingsError(
            "--mqtt: everybody on this machine could read a password in the address; give it in SORVOLO_MQTT_PASSWORD"
        )
    if password and not user:
        raise SettingsError(f"--mqtt: a password without a user's name; {_WANTED}")
    return MqttPlace(
        host, port or _PORTS[parts.scheme], prefix, user, password, parts.scheme == "mqtts"
    )


class MqttSender:
    """Publishes events; a connection that broke is made anew with the next one.

    The topic is PREFIX/SITE/TYPE, such as sorvolo/field/object.found, the payload the event as JSON. PREFIX/status is
    `online` while the station is connected, else `offline`; it is retained.
    """

    def __init__(self, place: MqttPlace, authority: Path | None = None) -> None:
        self._place = place
        self._connected = threading.Event()
        self._reason = ""
        self._client = Client(CallbackAPIVersion.VERSION2)
        self._client.on_connect = self._on_connect
        self._client.on_disconnect = lambda *_: self._connected.clear()
        self._client.will_set(f"{place.prefix}/status", "offline", qos=1, retain=True)
        if place.user:
            self._client.username_pw_set(place.user, place.password)
        if place.is_secure:
            self._client.tls_set_context(trusting(authority, "--mqtt-ca"))
        self._is_begun = False

    def send(self, event: JsonView) -> None:
        """Publish one event. Raises OSError where the broker does not acknowledge it."""
        # wait for the connection, which the library makes anew by itself once it stood.
        # Raises OSError
        if not self._is_begun:
            self._client.connect(self._place.host, self._place.port, _KEEPALIVE_S)
            self._client.loop_start()
            self._is_begun = True
        if not self._connected.wait(_CONNECT_S):
            raise OSError(self._reason or "no connection to the broker")
        topic = (
            f"{self._place.prefix}/{_level(event.get('site') or 'station')}/{_level(event['type'])}"
        )
        sent = self._client.publish(topic, json.dumps(event, separators=(",", ":")), qos=1)
        try:
            sent.wait_for_publish(_PUBLISH_S)
        except (RuntimeError, ValueError) as error:
            raise OSError(f"the broker took no message ({error})") from error
        if not sent.is_published():
            raise OSError("the broker acknowledged nothing")

    def close(self) -> None:
        """End the connection."""
        if self._connected.is_set():
            self._client.publish(
                f"{self._place.prefix}/status", "offline", qos=1, retain=True
            ).wait_for_publish(1.0)
        self._client.disconnect()
        self._client.loop_stop()

    def _on_connect(self, client: Client, _: Any, __: Any, reason: Any, ___: Any) -> None:
        if reason != CONNACK_ACCEPTED:
            self._reason = f"the broker refuses: {reason}"
            return
        self._reason = ""
        client.publish(f"{self._place.prefix}/status", "online", qos=1, retain=True)
        self._connected.set()


def _level(text: str) -> str:
    """One level of a topic: what would be read as several, or as a pattern, is replaced."""
    return "".join("_" if each in "/+#\0" else each for each in str(text)) or "_"
