"""The receivers of a station's events besides its pages: webhooks, an MQTT broker, a TAK server or team."""

import hashlib
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from math import atan2, cos, degrees, hypot, isfinite, nan, radians, sin
from pathlib import Path

from sorvolo.geometry.units import M_PER_DEG_LATITUDE
from sorvolo.missions.watch.cot_sender import CotSender, CotTls, check_cot, check_host, cot_place
from sorvolo.paths import JsonView
from sorvolo.station.events import EventLog
from sorvolo.station.ingest import Ingest
from sorvolo.station.relays import (
    MqttSender,
    NotTaken,
    Relay,
    RelayFigures,
    features_of,
    mqtt_place,
    webhook,
    webhook_name,
)
from sorvolo.station.state import ThreadOwner, utc_now
from sorvolo.store.exports.cursor_on_target import (
    COT_TYPES,
    DroneView,
    cot_drone,
    cot_removal,
    cot_spot,
    cot_type,
)

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
        check_cot(self.cot, self.cot_tls)


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
            each.begin()
        if self._cot is not None:
            self._cot.begin()

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


WANTED = frozenset(
    {"object.found", "person.found", "change.announced", "change.withdrawn", "frame.placed"}
)
"""The events that a TAK server gets."""

_DRONE_EVERY_S = 1.0  # by choice
_DRONE_STALE_S, _SPOT_STALE_S = 15.0, 3600.0
_CHANGE_TYPE = COT_TYPES["small object"]

Drones = Callable[[], Mapping[str, DroneView]]
"""The drones that send to this station, by stream."""


class CotRelay(ThreadOwner):
    """Sends events, and once a second each drone. `send` is for one `Relay`; a sender is not shared by threads."""

    def __init__(self, sender: CotSender, drones: Drones, drone_sender: CotSender) -> None:
        self._sender, self._drones, self._drone_sender = sender, drones, drone_sender
        self._sent_types: dict[str, str] = {}
        self._placed_s: dict[str, float] = {}
        super().__init__("drones to TAK", self._run)

    def close(self) -> None:
        """End, and let go of the connections."""
        super().close()
        self._sender.close()
        self._drone_sender.close()

    def send(self, event: JsonView) -> None:
        """Send one event's things. Raises OSError where the connection fails, NotTaken for what has no place."""
        data, site = event.get("data") or {}, str(event.get("site") or "station")
        if event["type"] == "frame.placed":
            self._place(str(event.get("run") or site), event, data)
        elif event["type"] == "change.withdrawn":
            uid = f"sorvolo.{site}.{data.get('id')}"
            if uid in self._sent_types:
                self._sender.send(
                    cot_removal(uid, type_=self._sent_types.pop(uid), now_ns=time.time_ns())
                )
        else:
            for feature in features_of(event):
                self._spot(site, event, feature)

    def _spot(self, site: str, event: JsonView, feature: JsonView) -> None:
        properties = feature.get("properties") or {}
        place = _middle(feature.get("geometry") or {})
        if place is None or (event.get("data") or {}).get("is_local"):
            raise NotTaken("it has no place on Earth")
        thing = properties.get("id", event["seq"])
        if event["type"] == "change.announced":
            name = str(properties.get("kind", "change"))
            uid = f"sorvolo.{site}.{thing}"
            type_ = _CHANGE_TYPE
        else:
            name = str(properties.get("class", "object"))
            uid, type_ = f"sorvolo.{site}.{event.get('run')}.{thing}", cot_type(name)
        self._sent_types[uid] = type_
        score = properties.get("score")
        scored = "" if score is None else f", score {float(score):.2f}"
        self._sender.send(
            cot_spot(
                *place,
                uid=uid,
                kind=type_,
                callsign=f"{name} {thing}",
                words=f"{name}{scored}, found by Sorvolo at {event['at'][:19]}Z",
                error_m=float(properties.get("sigma_m") or nan),
                now_ns=time.time_ns(),
                stale_s=_SPOT_STALE_S,
            )
        )

    def _place(self, run: str, event: JsonView, data: JsonView) -> None:
        """A mission placed a frame: the drone is where its camera was, unless it sends that itself."""
        if (
            time.monotonic() - self._placed_s.get(run, -1e9) < _DRONE_EVERY_S
            # a position that waited for a receiver is no position any more
            or str(event.get("at", ""))[:16] != utc_now()[:16]
            or self._drones()
        ):
            return
        self._placed_s[run] = time.monotonic()
        view = view_of_frame(data)
        if view is not None:
            self._sender.send(_drone(view, run, f"drone {event.get('site') or run}"))

    def _run(self) -> None:
        while not self._ending.wait(_DRONE_EVERY_S):
            for stream, view in self._drones().items():
                try:
                    self._drone_sender.send(_drone(view, stream, stream))
                except OSError:
                    # the next position is sent in a second; `send` reports a receiver that is
                    # away
                    break


