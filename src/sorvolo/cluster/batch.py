"""A mission over many flights, a process each. A table keeps what became of each flight through any kill.

`batch.jsonl` holds a row for each change, the newest of a flight last; `docs/formats.md` has its fields.
"""

import hashlib
import json
import os
import socket
import time
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal, Self

from sorvolo.build import build
from sorvolo.cluster.executors import LOCK, Executor, TryEnding
from sorvolo.cluster.flights import (
    FlightFiles,
    Scouted,
    existing_site,
    find_flights,
    sites_of,
)
from sorvolo.errors import SettingsError, StoreError, check_choices
from sorvolo.missions.flight.request import software
from sorvolo.missions.worker import Order
from sorvolo.store.atomic import atomic_write_bytes, make_folder, take_lock, writing
from sorvolo.store.exports.detection_files import REPORT, find_watched
from sorvolo.store.site.catalogue import utc_now
from sorvolo.store.site.catalogue_place import is_site

TABLE = "batch.jsonl"
WATCH_ENDING = "-watch"
"""Of the folder of a watch's results, after the flight's name."""

_HEAD = {"made_by": "sorvolo batch", "format": 1}
_MOST_TRIES = 2  # that end a flight's process; then it is set aside
_ENDING_S = 10.0  # how long missions of a batch that was killed may take to end

FINAL = frozenset({"done", "doubtful", "set aside"})
"""States that stand as long as the flight's files and what is asked for of it are the same."""


@dataclass(frozen=True)
class BatchSettings:
    """What a batch does with each flight; everything else is as the mission's own defaults.

    `camera` is what --camera takes, `m_per_px` the ground resolution of new maps (None: the frames' own). `by_place`:
    flights near each other share a site. `retries`: flights that were set aside are tried again.
    """

    mission: Literal["map", "compare", "search", "watch"] = "map"
    camera: str = ""
    model: str = "default"
    m_per_px: float | None = None
    by_place: bool = False
    retries: bool = False

    def __post_init__(self) -> None:
        from sorvolo.detection.models import demand_searching, find_model
        from sorvolo.detection.session import read_info
        from sorvolo.missions.flight.settings import MapSettings

        check_choices(self)
        MapSettings(m_per_px=self.m_per_px)  # states what is out of range
        if self.model not in ("none", "default"):
            demand_searching(read_info(find_model(self.model)))
        if self.mission != "watch":
            return
        if self.by_place:
            raise SettingsError("--mission watch makes no sites: leave --site-by out")
        if self.model == "none":
            raise SettingsError("--mission watch needs a detector: leave --model none out")
        if self.m_per_px is not None:
            raise SettingsError("--gsd is for maps; --mission watch makes none")


@dataclass(frozen=True)
class BatchRow:
    """One flight: its files, its site, and what became of it.

    `request` is what is asked for, `stamp` its files', `tries` how often it was begun for this request, of which
    `crashes` ended its process. Seconds and processor time are of all tries together, the memory is the largest, MB.
    `state` is "waiting", "running", "done", "doubtful" (to be checked before use), "duplicate" (of another flight),
    "skipped" (no flight, though it may be taken for one), "failed", or "set aside" (it ended its process each time).
    """

    source: str
    mission: str
    stamp: str
    request: str
    scouted: Scouted | None
    site: str = ""
    flight: str = ""
    state: str = "waiting"
    words: str = ""
    tries: int = 0
    crashes: int = 0
    seconds: float = 0.0
    cpu_s: float = 0.0
    peak_memory_mb: float = 0.0
    host: str = ""
    changed_utc: str = ""

    @property
    def key(self) -> tuple[str, str]:
        """The mission and the flight, by its fingerprint, or by its path while that is unknown."""
        return self.mission, self.scouted.fingerprint if self.scouted else self.source

    def after(self, ending: TryEnding) -> Self:
        """The row after a try; it waits for another one after its first crash."""
        crashes = self.crashes + (ending.outcome == "crashed")
        state, words = ending.outcome, ending.words
        if state == "crashed":
            state = "set aside" if crashes >= _MOST_TRIES else "waiting"
        if state == "set aside":
            words = f"set aside after {crashes} tries: {words}"
        return replace(
            self,
            state=state,
            words=words,
            crashes=crashes,
            flight=ending.flight or self.flight,
            seconds=round(self.seconds + ending.seconds, 3),
            cpu_s=round(self.cpu_s + ending.cpu_s, 3),
            peak_memory_mb=max(self.peak_memory_mb, ending.peak_memory_mb),
            host=ending.host,
        )


