"""A database and an object store for a benchmark that go away at random: killed, cut off, or answering nothing.

PostgreSQL of this machine's packages, and moto's S3 server with a log that outlives it
(`tests/store/killed_bucket.py`), each behind a link of its own (`tests/faulty_link.py`).
"""

import os
import random
import sys
import threading
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from unittest import mock

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "store"))

from fake_bucket import BUCKET, environment
from killed_bucket import KilledBucket

from faulty_link import FaultyLink
from postgres_server import PostgresServer
from sorvolo.store.site.catalogue_place import VARIABLE

PLACE = f"s3://{BUCKET}/maps"
"""Where sites are copied to."""


class Outages:
    """Strikes from a thread of its own until `end`: every 4 to 15 s one outage of 0.5 to `longest_s`."""

    def __init__(
        self,
        servers: Mapping[str, PostgresServer | KilledBucket],
        links: Mapping[str, FaultyLink],
        seed: int,
        longest_s: float,
    ) -> None:
        """Servers and their links have the same names."""
        self.counts: Counter[str] = Counter()
        self.seconds = 0.0
        self._servers, self._links, self._longest_s = servers, links, longest_s
        self._draw, self._is_over = random.Random(seed), threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def end(self) -> None:
        """Leave everything there and whole."""
        self._is_over.set()
        self._thread.join()

    def _run(self) -> None:
        kinds = [(name, how) for name in self._links for how in ("killed", "cut", "stalled")]
        waiting: list[tuple[str, str]] = []
        while not self._is_over.wait(self._draw.uniform(4.0, 15.0)):
            waiting = waiting or self._draw.sample(
                kinds, len(kinds)
            )  # each kind once before the first comes again
            name, how = waiting.pop()
            wait_s = self._draw.uniform(0.5, self._longest_s)
            self.counts[f"{name} {how}"] += 1
            self.seconds += wait_s
            print(f"the {name} is {how} for {wait_s:.1f} s", flush=True)
            link, server = self._links[name], self._servers[name]
            {"killed": server.stop, "cut": link.cut, "stalled": link.stall}[how]()
            self._is_over.wait(wait_s)
            {"killed": server.start, "cut": link.mend, "stalled": link.mend}[how]()


@contextmanager
def outages(seed: int, longest_s: float) -> Iterator[Outages]:
    """Both servers, which the environment names meanwhile, and what strikes them."""
    server = PostgresServer()
    try:
        with (
            KilledBucket() as bucket,
            FaultyLink(server.port) as database,
            FaultyLink(bucket.port) as store,
        ):
            named = {
                VARIABLE: server.url.replace(f":{server.port}", f":{database.port}"),
                **environment(f"http://127.0.0.1:{store.port}"),
            }
            with mock.patch.dict(os.environ, named):
                made = Outages(
                    {"database": server, "store": bucket},
                    {"database": database, "store": store},
                    seed,
                    longest_s,
                )
                try:
                    yield made
                finally:
                    made.end()
    finally:
        server.remove()
