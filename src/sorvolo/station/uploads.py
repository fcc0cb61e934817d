"""Uploads of flights by the tus protocol (1.0): resumed after a cut, limited in size and kind, checked before use."""

import base64
import binascii
import json
import re
import secrets
import shutil
import subprocess
import threading
import time
from collections.abc import AsyncIterator, Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, replace
from pathlib import Path, PureWindowsPath

import anyio
from fastapi import APIRouter, Header, Request, Response
from starlette.requests import ClientDisconnect

from sorvolo.child_process import python_command
from sorvolo.paths import Json, JsonView
from sorvolo.station.events import EventLog, NewEvent
from sorvolo.station.problems import Problem, demand_room
from sorvolo.station.security import FOR_OPERATORS, needs
from sorvolo.station.settings import StationSettings
from sorvolo.station.state import utc_now
from sorvolo.station.tokens import Holder, Role
from sorvolo.store.atomic import atomic_write_bytes, writing
from sorvolo.store.site.files import is_plain_name

VIDEO_ENDINGS = (".mp4", ".mov", ".m4v", ".mkv", ".ts")
"""Files that are taken as videos."""

TEXT_ENDINGS = (
    ".srt",
    ".ass",
    ".mrk",
    ".csv",
    ".gpx",
    ".txt",
    ".nmea",
    ".log",
    ".xml",
    ".yaml",
    ".yml",
    ".json",
    ".geojson",
)
"""Files that are taken as telemetry, cameras and areas."""

MAX_UPLOAD_BYTES = 64_000_000_000
"""The largest upload: an hour of 4K video, or some 5,000 photos."""

_ARCHIVE_ENDINGS = (".zip",)
_MOST_TEXT_BYTES = 256_000_000  # of telemetry: half of what a reader takes
_PART, _INFO, _FILES = "part", "info.json", "files"
_CHECK_WITHIN_S = 1800.0  # for the check of a whole upload, by the clock; by choice
_GIVEN_UP_S = 3600.0  # nothing came for so long: the room that an upload announced is free again
_LOOK_EVERY_BYTES = 64_000_000  # written between two looks at the free space
# a request that sends nothing for so long has lost its link: another one may go on
_SILENT_S = 30.0
_ID = re.compile(r"[0-9a-f]{24}")


@dataclass(frozen=True)
class Upload:
    """An upload as its info.json has it. `state`: receiving, checking, ready, refused (`why`)."""

    id: str
    name: str
    bytes: int
    made_at: str
    who: str
    state: str = "receiving"
    why: str | None = None
    facts: JsonView | None = None

    @property
    def kind(self) -> str:
        """What it is by its name: "video", "photos" (a .zip) or "text"."""
        ending = Path(self.name).suffix.lower()
        return (
            "video"
            if ending in VIDEO_ENDINGS
            else "photos"
            if ending in _ARCHIVE_ENDINGS
            else "text"
        )


