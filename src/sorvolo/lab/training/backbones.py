"""Pictures to features: EfficientNet-Lite0 (Tan and Le 2019, without squeeze and swish) and ResNet-50 (He et al. 2016),
their layers named as published weights name them; and the pyramid over them (Lin et al. 2017)."""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

_EPSILON = 1e-3  # of EfficientNet-Lite's batch norms
_BLOCKS = (  # repeats, kernel, stride, growth, out channels
    (1, 3, 1, 1, 16),
    (2, 3, 2, 6, 24),
    (2, 5, 2, 6, 40),
    (3, 3, 2, 6, 80),
    (3, 5, 1, 6, 112),
)

_STRIDE_8 = 5  # so many blocks come up to it


class _OneNode(torch.autograd.Function):
    """A convolution padded unevenly as a single node of the exported graph; torch itself needs two."""

    @staticmethod
    def forward(
        ctx: object,
        features: Tensor,
        weight: Tensor,
        bias: Tensor,
        stride: int,
        pads: tuple[int, int],
        groups: int,
    ) -> Tensor:
        before, after = pads
        padded = functional.pad(features, (before, after, before, after))
        return functional.conv2d(padded, weight, bias, stride, groups=groups)

    @staticmethod
    def symbolic(g, features, weight, bias, stride: int, pads: tuple[int, int], groups: int):  # type: ignore[no-untyped-def]
        before, after = pads
        return g.op(
            "Conv",
            features,
            weight,
            bias,
            strides_i=[stride, stride],
            pads_i=[before, before, after, after],
            group_i=groups,
        )


class SamePadded(nn.Conv2d):
    """A convolution padded as TensorFlow's "same": what is odd goes to the right and bottom."""

    def forward(self, features: Tensor) -> Tensor:
        """(N, C, H, W) -> (N, D, ceil(H / stride), ceil(W / stride)), for sides that the stride divides."""
        total = self.kernel_size[0] - self.stride[0]
        before = total // 2
        after = total - before
        if before != after and torch.onnx.is_in_onnx_export():
            return _OneNode.apply(  # type: ignore[no-untyped-call]
                features, self.weight, self.bias, self.stride[0], (before, after), self.groups
            )
        if before != after:
            features, before = functional.pad(features, (before, after, before, after)), 0
        if self.groups > 1:
            return depthwise(features, self.weight, self.bias, self.stride[0], before)
        return functional.conv2d(features, self.weight, self.bias, self.stride, before)


class _Block(nn.Module):
    """Inverted residual: widen, filter each channel by itself, narrow."""

    def __init__(self, channels: int, out: int, kernel: int, stride: int, growth: int) -> None:
        super().__init__()
        wide = channels * growth
        if growth > 1:
            self._expand_conv = SamePadded(channels, wide, 1)
        self._depthwise_conv = SamePadded(wide, wide, kernel, stride, groups=wide)
        self._project_conv = SamePadded(wide, out, 1)
        self._is_residual = stride == 1 and channels == out

    def forward(self, features: Tensor) -> Tensor:
        x = features
        if hasattr(self, "_expand_conv"):
            x = functional.relu6(self._expand_conv(x))
        x = functional.relu6(self._depthwise_conv(x))
        x = self._project_conv(x)
        return x + features if self._is_residual else x


def _blocks() -> list[_Block]:
    """The blocks up to stride 16, behind a stem of 32 channels."""
    blocks: list[_Block] = []
    channels = 32
    for repeats, kernel, stride, growth, out in _BLOCKS:
        for repeat in range(repeats):
            blocks.append(_Block(channels, out, kernel, stride if repeat == 0 else 1, growth))
            channels = out
    return blocks


