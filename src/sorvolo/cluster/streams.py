"""Live streams side by side, mapped, compared or watched, each by a process that is started again when it dies."""

import hashlib
import re
import threading
import time
from collections import Counter
from collections.abc import Callable, Generator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path

from sorvolo.capture.live.addresses import is_live_address, live_address, shown_address
from sorvolo.capture.live.links import LINK_FORMS, is_link
from sorvolo.capture.source import safe_name
from sorvolo.cluster.batch import BatchReport, BatchSettings, BatchUpdate
from sorvolo.cluster.cost import cost_of
from sorvolo.cluster.executor import Executor, Key
from sorvolo.cluster.orders import Ending, Mission, Order, Outcome, Scouted
from sorvolo.cluster.table import BatchTable, Row, State
from sorvolo.cluster.watches import ENDING
from sorvolo.errors import SettingsError

_LOOK_S = 0.5  # how soon an end or a free place is noticed; by choice
_NO_ROOM = "waits for memory or cores that others have; it starts when they are known to be free"


@dataclass(frozen=True)
class Stream:
    """A live source, the site that it is mapped into, or whose name its watches have, and the address of a receiver
    beside it ("": none). `shown` has no password."""

    address: str
    site: str
    telemetry: str = ""

    @property
    def shown(self) -> str:
        """The address as it may be printed and kept."""
        return (
            shown_address(self.address).partition("?")[0] if "://" in self.address else self.address
        )


def streams_of(texts: Sequence[str], receivers: Sequence[str] = ()) -> list[Stream]:
    """Streams given as ADDRESS or SITE=ADDRESS, and their receivers as SITE=ADDRESS.

    Raises SettingsError for two streams, or receivers, of one site and for a receiver of no stream, InputError for
    what is no address.
    """
    telemetry = _receivers(receivers)
    found = []
    for text in texts:
        named = re.match(r"([A-Za-z0-9][\w.-]*)=(.+)", text)
        address = named[2] if named else text
        live_address(address)
        site = named[1] if named else _name(address)
        found.append(Stream(address, site, telemetry.pop(site, "")))
    sites = [each.site for each in found]
    if twice := next((each for each in sites if sites.count(each) > 1), ""):
        raise SettingsError(
            f"two streams would be mapped into the site {twice}; name the site of each: SITE=ADDRESS"
        )
    if telemetry:
        raise SettingsError(
            f"--telemetry {next(iter(telemetry))}=...: there are streams of {', '.join(sites)}"
        )
    return found


def _receivers(texts: Sequence[str]) -> dict[str, str]:
    """The addresses of receivers by the site of their stream."""
    found: dict[str, str] = {}
    for text in texts:
        site, equals, address = text.partition("=")
        if not (equals and site and address) or site in found:
            raise SettingsError(
                f"--telemetry {text}: give each stream's receiver once, as SITE=ADDRESS"
            )
        if not is_link(address):
            raise SettingsError(f"--telemetry {text}: {address} is no receiver; give {LINK_FORMS}")
        found[site] = address
    return found


def _name(address: str) -> str:
    """The site of a stream that nobody named: its host and path, or the file's or folder's name."""
    place = shown_address(address).partition("?")[0].partition(":")[2].strip("/")
    return safe_name(place if "://" in address else Path(place).stem)


def is_stream(text: str) -> bool:
    """Whether an input of a batch is a live source, alone or as SITE=ADDRESS."""
    return is_live_address(text) or is_live_address(text.partition("=")[2])


def run_streams(
    streams: Sequence[Stream],
    root: Path,
    settings: BatchSettings,
    executor_of: Callable[[BatchTable], AbstractContextManager[Executor]],
    until: threading.Event,
) -> Generator[BatchUpdate, None, BatchReport]:
    """Map, compare or watch each stream until it ends or `until` is set; then its flight is finished like any other's.

    A process that dies is started again, after a second and ever longer: it goes on with the flight as another segment
    where the stream is back in time (`LiveSettings.same_flight_s`), else with a flight of its own. One that dies
    `most_tries` times in a row within a minute of its start is set aside; the others go on. One whose database or site
    is out of reach is started again as often as need be. Raises as `run_batch`.
    """
    if settings.wish.mission is Mission.SEARCH:
        raise SettingsError(
            "--mission search measures flights that are over: give map, compare or watch for live streams"
        )
    started_s = time.monotonic()
    with BatchTable.open(root) as table, executor_of(table) as executor:
        run = _Streams(streams, table, settings, executor, until)
        yield from run.through()
        return BatchReport(
            tuple(run.rows.values()),
            frozenset(),
            round(time.monotonic() - started_s, 3),
            run.tries,
            run.crashes,
        )


