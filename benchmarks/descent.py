"""A network in training: AdamW along a falling rate, weights averaged, able to go on after a stop."""

import math
from collections.abc import Mapping
from copy import deepcopy

import torch
from torch import Tensor, nn

WARM, LEAST, CLIP, AVERAGED, DECAY = 60, 0.02, 10.0, 0.998, 0.02


class Descent:
    """`net` learns, `averaged` is what is kept of it. Only `descend` and `load` change them."""

    def __init__(
        self,
        net: nn.Module,
        rate: float,
        steps: int,
        device: str,
        shares: Mapping[str, float] | None = None,
    ) -> None:
        """`shares`: for the names of modules that `net` has, by which part of the rate each learns; None: all of it."""
        self.net = net.to(device, memory_format=torch.channels_last).train()  # type: ignore[call-overload]
        self.averaged, self.device = deepcopy(self.net).eval(), device
        self.rate, self.steps, self.step = rate, steps, 0
        parts = {name: self.net.get_submodule(name).parameters() for name in shares or {"": 1.0}}
        self.optimiser = torch.optim.AdamW(
            [
                {"params": each, "share": (shares or {}).get(name, 1.0)}
                for name, each in parts.items()
            ],
            rate,
            weight_decay=DECAY,
        )

    def descend(self, loss: Tensor) -> float:
        """One step; the loss before it."""
        falling = 0.5 + 0.5 * math.cos(math.pi * min(self.step / self.steps, 1.0))
        for group in self.optimiser.param_groups:
            group["lr"] = (
                self.rate
                * group["share"]
                * min((self.step + 1) / WARM, LEAST + (1 - LEAST) * falling)
            )
        self.optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(self.net.parameters(), CLIP)
        self.optimiser.step()
        self.step += 1
        share = min(AVERAGED, (1 + self.step) / (10 + self.step))
        with torch.no_grad():
            for own, new in zip(self.averaged.parameters(), self.net.parameters()):
                own.lerp_(new, 1 - share)
        return float(loss.detach())

    def state(self) -> dict[str, object]:
        """All that `load` needs to go on."""
        return {
            "net": self.net.state_dict(),
            "averaged": self.averaged.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "step": self.step,
        }

    def load(self, state: dict[str, object]) -> None:
        """Go on from a checkpoint."""
        self.net.load_state_dict(state["net"])
        self.averaged.load_state_dict(state["averaged"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.step = int(state["step"])