class EfficientNetLite0(nn.Module):
    """Features of strides 4, 8 and 16 (24, 40 and 112 channels).

    Its batch norms, which would stay as ImageNet left them, are folded into the convolutions. Unless `thaw_all` the
    stem and the first block are frozen, and up to stride 8 the kernels that filter each channel by itself, which are
    the dearest to learn. Input: (N, 3, H, W) floats 0 to 255, sides multiples of the last stride.
    """

    def __init__(self, *, thaw_all: bool = False) -> None:
        super().__init__()
        self._conv_stem = SamePadded(3, 32, 3, 2)
        blocks = _blocks()
        self._blocks = nn.ModuleList(blocks)
        self._taps = (2, 4, 10)
        self.channels, self.strides = (24, 40, 112), (4, 8, 16)
        for layer in self.modules():
            if isinstance(
                layer, nn.Conv2d
            ):  # without norms a net from nothing needs its signals kept at one size
                nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
                nn.init.zeros_(layer.bias)  # type: ignore[arg-type]
        if not thaw_all:
            for module in (
                self._conv_stem,
                blocks[0],
                *(each._depthwise_conv for each in blocks[1:_STRIDE_8]),
            ):
                module.requires_grad_(False)

    def forward(self, images: Tensor) -> list[Tensor]:
        """One tensor (N, channels, H / stride, W / stride) per stride."""
        x = functional.relu6(self._conv_stem((images - 127.0) / 128.0))
        levels = []
        for index, block in enumerate(self._blocks):
            x = block(x)
            if index in self._taps:
                levels.append(x)
        return levels

    def load_imagenet(self, weights: dict[str, Tensor]) -> None:
        """Take the published weights; layers that this net does not have are left out.

        Raises KeyError when a layer of this net is missing there.
        """
        norms = {
            "_conv_stem": "_bn0",
            "_expand_conv": "_bn0",
            "_depthwise_conv": "_bn1",
            "_project_conv": "_bn2",
        }
        folded = {}
        for name in self.state_dict():
            layer, kind = name.rsplit(".", 1)
            place, own = layer.rpartition(".")[0], layer.rpartition(".")[2]
            norm = f"{place}.{norms[own]}".lstrip(".")
            gain = weights[f"{norm}.weight"] / torch.sqrt(weights[f"{norm}.running_var"] + _EPSILON)
            if kind == "weight":
                folded[name] = weights[name] * gain[:, None, None, None]
            else:
                folded[name] = weights[f"{norm}.bias"] - weights[f"{norm}.running_mean"] * gain
        self.load_state_dict(folded)


_QUICK_KERNEL = 3  # px a side; PyTorch's own way is quick for these


class _Depthwise(torch.autograd.Function):
    """The same values as torch's own. The weights' gradient is computed in float32, and with a stride the features'
    too: mostly several times as fast as in bfloat16."""

    @staticmethod
    def forward(ctx, features: Tensor, weight: Tensor, stride: int, padding: int) -> Tensor:  # type: ignore[no-untyped-def]
        out = functional.conv2d(features, weight, None, stride, padding, groups=len(weight))
        ctx.save_for_backward(features.to(out.dtype), weight)
        ctx.shape = stride, padding
        return out

    @staticmethod
    def backward(ctx, grown: Tensor) -> tuple[Tensor | None, Tensor | None, None, None]:  # type: ignore[no-untyped-def]
        features, weight = ctx.saved_tensors
        stride, padding = ctx.shape
        places = [stride, stride], [padding, padding], [1, 1], False, [0, 0], len(weight)
        to_features = to_weight = None
        if ctx.needs_input_grad[0]:
            kind = grown.dtype if stride == 1 else torch.float32
            to_features = torch.ops.aten.convolution_backward(
                grown.to(kind),
                features.to(kind),
                weight.to(kind),
                None,
                *places,
                [True, False, False],
            )[0].to(features.dtype)
        if ctx.needs_input_grad[1]:
            to_weight = torch.ops.aten.convolution_backward(
                grown.float(), features.float(), weight.float(), None, *places, [False, True, False]
            )[1].to(weight.dtype)
        return to_features, to_weight, None, None


def depthwise(
    features: Tensor, weight: Tensor, bias: Tensor | None, stride: int, padding: int
) -> Tensor:
    """(N, C, H, W) filtered channel by channel with `weight` (C, 1, k, k), as torch.nn.functional.conv2d does it."""
    learns = torch.is_grad_enabled() and (features.requires_grad or weight.requires_grad)
    is_quick = weight.shape[-1] <= _QUICK_KERNEL and stride == 1  # in bfloat16 too
    if features.device.type != "cpu" or not learns or is_quick:
        return functional.conv2d(features, weight, bias, stride, padding, groups=len(weight))
    out: Tensor = _Depthwise.apply(features, weight, stride, padding)  # type: ignore[no-untyped-call]
    return out if bias is None else out + bias.to(out.dtype)[:, None, None]


