"""A camera that a mission is started on: one process opens it, once, and sends it to the station as a drone does."""

import json
import logging
import os
import queue
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from sorvolo.capture.live.addresses import is_live_address, without_secret
from sorvolo.capture.live.growing import ENDED_SUFFIX
from sorvolo.capture.live.reconnect import LiveSettings
from sorvolo.child_process import python_command
from sorvolo.errors import InputError, SorvoloError
from sorvolo.paths import JsonView
from sorvolo.station.orders import RunOrder

_SPOOL_BYTES = 512_000_000  # what waits for a station that is away
_STATION_AWAY_S = 300.0  # to wait for the flight's first picture at the station
_END_S = 20.0  # to end a flight: a camera that is silent is noticed, what waits is sent
_LEAVE_S = 3.0  # the same for a flight that nobody wants
_TURN_S = 0.1  # how soon an end is noticed; by choice


@dataclass(frozen=True)
class CameraJob:
    """What the process is to do; comes by its standard input, where nobody else can read the camera's password."""

    source: str
    telemetry: str
    stream: str
    door: str
    spool: str


@dataclass(frozen=True)
class OpenedCamera:
    """An order whose camera is being read; `left` is asked for when that is over."""

    order: RunOrder
    left: Callable[[], int] = lambda: 0
    """How many pictures the camera sent that the station's disk has not."""


@contextmanager
def camera_opened(order: RunOrder, folder: Path, until: threading.Event) -> Iterator[OpenedCamera]:
    """The order with the flight that the station keeps of its camera as the source, while the camera is read.

    An order without a camera's door stays as it is; so does one whose camera sends what no browser plays, but for its
    stream: the mission then reads the camera by itself. The flight ends with the context. `folder` is the run's.
    Raises InputError where the camera sends nothing or the station does not take it, KeyboardInterrupt where the run
    is stopped before the first picture.
    """
    if not order.door:
        yield OpenedCamera(order)
        return
    camera = _Camera(order, folder)
    try:
        path = camera.flight(Path(order.streams) / order.stream, until)
        own = (
            replace(order, stream="")
            if path is None
            else replace(order, source=f"follow:{path}", telemetry="")
        )
        yield OpenedCamera(own, lambda: camera.left)
    except KeyboardInterrupt:
        camera.end(_LEAVE_S)
        raise
    finally:
        camera.end(_END_S)


class _Camera:
    """The process that reads a camera, seen from the mission. `end` ends it; it ends by itself with the mission."""

    def __init__(self, order: RunOrder, folder: Path) -> None:
        job = CameraJob(
            order.source, order.telemetry, order.stream, order.door, str(folder.resolve() / "spool")
        )
        self._spool = Path(job.spool)
        self._process = subprocess.Popen(
            python_command("sorvolo.station.camera"),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            cwd=Path(order.door).parent,
        )
        assert self._process.stdin is not None
        with suppress(BrokenPipeError):  # it ended at once: its answer is missing
            self._process.stdin.write(json.dumps(asdict(job)).encode() + b"\n")
            self._process.stdin.flush()
        self._path: Path | None = None
        self.left = 0
        self._answers: queue.Queue[JsonView] = queue.Queue()
        self._listening = threading.Thread(target=self._listen, name="camera", daemon=True)
        self._listening.start()

    def flight(self, folder: Path, until: threading.Event) -> Path | None:
        """The flight's file once it has begun; None where a station cannot show what the camera sends."""
        flight, why, since_s = "", "", time.monotonic()
        while not until.is_set():
            answer = self._answer()
            if "unsendable" in answer:
                return None
            if "failed" in answer:
                raise InputError(str(answer["failed"]))
            if "flight" in answer:
                flight, since_s = str(answer["flight"]), time.monotonic()
            why = str(answer.get("words", why))
            found = next(iter(folder.glob(f"*_{flight}.ts")), None) if flight else None
            if found is not None and found.stat().st_size:
                self._path = found.resolve()
                return self._path
            if flight and time.monotonic() - since_s > _STATION_AWAY_S:
                raise InputError(
                    f"the station took no picture of the camera: {why or 'it is away'}"
                )
        raise KeyboardInterrupt

    def end(self, within_s: float) -> None:
        """Let the flight end, or kill what does not come to its end; again: nothing."""
        assert self._process.stdin is not None
        with suppress(OSError):
            self._process.stdin.close()
        try:
            self._process.wait(within_s)
        except subprocess.TimeoutExpired:
            pass
        finally:
            self._process.kill()
            self._process.wait()
            self._listening.join(_TURN_S * 10)  # for its last lines
            shutil.rmtree(self._spool, ignore_errors=True)

    def _answer(self) -> JsonView:
        """What the process stated meanwhile; nothing where it did not."""
        try:
            return self._answers.get(timeout=_TURN_S)
        except queue.Empty:
            return {}

    def _listen(self) -> None:
        assert self._process.stdout is not None
        with suppress(ValueError):  # closed, or cut in the middle of a line
            for line in self._process.stdout:
                answer = json.loads(line)
                self.left = int(answer.get("left", self.left))
                self._answers.put(answer)
        self._answers.put({"failed": "the process that reads the camera ended without a word"})
        if self._path is not None:  # it ended: who follows its file must not wait for more
            with suppress(OSError):
                self._path.with_name(self._path.name + ENDED_SUFFIX).touch()


