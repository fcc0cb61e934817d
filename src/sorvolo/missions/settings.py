"""What a person may choose for a mission; each value has its unit and a default that suits most flights."""

from dataclasses import dataclass
from typing import Literal

from sorvolo.errors import SettingsError
from sorvolo.geometry.geodesy import check_map_crs


@dataclass(frozen=True)
class MapSettings:
    """How a flight becomes a map (`sorvolo map`)."""

    method: Literal["planar", "thesis"] = "planar"
    m_per_px: float | None = None  # of the map; None: the pictures' own, when the site is new
    overlap: float = 0.7  # s of eq. 3.17
    offset_s: float | None = None  # telemetry time = video time + this; None: estimated from motion
    ground_elevation_m: float | None = None  # of the ground, in the telemetry's own height reference
    crs: str | None = None  # of mosaic.tif; None: the site's UTM zone
    transform: Literal["similarity", "homography"] = "similarity"  # of method thesis (its Figure 3.12)
    live_s: float = 3.0  # how often the growing map is made visible

    def __post_init__(self) -> None:
        if self.method not in ("planar", "thesis"):
            raise SettingsError(f"method must be planar or thesis, got {self.method!r}")
        if self.m_per_px is not None and not 1e-4 <= self.m_per_px <= 100:
            raise SettingsError(f"the ground sampling distance must lie in 0.0001 to 100 m, got {self.m_per_px}")
        if not 0 < self.overlap < 1:
            raise SettingsError(f"overlap must lie between 0 and 1, got {self.overlap}")
        if self.crs is not None:
            check_map_crs(self.crs)
        if self.offset_s is not None and not abs(self.offset_s) <= 86_400 * 365:
            raise SettingsError(f"the clock offset must be a number of seconds, got {self.offset_s}")
