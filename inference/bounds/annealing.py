"""Bounds on the evidence from both sides: annealed importance sampling from guide to posterior, and in reverse.

    f_b(z) = q(z | x)^(1 - b) p(x, z)^b,    0 = b_0 < ... < b_L = 1,
    log w  = sum_l (b_l - b_{l-1}) (log p(x, z_l) - log q(z_l | x)),   z_1 ~ q,   z_{l+1} ~ T_l(z_l)

The transition T_l leaves f_{b_l} invariant. The mean weight is unbiased for p(x) (Neal, 2001), so its logarithm is a
lower bound on average. The larger L, the less the bound depends on the quality of the guide; with L = 1 it is the IWAE
bound.

If data are simulated from the model, the simulated latents are an exact draw from their posterior. Chains that start
there and run back to the guide give weights whose mean inverse is unbiased for 1 / p(x): an upper bound (bidirectional
Monte Carlo: Grosse, Ghahramani and Adams, 2015, arXiv 1511.02543). On average the evidence lies between the two. Their
gap on simulated data shows how reliable the lower bound is on real data for a similar model.

Transitions are Hamiltonian. All chains of all sequences are the rows of one batch. Coordinates are in the guide's
standard deviations. Separate chains tune the step sizes for each sequence and temperature, which then stay fixed.
Chains that adapt their own step sizes would not leave f_b invariant.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ...program.batch import AnyBatch, repeat
from ...program.conditional import like
from ...program.model import DynamicalVAE
from ..diagnostics.latents import joined, split
from ..evaluation.evaluation_windows import seeded_evaluation
from ..evaluation.result import progress_bar
from .elbo import joint_and_guide, require_data, require_densities, require_latents

ACCEPTED = 0.8
"""Target acceptance rate of Hamiltonian proposals."""
TRIED = 4
"""Number of chains that tune the step sizes."""
DRAWS = 32
"""Fewest draws from the guide for its standard deviations."""
FIRST, LEAST, MOST = 0.2, 1e-4, 2.0
"""Initial, smallest and largest step size, in the guide's standard deviations."""


@dataclass(frozen=True)
class AnnealedBound:
    """Bounds of every sequence by annealed importance sampling, with statistics of the chains.

    Args:
        bound: log of the estimated evidence, in nats, (B,); on average below it, or above it for reverse chains.
        error: standard error of the bound, (B,), from the spread of the weights, with K - 1 degrees of freedom for an
            interval by Student's t. It covers only the modes that the chains visit: if all stay in one of two equal
            modes, the bound is log 2 too low, whatever `error` and `effective` are. The upper bound on simulated data
            reveals such a deficit. With few effective chains the error is too small. NaN for reverse chains: all chains
            of a sequence start at one draw, and their spread does not include the randomness of that draw. For the
            error of a mean over sequences, use the spread of their bounds.
        effective: effective number of chains, between 1 and K, (B,); NaN for reverse chains. It does not account for a
            mode that no chain visits.
        accepted: share of accepted proposals, (B,).
        chains: K, number of chains.
        temperatures: L, number of temperatures.
    """

    bound: Tensor
    error: Tensor
    effective: Tensor
    accepted: Tensor
    chains: int
    temperatures: int


