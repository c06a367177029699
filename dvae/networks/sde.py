"""LinearSDE: the exact transition of a linear stochastic differential equation, for steps at irregular times.

    dz = A z dt + L dW        z_1 ~ N(0, I)        d_t: time since the previous step (the gap)

    p(z_t | z_{t-1}, d_t) = N(F z_{t-1}, Q)        F = e^{A d_t},  Q = int_0^{d_t} e^{A s} L L' e^{A' s} ds

In the chosen coordinates, the stationary distribution is N(0, I), that is A + A' + L L' = 0, and the noise of the
coordinates is independent:

    A = S - diag(r)        L L' = 2 diag(r)        S' = -S,  r > 0

The solution of every stable linear equation whose noise reaches all coordinates is a linear map of the solution of such
an equation, or of a limit with some r going to 0. The networks that read z learn this map. The parameterisation has
three consequences. The variance does not grow over a long gap, and after an infinite gap z follows its initial
distribution. The first step of a sequence needs no distribution of its own. Omitting a step is equivalent to merging
two gaps.

LinearSDEGuide multiplies a transition of the same form by a Gaussian potential, computed from all other parents:

    q(z_t | z_{t-1}, d_t, ...) = N(F z_{t-1}, Q) N(e_t; W_t' z_t, I) / constant

If e_t and W_t represent the likelihood of z_t given the data from t on in a linear-Gaussian model, this is the exact
posterior of that model.

(Särkkä and Solin, Applied Stochastic Differential Equations, 2019, chapter 6. A guide with the prior's transition and
potentials from a network: Johnson et al., 2016, arXiv 1603.06277.)
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor, nn
from typing_extensions import override

from ..distributions.triangular import InverseCholesky, Triangular, refuse_half
from .base import Input, Network, NetworkSpec
from .loop import at, memoize, select, shift, valid_steps
from .recurrent import Recurrent

ORDER = 22
"""Terms of the series over a gap of norm 1: in double precision the remainder is below rounding, 2^22 / 23! = 2e-16."""


@dataclass(frozen=True)
class LinearSDE:
    """A network for p(z_t | z_{t-1}, d_t), the transition of a linear SDE over a gap, for `distributions.Triangular`.

    Args:
        times: range of the initial relaxation times 1 / r of the coordinates, in the unit of the gaps.

    Example:
        >>> networks = {"p(z)": dvae.networks.LinearSDE(), "q(z)": dvae.networks.LinearSDEGuide()}
        >>> distributions = {"p(z)": dvae.distributions.Triangular(), "q(z)": dvae.distributions.Triangular()}
        >>> pair = "p(z_t | z_{t-1}, d_t) p(x_t | z_t)", "q(z_t | z_{t-1}, x_{1:T}, d_{1:T})"
        >>> model = dvae.DynamicalVAE(*pair, {"z": 4, "x": 3, "d": 1}, networks, distributions)
        >>> model.sample(batch={"d": 10 * torch.rand(5, 20, 1) + 0.1})["x"].shape
        torch.Size([5, 20, 3])
    """

    times: tuple[float, float] = (1.0, 100.0)

    def build(self, inputs: Sequence[Input], local: bool, size: int) -> LinearSDENetwork:
        """Return the network of a factor p(z_t | z_{t-1}, d_t), for z of dimension `size`.

        Args:
            inputs: the parents of the factor.
            local: whether the child has a value at every step; otherwise it is static.
            size: D, dimension of the child.

        Raises:
            ValueError: the parents differ from z_{t-1} and d_t, or `times` are not positive, finite and in order.
        """
        before = [p for p in inputs if p.lags == (-1,) and p.size == size]
        gaps = [p for p in inputs if p.lags == (0,) and p.size == 1]
        if not (local and len(before) == len(gaps) == 1 and len(inputs) == 2):
            raise ValueError(
                "LinearSDE needs two parents, the child's last value and a gap of size 1, as in p(z_t | z_{t-1}, d_t), "
                + _describe_parents(inputs, size)
            )
        return LinearSDENetwork(inputs, before[0], gaps[0].name, self.times)


@dataclass(frozen=True)
class LinearSDEGuide:
    """The transition of a `LinearSDE` times a Gaussian potential, for `distributions.Triangular`.

    Under a prior with little noise, the guide must know how z rotates over a gap. A general network of z_{t-1} and the
    gap would have to learn this for gaps of every length; this guide computes it from its equation. To use the prior's
    own equation, and compute it once, call `networks.base.share_modules(networks, "equation")` with the networks of
    both factors.

    Args:
        potential: specification of the network that computes e_t and W_t from all parents except z_{t-1}.
        times: range of the initial relaxation times, as in `LinearSDE`.
        gap: name of the parent d_t, the time since the previous step, which `potential` reads too.
    """

    potential: NetworkSpec = field(default_factory=Recurrent)
    times: tuple[float, float] = (1.0, 100.0)
    gap: str = "d"

    def build(self, inputs: Sequence[Input], local: bool, size: int) -> LinearSDEGuideNetwork:
        """Return the network of a factor q(z_t | z_{t-1}, d_t, ...), for z of dimension `size`.

        Args:
            inputs: the parents of the factor.
            local: whether the child has a value at every step; otherwise it is static.
            size: D, dimension of the child.

        Raises:
            ValueError: z_{t-1} or the gap is missing among the parents, or `times` are not positive, finite and in
                order.
        """
        before = [p for p in inputs if p.lags == (-1,) and p.size == size]
        gaps = [p for p in inputs if p.name == self.gap and p.relation and p.relation.reads(0, 2) and p.size == 1]
        if not (local and len(before) == len(gaps) == 1):
            raise ValueError(
                f"LinearSDEGuide needs the child's last value and a gap {self.gap} of size 1 among its parents, as in "
                f"q(z_t | z_{{t-1}}, x_{{1:T}}, {self.gap}_{{1:T}}), " + _describe_parents(inputs, size)
            )
        return LinearSDEGuideNetwork(self, inputs, before[0])


def _describe_parents(inputs: Sequence[Input], size: int) -> str:
    parents = ", ".join(f"{p.name} at {p.relation and p.relation.name} ({p.size})" for p in inputs)
    return f"but the parents of this child of size {size} are {parents}"


class Equation(nn.Module):
    """The parameters A and L L' of a linear stochastic differential equation, and its transitions over gaps.

    Args:
        size: D, dimension of z.
        times: initial relaxation times, as in `LinearSDE`.
    """

    unit: Tensor

    def __init__(self, size: int, times: tuple[float, float]):
        super().__init__()
        shortest, longest = times
        if not 0 < shortest <= longest < math.inf:
            raise ValueError(f"`times` must be (shortest, longest), positive, finite and in this order, got {times}")
        quantiles = (torch.arange(size) + 0.5) / size
        self.log_rate = nn.Parameter(-math.log(shortest) - math.log(longest / shortest) * quantiles)
        root = (0.5 * self.log_rate.detach()).exp()
        self.turning = nn.Parameter(0.3 * shortest * torch.randn(size, size) * root * root[:, None])  # dimensionless
        self.register_buffer("unit", torch.tensor(1 / shortest))

    @property
    def drift(self) -> Tensor:
        """A, (D, D)."""
        return self.unit * (self.turning - self.turning.mT) - self.log_rate.exp().diag()

    @property
    def noise(self) -> Tensor:
        """L L', (D, D)."""
        return 2 * self.log_rate.exp().diag()

    def at_all(self, gaps: Tensor, lengths: Tensor | None, name: str) -> tuple[Tensor, Tensor]:
        """Return F and the whitening matrix of Q, (B, T, D, D) each, at all steps.

        Args:
            gaps: d, (B, T, 1); the value at the first step is ignored.
            lengths: (B,) number of valid steps of each sequence, or None.
            name: name of the gaps in error messages.

        Raises:
            ValueError: a gap is not positive and finite.
        """

        def compute() -> tuple[Tensor, Tensor]:
            has_previous = torch.ones_like(gaps[..., 0], dtype=torch.bool)
            if lengths is not None:
                has_previous &= valid_steps(lengths, gaps.shape[1])
            has_previous[:, 0] = False
            return self.over(gaps[..., 0], has_previous, name)

        return memoize(self, [gaps, lengths], compute)

    def over(self, gaps: Tensor, has_previous: Tensor, name: str, first: int = 0) -> tuple[Tensor, Tensor]:
        """Return F and the whitening matrix of Q, (B, T, D, D) each; equal gaps are computed once.

        Args:
            gaps: d, (B, T).
            has_previous: (B, T), False if there is no previous step and z follows its stationary distribution.
            name: name of the gaps in error messages.
            first: number of the first of the T steps, counted from 0, for error messages.

        Raises:
            ValueError: a gap is not positive and finite.
        """
        if (bad := has_previous & ~((gaps > 0) & (gaps < math.inf))).any():
            row, t = bad.nonzero()[0].tolist()
            raise ValueError(
                f"{name} is {gaps[row, t]:g} at step {first + t} of sequence {row}, counted from 0; a gap, the time "
                "since the previous step, must be positive and finite: merge values at one time into one step"
            )
        distinct = gaps[has_previous]
        positions = torch.arange(len(distinct), device=gaps.device)
        if not gaps.requires_grad:
            distinct, positions = distinct.unique(return_inverse=True)
        refuse_half(self.log_rate.dtype)
        with torch.autocast(gaps.device.type, enabled=False):
            decay, covariance = transition(self.drift, self.noise, distinct.to(self.log_rate.dtype))
            # the last entry draws from the stationary distribution, independently of the previous value
            decay = torch.cat([decay, torch.zeros_like(self.turning)[None]])
            whitening = torch.cat(
                [
                    InverseCholesky.apply(covariance),
                    torch.eye(len(self.turning), dtype=decay.dtype, device=decay.device)[None],
                ]
            )
        index = torch.full(gaps.shape, len(distinct), device=gaps.device)
        index[has_previous] = positions
        return decay[index], whitening[index]


