"""A real Chromium before a real station: what the tests of the page share. Skips by name where either is missing."""

import json
import re
import shutil
import threading
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import uvicorn

from sorvolo.station.app import station_app
from sorvolo.station.settings import StationSettings

sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or ""
FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-sync",
    "--disable-background-networking",
    "--disable-component-update",
    "--mute-audio",
)
WAIT_MS = 20_000


@contextmanager
def chromium() -> Iterator[Any]:
    """Debian's Chromium without a window."""
    if not CHROMIUM:
        pytest.skip("no Chromium on this machine (Debian: apt-get install chromium)")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=list(FLAGS))
        yield browser
        browser.close()


def context_of(browser: Any, *, keeps: bool = False, **options: Any) -> Any:
    """A browser's own world; `keeps`: with the page's service worker, whose requests no route of a test sees.

    Its window is small and coarse and nothing in it moves by itself: most of a test's time would go into painting it.
    """
    workers = "allow" if keeps else "block"
    still = {
        "reduced_motion": "reduce",
        "viewport": {"width": 900, "height": 600},
        "device_scale_factor": 0.5,
    }
    return browser.new_context(**({"service_workers": workers} | still | options))


class Served:
    """A station at a port of its own, in a thread; `station` is its record."""

    def __init__(self, root: Path, **settings: Any) -> None:
        app = station_app(StationSettings(root, **settings))
        self.station = app.state.station
        config = uvicorn.Config(
            app, "127.0.0.1", 0, log_level="error", ws="websockets-sansio", ws_max_size=16_000_000
        )
        self.server = uvicorn.Server(config)
        self._thread = threading.Thread(target=self.server.run, daemon=True)

    def __enter__(self) -> "Served":
        self._thread.start()
        while not self.server.started:
            assert self._thread.is_alive()
            time.sleep(0.005)  # the thread that starts needs the interpreter
        self.port = self.server.servers[0].sockets[0].getsockname()[1]
        self.url = f"http://127.0.0.1:{self.port}"
        return self

    def ask(self, path: str, method: str = "GET", body: object = None) -> Any:
        """The JSON that the station answers to somebody else's program. Raises HTTPError."""
        data = None if body is None else json.dumps(body).encode()
        request = urllib.request.Request(
            self.url + path, data, {"content-type": "application/json"}, method=method
        )
        with urllib.request.urlopen(request) as answer:
            return json.load(answer)

    def send(self, path: str, method: str) -> None:
        """A request whose answer has no content. Raises HTTPError."""
        urllib.request.urlopen(urllib.request.Request(self.url + path, method=method)).close()

    def read(self, path: str) -> str:
        """The text that the station answers. Raises HTTPError."""
        with urllib.request.urlopen(self.url + path) as answer:
            return str(answer.read().decode())

    def __exit__(self, *_: object) -> None:
        self.server.should_exit = True
        self._thread.join(60)
        assert not self._thread.is_alive()  # else a second one would not get the folder


class Watched:
    """A page that notes what must not happen: errors in the console, requests to anybody else."""

    def __init__(self, context: Any, url: str) -> None:
        self.page = context.new_page()
        self.page.set_default_timeout(WAIT_MS)
        self.faults: list[str] = []
        self._url = url
        self.page.on("console", self._heard)
        self.page.on("pageerror", lambda error: self.faults.append(f"uncaught: {error}"))
        self.page.on("request", self._asked)

    def _heard(self, message: Any) -> None:
        is_ours = not re.search("GPU stall|blocked by Playwright", message.text)
        if message.type in ("error", "warning") and is_ours:
            self.faults.append(f"{message.type}: {message.text} {message.location.get('url', '')}")

    def _asked(self, request: Any) -> None:
        if not request.url.startswith(
            (self._url, "blob:", "data:", self._url.replace("http", "ws"))
        ):
            self.faults.append(f"asked a third party: {request.url}")
