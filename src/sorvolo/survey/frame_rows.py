"""One frame as a map's or a truth's frames.geojson has it."""

from dataclasses import dataclass

from sorvolo.geometry.arrays import Floats
from sorvolo.geometry.level_ground import is_on_ground


@dataclass(frozen=True, eq=False)
class FrameRow:
    """One frame of a frames.geojson, map or truth, in site metres; NaN where the file has nothing."""

    name: str
    status: str
    outline_m: Floats  # (4, 2)
    camera_m: Floats  # (2,)
    camera_height_m: float
    fix_m: Floats  # (2,)
    time_ns: int  # UTC; 0 where the file has none

    @property
    def has_outline(self) -> bool:
        """Whether the outline is known."""
        return is_on_ground(self.outline_m)

    @property
    def has_camera(self) -> bool:
        """Whether the camera's place is known."""
        return is_on_ground(self.camera_m)

    @property
    def has_fix(self) -> bool:
        """Whether the fix is known."""
        return is_on_ground(self.fix_m)
