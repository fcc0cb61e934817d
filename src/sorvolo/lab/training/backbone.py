"""Pictures to features: EfficientNet-Lite0 (Tan and Le 2019, without squeeze and swish), its layers named as its
published weights name them."""

import torch
from torch import Tensor, nn
from torch.nn import functional

from sorvolo.lab.training.depthwise import depthwise

_EPSILON = 1e-3  # of EfficientNet-Lite's batch norms
_BLOCKS = (  # repeats, kernel, stride, growth, out channels
    (1, 3, 1, 1, 16),
    (2, 3, 2, 6, 24),
    (2, 5, 2, 6, 40),
    (3, 3, 2, 6, 80),
    (3, 5, 1, 6, 112),
    (4, 5, 2, 6, 192),
    (1, 3, 1, 6, 320),
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


def _blocks(deep: bool) -> list[_Block]:
    """The blocks up to stride 16, or to 32 if `deep`, behind a stem of 32 channels."""
    blocks: list[_Block] = []
    channels = 32
    for repeats, kernel, stride, growth, out in _BLOCKS if deep else _BLOCKS[:5]:
        for repeat in range(repeats):
            blocks.append(_Block(channels, out, kernel, stride if repeat == 0 else 1, growth))
            channels = out
    return blocks


class EfficientNetLite0(nn.Module):
    """Features of strides 4, 8 and 16 (24, 40 and 112 channels), of 32 too (320) if `deep`.

    Its batch norms, which would stay as ImageNet left them, are folded into the convolutions. Unless `thaw_all` the
    stem and the first block are frozen, and up to stride 8 the kernels that filter each channel by itself, which are
    the dearest to learn. Input: (N, 3, H, W) floats 0 to 255, sides multiples of the last stride.
    """

    def __init__(self, *, deep: bool = False, thaw_all: bool = False) -> None:
        super().__init__()
        self._conv_stem = SamePadded(3, 32, 3, 2)
        blocks = _blocks(deep)
        self._blocks = nn.ModuleList(blocks)
        self._taps = (2, 4, 10, 15) if deep else (2, 4, 10)
        self.channels = (24, 40, 112, 320) if deep else (24, 40, 112)
        self.strides = (4, 8, 16, 32) if deep else (4, 8, 16)
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
