"""What a person may choose for the thesis's experiments, and how large they are."""

from dataclasses import dataclass, replace

from sorvolo.errors import SettingsError
from sorvolo.lab.thesis.changes import ThesisComparison, ThesisSettings
from sorvolo.lab.training.settings import TrainSettings

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
class SimulatedSize:
    """How large a simulated dataset is."""

    length_m: float = 24.0  # of each path, at most
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
    training: TrainSettings | None = None  # of both networks of Table 4.6; None trains none

    def __post_init__(self) -> None:
        if self.videos is not None and self.videos < 1:
            raise SettingsError(f"--videos must be 1 or more, got {self.videos}")


def quick(
    settings: ReproductionSettings, size: SimulatedSize
) -> tuple[ReproductionSettings, SimulatedSize]:
    """The same at the size of a try: one short path of small pictures, and a training that only shows that it runs."""
    training = settings.training and replace(
        settings.training, steps=min(4, settings.training.steps), side_px=128, weights="none"
    )
    small = replace(size, length_m=10.0, size_px=(480, 270), environments=("Countryside",))
    return replace(settings, videos=1, repeats=1, training=training), small
