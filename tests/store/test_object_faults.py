"""What an object store can refuse, and connections that stall or are cut: in words, within limits, without keys."""

import shutil
import socket
import threading
import time
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
from fake_bucket import BUCKET, KEY, SECRET, environment, served_bucket
from fake_flights import hashes, mapped_site
from test_buckets import copied

from sorvolo.cli.main import main
from sorvolo.errors import SettingsError, StoreError, UnavailableError
from sorvolo.store.copies.bucket import BucketEnd
from sorvolo.store.copies.folder import FolderEnd
from sorvolo.store.copies.object_store import (
    Objects,
    ObjectSettings,
    _kind_of,
    _words_of,
    open_objects,
)

_QUICK = ObjectSettings(
    connect_s=1.0, request_s=1.0, retries=1, retry_s=2.0, tries=2, part_bytes=5 << 20
)


@pytest.fixture(scope="module")
def one_flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return mapped_site(tmp_path_factory.mktemp("faults") / "site", 1)


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("obstore", reason="object stores need obstore: pip install 'sorvolo[s3]'")
    for name, value in environment("http://127.0.0.1:9").items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(time, "sleep", lambda _: None)


class _Server(ThreadingHTTPServer):
    """Answers every request as a test wants it, and counts them."""

    answer: Any = None
    asked = 0
    daemon_threads = True


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server: _Server

    def _any(self) -> None:
        self.server.asked += 1
        length = int(self.headers.get("content-length") or 0)
        self.rfile.read(length)
        self.server.answer(self)

    do_GET = do_PUT = do_HEAD = do_POST = do_DELETE = _any

    def refuse(self, status: int, code: str) -> None:
        auth = self.headers.get("authorization", "")
        body = f"<Error><Code>{code}</Code><Message>{auth} {SECRET}</Message></Error>".encode()
        self.send_response(status)
        self.send_header("content-length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[_Server]:
    made_server = _Server(("127.0.0.1", 0), _Handler)
    threading.Thread(target=made_server.serve_forever, daemon=True).start()
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{made_server.server_port}")
    yield made_server
    made_server.shutdown()
    made_server.server_close()


def _refused(words: str) -> None:
    with pytest.raises(StoreError, match=words) as caught:
        BucketEnd(open_objects(f"s3://{BUCKET}/field", _QUICK)).manifest()
    shown = f"{caught.value!r} {caught.value.__cause__!r} {caught.value.__suppress_context__}"
    assert SECRET not in shown and KEY not in shown and shown.endswith("True")


@pytest.mark.parametrize(
    ("status", "code", "words"),
    [
        (
            403,
            "AccessDenied",
            r"no right to do this in the bucket: ask its owner .*\(AccessDenied\)",
        ),
        (403, "InvalidAccessKeyId", "the keys are not valid: check AWS_ACCESS_KEY_ID"),
        (403, "SignatureDoesNotMatch", "the keys are not valid"),
        (403, "RequestTimeTooSkewed", "clock is off: set it"),
        (403, "ExpiredToken", "the session has ended"),
        (404, "NoSuchBucket", "there is no such bucket"),
        (400, "AuthorizationHeaderMalformed", "another region: set AWS_REGION"),
        (301, "PermanentRedirect", "another region: set AWS_REGION"),
        (503, "SlowDown", "the store is busy"),
        (507, "XMinioStorageFull", "the store is full"),
        (418, "Teapot", "the store answered 418 Teapot"),
    ],
)
def test_each_refusal_states_what_to_do(
    server: _Server, status: int, code: str, words: str
) -> None:
    server.answer = lambda request: request.refuse(status, code)
    _refused(words)
    assert server.asked <= 4  # 503 is asked again, within limits


@pytest.mark.parametrize(
    ("region", "clock_s", "words"),
    [
        ("eu-west-1", 0.0, "another region: set AWS_REGION"),
        ("eu-central-1", 3600.0, "clock is off: set it (by NTP)"),
        ("eu-central-1", 0.0, "no site at"),
    ],
)
def test_a_wrong_region_and_a_wrong_clock_are_named_by_what_was_signed(
    server: _Server,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    region: str,
    clock_s: float,
    words: str,
) -> None:
    """As Amazon does: the region and the time that the client signed with are held against the server's own."""

    def checked(request: _Handler) -> None:
        signed = datetime.strptime(request.headers["x-amz-date"], "%Y%m%dT%H%M%SZ").replace(
            tzinfo=UTC
        )
        if "/eu-central-1/s3/aws4_request" not in request.headers["authorization"]:
            request.refuse(400, "AuthorizationHeaderMalformed")
        elif abs((datetime.now(UTC) + timedelta(seconds=clock_s) - signed).total_seconds()) > 900:
            request.refuse(403, "RequestTimeTooSkewed")
        else:
            request.refuse(404, "NoSuchKey")

    server.answer = checked
    monkeypatch.setenv("AWS_REGION", region)
    monkeypatch.setenv("SORVOLO_CACHE", str(tmp_path))
    assert main(["history", f"s3://{BUCKET}/field"]) == 1
    printed = capsys.readouterr().err
    assert words in printed and SECRET not in printed and len(printed.splitlines()) == 1


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (
            "Error performing PUT http://169.254.169.254/latest/api/token: status code: 403 Forbidden",
            "no keys were found",
        ),
        (
            "Error performing PUT http://169.254.169.254/latest/api/token: operation timed out",
            "no keys were found",
        ),
        (
            "error sending request https://store/x: error: InvalidCertificate(UnknownIssuer)",
            "certificate is not trusted",
        ),
    ],
)
def test_what_keeps_a_request_from_being_sent_is_not_waited_for(fault: str, words: str) -> None:
    """A batch tries again what may pass; missing keys and untrusted certificates do not."""
    assert words in _words_of(fault) and _kind_of(fault) is StoreError
    away = "error sending request https://store/certificates/credentials: connection refused"
    assert issubclass(_kind_of(away), UnavailableError) and "no connection" in _words_of(away)


