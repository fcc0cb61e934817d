"""The station's missions: each in its own process, found again after a restart, its journal turned into events."""

import contextlib
import itertools
import json
import logging
import os
import re
import secrets
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from urllib.parse import urlsplit

from fastapi import APIRouter, Query

from sorvolo.child_process import python_command
from sorvolo.missions.worker import BOXES, MOTION, TO_CHECK
from sorvolo.paths import Json, JsonView
from sorvolo.station.collections import SEARCH_FOLDER
from sorvolo.station.events import EventLog, NewEvent
from sorvolo.station.ingest import Ingest
from sorvolo.station.inputs import Inputs, input_row
from sorvolo.station.orders import (
    JOURNAL_FILE,
    LOCK_FILE,
    LOCK_VARIABLE,
    LOG_FILE,
    ORDER_FILE,
    SOURCE_VARIABLE,
    RunOrder,
    RunWish,
    writes,
)
from sorvolo.station.problems import Problem, below, demand_room
from sorvolo.station.security import FOR_OPERATORS, FOR_VIEWERS, needs
from sorvolo.station.settings import RESERVE_FILE, RUNS_FOLDER, STREAMS_FOLDER, StationSettings
from sorvolo.station.sites import SiteShelf
from sorvolo.station.state import (
    Reserve,
    StationState,
    ThreadOwner,
    compact_json,
    shortage,
    utc_after,
    utc_now,
)
from sorvolo.station.tokens import Holder, Role
from sorvolo.store.atomic import take_lock, writing

RUNNING = "running"
FINISHED = "finished"
INCOMPLETE = "incomplete"
FAILED = "failed"
STOPPED = "stopped"
LOST = "lost"
"""States of a run. Incomplete: finished and kept, but pictures of its flight are missing, as where the disk was full.
Lost: its process ended without a word, as when the machine was switched off."""

_ENDS = {"run.finished": FINISHED, "run.failed": FAILED, "run.stopped": STOPPED}
NOTHING_KEPT = "stopped; nothing was kept"
"""The headline of a mission that was stopped before it had anything."""

_NEVER = "9999"
_MOST_LINE_BYTES = 4_000_000  # read of a journal at a time: a line must fit
_MOST_LOG_BYTES = 4000  # some forty lines, enough for an error's trace
_LOOK_EVERY_S = 0.1  # at all that runs
_GLANCE_EVERY_S = 0.02  # whether a journal has grown: the boxes of a picture are in it
_LOG = logging.getLogger("sorvolo.station.disk")
_LIVE_S = 0.5  # how often the growing map is shown: a browser waits for it
_DISK_EVERY = 50  # looks between two at the disk


@dataclass(frozen=True)
class Run:
    """A mission as the page sees it. Times are RFC 3339 UTC; `input` holds no password."""

    id: str
    mission: str
    site: str
    state: str
    who: str
    started_at: str
    ended_at: str | None = None
    input: JsonView | None = None
    options: JsonView | None = None
    progress: JsonView | None = None
    headline: str | None = None
    exit_code: int | None = None
    error: str | None = None
    notice: str | None = None  # what a person should know while it runs: that the disk is full
    pid: int | None = None
    stop_asked: bool = False
    kill_at: str | None = None  # when a stop that brought no end becomes a kill


