"""A small RTSP server for tests: one film, live, RTP over the TCP connection, with the sender's reports."""

import socket
import threading
from contextlib import closing, suppress

from live_sender import free_port, sending_apart

_SDP = (
    "v=0\r\no=- 0 0 IN IP4 127.0.0.1\r\ns=drone\r\nt=0 0\r\nm=video 0 RTP/AVP 96\r\n"
    "a=rtpmap:96 H264/90000\r\na=fmtp:96 packetization-mode=1\r\na=control:track1\r\n"
)


class RtspServer(threading.Thread):
    """Serves `rtsp://127.0.0.1:PORT/live`; who gives no password, where one is set, is sent away.

    `says`: what it answers to every request in place of that, as it is; `{cseq}` is the request's number.
    """

    def __init__(self, *, password: bool = False, says: str = "") -> None:
        super().__init__(daemon=True)
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._password, self._says = password, says
        self.address = f"rtsp://127.0.0.1:{self._listener.getsockname()[1]}/live"
        self.methods: list[str] = []
        self.playing = 0  # connections that get the film now
        self._connections: list[socket.socket] = []

    def run(self) -> None:
        while True:
            try:
                connection, _ = self._listener.accept()
            except OSError:
                return
            self._connections.append(connection)
            threading.Thread(target=self._serve, args=(connection,), daemon=True).start()

    def hang_up(self) -> None:
        """Break all connections, as a drone out of reach does."""
        while self._connections:
            connection = self._connections.pop()
            with suppress(OSError):  # the other side was first
                connection.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        self._listener.close()
        self.hang_up()

    def _serve(self, connection: socket.socket) -> None:
        lines = connection.makefile("rb")
        try:
            while line := lines.readline():
                method = line.split()[0].decode()
                headers: dict[str, str] = {}
                while header := lines.readline().strip():
                    name, _, value = header.decode().partition(":")
                    headers[name.lower()] = value.strip()
                self.methods.append(method)
                self._answer(connection, method, headers)
                if method == "PLAY":
                    self.playing += 1
                    try:
                        self._play(connection)
                    finally:
                        self.playing -= 1
                    return
        except (OSError, IndexError):
            return

    def _answer(self, connection: socket.socket, method: str, headers: dict[str, str]) -> None:
        if self._says:
            connection.sendall(self._says.replace("{cseq}", headers["cseq"]).encode())
            return
        status, extra, body = "200 OK", "", ""
        if self._password:
            status = "401 Unauthorized"
            extra = 'WWW-Authenticate: Basic realm="drone"\r\n'
        elif method == "OPTIONS":
            extra = "Public: OPTIONS, DESCRIBE, SETUP, PLAY, TEARDOWN\r\n"
        elif method == "DESCRIBE":
            body = _SDP
            extra = f"Content-Type: application/sdp\r\nContent-Base: {self.address}/\r\nContent-Length: {len(body)}\r\n"
        elif method == "SETUP":
            extra = "Transport: RTP/AVP/TCP;unicast;interleaved=0-1\r\nSession: 1\r\n"
        elif method == "PLAY":
            extra = "Session: 1\r\n"
        connection.sendall(
            f"RTSP/1.0 {status}\r\nCSeq: {headers['cseq']}\r\n{extra}\r\n{body}".encode()
        )

    def _play(self, connection: socket.socket) -> None:
        """What FFmpeg's RTP writer sends by UDP goes on over the connection: `$`, channel, length."""
        port = free_port(count=2)
        with closing(_bound(port)) as media, closing(_bound(port + 1)) as reports:
            url = f"rtp://127.0.0.1:{port}?pkt_size=1200"
            with sending_apart(url, container="rtp", count=100_000):
                threading.Thread(
                    target=_pass_on, args=(reports, connection, 1), daemon=True
                ).start()
                _pass_on(media, connection, 0)


def _bound(port: int) -> socket.socket:
    bound = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    bound.bind(("127.0.0.1", port))
    bound.settimeout(10)
    return bound


def _pass_on(source: socket.socket, connection: socket.socket, channel: int) -> None:
    try:
        while True:
            data = source.recv(65_536)
            connection.sendall(b"$" + bytes([channel]) + len(data).to_bytes(2, "big") + data)
    except OSError:
        return