class Uploads:
    """The uploads of a station, each in a folder of its own. Threads may share it."""

    def __init__(self, settings: StationSettings, events: EventLog) -> None:
        self._settings, self._events = settings, events
        self._folder = settings.state_folder / "uploads"
        self._busy: set[str] = set()
        self._lock = threading.Lock()
        self._checking = ThreadPoolExecutor(1, thread_name_prefix="upload check")
        self._child = Child()
        for each in self.all():  # the station was stopped meanwhile
            if each.state == "checking" or (
                each.state == "receiving" and self.offset(each) == each.bytes
            ):
                self._begin_check(each)

    def all(self) -> list[Upload]:
        """Every upload, oldest first."""
        found = []
        for path in self._folder.glob(f"*/{_INFO}") if self._folder.is_dir() else ():
            try:
                found.append(Upload(**json.loads(path.read_bytes())))
            except (
                OSError,
                ValueError,
                TypeError,
            ):
                # being taken away, or broken by somebody: no upload
                continue
        return sorted(found, key=lambda each: (each.made_at, each.id))

    def create(self, metadata: str, length: int, who: str) -> Upload:
        """Begin an upload. Raises Problem: 400, 413 too large, 415 of no known kind, 507 without room."""
        name = _checked_name(_metadata(metadata).get("filename", ""))
        made = Upload(secrets.token_hex(12), name, length, utc_now(), who)
        if not 0 < length <= MAX_UPLOAD_BYTES or (
            made.kind == "text" and length > _MOST_TEXT_BYTES
        ):
            raise Problem(
                413,
                f"{length} bytes: 1 to {MAX_UPLOAD_BYTES} are taken, of text {_MOST_TEXT_BYTES}",
            )
        here = self.all()
        announced = sum(each.bytes - self.offset(each) for each in here if self._comes(each))
        self._demand_room(length + announced)
        most = self._settings.limits.most_uploads
        if len(here) >= most:
            raise Problem(
                409, f"there are {most} uploads already; delete those that you no longer need"
            )
        folder = self._folder / made.id
        with writing(folder):
            folder.mkdir(parents=True)
            (folder / _PART).touch()
        self._write(made)
        return made

    def get(self, upload_id: str) -> Upload:
        """An upload. Raises Problem (404)."""
        try:
            if _ID.fullmatch(upload_id):
                return Upload(**json.loads((self._folder / upload_id / _INFO).read_bytes()))
        except (OSError, ValueError, TypeError):
            pass
        raise Problem(404, f"no upload {upload_id[:40]!r}; /api/uploads lists those there are")

    def offset(self, upload: Upload) -> int:
        """How many bytes of it are here."""
        if upload.state != "receiving":
            return upload.bytes
        try:
            return (self._folder / upload.id / _PART).stat().st_size
        except OSError:
            return 0

    def _comes(self, upload: Upload) -> bool:
        """Whether more of an upload is to be expected: what was given up holds no room."""
        try:
            last_s = (self._folder / upload.id / _PART).stat().st_mtime
        except OSError:
            return False
        return time.time() - last_s < _GIVEN_UP_S

    async def take(self, upload: Upload, offset: int, chunks: AsyncIterator[bytes]) -> int:
        """Append what comes to an upload; how many bytes are here then. What came before a cut is kept.

        Raises Problem: 409 for an offset that is not where it ends, 423 while another request appends, 413, 507.
        """
        with self._lock:
            if upload.id in self._busy:
                raise Problem(423, "another request is sending this upload; wait until it ends")
            self._busy.add(upload.id)
        try:
            upload = self.get(upload.id)
            if upload.state != "receiving" or offset != self.offset(upload):
                raise Problem(
                    409,
                    f"the upload ends at {self.offset(upload)}, not at {offset}; ask where it ends",
                )
            here = await self._append(upload, offset, chunks)
            if here == upload.bytes:
                self._begin_check(upload)
            return here
        finally:
            with self._lock:
                self._busy.discard(upload.id)

    def delete(self, upload_id: str) -> None:
        """Take an upload away. Raises Problem (404, 423)."""
        upload = self.get(upload_id)
        with self._lock:
            if upload.id in self._busy:
                raise Problem(423, "another request is sending this upload; wait until it ends")
        shutil.rmtree(self._folder / upload.id, ignore_errors=True)

    def finished_path(self, upload_id: str) -> Path:
        """The file, or the folder of photos, of an upload that was checked. Raises Problem (404, 409)."""
        upload = self.get(upload_id)
        if upload.state == "refused":
            raise Problem(409, f"{upload.name} cannot be used: {upload.why}")
        if upload.state != "ready":
            raise Problem(
                409, f"{upload.name} is not here yet ({upload.state}); wait until it is ready"
            )
        return self._target(upload)

    def videos(self) -> list[Path]:
        """The files of all uploads that are videos and ready."""
        return [
            self._target(each)
            for each in self.all()
            if each.state == "ready" and each.kind == "video"
        ]

    def name_of(self, upload_id: str) -> str:
        """The name of an upload's file; its id where it is gone."""
        try:
            return self.get(upload_id).name
        except Problem:
            return upload_id

    def _demand_room(self, more_bytes: int = 0) -> None:
        demand_room(self._settings.root, self._settings.free_floor_gb, more_bytes / 1e9)

    def close(self) -> None:
        """Stop checking; what was not checked is when the station starts again."""
        self._child.end()
        self._checking.shutdown(wait=False, cancel_futures=True)

    # ---- inside -----------------------------------------------------------------------------------------------

    async def _append(self, upload: Upload, offset: int, chunks: AsyncIterator[bytes]) -> int:
        self._demand_room()  # of each request: many small ones would else fill the disk
        here, looked = offset, offset
        with writing(self._folder / upload.id):
            async with await anyio.open_file(self._folder / upload.id / _PART, "r+b") as file:
                await file.seek(offset)
                async for chunk in _while_they_come(chunks):
                    if here + len(chunk) > upload.bytes:
                        raise Problem(
                            413, f"more came than the {upload.bytes} bytes that were announced"
                        )
                    if here - looked > _LOOK_EVERY_BYTES:
                        self._demand_room()
                        looked = here
                    await file.write(chunk)
                    here += len(chunk)
        return here

    def _begin_check(self, upload: Upload) -> None:
        checked = replace(upload, state="checking")
        self._write(checked)
        self._checking.submit(self._check, checked)

    def _check(self, upload: Upload) -> None:
        """Look into an upload in a process of its own, and make it ready or refuse it."""
        folder, target = self._folder / upload.id, self._target(upload)
        part = folder / _PART
        if part.exists():
            shutil.rmtree(target.parent, ignore_errors=True)  # of a check that was cut off
        keep_free_bytes = int(self._settings.free_floor_gb * 1e9)
        try:
            error, facts = checked_apart(
                part if part.exists() else target,
                target,
                MAX_UPLOAD_BYTES,
                keep_free_bytes,
                self._child.run,
            )
            if self._child.is_ended or not folder.is_dir():  # the station ends; deleted meanwhile
                return
            if error is None and upload.kind != "photos" and part.exists():
                target.parent.mkdir(exist_ok=True)
                part.rename(target)
        except OSError as fault:
            error, facts = f"it cannot be looked into here ({fault.strerror})", None
        if error is not None:
            shutil.rmtree(target.parent, ignore_errors=True)
        done = replace(
            upload, state="ready" if error is None else "refused", why=error, facts=facts
        )
        self._write(done)
        part.unlink(missing_ok=True)
        self._events.append(NewEvent("upload.checked", asdict(done)))

    def _target(self, upload: Upload) -> Path:
        is_folder = upload.kind == "photos"  # whose name has no ending that states another kind
        name = Path(upload.name).stem.replace(".", "_") if is_folder else upload.name
        return self._folder / upload.id / _FILES / name

    def _write(self, upload: Upload) -> None:
        atomic_write_bytes(self._folder / upload.id / _INFO, json.dumps(asdict(upload)).encode())