class Runs(ThreadOwner):
    """The missions of a station. Only `look` changes what is known of one that runs; a thread calls it."""

    def __init__(
        self,
        settings: StationSettings,
        state: StationState,
        shelf: SiteShelf,
        events: EventLog,
        inputs: Inputs,
        show: Callable[[str, JsonView], None] = lambda *_: None,
    ) -> None:
        self._show = show
        self._settings = settings
        self._state = state
        self._shelf = shelf
        self._events = events
        self._inputs = inputs
        self._folder = settings.state_folder / RUNS_FOLDER
        self._lock = threading.RLock()
        self._processes: dict[str, subprocess.Popen[bytes]] = {}
        self._ends: dict[str, int] = {}  # how far the journals of those that run were read
        self._lingering_s: dict[
            str, float
        ] = {}  # ended by their own journal, their processes not yet: since when
        self._is_low = False
        self._reserve = Reserve(settings.state_folder / RESERVE_FILE)
        super().__init__("runs", self._watch)

    def all(self, limit: int = 200, site: str = "") -> list[Run]:
        """The newest runs first, of one site or ("") of all."""
        rows = self._state.rows(
            "SELECT record FROM runs WHERE ? IN ('', site) ORDER BY made_at DESC, id LIMIT ?",
            (site, limit),
        )
        return [Run(**json.loads(row["record"])) for row in rows]

    def counts(self) -> dict[str, int]:
        """How many missions there are in each state."""
        return {
            row["state"]: row["count"]
            for row in self._state.rows("SELECT state, count(*) AS count FROM runs GROUP BY state")
        }

    def get(self, run_id: str) -> Run:
        """A run. Raises Problem (404)."""
        rows = self._state.rows("SELECT record FROM runs WHERE id = ?", (run_id,))
        if not rows:
            raise Problem(404, f"no run {run_id[:40]!r}; /api/runs lists those there are")
        return Run(**json.loads(rows[0]["record"]))

    def start(self, wish: RunWish, who: str) -> Run:
        """Start a mission in a process of its own.

        Raises Problem: 400, 404 for inputs, 409 where the site is being written or too many run, 507 without room.
        """
        demand_room(self._settings.root, self._settings.free_floor_gb)
        with self._lock:
            running = [each for each, _ in self._running()]
            if len(running) >= self._settings.limits.most_missions:
                raise Problem(
                    409, f"{len(running)} missions run already; wait until one ends, or stop one"
                )
            is_writing = writes(wish.mission, wish.input is not None, wish.options.model_dump())
            for each in running if is_writing else ():
                own = each.mission, each.input is not None, each.options or {}
                if each.site == wish.site and writes(*own):
                    raise _busy(409, each, f"writes into the site {wish.site!r}")
            makes_site = wish.mission in ("map", "watch", "demo") or (
                wish.mission == "search" and wish.input is not None
            )
            find = self._shelf.new_folder if makes_site else self._shelf.folder
            site = find(wish.site)
            run_id = secrets.token_hex(8)
            folder = self._folder / run_id
            options = wish.options
            given = {
                name: "" if each is None else self._inputs.source(each)
                for name, each in (
                    ("source", wish.input),
                    ("telemetry", options.telemetry),
                    ("camera", options.camera_file),
                )
            }
            results = site / SEARCH_FOLDER if wish.mission == "search" else folder / "results"
            stream = (wish.input.stream if wish.input else None) or ""
            door = self._settings.camera_door
            is_camera = (
                wish.input is not None and wish.input.stream_url is not None and door.is_socket()
            )
            order = RunOrder(
                run=run_id,
                mission=wish.mission,
                site=str(site.resolve()),
                source=given["source"],
                telemetry=given["telemetry"],
                camera=given["camera"] or options.camera or "",
                folder=str(results.resolve()),
                stream=_stream_of_camera(given["source"], run_id) if is_camera else stream,
                away_s=self._settings.limits.away_s,
                options=options.model_dump() | {"live_s": _LIVE_S, "voters": options.votes + 2},
                door=str(door.resolve()) if is_camera else "",
                streams=str((self._settings.root / STREAMS_FOLDER).resolve()),
                floor_gb=self._settings.free_floor_gb,
            )
            with writing(folder):
                folder.mkdir(parents=True)
            order.write(folder)
            run = Run(
                run_id,
                wish.mission,
                wish.site,
                RUNNING,
                who,
                utc_now(),
                input=self._inputs.shown(wish.input),
                options=wish.options.model_dump(mode="json", exclude_defaults=True),
            )
            process = _spawned(folder, order)
            run = replace(run, pid=process.pid)
            try:
                self._begin(run)
            except BaseException:
                # a full disk: nobody would know of the mission, nor could stop it
                process.kill()
                process.wait()
                raise
            self._processes[run_id] = process
            return run

    def stop(self, run_id: str) -> Run:
        """Ask a mission to end: a live flight is finished (a watch searches what was left) and kept, a recorded one is
        left out; asked again, at once.

        A process that takes longer to end than the settings allow is killed by `look`. Raises Problem (404, 409).
        """
        with self._lock:
            run = self.get(run_id)
            if run.state != RUNNING:
                raise Problem(409, f"this run is {run.state} already")
            # the number is still its own
            if run.pid is not None and not _has_ended(self._folder / run.id):
                with contextlib.suppress(ProcessLookupError):
                    os.kill(run.pid, signal.SIGTERM)
            limits = self._settings.limits
            is_finishing = _is_live(run) and not run.stop_asked
            within_s = limits.finish_within_s if is_finishing else limits.stop_within_s
            # a live watch then searches what was left, however long that takes
            searches_rest = is_finishing and run.mission == "watch"
            kill_at = None if searches_rest else utc_after(within_s)
            asked = replace(run, stop_asked=True, kill_at=kill_at)
            self._keep(asked, [])
            return asked

    def look(self) -> int:
        """Take in what the running missions wrote since; how many still run."""
        count = 0
        for run, offset in self._running():
            count += self._look_at(run, offset).state == RUNNING
        # take the exit codes of processes whose runs are over; kill those that state the
        # end and do not come to it
        for run_id, since_s in list(self._lingering_s.items()):
            process = self._processes.get(run_id)
            if process is not None and process.poll() is None:
                if time.monotonic() - since_s > self._settings.limits.stop_within_s:
                    _kill(process.pid)
                continue
            self._processes.pop(run_id, None)
            del self._lingering_s[run_id]
        return count

    def delete(self, run_id: str) -> Run:
        """Take away what is kept of a mission that is over: its record, its folder with what a watch found.

        The map that it made stays in its site. Raises Problem: 404, 409 for one that runs.
        """
        with self._lock:
            run = self.get(run_id)
            if run.state == RUNNING or not _has_ended(self._folder / run.id):
                raise Problem(409, "this run is running; stop it first")
            with self._events.appending([_event("run.deleted", run, {"id": run.id})]) as connection:
                connection.execute("DELETE FROM runs WHERE id = ?", (run.id,))
            # the loop that answers everybody does not wait for a disk
            threading.Thread(target=shutil.rmtree, args=(self._folder / run.id, True)).start()
            return run

    def stream_of(self, run_id: str) -> str:
        """The stream whose recording belongs to a mission alone: that of its camera; "" where there is none."""
        run = self.get(run_id)
        return _order_stream(self._folder / run.id) if "stream_url" in (run.input or {}) else ""

    def unused_stream(self, stream: str, but: str = "") -> AbstractContextManager[None]:
        """No mission begins meanwhile. Raises Problem (423) where one that runs, `but` this one, reads the stream."""
        return self._unused(
            lambda run: stream and run.id != but and stream == _order_stream(self._folder / run.id),
            "reads this stream",
        )

    def of_site(self, site_id: str) -> list[Run]:
        """All runs of a site, of however long ago."""
        return self.all(-1, site_id)

    @contextmanager
    def unused_site(self, site_id: str) -> Iterator[None]:
        """No mission begins meanwhile. Raises Problem (409) where one runs on the site."""
        with self._lock:
            for run in self.of_site(site_id):
                if run.state == RUNNING or not _has_ended(self._folder / run.id):
                    raise _busy(409, run, f"runs on the site {site_id!r}")
            yield

    def unused(self, upload_id: str) -> AbstractContextManager[None]:
        """No mission begins meanwhile. Raises Problem (423) where one that runs reads the upload."""
        return self._unused(lambda run: upload_id in _uploads_of(run), "reads this upload")

    def look_at_disk(self) -> None:
        """Announce once that the free space fell below the floor, and once that it is above it again.

        Missions that run carry a notice meanwhile.
        """
        free_gb = shutil.disk_usage(self._settings.root).free / 1e9
        floor_gb = self._settings.free_floor_gb
        short = shortage(self._settings.root, floor_gb)
        if not (is_low := bool(short)):
            self._reserve.hold()
        # let the missions that run state that the disk is full (`short`: in words), or no
        # more
        with self._lock:
            for run, _ in self._running():
                if bool(short) != bool(run.notice):
                    self._keep(replace(run, notice=_notice(run, short) if short else None), [])
        if is_low != self._is_low:
            data = {"is_low": is_low, "free_gb": round(free_gb, 2), "floor_gb": floor_gb}
            self._events.append(NewEvent("station.disk", data))
            self._is_low = is_low  # what a full disk did not take is announced at the next look
            _LOG.log(
                logging.WARNING if is_low else logging.INFO,
                "disk %s: %.2f GB are free, %.2f GB must stay so",
                "full" if is_low else "has room again",
                free_gb,
                floor_gb,
            )

    # ---- inside -----------------------------------------------------------------------------------------------

    @contextmanager
    def _unused(self, uses: Callable[[Run], object], words: str) -> Iterator[None]:
        with self._lock:
            for run, _ in self._running():
                if uses(run):
                    raise _busy(423, run, words)
            yield

    def _begin(self, run: Run) -> None:
        with self._events.appending([_event("run.started", run, run_row(run))]) as connection:
            connection.execute(
                "INSERT INTO runs (id, made_at, site, mission, state, record) VALUES (?, ?, ?, ?, ?, ?)",
                (
                    run.id,
                    run.started_at,
                    run.site,
                    run.mission,
                    run.state,
                    compact_json(asdict(run)),
                ),
            )

    def _running(self) -> list[tuple[Run, int]]:
        """The missions that run, each with how far its journal was read."""
        rows = self._state.rows(
            "SELECT record, journal_offset FROM runs WHERE state = ?", (RUNNING,)
        )
        return [(Run(**json.loads(row["record"])), row["journal_offset"]) for row in rows]

    def _watch(self) -> None:
        for count in itertools.count():
            if self._is_ending():
                return
            try:
                if count % _DISK_EVERY == 0:
                    self.look_at_disk()
                self.look()
            except Exception as error:  # a full disk, a folder taken away: logged, tried again
                if self._reserve.give():
                    continue
                sys.stderr.write(f"station: runs cannot be followed: {error}\n")
                self._ending.wait(2.0)

    def _is_ending(self) -> bool:
        """Wait until a journal has grown, for `_LOOK_EVERY_S` at most; whether the station ends."""
        until_s = time.monotonic() + _LOOK_EVERY_S
        while not self._ending.wait(_GLANCE_EVERY_S):
            ends = list(self._ends.items())
            grown = (
                _size_bytes(self._folder / run_id / JOURNAL_FILE) > end for run_id, end in ends
            )
            if time.monotonic() >= until_s or any(grown):
                return False
        return True

    def _look_at(self, run: Run, offset: int) -> Run:
        folder = self._folder / run.id
        # asked first: lines written before the end are then all there
        has_ended = _has_ended(folder)
        with self._lock:
            lines, end = _new_lines(folder / JOURNAL_FILE, offset)
            run, events = self._advanced(self.get(run.id), lines)
            # whether a run that counts as running, and whose lock is free, has no process any more
            process = self._processes.get(run.id)
            is_gone = run.state == RUNNING and (process is None or process.poll() is not None)
            if has_ended and end == offset and is_gone:
                run, event = self._mark_lost(run, folder)
                events.append(event)
            if events or end > offset:
                self._keep(run, events, end)
        self._ends[run.id] = end
        if run.state != RUNNING:
            self._ends.pop(run.id, None)
            self._lingering_s.setdefault(run.id, time.monotonic())
            self._shelf.forget(run.site)
        elif not has_ended and (run.kill_at or _NEVER) < utc_now():
            _kill(run.pid)
        return run

    def _advanced(self, run: Run, lines: Sequence[JsonView]) -> tuple[Run, list[NewEvent]]:
        """The run after lines of its journal, and the events that they become."""
        events = []
        for line in lines:
            if line["type"] in (BOXES, MOTION):  # ten a second: shown with the video, not kept
                self._show(line["type"], line["data"])
                continue
            data = json.loads(
                below(self._settings.root, json.dumps(line["data"], ensure_ascii=False))
            )
            run, event = _taken(run, {"type": line["type"], "data": data})
            events.append(event)
        return run, events

    def _mark_lost(self, run: Run, folder: Path) -> tuple[Run, NewEvent]:
        """A run whose process ended without its last line: killed, crashed, or switched off with the machine."""
        process = self._processes.get(run.id)
        code = process.poll() if process is not None else None
        ended = replace(run, ended_at=utc_now(), exit_code=code, notice=None)
        if run.stop_asked:
            run = replace(ended, state=STOPPED, headline=NOTHING_KEPT)
            return run, _event("run.stopped", run, run_row(run))
        last = _tail(folder / LOG_FILE)
        words = "its process ended without a word"
        if not (folder / ORDER_FILE).exists():
            words = "its folder was taken away, and its process ended"
        elif code is not None and code < 0:
            words = f"its process was killed (signal {-code}), perhaps because memory ran out"
        if short := shortage(self._settings.root, self._settings.free_floor_gb):
            words += f" while the disk was full ({short})"
        run = replace(
            ended,
            state=LOST if code is None else FAILED,
            error=f"{words}; the site is as it was before{': ' + last if last else ''}",
        )
        return run, _event("run.failed", run, run_row(run))

    def _keep(self, run: Run, events: list[NewEvent], offset: int | None = None) -> None:
        with self._events.appending(events) as connection:
            connection.execute(
                "UPDATE runs SET state = ?, record = ?, journal_offset = coalesce(?, journal_offset) WHERE id = ?",
                (run.state, compact_json(asdict(run)), offset, run.id),
            )


