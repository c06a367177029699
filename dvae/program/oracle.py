"""The oracle: linear-Gaussian models, whose evidence and whose every bound are known exactly.

With `networks.Linear` and normals of fixed scale, any factorization is one dense joint normal. Then log p(x), the exact
posterior, and the evidence lower bound of any linear guide are closed forms; so is the expected gap between bound and
evidence, over data from the model. Minimised over guides, that gap is what the guide's factorization costs: the price
of its dropped arrows, in nats.

Discrete latents that move locations make the joint a mixture of such normals, one for each course of their states.
Where these can be counted, evidence and posterior moments are known still; bounds of a guide are not.
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

from ..distributions.families import FixedNormal, FixedNormalLaw, Gaussian
from ..distributions.family import Family
from ..factorization.inversion import FAITHFUL, guide
from ..factorization.notation import Factor, Factorization
from ..networks.base import indicator
from ..networks.linear import Linear, LinearNetwork
from ..networks.loop import valid_steps
from ..options import Count, kind_of, require
from ..turns import seeded
from .conditional import Conditional, like
from .model import DynamicalVAE
from .rollout import Rollout
from .summed import Discrete


def twin(
    generative: str | Factorization,
    inference: str | Factorization | None,
    sizes: Mapping[str, int],
    steps: int,
    seed: int = 0,
    observed: tuple[str, ...] = ("x",),
    scale: float = 0.3,
) -> DynamicalVAE:
    """The linear-Gaussian model of a pair of factorizations, with random weights, in double precision.

    Args:
        generative, inference, sizes, observed: as of `DynamicalVAE`.
        steps: T, the number of time steps.
        seed: of the weights.
        scale: standard deviation of the weights.

    Example:
        >>> model = dvae.twin("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | z_{t-1}, x_{t:T})", {"z": 1, "x": 2}, 4)
        >>> model.sample(5, length=4)["x"].shape
        torch.Size([5, 4, 2])
    """
    model = Factorization.parse(generative)
    summed = tuple(name for name, size in sizes.items() if isinstance(size, Discrete) and name not in observed)
    equations = (model, guide(model, inference, observed, summed=summed))
    laws = {
        f"{factor.kind}({factor.child})": Family("OneHotCategorical", project=False)
        if factor.child in summed
        else FixedNormal(scale=0.7, learned=True, project=False, steps=steps if factor.local else 0)
        for equation in equations
        for factor in equation.factors
        if factor.parents or factor.kind == "q"
    }
    with seeded(seed):
        return DynamicalVAE(generative, inference, sizes, Linear(steps, scale), laws, observed=observed).double()


def _is_partial(run: Rollout) -> bool:
    """Whether entries may be missing or padding."""
    return run.lengths is not None or bool(run.observed)


_STARTS, _AWAY = 12, 0.6
"""Further starts of the search for the best reduced model, and how far their weights are from those of the whole."""


@dataclass(frozen=True)
class _System:
    """v = W v + U d + b + diag(s) e for stacked variables v, stacked data d and standard normal e.

    Each has one row for each sequence, or a single row where all sequences are complete. Padding is N(0, 1), which
    nothing reads.
    """

    weights: Tensor
    data_weights: Tensor
    bias: Tensor
    scale: Tensor


class Oracle:
    """Exact quantities of a linear-Gaussian model and its guide.

    Missing entries, lengths and units are those of the program: the model reads its own mean at a missing entry, and
    nothing reads padding.

    Args:
        model: a `twin`, or any `DynamicalVAE` of Linear networks with fixed scales.
        steps: T.

    Raises:
        TypeError: no model, or steps that are no whole number.
        ValueError: a model that is not linear-Gaussian, given the states of what is summed out, or has context or
            energies; a batch of another length, without all data, or with groups.

    Example:
        >>> model = dvae.twin("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | z_{t-1}, x_{t:T})", {"z": 1, "x": 2}, 4)
        >>> dvae.Oracle(model, 4).evidence(torch.randn(3, 4, 2).double()).shape
        torch.Size([3])
    """

    def __init__(self, model: DynamicalVAE, steps: int):
        if not isinstance(model, DynamicalVAE):
            raise TypeError(f"the model is {kind_of(model)}; expected a DynamicalVAE, such as dvae.twin(...)")
        require(Count, steps=steps)
        if model.context:
            raise ValueError(f"the oracle knows no law of the context {', '.join(model.context)}")
        if type(model).penalties is not DynamicalVAE.penalties:
            raise ValueError(f"{type(model).__name__} adds energies to the log joint, which is not normal then")
        # what is affine in a variable far from 0 is found from values that float32 does not resolve
        self.model, self.steps = deepcopy(model).double() if model.wide else model, steps
        for name in model.summed:
            if other := [parent for parent in model.generator[name].parents if parent not in model.summed]:
                raise ValueError(
                    f"{model.generator[name].factor} reads {', '.join(other)}, so that states depend on what is "
                    "continuous, and nothing of it is known exactly; the oracle knows states that read states"
                )

    def _size(self, name: str) -> int:
        return self.model.sizes[name] * (self.steps if self.model.generative.local(name) else 1)

    def _run(self, x: Tensor | Mapping[str, Tensor]) -> Rollout:
        """The model's run over a batch, with its values, lengths and observed entries."""
        run = self.model.rollout(x)
        if missing := [name for name in self.model.observed if name not in run.values]:
            raise ValueError(f"the batch has no {', '.join(missing)}; the oracle needs a value of every data variable")
        if run.length != self.steps:
            raise ValueError(f"the batch has {run.length} steps, but this oracle is Oracle(model, {self.steps})")
        if run.groups is not None:
            raise ValueError(
                f"sequences of a group share {', '.join(self.model.grouped)}, and the oracle knows sequences one by "
                f"one; leave 'group' out of the batch"
            )
        if self.model.sums is not None:
            self.model.sums.require_data(run.hidden)
        return run

    def _stack(self, values: Mapping[str, Tensor], names: tuple[str, ...]) -> Tensor:
        return torch.cat([values[name].flatten(1) for name in names], dim=1)

    def _counted(self, names: tuple[str, ...], run: Rollout | None, observed: bool = True) -> Tensor:
        """(R, N) 1 at entries that are not padding, nor missing where `observed`; R is 1 where all are there."""
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
        """The affine functions that the conditionals are, from their locations at 0 and at every unit vector."""
        columns = (*names, *data)
        there, real = (self._counted(each, run, observed=False) for each in (columns, names))
        rows, count = there.shape
        probes = torch.cat([there.new_zeros(rows, 1, count), torch.diag_embed(there)], dim=1).flatten(0, 1)
        parts = probes.to(like(self.model)).split([self._size(name) for name in columns], dim=1)
        values = {
            name: part.unflatten(1, (self.steps, -1)) if self.model.generative.local(name) else part
            for name, part in zip(columns, parts, strict=True)
        }
        lengths = None if run is None or run.lengths is None else run.lengths.repeat_interleave(count + 1)
        observed = {} if run is None else run.observed
        values |= {indicator(name): seen.repeat_interleave(count + 1, 0) for name, seen in observed.items()}
        located, scales = [], []
        for name in names:
            conditional = conditionals[name]
            self._require_linear(conditional)
            location, scale = conditional(values, len(probes), self.steps, lengths)
            located.append(location.flatten(1).unflatten(0, (rows, -1)).double())
            scales.append(scale.flatten(1).unflatten(0, (rows, -1))[:, 0].double())
        location = torch.cat(located, dim=2) * real[:, None]
        weights = (location[:, 1:] - location[:, :1]).mT
        own = len(real.t())
        scale = torch.where(real > 0, torch.cat(scales, dim=1), 1.0)
        return _System(weights[..., :own], weights[..., own:], location[:, 0], scale)

    def _require_linear(self, conditional: Conditional) -> None:
        units = self.model.units
        linear = isinstance(conditional.network, LinearNetwork) and isinstance(conditional.law, FixedNormalLaw)
        if not linear and not (conditional.network is None and isinstance(conditional.law, Gaussian)):
            raise ValueError(
                f"{conditional.factor} is not linear-Gaussian: the oracle needs networks.Linear with "
                "distributions.FixedNormal, as dvae.program.oracle.twin builds, or without parents a normal"
            )
        if read := [name for name in conditional.parents if name in units and units[name].logarithms]:
            raise ValueError(f"{conditional.factor} reads logarithms of {', '.join(read)}, and is not linear in them")

    def _joint(self) -> tuple[Tensor, Tensor]:
        """Mean and precision of (latents, data) under the model, both stacked variable by variable.

        Raises:
            ValueError: a mixture of such.
        """
        if self.model.summed:
            raise ValueError(
                f"with {', '.join(self.model.summed)} summed out the posterior is a mixture of normals, from which the "
                "divergence of a normal guide is not known exactly; evidence and posterior moments are"
            )
        _, means, precision = self._mixture(None)
        return means[0, 0], precision[0]

    def _mixture(self, run: Rollout | None) -> tuple[Tensor, Tensor, Tensor]:
        """Log probability (C,) and mean (R, C, N) of each course of the states, and the precision (R, N, N) of all.

        A missing entry is its mean, a function of its parents, so that what remains of it is N(0, 1) by itself.
        """
        model, names = self.model, (*self.model.latents, *self.model.observed)
        system = self._system(model.generator, names, model.summed, run)
        identity = torch.eye(system.bias.shape[1], dtype=torch.float64)
        rest = identity - system.weights
        missing = self._counted(names, run, observed=False) - self._counted(names, run)
        kept = 1 - missing
        # without missing entries: those are replaced in all that reads them
        own = torch.linalg.solve(identity - missing[..., None] * system.weights, rest, left=False)
        white = (kept / system.scale)[..., None] * own * kept[:, None] + torch.diag_embed(missing)
        moved, logs = system.bias[:, None], torch.zeros(1, dtype=torch.float64)
        if model.sums is not None:
            states = model.sums.courses(self.steps)
            logs = sum((self._log_probability(name, states) for name in model.summed), logs)
            moved = moved + self._stack(states, model.summed) @ system.data_weights.mT
        means = torch.linalg.solve(rest, moved.mT).mT * kept[:, None]
        return logs, means, white.mT @ white

    def _log_probability(self, name: str, states: Mapping[str, Tensor]) -> Tensor:
        """(C,), of courses of a variable that is summed out given those of the others."""
        conditional, value = self.model.generator[name], states[name]
        law = conditional.law.distribution(conditional(states, len(value), self.steps))
        logs: Tensor = (law.logits * value).flatten(1).sum(1)
        return logs

    def _guide(self, run: Rollout | None = None) -> tuple[Tensor, Tensor, Tensor]:
        """Gain on the data, offset, and a root R of the covariance R R' of q(latents | data), for each row."""
        system = self._system(self.model.encoder, self.model.latents, self.model.observed, run)
        rest = torch.eye(system.bias.shape[1], dtype=torch.float64) - system.weights
        right = torch.cat([system.data_weights, system.bias[..., None], torch.diag_embed(system.scale)], dim=-1)
        solved = torch.linalg.solve(rest, right)
        data = system.data_weights.shape[-1]
        return solved[..., :data], solved[..., data], solved[..., data + 1 :]

    def evidence(self, x: Tensor | Mapping[str, Tensor]) -> Tensor:
        """log p(x), (B,), of data (B, T, D), or of their observed entries."""
        seen = self.model.read(x)
        run = self._run(seen)
        evidence: Tensor = self._weighed(run, *self._mixture(run)).logsumexp(1)
        return evidence if seen.log_det is None else evidence + seen.volume

    def _weighed(self, run: Rollout, logs: Tensor, means: Tensor, precision: Tensor) -> Tensor:
        """(B, C): log joint of the data and each course that the states may take."""
        counted = self._counted(self.model.observed, run)
        data = self._stack(run.values, self.model.observed) * counted
        start = means.shape[-1] - data.shape[1]
        covariance = torch.linalg.inv(precision)[:, None, start:, start:]
        law = torch.distributions.MultivariateNormal(means[..., start:], covariance)
        # entries that do not count are 0, of N(0, 1) by themselves
        weighed: Tensor = logs + law.log_prob(data[:, None]) + (1 - counted).sum(1, True) * math.log(2 * math.pi) / 2
        return weighed

    def posterior(self, x: Tensor | Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Mean (B, N) and covariance of the latents, stacked in the guide's order, given data (B, T, D); 0 at padding.

        The covariance is (N, N), or each sequence's own, (B, N, N), of a batch with "mask" or "lengths" and of a model
        with discrete latents summed out, whose posterior is a mixture.
        """
        run = self._run(x)
        logs, means, precision = self._mixture(run)
        found, within = self._given_states(run, means, precision)
        real = self._counted(self.model.latents, run)
        within = within * real[:, None] * real[..., None]
        if not self.model.summed:
            return found[:, 0], within if _is_partial(run) else within[0]
        weights = self._weighed(run, logs, means, precision).softmax(1)
        mean = torch.einsum("bc,bci->bi", weights, found)
        away = found - mean[:, None]
        return mean, within + torch.einsum("bc,bci,bcj->bij", weights, away, away)

    def _given_states(self, run: Rollout, means: Tensor, precision: Tensor) -> tuple[Tensor, Tensor]:
        """Mean (B, C, N) and covariance (R, N, N) of the latents given the data and each course of the states."""
        data = self._stack(run.values, self.model.observed) * self._counted(self.model.observed, run)
        n = means.shape[-1] - data.shape[1]
        within = torch.linalg.inv(precision[:, :n, :n])
        gain = -within @ precision[:, :n, n:]
        return means[..., :n] + (data[:, None] - means[..., n:]) @ gain.mT, within

    def bound(self, x: Tensor | Mapping[str, Tensor]) -> Tensor:
        """The exact evidence lower bound of the model's guide, (B,): no draws are taken."""
        evidence = self.evidence(x)
        if not self.model.latents:
            return evidence
        self._joint()  # which a mixture has not
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
        """The expected evidence minus bound, in nats a sequence, over complete data drawn from the model."""
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
        """Of N(m, root root') from N(n, precision^-1), with the distance of m and n under the precision."""
        spread = (root.mT @ precision * root.mT).sum((-2, -1))
        log_volume = torch.linalg.slogdet(precision)[1] + 2 * torch.linalg.slogdet(root)[1]
        divergence: Tensor = 0.5 * (spread + distance - root.shape[-1] - log_volume)
        return divergence

    @torch.inference_mode(False)
    def fit_guide(self, iterations: int = 2000) -> float:
        """Fits the guide to the model's exact gap by L-BFGS and returns what is left of it, in nats a sequence."""
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


def price(
    generative: str | Factorization,
    inference: str | Factorization | None,
    sizes: Mapping[str, int],
    steps: int = 5,
    seeds: int = 5,
    observed: tuple[str, ...] = ("x",),
) -> Tensor:
    """What a guide's factorization costs: the smallest expected gap in nats a sequence, (seeds,).

    Each seed is a linear-Gaussian model with random weights, and the best guide of this factorization for it. A guide
    that holds the posterior's dependencies costs nothing where latents have one dimension; with more, what is left is
    the price of its diagonal covariance. Over context, prices are averages: it is drawn from N(0, I).

    Args:
        generative, inference, sizes, observed: as of `DynamicalVAE`.
        steps: T.
        seeds: number of random models.

    Example:
        >>> dvae.price("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | x_{1:T})", {"z": 1, "x": 2}, steps=3, seeds=1) > 0
        tensor([True])
    """
    if min(steps, seeds) < 1:
        raise ValueError(f"a price is of at least 1 step and 1 model, not of {steps} and {seeds}")
    model = Factorization.parse(generative)
    read = guide(model, inference, observed)
    context = _context(model, read)
    model, data = _drawing(model, context), (*observed, *(factor.child for factor in context))
    gaps = [Oracle(twin(model, read, sizes, steps, seed, data), steps).fit_guide() for seed in range(seeds)]
    return torch.tensor(gaps, dtype=torch.float64)


def _context(model: Factorization, other: Factorization) -> tuple[Factor, ...]:
    """Factors of what a model and its guide, or another model, are given."""
    local = {name: part.local(name) for part in (model, other) for name in part.context if name not in model.variables}
    return tuple(Factor("p", name, each) for name, each in local.items())


def _drawing(model: Factorization, context: tuple[Factor, ...]) -> Factorization:
    """A model that draws its context too."""
    return replace(model, factors=(*context, *model.factors))


def model_price(
    generative: str | Factorization,
    reduced: str | Factorization,
    sizes: Mapping[str, int],
    steps: int = 5,
    seeds: int = 5,
    observed: tuple[str, ...] = ("x",),
) -> Tensor:
    """What a model of fewer arrows costs: the least expected evidence that it loses, in nats a sequence, (seeds,).

    Each seed is a linear-Gaussian model p with random weights, the one that `price` has. The cost is the least of
    KL(p(x) || r(x)) over linear-Gaussian models r of the reduced factorization: both are normals whose covariances are
    known, and no guide is involved. Without latents the search is convex. With latents it has local minima: it starts
    at the weights of p less those of the missing arrows and at twelve random ones near these, and the result is the
    least found, which is no less than the price.

    Args:
        generative, sizes, observed: as of `DynamicalVAE`; sizes are of context too, see `price`.
        reduced: a model of the same variables.
        steps: T.
        seeds: number of random models.

    Raises:
        ValueError: other variables than those of the model; less than 1 step or model.

    Example:
        >>> dvae.model_price("p(x_t | x_{t-1})", "p(x_t)", {"x": 1}, steps=3, seeds=1) > 0
        tensor([True])
    """
    if min(steps, seeds) < 1:
        raise ValueError(f"a price is of at least 1 step and 1 model, not of {steps} and {seeds}")
    whole, less = Factorization.parse(generative), Factorization.parse(reduced)
    if {*whole.variables} != {*less.variables}:
        names = ", ".join(whole.variables)
        raise ValueError(f"a reduced model has the variables of the whole one, {names}, but it is {less.text!r}")
    context = _context(whole, less)
    whole, less, data = _drawing(whole, context), _drawing(less, context), (*observed, *(f.child for f in context))
    lost = [_lost(Oracle(twin(whole, None, sizes, steps, seed, data), steps), less) for seed in range(seeds)]
    return torch.tensor(lost, dtype=torch.float64)


def _lost(oracle: Oracle, less: Factorization) -> float:
    """The least KL of the data's normal under the model from that under a reduced one.

    A model is R v = e, for its variables v less their means and standard normal e. Biases of the data give a reduced
    one any mean of theirs, so that covariances C are all there is to compare. As latents may be rescaled, R has ones on
    their diagonal; on that of the data it has the reciprocal scales of their noise. With J = (-P_xz P_zz^-1, I) for the
    precision P = R'R, the data have the precision M = J P J', and the gradient of the divergence is R J'(C - M^-1) J.
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
        return np.kron(less.mask(child, parent, oracle.steps), np.ones((model.sizes[child], model.sizes[parent])))

    free = np.block([[reads(child, parent) for parent in names] for child in names]) > 0
    noise = np.arange(n, len(scale))

    def divergence(values: np.ndarray) -> tuple[float, np.ndarray]:
        r, log_scale = np.eye(len(scale)), values[: len(noise)]
        r[noise, noise], r[free] = np.exp(-log_scale), values[len(noise) :]
        precision = r.T @ r
        onto = np.hstack([-np.linalg.solve(precision[:n, :n], precision[:n, n:]).T, np.eye(len(noise))])
        margin = onto @ precision @ onto.T
        lost = 0.5 * ((margin * covariance).sum() - np.linalg.slogdet(margin)[1] - entropy)
        slope = r @ onto.T @ (covariance - np.linalg.inv(margin)) @ onto
        return lost, np.concatenate([-slope[noise, noise] * r[noise, noise], slope[free]])

    # the best scale of noise may be 0, where precisions have no end
    bounds = [(-10.0, None)] * len(noise) + [(None, None)] * int(free.sum())

    def search(start: np.ndarray, iterations: int) -> scipy.optimize.OptimizeResult:
        options = {"maxiter": iterations, "maxfun": 2 * iterations, "maxcor": 50, "ftol": 1e-14, "gtol": 1e-9}
        return scipy.optimize.minimize(divergence, start, jac=True, method="L-BFGS-B", bounds=bounds, options=options)

    start = np.concatenate([np.log(scale[n:]), root[free]])
    least = search(start, 20_000).fun
    if n and least > 1e-9:  # without latents it is convex, and nothing is below 0
        chance = np.random.default_rng(0)
        steps = _AWAY * chance.standard_normal((_STARTS, free.sum()))
        starts = [start + np.concatenate([np.zeros(len(noise)), step]) for step in steps]
        best = min((search(each, 100) for each in starts), key=lambda found: found.fun)
        least = min(least, search(best.x, 20_000).fun)
    return float(least)


def arrow_prices(
    generative: str | Factorization,
    inference: str | Factorization | None = FAITHFUL,
    sizes: Mapping[str, int] | None = None,
    steps: int = 5,
    seeds: int = 5,
    observed: tuple[str, ...] = ("x",),
) -> dict[str, Tensor]:
    """What leaving out each arrow of a guide costs by itself, in nats a sequence; see `price`.

    Args:
        generative, inference, observed: as of `DynamicalVAE`.
        sizes: of the variables; 1 each by default, with which a guide that misses nothing costs nothing.
        steps, seeds: see `price`.

    Returns:
        {arrow: (seeds,), how much more the guide without it costs in each of the random models}, the dearest first.

    Example:
        >>> {arrow: bool((cost > 0).all()) for arrow, cost in dvae.arrow_prices(
        ...     "p(z_t) p(x_t | z_t)", "q(z_t | x_t, z_{t-1})", steps=3, seeds=2).items()}
        {'x_t to z_t': True, 'z_{t-1} to z_t': False}
    """
    model = Factorization.parse(generative)
    written = guide(model, inference, observed)
    known = sizes or ones(model, written)
    whole = price(model, written, known, steps, seeds, observed)
    return _dearest_first(written, lambda less: price(model, less, known, steps, seeds, observed) - whole)


def model_arrow_prices(
    generative: str | Factorization,
    sizes: Mapping[str, int] | None = None,
    steps: int = 5,
    seeds: int = 5,
    observed: tuple[str, ...] = ("x",),
) -> dict[str, Tensor]:
    """What leaving out each arrow of a model costs by itself, in nats a sequence; see `model_price`.

    Args:
        generative, observed: as of `DynamicalVAE`.
        sizes: of the variables; by default 2 of data and 1 of others, as what data of size 1 lose on one path can often
            take another one.
        steps, seeds: see `model_price`.

    Returns:
        {arrow: (seeds,), the evidence lost without it in each of the random models}, the dearest first.

    Example:
        >>> {arrow: bool((cost > 1e-6).all()) for arrow, cost in dvae.model_arrow_prices(
        ...     "p(z_t | z_{t-1}) p(x_t | x_{<t}, z_t)", steps=3, seeds=2).items()}
        {'x_{<t} to x_t': True, 'z_t to x_t': True, 'z_{t-1} to z_t': False}
    """
    model = Factorization.parse(generative)
    known = sizes or {**ones(model), **dict.fromkeys(observed, 2)}
    return _dearest_first(model, lambda less: model_price(model, less, known, steps, seeds, observed))


def ones(*equations: Factorization) -> dict[str, int]:
    """A size of 1 for each variable."""
    return dict.fromkeys((name for part in equations for name in (*part.variables, *part.context)), 1)


def _dearest_first(written: Factorization, cost: Callable[[Factorization], Tensor]) -> dict[str, Tensor]:
    """What each arrow costs, by what it is called."""
    found = {written.arrow(*arrow): cost(written.without(*arrow)) for arrow in written.arrows}
    return dict(sorted(found.items(), key=lambda item: -float(item[1].mean())))
