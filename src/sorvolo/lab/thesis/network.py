"""Section 3.3.2: the detector. ResNet-50 whose proposals pass through Table 3.2's nine Inception modules (Figure 3.26).

docs/thesis.md describes how the table was read.
"""

from collections.abc import Mapping, Sequence
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional

from sorvolo.lab.thesis.faster_rcnn import FasterRCNN, ProposalNetwork, StageHead
from sorvolo.lab.thesis.resnet import ResNet50, convolution, load_imagenet, resnet_stage

_STANDARD_WIDTH = 512  # of the standard proposal network's 3x3 convolution (Ren et al. 2015)
_TABLE_3_2 = (  # of each layer, its branches: filters, kernel
    *[((64, 1), (96, 3), (64, 5))] * 3,
    *[((192, 1), (192, 7), (192, 7))] * 4,
    *[((320, 1), *[(384, 3)] * 4)] * 2,
)
_POOLED_LAYER = 2  # layer 3 has a branch more, which pools
_REDUCED = {5: 48, 3: 64}  # channels in front of the larger kernels of layers 1 to 3


class InceptionA(nn.Module):
    """Layers 1 to 3: 1x1, 3x3 and 5x5 side by side, a 1x1 in front of the larger ones; in layer 3 the pooled input as
    well, for which the table gives no filters."""

    def __init__(self, channels: int, branches: Sequence[tuple[int, int]], *, pools: bool) -> None:
        super().__init__()
        self.branches = nn.ModuleList()
        self.channels = 0
        for out, kernel in branches:
            if kernel == 1:
                self.branches.append(convolution(channels, out, 1))
            else:
                inner = _REDUCED[kernel]
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

    def __init__(self, channels: int, branches: Sequence[tuple[int, int]]) -> None:
        super().__init__()
        out = branches[0][0]
        inner = 128
        self.first = convolution(channels, out, 1)
        self.second = nn.Sequential(
            convolution(channels, inner, 1),
            convolution(inner, inner, (1, 7)),
            convolution(inner, out, (7, 1)),
        )
        self.third = nn.Sequential(
            convolution(channels, inner, 1),
            convolution(inner, inner, (7, 1)),
            convolution(inner, out, (1, 7)),
        )
        self.channels = 3 * out

    def forward(self, features: Tensor) -> Tensor:
        """(N, channels, H, W) -> (N, self.channels, H, W)."""
        return torch.cat([self.first(features), self.second(features), self.third(features)], 1)


class InceptionC(nn.Module):
    """Layers 8 and 9: 1x1, and four branches 3x3 as pairs of 1x3 and 3x1, the second pair behind a 3x3."""

    def __init__(self, channels: int, branches: Sequence[tuple[int, int]]) -> None:
        super().__init__()
        narrow = branches[0][0]
        out = branches[1][0]
        inner = 448
        self.first = convolution(channels, narrow, 1)
        self.near = convolution(channels, out, 1)
        self.far = nn.Sequential(convolution(channels, inner, 1), convolution(inner, out, 3))
        self.branches = nn.ModuleList(
            convolution(out, out, kernel) for kernel in ((1, 3), (3, 1), (1, 3), (3, 1))
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
    """The nine stacked Inception modules of Table 3.2 and Figure 3.26."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        layers: list[InceptionA | InceptionB | InceptionC] = []
        for index, branches in enumerate(_TABLE_3_2):
            if index < 3:
                layers.append(InceptionA(channels, branches, pools=index == _POOLED_LAYER))
            elif index < 7:
                layers.append(InceptionB(channels, branches))
            else:
                layers.append(InceptionC(channels, branches))
            channels = layers[-1].channels
        self.layers = nn.Sequential(*layers)
        self.channels = channels

    def forward(self, features: Tensor) -> Tensor:
        """(N, channels, H, W) -> (N, self.channels, H, W), nothing resampled."""
        return self.layers(features)


def thesis_network(
    classes: Sequence[str],
    rpn: Literal["standard", "extended"],
    imagenet: Mapping[str, Tensor] | None = None,
) -> FasterRCNN:
    """The thesis's own (its 3.3.2): ResNet-50 up to res4, proposals through Table 3.2's nine modules, res5 as head.

    With the weights of `imagenet` batch norms and first layers stay as they are loaded; without, everything learns.
    """
    frozen = imagenet is not None
    backbone = ResNet50(frozen=frozen)
    # cut out at the 7x7 that res5's stride would leave of 14x14: a quarter as much to sample, and all of it is used
    stage = resnet_stage(4, frozen=frozen, halves=False)
    if imagenet is not None:
        load_imagenet(backbone, imagenet)
        load_imagenet(stage, imagenet, "layer4.")
    if rpn == "extended":
        nine = ExtendedStack(backbone.channels)
        proposals = ProposalNetwork(nine, nine.channels, backbone.stride)
    else:
        standard = convolution(backbone.channels, _STANDARD_WIDTH, 3)
        proposals = ProposalNetwork(standard, _STANDARD_WIDTH, backbone.stride)
    return FasterRCNN(backbone, proposals, StageHead(stage, 2048, len(classes)))
