"""A database and an object store for a benchmark that go away at random: killed, cut off, or answering nothing.

PostgreSQL of this machine's packages, and moto's S3 server, each behind a link of its own (`tests/faulty_link.py`).
What the store holds is kept: it is cut off, not killed.
"""

import os
import random
import sys
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest import mock
from urllib.parse import urlsplit

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "store"))

from fake_bucket import BUCKET, served_bucket

from faulty_link import FaultyLink
from postgres_server import PostgresServer
from sorvolo.store.site.catalogue_place import VARIABLE

PLACE = f"s3://{BUCKET}/maps"
"""Where sites are copied to."""


class Outages:
    """Strikes from a thread of its own until `end`: every 4 to 15 s one outage of 0.5 to `longest_s`."""

    def __init__(self, server: PostgresServer, database: FaultyLink, store: FaultyLink, seed: int, longest_s: float):
        self.counts: Counter[str] = Counter()
        self.seconds = 0.0
        self._server, self._links, self._longest_s = server, {"database": database, "store": store}, longest_s
        self._draw, self._is_over = random.Random(seed), threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def end(self) -> None:
        """Leave everything there and whole."""
        self._is_over.set()
        self._thread.join()

    def _run(self) -> None:
        kinds = [("database", "killed"), *((name, how) for name in self._links for how in ("cut", "stalled"))]
        waiting: list[tuple[str, str]] = []
        while not self._is_over.wait(self._draw.uniform(4.0, 15.0)):
            waiting = waiting or self._draw.sample(kinds, len(kinds))  # each kind once before the first comes again
            name, how = waiting.pop()
            wait_s = self._draw.uniform(0.5, self._longest_s)
            self.counts[f"{name} {how}"] += 1
            self.seconds += wait_s
            print(f"the {name} is {how} for {wait_s:.1f} s", flush=True)
            link = self._links[name]
            {"killed": self._server.stop, "cut": link.cut, "stalled": link.stall}[how]()
            self._is_over.wait(wait_s)
            {"killed": self._server.start, "cut": link.mend, "stalled": link.mend}[how]()


@contextmanager
def outages(seed: int, longest_s: float) -> Iterator[Outages]:
    """Both servers, which the environment names meanwhile, and what strikes them."""
    server = PostgresServer()
    try:
        with served_bucket() as endpoint, FaultyLink(server.port) as database, \
                FaultyLink(urlsplit(endpoint).port or 0) as store:
            named = {
                VARIABLE: server.url.replace(f":{server.port}", f":{database.port}"),
                "AWS_ENDPOINT_URL": f"http://127.0.0.1:{store.port}",
            }
            with mock.patch.dict(os.environ, named):
                made = Outages(server, database, store, seed, longest_s)
                try:
                    yield made
                finally:
                    made.end()
    finally:
        server.remove()
