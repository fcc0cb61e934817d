"""Events published to an MQTT broker: a topic for each site and kind, at least once."""

import json
import ssl
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

from paho.mqtt.client import CONNACK_ACCEPTED, Client
from paho.mqtt.enums import CallbackAPIVersion

from sorvolo.errors import SettingsError

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
    _check_password(parts.password, password, user)
    return MqttPlace(
        host, port or _PORTS[parts.scheme], prefix, user, password, parts.scheme == "mqtts"
    )


def _check_password(in_address: str | None, password: str, user: str) -> None:
    if in_address is not None:
        raise SettingsError(
            "--mqtt: everybody on this machine could read a password in the address; give it in SORVOLO_MQTT_PASSWORD"
        )
    if password and not user:
        raise SettingsError(f"--mqtt: a password without a user's name; {_WANTED}")


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
            try:
                context = ssl.create_default_context(
                    cafile=None if authority is None else str(authority)
                )
            except (OSError, ssl.SSLError) as error:
                words = f"--mqtt-ca {authority}: no usable certificate ({error}); give a PEM file"
                raise SettingsError(words) from error
            self._client.tls_set_context(context)
        self._is_begun = False

    def send(self, event: Mapping[str, Any]) -> None:
        """Publish one event. Raises OSError where the broker does not acknowledge it."""
        self._demand_connection()
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

    def _demand_connection(self) -> None:
        """Wait for the connection, which the library makes anew by itself once it stood. Raises OSError."""
        if not self._is_begun:
            self._client.connect(self._place.host, self._place.port, _KEEPALIVE_S)
            self._client.loop_start()
            self._is_begun = True
        if not self._connected.wait(_CONNECT_S):
            raise OSError(self._reason or "no connection to the broker")

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
