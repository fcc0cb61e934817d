"""Alerts while a watch runs: to a command, a URL, a TAK server; slow or dead receivers delay nothing."""

import http.client
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import threading
import time
import urllib.request
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from string import Formatter
from typing import Any, Generic, TypeVar
from urllib.parse import urlsplit

from sorvolo.errors import SettingsError, StoreError
from sorvolo.survey.flight import Notice
from sorvolo.survey.wording import counted

PLACEHOLDERS = ("flight", "id", "class", "score", "latitude", "longitude", "time", "crop")
"""What an alert command's words may hold in braces."""

_MOST_WAITING = 1000  # alerts, then the oldest is given up; by choice
_COMMAND_LIMIT_S = 30.0  # after which it is ended, so that others are called; by choice
_URL_LIMIT_S = 10.0  # for an answer; by choice
_CODE_OPTIONS = {  # of each interpreter, the options whose next word it runs as a program
    **dict.fromkeys(("sh", "bash", "dash", "ash", "ksh", "zsh", "fish"), re.compile(r"-\w*c")),
    **dict.fromkeys(("python", "python3"), re.compile(r"-\w*c")),
    **dict.fromkeys(("perl", "ruby", "node"), re.compile(r"-\w*e")),
    **dict.fromkeys(("cmd", "cmd.exe"), re.compile(r"(?i)/[ck]")),
}

_Item = TypeVar("_Item")


class Outbox(Generic[_Item]):
    """Sends items one after another in a thread of its own; a failure is counted and the next item goes on.

    No failure of a receiver ends the thread, whatever its kind. When more items wait than memory should hold, the
    oldest are dropped and counted. `what` names the receiver in notices, which count failures under `code`.
    """

    def __init__(self, send: Callable[[_Item], None], *, code: str, what: str) -> None:
        self._send, self._code, self._what = send, code, what
        self._waiting: deque[_Item] = deque()
        self._changed = threading.Condition()
        self._is_closing = False
        self._failed, self._dropped, self._last_words = 0, 0, ""
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

    def close(self, timeout_s: float) -> bool:
        """Wait until all is sent, at most so long; what then still waits is dropped and counted.

        Whether nothing is being sent any more.
        """
        with self._changed:
            self._is_closing = True
            self._changed.notify()
        self._thread.join(timeout_s)
        with self._changed:
            self._dropped += len(self._waiting)
            self._waiting.clear()
        return not self._thread.is_alive()

    def notices(self) -> tuple[Notice, ...]:
        """What failed so far."""
        found = []
        if self._failed:
            text = f"{self._what} failed {counted(self._failed, 'time')}, last: {self._last_words}"
            found.append(Notice(f"{self._code}_failed", self._failed, text))
        if self._dropped:
            text = f"{self._what} was too slow: {counted(self._dropped, 'message')} not sent"
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
            except (
                Exception
            ) as error:  # counted and reported: one bad answer must not end all later alerts
                self._failed += 1
                self._last_words = " ".join(str(error).split())[:200] or type(error).__name__


def alert_command(
    template: str, *, limit_s: float = _COMMAND_LIMIT_S
) -> Callable[[Mapping[str, Any]], None]:
    """A function that runs the command for one alert, its placeholders filled in, the alert as JSON on its stdin.

    The template is split into words as a shell does, but no shell runs. The function raises StoreError when the command
    ends with another code than 0, and kills it, with what it started, after `limit_s`. Raises SettingsError here for an
    unknown placeholder or a command that is not found.
    """
    words = _split(template)
    named = {name for word in words for name in _placeholders(word)}
    if not words:
        raise SettingsError("--alert-command is empty; give a program and its arguments")
    if unknown := sorted(named - set(PLACEHOLDERS)):
        known = " ".join(f"{{{name}}}" for name in PLACEHOLDERS)
        raise SettingsError(
            f"--alert-command: there is no placeholder {{{unknown[0]}}}; use {known}"
        )
    if shutil.which(words[0]) is None:
        raise SettingsError(
            f"--alert-command: no program {words[0]!r} was found; give its full path"
        )

    def run(alert: Mapping[str, Any]) -> None:
        values = {
            name: "" if alert.get(name) is None else str(alert[name]) for name in PLACEHOLDERS
        }
        _run_command(
            [word.format_map(values) for word in words], json.dumps(alert).encode(), limit_s
        )

    return run


