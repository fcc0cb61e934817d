"""What was wrong with a flight's telemetry, in sentences."""

from collections.abc import Sequence
from math import isfinite
from statistics import median

from sorvolo.survey.corrected import Bias, PathFit, TelemetryFaults
from sorvolo.survey.wording import counted

_LEAST = {
    "clock": 0.04,
    "heading": 0.5,
    "tilt": 0.5,
    "height": 0.3,
}  # s, deg, deg, m: smaller errors are not reported
_NOT_KNOWN = {"clock": 1.0, "heading": 10.0, "height": 10.0}
"""s (10 m of flight, or less), deg, m: right within more than this is no knowledge; by choice."""
_TOO_FEW = "too few frames have a fix"
_MOST_NAMED = 6  # frames in a sentence


def fault_sentences(faults: TelemetryFaults, names: Sequence[str]) -> list[str]:
    """One sentence for each quantity that telemetry states; `names` are those of the compared frames."""
    return [
        *_clock(faults.clock_s),
        *_heading(faults.heading_deg, faults.path),
        *_outlying(faults, names),
        *_misplaced(faults, names),
        *_tilt(faults.tilt_deg),
        *_height(faults.height_m, faults.path),
        *_map(faults.path),
        f"fixes scatter by {faults.position_m.scatter:.2f} m about the path in the pictures (1 sigma per axis)",
    ]


def _clock(found: Bias) -> list[str]:
    if not isfinite(found.value):
        return ["the clocks cannot be compared: the motion does not show an offset"]
    if _is_unknown(found, "clock"):
        return [
            "whether the clocks agree cannot be known: the flight turns too little to show an offset"
        ]
    if abs(found.value) < _LEAST["clock"] or not found.is_significant:
        return [f"the clocks agree within {_within(found, 0.01):.2f} s"]
    side = "ahead of" if found.value > 0 else "behind"
    return [
        f"the telemetry's clock was {abs(found.value):.2f} s {side} the pictures (1 sigma {found.sigma:.2f} s)"
    ]


def _heading(found: Bias, path: PathFit) -> list[str]:
    if not isfinite(found.value):
        return ["telemetry has no heading to compare"]
    if _is_unknown(found, "heading"):
        return [f"whether the compass was right cannot be known: {_why_unknown(path)}"]
    if abs(found.value) < _LEAST["heading"] or not found.is_significant:
        return [f"the compass was right within {_within(found, 0.1):.1f} deg"]
    side = "clockwise" if found.value > 0 else "counter-clockwise"
    return [
        f"the compass was {abs(found.value):.1f} deg off, too far {side} (1 sigma {found.sigma:.1f} deg; scatter "
        f"{found.scatter:.1f} deg)"
    ]


def _why_unknown(path: PathFit) -> str:
    if not isfinite(path.turn_deg.value):
        return _TOO_FEW
    if 2 * path.turn_deg.sigma > _NOT_KNOWN["heading"]:
        return f"the GPS track is too short for its scatter (its direction: 1 sigma {path.turn_deg.sigma:.0f} deg)"
    return "the frames' angles disagree with each other"


def _map(path: PathFit) -> list[str]:
    """What the corrected files were changed by against the map."""
    found = []
    if path.sure_scale != 1:
        found.append(f"{1 / path.sure_scale:.2f} times as large as its GPS track")
    if path.sure_turn_deg:
        side = "clockwise" if path.sure_turn_deg > 0 else "counter-clockwise"
        found.append(
            f"turned by {abs(path.sure_turn_deg):.1f} deg {side} against {'it' if found else 'its GPS track'} (1 sigma "
            f"{path.turn_deg.sigma:.1f} deg)"
        )
    return (
        [f"the map is {' and '.join(found)}: the corrected cameras follow the track"]
        if found
        else []
    )


def _outlying(faults: TelemetryFaults, names: Sequence[str]) -> list[str]:
    if not faults.outlying:
        return []
    return [
        f"the stated angles of {counted(len(faults.outlying), 'frame')} of {len(names)} are far beside the others', by "
        f"{faults.outlying_deg:.0f} deg in the median, so that places by telemetry alone are wrong there: "
        f"{_named(faults.outlying, names)}"
    ]


def _misplaced(faults: TelemetryFaults, names: Sequence[str]) -> list[str]:
    """Where the map itself is doubtful."""
    found = []
    if faults.misplaced:
        found.append(
            f"the map is doubtful at {counted(len(faults.misplaced), 'frame')} of {len(names)}, where the log "
            f"contradicts both places (by {median(faults.misplaced_m):.1f} m in the median) and angles; the corrected "
            f"cameras follow the log there: {_named(faults.misplaced, names)}"
        )
    if faults.apart:
        found.append(
            f"at {counted(len(faults.apart), 'frame')} of {len(names)} the map or the log is wrong, "
            f"{median(faults.apart_m):.1f} m apart in the median; the corrected cameras follow the map, with that as "
            f"their accuracy: {_named(faults.apart, names)}"
        )
    return found


def _named(rows: Sequence[int], names: Sequence[str]) -> str:
    """Which frames these are, the first of them by name."""
    more = f" and {len(rows) - _MOST_NAMED} more" if len(rows) > _MOST_NAMED else ""
    return f"{', '.join(names[row] for row in rows[:_MOST_NAMED])}{more}"


def _tilt(found: Bias) -> list[str]:
    if not isfinite(found.value) or found.value < _LEAST["tilt"] or not found.is_significant:
        return []
    return [
        f"the camera looked {found.value:.1f} deg beside where telemetry puts it (1 sigma {found.sigma:.1f} deg)"
    ]


def _height(found: Bias, path: PathFit) -> list[str]:
    if not isfinite(found.value):
        return ["telemetry has no height above the ground to compare"]
    if _is_unknown(found, "height"):
        why = (
            "the GPS track is too short for its scatter" if isfinite(path.scale.value) else _TOO_FEW
        )
        return [f"whether heights above the ground were right cannot be known: {why}"]
    if abs(found.value) < _LEAST["height"] or not found.is_significant:
        return [f"heights above the ground were right within {_within(found, 0.1):.1f} m"]
    side = "too high" if found.value > 0 else "too low"
    return [
        f"heights above the ground were {abs(found.value):.1f} m {side} (1 sigma {found.sigma:.1f} m)"
    ]


def _is_unknown(found: Bias, what: str) -> bool:
    """Whether an error could be so large that "right within" would mislead; one that surely is an error is known."""
    return not 2 * found.sigma <= _NOT_KNOWN[what] and not (
        isfinite(found.sigma) and found.is_significant
    )


def _within(found: Bias, least: float) -> float:
    """What an error that is not significant hardly exceeds (2 sigma)."""
    return max(abs(found.value) + 2 * found.sigma, least)
