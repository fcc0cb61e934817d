"""Our depthwise convolution and its gradients are those of torch's own."""

import pytest

torch = pytest.importorskip("torch")

from torch.nn import functional

from sorvolo.lab.training import backbones as module
from sorvolo.lab.training.backbones import Depthwise, SamePadded, depthwise

_CHANNELS = 6

torch.set_num_threads(1)


def _inputs(kernel: int, *, seed: int = 1) -> tuple["torch.Tensor", "torch.Tensor", "torch.Tensor"]:
    """Features (2, C, 14, 18), weight (C, 1, k, k) and bias (C,)."""
    chance = torch.Generator().manual_seed(seed)
    shapes = (2, _CHANNELS, 14, 18), (_CHANNELS, 1, kernel, kernel), (_CHANNELS,)
    features, weight, bias = (
        torch.randn(shape, generator=chance, requires_grad=True) for shape in shapes
    )
    return features, weight, bias


def _own(features, weight, bias, stride, padding):  # type: ignore[no-untyped-def]
    return functional.conv2d(features, weight, bias, stride, padding, groups=len(weight))


def _taught(convolve, tensors, stride, padding):  # type: ignore[no-untyped-def]
    """The output, and the gradients of a loss in which every output pixel weighs differently."""
    out = convolve(*tensors, stride, padding)
    weights = torch.linspace(-1, 1, out.numel()).reshape(out.shape)
    known = [each for each in tensors if each is not None and each.requires_grad]
    return [out.detach(), *torch.autograd.grad((out.float() * weights).sum(), known)]


@pytest.mark.parametrize("with_bias", [False, True])
@pytest.mark.parametrize(("kernel", "padding"), [(3, 1), (3, 0), (5, 2), (7, 3)])
@pytest.mark.parametrize("stride", [1, 2])
def test_output_and_gradients_are_torchs(
    stride: int, kernel: int, padding: int, with_bias: bool
) -> None:
    features, weight, bias = _inputs(kernel)
    tensors = (features, weight, bias if with_bias else None)
    for found, wanted in zip(
        _taught(depthwise, tensors, stride, padding), _taught(_own, tensors, stride, padding)
    ):
        torch.testing.assert_close(found, wanted)


def test_the_derivatives_are_those_of_small_steps() -> None:
    features, weight, bias = (each.detach().double().requires_grad_() for each in _inputs(3))
    # gradients are reckoned in float32, so the steps are larger and the tolerance is float32's
    assert torch.autograd.gradcheck(
        lambda *each: depthwise(*each, 2, 1),
        (features[:1, :, :6, :6], weight, bias),
        eps=1e-3,
        atol=1e-3,
        rtol=1e-3,
    )


def test_features_in_channels_last_are_the_same() -> None:
    features, weight, _ = _inputs(5)
    last = features.detach().contiguous(memory_format=torch.channels_last).requires_grad_()
    for found, wanted in zip(
        _taught(depthwise, (last, weight, None), 1, 2),
        _taught(_own, (features, weight, None), 1, 2),
    ):
        torch.testing.assert_close(found, wanted)


def test_a_frozen_picture_or_weight_asks_for_the_other_gradient_only() -> None:
    features, weight, _ = _inputs(5)
    fixed = features.detach()
    (to_weight,) = torch.autograd.grad(depthwise(fixed, weight, None, 1, 2).sum(), [weight])
    (wanted,) = torch.autograd.grad(_own(fixed, weight, None, 1, 2).sum(), [weight])
    torch.testing.assert_close(to_weight, wanted)
    out = depthwise(features, weight.detach(), None, 1, 2)
    (to_features,) = torch.autograd.grad(out.sum(), [features])
    (wanted,) = torch.autograd.grad(_own(features, weight.detach(), None, 1, 2).sum(), [features])
    torch.testing.assert_close(to_features, wanted)


@pytest.mark.parametrize("stride", [1, 2])
def test_under_autocast_the_type_is_bfloat16_and_gradients_are_near_the_exact_ones(
    stride: int,
) -> None:
    features, weight, bias = _inputs(5)
    with torch.autocast("cpu", torch.bfloat16):
        found = _taught(depthwise, (features, weight, bias), stride, 2)
        assert found[0].dtype == torch.bfloat16
    exact = _taught(_own, (features, weight, bias), stride, 2)
    assert [each.dtype for each in found[1:]] == [torch.float32] * 3
    for mine, wanted in zip(found, exact):
        torch.testing.assert_close(
            mine.float(), wanted, atol=0.03 * float(wanted.abs().max()), rtol=0.03
        )


@pytest.mark.parametrize("frozen", [True, False])
def test_where_nothing_is_learnt_torch_itself_is_asked(
    frozen: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    def never(*_: object) -> None:
        raise AssertionError("the detour through autograd was taken")

    features, weight, bias = _inputs(3)
    monkeypatch.setattr(module._Depthwise, "apply", never)
    wanted = _own(features, weight, bias, 2, 1)
    if frozen:
        torch.testing.assert_close(
            depthwise(features.detach(), weight.detach(), bias, 2, 1), wanted
        )
    else:
        with torch.no_grad():
            assert torch.equal(depthwise(features, weight, bias, 2, 1), wanted)
    small = depthwise(features, weight, bias, 1, 1)  # quick anyway
    torch.testing.assert_close(small, _own(features, weight, bias, 1, 1))
    for learnt in ((features, weight.detach()), (features.detach(), weight)):
        with pytest.raises(AssertionError, match="detour"):
            depthwise(*learnt, bias, 2, 1)


def test_other_devices_than_the_cpu_use_torch_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    def never(*_: object) -> None:
        raise AssertionError("the detour through autograd was taken")

    monkeypatch.setattr(module._Depthwise, "apply", never)
    device = "cuda" if torch.cuda.is_available() else "meta"
    features, weight, bias = (each.detach().to(device).requires_grad_() for each in _inputs(5))
    out = depthwise(features, weight, bias, 1, 2)
    assert out.device.type == device and out.shape == features.shape


def test_the_layers_are_torchs_own_with_the_same_weights() -> None:
    features, _, _ = _inputs(3)
    torch.manual_seed(2)
    layer = Depthwise(_CHANNELS, 5)
    plain = torch.nn.Conv2d(_CHANNELS, _CHANNELS, 5, padding=2, groups=_CHANNELS, bias=False)
    plain.load_state_dict(layer.state_dict())
    torch.testing.assert_close(layer(features), plain(features))
    same = SamePadded(_CHANNELS, _CHANNELS, 3, 2, groups=_CHANNELS)
    # what is odd of the padding goes to the right and bottom
    wanted = _own(functional.pad(features, (0, 1, 0, 1)), same.weight, same.bias, 2, 0)
    torch.testing.assert_close(same(features), wanted)