def interpreted_placeholder(template: str) -> str:
    """A placeholder that a shell or another interpreter would run as part of a program ("sh -c"); else "".

    What stands for it there, such as a folder's name in {crop}, is then read as code. Raises SettingsError for a
    template that cannot be split into words.
    """
    words = _split(template)
    for place, word in enumerate(words):
        option = _CODE_OPTIONS.get(re.split(r"[/\\]", word)[-1])
        if option is None:
            continue
        for before, code in zip(words[place + 1 :], words[place + 2 :]):
            if option.fullmatch(before):
                return next(_placeholders(code), "")
    return ""


def interpreted_words(name: str) -> str:
    """The warning about a placeholder that `interpreted_placeholder` found."""
    return (
        f"--alert-command: {{{name}}} stands inside a program for a shell or an interpreter, which would run what is "
        f"filled in as code; pass it as an argument instead: sh -c 'echo \"$1\"' alert {{{name}}}"
    )


def alert_url(url: str) -> Callable[[Mapping[str, Any]], None]:
    """A function that posts one alert as JSON to the URL; it raises OSError or StoreError when the server does not take
    it, or sends the alert elsewhere.

    Raises SettingsError here for anything but an http or https URL.
    """
    parts = urlsplit(url)
    if parts.scheme not in ("http", "https") or not parts.hostname:
        raise SettingsError(
            f"--alert-url {url} is not a web address; give one with http:// or https://"
        )
    opener = urllib.request.build_opener(_NoRedirect)

    def post(alert: Mapping[str, Any]) -> None:
        request = urllib.request.Request(
            url,
            json.dumps(alert).encode(),
            {"Content-Type": "application/json", "User-Agent": "sorvolo"},
        )
        try:
            opener.open(request, timeout=_URL_LIMIT_S).close()
        except http.client.HTTPException as error:
            reason = " ".join(str(error).split()) or type(error).__name__
            raise StoreError(
                f"{parts.hostname} does not answer as a web server does: {reason}"
            ) from error

    return post


class _NoRedirect(urllib.request.HTTPRedirectHandler):
    """A redirected POST would become a GET without the alert, perhaps to another protocol: it is an error instead."""

    def redirect_request(
        self, req: Any, fp: Any, code: int, msg: str, headers: Any, newurl: str
    ) -> None:
        """Refuse. Raises StoreError with the address to give."""
        raise StoreError(
            f"the server redirects alerts to {newurl}; give that address with --alert-url"
        )


class Pace:
    """Lets each track through at once the first time, then at most every `step_s` seconds."""

    def __init__(self, step_s: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._step_s, self._clock = step_s, clock
        self._last_s: dict[int, float] = {}

    def allows(self, track_id: int) -> bool:
        """Whether this track may be reported now; then it counts as reported."""
        now_s = self._clock()
        if now_s - self._last_s.get(track_id, -float("inf")) < self._step_s:
            return False
        self._last_s[track_id] = now_s
        return True


def _split(template: str) -> list[str]:
    try:
        words = shlex.split(template)
        for word in words:
            list(_placeholders(word))
    except ValueError as error:
        raise SettingsError(f"--alert-command {template!r} cannot be read: {error}") from error
    return words


def _placeholders(word: str) -> Iterator[str]:
    for _, name, _, _ in Formatter().parse(word):
        if name is not None:
            yield name


def _run_command(words: list[str], alert_json: bytes, limit_s: float) -> None:
    # a session of its own: Ctrl-C is meant for the watch, and whatever the command started can be ended with it
    with subprocess.Popen(
        words,
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        start_new_session=True,
    ) as running:
        try:
            _, complaint = running.communicate(alert_json, timeout=limit_s)
        except subprocess.TimeoutExpired:
            os.killpg(running.pid, signal.SIGKILL)
            raise StoreError(f"{words[0]} ran longer than {limit_s:g} s and was ended") from None
    if running.returncode != 0:
        last = complaint.decode("utf-8", "replace").strip().splitlines()[-1:] or [
            "without a message"
        ]
        raise StoreError(f"{words[0]} ended with code {running.returncode}: {last[0]}")
