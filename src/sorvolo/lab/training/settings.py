"""What a person may choose for training the detector; torch is not needed to know it."""

from dataclasses import dataclass
from typing import Literal

from sorvolo.errors import SettingsError, check_choices


@dataclass(frozen=True)
class TrainSettings:
    """How the detector is trained (`sorvolo train`)."""

    preset: Literal["fast", "thesis"] = "fast"
    rpn: Literal["standard", "extended"] = "extended"  # of the preset thesis alone
    weights: str = "auto"  # fast: a model to tune, its name or file, auto the packaged one; thesis: ImageNet's; none
    steps: int = 8000  # batches
    batch: int = 8  # samples a step
    side_px: int = 384  # of the square samples
    seed: int = 1
    patience: int = 8  # checks without a better AP50 before it stops; 0 never does

    def __post_init__(self) -> None:
        check_choices(self)
        for name, number, low, high in (
            ("steps", self.steps, 1, 10**8),
            ("batch", self.batch, 1, 1024),
            ("side_px", self.side_px, 64, 4096),
            ("seed", self.seed, 0, 2**62),
            ("patience", self.patience, 0, 10**6),
        ):
            if not low <= number <= high:
                raise SettingsError(f"{name} must lie in {low} to {high}, got {number}")
        if self.preset == "thesis" and self.steps < 4:
            raise SettingsError(
                f"the preset thesis needs at least 4 steps, one of each kind; got {self.steps}"
            )
        if self.side_px % 32:
            raise SettingsError(f"side_px must be a multiple of 32, got {self.side_px}")