class BatchTable:
    """The rows of a folder of sites, by `BatchRow.key`. Only `put` changes them. A context manager; made by `open`."""

    def __init__(self, root: Path, lock: int, rows: dict[tuple[str, str], BatchRow]) -> None:
        self.root, self.lock, self._rows = root, lock, rows
        self._file = (root / TABLE).open("ab")

    @classmethod
    def open(cls, root: Path) -> Self:
        """Open the table of a folder, which is made if it is not there, as its only batch.

        Raises StoreError for a folder that another batch works in, that is a site itself or cannot be written, and for
        a table of another format.
        """
        if is_site(root):
            raise StoreError(
                f"{root} is a site itself; a batch makes several: name the folder above it, or a new one"
            )
        try:
            make_folder(root)
        except (FileExistsError, NotADirectoryError) as error:
            raise StoreError(
                f"{root} is a file, a folder was needed; choose another name"
            ) from error
        lock = _lock(root)
        try:
            rows = _read(root / TABLE)
            lines = [_HEAD, *map(asdict, rows.values())]
            atomic_write_bytes(root / TABLE, b"".join(map(_line, lines)))
            return cls(root, lock, rows)
        except BaseException:
            os.close(lock)
            raise

    def close(self) -> None:
        """Let go of the folder."""
        self._file.close()
        os.close(self.lock)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __iter__(self) -> Iterator[BatchRow]:
        return iter(list(self._rows.values()))

    def get(self, key: tuple[str, str]) -> BatchRow | None:
        """The newest row of a flight."""
        return self._rows.get(key)

    def put(self, row: BatchRow) -> BatchRow:
        """Keep the newest row of a flight: on the disk when this returns; the row as it is kept."""
        row = replace(row, changed_utc=utc_now())
        with writing(self.root / TABLE):
            self._file.write(_line(asdict(row)))
            self._file.flush()
            os.fsync(self._file.fileno())
        self._rows[row.key] = row
        return row


def _lock(root: Path) -> int:
    """The right to work in the folder, as a descriptor; a batch that was killed has it until its missions are gone."""
    path = root / LOCK
    with writing(path):
        lock = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o644)
    until_s = time.monotonic() + _ENDING_S
    while not take_lock(lock):
        holder = os.pread(lock, 1000, 0).decode("utf-8", "replace").strip()
        pid, _, host = holder.removeprefix("process ").partition(",")[0].partition(" on ")
        is_gone = host == socket.gethostname() and not Path("/proc", pid).exists()
        if not is_gone or time.monotonic() > until_s:
            os.close(lock)
            raise StoreError(
                f"another batch is running in {root}: {holder or 'its name is not known'}; wait until it ends, or stop it"
            )
        time.sleep(0.1)
    os.ftruncate(lock, 0)
    words = f"process {os.getpid()} on {socket.gethostname()}, since {utc_now()}"
    os.pwrite(lock, words.encode(), 0)
    return lock


