"""When a change is announced: what the views reported of a candidate, and the one function that decides on it."""

from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from sorvolo.errors import SettingsError
from sorvolo.geometry.arrays import Floats


class Reason(StrEnum):
    """Why a candidate is not announced, or no longer."""

    TOO_FEW_VIEWS = "too few views show it"
    UNSURE = "its score is too low"
    UNSURE_OF_FEW = "its score is too low for the few views that show it"
    SMALL_SHARE = "too few of the views from above show it"
    PASSED_BY = "most views of its ground do not show it"
    LARGE_AND_UNSURE = "it is large and its score is low, like a wall that leans"
    SHADE = "it is ground in another shade"
    LEFT_BY_MOVER = "something that moves was there"


@dataclass(frozen=True)
class Announce:
    """The candidate is a change."""

    score: float  # 0 to 1


@dataclass(frozen=True)
class Wait:
    """Not yet: more views may confirm it."""

    reason: Reason


@dataclass(frozen=True)
class Drop:
    """No view is left to confirm it: not announced, or withdrawn."""

    reason: Reason


Verdict = Announce | Wait | Drop


@dataclass(frozen=True)
class AnnounceSettings:
    """When a candidate is announced. Decisions name where a value was chosen; 0007 and later by development flights."""

    k: int = 3  # views that usually show it; with fewer it is one of few. Chosen with the evidence's votes
    least_score: float = 0.38  # 0007: half of what the trees without flights asked for
    few_views_score: float = 0.62  # 0017: two or so views of one tree often agree
    least_share: float = 0.4  # of the views of its ground, those from above counting most
    mostly_there: float = 0.45  # 0018: share of all views of its ground; fewer is something that passed by
    large_m2: float = 2.0  # 0018: from this size on ...
    large_score: float = 0.52  # 0018: ... and shorter than the flying height, a less sure one is a wall that leans
    shade_score: float = 0.6  # 0015: what is mostly shade must be surer than this
    calm_share: float = 0.9  # of the score left on calm ground: there views from aside count like those from above
    restless_half: float = 0.05  # share of views that flag the ground around for nothing: half the score is left
    doubt: float = 2.0  # 0007: restless ground counts in full where half of the score is missing
    many_views: int = 16  # 0018: that agree are no chance, whatever the ground around does
    cut_off: float = 0.5  # 0007: of the score is left where no view shows all of it, taken ...
    far_apart: float = 0.5  # ... so far from each other, in flying heights; less from nearer
    one_place: float = 0.05  # flying heights: views no wider apart see the same ghost, and count half

    def __post_init__(self) -> None:
        if not (0 <= self.least_share <= 1 and 0 <= self.least_score <= 1):
            raise SettingsError(
                f"least_share and least_score must lie in 0 to 1, got {self.least_share} and {self.least_score}"
            )


@dataclass(frozen=True)
class Look:
    """What a candidate's pictures and outline show."""

    area_m2: float
    length_m: float
    is_shade: bool  # mostly ground in another shade


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
    weight_for: float = 0.0  # sum of the weights of the views that show it ...
    weight_asked: float = 0.0  # ... and of all that saw its ground; see `upright_weight`
    score_sum: float = 0.0  # of the views that show it, 0 to 1 each
    residual_m_sum: float = 0.0  # of the views' alignment
    whole: int = 0  # views that show all of it; in the others it ends at a rim
    held: int = 0  # views in which it may move
    camera_low_m: tuple[float, float, float] = (np.inf, np.inf, np.inf)
    camera_high_m: tuple[float, float, float] = (-np.inf, -np.inf, -np.inf)
    is_single: bool = False  # one view saw its ground, and no other could
    restless: float = 0.0  # share of views that flag the ground around for nothing
    was_mover: bool = False  # something that moves was there all the while, and it is gone
    look: Look | None = None

    def with_view(self, time_ns: int, score: float, weight: float, residual_m: float, camera_m: Floats) -> "Tally":
        """One more view shows it."""
        return replace(
            self, views=self.views + 1, asked=self.asked + 1, weight_for=self.weight_for + weight,
            weight_asked=self.weight_asked + weight, score_sum=self.score_sum + score,
            residual_m_sum=self.residual_m_sum + residual_m,
            first_seen_ns=min(self.first_seen_ns, time_ns), last_seen_ns=max(self.last_seen_ns, time_ns),
            camera_low_m=_three(np.minimum(self.camera_low_m, camera_m)),
            camera_high_m=_three(np.maximum(self.camera_high_m, camera_m)),
        )

    def without_view(self, weight: float, times: int = 1) -> "Tally":
        """One more view of its ground, or several, do not show it."""
        total = self.weight_asked
        for _ in range(times):
            total += weight
        return replace(self, asked=self.asked + times, weight_asked=total)

    def recounted(self, views: int, asked: int) -> "Tally":
        """As if `views` of `asked` had shown it: what is left of it after it lost ground."""
        views, asked = max(views, 1), max(asked, views, 1)
        before = max(self.views, 1)
        return replace(
            self, views=views, asked=asked, score_sum=self.score_sum * (views / before),
            weight_for=self.weight_asked * views / asked, whole=round(self.whole * views / before),
            residual_m_sum=self.residual_m_sum * (views / before),
        )

    @property
    def share(self) -> float:
        """The weighted share of the views of its ground that show it."""
        return self.weight_for / self.weight_asked if self.weight_asked else 1.0

    @property
    def flying_height_m(self) -> float:
        """The largest of the views that show it."""
        return max(float(self.camera_high_m[2]), 1e-6)

    @property
    def heights_apart(self) -> float:
        """How far apart the views that show it were taken, in flying heights."""
        (west, south, _), (east, north, _) = self.camera_low_m, self.camera_high_m
        return float(np.hypot(east - west, north - south)) / self.flying_height_m

    def is_from_one_place(self, settings: AnnounceSettings) -> bool:
        """Whether several views show it, all from one place, as from a drone that hovers."""
        return self.views > 1 and self.heights_apart < settings.one_place