# ---- the process itself -----------------------------------------------------------------------------------------


def main() -> int:
    """Do one job until its stream ends or its parent exits; log progress as JSON lines."""
    logging.basicConfig(format="%(levelname)s %(name)s: %(message)s")
    job = CameraJob(**json.loads(sys.stdin.readline()))
    stop = threading.Event()
    threading.Thread(target=_stop_with_mission, args=(stop,), daemon=True).start()
    try:
        return _send(job, stop)
    except SorvoloError as error:
        _state({"failed": without_secret(str(error), job.source)})
    except Exception as error:
        _state({"failed": without_secret(f"{type(error).__name__}: {error}", job.source)})
    return 1


def _send(job: CameraJob, stop: threading.Event) -> int:
    from sorvolo.station.client import StreamClient, StreamReport, StreamSettings
    from sorvolo.station.footage import UnsendableInput, open_footage
    from sorvolo.station.spool import Spool

    if not is_live_address(job.source):
        raise InputError("a camera's address was needed")
    try:
        live = LiveSettings(follows_redirects=False)
        footage = open_footage(job.source, job.telemetry or None, None, live, stop)
    except UnsendableInput as error:
        _state({"unsendable": without_secret(str(error), job.source)})
        return 0
    # every picture is sent, also after the station was away: the mission's own map is made of them
    settings = StreamSettings(
        latency_s=float("inf"), spool_bytes=_SPOOL_BYTES, door=Path(job.door).name
    )
    waiting = Spool(Path(job.spool), _SPOOL_BYTES)
    client = StreamClient(footage, waiting, f"ws://localhost/{job.stream}", "", settings, stop)
    _state({"flight": waiting.flight})
    words = ""

    def show(report: StreamReport) -> None:
        nonlocal words
        if report.words != words:
            words = report.words
            _state({"words": words})

    try:
        client.run(show)
    finally:
        _state({"left": client.report.spooled + client.report.overflowed})
        if client.is_complete:
            waiting.remove()
        else:
            waiting.close()
    return 0


def _state(answer: JsonView) -> None:
    with suppress(BrokenPipeError):  # the mission is gone
        sys.stdout.write(json.dumps(answer) + "\n")
        sys.stdout.flush()


def _stop_with_mission(stop: threading.Event) -> None:
    """The other end of the standard input is open as long as the mission lives, and wants the camera."""
    sys.stdin.read()
    stop.set()
    time.sleep(_END_S)
    os._exit(1)


if __name__ == "__main__":
    sys.exit(main())
