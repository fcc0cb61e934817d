"""An S3 server of this process with an empty bucket, for tests: moto's, skipped by name where it is missing."""

import logging
import os
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from unittest import mock

import pytest

BUCKET = "archive"
SECRET = "nobody-may-read-this-secret"
KEY = "AKIANOBODYMAYREADTHIS"


def environment(endpoint: str) -> dict[str, str]:
    """The variables with which a person names the store."""
    return {
        "AWS_ENDPOINT_URL": endpoint,
        "AWS_ACCESS_KEY_ID": KEY,
        "AWS_SECRET_ACCESS_KEY": SECRET,
        "AWS_SESSION_TOKEN": f"{SECRET}-token",
        "AWS_REGION": "eu-central-1",
    }


@contextmanager
def served_bucket() -> Iterator[str]:
    """The endpoint of a server with the bucket, which the environment names meanwhile."""
    pytest.importorskip("obstore", reason="object stores need obstore: pip install 'sorvolo[s3]'")
    server_module = pytest.importorskip(
        "moto.server", reason="needs moto's S3 server: pip install 'moto[server]'"
    )
    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    server = server_module.ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    endpoint = f"http://{host}:{port}"
    urllib.request.urlopen(urllib.request.Request(f"{endpoint}/moto-api/reset", method="POST"))
    urllib.request.urlopen(urllib.request.Request(f"{endpoint}/{BUCKET}", method="PUT"))
    others = {name for name in os.environ if name.startswith("AWS_")}
    try:
        with mock.patch.dict(os.environ, environment(endpoint)):
            for name in others - environment("").keys():
                del os.environ[name]
            yield endpoint
    finally:
        server.stop()