def judge(tally: Tally, settings: AnnounceSettings, *, is_over: bool) -> Verdict:
    """Whether a candidate is a change. `is_over`: no more views will come."""
    reason = _objection(tally, settings)
    if reason is None:
        return Announce(sureness(tally, settings))
    return Drop(reason) if is_over else Wait(reason)


def sureness(tally: Tally, settings: AnnounceSettings) -> float:
    """The score, 0 to 1: what the views report, less on restless ground."""
    # views agree by chance now and then; nearly all of many do not
    agree = (tally.views + 1) / (tally.asked + 2) if tally.views >= settings.many_views else 0.0
    doubt = min(1.0, settings.doubt * (1 - max(views_score(tally, settings), agree)))
    return views_score(tally, settings, _calm(tally, settings) ** doubt)


def views_score(tally: Tally, settings: AnnounceSettings, calm: float = 1.0) -> float:
    """The score before the ground around counts, times `calm`.

    The mean score of the views x (views that show it + 1) / (views of its ground + 2), which is the mean of a share
    under Bayes; half if all looked from one place; less if few show all of it, for at a rim walls lean in whole, most
    of all seen from places near each other.
    """
    if not tally.views:
        return 0.0
    single = 0.5 if tally.is_single else 1.0
    score = tally.score_sum / tally.views * (tally.views + 1) / (tally.asked + 2) * single * calm
    cut_off = settings.cut_off * min(tally.heights_apart / settings.far_apart, 1.0)
    wholeness = cut_off + (1 - cut_off) * min(2 * tally.whole / tally.views, 1.0)
    return float(np.clip(score * (0.5 if tally.is_from_one_place(settings) else 1.0) * wholeness, 0, 1))


def _objection(tally: Tally, settings: AnnounceSettings) -> Reason | None:
    """The first rule that a candidate fails."""
    score = sureness(tally, settings)
    share = tally.share
    if _calm(tally, settings) > settings.calm_share:
        # nothing tall leans over calm ground: there views from aside count as much as those from above
        share = max(share, tally.views / max(tally.asked, 1))
    if score < settings.least_score:
        return Reason.UNSURE
    if 1 < tally.views < settings.k and score < settings.few_views_score:
        return Reason.UNSURE_OF_FEW
    if share < settings.least_share:
        return Reason.SMALL_SHARE
    if tally.views < settings.mostly_there * tally.asked:
        return Reason.PASSED_BY
    if tally.was_mover:
        return Reason.LEFT_BY_MOVER
    return None if tally.look is None else _objection_to_look(tally, tally.look, score, settings)


def _objection_to_look(tally: Tally, look: Look, score: float, settings: AnnounceSettings) -> Reason | None:
    if look.is_shade and score < settings.shade_score:
        return Reason.SHADE
    may_be_a_wall = look.area_m2 >= settings.large_m2 and look.length_m < tally.flying_height_m  # snow is longer
    if may_be_a_wall and score < settings.large_score and not tally.is_from_one_place(settings):
        return Reason.LARGE_AND_UNSURE
    return None


def _calm(tally: Tally, settings: AnnounceSettings) -> float:
    """What is left of a score, 1 to 0, on ground so restless."""
    return 1 / (1 + (tally.restless / settings.restless_half) ** 2)


def _three(values: Floats) -> tuple[float, float, float]:
    east, north, up = values
    return float(east), float(north), float(up)
