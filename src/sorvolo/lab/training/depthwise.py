"""Convolutions of each channel by itself, whose weights' gradient does not take most of a step on a CPU."""

import torch
from torch import Tensor, nn
from torch.nn import functional

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
