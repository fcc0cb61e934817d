"""The robust method's parameters, set for each flight by what does not change in it."""

from collections import deque
from dataclasses import dataclass, replace
from statistics import median

from sorvolo.change.regions import LEAST_DIFFERENCE, NOISE_FACTOR
from sorvolo.change.robust import RobustResult, RobustSettings
from sorvolo.geometry.arrays import Floats

# What the measures of unchanged ground decide; lengths in px of the half size pictures that are
# compared.
_CALM_PX = 0.12  # rest of the flow below: values count as known one pixel around
_RESTLESS_PX = 0.9  # rest of the flow above: three pixels around
_FRAMES_TO_SETTLE = 10  # frames that must agree before less is tolerated than at first
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


class FlightTuning:
    """What a flight's unchanged ground shows of noise, misalignment, parallax and light. Only `observe` changes it.

    Every pair of pictures adapts itself already; this makes what they have in common a property of the flight, so
    that one odd frame (a gust, a cloud, a frame changed all over) does not decide for itself.
    """

    def __init__(self) -> None:
        self._base = RobustSettings()
        self._seen: deque[PairMeasures] = deque(maxlen=_MEMORY_FRAMES)
        self._frames = 0

    def observe(self, measured: PairMeasures) -> None:
        """Learn from a comparison."""
        self._frames += 1
        if measured.known >= _LEAST_KNOWN:
            self._seen.append(measured)

    def settings(self) -> RobustSettings:
        """The settings for the next frame; the ones given at first until something was seen."""
        if not self._seen:
            return self._base
        rest_px = median(each.rest_px for each in self._seen)
        reach_px = self._base.regions.reach_px
        if rest_px > _RESTLESS_PX:
            reach_px += 1
        elif rest_px < _CALM_PX and len(self._seen) >= _FRAMES_TO_SETTLE:
            reach_px = max(1, reach_px - 1)
        regions = replace(
            self._base.regions, reach_px=reach_px, least_noise=round(self._noise() / 2, 1)
        )
        return replace(self._base, regions=regions)

    def chosen(self) -> dict[str, float | int | str]:
        """What was measured and chosen, for a report: grey levels, px of the pictures given, octaves of brightness."""
        settings = self.settings()
        if not self._seen:
            return {"frames": self._frames, "settings": "those given: nothing was compared yet"}
        brightness = [
            float(median(float(each.brightness[band]) for each in self._seen)) for band in range(3)
        ]
        return {
            "frames": self._frames,
            "noise_levels": round(self._noise(), 1),
            "misaligned_px": round(2 * median(each.moved_px for each in self._seen), 2),
            "parallax_px": round(2 * median(each.rest_px for each in self._seen), 2),
            "brightness_blue_green_red": " ".join(f"{each:.2f}" for each in brightness),
            "clouds_octaves": round(median(each.unevenness for each in self._seen), 2),
            "search_px": 2 * settings.regions.reach_px,
            "least_difference_levels": round(
                LEAST_DIFFERENCE + NOISE_FACTOR * max(self._noise(), settings.regions.least_noise),
                1,
            ),
            "least_score": settings.least_score,
        }

    @property
    def brightness(self) -> float:
        """How many times as bright as the reference a middle grey is on this flight; NaN while nothing was seen."""
        return (
            float(median(float(each.brightness.mean()) for each in self._seen))
            if self._seen
            else float("nan")
        )

    def _noise(self) -> float:
        return float(median(each.noise for each in self._seen))
