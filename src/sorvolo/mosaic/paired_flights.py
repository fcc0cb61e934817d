"""The frames of a map's flights beside the same frames of the truth."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sorvolo.geometry.arrays import Matrix3
from sorvolo.geometry.homography import apply_homography, fit_similarity
from sorvolo.survey.mosaic import FrameRow, Status

_NOT_PLACED = {"not-aligned", "outside", "lost", Status.REJECTED.value}
_SAME_FLIGHT_NS = 60 * 10**9  # clocks differ, flights lie hours apart


def true_names(
    frames: Mapping[str, Sequence[FrameRow]], true_frames: Mapping[str, Mapping[str, FrameRow]]
) -> dict[str, str]:
    """Flights of a map -> the same flights in the truth, by their names, else by frames of one name and one minute.

    Photos are mapped under their folder's name, which the truth does not know. Flights without a partner are left out.
    """
    named = {name: name for name in frames if name in true_frames}
    for name in frames.keys() - named.keys():
        alike = {
            true: sum(
                row.name in rows and abs(row.time_ns - rows[row.name].time_ns) < _SAME_FLIGHT_NS
                for row in frames[name]
            )
            for true, rows in true_frames.items()
            if true not in named.values()
        }
        best = max(alike, key=alike.__getitem__, default="")
        if best and alike[best]:
            named[name] = best
    return named


@dataclass(frozen=True, eq=False)
class PairedFlights:
    """The frames of the site's flights and of the truth's, and which are the same."""

    mine: Mapping[str, Sequence[FrameRow]]
    true: Mapping[str, Mapping[str, FrameRow]]
    names: Mapping[str, str]

    def true_name(self, name: str) -> str:
        """The truth's name of one of the site's flights; "" where the truth does not know it."""
        return self.names.get(name, "")

    def placed(self, names: Sequence[str]) -> list[tuple[str, FrameRow]]:
        """The frames of these flights that lie somewhere, with their flights."""
        return [
            (name, row)
            for name in names
            for row in self.mine.get(name, ())
            if row.status not in _NOT_PLACED and row.has_outline
        ]

    def clock(self, name: str) -> tuple[int, int]:
        """When the flight ended by its own clock, and how far that is behind the truth's: logs may have no date."""
        true = self.true[self.names[name]]
        behind_ns = [
            true[row.name].time_ns - row.time_ns for row in self.mine[name] if row.name in true
        ]
        return max((row.time_ns for row in self.mine[name]), default=0), int(
            np.median(behind_ns)
        ) if behind_ns else 0

    def map_from_truth(self, names: Sequence[str]) -> tuple[Matrix3, float]:
        """The similarity that takes true places to where these flights lie; the rms of what it moves, NaN if none."""
        pairs = [
            (row.outline_m, self.true[self.names[name]][row.name].outline_m)
            for name, row in self.placed(names)
            if name in self.names and row.name in self.true[self.names[name]]
        ]
        pairs = [pair for pair in pairs if np.isfinite(pair).all()]
        if not pairs:
            return np.eye(3), math.nan
        mine_m, true_m = (np.concatenate(side) for side in zip(*pairs))
        matrix = fit_similarity(mine_m, true_m)
        moved_m = apply_homography(matrix, true_m) - true_m
        return matrix, float(np.sqrt((moved_m**2).sum(axis=1).mean()))