def _read(path: Path) -> dict[tuple[str, str], BatchRow]:
    """The newest row of each flight; a last line that a kill tore is passed over."""
    rows: dict[tuple[str, str], BatchRow] = {}
    try:
        lines = path.read_bytes().split(b"\n")
    except FileNotFoundError:
        return rows
    except OSError as error:
        raise StoreError(f"{path} cannot be read ({error.strerror})") from error
    for number, line in enumerate(lines):
        try:
            plain = json.loads(line) if line else None
            if number == 0:
                if not isinstance(plain, dict) or plain.get("made_by") != _HEAD["made_by"]:
                    raise StoreError(
                        f"{path} is not a table of sorvolo batch; move it away, or choose another --root"
                    )
                if plain != _HEAD:
                    raise StoreError(
                        f"{path} has format {plain.get('format')}, this version reads {_HEAD['format']}; use the version that wrote it"
                    )
            elif plain is not None:
                if (seen := plain["scouted"]) is not None:
                    seen = Scouted(**seen)
                row = BatchRow(**{**plain, "scouted": seen})
                rows.pop((row.mission, row.source), None)  # from when its files could not be read
                rows[row.key] = row
        except (ValueError, TypeError, KeyError) as error:
            if number >= len(lines) - 1:
                break
            raise StoreError(
                f"{path}: line {number + 1} is no row of a batch ({error}); move the file away"
            ) from error
    return rows


def _line(content: Mapping[str, Any]) -> bytes:
    return json.dumps(content, ensure_ascii=False).encode("utf-8", "surrogateescape") + b"\n"


@dataclass(frozen=True)
class BatchUpdate:
    """One event of a batch: the row that changed, how many flights of how many are through, and what runs."""

    task: str
    done: int
    total: int
    row: BatchRow | None = None
    is_known: bool = False  # it was through before this batch
    running: tuple[str, ...] = ()


@dataclass(frozen=True)
class BatchReport:
    """All flights of a batch and their results; those in `known` were through before it began."""

    rows: tuple[BatchRow, ...]
    known: frozenset[tuple[str, str]]
    seconds: float
    tries: int
    crashes: int

    def counts(self) -> dict[str, int]:
        """How many flights ended in each state; "known" are those that were through before."""
        names = [
            "known" if row.key in self.known and row.state == "done" else row.state
            for row in self.rows
        ]
        return dict(sorted(Counter(names).items()))


def run_batch(
    places: Sequence[Path],
    root: Path,
    settings: BatchSettings,
    open_executor: Callable[[BatchTable], AbstractContextManager[Executor]],
) -> Generator[BatchUpdate, None, BatchReport]:
    """Do the mission over all flights in these folders, each in a site below `root`; yields what happens.

    A flight that was through before, with the same files, request and version, is left out. Killed, or closed, at any
    moment, the same call goes on: what ran is taken up from its journal. Raises InputError for folders without
    flights, StoreError for a root that cannot be used, SettingsError for an executor that is not there.
    """
    started_s, tries, crashes = time.monotonic(), 0, 0
    found = find_flights(places, root)
    with BatchTable.open(root) as table, open_executor(table) as executor:
        # look into the flights that are new, or whose files changed
        seen = {(row.source, row.stamp): row.scouted for row in table if row.scouted is not None}
        rows = [_new_row(flight, settings, seen) for flight in found]
        given_up = [
            before
            for row in rows
            if (before := table.get(row.key))
            and before.state == "set aside"
            and before.request == row.request
            and not settings.retries
        ]
        left_out = {row.source for row in given_up}
        queues = {
            row.source: [row]
            for row in rows
            if row.state == "waiting" and row.scouted is None and row.source not in left_out
        }
        yield BatchUpdate("looking into flights", 0, len(queues))
        looked = {row.source: row for row in given_up}

        def inspecting(row: BatchRow) -> Order:
            return Order("inspect", "", row.source, camera=settings.camera)

        for row, ending in _run(queues, inspecting, executor):
            if ending is None or row.state == "waiting":
                continue
            if row.state == "done":
                row = replace(_new_row_of(row), scouted=Scouted(**ending.inspected))
            looked[row.source] = row
        rows = [looked.get(row.source, row) for row in rows]

        # what was through before stands; copies of a flight are named; each flight has its site
        through = {row.key for row in table if row.state in FINAL}
        rows = [_continued(row, table, settings) for row in rows]
        rows = _place(_without_duplicates(rows, through), table, settings)
        current = {row.key: table.put(row) for row in rows if row.state != "duplicate"}
        rows = [current.get(row.key, row) if row.state != "duplicate" else row for row in rows]
        known = frozenset(row.key for row in rows if row.state in FINAL and row.key in through)

        def update(row: BatchRow, *, is_known: bool = False) -> BatchUpdate:
            done = sum(each.state not in ("waiting", "running") for each in current.values())
            copies = sum(each.state == "duplicate" for each in rows)
            running = [
                Path(each.source).stem for each in current.values() if each.state == "running"
            ]
            return BatchUpdate("flights", done + copies, len(rows), row, is_known, tuple(running))

        queues = {}
        for row in sorted(rows, key=_moment):
            if row.state == "waiting":
                queues.setdefault(row.site, []).append(row)
            else:
                yield update(row, is_known=row.key in known)
        # the flights of a site one after another; sites with most frames first, beside each other
        queues = dict(sorted(queues.items(), key=lambda each: -sum(map(_frames, each[1]))))
        try:
            for row, ending in _run(queues, lambda row: _order(row, root, settings), executor):
                tries += ending is None
                crashes += ending is not None and ending.outcome == "crashed"
                current[row.key] = table.put(row)
                yield update(row)
        finally:
            for row in current.values():
                if row.state == "running":
                    table.put(replace(row, state="waiting", words="the batch was stopped"))
        rows = [current[row.key] if row.state != "duplicate" else row for row in rows]
        seconds = round(time.monotonic() - started_s, 3)
        return BatchReport(tuple(rows), known, seconds, tries, crashes)


