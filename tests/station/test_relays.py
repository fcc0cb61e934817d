"""Events reach other systems: webhooks, a real MQTT broker; nothing lost while they are away."""

import hashlib
import hmac
import json
import shutil
import socket
import subprocess
import threading
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

import pytest
from paho.mqtt.client import Client
from paho.mqtt.enums import CallbackAPIVersion

from sorvolo.errors import SettingsError
from sorvolo.station.events import EventLog, NewEvent
from sorvolo.station.outward import OutwardSettings
from sorvolo.station.relays import SIGNATURE, MqttSender, Relay, mqtt_place, webhook, webhook_name
from sorvolo.station.state import StationState
from waiting import wait_for

FOUND = NewEvent(
    "object.found",
    {"feature": {"type": "Feature", "properties": {"class": "person"}}},
    "field",
    "r1",
)


@pytest.fixture
def events(tmp_path: Path) -> Iterator[EventLog]:
    state = StationState.open(tmp_path / "station")
    yield EventLog(state)
    state.close()


class Receiver:
    """A web server that answers with the given codes, then 200."""

    def __init__(self, *codes: int) -> None:
        self.got: list[tuple[dict[str, str], bytes]] = []
        self.codes = list(codes)
        receiver = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["Content-Length"]))
                receiver.got.append((dict(self.headers), body))
                self.send_response(receiver.codes.pop(0) if receiver.codes else 200)
                self.send_header("Location", "http://127.0.0.1:1/")
                self.end_headers()

            def log_message(self, *_: Any) -> None:
                pass

        self.server = HTTPServer(("127.0.0.1", 0), Handler)
        threading.Thread(target=self.server.serve_forever, daemon=True).start()
        self.url = f"http://127.0.0.1:{self.server.server_port}/hook?key=hidden"

    @property
    def seqs(self) -> list[int]:
        return [json.loads(body)["seq"] for _, body in self.got]


def test_a_webhook_gets_signed_events_in_order_and_again_after_a_restart(
    events: EventLog, tmp_path: Path
) -> None:
    receiver = Receiver(503)
    place = tmp_path / "hook.json"
    relay = Relay("hook", webhook(receiver.url, "secret"), events, place, pause_s=0.02)
    relay.begin()
    events.append(FOUND, NewEvent("run.progress", {"frames": 5}, "field"), FOUND)
    wait_for(lambda: relay.figures().delivered == 2)
    relay.close()
    headers, body = receiver.got[-1]
    assert receiver.seqs == [1, 1, 3]  # 503: sent again; progress is not passed on
    assert headers[SIGNATURE] == f"sha256={hmac.new(b'secret', body, hashlib.sha256).hexdigest()}"
    events.append(FOUND)
    again = Relay("hook", webhook(receiver.url), events, place, pause_s=0.02)
    again.begin()
    wait_for(lambda: again.figures().delivered == 1)
    again.close()
    assert receiver.seqs == [1, 1, 3, 4] and SIGNATURE not in receiver.got[-1][0]


@pytest.mark.parametrize("code", [400, 302])
def test_an_event_that_a_receiver_refuses_is_counted_and_holds_up_nothing(
    events: EventLog, tmp_path: Path, code: int
) -> None:
    receiver = Receiver(code)
    relay = Relay("hook", webhook(receiver.url), events, tmp_path / "hook.json", pause_s=0.02)
    relay.begin()
    events.append(FOUND, FOUND)
    wait_for(lambda: relay.figures().delivered == 1)
    relay.close()
    figures = relay.figures()
    assert (figures.delivered, figures.lost, figures.waiting) == (1, 1, 0) and receiver.seqs == [
        1,
        2,
    ]


def test_a_receiver_that_is_away_is_waited_for(events: EventLog, tmp_path: Path) -> None:
    relay = Relay(
        "hook", webhook("http://127.0.0.1:9/"), events, tmp_path / "hook.json", pause_s=0.02
    )
    relay.begin()
    events.append(FOUND)
    wait_for(lambda: relay.figures().words != "")
    assert relay.figures().waiting == 1 and "refused" in relay.figures().words
    relay.close()


@pytest.mark.parametrize(
    "url", ["ftp://host/x", "host", "http://user:secret@host/", "gopher://host/secret"]
)
def test_what_is_no_web_address_is_refused_without_its_password(url: str) -> None:
    with pytest.raises(SettingsError, match="no web address") as refused:
        webhook(url)
    assert "secret" not in str(refused.value)


