"""Who is told of a track while a watch runs: a command, a URL, a TAK server; slow or dead ones hold nothing up."""

import json
import os
import shlex
import shutil
import signal
import subprocess
import threading
import time
import urllib.request
from collections import deque
from collections.abc import Callable, Mapping
from string import Formatter
from typing import Any, Generic, TypeVar
from urllib.parse import urlsplit

from sorvolo.errors import SettingsError, StoreError
from sorvolo.survey.flight import Notice

PLACEHOLDERS = ("id", "class", "score", "latitude", "longitude", "time", "crop")
"""What an alert command's words may hold in braces."""

_MOST_WAITING = 1000
_COMMAND_LIMIT_S = 30.0
_URL_LIMIT_S = 10.0

_Item = TypeVar("_Item")


class Outbox(Generic[_Item]):
    """Sends items one after another in a thread of its own; a failure is counted and the next item goes on.

    When more wait than memory should hold, the oldest are dropped and counted. `what` names it in notices, which
    count failures under `code`.
    """

    def __init__(self, send: Callable[[_Item], None], *, code: str, what: str) -> None:
        self._send, self._code, self._what = send, code, what
        self._waiting: deque[_Item] = deque()
        self._changed = threading.Condition()
        self._is_closing = False
        self._sent, self._failed, self._dropped, self._last_words = 0, 0, 0, ""
        self._thread = threading.Thread(target=self._run, name=code, daemon=True)
        self._thread.start()

    def put(self, item: _Item) -> None:
        """Send an item soon."""
        with self._changed:
            if len(self._waiting) >= _MOST_WAITING:
                self._waiting.popleft()
                self._dropped += 1
            self._waiting.append(item)
            self._changed.notify()

    def close(self, timeout_s: float) -> None:
        """Wait until all is sent, at most so long; what then still waits is dropped and counted."""
        with self._changed:
            self._is_closing = True
            self._changed.notify()
        self._thread.join(timeout_s)
        with self._changed:
            self._dropped += len(self._waiting)
            self._waiting.clear()

    @property
    def sent(self) -> int:
        """How many went out well."""
        return self._sent

    def notices(self) -> tuple[Notice, ...]:
        """What failed so far."""
        found = []
        if self._failed:
            text = f"{self._what} failed {self._failed} times, last: {self._last_words}"
            found.append(Notice(f"{self._code}_failed", self._failed, text))
        if self._dropped:
            text = f"{self._what} was too slow: {self._dropped} were not sent"
            found.append(Notice(f"{self._code}_dropped", self._dropped, text))
        return tuple(found)

    def _run(self) -> None:
        while True:
            with self._changed:
                while not self._waiting and not self._is_closing:
                    self._changed.wait()
                if not self._waiting:
                    return
                item = self._waiting.popleft()
            try:
                self._send(item)
            except (OSError, StoreError, ValueError, subprocess.SubprocessError) as error:
                self._failed += 1
                self._last_words = " ".join(str(error).split())[:200]
            else:
                self._sent += 1


def alert_command(template: str, *, limit_s: float = _COMMAND_LIMIT_S) -> Callable[[Mapping[str, Any]], None]:
    """A function that runs the command for one alert, its placeholders filled in, the alert as JSON on its stdin.

    The template is split as a shell splits words, but no shell runs. The function raises StoreError when the command
    ends with another code than 0, and kills it, with what it started, after `limit_s`. Raises SettingsError here for a
    placeholder that there is not or a command that is not found.
    """
    try:
        words = shlex.split(template)
        named = {name for word in words for _, name, _, _ in Formatter().parse(word) if name is not None}
    except ValueError as error:
        raise SettingsError(f"--alert-command {template!r} cannot be read: {error}") from error
    if not words:
        raise SettingsError("--alert-command is empty; give a program and its arguments")
    if unknown := sorted(named - set(PLACEHOLDERS)):
        known = " ".join(f"{{{name}}}" for name in PLACEHOLDERS)
        raise SettingsError(f"--alert-command: no placeholder {{{unknown[0]}}}; there are {known}")
    if shutil.which(words[0]) is None:
        raise SettingsError(f"--alert-command: no program {words[0]!r} that can be run; give its whole path")

    def run(alert: Mapping[str, Any]) -> None:
        told = {name: "" if alert.get(name) is None else str(alert[name]) for name in PLACEHOLDERS}
        _run_command([word.format_map(told) for word in words], json.dumps(alert).encode(), limit_s)

    return run


def alert_url(url: str) -> Callable[[Mapping[str, Any]], None]:
    """A function that posts one alert as JSON to the URL; it raises OSError when the server does not take it.

    Raises SettingsError here for what is no http or https URL.
    """
    parts = urlsplit(url)
    if parts.scheme not in ("http", "https") or not parts.hostname:
        raise SettingsError(f"--alert-url {url} is no web address; give one with http:// or https://")

    def post(alert: Mapping[str, Any]) -> None:
        request = urllib.request.Request(
            url, json.dumps(alert).encode(), {"Content-Type": "application/json", "User-Agent": "sorvolo"}
        )
        with urllib.request.urlopen(request, timeout=_URL_LIMIT_S) as answer:
            answer.read(4096)

    return post


class Pace:
    """Lets each track through at once the first time, then at most every `step_s` seconds."""

    def __init__(self, step_s: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._step_s, self._clock = step_s, clock
        self._last_s: dict[int, float] = {}

    def allows(self, track_id: int) -> bool:
        """Whether this track may be told of now; then it counts as told."""
        now_s = self._clock()
        if now_s - self._last_s.get(track_id, -float("inf")) < self._step_s:
            return False
        self._last_s[track_id] = now_s
        return True


def _run_command(words: list[str], told: bytes, limit_s: float) -> None:
    # a session of its own: Ctrl-C is meant for the watch, and whatever the command started can be ended with it
    with subprocess.Popen(
        words, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, start_new_session=True
    ) as running:
        try:
            _, complaint = running.communicate(told, timeout=limit_s)
        except subprocess.TimeoutExpired:
            os.killpg(running.pid, signal.SIGKILL)
            raise StoreError(f"{words[0]} ran longer than {limit_s:g} s and was ended") from None
    if running.returncode != 0:
        last = complaint.decode("utf-8", "replace").strip().splitlines()[-1:] or ["it said nothing"]
        raise StoreError(f"{words[0]} ended with code {running.returncode}: {last[0]}")
