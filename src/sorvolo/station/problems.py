"""Errors as HTTP answers: RFC 9457 problem documents that state what was found, what was needed, what to do."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from starlette.exceptions import HTTPException

from sorvolo.errors import (
    DiskFullError,
    NoHeightsError,
    NotFoundError,
    SorvoloError,
    StoreError,
)
from sorvolo.station.state import shortage

_TITLES = {
    400: "This does not work as it was asked",
    401: "Token needed",
    403: "Not allowed",
    404: "Not found",
    405: "Method not allowed",
    408: "Nothing came",
    409: "Conflict",
    410: "Gone",
    412: "Changed meanwhile",
    413: "Too large",
    415: "Unknown kind",
    421: "Misdirected request",
    422: "Invalid request",
    423: "In use",
    428: "Look first",
    429: "Too many attempts",
    500: "Error in the station",
    507: "Disk full",
}
_KIND = "application/problem+json"
_SCHEMA = {
    "type": "object",
    "required": ["title", "status", "detail"],
    "properties": {
        "title": {"type": "string"},
        "status": {"type": "integer"},
        "detail": {"type": "string"},
    },
}
PROBLEM_ANSWERS: dict[int | str, dict[str, Any]] = {
    status: {
        "description": "What was found, needed, to do (RFC 9457)",
        "content": {_KIND: {"schema": _SCHEMA}},
    }
    for status in (422, "4XX", "5XX")
}
"""How the API's description announces problem documents."""


class Problem(Exception):
    """A request that cannot be answered as it is: the HTTP status, what is wrong and what to do, more fields."""

    def __init__(
        self, status: int, detail: str, *, headers: Mapping[str, str] | None = None, **more: object
    ) -> None:
        super().__init__(detail)
        self.status = status
        self.detail = detail
        self.headers = dict(headers or {})
        self.more = more


def problem_answer(problem: Problem) -> JSONResponse:
    """The document of a problem."""
    body = {
        "title": _TITLES.get(problem.status, "Error"),
        "status": problem.status,
        "detail": problem.detail,
        **problem.more,
    }
    return JSONResponse(body, problem.status, problem.headers, media_type=_KIND)


def status_of(error: SorvoloError) -> int:
    """The HTTP status of an error that a person must act on."""
    if isinstance(error, DiskFullError):
        return 507
    if isinstance(error, NotFoundError | NoHeightsError):
        return 404
    return 409 if isinstance(error, StoreError) else 400


def demand_room(root: Path, floor_gb: float, coming_gb: float = 0.0) -> None:
    """Raise Problem (507) where what is coming would not leave the floor of free space."""
    if short := shortage(root, floor_gb, coming_gb):
        raise Problem(
            507, f"{short}; delete uploads, recordings or flights that you no longer need"
        )


def below(root: Path, words: str) -> str:
    """A message without the folder in which the station's sites lie: it is nobody's business who asks."""
    return words.replace(f"{root.resolve()}/", "").replace(f"{root.absolute()}/", "")


def answer_problems(app: FastAPI, root: Path) -> None:
    """Let every error of the app's routes be answered by a problem document; files are named below the root."""

    @app.exception_handler(Problem)
    async def _of_problem(_: Request, error: Problem) -> JSONResponse:
        return problem_answer(error)

    @app.exception_handler(SorvoloError)
    async def _of_ours(_: Request, error: SorvoloError) -> JSONResponse:
        return problem_answer(Problem(status_of(error), below(root, str(error))))

    @app.exception_handler(RequestValidationError)
    async def _of_request(_: Request, error: RequestValidationError) -> JSONResponse:
        faults = "; ".join(
            f"{'.'.join(str(part) for part in each['loc'])}: {each['msg']}"
            for each in error.errors()[:4]
        )
        words = f"{faults}; /openapi.json describes what each request needs"
        return problem_answer(Problem(422, words))

    @app.exception_handler(HTTPException)
    async def _of_http(_: Request, error: HTTPException) -> JSONResponse:
        return problem_answer(Problem(error.status_code, str(error.detail), headers=error.headers))

    @app.exception_handler(Exception)
    async def _of_unexpected(_: Request, error: Exception) -> JSONResponse:
        words = f"an error in the station ({type(error).__name__}); its log has the rest: please report it"
        return problem_answer(Problem(500, words))