def _run(
    queues: Mapping[str, Sequence[BatchRow]],
    order_of: Callable[[BatchRow], Order],
    executor: Executor,
) -> Iterator[tuple[BatchRow, TryEnding | None]]:
    """Run the rows of each queue one after another, queues beside each other: each row as it begins, and as it ends.

    A row whose process crashed is tried once more.
    """
    waiting = {name: list(rows) for name, rows in queues.items()}
    running: dict[str, BatchRow] = {}
    while waiting or running:
        for name in [name for name in waiting if name not in running]:
            if len(running) >= executor.slots:
                break
            row = waiting[name].pop(0)
            row = replace(row, state="running", tries=row.tries + 1, words="")
            executor.start(name, order_of(row))
            running[name] = row
            yield row, None
        name, ending = executor.next_ended()
        row = running.pop(name).after(ending)
        if row.state == "waiting":
            waiting[name].insert(0, row)
        elif not waiting[name]:
            del waiting[name]
        yield row, ending


def _order(row: BatchRow, root: Path, settings: BatchSettings) -> Order:
    """One try at a flight; the first flight over a site is mapped where flights are compared."""
    site, mission = root.resolve() / row.site, settings.mission
    if mission == "compare":
        there = existing_site(site)
        if there is None or row.scouted is None or there.founder in ("", row.scouted.fingerprint):
            mission = "map"
    folder = site.with_name(f"{site.name}-search") if mission == "search" else site
    options = {"model": settings.model, "m_per_px": settings.m_per_px}
    return Order(
        mission, str(site), row.source, camera=settings.camera, folder=str(folder), options=options
    )


def _new_row(
    found: FlightFiles,
    settings: BatchSettings,
    seen: Mapping[tuple[str, str], Scouted],
) -> BatchRow:
    """A flight as it is asked for now; `scouted` where somebody looked into the same files before."""
    camera = Path(settings.camera)
    facts = None
    if settings.camera and camera.is_file():
        facts = camera.stat().st_size, camera.stat().st_mtime_ns
    wish = replace(settings, by_place=False, retries=False)
    text = repr((build(), software(), found.stamp, wish, facts))
    request = hashlib.sha256(text.encode("utf-8", "surrogateescape")).hexdigest()[:32]
    row = BatchRow(str(found.path), settings.mission, found.stamp, request, None)
    if found.why_not:
        return replace(row, state="skipped", words=found.why_not)
    return replace(row, scouted=seen.get((row.source, row.stamp)))


