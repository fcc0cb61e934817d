"""What a comparison adds to a flight's report: views counted, changes counted, warnings."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np

from sorvolo.change.coverage import (
    GroundCoverage,
    coverage_summary,
)
from sorvolo.change.flight_on_map import FlightFit
from sorvolo.change.planting import recall_curve
from sorvolo.change.views import ViewMaker, ViewOutcome
from sorvolo.findings.importance import in_short
from sorvolo.geometry.arrays import PointsM
from sorvolo.geometry.summary import median_of_known, percentile_of_known
from sorvolo.heights.volumes import height_changes
from sorvolo.missions.compare.extension import NIGHT
from sorvolo.missions.flight.settings import CompareSettings
from sorvolo.missions.heights.measure import flight_with_heights, own_surface, read_field
from sorvolo.mosaic.selection import evenly
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.files import HeightFile
from sorvolo.survey.coverage import CoveredGround, Gap
from sorvolo.survey.findings import Change, ChangeKind, ViewStatus
from sorvolo.survey.flight import Notice
from sorvolo.survey.mosaic import PlacedFrame
from sorvolo.survey.wording import area_text, counted, plural

_SAMPLED = 100  # frames, whose middle is looked for in their neighbours
_DARK = 0.4  # times the map's brightness: less hides things
_ALL_OVER = 0.1  # share of the compared ground: a day without changes has 0.01, other leaves 0.13, half snow 0.4
_OTHER_GROUND = 0.5  # share of the compared ground that areas cover: more is no list of changes
_MANY_GONE = 0.1  # share of the map's key frames: their ground is compared with the mosaic alone
_COARSE = 3.0  # times the flight's pixels: a map with larger ones hides what the flight shows


class ViewCounts:
    """How a flight's frames ended and what ground they compared, as they come. Only `end` and `take` change it."""

    def __init__(self) -> None:
        self.ground = GroundCoverage()
        self._statuses: Counter[ViewStatus] = Counter()
        self._reasons: Counter[str] = Counter()
        self._residuals_px: list[float] = []
        self._differing: list[float] = []
        self._local_m: list[float] = []
        self.with_flight = 0
        self.left_out = 0

    def end(self, status: ViewStatus, reason: str) -> None:
        """Count a frame that ended so."""
        self._statuses[status] += 1
        if reason:
            self._reasons[reason] += 1

    def take(self, outcome: ViewOutcome, outline_m: PointsM | None) -> None:
        """Count a frame's comparison; `outline_m` (4, 2) is the ground under it, None where unknown."""
        self.end(outcome.status, outcome.reason)
        if outcome.site_from_image is not None:
            self._residuals_px.append(outcome.residual_px)
        self.with_flight += outcome.with_flight
        if outcome.local_m > 0:
            self._local_m.append(outcome.local_m)
        if outcome.view is not None:
            is_dark = outcome.brightness < NIGHT
            self._differing.append(outcome.view.changed_share)
            self.ground.compare(
                outcome.view, is_dark=is_dark, doubted=outcome.doubted, planted=outcome.planted
            )
        else:
            gap = Gap.NO_MAP if outcome.status is ViewStatus.OUTSIDE else Gap.REJECTED
            self.ground.reject(outline_m, gap, outcome.reason.partition(":")[0])

    def __getitem__(self, status: ViewStatus) -> int:
        return self._statuses[status]

    @property
    def total(self) -> int:
        """Frames that ended so far, lost ones included."""
        return self._statuses.total()

    @property
    def differing_share(self) -> float:
        """The share of a view's compared ground that differs, announced or not: the median over the views."""
        return median_of_known(self._differing) or 0.0

    @property
    def commonest_reason(self) -> str:
        """Why most frames could not be compared, in words."""
        return self._reasons.most_common(1)[0][0] if self._reasons else "there is none"

    def summary(self) -> dict[str, Any]:
        """The counts as the report has them."""
        return {
            "views": {status.value: self._statuses[status] for status in ViewStatus},
            "reasons": dict(self._reasons.most_common()),
            "differing_share": self.differing_share,
            "residual_px": {
                "median": median_of_known(self._residuals_px),
                "p95": percentile_of_known(self._residuals_px, 95),
            },
            "local_fit": {
                "views": len(self._local_m),
                "median_m": median_of_known(self._local_m),
                "p95_m": percentile_of_known(self._local_m, 95),
            },
        }