def _drone(view: DroneView, name: str, callsign: str) -> bytes:
    uid = f"sorvolo.drone.{name}"
    return cot_drone(
        view, uid=uid, callsign=callsign, now_ns=time.time_ns(), stale_s=_DRONE_STALE_S
    )


def view_of_sample(columns: Mapping[str, float], stated: Mapping[str, float]) -> DroneView | None:
    """A drone's place and view by its own telemetry; None without a place."""

    def known(*names: str) -> float:
        return next((columns[name] for name in names if isfinite(columns.get(name, nan))), nan)

    if not isfinite(known("latitude_deg")) or not isfinite(known("longitude_deg")):
        return None
    elevation_deg = known("camera_pitch_deg")
    # to level ground along the camera's axis; NaN where it looks at the sky or the height
    # is unknown
    height_m = known("height_above_takeoff_m")
    down = -sin(radians(elevation_deg))
    return DroneView(
        known("latitude_deg"),
        known("longitude_deg"),
        known("ellipsoidal_height_m"),
        known("course_deg"),
        known("speed_m_s"),
        known("camera_yaw_deg", "body_yaw_deg"),
        elevation_deg,
        stated.get("sensor_horizontal_fov_deg", nan),
        stated.get("sensor_vertical_fov_deg", nan),
        (
            height_m / down
            if isfinite(height_m) and isfinite(elevation_deg) and down > 0.05
            else nan
        ),
        known("horizontal_sigma_m"),
    )


def view_of_frame(data: JsonView) -> DroneView | None:
    """A drone's place and view by a placed frame: its camera's position, and the angles at which it saw the corners.

    `footprint` is the frame's outline, longitude and latitude, from its top left corner clockwise. None where the
    frame's data are not as they should be.
    """
    try:
        longitude, latitude = (float(each) for each in data["position"])
        height_m, heading_deg = float(data["height_m"]), float(data["heading_deg"])
        east_m = M_PER_DEG_LATITUDE * cos(radians(latitude))
        corners = [
            ((x - longitude) * east_m, (y - latitude) * M_PER_DEG_LATITUDE)
            for x, y in data["footprint"][:4]
        ]
        top_left, top_right, low_right, low_left = corners
    except (KeyError, TypeError, ValueError):
        return None
    middle = _mean(*corners)
    return DroneView(
        latitude,
        longitude,
        course_deg=nan,
        azimuth_deg=heading_deg,
        elevation_deg=float(data.get("pitch_deg", -90.0)),
        across_deg=_angle_deg(_mean(top_left, low_left), _mean(top_right, low_right), height_m),
        down_deg=_angle_deg(_mean(top_left, top_right), _mean(low_left, low_right), height_m),
        range_m=hypot(*middle, height_m),
    )


def _mean(*points: tuple[float, float]) -> tuple[float, float]:
    return sum(each[0] for each in points) / len(points), sum(each[1] for each in points) / len(
        points
    )


def _angle_deg(one: tuple[float, float], other: tuple[float, float], height_m: float) -> float:
    """The angle between two places on the ground as seen from a height above the origin."""
    a, b = (*one, -height_m), (*other, -height_m)
    cross = (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])
    return degrees(atan2(hypot(*cross), sum(x * y for x, y in zip(a, b))))


def _middle(geometry: JsonView) -> tuple[float, float] | None:
    """A point's place, or the mean of an outline's corners, longitude and latitude."""
    found = geometry.get("coordinates")
    while (
        isinstance(found, list)
        and found
        and isinstance(found[0], list)
        and isinstance(found[0][0], list)
    ):
        found = found[0]
    if not isinstance(found, list) or not found:
        return None
    points = found if isinstance(found[0], list) else [found]
    return _mean(*((float(each[0]), float(each[1])) for each in points))
