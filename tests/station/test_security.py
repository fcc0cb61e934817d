"""Tests that try to get in: forged hosts and origins, guessed tokens, paths, links, streams of the own network."""

import os
import signal
import socket
import threading
import time
import urllib.request
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
import uvicorn
from fastapi import FastAPI
from starlette.testclient import TestClient, WebSocketDenialResponse
from starlette.websockets import WebSocketDisconnect
from typer.testing import CliRunner

from sorvolo.cli.main import app as command
from sorvolo.errors import InputError, SettingsError
from sorvolo.station import run_process, security
from sorvolo.station.app import Station, server_config, station_app
from sorvolo.station.events import NewEvent
from sorvolo.station.inputs import checked_stream
from sorvolo.station.orders import SOURCE_VARIABLE, RunOrder
from sorvolo.station.problems import Problem
from sorvolo.station.security import address_group
from sorvolo.station.settings import StationLimits, StationSettings, check_exposure
from sorvolo.station.state import StationState
from sorvolo.station.tokens import Guesses, Role, holder_of, list_tokens, make_token, revoke_token
from waiting import wait_for

HOST = "http://127.0.0.1:8750"
SOCKET = "ws://127.0.0.1:8750/api/events"


@pytest.fixture
def state(tmp_path: Path) -> Iterator[StationState]:
    """A station's memory."""
    with closing(StationState.open(tmp_path / "station")) as state:
        yield state


def guarded(root: Path, role: str = "view", host: str = "127.0.0.1") -> tuple[TestClient, str]:
    """A station with one token, and the token."""
    with closing(StationState.open(root / "station")) as state:
        token = make_token(state, "Ada", role)
    settings = StationSettings(root, host, insecure_lan=True)
    return TestClient(station_app(settings), base_url=HOST, client=("192.0.2.7", 4000)), token


def refused(client: TestClient, address: str, **headers: str) -> int:
    """The status with which a WebSocket is refused; 0 where it is not."""
    try:
        with client.websocket_connect(address, headers=headers):
            return 0
    except WebSocketDenialResponse as denial:
        return denial.status_code
    except WebSocketDisconnect as end:
        return end.code


# ---- hosts and origins --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "host", ["evil.example", "127.0.0.1.evil.example", "localhost.evil.example:8750", "", "[::2]"]
)
def test_a_forged_host_is_refused(reader: TestClient, host: str) -> None:
    """A page whose name was pointed to this machine (DNS rebinding) sends its own name."""
    assert reader.get("/api/status", headers={"host": host}).status_code == 421
    assert refused(reader, SOCKET, host=host) in (421, 4421)


@pytest.mark.parametrize("host", ["localhost:8750", "127.0.0.1", "[::1]:8750", "LOCALHOST"])
def test_this_machines_names_are_right(reader: TestClient, host: str) -> None:
    """However they are written."""
    assert reader.get("/api/status", headers={"host": host}).status_code == 200


def test_names_are_known_on_other_addresses_too(root: Path) -> None:
    """An address cannot be pointed elsewhere; a name has to be given with --name."""
    with closing(StationState.open(root / "station")) as state:
        token = make_token(state, "Ada", "view")
    settings = StationSettings(root, "0.0.0.0", insecure_lan=True, names=("field.example",))
    with TestClient(station_app(settings), base_url=HOST) as client:
        client.headers["authorization"] = f"Bearer {token}"
        for host, status in (
            ("field.example:8750", 200),
            ("192.168.7.9:8750", 200),
            ("evil.example", 421),
        ):
            assert client.get("/api/status", headers={"host": host}).status_code == status, host


def proxied(root: Path, **headers: str) -> tuple[TestClient, str]:
    """A station behind a TLS proxy on its own machine, as uvicorn runs it, and a token."""
    with closing(StationState.open(root / "station")) as state:
        token = make_token(state, "Ada", "review")
    settings = StationSettings(root, public_url="https://maps.example")
    config = server_config(station_app(settings), settings)
    config.load()
    client = TestClient(config.loaded_app, base_url=HOST, client=("127.0.0.1", 4000))  # type: ignore[arg-type]
    client.headers.update(
        {"x-forwarded-for": "198.51.100.7", "x-forwarded-proto": "https", **headers}
    )
    return client, token


