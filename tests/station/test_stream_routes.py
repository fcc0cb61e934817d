"""A drone and browsers at a whole station: roles, states, pictures, and the command itself."""

import asyncio
import json
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import uvicorn
from starlette.testclient import TestClient, WebSocketDenialResponse
from starlette.websockets import WebSocketDisconnect
from stream_flights import write_track, write_video
from test_stream_messages import units

from sorvolo.cli import main as cli
from sorvolo.station.app import station_app
from sorvolo.station.events import NewEvent
from sorvolo.station.messages import Hello, Kind, Message
from sorvolo.station.settings import STATE_FOLDER, StationSettings
from sorvolo.station.state import StationState
from sorvolo.station.stream_routes import announcing
from sorvolo.station.tokens import make_token
from waiting import wait_for

WS = "ws://127.0.0.1:8750"
HELLO = Message(
    Kind.HELLO, 0, 0, Hello("a" * 16, "h264", 160, 120, 10.0).to_json().encode()
).to_bytes()


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("flight")
    write_track(folder / "scout.csv")
    return write_video(folder / "scout.mp4")


def test_a_flight_comes_in_and_its_pictures_go_out(
    client: TestClient, video: Path, root: Path
) -> None:
    messages = units(video, "h264")
    with client.websocket_connect(f"{WS}/api/ingest/scout") as drone:
        drone.send_bytes(HELLO)
        assert drone.receive_json() == {"type": "welcome", "seq": 0}
        for each in messages[:20]:
            drone.send_bytes(each.to_bytes())
        assert drone.receive_json()["type"] == "ack"
        with client.websocket_connect(f"{WS}/api/streams/scout/video") as page:
            assert page.receive_json()["codec"] == "avc1.42c00a"
            assert len(page.receive_bytes()) > 100
        state = client.get("/api/streams/scout").json()
        assert (
            state["is_connected"]
            and state["frames"] + state["samples"] <= 20
            and state["width"] == 160
        )
        for each in messages[20:]:
            drone.send_bytes(each.to_bytes())
        drone.send_bytes(Message(Kind.END, 0, 0, b"").to_bytes())
        while (answer := drone.receive_json())["type"] != "ended":
            pass
        assert answer["seq"] == messages[-1].seq
    (stream,) = client.get("/api/streams").json()
    assert not stream["is_connected"] and stream["flights"][0]["is_over"]
    assert len(list((root / "streams" / "scout").glob("*.ts"))) == 1


@pytest.mark.parametrize("name", ["..", "a%2Fb", ".hidden", "x" * 65])
def test_a_stream_s_name_reaches_no_other_folder(client: TestClient, root: Path, name: str) -> None:
    with (
        pytest.raises(WebSocketDisconnect),
        client.websocket_connect(f"{WS}/api/ingest/{name}") as drone,
    ):
        drone.send_bytes(HELLO)
        drone.receive_json()
    assert not (root / "streams").exists()
    assert client.get(f"/api/streams/{name}").status_code in (400, 404)


def test_a_refused_link_leaves_its_name_free(client: TestClient) -> None:
    """A link that was refused after its hello counted for ever: the drone's next flight was held up by it."""

    def answer(flight: str, codec: str) -> dict[str, object]:
        hello = Hello(flight * 16, codec, 160, 120, 10.0).to_json().encode()
        with client.websocket_connect(f"{WS}/api/ingest/scout") as drone:
            drone.send_bytes(Message(Kind.HELLO, 0, 0, hello).to_bytes())
            return dict(drone.receive_json())

    def wait_until_gone() -> None:
        wait_for(lambda: not client.get("/api/streams/scout").json()["is_connected"])

    assert answer("a", "h264")["type"] == "welcome"
    wait_until_gone()
    with pytest.raises(WebSocketDisconnect) as refused:
        answer("a", "hevc")
    assert "begin a new flight" in refused.value.reason
    wait_until_gone()
    assert answer("b", "h264")["type"] == "welcome"


