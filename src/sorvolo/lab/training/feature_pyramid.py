"""Features of several strides made equally wide and aware of the coarser ones (Lin et al. 2017, Feature Pyramid
Networks)."""

from collections.abc import Sequence

from torch import Tensor, nn
from torch.nn import functional

from sorvolo.lab.training.depthwise import Depthwise


def convolution(channels: int, out: int, kernel: int, *, groups: int = 1) -> nn.Sequential:
    """Convolution, batch norm, ReLU; size kept."""
    return nn.Sequential(
        nn.Conv2d(channels, out, kernel, padding=kernel // 2, groups=groups, bias=False),
        nn.BatchNorm2d(out),
        nn.ReLU(inplace=True),
    )


def separable(channels: int, kernel: int) -> nn.Sequential:
    """Each channel by itself, then across channels: a light convolution."""
    return nn.Sequential(
        Depthwise(channels, kernel),
        nn.BatchNorm2d(channels),
        *convolution(channels, channels, 1),
    )


class Pyramid(nn.Module):
    """Levels of `width` channels each; `light` smooths them with separable convolutions."""

    def __init__(self, channels: Sequence[int], width: int, *, light: bool) -> None:
        super().__init__()
        self.lateral = nn.ModuleList(nn.Conv2d(each, width, 1) for each in channels)
        self.smooth = nn.ModuleList(
            separable(width, 3) if light else convolution(width, width, 3) for _ in channels
        )
        self.channels = (width,) * len(channels)

    def forward(self, levels: Sequence[Tensor]) -> list[Tensor]:
        """Fine to coarse, (N, channels, H, W) in, (N, width, H, W) out."""
        sides = [lateral(level) for lateral, level in zip(self.lateral, levels)]
        for index in range(len(sides) - 1, 0, -1):
            sides[index - 1] = sides[index - 1] + functional.interpolate(
                sides[index], scale_factor=2.0, mode="nearest"
            )
        return [smooth(side) for smooth, side in zip(self.smooth, sides)]
