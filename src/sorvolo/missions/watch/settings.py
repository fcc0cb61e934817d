"""What a person may choose for a watch: what is searched for in which frames, and who is notified."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from sorvolo.errors import SettingsError, check_choices
from sorvolo.missions.flight.looked_at import ENOUGH_LOOKED_AT, check_enough
from sorvolo.missions.flight.settings import check_telemetry
from sorvolo.missions.watch import alerts
from sorvolo.missions.watch.cot_sender import CotTls, check_cot
from sorvolo.paths import as_path, take_one_or_several

DEFAULT_FRAMES_PER_SECOND = 10.0
"""Frames searched a second of a recorded flight: what a camera sees for half a second only is seen five times."""

_LABEL_FORMATS = ("coco", "yolo")


@dataclass(frozen=True)
class WatchSettings:
    """What is looked for, in how many frames, and how frames are placed (`sorvolo watch`)."""

    model: str = "default"  # a name or a file
    classes: tuple[str, ...] = ()  # empty: all that the model knows
    least_score: float | None = None  # of a detection; None: each class's own, as its model has it
    frames_per_second: float | None = (
        None  # of flight; None: 10, and of a live stream as many as there is time for
    )
    offset_s: float | None = None  # telemetry time = video time + this; None: by their clocks
    ground_elevation_m: float | None = (
        None  # of the ground, in the telemetry's own height reference
    )
    height_model: str = (
        ""  # a GeoTIFF of the ground's heights, in the same reference; empty: the ground is level
    )
    through_trees: bool = False  # frames are also put together on the forest floor
    enough_looked_at: float = ENOUGH_LOOKED_AT  # share of the ground, else the result is to check

    def __post_init__(self) -> None:
        take_one_or_several(self, "classes")
        if self.least_score is not None and not 0 <= self.least_score <= 1:
            raise SettingsError(f"the least score must lie in 0 to 1, got {self.least_score}")
        if self.frames_per_second is not None and not 0.001 <= self.frames_per_second <= 1000:
            raise SettingsError(
                f"frames a second must lie in 0.001 to 1000, got {self.frames_per_second}"
            )
        check_enough(self.enough_looked_at)
        if self.height_model and self.ground_elevation_m is not None:
            raise SettingsError("give a height model or the ground's elevation, not both")
        check_telemetry(self.offset_s, self.ground_elevation_m)


@dataclass(frozen=True)
class WatchOutputs:
    """The files that a watch leaves, and whom it notifies while it runs."""

    folder: Path | None = None  # None: `<source>-watch` where the command runs
    save: Literal["none", "video", "pictures"] = "none"  # frames with what was found drawn in
    labels: tuple[
        str, ...
    ] = ()  # of "coco", "yolo": what was found, as labels to correct and train with
    cot: str = ""  # udp://host:port, tcp://host:port or tls://host:port
    cot_every_s: float = 3.0  # of one track, once it was reported
    cot_stale_s: float = 300.0
    alert_command: str = ""
    alert_url: str = ""
    cot_tls: CotTls = field(default_factory=CotTls)  # certificates for tls://
    below: Path | None = (
        None  # where `folder` is not given: each watch has a folder of its source's name in this one
    )

    def __post_init__(self) -> None:
        for name in ("folder", "below"):
            object.__setattr__(self, name, as_path(getattr(self, name)))
        take_one_or_several(self, "labels")
        check_choices(self)
        if unknown := sorted(set(self.labels) - set(_LABEL_FORMATS)):
            raise SettingsError(
                f"labels are written as {' and '.join(_LABEL_FORMATS)}, not as {unknown[0]!r}"
            )
        if not (self.cot_every_s >= 0 and self.cot_stale_s > 0):
            raise SettingsError(
                "events are sent every 0 s or more, and are stale after more than 0 s"
            )
        check_cot(self.cot, self.cot_tls)
        if self.alert_command:
            alerts.alert_command(self.alert_command)
        if self.alert_url:
            alerts.alert_url(self.alert_url)
