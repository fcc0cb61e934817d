"""Files from a web address, taken only if their hash is the one that was asked for."""

import hashlib
import http.client
import urllib.error
import urllib.parse
import urllib.request
from pathlib import Path
from typing import Any

from sorvolo.errors import InputError

_MOST_BYTES = 1 << 30  # a model has 10 to 300 MB; by choice
_CHUNK_BYTES = 1 << 20
_PATIENCE_S = 30.0  # without a byte; by choice


def copy_by_hash(address: str, to: Path, sha256: str, *, offline: str) -> None:
    """Copy what is at a web address to the file `to`; it is what was asked for when this returns.

    `offline` is what a person without a network can do. Raises InputError where the file cannot be had, is larger than
    1 GB, or has another SHA-256 than `sha256` (hexadecimal): `to` is then to be thrown away.
    """
    digest, size = hashlib.sha256(), 0
    opener = urllib.request.build_opener(WebRedirects)
    try:
        with opener.open(address, timeout=_PATIENCE_S) as stream, to.open("wb") as file:
            while chunk := stream.read(_CHUNK_BYTES):
                size += len(chunk)
                if size > _MOST_BYTES:
                    raise InputError(
                        f"{address} is larger than {_MOST_BYTES >> 30} GB, so not what was asked for"
                    )
                digest.update(chunk)
                file.write(chunk)
    except (
        urllib.error.URLError,
        TimeoutError,
        ConnectionError,
        http.client.HTTPException,
    ) as error:
        reason = getattr(error, "reason", None) or error
        raise InputError(
            f"{address} cannot be fetched ({reason}). Without a network, {offline}"
        ) from error
    found = digest.hexdigest()
    if found != sha256:
        raise InputError(
            f"{address} is not the file that was asked for: its SHA-256 is {found}, wanted was {sha256}; nothing was "
            "installed. Try again, or ask again for file and hash"
        )


class WebRedirects(urllib.request.HTTPRedirectHandler):
    """Follows a redirect to the web alone, and from https to https alone."""

    def redirect_request(
        self, req: urllib.request.Request, fp: Any, code: int, msg: str, headers: Any, newurl: str
    ) -> urllib.request.Request | None:
        asked = urllib.parse.urlsplit(req.full_url).scheme
        scheme = urllib.parse.urlsplit(newurl).scheme
        if scheme not in ("http", "https") or (asked == "https" and scheme != "https"):
            raise urllib.error.URLError(
                f"it redirects from {asked} to {scheme}, which is not followed"
            )
        return super().redirect_request(req, fp, code, msg, headers, newurl)
