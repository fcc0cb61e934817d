"""Cursor on Target events arrive over real sockets."""

import socket
import time

import pytest
from live_sender import free_port

from sorvolo.errors import SettingsError
from sorvolo.missions.watch.cot_sender import CotPlace, CotSender, cot_place


@pytest.mark.parametrize(
    ("url", "place"),
    [
        ("udp://239.2.3.1:6969", CotPlace("udp", "239.2.3.1", 6969)),
        ("udp://tak.local", CotPlace("udp", "tak.local", 6969)),
        ("tcp://[::1]:9000", CotPlace("tcp", "::1", 9000)),
        ("tcp://tak.local", CotPlace("tcp", "tak.local", 8087)),
    ],
)
def test_places(url: str, place: CotPlace) -> None:
    assert cot_place(url) == place


@pytest.mark.parametrize("url", ["", "tak.local:4242", "http://tak.local", "udp://:99", "udp://h:77777", "udp://h:0"])
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
        with pytest.raises(ConnectionRefusedError):  # tells of the datagram before
            sender.send(b"<event n='2'/>")
        assert again.recv(100) == b"<event n='2'/>"
    sender.close()


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
