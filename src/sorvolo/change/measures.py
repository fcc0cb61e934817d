"""What the comparisons of a flight measured of its unchanged ground, for the report."""

from collections import deque
from dataclasses import dataclass
from statistics import median

from sorvolo.change.robust import RobustResult
from sorvolo.geometry.arrays import Floats

_MEMORY_FRAMES = 50  # light and wind change within minutes: older frames do not show how it is now
_LEAST_KNOWN = 0.05  # share of a frame that must be known for its measures to count


@dataclass(frozen=True, eq=False)
class PairMeasures:
    """What one comparison measured: see `RobustResult`. `brightness` (3,) is that of the light, blue green red."""

    known: float
    noise: float
    moved_px: float
    rest_px: float
    brightness: Floats
    unevenness: float

    @classmethod
    def of(cls, result: RobustResult) -> "PairMeasures":
        """Those of a comparison, without its pictures."""
        light, settling = result.light, result.settling
        return cls(
            float(result.known),
            float(result.noise),
            float(settling.moved_px),
            float(settling.rest_px),
            light.brightness,
            float(light.unevenness),
        )


class FlightMeasures:
    """What a flight's unchanged ground shows of noise, misalignment, parallax and light. Only `observe` changes it."""

    def __init__(self) -> None:
        self._seen: deque[PairMeasures] = deque(maxlen=_MEMORY_FRAMES)
        self._frames = 0

    def observe(self, measured: PairMeasures) -> None:
        """Learn from a comparison."""
        self._frames += 1
        if measured.known >= _LEAST_KNOWN:
            self._seen.append(measured)

    def summary(self) -> dict[str, float | int | str]:
        """What was measured, for a report: grey levels, px of the pictures given, octaves of brightness."""
        if not self._seen:
            return {"frames": self._frames}
        brightness = [
            float(median(float(each.brightness[band]) for each in self._seen)) for band in range(3)
        ]
        return {
            "frames": self._frames,
            "noise_levels": round(float(median(each.noise for each in self._seen)), 1),
            "misaligned_px": round(2 * median(each.moved_px for each in self._seen), 2),
            "parallax_px": round(2 * median(each.rest_px for each in self._seen), 2),
            "brightness_blue_green_red": " ".join(f"{each:.2f}" for each in brightness),
            "clouds_octaves": round(median(each.unevenness for each in self._seen), 2),
        }

    @property
    def brightness(self) -> float:
        """How many times as bright as the reference a middle grey is on this flight; NaN while nothing was seen."""
        return (
            float(median(float(each.brightness.mean()) for each in self._seen))
            if self._seen
            else float("nan")
        )
