"""Why a PostgreSQL server ends a connection that is being made: by its codes, which are the same in every language."""

import os
import re
import select
import time

from sqlalchemy import URL

_CODE = re.compile(rb'ErrorResponse\t.*? C "([0-9A-Z]{5})"')


def refusal_codes(url: URL, within_s: float) -> tuple[str, ...]:
    """The SQLSTATEs of the errors with which a server refuses one more connection, in their order.

    psycopg has only the words of these errors, in the server's language: libpq keeps the code of an error before the
    first statement to itself. It is in libpq's trace, which exists on Linux. Empty where there is no trace, where the
    server is not reached, and where it takes the connection.
    """
    if not hasattr(os, "memfd_create"):
        return ()
    trace = os.memfd_create("trace")  # in memory alone: the trace has what the client sends, too
    try:
        _connect(url, trace, within_s)
        sent = os.pread(trace, os.fstat(trace).st_size, 0)
    finally:
        os.close(trace)
    return tuple(code.decode() for code in _CODE.findall(sent))


def _connect(url: URL, trace: int, within_s: float) -> None:
    """Connect and hang up, with all messages written into a file."""
    from psycopg.conninfo import make_conninfo
    from psycopg.pq import PGconn, PollingStatus

    _, options = url.get_dialect()().create_connect_args(url)
    connection = PGconn.connect_start(make_conninfo(**options).encode())
    try:
        connection.trace(trace)
        end_s = time.monotonic() + within_s
        while time.monotonic() < end_s:
            status = connection.connect_poll()
            if status in (PollingStatus.OK, PollingStatus.FAILED):
                break
            waiting = select.poll()
            waiting.register(
                connection.socket,
                select.POLLIN if status == PollingStatus.READING else select.POLLOUT,
            )
            waiting.poll(1000 * max(0.0, end_s - time.monotonic()))
        connection.untrace()
    finally:
        connection.finish()
