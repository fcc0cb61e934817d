"""A mission over many flights: each is one retried task; a table keeps its result through any kill."""

import hashlib
import time
from collections import Counter
from collections.abc import Callable, Generator, Mapping, Sequence, Set
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeGuard

import sorvolo
from sorvolo.cluster.cost import CostSettings, cost_of
from sorvolo.cluster.executor import Executor, Key
from sorvolo.cluster.orders import Ending, FlightWish, Mission, Order, Outcome, Scouted, WatchWish
from sorvolo.cluster.scout import FoundFlight, Unreadable, find_flights, scout
from sorvolo.cluster.sites import Placed, SiteBy, existing_site, existing_sites, sites_of
from sorvolo.cluster.table import FINAL, BatchTable, Row, State
from sorvolo.cluster.watches import (
    ENDING,
    existing_watches,
    is_watched,
    watch_outputs,
    watch_settings,
)
from sorvolo.detection.models import demand_searching, find_model
from sorvolo.detection.session import read_info
from sorvolo.errors import SettingsError
from sorvolo.missions.flight.software import software


@dataclass(frozen=True)
class RestartSettings:
    """When the process of a live stream that died is started again, and a flight whose database was out of reach."""

    settled_s: float = (
        60.0  # one that lived so long did not die of its beginning: its tries are counted anew
    )
    longest_wait_s: float = 60.0  # before the next start; the waits are 1 s, 2 s, 4 s and so on
    patience_s: float = (
        900.0  # a database or store that is restored from its backup; then the flight has failed
    )

    def wait_s(self, starts: int) -> float:
        """The wait after this many starts in a row that ended badly."""
        return min(self.longest_wait_s, 2.0 ** (starts - 1))


@dataclass(frozen=True)
class BatchSettings:
    """How a batch treats its flights."""

    wish: FlightWish = FlightWish()  # noqa: RUF009 (frozen)
    site_by: SiteBy = SiteBy.FLIGHT
    most_tries: int = 3  # that end the process of a flight's worker; then it is set aside
    stall_s: float = 300.0  # without an answer or any work: the worker is ended
    retries: bool = False  # flights that were set aside before are tried again
    near_m: float = (
        50.0  # from a site's ground: a drone sees no less than half of that beside its track
    )
    costs: CostSettings = CostSettings()  # noqa: RUF009 (frozen)
    restarts: RestartSettings = RestartSettings()

    def __post_init__(self) -> None:
        if self.most_tries < 1:
            raise SettingsError(f"--tries {self.most_tries}: at least 1 is needed")
        if not self.stall_s > 0:
            raise SettingsError(f"--stall {self.stall_s:g}: more than 0 seconds are needed")
        self._check_watch()
        if self.wish.m_per_px is not None:
            from sorvolo.missions.flight.settings import MapSettings  # which takes long to import

            MapSettings(m_per_px=self.wish.m_per_px)  # states what is out of range
        if self.wish.model not in ("none", "default"):
            demand_searching(read_info(find_model(self.wish.model)))
        if self.wish.copy_to:
            from sorvolo.missions.site.copy import open_end

            open_end(f"{self.wish.copy_to}/site")

    def _check_watch(self) -> None:
        wish = self.wish
        if wish.mission is not Mission.WATCH:
            if wish.watch != WatchWish():
                raise SettingsError(
                    "--classes, --least-score, --fps, --save, --cot and --alert-... are for --mission watch; leave "
                    f"them out, --mission {wish.mission} takes none"
                )
            return
        if self.site_by is not SiteBy.FLIGHT:
            raise SettingsError("--mission watch makes no sites: leave --site-by out")
        if wish.model == "none":
            raise SettingsError("--mission watch needs a detector: leave --model none out")
        if wish.m_per_px is not None or wish.copy_to:
            raise SettingsError("--gsd and --copy-to are for maps; --mission watch makes none")
        watch_settings(wish.model, wish.watch)
        watch_outputs(wish.watch, Path())


@dataclass(frozen=True)
class BatchUpdate:
    """One event of a batch: its flight, how many of how many are finished, and the names of those that run.

    `found` is what the row's watch has just found, in words.
    """

    task: str
    done: int
    total: int
    row: Row | None = None
    is_known: bool = False  # it was finished before this batch
    running: tuple[str, ...] = ()
    found: str = ""


@dataclass(frozen=True)
class BatchReport:
    """All flights of a batch and their results; those in `known` were finished before it began."""

    rows: tuple[Row, ...]
    known: frozenset[Key]
    seconds: float
    tries: int
    crashes: int

    def counts(self) -> dict[str, int]:
        """How many flights ended in each state; "known" are those that were finished before."""
        found = Counter(
            "known" if row.key in self.known and row.state is State.DONE else row.state.value
            for row in self.rows
        )
        return {name: found[name] for name in ("known", *State) if found[name]}


