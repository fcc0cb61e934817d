"""When a change is announced: what the views reported of a candidate, and the one function that decides on it."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from sorvolo.geometry.arrays import Floats


class Objection(StrEnum):
    """Why a candidate is not announced, or no longer."""

    TOO_FEW_VIEWS = "too few views show it"
    UNSURE = "its score is too low"
    LARGE_AND_UNSURE = "it is large and its score is low, like a wall that leans"
    MOVES = "most views that show it show something that moves"


# When a candidate is announced.
LEAST_SCORE = 0.38  # half the threshold of trees that were not trained on flights
_LARGE_M2 = 2.0  # from this size on ...
_LARGE_SCORE = 0.52  # ... and shorter than the flying height, a less sure one is a wall that leans
# false-alarm rate nearby that halves the score
_RESTLESS_HALF = 0.05
_DOUBT = 2.0  # restless ground counts in full where half of the score is missing
_CUT_OFF = 0.5  # of the score is left where no view shows all of it
_ONE_PLACE = 0.05  # flying heights: views closer together share a parallax error; they count half


@dataclass(frozen=True)
class Look:
    """What a candidate's outline shows."""

    area_m2: float
    length_m: float


@dataclass(frozen=True)
class Tally:
    """What the views reported of one candidate; every view that saw its ground counts once.

    `look` is None until the pictures were measured: then only what the views report is judged. Camera places are the
    corners (east, north, up in site metres) of the box around those that show it.
    """

    first_seen_ns: int
    last_seen_ns: int
    views: int = 0  # that show it
    asked: int = 0  # that saw its ground
    score_sum: float = 0.0  # of the views that show it, 0 to 1 each
    residual_m_sum: float = 0.0  # of the views' alignment
    whole: int = 0  # views that show all of it; in the others it ends at a rim
    camera_low_m: tuple[float, float, float] = (np.inf, np.inf, np.inf)
    camera_high_m: tuple[float, float, float] = (-np.inf, -np.inf, -np.inf)
    restless: float = 0.0  # false-alarm rate nearby
    moved: int = 0  # views that were taken out, since what moves shows in them
    look: Look | None = None

    def with_view(self, time_ns: int, score: float, residual_m: float, camera_m: Floats) -> "Tally":
        """One more view shows it."""
        return replace(
            self,
            views=self.views + 1,
            asked=self.asked + 1,
            score_sum=self.score_sum + score,
            residual_m_sum=self.residual_m_sum + residual_m,
            first_seen_ns=min(self.first_seen_ns, time_ns),
            last_seen_ns=max(self.last_seen_ns, time_ns),
            camera_low_m=_three(np.minimum(self.camera_low_m, camera_m)),
            camera_high_m=_three(np.maximum(self.camera_high_m, camera_m)),
        )

    def less(self, others: Iterable["Tally"]) -> "Tally":
        """Without the views that others hold, which are a part of these."""
        taken = list(others)
        if not taken:
            return self
        views, whole = (sum(getattr(each, name) for each in taken) for name in ("views", "whole"))
        left = max(self.views - views, 0)
        return replace(
            self,
            views=left,
            asked=max(self.asked - views, left),
            whole=min(max(self.whole - whole, 0), left),
            score_sum=max(self.score_sum - sum(each.score_sum for each in taken), 0.0),
            residual_m_sum=max(
                self.residual_m_sum - sum(each.residual_m_sum for each in taken), 0.0
            ),
            moved=self.views - left,
        )

    def without_view(self, times: int = 1) -> "Tally":
        """One more view of its ground, or several, do not show it."""
        return replace(self, asked=self.asked + times)

    def recounted(self, views: int, asked: int) -> "Tally":
        """As if `views` of `asked` had shown it: what is left of it after it lost ground."""
        views, asked = max(views, 1), max(asked, views, 1)
        part = views / max(self.views, 1)
        return replace(
            self,
            views=views,
            asked=asked,
            score_sum=self.score_sum * part,
            whole=round(self.whole * part),
            residual_m_sum=self.residual_m_sum * part,
        )

    @property
    def flying_height_m(self) -> float:
        """The largest of the views that show it."""
        return max(float(self.camera_high_m[2]), 1e-6)

    @property
    def heights_apart(self) -> float:
        """How far apart the views that show it were taken, in flying heights."""
        (west, south, _), (east, north, _) = self.camera_low_m, self.camera_high_m
        return float(np.hypot(east - west, north - south)) / self.flying_height_m

    def is_from_one_place(self) -> bool:
        """Whether several views show it, all from one place, as from a drone that hovers."""
        return self.views > 1 and self.heights_apart < _ONE_PLACE


def judge(tally: Tally) -> Objection | None:
    """Why a candidate is no change, as far as it was seen; None where it is one, as sure as `sureness` has it."""
    score, look = sureness(tally), tally.look
    if score < LEAST_SCORE:
        return Objection.MOVES if tally.moved > tally.views else Objection.UNSURE
    if look is None or score >= _LARGE_SCORE or tally.is_from_one_place():
        return None
    # a wall that leans is large; snow is longer than the flying height
    may_be_a_wall = look.area_m2 >= _LARGE_M2 and look.length_m < tally.flying_height_m
    return Objection.LARGE_AND_UNSURE if may_be_a_wall else None


def sureness(tally: Tally) -> float:
    """The score, 0 to 1: what the views report, less on restless ground."""
    calm = 1 / (1 + (tally.restless / _RESTLESS_HALF) ** 2)
    doubt = min(1.0, _DOUBT * (1 - views_score(tally)))
    return views_score(tally, calm**doubt)


def views_score(tally: Tally, calm: float = 1.0) -> float:
    """The score before the ground around counts, times `calm`.

    The mean score of the views x (views that show it + 1) / (views of its ground + 2), which is the mean of a share
    under Bayes; half if all looked from one place; less if few show all of it, for at a rim walls lean in whole.
    """
    if not tally.views:
        return 0.0
    score = tally.score_sum / tally.views * (tally.views + 1) / (tally.asked + 2) * calm
    wholeness = _CUT_OFF + (1 - _CUT_OFF) * min(2 * tally.whole / tally.views, 1.0)
    return float(np.clip(score * (0.5 if tally.is_from_one_place() else 1.0) * wholeness, 0, 1))


def _three(values: Floats) -> tuple[float, float, float]:
    east, north, up = values
    return float(east), float(north), float(up)