def test_who_only_looks_keeps_no_drone_away(client: TestClient) -> None:
    """Asking for streams that nobody sends takes nothing that a drone needs."""
    for number in range(200):
        assert client.get(f"/api/streams/x{number}").json()["viewers"] == 0
    with (
        client.websocket_connect(f"{WS}/api/streams/early/video"),
        client.websocket_connect(f"{WS}/api/ingest/scout") as drone,
    ):
        drone.send_bytes(HELLO)
        assert drone.receive_json()["type"] == "welcome"
        assert client.get("/api/streams/early").json()["viewers"] == 1
    assert client.get("/metrics").status_code == 200


def test_a_stream_s_states_are_announced_in_their_order() -> None:
    """Else a page would show a drone as connected that went away just after it came. With the newest flight alone:
    thousands of events are kept."""
    written: list[int] = []
    flights = [{"flight": "one"}, {"flight": "two"}]

    class Disk:
        """Takes long for the first event."""

        def append(self, event: NewEvent) -> int:
            time.sleep(0.2 if event.data["n"] == 0 else 0.0)
            assert event.data["flights"] == flights[-1:]
            written.append(event.data["n"])
            return 0

    async def run() -> None:
        announce = announcing(Disk())  # type: ignore[arg-type]
        for number in range(3):
            announce("scout", {"n": number, "flights": flights})
        while len(written) < 3:
            await asyncio.sleep(0.02)

    asyncio.run(asyncio.wait_for(run(), 60))
    assert written == [0, 1, 2]


def test_only_operators_send_and_whoever_sees_the_station_sees_the_video(root: Path) -> None:
    state = StationState.open(root / STATE_FOLDER)
    view = {"Authorization": f"Bearer {make_token(state, 'guest', 'view', None)}"}
    state.close()
    with TestClient(station_app(StationSettings(root)), base_url="http://127.0.0.1:8750") as client:
        for path, headers, status in (("ingest/x", view, 403), ("streams/x/video", {}, 401)):
            with (
                pytest.raises(WebSocketDenialResponse) as denied,
                client.websocket_connect(f"{WS}/api/{path}", headers=headers),
            ):
                pass
            assert denied.value.status_code == status
        with client.websocket_connect(f"{WS}/api/streams/x/video", headers=view):
            pass


@pytest.fixture
def station(root: Path) -> Iterator[str]:
    """A station at a port of its own, on the network."""
    app = station_app(StationSettings(root))
    config = uvicorn.Config(
        app, "127.0.0.1", 0, log_level="error", ws="websockets-sansio", ws_max_size=16_000_000
    )
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    while not server.started:
        assert thread.is_alive()
        threading.Event().wait(0.02)
    yield f"http://127.0.0.1:{server.servers[0].sockets[0].getsockname()[1]}"
    server.should_exit = True
    thread.join(5)


def test_the_command_sends_a_recording_and_cleans_up(
    station: str, video: Path, root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    spool = tmp_path / "spool"
    arguments = ["stream", str(video), "--to", station, "--spool", str(spool), "--speed", "0"]
    assert cli.main([*arguments, "--json"]) == 0
    (flight,) = json.loads(capsys.readouterr().out)["flights"]
    assert (
        flight["frames"] == 30
        and flight["samples"] == 7
        and flight["waiting"] == flight["dropped_late"] == 0
    )
    assert not spool.exists() and list((root / "streams" / "scout").glob("*.ts.ended"))
    assert cli.main(arguments) == 0
    assert "Sent as scout: 30 frames and 7 telemetry samples" in capsys.readouterr().out


def test_the_command_refuses_in_words(
    station: str, video: Path, root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    state = StationState.open(root / STATE_FOLDER)
    guest = make_token(state, "guest", "view", None)
    state.close()
    arguments = ["stream", str(video), "--spool", str(tmp_path / "spool"), "--speed", "0", "--to"]
    assert cli.main([*arguments, station, "--token", guest]) == 1
    assert "refuses the token (HTTP 403)" in capsys.readouterr().err
    assert cli.main([*arguments, "ftp://x"]) == 1
    assert "no station's address" in capsys.readouterr().err
    assert cli.main([*arguments, station, "--token", guest, "--stream", "a/b"]) == 1
    assert "'a/b' is no stream's name" in capsys.readouterr().err