@pytest.mark.parametrize("host", ["maps.example", "127.0.0.1:8750"])
def test_behind_a_proxy_its_pages_may_ask(root: Path, host: str) -> None:
    """Whether the proxy passes the host's name on or not: judge, hear events, log in; others' pages may not."""
    client, token = proxied(root, host=host, origin="https://maps.example")
    with client:
        assert client.get("/api/status").status_code == 401
        answer = client.post("/api/session", json={"token": token})
        assert answer.status_code == 200 and "Secure" in answer.headers["set-cookie"]
        client.headers["authorization"] = f"Bearer {token}"
        body = {"kind": "change", "id": "b-1", "verdict": "confirmed"}
        assert client.post("/api/sites/field/reviews", json=body).status_code == 201
        assert refused(client, "/api/events", **dict(client.headers)) == 0
        for origin in (
            "https://evil.example",
            "https://maps.example.evil.example",
            "https://maps.example:444",
        ):
            foreign = client.post("/api/sites/field/reviews", json=body, headers={"origin": origin})
            assert foreign.status_code == 403, origin
        assert client.get("/api/status", headers={"host": "evil.example"}).status_code == 421


def test_behind_a_proxy_guesses_count_for_who_made_them(root: Path) -> None:
    """All requests come from the proxy's address; a stranger's guesses do not lock the crew out."""
    client, token = proxied(root, host="maps.example")
    with client:
        for _ in range(6):
            client.post("/api/session", json={"token": "sorvolo_0_wrong"})
        assert client.post("/api/session", json={"token": "sorvolo_0_wrong"}).status_code == 429
        other = {"x-forwarded-for": "198.51.100.8"}
        assert (
            client.post(
                "/api/session", json={"token": "sorvolo_0_wrong"}, headers=other
            ).status_code
            == 401
        )
        assert client.post("/api/session", json={"token": token}, headers=other).status_code == 200


@pytest.mark.parametrize(
    "more", [{"names": ("field.example",)}, {"public_url": "https://maps.example"}]
)
def test_other_names_of_a_station_on_loopback_need_tokens(root: Path, more: dict[str, Any]) -> None:
    """Without any a page under that name, wherever it came from, could start missions."""
    settings = StationSettings(root, **more)
    with pytest.raises(SettingsError, match="no token was made"):
        check_exposure(settings, has_tokens=False)
    check_exposure(settings, has_tokens=True)
    with TestClient(station_app(settings), base_url=HOST) as client:
        for host in ("field.example", "127.0.0.1:8750"):
            assert client.get("/api/sites", headers={"host": host}).status_code in (401, 421)


@pytest.mark.parametrize(
    "url",
    [
        "http://maps.example",
        "maps.example",
        "https://maps.example/station",
        "https://me:pw@maps.example",
        "https://:1",
        "https://maps.example:x",
        "https://maps.example/?a=b",
    ],
)
def test_what_is_no_proxy_s_address(tmp_path: Path, url: str) -> None:
    """The station's pages ask for /api of a whole host, by TLS."""
    with pytest.raises(SettingsError, match=r"without a path: https://maps\.example"):
        StationSettings(tmp_path, public_url=url)


def test_one_address_keeps_so_many_live_channels_and_no_more(root: Path) -> None:
    """Each holds memory and a task for as long as it is open; closing one makes room."""
    settings = StationSettings(root, limits=StationLimits(most_live_per_address=2))
    with (
        TestClient(station_app(settings), base_url=HOST, client=("127.0.0.1", 5000)) as client,
        client.websocket_connect(SOCKET),
    ):
        with client.websocket_connect(SOCKET):
            assert refused(client, SOCKET) in (429, 4429)
            assert client.get("/api/events").status_code == 429
            assert client.get("/api/sites").status_code == 200
        assert refused(client, SOCKET) == 0


def test_the_server_takes_so_many_connections(root: Path) -> None:
    """uvicorn answers 503 to more."""
    settings = StationSettings(root, limits=StationLimits(most_connections=7))
    app = station_app(settings)
    assert server_config(app, settings).limit_concurrency == 7
    app.state.station.close()


