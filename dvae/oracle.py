"""The oracle: linear-Gaussian models, whose evidence and whose every bound are known exactly.

With `networks.Linear` and normals of fixed scale, any factorization is one dense joint normal. Then log p(x), the exact
posterior, and the evidence lower bound of any linear guide are closed forms; so is the expected gap between bound and
evidence, over data from the model. Minimised over guides, that gap is what the guide's factorization costs: the price
of its dropped arrows, in nats.

Discrete latents that move locations make the joint a mixture of such normals, one for each course of their states.
Where these can be counted, evidence and posterior moments are known still; bounds of a guide are not.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy
import torch
from torch import Tensor, nn

from .inversion import FAITHFUL, guide
from .laws.families import FixedNormal, FixedNormalLaw, Gaussian
from .laws.family import Family
from .networks.linear import Linear, LinearNetwork
from .notation import Factor, Factorization
from .program.model import DynamicalVAE
from .program.summed import Discrete
from .turns import alone
from .views import LOG_DET, volume


@alone
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
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return DynamicalVAE(generative, inference, sizes, Linear(steps, scale), laws, observed=observed).double()


@dataclass(frozen=True)
class _System:
    """v = W v + U d + b + diag(s) e for stacked variables v, stacked data d and standard normal e."""

    weights: Tensor
    data_weights: Tensor
    bias: Tensor
    scale: Tensor


class Oracle:
    """Exact quantities of a linear-Gaussian model and its guide.

    Args:
        model: a `twin`, or any `DynamicalVAE` of Linear networks with fixed scales and without projections.
        steps: T.

    Raises:
        ValueError: a model that is not linear-Gaussian, given the states of what is summed out, or has context.

    Example:
        >>> model = dvae.twin("p(z_t | z_{t-1}) p(x_t | z_t)", "q(z_t | z_{t-1}, x_{t:T})", {"z": 1, "x": 2}, 4)
        >>> dvae.Oracle(model, 4).evidence(torch.randn(3, 4, 2).double()).shape
        torch.Size([3])
    """

    def __init__(self, model: DynamicalVAE, steps: int):
        if model.context:
            raise ValueError(f"the oracle knows no law of the context {', '.join(model.context)}")
        self.model, self.steps = model, steps
        for name in model.summed:
            if other := [parent for parent in model.generator[name].parents if parent not in model.summed]:
                raise ValueError(
                    f"{model.generator[name].factor} reads {', '.join(other)}, so that states depend on what is "
                    "continuous, and nothing of it is known exactly; the oracle knows states that read states"
                )

    def _size(self, name: str) -> int:
        return self.model.sizes[name] * (self.steps if self.model.generative.local(name) else 1)

    def _system(self, conditionals: Mapping[str, Any], names: tuple[str, ...], data: tuple[str, ...]) -> _System:
        def block(child: str, parent: str) -> Tensor:
            network = conditionals[child].network
            if network is None or parent not in network.weights:
                return torch.zeros(self._size(child), self._size(parent), dtype=torch.float64)
            weight: Tensor = network.weight(parent, self.steps)
            return weight.transpose(1, 2).reshape(self._size(child), self._size(parent))

        def stack(parents: tuple[str, ...]) -> Tensor:
            rows = [torch.cat([block(c, p) for p in parents], dim=1) for c in names] if parents else []
            return torch.cat(rows) if rows else torch.zeros(sum(map(self._size, names)), 0, dtype=torch.float64)

        biases, scales = [], []
        for name in names:
            conditional = conditionals[name]
            law = conditional.law
            linear = (
                isinstance(conditional.network, LinearNetwork)
                and isinstance(law, FixedNormalLaw)
                and isinstance(law.out, nn.Identity)
                and not law.residual
            )
            if not linear and not (conditional.network is None and isinstance(law, Gaussian)):
                raise ValueError(
                    f"{conditional.factor} is not linear-Gaussian: the oracle needs networks.Linear with "
                    "laws.FixedNormal(project=False), as dvae.oracle.twin builds, or without parents a normal"
                )
            zeros = {
                parent: torch.zeros(1, self._size(parent), dtype=torch.float64).unflatten(
                    1, (self.steps, -1) if self.model.generative.local(parent) else (-1,)
                )
                for parent in conditional.parents
            }
            location, scale = conditional(zeros, 1, self.steps)
            biases.append(location.flatten())
            scales.append(scale.flatten())
        return _System(stack(names), stack(data), torch.cat(biases), torch.cat(scales))

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
        _, means, precision = self._mixture()
        return means[0], precision

    def _mixture(self) -> tuple[Tensor, Tensor, Tensor]:
        """Of every course that the states may take: log probability (C,) and mean (C, N), and the precision of all."""
        model = self.model
        system = self._system(model.generator, (*model.latents, *model.observed), model.summed)
        rest = torch.eye(len(system.bias), dtype=torch.float64) - system.weights
        white = rest / system.scale[:, None]
        moved, logs = system.bias[None], torch.zeros(1, dtype=torch.float64)
        if model.sums is not None:
            states = model.sums.courses(self.steps)
            logs = sum((self._log_probability(name, states) for name in model.summed), logs)
            moved = moved + self._stack(states, model.summed) @ system.data_weights.t()
        return logs, torch.linalg.solve(rest, moved.t()).t(), white.t() @ white

    def _log_probability(self, name: str, states: Mapping[str, Tensor]) -> Tensor:
        """(C,), of courses of a variable that is summed out given those of the others."""
        conditional, value = self.model.generator[name], states[name]
        law = conditional.law.distribution(conditional(states, len(value), self.steps))
        logs: Tensor = (law.logits * value).flatten(1).sum(1)
        return logs

    def _guide(self) -> tuple[Tensor, Tensor, Tensor]:
        """Gain on the data, offset, and a root R of the covariance R R' of q(latents | data)."""
        system = self._system(self.model.encoder, self.model.latents, self.model.observed)
        rest = torch.eye(len(system.bias), dtype=torch.float64) - system.weights
        right = torch.cat([system.data_weights, system.bias[:, None], torch.diag(system.scale)], dim=1)
        solved = torch.linalg.solve(rest, right)
        data = system.data_weights.shape[1]
        return solved[:, :data], solved[:, data], solved[:, data + 1 :]

    def _stack(self, values: Mapping[str, Tensor], names: tuple[str, ...]) -> Tensor:
        return torch.cat([values[name].flatten(1) for name in names], dim=1)

    def evidence(self, x: Tensor | Mapping[str, Tensor]) -> Tensor:
        """log p(x), (B,), of data (B, T, D)."""
        seen = self.model.read(x)
        evidence: Tensor = self._weighed(self._stack(seen, self.model.observed)).logsumexp(1)
        return evidence + volume(seen) if LOG_DET in seen else evidence

    def _weighed(self, data: Tensor) -> Tensor:
        """(B, C): log joint of data (B, N) and each course that the states may take."""
        logs, means, precision = self._mixture()
        start = means.shape[1] - data.shape[1]
        covariance = torch.linalg.inv(precision)[start:, start:]
        law = torch.distributions.MultivariateNormal(means[:, start:], covariance)
        weighed: Tensor = logs + law.log_prob(data[:, None])
        return weighed

    def posterior(self, x: Tensor | Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Mean (B, N) and covariance (N, N) of the latents, stacked in the guide's order, given data (B, T, D).

        With discrete latents summed out the posterior is a mixture, and the covariance each sequence's own, (B, N, N).
        """
        data = self._stack(self.model.read(x), self.model.observed)
        _, means, precision = self._mixture()
        n = means.shape[1] - data.shape[1]
        within = torch.linalg.inv(precision[:n, :n])
        gain = -within @ precision[:n, n:]
        found = means[:, :n] + (data[:, None] - means[:, n:]) @ gain.t()  # (B, C, N)
        if not self.model.summed:
            return found[:, 0], within
        weights = self._weighed(data).softmax(1)
        mean = torch.einsum("bc,bci->bi", weights, found)
        away = found - mean[:, None]
        return mean, within + torch.einsum("bc,bci,bcj->bij", weights, away, away)

    def bound(self, x: Tensor | Mapping[str, Tensor]) -> Tensor:
        """The exact evidence lower bound of the model's guide, (B,): no draws are taken."""
        if not self.model.latents:
            return self.evidence(x)
        gain, offset, root = self._guide()
        mean, _ = self.posterior(x)
        data = self._stack(self.model.read(x), self.model.observed)
        n = len(mean.t())
        precision = self._joint()[1][:n, :n]
        difference = data @ gain.t() + offset - mean
        distance = torch.einsum("bi,ij,bj->b", difference, precision, difference)
        return self.evidence(x) - self._divergence(distance, precision, root)

    def gap(self) -> Tensor:
        """The expected evidence minus bound, in nats a sequence, over data drawn from the model."""
        gain, offset, root = self._guide()
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
        spread = (root.t() @ precision * root.t()).sum()
        log_volume = torch.linalg.slogdet(precision)[1] + 2 * torch.linalg.slogdet(root)[1]
        divergence: Tensor = 0.5 * (spread + distance - len(root) - log_volume)
        return divergence

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


@alone
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


@alone
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
    known, and no guide is involved. The search begins at the weights of p less those of the missing arrows. Without
    latents it is convex; with latents it could end in a local minimum, which is no less than the price.

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
    weights, scale = system.weights.numpy(), system.scale.numpy()
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

    start = np.concatenate([np.log(scale[n:]), root[free]])
    options = {"maxiter": 20_000, "maxfun": 40_000, "maxcor": 50, "ftol": 1e-14, "gtol": 1e-9}
    return float(scipy.optimize.minimize(divergence, start, jac=True, method="L-BFGS-B", options=options).fun)


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