def test_a_store_that_cannot_be_reached_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    _refused("no connection, or it was cut: check the network and AWS_ENDPOINT_URL")
    with socket.socket() as silent:
        silent.bind(("127.0.0.1", 0))
        silent.listen()
        monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{silent.getsockname()[1]}")
        started_s = time.monotonic()
        _refused("no connection, or it was cut|too slow or was cut")
        assert time.monotonic() - started_s < 12


def test_a_connection_that_is_cut_within_an_answer_is_tried_again(server: _Server) -> None:
    def cut(request: _Handler) -> None:
        request.send_response(206)
        request.send_header("content-length", "1000")
        request.send_header("content-range", "bytes 0-999/1000")
        request.send_header("etag", '"1"')
        request.send_header("last-modified", "Mon, 23 Nov 2026 05:00:00 GMT")
        request.end_headers()
        request.wfile.write(b"x" * (1000 if server.asked == 3 else 10))
        request.close_connection = True

    server.answer = cut
    objects = open_objects(f"s3://{BUCKET}/field", _QUICK)
    assert objects.part("tiles/x", 0, 1000) == b"x" * 1000 and server.asked == 3
    server.asked = 10
    with pytest.raises(StoreError, match=r"cannot read at s3://archive/field: .*cut"):
        objects.part("tiles/x", 0, 1000)


class _Failing(Objects):
    """A store that is gone after so many objects were read or written."""

    left = 5

    def _count(self) -> None:
        self.left -= 1
        if self.left < 0:
            raise StoreError("no connection, or it was cut")

    def write(self, key: str, stream: Any) -> None:
        self._count()
        super().write(key, stream)

    def part(self, key: str, start: int, length: int) -> bytes:
        self._count()
        return super().part(key, start, length)


