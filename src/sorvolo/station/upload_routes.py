"""The routes of uploads: tus 1.0 with creation and termination."""

from dataclasses import asdict
from typing import Any

from fastapi import APIRouter, Depends, Header, Request, Response
from starlette.requests import ClientDisconnect

from sorvolo.station.problems import Problem
from sorvolo.station.runs import Runs
from sorvolo.station.security import needs
from sorvolo.station.tokens import Holder, Role
from sorvolo.station.uploads import MAX_UPLOAD_BYTES, Upload, Uploads

_VERSION = "1.0.0"
_KIND = "application/offset+octet-stream"
_MOST_LENGTH = 10**15  # bytes; the free disk is asked before one is taken


def upload_routes(uploads: Uploads, runs: Runs) -> APIRouter:
    """Begin, continue, ask after, end an upload."""
    router = APIRouter(
        prefix="/api/uploads", tags=["uploads"], dependencies=[Depends(needs(Role.OPERATE))]
    )

    @router.options("", status_code=204)
    def about() -> Response:
        """What this tus server can do."""
        return _answer(
            204,
            {
                "Tus-Version": _VERSION,
                "Tus-Extension": "creation,termination",
                "Tus-Max-Size": str(MAX_UPLOAD_BYTES),
            },
        )

    @router.get("")
    def all_uploads() -> list[dict[str, Any]]:
        """Every upload with how much of it is here and whether it can be used."""
        return [_row(uploads, each) for each in uploads.all()]

    @router.post("", status_code=201)
    def begin(
        upload_length: int = Header(ge=1, le=_MOST_LENGTH),
        upload_metadata: str = Header(max_length=4000),
        holder: Holder = Depends(needs(Role.OPERATE)),
    ) -> Response:
        """Begin an upload of Upload-Length bytes; Upload-Metadata names its file (`filename BASE64`)."""
        made = uploads.create(upload_metadata, upload_length, holder.name)
        return _answer(201, {"Location": f"/api/uploads/{made.id}", "Upload-Offset": "0"})

    @router.head("/{upload_id}")
    def where(upload_id: str) -> Response:
        """How much of an upload is here."""
        upload = uploads.get(upload_id)
        return _answer(
            200, {"Upload-Offset": str(uploads.offset(upload)), "Upload-Length": str(upload.bytes)}
        )

    @router.get("/{upload_id}")
    def one(upload_id: str) -> dict[str, Any]:
        """An upload: its state (receiving, checking, ready, refused and why)."""
        return _row(uploads, uploads.get(upload_id))

    @router.patch("/{upload_id}", status_code=204)
    async def send(
        request: Request,
        upload_id: str,
        upload_offset: int = Header(ge=0, le=_MOST_LENGTH),
        content_type: str = Header(max_length=100),
    ) -> Response:
        """Append bytes at Upload-Offset."""
        if content_type != _KIND:
            raise Problem(415, f"Content-Type: {_KIND} was needed")
        upload = uploads.get(upload_id)
        try:
            here = await uploads.take(upload, upload_offset, request.stream())
        except ClientDisconnect:  # what came is kept; nobody reads this answer
            here = uploads.offset(upload)
        return _answer(204, {"Upload-Offset": str(here)})

    @router.delete("/{upload_id}", status_code=204)
    def end(upload_id: str) -> Response:
        """Take an upload away. 423 while a mission reads it."""
        with runs.unused(upload_id):
            uploads.delete(upload_id)
        return _answer(204, {})

    return router


def _answer(status: int, headers: dict[str, str]) -> Response:
    return Response(status_code=status, headers={"Tus-Resumable": _VERSION, **headers})


def _row(uploads: Uploads, upload: Upload) -> dict[str, Any]:
    return {**asdict(upload), "kind": upload.kind, "offset": uploads.offset(upload)}
