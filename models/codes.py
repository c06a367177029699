"""The diversity of what a decoder starts from: whether a model that draws noise still listens to it as it learns.

A conditional model that makes a future from a code of its past and noise may learn to ignore the noise. With h_1, ...,
h_K the codes that K draws make of one observation, their diversity is

    d = 2 / (K (K - 1)) sum_{j < k} ||h_j - h_k||

of which the mean and the standard deviation over 50 observations, K = 50, are Figure 1 of Aliakbarian, Saleh, Salzmann,
Petersson and Gould, 2020, arXiv 1908.00733. It is in the code's own unit, so that a model compares with itself over
training, and with others by whether it rises or falls.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn
from typing_extensions import override

from ..inference.fit import Callback
from ..inference.held import on_device_of, reproducibly
from ..inference.metrics import average_pairwise_distance
from ..inference.svi import State
from ..program.batch import AnyBatch
from ..views import WHOLE


@torch.no_grad()
def codes(model: Any, batch: AnyBatch, samples: int = 50) -> Tensor:
    """The codes that a forecast of a batch starts from, with noise and whatever else is random as a forecast has them.

    Where each step has a latent of its own, the first state is that of the past alone; codes are then the features that
    the first pose is made of, in which z_1 has joined that state.

    Args:
        model: whose network of x has an `entrance`, the module through which the noise enters, such as those of
            "mix-and-match".
        batch: the past (B, O, D), as `forecast` takes it.
        samples: K.

    Returns:
        (K, B, L).

    Raises:
        TypeError: a model without such a network.
    """
    network = model.generator[WHOLE].network
    entrance = getattr(network, "entrance", None)
    if not isinstance(entrance, nn.Module):
        raise TypeError(
            f"codes are of a decoder with an entrance, the module through which noise enters; {type(network).__name__} "
            "has none"
        )
    seen: list[Tensor] = []
    hook = entrance.register_forward_hook(lambda module, given, made: seen.append(made))
    try:
        size = model.forecast(batch, 1, samples, chunk=2**62)[WHOLE].shape[1]  # at once
    finally:
        hook.remove()
    return seen[0].unflatten(0, (samples, size))


def code_diversity(model: Any, batch: AnyBatch, samples: int = 50) -> Tensor:
    """The mean distance of two of K `codes` of each observation, (B,)."""
    found: Tensor = average_pairwise_distance(codes(model, batch, samples).movedim(0, 1)[:, :, None])
    return found


class CodeDiversity(Callback):
    """Writes the diversity of codes into the log of a fit: "codes/diversity" and "codes/deviation", every few steps.

    They are the mean and the standard deviation over the observations of a batch, of which the draws are the same each
    time. The run itself goes as it would without.

    Args:
        batch: the past of held-out windows, as `forecast` takes it; 50 of them in the paper.
        every: steps from one to the next.
        samples: K.
        seed: of the draws.
    """

    def __init__(self, batch: Mapping[str, Any], every: int = 100, samples: int = 50, seed: int = 0) -> None:
        self.batch, self.every, self.samples, self.seed = batch, every, samples, seed

    @override
    def on_step(self, state: State) -> Mapping[str, float] | None:
        if state.step % self.every:
            return None
        with reproducibly(state.model, self.seed):
            found = code_diversity(state.model, on_device_of(state.model, self.batch), self.samples)
        return {"codes/diversity": float(found.mean()), "codes/deviation": float(found.std())}