class Depthwise(nn.Conv2d):
    """A convolution (channels, 1, k, k) of each channel by itself that keeps the size; without a bias."""

    def __init__(self, channels: int, kernel: int) -> None:
        super().__init__(
            channels, channels, kernel, padding=kernel // 2, groups=channels, bias=False
        )

    def forward(self, features: Tensor) -> Tensor:
        """(N, C, H, W) -> (N, C, H, W)."""
        return depthwise(features, self.weight, None, 1, self.kernel_size[0] // 2)


# of red, green and blue, 0 to 1: torchvision's, which the weights expect; so the next
IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)
"""Of RGB 0 to 1, as torchvision's weights were trained."""

_RESNET_EPSILON = 1e-5  # PyTorch's of batch norms
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
            eps=_RESNET_EPSILON,
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
    """Features of stride 16 (C4, 1024 channels).

    `original` places the strides as He et al. and Keras do, else as torchvision does: weights of one compute another
    function in the other. The stem and res2 stay as they are unless `thaw_all`; batch norms do if `frozen_norms`.
    Input: (N, 3, H, W) RGB, floats 0 to 255, sides multiples of the last stride.
    """

    mean: Tensor

    def __init__(
        self,
        *,
        original: bool = False,
        frozen_norms: bool = True,
        thaw_all: bool = False,
    ) -> None:
        super().__init__()
        self.original = original
        self.conv1 = nn.Conv2d(3, 64, 7, 2, 3, bias=False)
        self.bn1 = FrozenNorm(64) if frozen_norms else nn.BatchNorm2d(64)
        self.register_buffer("mean", torch.tensor(IMAGENET_MEAN) * 255)
        for index in range(1, 4):
            self.add_module(
                f"layer{index}", resnet_stage(index, original=original, frozen_norms=frozen_norms)
            )
        nn.init.kaiming_normal_(self.conv1.weight, mode="fan_out", nonlinearity="relu")
        with torch.no_grad():  # what torchvision does to its input: (value / 255 - mean) / std
            self.conv1.weight /= torch.tensor(IMAGENET_STD)[None, :, None, None] * 255
        self.channels, self.strides = (1024,), (16,)
        if not thaw_all:
            for module in (self.conv1, self.bn1, self.get_submodule("layer1")):
                module.requires_grad_(False)

    def forward(self, images: Tensor) -> list[Tensor]:
        """One tensor (N, 1024, H / 16, W / 16)."""
        x = functional.relu(self.bn1(self.conv1(images - self.mean[:, None, None])))
        x = functional.max_pool2d(x, 3, 2, 1)
        for index in range(1, 4):
            x = self.get_submodule(f"layer{index}")(x)
        return [x]

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


def convolution(channels: int, out: int, kernel: int | tuple[int, int]) -> nn.Sequential:
    """Convolution of a kernel of odd sides, (rows, columns) or square, batch norm, ReLU; size kept."""
    rows, columns = kernel if isinstance(kernel, tuple) else (kernel, kernel)
    return nn.Sequential(
        nn.Conv2d(channels, out, (rows, columns), padding=(rows // 2, columns // 2), bias=False),
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


class FeaturePyramid(nn.Module):
    """Levels of `width` channels each, smoothed with separable convolutions."""

    def __init__(self, channels: Sequence[int], width: int) -> None:
        super().__init__()
        self.lateral = nn.ModuleList(nn.Conv2d(each, width, 1) for each in channels)
        self.smooth = nn.ModuleList(separable(width, 3) for _ in channels)
        self.channels = (width,) * len(channels)

    def forward(self, levels: Sequence[Tensor]) -> list[Tensor]:
        """Fine to coarse, (N, channels, H, W) in, (N, width, H, W) out."""
        sides = [lateral(level) for lateral, level in zip(self.lateral, levels)]
        for index in range(len(sides) - 1, 0, -1):
            sides[index - 1] = sides[index - 1] + functional.interpolate(
                sides[index], scale_factor=2.0, mode="nearest"
            )
        return [smooth(side) for smooth, side in zip(self.smooth, sides)]