class _Streams:
    """The streams while they run."""

    def __init__(
        self,
        streams: Sequence[Stream],
        table: BatchTable,
        settings: BatchSettings,
        executor: Executor,
        until: threading.Event,
    ) -> None:
        self._table, self._settings, self._executor, self._until = table, settings, executor, until
        rows = [_row(each, settings) for each in streams]
        self.rows = {row.key: row for row in rows}
        self._streams = {row.key: each for row, each in zip(rows, streams)}
        self._due_s: dict[Key, float] = dict.fromkeys(
            self.rows, 0.0
        )  # those that wait for their start
        self._put_off: Counter[Key] = Counter()  # how often in a row it was out of reach
        self._is_finishing = False
        self.tries = self.crashes = 0

    def through(self) -> Generator[BatchUpdate]:
        """Run them all until each has ended."""
        while self._due_s or self._executor.running:
            yield from self._begin()
            if self._until.is_set() and not self._is_finishing:
                self._is_finishing = True
                for key in self._executor.running:
                    self._executor.finish(key)
            if self._executor.running:
                ended = self._executor.next_ended(_LOOK_S)
                for key, words in self._executor.take_found():
                    yield replace(self._update(self.rows[key]), found=words)
                if ended is not None:
                    yield self._update(self._end(*ended))
            else:
                self._until.wait(_LOOK_S)

    def _begin(self) -> Generator[BatchUpdate]:
        """Start those that are due; none any more once they are to end."""
        if self._until.is_set():
            for key in self._due_s:
                row = replace(self.rows[key], state=State.DONE, words="stopped while it waited")
                yield self._update(self._keep(row))
            self._due_s.clear()
        for key in [key for key, due_s in self._due_s.items() if due_s <= time.monotonic()]:
            row = self.rows[key]
            cost = cost_of(replace(row, crashes=0), self._table, self._settings.costs)
            if not self._executor.has_room(cost):
                if not row.tries and row.words != _NO_ROOM:
                    yield self._update(self._keep(replace(row, words=_NO_ROOM)))
                return
            del self._due_s[key]
            site = str((self._table.root / row.site).resolve())
            row = self._keep(replace(row, state=State.RUNNING, tries=row.tries + 1, words=""))
            self.tries += 1
            stream = self._streams[key]
            order = Order(
                stream.address,
                site,
                self._settings.wish,
                self._executor.cache_mb,
                telemetry=stream.telemetry,
            )
            self._executor.start(key, order, cost)
            yield self._update(row)

    def _end(self, key: Key, ending: Ending) -> Row:
        row = self.rows[key]
        if ending.outcome is Outcome.WAITS:
            self._put_off[key] += 1
            return self._start_later(
                row.after(ending, State.WAITING, ending.words), self._put_off[key]
            )
        del self._put_off[key]
        if ending.outcome is not Outcome.CRASHED:
            return self._keep(row.after(ending, State(ending.outcome.value), ending.words))
        self.crashes += 1
        row = replace(
            row,
            crashes=1 if ending.seconds > self._settings.restarts.settled_s else row.crashes + 1,
        )
        if row.crashes >= self._settings.most_tries:
            words = f"set aside after {row.crashes} tries: {ending.words}"
            return self._keep(row.after(ending, State.SET_ASIDE, words))
        return self._start_later(row.after(ending, State.WAITING, ending.words), row.crashes)

    def _start_later(self, row: Row, starts: int) -> Row:
        """The row, which waits longer the more starts in a row ended badly."""
        self._due_s[row.key] = time.monotonic() + self._settings.restarts.wait_s(starts)
        return self._keep(row)

    def _keep(self, row: Row) -> Row:
        row = self._table.put(row)
        self.rows[row.key] = row
        return row

    def _update(self, row: Row) -> BatchUpdate:
        running = tuple(self.rows[key].site for key in self._executor.running)
        through = sum(
            each.state not in (State.WAITING, State.RUNNING) for each in self.rows.values()
        )
        return BatchUpdate("streams", through, len(self.rows), row, running=running)


def _row(stream: Stream, settings: BatchSettings) -> Row:
    """A stream's row: every time a new one, since a stream is another flight each time."""
    name = hashlib.sha256(f"stream {stream.site}".encode()).hexdigest()
    scouted, mission = Scouted(name, 0, 0, None), settings.wish.mission
    site = f"{stream.site}{ENDING}" if mission is Mission.WATCH else stream.site
    return Row(stream.shown, mission.value, "", "", scouted, site)