def run_row(run: Run) -> Json:
    """A run as the API gives it: without what is of no use to a browser."""
    return {name: value for name, value in asdict(run).items() if name not in ("pid", "kill_at")}


def _busy(status: int, run: Run, words: str) -> Problem:
    return Problem(
        status,
        f"a {run.mission} that {run.who} started {words}; wait until it ends, or stop it",
        run=run.id,
    )


def _event(kind: str, run: Run, data: JsonView) -> NewEvent:
    return NewEvent(kind, data, run.site, run.id)


def _taken(run: Run, line: JsonView) -> tuple[Run, NewEvent]:
    """The run after a line of its journal, and the event that the line becomes."""
    kind, data = str(line["type"]), line["data"]
    if kind == "run.progress":
        run = replace(run, progress=data)
    elif kind in _ENDS:
        is_short = kind == "run.finished" and data["exit_code"] == TO_CHECK
        run = replace(
            run,
            state=INCOMPLETE if is_short else _ENDS[kind],
            ended_at=utc_now(),
            headline=data["headline"],
            exit_code=data["exit_code"],
            error=data["error"],
            notice=None,
        )
        return run, _event(kind, run, run_row(run))
    return run, _event(kind, run, data)


def _notice(run: Run, short: str) -> str:
    """What a full disk means for a run."""
    if _is_live(run):
        return (
            f"the station's disk is full ({short}): it takes no pictures of this flight until there is room. Delete "
            "uploads, recordings or flights, or stop the mission to finish what came"
        )
    return (
        f"{short} on the station's disk. If it fills, this mission fails and leaves its site as it was. Delete "
        "uploads, recordings or flights"
    )


