"""One flight in blocks: registered by several workers, joined here into one graph, painted by several workers."""

import resource
import socket
import time
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path

from sorvolo.cluster.copying import copy_result
from sorvolo.cluster.cost import Cost
from sorvolo.cluster.executor import Executor, Key
from sorvolo.cluster.orders import Ending, Order, Outcome, Part, PartKind
from sorvolo.errors import SorvoloError
from sorvolo.geometry.grid import TileIndex
from sorvolo.missions.flight.request import AlreadyDone
from sorvolo.missions.flight.settings import MapSettings
from sorvolo.missions.map.joining import join_blocks, plan_blocks
from sorvolo.missions.map.tile_shares import PaintPlan, tile_blobs, tiles_painted, write_plan
from sorvolo.missions.site.reported_headline import reported_headline
from sorvolo.survey.mosaic import MosaicUpdate

Progress = tuple[str, int, int]
"""What is being done, and how many of how many parts of it are through."""


class SetAside(SorvoloError):
    """A part of a flight ended its process each time."""


class PartFailed(SorvoloError):
    """A part of a flight cannot be done as it is."""


def map_divided(
    key: Key,
    order: Order,
    count: int,
    executor: Executor,
    cost_of: Callable[[int], Cost],
    most_tries: int,
) -> Generator[Progress, None, Ending]:
    """Map a flight in `count` blocks; yields how far it is.

    `order` is that of the whole flight, `cost_of` what a part asks for that crashed so often. Blocks that are whole
    stay until the map is made: the same call goes on with them. The joining is done in this process. Raises SetAside
    for a part that ended its process `most_tries` times.
    """
    started_s, cpu_s = time.monotonic(), time.process_time()
    parts = _Parts(key, order, executor, cost_of, most_tries)
    try:
        flight, words, is_good = yield from _mapped(order, count, parts)
        if order.wish.copy_to:
            copy_result(Path(order.site), order.wish.copy_to)
        ending = Ending(Outcome.DONE if is_good else Outcome.DOUBTFUL, words, flight)
    except SetAside:
        raise
    except SorvoloError as error:
        ending = Ending(Outcome.of(error), str(error))
    own_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return ending.with_effort(
        round(time.monotonic() - started_s, 3),
        round(parts.cpu_s + time.process_time() - cpu_s, 3),
        max(parts.peak_memory_mb, round(own_mb, 1)),
        socket.gethostname(),
    )


def _mapped(
    order: Order, count: int, parts: "_Parts"
) -> Generator[Progress, None, tuple[str, str, bool]]:
    """The flight's name in the site, its headline, and whether it is a map to use."""
    site, camera = Path(order.site), order.wish.camera or None
    settings = MapSettings(
        m_per_px=order.wish.m_per_px, model=order.wish.model, memory_mb=order.memory_mb
    )
    folder = site.with_name(f".{site.name}.blocks")
    division = plan_blocks(Path(order.source), site, settings, camera, count, folder)
    if isinstance(division, AlreadyDone):
        return division.flight, *reported_headline(site, division.flight)
    folder.mkdir(exist_ok=True)
    if division.is_video and division.chosen() is None:
        yield from parts.through(
            "frames chosen", [Part(PartKind.FRAMES, 0, 1, str(folder), division.key)], 1
        )
    waiting = [
        Part(PartKind.BLOCK, number, division.count, str(folder), division.key)
        for number in range(division.count)
        if not division.is_done(number)
    ]
    yield from parts.through("blocks", waiting, division.count)

    def painted(plan: PaintPlan) -> Iterator[tuple[TileIndex, bytes]]:
        write_plan(plan, folder)
        shares = len(plan.shares(division.count))
        for _ in parts.through(
            "tiles",
            [Part(PartKind.TILES, number, division.count, str(folder)) for number in range(shares)],
            shares,
        ):
            pass
        blobs = tile_blobs(folder)
        for number in range(shares):
            for tile, sha256 in tiles_painted(folder, number).items():
                yield tile, blobs.encoded(sha256)

    joining = join_blocks(Path(order.source), site, settings, camera, division, painted)
    flight = yield from _shown(joining)
    division.remove()
    return flight, *reported_headline(site, flight)


def _shown(joining: Generator[MosaicUpdate, None, str]) -> Generator[Progress, None, str]:
    with closing(joining):
        while True:
            try:
                update = next(joining)
            except StopIteration as end:
                return str(end.value)
            yield "pictures joined", update.keyframes, update.keyframes_expected


class _Parts:
    """Parts of one flight on their way, each tried until it is through. `through` changes what they took."""

    def __init__(
        self,
        key: Key,
        order: Order,
        executor: Executor,
        cost_of: Callable[[int], Cost],
        most_tries: int,
    ) -> None:
        self.cpu_s = self.peak_memory_mb = 0.0
        self._key, self._order, self._executor, self._cost_of = key, order, executor, cost_of
        self._most_tries = most_tries
        self._running: dict[Key, Part] = {}
        self._crashes: Counter[Part] = Counter()

    def through(self, task: str, parts: Sequence[Part], total: int) -> Generator[Progress]:
        """Have all of them done. Raises PartFailed or SetAside, once none runs any more."""
        waiting = list(parts)
        try:
            while waiting or self._running:
                yield task, total - len(waiting) - len(self._running), total
                while waiting and self._executor.has_room(self._cost(waiting[0])):
                    self._start(waiting.pop(0))
                if (part := self._ended()) is not None:
                    waiting.insert(0, part)
        except SorvoloError:
            while self._running:
                self._next()
            raise

    def _cost(self, part: Part) -> Cost:
        return self._cost_of(self._crashes[part])

    def _start(self, part: Part) -> None:
        key = (self._key[0], f"{self._key[1]} {part.kind} {part.number}")
        self._running[key] = part
        self._executor.start(
            key,
            replace(self._order, part=part, memory_mb=self._executor.cache_mb),
            self._cost(part),
        )

    def _ended(self) -> Part | None:
        """Wait until a part has ended; the part where it has to be tried again."""
        if (found := self._next()) is None:
            return None
        part, ending = found
        name = f"{part.kind} {part.number + 1} of {part.count}"
        if ending.outcome is Outcome.FAILED:
            raise PartFailed(ending.words)
        if ending.outcome in (Outcome.DONE, Outcome.DOUBTFUL):
            return None
        self._crashes[part] += 1
        if self._crashes[part] >= self._most_tries:
            raise SetAside(f"{name}: {ending.words}")
        return part

    def _next(self) -> tuple[Part, Ending] | None:
        ended = self._executor.next_ended()
        if ended is None:
            return None
        key, ending = ended
        self.cpu_s += ending.cpu_s
        self.peak_memory_mb = max(self.peak_memory_mb, ending.peak_memory_mb)
        return self._running.pop(key), ending