def test_connections_that_ask_nothing_keep_nobody_out(root: Path) -> None:
    """Two hundred idle ones, half of them with a head that never ends; 150 connections are taken."""
    settings = StationSettings(root, limits=StationLimits(most_connections=150))
    app = station_app(settings)
    server = uvicorn.Server(server_config(app, settings))
    listening = socket.create_server(("127.0.0.1", 0))
    thread = threading.Thread(target=server.run, args=([listening],))
    thread.start()
    idle = []
    try:
        wait_for(lambda: server.started)
        for number in range(200):
            idle.append(socket.create_connection(listening.getsockname()))
            idle[-1].sendall(b"GET / HT" if number % 2 else b"")
        port = listening.getsockname()[1]
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/api/sites", timeout=5) as answer:
            assert answer.status == 200
    finally:
        server.should_exit = True
        for each in idle:
            each.close()
        thread.join()
        app.state.station.close()


def test_a_long_answer_over_a_slow_link_comes_whole(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is on its way long after the station has written it."""
    length = 12_000_000

    async def answers(_scope: Any, _receive: Any, send: Any) -> None:
        head = [(b"content-length", b"%d" % length)]
        await send({"type": "http.response.start", "status": 200, "headers": head})
        await send({"type": "http.response.body", "body": bytes(length)})

    config = server_config(FastAPI(), StationSettings(root))
    monkeypatch.setattr(config.http, "_SILENT_S", 0.1)
    config = uvicorn.Config(answers, http=config.http, lifespan="off", log_config=None)
    server, listening = uvicorn.Server(config), socket.create_server(("127.0.0.1", 0))
    thread = threading.Thread(target=server.run, args=([listening],))
    thread.start()
    try:
        wait_for(lambda: server.started)
        with urllib.request.urlopen(
            f"http://127.0.0.1:{listening.getsockname()[1]}", timeout=5
        ) as got:
            time.sleep(1.5)
            assert len(got.read()) == length
    finally:
        server.should_exit = True
        thread.join()


@pytest.mark.parametrize(
    "origin",
    [
        "http://evil.example",
        "https://127.0.0.1:8750",
        "http://127.0.0.1:9999",
        "http://localhost:8750",
        "null",
    ],
)
def test_pages_of_other_sites_change_nothing(client: TestClient, origin: str) -> None:
    """Nor do they open a WebSocket."""
    body = {"kind": "change", "id": "b-1", "verdict": "confirmed"}
    assert (
        client.post("/api/sites/field/reviews", json=body, headers={"origin": origin}).status_code
        == 403
    )
    assert client.delete("/api/session", headers={"origin": origin}).status_code == 403
    assert refused(client, SOCKET, origin=origin) in (403, 4403)
    own = client.post("/api/sites/field/reviews", json=body, headers={"origin": HOST})
    assert own.status_code == 201


def test_requests_that_browsers_mark_as_cross_site(client: TestClient) -> None:
    """A form of another page that names no origin."""
    assert (
        client.post("/api/runs", json={}, headers={"sec-fetch-site": "cross-site"}).status_code
        == 403
    )
    assert refused(client, SOCKET, **{"sec-fetch-site": "cross-site"}) in (403, 4403)
    assert refused(client, SOCKET) == 0


def test_headers_that_keep_a_page_to_its_own(client: TestClient) -> None:
    """No third party, no framing, no guessing of kinds; what is private is not kept by caches."""
    headers = client.get("/api/sites").headers
    policy = headers["content-security-policy"]
    assert (
        "default-src 'none'" in policy
        and "frame-ancestors 'none'" in policy
        and "http" not in policy
    )
    assert headers["x-content-type-options"] == "nosniff" and headers["cache-control"] == "no-store"
    assert "access-control-allow-origin" not in headers
    assert (
        "access-control-allow-origin"
        not in client.get("/api/sites", headers={"origin": "http://evil.example"}).headers
    )


# ---- tokens -------------------------------------------------------------------------------------------------------


def test_tokens_are_hashes_with_roles(state: StationState) -> None:
    """Only their holder has the secret; a revoked or expired one is nobody's."""
    token = make_token(state, "Ada", "review")
    assert token.rpartition("_")[2].encode() not in state.path.read_bytes()
    holder = holder_of(state, token)
    assert holder is not None and (holder.name, holder.role) == ("Ada", Role.REVIEW)
    other = token.replace("sorvolo", "other")
    for wrong in (token[:-1], token + "x", "", "sorvolo__", "x" * 500, other, "sorvolo_%_'"):
        assert holder_of(state, wrong) is None, wrong
    old = make_token(state, "Old", "operate", days=1e-9)
    assert holder_of(state, old) is None
    revoke_token(state, "Ada")
    assert holder_of(state, token) is None and [each.name for each in list_tokens(state)] == ["Old"]
    with pytest.raises(InputError, match="already"):
        make_token(state, "Old", "view")
    with pytest.raises(SettingsError, match="role"):
        make_token(state, "New", "admin")


def test_without_a_token_nothing_is_shown_once_there_is_one(root: Path) -> None:
    """Also on this machine; the page itself and the way to log in are open."""
    client, token = guarded(root)
    with client:
        tile = "/api/sites/field/tiles/1/18/1/1.webp"
        for path in ("/api/status", "/api/sites", "/openapi.json", tile, "/api/events"):
            answer = client.get(path)
            assert answer.status_code == 401 and answer.headers["www-authenticate"] == "Bearer", (
                path
            )
        assert refused(client, SOCKET) in (401, 4401)
        assert client.get("/").status_code in (200, 404)
        assert client.post("/api/session", json={"token": token}).status_code == 200
        cookie = client.cookies.get("sorvolo_session")
        assert cookie == token and client.get("/api/status").json()["role"] == "view"
        client.cookies.clear()
        shown = client.get("/api/status", headers={"authorization": f"Bearer {token}"})
        assert shown.json()["name"] == "Ada"


def test_the_cookie_is_out_of_reach_of_scripts_and_other_sites(root: Path) -> None:
    """HttpOnly, SameSite=Strict."""
    client, token = guarded(root)
    with client:
        cookie = client.post("/api/session", json={"token": token}).headers["set-cookie"]
        assert "HttpOnly" in cookie and "samesite=strict" in cookie.lower()


@pytest.mark.parametrize("is_socket", [True, False])
def test_a_live_channel_ends_with_its_token(
    root: Path, monkeypatch: pytest.MonkeyPatch, *, is_socket: bool
) -> None:
    """Who was shut out hears nothing more of what is found."""
    monkeypatch.setattr(security, "LOOK_AGAIN_S", 0.0)
    client, token = guarded(root)
    headers = {"authorization": f"Bearer {token}"}
    station: Station = client.app.state.station  # type: ignore[attr-defined]

    make_token(
        station.state, "Ben", "view"
    )  # a station whose last token goes is open to this machine

    def shut_out() -> None:
        revoke_token(station.state, "Ada")
        station.events.append(NewEvent("object.found", {"secret": 1}, "field"))

    with client:
        station.events.append(NewEvent("object.found", {"at": 0}, "field"))
        if is_socket:
            with client.websocket_connect(f"{SOCKET}?after=0", headers=headers) as socket:
                assert socket.receive_json()["data"] == {"at": 0}
                shut_out()
                with pytest.raises(WebSocketDisconnect):
                    socket.receive_json()
        else:
            threading.Timer(0.5, shut_out).start()
            heard = client.get("/api/events?after=0", headers=headers).text  # else it never ends
            assert '"at"' in heard and "secret" not in heard


@pytest.mark.parametrize(("role", "allowed"), [("view", {"view"}), ("review", {"view", "review"})])
def test_roles(root: Path, role: str, allowed: set[str]) -> None:
    """Who may look cannot judge, who may judge cannot run."""
    client, token = guarded(root, role)
    with client:
        client.headers["authorization"] = f"Bearer {token}"
        review = {"kind": "change", "id": "b-1", "verdict": "confirmed"}
        statuses = {
            "view": client.get("/api/sites").status_code,
            "review": client.post("/api/sites/field/reviews", json=review).status_code,
            "operate": client.post(
                "/api/runs", json={"mission": "search", "site": "nowhere"}
            ).status_code,
        }
        assert {name for name, status in statuses.items() if status != 403} == allowed
        assert client.get("/api/uploads").status_code == 403
        assert refused(client, SOCKET.replace("events", "ingest/drone")) in (403, 4403)


def test_guessing_is_slowed_down(root: Path) -> None:
    """After some wrong secrets of a token not even the right one is looked at for a while."""
    client, token = guarded(root)
    with client:
        wrong = {"authorization": f"Bearer {token[:-1]}"}
        statuses = [client.get("/api/sites", headers=wrong).status_code for _ in range(7)]
        assert statuses[:5] == [401] * 5 and 429 in statuses[5:]
        waiting = client.get("/api/sites", headers={"authorization": f"Bearer {token}"})
        assert waiting.status_code == 429 and int(waiting.headers["retry-after"]) >= 1
        assert refused(client, SOCKET, **wrong) in (429, 4429)


def test_who_guesses_keeps_nobody_else_out(root: Path) -> None:
    """A crew shares one address: one of them with an old token must not hold up the others, nor its own next login."""
    client, token = guarded(root)
    with client:
        old = {
            "authorization": "Bearer sorvolo_000000000000_old",
            "cookie": "sorvolo_session=sorvolo_000000000000_old",
        }
        assert [client.get("/api/sites", headers=old).status_code for _ in range(7)][-1] == 429
        assert (
            client.get("/api/sites", headers={"authorization": f"Bearer {token}"}).status_code
            == 200
        )
        assert client.get("/", headers=old).status_code == 200
        assert client.post("/api/session", json={"token": token}, headers=old).status_code == 200


def test_a_network_of_ipv6_addresses_guesses_as_one() -> None:
    """Whoever has one address of it has 2^64."""
    assert (
        address_group("2001:db8::1")
        == address_group("2001:db8::ffff:2")
        != address_group("2001:db8:0:1::1")
    )
    assert (
        address_group("192.0.2.1") != address_group("192.0.2.2")
        and address_group("testclient") == "testclient"
    )


def test_each_wrong_token_doubles_the_wait() -> None:
    """Up to minutes; a right one forgives."""
    now = [0.0]
    guesses = Guesses(clock=lambda: now[0])
    waits = []
    for _ in range(20):
        now[0] += guesses.wait_s("a")
        guesses.note("a", right=False)
        waits.append(guesses.wait_s("a"))
    assert waits[:4] == [0.0] * 4 and waits[4:8] == [1.0, 2.0, 4.0, 8.0] and waits[-1] == 300.0
    assert guesses.wait_s("b") == 0.0
    guesses.note("a", right=True)
    assert guesses.wait_s("a") == 0.0


# ---- where it listens ---------------------------------------------------------------------------------------------


def test_others_reach_it_only_with_tokens_and_tls(tmp_path: Path) -> None:
    """Or with the option that the network is trusted."""
    check_exposure(StationSettings(tmp_path), has_tokens=False)
    check_exposure(StationSettings(tmp_path, "localhost"), has_tokens=False)
    with pytest.raises(SettingsError, match="sorvolo token"):
        check_exposure(StationSettings(tmp_path, "0.0.0.0", insecure_lan=True), has_tokens=False)
    with pytest.raises(SettingsError, match="tls_cert"):
        check_exposure(StationSettings(tmp_path, "192.168.1.5"), has_tokens=True)
    check_exposure(StationSettings(tmp_path, "0.0.0.0", insecure_lan=True), has_tokens=True)
    certificate = tmp_path / "cert.pem"
    certificate.write_text("")
    check_exposure(
        StationSettings(tmp_path, "::", tls_cert=certificate, tls_key=certificate), has_tokens=True
    )
    with pytest.raises(SettingsError, match="belong together"):
        StationSettings(tmp_path, tls_cert=certificate)


def test_the_command_refuses_in_one_line(tmp_path: Path) -> None:
    """Not after it has listened already."""
    result = CliRunner().invoke(command, ["serve", str(tmp_path), "--host", "0.0.0.0"])
    assert isinstance(result.exception, SettingsError) and "sorvolo token" in str(result.exception)
    made = CliRunner().invoke(command, ["token", str(tmp_path), "Ada", "--role", "operate"])
    assert made.exit_code == 0 and made.output.startswith("sorvolo_")
    result = CliRunner().invoke(command, ["serve", str(tmp_path), "--host", "0.0.0.0"])
    assert "--insecure-lan" in f"{result.exception}"
    listed = CliRunner().invoke(command, ["token", str(tmp_path)])
    assert "Ada" in listed.output and made.output.strip() not in listed.output
    with closing(socket.socket()) as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        result = CliRunner().invoke(
            command, ["serve", str(tmp_path), "--port", str(taken.getsockname()[1])]
        )
        assert "another program" in str(result.exception)


# ---- paths and links ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "path",
    [
        "/page/../app.py",
        "/page/..%2fapp.py",
        "/page/%2e%2e/state.py",
        "/page//etc/passwd",
        "/page/..\\app.py",
        "/api/sites/..%2f..%2fetc",
        "/api/sites/%2e%2e",
        "/api/sites/..",
        "/api/sites/field%2f..%2f..",
        "/api/sites/field/crops/change/..%2f..%2fsite.db/0.jpg",
        "/api/sites/field/flights/..%2f..%2f/video",
        "/api/sites/field/flights/..%5c..%5csite.db/video",
        "/api/runs/..%2fstation.db",
        "/api/uploads/..%2fstation.db",
        "/api/sites/field/tiles/..%2f1/18/1/1.webp",
        "/api/sites/station/tiles/1/18/1/1.webp",
        "/station/station.db",
        "/api/streams/..%2f..",
    ],
)
def test_no_path_leads_outside(reader: TestClient, path: str) -> None:
    """Names are looked up, never followed."""
    answer = reader.get(path)
    assert answer.status_code in (400, 404, 405), path
    assert (
        b"root:" not in answer.content
        and b"SQLite" not in answer.content
        and b"import" not in answer.content
    )


