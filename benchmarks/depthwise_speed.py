"""How long a depthwise convolution takes to learn, torch's own against ours (sorvolo.lab.training.depthwise).

python benchmarks/depthwise_speed.py [--repeats 15]

Forward and backward of one layer on one thread, the median over the repeats, the two in turn; in bfloat16 (autocast)
and in float32. The shapes are those of the `fast` preset in a joint step (four samples of 416 px): the backbone's
blocks, the pyramid and the proposals' stacks. Outputs and gradients of both are compared: the largest
difference, as a share of the largest value. Written to results/depthwise_speed.json.
"""

import argparse
import json
import statistics
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import torch
from torch import Tensor
from torch.nn import functional

from mosaic_methods import commit, machine
from sorvolo.lab.training.depthwise import depthwise

RESULTS = Path(__file__).parent / "results" / "depthwise_speed.json"
LAYERS = {  # channels, side of its features, kernel, stride, whether the kernel learns
    "backbone, stride 2, kernel kept": (96, 208, 3, 2, False),
    "backbone, stride 4, kernel kept": (144, 104, 5, 2, False),
    "backbone, stride 8": (240, 52, 3, 2, True),
    "backbone, stride 16": (480, 26, 5, 1, True),
    "stack, level 4, 3x3": (64, 104, 3, 1, True),
    "stack, level 4, 7x7": (64, 104, 7, 1, True),
    "stack, level 8, 5x5": (64, 52, 5, 1, True),
}
BATCH = 4


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeats", type=int, default=15)
    options = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    rows = []
    for name, (channels, side, kernel, stride, learns) in LAYERS.items():
        shape = BATCH, channels, side, side
        given = torch.rand(shape).to(memory_format=torch.channels_last)
        weight = torch.randn(channels, 1, kernel, kernel, requires_grad=learns)
        for half in (True, False):
            features = given.bfloat16() if half else given  # as the layer before hands them on
            ways = {
                "torch": partial(step, _torchs, features, weight, stride, half),
                "ours": partial(step, depthwise, features, weight, stride, half),
            }
            answers = {way: run() for way, run in ways.items()}  # the first of each is not timed
            milliseconds: dict[str, list[float]] = {way: [] for way in ways}
            for _ in range(options.repeats):
                for way, run in ways.items():
                    started_s = time.process_time()
                    run()
                    milliseconds[way].append(1000 * (time.process_time() - started_s))
            row = {
                "layer": name,
                "channels": channels,
                "side": side,
                "kernel": kernel,
                "stride": stride,
                "kernel_learns": learns,
                "numbers": "bfloat16" if half else "float32",
                **{
                    f"{way}_ms": round(statistics.median(each), 2)
                    for way, each in milliseconds.items()
                },
                **{
                    f"{way}_spread_ms": round(max(each) - min(each), 2)
                    for way, each in milliseconds.items()
                },
                "difference": max(map(difference, answers["ours"], answers["torch"])),
            }
            rows.append(row)
            print(row, flush=True)
    RESULTS.write_text(
        json.dumps(
            {
                "benchmark": "depthwise_speed",
                "machine": machine(),
                "commit": commit(),
                "torch": torch.__version__,
                "threads": 1,
                "batch": BATCH,
                "repeats": options.repeats,
                "clock": "processor time",
                "rows": rows,
            },
            indent=1,
        )
        + "\n"
    )


def step(
    convolve: Callable[..., Tensor], features: Tensor, weight: Tensor, stride: int, half: bool
) -> list[Tensor]:
    """The output of one layer, and the gradients of its features and, if it learns, of its weights."""
    own = features.detach().requires_grad_()
    with torch.autocast("cpu", torch.bfloat16, enabled=half):
        out = convolve(own, weight, None, stride, weight.shape[-1] // 2)
    known = [own, weight] if weight.requires_grad else [own]
    return [out.detach(), *torch.autograd.grad(out, known, 2 * out.detach())]


def difference(mine: Tensor, theirs: Tensor) -> float:
    """The largest difference as a share of the largest value."""
    return float((mine.float() - theirs.float()).abs().max() / theirs.float().abs().max())


def _torchs(
    features: Tensor, weight: Tensor, bias: Tensor | None, stride: int, padding: int
) -> Tensor:
    return functional.conv2d(features, weight, bias, stride, padding, groups=len(weight))


if __name__ == "__main__":
    main()