def test_a_receiver_is_named_without_its_path_and_its_port_is_one() -> None:
    """Figures and logs name receivers; the path of a chat's webhook is its password."""
    urls = [f"https://hooks.example:8443/services/T{number}secret?key=secret" for number in (0, 1)]
    names = {webhook_name(each) for each in urls}
    assert len(names) == 2 and all(
        each.startswith("https://hooks.example:8443/#") for each in names
    )
    assert not any("secret" in each for each in names)
    with pytest.raises(SettingsError, match="give one with"):
        webhook("http://host:99999")


@pytest.mark.parametrize("url", ["http://host", "mqtt://", "mqtt://host:x", "mqtt://host/a/#"])
def test_what_is_no_broker_is_refused(url: str) -> None:
    with pytest.raises(SettingsError, match="mqtt://HOST"):
        mqtt_place(url)


def test_a_broker_s_address_in_its_parts() -> None:
    place = mqtt_place("mqtts://crew@broker.example/team/a", "p@ss")
    assert (place.host, place.port, place.prefix, place.password) == (
        "broker.example",
        8883,
        "team/a",
        "p@ss",
    )
    assert "p@ss" not in str(place)


def test_a_password_in_a_broker_s_address_is_refused() -> None:
    """The list of processes shows a command's arguments to everybody on the machine."""
    with pytest.raises(SettingsError, match="SORVOLO_MQTT_PASSWORD") as refused:
        mqtt_place("mqtts://crew:p%40ss@broker.example")
    assert "p%40ss" not in str(refused.value)
    assert "p@ss" not in repr(OutwardSettings(mqtt="mqtt://crew@host", mqtt_password="p@ss"))


class Broker:
    """Mosquitto, at a port of its own; may be killed and started again."""

    def __init__(self, folder: Path) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self._config = folder / "mosquitto.conf"
        self._config.write_text(f"listener {self.port} 127.0.0.1\nallow_anonymous true\n")
        self.start()

    def start(self) -> None:
        program = shutil.which("mosquitto") or "/usr/sbin/mosquitto"
        self._process = subprocess.Popen(
            [program, "-c", str(self._config)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        wait_for(self._answers)

    def stop(self) -> None:
        self._process.terminate()
        self._process.wait(5)

    def _answers(self) -> bool:
        with socket.socket() as tried:
            return tried.connect_ex(("127.0.0.1", self.port)) == 0


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Broker]:
    if shutil.which("mosquitto") is None and not Path("/usr/sbin/mosquitto").exists():
        pytest.skip("mosquitto is not installed (Debian: apt-get install mosquitto)")
    made = Broker(tmp_path)
    yield made
    made.stop()


def listening(port: int, got: list[tuple[str, bytes]]) -> Client:
    client = Client(CallbackAPIVersion.VERSION2)
    client.on_connect = lambda each, *_: each.subscribe("team/#", qos=1)
    client.on_message = lambda _, __, message: got.append((message.topic, message.payload))
    ready = threading.Event()
    client.on_subscribe = lambda *_: ready.set()
    client.connect("127.0.0.1", port)
    client.loop_start()
    assert ready.wait(60)
    return client


def test_a_real_broker_gets_events_also_those_of_while_it_was_away(
    events: EventLog, tmp_path: Path, broker: Broker
) -> None:
    got: list[tuple[str, bytes]] = []
    listener = listening(broker.port, got)
    sender = MqttSender(mqtt_place(f"mqtt://127.0.0.1:{broker.port}/team"))
    relay = Relay("mqtt", sender.send, events, tmp_path / "mqtt.json", pause_s=0.05)
    relay.begin()
    events.append(FOUND)
    wait_for(lambda: len(got) == 2)
    assert got[0] == ("team/status", b"online") and got[1][0] == "team/field/object.found"
    assert json.loads(got[1][1])["data"]["feature"]["properties"] == {"class": "person"}
    listener.loop_stop()
    broker.stop()
    events.append(NewEvent("change.announced", {"feature": {}}, "a/b"))
    time.sleep(0.3)
    broker.start()
    listener = listening(broker.port, got)
    wait_for(lambda: any(topic == "team/a_b/change.announced" for topic, _ in got))
    wait_for(lambda: relay.figures().waiting == 0)
    relay.close()
    sender.close()
    wait_for(lambda: got[-1] == ("team/status", b"offline"))
    listener.loop_stop()
