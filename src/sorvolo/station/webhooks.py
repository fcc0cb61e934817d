"""Events posted to web addresses: JSON, signed where there is a secret."""

import hashlib
import hmac
import http.client
import json
import urllib.error
import urllib.request
from collections.abc import Mapping
from typing import Any
from urllib.parse import urlsplit

from sorvolo.errors import SettingsError
from sorvolo.station.relays import NotTaken, Send

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

    def post(event: Mapping[str, Any]) -> None:
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
