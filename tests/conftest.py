"""What holds for all tests."""

import gc
import importlib
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest
from hypothesis import settings

from postgres_server import PostgresServer, program

# a shell's background job ignores Ctrl-C, and so would the programs that tests start and stop
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# beside other workers of the suite, a second thread of the same sum only waits; read before any library starts threads
if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    os.environ.setdefault("OPENCV_FOR_THREADS_NUM", "1")

# how long an example takes depends on what else the machine does: no test is judged by it. Continuous integration (CI
# is set) draws the same examples every time, others new ones.
settings.register_profile("anywhere", deadline=None)
settings.register_profile(
    "every time the same", deadline=None, derandomize=True, database=None, print_blob=True
)
settings.load_profile("every time the same" if "CI" in os.environ else "anywhere")


os.environ.pop("SORVOLO_CATALOGUE", None)  # where the tester's own catalogues lie


def pytest_collectstart(collector: pytest.Collector) -> None:
    """Each worker of the whole suite begins with tests of its own: in a fresh clone all of them would rewrite the
    assertions of every file, where one writes what the others read."""
    is_whole = collector.config.args_source is pytest.Config.ArgsSource.TESTPATHS
    workers, tests = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "0")), Path(__file__).parent
    if not (workers and is_whole and collector.path == tests):
        return
    own = int(os.environ["PYTEST_XDIST_WORKER"].removeprefix("gw"))
    for path in sorted(tests.rglob("test_*.py"))[own::workers]:
        if str(path.parent) not in sys.path:
            sys.path.insert(0, str(path.parent))  # as pytest does itself
        with suppress(Exception, pytest.skip.Exception):  # which the collection reports
            importlib.import_module(path.stem)


def pytest_collection_finish() -> None:
    """The garbage collector leaves alone what the imports made: it lasts, and walking it took a fifth of some rooms."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session")
def postgres() -> Iterator[PostgresServer]:
    """A PostgreSQL server for the tests of this process."""
    pytest.importorskip("psycopg")
    if program("initdb") is None:
        pytest.skip("PostgreSQL is not installed (Debian: apt-get install postgresql)")
    server = PostgresServer()
    yield server
    server.remove()


@pytest.fixture(params=["sqlite", "postgresql"])
def kind(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Where the catalogues of new sites lie: what holds of a catalogue holds of both."""
    if request.param == "postgresql":
        monkeypatch.setenv("SORVOLO_CATALOGUE", request.getfixturevalue("postgres").url)
    return request.param