class LinearSDENetwork(Network):
    """Network of `LinearSDE`; the features are location and flattened whitening matrix, (..., D + D * D).

    Args:
        inputs: the parents.
        before: the parent z_{t-1}.
        gap: name of the parent d_t.
        times: range of the initial relaxation times, as in `LinearSDE`.
    """

    head = Triangular
    stationary = True

    def __init__(self, inputs: Sequence[Input], before: Input, gap: str, times: tuple[float, float]):
        super().__init__(inputs, True, before.size + before.size**2)
        self.before, self.gap, self.size = before.name, gap, before.size
        self.equation: Any = Equation(before.size, times)

    @override
    def forward(self, parents: Mapping[str, Tensor], length: int, lengths: Tensor | None = None) -> Tensor:
        decay, whitening = self.equation.at_all(parents[self.gap], lengths, self.gap)
        return _features(decay, None, whitening, shift(parents[self.before], -1))

    @override
    def start(self, parents: Mapping[str, Tensor], batch: int, length: int, lengths: Tensor | None = None) -> Any:
        transitions = None
        if self.gap in parents:
            transitions = tuple(part.unbind(1) for part in self.equation.at_all(parents[self.gap], lengths, self.gap))
        return transitions, parents[self.before].unbind(1) if self.before in parents else None, lengths

    @override
    def step(self, state: Any, t: int, samples: Mapping[str, Sequence[Tensor]]) -> tuple[Tensor, Any]:
        transitions, previous, lengths = state
        decay, whitening = self.transition_at(t, transitions, lengths, samples)
        return _features(decay, None, whitening, self._last(previous, t, samples, decay)), state

    def transition_at(
        self, t: int, transitions: Any, lengths: Tensor | None, samples: Mapping[str, Sequence[Tensor]]
    ) -> tuple[Tensor, Tensor]:
        """Return F and the whitening matrix of Q, (B, D, D) each, at step t.

        Args:
            t: the step, counted from 0.
            transitions: both for all steps, or None if the loop draws the gaps.
            lengths: (B,) number of valid steps of each sequence, or None.
            samples: as in `step`.
        """
        if transitions is not None:
            decays, whitenings = transitions
            return decays[t], whitenings[t]
        gaps = samples[self.gap][t]
        has_previous = torch.full_like(gaps, t > 0, dtype=torch.bool)
        if lengths is not None:
            has_previous &= (t < lengths)[:, None]
        decay, whitening = self.equation.over(gaps, has_previous, self.gap, t)
        return decay[:, 0], whitening[:, 0]

    def _last(self, previous: Any, t: int, samples: Mapping[str, Sequence[Tensor]], like: Tensor) -> Tensor:
        return at(samples[self.before] if previous is None else previous, t - 1, like, self.size)


