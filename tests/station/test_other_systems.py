"""The station for other people's programs: Prometheus, structured logs, TAK with the drone's field of view."""

import io
import json
import logging
import math
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, fromstring

import pytest
from prometheus_client.parser import text_string_to_metric_families
from starlette.testclient import TestClient
from stream_flights import write_track, write_video
from test_stream_messages import units
from test_stream_routes import HELLO, WS

from sorvolo.station.app import station_app
from sorvolo.station.events import NewEvent
from sorvolo.station.metrics import JsonLines
from sorvolo.station.outward import OutwardSettings, view_of_frame, view_of_sample
from sorvolo.station.settings import StationSettings
from sorvolo.store.exports.cursor_on_target import cot_drone

HOST = "http://127.0.0.1:8750"


def metrics(client: TestClient) -> dict[tuple[str, tuple[tuple[str, str], ...]], float]:
    text = client.get("/metrics").text
    return {
        (sample.name, tuple(sorted(sample.labels.items()))): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


def test_metrics_count_requests_streams_and_what_is_refused(client: TestClient) -> None:
    client.get("/api/sites/field")
    client.get("/api/sites/field")
    client.get("/api/sites/none")
    client.get("/api/status", headers={"Host": "evil.example"})
    with client.websocket_connect(f"{WS}/api/ingest/scout") as drone:
        drone.send_bytes(HELLO)
        drone.receive_json()
        found = metrics(client)
        assert found["sorvolo_stream_connected", (("stream", "scout"),)] == 1
    site = (("method", "GET"), ("route", "/api/sites/{site}"), ("status", "200"))
    assert found["sorvolo_http_requests_total", site] == 2
    assert (
        found[
            "sorvolo_http_requests_total",
            (("method", "GET"), ("route", "refused"), ("status", "421")),
        ]
        == 1
    )
    assert found["sorvolo_http_request_seconds_count", (("route", "/api/sites/{site}"),)] == 3
    assert found["sorvolo_disk_free_bytes", ()] > 0 and found["sorvolo_events_total", ()] >= 1


def test_invented_methods_make_no_new_series(client: TestClient) -> None:
    """Anybody may send them, also without a token: each would take memory for ever."""
    for number in range(3):
        assert client.request(f"INVENTED{number}", "/api/status").status_code in (404, 405)
    methods = {dict(labels).get("method") for _, labels in metrics(client)}
    assert "other" in methods and not any(str(each).startswith("INVENTED") for each in methods)


def test_logs_are_json_without_queries_and_tokens(client: TestClient) -> None:
    stream = io.StringIO()
    handler = logging.StreamHandler(stream)
    handler.setFormatter(JsonLines())
    logger = logging.getLogger("sorvolo.station.requests")
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    try:
        client.get(
            "/api/sites/field?place=45.1234567,9.2", headers={"Authorization": "Bearer hidden"}
        )
        logger.error("fell over", exc_info=ValueError("why"))
    finally:
        logger.removeHandler(handler)
        logger.setLevel(logging.NOTSET)
    request, fault = map(json.loads, stream.getvalue().splitlines())
    assert (request["path"], request["status"], request["method"], request["who"]) == (
        "/api/sites/field",
        200,
        "GET",
        "this machine",
    )
    assert request["time"].endswith("Z") and request["ms"] > 0 and request["level"] == "info"
    assert "45.1234567" not in stream.getvalue() and "hidden" not in stream.getvalue()
    assert "ValueError: why" in fault["traceback"]


def test_a_field_of_view_from_telemetry_and_from_a_footprint() -> None:
    """A camera of 60 x 40 degrees, 100 m up, looks straight down with its top to the east."""
    half_m = 100 * math.tan(math.radians(30)), 100 * math.tan(math.radians(20))
    east_m = 111_320 * math.cos(math.radians(45))
    corners = [(1, 1), (1, -1), (-1, -1), (-1, 1)]  # the top left one lies in the north-east
    outline = [[9 + x * half_m[1] / east_m, 45 + y * half_m[0] / 111_320] for x, y in corners]
    view = view_of_frame(
        {
            "position": [9.0, 45.0],
            "height_m": 100.0,
            "heading_deg": 90.0,
            "pitch_deg": -90.0,
            "footprint": [*outline, outline[0]],
        }
    )
    assert view is not None
    assert (view.across_deg, view.down_deg, view.range_m) == pytest.approx((60, 40, 100), rel=1e-6)
    view = view_of_sample(
        {
            "latitude_deg": 45.0,
            "longitude_deg": 9.0,
            "camera_yaw_deg": -90.0,
            "camera_pitch_deg": -30.0,
            "height_above_takeoff_m": 50.0,
        },
        {"sensor_horizontal_fov_deg": 60.0},
    )
    assert view is not None and view.range_m == pytest.approx(100) and math.isnan(view.height_m)
    event = fromstring(cot_drone(view, uid="u", callsign="scout\x00", now_ns=0, stale_s=15))
    sensor = event.find("detail/sensor")
    assert sensor is not None and event.get("type") == "a-f-A-M-H-Q"
    assert (
        sensor.get("azimuth"),
        sensor.get("elevation"),
        sensor.get("fov"),
        sensor.get("range"),
    ) == (
        "270.0",
        "-30.0",
        "60.0",
        "100",
    )
    assert event.find("detail/contact").get("callsign") == "scout"  # type: ignore[union-attr]
    assert (
        view_of_sample({"latitude_deg": 45.0}, {}) is None
        and view_of_frame({"position": [1]}) is None
    )


@pytest.fixture
def team() -> Iterator[socket.socket]:
    """A TAK phone that listens."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        listener.bind(("127.0.0.1", 0))
        listener.settimeout(0.2)
        yield listener


def heard(team: socket.socket, *, wanted: str, limit_s: float = 4.0) -> Element:
    """The first event whose uid begins so."""
    until_s = time.monotonic() + limit_s
    while time.monotonic() < until_s:
        try:
            event = fromstring(team.recv(65_536))
        except TimeoutError:
            continue
        if str(event.get("uid")).startswith(wanted):
            return event
    raise AssertionError(f"nothing of {wanted} came")


def feature(**properties: Any) -> dict[str, Any]:
    return {
        "type": "Feature",
        "geometry": {"type": "Point", "coordinates": [9.0, 45.0]},
        "properties": properties,
    }


def test_a_team_sees_the_drone_what_it_found_and_what_turned_out_to_be_none(
    root: Path, tmp_path: Path, team: socket.socket
) -> None:
    write_track(tmp_path / "v.csv")
    messages = units(write_video(tmp_path / "v.mp4", seconds=1), "h264")
    receivers = OutwardSettings(cot=f"udp://127.0.0.1:{team.getsockname()[1]}")
    app = station_app(StationSettings(root), receivers)
    with (
        TestClient(app, base_url=HOST) as client,
        client.websocket_connect(f"{WS}/api/ingest/scout") as drone,
    ):
        drone.send_bytes(HELLO)
        for each in messages:
            drone.send_bytes(each.to_bytes())
        assert heard(team, wanted="sorvolo.drone.scout").find("point").get("lat") == "45.0000000"  # type: ignore[union-attr]
        events = app.state.station.events
        events.append(
            NewEvent(
                "object.found",
                {"feature": feature(id=3, score=0.9, **{"class": "person"})},
                "field",
                "r1",
            ),
            NewEvent(
                "change.announced", {"feature": feature(id="c-1", kind="appeared")}, "field", "r2"
            ),
            NewEvent("change.withdrawn", {"id": "c-1"}, "field", "r2"),
        )
        person = heard(team, wanted="sorvolo.field.r1.3")
        assert person.get("type") == "a-u-G"
        assert "person, score 0.90" in str(person.findtext("detail/remarks"))
        removed = heard(team, wanted="sorvolo.field.c-1.removed")
        assert removed.find("detail/link").get("uid") == "sorvolo.field.c-1"  # type: ignore[union-attr]