def _stream_of_camera(source: str, run_id: str) -> str:
    """The name of a camera's stream: how and where it is reached, by which run; no path, which may be a key."""
    parts = urlsplit(source)
    place = re.sub(r"[^A-Za-z0-9.]+", "-", f"{parts.hostname or ''}-{parts.port or ''}").strip("-.")
    return f"{parts.scheme}-{place[:40]}-{run_id[:6]}"


def _is_live(run: Run) -> bool:
    """Whether a run reads a stream, which ends when somebody ends it."""
    return bool((run.input or {}).keys() & {"stream", "stream_url"})


def _uploads_of(run: Run) -> set[str]:
    """The uploads that a run reads."""
    options = run.options or {}
    wishes = (run.input, options.get("telemetry"), options.get("camera_file"))
    return {str(each["upload"]) for each in wishes if each and each.get("upload")}


def _order_stream(folder: Path) -> str:
    """The stream that a run's order names; "" where it names none."""
    try:
        return str(json.loads((folder / ORDER_FILE).read_bytes()).get("stream") or "")
    except (OSError, ValueError):
        return ""


def _kill(pid: int | None) -> None:
    """End a mission's process and its children at once: they are a session of their own, led by it."""
    if pid is not None:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(pid, signal.SIGKILL)


def _spawned(folder: Path, order: RunOrder) -> "subprocess.Popen[bytes]":
    """A process that does the order in a folder, apart from the server's own fate.

    It holds the folder's lock from before its first moment on to its last: who can lock it knows that it has ended.
    A stream's password goes to it through its environment, which only this user's processes can read.
    """
    lock = os.open(folder / LOCK_FILE, os.O_RDWR | os.O_CREAT, 0o600)
    try:
        take_lock(lock)
        with (folder / LOG_FILE).open("ab") as log:
            return subprocess.Popen(
                python_command("sorvolo.station.run_process", str(folder.resolve())),
                cwd=folder,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
                pass_fds=(lock,),
                env={**os.environ, LOCK_VARIABLE: str(lock), SOURCE_VARIABLE: order.source},
            )
    finally:
        os.close(lock)


