"""The API as it describes itself: whatever is sent by that description, it answers by it, and never with a 500."""

import json
from collections import Counter
from contextlib import suppress
from typing import Any

import pytest
from fake_flights import SITE, map_flight
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis.errors import Unsatisfiable
from starlette.testclient import TestClient

from sorvolo.station.app import station_app
from sorvolo.station.settings import StationSettings
from sorvolo.store.site.archive import Archive

pytest.importorskip("schemathesis")

import schemathesis
from schemathesis import GenerationMode
from schemathesis.checks import not_a_server_error
from schemathesis.core import NOT_SET
from schemathesis.specs.openapi.checks import (
    content_type_conformance,
    response_schema_conformance,
    status_code_conformance,
)

CHECKS = [
    not_a_server_error,
    status_code_conformance,
    content_type_conformance,
    response_schema_conformance,
]

_ENDLESS = "/api/events"  # Server-Sent Events go on for ever


@pytest.fixture(scope="module")
def api(tmp_path_factory: pytest.TempPathFactory):  # type: ignore[no-untyped-def]
    """The description of a station over a site with a map and changes, and a client of it."""
    root = tmp_path_factory.mktemp("root")
    with Archive.open(root / "field", write=True) as archive:
        archive.create_site(SITE)
        map_flight(archive, "a", 40, count=2)
        map_flight(archive, "b", 90, count=2, compared=True)
    app = station_app(StationSettings(root, free_floor_gb=0.0))
    with TestClient(app, base_url="http://127.0.0.1:8750", raise_server_exceptions=False) as client:
        yield schemathesis.openapi.from_dict(client.get("/openapi.json").json()), client


def test_the_description_names_every_route_once(api) -> None:  # type: ignore[no-untyped-def]
    """Operations have ids of their own, and words."""
    schema, _ = api
    operations = [each for path in schema.raw_schema["paths"].values() for each in path.values()]
    ids = [each["operationId"] for each in operations]
    assert len(ids) == len(set(ids)) > 30
    assert all(each.get("description") for each in operations)


def test_whatever_is_sent_by_the_description_is_answered_as_described(api) -> None:  # type: ignore[no-untyped-def]
    """Statuses, kinds of content and bodies, of what fits the description and of what does not."""
    schema, client = api
    asked: Counter[str] = Counter()
    for found in schema.get_all_operations():
        operation = found.ok()
        if operation.path == _ENDLESS:
            continue
        _ask(client, operation, GenerationMode.POSITIVE, asked)
        if (
            len(operation.query) or len(operation.body) or len(operation.headers)
        ):  # a name in a path cannot be wrong
            _ask(client, operation, GenerationMode.NEGATIVE, asked)
    assert len(asked) > 30 and sum(asked.values()) > 60


def _ask(client: TestClient, operation: Any, mode: GenerationMode, asked: Counter[str]) -> None:
    """Some requests of one operation; raises what schemathesis finds wrong with an answer."""

    @settings(
        max_examples=2,
        deadline=None,
        database=None,
        derandomize=True,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(operation.as_strategy(generation_mode=mode))
    def ask(case: Any) -> None:
        body = {}
        if case.body is not NOT_SET:
            body["content"] = (
                case.body
                if isinstance(case.body, bytes)
                else json.dumps(case.body, default=str).encode()
            )
        headers = {
            name: text for name, text in (case.headers or {}).items() if _can_be_sent(name, text)
        }
        kind = {"content-type": case.media_type} if body and case.media_type else {}
        answer = client.request(
            case.method,
            case.formatted_path,
            params=dict(case.query or {}),
            headers={**kind, **headers},
            **body,
        )
        asked[operation.label] += 1
        case.validate_response(answer, checks=CHECKS)

    with suppress(Unsatisfiable):  # some operations have nothing that could be wrong
        ask()


def _can_be_sent(name: str, text: Any) -> bool:
    """Whether a client can put this into a header at all."""
    return (
        str(text).isascii()
        and str(text).isprintable()
        and name.lower() not in ("host", "cookie", "authorization")
    )
