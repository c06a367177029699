"""The oracle: linear-Gaussian models with exact evidence and exact bounds.

With `networks.Linear` and normals of fixed scale, any factorization is one dense joint normal. Evidence log p(x), exact
posterior and the ELBO of any linear guide then have closed forms. So does the KL gap, the expected difference between
evidence and bound over data from the model. Its minimum over guides is the cost of the guide's factorization, that is
of its missing edges, in nats.

Discrete latents that shift locations turn the joint into a mixture of such normals, one for each state sequence. If
these can be enumerated, evidence and posterior moments remain exact; bounds of a guide do not.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy
import torch
from torch import Tensor
from torch.func import functional_call

from ..distributions.families import FixedNormal
from ..distributions.family import Family
from ..factorization.inversion import FAITHFUL, guide
from ..factorization.notation import Factor, Factorization
from ..locking import seeded
from ..networks.base import indicator
from ..networks.linear import Linear
from ..networks.loop import valid_steps
from ..options import Count, kind_of, require
from .conditional import Conditional, like
from .enumeration import Discrete
from .gaussian import is_affine_normal
from .model import DynamicalVAE
from .rollout import Rollout


def linear_gaussian_surrogate(
    generative: str | Factorization,
    inference: str | Factorization | None,
    sizes: Mapping[str, int],
    steps: int,
    seed: int = 0,
    observed: tuple[str, ...] = ("x",),
    scale: float = 0.3,
) -> DynamicalVAE:
    """Return a linear-Gaussian surrogate of two factorizations, with random weights, in double precision.

    Args:
        generative, inference, sizes, observed: as in `DynamicalVAE`.
        steps: T, the number of time steps.
        seed: random seed of the weights.
        scale: standard deviation of the weights.

    Raises:
        ValueError: a text cannot be parsed, or the guide does not fit the model.

    Example:
        >>> pair = "p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | z_{t-1}, x_{t:T})"
        >>> model = dvae.linear_gaussian_surrogate(*pair, {"z": 1, "x": 2}, 4)
        >>> model.sample(5, length=4)["x"].shape
        torch.Size([5, 4, 2])
    """
    model = Factorization.parse(generative)
    summed = tuple(name for name, size in sizes.items() if isinstance(size, Discrete) and name not in observed)
    equations = (model, guide(model, inference, observed, summed=summed))
    distributions = {
        f"{factor.kind}({factor.child})": Family("OneHotCategorical", project=False)
        if factor.child in summed
        else FixedNormal(scale=0.7, learned=True, project=False, steps=steps if factor.local else 0)
        for equation in equations
        for factor in equation.factors
        if factor.parents or factor.kind == "q"
    }
    with seeded(seed):
        return DynamicalVAE(
            generative, inference, sizes, Linear(steps, scale), distributions, observed=observed
        ).double()


def _is_partial(run: Rollout) -> bool:
    """Return whether entries may be missing or padding."""
    return run.lengths is not None or bool(run.observed)


_N_STARTS, _START_SPREAD = 12, 0.6
"""Number of random starts in the search for the best reduced model, and standard deviation of their weights' noise."""


@dataclass(frozen=True)
class _System:
    """v = W v + U d + b + diag(s) e for stacked variables v, stacked data d and standard normal e.

    Each tensor has one row per sequence, or a single row if all sequences are complete. Padding is N(0, 1), and no
    variable reads it.
    """

    weights: Tensor
    data_weights: Tensor
    bias: Tensor
    scale: Tensor


