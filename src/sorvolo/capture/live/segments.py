"""A live flight that an earlier process had read: what it knew, so that the flight goes on as another segment."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sorvolo.geometry.arrays import Floats, TimesNs
from sorvolo.survey.flight import TELEMETRY_COLUMNS, CameraModel, Notice


@dataclass(frozen=True, eq=False)
class FlightBegun:
    """How a live flight began, and the pauses between its segments so far."""

    name: str
    fingerprint: str
    start_ns: int
    start_origin: str
    camera: CameraModel
    gaps_s: tuple[float, ...] = ()


@dataclass(frozen=True, eq=False, kw_only=True)
class FlightSoFar(FlightBegun):
    """What was known of a live flight when it was last read.

    `samples` (N, columns of `TELEMETRY_COLUMNS`) with their times are its telemetry. `last_ns` is the UTC of its last
    frame, `names` are those of its frames.
    """

    next_index: int
    last_ns: int
    names: frozenset[str]
    times_ns: TimesNs
    samples: Floats


def joined_samples(parts: Sequence[tuple[TimesNs, Floats]]) -> tuple[TimesNs, Floats]:
    """Times (N,) and samples (N, columns of `TELEMETRY_COLUMNS`) that were noted in parts, in one piece.

    Raises ValueError where a part has other columns.
    """
    columns = len(TELEMETRY_COLUMNS)
    times_ns = np.concatenate([np.zeros(0, np.int64), *(each for each, _ in parts)])
    return times_ns, np.concatenate(
        [np.zeros((0, columns)), *(each.reshape(-1, columns) for _, each in parts)]
    )


def segment_notices(gaps_s: Sequence[float]) -> tuple[Notice, ...]:
    """That a flight was read in several segments, with the pauses between them."""
    if not gaps_s:
        return ()
    text = (
        f"the flight was read in {len(gaps_s) + 1} segments: {sum(gaps_s):.1f} s between them are missing, the longest "
        f"gap {max(gaps_s):.1f} s"
    )
    return (Notice("segments", len(gaps_s) + 1, text),)
