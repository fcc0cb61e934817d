"""The receivers of a station's events besides its pages: webhooks, an MQTT broker, a TAK server or team."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from sorvolo.errors import SettingsError
from sorvolo.missions.watch.cot_sender import CotSender, CotTls, check_host, cot_place
from sorvolo.station.cot_relay import WANTED, CotRelay, view_of_sample
from sorvolo.station.events import EventLog
from sorvolo.station.ingest import Ingest
from sorvolo.station.mqtt import MqttSender, mqtt_place
from sorvolo.station.relays import Relay, RelayFigures
from sorvolo.station.webhooks import webhook, webhook_name
from sorvolo.store.exports.cursor_on_target import DroneView

_FOLDER = "relays"


@dataclass(frozen=True)
class OutwardSettings:
    """The receivers of a station's events.

    `webhook_secret` signs what is posted; `mqtt_password` is that of the user in `mqtt`, `mqtt_ca` the broker's
    authority, PEM. Raises SettingsError for an address that cannot be.
    """

    webhooks: tuple[str, ...] = ()
    webhook_secret: str = ""
    mqtt: str = ""
    mqtt_password: str = field(default="", repr=False)
    mqtt_ca: Path | None = None
    cot: str = ""
    cot_tls: CotTls = field(default_factory=CotTls)

    def __post_init__(self) -> None:
        for each in self.webhooks:
            webhook(each)
        if self.mqtt:
            mqtt_place(self.mqtt, self.mqtt_password)
        if self.cot:
            cot_place(self.cot)
        if self.cot_tls != CotTls() and not self.cot.startswith("tls://"):
            raise SettingsError("--cot-ca and --cot-cert are for --cot tls://host:port")


class Outward:
    """All receivers of a station at work. `start` and `close` begin and end it.

    Raises InputError for a TAK server's host that nothing knows, or certificates that cannot be used.
    """

    def __init__(
        self, settings: OutwardSettings, events: EventLog, ingest: Ingest, folder: Path
    ) -> None:
        self._ingest = ingest
        self._relays: list[Relay] = []
        self._mqtt: MqttSender | None = None
        self._cot: CotRelay | None = None
        if settings.webhooks or settings.mqtt or settings.cot:
            (folder / _FOLDER).mkdir(parents=True, exist_ok=True)
        for url in settings.webhooks:
            send = webhook(url, settings.webhook_secret)
            self._relays.append(Relay(webhook_name(url), send, events, _place(folder, url)))
        if settings.mqtt:
            place = mqtt_place(settings.mqtt, settings.mqtt_password)
            self._mqtt = MqttSender(place, settings.mqtt_ca)
            self._relays.append(
                Relay(str(place), self._mqtt.send, events, _place(folder, str(place)))
            )
        if settings.cot:
            target = cot_place(settings.cot)
            check_host(target)
            self._cot = CotRelay(
                CotSender(target, settings.cot_tls),
                self._drones,
                CotSender(target, settings.cot_tls),
            )
            self._relays.append(
                Relay(
                    str(target), self._cot.send, events, _place(folder, str(target)), wanted=WANTED
                )
            )

    def start(self) -> None:
        """Begin to pass events on."""
        for each in self._relays:
            each.start()
        if self._cot is not None:
            self._cot.start()

    def close(self) -> None:
        """End; what was not delivered is, when the station runs again."""
        for each in self._relays:
            each.close()
        if self._mqtt is not None:
            self._mqtt.close()
        if self._cot is not None:
            self._cot.close()

    def figures(self) -> list[RelayFigures]:
        """How each receiver is served."""
        return [each.figures() for each in self._relays]

    def _drones(self) -> Mapping[str, DroneView]:
        samples = self._ingest.samples()
        views = {
            stream: view_of_sample(each.columns, each.stated) for stream, each in samples.items()
        }
        return {stream: view for stream, view in views.items() if view is not None}


def _place(folder: Path, address: str) -> Path:
    return folder / _FOLDER / f"{hashlib.sha256(address.encode()).hexdigest()[:16]}.json"
