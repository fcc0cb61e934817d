"""`sorvolo stream`: a flight sent to a station while it is flown, or a recorded one as if it were."""

import hashlib
import os
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from rich.markup import escape

from sorvolo.cli.options import AsJson, Authority, Camera, Telemetry, argument, option
from sorvolo.cli.printing import Console, print_json
from sorvolo.cli.progress import ProgressReport
from sorvolo.cli.serve import demand_extra
from sorvolo.cli.sites import SignalStop
from sorvolo.errors import SettingsError
from sorvolo.survey.wording import counted

if TYPE_CHECKING:
    from sorvolo.station.client import StreamReport, StreamSettings
    from sorvolo.station.footage import Footage
    from sorvolo.station.spool import Spool

StreamInput = Annotated[
    str, argument("A video, or the camera's address, such as rtsp://192.168.1.10/live.")
]
To = Annotated[str, option("The station's address, such as https://station.example:8750.")]
StreamName = Annotated[
    str,
    option("The stream's name at the station.", "--stream", show_default="the input's"),
]
Token = Annotated[
    str,
    option(
        "Token of the role operate; others cannot see it in SORVOLO_TOKEN.", envvar="SORVOLO_TOKEN"
    ),
]
Speed = Annotated[
    float, option("Of a recording: 1 as it was flown, 0 as fast as the link takes it.")
]
Latency = Annotated[
    float,
    option("On a slow link pictures older than this are dropped, s; inf drops none."),
]
SpoolFolder = Annotated[
    Path | None, option("Folder for what waits.", show_default="in the user's cache")
]
SpoolMb = Annotated[float, option("Most that waits through an outage, MB.")]
StreamGiveUp = Annotated[
    float | None,
    option(
        "End when the camera sent nothing for so long, or all is taken and there is no link, s.",
        show_default="30 for the camera, never for the link",
    ),
]


def stream(
    source: StreamInput,
    to: To,
    name: StreamName = "",
    token: Token = "",
    telemetry: Telemetry = None,
    camera: Camera = "",
    speed: Speed = 1.0,
    latency: Latency = 5.0,
    spool: SpoolFolder = None,
    spool_mb: SpoolMb = 512.0,
    give_up: StreamGiveUp = None,
    ca: Authority = None,
    as_json: AsJson = False,
) -> None:
    """Send a flight to a station: its video as it is, and its telemetry, over one connection.

    What is taken while there is no link waits on the disk and is sent when it is back. Ctrl-C ends the flight.

    Example: sorvolo stream rtsp://192.168.1.10/live --to https://station.example:8750 --stream scout

    Example: sorvolo stream DJI_0042.MP4 --to http://127.0.0.1:8750 --speed 2
    """
    demand_extra()
    from sorvolo.capture.live.reconnect import LiveSettings
    from sorvolo.station.client import StreamSettings
    from sorvolo.station.footage import open_footage

    forever = float("inf")
    settings = StreamSettings(
        speed,
        latency,
        round(spool_mb * 1e6),
        give_up_s=forever if give_up is None else give_up,
        authority=ca,
    )
    stopping = SignalStop(is_running=True)
    stop = stopping.until
    with stopping.on_signals():
        live = LiveSettings(give_up_s=30.0 if give_up is None else give_up)
        footage = open_footage(source, telemetry or None, camera or None, live, stop)
        stream_name = name or footage.name
        folder = spool or _cache() / _flight_key(to, stream_name, source)
        reports = _send(footage, folder, (to, stream_name, token), settings, stop, is_quiet=as_json)
    _show_end(reports, footage, Console(), as_json=as_json)


def _send(
    footage: "Footage",
    folder: Path,
    station: tuple[str, str, str],
    settings: "StreamSettings",
    stop: threading.Event,
    *,
    is_quiet: bool,
) -> "list[StreamReport]":
    """Send what an earlier run left, where that was another flight, then this one; the report of each."""
    from sorvolo.station.client import StreamClient, remains_of, stream_url
    from sorvolo.station.spool import Spool

    to, name, token = station
    url = stream_url(to, name)
    console = Console(stderr=True)
    from urllib.parse import urlsplit

    parts = urlsplit(url)
    if token and parts.scheme == "ws" and parts.hostname not in ("127.0.0.1", "::1", "localhost"):
        console.print(
            "[yellow]warning[/yellow]  without TLS (https://) who listens in this network can read the token"
        )
    reports = []
    waiting = Spool(folder, settings.spool_bytes)
    if footage.is_live and (remains := remains_of(waiting, time.time_ns())) is not None:
        console.print("sending what an earlier flight left first")
        earlier = StreamClient(remains, waiting, url, token, settings, stop)
        reports.append(_run(earlier, waiting, console, is_quiet=is_quiet))
        waiting = Spool(folder, settings.spool_bytes)
    sending = StreamClient(footage, waiting, url, token, settings, stop)
    reports.append(_run(sending, waiting, console, is_quiet=is_quiet))
    return reports