class Oracle:
    """Exact quantities of a linear-Gaussian model and its guide.

    Missing entries, lengths and units work as in the program: the model reads its own mean at a missing entry, and no
    variable reads padding.

    Args:
        model: a `linear_gaussian_surrogate`, or any `DynamicalVAE` with networks `Linear` or `Dense(())` and normals of
            fixed scale.
        steps: T.

    Raises:
        TypeError: if `model` is not a model or `steps` is not an integer.
        ValueError: if the model is not linear-Gaussian given its discrete states, or has context or penalties. Methods
            also raise it for a batch with another number of steps, with groups, or without a data variable.

    Example:
        >>> pair = "p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | z_{t-1}, x_{t:T})"
        >>> model = dvae.linear_gaussian_surrogate(*pair, {"z": 1, "x": 2}, 4)
        >>> dvae.Oracle(model, 4).evidence(torch.randn(3, 4, 2).double()).shape
        torch.Size([3])
    """

    def __init__(self, model: DynamicalVAE, steps: int):
        if not isinstance(model, DynamicalVAE):
            raise TypeError(
                f"the model is {kind_of(model)}; expected a DynamicalVAE, such as dvae.linear_gaussian_surrogate(...)"
            )
        require(Count, steps=steps)
        if model.context:
            raise ValueError(
                f"the oracle requires a distribution of {', '.join(model.context)}; give this context a factor"
            )
        if type(model).penalties is not DynamicalVAE.penalties:
            raise ValueError(
                f"{type(model).__name__} has penalties, so its joint is not normal; use a model without them"
            )
        self.model, self.steps = deepcopy(model).double() if model.wide else model, steps
        for name in model.summed:
            if other := [parent for parent in model.generator[name].parents if parent not in model.summed]:
                raise ValueError(
                    f"{model.generator[name].factor} reads {', '.join(other)}, so discrete states depend on continuous "
                    "variables and no exact result exists; let discrete latents read only discrete latents"
                )

    def _size(self, name: str) -> int:
        return self.model.sizes[name] * (self.steps if self.model.generative.local(name) else 1)

    def _run(self, x: Tensor | Mapping[str, Tensor]) -> Rollout:
        """Return the model's run over a batch, with its values, lengths and observed entries."""
        run = self.model.rollout(x)
        if missing := [name for name in self.model.observed if name not in run.values]:
            raise ValueError(f"the batch has no {', '.join(missing)}; the oracle needs a value of every data variable")
        if run.length != self.steps:
            raise ValueError(f"this oracle was built for {self.steps} steps; build Oracle(model, {run.length})")
        if run.groups is not None:
            raise ValueError(
                f"sequences of a group share {', '.join(self.model.grouped)}, but the oracle treats sequences one by "
                f"one; leave 'group' out of the batch"
            )
        if self.model.sums is not None:
            self.model.sums.require_data(run.hidden)
        return run

    def _stack(self, values: Mapping[str, Tensor], names: tuple[str, ...]) -> Tensor:
        return torch.cat([values[name].flatten(1) for name in names], dim=1)

    def _count_mask(self, names: tuple[str, ...], run: Rollout | None, observed: bool = True) -> Tensor:
        """Return a mask (R, N) of stacked variables: 1 at valid entries, 0 at padding.

        Args:
            names: names of the variables, in the order of stacking.
            run: run over a batch of R sequences. R is 1 without a run, or if all its sequences are complete.
            observed: whether missing entries are 0 too.
        """
        if run is None or not _is_partial(run):
            return torch.ones(1, sum(map(self._size, names)), dtype=torch.float64)
        parts = []
        for name in names:
            shape = (run.batch, *((self.steps,) if self.model.generative.local(name) else ()), self.model.sizes[name])
            part = run.observed[name] if observed and name in run.observed else torch.ones(shape, dtype=torch.bool)
            if run.lengths is not None and len(shape) == 3:
                part = part & valid_steps(run.lengths, self.steps)[..., None]
            parts.append(part.flatten(1))
        return torch.cat(parts, dim=1).double()

    def _system(
        self, conditionals: Mapping[str, Any], names: tuple[str, ...], data: tuple[str, ...], run: Rollout | None = None
    ) -> _System:
        """Return conditionals as one affine system, from their locations at 0 and at every unit vector.

        Args:
            conditionals: conditional of each variable by name.
            names: names of the variables v of the system, in the order of stacking.
            data: names of the variables d that the system reads.
            run: run over a batch with missing entries or padding; None for complete sequences.
        """
        # float32 does not resolve affine functions of a variable far from 0
        exact = self.model if like(self.model).dtype is torch.float64 else deepcopy(self.model).double()
        exact_conditionals = exact.generator if conditionals is self.model.generator else exact.encoder
        columns = (*names, *data)
        valid, valid_own = (self._count_mask(each, run, observed=False) for each in (columns, names))
        rows, count = valid.shape
        probes = torch.cat([valid.new_zeros(rows, 1, count), torch.diag_embed(valid)], dim=1).flatten(0, 1)
        parts = probes.to(like(exact)).split([self._size(name) for name in columns], dim=1)
        values = {
            name: part.unflatten(1, (self.steps, -1)) if self.model.generative.local(name) else part
            for name, part in zip(columns, parts, strict=True)
        }
        lengths = None if run is None or run.lengths is None else run.lengths.repeat_interleave(count + 1)
        observed = {} if run is None else run.observed
        values |= {indicator(name): mask.repeat_interleave(count + 1, 0) for name, mask in observed.items()}
        located, scales = [], []
        for name in names:
            conditional = conditionals[name]
            self._require_linear(conditional)
            parameters = {key: value.double() for key, value in conditional.named_parameters()}
            arguments = values, len(probes), self.steps, lengths
            location, scale = functional_call(exact_conditionals[name], parameters, arguments)
            located.append(location.flatten(1).unflatten(0, (rows, -1)).double())
            scales.append(scale.flatten(1).unflatten(0, (rows, -1))[:, 0].double())
        location = torch.cat(located, dim=2) * valid_own[:, None]
        weights = (location[:, 1:] - location[:, :1]).mT
        n_own = len(valid_own.t())
        scale = torch.where(valid_own > 0, torch.cat(scales, dim=1), 1.0)
        return _System(weights[..., :n_own], weights[..., n_own:], location[:, 0], scale)

    def _require_linear(self, conditional: Conditional) -> None:
        units = self.model.units
        if not is_affine_normal(conditional):
            raise ValueError(
                f"{conditional.factor} is not linear-Gaussian; give it networks.Linear or networks.Dense(()) with "
                "distributions.FixedNormal, as in dvae.linear_gaussian_surrogate, or, if it has no parents, any normal "
                "distribution"
            )
        if log_parents := [name for name in conditional.parents if name in units and units[name].logarithms]:
            raise ValueError(
                f"{conditional.factor} reads logarithms of {', '.join(log_parents)}, so it is not linear in them; use "
                "units without logarithms (floor=0)"
            )

    def _joint(self) -> tuple[Tensor, Tensor]:
        """Return mean and precision of (latents, data) under the model, both stacked variable by variable.

        Raises:
            ValueError: if the joint is a mixture.
        """
        if self.model.summed:
            raise ValueError(
                f"{', '.join(self.model.summed)} is summed out, so the posterior is a mixture of normals, and bound "
                "and KL gap of a guide have no closed form; use `evidence` and `posterior`, which are exact"
            )
        _, means, precision = self._mixture(None)
        return means[0, 0], precision[0]

    def _mixture(self, run: Rollout | None) -> tuple[Tensor, Tensor, Tensor]:
        """Return the joint of latents and data as a mixture of normals over C state sequences of discrete latents.

        The model replaces a missing entry by its mean, a function of its parents; the entry itself is an independent
        N(0, 1).

        Args:
            run: run over a batch; None for one complete sequence.

        Returns:
            Log probabilities (C,) and means (R, C, N) of the components, and their common precision (R, N, N).
        """
        model, names = self.model, (*self.model.latents, *self.model.observed)
        system = self._system(model.generator, names, model.summed, run)
        identity = torch.eye(system.bias.shape[1], dtype=torch.float64)
        lhs = identity - system.weights
        missing = self._count_mask(names, run, observed=False) - self._count_mask(names, run)
        present = 1 - missing
        # without missing entries, which are replaced wherever they are read
        replaced = torch.linalg.solve(identity - missing[..., None] * system.weights, lhs, left=False)
        white = (present / system.scale)[..., None] * replaced * present[:, None] + torch.diag_embed(missing)
        offset, logs = system.bias[:, None], torch.zeros(1, dtype=torch.float64)
        if model.sums is not None:
            states = model.sums.state_sequences(self.steps)
            logs = sum((self._log_probability(name, states) for name in model.summed), logs)
            offset = offset + self._stack(states, model.summed) @ system.data_weights.mT
        means = torch.linalg.solve(lhs, offset.mT).mT * present[:, None]
        return logs, means, white.mT @ white

    def _log_probability(self, name: str, states: Mapping[str, Tensor]) -> Tensor:
        """Return log probabilities (C,) of state sequences of one variable given the other summed-out variables."""
        conditional, value = self.model.generator[name], states[name]
        distribution = conditional.head.distribution(conditional(states, len(value), self.steps))
        logs: Tensor = (distribution.logits * value).flatten(1).sum(1)
        return logs

    def _guide(self, run: Rollout | None = None) -> tuple[Tensor, Tensor, Tensor]:
        """Return q(latents | data) = N(gain data + offset, root root') as gain, offset and root, for each sequence."""
        system = self._system(self.model.encoder, self.model.latents, self.model.observed, run)
        lhs = torch.eye(system.bias.shape[1], dtype=torch.float64) - system.weights
        right = torch.cat([system.data_weights, system.bias[..., None], torch.diag_embed(system.scale)], dim=-1)
        solved = torch.linalg.solve(lhs, right)
        data = system.data_weights.shape[-1]
        return solved[..., :data], solved[..., data], solved[..., data + 1 :]

    def evidence(self, x: Tensor | Mapping[str, Tensor]) -> Tensor:
        """Return log p(x), (B,), of data (B, T, D), or of their observed entries.

        Args:
            x: data (B, T, D), or a batch with data by name.

        Raises:
            ValueError: the batch has no value of a data variable, another number of steps, or groups.
        """
        batch = self.model.read(x)
        run = self._run(batch)
        evidence: Tensor = self._log_joint(run, *self._mixture(run)).logsumexp(1)
        return evidence if batch.log_det is None else evidence + batch.volume

    def _log_joint(self, run: Rollout, logs: Tensor, means: Tensor, precision: Tensor) -> Tensor:
        """Return the log joint (B, C) of the data and each state sequence."""
        mask = self._count_mask(self.model.observed, run)
        data = self._stack(run.values, self.model.observed) * mask
        start = means.shape[-1] - data.shape[1]
        covariance = torch.linalg.inv(precision)[:, None, start:, start:]
        distribution = torch.distributions.MultivariateNormal(means[..., start:], covariance)
        # uncounted entries are 0, and independent N(0, 1)
        log_joint: Tensor = (
            logs + distribution.log_prob(data[:, None]) + (1 - mask).sum(1, True) * math.log(2 * math.pi) / 2
        )
        return log_joint

    def posterior(self, x: Tensor | Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Return mean (B, N) and covariance of the latents given data (B, T, D); 0 at padding.

        Latents are stacked in the guide's order. The covariance is (N, N). It is (B, N, N) for a batch with "mask" or
        "lengths", and for a model with discrete latents, whose posterior is a mixture.

        Args:
            x: data (B, T, D), or a batch with data by name.

        Raises:
            ValueError: the batch has no value of a data variable, another number of steps, or groups.
        """
        run = self._run(x)
        logs, means, precision = self._mixture(run)
        state_means, within = self._given_states(run, means, precision)
        valid = self._count_mask(self.model.latents, run)
        within = within * valid[:, None] * valid[..., None]
        if not self.model.summed:
            return state_means[:, 0], within if _is_partial(run) else within[0]
        weights = self._log_joint(run, logs, means, precision).softmax(1)
        mean = torch.einsum("bc,bci->bi", weights, state_means)
        difference = state_means - mean[:, None]
        return mean, within + torch.einsum("bc,bci,bcj->bij", weights, difference, difference)

    def _given_states(self, run: Rollout, means: Tensor, precision: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean (B, C, N) and covariance (R, N, N) of the latents given the data and each state sequence."""
        data = self._stack(run.values, self.model.observed) * self._count_mask(self.model.observed, run)
        n = means.shape[-1] - data.shape[1]
        within = torch.linalg.inv(precision[:, :n, :n])
        gain = -within @ precision[:, :n, n:]
        return means[..., :n] + (data[:, None] - means[..., n:]) @ gain.mT, within

    def bound(self, x: Tensor | Mapping[str, Tensor]) -> Tensor:
        """Return the exact ELBO (B,) of the model's guide for data (B, T, D), computed in closed form.

        Args:
            x: data (B, T, D), or a batch with data by name.

        Raises:
            ValueError: same as `evidence`, or a latent is summed out, so the posterior is a mixture.
        """
        evidence = self.evidence(x)
        if not self.model.latents:
            return evidence
        self._joint()  # raises for a mixture
        run = self._run(x)
        _, means, precision = self._mixture(run)
        gain, offset, root = self._guide(run)
        mean = self._given_states(run, means, precision)[0][:, 0]
        data = self._stack(run.values, self.model.observed)
        precision = precision[:, : mean.shape[1], : mean.shape[1]]
        difference = (gain @ data[..., None])[..., 0] + offset - mean
        distance = (difference * (precision @ difference[..., None])[..., 0]).sum(1)
        return evidence - self._divergence(distance, precision, root)

    def gap(self) -> Tensor:
        """Return the KL gap: expected evidence minus bound, in nats per sequence, over complete data from the model.

        Raises:
            ValueError: a latent is summed out, so the posterior is a mixture.
        """
        gain, offset, root = (part[0] for part in self._guide())
        mean, precision = self._joint()
        n = len(offset)
        within, across = precision[:n, :n], precision[:n, n:]
        exact_gain = -torch.linalg.solve(within, across)
        slope = gain - exact_gain
        shift = gain @ mean[n:] + offset - mean[:n]
        covariance = torch.linalg.inv(precision)[n:, n:]
        distance = shift @ within @ shift + (slope.t() @ within @ slope * covariance).sum()
        return self._divergence(distance, within, root)

    @staticmethod
    def _divergence(distance: Tensor, precision: Tensor, root: Tensor) -> Tensor:
        """Return KL(N(m, root root'), N(n, precision^-1)), given the squared Mahalanobis distance of m and n."""
        spread = (root.mT @ precision * root.mT).sum((-2, -1))
        log_volume = torch.linalg.slogdet(precision)[1] + 2 * torch.linalg.slogdet(root)[1]
        divergence: Tensor = 0.5 * (spread + distance - root.shape[-1] - log_volume)
        return divergence

    @torch.inference_mode(False)
    def fit_guide(self, iterations: int = 2000) -> float:
        """Fit the guide to the model's exact KL gap by L-BFGS.

        Args:
            iterations: maximum number of iterations.

        Returns:
            The remaining gap, in nats per sequence; 0 for a model without latents.

        Raises:
            ValueError: a latent is summed out, so the posterior is a mixture.
        """
        if not self.model.latents:
            return 0.0
        parameters = list(self.model.encoder.parameters())
        optimiser = torch.optim.LBFGS(
            parameters,
            max_iter=iterations,
            history_size=50,
            tolerance_grad=1e-10,
            tolerance_change=1e-14,
            line_search_fn="strong_wolfe",
        )

        def closure() -> Tensor:
            optimiser.zero_grad()
            gap = self.gap()
            gap.backward(inputs=parameters)
            return gap

        optimiser.step(closure)
        return float(self.gap().detach())


def kl_gap(
    generative: str | Factorization,
    inference: str | Factorization | None,
    sizes: Mapping[str, int],
    steps: int = 5,
    seeds: int = 5,
    observed: tuple[str, ...] = ("x",),
) -> Tensor:
    """Return the smallest KL gap of a guide's factorization, in nats per sequence, (seeds,).

    Each seed is a linear-Gaussian model with random weights, and the gap is minimised over guides with this
    factorization. A guide with all dependencies of the posterior has no gap if latents have one dimension. With more
    dimensions, the remaining gap is the cost of its diagonal covariance. Context is drawn from N(0, I), and the gap is
    an average over it.

    Args:
        generative, inference, sizes, observed: as in `DynamicalVAE`.
        steps: T.
        seeds: number of random models.

    Raises:
        ValueError: `steps` or `seeds` is less than 1, a text cannot be parsed, the guide does not fit the model, or a
            latent is `Discrete`.

    Example:
        >>> dvae.kl_gap("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | x_{1:T})", {"z": 1, "x": 2}, steps=3, seeds=1) > 0
        tensor([True])
    """
    if min(steps, seeds) < 1:
        raise ValueError(f"`steps` and `seeds` must be at least 1, got {steps} and {seeds}")
    model = Factorization.parse(generative)
    parsed = guide(model, inference, observed)
    context = _context(model, parsed)
    model, data = _with_context(model, context), (*observed, *(factor.child for factor in context))
    gaps = [
        Oracle(linear_gaussian_surrogate(model, parsed, sizes, steps, seed, data), steps).fit_guide()
        for seed in range(seeds)
    ]
    return torch.tensor(gaps, dtype=torch.float64)


def _context(model: Factorization, other: Factorization) -> tuple[Factor, ...]:
    """Return factors for the context of a model and its guide, or of two models."""
    local = {name: part.local(name) for part in (model, other) for name in part.context if name not in model.variables}
    return tuple(Factor("p", name, each) for name, each in local.items())


def _with_context(model: Factorization, context: tuple[Factor, ...]) -> Factorization:
    """Return the model extended by factors for its context."""
    return replace(model, factors=(*context, *model.factors))


def model_kl_gap(
    generative: str | Factorization,
    reduced: str | Factorization,
    sizes: Mapping[str, int],
    steps: int = 5,
    seeds: int = 5,
    observed: tuple[str, ...] = ("x",),
) -> Tensor:
    """Return the smallest expected loss of evidence of a model with fewer edges, in nats per sequence, (seeds,).

    Each seed is a linear-Gaussian model p with random weights, the same as in `kl_gap`. The cost is the minimum of
    KL(p(x) || r(x)) over linear-Gaussian models r with the reduced factorization. Both are normals with known
    covariances, and no guide is involved. Without latents the search is convex. With latents it has local minima. The
    search then starts at the weights of p without the missing edges, and at twelve random points near them. The result
    is the best minimum found, an upper bound of the cost.

    Args:
        generative, observed: as in `DynamicalVAE`.
        reduced: a factorization of the same variables with fewer edges.
        sizes: dimension of every variable, context included.
        steps: T.
        seeds: number of random models.

    Raises:
        ValueError: if the two models have different variables, or `steps` or `seeds` is below 1.

    Example:
        >>> dvae.model_kl_gap("p(x_t | x_{t-1})", "p(x_t)", {"x": 1}, steps=3, seeds=1) > 0
        tensor([True])
    """
    if min(steps, seeds) < 1:
        raise ValueError(f"`steps` and `seeds` must be at least 1, got {steps} and {seeds}")
    model, smaller = Factorization.parse(generative), Factorization.parse(reduced)
    if {*model.variables} != {*smaller.variables}:
        names = ", ".join(model.variables)
        raise ValueError(f"a reduced model must have the variables {names} of the full model, got {smaller.text!r}")
    context = _context(model, smaller)
    model, smaller, data = (
        _with_context(model, context),
        _with_context(smaller, context),
        (*observed, *(f.child for f in context)),
    )
    losses = [
        _evidence_loss(Oracle(linear_gaussian_surrogate(model, None, sizes, steps, seed, data), steps), smaller)
        for seed in range(seeds)
    ]
    return torch.tensor(losses, dtype=torch.float64)


def _evidence_loss(oracle: Oracle, reduced: Factorization) -> float:
    """Return the smallest KL between the data's normal under the model and under a reduced model.

    A model is R v = e, for its variables v minus their means and standard normal e. Biases of the data give a reduced
    model any mean of the data, and only covariances C remain to compare. Latents can be rescaled: R has ones on their
    diagonal. On the diagonal of the data, it has the reciprocal scales of their noise. With J = (-P_xz P_zz^-1, I) for
    the precision P = R'R, the data have the precision M = J P J'. The gradient of the divergence is R J'(C - M^-1) J.
    """
    model, names = oracle.model, (*oracle.model.latents, *oracle.model.observed)
    n = sum(map(oracle._size, model.latents))
    with torch.no_grad():
        system = oracle._system(model.generator, names, ())
    weights, scale = system.weights[0].numpy(), system.scale[0].numpy()
    unit = np.where(np.arange(len(scale)) < n, scale, 1.0)
    root = (np.eye(len(scale)) - weights) / scale[:, None] * unit
    covariance = np.linalg.inv(root.T @ root)[n:, n:]
    entropy = len(covariance) + np.linalg.slogdet(covariance)[1]

    def reads(child: str, parent: str) -> np.ndarray:
        return np.kron(reduced.mask(child, parent, oracle.steps), np.ones((model.sizes[child], model.sizes[parent])))

    free = np.block([[reads(child, parent) for parent in names] for child in names]) > 0
    noise = np.arange(n, len(scale))

    def divergence(values: np.ndarray) -> tuple[float, np.ndarray]:
        r, log_scale = np.eye(len(scale)), values[: len(noise)]
        r[noise, noise], r[free] = np.exp(-log_scale), values[len(noise) :]
        precision = r.T @ r
        projection = np.hstack([-np.linalg.solve(precision[:n, :n], precision[:n, n:]).T, np.eye(len(noise))])
        margin = projection @ precision @ projection.T
        loss = 0.5 * ((margin * covariance).sum() - np.linalg.slogdet(margin)[1] - entropy)
        slope = r @ projection.T @ (covariance - np.linalg.inv(margin)) @ projection
        return loss, np.concatenate([-slope[noise, noise] * r[noise, noise], slope[free]])

    # bounded, since the best noise scale may be 0, with infinite precision
    bounds = [(-10.0, None)] * len(noise) + [(None, None)] * int(free.sum())

    def search(start: np.ndarray, iterations: int) -> scipy.optimize.OptimizeResult:
        options = {"maxiter": iterations, "maxfun": 2 * iterations, "maxcor": 50, "ftol": 1e-14, "gtol": 1e-9}
        return scipy.optimize.minimize(divergence, start, jac=True, method="L-BFGS-B", bounds=bounds, options=options)

    start = np.concatenate([np.log(scale[n:]), root[free]])
    least = search(start, 20_000).fun
    if n and least > 1e-9:  # convex without latents, and never below 0
        generator = np.random.default_rng(0)
        steps = _START_SPREAD * generator.standard_normal((_N_STARTS, free.sum()))
        starts = [start + np.concatenate([np.zeros(len(noise)), step]) for step in steps]
        best = min((search(point, 100) for point in starts), key=lambda result: result.fun)
        least = min(least, search(best.x, 20_000).fun)
    return float(least)


def edge_costs(
    generative: str | Factorization,
    inference: str | Factorization | None = FAITHFUL,
    sizes: Mapping[str, int] | None = None,
    steps: int = 5,
    seeds: int = 5,
    observed: tuple[str, ...] = ("x",),
) -> dict[str, Tensor]:
    """Return the cost of removing each edge of a guide, one at a time, in nats per sequence (`kl_gap`).

    Args:
        generative, inference, observed: as in `DynamicalVAE`.
        sizes: dimension of every variable; 1 each by default; a faithful guide then has no KL gap.
        steps: as in `kl_gap`.
        seeds: as in `kl_gap`.

    Returns:
        {edge: (seeds,), increase of the KL gap without the edge in each random model}, largest mean first.

    Raises:
        ValueError: `steps` or `seeds` is less than 1, a text cannot be parsed, the guide does not fit the model, or a
            latent is `Discrete`.

    Example:
        >>> {edge: bool((cost > 0).all()) for edge, cost in dvae.edge_costs(
        ...     "p(z_t) p(x_t | z_t)", "q(z_t | x_t, z_{t-1})", steps=3, seeds=2).items()}
        {'x_t to z_t': True, 'z_{t-1} to z_t': False}
    """
    model = Factorization.parse(generative)
    inverse = guide(model, inference, observed)
    dimensions = sizes or ones(model, inverse)
    baseline = kl_gap(model, inverse, dimensions, steps, seeds, observed)
    return _costliest_first(
        inverse, lambda reduced: kl_gap(model, reduced, dimensions, steps, seeds, observed) - baseline
    )


def model_edge_costs(
    generative: str | Factorization,
    sizes: Mapping[str, int] | None = None,
    steps: int = 5,
    seeds: int = 5,
    observed: tuple[str, ...] = ("x",),
) -> dict[str, Tensor]:
    """Return the cost of removing each edge of a model, one at a time, in nats per sequence (`model_kl_gap`).

    Args:
        generative, observed: as in `DynamicalVAE`.
        sizes: dimension of every variable. By default 2 for data, since data of size 1 can often replace a removed path
            by another one, and 1 for other variables.
        steps: as in `model_kl_gap`.
        seeds: as in `model_kl_gap`.

    Returns:
        {edge: (seeds,), loss of evidence without the edge in each random model}, largest mean first.

    Raises:
        ValueError: `steps` or `seeds` is less than 1, or the text cannot be parsed.

    Example:
        >>> {edge: bool((cost > 1e-6).all()) for edge, cost in dvae.model_edge_costs(
        ...     "p(z_t | z_{t-1}) p(x_t | x_{<t}, z_t)", steps=3, seeds=2).items()}
        {'x_{<t} to x_t': True, 'z_t to x_t': True, 'z_{t-1} to z_t': False}
    """
    model = Factorization.parse(generative)
    dimensions = sizes or {**ones(model), **dict.fromkeys(observed, 2)}
    return _costliest_first(model, lambda reduced: model_kl_gap(model, reduced, dimensions, steps, seeds, observed))


def ones(*equations: Factorization) -> dict[str, int]:
    """Return a size of 1 for each variable."""
    return dict.fromkeys((name for part in equations for name in (*part.variables, *part.context)), 1)


def _costliest_first(factorization: Factorization, cost: Callable[[Factorization], Tensor]) -> dict[str, Tensor]:
    """Return a dictionary from the name of each edge to its cost, largest mean first."""
    costs = {factorization.describe_edge(*edge): cost(factorization.without(*edge)) for edge in factorization.edges}
    return dict(sorted(costs.items(), key=lambda item: -float(item[1].mean())))
