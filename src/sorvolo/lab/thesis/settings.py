"""What a person may choose for the thesis's experiments, and how large they are."""

from dataclasses import dataclass, field, replace
from typing import Literal

from sorvolo.errors import SettingsError
from sorvolo.lab.thesis.changes import ThesisComparison, ThesisSettings

ENVIRONMENTS = ("Urban", "Dirt", "Countryside")
FIGURE_PX = 960
"""The longer side of a picture in the figures."""

MAP_METHODS = ("thesis", "planar")
PUBLISHED, BENCHMARK = "published", "benchmark"
"""The kinds of rows that compare a map with a published mosaic, of the NPU Drone-Map dataset and of UMCD's (2.4)."""
COMPARISONS: dict[str, ThesisComparison | None] = {
    "thesis": ThesisComparison(),
    "thesis, eq. 3.21 as printed": ThesisComparison(ThesisSettings(isolation_as_printed=True)),
    "thesis, thresholds from the light": ThesisComparison(
        ThesisSettings(gray_threshold=None, hamming_share=None)
    ),
    "robust": None,
}
"""The ways in which pictures are compared, by their titles; None is the robust method."""


@dataclass(frozen=True)
class DetectorSettings:
    """Table 4.6: how the two networks are trained. `steps` 0 trains none; `weights` as `sorvolo train` takes it."""

    steps: int = 400
    preset: Literal["fast", "thesis"] = "fast"
    weights: str = "auto"  # the thesis, too, begins with ImageNet's
    device: str = "auto"
    side_px: int = 416  # of the training samples, as `sorvolo train` cuts them
    schedule: Literal["joint", "four-steps"] = "joint"  # four-steps is the thesis's

    def __post_init__(self) -> None:
        if not 0 <= self.steps <= 10**8:
            raise SettingsError(f"--train-steps must lie in 0 to 100000000, got {self.steps}")
        if self.schedule == "four-steps" and 0 < self.steps < 4:
            raise SettingsError(
                f"--schedule four-steps needs at least 4 --train-steps, got {self.steps}"
            )


@dataclass(frozen=True)
class SimulatedSize:
    """How large a simulated dataset is; the dataset itself is `length_m` None with its own number of videos."""

    length_m: float | None = 24.0  # of each path; None: as Tables 2.1 and 2.3 have them
    size_px: tuple[int, int] = (1280, 720)
    bare_videos: int = 1  # without telemetry, of each environment that has such
    environments: tuple[str, ...] = ENVIRONMENTS


@dataclass(frozen=True)
class ReproductionSettings:
    """How much of chapter 4 is done, and how. The dataset's own size is `videos` None."""

    videos: int | None = None  # at most this many of each environment, in each part of the dataset
    views_per_second: float = 5.0  # that are compared; the thesis compared every frame
    repeats: int = 5  # of the timed comparison of section 4.2.2
    seed: int = 1  # of what is simulated, held out, and learnt
    detector: DetectorSettings = field(default_factory=DetectorSettings)

    def __post_init__(self) -> None:
        if self.videos is not None and self.videos < 1:
            raise SettingsError(f"--videos must be 1 or more, got {self.videos}")


def quick(
    settings: ReproductionSettings, size: SimulatedSize
) -> tuple[ReproductionSettings, SimulatedSize]:
    """The same at the size of a try: one short path of small pictures, and a training that only shows that it runs."""
    detector = replace(
        settings.detector, steps=min(4, settings.detector.steps), side_px=128, weights="none"
    )
    small = replace(size, length_m=10.0, size_px=(480, 270), environments=("Countryside",))
    return replace(settings, videos=1, repeats=1, detector=detector), small
