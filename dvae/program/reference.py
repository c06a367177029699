"""The generative program as an explicit loop over time; tests compare the vectorised program with it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pyro
import torch
from torch import Tensor

from .batch import AnyBatch
from .conditional import like


def reference(model: Any, batch: AnyBatch) -> None:
    """Run the generative program of a `DynamicalVAE` as a loop over time, with one site per variable and step.

    Sites are named "z_1", "x_1", "z_2", ... as in the equations. Each factor receives noise in place of values that are
    not drawn yet. A network that reads future values therefore changes the result. Slow.
    """
    rollout = model.rollout(batch)
    context = {name: value for name, value in rollout.values.items() if name not in model.observed}
    size, length = rollout.batch, rollout.length

    def distribution(name: str, sofar: Mapping[str, list[Tensor]]) -> Any:
        conditional = model.generator[name]
        parents = dict(context)
        for other, values in sofar.items():
            later = torch.randn(size, length - len(values), model.sizes[other]).to(like(model))
            parents[other] = torch.cat([torch.stack(values, 1), later], 1) if values else later
        return conditional.head, conditional(parents, size, length)

    with pyro.plate("sequences", size, dim=-1):
        for block in model.generative.blocks:
            if not model.generative.local(block.names[0]):
                (name,) = block.names
                head, parameters = distribution(name, {})
                context[name] = pyro.sample(name, head.joint(parameters))
                continue
            sofar: dict[str, list[Tensor]] = {name: [] for name in block.names}
            for t in pyro.markov(range(length), history=length):
                for name in block.names:
                    head, parameters = distribution(name, sofar)
                    at_t = head.joint(tuple(p[:, t] for p in parameters))
                    data = rollout.values[name][:, t] if name in model.observed else None
                    sofar[name].append(pyro.sample(f"{name}_{t + 1}", at_t, obs=data))
            context |= {name: torch.stack(values, 1) for name, values in sofar.items()}