class Child:
    """Runs one process at a time, which a Ctrl-C at the station does not reach; `end` kills it, and any later one."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self.is_ended = False

    def run(self, command: Sequence[str], timeout_s: float) -> bytes:
        """What the process prints. Raises subprocess.TimeoutExpired, after which it is gone."""
        with self._lock:
            if self.is_ended:
                return b""
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                start_new_session=True,
            )
        with self._process as process:
            try:
                return process.communicate(timeout=timeout_s)[0]
            except subprocess.TimeoutExpired:
                process.kill()
                raise

    def end(self) -> None:
        """Kill it."""
        with self._lock:
            self.is_ended = True
            if self._process is not None:
                self._process.kill()


def checked_apart(
    part: Path,
    target: Path,
    most_bytes: int,
    keep_free_bytes: int,
    run: Callable[[Sequence[str], float], bytes],
) -> tuple[str | None, JsonView | None]:
    """What is wrong with an upload (None: nothing), and what it holds, found in a process with limits of its own."""
    command = python_command(
        "sorvolo.station.check_upload",
        str(part),
        str(target),
        str(most_bytes),
        str(keep_free_bytes),
    )
    try:
        answer = json.loads(run(command, _CHECK_WITHIN_S))
        return answer["error"], answer.get("facts")
    except subprocess.TimeoutExpired:
        return "looking into it took too long", None
    except (ValueError, KeyError, TypeError):
        return (
            "looking into it took more memory or time than a flight needs, or broke the decoder",
            None,
        )


async def _while_they_come(chunks: AsyncIterator[bytes]) -> AsyncIterator[bytes]:
    """The chunks of a request. Raises Problem (408) where none comes for a while."""
    while True:
        try:
            with anyio.fail_after(_SILENT_S):
                chunk = await anext(chunks, None)
        except TimeoutError:
            raise Problem(
                408, f"nothing came for {_SILENT_S:.0f} s; ask where the upload ends, and go on"
            ) from None
        if chunk is None:
            return
        yield chunk


def _metadata(text: str) -> dict[str, str]:
    """tus's Upload-Metadata: names and values in base64. Raises Problem (400)."""
    found = {}
    for pair in filter(None, (each.strip() for each in text.split(","))):
        key, _, value = pair.partition(" ")
        try:
            found[key] = base64.b64decode(value, validate=True).decode()
        except (binascii.Error, ValueError) as error:
            raise Problem(
                400, "Upload-Metadata: names with values in base64 were needed (`filename ...`)"
            ) from error
    return found


