"""Discrete latents, summed out by the forward algorithm, and their posterior.

    p(v, x) = sum over k of prod_t p(k_t | k_{t-1}, ...) p(v_t | k_t, ...) p(x_t | k_t, ...)

The latents v are drawn, the data x are given, and the forward algorithm sums over k (Rabiner, 1989). Factors read k at
lags of at most L steps, so the recursion keeps the states of L + 1 steps only. Densities are computed before it, for
all steps in parallel. A factor that reads m consecutive steps of k is evaluated at every sequence of states with period
m. At each step, these sequences contain every combination of the m states once. Only the recursion is a loop, with
three small operations per step.

Static latents are enumerated in addition to the chain. Every variable contributes a term to the log joint: its log
density given all earlier variables with the states summed out, log p(x_t | v_{<=t}, x_{<t}). Bounds use these terms.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import one_hot

from ..distributions.scan import BLOCK
from ..factorization.notation import Factor, Factorization
from .conditional import like

LARGEST = 4096
"""Maximum number of joint states of a window and the static latents."""
WIDE = 2**11
"""Maximum number of transition terms per step, over all sequences, at which blocks of steps save time."""
MAX_SEQUENCES = 2**17
"""Maximum number of state sequences that are enumerated one by one."""


class Discrete(int):
    """Size of a categorical latent that is summed out, as a number of states; its values are one-hot vectors.

    The latent has a factor in the generative model and none in the guide.

    Args:
        states: number of states K, at least 2.

    Raises:
        ValueError: if there are fewer than two states.

    Example:
        >>> model = dvae.DynamicalVAE(
        ...     "p(k_t | k_{t-1}) p(x_t | k_t)", "", {"k": dvae.Discrete(3), "x": 2}
        ... )
        >>> model.summed, model.latents
        (('k',), ())
    """

    def __new__(cls, states: int) -> Self:
        """Create the size for a number of states."""
        if int(states) != states or states < 2:
            raise ValueError(f"a discrete latent needs a whole number of states, at least two, got {states}")
        return super().__new__(cls, states)

    def __repr__(self) -> str:
        return f"Discrete({self})"

    __str__ = int.__repr__


@dataclass(frozen=True)
class Window:
    """The summed-out latents that a factor reads.

    Args:
        factor: the factor.
        statics: names of the static latents that it reads.
        chain: names of the local latents that it reads.
        low, high: smallest and largest lag of these local latents, in steps.
    """

    factor: Factor
    statics: tuple[str, ...]
    chain: tuple[str, ...]
    low: int = 0
    high: int = 0

    @property
    def period(self) -> int:
        """Period of the state sequences that the factor is evaluated at, in steps."""
        return self.high - self.low + 1


@dataclass(frozen=True)
class EnumerationPlan:
    """The structure of the sum over a model's discrete latents.

    Args:
        generative: the generative factorization.
        sizes: dictionary from each summed-out latent to its number of states.

    Raises:
        ValueError: if the sum has too many states; the message states their number.
    """

    generative: Factorization
    sizes: Mapping[str, int]

    def __post_init__(self) -> None:
        states = self.n_static_states * self.width ** (self.lag + 1)
        if states > LARGEST:
            each = ", ".join(f"{name} has {size}" for name, size in self.sizes.items())
            raise ValueError(
                f"the discrete latents have {states:,} joint states in {self.lag + 1} consecutive steps ({each}), but "
                f"a sum supports at most {LARGEST:,}; use fewer states, or shorter lags"
            )

    @cached_property
    def statics(self) -> tuple[str, ...]:
        """Names of the static latents that are summed out."""
        return tuple(name for name in self.sizes if not self.generative.local(name))

    @cached_property
    def chain(self) -> tuple[str, ...]:
        """Names of the local latents that are summed out."""
        return tuple(name for name in self.sizes if self.generative.local(name))

    @cached_property
    def width(self) -> int:
        """K, number of joint states of the local latents at one step."""
        return math.prod(self.sizes[name] for name in self.chain)

    @cached_property
    def n_static_states(self) -> int:
        """M, number of joint states of the static latents."""
        return math.prod(self.sizes[name] for name in self.statics)

    @cached_property
    def windows(self) -> dict[str, Window]:
        """Dictionary from child to `Window`, for summed-out latents and their readers, in the order of sampling."""
        ordered = (self.generative.factor(name) for block in self.generative.blocks for name in block.names)
        windows = {factor.child: self._window(factor) for factor in ordered}
        return {name: w for name, w in windows.items() if name in self.sizes or w.statics or w.chain}

    @cached_property
    def readers(self) -> tuple[str, ...]:
        """Names of variables that read summed-out latents and are not summed out themselves."""
        return tuple(name for name in self.windows if name not in self.sizes)

    @cached_property
    def lag(self) -> int:
        """L, the largest lag of a factor to a summed-out latent, in steps."""
        return max((window.high for window in self.windows.values()), default=0)

    def require_data(self, replaced: Collection[str]) -> None:
        """Check that the model does not read data that are replaced by its own means or by noise.

        Raises:
            ValueError: if the model reads replaced data, since the replacements depend on the states.
        """
        parents = {parent.name for factor in self.generative.factors for parent in factor.parents}
        if unsupported := sorted(parents.intersection(replaced)):
            raise ValueError(
                f"{', '.join(self.sizes)} cannot be summed out: at missing entries and in scheduled sampling, the "
                f"model reads its own means or noise instead of {', '.join(unsupported)}, and these depend on the "
                f"states; fill in missing entries, omit scheduled sampling, or let no factor read "
                f"{', '.join(unsupported)}"
            )

    def _window(self, factor: Factor) -> Window:
        statics, chain, lags = [], [], [0]
        for parent in factor.parents:
            if parent.name not in self.sizes:
                continue
            if parent.relation is None:
                statics.append(parent.name)
                continue
            ends = [end for interval in parent.relation.intervals or [(-math.inf, 0)] for end in interval]
            if not factor.local or not all(-math.inf < end <= 0 for end in ends):
                raise ValueError(
                    f"{factor} reads {parent}, so {parent.name} cannot be summed out: the sum would have "
                    f"{self.sizes[parent.name]}^T terms. A factor of a local variable can read a discrete latent at "
                    f"fixed lags, such as {parent.name}_t or {parent.name}_{{t-1}}"
                )
            chain.append(parent.name)
            lags = [*(lags if len(chain) > 1 else []), *(int(-end) for end in ends)]
        return Window(factor, tuple(statics), tuple(chain), min(lags), max(lags))

    def state_sequences(self, length: int) -> dict[str, Tensor]:
        """Return all state sequences: name to one-hot values (C, T, states), or (C, states) for a static latent.

        Raises:
            ValueError: if there are too many to enumerate.
        """
        sizes = [self.sizes[name] for name in self.sizes for _ in range(length if name in self.chain else 1)]
        if (count := math.prod(sizes)) > MAX_SEQUENCES:
            raise ValueError(
                f"{', '.join(self.sizes)} have {count:.3g} state sequences in {length} steps, but at most "
                f"{MAX_SEQUENCES:,} can be enumerated; use fewer steps or states"
            )
        digits = np.stack(np.unravel_index(np.arange(count), sizes)).T
        sequences = {}
        for name, size in self.sizes.items():
            indices, digits = np.split(digits, [length if name in self.chain else 1], 1)
            values = one_hot(torch.from_numpy(indices.astype(np.int64)), size).double()
            sequences[name] = values if name in self.chain else values[:, 0]
        return sequences

    def patterns(self, window: Window, length: int) -> dict[str, Tensor]:
        """Return the n periodic state sequences that a factor is evaluated at, as integers.

        The result is a dictionary from latent to (n, T), or (n,) for a static latent.
        """
        sizes = [self.sizes[name] for name in window.statics]
        sizes += [self.sizes[name] for name in window.chain for _ in range(window.period)]
        digits = np.stack(np.unravel_index(np.arange(math.prod(sizes)), sizes or [1])).astype(np.int64)
        states = {name: torch.from_numpy(row) for name, row in zip(window.statics, digits, strict=False)}
        repeated = np.arange(length) % window.period
        for name, rows in zip(
            window.chain, np.split(digits[len(window.statics) :], len(window.chain) or 1), strict=False
        ):
            states[name] = torch.from_numpy(rows.T[:, repeated].copy())
        return states

    def places(self, window: Window, length: int) -> Tensor:
        """Return the index (T, J) of the pattern that contains, at each step, the states that the factor reads.

        If the child of the factor is summed out, the index also contains the child's state. The J joint states
        enumerate the static latents, then the chain at lags L to 0; the last one varies fastest.
        """
        names: list[tuple[str, int | None]] = [(name, None) for name in self.statics]
        names += [(name, lag) for lag in range(self.lag, -1, -1) for name in self.chain]
        sizes = [self.sizes[name] for name, _ in names]
        digits = dict(zip(names, np.unravel_index(np.arange(math.prod(sizes)), sizes or [1]), strict=False))
        t = np.arange(length)[:, None] if window.factor.local else np.zeros((1, 1), int)
        index = np.zeros((len(t), math.prod(sizes)), np.int64)
        for name in window.statics:
            index = index * self.sizes[name] + digits[name, None]
        for name in window.chain:
            for residue in range(window.period):  # the lag, seen from t, of the step with this residue
                lag = window.low + (t - window.low - residue) % window.period
                rows = np.stack([digits[name, offset] for offset in range(window.low, window.high + 1)])
                index = index * self.sizes[name] + rows[lag[:, 0] - window.low]
        offset = window.factor.child
        if offset in self.sizes:
            index = index * self.sizes[offset] + digits[offset, 0 if window.factor.local else None]
        return torch.from_numpy(index)

    @torch.inference_mode(False)
    def placed(self, window: Window, length: int, device: torch.device) -> tuple[dict[str, Tensor], Tensor]:
        """Return `patterns` and `places` on a device, where they are kept after the first call."""
        key = window.factor.child, length, device
        if key not in self._device_patterns:
            patterns = {name: value.to(device) for name, value in self.patterns(window, length).items()}
            self._device_patterns[key] = patterns, self.places(window, length).to(device)
        return self._device_patterns[key]

    @cached_property
    def _device_patterns(self) -> dict[Any, tuple[dict[str, Tensor], Tensor]]:
        return {}


class Enumeration:
    """The sum over discrete latents in one run, given all other variables.

    Args:
        sums: structure of the sum.
        rollout: run (`Rollout`) with values of all variables that the latents and their readers read.

    Raises:
        ValueError: if the model reads its own means or noise instead of data, since these depend on the states.
    """

    def __init__(self, sums: EnumerationPlan, rollout: Any):
        self.sums, self.rollout, self.values = sums, rollout, dict(rollout.values)
        sums.require_data(rollout.hidden.keys() | rollout.noisy)
        logs = {name: self._logs(name, window) for name, window in sums.windows.items()}
        self._static = {name: value for name, value in logs.items() if not sums.generative.local(name)}
        self._local = {name: value for name, value in logs.items() if sums.generative.local(name)}
        none = like(next(iter(rollout.conditionals.values()))).new_zeros(())
        shape = (rollout.batch, rollout.length, sums.n_static_states, sums.width**sums.lag, sums.width)
        self._start = sum(self._static.values(), none).expand(shape[0], sums.n_static_states)
        self._steps = sum(self._local.values(), none).expand(shape)

    def _logs(self, name: str, window: Window) -> Tensor:
        """Return the log density or log probability of a variable in every joint state of the discrete latents.

        Args:
            name: name of the variable.
            window: summed-out latents that its factor reads.

        Returns:
            (B, T, M, K^L, K) for a local variable, or (B, M) for a static one; B is 1 if all sequences have the same
            values.
        """
        sums, run, local = self.sums, self.rollout, window.factor.local
        conditional, is_summed = run.conditionals[name], name in sums.sizes
        patterns, places = sums.placed(window, run.length, like(conditional).device)
        count = len(next(iter(patterns.values()))) if patterns else 1
        values = {n: one_hot(v, sums.sizes[n]).to(like(conditional)) for n, v in patterns.items()}
        if values.keys() == {*conditional.parents}:  # equal for all sequences
            parameters = conditional(values, count, run.length)
        else:
            repeated = run.repeat(count)
            repeated.values |= {n: v.repeat_interleave(run.batch, 0) for n, v in values.items()}
            parameters = conditional(repeated.known, repeated.batch, run.length, repeated.lengths)
        distribution = conditional.distribution(tuple(p.unflatten(0, (count, -1)) for p in parameters))
        if is_summed:
            logs = distribution.logits  # type: ignore[attr-defined]
        else:
            mask = run.mask(name)
            logs = distribution.log_prob(conditional.scored(run.values[name], mask))
            logs = logs if mask is None else torch.where(mask, logs, 0.0)
            logs = logs if conditional.whole else logs.sum(-1)
        logs = logs.reshape(count, -1, len(places), self.sums.sizes.get(name, 1)).permute(1, 2, 0, 3).flatten(2)
        logs = logs.gather(2, places.expand(len(logs), -1, -1))
        shape = (sums.n_static_states, sums.width**sums.lag, sums.width)
        return logs.unflatten(2, shape) if local else logs[:, 0].unflatten(1, shape)[..., 0, 0]

    @cached_property
    def shares(self) -> dict[str, Tensor]:
        """Dictionary from each reader to its log density given all earlier variables: (B, T), or (B,) if static."""
        filtered = self._forward(self._start, self._steps)[:, :-1, ..., None].expand_as(self._steps)
        shares = {}
        for logs, sofar in ((self._static, torch.zeros_like(self._start)), (self._local, filtered)):
            states = tuple(range(1 if logs is self._static else 2, sofar.dim()))
            for name, each in logs.items():
                last, sofar = sofar, sofar + each
                if name not in self.sums.sizes:
                    shares[name] = sofar.logsumexp(states) - last.logsumexp(states)
        return shares

    def _forward(self, start: Tensor, steps: Tensor) -> Tensor:
        """Return the log joint (B, T + 1, M, K^L) of states and variables so far, up to a constant per step."""
        alpha = start[..., None].expand(*start.shape, self.sums.width**self.sums.lag)
        steps = steps - steps.detach().amax((2, 3, 4), keepdim=True)  # a large sum would lose digits
        if not self.sums.lag:  # no transition depends on earlier states
            return torch.cat([alpha[:, None], alpha[:, None] + steps.logsumexp(-1).cumsum(1)], 1)
        return forward_sums(alpha, steps)

    @torch.no_grad()
    def draw(self) -> dict[str, Tensor]:
        """Draw states from their posterior given all other variables, one-hot: (B, T, C), or (B, C) if static."""
        width, rows = self.sums.width, torch.arange(len(self._start), device=self._start.device)
        joint = (self._forward(self._start, self._steps)[:, :-1, ..., None] + self._steps).flatten(3)
        last = _draw_index(joint[:, -1].flatten(1))
        static, window = last // joint.shape[-1], last % joint.shape[-1]
        symbols = [window % width]
        for t in reversed(range(joint.shape[1] - 1)):  # the window of the next step contains all but the oldest state
            newer = window // width
            oldest = _draw_index(joint[rows, t, static].unflatten(1, (width, -1))[rows, :, newer])
            window = oldest * width**self.sums.lag + newer
            symbols.append(window % width)
        states = {}
        for names, number in ((self.sums.statics, static), (self.sums.chain, torch.stack(symbols[::-1], 1))):
            for name in reversed(names):
                states[name] = one_hot(number % self.sums.sizes[name], self.sums.sizes[name]).to(self._start)
                number = number // self.sums.sizes[name]
        return states

    @torch.enable_grad()
    def probabilities(self) -> dict[str, Tensor]:
        """Return posterior probabilities (B, T, C), or (B, C) if static, as gradients of the log density."""
        parts = [part.detach().contiguous().requires_grad_() for part in (self._start, self._steps)]
        total = self._forward(*parts)[:, -1].flatten(1).logsumexp(1).sum()
        static, steps = torch.autograd.grad(total, parts)
        posterior = {}
        for names, each in ((self.sums.statics, static), (self.sums.chain, steps.sum((2, 3)))):
            joint = each.unflatten(-1, [self.sums.sizes[name] for name in names] or [1])
            first = each.dim() - 1
            for index, name in enumerate(names):
                others = [first + other for other in range(len(names)) if other != index]
                posterior[name] = joint.sum(others) if others else joint
        return posterior


def forward_sums(start: Tensor, steps: Tensor) -> Tensor:
    """Run the forward algorithm and return log sums (..., B, T + 1, M, W).

    Long sequences run in blocks (`distributions.scan`) from each of the W states: a block is a step from W states to W.

    Args:
        start: log weights (..., B, M, W) of the states at the start.
        steps: log densities (B, T, M, W, K) of each step from each of the W states.
    """
    batch, length, statics, window, width = steps.shape
    if length >= 4 * BLOCK and batch * statics * window**2 * width <= WIDE:
        padded = torch.cat([steps, steps.new_zeros(batch, -length % BLOCK, statics, window, width)], 1)
        blocks = padded.unflatten(1, (-1, BLOCK)).flatten(0, 1)
        never = torch.finfo(steps.dtype).min / 1000  # infinite values have no gradient
        identity = torch.full_like(steps[0, 0, 0, :, :1].expand(-1, window), never).fill_diagonal_(0.0)
        within = forward_sums(identity[:, None, None].expand(-1, len(blocks), statics, -1), blocks)[:, :, 1:]
        within = within.unflatten(1, (batch, -1))  # (W, B, blocks, BLOCK, M, W)
        starts = forward_sums(start, within[:, :, :, -1].movedim(0, 3))[:, :-1]
        joint = starts.movedim(3, 0)[:, :, :, None, :, None] + within
        return torch.cat([start[:, None], joint.logsumexp(0).flatten(1, 2)[:, :length]], 1)
    alphas = [start]
    for step in steps.unbind(1):
        joint = alphas[-1][..., None] + step
        alphas.append(joint.flatten(-2).unflatten(-1, (width, -1)).logsumexp(-2))
    return torch.stack(alphas, -3)


def _draw_index(logits: Tensor) -> Tensor:
    """Draw an index of the last dimension with these logits."""
    return torch.multinomial(logits.softmax(-1), 1)[:, 0]