def _has_ended(folder: Path) -> bool:
    """Whether a run's process is gone: nobody holds its lock."""
    try:
        lock = os.open(folder / LOCK_FILE, os.O_RDWR)
    except OSError:
        return True
    try:
        return take_lock(lock)
    finally:
        os.close(lock)


def _new_lines(path: Path, offset: int) -> tuple[list[Json], int]:
    """The whole lines of a journal from an offset on, and where they end."""
    try:
        with path.open("rb") as file:
            file.seek(offset)
            data = file.read(_MOST_LINE_BYTES)
    except FileNotFoundError:
        return [], offset
    end = data.rfind(b"\n") + 1
    lines = []
    for text in data[:end].splitlines():
        try:
            line = json.loads(text)
            if isinstance(line, dict) and isinstance(line.get("data"), dict) and "type" in line:
                lines.append(line)
        except ValueError:  # a line that a power cut tore
            continue
    return lines, offset + end


def _size_bytes(path: Path) -> int:
    """How large a file is; 0 where it is not there."""
    try:
        return path.stat().st_size
    except OSError:
        return 0


def _tail(path: Path) -> str:
    """The last line that a process printed."""
    try:
        data = path.read_bytes()[-_MOST_LOG_BYTES:]
    except OSError:
        return ""
    lines = [each for each in data.decode("utf-8", "replace").splitlines() if each.strip()]
    return lines[-1].strip()[:300] if lines else ""


