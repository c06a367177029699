"""Latents as rows of numbers, and the posterior of one sequence where these are measured in the guide's deviations."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import torch
from pyro import poutine
from torch import Tensor

from ...data.batch import Batch
from ...networks.loop import valid_steps
from ...program.batch import AnyBatch, repeat, rows
from ...program.model import DynamicalVAE
from ..bounds.elbo import log_densities, require_data, require_latents, require_likelihood, total

Values = Mapping[str, Tensor]
Shapes = Mapping[str, tuple[int, int]]
"""Latent to steps and dimension; no steps of a static one."""
CHUNK = 4096
"""Rows of a batch that are held at once."""
_LEAST = 1e-6


def joined(values: Values) -> Tensor:
    """(..., B, P) of latents (..., B, ...), of which all but one dimension is of a sequence."""
    return torch.cat([value.reshape(len(value), -1) for value in values.values()], -1)


def split(flat: Tensor, like: Values) -> dict[str, Tensor]:
    """Latents (..., ...) of (..., P), in the shapes of these."""
    shapes = {name: value.shape[1:] for name, value in like.items()}
    parts = flat.split([shape.numel() for shape in shapes.values()], -1)
    each = zip(shapes.items(), parts, strict=True)
    return {name: part.reshape(*part.shape[:-1], *shape) for (name, shape), part in each}


def quantities(model: DynamicalVAE, steps: Iterable[int]) -> tuple[str, ...]:
    """What single numbers of latents are called: "w[0]", "z_3[1]" (step from 1, coordinate from 0)."""
    local = [f"_{t}" for t in steps]
    return tuple(
        f"{name}{step}[{d}]"
        for name in model.latents
        for step in (local if model.generative.local(name) else [""])
        for d in range(model.sizes[name])
    )


def some_of(model: DynamicalVAE, batch: AnyBatch, sequences: Sequence[int] | None) -> list[Batch]:
    """Batches of one sequence each, as the model reads them, of those whose posteriors have a score.

    Args:
        model: the model.
        batch: see `DynamicalVAE.model`.
        sequences: which of the batch; None for all.

    Raises:
        ValueError: a model without likelihood or latents, with latents that are not any real numbers, or whose
            sequences share some; data that are missing; sequences that are not in the batch.
    """
    require_likelihood(model)
    require_latents(model)
    for name in model.latents:
        conditional = model.generator[name]
        if conditional.support is not None or conditional.law.deterministic:
            raise ValueError(
                f"the latent {name} cannot be any real number by the law of {conditional.factor}; gradients lead "
                "through posteriors on the whole line alone, such as those of distributions.Normal()"
            )
    data = model.read(batch)
    if model.grouped and data.group is not None:
        raise ValueError("sequences of a group have one posterior together; leave 'group' out of the batch")
    size = require_data(model, data)
    chosen = range(size) if sequences is None else sequences
    if not chosen or not set(chosen) <= set(range(size)):
        raise ValueError(f"sequences are some of 0 to {size - 1}, the rows of the batch; got {list(chosen)}")
    return [rows(data, slice(each, each + 1)) for each in chosen]


class Inferred:
    """The latents of one sequence as P numbers u: what the guide draws, and the density that they should have.

        z = m + s u,    m and s: mean and standard deviation of the guide's draws, number by number

    Numbers at padding, which the posterior says nothing of, are not among them.

    Args:
        model: with its guide.
        data: of one sequence, as the model reads them.
        guide: a Pyro program of the batch with a site for every latent; None for the model's own.
        draws: K of the guide, of which m and s are.

    Raises:
        ValueError: a guide without some latent.
        FloatingPointError: draws that are not finite.
    """

    def __init__(self, model: DynamicalVAE, data: Batch, guide: Callable[..., Any] | None, draws: int):
        self.model, self.data, self.guide = model, data, guide or model.guide
        self._like = self._of_guide(1)
        self.shapes: Shapes = {name: (v.shape[1] if v.dim() == 3 else 0, v.shape[-1]) for name, v in self._like.items()}
        there = {name: torch.ones_like(value, dtype=torch.bool) for name, value in self._like.items()}
        if data.lengths is not None:
            valid = [(steps, valid_steps(data.lengths, steps)[..., None]) for steps, _ in self.shapes.values()]
            there = {n: v & ok if steps else v for (n, v), (steps, ok) in zip(there.items(), valid, strict=True)}
        self.there = joined(there)[0]
        self.draws = self.drawn(draws)
        if not self.draws.isfinite().all():
            raise FloatingPointError("the guide draws latents that are not finite; see whether it has been fitted")
        self._elsewhere = joined(self._like)
        self.center, self.scale = self.draws.mean(0), self.draws.std(0).clamp(min=_LEAST)
        self._repeated: tuple[int, Any] = 0, None

    def drawn(self, n: int) -> Tensor:
        """(n, P) draws z of the guide."""
        counts = [min(CHUNK, n - first) for first in range(0, n, CHUNK)]
        return torch.cat([joined(self._of_guide(count))[:, self.there] for count in counts])

    def prior(self, n: int) -> Tensor:
        """(n, P) draws z of what the model says of them before it has seen the data of their own step."""
        drawn = self.model.model(repeat(self.data, n))
        return joined({name: drawn[name] for name in self.model.latents})[:, self.there]

    def whitened(self, z: Tensor) -> Tensor:
        """(..., P) numbers u of z."""
        return (z - self.center) / self.scale

    def log_joint(self, u: Tensor) -> Tensor:
        """(R,) log p(x, z) of u (R, P), but for a constant."""
        if self._repeated[0] != len(u):
            self._repeated = len(u), repeat(self.data, len(u))
        flat = self._elsewhere.repeat(len(u), 1)
        flat[:, self.there] = (self.center + self.scale * u).to(flat)  # of single precision NUTS makes double
        program = poutine.condition(self.model.model, data=split(flat, self._like))
        with torch.backends.cudnn.flags(enabled=False):  # which has no gradients of recurrent networks in evaluation
            return total(log_densities(poutine.trace(program).get_trace(self._repeated[1])))

    def score(self, u: Tensor) -> Tensor:
        """(R, P), the gradient of `log_joint`."""
        parts = []
        for some in u.split(CHUNK):
            with torch.enable_grad():
                some = some.detach().requires_grad_()
                (slope,) = torch.autograd.grad(self.log_joint(some).sum(), [some])
                parts.append(slope)
        return torch.cat(parts)

    def whole(self, values: Tensor) -> Tensor:
        """(..., Q) of (..., P), NaN at padding."""
        found = values.new_full((*values.shape[:-1], len(self.there)), math.nan)
        found[..., self.there] = values
        return found

    def _of_guide(self, n: int) -> dict[str, Tensor]:
        sites = poutine.trace(self.guide).get_trace(repeat(self.data, n)).nodes
        if missing := [name for name in self.model.latents if name not in sites]:
            raise ValueError(f"the guide draws no {', '.join(missing)}; it needs one site for each latent")
        values: dict[str, Any] = {name: sites[name]["value"] for name in self.model.latents}
        return {name: value.detach() for name, value in values.items()}
