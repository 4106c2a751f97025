"""The moving average of a network's weights, which does better than the weights of any one step."""

from __future__ import annotations

import copy
from typing import Any

import torch
from torch import nn


class WeightAverage:
    """An exponential moving average of all weights and of batch normalisation's statistics.

    `decay` counts per step; at the start it is lower, so that the first weights, which know nothing, are soon
    forgotten: min(decay, (1 + n) / (10 + n)) after n steps. Source: B. Polyak and A. Juditsky, "Acceleration of
    stochastic approximation by averaging", 1992, in its exponential form.
    """

    def __init__(self, network: nn.Module, decay: float) -> None:
        self.network = copy.deepcopy(network).requires_grad_(False).eval()
        self._decay = decay
        self._steps = 0

    @torch.no_grad()
    def update(self, network: nn.Module) -> None:
        """Takes in the weights of `network` after a step."""
        self._steps += 1
        share = 1.0 - min(self._decay, (1 + self._steps) / (10 + self._steps))
        mine, theirs = self.network.state_dict(), network.state_dict()
        floats = [key for key, value in mine.items() if value.is_floating_point()]
        torch._foreach_lerp_([mine[key] for key in floats], [theirs[key] for key in floats], share)
        for key in mine.keys() - set(floats):  # counters
            mine[key].copy_(theirs[key])

    def state(self) -> dict[str, Any]:
        """What `restore` goes on from."""
        return {"network": self.network.state_dict(), "steps": self._steps}

    def restore(self, state: dict[str, Any]) -> None:
        """Goes on from a saved `state`."""
        self.network.load_state_dict(state["network"])
        self._steps = int(state["steps"])
