"""Cursor on Target events arrive over real sockets."""

import shutil
import socket
import ssl
import subprocess
import threading
import time
from pathlib import Path

import pytest
from live_sender import free_port

from sorvolo.errors import InputError, SettingsError
from sorvolo.missions.watch.cot_sender import CotPlace, CotSender, CotTls, cot_place, send_all
from sorvolo.missions.watch.settings import WatchOutputs


@pytest.mark.parametrize(
    ("url", "place"),
    [
        ("udp://239.2.3.1:6969", CotPlace("udp", "239.2.3.1", 6969)),
        ("udp://tak.local", CotPlace("udp", "tak.local", 6969)),
        ("tcp://[::1]:9000", CotPlace("tcp", "::1", 9000)),
        ("tcp://tak.local", CotPlace("tcp", "tak.local", 8087)),
        ("tls://tak.local", CotPlace("tls", "tak.local", 8089)),
    ],
)
def test_places(url: str, place: CotPlace) -> None:
    assert cot_place(url) == place


@pytest.mark.parametrize(
    "url", ["", "tak.local:4242", "http://tak.local", "udp://:99", "udp://h:77777", "udp://h:0"]
)
def test_what_is_no_place(url: str) -> None:
    with pytest.raises(SettingsError, match="udp://host:port"):
        cot_place(url)


def test_udp_arrives_and_a_dead_receiver_is_an_error_that_passes() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        port = free_port()
        receiver.bind(("127.0.0.1", port))
        receiver.settimeout(5)
        sender = CotSender(CotPlace("udp", "127.0.0.1", port))
        sender.send(b"<event/>")
        assert receiver.recv(100) == b"<event/>"
    failed = 0
    for _ in range(2):
        try:
            sender.send(b"<event/>")
        except OSError:
            failed += 1
    assert failed == 1
    sender.send(b"<event/>")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as again:
        again.bind(("127.0.0.1", port))
        again.settimeout(5)
        with pytest.raises(ConnectionRefusedError):  # of the datagram before
            sender.send(b"<event n='2'/>")
        assert again.recv(100) == b"<event n='2'/>"
    sender.close()


def test_datagrams_that_a_host_refuses_are_not_counted_as_sent() -> None:
    """Each other one was: a refusal is only known when the next one is sent."""
    with pytest.raises(
        InputError, match=r"nothing listens there .*start the receiver, and send them again"
    ):
        send_all([b"<event/>"] * 16, CotPlace("udp", "127.0.0.1", free_port()))


def test_tcp_is_connected_again_after_the_server_went_away() -> None:
    port = free_port(socket.SOCK_STREAM)
    with socket.create_server(("127.0.0.1", port)) as server:
        server.settimeout(5)
        sender = CotSender(CotPlace("tcp", "127.0.0.1", port))
        sender.send(b"<a/>")
        first, _ = server.accept()
        assert first.recv(100) == b"<a/>"
        first.sendall(b"<event>what servers send back</event>")
        sender.send(b"<b/>")
        assert first.recv(100) == b"<b/>"
        first.close()
        time.sleep(0.05)
        sender.send(b"<c/>")
        second, _ = server.accept()
        assert second.recv(100) == b"<c/>"
        second.close()
    time.sleep(0.05)
    with pytest.raises(OSError):
        sender.send(b"<d/>")
    sender.close()


@pytest.fixture(scope="module")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A server's and a client's certificate with their keys, each its own authority."""
    if shutil.which("openssl") is None:
        pytest.skip("openssl is not installed")
    folder = tmp_path_factory.mktemp("certificates")
    made = {}
    for name in ("server", "client"):
        path = folder / f"{name}.pem"
        subprocess.run(
            [
                "openssl",
                "req",
                "-x509",
                "-newkey",
                "rsa:2048",
                "-nodes",
                "-days",
                "2",
                "-subj",
                f"/CN={name}",
                "-addext",
                "subjectAltName=DNS:localhost,IP:127.0.0.1",
                "-keyout",
                str(folder / "key"),
                "-out",
                str(folder / "cert"),
            ],
            check=True,
            capture_output=True,
        )
        path.write_bytes((folder / "cert").read_bytes() + (folder / "key").read_bytes())
        made[name] = path
    return made


def _tls_server(
    certificates: dict[str, Path], server: socket.socket, received: list[bytes]
) -> threading.Thread:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(certificates["server"])
    context.load_verify_locations(certificates["client"])
    context.verify_mode = ssl.CERT_REQUIRED

    def serve() -> None:
        plain, _ = server.accept()
        plain.settimeout(5)
        try:
            with context.wrap_socket(plain, server_side=True) as stream:
                received.append(stream.recv(100))
                received.append(stream.recv(100))
        except OSError:
            plain.close()

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    return thread


def test_tls_with_certificates_on_both_sides(certificates: dict[str, Path]) -> None:
    received: list[bytes] = []
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(5)
        thread = _tls_server(certificates, server, received)
        place = CotPlace("tls", "127.0.0.1", server.getsockname()[1])
        sender = CotSender(place, CotTls(certificates["server"], certificates["client"]))
        sender.send(b"<event n='1'/>")
        while not received:
            time.sleep(0.01)
        sender.send(b"<event n='2'/>")
        thread.join(5)
        sender.close()
    assert received == [b"<event n='1'/>", b"<event n='2'/>"]


def _serve_all(
    certificates: dict[str, Path], server: socket.socket, received: list[bytes], tickets: int
) -> None:
    """Take connections one after the other, each to its end; of a client without the right certificate nothing."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(certificates["server"])
    context.load_verify_locations(certificates["client"])
    context.verify_mode, context.num_tickets = ssl.CERT_REQUIRED, tickets
    while True:
        try:
            plain, _ = server.accept()
        except OSError:
            return
        plain.settimeout(5)
        try:
            with context.wrap_socket(plain, server_side=True) as stream:
                while part := stream.recv(1000):
                    received.append(part)
        except OSError:
            plain.close()


