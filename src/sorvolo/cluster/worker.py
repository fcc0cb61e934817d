"""A worker's own process: one order from its standard input, answers line by line on its standard output.

It ends with whoever holds the other end of its input, so that no flight is mapped for a batch that is gone. It imports
what its order needs alone: there is a process for each flight.
"""

import json
import os
import resource
import signal
import sys
import threading
import time
from collections.abc import Callable, Generator, Mapping
from contextlib import closing, suppress
from pathlib import Path
from typing import Any, BinaryIO

from sorvolo.capture.live.addresses import is_live_address, without_secret
from sorvolo.capture.live.reconnect import LiveSettings
from sorvolo.cluster.orders import (
    FINISH,
    Mission,
    Order,
    Outcome,
    Scouted,
    answer_line,
)
from sorvolo.errors import SorvoloError

_ALIVE_EVERY_S = 0.5  # far within what counts as standing still; by choice
_SITE_BUSY_S = 90.0  # a worker of a cluster that is gone holds its site's lock until Ray ends it, after a minute
_FIRST_TO_GO = 500  # for the kernel that looks for memory: the worker, not the batch


class Answers:
    """The lines that go back. Only `add` writes them; whatever libraries print goes to the log instead."""

    def __init__(self) -> None:
        self._file: BinaryIO = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
        os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
        self._alive_s = 0.0

    def add(self, kind: str, data: Mapping[str, Any]) -> None:
        """One answer."""
        self._file.write(answer_line(kind, data))
        self._file.flush()

    def alive(self, *_: object) -> None:
        """That the work goes on, twice a second at most."""
        if time.monotonic() - self._alive_s >= _ALIVE_EVERY_S:
            self._alive_s = time.monotonic()
            self.add("alive", {})

    def found(self, words: str) -> None:
        """Something that a watch found, in words."""
        self.add("found", {"words": words})


def main() -> int:
    """Do the one order of standard input. 0 also for a flight that cannot be used: that is an answer."""
    answers = Answers()
    with os.fdopen(
        os.dup(sys.stdin.fileno()), "rb", buffering=0
    ) as line:  # what follows it is another's to read
        content = json.loads(line.readline())
    until = threading.Event()
    threading.Thread(target=_follow_input, args=(until,), daemon=True).start()
    if "scout" in content:
        for source in content["scout"]["sources"]:
            _scout(source, content["scout"]["camera"], answers)
        return 0
    order = Order.of(content["order"])
    try:
        flight, words, is_good = _done(order, answers, until)
    except SorvoloError as error:
        answers.add(
            "ended",
            {"outcome": Outcome.of(error), "words": without_secret(str(error), order.source)},
        )
        return 0
    outcome = Outcome.DONE if is_good else Outcome.DOUBTFUL
    answers.add("ended", {"outcome": outcome, "words": words, "flight": flight})
    return 0


def _done(order: Order, answers: Answers, until: threading.Event) -> tuple[str, str, bool]:
    """Do the order: the flight's name in the site, words about it, and whether its result is one to use."""
    if order.wish.mission is Mission.WATCH:
        from sorvolo.cluster.watches import watch_flight

        return *watch_flight(order, answers.alive, answers.found, until), True
    _wait_for_site(Path(order.site))
    result = _MISSIONS[order.wish.mission](order, answers.alive, until)
    if order.wish.copy_to:
        from sorvolo.cluster.copying import copy_result

        copy_result(Path(order.site), order.wish.copy_to, answers.alive)
    return result


def _follow_input(until: threading.Event) -> None:
    """Set the event when a live flight is to end; end the process at once when nobody holds its input any more.

    What it was at then is taken up from its journal.
    """
    with suppress(OSError):
        while data := os.read(sys.stdin.fileno(), 4096):
            if FINISH in data:
                until.set()
    os._exit(1)


def _scout(source: str, camera: str, answers: Answers) -> None:
    from sorvolo.capture.source import open_sources

    try:
        found = open_sources([source], camera=camera or None)
        if len(found) != 1:
            raise SorvoloError(
                f"{source} holds {len(found)} flights, one was expected; files came or went meanwhile"
            )
        flight = found[0]
    except SorvoloError as error:
        answers.add("unreadable", {"words": str(error)})
        return
    samples = flight.telemetry
    box = None
    if samples.has_fixes:
        latitudes, longitudes = (
            [each for each in samples[name].tolist() if each == each]
            for name in ("latitude_deg", "longitude_deg")
        )
        box = (min(latitudes), min(longitudes), max(latitudes), max(longitudes))
    start_ns = flight.start_ns or (int(samples.time_ns[0]) if len(samples) else 0)
    answers.add("scouted", vars(Scouted(flight.fingerprint, flight.frame_count, start_ns, box)))


def _live(order: Order) -> LiveSettings:
    return LiveSettings(keeps_all=True, give_up_s=order.wish.give_up_s)


