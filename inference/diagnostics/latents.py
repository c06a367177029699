"""Latents as flat vectors, and the posterior of one sequence in the guide's standard deviations."""

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
from ..bounds.elbo import log_densities, require_data, require_densities, require_latents, total

Values = Mapping[str, Tensor]
Shapes = Mapping[str, tuple[int, int]]
"""Number of steps and dimension of each latent, by name; 0 steps for a static one."""
CHUNK = 4096
"""Largest number of rows of a batch in memory."""
_MIN_SCALE = 1e-6


def joined(values: Values) -> Tensor:
    """Return latents (..., B, ...) as flat vectors (..., B, P); B is the first dimension of each."""
    return torch.cat([value.reshape(len(value), -1) for value in values.values()], -1)


def split(flat: Tensor, like: Values) -> dict[str, Tensor]:
    """Return latents by name from flat vectors (..., P), in the shapes of `like`."""
    shapes = {name: value.shape[1:] for name, value in like.items()}
    parts = flat.split([shape.numel() for shape in shapes.values()], -1)
    each = zip(shapes.items(), parts, strict=True)
    return {name: part.reshape(*part.shape[:-1], *shape) for (name, shape), part in each}


def quantities(model: DynamicalVAE, steps: Iterable[int]) -> tuple[str, ...]:
    """Return names of the scalar entries of latents: "w[0]", "z_3[1]" (step from 1, coordinate from 0).

    Args:
        model: model with these latents.
        steps: steps of the local latents, from 1.
    """
    local = [f"_{t}" for t in steps]
    return tuple(
        f"{name}{step}[{d}]"
        for name in model.latents
        for step in (local if model.generative.local(name) else [""])
        for d in range(model.sizes[name])
    )


def some_of(model: DynamicalVAE, batch: AnyBatch, sequences: Sequence[int] | None) -> list[Batch]:
    """Return batches of one sequence each, after checking that the log posterior has a gradient in the latents.

    Args:
        model: the model.
        batch: batch as in `DynamicalVAE.model`.
        sequences: indices of sequences in the batch; None for all.

    Raises:
        ValueError: when the model has no likelihood or latents, or a latent is shared by sequences or cannot take every
            real value. Also when data are missing, or a sequence is not in the batch.
    """
    require_densities(model)
    require_latents(model)
    require_real(model)
    data = model.read(batch)
    if model.grouped and data.group is not None:
        raise ValueError("sequences of a group have one joint posterior; remove 'group' from the batch")
    size = require_data(model, data)
    indices = range(size) if sequences is None else sequences
    if not indices or not set(indices) <= set(range(size)):
        raise ValueError(f"sequences must be some of 0 to {size - 1}, the rows of the batch; got {list(indices)}")
    return [rows(data, slice(index, index + 1)) for index in indices]


def require_real(model: DynamicalVAE) -> None:
    """Refuse latents that cannot take every real value, which gradient-based sampling requires.

    Raises:
        ValueError: when the model has such a latent.
    """
    for name in model.latents:
        conditional = model.generator[name]
        if conditional.support is not None or conditional.head.deterministic:
            raise ValueError(
                f"the distribution of {conditional.factor} restricts the values of the latent {name}, but "
                "gradient-based sampling requires latents on the whole real line; "
                "use a distribution such as distributions.Normal()"
            )


class Inferred:
    """Latents of one sequence as P numbers u, with draws of the guide and the posterior density up to a constant.

        z = m + s u,    m and s: mean and standard deviation of each number over the guide's draws

    Numbers at padding are excluded, because the posterior does not depend on them.

    Args:
        model: model with its guide.
        data: batch of one sequence, as the model reads it.
        guide: Pyro program of the batch with a site for every latent; None for the model's guide.
        draws: K, number of draws of the guide for m and s.

    Raises:
        ValueError: when the guide has no site for a latent.
        FloatingPointError: when draws are not finite.
    """

    def __init__(self, model: DynamicalVAE, data: Batch, guide: Callable[..., Any] | None, draws: int):
        self.model, self.data, self.guide = model, data, guide or model.guide
        self._like = self._of_guide(1)
        self.shapes: Shapes = {name: (v.shape[1] if v.dim() == 3 else 0, v.shape[-1]) for name, v in self._like.items()}
        masks = {name: torch.ones_like(value, dtype=torch.bool) for name, value in self._like.items()}
        if data.lengths is not None:
            valid = [(steps, valid_steps(data.lengths, steps)[..., None]) for steps, _ in self.shapes.values()]
            masks = {n: v & ok if steps else v for (n, v), (steps, ok) in zip(masks.items(), valid, strict=True)}
        self.valid = joined(masks)[0]
        self.draws = self.drawn(draws)
        if not self.draws.isfinite().all():
            raise FloatingPointError("the guide draws latents that are not finite; check whether it has been fitted")
        self._template = joined(self._like)
        self.center, self.scale = self.draws.mean(0), self.draws.std(0).clamp(min=_MIN_SCALE)
        self._repeated: tuple[int, Any] = 0, None

    def drawn(self, n: int) -> Tensor:
        """Return draws z (n, P) of the guide."""
        counts = [min(CHUNK, n - first) for first in range(0, n, CHUNK)]
        return torch.cat([joined(self._of_guide(count))[:, self.valid] for count in counts])

    def prior(self, n: int) -> Tensor:
        """Return draws z (n, P) from the model's conditionals, which do not use the data of their step."""
        draws = self.model.model(repeat(self.data, n))
        return joined({name: draws[name] for name in self.model.latents})[:, self.valid]

    def whitened(self, z: Tensor) -> Tensor:
        """Return u = (z - mean) / scale, (..., P), by mean and standard deviation of the guide's draws."""
        return (z - self.center) / self.scale

    def log_joint(self, u: Tensor) -> Tensor:
        """Return log p(x, z) of u (R, P), up to a constant, (R,)."""
        if self._repeated[0] != len(u):
            self._repeated = len(u), repeat(self.data, len(u))
        flat = self._template.repeat(len(u), 1)
        flat[:, self.valid] = (self.center + self.scale * u).to(flat)  # NUTS converts single precision to double
        program = poutine.condition(self.model.model, data=split(flat, self._like))
        with torch.backends.cudnn.flags(enabled=False):  # no gradients of recurrent networks in evaluation mode
            return total(log_densities(poutine.trace(program).get_trace(self._repeated[1])))

    def score(self, u: Tensor) -> Tensor:
        """Return the gradient of `log_joint`, (R, P)."""
        parts = []
        for chunk in u.split(CHUNK):
            with torch.enable_grad():
                chunk = chunk.detach().requires_grad_()
                (slope,) = torch.autograd.grad(self.log_joint(chunk).sum(), [chunk])
                parts.append(slope)
        return torch.cat(parts)

    def whole(self, values: Tensor) -> Tensor:
        """Return values (..., P) as (..., Q), with NaN at padding."""
        result = values.new_full((*values.shape[:-1], len(self.valid)), math.nan)
        result[..., self.valid.to(values.device)] = values
        return result

    def _of_guide(self, n: int) -> dict[str, Tensor]:
        sites = poutine.trace(self.guide).get_trace(repeat(self.data, n)).nodes
        if missing := [name for name in self.model.latents if name not in sites]:
            raise ValueError(f"the guide has no site for {', '.join(missing)}; it needs one for each latent")
        values: dict[str, Any] = {name: sites[name]["value"] for name in self.model.latents}
        return {name: value.detach() for name, value in values.items()}
