"""The diversity of what a decoder starts from: how much what a model draws, as it learns, makes of one past.

A conditional model that makes a future from a code of its past and noise may learn to ignore the noise. With h_1, ...,
h_K the codes that K draws make of one observation, their diversity is

    d = 2 / (K (K - 1)) sum_{j < k} ||h_j - h_k||

of which the mean and the standard deviation over 50 observations, K = 50, are Figure 1 of Aliakbarian, Saleh, Salzmann,
Petersson and Gould, 2020, arXiv 1908.00733. It is in the code's own unit, so that a model compares with itself over
training, and with others by whether it rises or falls.

Where indices are drawn too, as Mix-and-Match does, each code has its own: they alone make codes differ, and those of a
decoder that is deaf to z as well. What z makes of it is told with the indices drawn once for all K.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn
from typing_extensions import override

from ...data.batch import WHOLE
from ...inference.evaluation.held import on_device_of, reproducibly
from ...inference.evaluation.metrics import average_pairwise_distance
from ...inference.training.fit import Callback
from ...inference.training.svi import State
from ...program.batch import AnyBatch


@torch.no_grad()
def codes(model: Any, batch: AnyBatch, samples: int = 50) -> Tensor:
    """The codes that a forecast of a batch starts from, with noise and whatever else is random as a forecast has them.

    Where each step has a latent of its own, the first state is that of the past alone; codes are then the features that
    the first pose is made of, in which z_1 has joined that state.

    Args:
        model: whose network of x has an `entrance`, the module through which the noise enters, such as those of
            "mix-and-match".
        batch: the past (B, O, D), as `forecast` takes it; what all codes are to share in it, such as indices, as
            `model.read(batch)` has drawn them.
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
    """The mean distance of two of K `codes` of each observation, (B,).

    Raises:
        ValueError: less than two codes.
    """
    if samples < 2:
        raise ValueError(f"samples is {samples}; codes differ where there are two of them or more")
    found: Tensor = average_pairwise_distance(codes(model, batch, samples).movedim(0, 1)[:, :, None])
    return found


class CodeDiversity(Callback):
    """Writes the diversity of codes into the log of a fit: "codes/diversity" and "codes/deviation", every few steps.

    They are the mean and the standard deviation over the observations of a batch, of which the draws are the same each
    time. Where sequences share what a model draws, "codes/latent" is the mean with that drawn once, which is what the
    latents make. The run itself goes as it would without.

    Args:
        batch: the past of at least two held-out windows, as `forecast` takes it; 50 of them in the paper.
        every: steps from one to the next.
        samples: K.
        seed: of the draws.
    """

    def __init__(self, batch: Mapping[str, Any], every: int = 100, samples: int = 50, seed: int = 0) -> None:
        if every < 1 or samples < 2 or len(batch[WHOLE]) < 2:
            raise ValueError(
                f"codes of {len(batch[WHOLE])} pasts, {samples} each, every {every} steps; give at least two pasts, "
                "two samples and one step"
            )
        self.batch, self.every, self.samples, self.seed = batch, every, samples, seed

    @override
    def on_step(self, state: State) -> Mapping[str, float] | None:
        if state.step % self.every:
            return None
        model: Any = state.model
        batch = on_device_of(model, self.batch)
        with reproducibly(model, self.seed):
            found = code_diversity(model, batch, self.samples)
        row = {"codes/diversity": float(found.mean()), "codes/deviation": float(found.std())}
        if getattr(model, "shared", None):
            with reproducibly(model, self.seed):
                row["codes/latent"] = float(code_diversity(model, model.read(batch), self.samples).mean())
        return row
