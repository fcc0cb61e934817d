"""What stands between features and proposals: the standard convolution, the thesis's nine Inception modules, and
residual stacks of ours (docs/thesis.md describes how Table 3.2 was read)."""

from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional

from sorvolo.lab.training.depthwise import Depthwise
from sorvolo.lab.training.feature_pyramid import convolution, separable

Stem = Literal["standard", "extended", "extended-residual"]

_TABLE_3_2 = (  # of each layer, its branches: filters, kernel
    ((64, 1), (96, 3), (64, 5)),
    ((64, 1), (96, 3), (64, 5)),
    ((64, 1), (96, 3), (64, 5)),
    ((192, 1), (192, 7), (192, 7)),
    ((192, 1), (192, 7), (192, 7)),
    ((192, 1), (192, 7), (192, 7)),
    ((192, 1), (192, 7), (192, 7)),
    ((320, 1), (384, 3), (384, 3), (384, 3), (384, 3)),
    ((320, 1), (384, 3), (384, 3), (384, 3), (384, 3)),
)
_POOLED_LAYER = 2  # layer 3 has a branch more, which pools
_REDUCED = {5: 48, 3: 64}  # channels in front of the larger kernels of layers 1 to 3


class InceptionA(nn.Module):
    """Layers 1 to 3: 1x1, 3x3 and 5x5 side by side, a 1x1 in front of the larger ones; in layer 3 the pooled input as
    well, for which the table gives no filters."""

    def __init__(
        self, channels: int, branches: Sequence[tuple[int, int]], scale: float, *, pools: bool
    ) -> None:
        super().__init__()
        self.branches = nn.ModuleList()
        self.channels = 0
        for filters, kernel in branches:
            out = _scaled(filters, scale)
            if kernel == 1:
                self.branches.append(convolution(channels, out, 1))
            else:
                inner = _scaled(_REDUCED[kernel], scale)
                self.branches.append(
                    nn.Sequential(convolution(channels, inner, 1), convolution(inner, out, kernel))
                )
            self.channels += out
        self.pools = pools
        self.channels += channels if pools else 0

    def forward(self, features: Tensor) -> Tensor:
        """(N, channels, H, W) -> (N, self.channels, H, W)."""
        out = [branch(features) for branch in self.branches]
        if self.pools:
            out.append(functional.avg_pool2d(features, 3, 1, 1, count_include_pad=False))
        return torch.cat(out, 1)


class InceptionB(nn.Module):
    """Layers 4 to 7: 1x1; 1x7 and 7x1 (branch 7x7_1); 7x1, 1x7 (branch 7x7_2), the 7x7 kernels factorised."""

    def __init__(self, channels: int, branches: Sequence[tuple[int, int]], scale: float) -> None:
        super().__init__()
        out = _scaled(branches[0][0], scale)
        inner = _scaled(128, scale)
        self.first = convolution(channels, out, 1)
        self.second = nn.Sequential(
            convolution(channels, inner, 1), _line(inner, inner, 1, 7), _line(inner, out, 7, 1)
        )
        self.third = nn.Sequential(
            convolution(channels, inner, 1), _line(inner, inner, 7, 1), _line(inner, out, 1, 7)
        )
        self.channels = 3 * out

    def forward(self, features: Tensor) -> Tensor:
        """(N, channels, H, W) -> (N, self.channels, H, W)."""
        return torch.cat([self.first(features), self.second(features), self.third(features)], 1)


class InceptionC(nn.Module):
    """Layers 8 and 9: 1x1, and four branches 3x3 as pairs of 1x3 and 3x1, the second pair behind a 3x3."""

    def __init__(self, channels: int, branches: Sequence[tuple[int, int]], scale: float) -> None:
        super().__init__()
        narrow, out, inner = (
            _scaled(branches[0][0], scale),
            _scaled(branches[1][0], scale),
            _scaled(448, scale),
        )
        self.first = convolution(channels, narrow, 1)
        self.near = convolution(channels, out, 1)
        self.far = nn.Sequential(convolution(channels, inner, 1), convolution(inner, out, 3))
        self.branches = nn.ModuleList(
            _line(out, out, *kernel) for kernel in ((1, 3), (3, 1), (1, 3), (3, 1))
        )
        self.channels = narrow + 4 * out

    def forward(self, features: Tensor) -> Tensor:
        """(N, channels, H, W) -> (N, self.channels, H, W)."""
        near, far = self.near(features), self.far(features)
        inputs = (near, near, far, far)
        return torch.cat(
            [self.first(features), *(branch(each) for branch, each in zip(self.branches, inputs))],
            1,
        )