class LinearSDEGuideNetwork(LinearSDENetwork):
    """Network of `LinearSDEGuide`."""

    def __init__(self, spec: LinearSDEGuide, inputs: Sequence[Input], before: Input):
        super().__init__(inputs, before, spec.gap, spec.times)
        size = before.size
        self.potential = spec.potential.build([p for p in inputs if p is not before], True, size)
        self.stationary = self.potential.stationary
        self.out = nn.Linear(self.potential.features, size + size**2)
        with torch.no_grad():  # initially, the potential observes every coordinate with unit noise
            self.out.weight[size:] *= 0.1
            self.out.bias[size:] = torch.eye(size).flatten()

    @override
    def forward(self, parents: Mapping[str, Tensor], length: int, lengths: Tensor | None = None) -> Tensor:
        return _features(*self._at_all(parents, length, lengths), shift(parents[self.before], -1))

    @override
    def start(self, parents: Mapping[str, Tensor], batch: int, length: int, lengths: Tensor | None = None) -> Any:
        if all(parent.name in parents for parent in self.potential.inputs):
            transitions = tuple(part.unbind(1) for part in self._at_all(parents, length, lengths))
            return transitions, parents[self.before].unbind(1) if self.before in parents else None, lengths, None
        others = {parent.name: parents[parent.name] for parent in self.potential.inputs if parent.name in parents}
        return *super().start(parents, batch, length, lengths), self.potential.start(others, batch, length, lengths)

    @override
    def step(self, state: Any, t: int, samples: Mapping[str, Sequence[Tensor]]) -> tuple[Tensor, Any]:
        transitions, previous, lengths, potential = state
        if potential is None:
            decay, offset, whitening = (part[t] for part in transitions)
            return _features(decay, offset, whitening, self._last(previous, t, samples, decay)), state
        decay, whitening = self.transition_at(t, transitions, lengths, samples)
        features, potential = self.potential.step(potential, t, samples)
        last = self._last(previous, t, samples, decay)
        return _features(*self.updated(decay, whitening, features), last), (transitions, previous, lengths, potential)

    @override
    def select(self, state: Any, rows: Tensor | None) -> Any:
        *own, potential = state
        return *select(tuple(own), rows), None if potential is None else self.potential.select(potential, rows)

    def _at_all(
        self, parents: Mapping[str, Tensor], length: int, lengths: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        decay, whitening = self.equation.at_all(parents[self.gap], lengths, self.gap)
        others = {parent.name: parents[parent.name] for parent in self.potential.inputs}
        return self.updated(decay, whitening, self.potential(others, length, lengths))

    def updated(self, decay: Tensor, whitening: Tensor, features: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return M (..., D, D), c (..., D) and V (..., D, D) of q(z_t | z_{t-1}, ...) = N(M z_{t-1} + c, (V'V)^-1).

        With G = U'^-1 W, where U whitens Q, the only inverted matrix is I + G'G, which is close to I over short gaps.

        Args:
            decay, whitening: F and U, (..., D, D) each.
            features: (..., H) features of the network `potential`.
        """
        with torch.autocast(decay.device.type, enabled=False):
            observation, scale = self.out(features.to(decay)).split([self.size, self.size**2], dim=-1)
            weight = scale.unflatten(-1, decay.shape[-2:])
            g = torch.linalg.solve_triangular(whitening.mT, weight, upper=True)
            identity = torch.eye(self.size, dtype=g.dtype, device=g.device)
            # lower triangular T with T'T = I + G G': Cholesky factor of the matrix with rows and columns reversed
            root = torch.linalg.cholesky((identity + g @ g.mT).flip(-1, -2)).flip(-1, -2).mT
            inner = torch.linalg.cholesky(identity + g.mT @ g)
            gain = torch.linalg.solve_triangular(whitening, torch.cholesky_solve(g.mT, inner).mT, upper=False)
            return decay - gain @ (weight.mT @ decay), (gain @ observation[..., None])[..., 0], root @ whitening


def _features(decay: Tensor, offset: Tensor | None, whitening: Tensor, before: Tensor) -> Tensor:
    with torch.autocast(decay.device.type, enabled=False):
        loc = (decay @ before.to(decay)[..., None])[..., 0]
    return torch.cat([loc if offset is None else loc + offset, whitening.flatten(-2)], dim=-1)


def transition(drift: Tensor, noise: Tensor, gaps: Tensor) -> tuple[Tensor, Tensor]:
    """Return F = e^{A d} and Q = int_0^d e^{A s} N e^{A' s} ds, (K, D, D) each, for dz = A z dt + L dW.

    The function sums a series for the gap d / 2^k and doubles the gap k times: F(2d) = F(d)^2 and
    Q(2d) = Q(d) + F(d) Q(d) F(d)'. It stores F - I in place of F, so there is no cancellation, and both results are
    accurate for the shortest gaps. For stable A they are also accurate for the longest gaps, where the single matrix
    exponential of Van Loan (1978) overflows.

    Args:
        drift: A, (D, D).
        noise: N = L L', (D, D).
        gaps: d, (K,), positive.
    """
    norm = torch.linalg.matrix_norm(drift.detach(), 1)
    doublings = max(0, math.frexp(float(gaps.detach().max() * norm))[1]) if len(gaps) else 0
    rate, moves, spreads = drift / norm, [drift / norm], [noise / norm]
    for n in range(2, ORDER + 1):
        moves.append(rate @ moves[-1] / n)
        half = rate @ spreads[-1] / n
        spreads.append(half + half.mT)
    powers = (gaps * (norm / 2**doublings))[:, None] ** torch.arange(1, ORDER + 1, device=gaps.device)
    change, covariance = ((powers @ torch.stack(p).flatten(1)).unflatten(-1, drift.shape) for p in (moves, spreads))
    identity, size = torch.eye(len(drift), dtype=drift.dtype, device=drift.device), len(drift)
    for _ in range(doublings):
        product = (identity + change) @ torch.cat([change, covariance], dim=-1)
        covariance = torch.baddbmm(covariance, product[..., size:], (identity + change).mT)
        change = change + product[..., :size]
    return identity + change, covariance
