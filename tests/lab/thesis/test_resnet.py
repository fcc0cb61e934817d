"""ResNet-50: Keras' weights compute what Keras computes (a NumPy reference), and layers stay as they should."""

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from numpy.typing import NDArray

from sorvolo.lab.thesis.resnet import (
    FrozenNorm,
    ResNet50,
    load_imagenet,
    resnet50_from_keras,
    resnet_stage,
)

Array = NDArray[np.float32]
_STAGES = {2: (64, 3), 3: (128, 4), 4: (256, 6), 5: (512, 3)}
_EPSILON = 1e-3


@pytest.fixture(scope="module")
def keras() -> dict[str, Array]:
    """Random layers by Keras' names and shapes (height, width, in, out), scaled so that features stay of order one."""
    rng = np.random.default_rng(5)
    noise = rng.standard_normal(1 << 16).astype(np.float32)
    layers: dict[str, Array] = {}

    def add(conv: str, norm: str, kernel: int, channels: int, out: int) -> None:
        count = kernel * kernel * channels * out
        start = rng.integers(1 << 15)
        values = np.resize(np.roll(noise, start), count) * np.sqrt(
            1.5 / (kernel * kernel * channels)
        )
        layers[f"{conv}/kernel"] = values.reshape(kernel, kernel, channels, out).astype(np.float32)
        layers[f"{conv}/bias"] = rng.normal(0, 0.3, out).astype(np.float32)
        layers[f"{norm}/gamma"] = rng.uniform(0.5, 1.0, out).astype(np.float32)
        layers[f"{norm}/beta"] = rng.normal(0, 0.2, out).astype(np.float32)
        layers[f"{norm}/moving_mean"] = rng.normal(0, 0.3, out).astype(np.float32)
        layers[f"{norm}/moving_variance"] = rng.uniform(0.001, 1.5, out).astype(np.float32)

    add("conv1", "bn_conv1", 7, 3, 64)
    layers["conv1/kernel"] /= 60.0
    channels = 64
    for stage, (inner, repeats) in _STAGES.items():
        for repeat in range(repeats):
            name = f"{stage}{'abcdef'[repeat]}_branch"
            add(f"res{name}2a", f"bn{name}2a", 1, channels, inner)
            add(f"res{name}2b", f"bn{name}2b", 3, inner, inner)
            add(f"res{name}2c", f"bn{name}2c", 1, inner, 4 * inner)
            if repeat == 0:
                add(f"res{name}1", f"bn{name}1", 1, channels, 4 * inner)
            channels = 4 * inner
    return layers


@pytest.fixture(scope="module")
def ours(keras: dict[str, Array]) -> dict[str, "torch.Tensor"]:
    norms = {name.split("/")[0] for name in keras if name.endswith("gamma")}
    return resnet50_from_keras(keras, {name: {"epsilon": _EPSILON} for name in norms})


def _convolved(x: Array, layers: dict[str, Array], conv: str, norm: str, stride: int) -> Array:
    """(H, W, C), already padded -> convolution with bias, batch norm; Keras' "valid"."""
    kernel = layers[f"{conv}/kernel"].astype(np.float64)
    side = kernel.shape[0]
    windows = np.lib.stride_tricks.sliding_window_view(x, (side, side), axis=(0, 1))[
        ::stride, ::stride
    ]
    y = np.tensordot(windows, kernel, axes=((3, 4, 2), (0, 1, 2))) + layers[f"{conv}/bias"]
    scale = layers[f"{norm}/gamma"] / np.sqrt(
        layers[f"{norm}/moving_variance"].astype(np.float64) + _EPSILON
    )
    return (y - layers[f"{norm}/moving_mean"]) * scale + layers[f"{norm}/beta"]


def _keras_features(rgb: Array, layers: dict[str, Array]) -> list[Array]:
    """res2 to res5 of Keras' ResNet-50 ("caffe" preprocessing), as its model.json draws them."""
    x = rgb[..., ::-1] - np.array([103.939, 116.779, 123.68])
    x = np.maximum(
        _convolved(np.pad(x, ((3, 3), (3, 3), (0, 0))), layers, "conv1", "bn_conv1", 2), 0
    )
    x = np.pad(x, ((1, 1), (1, 1), (0, 0)))
    x = np.lib.stride_tricks.sliding_window_view(x, (3, 3), axis=(0, 1))[::2, ::2].max((3, 4))
    levels = []
    for stage, (_, repeats) in _STAGES.items():
        for repeat in range(repeats):
            name = f"{stage}{'abcdef'[repeat]}_branch"
            stride = 2 if repeat == 0 and stage > 2 else 1
            y = np.maximum(_convolved(x, layers, f"res{name}2a", f"bn{name}2a", stride), 0)
            y = np.pad(y, ((1, 1), (1, 1), (0, 0)))
            y = np.maximum(_convolved(y, layers, f"res{name}2b", f"bn{name}2b", 1), 0)
            y = _convolved(y, layers, f"res{name}2c", f"bn{name}2c", 1)
            short = _convolved(x, layers, f"res{name}1", f"bn{name}1", stride) if repeat == 0 else x
            x = np.maximum(y + short, 0)
        levels.append(x)
    return levels


def test_keras_weights_compute_keras_function(
    keras: dict[str, Array], ours: dict[str, "torch.Tensor"]
) -> None:
    picture = np.random.default_rng(1).integers(0, 256, (64, 96, 3)).astype(np.float32)
    wanted = _keras_features(picture, keras)
    images = torch.from_numpy(picture.transpose(2, 0, 1)[None].copy())
    net, stage = ResNet50(frozen=True).eval(), resnet_stage(4, frozen=True).eval()
    load_imagenet(net, ours)
    load_imagenet(stage, ours, "layer4.")
    with torch.no_grad():
        c4 = net(images)
        found = [c4, stage(c4)]
    assert [tuple(each.shape[1:]) for each in found] == [(1024, 4, 6), (2048, 2, 3)]
    for each, level in zip(found, wanted[2:]):
        assert np.abs(each[0].permute(1, 2, 0).numpy() - level).max() < 1e-3 * level.std()


def test_what_stays_as_it_is(ours: dict[str, "torch.Tensor"]) -> None:
    net = ResNet50(frozen=True)
    load_imagenet(net, ours)
    before = {name: value.clone() for name, value in net.state_dict().items()}
    optimiser = torch.optim.SGD([each for each in net.parameters() if each.requires_grad], lr=1.0)
    net.train()
    net(torch.rand(2, 3, 32, 32) * 255).square().mean().backward()
    optimiser.step()
    changed = {
        name for name, value in net.state_dict().items() if not torch.equal(value, before[name])
    }
    assert changed
    for name in changed:
        assert name.startswith(("layer2", "layer3")) and (
            "conv" in name or "downsample.0" in name
        ), name


def test_norms_learn_if_asked() -> None:
    net = ResNet50(frozen=False)
    assert not any(isinstance(module, FrozenNorm) for module in net.modules())
    assert all(each.requires_grad for each in net.parameters())


def test_a_frozen_norm_is_batch_norm_in_evaluation() -> None:
    torch.manual_seed(0)
    norm, frozen = torch.nn.BatchNorm2d(5), FrozenNorm(5)
    with torch.no_grad():
        for each in (norm.weight, norm.bias, norm.running_mean):
            each.normal_()
        norm.running_var.uniform_(0.1, 2)
    frozen.load_state_dict({k: v for k, v in norm.state_dict().items() if "num" not in k})
    x = torch.randn(2, 5, 4, 4)
    assert torch.allclose(frozen(x), norm.eval()(x), atol=1e-5)