def test_links_in_a_site_are_not_followed(root: Path, tmp_path: Path) -> None:
    """A stranger's site with a link in it is refused as a whole, and so is a picture that became a link."""
    secret = tmp_path / "secret.jpg"
    secret.write_bytes(b"\xff\xd8 secret")
    with TestClient(station_app(StationSettings(root)), base_url=HOST) as client:
        crop = "/api/sites/field/crops/change/b-1/0.jpg"
        assert client.get(crop).status_code == 200
        picture = root / "field/flights/b/changes/b-1-before.png"
        picture.unlink()
        picture.symlink_to(secret)
        answer = client.get(crop)
        assert answer.status_code == 409 and b"secret" not in answer.content
    with TestClient(station_app(StationSettings(root)), base_url=HOST) as client:
        assert client.get("/api/sites/field").status_code == 409
        assert "link" in client.get("/api/sites").json()[0]["error"]


def test_a_large_request_is_refused(client: TestClient) -> None:
    """Announced, or in pieces of unknown length."""
    large = b'{"note": "' + b"x" * 1_500_000 + b'"}'
    assert client.post("/api/sites/field/reviews", content=large).status_code == 413
    assert (
        client.post(
            "/api/sites/field/reviews",
            content=(large[i : i + 99_999] for i in range(0, len(large), 99_999)),
        ).status_code
        == 413
    )
    assert client.post(
        "/api/runs", content=large[:100], headers={"content-length": "-5"}
    ).status_code in (400, 413)


