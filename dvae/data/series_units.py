"""View of each sequence relative to its own level and scale, which are estimated from its earlier values.

    u_t = f(x_t) - b_t                 f: the identity, or the logarithm of positive data
    y_t = (u_t - m_t) / s_t            the model's x

The base b_t is 0 for L = 0, the last value f(x_{t-1}) for L = 1, and for a season of L > 1 steps the mean of
f(x_{t-L}), f(x_{t-2L}), ... m_t and s_t are the location and scale of the one-step prediction of u_t under a normal
distribution with unknown mean and variance, given u_1, ..., u_{t-1} (Gelman et al., Bayesian Data Analysis, 2013,
section 3.3):

    m_t = (k m + sum u) / (k + n)      s_t^2 = v_t (1 + 1 / (k + n))
    v_t = (d v + S + k n / (k + n) (mean u - m)^2) / (d + n)

n is the number of earlier values and S the sum of their squares about their mean. The prior (m, k, v, d) is estimated
from training sequences. After `observed` steps, m_t, s_t and the means of seasons no longer change, as in RevIN (Kim et
al., 2022), so a forecast has one level and one scale. A value without a base is standardised by the mean and standard
deviation of f(x) in the training data.

The map is triangular with diagonal f'(x_t) / s_t, so densities and bounds of a model with this view are densities of
the data. A model whose y_t is 0 forecasts the level of the sequence with L = 0, a linear trend from the last value with
L = 1, because m_t is a mean change, and earlier seasons with L > 1. What the model predicts is added to this forecast.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from typing_extensions import override

from ..factorization.notation import Factorization
from .batch import WHOLE, Batch
from .views import View, given_entries

LOCATION, SCALE, STATE = "x_location", "x_scale", "x_state"
"""Names of the entries that the view adds: location and scale of each step, and the state after the last step."""


class SeriesPrior(NamedTuple):
    """Prior of the level and scale of one coordinate's u_t; the module docstring defines the symbols.

    Args:
        mean: m.
        weight: k, in steps: the variance within sequences divided by the variance of their means.
        variance: v.
        freedom: d, in steps.
        level, spread: mean and standard deviation of f(x), which standardise a value without an earlier one if L > 0.
        logarithm: whether f is the logarithm.
    """

    mean: float = 0.0
    weight: float = 1.0
    variance: float = 1.0
    freedom: float = 1.0
    level: float = 0.0
    spread: float = 1.0
    logarithm: bool = False

    @classmethod
    def estimate(cls, windows: np.ndarray, lag: int = 0, logarithm: bool = False) -> SeriesPrior:
        """Estimate the prior from training windows, by moments (Smyth, 2004, section 6, for d and v).

        Args:
            windows: values (N, T), NaN where missing; at least one is observed.
            lag: L.
            logarithm: whether f is the logarithm.
        """
        z = torch.from_numpy(np.log(windows) if logarithm else np.asarray(windows, np.float64))[..., None]
        level, spread = float(np.nanmean(z)), float(np.nanstd(z))
        base, count, present = torch.zeros_like(z), torch.ones_like(z), ~z.isnan()
        if lag:
            base, count, _ = _last_values(z, present) if lag == 1 else _means_by_phase(z, present, lag)
        u = torch.where(present & (count > 0), z - base, torch.nan)[..., 0].numpy()
        numbers = (~np.isnan(u)).sum(1)
        u, numbers = u[numbers > 2], numbers[numbers > 2]
        if not len(u):
            return cls(0.0, 1.0, spread**2 or 1.0, 1.0, level, spread or 1.0, logarithm)
        means, variances, degrees = np.nanmean(u, 1), np.nanvar(u, 1, ddof=1), numbers - 1.0
        within = max(float((degrees * variances).sum() / degrees.sum()), 1e-12 * spread**2, 1e-36)
        between = float(means.var() - (within / numbers).mean())
        freedom, variance = _inverse_chi_square(variances, degrees, within)
        weight = float(np.clip(within / max(between, 1e-9 * within), 1e-6, 100.0))
        return cls(float(means.mean()), weight, variance, freedom, level, spread or 1.0, logarithm)


def _inverse_chi_square(variances: np.ndarray, degrees: np.ndarray, within: float) -> tuple[float, float]:
    """Return d and v of the scaled inverse chi-square prior of variances, each estimated with its degrees of freedom.

    The logarithm of an estimated variance has the variance psi'(degrees / 2) + psi'(d / 2) and a known mean.
    """
    from scipy.optimize import brentq  # slow to import
    from scipy.special import digamma, polygamma

    positive = variances > 1e-9 * within  # windows without variation have no logarithm
    if positive.sum() < 2:
        return 1.0, within
    half = degrees[positive] / 2
    logarithms = np.log(variances[positive]) - digamma(half) + np.log(half)
    excess = float(logarithms.var(ddof=1) - polygamma(1, half).mean())
    least, most = 2.0, 100.0
    bounds = polygamma(1, [least / 2, most / 2])
    freedom = least if excess >= bounds[0] else most
    if bounds[1] < excess < bounds[0]:
        freedom = float(brentq(lambda d: float(polygamma(1, d / 2)) - excess, least, most))
    return freedom, float(np.exp(logarithms.mean() + digamma(freedom / 2) - np.log(freedom / 2)))


@dataclass(frozen=True)
class SeriesUnits(View):
    """Values of each sequence relative to its own level and scale; the module docstring gives the equations.

    A forecast from fewer than `observed` steps keeps the level and scale of its last step. The state that continues a
    sequence has 3 + 2 L rows: count, sum and sum of squares of u - m; then, for each of the next L steps, the number of
    values in its base; then these bases.

    Args:
        priors: prior of each coordinate of x; None for a coordinate that the view does not change.
        lag: L, in steps.
        observed: number of steps after which level and scale no longer change; None for never.
    """

    priors: tuple[SeriesPrior | None, ...]
    lag: int = 0
    observed: int | None = None
    names = (LOCATION, SCALE, STATE)
    exact = names
    by_coordinate = True

    def __post_init__(self) -> None:
        if self.observed is not None and self.lag > self.observed:
            raise ValueError(f"lag is {self.lag} and observed {self.observed}; lag must be at most observed")

    @override
    def check(self, sizes: Mapping[str, int], context: Collection[str], generative: Factorization) -> None:
        if sizes.get(WHOLE) != len(self.priors):
            raise ValueError(f"the view has priors of {len(self.priors)} coordinates, but x has {sizes.get(WHOLE)}")

    @override
    def __call__(self, data: Batch, view_inputs: Batch | None = None) -> Batch:
        if WHOLE not in data or LOCATION in data:
            return data
        if view_inputs is not None:
            location, scale = self._frozen(self._transform(data), view_inputs[STATE])
            return data | {WHOLE: (self._transform(data) - location) / scale}
        location, scale, state = self._units(data)
        y = (self._transform(data) - location) / scale
        return data | {WHOLE: y, LOCATION: location, SCALE: scale, STATE: state}

    @override
    def inverse(self, model_values: Batch) -> Batch:
        y = model_values[WHOLE]
        if STATE not in model_values:
            return model_values | {WHOLE: self._original(self._generate(y))}
        state = model_values[STATE]
        known = model_values[LOCATION].shape[1] if LOCATION in model_values else 0
        z = y[..., :known, :]
        if known:
            z = model_values[LOCATION][:, : y.shape[-2]] + model_values[SCALE][:, : y.shape[-2]] * z
        if y.shape[-2] > known:
            z = torch.cat([z, self._continue(y[..., known:, :], state)], -2)
        others = {name: value for name, value in model_values.items() if name not in self.names}
        return Batch(others) | {WHOLE: self._original(z)}

    @override
    def following(self, data: Batch) -> Batch:
        return Batch({name: value for name, value in data.items() if name not in (LOCATION, SCALE)})

    @override
    def log_det(self, data: Batch) -> Tensor:
        _, scale, _ = self._units(data)
        use_log = self._constants(scale)["logarithm"] > 0
        return -scale.log() - torch.where(use_log, self._transform(data), 0.0)

    def _constants(self, like: Tensor) -> dict[str, Tensor]:
        """Return the fields of the priors, (D,) each, and whether each coordinate changes."""
        rows = [prior or SeriesPrior() for prior in self.priors]
        table = torch.tensor([[float(each) for each in row] for row in rows], dtype=torch.float64, device=like.device)
        changed = torch.tensor([prior is not None for prior in self.priors], device=like.device)
        return {**dict(zip(SeriesPrior._fields, table.T, strict=True)), "changed": changed}

    def _transform(self, data: Batch) -> Tensor:
        """Return f(x) (B, T, D) in float64, 0 at missing entries."""
        x, mask = data[WHOLE].double(), data.mask()
        use_log = self._constants(x)["logarithm"] > 0
        present = torch.ones_like(x, dtype=torch.bool) if mask is None else mask
        return torch.where(present, torch.where(use_log, torch.where(present & use_log, x, 1.0).log(), x), 0.0)

    def _original(self, z: Tensor) -> Tensor:
        """Invert f."""
        use_log = self._constants(z)["logarithm"] > 0
        return torch.where(use_log, torch.where(use_log, z, 0.0).exp(), z)

    def _units(self, data: Batch) -> tuple[Tensor, Tensor, Tensor]:
        """Return location and scale (B, T, D) of each step, and the state (B, R, D) after the last step."""
        z, mask = self._transform(data), data.mask()
        steps, constants = z.shape[1], self._constants(z)
        present = torch.ones_like(z, dtype=torch.bool) if mask is None else mask
        adapts = (torch.arange(steps, device=z.device) < (steps if self.observed is None else self.observed))[:, None]
        base, count = torch.zeros_like(z), torch.ones_like(z)
        following = z[:, :0]
        if self.lag == 1:
            base, count, following = _last_values(z, present)
        elif self.lag:
            base, count, following = _means_by_phase(z, present & adapts, self.lag)
        counted = present & adapts & (count > 0)
        deviation = torch.where(counted, z - base - constants["mean"], 0.0)
        sums = torch.stack([counted.double(), deviation, deviation.square()], 1).cumsum(2)
        earlier = torch.cat([torch.zeros_like(sums[:, :, :1]), sums[:, :, :-1]], 2)
        location, scale = self._predict(earlier.unbind(1), base, count, constants)
        return location, scale, torch.cat([sums[:, :, -1], following], 1)

    def _predict(
        self, sums: Sequence[Tensor], base: Tensor, count: Tensor, constants: Mapping[str, Tensor]
    ) -> tuple[Tensor, Tensor]:
        """Return location and scale of f(x_t).

        Args:
            sums: count, sum and sum of squares of u - m over earlier steps (..., D).
            base: b_t (..., D).
            count: number of values in the base (..., D); 0 if there is none.
            constants: result of `_constants`.
        """
        number, total, squares = sums
        weight = constants["weight"] + number
        variance = constants["freedom"] * constants["variance"] + squares - total.square() / weight
        variance = (variance / (constants["freedom"] + number)).clamp(min=1e-36)
        location = torch.where(count > 0, base + constants["mean"] + total / weight, constants["level"])
        scale = torch.where(count > 0, (variance * (1 + 1 / weight)).sqrt(), constants["spread"])
        changed = constants["changed"]
        return torch.where(changed, location, 0.0), torch.where(changed, scale, 1.0)

    def _following(self, state: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return base, location and scale (..., B, P, D) of the P = max(L, 1) steps after a state."""
        count, base = torch.ones_like(state[..., :1, :]), torch.zeros_like(state[..., :1, :])
        if self.lag:
            count, base = state[..., 3:, :].chunk(2, -2)
        sums = [each[..., None, :] for each in state[..., :3, :].unbind(-2)]
        return base, *self._predict(sums, base, count, self._constants(state))

    def _frozen(self, z: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Return location and scale of known values z (B, H, D) after a state, which does not change."""
        _, location, scale = self._following(state)
        phase = torch.arange(z.shape[1], device=z.device) % location.shape[1]
        location, scale = location[:, phase], scale[:, phase]
        if self.lag != 1 or z.shape[1] == 1:
            return location, scale
        sums, one = [each[:, None] for each in state[:, :3].unbind(1)], torch.ones_like(z[:, 1:])
        later = self._predict(sums, z[:, :-1], one, self._constants(z))
        return tuple(torch.cat([first[:, :1], rest], 1) for first, rest in zip((location, scale), later, strict=True))  # type: ignore[return-value]

    def _continue(self, y: Tensor, state: Tensor) -> Tensor:
        """Return f(x) (..., B, H, D) after a state (B, R, D); with L = 1, later steps read the earlier ones."""
        _, location, scale = self._following(state)
        if self.lag != 1:
            phase = torch.arange(y.shape[-2], device=y.device) % location.shape[-2]
            return location[..., phase, :] + scale[..., phase, :] * y
        first = location + scale * y[..., :1, :]
        sums = [each[:, None] for each in state[:, :3].unbind(1)]
        constants = self._constants(y)
        mean, scale = self._predict(sums, torch.zeros_like(first), torch.ones_like(first), constants)
        z = torch.cat([first, mean + scale * y[..., 1:, :]], -2)
        return torch.where(constants["changed"], z.cumsum(-2), z)

    def _generate(self, y: Tensor) -> Tensor:
        """Return f(x) (..., T, D) of sequences from their first step on."""
        lag, constants, values = self.lag, self._constants(y), list[Tensor]()
        state = y.new_zeros(*y.shape[:-2], 3 + 2 * lag, y.shape[-1], dtype=torch.float64)
        for t, each in enumerate(y.double().unbind(-2)):
            base, location, scale = (part[..., 0, :] for part in self._following(state))
            values.append(location + scale * each)
            deviation, adapts = values[-1] - base - constants["mean"], self.observed is None or t < self.observed
            state = state.clone()
            if adapts and t >= lag:
                state[..., :3, :] += torch.stack([torch.ones_like(deviation), deviation, deviation.square()], -2)
            if lag == 1:
                state[..., 3, :], state[..., 4, :] = 1, values[-1]
            elif lag:
                counts, means = state[..., 3:, :].clone().chunk(2, -2)
                if adapts:
                    counts[..., 0, :] += 1
                    means[..., 0, :] += (values[-1] - means[..., 0, :]) / counts[..., 0, :]
                state = torch.cat([state[..., :3, :], counts.roll(-1, -2), means.roll(-1, -2)], -2)
        return torch.stack(values, -2)


@dataclass(frozen=True)
class GivenUnits(SeriesUnits):
    """Values of each sequence relative to one level and one scale, which are estimated from its given entries.

    Level and scale are m_t and s_t of `SeriesUnits` with L = 0, given the entries of `views.given_entries` at all
    steps. Densities refer to the other entries.
    """

    @override
    def _units(self, data: Batch) -> tuple[Tensor, Tensor, Tensor]:
        z, given = self._transform(data), given_entries(data, self.observed)
        constants = self._constants(z)
        deviation = torch.where(given, z - constants["mean"], 0.0)
        state = torch.stack([given.double(), deviation, deviation.square()], 1).sum(2)
        zero = torch.zeros_like(z[:, :1])
        location, scale = self._predict(state[:, :, None].unbind(1), zero, zero + 1, constants)
        return location.expand_as(z), scale.expand_as(z), state

    @override
    def log_det(self, data: Batch) -> Tensor:
        return torch.where(given_entries(data, self.observed), 0.0, super().log_det(data))


def _last_values(z: Tensor, present: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the last value before each step (B, T, D), whether there is one, and both after the end (B, 2, D)."""
    index = torch.where(present, torch.arange(z.shape[1], device=z.device)[:, None], -1).cummax(1).values
    values, exists = z.gather(1, index.clamp(min=0)), (index >= 0).double()
    before, existed = (torch.cat([torch.zeros_like(each[:, :1]), each[:, :-1]], 1) for each in (values, exists))
    return before, existed, torch.stack([exists[:, -1], values[:, -1]], 1)


def _means_by_phase(z: Tensor, present: Tensor, lag: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return the mean of z_{t-L}, z_{t-2L}, ... for each step (B, T, D), their number, and both for the next L steps.

    Args:
        z: values (B, T, D).
        present: whether each value counts.
        lag: L.
    """
    steps = z.shape[1]
    more = -steps % lag  # steps that complete the last period
    values = torch.stack([present.double(), torch.where(present, z, 0.0)])
    values = torch.cat([values, torch.zeros_like(values[:, :, :1]).expand(-1, -1, more, -1)], 2).unflatten(2, (-1, lag))
    sums = torch.cat([torch.zeros_like(values[:, :, :1]), values.cumsum(2)], 2)  # entry p: the sums before period p
    count, total = sums
    mean = total / count.clamp(min=1)
    before, number = (each[:, :-1].flatten(1, 2)[:, :steps] for each in (mean, count))
    return before, number, torch.cat([each[:, -1].roll(more, 1) for each in (count, mean)], 1)