def run_routes(runs: Runs, inputs: Inputs, ingest: Ingest) -> APIRouter:
    """Missions by the API, as from the command line."""
    router = APIRouter(tags=["runs"])

    @router.get("/api/inputs", dependencies=FOR_VIEWERS)
    def list_inputs() -> list[Json]:
        """Videos, folders of photos, telemetry and camera files below the station's folder."""
        return [input_row(each) for each in inputs.all()]

    @router.get("/api/runs", dependencies=FOR_VIEWERS)
    def all_runs(
        site: str = Query("", max_length=200),
        limit: int = Query(200, ge=1, le=1000),
    ) -> list[Json]:
        """The newest missions first, of all sites or of one."""
        return [run_row(each) for each in runs.all(limit, site)]

    @router.post("/api/runs", status_code=201)
    def start(wish: RunWish, holder: Holder = needs(Role.OPERATE)) -> Json:
        """Start a mission: map, compare, watch, search or demo. 409 while another one writes into the site."""
        return run_row(runs.start(wish, holder.name))

    @router.get("/api/runs/{run_id}", dependencies=FOR_VIEWERS)
    def one(run_id: str) -> Json:
        """A mission: its state (running, finished, incomplete, failed, stopped, lost), how far it is, how it ended."""
        return run_row(runs.get(run_id))

    @router.post("/api/runs/{run_id}/stop", dependencies=FOR_OPERATORS)
    def stop(run_id: str) -> Json:
        """Ask it to end: a live flight is finished and kept, a recorded one is left out."""
        return run_row(runs.stop(run_id))

    @router.delete("/api/runs/{run_id}", status_code=204, dependencies=FOR_OPERATORS)
    async def delete(run_id: str) -> None:
        """Take a mission that is over away: its record, what a watch found, the recording of its camera. The map that
        it made stays. 409 while it runs, 423 while another mission reads the recording."""
        stream = runs.stream_of(run_id)
        with runs.unused_stream(stream, but=run_id):
            runs.delete(run_id)
            if stream and ingest.newest(stream) is not None:
                ingest.delete(stream)

    return router
