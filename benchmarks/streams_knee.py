"""How many live streams one machine watches before they fall behind: N processes, each with a watch of one stream.

python benchmarks/streams_knee.py [--streams 1 2 4 8 16 24] [--rate 2] [--seconds 12] [--size 640x360] [--share]
    [--output FILE]

A simulated flight is written into N growing transport streams at its own pace, and N processes watch them as `sorvolo
watch follow:FILE --fps RATE` does. Of a live stream a watch searches the newest frame and counts the others as skipped,
so a machine that is too small shows in the share of the wanted frames that were searched, and in the lag: how long ago
a frame was written into the file when its detections are out. Reported for each N: both, processor seconds a searched
frame (the processes' start apart) and the peak memory of a process. The knee is the largest N whose share stays at 0.9
or above. With `--share` all watches ask one detector, as those of a batch do; its processor time and memory count, too.
Pictures begin once all processes are up. The figures depend on what else runs: stated are the load before, and the
cores that everything else on the machine used meanwhile.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from statistics import median
from typing import Any

import av
from rich.console import Console
from rich.table import Table

from provenance import commit, machine
from sorvolo.capture.live.reconnect import LiveSettings
from sorvolo.cluster.shared_detector import SharedDetector
from sorvolo.lab.simulate.site import simulate_site
from sorvolo.lab.simulation.settings import (
    ImagingSettings,
    OutputSettings,
    PathSettings,
    SceneSettings,
    SimulationSettings,
)
from sorvolo.missions.flight.map_objects import open_detector
from sorvolo.missions.watch.flights import watch
from sorvolo.missions.watch.settings import WatchOutputs, WatchSettings

RESULTS = Path(__file__).parent / "results" / "streams_knee.json"
FPS, UP_WITHIN_S, STEP_S, KEEPS_UP = 10.0, 240.0, 0.1, 0.9
FIRST_S = 7.0  # of the flight that is there at once: FFmpeg looks at five seconds before it opens a stream


def main() -> None:
    """Simulate, watch, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--streams", type=int, nargs="+", default=[1, 2, 4, 8, 16, 24])
    parser.add_argument(
        "--rate", type=float, default=2.0, help="frames searched a second of each stream"
    )
    parser.add_argument("--seconds", type=float, default=12.0)
    parser.add_argument("--size", default="640x360")
    parser.add_argument("--share", action="store_true", help="one detector for all")
    parser.add_argument("--output", type=Path, default=RESULTS)
    parser.add_argument("--child", nargs=3, help=argparse.SUPPRESS)
    parser.add_argument("--make", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.make:
        make_stream(Path(options.make), options.size, options.seconds + FIRST_S)
        return
    if options.child:
        watch_one(*options.child, options.rate)
        return
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as scratch:
        stream = transport_stream(Path(scratch), options)
        for count in options.streams:
            rows.append(watched(stream, count, Path(scratch) / f"of{count}", options))
            keeping = [row["streams"] for row in rows if row["share"] >= KEEPS_UP]
            result = {
                "benchmark": "streams_knee",
                "machine": machine(),
                "commit": commit(),
                "rate_hz": options.rate,
                "seconds": options.seconds,
                "size": options.size,
                "share_detector": options.share,
                "knee": max(keeping, default=0),
                "rows": rows,
            }
            options.output.parent.mkdir(exist_ok=True)
            options.output.write_text(json.dumps(result, indent=1) + "\n")
    show(rows)


def transport_stream(folder: Path, options: Any) -> bytes:
    """A flight's stream, simulated by a process of its own: a child's peak memory counts what its parent had."""
    command = [sys.executable, __file__, "--size", options.size, "--seconds", str(options.seconds)]
    subprocess.run([*command, "--make", str(folder)], check=True)
    return (folder / "flight.ts").read_bytes()


def make_stream(folder: Path, size: str, seconds: float) -> None:
    """Write a simulated flight as MPEG-TS with a key frame each second, as a drone sends it: flight.ts."""
    width, height = map(int, size.split("x"))
    settings = SimulationSettings(
        seed=3,
        flights=1,
        scene=SceneSettings(people=6, cars=4, small_objects=3),
        path=PathSettings(height_m=20, speed_m_s=4, length_m=4 * seconds, strips=1),
        imaging=ImagingSettings(width, height, fps=FPS),
        output=OutputSettings("none", truth_step=1_000_000),
    )
    for _ in simulate_site(folder / "flight", settings):
        pass
    place = folder / "flight.ts"
    with (
        av.open(str(folder / "flight" / "flight1" / "flight1.mp4")) as video,
        av.open(str(place), "w") as sent,
    ):
        stream = sent.add_stream("libx264", rate=int(FPS))
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        stream.options = {"preset": "ultrafast", "tune": "zerolatency", "g": str(int(FPS))}
        for frame in video.decode(video=0):
            sent.mux(stream.encode(frame))
        sent.mux(stream.encode())


def watched(stream: bytes, count: int, folder: Path, options: Any) -> dict[str, Any]:
    """N watches of N growing files."""
    folder.mkdir()
    load = os.getloadavg()[0]
    files = [folder / f"stream{number}.ts" for number in range(count)]
    first = round(len(stream) * FIRST_S / (options.seconds + FIRST_S))
    for file in files:
        file.write_bytes(stream[:first])
    with SharedDetector() as shared:
        address = shared.address if options.share else ""
        return fed(
            stream,
            first,
            files,
            [begun(file, options.rate, address) for file in files],
            shared,
            options,
        ) | {"streams": count, "load_before": load}


def fed(
    stream: bytes,
    first: int,
    files: list[Path],
    children: list[subprocess.Popen[bytes]],
    shared: SharedDetector,
    options: Any,
) -> dict[str, Any]:
    """What watches of files do that grow from the first bytes of the stream to all of it."""
    pids = [*(child.pid for child in children), *([shared.pid] if shared.pid else [])]
    up_s = time.monotonic()
    while not all(frames_of(file) for file in files) and time.monotonic() - up_s < UP_WITHIN_S:
        time.sleep(0.2)
    started_cpu_s, busy_s = sum(map(cpu_s, pids)), machine_cpu_s()
    began_s = feed(files, stream, first, options.seconds)
    cpu = sum(map(cpu_s, pids)) - started_cpu_s
    others_s = machine_cpu_s() - busy_s - cpu
    for file in files:
        file.with_name(f"{file.name}.ended").touch()
    peaks = [ended(child) for child in children]
    seen = [each for file in files for each in frames_of(file) if each[1] >= FIRST_S * FPS]
    lags_s = [
        at_s - (began_s + index / FPS - FIRST_S)
        for at_s, index in seen
        if at_s <= began_s + options.seconds
    ]
    count = len(files)
    wanted = options.rate * options.seconds * count
    return {
        "wanted_frames": wanted,
        "searched_frames": len(lags_s),
        "share": round(min(1.0, len(lags_s) / wanted), 3),
        "cpu_s_per_frame": round(cpu / max(1, len(lags_s)), 4),
        "cores_used": round(cpu / options.seconds, 2),
        "cores_of_others": round(others_s / options.seconds, 2),
        "lag_s": round(median(lags_s), 2) if lags_s else None,
        "lag_max_s": round(max(lags_s), 2) if lags_s else None,
        "start_cpu_s": round(started_cpu_s / count, 2),
        "peak_mb": round(max(peaks)),
        "detector_mb": round(shared.memory_mb),
    }


def begun(file: Path, rate: float, detector: str) -> subprocess.Popen[bytes]:
    """A process with the watch of one growing file, which writes down when it had searched which frame."""
    with seen_file(file).open("wb") as seen:
        return subprocess.Popen(
            [
                sys.executable,
                __file__,
                "--rate",
                str(rate),
                "--child",
                str(file),
                str(file.with_suffix("")),
                detector,
            ],
            env={**os.environ, "OMP_NUM_THREADS": "1"},
            stdout=seen,
            stderr=subprocess.DEVNULL,
        )


def watch_one(file: str, out: str, detector: str, rate: float) -> None:
    """The child: a line for each searched frame, the monotonic clock and the frame's number."""
    settings = WatchSettings(frames_per_second=rate)
    patient = LiveSettings(
        silent_s=UP_WITHIN_S, first_s=UP_WITHIN_S, give_up_s=UP_WITHIN_S
    )  # while others start
    shared = open_detector("default", detector) if detector else None
    for update in watch(
        f"follow:{file}", settings, WatchOutputs(folder=Path(out)), live=patient, detector=shared
    ):
        print(time.monotonic(), update.frames_read - 1, flush=True)


def seen_file(file: Path) -> Path:
    """Where a stream's watch writes down its frames."""
    return file.with_suffix(".seen")


def frames_of(file: Path) -> list[tuple[float, int]]:
    """When which frames were searched."""
    rows = [
        line.split()
        for line in seen_file(file).read_text().splitlines(keepends=True)
        if line.endswith("\n")
    ]
    return [(float(at_s), int(index)) for at_s, index in rows]


def feed(files: list[Path], stream: bytes, first: int, seconds: float) -> float:
    """Let all files grow to the whole stream at the flight's pace; the monotonic clock when it began."""
    began_s, done = time.monotonic(), first
    while done < len(stream):
        share = min(1.0, (time.monotonic() - began_s) / seconds)
        until = first + round((len(stream) - first) * share)
        for file in files:
            with file.open("ab") as growing:
                growing.write(stream[done:until])
        done = until
        time.sleep(STEP_S)
    return began_s


def cpu_s(pid: int) -> float:
    """Processor seconds of a process so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def machine_cpu_s() -> float:
    """Processor seconds that the whole machine has used so far."""
    user, nice, system, _idle, _wait, *interrupts = map(
        int, Path("/proc/stat").read_text().split()[1:8]
    )
    return (user + nice + system + sum(interrupts)) / os.sysconf("SC_CLK_TCK")


def ended(child: "subprocess.Popen[bytes]") -> float:
    """Wait for a watch to end; its peak memory, MB. A watch that does not end is killed after two minutes."""
    timer = threading.Timer(120.0, child.kill)
    timer.start()
    _, _, used = os.wait4(child.pid, 0)
    timer.cancel()
    child.returncode = 0
    return used.ru_maxrss / 1024


def show(rows: list[dict[str, Any]]) -> None:
    """The table."""
    names = (
        "streams",
        "share",
        "lag_s",
        "lag_max_s",
        "cpu_s_per_frame",
        "cores_used",
        "start_cpu_s",
        "peak_mb",
        "detector_mb",
        "load_before",
        "cores_of_others",
    )
    table = Table(*names)
    for row in rows:
        table.add_row(*(str(row[name]) for name in names))
    Console().print(table)


if __name__ == "__main__":
    main()