# ---- streams ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "url",
    [
        "rtsp://127.0.0.1/live",
        "rtsp://localhost:554/live",
        "rtsp://[::1]/live",
        "rtsp://10.0.0.5/live",
        "rtsp://192.168.1.1/",
        "rtsp://169.254.169.254/latest",
        "rtsp://[fe80::1]/x",
        "rtsp://[::ffff:127.0.0.1]/x",
        "rtsp://0.0.0.0/x",
        "rtsp://224.0.0.1/x",
        "rtmp://[fd00::1]/live",
        "rtsp://2130706433/x",
        "rtsp://[2002:7f00:1::]/x",
        "http://example.com/x.m3u8",
        "https://example.com/x",
        "file:///etc/passwd",
        "tcp://8.8.8.8:80",
        "concat:/etc/x",
        "follow:/etc/passwd",
        "webcam:0",
        "/etc/passwd",
        "udp://:80",
        "udp://:5600?localaddr=10.0.0.1",
        "rtsp://8.8.8.8\r\nx",
        "rtsp:///x",
        "srt://8.8.8.8:9000?mode=listener",
        "rtsp://8.8.8.8:99999/x",
    ],
)
def test_streams_of_the_own_network_are_not_called(url: str) -> None:
    """Nor other schemes, nor files in disguise."""
    with pytest.raises(Problem) as problem:
        checked_stream(url, ())
    assert problem.value.status == 400


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("file:///etc/passwd", "streams of file are not called"),
        ("rtsp:///x", "names no host"),
        ("/etc/x", "no scheme"),
        ("udp://:80", "with a port from 1024 on"),
    ],
)
def test_an_address_that_is_refused_states_what_was_found(url: str, words: str) -> None:
    with pytest.raises(Problem, match=words):
        checked_stream(url, ())


