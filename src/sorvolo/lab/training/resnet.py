"""ResNet-50 (He et al. 2016) as a backbone, its layers named as torchvision's, and its last stage as a head."""

from collections.abc import Mapping

import torch
from torch import Tensor, nn
from torch.nn import functional

# of red, green and blue, 0 to 1: torchvision's, which the weights expect; so the next
IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)
"""Of RGB 0 to 1, as torchvision's weights were trained."""

_EPSILON = 1e-5  # PyTorch's of batch norms
_STAGES = ((64, 3), (128, 4), (256, 6), (512, 3))  # inner width, blocks
_GROWTH = 4  # times the inner width (He et al. 2016)


class FrozenNorm(nn.Module):
    """A batch norm that stays as it was loaded: statistics of a few large pictures a step would be poor ones."""

    weight: Tensor
    bias: Tensor
    running_mean: Tensor
    running_var: Tensor

    def __init__(self, channels: int) -> None:
        super().__init__()
        for name, value in (
            ("weight", 1.0),
            ("bias", 0.0),
            ("running_mean", 0.0),
            ("running_var", 1.0),
        ):
            self.register_buffer(name, torch.full((channels,), value))

    def forward(self, features: Tensor) -> Tensor:
        """(N, C, H, W) -> the same shape."""
        # as one known operation, so that an export folds it into the convolution before
        return functional.batch_norm(
            features,
            self.running_mean,
            self.running_var,
            self.weight,
            self.bias,
            training=False,
            eps=_EPSILON,
        )


class _Bottleneck(nn.Module):
    """1x1, 3x3, 1x1 beside a shortcut. The stride sits in the first 1x1 if `original`, else in the 3x3."""

    def __init__(
        self, channels: int, inner: int, stride: int, *, original: bool, frozen_norms: bool
    ) -> None:
        super().__init__()
        norm = FrozenNorm if frozen_norms else nn.BatchNorm2d
        out = inner * _GROWTH
        first, second = (stride, 1) if original else (1, stride)
        self.conv1 = nn.Conv2d(channels, inner, 1, first, bias=False)
        self.bn1 = norm(inner)
        self.conv2 = nn.Conv2d(inner, inner, 3, second, 1, bias=False)
        self.bn2 = norm(inner)
        self.conv3 = nn.Conv2d(inner, out, 1, bias=False)
        self.bn3 = norm(out)
        self.downsample: nn.Sequential | None = None
        if stride != 1 or channels != out:
            self.downsample = nn.Sequential(
                nn.Conv2d(channels, out, 1, stride, bias=False), norm(out)
            )

    def forward(self, features: Tensor) -> Tensor:
        x = functional.relu(self.bn1(self.conv1(features)))
        x = functional.relu(self.bn2(self.conv2(x)))
        x = self.bn3(self.conv3(x))
        return functional.relu(
            x + (features if self.downsample is None else self.downsample(features))
        )


def resnet_stage(
    index: int, *, original: bool, frozen_norms: bool = True, halves: bool = True
) -> nn.Sequential:
    """Stage `index` 1 to 4 (res2 to res5): 64, 256, 512 or 1024 channels in, four times its width out.

    All but the first halve the picture, unless `halves` is False.
    """
    inner, blocks = _STAGES[index - 1]
    channels = 64 if index == 1 else _STAGES[index - 2][0] * _GROWTH
    rows = []
    for block in range(blocks):
        stride = 2 if halves and block == 0 and index > 1 else 1
        rows.append(
            _Bottleneck(channels, inner, stride, original=original, frozen_norms=frozen_norms)
        )
        channels = inner * _GROWTH
    stage = nn.Sequential(*rows)
    for module in stage.modules():
        if isinstance(module, nn.Conv2d):
            nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")
    return stage


class ResNet50(nn.Module):
    """Features of stride 16 (C4, 1024 channels), or with `deep` of strides 4, 8, 16, 32 (C2 to C5: 256 to 2048).

    `original` places the strides as He et al. and Keras do, else as torchvision does: weights of one compute another
    function in the other. The stem and res2 stay as they are unless `thaw_all`; batch norms do if `frozen_norms`.
    Input: (N, 3, H, W) RGB, floats 0 to 255, sides multiples of the last stride.
    """

    mean: Tensor

    def __init__(
        self,
        *,
        deep: bool = False,
        original: bool = False,
        frozen_norms: bool = True,
        thaw_all: bool = False,
    ) -> None:
        super().__init__()
        self.original, self.deep = original, deep
        self.conv1 = nn.Conv2d(3, 64, 7, 2, 3, bias=False)
        self.bn1 = FrozenNorm(64) if frozen_norms else nn.BatchNorm2d(64)
        self.register_buffer("mean", torch.tensor(IMAGENET_MEAN) * 255)
        for index in range(1, 5 if deep else 4):
            self.add_module(
                f"layer{index}", resnet_stage(index, original=original, frozen_norms=frozen_norms)
            )
        nn.init.kaiming_normal_(self.conv1.weight, mode="fan_out", nonlinearity="relu")
        with torch.no_grad():  # what torchvision does to its input: (value / 255 - mean) / std
            self.conv1.weight /= torch.tensor(IMAGENET_STD)[None, :, None, None] * 255
        self.channels = (256, 512, 1024, 2048) if deep else (1024,)
        self.strides = (4, 8, 16, 32) if deep else (16,)
        if not thaw_all:
            for module in (self.conv1, self.bn1, self.get_submodule("layer1")):
                module.requires_grad_(False)

    def forward(self, images: Tensor) -> list[Tensor]:
        """One tensor (N, channels, H / stride, W / stride) per stride."""
        x = functional.relu(self.bn1(self.conv1(images - self.mean[:, None, None])))
        x = functional.max_pool2d(x, 3, 2, 1)
        levels = []
        for index in range(1, 5 if self.deep else 4):
            x = self.get_submodule(f"layer{index}")(x)
            levels.append(x)
        return levels if self.deep else levels[-1:]

    def load_imagenet(self, weights: Mapping[str, Tensor]) -> None:
        """Take weights by torchvision's names and `mean` (`weights.ImageNetWeights`); what is not of this net is left.

        Raises KeyError when a layer of this net is missing there.
        """
        _load(self, weights, "")


def load_stage(stage: nn.Sequential, index: int, weights: Mapping[str, Tensor]) -> None:
    """Take the weights of stage `index` 1 to 4 into `stage`, for a region head. Raises KeyError when one is missing."""
    _load(stage, weights, f"layer{index}.")


def _load(module: nn.Module, weights: Mapping[str, Tensor], prefix: str) -> None:
    counters = ("num_batches_tracked",)
    own = {
        name: weights[prefix + name] for name in module.state_dict() if not name.endswith(counters)
    }
    module.load_state_dict(own, strict=False)
