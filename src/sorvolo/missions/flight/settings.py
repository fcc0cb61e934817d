"""What a person may choose for a mission; each value has its unit and a default that suits most flights."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, runtime_checkable

from sorvolo.change.compare import PairMethod
from sorvolo.errors import SettingsError
from sorvolo.geometry.geodesy import check_map_crs
from sorvolo.missions.flight.looked_at import ENOUGH_LOOKED_AT, check_enough
from sorvolo.paths import take_one_or_several

if TYPE_CHECKING:
    from sorvolo.missions.flight.map_objects import ObjectFinder
    from sorvolo.missions.flight.setup import FlightSetup
    from sorvolo.missions.map.planar_run import FlightRun
    from sorvolo.store.site.archive import Archive

_CGROUP_LIMIT = Path("/sys/fs/cgroup/memory.max")


MEMORY_SHARE = 0.25  # of the machine's memory, or of the container's limit
_ENOUGH_MB = 512.0  # more saves no time
LEAST_MB = 64.0
"""With less, a picture of 12 megapixels and the tiles below it do not fit."""
TILES_MB = 24
"""At most, for tiles: each is painted once."""
WAITING_MB = 64
"""For frames that wait for the detector, though one may always."""


def memory_budget_bytes(memory_mb: float | None) -> int:
    """Return the given budget (MB) in bytes; without one 512 MB, or a quarter of the machine's memory where that is less.

    Raises SettingsError when it is too small to work with.
    """
    if memory_mb is None:
        return int(min(1e6 * _ENOUGH_MB, MEMORY_SHARE * available_bytes()))
    if not memory_mb >= LEAST_MB:
        raise SettingsError(f"memory_mb must be at least {LEAST_MB:g} MB, got {memory_mb:g}")
    return int(memory_mb * 1e6)


def available_bytes() -> int:
    """The machine's memory, or the container's limit."""
    machine = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    try:
        limit = _CGROUP_LIMIT.read_text().strip()
    except OSError:
        return machine
    return min(machine, int(limit)) if limit.isdigit() else machine


_MOST_OFFSET_S = 86_400 * 365 * 20  # a clock that was never set begins with its maker's year


def check_telemetry(offset_s: float | None, ground_elevation_m: float | None) -> None:
    """Raise SettingsError for a clock offset, s, that no clock has, or for ground that is not on Earth."""
    if offset_s is not None and not abs(offset_s) <= _MOST_OFFSET_S:
        raise SettingsError(
            f"the clock offset (--offset) must be 20 years of seconds at most, got {offset_s}"
        )
    if not -1000 <= (ground_elevation_m or 0) <= 9000:
        raise SettingsError(
            f"--ground-elevation must lie in -1000 to 9000 m, got {ground_elevation_m}"
        )


def check_method(method: object, kind: type) -> None:
    """Raise SettingsError for what cannot map or compare; `kind` is the protocol that it would have to follow."""
    if method is not None and not isinstance(method, kind):
        raise SettingsError(
            f"method must be None or an object that is a {kind.__name__}, got {method!r}; those of the thesis are "
            "sorvolo.lab.thesis.mapping.ThesisMapping() and sorvolo.lab.thesis.changes.ThesisComparison()"
        )


@runtime_checkable
class MapMethod(Protocol):
    """Another way to map a flight than fitting all of its frames together. A frozen record of its own choices."""

    @property
    def name(self) -> str:
        """As reports name it."""

    def begin(
        self,
        setup: "FlightSetup",
        archive: "Archive",
        settings: "MapSettings",
        finder: "ObjectFinder | None",
        request: str,
    ) -> "FlightRun":
        """The run of one flight."""


@dataclass(frozen=True)
class MapSettings:
    """How a flight becomes a map (`sorvolo map`)."""

    method: MapMethod | None = None  # None: planar, all frames fitted together
    m_per_px: float | None = None  # of the map; None: the pictures' own, when the site is new
    overlap: float = 0.7  # s of eq. 3.17
    offset_s: float | None = None  # telemetry time = video time + this; None: estimated from motion
    ground_elevation_m: float | None = (
        None  # of the ground, in the telemetry's own height reference
    )
    crs: str | None = None  # of mosaic.tif; None: the site's UTM zone
    live_s: float = 3.0  # how often the growing map is made visible
    model: str = "default"  # that looks for objects: an installed one's name, a file, or "none"
    control_sigma_m: float = 0.05  # of the control points' places, horizontal
    checks: tuple[
        str, ...
    ] = ()  # control points held back to measure the map; "NAME*" for all that begin so
    memory_mb: float | None = None  # for what can be read again; None: 512 MB
    heights: bool | None = (
        None  # whether the map stands on measured heights; None: where the ground is not level
    )
    classes: tuple[str, ...] = ()  # that are looked for; none: those that the model usually reports
    enough_looked_at: float = ENOUGH_LOOKED_AT  # share of the ground, else the result is to check

    def __post_init__(self) -> None:
        take_one_or_several(self, "classes", "checks")
        check_method(self.method, MapMethod)
        check_enough(self.enough_looked_at)
        memory_budget_bytes(self.memory_mb)
        if not 1e-4 <= self.control_sigma_m <= 100:
            raise SettingsError(
                f"the control points' accuracy (--gcp-accuracy) must lie in 0.0001 to 100 m, got {self.control_sigma_m}"
            )
        if self.m_per_px is not None and not 1e-4 <= self.m_per_px <= 100:
            raise SettingsError(
                f"the ground sampling distance (--gsd) must lie in 1e-4 to 100 m, got {self.m_per_px}"
            )
        if not 0 < self.overlap < 1:
            raise SettingsError(f"overlap must lie between 0 and 1, got {self.overlap}")
        if self.crs is not None:
            check_map_crs(self.crs)
        check_telemetry(self.offset_s, self.ground_elevation_m)

    @property
    def method_name(self) -> str:
        """As reports name it."""
        return "planar" if self.method is None else self.method.name


@dataclass(frozen=True)
class CompareSettings:
    """How a later flight is compared with the map (`sorvolo compare`)."""

    method: PairMethod | None = None  # None: robust
    views_per_second: float = 5.0  # of flight: neighbouring frames of a video show the same again
    votes: int = 3  # k: views of a piece of ground that must show a change ...
    voters: int = 5  # n: ... among the last this many that saw it
    offset_s: float | None = None  # telemetry time = video time + this
    ground_elevation_m: float | None = (
        None  # of the ground, in the telemetry's own height reference
    )
    updates_map: bool = True  # make a new version of the map where the ground changed or is new
    writes_masks: bool = False
    trusts_map: bool = False  # also a map that contradicts itself
    model: str = "default"  # that looks for objects: an installed one's name, a file, or "none"
    classes: tuple[str, ...] = ()  # that are looked for; none: those that the model usually reports
    enough_looked_at: float = ENOUGH_LOOKED_AT  # share of the ground, else the result is to check

    def __post_init__(self) -> None:
        take_one_or_several(self, "classes")
        check_method(self.method, PairMethod)
        check_enough(self.enough_looked_at)
        if not 0.05 <= self.views_per_second <= 240:
            raise SettingsError(
                f"views per second must lie in 0.05 to 240, got {self.views_per_second}"
            )
        if not 1 <= self.votes <= self.voters <= 8:
            raise SettingsError(
                f"a change needs {self.votes} of the last {self.voters} views: the first must not exceed the second, "
                "and both lie in 1 to 8"
            )
        check_telemetry(self.offset_s, self.ground_elevation_m)

    @property
    def method_name(self) -> str:
        """As reports name it."""
        return "robust" if self.method is None else self.method.name

    @property
    def mapping(self) -> MapSettings:
        """How frames that show new ground are mapped."""
        return MapSettings(
            offset_s=self.offset_s,
            ground_elevation_m=self.ground_elevation_m,
            model=self.model,
            classes=self.classes,
        )