def run_batch(
    places: Sequence[Path],
    root: Path,
    settings: BatchSettings,
    executor_of: Callable[[BatchTable], AbstractContextManager[Executor]],
) -> Generator[BatchUpdate, None, BatchReport]:
    """Do the mission over all flights in these folders, each in a site below `root`; yields what happens.

    `executor_of` makes what runs the tries, once the table is open. A flight that was through before, with the same
    files, wish and version, is left out. Killed, or closed, at any moment, the same call goes on: what was through is
    known, what ran is taken up from its journal. Raises InputError for folders without flights, StoreError for a root
    that cannot be used or that another batch works in, SettingsError for an executor that is not there.
    """
    started_s = time.monotonic()
    found = find_flights(places, root)
    with BatchTable.open(root) as table, executor_of(table) as executor:
        through = frozenset(row.key for row in table if row.state in FINAL)
        rows = yield from _listed(found, table, settings)
        rows = _with_sites(rows, table, settings)
        known = frozenset(row.key for row in rows if row.state in FINAL and row.key in through)
        run = _Run(rows, table, settings, executor)
        for row in rows:
            if row.state is not State.WAITING:
                yield run.update(row, is_known=row.key in known)
        yield from run.through()
        return BatchReport(
            tuple(run.rows[row.key] for row in rows),
            known,
            round(time.monotonic() - started_s, 3),
            run.tries,
            run.crashes,
        )


class _Run:
    """The flights on their way: those of one site one after the other, sites beside each other."""

    def __init__(
        self, rows: Sequence[Row], table: BatchTable, settings: BatchSettings, executor: Executor
    ) -> None:
        self.rows = {row.key: row for row in rows}
        self.tries = self.crashes = 0
        self._table, self._settings, self._executor = table, settings, executor
        self._late = _Latecomers(settings.restarts)
        self._waiting: dict[str, list[Row]] = {}  # by site, in order of time
        for row in sorted(rows, key=_moment):
            if row.state is State.WAITING:
                self._waiting.setdefault(row.site, []).append(row)

    def update(self, row: Row | None = None, *, is_known: bool = False) -> BatchUpdate:
        """How far the batch is."""
        done = sum(each.state not in (State.WAITING, State.RUNNING) for each in self.rows.values())
        running = tuple(_name(each) for each in self.rows.values() if each.state is State.RUNNING)
        return BatchUpdate("flights", done, len(self.rows), row, is_known, running)

    def through(self) -> Generator[BatchUpdate]:
        """Try each flight until it is through. Closed on the way, those that run are marked as waiting again."""
        try:
            while self._waiting or self._executor.running:
                if not self._executor.running and not self._due():  # all that wait are out of reach
                    time.sleep(self._late.wait_s or 0.0)
                else:
                    yield from self._side_by_side()
        finally:
            for row in [each for each in self.rows.values() if each.state is State.RUNNING]:
                self._keep(replace(row, state=State.WAITING, words="the batch was stopped"))

    def _side_by_side(self) -> Generator[BatchUpdate]:
        """Begin what there is room for; one flight, at most, is over when this ends."""
        while (row := self._next()) is not None:
            self._start(row)
            yield self.update()
        if (ended := self._executor.next_ended(self._late.wait_s)) is not None:
            key, ending = ended
            yield self.update(self._end(self.rows[key], ending))

    def _next(self) -> Row | None:
        """The flight to begin, if there is room for it."""
        due = self._due()
        has_room = bool(due) and self._executor.has_room(
            cost_of(due[0], self._table, self._settings.costs)
        )
        return due[0] if has_room else None

    def _due(self) -> list[Row]:
        """The next flight of each site that nobody writes and that is in reach, that with most frames before it first."""
        busy = {self.rows[key].site for key in self._executor.running}
        free = [
            queue
            for site, queue in self._waiting.items()
            if site not in busy and self._late.is_due(queue[0].key)
        ]
        return [queue[0] for queue in sorted(free, key=_all_frames, reverse=True)]

    def _take(self, row: Row) -> Row:
        """The row, no longer waiting."""
        self._waiting[row.site].remove(row)
        if not self._waiting[row.site]:
            del self._waiting[row.site]
        self.tries += 1
        return self._keep(replace(row, state=State.RUNNING, tries=row.tries + 1, words=""))

    def _order(self, row: Row) -> Order:
        return Order(
            row.source,
            str((self._table.root / row.site).resolve()),
            self._settings.wish,
            self._executor.cache_mb,
        )

    def _start(self, row: Row) -> None:
        cost = cost_of(row, self._table, self._settings.costs)
        row = self._take(row)
        self._executor.start(row.key, self._order(row), cost)

    def _end(self, row: Row, ending: Ending) -> Row:
        if ending.outcome is Outcome.WAITS:
            if self._late.put_off(row.key):
                return self._again(row.after(ending, State.WAITING, ending.words))
            return self._keep(row.after(ending, State.FAILED, ending.words))
        self._late.forget(row.key)
        if ending.outcome is not Outcome.CRASHED:
            return self._keep(row.after(ending, State(ending.outcome.value), ending.words))
        self.crashes += 1
        row = replace(row, crashes=row.crashes + 1)
        if row.crashes >= self._settings.most_tries:
            words = f"set aside after {row.crashes} tries: {ending.words}"
            return self._keep(row.after(ending, State.SET_ASIDE, words))
        return self._again(row.after(ending, State.WAITING, ending.words))

    def _again(self, row: Row) -> Row:
        """The row, waiting before the others of its site."""
        row = self._keep(row)
        self._waiting.setdefault(row.site, []).insert(0, row)
        return row

    def _keep(self, row: Row) -> Row:
        row = self._table.put(row)
        self.rows[row.key] = row
        return row