def _checked_name(name: str) -> str:
    """A file's name without any folder. Raises Problem (400, 415)."""
    bare = PureWindowsPath(name).name
    if not is_plain_name(bare):
        raise Problem(
            400, "Upload-Metadata: a `filename` of letters, digits and usual punctuation was needed"
        )
    if Path(bare).suffix.lower() not in (*VIDEO_ENDINGS, *TEXT_ENDINGS, *_ARCHIVE_ENDINGS):
        raise Problem(
            415,
            f"{bare[:80]}: a video ({', '.join(VIDEO_ENDINGS)}), photos as .zip, or telemetry and cameras "
            f"({', '.join(TEXT_ENDINGS)}) were needed",
        )
    return bare


_VERSION = "1.0.0"
_KIND = "application/offset+octet-stream"
_MOST_LENGTH = 10**15  # bytes; the free disk is asked before one is taken


def upload_routes(
    uploads: Uploads, unused: Callable[[str], AbstractContextManager[None]]
) -> APIRouter:
    """Begin, continue, ask after, end an upload."""
    router = APIRouter(prefix="/api/uploads", tags=["uploads"], dependencies=FOR_OPERATORS)

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
    def all_uploads() -> list[Json]:
        """Every upload with how much of it is here and whether it can be used."""
        return [_row(uploads, each) for each in uploads.all()]

    @router.post("", status_code=201)
    def begin(
        upload_length: int = Header(ge=1, le=_MOST_LENGTH),
        upload_metadata: str = Header(max_length=4000),
        holder: Holder = needs(Role.OPERATE),
    ) -> Response:
        """Begin an upload of Upload-Length bytes; Upload-Metadata names its file (`filename BASE64`)."""
        made = uploads.create(upload_metadata, upload_length, holder.name)
        return _answer(201, {"Location": f"/api/uploads/{made.id}", "Upload-Offset": "0"})

    @router.get("/{upload_id}")
    def one(upload_id: str, answer: Response) -> Json:
        """An upload: its state (receiving, checking, ready, refused and why); its head says how much of it is here."""
        row = _row(uploads, uploads.get(upload_id))
        here = {"Upload-Offset": str(row["offset"]), "Upload-Length": str(row["bytes"])}
        answer.headers.update({"Tus-Resumable": _VERSION, **here})
        return row

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
        with unused(upload_id):  # no mission reads it meanwhile
            uploads.delete(upload_id)
        return _answer(204, {})

    return router


def _answer(status: int, headers: dict[str, str]) -> Response:
    return Response(status_code=status, headers={"Tus-Resumable": _VERSION, **headers})


def _row(uploads: Uploads, upload: Upload) -> Json:
    return {**asdict(upload), "kind": upload.kind, "offset": uploads.offset(upload)}