def _map(order: Order, alive: Callable[..., None], until: threading.Event) -> tuple[str, str, bool]:
    """Map the flight: its name in the site, the headline, and whether it is a map to use."""
    from sorvolo.missions.flight.settings import MapSettings
    from sorvolo.missions.map.flights import map_flights
    from sorvolo.missions.site.reported_headline import reported_headline

    site, wish = Path(order.site), order.wish
    settings = MapSettings(m_per_px=wish.m_per_px, model=wish.model, memory_mb=order.memory_mb)
    updates = map_flights(
        [order.source],
        site,
        settings,
        telemetry=order.telemetry or None,
        camera=wish.camera or None,
        live=_live(order),
        until=until,
    )
    flight = _run(updates, site, alive)
    return flight, *reported_headline(site, flight)


def _compare(
    order: Order, alive: Callable[..., None], until: threading.Event
) -> tuple[str, str, bool]:
    """Compare the flight with the site's map; the first flight over a site is mapped."""
    from sorvolo.missions.compare.flights import compare_flights
    from sorvolo.missions.flight.settings import CompareSettings
    from sorvolo.store.site.archive import Archive

    site, wish = Path(order.site), order.wish
    founder = _founder(site)
    if not founder or _is_flight(order.source, site, founder):
        return _map(order, alive, until)
    updates = compare_flights(
        [order.source],
        site,
        CompareSettings(model=wish.model),
        telemetry=order.telemetry or None,
        camera=wish.camera or None,
        live=_live(order),
        until=until,
    )
    flight = _run(updates, site, alive)
    with Archive.open(site, write=False) as archive:
        report = archive.report(flight).get("comparison") or {}
    head = report.get("headline") or {}
    return flight, str(head.get("text", "")), head.get("quality") == "compared"


def _search(
    order: Order, alive: Callable[..., None], until: threading.Event
) -> tuple[str, str, bool]:
    """Map the flight if the site has it not yet; measure what a search of it would have found."""
    from sorvolo.missions.search.flights import search_site
    from sorvolo.missions.search.settings import SearchOutputs, SearchSettings

    flight, words, is_good = _map(order, alive, until)
    if not is_good:
        return flight, words, False
    site = Path(order.site)
    outputs = SearchOutputs(site.with_name(f"{site.name}-search") / flight, flights=(flight,))
    report: Mapping[str, Any] = {}
    settings = SearchSettings(model=order.wish.model)
    with closing(search_site(site, settings, outputs)) as measuring:
        for each in measuring:
            alive()
            if isinstance(each, dict):
                report = each
    head = report.get("headline") or {}
    return flight, str(head.get("text", "")), bool(head.get("complete"))


_MISSIONS = {Mission.MAP: _map, Mission.COMPARE: _compare, Mission.SEARCH: _search}


def _run(updates: Generator[Any, None, Any], site: Path, alive: Callable[..., None]) -> str:
    """Take all updates of a mission over one flight; its name in the site."""
    from sorvolo.store.site.archive import Archive

    before = _newest(site)
    known: Any = ()

    def noted() -> Generator[Any]:
        nonlocal known
        known = yield from updates

    with closing(updates):
        for each in noted():
            alive(each)
    if known:
        return str(known[0].flight)
    with Archive.open(site, write=False) as archive:
        return next(
            each.flight_id for each in archive.versions() if each.complete and each.id > before
        )


def _newest(site: Path) -> int:
    from sorvolo.store.site.archive import Archive
    from sorvolo.store.site.catalogue_place import is_site

    if not is_site(site):
        return 0
    with Archive.open(site, write=False) as archive:
        return max((each.id for each in archive.versions() if each.complete), default=0)


def _founder(site: Path) -> str:
    """The flight whose map the site began with; "" where there is no map yet."""
    from sorvolo.store.site.archive import Archive
    from sorvolo.store.site.catalogue_place import is_site

    if not is_site(site):
        return ""
    with Archive.open(site, write=False) as archive:
        return next((each.flight_id for each in archive.versions() if each.complete), "")


def _is_flight(source: str, site: Path, flight: str) -> bool:
    """Whether the files are those of the site's flight of this name."""
    from sorvolo.capture.source import open_sources
    from sorvolo.missions.flight.setup import known_flights

    if is_live_address(source):
        return False
    return open_sources([source])[0].fingerprint == known_flights(site)[flight]


def _wait_for_site(site: Path) -> None:
    """Wait for a site whose writer is about to end."""
    from sorvolo.store.locks import take_lock
    from sorvolo.store.site.files import LOCK

    end_s = time.monotonic() + _SITE_BUSY_S
    while time.monotonic() < end_s:
        try:
            lock = os.open(site / LOCK, os.O_RDWR | os.O_NOFOLLOW)
        except OSError:  # no site yet, or none that may be opened: the mission states which
            return
        try:
            if take_lock(lock):
                return
        finally:
            os.close(lock)
        time.sleep(0.2)


def _begin() -> int:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the batch decides when its workers end
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    with suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text(str(_FIRST_TO_GO))
    return main()


if __name__ == "__main__":
    sys.exit(_begin())