def comparison_summary(
    changes: Sequence[Change],
    suppressed: int,
    counts: ViewCounts,
    views: ViewMaker,
    settings: CompareSettings,
    base_version: int,
    ground: Sequence[CoveredGround],
    *,
    is_local: bool,
    doubt: str,
) -> dict[str, Any]:
    """The report's part on the comparison; specified in docs/formats.md. `suppressed` changes were not reported: a
    person rejected them on an earlier flight. `doubt`: see `map_doubt`."""
    kinds = Counter(each.kind for each in changes)
    coverage = coverage_summary(ground, counts.ground.unplaced, counts.ground.planted)
    areas_m2 = sum(each.area_m2 for each in changes if each.kind is ChangeKind.AREA)
    coverage["other_ground_m2"] = min(areas_m2, coverage["compared_m2"])
    return {
        "against_version": base_version,
        "method": settings.method_name,
        **counts.summary(),
        "changes": {kind.value: kinds[kind] for kind in ChangeKind},
        "in_short": in_short(changes, is_local=is_local),
        "single_view": sum(each.is_single_view for each in changes),
        "suppressed": suppressed,
        "compared_area_m2": coverage["compared_m2"],
        "headline": comparison_headline(len(changes), coverage, doubt, is_local=is_local),
        "coverage": coverage | {"planted": recall_curve(counts.ground.planted)},
        "unknown_share": counts.ground.unknown_share,
        "votes": settings.votes,
        "voters": settings.voters,
        "chosen": views.measured(),
        "map_updated": settings.updates_map,
        "most_missed": views.brightness < NIGHT,
    }


def flight_summary(counts: ViewCounts, fit: FlightFit | None) -> dict[str, Any]:
    """The report's part on photos that were placed with all others of their flight; `fit` is where that lies on the
    map, None where it was not looked for, or not found: then none was."""
    return {
        "views": counts.with_flight,
        "left_out": counts.left_out,
        "ratio": None if fit is None else fit.ratio,
        "residual_m": None if fit is None else fit.residual_m,
    }


def flight_notices(counts: ViewCounts, fit: FlightFit | None) -> list[Notice]:
    """What a user should know of photos that were placed with all others of their flight."""
    if fit is None or not counts.with_flight:
        return []
    text = (
        f"{counts.with_flight} pictures were not found on the map for sure by themselves and lie where all pictures of "
        f"the flight together fit it, within {max(fit.residual_m, 0.1):.1f} m (median)"
    )
    return [Notice("placed_with_flight", counts.with_flight, text)]


def views_notices(placed: Sequence[PlacedFrame], votes: int) -> list[Notice]:
    """What a user should know where most ground is in fewer views than must show a change."""
    outlines = [each.outline_m for each in placed if np.isfinite(each.outline_m).all()]
    if len(outlines) < 2:
        return []
    seen = []
    for number in evenly(len(outlines), _SAMPLED):
        x, y = outlines[number].mean(axis=0).tolist()
        near = outlines[max(0, number - 2 * votes) : number + 2 * votes + 1]
        inside = [
            cv2.pointPolygonTest(each.astype(np.float32)[:, None], (x, y), False) for each in near
        ]
        seen.append(sum(each >= 0 for each in inside))
    usual = int(np.median(seen))
    if usual >= votes:
        return []
    text = (
        f"most ground is in {counted(usual, 'compared view')}, and {votes} must show a change: fly slower or take more "
        f"pictures, or use --votes {usual}, which reports more false changes"
    )
    return [Notice("few_views", usual, text)]


def map_doubt(archive: Archive, flown_ns: int, base_version: int) -> str:
    """Why nothing that was flown then can be compared well with a version of the map; "" where it can."""
    versions = [each for each in archive.versions() if each.id <= base_version]
    if any(0 < flown_ns < each.flown_ns for each in versions):
        return "it was flown before the map, so that what appeared had left and the reverse (or a clock is wrong)"
    gone = sum(each.count for each in archive.notices if each.code == "damaged_keyframes")
    keyframes = len(archive.keyframes())
    if gone > _MANY_GONE * keyframes:
        return f"{gone} of the map's {keyframes} key frames are damaged or gone"
    return ""


