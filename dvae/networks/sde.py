"""LinearSDE: the exact transition of a linear stochastic differential equation, for steps at irregular times.

    dz = A z dt + L dW        z_1 ~ N(0, I)        d_t, the time since the step before

    p(z_t | z_{t-1}, d_t) = N(F z_{t-1}, Q)        F = e^{A d_t},  Q = int_0^{d_t} e^{A s} L L' e^{A' s} ds

The coordinates are those in which the stationary law is N(0, I), which is to say A + A' + L L' = 0, and in which noise
enters each by itself:

    A = S - diag(r)        L L' = 2 diag(r)        S' = -S,  r > 0

Every stable linear equation whose noise spreads to all coordinates is a linear map of one of these, or of a limit as
some r vanish, and what reads z learns that map. So nothing grows in a gap however long, at the end of which z is as at
the start; the first step of a sequence has no law of its own; and to leave out a step is to make one gap of two.

(Särkkä and Solin, Applied Stochastic Differential Equations, 2019, chapter 6.)
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from typing_extensions import override

from ..laws.triangular import InverseCholesky, Triangular, refuse_half
from .base import Input, Network, at, shift, valid_steps

ORDER = 22
"""Terms of the series over a gap of norm 1: in double precision the rest is below rounding, 2^22 / 23! = 2e-16."""


@dataclass(frozen=True)
class LinearSDE:
    """A linear stochastic differential equation from z_{t-1} over a gap, for the law `laws.Triangular`; see the file.

    Args:
        times: between which the coordinates' times of forgetting, 1 / r, are spread at the start; in the unit of gaps.

    Example:
        >>> parts = {"p(z)": dvae.networks.LinearSDE()}, {"p(z)": dvae.laws.Triangular()}
        >>> pair = "p(z_t | z_{t-1}, d_t) p(x_t | z_t)", "q(z_t | z_{t-1}, x_{1:T}, d_{1:T})"
        >>> model = dvae.DynamicalVAE(*pair, {"z": 4, "x": 3, "d": 1}, *parts)
        >>> model.sample(batch={"d": 10 * torch.rand(5, 20, 1) + 0.1})["x"].shape
        torch.Size([5, 20, 3])
    """

    times: tuple[float, float] = (1.0, 100.0)

    def build(self, inputs: Sequence[Input], local: bool, size: int) -> LinearSDENetwork:
        """The network of a factor p(z_t | z_{t-1}, d_t), for z of dimension `size`.

        Raises:
            ValueError: other parents, or times that are not positive or not in order.
        """
        if not 0 < self.times[0] <= self.times[1] < math.inf:
            raise ValueError(f"times are positive, the shortest and the longest, but these are {self.times}")
        before = [p for p in inputs if p.lags == (-1,) and p.size == size]
        gaps = [p for p in inputs if p.lags == (0,) and p.size == 1]
        if not (local and len(before) == len(gaps) == 1 and len(inputs) == 2):
            raise ValueError(
                "a LinearSDE network goes from a variable's last value over a gap of size 1, p(z_t | z_{t-1}, d_t), "
                f"but for a child of size {size} the parents here are "
                + ", ".join(f"{p.name} at {p.relation and p.relation.name} ({p.size})" for p in inputs)
            )
        return LinearSDENetwork(self, before[0], gaps[0])


class LinearSDENetwork(Network):
    """What `LinearSDE` describes; the features are location and whitening matrix, (..., D + D * D)."""

    law = Triangular

    def __init__(self, spec: LinearSDE, before: Input, gap: Input):
        size = before.size
        super().__init__([before, gap], True, size + size**2)
        self.before, self.gap = before.name, gap.name
        shortest, longest = map(math.log, spec.times)
        places = (torch.arange(size) + 0.5) / size
        self.log_rate = nn.Parameter(-shortest - (longest - shortest) * places)
        root = (0.5 * self.log_rate.detach()).exp()
        self.turning = nn.Parameter(0.3 * torch.randn(size, size) * root * root[:, None])

    @property
    def drift(self) -> Tensor:
        """A, (D, D)."""
        return self.turning - self.turning.mT - self.log_rate.exp().diag()

    @property
    def noise(self) -> Tensor:
        """L L', (D, D)."""
        return 2 * self.log_rate.exp().diag()

    def over(self, gaps: Tensor, first: Tensor) -> tuple[Tensor, Tensor]:
        """F and the whitening matrix of Q, (..., D, D) each, over gaps (...); once for gaps that are equal.

        Args:
            gaps: d.
            first: (...) True where z is from its stationary law, whatever the gap.
        """
        distinct = gaps[~first]
        place = torch.arange(len(distinct), device=gaps.device)
        if not gaps.requires_grad:
            distinct, place = distinct.unique(return_inverse=True)
        refuse_half(self.log_rate.dtype)
        with torch.autocast(gaps.device.type, enabled=False):
            decay, covariance = transition(self.drift, self.noise, distinct.to(self.log_rate.dtype))
            # the last is that from the stationary law, which forgets all
            decay = torch.cat([decay, torch.zeros_like(self.turning)[None]])
            whitening = torch.cat([InverseCholesky.apply(covariance), torch.eye(len(self.turning)).to(decay)[None]])
        which = torch.full(gaps.shape, len(distinct), device=gaps.device)
        which[~first] = place
        return decay[which], whitening[which]

    def refuse(self, gaps: Tensor, counted: Tensor, first: int = 0) -> None:
        """Refuses gaps (B, T) that count and are not positive."""
        if (bad := counted & ~((gaps > 0) & (gaps < math.inf))).any():
            row, t = bad.nonzero()[0].tolist()
            raise ValueError(
                f"{self.gap} is {gaps[row, t]:g} at step {first + t} of sequence {row}, counted from 0; a gap is the "
                "time since the step before, in its own unit and above 0 (values at one time make one step)"
            )

    def _transitions(self, gaps: Tensor, lengths: Tensor | None) -> tuple[Tensor, Tensor]:
        """Of all steps, (B, T, D, D) each, from gaps (B, T)."""
        counted = torch.ones_like(gaps, dtype=torch.bool)
        if lengths is not None:
            counted &= valid_steps(lengths, gaps.shape[1])
        counted[:, 0] = False  # nothing is before the first step
        self.refuse(gaps, counted)
        return self.over(gaps, ~counted)

    @override
    def forward(self, parents: Mapping[str, Tensor], length: int, lengths: Tensor | None = None) -> Tensor:
        decay, whitening = self._transitions(parents[self.gap][..., 0], lengths)
        return _features(decay, whitening, shift(parents[self.before], -1))

    @override
    def start(self, given: Mapping[str, Tensor], batch: int, length: int, lengths: Tensor | None = None) -> Any:
        made = None
        if self.gap in given:
            made = tuple(part.unbind(1) for part in self._transitions(given[self.gap][..., 0], lengths))
        return made, given[self.before].unbind(1) if self.before in given else None

    @override
    def step(self, state: Any, t: int, drawn: Mapping[str, Sequence[Tensor]]) -> tuple[Tensor, Any]:
        made, known = state
        if made is None:  # the loop draws the gaps too
            gaps = drawn[self.gap][t]
            self.refuse(gaps, torch.full_like(gaps, t > 0, dtype=torch.bool), t)
            decay, whitening = self.over(gaps[:, 0], torch.full_like(gaps[:, 0], t == 0, dtype=torch.bool))
        else:
            decay, whitening = made[0][t], made[1][t]
        before = at(drawn[self.before] if known is None else known, t - 1, decay, decay.shape[-1])
        return _features(decay, whitening, before), state


def _features(decay: Tensor, whitening: Tensor, before: Tensor) -> Tensor:
    with torch.autocast(decay.device.type, enabled=False):
        loc = (decay @ before.to(decay)[..., None])[..., 0]
    return torch.cat([loc, whitening.flatten(-2)], dim=-1)


def transition(drift: Tensor, noise: Tensor, gaps: Tensor) -> tuple[Tensor, Tensor]:
    """F = e^{A d} and Q = int_0^d e^{A s} N e^{A' s} ds, (K, D, D) each: dz = A z dt + L dW over gaps of length d.

    By series over d / 2^k, and k doublings, F(2d) = F(d)^2 and Q(2d) = Q(d) + F(d) Q(d) F(d)'. Nothing that is large
    is taken from anything (F - I is carried in place of F), so that both keep their digits over the shortest gaps, and
    over the longest where A is stable; Van Loan's one exponential of both (1978) overflows there.

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
        moved = (identity + change) @ torch.cat([change, covariance], dim=-1)
        covariance = torch.baddbmm(covariance, moved[..., size:], (identity + change).mT)
        change = change + moved[..., :size]
    return identity + change, covariance
