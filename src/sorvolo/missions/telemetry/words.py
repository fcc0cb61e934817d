"""What was wrong with a flight's telemetry, in sentences."""

from collections.abc import Sequence
from math import isfinite

from sorvolo.survey.corrected import Bias, TelemetryFaults
from sorvolo.survey.wording import counted

_LEAST = {"clock": 0.04, "heading": 0.5, "tilt": 0.5, "height": 0.3}  # s, deg, deg, m: smaller ones matter to nobody


_MOST_NAMED = 6  # frames in a sentence


def fault_sentences(faults: TelemetryFaults, names: Sequence[str]) -> list[str]:
    """One sentence for each quantity that telemetry states; `names` are those of the compared frames."""
    return [
        *_clock(faults.clock_s), *_heading(faults.heading_deg), *_outlying(faults, names), *_tilt(faults.tilt_deg),
        *_height(faults.height_m),
        f"fixes scatter by {faults.position_m.scatter:.2f} m about the path in the pictures (1 sigma per axis)",
    ]


def _clock(found: Bias) -> list[str]:
    if not isfinite(found.value):
        return ["the clocks cannot be compared: the motion does not show an offset"]
    if abs(found.value) < _LEAST["clock"] or not found.is_significant:
        return [f"the clocks agree within {max(2 * found.sigma, 0.01):.2f} s"]
    side = "ahead of" if found.value > 0 else "behind"
    return [f"the telemetry's clock was {abs(found.value):.2f} s {side} the pictures (1 sigma {found.sigma:.2f} s)"]


def _heading(found: Bias) -> list[str]:
    if not isfinite(found.value):
        return ["telemetry has no heading to compare"]
    if abs(found.value) < _LEAST["heading"] or not found.is_significant:
        return [f"the compass was right within {max(2 * found.sigma, 0.1):.1f} deg"]
    side = "clockwise" if found.value > 0 else "counter-clockwise"
    return [
        f"the compass was {abs(found.value):.1f} deg off, too far {side} (1 sigma {found.sigma:.1f} deg; scatter "
        f"{found.scatter:.1f} deg)"
    ]


def _outlying(faults: TelemetryFaults, names: Sequence[str]) -> list[str]:
    if not faults.outlying:
        return []
    known = [names[row] for row in faults.outlying]
    more = f" and {len(known) - _MOST_NAMED} more" if len(known) > _MOST_NAMED else ""
    return [
        f"the stated angles of {counted(len(known), 'frame')} of {len(names)} are far beside that, by "
        f"{faults.outlying_deg:.0f} deg in the median, so that places by telemetry alone are wrong there: "
        f"{', '.join(known[:_MOST_NAMED])}{more}"
    ]


def _tilt(found: Bias) -> list[str]:
    if not isfinite(found.value) or found.value < _LEAST["tilt"] or not found.is_significant:
        return []
    return [f"the camera looked {found.value:.1f} deg beside where telemetry puts it (1 sigma {found.sigma:.1f} deg)"]


def _height(found: Bias) -> list[str]:
    if not isfinite(found.value):
        return ["telemetry has no height above the ground to compare"]
    if abs(found.value) < _LEAST["height"] or not found.is_significant:
        return [f"heights above the ground were right within {max(2 * found.sigma, 0.1):.1f} m"]
    side = "too high" if found.value > 0 else "too low"
    return [f"heights above the ground were {abs(found.value):.1f} m {side} (1 sigma {found.sigma:.1f} m)"]