class ExtendedStack(nn.Module):
    """The nine stacked Inception modules of Table 3.2 and Figure 3.26; `scale` multiplies every width."""

    def __init__(self, channels: int, scale: float = 1.0) -> None:
        super().__init__()
        layers: list[InceptionA | InceptionB | InceptionC] = []
        for index, branches in enumerate(_TABLE_3_2):
            if index < 3:
                layers.append(InceptionA(channels, branches, scale, pools=index == _POOLED_LAYER))
            elif index < 7:
                layers.append(InceptionB(channels, branches, scale))
            else:
                layers.append(InceptionC(channels, branches, scale))
            channels = layers[-1].channels
        self.layers = nn.Sequential(*layers)
        self.channels = channels

    def forward(self, features: Tensor) -> Tensor:
        """(N, channels, H, W) -> (N, self.channels, H, W), nothing resampled."""
        return self.layers(features)


class StandardStack(nn.Module):
    """The standard proposal network's one 3x3 convolution."""

    def __init__(self, channels: int, out: int) -> None:
        super().__init__()
        self.convolution = convolution(channels, out, 3)
        self.channels = out

    def forward(self, features: Tensor) -> Tensor:
        """(N, channels, H, W) -> (N, self.channels, H, W)."""
        return self.convolution(features)


class ResidualStack(nn.Module):
    """Ours: the standard convolution, to which a stack of Inception modules learns to add; at first it adds nothing.

    `light` is for pictures on a laptop: each module filters by 3x3, 5x5 and 7x7, channel by channel, side by side, and
    mixes the three with its input. Else the modules are the table's, `scale` times as wide.
    """

    def __init__(
        self, channels: int, out: int, *, light: bool, modules: int = 1, scale: float = 0.25
    ) -> None:
        super().__init__()
        self.channels = out
        self.standard: nn.Module = (
            separable(channels, 3) if light else convolution(channels, out, 3)
        )
        if light:
            if channels != out:
                raise ValueError(f"a light stack keeps its width, {channels}; got {out}")
            self.added = nn.Sequential(*(_LightInception(channels) for _ in range(modules)))
        else:
            stack = ExtendedStack(channels, scale)
            self.added = nn.Sequential(
                stack, nn.Conv2d(stack.channels, out, 1, bias=False), nn.BatchNorm2d(out)
            )
            nn.init.zeros_(self.added[2].weight)  # type: ignore[arg-type]

    def forward(self, features: Tensor) -> Tensor:
        """(N, channels, H, W) -> (N, self.channels, H, W)."""
        standard = self.standard(features)
        if isinstance(self.added[0], _LightInception):
            return self.added(standard)
        return standard + self.added(features)


class _LightInception(nn.Module):
    def __init__(self, channels: int) -> None:
        super().__init__()
        self.branches = nn.ModuleList(
            nn.Sequential(
                Depthwise(channels, kernel),
                nn.BatchNorm2d(channels),
                nn.ReLU(inplace=True),
            )
            for kernel in (3, 5, 7)
        )
        self.mix = nn.Sequential(
            nn.Conv2d(3 * channels, channels, 1, bias=False), nn.BatchNorm2d(channels)
        )
        nn.init.zeros_(self.mix[1].weight)  # type: ignore[arg-type]

    def forward(self, features: Tensor) -> Tensor:
        mixed = self.mix(torch.cat([branch(features) for branch in self.branches], 1))
        return functional.relu(features + mixed)


def proposal_stem(kind: Stem, channels: int, out: int, *, light: bool) -> nn.Module:
    """What replaces the proposal network's convolution; it has `.channels`, the width that comes out."""
    if kind == "standard":
        if not light:
            return StandardStack(channels, out)
        stem = separable(channels, 3)
        stem.channels = channels  # type: ignore[assignment]
        return stem
    if kind == "extended":
        return ExtendedStack(channels, 0.125 if light else 1.0)
    return ResidualStack(channels, out, light=light)


def _line(channels: int, out: int, rows: int, columns: int) -> nn.Sequential:
    """A convolution of rows x columns, batch norm, ReLU."""
    return nn.Sequential(
        nn.Conv2d(channels, out, (rows, columns), padding=(rows // 2, columns // 2), bias=False),
        nn.BatchNorm2d(out),
        nn.ReLU(inplace=True),
    )


def _scaled(width: int, scale: float) -> int:
    return max(8, round(width * scale))