def test_a_stream_that_may_be_called_is_called_where_it_was_checked() -> None:
    """The name is asked for once: an answer that changes afterwards changes nothing."""
    answers = iter([["203.0.113.9"], ["127.0.0.1"]])
    with pytest.raises(Problem):  # a documentation network is no public one
        checked_stream("rtsp://cam.example/live", (), lambda _, __: next(answers))
    assert checked_stream(
        "rtsp://me:pw@cam.example:8554/live?x=1", (), lambda _, __: ["93.184.216.34"]
    ) == ("rtsp://me:pw@93.184.216.34:8554/live?x=1")
    with pytest.raises(Problem):
        checked_stream("rtsp://cam.example/live", (), lambda _, __: ["93.184.216.34", "10.0.0.1"])
    assert (
        checked_stream("rtsp://192.168.1.10/live", ("192.168.1.0/24",))
        == "rtsp://192.168.1.10/live"
    )
    with pytest.raises(Problem):
        checked_stream("rtsp://192.168.2.10/live", ("192.168.1.0/24",))
    assert checked_stream("udp://:5600", ()) == "udp://:5600"


def test_a_streams_password_is_shown_to_nobody(client: TestClient, root: Path) -> None:
    """Not in the run, its events, its errors; on the disk for the mission's eyes alone."""
    run = client.post(
        "/api/runs",
        json={
            "mission": "watch",
            "site": "field",
            "input": {"stream_url": "rtsp://me:secretword@127.0.0.1/live"},
        },
    )
    assert run.status_code == 400 and "secretword" not in run.text
    inputs = client.app.state.station.inputs  # type: ignore[attr-defined]
    from sorvolo.station.orders import InputWish

    shown = inputs.shown(
        InputWish(stream_url="rtsp://me:secretword@93.184.216.34/live?token=secretword")
    )
    assert shown == {"stream_url": "rtsp://93.184.216.34/live"}
    assert (root / "station").stat().st_mode & 0o077 == 0