def _new_row_of(row: BatchRow) -> BatchRow:
    """The row before it was begun."""
    return BatchRow(row.source, row.mission, row.stamp, row.request, row.scouted)


def _continued(fresh: BatchRow, table: BatchTable, settings: BatchSettings) -> BatchRow:
    """The row to go on with: the earlier one where the same is asked for and stands, else one that waits."""
    before = table.get(fresh.key)
    if before is None or fresh.state != "waiting":
        return fresh
    if before.request != fresh.request:
        return replace(fresh, site=before.site)
    moved = replace(before, source=fresh.source, stamp=fresh.stamp, scouted=fresh.scouted)
    if before.state == "set aside" and settings.retries:
        return replace(moved, state="waiting", crashes=0)
    if before.state == "set aside" or (before.state in FINAL and _has_results(before, table.root)):
        return moved
    return replace(
        moved, state="waiting", crashes=0 if before.state == "failed" else before.crashes
    )


def _has_results(row: BatchRow, root: Path) -> bool:
    """Whether the site has the flight, or the folder a complete watch of it."""
    if row.scouted is None:
        return False
    folder = root / row.site
    if row.mission == "watch":
        return find_watched(folder) == row.scouted.fingerprint and (folder / REPORT).is_file()
    site = existing_site(folder)
    return site is not None and row.scouted.fingerprint in site.flights


def _without_duplicates(rows: Sequence[BatchRow], through: set[tuple[str, str]]) -> list[BatchRow]:
    """Of rows that are one flight, the one with most frames, and of these the first; the others name it."""
    own: dict[tuple[str, str], BatchRow] = {}
    for row in rows:
        if row.key not in own or _frames(row) > _frames(own[row.key]):
            own[row.key] = row
    named = []
    for row in rows:
        if (other := own[row.key]) is not row:
            fewer = f", which has {_frames(other)} frames" if _frames(row) < _frames(other) else ""
            words = f"the same flight as {other.source}{fewer}"
            row = replace(_new_row_of(row), scouted=None, state="duplicate", words=words)
        named.append(row)
    return named


def _place(rows: Sequence[BatchRow], table: BatchTable, settings: BatchSettings) -> list[BatchRow]:
    """The rows with the site of each flight, or the folder of its watch; one that has a place already stays there."""
    is_watch, root = settings.mission == "watch", table.root
    flights = [(Path(row.source), row.scouted) for row in rows if row.scouted is not None]
    names = [path.name for path in sorted(root.iterdir()) if path.is_dir()]
    known, grounds = {}, {}
    for name in names:
        if is_watch and (watched := find_watched(root / name)) is not None:
            known[watched] = name
        site = None if is_watch else existing_site(root / name, with_ground=settings.by_place)
        if site is not None:
            known |= dict.fromkeys(site.flights, name)
            if site.ground is not None:
                grounds[name] = site.ground
    known |= {
        row.scouted.fingerprint: row.site
        for row in table
        if row.scouted is not None and row.site and (row.mission == "watch") == is_watch
    }
    ending = WATCH_ENDING if is_watch else ""
    sites = sites_of(flights, known, grounds, names, by_place=settings.by_place, ending=ending)
    return [
        row if row.scouted is None else replace(row, site=sites[row.scouted.fingerprint])
        for row in rows
    ]


def _moment(row: BatchRow) -> tuple[int, str]:
    return (row.scouted.start_ns if row.scouted is not None else 0), row.source


def _frames(row: BatchRow) -> int:
    return row.scouted.frames if row.scouted is not None else 0