def _run(sending: Any, waiting: "Spool", console: Console, *, is_quiet: bool) -> "StreamReport":
    with ProgressReport(console) as progress:

        def show(report: "StreamReport") -> None:
            if not is_quiet:
                progress.show("sending, frame", report.frames, words=_words(report))

        try:
            report: StreamReport = sending.run(show)
        finally:
            if sending.is_complete:
                waiting.remove()
            else:
                waiting.close()
    return report


def _words(report: "StreamReport") -> str:
    """What was sent, dropped and spooled, in one line."""
    words = [f"{report.sent_bytes / 1e6:.1f} MB"]
    if dropped := report.late + report.overflowed:
        words.append(f"{dropped:,} dropped")
    if report.spooled:
        words.append(f"{report.spooled:,} waiting")
    recent = list(report.delays_s)[-60:]
    if recent and report.is_linked:
        words.append(f"delay {sum(recent) / len(recent):.1f} s")
    if not report.is_linked:
        words.append(f"no link: {report.words or 'connecting'}")
    return ", ".join(words)


def _show_end(
    reports: "list[StreamReport]", footage: "Footage", console: Console, *, as_json: bool
) -> None:
    if as_json:
        flights = [_result(each) for each in reports]
        print_json({"flights": flights, "notices": list(footage.notices())})
        return
    for report in reports:
        samples = counted(report.samples, "telemetry sample")
        words = [
            f"{counted(report.frames, 'frame')} and {samples}, {report.sent_bytes / 1e6:.1f} MB"
        ]
        if report.late:
            words.append(f"{counted(report.late, 'frame')} dropped: the link was too slow")
        if report.overflowed:
            words.append(f"{counted(report.overflowed, 'frame')} dropped: the spool was full")
        if report.outages:
            words.append(f"{counted(report.outages, 'outage')}, {report.outage_s:.1f} s in all")
        if report.spooled:
            words.append(
                f"{counted(report.spooled, 'frame')} still waiting; the same command sends them"
            )
        words_of_end = "; ".join(words)
        console.print(
            f"Sent as {escape(report.stream)}: {words_of_end}",
            soft_wrap=True,
        )
    for text in footage.notices():
        console.print(f"  {escape(text)}", soft_wrap=True)


def _result(report: "StreamReport") -> dict[str, Any]:
    delays_s = sorted(report.delays_s)
    return {
        "stream": report.stream,
        "frames": report.frames,
        "samples": report.samples,
        "sent_mb": report.sent_bytes / 1e6,
        "dropped_late": report.late,
        "dropped_spool_full": report.overflowed,
        "waiting": report.spooled,
        "outages": report.outages,
        "outage_s": round(report.outage_s, 2),
        "delay_median_s": delays_s[len(delays_s) // 2] if delays_s else None,
        "delay_p95_s": delays_s[len(delays_s) * 95 // 100] if delays_s else None,
    }


def _cache() -> Path:
    """Where what waits is kept."""
    text = os.environ.get("XDG_CACHE_HOME", "")
    try:
        return (Path(text) if text else Path.home() / ".cache") / "sorvolo" / "spool"
    except RuntimeError as error:
        raise SettingsError("no home folder is known; give --spool a folder") from error


def _flight_key(to: str, stream_name: str, source: str) -> str:
    """The same for the same input sent to the same place; another for a recording that was replaced."""
    path = Path(source)
    found = path.stat() if path.is_file() else None
    content = f"{found.st_size} {found.st_mtime_ns}" if found is not None else ""
    return hashlib.sha256(f"{to} {stream_name} {source} {content}".encode()).hexdigest()[:16]
