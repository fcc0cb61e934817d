"""Alerts: a real script, a real web server, and that slow or dead ones hold nothing up."""

import json
import socket
import sys
import threading
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import ClassVar

import pytest

from sorvolo.errors import SettingsError, StoreError
from sorvolo.missions.watch.alerts import (
    Outbox,
    Pace,
    alert_command,
    alert_url,
    interpreted_placeholder,
)

_ALERT = {
    "id": 3,
    "class": "small object",
    "score": 0.9,
    "latitude": 41.9,
    "longitude": None,
    "crop": "/a b/3.jpg",
}


class _Receiver(BaseHTTPRequestHandler):
    got: ClassVar[list[dict[str, object]]] = []

    def do_POST(self) -> None:
        if self.path == "/moved":
            self.send_response(302)
            self.send_header("Location", "/hook")
            self.end_headers()
            return
        body = self.rfile.read(int(self.headers["Content-Length"]))
        self.got.append(json.loads(body))
        self.send_response(500 if self.path == "/broken" else 204)
        self.end_headers()

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def server() -> Iterator[str]:
    _Receiver.got.clear()
    with HTTPServer(("127.0.0.1", 0), _Receiver) as made:
        thread = threading.Thread(target=made.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{made.server_port}"
        made.shutdown()
        thread.join()


def _script(folder: Path, body: str) -> str:
    path = folder / "sent to me.py"
    path.write_text(body)
    return f"{sys.executable} '{path}'"


def test_a_command_gets_words_and_json(tmp_path: Path) -> None:
    script = _script(
        tmp_path,
        "import json, sys\nopen(sys.argv[1], 'w').write(json.dumps([sys.argv[2:], json.load(sys.stdin)]))",
    )
    out = tmp_path / "out.json"
    run = alert_command(
        f"{script} '{out}' {{id}} '{{class}} at {{latitude}} {{longitude}}' {{crop}} ';|$HOME'"
    )
    run(_ALERT)
    words, body = json.loads(out.read_text())
    assert words == ["3", "small object at 41.9 ", "/a b/3.jpg", ";|$HOME"]  # no shell reads them
    assert body == _ALERT


def test_what_a_command_does_wrong_is_reported(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="code 3: no such number"):
        alert_command(
            _script(tmp_path, "import sys\nprint('no such number', file=sys.stderr); sys.exit(3)")
        )(_ALERT)
    began_s = time.monotonic()
    with pytest.raises(StoreError, match=r"longer than 0.3 s"):
        alert_command("sh -c 'sleep 30 & sleep 30'", limit_s=0.3)(_ALERT)
    assert time.monotonic() - began_s < 20  # the command takes 30 s


@pytest.mark.parametrize(
    ("template", "words"),
    [
        ("", "empty"),
        ("echo {name}", "no placeholder {name}"),
        ("echo {id.__class__}", "no placeholder"),
        ("echo {}", "no placeholder"),
        ("echo {id", "cannot be read"),
        ("echo 'a", "cannot be read"),
        ("no-such-program {id}", "no program"),
    ],
)
def test_commands_that_cannot_be(template: str, words: str) -> None:
    with pytest.raises(SettingsError, match=words):
        alert_command(template)


def test_a_url_gets_json(server: str) -> None:
    alert_url(f"{server}/hook")(_ALERT)
    assert _Receiver.got == [_ALERT]
    with pytest.raises(OSError, match="500"):
        alert_url(f"{server}/broken")(_ALERT)
    for url in ("ftp://host/x", "hook", "file:///etc/passwd", "http://"):
        with pytest.raises(SettingsError, match="web address"):
            alert_url(url)


def test_an_outbox_goes_on_after_failures(server: str) -> None:
    outbox = Outbox(alert_url(f"{server}/broken"), code="alert_url", what="the alert")
    outbox.put(_ALERT)
    outbox.put(_ALERT)
    outbox.close(10)
    (reported,) = outbox.notices()
    assert (reported.code, reported.count, len(_Receiver.got)) == ("alert_url_failed", 2, 2)
    assert "500" in reported.text


@pytest.fixture
def rude_server() -> Iterator[tuple[str, list[bytes]]]:
    """Answers the first request with what is no HTTP, later ones well."""
    requests: list[bytes] = []
    with socket.create_server(("127.0.0.1", 0)) as listening:

        def serve() -> None:
            while True:
                try:
                    connection, _ = listening.accept()
                except OSError:
                    return
                with connection:
                    requests.append(connection.recv(65536))
                    connection.sendall(
                        b"GARBAGE\r\n\r\n"
                        if len(requests) == 1
                        else b"HTTP/1.1 204 No Content\r\n\r\n"
                    )

        threading.Thread(target=serve, daemon=True).start()
        yield f"http://127.0.0.1:{listening.getsockname()[1]}", requests
        listening.shutdown(socket.SHUT_RDWR)


def test_alerts_go_on_after_an_answer_that_is_no_http(rude_server: tuple[str, list[bytes]]) -> None:
    url, requests = rude_server
    outbox = Outbox(alert_url(url), code="alert_url", what="the alert")
    for _ in range(3):
        outbox.put(_ALERT)
    outbox.close(20)
    (notice,) = outbox.notices()
    assert (notice.count, len(requests)) == (1, 3)
    assert "does not answer as a web server does: GARBAGE" in notice.text


def test_alerts_go_on_after_a_failure_of_any_kind() -> None:
    sent = []

    def fails_once(number: int) -> None:
        if number == 0:
            raise RuntimeError
        sent.append(number)

    outbox = Outbox(fails_once, code="x", what="it")
    outbox.put(0)
    outbox.put(1)
    outbox.close(10)
    assert sent == [1] and outbox.notices()[0].text == "it failed 1 time, last: RuntimeError"


def test_an_alert_is_not_sent_elsewhere(server: str) -> None:
    with pytest.raises(StoreError, match=r"redirects alerts to http://127.0.0.1:\d+/hook"):
        alert_url(f"{server}/moved")(_ALERT)
    assert not _Receiver.got


@pytest.mark.parametrize(
    ("template", "found"),
    [
        ("sh -c 'echo {class}'", "class"),
        ("/bin/bash -ec 'mail {crop}'", "crop"),
        ("env LANG=C sh -c 'x {id}'", "id"),
        ("python3 -c 'print(\"{class}\")'", "class"),
        ("cmd /C 'copy {crop} x'", "crop"),
        ("sh -c 'echo \"$1\"' alert {class}", ""),
        ("sh notify.sh {class}", ""),
        ("notify -c {class}", ""),
        ("", ""),
    ],
)
def test_a_placeholder_that_an_interpreter_would_run_is_found(template: str, found: str) -> None:
    assert interpreted_placeholder(template) == found


def test_a_slow_receiver_holds_nothing_up() -> None:
    gate = threading.Event()

    def slow(_: int) -> None:
        gate.wait(10)

    outbox = Outbox(slow, code="slow", what="it")
    began_s = time.monotonic()
    for number in range(1200):
        outbox.put(number)
    outbox.close(0.1)
    assert time.monotonic() - began_s < 8  # the receiver takes 10 s for each
    gate.set()
    (reported,) = outbox.notices()
    assert reported.code == "slow_dropped" and 1190 <= reported.count <= 1200


def test_a_track_is_reported_at_once_then_at_its_pace() -> None:
    now_s = 100.0
    pace = Pace(3.0, lambda: now_s)
    assert pace.allows(1) and pace.allows(2) and not pace.allows(1)
    now_s = 102.9
    assert not pace.allows(1)
    now_s = 103.0
    assert pace.allows(1) and not pace.allows(1)
