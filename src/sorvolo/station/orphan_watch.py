"""Whether anybody can still know of a mission's process: its run's folder is there, and the station's record of it."""

import os
import signal
import sqlite3
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from urllib.parse import quote

from sorvolo.station.orders import ORDER_FILE
from sorvolo.station.state import STATE_FILE

_LOOK_EVERY_S = 2.0  # by choice
_LOOKS = 3  # that must agree: a disk may be away for a moment, and a record is written just after the process began
_END_S = 30.0  # for a mission to end by itself, then its processes are killed


@contextmanager
def ended_when_orphaned(
    folder: Path,
    run_id: str,
    end: Callable[[str], None],
    *,
    every_s: float = _LOOK_EVERY_S,
) -> Iterator[None]:
    """Call `end` with the reason, from a thread, once nobody can know any more of the run in this folder.

    Such a process would write into a site that others take for free, and nobody could stop it. Where it does not end
    within 30 s, it and all that it started are killed.
    """
    leaving = threading.Event()
    watching = threading.Thread(
        target=_watch, args=(folder, run_id, end, every_s, leaving), name="orphan", daemon=True
    )
    watching.start()
    try:
        yield
    finally:
        leaving.set()


def why_orphaned(folder: Path, run_id: str) -> str:
    """Why nobody knows of a run any more, in words; "" where somebody does, or it cannot be found out."""
    if not (folder / ORDER_FILE).exists():
        return "the folder of this run was taken away"
    state = folder.parent.parent / STATE_FILE
    try:
        with closing(
            sqlite3.connect(f"file:{quote(str(state))}?mode=ro", uri=True, timeout=5.0)
        ) as connection:
            known = connection.execute(
                "SELECT count(*) FROM runs WHERE id = ?", (run_id,)
            ).fetchone()[0]
    except sqlite3.Error:  # it is being written, or damaged, or this is no station's folder
        return ""
    return "" if known else "the station has no record of this run"


def _watch(
    folder: Path, run_id: str, end: Callable[[str], None], every_s: float, leaving: threading.Event
) -> None:
    looks = 0
    while looks < _LOOKS:
        if leaving.wait(every_s):
            return
        why = why_orphaned(folder, run_id)
        looks = looks + 1 if why else 0
    end(f"{why}: nobody could stop it or see its result")
    if not leaving.wait(_END_S):
        os.killpg(
            os.getpgrp(), signal.SIGKILL
        )  # a session of its own, led by the mission's process