def test_a_copy_that_loses_its_store_goes_on(one_flight: Path, tmp_path: Path) -> None:
    from obstore.store import MemoryStore

    store, target = MemoryStore(), tmp_path / "back"
    whole = Objects(store, "memory://site")
    with pytest.raises(StoreError, match="was cut"):
        copied(FolderEnd(one_flight), BucketEnd(_Failing(store, "memory://site")))
    stored = len(whole.sizes(""))
    assert stored == 5 and not BucketEnd(whole).has_site
    outcome = copied(FolderEnd(one_flight), BucketEnd(whole))
    assert (
        outcome.newest == 1 and outcome.copied < outcome.files
    )  # what is there is not sent again, nor counted
    with pytest.raises(StoreError, match="was cut"):
        copied(BucketEnd(_Failing(store, "memory://site")), FolderEnd(target))
    assert not (target / "site.db").exists()
    copied(BucketEnd(whole), FolderEnd(target))
    assert hashes(target) == hashes(one_flight)


def test_a_full_disk_is_announced_before_the_download(
    one_flight: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    with served_bucket():
        assert main(["site", "copy", str(one_flight), f"s3://{BUCKET}/full"]) == 0
        usage = shutil.disk_usage(tmp_path)
        monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=1000))
        assert main(["site", "copy", f"s3://{BUCKET}/full", str(tmp_path / "back")]) == 1
        assert "MB free, and the copy needs" in capsys.readouterr().err
        assert main(["site", "copy", f"s3://{BUCKET}/nothing-here", str(tmp_path / "back")]) == 1
        assert "no site at s3://archive/nothing-here" in capsys.readouterr().err
        assert main(["--debug", "site", "copy", f"s3://no-{BUCKET}/x", str(tmp_path / "back")]) == 1
        output = capsys.readouterr().err
        assert "there is no such bucket" in output and SECRET not in output and KEY not in output


@pytest.mark.parametrize(
    "address",
    [
        "s3://",
        "s3:///x",
        "s3://UPPER/x",
        "s3://bucket/../x",
        "s3://bucket/a b",
        "s3://bucket/x?y=1",
        "s3://b/x",
    ],
)
def test_addresses_that_name_no_place_are_refused(address: str) -> None:
    with pytest.raises(SettingsError, match="names no place in a store"):
        open_objects(address)


def test_keys_in_an_address_are_refused_and_not_repeated(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(SettingsError) as caught:
        open_objects(f"s3://{KEY}:{SECRET}@bucket/x")
    assert SECRET not in str(caught.value)
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"https://{KEY}:{SECRET}@host")
    with pytest.raises(SettingsError) as caught:
        open_objects("s3://bucket/x")
    assert SECRET not in str(caught.value)


def test_keys_of_a_profile_are_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, server: _Server
) -> None:
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY", "AWS_SESSION_TOKEN", "AWS_REGION"):
        monkeypatch.delenv(name)
    (tmp_path / ".aws").mkdir()
    (tmp_path / ".aws/credentials").write_text(
        "[survey]\naws_access_key_id = OTHERKEY\naws_secret_access_key = x\n"
    )
    (tmp_path / ".aws/config").write_text("[profile survey]\nregion = eu-west-3\n")
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("AWS_PROFILE", "survey")
    signed = []

    def answer(request: _Handler) -> None:
        signed.append(request.headers["authorization"])
        request.refuse(404, "NoSuchKey")

    server.answer = answer
    assert not BucketEnd(open_objects(f"s3://{BUCKET}/field", _QUICK)).has_site
    assert "OTHERKEY" in signed[0] and "eu-west-3" in signed[0]
    monkeypatch.setenv("AWS_PROFILE", "nobody")
    with pytest.raises(SettingsError, match=r"'nobody' \(AWS_PROFILE\) has no keys"):
        open_objects(f"s3://{BUCKET}/field")