def comparison_headline(
    changes: int, coverage: Mapping[str, Any], doubt: str = "", *, is_local: bool
) -> dict[str, str]:
    """The first line of a comparison: its `quality`, "compared" or "doubtful", and its `text`.

    It is doubtful when most of the ground under the views that the map shows could not be compared, or is other ground
    now: then the number of changes proves nothing about the site; or for a `doubt` about the map. `coverage` is that of
    the report.
    """
    compared, missing = (
        area_text(coverage[name], is_local=is_local) for name in ("compared_m2", "not_compared_m2")
    )
    found = (
        f"{changes:,} {plural('change', changes)} in {compared}; {missing} could not be compared"
    )
    if not doubt and not coverage["is_enough"]:
        doubt = "most of the ground could not be compared"
    elif not doubt and coverage["other_ground_m2"] > _OTHER_GROUND * coverage["compared_m2"]:
        doubt = "most of the ground surface changed (snow, water, ploughing?), and objects on it may be missed"
    if not doubt:
        return {"quality": "compared", "text": found}
    return {"quality": "doubtful", "text": f"not to be relied on, {doubt}: {found}"}


def comparison_warnings(counts: ViewCounts, brightness: float, times_coarser: float) -> list[str]:
    """What makes this comparison show less than a user would expect of it; `brightness` is in times the map's, and the
    map's pixels are `times_coarser` than the flight's (NaN: not known)."""
    return [*_light_and_size_warnings(brightness, times_coarser), *_ground_warnings(counts)]


def _light_and_size_warnings(brightness: float, times_coarser: float) -> list[str]:
    warnings = []
    if brightness < NIGHT:
        warnings.append(
            f"the flight is {brightness:.2f} times as bright as the map: most changes are missed, so that finding "
            "none means little, and new ground is not added to the map; compare flights by daylight"
        )
    elif brightness < _DARK or brightness > 1 / _DARK:
        warnings.append(
            f"the flight is {brightness:.2f} times as bright as the map: changes that are small, dark or of the "
            "ground's colour are missed; compare flights by daylight"
        )
    if times_coarser > _COARSE:
        warnings.append(
            f"the map's pixels are {times_coarser:.0f} times as large as the flight's: only what is large on the map "
            "is compared, and finding nothing means little for the rest; compare with a map as fine as the flight"
        )
    return warnings


def _ground_warnings(counts: ViewCounts) -> list[str]:
    warnings = []
    views = max(1, counts.total)
    if counts[ViewStatus.OUTSIDE] == counts.total - counts[ViewStatus.LOST]:
        warnings.append(
            f"none of {counts.total} views lies on the map, which grew beside what it showed: if the flight was over "
            "the same ground, its telemetry is metres off; `sorvolo history` has the map from before"
        )
    unmatched = counts[ViewStatus.NOT_ALIGNED] + counts[ViewStatus.LOST]
    if unmatched > 0.3 * views:
        warnings.append(
            f"{unmatched} of {views} views could not be matched with the map; `reasons` lists why"
        )
    all_changed = counts[ViewStatus.ALL_CHANGED]
    if all_changed > 0.1 * views:
        warnings.append(
            f"{all_changed} of {views} views look changed all over (water, snow, ploughing?) and were left out: fly "
            "again when that is gone, or map the site anew"
        )
    if counts.differing_share > _ALL_OVER:
        warnings.append(
            f"{counts.differing_share:.0%} of the compared ground looks changed (snow, water, another season?): some "
            "of the listed changes may be the ground's own, and things may be missed among them; compare with a map of "
            "the same season"
        )
    return warnings


def with_height_changes(
    archive: Archive, flight_id: str, changes: Sequence[Change]
) -> tuple[list[Change], list[Notice]]:
    """The changes of a flight, its areas with their height change: between the newest heights of another flight and
    the flight's own, which it has if it was mapped with heights before it was compared. A notice names areas that have
    none though both flights have heights."""
    areas = [each for each in changes if each.kind is ChangeKind.AREA]
    before = flight_with_heights(archive, but=flight_id)
    later = own_surface(archive, flight_id) if areas and before is not None else None
    if before is None or later is None:
        return list(changes), []
    earlier = read_field(archive, before, HeightFile.SURFACE)
    found = height_changes(
        earlier, later, [each.outline_m for each in areas], [each.outline_m for each in changes]
    )
    risen = dict(zip((each.id for each in areas), found))
    missing = sum(each is None for each in found)
    notices = (
        []
        if not missing
        else [
            Notice(
                "no_height_change",
                missing,
                f"{missing} of {len(found)} changed areas have no height change: half of their ground has no heights on one of "
                "the dates (water, smooth or dark ground), or too little ground beside them stayed to tie both flights",
            )
        ]
    )
    return [replace(each, height_change=risen.get(each.id)) for each in changes], notices