@pytest.mark.parametrize("tickets", [0, 2])
def test_a_client_that_the_server_refuses_has_sent_nothing(
    certificates: dict[str, Path], tickets: int
) -> None:
    received: list[bytes] = []
    events = [b"<event n='%d'/>" % number for number in range(25)]
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(5)
        thread = threading.Thread(
            target=_serve_all, args=(certificates, server, received, tickets), daemon=True
        )
        thread.start()
        place = CotPlace("tls", "127.0.0.1", server.getsockname()[1])
        with pytest.raises(
            InputError, match=r"nothing could be sent.*certificate required.*give cot_cert"
        ):
            send_all(events, place, CotTls(certificates["server"]))
        with pytest.raises(
            InputError, match=r"nothing could be sent.*check that it knows .*cot_cert"
        ):
            send_all(events, place, CotTls(certificates["server"], certificates["server"]))
        assert not received
        assert send_all(events, place, CotTls(certificates["server"], certificates["client"])) == 25
        assert b"".join(received) == b"".join(
            events
        )  # `send_all` returns when the server has taken them
        with pytest.raises(ConnectionRefusedError, match="--cot-cert"):
            CotSender(place, CotTls(certificates["server"])).send(events[0])
    thread.join(6)


def test_a_receiver_that_breaks_the_connection_is_no_receiver() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(5)
        sender = CotSender(CotPlace("tcp", "127.0.0.1", server.getsockname()[1]))
        sender.send(b"<event/>")
        taken, _ = server.accept()
        time.sleep(0.05)
        taken.close()  # with the event unread
        time.sleep(0.05)
        with pytest.raises(ConnectionResetError):
            sender.finish()
        sender.send(b"<event n='2'/>")
        taken, _ = server.accept()
        assert taken.recv(100) == b"<event n='2'/>"
        began_s = time.monotonic()
        sender.finish()  # a server that holds its half open is not waited for without end
        assert time.monotonic() - began_s < 10
        assert taken.recv(100) == b""
        taken.close()


def test_an_unknown_server_is_refused(certificates: dict[str, Path]) -> None:
    received: list[bytes] = []
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(5)
        thread = _tls_server(certificates, server, received)
        sender = CotSender(CotPlace("tls", "127.0.0.1", server.getsockname()[1]))
        with pytest.raises(ssl.SSLCertVerificationError):
            sender.send(b"<event/>")
        thread.join(5)
    assert not received


def test_a_server_that_is_not_trusted_is_asked_once_and_the_remedy_named(
    certificates: dict[str, Path],
) -> None:
    """Each event made a handshake, and a later "Connection refused" took the place of the cause."""
    received: list[bytes] = []
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(5)
        thread = _tls_server(certificates, server, received)  # takes one connection
        place = CotPlace("tls", "127.0.0.1", server.getsockname()[1])
        with pytest.raises(
            InputError, match=r"certificate is not trusted \(self.signed certificate\).*cot_ca"
        ):
            send_all([b"<event/>"] * 3, place)
        thread.join(5)
        server.settimeout(0.2)
        with pytest.raises(TimeoutError):
            server.accept()
    assert not received


def test_a_receiver_that_does_not_answer_is_waited_for_once() -> None:
    """40 events to a server whose queue is full took two minutes."""
    with socket.socket() as server:
        server.bind(("127.0.0.1", 0))
        server.listen(0)
        place = CotPlace("tcp", "127.0.0.1", server.getsockname()[1])
        waiting = [socket.socket() for _ in range(4)]
        for each in waiting:  # more than the queue takes
            each.setblocking(False)
            each.connect_ex(("127.0.0.1", place.port))
        began_s = time.monotonic()
        with pytest.raises(InputError, match=r"nothing could be sent \(timed out\)"):
            send_all([b"<event/>"] * 5, place)
        assert time.monotonic() - began_s < 10  # three seconds for each event otherwise
        for each in waiting:
            each.close()


def test_a_receiver_that_goes_away_is_tried_once_more() -> None:
    """What it took counts, and nothing more is waited for."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(5)
        place = CotPlace("tcp", "127.0.0.1", server.getsockname()[1])

        def take_one() -> None:
            taken, _ = server.accept()
            server.close()
            taken.recv(1000)
            taken.close()

        thread = threading.Thread(target=take_one, daemon=True)
        thread.start()
        sent = send_all([b"<event/>" * 10_000] * 200, place)
        thread.join(5)
    assert 1 <= sent < 200


def test_certificates_that_cannot_be_used(tmp_path: Path) -> None:
    broken = tmp_path / "broken.pem"
    broken.write_text("nothing")
    with pytest.raises(InputError, match=r"broken\.pem"):
        CotTls(certificate=broken).context()
    with pytest.raises(SettingsError, match="missing"):
        CotTls(ca=tmp_path / "missing.pem").context()
    with pytest.raises(SettingsError, match="tls://"):
        WatchOutputs(cot="udp://tak.local", cot_tls=CotTls(ca=broken))