class _Latecomers:
    """Flights whose database, store or site was out of reach: when each is due again. `put_off`, `forget` change it."""

    def __init__(self, settings: RestartSettings) -> None:
        self._settings = settings
        self._since_s: dict[Key, float] = {}
        self._starts: Counter[Key] = Counter()
        self._due_s: dict[Key, float] = {}

    def put_off(self, key: Key) -> bool:
        """Have a flight wait longer than the last time; False where it has waited long enough."""
        now_s = time.monotonic()
        if now_s - self._since_s.setdefault(key, now_s) > self._settings.patience_s:
            self.forget(key)
            return False
        self._starts[key] += 1
        self._due_s[key] = now_s + self._settings.wait_s(self._starts[key])
        return True

    def forget(self, key: Key) -> None:
        """It was in reach."""
        for each in (self._since_s, self._starts, self._due_s):
            each.pop(key, None)

    def is_due(self, key: Key) -> bool:
        """Whether the flight may begin."""
        return self._due_s.get(key, 0.0) <= time.monotonic()

    @property
    def wait_s(self) -> float | None:
        """How long until the next of them is due; None where none waits for that."""
        now_s = time.monotonic()
        return min((due_s - now_s for due_s in self._due_s.values() if due_s > now_s), default=None)


def _listed(
    found: Sequence[FoundFlight], table: BatchTable, settings: BatchSettings
) -> Generator[BatchUpdate, None, list[Row]]:
    """The flights as rows, in the order found: looked into where that is new, each as it is asked for now."""
    seen = {(row.source, row.stamp): row.scouted for row in table if row.scouted is not None}
    new = [
        each.path
        for each in found
        if not each.why_not
        and (str(each.path), each.stamp) not in seen
        and not _is_set_aside(table, each, settings)
    ]
    yield BatchUpdate("looking into flights", 0, len(new))
    answers = dict(zip(new, scout(new, settings.wish.camera, settings.most_tries, [table.lock])))
    rows = [
        _row_of(
            each, answers.get(each.path) or seen.get((str(each.path), each.stamp)), table, settings
        )
        for each in found
    ]
    return _without_duplicates(rows, table)


def _row_of(
    found: FoundFlight,
    answer: Scouted | Unreadable | None,
    table: BatchTable,
    settings: BatchSettings,
) -> Row:
    """A flight's row: the one to go on with, or a new one; None for an answer if nobody looked into it again."""
    scouted = answer if isinstance(answer, Scouted) else None
    wish = settings.wish
    fresh = Row(str(found.path), wish.mission.value, found.stamp, _request(found, wish), scouted)
    if found.why_not:
        return table.put(replace(fresh, scouted=None, state=State.SKIPPED, words=found.why_not))
    if isinstance(answer, Unreadable):
        state = State.SET_ASIDE if answer.crashed else State.FAILED
        return table.put(replace(fresh, state=state, words=answer.words))
    before = table.get(fresh.key)
    return fresh if before is None else _continued(fresh, before, table.root, settings)


def _is_set_aside(table: BatchTable, found: FoundFlight, settings: BatchSettings) -> bool:
    """Whether nobody could look into it before, and it is not to be tried again."""
    row = table.get((settings.wish.mission.value, str(found.path)))
    if row is None or row.state is not State.SET_ASIDE or settings.retries:
        return False
    return row.request == _request(found, settings.wish)


def _request(found: FoundFlight, wish: FlightWish) -> str:
    """What is asked for of a flight, as one number: files, options and program."""
    camera = Path(wish.camera)
    stamp = (
        (camera.stat().st_size, camera.stat().st_mtime_ns)
        if wish.camera and camera.is_file()
        else None
    )
    text = repr((sorvolo.__version__, software(), found.stamp, wish, stamp))
    return hashlib.sha256(text.encode("utf-8", "surrogateescape")).hexdigest()[:32]