def test_a_missions_error_holds_no_password(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """FFmpeg's own errors state the whole address, and every viewer reads why a mission failed."""
    source = "rtsp://me:secretword@93.184.216.34/live?token=hidden"
    RunOrder(run="r", mission="watch", site=str(tmp_path), source=source).write(tmp_path)

    def fail(*_: object) -> str:
        raise ValueError(f"Invalid data found when processing input: {source!r}")

    monkeypatch.setitem(run_process.MISSIONS, "watch", fail)
    monkeypatch.setattr(signal, "signal", lambda *_: None)  # those of the tests stay
    monkeypatch.setenv(SOURCE_VARIABLE, source)
    assert run_process.main(tmp_path) == 1
    text = (tmp_path / "journal.jsonl").read_text() + capsys.readouterr().err
    assert (
        text.count("93.184.216.34/live") == 2 and "secretword" not in text and "hidden" not in text
    )


def test_a_mission_gets_a_streams_password_by_its_environment_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its children do not; what the environment holds of another order is left alone."""
    source = "rtsp://me:secretword@93.184.216.34/live?token=hidden"
    order = RunOrder(run="r", mission="watch", site=str(tmp_path), source=source)
    order.write(tmp_path)
    assert (
        "secretword" not in (text := (tmp_path / "order.json").read_text()) and "hidden" not in text
    )
    monkeypatch.setenv(SOURCE_VARIABLE, source)
    assert RunOrder.read(tmp_path).source == source and SOURCE_VARIABLE not in os.environ
    monkeypatch.setenv(SOURCE_VARIABLE, "rtsp://me:pw@192.0.2.1/else")
    assert RunOrder.read(tmp_path).source == "rtsp://93.184.216.34/live"
