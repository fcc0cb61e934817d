"""Which ground a comparison could speak about, and what kept it from the rest."""

from dataclasses import dataclass
from enum import StrEnum

from sorvolo.geometry.arrays import PointsM


class Gap(StrEnum):
    """Why ground under a flight's views was not compared."""

    NO_MAP = "no-map"  # the map does not show it
    REJECTED = "view-rejected"  # its views were not aligned, or nearly all of them differs; `why` has the reason
    DARK = "dark"  # too dark on either date
    LEANING = "leaning"  # earlier pictures contradict the map there: crowns and walls that lean
    BLURRED = "blurred"  # its views are blurred
    ONE_VIEW = "one-view"  # seen in one view only, too few to announce a change
    # most of its views differ from the map, and no change is reported there
    UNEXPLAINED = "unexplained"
    INSENSITIVE = "insensitive"  # test objects that were drawn there were not found


GAP_WORDS = {
    Gap.NO_MAP: "the map does not show it",
    Gap.REJECTED: "its views could not be compared",
    Gap.DARK: "black shadow or night on one of the dates",
    Gap.LEANING: "crowns or walls lean there: earlier pictures contradict the map",
    Gap.BLURRED: "its views are blurred",
    Gap.ONE_VIEW: "seen in one view only, too few to announce a change",
    Gap.UNEXPLAINED: "it differs from the map, and none of the reported changes is why",
    Gap.INSENSITIVE: "test objects drawn into its views were not found",
}
"""Each reason in words."""


@dataclass(frozen=True, eq=False)
class CoveredGround:
    """Ground that was treated alike: polygons (outline, then holes; (N, 2) site metres each).

    `gap` is None where it was compared; then `smallest_m` and `faint_m` are the sizes from which a plain and a faint
    thing are found, NaN where not known. `why` is the reason of a rejected view.
    """

    polygons: tuple[tuple[PointsM, ...], ...]
    area_m2: float
    gap: Gap | None
    why: str
    smallest_m: float
    faint_m: float


@dataclass(frozen=True, eq=False)
class SeenGround:
    """Ground that a flight's pictures show alike: polygons (outline, then holes; (N, 2) site metres each).

    `views` is how many pictures show it at least; 0: a hole, which none shows though it lies in the area that was asked
    for, or amid what was seen. `m_per_px` is the median of the finest picture's resolution there, NaN for a hole.
    """

    polygons: tuple[tuple[PointsM, ...], ...]
    area_m2: float
    views: int
    m_per_px: float