@torch.inference_mode(False)
def annealed_bound(
    model: DynamicalVAE,
    batch: AnyBatch,
    temperatures: int = 100,
    chains: int = 16,
    *,
    leaps: int = 5,
    latents: Mapping[str, Tensor] | None = None,
    seed: int = 0,
    chunk: int = 4096,
    progress: bool = False,
) -> AnnealedBound:
    """Return a bound on the log evidence that is tight even with a poor guide, at the cost of many evaluations.

    Args:
        model: model with its guide.
        batch: batch as in `DynamicalVAE.model`, which may be ragged or have missing entries and context.
        temperatures: L, number of temperatures.
        chains: K, number of chains per sequence.
        leaps: number of leapfrog steps of a transition, each a gradient of model and guide.
        latents: exact draws (B, ...) from the posterior by name, such as the latents of simulated data; the
            chains then run from these to the guide and give an upper bound.
        seed: seed of the chains.
        chunk: largest number of sequences times chains in memory.
        progress: whether to show a bar.

    Returns:
        Bound and its statistics, (B,) each.

    Raises:
        ValueError: when the model has no latents or likelihood, sequences share latents, a number is below 1, or data
            or latents are missing in the batch.

    Example:
        >>> pair = "p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | x_{1:T})"
        >>> model = dvae.linear_gaussian_surrogate(*pair, {"z": 1, "x": 2}, 4)
        >>> x = model.sample(3, 4)["x"]
        >>> result = dvae.annealed_bound(model, x, temperatures=50)
        >>> bool((result.bound - dvae.Oracle(model, 4).evidence(x)).abs().max() < 1.0)
        True
    """
    if min(temperatures, chains, leaps, chunk) < 1:
        raise ValueError(
            f"temperatures, chains, leaps and chunk must be at least 1, got {temperatures}, {chains}, {leaps} and "
            f"{chunk}"
        )
    require_densities(model)
    data = model.read(batch)
    require_latents(model)
    if model.grouped and data.group is not None:
        raise ValueError("sequences of a group have no separate evidence; remove 'group' from the batch")
    size = require_data(model, data)
    if not size:
        raise ValueError("the batch has no sequences; expected at least one")
    start_latents = None if latents is None else _exact(model, data, latents)
    at_once = max(1, chunk // chains)
    results = []
    with seeded_evaluation(model, seed), progress_bar(progress) as bar:
        for first in bar.track(range(0, size, at_once), description="annealing"):
            part = slice(first, first + at_once)
            start = None if start_latents is None else {name: value[part] for name, value in start_latents.items()}
            sequences = data.rows(part)
            step_sizes = _Annealing(model, sequences, temperatures, min(chains, TRIED), leaps).step_sizes()
            results.append(_Annealing(model, sequences, temperatures, chains, leaps).run(step_sizes, start))
    bound, error, effective, accepted = (torch.cat(parts) for parts in zip(*results, strict=True))
    return AnnealedBound(bound, error, effective, accepted, chains, temperatures)


def _exact(model: DynamicalVAE, data: Mapping[str, Any], latents: Mapping[str, Any]) -> dict[str, Tensor]:
    """Return the starting latents of reverse chains, in the model's dtype and on its device.

    Raises:
        ValueError: when a latent is missing, or has another shape.
    """
    if missing := [name for name in model.latents if name not in latents]:
        raise ValueError(f"`latents` must have a start value for every latent; missing are {', '.join(missing)}")
    first = data[model.observed[0]]
    values = {}
    for name in model.latents:
        values[name] = torch.as_tensor(latents[name]).to(like(model))
        steps = first.shape[1:2] if model.generative.local(name) else ()
        expected = (len(first), *steps, model.sizes[name])
        if values[name].shape != expected:
            raise ValueError(f"the latent {name} has shape {tuple(values[name].shape)}, expected {tuple(expected)}")
    return values


class _Annealing:
    """Chains of some sequences; row k B + b is chain k of sequence b."""

    def __init__(self, model: DynamicalVAE, data: AnyBatch, temperatures: int, chains: int, leaps: int):
        self.model, self.chains, self.leaps = model, chains, leaps
        self.data = repeat(data, chains)
        # small steps at both ends, where the mixture has little of one distribution
        self.inverse = (1 - torch.cos(math.pi * torch.arange(temperatures + 1) / temperatures)).double() / 2
        self.levels = range(1, temperatures)
        draws = [model.guide(self.data) for _ in range(math.ceil(DRAWS / chains))]
        self.like = {name: draws[0][name] for name in model.latents}
        flat = torch.stack([self._flattened(draw) for draw in draws]).unflatten(1, (chains, -1))
        self.scale = flat.flatten(0, 1).std(0).clamp(min=1e-6).repeat(chains, 1)

    def step_sizes(self) -> dict[int, Tensor]:
        """Return step sizes (B,) by index of the temperature, tuned on chains that are not used for the bound."""
        points = self._flattened(self.model.guide(self.data))
        step, step_sizes = points.new_full((len(points) // self.chains,), FIRST), {}
        for level in self.levels:
            points, accepted, _ = self._move(points, float(self.inverse[level]), step)
            step = (step * torch.exp(accepted - ACCEPTED)).clamp(LEAST, MOST)
            step_sizes[level] = step
        return step_sizes

    def run(
        self, step_sizes: Mapping[int, Tensor], start: Mapping[str, Tensor] | None
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Run the chains and return bound, error, effective number of chains and acceptance rate, (B,) each.

        Args:
            step_sizes: step sizes (B,) by index of the temperature, from `step_sizes`.
            start: exact latents (B, ...) by name, where reverse chains to the guide start; None for forward chains,
                which start at draws from the guide.
        """
        back = start is not None
        points = self._flattened(self.model.guide(self.data) if start is None else repeat(start, self.chains))
        weights, rates = points.new_zeros(len(points)), []
        increments = self.inverse.diff().to(points)
        for level in [*reversed(self.levels), 0] if back else [*self.levels, len(increments)]:
            if level in step_sizes:
                points, accepted, ratio = self._move(points, float(self.inverse[level]), step_sizes[level])
                rates.append(accepted)
            else:  # the last level has no transition
                log_joint, log_guide = self._densities(points)
                ratio = log_joint - log_guide
            weights += increments[level if back else level - 1] * ratio
        log_weights = weights.unflatten(0, (self.chains, -1)) * (-1 if back else 1)
        bound = log_weights.logsumexp(0) - math.log(self.chains)
        shares = (log_weights - log_weights.amax(0)).exp()
        effective = shares.sum(0).square() / shares.square().sum(0)
        spread = shares.std(0) / shares.mean(0) / math.sqrt(self.chains) if self.chains > 1 else bound * math.nan
        accepted = torch.stack(rates).mean(0) if rates else torch.ones_like(bound)
        if back:
            return -bound, bound * math.nan, bound * math.nan, accepted
        return bound, spread, effective, accepted

    def _move(self, points: Tensor, inverse: float, step: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Make a Hamiltonian transition that leaves f_b invariant.

        Args:
            points: points (R, N).
            inverse: b, an inverse temperature.
            step: step sizes (B,), in the guide's standard deviations.

        Returns:
            Points (R, N), acceptance rate (B,), and log p(x, z) - log q(z | x) at the points before the move, (R,).
        """
        length = step.repeat(self.chains)[:, None]
        momentum = torch.randn_like(points)
        before, slope, weight = self._slope(points, inverse)
        proposal, new_momentum = points, momentum + 0.5 * length * self.scale * slope
        for leap in range(self.leaps):
            proposal = proposal + length * self.scale * new_momentum
            after, slope, _ = self._slope(proposal, inverse)
            new_momentum = new_momentum + (0.5 if leap == self.leaps - 1 else 1.0) * length * self.scale * slope
        ratio = after - before - 0.5 * (new_momentum.square() - momentum.square()).sum(1)
        acceptance = ratio.nan_to_num(-math.inf).clamp(max=0).exp()
        accepted = torch.rand_like(acceptance) < acceptance
        points = torch.where(accepted[:, None], proposal, points)
        return points, acceptance.unflatten(0, (self.chains, -1)).mean(0), weight

    def _slope(self, points: Tensor, inverse: float) -> tuple[Tensor, Tensor, Tensor]:
        """Return log f_b (R,), its gradient (R, N), and log p(x, z) - log q(z | x), (R,).

        Args:
            points: latents as flat vectors, (R, N).
            inverse: b, an inverse temperature.
        """
        # cuDNN has no gradients of recurrent networks in evaluation mode
        with torch.enable_grad(), torch.backends.cudnn.flags(enabled=False):
            points = points.detach().requires_grad_()
            log_joint, log_guide = self._densities(points)
            tempered = (1 - inverse) * log_guide + inverse * log_joint
            (slope,) = torch.autograd.grad(tempered.sum(), points)
        return tempered.detach(), slope.nan_to_num(), (log_joint - log_guide).detach()

    def _densities(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Return log p(x, z) and log q(z | x), (R,) each."""
        return joint_and_guide(self.model, self.data, split(points, self.like))

    def _flattened(self, values: Mapping[str, Tensor]) -> Tensor:
        return joined({name: values[name] for name in self.model.latents})
