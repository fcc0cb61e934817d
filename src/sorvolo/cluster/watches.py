"""Watches as a mission of a batch: their options, the folder of each, what becomes of them in words."""

import json
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Any

from sorvolo.capture.live.addresses import is_live_address
from sorvolo.capture.live.reconnect import LiveSettings
from sorvolo.cluster.orders import Order, WatchWish
from sorvolo.survey.wording import counted, counted_list

if TYPE_CHECKING:
    from sorvolo.missions.watch.settings import WatchOutputs, WatchSettings

ENDING = "-watch"
"""Of the folder of a flight's results, after its name."""

_UNSENT = ("cot", "alert")
"""How codes of notices begin that count what did not reach its receiver."""


def watch_settings(model: str, wish: WatchWish) -> "WatchSettings":
    """What is searched for. Raises SettingsError for what is out of range."""
    from sorvolo.missions.watch.settings import (
        WatchSettings,
    )  # with what it imports, which takes long

    return WatchSettings(
        model=model,
        classes=wish.classes,
        least_score=wish.least_score,
        frames_per_second=wish.frames_per_second,
    )


def watch_outputs(wish: WatchWish, folder: Path, *, is_live: bool = False) -> "WatchOutputs":
    """Where results go, each flight of a live source into a folder of its own, and who is alerted.

    Raises SettingsError for what nobody can be alerted by.
    """
    from sorvolo.missions.watch.cot_sender import CotTls
    from sorvolo.missions.watch.settings import WatchOutputs

    tls = CotTls(
        Path(wish.cot_ca) if wish.cot_ca else None, Path(wish.cot_cert) if wish.cot_cert else None
    )
    return WatchOutputs(
        folder=None if is_live else folder,
        below=folder if is_live else None,
        save=wish.save,
        cot=wish.cot,
        alert_command=wish.alert_command,
        alert_url=wish.alert_url,
        cot_tls=tls,
    )


def existing_watches(root: Path) -> dict[str, str]:
    """The folders of watches of recorded flights below `root`, by the fingerprint of the flight."""
    from sorvolo.store.exports.detection_files import find_watched

    found = {path.name: find_watched(path) for path in sorted(root.iterdir()) if path.is_dir()}
    return {fingerprint: name for name, fingerprint in found.items() if fingerprint is not None}


def is_watched(folder: Path, fingerprint: str) -> bool:
    """Whether the folder holds a complete watch of the flight."""
    from sorvolo.store.exports.detection_files import REPORT, find_watched

    return find_watched(folder) == fingerprint and (folder / REPORT).is_file()


def watch_flight(
    order: Order,
    alive: Callable[..., None],
    announce: Callable[[str], None],
    until: Event,
) -> tuple[str, str]:
    """Watch the order's flight: its name, and what was found. `announce` gets each new object in words."""
    from sorvolo.missions.watch.flights import watch
    from sorvolo.missions.watch.report import found_words

    wish = order.wish
    outputs = watch_outputs(wish.watch, Path(order.site), is_live=is_live_address(order.source))
    folder: Path | None = None
    updates = watch(
        order.source,
        watch_settings(wish.model, wish.watch),
        outputs,
        telemetry=order.telemetry or None,
        camera=wish.camera or None,
        live=LiveSettings(give_up_s=wish.give_up_s),
        until=until,
    )
    with closing(updates):
        for update in updates:
            alive()
            folder = update.folder
            for track in () if update.is_resumed else update.new:
                announce(" ".join(found_words(track, update.site)))
    if folder is None:
        return "", "stopped before the first frame was searched"
    report = json.loads((folder / "report.json").read_bytes())
    return str(report["flight"]), headline(report)


def headline(report: dict[str, Any]) -> str:
    """What a watch found, and what a person should know of it before anything else."""
    frames = report["frames"]
    words = f"{counted_list(report['objects']['by_class'])} found in {counted(frames['detected'], 'frame')}"
    if not report["georeferenced"]:
        words += ", without a place on the ground"
    unsent = [each["text"] for each in report["notices"] if each["code"].startswith(_UNSENT)]
    return "; ".join([words, *unsent])