def _continued(fresh: Row, before: Row, root: Path, settings: BatchSettings) -> Row:
    """The row to go on with: the earlier one where the same is asked for and stands, else one that waits."""
    moved = replace(before, source=fresh.source, stamp=fresh.stamp, scouted=fresh.scouted)
    if before.request != fresh.request:
        return replace(fresh, site=before.site)
    if before.state is State.SET_ASIDE and settings.retries:
        return replace(moved, state=State.WAITING, crashes=0)
    if before.state in FINAL and (before.state is State.SET_ASIDE or _has_results(before, root)):
        return moved
    crashes = 0 if before.state is State.FAILED else before.crashes
    return replace(moved, state=State.WAITING, crashes=crashes)


def _has_results(row: Row, root: Path) -> bool:
    """Whether the site has the flight, or the folder a complete watch of it."""
    if row.scouted is None:
        return False
    if row.mission == Mission.WATCH:
        return is_watched(root / row.site, row.scouted.fingerprint)
    found = existing_site(root / row.site)
    return found is not None and row.scouted.fingerprint in found.flights


def _without_duplicates(rows: Sequence[Row], table: BatchTable) -> list[Row]:
    """Of rows that are one flight, the one that was through before, else the one with most frames.

    The others are named as duplicates, and so is a flight that was through under another name that is still there.
    """
    chosen: dict[Key, Row] = {}
    for row in rows:
        other = chosen.setdefault(row.key, row)
        if row is not other and _rank(row, table) > _rank(other, table):
            chosen[row.key] = row
    sources = {row.source for row in rows}
    return [_named(row, chosen[row.key], sources, table) for row in rows]


def _named(row: Row, own: Row, sources: Set[str], table: BatchTable) -> Row:
    """The row itself where it is `own`, the one that is used; else as a duplicate of it."""
    before = table.get(row.key)
    if _is_used(before) and before.source not in sources and Path(before.source).exists():
        own = before
    if row.source == own.source:
        return row
    frames = f", which has {_frames(own)} frames" if _frames(row) < _frames(own) else ""
    words = f"the same flight as {own.source}{frames}"
    return table.put(
        Row(
            row.source,
            row.mission,
            row.stamp,
            row.request,
            None,
            state=State.DUPLICATE,
            words=words,
        )
    )


def _rank(row: Row, table: BatchTable) -> tuple[bool, int]:
    before = table.get(row.key)
    return _is_used(before) and before.source == row.source, _frames(row)


def _is_used(row: Row | None) -> TypeGuard[Row]:
    return row is not None and row.state in (State.DONE, State.DOUBTFUL)


def _with_sites(rows: Sequence[Row], table: BatchTable, settings: BatchSettings) -> list[Row]:
    """The rows with the site of each flight, or the folder of its watch; one that has a place already stays there."""
    placed, names = _placed(rows), [each.name for each in table.root.iterdir()]
    if settings.wish.mission is Mission.WATCH:
        known = existing_watches(table.root) | _placed_before(table, are_watches=True)
        sites = sites_of(placed, SiteBy.FLIGHT, known, {}, names, ending=ENDING)
    else:
        there = existing_sites(table.root, with_ground=settings.site_by is SiteBy.PLACE)
        known = {fingerprint: name for name, site in there.items() for fingerprint in site.flights}
        grounds = {name: site.ground for name, site in there.items() if site.ground is not None}
        known |= _placed_before(table, are_watches=False)
        sites = sites_of(placed, settings.site_by, known, grounds, names, settings.near_m)
    return [_at_site(row, sites, table) for row in rows]


def _placed_before(table: BatchTable, *, are_watches: bool) -> dict[str, str]:
    """The sites, or the folders of watches, of flights that the table knows, by the flight's fingerprint."""
    return {
        row.scouted.fingerprint: row.site
        for row in table
        if row.scouted is not None and row.site and (row.mission == Mission.WATCH) == are_watches
    }


def _placed(rows: Sequence[Row]) -> list[Placed]:
    return [Placed(Path(row.source), row.scouted) for row in rows if row.scouted is not None]


def _at_site(row: Row, sites: Mapping[str, str], table: BatchTable) -> Row:
    if row.scouted is None or row.site == sites[row.scouted.fingerprint]:
        return row
    return table.put(replace(row, site=sites[row.scouted.fingerprint]))


def _moment(row: Row) -> tuple[int, str]:
    return (row.scouted.start_ns if row.scouted is not None else 0), row.source


def _frames(row: Row) -> int:
    return row.scouted.frames if row.scouted is not None else 0


def _all_frames(rows: Sequence[Row]) -> int:
    return sum(_frames(each) for each in rows)


def _name(row: Row) -> str:
    path = Path(row.source)
    return path.stem if path.suffix else path.name
