"""The process of a station's run: does its order and writes its journal; needs no server, and outlives one."""

import fcntl
import os
import resource
import signal
import sqlite3
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from urllib.parse import quote

from sorvolo.capture.live.growing import ENDED_SUFFIX
from sorvolo.errors import SorvoloError
from sorvolo.missions.worker import MISSIONS, Done, Journal, Stop, work
from sorvolo.station.camera import camera_opened
from sorvolo.station.orders import JOURNAL_FILE, LOCK_VARIABLE, ORDER_FILE, RunOrder
from sorvolo.station.state import STATE_FILE, shortage
from sorvolo.store.freed_memory import share_arenas
from sorvolo.survey.wording import counted

_NICE = 5  # the server answers first
_LOOK_EVERY_S = 2.0  # whether somebody knows of the run; by choice
_LOOKS = 3  # that must agree: a disk may be away for a moment, and a record is written just after the process began
_END_S = 30.0  # for an orphan to end by itself, then its processes are killed
_FOLLOW = "follow:"


def main(folder: Path) -> int:
    """Do the order in a run's folder; the exit code: 0, 1 for an error that its journal states, 3 where the flight
    is incomplete, 130 stopped."""
    order = RunOrder.read(folder)
    with (folder / JOURNAL_FILE).open("ab") as file:
        journal = Journal(file)
        return work(order, journal, lambda stop: _fly_watched(order, folder, journal, stop))


def _fly_watched(order: RunOrder, folder: Path, journal: Journal, stop: Stop) -> Done:
    """Fly as long as somebody knows of the run. Raises what the mission raises, or why nobody can see its result."""
    with ended_when_orphaned(folder, order.run, stop.at_once):
        try:
            return fly(order, folder, journal, stop.until)
        except Exception as error:
            # where its folder is gone, that is why the mission failed
            if (folder / ORDER_FILE).exists() or not (why := why_orphaned(folder, order.run)):
                raise
            sys.stderr.write(f"{why}; stopped\n")
            raise SorvoloError(f"{why}; nothing was kept") from error


def fly(order: RunOrder, folder: Path, journal: Journal, until: threading.Event) -> Done:
    """Do the mission, with its camera opened if it has one; a flight that is incomplete is not good.

    Raises what the mission raises; its words name what the flight lacks.
    """
    with camera_opened(order, folder, until) as camera:
        try:
            done = MISSIONS[order.mission](camera.order, journal, until)
        except SorvoloError as error:
            if not (why := cut_off(camera.order, was_stopped=until.is_set())):
                raise
            raise type(error)(f"{error}; the flight is incomplete: {why}") from error
        why = cut_off(camera.order, was_stopped=until.is_set())
    if left := camera.left():
        unsent = f"{counted(left, 'picture')} of the camera did not get to the station's disk"
        why = "; ".join(filter(None, (why, unsent)))
    headline = f"incomplete: {why}. {done.headline}" if why else done.headline
    return replace(done, headline=headline, is_good=not why)


def cut_off(order: RunOrder, *, was_stopped: bool) -> str:
    """Why the flight that a mission followed did not come to its own end; "" where it did, or a person ended it.

    A full disk is named also where a person ended it: pictures wait at the drone, or beside the mission, that the
    station could not take. Ask before the camera's reader is ended.
    """
    if not order.source.startswith(_FOLLOW):
        return ""
    path = Path(order.source.removeprefix(_FOLLOW))
    if path.with_name(path.name + ENDED_SUFFIX).exists():
        return ""
    short = shortage(path.parent, order.floor_gb)
    full = f"the station's disk is full ({short}): it took no more pictures" if short else ""
    away = f"nothing came for {order.away_s:.0f} s, and the flight's end was never stated"
    return "; ".join(filter(None, (full, "" if was_stopped else away)))


@contextmanager
def ended_when_orphaned(
    folder: Path, run_id: str, end: Callable[[str], None], *, every_s: float = _LOOK_EVERY_S
) -> Iterator[None]:
    """Call `end` with the reason, from a thread, once nobody can know any more of the run in this folder.

    Such a process would write into a site that others take for free, and nobody could stop it. Where it does not end
    within 30 s, it and all that it started are killed.
    """
    leaving = threading.Event()

    def watch() -> None:
        looks = 0
        while looks < _LOOKS:
            if leaving.wait(every_s):
                return
            why = why_orphaned(folder, run_id)
            looks = looks + 1 if why else 0
        end(f"{why}: nobody could stop it or see its result")
        if not leaving.wait(_END_S):  # a session of its own, led by the mission's process
            os.killpg(os.getpgrp(), signal.SIGKILL)

    threading.Thread(target=watch, daemon=True, name="orphan").start()
    try:
        yield
    finally:
        leaving.set()


def why_orphaned(folder: Path, run_id: str) -> str:
    """Why nobody knows of a run any more, in words; "" where somebody does, or it cannot be found out."""
    if not (folder / ORDER_FILE).exists():
        return "the folder of this run was taken away"
    state = folder.parent.parent / STATE_FILE
    query = "SELECT count(*) FROM runs WHERE id = ?"
    try:
        uri = f"file:{quote(str(state))}?mode=ro"
        with closing(sqlite3.connect(uri, uri=True, timeout=5.0)) as connection:
            known = connection.execute(query, (run_id,)).fetchone()[0]
    except sqlite3.Error:  # it is being written, or damaged, or this is no station's folder
        return ""
    return "" if known else "the station has no record of this run"


if __name__ == "__main__":
    # the run's lock is open in this process alone, not in its children, so that its end is seen
    lock = os.environ.pop(LOCK_VARIABLE, "")
    if lock.isdecimal():
        fcntl.fcntl(int(lock), fcntl.F_SETFD, fcntl.FD_CLOEXEC)
    os.nice(_NICE)
    share_arenas()
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    sys.exit(main(Path(sys.argv[1])))
